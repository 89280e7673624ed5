"""What the cells of the study of pushes say together: tables, findings, a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dropo_torch.commands.folder import versions
from dropo_torch.report.recovery import draw_recovery, write_recovery_study
from dropo_torch.studies.recovery import (
    Result,
    Row,
    draws,
    largest_error,
    mean_error,
    methods_section,
    number,
    pick,
    recovery_rows,
    std_error,
    widest,
)
from dropo_torch.studies.study import Finding, Section

from . import SIM

TITLE = "The paper's pushed box, in simulation"
INTRODUCTION = (
    "Written by dropo reproduce push. Arm, controller, pushes and logs are this project's: compare with the paper in "
    "kind, not digit by digit."
)
CASES = {"point": "one box", "distribution": "box redrawn for every push"}
#: The paper's own table: mean and standard deviation of mass, friction along x and y, center of mass along x and y.
PAPER = {
    "truth": ((0.7, 0.3), (0.8, 0.2), (0.8, 0.2), (0.01, 0.001), (0.01, 0.001)),
    "DROPO": ((0.788, 0.108), (0.603, 0.033), (0.683, 0.18), (0.015, 0.001), (0.009, 0.003)),
    "DROID": ((0.774, 3.1e-11), (0.737, 1.3e-10), (0.716, 1.2e-11), (0.014, 7.6e-11), (0.011, 2.4e-11)),
    "BayesSim": ((0.703, 0.269), (0.894, 0.224), (0.840, 0.257), (-0.011, 0.309), (0.004, 0.234)),
}
#: A standard deviation below this share of the search box has collapsed to a point.
COLLAPSED = 1e-3
#: What identifies a distribution: its means within this share, its standard deviations within that.
MEANS, WIDTHS = 0.05, 0.25
_COLOURS = {
    "dropo (fisher)": "#0072b2", "dropo (adam)": "#56b4e9", "droid": "#d55e00", "bayessim (mdnn)": "#009e73",
    "bayessim (mdrff)": "#cc79a7", "simopt": "#e69f00", "udr": "#7b8794",
}  # fmt: skip


def label(result: Result) -> str:
    """Return the name of a result's method, with its optimizer or features."""
    cell = result["cell"]
    kind = cell["optimizer"] or cell["features"]
    return f"{cell['method']} ({kind})" if kind else str(cell["method"])


def write_results(out: Path, results: Sequence[Result], plan: dict[str, Any]) -> list[str]:
    """Write ``study.json``, ``tables.md``, ``report.html`` and the figure; return the findings as sentences."""
    tables = {
        "table": recovery_rows(pick(results, "table"), CASES, label),
        "paper": [{"source": name, "values": values} for name, values in PAPER.items()],
        "optimizers": optimizer_rows(results),
        "identify": pick(results, "identify")[0]["identifiability"],
    }
    units = {name: str(p.get("unit", "")) for name, p in SIM.parameters.items()}
    chosen = [r for r in pick(results, "table", variant="distribution", seed=0) if label(r) in _COLOURS]
    return write_recovery_study(
        out, title=TITLE, lead=INTRODUCTION, plan=plan, findings=all_findings(results), tables=tables,
        sections=sections(tables), drawn={"recovery.png": draw_recovery(chosen, label, _COLOURS, units)},
        versions=versions(),
    )  # fmt: skip


def optimizer_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return one row for each optimizer on the same small log."""
    return [
        {
            "optimizer": r["fit"]["optimizer"],
            "log_likelihood": r["fit"]["log_likelihood"],
            "simulated_per_logged": r["fit"]["simulated_transitions"] / r["transitions"],
            "seconds": r["wall_seconds"],
        }
        for r in pick(results, "optimizers")
    ]


def all_findings(results: Sequence[Result]) -> list[Finding]:
    """Return the paper's findings, and whether they hold here."""

    def of(method: str, variant: str = "distribution", **wanted: Any) -> list[Result]:
        return pick(results, "table", method=method, variant=variant, **wanted)

    point = {m: 100 * max(map(largest_error, of(m, "point"))) for m in ("dropo", "droid")}
    means, widths = (errors(of("dropo", optimizer="fisher"), key) for key in ("mean", "std"))
    droid = max(map(widest, of("droid")))
    outside = [offset for r in of("bayessim") for offset in beyond_box(r)]
    return [
        Finding(
            "DROPO and DROID find one box",
            max(point.values()) < 2,
            f"largest error of a mean {point['dropo']:.2g} % and {point['droid']:.2g} %",
        ),
        Finding(
            "DROPO recovers the means of a box that is redrawn",
            max(means.values()) < MEANS,
            "; ".join(f"{name} {100 * error:.2g} % off" for name, error in means.items()),
        ),
        Finding(
            "DROPO recovers its standard deviations",
            max(widths.values()) < WIDTHS,
            "; ".join(f"{name} {100 * error:.2g} % off" for name, error in widths.items()),
        ),
        Finding(
            "DROID's standard deviations collapse",
            droid < COLLAPSED,
            f"widest standard deviation {100 * droid:.2g} % of the search box",
        ),
        Finding(
            "BayesSim's means stay in the search box, on data like its simulations",
            not outside,
            "; ".join(outside) or "all do",
        ),
    ]


def errors(results: Sequence[Result], key: str) -> dict[str, float]:
    """Return the largest relative error of each parameter's drawn mean or standard deviation, of all seeds."""
    rows = recovery_rows(results, CASES, label)
    name = {"mean": "largest_error_percent", "std": "largest_std_error_percent"}[key]
    return {row["parameter"]: row[name] / 100 for row in rows}


def beyond_box(result: Result) -> list[str]:
    """Return which means of a fit lie outside of the search box, in words."""
    return [
        f"{name} {p['mean']:.3g} with seed {result['cell']['seed']}"
        for name, p in result["fit"]["parameters"].items()
        if not p["low"] <= p["mean"] <= p["high"]
    ]


def sections(tables: dict[str, Any]) -> list[Section]:
    """Return the tables as people read them."""
    table: list[Row] = tables["table"]
    varied = [row for row in table if "largest_std_error_percent" in row]
    paper = {row["source"]: row["values"] for row in tables["paper"]}
    lines = [
        [name, *(f"{mean:.3g} ± {std:.2g}" for mean, std in (values[i] for values in paper.values()))]
        for i, name in enumerate(SIM.parameters)
    ]
    identified = [
        [r["parameter"], number(r["standard_error"]), f"{r['share_of_box_percent']:.2g}", r["correlated_with"]]
        + [f"{r['correlation']:.2f}"]
        for r in tables["identify"]
    ]
    optimizers = [
        [r["optimizer"], f"{r['log_likelihood']:.1f}", number(r["simulated_per_logged"]), number(r["seconds"])]
        for r in tables["optimizers"]
    ]
    return [
        methods_section("Mean ± std of draws, averaged over seeds", table, draws, "recovery.png"),
        Section("The same in the paper, with its arm and pushes", ["parameter", *paper], lines),
        methods_section("Largest error of a mean, of all seeds (%)", table, mean_error),
        methods_section("Largest error of a standard deviation, of all seeds (%)", varied, std_error),
        Section(
            "Optimizers on a small log",
            ["optimizer", "log-likelihood", "simulated per logged", "s"],
            optimizers,
        ),
        Section(
            "What the log tells, with a standard deviation of 1 mm, mm/s, mrad and mrad/s",
            ["parameter", "standard error", "% of the search box", "most confounded with", "correlation"],
            identified,
        ),
    ]  # fmt: skip
