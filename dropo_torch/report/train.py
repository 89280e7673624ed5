"""The page of a training: the learning curve, how good the policy is, what it was trained on, an episode."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Unpack

import numpy as np

from dropo_torch.report.figures.train import episodes_panel, learning_curve
from dropo_torch.report.formatting import duration, number, plain, thousands, whole
from dropo_torch.report.page import Frame, write_page
from dropo_torch.report.words import Finding
from dropo_torch.rl.collect import Returns
from dropo_torch.rl.train import Training

WORLDS = {
    "distribution": "the distribution it was trained on",
    "nominal": "the nominal model",
    "target": "the target model",
}


def write_train_report(
    path: str | Path,
    training: Training,
    *,
    strip: bytes | None = None,
    notes: Sequence[str] = (),
    **frame: Unpack[Frame],
) -> None:
    """Write the report of a training as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        training: the result.
        strip: a PNG of an episode, or ``None``.
        notes: further sentences for the reader.
        frame: title, config and versions: :class:`~dropo_torch.report.page.Frame`.
    """
    found = evaluations(training)
    content = {
        "title": "Trained policy",
        "headline": headline(training),
        "tiles": _tiles(training),
        "findings": list(_findings(training)),
        "notes": list(notes),
        "curve": learning_curve(training),
        "evaluations": found,
        "worlds": WORLDS,
        "episodes": episodes_panel(found),
        "kind": training.policy.distribution.get("kind", ""),
        "parameters": training.policy.distribution.get("parameters", {}),
        "strip": "" if strip is None else base64.b64encode(strip).decode(),
        "facts": _facts(training),
    }
    write_page(path, "train.html", content, frame)


def evaluations(training: Training) -> dict[str, Returns]:
    """Return the evaluations that there are, by world."""
    given = {"distribution": training.training, "nominal": training.nominal, "target": training.target}
    return {name: e for name, e in given.items() if e is not None}


def headline(training: Training) -> str:
    """Return how good the policy is, in a sentence or two."""
    judged = evaluations(training).items()
    found = {name: f"{number(e.mean, e.standard_error)} ± {number(e.std, e.std)}" for name, e in judged}
    parts = [f"{text} in {WORLDS[name]}" for name, text in found.items() if name != "distribution"]
    returns = ", and ".join(parts) or f"{found['distribution']} under {WORLDS['distribution']}"
    episodes = whole(len(training.training.returns), "episode")
    return (
        f"Trained by {training.algorithm.upper()} in {plain(training.steps)} environment steps. Mean return: {returns} "
        f"({episodes} each, without exploration)."
    )


def _busy(training: Training) -> float:
    return max(training.simulating + training.learning, 1e-9)


def _tiles(training: Training) -> list[tuple[str, str]]:
    return [
        *((number(e.mean, e.standard_error), f"mean return, {name}") for name, e in evaluations(training).items()),
        (plain(training.steps), "environment steps"),
        (thousands(training.steps / _busy(training)), "steps a second"),
        (duration(training.seconds), "computing time"),
    ]


def _findings(training: Training) -> Iterator[Finding]:
    """What the reader should know before relying on the policy."""
    if (nominal := training.nominal) is not None and (target := training.target) is not None:
        error = float(np.hypot(nominal.standard_error, target.standard_error))
        lost = nominal.mean - target.mean
        if lost > 3 * error and lost > 0.1 * abs(nominal.mean):
            text = (
                f"The target's return is {number(lost, error)} below the nominal model's. A distribution "
                "fitted to a log of the target, or a wider one, may close the gap."
            )
            yield Finding("attention", "Lower return in the target", text)
    if training.diverged:
        text = (
            f"{training.diverged:,} simulations diverged, which ended their episodes. If this is frequent, the "
            "bounds or the distribution include values at which the model is unstable."
        )
        yield Finding("note", "Diverged simulations", text)
    if training.repaired or training.skipped:
        text = (
            f"{training.repaired:,} steps with non-finite numbers were excluded from the losses, and "
            f"{training.skipped:,} updates were skipped."
        )
        yield Finding("attention", "Non-finite numbers", text)


def _facts(training: Training) -> list[tuple[str, str]]:
    total = _busy(training)
    return [
        ("Algorithm", training.algorithm.upper()),
        ("Stop reason", training.stop_reason),
        ("Environment steps", f"{training.steps:,} in {training.episodes:,} finished episodes"),
        ("Computing time", f"{training.seconds:,.1f} s"),
        ("of which simulating", f"{training.simulating:,.1f} s ({100 * training.simulating / total:.0f} %)"),
        ("of which learning", f"{training.learning:,.1f} s ({100 * training.learning / total:.0f} %)"),
        ("Seed", str(training.seed)),
        ("Diverged simulations", f"{training.diverged:,}"),
    ]
