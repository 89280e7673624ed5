"""The task of hitting: one action is a whole motion, after which the puck is to lie at a target."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from dropo_torch.models.load import load_model
from dropo_torch.rl.task import Task

from . import SIM
from .generator import LATENT, STEPS, load_decoder
from .policy import HOME, PUCK

#: Where the puck is to stop, x and y, m.
TARGET = (0.74, 0.03)


class PuckTask(Task):
    """Hit the puck so that it stops at a target: a contextual bandit.

    An episode is one step. The action is a point z of the latent space of :mod:`dropo_sims.puck.generator`, whose
    decoder makes a motion of it. The observation is where the puck lies, about its usual place, and the target. The
    reward is the paper's, −d² − log(d + 1e-3), with the distance d in meters.

    Args:
        model: an arm with a puck; the bundled one by default.
        target: where the puck is to stop, m.
    """

    name = "puck"
    frame_skip = SIM.frame_skip * STEPS
    max_episode_steps = 1
    num_observations = 4
    puck_noise = 0.005

    def __init__(self, model: mujoco.MjModel | None = None, target: tuple[float, float] = TARGET) -> None:
        self.model = load_model(SIM.model) if model is None else model
        self.target = torch.tensor(target, dtype=torch.float64)
        self.action_low, self.action_high = -2 * np.ones(LATENT), 2 * np.ones(LATENT)
        self._decoder = load_decoder()

    def controls(self, actions: torch.Tensor) -> torch.Tensor:
        """Return the motions' targets of the joints, ``(N, STEPS, 7)``, rad."""
        return self._decoder(actions.float().cpu()).to(actions)

    def initial_states(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return the arm at home, and the puck with uniform noise, ``(count, 27)``."""
        rest = np.concatenate([self.model.qpos0, np.zeros(self.model.nv)])
        rest[:7] = HOME
        states = torch.from_numpy(rest).repeat(count, 1)
        states[:, 7:9] += self.puck_noise * (2 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1)
        return states

    def observe(self, states: torch.Tensor) -> torch.Tensor:
        """Return the puck's place in half centimeters about its usual one, and the target in decimeters, ``(N, 4)``."""
        puck = (states[:, 7:9] - torch.from_numpy(PUCK).to(states)) / self.puck_noise
        return torch.cat([puck, 10 * (self.target.to(states) - torch.from_numpy(PUCK).to(states)).expand_as(puck)], 1)

    def reward(self, states: torch.Tensor, actions: torch.Tensor, next_states: torch.Tensor) -> torch.Tensor:
        """Return the paper's reward of where the puck has stopped, ``(N,)``."""
        distance = self.distance(next_states)
        return -distance.square() - torch.log(distance + 1e-3)

    def terminated(self, next_states: torch.Tensor) -> torch.Tensor:
        """Return that every episode ends, ``(N,)`` bool."""
        return torch.ones(len(next_states), dtype=torch.bool, device=next_states.device)

    def distance(self, states: torch.Tensor) -> torch.Tensor:
        """Return how far the puck lies from the target, ``(N,)``, m."""
        return (states[:, 7:9] - self.target.to(states)).norm(dim=1)
