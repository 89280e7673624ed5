"""How often the intervals of each method hold the truth, over simulated logs of a driven pendulum.

    python benchmarks/calibration.py --logs 100 --out out/calibration --workers 2     # --resume goes on

Writes ``trials.jsonl``, a line a fit below the settings, and ``calibration.md``. Mass and damping are searched for; the
log has 60 transitions and noise on their ends, whose variance is ε. :mod:`dropo_torch.studies.calibration` has the
two kinds of log.
"""

from __future__ import annotations

import argparse
import functools
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import dropo_torch as dropo
from dropo_torch.studies.calibration import Coverage, Trial, calibrate, coverages, plain
from dropo_torch.support.parallel import in_parallel

MODEL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="bob" pos="0 0 1">
      <joint name="pivot" type="hinge" axis="0 1 0" damping="0.1"/>
      <inertial pos="0 0 -.5" mass="1" diaginertia=".002 .002 .002"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator>
</mujoco>"""
#: Deviations of the noise, rad and rad/s.
NOISE = np.array([1e-4, 5e-4])
#: Name → what the config of the method has beside the common keys.
METHODS: dict[str, dict[str, Any]] = {
    "dropo": {},
    "dropo, full covariance": {"covariance": "full"},
    "dropo, entropy 1": {"entropy": 1.0},
    "laplace": {"method": "laplace"},
    "droid": {"method": "droid", "method_options": {"budget": 600}},
    "simopt": {"method": "simopt", "method_options": {"samples": 60, "iterations": 15, "horizon": 20}},
    "bayessim, mdnn": {
        "method": "bayessim", "noise": NOISE.tolist(), "method_options": {"simulations": 500, "horizon": 20},
    },
    "bayessim, mdrff": {
        "method": "bayessim", "noise": NOISE.tolist(),
        "method_options": {"simulations": 500, "horizon": 20, "features": "mdrff"},
    },
    "udr": {"method": "udr"},
}  # fmt: skip


def problem_of(folder: Path, name: str, transitions: int, threads: int) -> dropo.Problem:
    """The pendulum fitted by a method; the log gives actions and a start."""
    (folder / "pendulum.xml").write_text(MODEL)
    torque = 3 * np.sin(0.31 * np.arange(transitions)) + np.sin(1.1 * np.arange(transitions))
    still = np.zeros((transitions, 2))
    np.savez(
        folder / "log.npz", observations=still, next_observations=still, actions=torque[:, None],
        terminals=np.arange(transitions) == transitions - 1,
    )  # fmt: skip
    document = {
        "model": "pendulum.xml",
        "data": "log.npz",
        "frame_skip": 4,
        "parameters": {
            "mass": {"field": "body_mass", "name": "bob", "bounds": [0.5, 2.5], "unit": "kg"},
            "damping": {"field": "dof_damping", "name": "pivot", "bounds": [0.02, 0.5], "limits": [0, 1]},
        },
        "epsilon": (NOISE**2).tolist(),
        "samples": 50,
        "threads": threads,
        **METHODS[name],
    }
    return dropo.make_problem(dropo.make_config(document, base=folder))


def fit_log(task: tuple[int, list[Trial]], *, methods: Sequence[str], transitions: int, threads: int) -> list[Trial]:
    """Fit the logs of a number, one of each kind, by the methods; return what is not among the trials done."""
    log, done = task
    with tempfile.TemporaryDirectory() as folder:
        problems = functools.partial(problem_of, Path(folder), transitions=transitions, threads=threads)
        trials = calibrate(problems, methods, logs=[log], noise=NOISE, done=done)
    return trials[len(done) :]


def markdown(rows: Sequence[Coverage]) -> str:
    lines = ["| log | method | parameter | level | covered [95 %] | width of the interval, share of the box | logs |"]
    lines.append("|---|---|---|---|---|---|---|")
    for r in rows:
        covered = f"{100 * r.covered:.0f} % [{100 * r.low:.0f}, {100 * r.high:.0f}]"
        lines.append(
            f"| {r.kind} | {r.method} | {r.parameter} | {100 * r.level:.0f} % | {covered} | {r.width:.2g} | {r.logs} |"
        )
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=100, help="of each kind")
    parser.add_argument("--transitions", type=int, default=60)
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=1, help="logs at a time")
    parser.add_argument("--resume", action="store_true", help="keep the fits that --out holds")
    given = parser.parse_args(arguments)
    if given.workers < 1:
        parser.error(f"--workers {given.workers}: expected 1 or more")
    given.out.mkdir(parents=True, exist_ok=True)
    store = given.out / "trials.jsonl"
    if store.exists() and not given.resume:
        parser.error(f"{store} exists; add --resume, or name another folder")
    done = []
    plan = json.dumps({"transitions": given.transitions, "noise": NOISE.tolist(), "methods": METHODS})
    if store.exists():
        begun, *whole = store.read_text().splitlines(keepends=True)
        if begun.strip() != plan:
            parser.error(f"{store} holds fits with other settings; name another folder")
        whole = [line for line in whole if line.endswith("\n")]  # a line that was cut short is done again
        store.write_text(begun + "".join(whole))
        done = [Trial(**json.loads(line)) for line in whole]
    else:
        store.write_text(plan + "\n")
    kept = [[t for t in done if t.log == n and t.method in given.methods] for n in range(given.logs)]
    waiting = [task for task in enumerate(kept) if len(task[1]) < 2 * len(given.methods)]  # two kinds of log
    work = functools.partial(fit_log, methods=given.methods, transitions=given.transitions)
    trials = list(done)
    with store.open("a") as stream:
        for number, (_, found) in enumerate(in_parallel(work, waiting, given.workers), given.logs - len(waiting) + 1):
            stream.writelines(json.dumps(plain(trial)) + "\n" for trial in found)
            stream.flush()
            trials += found
            print(f"{number} of {given.logs} logs of each kind", flush=True)
    table = markdown(coverages(trials))
    (given.out / "calibration.md").write_text(table)
    print(table)


if __name__ == "__main__":
    main()
