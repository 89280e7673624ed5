"""The page of a fit: the verdict, the distribution, residuals, identifiability and convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from dropo_torch.baselines.mixture import Mixture
from dropo_torch.diagnostics import Diagnostics
from dropo_torch.distribution import Distribution, SearchBox, to_values
from dropo_torch.fit import Fit, HistoryEntry
from dropo_torch.parameters import ParameterSpace
from dropo_torch.report import words
from dropo_torch.report.figures import fit as figures
from dropo_torch.report.figures.drawing import BLUE, FAINT, PALETTE, Axis
from dropo_torch.report.formatting import duration, nats, number, plain, plural, rms
from dropo_torch.report.page import Frame, folder_of, write_page

#: What stands at the top of the page, by verdict.
TAGS = {"explained": "✓ Explained", "not_explained": "! Not fully explained", "hopeless": "✗ Hopeless"}
#: Columns with figures of their own; of more, the worst explained are shown.
MAX_COLUMNS = 24
#: Transitions in the traces of measured and simulated next states.
TRACE_LENGTH = 100
#: Pairs of inseparable parameters that are spelled out.
MAX_PAIRS = 10
#: Draws of a mixture in each pair's panel, and panels.
PAIR_DRAWS = 300
MAX_DRAWN_PAIRS = 15


def write_fit_report(
    path: str | Path,
    *,
    fit: Fit,
    diagnostics: Diagnostics,
    notes: Sequence[str] = (),
    space: ParameterSpace | None = None,
    **frame: Unpack[Frame],
) -> None:
    """Write the report of a fit.

    Args:
        path: the HTML file; written whole or not at all.
        fit: the result.
        diagnostics: what :func:`~dropo_torch.diagnostics.diagnose` says about it.
        notes: further sentences for the reader.
        space: the parameters, for their place in the model and the model's own values.
        frame: title, config and versions: :class:`~dropo_torch.report.page.Frame`; the
            config's ``parameters`` tell where they sit in the model.
    """
    judged = words.judgment(fit, diagnostics)
    nominal = np.full(len(fit.distribution), np.nan) if space is None else space.nominal
    content = {
        "title": "Fit",
        "fit": fit,
        "diagnostics": diagnostics,
        "words": words,
        "explained": judged.verdict == "explained",
        "tag": "Not judged" if fit.method == "udr" else TAGS[judged.verdict],
        "verdict": judged.reason[:1].upper() + judged.reason[1:],
        "findings": words.findings(fit, diagnostics),
        "notes": notes,
        "tiles": _tiles(fit, diagnostics),
        "parameters": _parameters(fit, diagnostics, frame.get("config") or {}, space, nominal),
        "has_nominal": bool(np.isfinite(nominal).any()),
        **_posterior(fit),
        **_columns(diagnostics),
        **_convergence(fit),
        **_identifiability(fit, diagnostics),
        "facts": _facts(fit, diagnostics),
        "folder": folder_of(path),
    }
    write_page(path, "fit.html", content, frame)


def shown_columns(diagnostics: Diagnostics, most: int = MAX_COLUMNS) -> list[int]:
    """Return the columns that get figures: all, or the worst explained, in the log's order."""
    standardized = np.nan_to_num(words.column_rms(diagnostics), nan=np.inf)
    return sorted(int(i) for i in np.argsort(-standardized, kind="stable")[:most])


def worst_stretch(standardized: np.ndarray, length: int = TRACE_LENGTH) -> slice:
    """Return the stretch ``length`` long over which standardized residuals ``(T, m)`` are largest."""
    count = len(standardized)
    if count <= length:
        return slice(0, count)
    size = np.nan_to_num(np.minimum(standardized**2, 1e6), nan=1e6).sum(1)  # a diverged entry counts, boundedly
    total = np.concatenate([[0.0], np.cumsum(size)])
    start = int(np.argmax(total[length:] - total[:-length]))
    return slice(start, start + length)


def _tiles(fit: Fit, diagnostics: Diagnostics) -> list[tuple[str, str]]:
    """Numbers for the top of the page, each with what it is."""
    parameters, columns = len(fit.distribution), len(diagnostics.labels)
    return [
        (str(parameters), plural("parameter", parameters)),
        (f"{len(diagnostics.rows):,}", "transitions judged"),
        (str(columns), plural("compared column", columns)),
        (rms(words.overall_rms(diagnostics)), "standardized residual, rms (1 is ideal)"),
        (plain(fit.simulated_transitions), "simulated transitions"),
        (duration(fit.seconds), "computing time"),
    ]


