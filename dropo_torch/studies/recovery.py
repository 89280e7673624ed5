"""What studies say of fits whose truth is known: rows for each parameter and method, errors, tables to read.

A result is what a study's cell left: its ``cell``, the ``truth`` of each parameter as ``mean`` and ``std``, and the
``fit`` as its document.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from dropo_torch.distribution import DRAWN_STD
from dropo_torch.studies.study import Section, grouped

Result = dict[str, Any]
Row = dict[str, Any]


def pick(results: Iterable[Result], block: str, **wanted: Any) -> list[Result]:
    """Return the results of a block whose cells have the wanted entries."""
    return [r for r in results if r["cell"]["block"] == block and all(r["cell"][key] == v for key, v in wanted.items())]


def drawn_std(result: Result, parameter: str) -> float:
    """Return the standard deviation of a fit's draws: those of a normal end two σ from its mean."""
    found = result["fit"]["parameters"][parameter]
    return float(found["std"] * (DRAWN_STD if found.get("law", "normal") == "normal" else 1.0))


def recovery_rows(results: Iterable[Result], cases: Mapping[str, str], label: Callable[[Result], str]) -> list[Row]:
    """Return one row for each case, parameter and method: means over the seeds, and the largest errors.

    Args:
        results: of all of them.
        cases: what a cell's ``variant`` is called.
        label: what a result's method is called.
    """
    rows = []
    for variant, case in grouped(results, lambda r: r["cell"]["variant"]).items():
        for parameter in case[0]["fit"]["parameters"]:
            for method, own in grouped(case, label).items():
                means = np.array([r["fit"]["parameters"][parameter]["mean"] for r in own])
                stds = np.array([drawn_std(r, parameter) for r in own])
                truths, true_stds = np.array([[r["truth"][parameter][key] for key in ("mean", "std")] for r in own]).T
                row = {
                    "case": cases[variant],
                    "parameter": parameter,
                    "method": method,
                    "truth": float(truths.mean()),
                    "true_std": float(true_stds.mean()),
                    "mean": float(means.mean()),
                    "std": float(stds.mean()),
                    "largest_error_percent": float(100 * np.max(np.abs(means / truths - 1))),
                    "mse": float(np.mean([r["fit"]["mse"] for r in own])),
                    "seeds": len(own),
                }
                if true_stds.min() > STEADY:
                    row["largest_std_error_percent"] = float(100 * np.max(np.abs(stds / true_stds - 1)))
                rows.append(row)
    return rows


#: A standard deviation that is rounding.
STEADY = 1e-9


def largest_error(result: Result) -> float:
    """Return the largest relative error of a mean."""
    return max(abs(p["mean"] / result["truth"][n]["mean"] - 1) for n, p in result["fit"]["parameters"].items())


def farthest_off(result: Result) -> float:
    """Return the largest error of a mean in standard deviations of the draws."""
    parameters = result["fit"]["parameters"]
    return max(abs(p["mean"] - result["truth"][n]["mean"]) / drawn_std(result, n) for n, p in parameters.items())


def widest(result: Result) -> float:
    """Return the largest standard deviation as a share of its search box."""
    return max(p["std"] / (p["high"] - p["low"]) for p in result["fit"]["parameters"].values())


def methods_section(title: str, rows: Sequence[Row], entry: Callable[[Row], str], figure: str = "") -> Section:
    """Return a table with cases and parameters down and methods across."""
    methods = list(dict.fromkeys(r["method"] for r in rows))
    lines = []
    for (case, parameter), group in grouped(rows, lambda r: (r["case"], r["parameter"])).items():
        own = {r["method"]: entry(r) for r in group}
        truth = spread(group[0]["truth"], group[0]["true_std"])
        lines.append([case, parameter, truth, *(own.get(method, "–") for method in methods)])
    return Section(title, ["case", "parameter", "truth", *methods], lines, figure)


def draws(row: Row) -> str:
    """Return mean and standard deviation of a row's draws."""
    return f"{row['mean']:.3f} ± {row['std']:.2g}"


def mean_error(row: Row) -> str:
    """Return the largest error of a row's mean, in percent."""
    return f"{row['largest_error_percent']:.2g}"


def std_error(row: Row) -> str:
    """Return the largest error of a row's standard deviation, in percent; a dash where nothing varies."""
    return number(row.get("largest_std_error_percent"))


def spread(mean: float, std: float) -> str:
    """Return a mean, with its standard deviation unless that is rounding."""
    return f"{mean:.3f} ± {std:.2g}" if std > STEADY else f"{mean:.3f}"


def number(value: float | None) -> str:
    """Return a number in three digits, or a dash."""
    return "–" if value is None else f"{value:.3g}"
