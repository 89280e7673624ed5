"""Where is the noise of the noisy Hopper log published with the paper, and what does it leave of the masses?

    python examples/noisy_hopper.py path/to/hoppernoisy

Noise of variance 1e-5 is on the ends of its transitions alone. Their initial states carry none: a state that ends a
transition with noise begins the next one without, and is what a simulation without contacts predicts. So ε = 1e-5 is
the exact model of it, as it is not where a robot's sensors measure both.

The masses are fitted to the first transitions of the log and of a twin: the log's initial states and commands,
simulated by today's MuJoCo. Both as they are, with the same noise on initial states too, and with that given as
``noise``. Models have the published masses' moments of inertia of that time's engine (see authors_hopper.py). Contacts
were computed differently then, so the log's transitions with any are left out.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from dropo_sims.hopper import LINKS, SIM
from dropo_sims.hopper.paper import MASSES, PARAMETERS

import dropo_torch as dropo
from dropo_torch.diagnostics import diagnose
from dropo_torch.problem import make_problem

sys.path.insert(0, str(Path(__file__).parent))
from authors_hopper import cylinder

#: Of the noise, as published.
VARIANCE = 1e-5
#: The order of the differences by which noise is told from motion.
ORDER = 4


def factors(model: mujoco.MjModel) -> dict[str, float]:
    """Return the moments of inertia of the links in that time's engine, relative to today's."""
    return {link: cylinder(model, link)[1][0] / model.body(link).inertia[0] for link in LINKS}


def hopper_of_then() -> mujoco.MjModel:
    """Return the Hopper with the published masses and the moments of inertia of that time's engine."""
    model = mujoco.MjModel.from_xml_path(str(SIM.model))
    for link, factor in factors(model).items():
        body = model.body(link)
        body.inertia[:] *= factor
        body.mass[0] = MASSES[f"{link}_mass"]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def roughness(log: dropo.Trajectories) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what noise would have to be, by column: of initial states, of ends, and between an end and the next state.

    The first two from fourth differences of a column in time, ``(n,)`` each: of white noise they have √70 of its
    standard deviation, of a smooth motion next to nothing.
    """
    last = np.flatnonzero(log.terminals.astype(bool))
    starts, ends = (np.split(x, last[:-1] + 1) for x in (log.observations, log.next_observations))
    scale = 0.6745 * np.sqrt(sum(c**2 for c in (1, 4, 6, 4, 1)))
    rough = [
        np.median(np.abs(np.concatenate([np.diff(e, n=ORDER, axis=0) for e in episodes])), axis=0) / scale
        for episodes in (starts, ends)
    ]
    between = np.concatenate([e[:-1] - s[1:] for s, e in zip(starts, ends, strict=True)])
    return rough[0], rough[1], between.std(0)


def simulate(model: mujoco.MjModel, log: dropo.Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of a log's transitions ``(T, n)``, and whether nothing touched anything, ``(T,)``."""
    data = mujoco.MjData(model)
    ends, free = np.empty_like(log.observations), np.ones(len(log), dtype=bool)
    for i, (start, action) in enumerate(zip(log.observations, log.actions, strict=True)):
        mujoco.mj_resetData(model, data)
        data.qpos[1:], data.qvel[:], data.ctrl[:] = start[:5], start[5:], action
        for _ in range(SIM.frame_skip):
            mujoco.mj_step(model, data)
            free[i] &= data.ncon == 0
        ends[i] = np.concatenate([data.qpos[1:], data.qvel])
    return ends, free


def noisy(log: dropo.Trajectories, rng: np.random.Generator, *, starts: bool, ends: bool) -> dropo.Trajectories:
    """Return a log with noise on the initial states, the ends, or both, independently."""
    noise = np.sqrt(VARIANCE) * rng.standard_normal((2, *log.observations.shape))
    noise *= np.array([starts, ends])[:, None, None]
    return replace(log, observations=log.observations + noise[0], next_observations=log.next_observations + noise[1])


def fit(log: dropo.Trajectories, folder: Path, settings: Mapping[str, float]) -> str:
    """Fit the masses to a log and return them in a line, with standard errors and σ."""
    columns = ("observations", "next_observations", "actions")
    single = np.ones(len(log), dtype=bool)  # each transition is a window of its own
    np.savez(folder / "log.npz", terminals=single, **{name: getattr(log, name) for name in columns})
    mujoco.mj_saveModel(hopper_of_then(), str(folder / "then.mjb"))
    document = {
        "model": "then.mjb", "frame_skip": SIM.frame_skip, "observation": list(SIM.observation), "data": "log.npz",
        "parameters": PARAMETERS,
    }  # fmt: skip
    objective = make_problem(dropo.make_config(document, settings, base=folder)).objective
    found = dropo.fit(objective).distribution
    errors = diagnose(objective, found).standard_error
    entries = zip(found.summary().values(), errors, strict=True)
    return ", ".join(f"{p['mean']:.4f} ± {error:.4f} (σ {p['std']:.1g})" for p, error in entries)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--transitions", type=int, default=1000, help="the first ones, which are fitted")
    parser.add_argument("--backend", choices=["mujoco", "warp"], default="mujoco")
    parser.add_argument("--seed", type=int, default=0, help="of the noise that is added")
    given = parser.parse_args(arguments)
    log = dropo.read_trajectories(given.data)
    told = ("of initial states", "of ends", "between an end and the next initial state")
    print(f"standard deviation of noise by column; of variance {VARIANCE:g} it is {VARIANCE**0.5:.4f}")
    for what, values in zip(told, roughness(log), strict=True):
        print(f"  {what}: " + ", ".join(f"{v:.5f}" for v in values))
    log = log.select(slice(0, given.transitions))
    ends, free = simulate(hopper_of_then(), log)
    twin, rng = replace(log, next_observations=ends), np.random.default_rng(given.seed)
    logs = {
        "the log": log.select(free),
        "the log, noise on its initial states, too": noisy(log.select(free), rng, starts=True, ends=False),
        "the twin, noise on the ends": noisy(twin, rng, starts=False, ends=True),
        "the twin, noise on both": noisy(twin, rng, starts=True, ends=True),
    }
    following = np.abs(ends[:-1] - log.observations[1:]).max(1)[free[:-1] & ~log.terminals[:-1].astype(bool)]
    print(f"median error of the initial state that follows a transition without contact: {np.median(following):.1e}")
    print(f"masses of {', '.join(LINKS)}, published {', '.join(map(str, MASSES.values()))} kg; {free.sum()} of "
          f"{len(log)} transitions of the log are without contact")  # fmt: skip
    for what, each in logs.items():
        ways: dict[str, dict[str, float]] = {"ε the noise's variance": {"epsilon": VARIANCE}}
        if "initial" in what or "both" in what:
            ways["given as noise"] = {"epsilon": 1e-8, "noise": VARIANCE**0.5}
        for way, settings in ways.items():
            with tempfile.TemporaryDirectory() as folder:
                line = fit(each, Path(folder), {**settings, "backend": given.backend})
            print(f"  {what}, {way}: {line}", flush=True)


if __name__ == "__main__":
    main()
