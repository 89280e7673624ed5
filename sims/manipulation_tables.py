"""What the cells of a study of an arm that manipulates say together: tables, findings, a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dropo_torch.commands.folder import versions
from dropo_torch.models.bundled import BundledSim
from dropo_torch.report.recovery import draw_recovery, write_recovery_study
from dropo_torch.studies.recovery import (
    STEADY,
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

#: Names of the columns of a study's table from the paper, mean and standard deviation of each parameter.
Published = Mapping[str, Sequence[tuple[float, float]]]


@dataclass(frozen=True)
class About:
    """What the pages of a study say.

    Attributes:
        sim: the simulation.
        title: of the page.
        lead: what the study is.
        cases: what the variants of its logs are called.
        published: the paper's own table, for the first parameters of the simulation.
    """

    sim: BundledSim
    title: str
    lead: str
    cases: Mapping[str, str]
    published: Published


#: A standard deviation below this share of the search box has collapsed to a point.
COLLAPSED = 1e-3
#: What identifies a distribution: its means within this share, its standard deviations within that.
MEANS, WIDTHS = 0.05, 0.25
_COLORS = {
    "dropo (fisher)": "#0072b2", "dropo (adam)": "#56b4e9", "droid": "#d55e00", "bayessim (mdnn)": "#009e73",
    "bayessim (mdrff)": "#cc79a7", "simopt": "#e69f00", "udr": "#7b8794",
}  # fmt: skip


def label(result: Result) -> str:
    """Return the name of a result's method, with its optimizer or features."""
    cell = result["cell"]
    kind = cell["optimizer"] or cell["features"]
    return f"{cell['method']} ({kind})" if kind else str(cell["method"])


def write_results(out: Path, about: About, results: Sequence[Result], plan: dict[str, Any]) -> list[str]:
    """Write ``study.json``, ``tables.md``, ``report.html`` and the figure; return the findings as sentences."""
    tables = {
        "table": recovery_rows(pick(results, "table"), about.cases, label),
        "paper": [{"source": name, "values": values} for name, values in about.published.items()],
        "optimizers": optimizer_rows(results),
        "identify": pick(results, "identify")[0]["identifiability"],
    }
    units = {name: str(p.get("unit", "")) for name, p in about.sim.parameters.items()}
    chosen = [varying(r) for r in pick(results, "table", variant="distribution", seed=0)]
    figure, page = draw_recovery(chosen, label, _COLORS, units), sections(tables, list(about.sim.parameters))
    return write_recovery_study(
        out, title=about.title, lead=about.lead, plan=plan, findings=all_findings(results), tables=tables,
        sections=page, drawn={"recovery.png": figure}, versions=versions(),
    )  # fmt: skip


def varying(result: Result) -> Result:
    """Return a result with the parameters that vary alone."""
    names = [name for name, true in result["truth"].items() if true["std"] > STEADY]
    found = result["fit"]["parameters"]
    return {**result, "fit": {**result["fit"], "parameters": {name: found[name] for name in names}}}


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
            "DROPO and DROID find one object",
            max(point.values()) < 2,
            f"largest error of a mean {point['dropo']:.2g} % and {point['droid']:.2g} %",
        ),
        Finding(
            "DROPO recovers the means of an object that is redrawn",
            max(means.values()) < MEANS,
            worst(means),
        ),
        Finding(
            "DROPO recovers its standard deviations",
            max(widths.values()) < WIDTHS,
            worst(widths),
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
    rows = recovery_rows(results, {"distribution": ""}, label)
    name = {"mean": "largest_error_percent", "std": "largest_std_error_percent"}[key]
    return {row["parameter"]: row[name] / 100 for row in rows if name in row}


def worst(found: Mapping[str, float], count: int = 5) -> str:
    """Return the largest errors in words."""
    largest = sorted(found.items(), key=lambda item: -item[1])[:count]
    return "; ".join(f"{name} {100 * error:.2g} % off" for name, error in largest)


def beyond_box(result: Result) -> list[str]:
    """Return which means of a fit lie outside of the search box, in words."""
    return [
        f"{name} {p['mean']:.3g} with seed {result['cell']['seed']}"
        for name, p in result["fit"]["parameters"].items()
        if not p["low"] <= p["mean"] <= p["high"]
    ]


def sections(tables: dict[str, Any], names: Sequence[str]) -> list[Section]:
    """Return the tables as people read them."""
    table: list[Row] = tables["table"]
    varied = [row for row in table if "largest_std_error_percent" in row]
    paper = {row["source"]: row["values"] for row in tables["paper"]}
    lines = [
        [name, *(f"{mean:.3g} ± {std:.2g}" for mean, std in (values[i] for values in paper.values()))]
        for i, name in enumerate(names[: min(map(len, paper.values()), default=0)])
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
        Section("The same in the paper, with its arm and its motions", ["parameter", *paper], lines),
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
