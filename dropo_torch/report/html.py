"""Reports as one HTML file: no network, no scripts, good on a phone and on paper."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import yaml
from markupsafe import Markup

from dropo_torch.baselines.mixture import Mixture
from dropo_torch.diagnostics import Diagnostics
from dropo_torch.distribution import Distribution, to_values
from dropo_torch.fit import Fit, HistoryEntry
from dropo_torch.parameters import ParameterSpace
from dropo_torch.report import figures, words
from dropo_torch.studies.sweep import Sweep
from dropo_torch.support.files import write_atomically

#: Columns with figures of their own; of more, the worst explained are shown.
MAX_COLUMNS = 24
#: Transitions in the traces of measured and simulated next states.
TRACE_LENGTH = 100
#: Pairs of inseparable parameters that are spelt out.
MAX_PAIRS = 10
#: Draws of a mixture in each pair's panel, and panels.
PAIR_DRAWS = 300
MAX_DRAWN_PAIRS = 15


def write_fit_report(
    path: str | Path,
    *,
    fit: Fit,
    diagnostics: Diagnostics,
    config: Mapping[str, Any] | None,
    title: str,
    notes: Sequence[str] = (),
    versions: Mapping[str, str] | None = None,
    space: ParameterSpace | None = None,
) -> None:
    """Write the report of a fit.

    Args:
        path: the HTML file; written whole or not at all.
        fit: the result.
        diagnostics: what :func:`~dropo_torch.diagnostics.diagnose` says about it.
        config: the run's config, printed as YAML; its ``parameters`` tell where they sit in the model.
        title: of the page.
        notes: further sentences for the reader.
        versions: name → version of what the result depends on.
        space: the parameters, for their place in the model and the model's own values.
    """
    ok, verdict = words.verdict(fit, diagnostics)
    nominal = np.full(len(fit.distribution), np.nan) if space is None else space.nominal
    shown = shown_columns(diagnostics)
    content = {
        "title": title,
        "headline": words.headline(fit, diagnostics),
        "explained": ok,
        "tag": "Not judged" if fit.method == "udr" else "✓ Explained" if ok else "! Not fully explained",
        "has_errors": words.has_standard_errors(fit),
        "verdict": verdict,
        "findings": words.findings(fit, diagnostics),
        "notes": list(notes),
        "tiles": _tiles(fit, diagnostics),
        "parameters": _parameter_rows(fit, diagnostics, config, space, nominal),
        "densities": _densities(fit.distribution, nominal),
        "law": words.law(fit),
        **_posterior(fit),
        "has_nominal": bool(np.isfinite(nominal).any()),
        **_column_content(diagnostics, shown),
        **_convergence(fit),
        **_identifiability(fit, diagnostics),
        "facts": _facts(fit, diagnostics),
        "config": config_yaml(config),
        "versions": dict(versions or {}),
    }
    write_atomically(Path(path), render("fit.html", content))


def write_sweep_report(
    path: str | Path,
    sweep: Sweep,
    *,
    use: Mapping[str, Any],
    config: Mapping[str, Any] | None,
    versions: Mapping[str, str] | None = None,
    title: str = "Choice of ε",
) -> None:
    """Write the report of a sweep over ε.

    Args:
        path: the HTML file; written whole or not at all.
        sweep: the sweep.
        use: the config's keys that are recommended, name → value.
        config: the runs' config, printed as YAML.
        versions: name → version of what the result depends on.
        title: of the page.
    """
    points = sweep.points
    values = [p.robust_log_likelihood if sweep.noisy_starts else p.log_likelihood for p in points]
    x, y, ll = (np.array(v, dtype=float) for v in ([p.epsilon for p in points], [p.mse for p in points], values))
    rows = [
        {
            "epsilon": figures.plain(p.epsilon),
            "mse": words.number(p.mse),
            "log_likelihood": nats(value),
            "chosen": p.epsilon == sweep.chosen,
        }
        for p, value in zip(points, ll.tolist(), strict=True)
    ]
    chosen = sweep.chosen
    content = {
        "title": title,
        "use": yaml.safe_dump(dict(use), sort_keys=False, allow_unicode=True).strip(),
        "noisy_starts": sweep.noisy_starts,
        "reason": sweep.reason,
        "rows": rows,
        "mse_figure": Markup(figures.log_log(x, y, chosen=chosen, x_label="ε", y_label="mean squared difference")),
        "likelihood_figure": Markup(
            figures.log_log(x, ll, chosen=chosen, x_label="ε", y_label="log-likelihood (nats)", y_log=False)
        ),
        "config": config_yaml(config),
        "versions": dict(versions or {}),
    }
    write_atomically(Path(path), render("sweep.html", content))


def shown_columns(diagnostics: Diagnostics, most: int = MAX_COLUMNS) -> list[int]:
    """Return the columns that get figures: all, or the worst explained, in the log's order."""
    standardised = np.nan_to_num(words.column_rms(diagnostics), nan=np.inf)
    return sorted(int(i) for i in np.argsort(-standardised, kind="stable")[:most])


