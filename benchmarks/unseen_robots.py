"""Take robots with hidden effects through ``dropo init`` and ``dropo gap`` as a user would, and judge the answers.

python benchmarks/unseen_robots.py --out out/unseen --jobs 2     # all robots; --seed N for other motions and noise
python benchmarks/unseen_robots.py --cases 'ro*'                 # some of them
python benchmarks/unseen_robots.py --out out/unseen --resume     # go on where it stopped
python benchmarks/unseen_robots.py --logs out/logs               # only write the models and logs, and what is true

Models, truths, motions and logs are in ``benchmarks/unseen``, simulated by plain MuJoCo alone. No config is edited.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.hidden_effects import read_results, share, spread_of, with_interval
from benchmarks.unseen.judge import judge, required
from benchmarks.unseen.record import write
from benchmarks.unseen.robots import ROBOTS, select
from dropo_torch.commands.options import workers
from dropo_torch.errors import InputError
from dropo_torch.support.parallel import in_parallel

ROOT = Path(__file__).parents[1]
#: Seconds after which a command is taken to hang; ``dropo gap`` ends its search after ten minutes by itself.
HANGS = 1800.0


class CommandFailed(Exception):
    """A command that ended with an error: its last line."""


def run_command(arguments: Sequence[str], folder: Path, threads: int) -> tuple[float, float]:
    """Run ``dropo`` in a folder; return the seconds and the seconds of processors that it took.

    Raises:
        CommandFailed: it ended with an error, or not at all.
    """
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    if threads:
        environment["OMP_NUM_THREADS"] = str(threads)
    began, used = time.perf_counter(), _children_seconds()
    with (folder / f"{arguments[0]}.txt").open("w", encoding="utf-8") as stream:
        command = [sys.executable, "-m", "dropo_torch", *arguments]
        try:
            done = subprocess.run(
                command, cwd=folder, env=environment, stdout=stream, stderr=subprocess.STDOUT, timeout=HANGS
            )
        except subprocess.TimeoutExpired:
            raise CommandFailed(f"dropo {arguments[0]} did not end in {HANGS:g} s") from None
    if done.returncode:
        said = Path(stream.name).read_text(encoding="utf-8").strip().splitlines()
        raise CommandFailed(f"dropo {arguments[0]} exited with {done.returncode}: {said[-1] if said else ''}")
    return time.perf_counter() - began, _children_seconds() - used


def _children_seconds() -> float:
    """Processor seconds of the processes that this one has waited for."""
    times = os.times()
    return times.children_user + times.children_system


def attempt(name: str, seed: int, folder: Path, threads: int = 0) -> dict[str, Any]:
    """Write a robot's log, take it through both commands, and judge the answer; what fails is recorded."""
    robot, place = ROBOTS[name], folder / name
    result: dict[str, Any] = {"name": name, "seed": seed, "truth": required(robot), "outside": robot.is_outside}
    try:
        model, log = write(robot, place, seed)
        result["init"] = run_command(["init", model.name, log.name, "--overwrite"], place, threads)
        limited = ["--threads", str(threads)] if threads else []
        result["gap"] = run_command(["gap", "robot.yaml", "--out", "gap", *limited], place, threads)
        document = json.loads((place / "gap" / "gap.json").read_text(encoding="utf-8"))
        result |= asdict(judge(robot, document))
    except CommandFailed as error:
        result["failure"] = str(error)
    except Exception as error:  # one that fails must not stop the others
        result["failure"] = f"{type(error).__name__}: {error}"
    return result


# --- the summary ------------------------------------------------------------------------------------------------


def truth_in_words(result: Mapping[str, Any]) -> str:
    """What is hidden."""
    outside = ["something without a name"] if result["outside"] else []
    return " + ".join([*result["truth"], *outside]) or "nothing"


def one_line(result: Mapping[str, Any]) -> str:
    """A result as a line."""
    asked = f"{result['name']} [{truth_in_words(result)}]"
    if "failure" in result:
        return f"WRONG {asked}: {result['failure']}"
    took = ", ".join(f"{c} {result[c][0]:.0f} s ({result[c][1]:.0f} s of processor)" for c in ("init", "gap"))
    off = f", numbers at most {100 * max(result['errors'].values()):.2g} % off" if result["errors"] else ""
    why = f" ({result['why']})" if result["why"] else ""
    return f"{'right' if result['right'] else 'WRONG'} {asked} → {result['told']}{why}{off}; {took}"