def _parameters(
    fit: Fit, diagnostics: Diagnostics, config: Mapping[str, Any], space: ParameterSpace | None, nominal: np.ndarray
) -> list[dict[str, Any]]:
    """Table and densities of the parameters, one dictionary each."""
    distribution = fit.distribution
    specs = config.get("parameters") or {}
    places = {} if space is None else {p.name: p.where for p in space.parameters if p.field or p.effect}
    error = diagnostics.standard_error * np.where(distribution.is_log, distribution.center, 1.0)
    curves = [words.density_curve(distribution, i) for i in range(len(distribution))]
    ends = np.array([v[[0, -1]] if len(v) else (np.nan, np.nan) for v, _ in curves])
    low, high, middle, own = (words.box_shares(distribution, v) for v in (*ends.T, distribution.center, nominal))
    return [
        {
            "name": name,
            "where": words.place(specs.get(name, {})) or places.get(name, ""),
            "mean": distribution.center[i],
            "std": distribution.spread[i],
            "error": error[i],
            "unit": distribution.units[i],
            "axis": axis,
            "nominal": nominal[i] if np.isfinite(nominal[i]) else None,
            "left": low[i],
            "width": high[i] - low[i],
            "middle": middle[i],
            "own": own[i] if np.isfinite(own[i]) else None,
            "figure": figures.distribution_row(axis, *curves[i], distribution.center[i], nominal[i]),
        }
        for i, (name, axis) in enumerate(zip(distribution.names, _axes(distribution), strict=True))
    ]


def _axes(distribution: Distribution) -> list[Axis]:
    ends = zip(distribution.low, distribution.high, distribution.is_log, strict=True)
    return [Axis(float(low), float(high), bool(log)) for low, high, log in ends]


def _posterior(fit: Fit) -> dict[str, Any]:
    """Panels of every parameter's own density and of pairs' draws, of a posterior that is more than a normal."""
    if "mixture" not in fit.extras:
        return {"marginals": [], "pairs_drawn": [], "pairs_omitted": 0}
    distribution, mixture = fit.distribution, Mixture.of(fit.extras["mixture"])
    names, axes = distribution.names, _axes(distribution)
    marginals = []
    for i, axis in enumerate(axes):
        points = np.linspace(mixture.low[i], mixture.high[i], 400)
        values, density = to_values(points, np.asarray(axis.is_log)), mixture.marginal_density(i, points)
        figure = figures.distribution_row(axis, values, density, distribution.center[i], np.nan)
        marginals.append({"name": names[i], "unit": distribution.units[i], "axis": axis, "figure": figure})
    draws = to_values(mixture.sample(PAIR_DRAWS, seed=0), distribution.is_log)
    pairs = [(i, j) for i in range(len(names)) for j in range(i)]
    drawn = [
        (f"{names[i]} over {names[j]}", figures.pair_panel(axes[j], axes[i], draws[:, j], draws[:, i]))
        for i, j in pairs[:MAX_DRAWN_PAIRS]
    ]
    return {"marginals": marginals, "pairs_drawn": drawn, "pairs_omitted": len(pairs) - len(drawn)}


def _columns(diagnostics: Diagnostics) -> dict[str, Any]:
    """Table, traces and residual panels of the compared columns."""
    z, size = words.standardized_residual(diagnostics), words.column_rms(diagnostics)
    limit = words.unexplained_above(diagnostics)
    both = (np.where(np.isfinite(z), v, np.nan) for v in (diagnostics.residual, diagnostics.expected))
    residual, expected = map(words.root_mean_square, both)
    stretch = worst_stretch(z)
    rows = diagnostics.rows[stretch]
    breaks = _breaks(diagnostics)[stretch]
    breaks[:1] = True
    finite = [v[np.isfinite(v)] for v in z.T]
    columns: list[dict[str, Any]] = [
        {
            "name": label,
            "unit": diagnostics.units[i],
            "residual": residual[i],
            "expected": expected[i],
            "rms": size[i],
            "bad": not size[i] <= limit,
            "bias": finite[i].mean() if len(finite[i]) else np.nan,
            "inside": np.mean(np.abs(finite[i]) <= 2) if len(finite[i]) else None,
        }
        for i, label in enumerate(diagnostics.labels)
    ]
    shown = shown_columns(diagnostics)
    for i in shown:
        of = (diagnostics.measured[stretch, i], diagnostics.mean[stretch, i], diagnostics.expected[stretch, i])
        columns[i]["trace"] = figures.trace_panel(rows, *of, breaks)
        columns[i]["figure"] = figures.residual_panel(diagnostics.rows, z[:, i])
    return {
        "columns": columns,
        "shown": [columns[i] for i in shown],
        "stretch": f"{rows[0]} to {rows[-1]}" if len(rows) else "",
        "rms_limit": limit,
    }


def _breaks(diagnostics: Diagnostics) -> np.ndarray:
    """Whether a window begins an episode or does not follow on the one before."""
    breaks = np.ones(len(diagnostics.rows), dtype=bool)
    if len(breaks) > 1:
        gaps = np.diff(diagnostics.rows)
        breaks[1:] = (gaps > 2 * np.median(gaps)) | (np.diff(diagnostics.episodes) != 0)
    return breaks


