"""What the fits with the paper's masses and boxes say, beside the paper's numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.commands.folder import versions
from dropo_torch.report.recovery import write_recovery_study
from dropo_torch.studies.recovery import (
    Result,
    Row,
    drawn_std,
    draws,
    mean_error,
    methods_section,
    number,
    pick,
    recovery_rows,
    spread,
    widest,
)
from dropo_torch.studies.study import Finding, Section, grouped

from .fits import UNMODELED
from .paper import GIVEN, MASSES
from .study_figures import label, recovery
from .study_tables import table_findings

CASES = {
    "point": "noiseless", "ends": "noise on the ends", "noisy": "noise on every measurement",
    "unmodeled": "unmodeled torso", "distribution": "masses redrawn",
}  # fmt: skip
#: A fit's means within this share of the truth are the paper's, under noise.
NEAR = 0.01
#: A standard deviation above this share of the search box says that masses cannot account for the log; its bound is a
#: quarter.
BLOWN = 0.1
TITLE = "The paper's simulated Hopper, with its masses and boxes"
INTRODUCTION = (
    "Written by dropo reproduce hopper: two trajectories of 500 transitions of 8 ms by a semi-converged policy. "
    "Standard deviations are those of draws; of the paper they are as it prints them."
)

_Numbers = tuple[tuple[float, float], ...]
#: From the paper: means and standard deviations of torso, thigh, leg and foot, or of the last three.
PUBLISHED: Mapping[str, Mapping[str, _Numbers]] = {
    "point": {
        "dropo": ((3.534, 1.0e-5), (3.927, 1.1e-5), (2.714, 1.1e-5), (5.089, 1.0e-5)),
        "droid": ((3.534, 1.2e-12), (3.927, 2.1e-12), (2.714, 2.0e-12), (5.089, 1.1e-12)),
        "bayessim": ((3.350, 0.697), (5.342, 0.707), (3.994, 0.686), (5.560, 0.541)),
    },
    "ends": {
        "dropo": ((3.531, 8.1e-3), (3.931, 1.3e-3), (2.717, 1.3e-3), (5.093, 2.4e-4)),
        "droid": ((3.534, 1.2e-12), (3.927, 2.4e-11), (2.714, 2.0e-12), (5.089, 1.2e-12)),
        "bayessim": ((6.295, 0.218), (4.002, 0.257), (3.486, 0.245), (3.771, 0.256)),
    },
    "unmodeled": {
        "dropo": ((4.707, 0.667), (3.181, 0.206), (4.385, 0.826)),
        "droid": ((4.021, 6.0e-6), (3.591, 1.7e-6), (4.845, 4.2e-6)),
        "bayessim": ((3.493, 1.576), (2.901, 1.471), (4.596, 1.537)),
    },
}


def write_results(out: Path, results: Sequence[Result], plan: dict[str, Any]) -> list[str]:
    """Write ``study.json``, ``tables.md``, ``report.html`` and the figure; return the findings as sentences."""
    tables = {
        "table": recovery_rows(pick(results, "table"), CASES, label),
        "paper": published_rows(),
        "why": why_rows(results),
        "noises": noise_rows(results),
    }
    figure = recovery(pick(results, "table", variant="distribution", seed=0))
    return write_recovery_study(
        out, title=TITLE, lead=INTRODUCTION, plan=plan, findings=all_findings(results), tables=tables,
        sections=sections(tables), drawn={"recovery.png": figure}, versions=versions(),
    )  # fmt: skip


def published_rows() -> list[Row]:
    """Return the paper's own numbers as rows of a table of methods."""
    rows = []
    for variant, methods in PUBLISHED.items():
        names = [name for name in MASSES if variant != "unmodeled" or name != UNMODELED]
        for method, values in methods.items():
            for name, (mean, std) in zip(names, values, strict=True):
                error = 100 * abs(mean / MASSES[name] - 1)
                rows.append({
                    "case": CASES[variant], "parameter": name, "method": f"{method}, paper", "truth": MASSES[name],
                    "true_std": 0.0, "mean": mean, "std": std, "largest_error_percent": error,
                })  # fmt: skip
    return rows


