"""Environments on Warp kernels: on a GPU, states, parameters and commands never leave it."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from dropo_torch.effects.placing import EffectSet
from dropo_torch.effects.simulator import check_backend
from dropo_torch.models.constants import derive
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl.effects import inside_model, no_effects
from dropo_torch.rl.stepper import BatchStepper
from dropo_torch.simulators.warp.engine import Batch, Engine


class WarpStepper(BatchStepper):
    """Environments on :class:`~dropo_torch.simulators.warp.WarpSimulator`'s kernels, in float64.

    A state is all that is kept between steps, with activations that are zero when an episode starts: the kernels solve
    every step's constraints to convergence, from a cold start.

    Args:
        space: what varies, over the model that is simulated.
        num_envs: environments N.
        frame_skip: physics steps of an environment step.
        effects: effects, of which those inside the simulation are applied here.
        num_threads: threads of a CPU, 0 for all processors; results do not depend on it.
        device: ``"cpu"`` or a CUDA device.

    Raises:
        InputError: a model, a parameter or an effect that the kernels do not know.
    """

    #: Environments in memory at a time, on a CPU.
    CHUNK = 4096

    def __init__(
        self, space: ParameterSpace, num_envs: int, *, frame_skip: int, effects: EffectSet | None = None,
        num_threads: int = 0, device: str = "cpu",
    ) -> None:  # fmt: skip
        effects = effects or no_effects(space, frame_skip)
        check_backend("warp", effects, space)
        model, self._finer, _ = inside_model(space, effects)
        derive(model)
        self.num_envs, self.frame_skip, self.num_states = num_envs, frame_skip, model.nq + model.nv
        self._engine = Engine(
            model, space.on(model), skip=frame_skip * self._finer,
            chunk_size=self.CHUNK if device == "cpu" else num_envs, num_threads=num_threads, device=device,
        )  # fmt: skip
        self._device = wp.device_to_torch(device)
        base = torch.from_numpy(self._engine.fields.constant())
        self._theta = base.repeat(num_envs, 1).to(self._device)
        width = self.num_states + self._engine.tables.na
        self._states = torch.zeros(num_envs, width, dtype=torch.float64, device=self._device)

    def reset(self, rows: torch.Tensor, states: torch.Tensor, values: torch.Tensor) -> None:
        """Start new episodes; see :meth:`BatchStepper.reset`."""
        at, width = rows.to(self._device), self._states.shape[1]
        self._theta[at] = self._engine.fields(values.cpu()).to(self._device)
        self._states[at] = torch.nn.functional.pad(states, (0, width - states.shape[1])).to(self._device)

    def step(self, controls: torch.Tensor) -> torch.Tensor:
        """Make an environment step; see :meth:`BatchStepper.step`."""
        count = controls.shape[1]
        given = controls.to(self._device, torch.float64).contiguous()
        skip = self.frame_skip * self._finer // count
        flat, _ = self._engine.simulate(Batch(self._theta, self._states, given, skip, paired=True), keep=False)
        path = flat.view(self.num_envs, count, -1)
        self._states = path[:, -1].clone()  # apart from what is returned: a reset writes into it
        return path[..., : self.num_states]

    def state_dict(self) -> dict[str, Any]:
        """Return the states; see :meth:`BatchStepper.state_dict`."""
        return {"states": self._states.cpu().clone()}

    def load_state_dict(self, state: dict[str, Any], values: torch.Tensor) -> None:
        """Go on from a state; see :meth:`BatchStepper.load_state_dict`."""
        self.reset(torch.arange(self.num_envs), state["states"], values)