def _convergence(fit: Fit) -> dict[str, Any]:
    """Panels of likelihood, means and standard deviations over the history, the legend of stages and parameters."""
    history = fit.history
    if not history:
        return {"stages": [], "progress": [], "legend": [], "others": 0}
    begins = [i for i, entry in enumerate(history) if i == 0 or entry.stage != history[i - 1].stage]
    spans = list(zip(begins, [*begins[1:], len(history)], strict=True))
    box, names = SearchBox.of(fit.distribution), fit.distribution.names
    means = (np.array([entry.mean for entry in history]) - box.low) / box.width
    stds = np.array([entry.std for entry in history]) / box.width
    shortfall = _shortfall(history, spans)
    colors = _line_colors(means)
    cost = np.array([float(entry.simulated_transitions) for entry in history])
    seconds = np.array([entry.seconds for entry in history])
    changes = [0.0 if i == 0 else float(cost[i - 1]) for i in begins]
    panel = partial(figures.progress_panel, cost, seconds, changes)

    return {
        "stages": [(chr(ord("A") + n % 26), history[a].stage, b - a) for n, (a, b) in enumerate(spans)],
        "progress": {
            "Log-likelihood": panel(
                shortfall, [BLUE] * len(spans), label="nats below the best", log=True, upside_down=True
            ),
            "Means": panel(means, colors, label="0, 1: ends of search box", limits=(-0.04, 1.04), marks=(0, 1)),
            "Standard deviations": panel(
                stds, colors, label="share of search box", log=True, limits=(5e-6, 0.5), marks=(0.25,)
            ),
        },
        "legend": [(name, color) for name, color in zip(names, colors, strict=True) if color != FAINT],
        "others": colors.count(FAINT),
    }


def _shortfall(history: Sequence[HistoryEntry], spans: Sequence[tuple[int, int]]) -> np.ndarray:
    """Gap to the best log-likelihood, one column a stage, so that no line joins two stages."""
    values = np.array([entry.log_likelihood for entry in history])
    values[~np.isfinite(values)] = np.nan
    gap = np.maximum(np.fmax.reduce(values) - values, 0.1)
    stages = np.arange(len(spans))
    stage = np.repeat(stages, [b - a for a, b in spans])
    return np.where(stage[:, None] == stages, gap[:, None], np.nan)


def _line_colors(means: np.ndarray) -> list[str]:
    """Colors of the parameters whose means moved most; the others are faint."""
    moved = np.nan_to_num(np.ptp(means, axis=0))
    colors = [FAINT] * means.shape[1]
    for color, i in zip(PALETTE, sorted(np.argsort(-moved, kind="stable")[: len(PALETTE)]), strict=False):
        colors[i] = color
    return colors


def _identifiability(fit: Fit, diagnostics: Diagnostics) -> dict[str, Any]:
    """Heat maps and pairs of parameters that the log cannot tell apart."""
    names, pairs = fit.distribution.names, words.strongest(diagnostics)
    expected = words.root_mean_square(diagnostics.expected)
    relative = diagnostics.sensitivity / np.where(expected > 0, expected, np.nan)
    correlation = figures.heat_map(diagnostics.correlation, names, names, diverging=True, lower=True)
    return {
        "sensitivity": figures.heat_map(relative, names, diagnostics.labels),
        "sensitivity_ramp": figures.ramp(False),
        "sensitivity_top": figures.heat_top(relative),
        "correlation": correlation if len(names) > 1 else None,
        "correlation_ramp": figures.ramp(True),
        "pairs": pairs[:MAX_PAIRS],
        "more_pairs": max(len(pairs) - MAX_PAIRS, 0),
    }


def _facts(fit: Fit, diagnostics: Diagnostics) -> list[tuple[str, str]]:
    """How the result came about."""
    epsilon = fit.epsilon[:1] if len(set(fit.epsilon)) == 1 else fit.epsilon
    return [
        ("Log-likelihood", f"{nats(fit.log_likelihood)} nats, on samples that the optimizer has not used"),
        ("Mean squared difference", f"{number(fit.mse)}, between measured and mean simulated next states"),
        ("Simulator", fit.backend),
        ("Method", fit.method),
        ("Optimizer", fit.optimizer),
        ("Stop reason", fit.stop_reason or "not recorded"),
        ("Evaluations of the objective", f"{fit.evaluations:,}"),
        ("Simulated transitions", f"{fit.simulated_transitions:,}"),
        ("Computing time", f"{fit.seconds:,.1f} s" if np.isfinite(fit.seconds) else "n/a"),
        ("Parameter vectors per transition (K)", f"{fit.samples:,}"),
        ("ε, variance added to each column", ", ".join(map(plain, epsilon))),
        ("Seed", str(fit.seed)),
        ("Diverged simulations", f"{fit.diverged:,} in the final evaluation, {diagnostics.diverged:,} in diagnostics"),
    ]
