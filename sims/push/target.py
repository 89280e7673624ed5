"""A box whose friction depends on how fast it slides, pushed by an arm with friction and delay, in a real one's place.

``python -m dropo_sims.push.target LOG.csv`` writes a raw log of pushes, as the equipment would.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from dropo_torch.rl.policy import Policy

from ..target import Arm, Control, Equipment, Run, Target, run_writer
from . import SIM
from .policy import Push, Pusher
from .record import random_push
from .task import PushTask

#: The real box and its friction in fast motion.
TRUTH = {"mass": 0.95, "friction_x": 0.62, "friction_y": 0.5, "com_x": -0.012, "com_y": 0.009}
ARM = Arm(delay=0.008, dry=(0.8, 0.8, 0.6, 0.6, 0.3, 0.25, 0.2), viscous=(2.0, 2.0, 1.5, 1.5, 0.5, 0.5, 0.3))
#: By what share friction is larger at rest, and the speed at which e⁻¹ of that is left, m/s.
STICKS, FADES = 0.4, 0.12
#: Commands of a push that is logged.
STEPS = 45
#: y of a box that no push meets, m.
OUT_OF_REACH = 1.0


def make_target() -> Target:
    """Return the target."""
    return Target(SIM, TRUTH, ARM, Equipment(period=0.004), law=_friction_by_speed)


def _friction_by_speed(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Set the table's friction, which is larger where the box slides slowly."""
    speed = float(np.hypot(*data.qvel[7:9]))
    more = 1 + STICKS * np.exp(-((speed / FADES) ** 2))
    model.pair_friction[model.pair("table_box").id, :2] = more * np.array([TRUTH["friction_y"], TRUTH["friction_x"]])


def record_runs(count: int, seed: int, *, alone: bool = False) -> list[Run]:
    """Return pushes like those of the bundled log, by the measured joints; alone, the box is out of reach."""
    target, generator = make_target(), np.random.default_rng(seed)
    pusher, found = Pusher(target.model), []
    for _ in range(count):
        push, start = random_push(generator), np.concatenate([target.model.qpos0, np.zeros(target.model.nv)])
        start[:7] = pusher.start(push)
        if alone:
            start[8] = OUT_OF_REACH
        found.append(target.run(start, _carried_out(pusher, push), STEPS, generator))
    return found


def _carried_out(pusher: Pusher, push: Push) -> Control:
    """Velocities that carry out a push, by the measured joints."""
    return lambda time, state: pusher.velocities(state[:7], push, time)


def distances(policy: Policy, count: int, seed: int) -> list[float]:
    """Return how far from its target the box lies in the end, m, in pushes of a policy that sees what is measured."""
    target, task, found = make_target(), PushTask(), []
    generator = np.random.default_rng(seed)

    def control(time: float, state: np.ndarray) -> np.ndarray:
        observed = task.observe(torch.from_numpy(state)[None]).float()
        return task.controls(policy(observed).double())[0].numpy()

    for start in task.initial_states(count, torch.Generator().manual_seed(seed)).numpy():
        run = target.run(start, control, task.max_episode_steps, generator)
        found.append(float(task.distance(torch.from_numpy(run.final)[None])))
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a raw log from the command line."""
    run_writer("a stand-in for a real arm that pushes a box", make_target(), record_runs, 16, arguments)


if __name__ == "__main__":
    main()
