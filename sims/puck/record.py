"""Record logs of an arm that hits a puck: ``python -m dropo_sims.puck.record LOG.npz --robot``.

Every episode is one hit, with a heading, a side of the puck and a speed of its own. The variants:

``point``         one puck and one arm;
``noisy``         and every measurement carries noise;
``distribution``  puck and contact are redrawn for every hit from normals around the truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from ..recorder import ObjectLog, check_names, check_request, record_object, run_recorder, transition
from . import SIM
from .policy import HOME, Hit, hit_targets

VARIANTS = ("point", "noisy", "distribution")
#: Standard deviations of the noise: of positions (m and rad; unit quaternions) and of velocities (m/s and rad/s).
NOISE = (1e-4, 1e-3)
#: Standard deviations of the parameters in the distribution variant.
SPREAD = {"mass": 0.01, "friction_x": 0.03, "friction_y": 0.03, "contact_time": 0.001}
#: The puck's quaternion in a state, the last of the positions.
QUATERNION = slice(10, 14)
#: Standard deviation of the heading, rad, and of the side, m; speeds, m/s.
HEADING, SIDE, SPEEDS = 0.2, 0.008, (0.5, 1.0)


def record(
    *, variant: str = "point", episodes: int = 5, steps: int = 750, seed: int = 0,
    truth: Mapping[str, float] | None = None, spread: Mapping[str, float] | None = None,
) -> ObjectLog:  # fmt: skip
    """Simulate hits and log them.

    Args:
        variant: one of :data:`VARIANTS`.
        episodes: number of hits.
        steps: transitions of each, of 10 ms.
        seed: seeds hits, noise and parameters.
        truth: parameters by name; the model's own where absent.
        spread: their standard deviations in the distribution variant.

    Raises:
        InputError: an unknown variant, parameter or number.
    """
    check_request(variant, VARIANTS, episodes, steps, seed)
    check_names("truth", {**(truth or {}), **(spread or {})}, SIM.parameters)
    widths = dict(SPREAD if spread is None else spread) if variant == "distribution" else {}
    return record_object(
        SIM, lambda model, generator: _episode(model, _hit(generator), steps), episodes=episodes, seed=seed,
        truth=truth, spread=widths, quaternion=QUATERNION, noise=NOISE if variant == "noisy" else None,
    )  # fmt: skip


def _hit(generator: np.random.Generator) -> Hit:
    heading, side = generator.standard_normal(2) * (HEADING, SIDE)
    return Hit(float(heading), float(side), generator.uniform(*SPEEDS))


def _episode(model: mujoco.MjModel, hit: Hit, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States ``(steps + 1, 27)`` and actions ``(steps, 7)`` of a hit."""
    actions, start = hit_targets(model, hit, steps), np.concatenate([model.qpos0, np.zeros(model.nv)])
    start[:7] = HOME
    states = [start]
    for action in actions:
        states.append(transition(model, states[-1], action, SIM.frame_skip))
    return np.stack(states), actions


def main(arguments: Sequence[str] | None = None) -> None:
    """Record a log from the command line."""

    def recorded(variant: str, episodes: int, steps: int, seed: int, robot: bool) -> ObjectLog:
        truth = SIM.truth if robot else None
        return record(variant=variant, episodes=episodes, steps=steps, seed=seed, truth=truth)

    about = "a simulated arm that hits a puck"
    run_recorder(recorded, arguments, what=about, variants=VARIANTS, episodes=5, steps=750)


if __name__ == "__main__":
    main()