def worst_stretch(standardised: np.ndarray, length: int = TRACE_LENGTH) -> slice:
    """Return the stretch ``length`` long over which standardised residuals ``(T, m)`` are largest."""
    count = len(standardised)
    if count <= length:
        return slice(0, count)
    size = np.nan_to_num(np.minimum(standardised**2, 1e6), nan=1e6).sum(1)  # a diverged entry counts, boundedly
    total = np.concatenate([[0.0], np.cumsum(size)])
    start = int(np.argmax(total[length:] - total[:-length]))
    return slice(start, start + length)


def config_yaml(config: Mapping[str, Any] | None) -> str:
    """Return a config as YAML; empty for ``None``."""
    if config is None:
        return ""
    document = json.loads(json.dumps(dict(config), default=_plain_data))
    options: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "width": 100}
    return "".join(
        yaml.safe_dump({key: value}, default_flow_style=None if isinstance(value, (dict, list)) else False, **options)
        for key, value in document.items()
    )


def nats(value: float) -> str:
    """Return a log-likelihood for people."""
    if not np.isfinite(value):
        return words.number(value)
    return f"{value:,.1f}".replace("-", "−") if abs(value) < 1e9 else words.number(value)


def render(template: str, content: Mapping[str, Any]) -> bytes:
    """Return a page of a template, as it goes into the file."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(**content).encode()


def _tiles(fit: Fit, diagnostics: Diagnostics) -> list[tuple[str, str]]:
    """Numbers for the top of the page, each with what it is."""
    return [
        (str(len(fit.distribution)), "parameter" if len(fit.distribution) == 1 else "parameters"),
        (f"{len(diagnostics.rows):,}", "transitions judged"),
        (str(len(diagnostics.labels)), "compared column" + "s" * (len(diagnostics.labels) != 1)),
        (words.rms(words.overall_rms(diagnostics)), "standardised residual, rms (1 is ideal)"),
        (figures.plain(float(fit.simulated_transitions)), "simulated transitions"),
        (figures.duration(fit.seconds), "computing time"),
    ]


def _parameter_rows(
    fit: Fit,
    diagnostics: Diagnostics,
    config: Mapping[str, Any] | None,
    space: ParameterSpace | None,
    nominal: np.ndarray,
) -> list[dict[str, Any]]:
    """The table of parameters, one dictionary a row."""
    distribution, has_errors = fit.distribution, words.has_standard_errors(fit)
    specs = (config or {}).get("parameters")
    specs = specs if isinstance(specs, Mapping) else {}
    places = {} if space is None else {p.name: p.where for p in space.parameters if p.field or p.effect}
    scale = np.where(distribution.is_log, distribution.center, 1.0)
    shares = [words.box_shares(distribution, v) for v in (_reach(distribution, 0), _reach(distribution, 1))]
    middle, own = words.box_shares(distribution, distribution.center), words.box_shares(distribution, nominal)
    rows = []
    for i, name in enumerate(distribution.names):
        mean, std, error = (float(v[i]) for v in (distribution.center, distribution.spread, diagnostics.standard_error))
        rows.append(
            {
                "name": name,
                "where": words.place(specs.get(name)) or places.get(name, ""),
                "mean": words.number(mean, std),
                "std": words.number(std, std),
                "log": bool(distribution.is_log[i]),
                "error": words.number(error * float(scale[i]), error * float(scale[i])) if has_errors else "",
                "unit": distribution.units[i],
                "low": figures.plain(float(distribution.low[i])),
                "high": figures.plain(float(distribution.high[i])),
                "nominal": words.number(float(nominal[i])) if np.isfinite(nominal[i]) else "",
                "left": _percent(shares[0][i]),
                "width": _percent(shares[1][i] - shares[0][i]),
                "middle": _percent(middle[i]),
                "own": _percent(own[i]) if np.isfinite(own[i]) else "",
            }
        )
    return rows


def _reach(distribution: Distribution, end: int) -> np.ndarray:
    """Lower (0) or upper (1) end of every parameter's support, in units, ``(d,)``."""
    ends = []
    for i in range(len(distribution)):
        values, _ = words.density_curve(distribution, i, points=2)
        ends.append(values[-end] if len(values) else float("nan"))
    return np.array(ends)


