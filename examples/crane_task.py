"""A task for the crane of ``crane.py``: bring the load to rest at a target, for ``dropo train``.

python examples/crane.py --out out/crane
dropo train out/crane/crane.yaml --out out/crane/policy --task ../../examples/crane_task.py:Deliver --train.steps 300000

Paths that are options of the command count from the config's folder, as those in the config do.
"""

from __future__ import annotations

import mujoco
import torch
from crane import MODEL

from dropo_torch.rl import Task

#: Where the load is to hang, length of the rope, and half that of the rail, in m.
TARGET, ROPE, RAIL = 0.6, 0.8, 1.5
#: Distance at which the reward is half of that at the target, in m, and seconds by which a speed counts as a distance.
NEAR, AHEAD = 0.1, 0.2


class Deliver(Task):
    """Bring the load from about 0 m to rest at :data:`TARGET`, and keep it there until 5 s are over.

    States are ``[rail, rope, their velocities]``. The observation is the state, the trolley's position counted from the
    target. The reward of a step is 1 where the load hangs still at the target, and less with its distance and speed. An
    episode ends where the rail ends.
    """

    name = "crane"
    frame_skip = 8  # 40 ms
    max_episode_steps = 125
    num_observations = 4

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.action_low, self.action_high = [-1.0], [1.0]  # the motor has no range of its own

    def initial_states(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return states within 0.1 m, 0.1 rad, 0.1 m/s and 0.1 rad/s of rest at 0, ``(count, 4)``."""
        return 0.2 * torch.rand(count, 4, generator=generator, dtype=torch.float64) - 0.1

    def observe(self, states: torch.Tensor) -> torch.Tensor:
        """Return the states as seen from the target, ``(N, 4)``."""
        return states - torch.tensor([TARGET, 0.0, 0.0, 0.0]).to(states)

    def reward(self, states: torch.Tensor, actions: torch.Tensor, next_states: torch.Tensor) -> torch.Tensor:
        """Return 1 at rest at the target, less with distance and speed, ``(N,)``."""
        rail, rope, rail_speed, rope_speed = next_states.T
        distance = (rail - ROPE * torch.sin(rope) - TARGET).abs()
        speed = (rail_speed - ROPE * torch.cos(rope) * rope_speed).abs()
        return 1 / (1 + (distance + AHEAD * speed) / NEAR)

    def terminated(self, next_states: torch.Tensor) -> torch.Tensor:
        """Return where the trolley has left the rail, ``(N,)`` bool."""
        return next_states[:, 0].abs() > RAIL
