"""The task of pushing: the box is to lie at a target, and the arm's joints are to move little."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from dropo_torch.models.load import load_model
from dropo_torch.rl.task import Task

from . import SIM
from .policy import START

#: Targets on the table, x and y, m; those of the paper's environment.
TARGETS = ((0.75, 0.0), (0.7, 0.1), (0.7, -0.1), (0.65, -0.2), (0.7, 0.05))
#: Number of joints.
JOINTS = 7


class PushTask(Task):
    """Push the box to a target.

    The observation is the joints' positions and velocities, then of the box its way to the target, its way from the
    rod's tip, sine and cosine of its heading, and its velocities; lengths in decimeters. The reward of a step is that
    of the paper, −d² − log(d² + 1e-3) with the distance d in meters, less a share of the squared actions. Actions are
    velocities of the joints in shares of ``fastest``. No episode ends early, unless the box tips over.

    Args:
        model: an arm with a box; the bundled one by default.
        target: which of :data:`TARGETS`.
    """

    name = "push"
    frame_skip = SIM.frame_skip
    max_episode_steps = 150
    num_observations = 2 * JOINTS + 12
    fastest = 0.6
    control_cost_weight = 0.05
    reset_noise = 0.02
    box_noise = 0.01
    lowest_upright = 0.7

    def __init__(self, model: mujoco.MjModel | None = None, target: int = 0) -> None:
        self.model = load_model(SIM.model) if model is None else model
        self.target = torch.tensor(TARGETS[target], dtype=torch.float64)
        self.action_low, self.action_high = -np.ones(JOINTS), np.ones(JOINTS)
        self._chain = _chain(self.model)

    def controls(self, actions: torch.Tensor) -> torch.Tensor:
        """Return velocities of the joints, ``(N, 7)``, rad/s."""
        return self.fastest * actions

    def initial_states(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return the arm behind the box, joints and place of the box with uniform noise, ``(count, 27)``."""
        rest = np.concatenate([self.model.qpos0, np.zeros(self.model.nv)])
        rest[:JOINTS] = START
        states = torch.from_numpy(rest).repeat(count, 1)
        noise = 2 * torch.rand(count, JOINTS + 2, generator=generator, dtype=torch.float64) - 1
        states[:, :JOINTS] += self.reset_noise * noise[:, :JOINTS]
        states[:, JOINTS : JOINTS + 2] += self.box_noise * noise[:, JOINTS:]
        return states

    def observe(self, states: torch.Tensor) -> torch.Tensor:
        """Return what the policy sees, ``(N, 26)``."""
        joints, box, speeds = states[:, :JOINTS], states[:, JOINTS : JOINTS + 3], states[:, JOINTS + 7 :]
        w, x, y, z = states[:, JOINTS + 3 : JOINTS + 7].unbind(1)
        sine, cosine = 2 * (w * z + x * y), 1 - 2 * (y * y + z * z)
        to_target, from_tip = self.target.to(box) - box[:, :2], box - self.tip(joints)
        return torch.cat([
            joints, speeds[:, :JOINTS], 10 * to_target, 10 * from_tip, sine[:, None], cosine[:, None],
            10 * speeds[:, JOINTS : JOINTS + 2], speeds[:, JOINTS + 3 :],
        ], 1)  # fmt: skip

    def reward(self, states: torch.Tensor, actions: torch.Tensor, next_states: torch.Tensor) -> torch.Tensor:
        """Return the paper's reward of the box's distance, less the control cost, ``(N,)``."""
        squared = self.distance(next_states).square()
        return -squared - torch.log(squared + 1e-3) - self.control_cost_weight * actions.square().sum(1)

    def terminated(self, next_states: torch.Tensor) -> torch.Tensor:
        """Return in which the box tips over, ``(N,)`` bool."""
        x, y = next_states[:, JOINTS + 4], next_states[:, JOINTS + 5]
        return 1 - 2 * (x * x + y * y) < self.lowest_upright

    def distance(self, states: torch.Tensor) -> torch.Tensor:
        """Return how far the box lies from the target, ``(N,)``, m."""
        return (states[:, JOINTS : JOINTS + 2] - self.target.to(states)).norm(dim=1)

    def tip(self, joints: torch.Tensor) -> torch.Tensor:
        """Return where the rod's tip is at joint positions ``(N, 7)``, ``(N, 3)``, m."""
        turn = torch.eye(3, dtype=joints.dtype, device=joints.device).expand(len(joints), 3, 3)
        place = torch.zeros(len(joints), 3, dtype=joints.dtype, device=joints.device)
        for offset, fixed, joint in self._chain:
            place = place + turn @ offset.to(joints)
            turn = turn @ fixed.to(joints)
            if joint is not None:
                turn = turn @ _about_z(joints[:, joint])
        return place


def _chain(model: mujoco.MjModel) -> list[tuple[torch.Tensor, torch.Tensor, int | None]]:
    """Offset ``(3,)``, rotation ``(3, 3)`` and joint of each body from the base to the tip, whose own come last."""
    body, found = int(model.site("tip").bodyid[0]), []
    while body:
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, model.body_quat[body])
        joint = int(model.body_jntadr[body])
        fixed = torch.from_numpy(matrix.reshape(3, 3))
        found.append((torch.from_numpy(model.body_pos[body].copy()), fixed, None if joint < 0 else joint))
        body = int(model.body_parentid[body])
    tip = torch.from_numpy(model.site("tip").pos.copy())
    return [*reversed(found), (tip, torch.eye(3, dtype=torch.float64), None)]


def _about_z(angles: torch.Tensor) -> torch.Tensor:
    """Rotations about z, ``(N, 3, 3)``."""
    sine, cosine, zero, one = angles.sin(), angles.cos(), torch.zeros_like(angles), torch.ones_like(angles)
    rows = (cosine, -sine, zero, sine, cosine, zero, zero, zero, one)
    return torch.stack(rows, 1).unflatten(1, (3, 3))
