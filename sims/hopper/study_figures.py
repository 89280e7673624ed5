"""Figures of the Hopper study."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dropo_torch.report import figures
from dropo_torch.report.recovery import draw_recovery, panel
from dropo_torch.studies.recovery import Result, pick

from . import SIM

_COLORS = {"dropo": "#0072b2", "dropo (noise given)": "#56b4e9", "droid": "#d55e00", "bayessim (mdnn)": "#009e73",
            "bayessim (mdrff)": "#cc79a7"}  # fmt: skip
_LINES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31", "#7b8794", "#999933")


def label(result: Result) -> str:
    """Return the name of a result's method, with how it treats noise."""
    cell = result["cell"]
    notes = [cell["features"]] * bool(cell["features"]) + ["noise given"] * cell["knows_noise"]
    return str(cell["method"]) + "".join(f" ({note})" for note in notes)


def draw_all(results: Sequence[Result], tables: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return the study's figures by the names of their files."""
    return {
        "recovery.png": recovery(pick(results, "recovery", seed=0)),
        "sweep.png": sweeps(tables["sweep"]),
        "noise.png": against_noise(tables["noise"]),
        "size.png": sizes(tables["size"]),
    }


def recovery(chosen: Sequence[Result]) -> Any:
    """Draw the fitted normals of the redrawn masses over the realized ones, of one log."""
    return draw_recovery(chosen, label, _COLORS, {name: p["unit"] for name, p in SIM.parameters.items()})


def sweeps(rows: Sequence[dict[str, Any]]) -> Any:
    """Draw error and mean standard deviation against ε, a line a case, the ε chosen marked."""
    figure = figures.new_figure(920, 320)
    for i, (key, title) in enumerate((("mse", "mean squared error"), ("mean_std", "mean standard deviation (kg)"))):
        axes = panel(figure, i, 2)
        for color, row in zip(_LINES, rows, strict=False):
            noise = "" if row["noise_variance"] is None else f", ε of {row['stands_for']}"
            words = row["case"] + noise if i == 0 else None
            axes.loglog(row["epsilons"], row[key], color=color, marker=".", linewidth=1.2, label=words)
            at = row["epsilons"].index(row["chosen"])
            axes.plot(row["chosen"], row[key][at], marker="o", markersize=8, markerfacecolor="none", color=color)
        axes.set_xlabel("ε")
        axes.set_ylabel(title)
    figure.legend(loc="upper center", ncol=3, frameon=False, fontsize=7)
    return figure


def against_noise(rows: Sequence[dict[str, Any]]) -> Any:
    """Draw the ε that is chosen against the noise's variance, a line a kind of noise and of sweep."""
    figure = figures.new_figure(560, 340)
    axes = panel(figure, 0, 1)
    kinds = list(dict.fromkeys((r["noise_on"], r["stands_for"]) for r in rows))
    for number, (color, kind) in enumerate(zip(_LINES[:3], kinds, strict=False)):
        own = sorted((r["noise_variance"], r["chosen"]) for r in rows if (r["noise_on"], r["stands_for"]) == kind)
        x, y = np.array(own).T
        words = f"noise on {kind[0]}, ε of {kind[1]}"
        width, size = 4.8 - 1.8 * number, 11 - 3 * number  # lines that coincide show one another
        axes.loglog(x, y, color=color, marker="osD"[number], markersize=size, linewidth=width, label=words)
    ends = np.array([min(r["noise_variance"] for r in rows), max(r["noise_variance"] for r in rows)])
    axes.fill_between(ends, ends / 10, 10 * ends, color="#7b8794", alpha=0.15, linewidth=0, label="within a factor 10")
    axes.set_xlabel("variance of the noise")
    axes.set_ylabel("ε chosen")
    figure.legend(loc="upper center", ncol=2, frameon=False, fontsize=7)
    return figure


def sizes(rows: Sequence[dict[str, Any]]) -> Any:
    """Draw the error of the mean against the number of transitions, with bootstrap intervals."""
    cases = list(dict.fromkeys(r["case"] for r in rows))
    names = list(dict.fromkeys(r["parameter"] for r in rows))
    figure = figures.new_figure(460 * len(cases), 320)
    for i, case in enumerate(cases):
        axes = panel(figure, i, len(cases))
        for shift, (color, name) in enumerate(zip(_LINES, names, strict=False)):
            own = [r for r in rows if (r["case"], r["parameter"]) == (case, name)]
            x = np.array([r["transitions"] for r in own]) * 1.06**shift
            y, low, high = (
                100 * np.array([r[k] / r["truth"] - 1 for r in own]) for k in ("mean", "mean_low", "mean_high")
            )
            bars, words = np.maximum([y - low, high - y], 0), name if i == 0 else None
            axes.errorbar(x, y, bars, color=color, marker=".", linewidth=1.1, capsize=2, label=words)
        axes.set_xscale("log")
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_xlabel(f"transitions, {case}")
        axes.set_ylabel("error of the mean (%)")
    figure.legend(loc="upper center", ncol=4, frameon=False, fontsize=9)
    return figure
