"""The interface of every simulator: many transitions under many parameter vectors, as one batch."""

from __future__ import annotations

import abc
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace

#: MuJoCo's own bound on a state it still calls stable (mjMAXVAL).
DIVERGED = 1e10

#: What a simulator takes: a tensor, or anything that NumPy makes an array of.
Numbers = torch.Tensor | npt.ArrayLike


class Simulator(abc.ABC):
    """Simulates T transitions under each of K parameter vectors.

    A simulator holds no state between calls: results depend on the arguments alone, whatever was
    simulated before, the number of threads and the size of the chunks in which it works.

    Attributes:
        differentiable: whether autograd reaches ``states``, ``controls`` and ``values``.
        remedy: what to do about it where it does not.
        parameters: what varies, d parameters.
        frame_skip: physics steps of one logged transition.
        history: logged steps before each transition whose controls come with it, for what remembers them.
        past: logged steps before each transition whose states may come with it, ``(T, past + 1, num_states)``, NaN
            where nothing is known of them.
        num_states: width of a state, ``nq + nv`` for a MuJoCo model.
        num_controls: width of a control, ``nu``.
        notes: how it simulates otherwise than the model's options say, in sentences for a person.
        timestep: seconds of one logged transition, or ``None`` if the simulator does not say.
    """

    differentiable: ClassVar[bool] = False
    remedy: str = "use backend: warp"
    name: ClassVar[str]
    parameters: ParameterSpace
    frame_skip: int
    history: int = 0
    past: int = 0
    num_states: int
    num_controls: int
    timestep: float | None
    notes: tuple[str, ...] = ()

    def simulate(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after ``lag`` transitions, the last of :meth:`rollout`.

        Arguments are tensors, arrays or lists; the result is a tensor.

        Args:
            states: initial states, ``(T, num_states)``, float64, or after those of ``past`` steps before it.
            controls: the controls of each transition, after those of ``history`` steps before it,
                ``(T, history + lag, num_controls)``.
            values: parameter vectors in their units, ``(K, d)``.

        Returns:
            ``(T, K, num_states)``, float64. A simulation that diverges is NaN throughout.

        Raises:
            InputError: shapes that do not fit, or gradients asked of a simulator that has none.
        """
        return self.rollout(states, controls, values)[:, :, -1]

    @abc.abstractmethod
    def rollout(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after each of the ``lag`` transitions, ``(T, K, lag, num_states)``.

        The arguments are those of :meth:`simulate`, whose result is the last of these.
        """

    def arrays(self, states: Numbers, controls: Numbers, values: Numbers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the arguments as float64 arrays; see :meth:`tensors`."""
        start, control, vectors = (x.detach().cpu().double().numpy() for x in self.tensors(states, controls, values))
        return start, control, vectors

    def tensors(
        self, states: Numbers, controls: Numbers, values: Numbers
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the arguments as tensors, once :meth:`check_arguments` finds that they fit.

        Raises:
            InputError: what is no number, shapes that do not fit, or gradients asked of a simulator that has none.
        """
        given = {"states": states, "controls": controls, "values": values}
        start, control, vectors = (_tensor(name, numbers) for name, numbers in given.items())
        self.check_arguments(start, control, vectors)
        asked = torch.is_grad_enabled() and not self.differentiable
        for name, tensor in zip(given, (start, control, vectors), strict=True):
            if asked and tensor.requires_grad:
                raise InputError(
                    f"{name}: gradients are asked (requires_grad), but backend {self.name} has none; {self.remedy}, or "
                    f"give {name}.detach()"
                )
        return start, control, vectors

    def check_arguments(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> None:
        """Raise an :class:`InputError` for arguments whose shapes do not fit."""
        expected = {
            "states": (states, 2, self.num_states, "(T, nq + nv)"),
            "controls": (controls, 3, self.num_controls, "(T, lag, nu)"),
            "values": (values, 2, len(self.parameters), "(K, d)"),
        }
        for name, (array, ndim, width, shape) in expected.items():
            if array.ndim != ndim or array.shape[-1] != width:
                raise InputError(f"{name}: shape {tuple(array.shape)} given; expected {shape} with {width} columns")
        if len(states) != len(controls):
            raise InputError(f"controls: {len(controls)} rows given for {len(states)} states; expected one each")
        if controls.shape[1] <= self.history:
            before = f"{self.history} before each transition, and " if self.history else ""
            raise InputError(f"controls: {controls.shape[1]} logged steps given; expected {before}lag 1 or more")


def _tensor(name: str, numbers: Numbers) -> torch.Tensor:
    """A tensor of what was given, on the CPU and in float64 unless it was one."""
    if isinstance(numbers, torch.Tensor):
        return numbers
    try:
        return torch.tensor(np.asarray(numbers, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: {error}; expected numbers in an array or a tensor") from None
