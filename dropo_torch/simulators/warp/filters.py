"""Where actuators' filters are when a transition starts: what the MuJoCo backend does, differentiably."""

from __future__ import annotations

import mujoco
import torch

from dropo_torch.simulators.hidden import control_range, filters_of


class FilterStarts:
    """Replays the filters of a model over the controls before transitions.

    Args:
        model: the model.
        skip: physics steps of a logged step.
        history: logged steps of controls before each transition; without any, filters start settled at the first.

    Attributes:
        actuators: the actuators that have a filter, F of them.

    Raises:
        InputError: actuators that remember otherwise; see :func:`~dropo_torch.simulators.hidden.filters_of`.
    """

    def __init__(self, model: mujoco.MjModel, *, skip: int, history: int) -> None:
        filters = filters_of(model)
        acting = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        self.actuators = filters.actuators if acting else filters.actuators[:0]
        self._controls = torch.from_numpy(filters.controls)
        self._allowed = torch.from_numpy(control_range(model)[0]), torch.from_numpy(control_range(model)[1])
        self._ranges = torch.from_numpy(filters.ranges)
        self._exact, self._rk4 = torch.from_numpy(filters.exact), model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        self._step, self._skip, self._history = float(model.opt.timestep), skip, history

    def __call__(self, controls: torch.Tensor, constants: torch.Tensor) -> torch.Tensor:
        """Return the activations before the controls of transitions, ``(T, K, F)``.

        Args:
            controls: those of the transitions, after those before them, ``(T, history + lag, nu)``; what stands behind
                them is not looked at.
            constants: time constants, ``(K, F)`` or ``(T, K, F)``.
        """
        before = controls[:, : max(self._history, 1)]
        wanted = before[..., : len(self._allowed[0])].clamp(*self._allowed)[..., self._controls][:, :, None]
        found = wanted[:, 0].clamp(*self._ranges)
        left = self._decay(constants) ** self._skip
        for step in range(self._history):
            found = (wanted[:, step] + (found - wanted[:, step]) * left).clamp(*self._ranges)
        return found.expand(-1, constants.shape[-2], -1)

    def _decay(self, constants: torch.Tensor) -> torch.Tensor:
        """See :meth:`~dropo_torch.simulators.hidden.Filters.decay`."""
        x = self._step / constants.clamp(min=mujoco.mjMINVAL)
        rate = 1 - x / 2 + x**2 / 6 - x**3 / 24 if self._rk4 else 1.0
        return 1 - rate * torch.where(self._exact, -torch.expm1(-x), x)
