"""Record logs of a simulated Hopper: ``python -m dropo_sims.hopper.record LOG.npz --variant noisy``.

The policy is scripted: slow random torques (low-pass filtered noise), which make the Hopper jump, fall
and scramble. No episode ends early. The variants are those of the paper's simulated experiments:

``point``         the masses never change;
``noisy``         and every measurement carries noise of variance 1e-5;
``unmodeled``     the torso is 1 kg lighter than the model's, and is not among the parameters;
``distribution``  thigh, leg and foot are redrawn every 25 steps from normals around the truth.
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

from . import LINKS, SIM

VARIANTS = ("point", "noisy", "unmodeled", "distribution")
NOISE_VARIANCE = 1e-5
#: Steps for which a draw of the masses holds in the distribution variant.
HOLD = 25
#: Standard deviations of the masses in the distribution variant, kg.
SPREAD = {"thigh_mass": 0.25, "leg_mass": 0.25, "foot_mass": 0.25}


@dataclass(frozen=True)
class HopperLog:
    """A recorded log.

    Attributes:
        observations, next_observations: ``(T, 11)``, qpos without the horizontal position, then qvel.
        actions: ``(T, 3)``, in [-1, 1].
        terminals: ``(T,)`` bool.
        masses: the masses in force at each step, ``(T, 4)``, kg.
    """

    observations: np.ndarray
    next_observations: np.ndarray
    actions: np.ndarray
    terminals: np.ndarray
    masses: np.ndarray

    def save(self, path: str | Path) -> None:
        """Write the log as ``.npz``, without the masses: a robot does not log those."""
        with open(path, "wb") as stream:  # numpy would append .npz to a path without it
            np.savez_compressed(
                stream,
                observations=self.observations,
                next_observations=self.next_observations,
                actions=self.actions,
                terminals=self.terminals,
            )


def nominal_masses() -> dict[str, float]:
    """Return the model's own masses, kg."""
    space = ParameterSpace(SIM.model, SIM.parameters)
    return space.named(space.nominal)


def record(
    *,
    variant: str = "point",
    episodes: int = 2,
    steps: int = 500,
    seed: int = 0,
    masses: Mapping[str, float] | None = None,
) -> HopperLog:
    """Simulate a Hopper and log it.

    Args:
        variant: one of :data:`VARIANTS`.
        episodes: number of episodes.
        steps: transitions of each.
        seed: seeds policy, initial states, noise and masses.
        masses: name → kg of the recorded Hopper; the model's own where absent.

    Raises:
        InputError: an unknown variant, mass or number.
    """
    if episodes < 1 or steps < 1 or seed < 0:
        raise InputError(f"episodes {episodes}, steps {steps}, seed {seed}: expected 1 or more, 1 or more, 0 or more")
    for name in masses or {}:
        if name not in SIM.parameters:
            raise InputError(f"masses: unknown name {name!r}" + choices(name, SIM.parameters))
    if variant not in VARIANTS:
        raise InputError(f"variant: unknown {variant!r}; expected one of {', '.join(VARIANTS)}")
    generator = np.random.default_rng(seed)
    truth = nominal_masses() | dict(masses or {})
    if variant == "unmodeled":
        truth["torso_mass"] -= 1.0
    parts = [_episode(variant, steps, generator, truth) for _ in range(episodes)]
    states, actions, used = (np.stack(p) for p in zip(*parts, strict=True))
    measured = states[..., 1:]
    if variant == "noisy":
        measured = measured + np.sqrt(NOISE_VARIANCE) * generator.standard_normal(measured.shape)
    terminals = np.zeros((episodes, steps), dtype=bool)
    terminals[:, -1] = True
    return HopperLog(
        observations=measured[:, :-1].reshape(-1, 11),
        next_observations=measured[:, 1:].reshape(-1, 11),
        actions=actions.reshape(-1, 3),
        terminals=terminals.reshape(-1),
        masses=used.reshape(-1, len(LINKS)),
    )


def _episode(
    variant: str, steps: int, generator: np.random.Generator, truth: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States ``(steps + 1, 12)``, actions ``(steps, 3)`` and masses ``(steps, 4)`` of one episode."""
    space = ParameterSpace(SIM.model, SIM.parameters)
    actions = _smooth_noise(steps, 3, generator)
    start = np.concatenate([space.apply(truth).qpos0, np.zeros(6)]) + generator.uniform(-0.005, 0.005, 12)
    states, used = [start], []
    model = space.apply(truth)
    for step in range(steps):
        if variant == "distribution" and step % HOLD == 0:
            drawn = {name: truth[name] + sigma * generator.standard_normal() for name, sigma in SPREAD.items()}
            model = space.apply({**truth, **drawn})
        states.append(_transition(model, states[-1], actions[step]))
        used.append(model.body_mass[1:].copy())
    return np.stack(states), actions, np.stack(used)


def _transition(model: mujoco.MjModel, state: np.ndarray, action: np.ndarray) -> np.ndarray:
    """One logged transition from a cold solver: a transition is a function of its state alone."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state[:6], state[6:], action
    mujoco.mj_step(model, data, nstep=SIM.frame_skip)
    return np.concatenate([data.qpos, data.qvel])


def _smooth_noise(steps: int, width: int, generator: np.random.Generator) -> np.ndarray:
    """Torques in [-1, 1], ``(steps, width)``: first-order filtered noise with a memory of ten steps."""
    noise = generator.standard_normal((steps, width))
    torque = np.zeros((steps, width))
    for step in range(1, steps):
        torque[step] = 0.9 * torque[step - 1] + 0.35 * noise[step]
    return np.clip(torque, -1.0, 1.0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Record a log from the command line."""
    parser = argparse.ArgumentParser(description="Record a log of a simulated Hopper.")
    parser.add_argument("path", type=Path, help="the .npz file to write")
    parser.add_argument("--variant", choices=VARIANTS, default="point")
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", action="store_true", help="the masses of the bundled log instead of the model's")
    given = parser.parse_args(arguments)
    try:
        log = record(
            variant=given.variant,
            episodes=given.episodes,
            steps=given.steps,
            seed=given.seed,
            masses=SIM.truth if given.robot else None,
        )
        log.save(given.path)
    except (InputError, OSError) as error:
        parser.error(str(error))
    print(f"{len(log.actions)} transitions in {given.path}")


if __name__ == "__main__":
    main()
