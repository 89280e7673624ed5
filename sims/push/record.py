"""Record logs of an arm that pushes a box: ``python -m dropo_sims.push.record LOG.npz --variant distribution``.

Every episode is one push, straight ahead, at a side of the box and with a heading and a speed of its own. The variants:

``point``         one box;
``noisy``         and every measurement carries noise;
``distribution``  the box's parameters are redrawn for every push from normals around the truth, as in the paper.

And ``guided``, by :func:`dropo_sims.push.guided.record_guided`: samples of instruments, not transitions, of an arm that
a hand guides around the box; an episode lasts as many steps of 10 ms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from ..recorder import ObjectLog, Saved, check_names, check_request, record_object, run_recorder, transition
from . import SIM
from .guided import GUIDED, record_guided
from .policy import Push, Pusher

VARIANTS = ("point", "noisy", "distribution")
#: Standard deviations of the noise: of positions (m and rad; unit quaternions) and of velocities (m/s and rad/s).
NOISE = (1e-4, 1e-3)
#: Standard deviations of the parameters in the distribution variant.
SPREAD = {"mass": 0.3, "friction_x": 0.2, "friction_y": 0.2, "com_x": 0.001, "com_y": 0.001}
#: The box's quaternion in a state, the last of the positions.
QUATERNION = slice(10, 14)
#: How far pushes are beside the box's middle (m) and from straight ahead (rad), at most, and their speeds, m/s.
SIDE, HEADING, SPEEDS = 0.03, 0.25, (0.2, 0.4)


def record(
    *, variant: str = "point", episodes: int = 20, steps: int = 30, seed: int = 0,
    truth: Mapping[str, float] | None = None, spread: Mapping[str, float] | None = None,
) -> ObjectLog:  # fmt: skip
    """Simulate pushes and log them.

    Args:
        variant: one of :data:`VARIANTS`.
        episodes: number of pushes.
        steps: transitions of each, of 20 ms.
        seed: seeds pushes, noise and parameters.
        truth: parameters by name; the model's own where absent.
        spread: their standard deviations in the distribution variant.

    Raises:
        InputError: an unknown variant, parameter or number.
    """
    check_request(variant, VARIANTS, episodes, steps, seed)
    check_names("truth", {**(truth or {}), **(spread or {})}, SIM.parameters)
    widths = dict(SPREAD if spread is None else spread) if variant == "distribution" else {}
    return record_object(
        SIM, lambda model, generator: _episode(model, random_push(generator), steps), episodes=episodes, seed=seed,
        truth=truth, spread=widths, quaternion=QUATERNION, noise=NOISE if variant == "noisy" else None,
    )  # fmt: skip


def random_push(generator: np.random.Generator) -> Push:
    """Return a push at a random side, heading and speed."""
    return Push(
        side=generator.uniform(-SIDE, SIDE), heading=generator.uniform(-HEADING, HEADING),
        speed=generator.uniform(*SPEEDS),
    )  # fmt: skip


def _episode(model: mujoco.MjModel, push: Push, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States ``(steps + 1, 27)`` and actions ``(steps, 7)`` of a push."""
    pusher, start = Pusher(model), np.concatenate([model.qpos0, np.zeros(model.nv)])
    start[:7] = pusher.start(push)
    states, actions = [start], []
    for step in range(steps):
        actions.append(pusher.velocities(states[-1][:7], push, step * model.opt.timestep * SIM.frame_skip))
        states.append(transition(model, states[-1], actions[-1], SIM.frame_skip))
    return np.stack(states), np.stack(actions)


def main(arguments: Sequence[str] | None = None) -> None:
    """Record a log from the command line."""

    def recorded(variant: str, episodes: int, steps: int, seed: int, robot: bool) -> Saved:
        truth = SIM.truth if robot else None
        if variant == GUIDED:
            return record_guided(episodes=episodes, steps=steps, seed=seed, truth=truth)
        return record(variant=variant, episodes=episodes, steps=steps, seed=seed, truth=truth)

    about = "a simulated arm that pushes a box"
    run_recorder(recorded, arguments, what=about, variants=(*VARIANTS, GUIDED), episodes=20, steps=30)


if __name__ == "__main__":
    main()
