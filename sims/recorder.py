"""What the recorders of bundled simulations share: the columns of a log, one transition of it, the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import mujoco
import numpy as np

from dropo_torch.errors import InputError, choices
from dropo_torch.models.bundled import BundledSim
from dropo_torch.parameters import ParameterSpace


@dataclass(frozen=True)
class Log:
    """A recorded log.

    Attributes:
        observations, next_observations: ``(T, n)``.
        actions: ``(T, m)``.
        terminals: ``(T,)`` bool.
    """

    observations: np.ndarray
    next_observations: np.ndarray
    actions: np.ndarray
    terminals: np.ndarray

    @property
    def size(self) -> str:
        """How much it is, in words."""
        return f"{len(self.actions)} transitions"

    def save(self, path: str | Path) -> None:
        """Write the log as ``.npz``, and nothing that a robot does not log."""
        columns = ("observations", "next_observations", "actions", "terminals")
        with open(path, "wb") as stream:  # numpy would append .npz to a path without it
            np.savez_compressed(stream, **{name: getattr(self, name) for name in columns})


@dataclass(frozen=True)
class ObjectLog(Log):
    """A recorded log of an arm and an object: joints, the object's position and quaternion, then velocities.

    Attributes:
        parameters: those in force in each episode, ``(E, d)``.
    """

    parameters: np.ndarray


def record_object(
    sim: BundledSim, episode: Callable[[mujoco.MjModel, np.random.Generator], tuple[np.ndarray, np.ndarray]], *,
    episodes: int, seed: int, truth: Mapping[str, float] | None, spread: Mapping[str, float],
    quaternion: slice, noise: tuple[float, float] | None,
) -> ObjectLog:  # fmt: skip
    """Simulate episodes with an object, each with its own parameters.

    Args:
        sim: the simulation.
        episode: simulates one, and returns its states and actions.
        episodes: how many.
        seed: of parameters, episodes and noise.
        truth: parameters by name; the model's own where absent.
        spread: standard deviations of those that are redrawn.
        quaternion: where the object's stands in a state.
        noise: of the measurement, or none.
    """
    space, generator = ParameterSpace(sim.model, sim.parameters), np.random.default_rng(seed)
    mean = space.named(space.nominal) | dict(truth or {})
    drawn = [drawn_within(sim.parameters, mean, spread, generator) for _ in range(episodes)]
    parts = [episode(space.apply(values), generator) for values in drawn]
    states, actions = (np.stack(part) for part in zip(*parts, strict=True))
    if noise is not None:
        states = measured(states, quaternion, noise, generator)
    values = np.array([[row[name] for name in sim.parameters] for row in drawn])
    return ObjectLog(**columns(states, actions), parameters=values)


def columns(states: np.ndarray, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Return a log's columns of measured states ``(E, steps + 1, n)`` and actions ``(E, steps, m)``."""
    terminals = np.zeros(actions.shape[:2], dtype=bool)
    terminals[:, -1] = True
    return {
        "observations": states[:, :-1].reshape(-1, states.shape[-1]),
        "next_observations": states[:, 1:].reshape(-1, states.shape[-1]),
        "actions": actions.reshape(-1, actions.shape[-1]),
        "terminals": terminals.reshape(-1),
    }


def transition(model: mujoco.MjModel, state: np.ndarray, action: np.ndarray, frame_skip: int) -> np.ndarray:
    """Return the state ``(nq + nv,)`` after one logged step, from a cold solver: it depends on its arguments alone."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state[: model.nq], state[model.nq :], action
    mujoco.mj_step(model, data, nstep=frame_skip)
    return np.concatenate([data.qpos, data.qvel])


def drawn_within(
    parameters: Mapping[str, Mapping[str, Any]], mean: Mapping[str, float], spread: Mapping[str, float],
    generator: np.random.Generator,
) -> dict[str, float]:  # fmt: skip
    """Return parameters drawn from normals, each within its bounds; those without a spread are as they are."""
    found = {}
    for name, value in mean.items():
        low, high = parameters[name]["bounds"]
        found[name] = value
        while spread.get(name):
            found[name] = value + spread[name] * generator.standard_normal()
            if low < found[name] < high:
                break
    return found


def measured(
    states: np.ndarray, quaternion: slice, noise: tuple[float, float], generator: np.random.Generator
) -> np.ndarray:
    """Return states ``(E, steps + 1, n)`` with noise on positions and velocities, and quaternions of length 1.

    Args:
        states: simulated.
        quaternion: where a quaternion stands, the last of the positions.
        noise: standard deviations of positions and of velocities.
        generator: of the noise.
    """
    level = np.where(np.arange(states.shape[-1]) < quaternion.stop, *noise)
    found = states + level * generator.standard_normal(states.shape)
    found[..., quaternion] /= np.linalg.norm(found[..., quaternion], axis=-1, keepdims=True)
    return found


def check_request(variant: str, variants: Collection[str], episodes: int, steps: int, seed: int) -> None:
    """Raise an :class:`InputError` for a log that cannot be recorded."""
    if episodes < 1 or steps < 1 or seed < 0:
        raise InputError(f"episodes {episodes}, steps {steps}, seed {seed}: expected 1 or more, 1 or more, 0 or more")
    if variant not in variants:
        raise InputError(f"variant: unknown {variant!r}; expected one of {', '.join(variants)}")


def check_names(key: str, given: Iterable[str], known: Collection[str]) -> None:
    """Raise an :class:`InputError` for a parameter that a simulation does not have."""
    for name in given:
        if name not in known:
            raise InputError(f"{key}: unknown name {name!r}" + choices(name, known))


class Saved(Protocol):
    """What a recorder makes."""

    @property
    def size(self) -> str:
        """How much it is, in words."""

    def save(self, path: str | Path) -> None:
        """Write it."""


def run_recorder(
    record: Callable[..., Saved], arguments: Sequence[str] | None, *, what: str, variants: Sequence[str],
    episodes: int, steps: int, add: Callable[[argparse.ArgumentParser], None] = lambda parser: None,
) -> None:  # fmt: skip
    """Record a log from the command line.

    Args:
        record: called with variant, episodes, steps, seed, whether the bundled log's ``robot`` is to be recorded, and
            what ``add`` adds, by name.
        arguments: those of the command line, by default the process's own.
        what: what is simulated.
        variants: kinds of logs.
        episodes, steps: of a log, by default.
        add: adds options of one's own.
    """
    parser = argparse.ArgumentParser(description=f"Record a log of {what}.")
    parser.add_argument("path", type=Path, help="the .npz file to write")
    parser.add_argument("--variant", choices=variants, default=variants[0])
    parser.add_argument("--episodes", type=int, default=episodes)
    parser.add_argument("--steps", type=int, default=steps)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", action="store_true", help="the robot of the bundled log, not the model as it is")
    add(parser)
    given = vars(parser.parse_args(arguments))
    path = given.pop("path")
    try:
        log = record(**given)
        log.save(path)
    except (InputError, OSError) as error:
        parser.error(str(error))
    print(f"{log.size} in {path}")
