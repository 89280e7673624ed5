"""Record logs of a simulated Hopper: ``python -m dropo_sims.hopper.record LOG.npz --variant noisy``.

The policy is scripted: slow random torques (low-pass filtered noise), which make the Hopper jump, fall and scramble.
With ``--policy``, it is a trained one, with its mean actions. No episode ends early. The variants are those of the
paper's simulated experiments:

``point``         the masses never change;
``noisy``         and every measurement carries noise of variance 1e-5;
``ends``          and that noise is on the ends of transitions alone, as in the noisy log published with the paper;
``starts``        and it is on their initial states alone;
``unmodeled``     the torso is 1 kg lighter than the model's, and is not among the parameters;
``distribution``  thigh, leg and foot are redrawn every 25 steps from normals around the truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace

from ..recorder import Log, check_names, check_request, columns, run_recorder, transition
from . import LINKS, SIM

VARIANTS = ("point", "noisy", "ends", "starts", "unmodeled", "distribution")
NOISE_VARIANCE = 1e-5
#: Which columns of a log carry noise.
NOISY = {
    "noisy": ("observations", "next_observations"),
    "ends": ("next_observations",),
    "starts": ("observations",),
}
#: Steps for which a draw of the masses holds in the distribution variant.
HOLD = 25
#: Standard deviations of the masses in the distribution variant, kg.
SPREAD = {"thigh_mass": 0.25, "leg_mass": 0.25, "foot_mass": 0.25}
#: Velocities are cut off there in what a policy observes, as where it was trained (:mod:`dropo_sims.hopper.task`).
VELOCITIES = (-10.0, 10.0)

#: Gives actions ``(3,)`` in [-1, 1] at observations ``(11,)``.
Policy = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class HopperLog(Log):
    """A recorded log: qpos without the horizontal position, then qvel, ``(T, 11)``; torques in [-1, 1], ``(T, 3)``.

    Attributes:
        masses: the masses in force at each step, ``(T, 4)``, kg.
    """

    masses: np.ndarray


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
    policy: Policy | None = None,
) -> HopperLog:
    """Simulate a Hopper and log it.

    Args:
        variant: one of :data:`VARIANTS`.
        episodes: number of episodes.
        steps: transitions of each.
        seed: seeds random torques, initial states, noise and masses.
        masses: name → kg of the recorded Hopper; the model's own where absent.
        policy: acts, on what is true; random torques by default.

    Raises:
        InputError: an unknown variant, mass or number.
    """
    check_request(variant, VARIANTS, episodes, steps, seed)
    check_names("masses", masses or {}, SIM.parameters)
    generator = np.random.default_rng(seed)
    truth = nominal_masses() | dict(masses or {})
    if variant == "unmodeled":
        truth["torso_mass"] -= 1.0
    parts = [_episode(variant, steps, generator, truth, policy) for _ in range(episodes)]
    states, actions, used = (np.stack(p) for p in zip(*parts, strict=True))
    log = columns(states[..., 1:], actions)
    noise = np.sqrt(NOISE_VARIANCE) * generator.standard_normal(states[..., 1:].shape)
    noisy = columns(states[..., 1:] + noise, actions)
    log |= {name: noisy[name] for name in NOISY.get(variant, ())}
    return HopperLog(**log, masses=used.reshape(-1, len(LINKS)))


def _episode(
    variant: str, steps: int, generator: np.random.Generator, truth: Mapping[str, float], policy: Policy | None
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
        if policy is not None:
            actions[step] = policy(np.concatenate([states[-1][1:6], np.clip(states[-1][6:], *VELOCITIES)]))
        states.append(transition(model, states[-1], actions[step], SIM.frame_skip))
        used.append(model.body_mass[1:].copy())
    return np.stack(states), actions, np.stack(used)


def _smooth_noise(steps: int, width: int, generator: np.random.Generator) -> np.ndarray:
    """Torques in [-1, 1], ``(steps, width)``: first-order filtered noise with a memory of ten steps."""
    noise = generator.standard_normal((steps, width))
    torque = np.zeros((steps, width))
    for step in range(1, steps):
        torque[step] = 0.9 * torque[step - 1] + 0.35 * noise[step]
    return np.clip(torque, -1.0, 1.0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Record a log from the command line."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--policy", type=Path, help="policy.pt of dropo train; random torques by default")

    def recorded(variant: str, episodes: int, steps: int, seed: int, robot: bool, policy: Path | None) -> HopperLog:
        masses, acts = SIM.truth if robot else None, None if policy is None else _loaded(policy)
        return record(variant=variant, episodes=episodes, steps=steps, seed=seed, masses=masses, policy=acts)

    run_recorder(recorded, arguments, what="a simulated Hopper", variants=VARIANTS, episodes=2, steps=500, add=add)


def _loaded(path: Path) -> Policy:
    """The policy of a file."""
    from dropo_torch.rl.policy import load_policy  # imports what a log of random torques does not need

    policy = load_policy(path)
    observed, acted = policy.num_observations, len(policy.low)
    if (observed, acted) != (11, 3):
        raise InputError(f"policy: {path} has {observed} observations and {acted} actions; expected 11 and 3")
    return policy


if __name__ == "__main__":
    main()