def _percent(share: float) -> str:
    return f"{100 * share:.1f}" if np.isfinite(share) else "0"


def _densities(distribution: Distribution, nominal: np.ndarray) -> list[dict[str, Any]]:
    """One panel a parameter."""
    panels = []
    for i, name in enumerate(distribution.names):
        values, density = words.density_curve(distribution, i)
        axis = figures.Axis(float(distribution.low[i]), float(distribution.high[i]), bool(distribution.is_log[i]))
        svg = figures.distribution_row(axis, values, density, float(distribution.center[i]), float(nominal[i]))
        panels.append({"name": name, "unit": distribution.units[i], "log": axis.is_log, "svg": Markup(svg)})
    return panels


def _posterior(fit: Fit) -> dict[str, Any]:
    """Panels of every parameter's own density and of pairs' draws, of a posterior that is more than a normal."""
    if "mixture" not in fit.extras:
        return {"marginals": [], "pairs_drawn": [], "pairs_omitted": 0}
    distribution, mixture = fit.distribution, Mixture.of(fit.extras["mixture"])
    names, is_log = distribution.names, distribution.is_log
    axes = [
        figures.Axis(float(low), float(high), bool(log))
        for low, high, log in zip(distribution.low, distribution.high, is_log, strict=True)
    ]
    marginals = []
    for i, name in enumerate(names):
        points = np.linspace(mixture.low[i], mixture.high[i], 400)
        values, density = to_values(points, np.full(len(points), is_log[i])), mixture.marginal_density(i, points)
        svg = figures.distribution_row(axes[i], values, density, float(distribution.center[i]), float("nan"))
        marginals.append({"name": name, "unit": distribution.units[i], "log": axes[i].is_log, "svg": Markup(svg)})
    draws = to_values(mixture.sample(PAIR_DRAWS, seed=0), is_log)
    pairs = [(i, j) for i in range(len(names)) for j in range(i)]
    drawn = [
        {
            "name": f"{names[i]} over {names[j]}",
            "svg": Markup(figures.pair_panel(axes[j], axes[i], draws[:, j], draws[:, i])),
        }
        for i, j in pairs[:MAX_DRAWN_PAIRS]
    ]
    return {"marginals": marginals, "pairs_drawn": drawn, "pairs_omitted": len(pairs) - len(drawn)}


def _column_content(diagnostics: Diagnostics, shown: Sequence[int]) -> dict[str, Any]:
    """Traces, residual panels and the table of all columns."""
    z = words.standardised_residual(diagnostics)
    stretch = worst_stretch(z)
    rows = diagnostics.rows[stretch]
    breaks = _breaks(diagnostics)[stretch].copy()
    breaks[:1] = True
    standardised = words.column_rms(diagnostics)
    limit = words.unexplained_above(diagnostics)
    panels = []
    for i in shown:
        at = (stretch, i)
        trace = figures.trace_panel(
            rows, diagnostics.measured[at], diagnostics.mean[at], diagnostics.expected[at], breaks
        )
        panels.append(
            {
                "name": diagnostics.labels[i],
                "unit": diagnostics.units[i],
                "rms": words.rms(float(standardised[i])),
                "bad": not standardised[i] <= limit,
                "trace": Markup(trace),
                "residual": Markup(figures.residual_panel(diagnostics.rows, z[:, i])),
            }
        )
    return {
        "columns": panels,
        "omitted": len(diagnostics.labels) - len(shown),
        "stretch": f"{rows[0]} to {rows[-1]}" if len(rows) else "",
        "column_rows": _column_rows(diagnostics, z, standardised, limit),
        "rms_limit": words.rms(limit),
    }


