"""Does a policy that is trained over a fitted distribution work where the model is wrong?

    python examples/transfer_hopper.py --out out/transfer --seeds 3 --workers 2

The paper's unmodeled Hopper: the model's torso is 1 kg too heavy, and its mass is not among the parameters. The masses
of thigh, leg and foot are fitted to a log of the target. Then policies are trained over

``fitted``   the fitted distribution,
``point``    its means alone,
``uniform``  the whole search bounds,
``true``     the target's own masses, which nobody knows in practice,

and each is evaluated in the target. Every seed has a log, a fit and policies of its own. What is finished is kept in
``--out``: the same command goes on where it was interrupted. ``--steps`` makes it small. Numbers do not depend on
``--workers``.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import scipy.stats
from dropo_sims.hopper import SIM
from dropo_sims.hopper.record import nominal_masses, record

import dropo_torch as dropo
from dropo_torch.commands.options import workers
from dropo_torch.rl.problem import make_training
from dropo_torch.rl.train import EvaluationPoint, TrainEntry, train
from dropo_torch.support.files import write_atomically
from dropo_torch.support.parallel import in_parallel

METHODS = ("true", "fitted", "point", "uniform")
LABELS = {"true": "target's own masses", "fitted": "fitted distribution", "point": "its means", "uniform": "bounds"}
FITTED = ("thigh_mass", "leg_mass", "foot_mass")
#: How much lighter the target's torso is than the model's, kg.
LIGHTER = 1.0
#: ε of the fit: about the variance of what no value of the three masses explains.
EPSILON = 1e-3
CONFIDENCE = 0.9


def target_masses() -> dict[str, float]:
    """The masses of the target, kg."""
    masses = nominal_masses()
    return {**masses, "torso_mass": masses["torso_mass"] - LIGHTER}


def fit_log(folder: Path, seed: int, given: argparse.Namespace) -> Path:
    """Record a log of the target and fit three masses to it; return the path of the fit."""
    path = folder / "fit.json"
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    record(variant="unmodeled", seed=seed, steps=given.log_steps).save(folder / "log.npz")
    document = {"sim": "hopper", "data": "log.npz", "parameters": {n: dict(SIM.parameters[n]) for n in FITTED}}
    settings = {"seed": seed, "epsilon": given.epsilon, "threads": given.threads}
    problem = dropo.make_problem(dropo.make_config(document, settings, base=folder))
    dropo.fit(problem.objective, dropo.FitSettings(seed=seed)).save(path)
    return path


def training_config(method: str, fit: Path, seed: int, given: argparse.Namespace, threads: int) -> dropo.Config:
    """The config of one training."""
    names = tuple(SIM.parameters) if method == "true" else FITTED
    distribution: str | dict[str, float] = str(fit.resolve())
    if method == "true":
        distribution = target_masses()
    elif method == "uniform":
        distribution = "uniform"
    elif method == "point":
        found = dropo.Distribution.load(fit)
        distribution = dict(zip(found.names, found.center.tolist(), strict=True))
    document: dict[str, Any] = {
        "sim": "hopper", "parameters": {n: dict(SIM.parameters[n]) for n in names}, "distribution": distribution,
        "target": target_masses(), "algorithm": given.algorithm, "seed": seed, "threads": threads,
        "train": {"episodes": given.episodes, **({} if given.steps is None else {"steps": given.steps})},
    }  # fmt: skip
    return dropo.make_config(document, {f"train.{k}": json.loads(v) for k, v in given.train})


def run(cell: tuple[int, str], given: argparse.Namespace, threads: int) -> dict[str, Any]:
    """Train the policy of a seed and a method, or go on with it, or take the result that is there."""
    seed, method = cell
    folder = given.out / f"{method}-{seed}"
    result = folder / "train.json"
    if not result.exists():
        fit = given.out / f"fit-{seed}" / "fit.json"
        problem = make_training(training_config(method, fit, seed, given, given.threads or threads))
        tell = functools.partial(show_progress, f"{method:<8} seed {seed}")
        found = train(problem, checkpoint=folder / "train-progress.bin", resume=True, on_progress=tell)
        found.policy.save(folder / "policy.pt")
        write_atomically(result, json.dumps(found.document(), indent=2).encode())
        (folder / "train-progress.bin").unlink()
    document = json.loads(result.read_text())
    evaluation = document["evaluation"]
    return {
        "method": method, "seed": seed, "target": evaluation["target"]["mean"],
        "own": evaluation["distribution"]["mean"], "seconds": document["seconds"], "steps": document["steps"],
    }  # fmt: skip


def show_progress(name: str, entry: TrainEntry, evaluation: EvaluationPoint | None) -> None:
    """Print each evaluation on the way."""
    if evaluation is not None:
        print(f"{name}: {entry.steps:,} steps, {evaluation.mean:.1f} in training", flush=True)


def same_settings(given: argparse.Namespace) -> bool:
    """Whether the folder is new, or was begun with the same settings."""
    path = given.out / "settings.json"
    settings = {k: getattr(given, k) for k in ("steps", "algorithm", "episodes", "log_steps", "epsilon", "train")}
    if not path.exists():
        write_atomically(path, json.dumps(settings).encode())
    return json.loads(path.read_text()) == settings


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean of values over seeds, and the ends of its interval (Student's t)."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, float("nan"), float("nan")
    half = scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return mean, mean - float(half), mean + float(half)


def summary(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means and intervals over seeds, and of the differences to the fitted distribution, seed by seed."""
    target = {m: [r["target"] for r in runs if r["method"] == m] for m in METHODS}
    own = {m: [r["own"] for r in runs if r["method"] == m] for m in METHODS}
    ahead = {m: interval(np.subtract(target["fitted"], target[m]).tolist()) for m in METHODS if m != "fitted"}
    return {
        "confidence": CONFIDENCE,
        "target": {m: interval(v) for m, v in target.items()},
        "own": {m: interval(v) for m, v in own.items()},
        "fitted_ahead_of": ahead,
        "runs": list(runs),
    }


