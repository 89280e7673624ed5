"""What ``dropo init`` makes of logs of systems whose truth is known, as plain MuJoCo simulates them.

    python benchmarks/init_systems.py --out out/init                 # all systems; --systems pendulum,hopper for some
    python benchmarks/init_systems.py --out out/init --seeds 3       # as many logs of each

Each system has a model as a user would have it, a true one that differs, and a log with columns, units and rate of its
own. The proposed config goes through ``dropo check`` and ``dropo fit`` unedited. Written are a folder a log and
``init_systems.md``: whether both pass, how many parameters were chosen, how many of their 90 % intervals (mean ± 1.64
standard errors) hold the truth, and what was left out although its standard error beside the chosen ones would be
below 10 % of its true value.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1]))

import dropo_torch as dropo
from benchmarks.init.systems import SYSTEMS, Samples, System
from dropo_torch.commands.cli import main as command
from dropo_torch.gap.refit import Z90
from dropo_torch.proposal import Proposal, propose_config


def true_model(system: System) -> mujoco.MjModel:
    """Return the true model; masses take their inertias along."""
    if system.motors:
        spec = mujoco.MjSpec.from_string(system.model)
        for joint in system.motors:
            spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        model = spec.compile()
    else:
        model = mujoco.MjModel.from_xml_string(system.model)
    for name, values in system.truth.items():
        key, _, component = name.partition("[")
        for thing, value in values.items():
            array = getattr(model, key)
            if key == "body_mass":
                row = model.body(thing).id
                model.body_inertia[row] *= value / model.body_mass[row]
                array[row] = value
            elif key == "actuator_kp":
                row = model.actuator(thing).id
                model.actuator_gainprm[row, 0], model.actuator_biasprm[row, 1] = value, -value
            elif key.startswith("dof_"):
                array[model.joint(thing).dofadr[0]] = value
            else:
                row = getattr(model, key.split("_")[0].replace("jnt", "joint"))(thing).id
                array.reshape(len(array), -1)[row, int(component[:-1]) if component else 0] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def record(system: System, seed: int) -> Samples:
    """Simulate a system, and return its noisy samples, one row each ``every`` steps."""
    model, rng = true_model(system), np.random.default_rng([seed, 5])
    step, rows = model.opt.timestep, []
    for episode in range(system.episodes):
        data = mujoco.MjData(model)
        if system.start is not None:
            system.start(model, data, rng)
        memory = np.random.default_rng([seed, episode, 8])
        for row in range(int(system.seconds / step / system.every)):
            if model.nu:
                data.ctrl[:] = system.command(row * system.every * step, episode, memory)
            rows.append((row * system.every * step, data.qpos.copy(), data.qvel.copy(), data.ctrl.copy(), episode))
            for _ in range(system.every):
                mujoco.mj_step(model, data)
    t, q, v, u, e = (np.array(x) for x in zip(*rows, strict=True))
    q = q + system.noise[0] * rng.standard_normal(q.shape)
    for j in np.flatnonzero(np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL))):
        first = model.jnt_qposadr[j] + (3 if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE else 0)
        q[:, first : first + 4] /= np.linalg.norm(q[:, first : first + 4], axis=1, keepdims=True)
    v = v + system.noise[1] * rng.standard_normal(v.shape)
    return {"t": t, "q": q, "v": v, "u": u, "episode": e}


def write(system: System, folder: Path, seed: int) -> tuple[Path, Path]:
    """Write a system's model and log, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    model, log = folder / f"robot{Path(system.robot).suffix}", folder / f"log{system.suffix}"
    model.write_text(system.model)
    columns = dict(system.columns(record(system, seed)))
    if system.suffix == ".npz":
        np.savez(log, **columns)  # type: ignore[arg-type]
    elif system.suffix == ".parquet":
        pd.DataFrame({k: list(v) if v.ndim > 1 else v for k, v in columns.items()}).to_parquet(log)
    else:
        pd.DataFrame(columns).to_csv(log, index=False, float_format="%.7g" if "stamp_ns" not in columns else None)
    return model, log


@dataclass(frozen=True)
class Outcome:
    """What became of one log."""

    system: str
    seed: int
    checked: int
    fitted: int
    verdict: str
    chosen: int
    held: int
    single: int
    single_held: int
    missed: tuple[str, ...]
    outside: tuple[str, ...]
    candidates: int
    lag: int
    seconds: float
    fit_seconds: float
    summary: str


