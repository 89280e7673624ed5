"""Run a fit whole, then again and again with kills until it is done: ``killed.py CONFIG OUT KILLS SEED``.

Every attempt is a process of its own, forked where all is imported. A kill falls on a seeded write of the
checkpoint, just before or just after the temporary file takes the checkpoint's name, or at a seeded moment
of the optimization. The last line of the output tells, as JSON, what happened.
"""

from __future__ import annotations

import functools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from dropo_torch.commands.cli import main
from dropo_torch.fit import HistoryEntry
from dropo_torch.optimizers.fisher import FisherOptimizer
from dropo_torch.support.checkpoint import loads

RESULTS = ("distribution.yaml", "model.xml", "fitted_config.yaml")


def attempt(config: str, out: Path, plan: dict[str, Any] | None) -> tuple[int, str]:
    """Run ``dropo fit --resume`` in a child that the plan kills; return its exit code and stderr."""
    with tempfile.TemporaryFile("w+") as errors:
        child = os.fork()
        if child == 0:
            os.dup2(errors.fileno(), 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            if plan is not None:
                die_around_writes(plan)
            os._exit(main(["fit", config, "--out", str(out), "--resume"]))
        status = os.waitpid(child, 0)[1]
        errors.seek(0)
        return os.waitstatus_to_exitcode(status), errors.read()


def die_around_writes(plan: dict[str, Any]) -> None:
    """Let this process die just before or after a file takes its name, or some time after the first does."""
    replace, count = os.replace, 0
    die = functools.partial(os.kill, os.getpid(), signal.Signals[plan["signal"]])

    def deadly(source: Any, target: Any) -> None:
        nonlocal count
        count += 1
        if count == plan["write"] and plan["when"] == "before":
            die()
        replace(source, target)
        if count == plan["write"] and plan["when"] == "after":
            die()
        elif count == 1 and plan["when"] == "later":
            timer = threading.Timer(plan["seconds"], die)
            timer.daemon = True
            timer.start()

    os.replace = deadly


def run(config: str, out: Path, kills: int, seed: int) -> dict[str, Any]:
    """The uninterrupted run, and one that is killed ``kills`` times unless it finishes before."""
    rng = random.Random(seed)
    shutil.rmtree(out, ignore_errors=True)
    code, error = attempt(config, out / "whole", None)
    assert (code, error) == (0, ""), error
    entries = kept(out / "whole")
    deaths, resumed, part = [], 0, 0
    for number in range(kills):
        plan = {
            "signal": rng.choice(["SIGKILL", "SIGINT"]),
            "when": ["before", "later", "after"][number % 3],
            "write": rng.randint(2, 1 + len(entries) // 4),
            "seconds": rng.uniform(0, 0.5) * entries[-1].seconds,
        }
        pieces = out / f"pieces-{part}"
        resumed += (pieces / "checkpoint.bin").exists()
        code, error = attempt(config, pieces, plan)
        if code == 0:  # it was quicker than its death: the next kills fall on another run
            compare(out / "whole", pieces)
            part += 1
        else:
            deaths.append({**plan, "code": code, "stderr": error})
    pieces = out / f"pieces-{part}"
    code, error = attempt(config, pieces, None)
    assert (code, error) == (0, ""), error
    return {
        "whole": json.loads((out / "whole" / "fit.json").read_text()),
        "pieced": json.loads((pieces / "fit.json").read_text()),
        "same_files": {name: (out / "whole" / name).read_bytes() == (pieces / name).read_bytes() for name in RESULTS},
        "leftovers": [p.name for p in pieces.iterdir() if p.name.startswith((".", "previous"))],
        "same_history": history(out / "whole") == history(pieces),
        "deaths": deaths,
        "resumed": resumed,
    }


def compare(whole: Path, pieces: Path) -> None:
    first, second = (json.loads((folder / "fit.json").read_text()) for folder in (whole, pieces))
    assert {**first, "seconds": 0} == {**second, "seconds": 0}
    assert history(whole) == history(pieces)


def history(folder: Path) -> list[str]:
    """Every batch of a fit, but for the time it took, to the last digit."""
    entries = [vars(entry) for entry in kept(folder)]
    return [repr({k: getattr(v, "tolist", lambda v=v: v)() for k, v in e.items() if k != "seconds"}) for e in entries]


def kept(folder: Path) -> list[HistoryEntry]:
    """The history in a checkpoint."""
    roots = (HistoryEntry, *FisherOptimizer.KINDS)
    return loads((folder / "checkpoint.bin").read_bytes(), roots)[2]["history"]


if __name__ == "__main__":
    print(json.dumps(run(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))))