def _breaks(diagnostics: Diagnostics) -> np.ndarray:
    """Whether a window begins an episode or does not follow on the one before."""
    count = len(diagnostics.rows)
    breaks = np.ones(count, dtype=bool)
    if count > 1:
        gaps = np.diff(diagnostics.rows)
        breaks[1:] = (gaps > 2 * np.median(gaps)) | (np.diff(diagnostics.episodes) != 0)
    return breaks


def _column_rows(
    diagnostics: Diagnostics, z: np.ndarray, standardised: np.ndarray, limit: float
) -> list[dict[str, Any]]:
    """The table of residuals, one dictionary a column of the log."""
    rows = []
    for i, label in enumerate(diagnostics.labels):
        finite = np.isfinite(z[:, i])
        residual, expected = diagnostics.residual[finite, i], diagnostics.expected[finite, i]
        size = words.rms(float(standardised[i]))
        rows.append(
            {
                "name": label,
                "unit": diagnostics.units[i],
                "residual": words.number(_root_mean_square(residual), _root_mean_square(residual)),
                "expected": words.number(_root_mean_square(expected), _root_mean_square(expected)),
                "rms": size,
                "bar": _percent(min(float(standardised[i]), 3.0) / 3),
                "bad": not standardised[i] <= limit,
                "bias": words.signed(float(z[finite, i].mean())) if finite.any() else "n/a",
                "inside": f"{100 * np.mean(np.abs(z[finite, i]) <= 2):.0f} %" if finite.any() else "n/a",
            }
        )
    return rows


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _convergence(fit: Fit) -> dict[str, Any]:
    """Panels of likelihood, means and deviations over the history, and the legend of stages and parameters."""
    history = fit.history
    if not history:
        return {"stages": [], "progress": [], "legend": [], "others": 0}
    begins = [i for i, entry in enumerate(history) if i == 0 or entry.stage != history[i - 1].stage]
    means = (np.array([entry.mean for entry in history]) - words.search_box(fit.distribution).low) / _width(fit)
    chosen, colours = _line_colours(means)
    ends = [*begins[1:], len(history)]
    return {
        "stages": [
            {"letter": chr(ord("A") + n % 26), "name": history[a].stage, "count": b - a}
            for n, (a, b) in enumerate(zip(begins, ends, strict=True))
        ],
        "progress": _progress(fit, begins, means, colours),
        "legend": [{"name": fit.distribution.names[i], "colour": colours[i]} for i in chosen],
        "others": len(fit.distribution) - len(chosen),
    }


def _progress(fit: Fit, begins: Sequence[int], means: np.ndarray, colours: list[str]) -> list[dict[str, Any]]:
    """The panels of the convergence section."""
    cost = np.array([float(entry.simulated_transitions) for entry in fit.history])
    seconds = np.array([entry.seconds for entry in fit.history])
    changes = [0.0 if i == 0 else float(cost[i - 1]) for i in begins]
    deviations = np.array([entry.std for entry in fit.history]) / _width(fit)
    gap, blue = _likelihood(fit.history, begins)

    def panel(name: str, lines: np.ndarray, palette: list[str], **options: Any) -> dict[str, Any]:
        return {
            "name": name,
            "svg": Markup(figures.progress_panel(cost, seconds, lines, palette, changes, **options)),
        }

    return [
        panel("Log-likelihood", gap, blue, label="nats below the best", log=True, upside_down=True),
        panel("Means", means, colours, label="0, 1: ends of search box", limits=(-0.04, 1.04), marks=(0, 1)),
        panel(
            "Standard deviations", deviations, colours,
            label="share of search box", log=True, limits=(5e-6, 0.5), marks=(0.25,),
        ),
    ]  # fmt: skip