def true_values(proposal: Proposal, system: System) -> dict[str, float]:
    """Return the true value of every candidate, in its unit."""
    truth, own = true_model(system), None
    found = {}
    for told in proposal.choice.told:
        space = dropo.ParameterSpace(proposal.base / proposal.document["model"], {"it": told.candidate.spec})
        own = space.parameters[0]
        target = own.targets[0]
        found[told.candidate.name] = target.read(truth) / target.factor
    return found


def run(name: str, folder: Path, seed: int, fit: bool = True) -> Outcome:
    """Propose a config for a system's log, check and fit with it, and compare with the truth."""
    system, place = SYSTEMS[name], folder / f"{name}-{seed}"
    model, log = write(system, place, seed)
    began, path = time.perf_counter(), place / "robot.yaml"
    proposal = propose_config(model, log, out=path, seed=seed)
    path.write_text(proposal.text)
    seconds, truth = time.perf_counter() - began, true_values(proposal, system)
    missed = tuple(
        f"{t.candidate.name} ({100 * t.error / abs(truth[t.candidate.name]):.2g} %)" for t in proposal.choice.told
        if not t.is_in and t.candidate.kind != "center" and t.error < 0.1 * abs(truth[t.candidate.name])
    )  # fmt: skip
    checked, began = command(["check", str(path)]), time.perf_counter()
    fitted = command(["fit", str(path), "--out", str(place / "fit")]) if fit else -1
    took, held, outside = time.perf_counter() - began, [], []
    document = json.loads((place / "fit" / "fit.json").read_text()) if fitted in (0, 3) else {}
    for told in proposal.choice.chosen if document else ():
        key = told.candidate.name
        mean, error = document["parameters"][key]["mean"], document["standard_errors"][key]["mean"]
        inside = error is not None and abs(mean - truth[key]) <= Z90 * error + 1e-12
        held.append((told.state == "chosen", inside))
        if not inside:
            outside.append(f"{key}: {mean:.4g} ± {error:.2g}, true {truth[key]:.4g}")
    single = [inside for alone, inside in held if alone]
    return Outcome(
        name, seed, checked, fitted, document.get("verdict", ""), len(held), sum(i for _, i in held), len(single),
        sum(single), missed, tuple(outside), len(proposal.choice.told), proposal.document["lag"], seconds, took,
        proposal.choice.summary,
    )  # fmt: skip


def markdown(found: Sequence[Outcome]) -> str:
    """Return the outcomes as a table, and what stands outside or was missed as lists."""
    lines = [
        "| system | log | check | fit | verdict | candidates | chosen | in 90 % | one by one | lag | init | fit |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for o in found:
        lines.append(
            f"| {o.system} | {o.seed} | {o.checked} | {o.fitted} | {o.verdict} | {o.candidates} | {o.chosen} "
            f"| {o.held} | {o.single_held} of {o.single} | {o.lag} | {o.seconds:.1f} s | {o.fit_seconds:.1f} s |"
        )
    total, held = sum(o.chosen for o in found), sum(o.held for o in found)
    single, inside = sum(o.single for o in found), sum(o.single_held for o in found)
    share, alone = 100 * held / max(total, 1), 100 * inside / max(single, 1)
    one = f"of those told one by one {inside} of {single} ({alone:.0f} %)"
    lines += ["", f"In their 90 % intervals: {held} of {total} ({share:.0f} %), {one}.", ""]
    for o in found:
        lines.append(f"- {o.system} {o.seed}: {o.summary}")
        lines += [f"  - outside: {text}" for text in o.outside]
        lines += [f"  - left out: {text}" for text in o.missed]
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--systems", default=",".join(SYSTEMS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--no-fit", action="store_true")
    given = parser.parse_args(arguments)
    found = []
    for seed in range(given.first, given.first + given.seeds):
        for name in given.systems.split(","):
            found.append(run(name, given.out, seed, fit=not given.no_fit))
            print(markdown(found[-1:]), flush=True)
            (given.out / "init_systems.md").write_text(markdown(found))


if __name__ == "__main__":
    main()
