"""The Hopper's task, with the numbers of Gymnasium's Hopper-v5: hop forward, do not fall, spare the motors."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from dropo_torch.models.load import load_model
from dropo_torch.rl.task import Task

from . import SIM


class HopperTask(Task):
    """Hop forward as fast as possible.

    The observation is ``qpos`` without the horizontal position, then ``qvel`` clipped to ±10. The reward is the
    forward speed, 1 for standing upright, and minus a thousandth of the squared actions. An episode ends when the
    Hopper falls.

    Args:
        model: a Hopper; the bundled one by default.
    """

    name = "hopper"
    frame_skip = SIM.frame_skip
    max_episode_steps = 1000
    num_observations = 11
    healthy_reward = 1.0
    control_cost_weight = 1e-3
    reset_noise = 5e-3
    lowest_height = 0.7
    largest_angle = 0.2
    largest_state = 100.0
    largest_velocity = 10.0

    def __init__(self, model: mujoco.MjModel | None = None) -> None:
        self.model = load_model(SIM.model) if model is None else model

    def initial_states(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return the model's rest position with uniform noise, ``(count, 12)``."""
        rest = torch.from_numpy(np.concatenate([self.model.qpos0, np.zeros(self.model.nv)]))
        noise = torch.rand(count, len(rest), generator=generator, dtype=torch.float64)
        return rest + self.reset_noise * (2 * noise - 1)

    def observe(self, states: torch.Tensor) -> torch.Tensor:
        """Return ``qpos[1:]`` and clipped velocities, ``(N, 11)``."""
        return torch.cat([states[:, 1:6], states[:, 6:].clamp(-self.largest_velocity, self.largest_velocity)], 1)

    def reward(self, states: torch.Tensor, actions: torch.Tensor, next_states: torch.Tensor) -> torch.Tensor:
        """Return forward speed, plus 1 where it has not fallen, minus the control cost, ``(N,)``."""
        speed = (next_states[:, 0] - states[:, 0]) / self.timestep
        cost = self.control_cost_weight * actions.square().sum(1)
        return speed + self.healthy_reward * self._healthy(next_states) - cost

    def terminated(self, next_states: torch.Tensor) -> torch.Tensor:
        """Return which have fallen, ``(N,)`` bool."""
        return ~self._healthy(next_states)

    def _healthy(self, states: torch.Tensor) -> torch.Tensor:
        upright = (states[:, 1] > self.lowest_height) & (states[:, 2].abs() < self.largest_angle)
        return upright & (states[:, 2:].abs() < self.largest_state).all(1)
