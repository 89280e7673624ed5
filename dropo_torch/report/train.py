"""The page of a training: the learning curve, how good the policy is, what it was trained on, an episode."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from dropo_torch.report import figures, words
from dropo_torch.report.html import config_yaml, render
from dropo_torch.rl.evaluate import Returns
from dropo_torch.rl.train import Training
from dropo_torch.support.files import write_atomically

WORLDS = {
    "distribution": "the distribution it was trained on",
    "nominal": "the nominal model",
    "target": "the target model",
}
_COLOURS = {"distribution": figures.GREY, "nominal": figures.BLUE, "target": figures.ORANGE}


def write_train_report(
    path: str | Path,
    training: Training,
    *,
    config: Mapping[str, Any] | None,
    versions: Mapping[str, str] | None = None,
    title: str = "Trained policy",
    strip: bytes | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Write the report of a training as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        training: the result.
        config: the run's config, printed as YAML.
        versions: name → version of what the result depends on.
        title: of the page.
        strip: a PNG of an episode, or ``None``.
        notes: further sentences for the reader.
    """
    found = evaluations(training)
    content = {
        "title": title,
        "headline": headline(training),
        "tiles": _tiles(training),
        "findings": _findings(training),
        "notes": list(notes),
        "curve": Markup(curve_panel(training)),
        "rows": [_row(name, e) for name, e in found.items()],
        "episodes": Markup(episodes_panel(found)),
        "kind": training.policy.distribution.get("kind", ""),
        "parameters": _parameters(training.policy.distribution),
        "strip": "" if strip is None else base64.b64encode(strip).decode(),
        "facts": _facts(training),
        "config": config_yaml(config),
        "versions": dict(versions or {}),
    }
    write_atomically(Path(path), render("train.html", content))


def evaluations(training: Training) -> dict[str, Returns]:
    """Return the evaluations that there are, by world."""
    given = {"distribution": training.training, "nominal": training.nominal, "target": training.target}
    return {name: e for name, e in given.items() if e is not None}


def headline(training: Training) -> str:
    """Return how good the policy is, in a sentence or two."""
    parts = []
    for name in ("nominal", "target"):
        found = evaluations(training).get(name)
        if found is not None:
            parts.append(f"{_return(found)} in {WORLDS[name]}")
    if not parts:
        parts.append(f"{_return(training.training)} under {WORLDS['distribution']}")
    count = len(training.training.returns)
    return (
        f"Trained by {training.algorithm.upper()} in {figures.plain(training.steps)} environment steps. Mean return: "
        f"{', and '.join(parts)} ({words.whole(count, 'episode')} each, without exploration)."
    )


def curve_panel(training: Training) -> str:
    """Draw the return of training episodes and of evaluations against environment steps."""
    figure = figures.new_figure(760, 300)
    axes = figures.new_axes(figure, (64, 42, 14, 26))
    axes.grid(color="#edf0f3", linewidth=0.8)
    axes.set_axisbelow(True)
    steps = np.array([e.steps for e in training.history], dtype=float)
    returns = np.array([e.mean_return for e in training.history])
    keep = np.isfinite(returns)
    if keep.any():
        axes.plot(steps[keep], returns[keep], color=figures.BLUE, linewidth=1.4)
    at = np.array([e.steps for e in training.evaluations], dtype=float)
    mean, std = (np.array([getattr(e, k) for e in training.evaluations]) for k in ("mean", "std"))
    axes.errorbar(at, mean, std, color=figures.INK, linewidth=0.9, marker="o", markersize=3.5, linestyle="none")
    best = [e for e in training.evaluations if e.kept][-1:]
    if best:
        axes.plot([best[0].steps], [best[0].mean], "o", markersize=8, color="none", markeredgecolor=figures.ORANGE)
    axes.set_xlim(0, float(training.steps) * 1.02)
    figures._few_ticks(axes.xaxis, 6)
    figures._few_ticks(axes.yaxis, 6)
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return of an episode")
    figures._clock(axes, steps, np.array([e.seconds for e in training.history]))
    return figures.to_svg(figure, "return against environment steps")


