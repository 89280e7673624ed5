"""Record logs of an arm that hits a puck: ``python -m dropo_sims.puck.record LOG.npz --robot``.

Every episode is one hit, with a heading, a side of the puck and a speed of its own. The variants:

``point``         one puck and one arm;
``noisy``         and every measurement carries noise;
``distribution``  puck and contact are redrawn for every hit from normals around the truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from dropo_torch.parameters import ParameterSpace

from ..recorder import Log, check_names, check_request, columns, drawn_within, measured, run_recorder, transition
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


@dataclass(frozen=True)
class PuckLog(Log):
    """A recorded log: the joints, the puck's position and quaternion, then velocities; positions that servos are given.

    Attributes:
        parameters: those in force at each hit, ``(E, 18)``.
    """

    parameters: np.ndarray


def record(
    *, variant: str = "point", episodes: int = 5, steps: int = 750, seed: int = 0,
    truth: Mapping[str, float] | None = None, spread: Mapping[str, float] | None = None,
) -> PuckLog:  # fmt: skip
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
    space = ParameterSpace(SIM.model, SIM.parameters)
    generator = np.random.default_rng(seed)
    mean = space.named(space.nominal) | dict(truth or {})
    widths = dict(SPREAD if spread is None else spread) if variant == "distribution" else {}
    drawn = [drawn_within(SIM.parameters, mean, widths, generator) for _ in range(episodes)]
    parts = [_episode(space.apply(values), _hit(generator), steps) for values in drawn]
    states, actions = (np.stack(part) for part in zip(*parts, strict=True))
    if variant == "noisy":
        states = measured(states, QUATERNION, NOISE, generator)
    drawn_values = np.array([[values[name] for name in SIM.parameters] for values in drawn])
    return PuckLog(**columns(states, actions), parameters=drawn_values)


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

    def recorded(variant: str, episodes: int, steps: int, seed: int, robot: bool) -> PuckLog:
        truth = SIM.truth if robot else None
        return record(variant=variant, episodes=episodes, steps=steps, seed=seed, truth=truth)

    about = "a simulated arm that hits a puck"
    run_recorder(recorded, arguments, what=about, variants=VARIANTS, episodes=5, steps=750)


if __name__ == "__main__":
    main()
