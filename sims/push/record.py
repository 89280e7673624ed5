"""Record logs of an arm that pushes a box: ``python -m dropo_sims.push.record LOG.npz --variant distribution``.

Every episode is one push, straight ahead, at a side of the box and with a heading and a speed of its own. The variants:

``point``         one box;
``noisy``         and every measurement carries noise;
``distribution``  the box's parameters are redrawn for every push from normals around the truth, as in the paper.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.errors import InputError, choices
from dropo_torch.parameters import ParameterSpace

from . import SIM
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


@dataclass(frozen=True)
class PushLog:
    """A recorded log.

    Attributes:
        observations, next_observations: ``(T, 27)``: joints, the box's position and quaternion, then velocities.
        actions: ``(T, 7)``, velocities of the joints that were asked for, rad/s.
        terminals: ``(T,)`` bool.
        parameters: those in force at each push, ``(E, 5)``.
    """

    observations: np.ndarray
    next_observations: np.ndarray
    actions: np.ndarray
    terminals: np.ndarray
    parameters: np.ndarray

    def save(self, path: str | Path) -> None:
        """Write the log as ``.npz``, without the parameters: a robot does not log those."""
        columns = ("observations", "next_observations", "actions", "terminals")
        with open(path, "wb") as stream:  # numpy would append .npz to a path without it
            np.savez_compressed(stream, **{name: getattr(self, name) for name in columns})


def record(
    *, variant: str = "point", episodes: int = 20, steps: int = 30, seed: int = 0,
    truth: Mapping[str, float] | None = None, spread: Mapping[str, float] | None = None,
) -> PushLog:  # fmt: skip
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
    if episodes < 1 or steps < 1 or seed < 0:
        raise InputError(f"episodes {episodes}, steps {steps}, seed {seed}: expected 1 or more, 1 or more, 0 or more")
    for name in (*(truth or {}), *(spread or {})):
        if name not in SIM.parameters:
            raise InputError(f"truth: unknown name {name!r}" + choices(name, SIM.parameters))
    if variant not in VARIANTS:
        raise InputError(f"variant: unknown {variant!r}; expected one of {', '.join(VARIANTS)}")
    space = ParameterSpace(SIM.model, SIM.parameters)
    generator = np.random.default_rng(seed)
    mean = space.named(space.nominal) | dict(truth or {})
    widths = dict(SPREAD if spread is None else spread) if variant == "distribution" else {}
    drawn = [_drawn(mean, widths, generator) for _ in range(episodes)]
    parts = [_episode(space.apply(values), _push(generator), steps) for values in drawn]
    states, actions = (np.stack(part) for part in zip(*parts, strict=True))
    if variant == "noisy":
        states = _measured(states, generator)
    terminals = np.zeros((episodes, steps), dtype=bool)
    terminals[:, -1] = True
    width = states.shape[-1]
    return PushLog(
        observations=states[:, :-1].reshape(-1, width),
        next_observations=states[:, 1:].reshape(-1, width),
        actions=actions.reshape(-1, 7),
        terminals=terminals.reshape(-1),
        parameters=np.array([[values[name] for name in SIM.parameters] for values in drawn]),
    )


def _drawn(mean: Mapping[str, float], spread: Mapping[str, float], generator: np.random.Generator) -> dict[str, float]:
    """Parameters of a push, within their bounds."""
    found = {}
    for name, value in mean.items():
        low, high = SIM.parameters[name]["bounds"]
        found[name] = value
        while spread.get(name):
            found[name] = value + spread[name] * generator.standard_normal()
            if low < found[name] < high:
                break
    return found


def _push(generator: np.random.Generator) -> Push:
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
        states.append(_transition(model, states[-1], actions[-1]))
    return np.stack(states), np.stack(actions)


def _transition(model: mujoco.MjModel, state: np.ndarray, action: np.ndarray) -> np.ndarray:
    """One logged transition from a cold solver: a transition is a function of its state alone."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state[: model.nq], state[model.nq :], action
    mujoco.mj_step(model, data, nstep=SIM.frame_skip)
    return np.concatenate([data.qpos, data.qvel])


def _measured(states: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """States with noise, their quaternions of length 1."""
    level = np.where(np.arange(states.shape[-1]) < QUATERNION.stop, *NOISE)
    found = states + level * generator.standard_normal(states.shape)
    found[..., QUATERNION] /= np.linalg.norm(found[..., QUATERNION], axis=-1, keepdims=True)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Record a log from the command line."""
    parser = argparse.ArgumentParser(description="Record a log of a simulated arm that pushes a box.")
    parser.add_argument("path", type=Path, help="the .npz file to write")
    parser.add_argument("--variant", choices=VARIANTS, default="point")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", action="store_true", help="the box of the bundled log instead of the model's")
    given = parser.parse_args(arguments)
    truth = SIM.truth if given.robot else None
    try:
        log = record(variant=given.variant, episodes=given.episodes, steps=given.steps, seed=given.seed, truth=truth)
        log.save(given.path)
    except (InputError, OSError) as error:
        parser.error(str(error))
    print(f"{len(log.actions)} transitions in {given.path}")


if __name__ == "__main__":
    main()