def episodes_panel(found: Mapping[str, Returns]) -> str:
    """Draw the return of every episode of each evaluation as a dot, and the mean as a stroke."""
    figure = figures.new_figure(760, 58 + 34 * len(found))
    axes = figures.new_axes(figure, (120, 42, 14, 8))
    axes.grid(axis="x", color="#edf0f3", linewidth=0.8)
    axes.set_axisbelow(True)
    for row, (name, e) in enumerate(found.items()):
        axes.plot(e.returns, np.full(len(e.returns), row), "o", color=_COLOURS[name], alpha=0.45, markersize=6)
        axes.plot([e.mean, e.mean], [row - 0.32, row + 0.32], color=_COLOURS[name], linewidth=2.2)
    axes.set_ylim(len(found) - 0.5, -0.5)
    axes.set_yticks(range(len(found)), list(found))
    axes.tick_params(axis="y", length=0, pad=8, labelsize=11)
    axes.spines["left"].set_visible(False)
    figures._few_ticks(axes.xaxis, 7)
    axes.set_xlabel("return of an episode")
    return figures.to_svg(figure, "returns of the evaluation episodes")


def _return(found: Returns) -> str:
    return f"{words.number(found.mean, found.standard_error)} ± {words.number(found.std, found.std)}"


def _row(name: str, found: Returns) -> dict[str, str]:
    return {
        "name": name,
        "what": WORLDS[name],
        "mean": words.number(found.mean, found.standard_error),
        "error": words.number(found.standard_error, found.standard_error),
        "std": words.number(found.std, found.std),
        "least": words.number(min(found.returns), max(found.std, 1e-9)),
        "length": f"{np.mean(found.lengths):,.0f}",
        "diverged": f"{found.diverged:,}",
    }


def _tiles(training: Training) -> list[tuple[str, str]]:
    rate = training.steps / max(training.simulating + training.learning, 1e-9)
    return [
        (words.number(e.mean, e.standard_error), f"mean return, {name}") for name, e in evaluations(training).items()
    ] + [
        (figures.plain(float(training.steps)), "environment steps"),
        (f"{rate:,.0f}", "steps a second"),
        (figures.duration(training.seconds), "computing time"),
    ]


def _findings(training: Training) -> list[dict[str, str]]:
    """What the reader should know before relying on the policy."""
    found = []
    nominal, target = training.nominal, training.target
    if nominal is not None and target is not None:
        error = np.hypot(nominal.standard_error, target.standard_error)
        lost = nominal.mean - target.mean
        if lost > 3 * error and lost > 0.1 * abs(nominal.mean):
            text = (
                f"The target's return is {words.number(lost, float(error))} below the nominal model's. A distribution "
                "that was fitted to a log of the target, or a wider one, may close the gap."
            )
            found.append({"level": "attention", "title": "The policy loses in the target", "text": text})
    if training.diverged:
        text = (
            f"{training.diverged:,} simulations diverged, and ended their episodes. Where that is frequent, "
            "bounds or a distribution reach values that the model cannot be simulated with."
        )
        found.append({"level": "note", "title": "Diverged simulations", "text": text})
    if training.repaired or training.skipped:
        text = (
            f"{training.repaired:,} steps with a number that was not finite were kept from the losses, and "
            f"{training.skipped:,} updates were left out."
        )
        found.append({"level": "attention", "title": "Numbers that are not finite", "text": text})
    return found


def _parameters(distribution: Mapping[str, Any]) -> list[dict[str, str]]:
    """The table of the distribution that was trained on."""
    rows = []
    for name, entry in distribution.get("parameters", {}).items():
        numbers = {k: float(v) for k, v in entry.items() if isinstance(v, int | float)}
        shown = {k: figures.plain(v) for k, v in numbers.items() if k in ("value", "mean", "std", "low", "high")}
        rows.append({"name": name, "unit": str(entry.get("unit") or "–"), **shown})
    return rows


def _facts(training: Training) -> list[tuple[str, str]]:
    total = max(training.simulating + training.learning, 1e-9)
    return [
        ("Algorithm", training.algorithm.upper()),
        ("Stopped because", training.stop_reason),
        ("Environment steps", f"{training.steps:,} in {training.episodes:,} finished episodes"),
        ("Computing time", f"{training.seconds:,.1f} s"),
        ("of it simulating", f"{training.simulating:,.1f} s ({100 * training.simulating / total:.0f} %)"),
        ("of it learning", f"{training.learning:,.1f} s ({100 * training.learning / total:.0f} %)"),
        ("Seed", str(training.seed)),
        ("Diverged simulations", f"{training.diverged:,}"),
    ]
