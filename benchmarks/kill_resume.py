"""Kill every command with SIGKILL at random moments, resume it, and compare with a run that nobody killed.

    python benchmarks/kill_resume.py [--kills 20] [--seed 0] [--only fit-fisher ...] [--out out/kill_resume]

Each kill is a run of its own: in a fresh folder the command is killed at a moment drawn from the length of the whole
run, and the same command with ``--resume`` then runs to its end. Its documents must be those of the whole run in every
key but the seconds, its other results to the last byte. Prints a table, and what differs where something does.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from dropo_torch.commands.cli import main as dropo

#: Keys that say how long something took.
SECONDS = ("seconds", "simulating_seconds", "learning_seconds")


def cart_pole(**changes: Any) -> Callable[[Path], Path]:
    """A cart-pole's log with damping at its hinge that the model lacks, and a config with some keys changed."""

    def write(folder: Path) -> Path:
        from benchmarks.hidden.systems import CART_POLE
        from benchmarks.hidden.truths import Effect, simulate_truth

        effect = Effect("joint_damping", "hinge", {"damping": 0.02})
        path = simulate_truth(CART_POLE, [effect], 3, episodes=3, transitions=60).write(folder)
        config = {**yaml.safe_load(path.read_text()), "threads": 1, "samples": 10, **changes}
        path.write_text(yaml.safe_dump(config))
        return path

    return write


def hopper(algorithm: str, **settings: Any) -> Callable[[Path], Path]:
    """A short training of the bundled Hopper under a uniform distribution."""
    small = {"num_envs": 4, "hidden": [8], "episodes": 2, "evaluations": 4, "checkpoint_seconds": 0}
    config = {"sim": "hopper", "distribution": "uniform", "algorithm": algorithm, "threads": 1}

    def write(folder: Path) -> Path:
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(yaml.safe_dump({**config, "train": {**small, **settings}}))
        return folder / "config.yaml"

    return write


#: Name → the command, its options, and what writes its config.
CASES: dict[str, tuple[str, tuple[str, ...], Callable[[Path], Path]]] = {
    "fit-fisher": ("fit", (), cart_pole(noise=1e-3, epsilon=1e-8)),
    "fit-full": ("fit", (), cart_pole(noise=None, covariance="full", epsilon=1e-6)),
    "fit-cma": ("fit", (), cart_pole(noise=None, optimizer="cma", budget=150)),
    "fit-adam": ("fit", (), cart_pole(noise=None, optimizer="adam", backend="warp", adam={"steps": 20, "samples": 4})),
    "gap": ("gap", (), cart_pole()),
    "plan": ("plan", ("--seconds", "2", "--evaluations", "60", "--no-video"), cart_pole(noise=1e-3)),
    "compare": ("compare", ("--methods", "fisher-mujoco,cma-mujoco", "--seeds", "1"), cart_pole(budget=30)),
    "sweep-epsilon": ("sweep-epsilon", ("--epsilons", "1e-6,1e-5,1e-4"), cart_pole(noise=None)),
    "train-ppo": ("train", (), hopper("ppo", steps=1024, horizon=32, minibatch=32)),
    "train-sac": ("train", (), hopper("sac", steps=400, warmup=64, minibatch=16, buffer=300)),
}


def attempt(arguments: list[str], after: float | None = None) -> int:
    """Run a command in a process of its own, killed after some seconds; return its exit code."""
    child = os.fork()
    if child == 0:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        code = 1
        try:
            code = dropo(arguments)
        finally:
            os._exit(code)
    if after is not None:
        time.sleep(after)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def documents(out: Path) -> dict[str, Any]:
    """What a run has written, but for its report, its checkpoints and how long it took."""
    found: dict[str, Any] = {}
    for path in sorted(out.iterdir()):
        if path.suffix == ".json" and "progress" not in path.name:
            found[path.name] = timeless(json.loads(path.read_text()))
        elif path.name == "policy.pt":
            from dropo_torch.rl.policy import load_policy

            found[path.name] = {name: t.tolist() for name, t in load_policy(path).state_dict().items()}
        elif path.suffix in (".yaml", ".xml"):
            found[path.name] = path.read_bytes().replace(str(out).encode(), b"OUT")
    return found


def timeless(document: Any) -> Any:
    """A document without the keys that say how long something took."""
    if isinstance(document, dict):
        return {k: timeless(v) for k, v in document.items() if k not in SECONDS}
    return [timeless(v) for v in document] if isinstance(document, list) else document


def differences(first: Any, second: Any, at: str = "") -> list[str]:
    """Where two documents differ."""
    if isinstance(first, dict) and isinstance(second, dict):
        keys = {**first, **second}
        return [d for k in keys for d in differences(first.get(k), second.get(k), f"{at}.{k}")]
    return [] if repr(first) == repr(second) else [f"{at[1:]}: {str(first)[:60]} and {str(second)[:60]}"]


def run(name: str, folder: Path, kills: int, seed: int) -> dict[str, Any]:
    """Kill and resume one command; count what became of it."""
    command, options, write = CASES[name]
    rng = random.Random(f"{seed}/{name}")
    shutil.rmtree(folder, ignore_errors=True)
    config = str(write(folder / "input"))
    arguments = [command, config, *options]
    begun = time.monotonic()
    code = attempt([*arguments, "--out", str(folder / "whole")])
    seconds = time.monotonic() - begun
    assert code == 0, f"{name}: exit code {code}"
    whole = documents(folder / "whole")
    found: dict[str, Any] = {"seconds": seconds, "killed": 0, "went on": 0, "equal": 0, "runs": 0, "differences": []}
    while found["killed"] < kills and found["runs"] < 2 * kills:
        found["runs"] += 1
        out, begun = folder / f"killed-{found['runs']}", time.monotonic()
        if attempt([*arguments, "--out", str(out)], rng.uniform(0, seconds)) == 0:
            seconds = min(seconds, time.monotonic() - begun)  # the first one may have compiled kernels besides
            continue  # done before its death
        found["killed"] += 1
        found["went on"] += out.exists() and any("progress" in p.name or "checkpoint" in p.name for p in out.iterdir())
        code = attempt([*arguments, "--out", str(out), "--resume"])
        unlike = [f"exit code {code}"] if code else differences(whole, documents(out))
        left = [p.name for p in out.iterdir() if p.name.endswith(".tmp")]
        unlike += [f"{left} left behind"] if left else []
        found["equal"] += not unlike
        found["differences"] += unlike
        shutil.rmtree(out)
    return found


def main() -> int:
    """Run all commands and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--out", type=Path, default=Path("out/kill_resume"))
    given = parser.parse_args()
    for module in ("commands.fit", "problem", "baselines", "report.fit", "diagnostics", "gap", "planning", "rl.train"):
        importlib.import_module(f"dropo_torch.{module}")  # so that kills fall on work, and not on imports
    console, table = Console(), Table("command", "seconds", "killed", "resumed from a checkpoint", "equal")
    wrong = 0
    for name in given.only:
        found = run(name, (given.out / name).resolve(), given.kills, given.seed)
        for words in found["differences"]:
            console.print(f"{name}: {words}", markup=False)
        wrong += found["killed"] - found["equal"]
        equal = f"{found['equal']} of {found['killed']}"
        table.add_row(name, f"{found['seconds']:.1f}", str(found["killed"]), str(found["went on"]), equal)
        console.print(f"{name}: {equal}", markup=False)
    console.print(table)
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main())