def _width(fit: Fit) -> np.ndarray:
    return words.search_box(fit.distribution).width


def _likelihood(history: Sequence[HistoryEntry], begins: Sequence[int]) -> tuple[np.ndarray, list[str]]:
    """Gap to the best log-likelihood, one column a stage, so that no line joins two stages."""
    values = np.array([entry.log_likelihood for entry in history])
    best = np.max(values, initial=-np.inf, where=np.isfinite(values))
    finite = np.isfinite(values)
    gap = np.full(len(values), np.nan)
    gap[finite] = np.maximum(best - values[finite], 0.1)
    lines = np.full((len(history), len(begins)), np.nan)
    for column, (a, b) in enumerate(zip(begins, [*begins[1:], len(history)], strict=True)):
        lines[a:b, column] = gap[a:b]
    return lines, [figures.BLUE] * len(begins)


def _line_colours(means: np.ndarray) -> tuple[list[int], list[str]]:
    """Which parameters are told apart by colour (those whose means moved most), and all colours."""
    moved = np.nan_to_num(np.ptp(means, axis=0))
    chosen = sorted(int(i) for i in np.argsort(-moved, kind="stable")[: len(figures.PALETTE)])
    colours = [figures.FAINT] * means.shape[1]
    for colour, i in zip(figures.PALETTE, chosen, strict=False):
        colours[i] = colour
    return chosen, colours


def _identifiability(fit: Fit, diagnostics: Diagnostics) -> dict[str, Any]:
    """Heat maps and sentences on what the log tells about the parameters."""
    names = fit.distribution.names
    finite = np.isfinite(diagnostics.expected)
    squares = np.sum(np.where(finite, diagnostics.expected, 0.0) ** 2, axis=0) / np.maximum(finite.sum(0), 1)
    expected = np.sqrt(np.where(squares > 0, squares, np.nan))
    relative = diagnostics.sensitivity / expected
    top = figures.heat_top(relative)
    pairs = words.strongest(diagnostics)
    return {
        "sensitivity": Markup(figures.heat_map(relative, names, diagnostics.labels)),
        "sensitivity_ramp": figures.ramp(False),
        "sensitivity_low": figures.plain(top / 1e4),
        "sensitivity_top": figures.plain(top),
        "correlation": Markup(figures.heat_map(diagnostics.correlation, names, names, diverging=True, lower=True))
        if len(names) > 1
        else "",
        "correlation_ramp": figures.ramp(True),
        "pairs": [(a, b, words.signed(c, 3), c > 0) for a, b, c in pairs[:MAX_PAIRS]],
        "more_pairs": max(len(pairs) - MAX_PAIRS, 0),
    }


def _facts(fit: Fit, diagnostics: Diagnostics) -> list[tuple[str, str]]:
    """How the result came about."""
    same = len(set(fit.epsilon)) == 1
    epsilon = ", ".join(figures.plain(e) for e in (fit.epsilon[:1] if same else fit.epsilon))
    return [
        ("Log-likelihood", f"{nats(fit.log_likelihood)} nats, on samples that the optimizer has not seen"),
        ("Mean squared difference", f"{words.number(fit.mse)}, measured against mean simulated next state"),
        ("Simulator", fit.backend),
        ("Method", fit.method),
        ("Optimizer", fit.optimizer),
        ("Stopped because", fit.stop_reason or "not recorded"),
        ("Evaluations of the objective", f"{fit.evaluations:,}"),
        ("Simulated transitions", f"{fit.simulated_transitions:,}"),
        ("Computing time", f"{fit.seconds:,.1f} s" if np.isfinite(fit.seconds) else "n/a"),
        ("Parameter vectors per transition (K)", f"{fit.samples:,}"),
        ("ε, variance added to each column", epsilon),
        ("Seed", str(fit.seed)),
        ("Diverged simulations", f"{fit.diverged:,} in the final evaluation, {diagnostics.diverged:,} in the checks"),
    ]


def _plain_data(value: Any) -> Any:
    """JSON for what JSON does not know."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return list(value) if isinstance(value, (set, frozenset)) else str(value)