def why_rows(results: Sequence[Result]) -> list[Row]:
    """Return one row for each thing that was varied: means over seeds, the largest errors, the widest spread."""
    rows = []
    for words, group in grouped(pick(results, "why"), lambda r: r["cell"]["differs"]).items():
        means = np.array([[r["fit"]["parameters"][name]["mean"] for name in MASSES] for r in group])
        stds = np.array([[drawn_std(r, name) for name in MASSES] for r in group])
        errors = 100 * np.abs(means / np.array(list(MASSES.values())) - 1)
        rows.append({
            "differs": words,
            "means": means.mean(0).tolist(),
            "stds": stds.mean(0).tolist(),
            "largest_error_percent": float(errors.max()),
            "mse": float(np.mean([r["fit"]["mse"] for r in group])),
        })  # fmt: skip
    return rows


def noise_rows(results: Sequence[Result]) -> list[Row]:
    """Return, for each parameter, how estimates from one log spread with its noise, beside what is to be expected."""
    own = pick(results, "noises")
    rows = []
    for name in MASSES:
        means = np.array([r["fit"]["parameters"][name]["mean"] for r in own])
        stds = [drawn_std(r, name) for r in own]
        published = dict(zip(MASSES, PUBLISHED["ends"]["dropo"], strict=True))[name]
        rows.append({
            "parameter": name,
            "noises": len(own),
            "standard_error": float(np.mean([r["standard_error"][name] for r in own])),
            "spread": float(np.sqrt(np.mean((means - MASSES[name]) ** 2))),
            "published_error": published[0] - MASSES[name],
            "std_median": float(np.median(stds)),
            "std_largest": float(max(stds)),
            "published_std": published[1],
        })  # fmt: skip
    return rows


def all_findings(results: Sequence[Result]) -> list[Finding]:
    """Return what the paper finds, and whether it holds here."""
    ends, every = (pick(results, "table", variant=v, method="dropo") for v in ("ends", "noisy"))
    error = max(abs(r["fit"]["parameters"][n]["mean"] / MASSES[n] - 1) for r in ends for n in MASSES)
    narrow, wide = max(map(widest, ends)), min(map(widest, every))
    (given,) = (row["largest_error_percent"] for row in why_rows(results) if row["differs"] == GIVEN)
    return [
        *table_findings(results),
        Finding(
            "DROPO finds the masses under noise on the ends of transitions, ε its variance",
            error < NEAR,
            f"largest error of a mean {100 * error:.2g} %, widest standard deviation {100 * narrow:.2g} % of the box",
        ),
        Finding(
            "with ε alone, noise on initial states too leaves nothing of that",
            wide > BLOWN,
            f"widest standard deviation {100 * wide:.2g} % of the search box or more",
        ),
        Finding(
            "given as noise of every measurement, it costs little",
            given < 100 * NEAR,
            f"largest error of a mean {given:.2g} %",
        ),
    ]


def sections(tables: Mapping[str, Sequence[Row]]) -> list[Section]:
    """Return the tables as people read them."""
    both = in_order([*tables["table"], *tables["paper"]])
    why = [
        [r["differs"], *(spread(m, s) for m, s in zip(r["means"], r["stds"], strict=True))]
        + [f"{r['largest_error_percent']:.2g}", number(r["mse"])]
        for r in tables["why"]
    ]
    paper = [spread(*pair) for pair in PUBLISHED["ends"]["dropo"]]
    worst = max(r["largest_error_percent"] for r in tables["paper"] if (r["case"], r["method"]) == _NOISY)
    noises = [
        [r["parameter"], number(r["standard_error"]), number(r["spread"]), f"{r['published_error']:+.3f}"]
        + [number(r[key]) for key in ("std_median", "std_largest", "published_std")]
        for r in tables["noises"]
    ]
    count = max((r["noises"] for r in tables["noises"]), default=0)
    return [
        methods_section("Table 1: mean ± std, averaged over seeds", both, draws, "recovery.png"),
        methods_section("Table 1: largest error of a mean, of all seeds (%)", both, mean_error),
        Section(
            "What the noisy case hangs on: mean ± std of draws, averaged over seeds",
            ["what differs", *MASSES, "largest error (%)", "mean squared error"],
            [["the paper", *paper, f"{worst:.2g}", "–"], *why],
        ),
        Section(
            f"What noise on the ends lets one know of one log, over {count} noises, kg",
            ["parameter", "standard error", "root mean square error", "the paper's error", "median std of draws"]
            + ["largest", "the paper's"],
            noises,
        ),
    ]


#: The paper's noisy row.
_NOISY = (CASES["ends"], "dropo, paper")


def in_order(rows: Sequence[Row]) -> list[Row]:
    """Return rows with the paper's behind ours of the same method."""
    return sorted(rows, key=lambda row: _ORDER.index(row["method"].split(" ")[0].rstrip(",")))


_ORDER = ("dropo", "droid", "bayessim")
