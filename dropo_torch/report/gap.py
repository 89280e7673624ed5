"""The page of a search for a gap: what the model lacks, how sure that is, and what to do about it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from dropo_torch.effects import VOCABULARY
from dropo_torch.gap.result import Gap, NamedEffect, Ranked, Residuals
from dropo_torch.report import figures, gap_figures, gap_words, words
from dropo_torch.report.html import config_yaml, nats, render
from dropo_torch.support.files import write_atomically

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
    path: str | Path,
    gap: Gap,
    *,
    config: Mapping[str, Any] | None,
    versions: Mapping[str, str] | None,
    title: str,
    model_note: str = "",
    has_config: bool = True,
) -> None:
    """Write the report of a search for a gap as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        gap: the result.
        config: the run's config, printed as YAML.
        versions: name → version of what the result depends on.
        title: of the page.
        model_note: what was written besides, such as a model that has the effects; a sentence.
        has_config: whether a config with the effects stands beside the report.
    """
    named = [e for e in gap.effects if gap_words.is_named(e)]
    headline, items = gap_words.answer(gap)
    content = {
        "title": title,
        "headline": headline,
        "items": items,
        "change": gap_words.change(gap),
        "found": gap.found,
        "named": len(named),
        "partly": bool(named) and len(named) < len(gap.effects),
        "known": len(VOCABULARY),
        "has_config": has_config,
        "tied": _tied(named),
        "model_note": model_note,
        "next_experiment": gap.next_experiment or "",
        "scores": _scores(gap, bool(named)),
        "effects": [row for effect in gap.effects for row in _effect_rows(effect)],
        "where": _where_rows(gap),
        "more_places": max(len(gap.where) - MAX_PLACES, 0),
        "residuals": [_residual(r, bool(named)) for r in gap.residuals[:MAX_RESIDUALS]],
        "more_residuals": max(len(gap.residuals) - MAX_RESIDUALS, 0),
        **_ranking(gap),
        "declared": _declared_rows(gap),
        "columns": _column_rows(gap),
        "seconds": figures.plain(gap.rollout_seconds) if gap.rollout_seconds > 0 else "",
        "chi": gap_words.chi(gap),
        "cannot_judge": gap_words.places(gap.cannot_judge),
        "symbolic": gap.symbolic,
        "notes": list(gap.notes),
        "folder": _folder(Path(path)),
        "facts": _facts(gap),
        "config": config_yaml(config),
        "versions": dict(versions or {}),
    }
    write_atomically(Path(path), render("gap.html", content))


def _tied(named: list[NamedEffect]) -> list[tuple[str, str]]:
    """Effects that have rivals, each with these in words."""
    return [
        (gap_words.noun(e.effect, e.target), gap_words.either([gap_words.noun(*t) for t in e.indistinguishable_from]))
        for e in named
        if e.indistinguishable_from
    ]


def _scores(gap: Gap, named: bool) -> list[dict[str, Any]]:
    """One panel a score."""
    pairs = [("before" if named else "your model", gap.before), ("noise floor", gap.noise_floor)]
    if named:
        pairs.insert(1, ("after", gap.after))
    names = [name for name, _ in pairs]
    unit = gap_words.position_unit(gap)
    span = f" over {figures.plain(gap.rollout_seconds)} s" if gap.rollout_seconds > 0 else ""

    def panel(name: str, which: str, label: str, values: list[float], log: bool) -> dict[str, Any]:
        return {"name": name, "which": which, "svg": Markup(gap_figures.score_panel(names, values, label, log=log))}

    positions = f"RMS error of positions{f' ({unit})' if unit else ''}"
    return [
        panel(f"Open loop{span}", "less is better", positions, [s.rollout_rmse for _, s in pairs], True),
        panel(
            "One step ahead", "less is better", "RMS error over all columns",
            [float(np.sqrt(s.mse)) if s.mse >= 0 else float("nan") for _, s in pairs], True,
        ),
        panel("Log-likelihood", "more is better", "nats", [s.log_likelihood for _, s in pairs], False),
    ]  # fmt: skip


def _effect_rows(effect: NamedEffect) -> list[dict[str, Any]]:
    """The table of effects: one row a number, the first with what the effect is."""
    parameters = list(effect.parameters.items())
    unknown = "not known" if gap_words.is_named(effect) else "–"
    rows = []
    for i, (name, number) in enumerate(parameters or [("", None)]):
        value, interval, unit = gap_words.strength(number) if number is not None else (unknown, "", "")
        rows.append(
            {
                "first": i == 0,
                "span": max(len(parameters), 1),
                "effect": gap_words.title(effect.effect),
                "key": effect.effect,
                "target": gap_words.target_name(effect.effect, effect.target),
                "quantity": gap_words.quantity(name),
                "value": value,
                "interval": interval or unknown,
                "unit": unit,
                "degrees": gap_words.degrees(number) if number is not None else "",
                "share": gap_words.percent(effect.share_of_gap),
                "ties": [gap_words.noun(*t) for t in effect.indistinguishable_from],
                "sentence": effect.sentence,
            }
        )
    return rows


def _where_rows(gap: Gap) -> list[dict[str, str]]:
    return [
        {
            "name": gap_words.place_name(place),
            "share": gap_words.percent(place.share),
            "bar": f"{100 * float(np.clip(np.nan_to_num(place.share), 0, 1)):.1f}",
            "when": place.when or "not known",
        }
        for place in gap.where[:MAX_PLACES]
    ]


def _residual(residuals: Residuals, named: bool) -> dict[str, Any]:
    """The panels of one missing force, before and after, on the same axes."""
    variable, before, after = (
        np.asarray(v, dtype=float).ravel() for v in (residuals.variable, residuals.before, residuals.after)
    )
    clouds = [("Before", before, figures.ORANGE)]
    if named and len(after) == len(variable):
        clouds.append(("After, with the effects", after, figures.BLUE))
    frame = gap_figures.force_frame(variable, *(force for _, force, _ in clouds))
    unit = f" ({residuals.unit})" if residuals.unit else ""
    return {
        "title": residuals.title,
        "panels": [
            {
                "name": name,
                "colour": colour,
                "svg": Markup(
                    gap_figures.force_panel(variable, force, frame, residuals.label, f"missing force{unit}", colour)
                ),
            }
            for name, force, colour in clouds
        ],
    }


def _ranking(gap: Gap) -> dict[str, Any]:
    """The first rounds of the search, each with its best candidates."""
    named = {(e.effect, e.target) for e in gap.effects if gap_words.is_named(e)}
    rounds = sorted({r.round for r in gap.ranking})
    shown = [
        sorted((r for r in gap.ranking if r.round == n), key=lambda r: float(np.nan_to_num(r.left, nan=np.inf)))
        for n in rounds[:MAX_ROUNDS]
    ]
    left = [r.left for candidates in shown for r in candidates if np.isfinite(r.left) and r.left > 0]
    decades = int(np.clip(np.ceil(-np.log10(min(left, default=0.1)) - 1e-9), 1, -np.log10(LEAST_LEFT)))
    return {
        "rounds": [
            {
                "rows": [_ranked_row(r, named, decades) for r in candidates[:MAX_RANKED]],
                "more": max(len(candidates) - MAX_RANKED, 0),
            }
            for candidates in shown
        ],
        "more_rounds": len(rounds) - len(shown),
        "bar_end": gap_words.percent(10.0**-decades),
        "decade": f"{100 / decades:.4g}",
    }


def _ranked_row(ranked: Ranked, named: set[tuple[str, str | None]], decades: int) -> dict[str, Any]:
    if np.isnan(ranked.left):
        reach, left = 0.0, "not known"
    elif ranked.left <= 0:
        reach, left = 1.0, "nothing"
    else:
        reach = -float(np.log10(min(ranked.left, 1.0))) / decades
        left = gap_words.percent(ranked.left) if np.isfinite(ranked.left) else "more than before"
        left = "more than before" if ranked.left > 1.0005 else left
    return {
        "name": gap_words.title(ranked.effect),
        "target": gap_words.target_name(ranked.effect, ranked.target),
        "fitted": ", ".join(f"{gap_words.quantity(n)} {gap_figures.score(v)}" for n, v in ranked.values.items()),
        "left": left,
        "bar": f"{100 * min(reach, 1.0):.1f}",
        "named": (ranked.effect, ranked.target) in named,
    }


def _declared_rows(gap: Gap) -> list[dict[str, str]]:
    return [
        {"name": name, "given": words.number(given), "alone": words.number(alone), "both": words.number(both)}
        for name, (given, alone, both) in gap.declared.items()
    ]


def _column_rows(gap: Gap) -> list[dict[str, str]]:
    """Noise and open-loop errors, one dictionary a column of the log."""

    def of(rollout: tuple[float, ...], i: int) -> str:
        return gap_figures.score(rollout[i]) if i < len(rollout) else "–"

    return [
        {
            "name": label,
            "unit": gap.units[i] if i < len(gap.units) else "",
            "noise": gap_figures.score(gap.noise[i]) if i < len(gap.noise) else "–",
            "before": of(gap.before.rollout, i),
            "after": of(gap.after.rollout, i),
            "floor": of(gap.noise_floor.rollout, i),
        }
        for i, label in enumerate(gap.labels)
    ]


def _folder(path: Path) -> str:
    """The folder of the page as a command takes it; of one elsewhere on the machine, but its name."""
    folder = path.parent
    return folder.name if folder.is_absolute() else folder.as_posix()


def _facts(gap: Gap) -> list[tuple[str, str]]:
    """How the result came about."""
    named = any(gap_words.is_named(e) for e in gap.effects)
    likelihood = f"{nats(gap.before.log_likelihood)} nats" + (
        f" before, {nats(gap.after.log_likelihood)} nats after" if named else ""
    )
    return [
        ("Log-likelihood on held-out data", f"{likelihood}; noise floor {nats(gap.noise_floor.log_likelihood)} nats"),
        ("Known effects", f"{len(VOCABULARY)}"),
        ("Candidates in the ranking", f"{len(gap.ranking):,}"),
        ("Windows on which hypotheses were compared", words.whole(gap.window, "logged step") + " each"),
        ("Simulator", gap.backend),
        ("Simulated transitions", f"{gap.simulated_transitions:,}"),
        ("Computing time", figures.duration(gap.seconds)),
        ("Seed", str(gap.seed)),
    ]