def totals(results: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The scores by name; what failed is wrong."""
    done = [r for r in results if "failure" not in r]
    kinds = {
        "effects of the vocabulary": [r for r in results if r["truth"] and not r["outside"]],
        "nothing is missing": [r for r in results if not r["truth"] and not r["outside"]],
        "outside the vocabulary": [r for r in results if r["outside"]],
    }
    rights = {f"right, {kind}": share([bool(r.get("right")) for r in members]) for kind, members in kinds.items()}
    errors = [e for r in done if r["right"] for e in r["errors"].values()]
    return {
        "right": share([bool(r.get("right")) for r in results]),
        **rights,
        "right, without a name more": share([bool(r.get("right")) and not r["extra"] for r in results]),
        "numbers within 5 %": share([e <= 0.05 for e in errors]),
        "true number in the 90 % interval": with_interval([h for r in done if r["right"] for h in r["held"].values()]),
        "processor seconds of init": spread_of([r["init"][1] for r in done], "{:.0f}"),
        "processor seconds of gap": spread_of([r["gap"][1] for r in done], "{:.0f}"),
        "failed": str(len(results) - len(done)),
    }


# --- running them -----------------------------------------------------------------------------------------------


def write_logs(names: Sequence[str], folder: Path, seed: int) -> None:
    """Write models and logs, and ``truth.json`` with what each model lacks."""
    for name in names:
        print(*write(ROBOTS[name], folder / name, seed), flush=True)
    hidden = {
        name: [{"names": h.names, "equals": h.equals, "values": h.values} for h in ROBOTS[name].hidden]
        for name in names
    }
    (folder / "truth.json").write_text(json.dumps(hidden, indent=1) + "\n", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, help="of motions, starts and noise (0)")
    parser.add_argument("--cases", default="*", metavar="PATTERN", help="only the robots whose name matches")
    parser.add_argument("--jobs", type=workers, default=1, metavar="N|ray", help="processes")
    parser.add_argument("--out", type=Path, help="folder of results.jsonl and a folder for each robot")
    parser.add_argument("--resume", action="store_true", help="skip the robots that are in results.jsonl; its seed")
    parser.add_argument("--list", action="store_true", help="print the robots and what their models lack, and stop")
    parser.add_argument("--logs", type=Path, metavar="DIR", help="only write models and logs there")
    given = parser.parse_args(arguments)
    names = select(given.cases)
    if given.list:
        print("\n".join(f"{name:12s} {ROBOTS[name].summary}" for name in names))
    elif given.logs is not None:
        write_logs(names, given.logs, given.seed or 0)
    elif given.out is not None:
        run_all(parser, given, names, given.out)
    elif given.resume:
        parser.error("--resume needs --out")
    else:
        with tempfile.TemporaryDirectory() as folder:
            run_all(parser, given, names, Path(folder))


def run_all(parser: argparse.ArgumentParser, given: argparse.Namespace, names: Sequence[str], folder: Path) -> None:
    """Run robots, print a line for each, and the totals."""
    path = folder / "results.jsonl"
    before = read_results(path)
    if before and not given.resume:
        parser.error(f"--out: {path} holds results; add --resume to go on with them, or name another folder")
    seed = given.seed if given.seed is not None else (before[0]["seed"] if before else 0)
    kept = [r for r in before if r["seed"] == seed and "failure" not in r]
    results = [r for r in kept if r["name"] in names]
    waiting = [name for name in names if name not in {r["name"] for r in results}]
    print(f"seed {seed}: {len(names)} robots, {len(results)} of them done before", flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(r) + "\n" for r in kept), encoding="utf-8")
    work = functools.partial(attempt, seed=seed, folder=folder.resolve())
    try:
        for _, result in in_parallel(work, waiting, given.jobs):
            results.append(result)
            print(f"{len(results)}/{len(names)} {one_line(result)}", flush=True)
            with path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(result) + "\n")
    except InputError as error:
        print(f"{error}; not done: {', '.join(set(names) - {r['name'] for r in results})}", flush=True)
    print()
    for what, value in totals(results).items():
        print(f"{what:40s} {value}")


if __name__ == "__main__":
    main()
