"""Score the remaining time that `dropo gap` shows: the share of instants at which it is right within a factor of two.

python benchmarks/time_left.py --cases '*torque_arm*' --out out/remaining.jsonl   # run, and keep what is reported
python benchmarks/time_left.py --read out/remaining.jsonl                         # score what was kept
python benchmarks/time_left.py --read out/remaining.jsonl --table                 # and print what stages cost

Instants from a quarter of a run up to 95 % of it count, as long as two seconds remain. Times are of the processor, with
one thread, so that other work on the machine has no part in them.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.hidden.cases import CaseSpec, cases, select
from dropo_torch.config import load_config
from dropo_torch.gap import find_gap
from dropo_torch.gap.time_left import TimeLeft
from dropo_torch.problem import make_problem

#: Shares of a run between which instants count, how many there are, and the seconds that remain at least.
FIRST, LAST, INSTANTS, LEAST = 0.25, 0.95, 200, 2.0
#: A factor up to which an estimate is right.
FACTOR = 2.0
#: Shares of a run at which a line shows what was estimated, relative to what remained.
SHOWN = (0.25, 0.4, 0.55, 0.7, 0.85)


@dataclass(frozen=True)
class Run:
    """What a run reported.

    Attributes:
        name: of the case.
        seconds: it took.
        reports: stage, share and seconds since the beginning.
    """

    name: str
    seconds: float
    reports: Sequence[tuple[str, float, float]]

    def at(self, now: float) -> TimeLeft:
        """Return what was known at an instant."""
        known = TimeLeft()
        for stage, share, seconds in self.reports:
            if seconds <= now:
                known = known.told(stage, share, seconds)
        return known


def record(spec: CaseSpec, backend: str) -> Run:
    """Run a case and keep what it reports."""
    reports: list[tuple[str, float, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        config = load_config(spec.make().write(folder), {"backend": backend, "threads": 1})
        problem = make_problem(config, general=True)
        started = time.process_time()
        find_gap(problem, report=lambda stage, share: reports.append((stage, share, time.process_time() - started)))
    return Run(spec.name, time.process_time() - started, reports)


def errors(run: Run) -> np.ndarray:
    """Return estimated by true remaining time at the instants that count, NaN where there is no estimate."""
    instants = np.linspace(FIRST, LAST, INSTANTS) * run.seconds
    instants = instants[run.seconds - instants >= LEAST]
    return np.array([run.at(t).left(t) / (run.seconds - t) for t in instants])


def share_right(ratios: np.ndarray) -> float:
    """Return the share of estimates that are right within the factor."""
    return float(np.mean((ratios >= 1 / FACTOR) & (ratios <= FACTOR)))


def one_line(run: Run) -> str:
    """A run's score, and what was estimated at some instants, relative to what remained."""
    instants = [share * run.seconds for share in SHOWN]
    ratios = [run.at(t).left(t) / (run.seconds - t) for t in instants]
    shown = " ".join(f"{ratio:5.2f}" for ratio in ratios)
    return f"{run.name:48s} {run.seconds:6.1f} s  {100 * share_right(errors(run)):5.1f} %  {shown}"


def costs(runs: Sequence[Run]) -> Iterator[str]:
    """Lines of what a visit of each stage costs, relative to what all stages of its run do, and of visits in a run."""
    found = defaultdict(list)
    for run in runs:
        visits = run.at(run.seconds).visits
        ends = [v.began for v in visits[1:]] + [run.seconds]
        times = [(v.stage, end - v.began) for v, end in zip(visits, ends, strict=True)]
        unit = run.seconds / sum(stage.cost for stage, _ in times)
        for stage, seconds in times:
            found[stage].append(seconds / unit)
    for stage, seconds in found.items():
        low, middle, high = np.quantile(seconds, (0.1, 0.5, 0.9))
        yield (
            f"{stage.words:34s} {middle:5.2f} ({low:5.2f} to {high:5.2f}), planned {stage.cost:5.2f}; "
            f"{len(seconds) / len(runs):4.1f} visits"
        )


def read(path: Path) -> list[Run]:
    """Return the runs that were kept in a file."""
    return [Run(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=901, help="of targets, strengths and logs")
    parser.add_argument(
        "--cases", nargs="+", default=["*"], metavar="PATTERN", help="only the cases whose name matches"
    )
    parser.add_argument("--backend", choices=("mujoco", "warp"), default="mujoco")
    parser.add_argument("--out", type=Path, metavar="FILE", help="of what runs report, appended as they end")
    parser.add_argument("--read", type=Path, metavar="FILE", help="score what was kept instead of running")
    parser.add_argument("--table", action="store_true", help="print what stages cost")
    given = parser.parse_args(arguments)
    print(f"{'case':48s} {'took':>8s}  {'right':>7s}  " + " ".join(f"{100 * share:3.0f} %" for share in SHOWN))
    runs = []
    for run in read(given.read) if given.read else _recorded(given):
        runs.append(run)
        print(one_line(run), flush=True)
    ratios = np.concatenate([errors(run) for run in runs])
    print(f"right within a factor of {FACTOR:g}: {100 * share_right(ratios):.1f} % of {len(ratios)} instants")
    if given.table:
        print("\n".join(costs(runs)))


def _recorded(given: argparse.Namespace) -> Iterator[Run]:
    every = cases(given.seed)
    for spec in {s.name: s for pattern in given.cases for s in select(every, pattern)}.values():
        run = record(spec, given.backend)
        if given.out:
            given.out.parent.mkdir(parents=True, exist_ok=True)
            with given.out.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(asdict(run)) + "\n")
        yield run


if __name__ == "__main__":
    main()
