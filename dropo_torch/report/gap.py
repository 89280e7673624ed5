"""The page of a search for a gap: what the model lacks, how sure that is, and what to do about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Unpack

import numpy as np

from dropo_torch.effects import VOCABULARY
from dropo_torch.gap.result import Gap, Ranked, Residuals
from dropo_torch.report import gap_words as words
from dropo_torch.report.figures.drawing import BLUE, CLOUD, ORANGE
from dropo_torch.report.figures.gap import course_panel, force_frame, force_panel, score_panel
from dropo_torch.report.formatting import duration, nats, percent, whole
from dropo_torch.report.page import Frame, folder_of, write_page

#: Rounds of the search that the ranking shows, and candidates in each.
MAX_ROUNDS = 3
MAX_RANKED = 12
#: Places that are listed.
MAX_PLACES = 20
#: Pictures of missing forces.
MAX_RESIDUALS = 8
#: Bars of the ranking end at this share of the gap, at most.
LEAST_LEFT = 1e-4


def write_gap_report(
    path: str | Path, gap: Gap, *, model_note: str = "", has_config: bool = True, **frame: Unpack[Frame]
) -> None:
    """Write the report of a search for a gap as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        gap: the result.
        model_note: what was written besides, such as a model that has the effects; a sentence.
        has_config: whether a config with the effects stands beside the report.
        frame: title, config and versions: :class:`~dropo_torch.report.page.Frame`.
    """
    named = [e for e in gap.effects if words.is_named(e)]
    headline, items = words.answer(gap)
    content = {
        "title": "What the model lacks",
        "gap": gap,
        "words": words,
        "headline": headline,
        "items": items,
        "named": len(named),
        "known": len(VOCABULARY),
        "has_config": has_config,
        "tied": [e for e in named if e.indistinguishable_from],
        "model_note": model_note,
        "scores": _scores(gap, bool(named)),
        "where": gap.where[:MAX_PLACES],
        "more_places": len(gap.where) - MAX_PLACES,
        "residuals": [(r.title, _residual(r, bool(named))) for r in gap.residuals[:MAX_RESIDUALS]],
        "blue": BLUE,
        "orange": ORANGE,
        "cloud": CLOUD,
        "courses": [(c.label, course_panel(c, named=bool(named))) for c in gap.courses],
        "more_residuals": len(gap.residuals) - MAX_RESIDUALS,
        **_ranking(gap),
        "folder": folder_of(path),
        "facts": _facts(gap, bool(named)),
    }
    write_page(path, "gap.html", content, frame)


def _scores(gap: Gap, named: bool) -> list[tuple[str, str, Any]]:
    """Name, direction and figure of each score."""
    models = {"before" if named else "your model": gap.before} | ({"after": gap.after} if named else {})
    models["noise floor"] = gap.noise_floor
    unit = words.position_unit(gap)
    positions = {name: s.rollout_rmse for name, s in models.items()}
    steps = {name: float(np.sqrt(s.mse)) if s.mse >= 0 else float("nan") for name, s in models.items()}
    likelihoods = {name: s.log_likelihood for name, s in models.items()}
    label = f"RMS error of positions{f' ({unit})' if unit else ''}"
    return [
        (f"Open loop{words.span(gap)}", "less is better", score_panel(positions, label, log=True)),
        ("One step ahead", "less is better", score_panel(steps, "RMS error over all columns", log=True)),
        ("Log-likelihood", "more is better", score_panel(likelihoods, "nats", log=False)),
    ]


def _residual(residuals: Residuals, named: bool) -> list[tuple[str, str, Any]]:
    """Name, color and figure of one missing force, before and after, on the same axes."""
    of = (residuals.variable, residuals.before, residuals.after)
    variable, before, after = (np.asarray(v, dtype=float).ravel() for v in of)
    clouds = [("Before", ORANGE, before)]
    if named and len(after) == len(variable):
        clouds.append(("After, with the effects", BLUE, after))
    frame = force_frame(variable, *(force for *_, force in clouds))
    label = f"missing force{f' ({residuals.unit})' if residuals.unit else ''}"
    return [
        (name, color, force_panel(variable, force, frame, residuals.label, label, color))
        for name, color, force in clouds
    ]


def _ranking(gap: Gap) -> dict[str, Any]:
    """The first rounds of the search, each with its best candidates, and the scale of their bars."""
    named = {
        (kind, target)
        for e in gap.effects
        if words.is_named(e)
        for kind in (e.effect, e.variant)
        for target in (e.parameters if e.target == "*" else [e.target])
    }
    rounds: dict[int, list[Ranked]] = {}
    for ranked in sorted(gap.ranking, key=lambda r: (r.round, float(np.nan_to_num(r.left, nan=np.inf)))):
        rounds.setdefault(ranked.round, []).append(ranked)
    shown = list(rounds.values())[:MAX_ROUNDS]
    left = [r.left for candidates in shown for r in candidates if np.isfinite(r.left) and r.left > 0]
    decades = int(np.clip(np.ceil(-np.log10(min(left, default=0.1)) - 1e-9), 1, -np.log10(LEAST_LEFT)))
    return {
        "rounds": [
            (
                [(r, *_left(r.left, decades), (r.effect, r.target) in named) for r in candidates[:MAX_RANKED]],
                len(candidates) - MAX_RANKED,
            )
            for candidates in shown
        ],
        "more_rounds": len(rounds) - len(shown),
        "bar_end": percent(10.0**-decades),
        "decade": f"{100 / decades:.4g}",
    }


def _left(left: float, decades: int) -> tuple[float, str]:
    """How long the bar of a candidate is that left a share of the gap, as a share, and this in words."""
    if np.isnan(left):
        return 0.0, "not known"
    if left <= 0:
        return 1.0, "nothing"
    return -float(np.log10(min(left, 1.0))) / decades, percent(left) if left <= 1.0005 else "more than before"


def _facts(gap: Gap, named: bool) -> list[tuple[str, str]]:
    """How the result came about."""
    before, after, floor = (f"{nats(s.log_likelihood)} nats" for s in (gap.before, gap.after, gap.noise_floor))
    likelihood = f"{before} before, {after} after" if named else before
    return [
        ("Log-likelihood on held-out data", f"{likelihood}; noise floor {floor}"),
        ("Known effects", str(len(VOCABULARY))),
        ("Candidates in the ranking", f"{len(gap.ranking):,}"),
        ("Windows on which hypotheses were compared", whole(gap.window, "logged step") + " each"),
        ("Simulator", gap.backend),
        ("Simulated transitions", f"{gap.simulated_transitions:,}"),
        ("Computing time", duration(gap.seconds)),
        ("Seed", str(gap.seed)),
    ]
