"""How often the intervals of each method hold the truth, over simulated logs of a driven pendulum.

    python benchmarks/calibration.py --logs 100 --out out/calibration --workers 2     # --resume goes on

Writes ``cells/``, a file a fit, and ``calibration.md``. Mass and damping are searched for; the
log has 60 transitions and noise on their ends, whose variance is ε. ``intervals.py`` has the
two kinds of log.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import dropo_torch as dropo
from benchmarks.intervals import KINDS, CalibrationCell, CalibrationRun, Coverage, calibrate, coverages
from dropo_torch.commands.options import workers
from dropo_torch.studies.study import run_cells

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
#: σ of the noise, rad and rad/s.
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


def problem_of(folder: Path, keys: dict[str, Any], transitions: int, threads: int) -> dropo.Problem:
    """The pendulum, with more keys of a config; the log gives actions and a start."""
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
        **keys,
    }
    return dropo.make_problem(dropo.make_config(document, base=folder))


@dataclass(frozen=True)
class Plan:
    """What all fits have in common."""

    transitions: int
    noise: tuple[float, ...] = tuple(NOISE.tolist())
    methods: dict[str, Any] = field(default_factory=lambda: METHODS)


def fit_cell(cell: CalibrationCell, *, transitions: int, threads: int) -> dict[str, Any]:
    """Fit one simulated log by one method."""
    with tempfile.TemporaryDirectory() as folder:
        problem = problem_of(Path(folder), METHODS[cell.method], transitions, threads)
        return asdict(calibrate(cell, problem, noise=NOISE))


def markdown(rows: Sequence[Coverage]) -> str:
    lines = ["| log | method | parameter | level | covered [95 %] | width of the interval, share of the box | logs |"]
    lines.append("|---|---|---|---|---|---|---|")
    for r in rows:
        covered = f"{100 * r.covered:.0f} % [{100 * r.low:.0f}, {100 * r.high:.0f}]"
        lines.append(
            f"| {r.kind} | {r.method} | {r.parameter} | {100 * r.level:.0f} % | {covered} | {r.width:.2g} | {r.logs} |"
        )
    return "\n".join(lines) + "\n"


def options(doc: str | None) -> argparse.ArgumentParser:
    """What every study of many fits is told on the command line."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=100, help="of each kind")
    parser.add_argument("--transitions", type=int, default=60)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=workers, default=1, metavar="N|ray", help="logs at a time")
    parser.add_argument("--resume", action="store_true", help="keep the fits that --out holds")
    return parser


def fit_all(
    parser: argparse.ArgumentParser, given: argparse.Namespace, plan: object, cells: Sequence[CalibrationCell],
    work: Callable[..., dict[str, Any]],
) -> list[dict[str, Any]]:  # fmt: skip
    """Fit every cell, with its progress, and return all results; what is wrong ends the command in one line."""
    for name in ("logs", "transitions"):
        if (number := getattr(given, name, 1)) < 1:
            parser.error(f"--{name} {number}: expected 1 or more")
    try:
        return run_cells(
            given.out, plan, cells, work, resume=given.resume, workers=given.workers,
            report=lambda stage, _: print(stage, flush=True),
        )  # fmt: skip
    except dropo.InputError as error:
        parser.error(str(error))


def write_table(path: Path, table: str) -> None:
    """Write a table, and print it."""
    path.write_text(table)
    print(table)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = options(__doc__)
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    given = parser.parse_args(arguments)
    cells = [CalibrationCell(k, m, n) for n in range(given.logs) for k in KINDS for m in given.methods]
    found = fit_all(
        parser, given, Plan(given.transitions), cells, functools.partial(fit_cell, transitions=given.transitions)
    )
    runs = [CalibrationRun(**{k: v for k, v in run.items() if k != "cell"}) for run in found]
    write_table(given.out / "calibration.md", markdown(coverages(runs)))


if __name__ == "__main__":
    main()