def show(found: dict[str, Any]) -> None:
    print(f"\nmean return in the target [{100 * CONFIDENCE:.0f} % interval over seeds], and where it was trained")
    for method in METHODS:
        mean, low, high = found["target"][method]
        print(f"  {LABELS[method]:<22} {mean:8.1f} [{low:8.1f}, {high:8.1f}]   {found['own'][method][0]:8.1f}")
    print("fitted distribution ahead of, seed by seed")
    for method, (mean, low, high) in found["fitted_ahead_of"].items():
        print(f"  {LABELS[method]:<22} {mean:8.1f} [{low:8.1f}, {high:8.1f}]")


def draw(found: dict[str, Any], path: Path) -> None:
    """Draw the returns in the target: a dot a seed, mean and interval."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6.4, 2.6), layout="constrained")
    for row, method in enumerate(METHODS):
        values = [r["target"] for r in found["runs"] if r["method"] == method]
        mean, low, high = found["target"][method]
        color = "#d55e00" if method == "fitted" else "#7b8794"
        axes.plot([low, high], [row, row], color=color, linewidth=3, alpha=0.4, solid_capstyle="butt")
        axes.plot(values, [row] * len(values), "o", color=color, markersize=4)
        axes.plot([mean, mean], [row - 0.3, row + 0.3], color=color, linewidth=2)
    axes.set_yticks(range(len(METHODS)), [LABELS[m] for m in METHODS])
    axes.set_ylim(len(METHODS) - 0.5, -0.5)
    axes.set_xlabel(f"return in the target (dot: seed; bar: {100 * CONFIDENCE:.0f} % interval of the mean)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/transfer"), help="folder of the results")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, help="environment steps of each training; the algorithm's by default")
    parser.add_argument("--algorithm", choices=["ppo", "sac"], default="ppo")
    parser.add_argument("--episodes", type=int, default=50, help="of each evaluation")
    parser.add_argument("--epsilon", type=float, default=EPSILON, help="of the fit")
    parser.add_argument("--log-steps", type=int, default=500, help="transitions of each of the log's two episodes")
    parser.add_argument("--threads", type=int, default=0, help="of the simulator")
    parser.add_argument("--workers", type=workers, default=1, metavar="N|ray", help="trainings side by side")
    parser.add_argument(
        "--train", nargs=2, action="append", default=[], metavar=("KEY", "VALUE"), help="a setting of the training"
    )
    given = parser.parse_args(arguments)
    if not same_settings(given):
        parser.error(f"{given.out} holds a study with other settings; name another folder")
    for seed in range(given.seeds):
        fit_log(given.out / f"fit-{seed}", seed, given)
    cells = list(itertools.product(range(given.seeds), METHODS))
    done: dict[tuple[int, str], dict[str, Any]] = {}
    for (seed, method), found in in_parallel(functools.partial(run, given=given), cells, given.workers):
        done[seed, method] = found
        told = f"{found['target']:.1f} in the target, {found['own']:.1f} in training"
        print(f"{method:<8} seed {seed}: {told}", flush=True)
    runs = [done[cell] for cell in cells]
    study = summary(runs)
    write_atomically(given.out / "transfer.json", json.dumps(study, indent=2).encode())
    draw(study, given.out / "transfer.png")
    show(study)


if __name__ == "__main__":
    main()
