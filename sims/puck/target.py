"""A puck on a whiteboard that is not level, hit by an arm with friction and delay: the real one's place is taken.

``python -m dropo_sims.puck.target LOG.csv`` writes a raw log of hits, as the equipment would.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from dropo_torch.rl.policy import Policy

from ..target import Arm, Control, Run, Target, run_writer
from . import SIM
from .generator import LATENT, STEPS, load_decoder
from .policy import HOME, STEP
from .task import PuckTask

#: The real puck, contact and gains.
TRUTH = {
    "mass": 0.125,
    "friction_x": 0.3,
    "friction_y": 0.37,
    "contact_time": 0.011,
    **dict(zip((f"kp{i}" for i in range(1, 8)), (2150, 1840, 1600, 1390, 930, 545, 280), strict=True)),
    **dict(zip((f"kd{i}" for i in range(1, 8)), (190, 215, 93, 108, 54, 18.5, 11), strict=True)),
}
ARM = Arm(delay=0.006, dry=(1.2, 1.2, 0.8, 0.8, 0.6, 0.25, 0.15), viscous=(3.0, 3.0, 2.0, 2.0, 1.0, 0.5, 0.3))
#: Roll and pitch of the board, rad: 1.15 degrees together.
TILT = (0.012, -0.016)
#: Commands after a motion's last, so that the puck has come to rest.
AFTER = 100
#: x of a puck that no motion hits, m.
OUT_OF_REACH = 1.5


def make_target() -> Target:
    """Return the target."""
    return Target(SIM, TRUTH, ARM, tilt=TILT)


def record_runs(count: int, seed: int, *, alone: bool = False) -> list[Run]:
    """Return hits of z ~ N(0, I), each from a place of the puck of its own, or out of reach of the stick."""
    target, generator = make_target(), np.random.default_rng(seed)
    decoder, task = load_decoder(), PuckTask()
    starts = task.initial_states(count, torch.Generator().manual_seed(seed)).numpy()
    if alone:
        starts[:, 7] = OUT_OF_REACH
    z = torch.from_numpy(generator.standard_normal((count, LATENT))).float().clamp(-2, 2)
    return [
        target.run(start, _played(motion), STEPS, generator)
        for start, motion in zip(starts, decoder(z).double().numpy(), strict=True)
    ]


def distances(policy: Policy, count: int, seed: int) -> list[float]:
    """Return how far from its target the puck comes to rest, m, in hits of a policy that sees what is measured."""
    target, task, found = make_target(), PuckTask(), []
    generator = np.random.default_rng(seed)
    for start in task.initial_states(count, torch.Generator().manual_seed(seed)).numpy():
        rest = target.run(start, lambda time, state: HOME, 20, generator)
        shown = torch.from_numpy(target.shown(rest, 20 * target.period))[None]
        motion = task.motion(policy(task.observe(shown).float()).double())[0].numpy()
        run = target.run(start, _played(motion), STEPS + AFTER, generator)
        found.append(float(task.distance(torch.from_numpy(run.final)[None])))
    return found


def _played(motion: np.ndarray) -> Control:
    """A motion's targets ``(S, 7)`` one after the other, and the last one held."""
    return lambda time, state: motion[min(round(time / STEP), len(motion) - 1)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a raw log from the command line."""
    run_writer("a stand-in for a real arm that hits a puck", make_target(), record_runs, 8, arguments)


if __name__ == "__main__":
    main()
