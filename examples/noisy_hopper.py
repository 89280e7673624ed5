"""What can be found in the noisy Hopper log published with the paper? The same search on a twin with the same noise.

    python examples/noisy_hopper.py path/to/hoppernoisy

The log has noise of variance 1e-5 on every observation, positions and velocities alike. Beside contacts such noise on
an initial state decides what happens next, so little of a log of 10,000 transitions tells much. The twin is simulated
with today's MuJoCo, under the log's own commands and from its first states, with the published masses and the moments
of inertia of that time's engine (see authors_hopper.py), and gets the same noise. What is named in it is all that a
search can be expected to name.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from dropo_sims.hopper import LINKS, SIM

import dropo_torch as dropo
from dropo_torch.gap import Gap, find_gap
from dropo_torch.report.gap_words import answer, change

sys.path.insert(0, str(Path(__file__).parent))
from authors_hopper import MASSES, cylinder

#: Of the noise, as published.
VARIANCE = 1e-5


def factors(model: mujoco.MjModel) -> dict[str, float]:
    """Return the moments of inertia of the links in that time's engine, relative to today's."""
    return {link: cylinder(model, link)[1][0] / model.body(link).inertia[0] for link in LINKS}


def hopper_of_then() -> mujoco.MjModel:
    """Return the Hopper with the published masses and the moments of inertia of that time's engine."""
    model = mujoco.MjModel.from_xml_path(str(SIM.model))
    for link, factor in factors(model).items():
        body = model.body(link)
        body.inertia[:] *= factor
        body.mass[0] = MASSES[link]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def twin(log: dropo.Trajectories, seed: int) -> dict[str, np.ndarray]:
    """Return the arrays of a log with the commands and the first states of another."""
    model, rng = hopper_of_then(), np.random.default_rng(seed)
    data, starts = mujoco.MjData(model), np.append(True, log.terminals[:-1].astype(bool))
    before, after = [], []
    for start, observation, action in zip(starts, log.observations, log.actions, strict=True):
        if start:
            mujoco.mj_resetData(model, data)
            data.qpos[1:], data.qvel[:] = observation[:5], observation[5:]
        before.append(np.concatenate([data.qpos[1:], data.qvel]))
        data.ctrl[:] = action
        mujoco.mj_step(model, data, SIM.frame_skip)
        after.append(np.concatenate([data.qpos[1:], data.qvel]))
    noise = np.sqrt(VARIANCE) * rng.standard_normal((2, len(before), len(before[0])))
    return {"observations": before + noise[0], "next_observations": after + noise[1], "actions": log.actions,
            "terminals": log.terminals}  # fmt: skip


def search(data: Path) -> Gap:
    """Return what is missing in today's Hopper on a log."""
    config = dropo.make_config({"sim": "hopper", "data": str(data)})
    return find_gap(dropo.make_problem(config, general=True))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="of the twin's noise")
    parser.add_argument("--out", type=Path, default=Path("out/noisy_hopper"))
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    np.savez(given.out / "twin.npz", **twin(dropo.read_trajectories(given.data), given.seed))
    truth = factors(mujoco.MjModel.from_xml_path(str(SIM.model)))
    print("moments of inertia of then, relative to today's: " + ", ".join(f"{k} {v:.3f}" for k, v in truth.items()))
    for label, path in (("the twin", given.out / "twin.npz"), ("the log", given.data)):
        print(f"searching {label}", file=sys.stderr, flush=True)
        gap = search(path)
        headline, items = answer(gap)
        before, after = gap.reduced
        print(f"\n{label}: {headline}", *(f"  - {item}" for item in items), change(gap), sep="\n")
        print(f"χ² per degree of freedom {before:.2f} before, {after:.2f} after")


if __name__ == "__main__":
    main()
