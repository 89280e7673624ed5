"""What the cells of the Hopper study say together: tables, findings, figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.commands.folder import versions
from dropo_torch.report.recovery import write_recovery_study
from dropo_torch.studies.recovery import (
    Result,
    drawn_std,
    draws,
    farthest_off,
    largest_error,
    mean_error,
    methods_section,
    number,
    pick,
    recovery_rows,
    widest,
)
from dropo_torch.studies.study import Finding, Section, grouped
from dropo_torch.studies.sweep import elbow, likeliest

from .record import NOISE_VARIANCE
from .study_figures import draw_all, label

#: A standard deviation below this share of the search box has collapsed to a point; one above the other is wide.
COLLAPSED, WIDE = 1e-3, 1e-2
CASES = {"point": "noiseless", "noisy": "noisy", "unmodeled": "unmodeled torso", "distribution": "masses redrawn"}

TITLE = "The paper's simulated Hopper"
INTRODUCTION = (
    "Written by dropo reproduce hopper. The logs are recorded by this project, from slow random torques: "
    "compare with the paper in kind, not digit by digit."
)


def write_results(out: Path, results: Sequence[Result], plan: dict[str, Any]) -> list[str]:
    """Write ``study.json``, ``tables.md``, ``report.html`` and the figures; return the findings as sentences."""
    tables = {
        "table": table_rows(results, "table"),
        "recovery": table_rows(results, "recovery"),
        "sweep": sweep_rows(pick(results, "sweep")),
        "noise": sweep_rows(pick(results, "noise")),
        "size": size_rows(results),
        "cma": cma_rows(results),
    }
    return write_recovery_study(
        out, title=TITLE, lead=INTRODUCTION, plan=plan, findings=all_findings(results), tables=tables,
        sections=sections(tables), drawn=draw_all(results, tables), versions=versions(),
    )  # fmt: skip


def table_rows(results: Sequence[Result], block: str) -> list[dict[str, Any]]:
    """Return the rows of a block's table of methods."""
    return recovery_rows(pick(results, block), CASES, label)


def sweep_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return one row for each sweep over ε, with the one chosen and, where there is noise, its variance."""
    keys = ("variant", "noise", "ends_only", "noisy_starts")
    groups = grouped(results, lambda r: tuple(r["cell"][key] for key in keys))
    rows = []
    for (variant, noise, ends_only, noisy_starts), group in groups.items():
        ordered = sorted(group, key=lambda r: r["cell"]["epsilon"])
        epsilons = [r["cell"]["epsilon"] for r in ordered]
        errors = [r["fit"]["mse"] for r in ordered]
        if noisy_starts:
            chosen, reason = likeliest(epsilons, [r["robust_log_likelihood"] for r in ordered])
        else:
            chosen, reason = elbow(epsilons, errors)
        true = NOISE_VARIANCE if noise is None and variant == "noisy" else noise
        caused = None if true is None else float(ordered[0]["mse_at_truth"])
        rows.append(
            {
                "case": CASES[variant],
                "noise_variance": true,
                "noise_on": None if true is None else ("ends of transitions" if ends_only else "every measurement"),
                "stands_for": "every measurement" if noisy_starts else "the ends",
                "chosen": chosen,
                "ratio": None if true is None else chosen / true,
                "caused_variance": caused,
                "caused_ratio": None if caused is None else chosen / caused,
                "epsilons": epsilons,
                "mse": errors,
                "mean_std": [float(np.mean([p["std"] for p in r["fit"]["parameters"].values()])) for r in ordered],
                "reason": reason,
            }
        )
    return rows


def size_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return one row for each case, number of transitions and parameter, with the range of n bootstrap samples.

    Another sample is inside that range with probability (n − 1) / (n + 1), ``level``.
    """
    rows = []
    groups = grouped(pick(results, "size"), lambda r: (r["cell"]["variant"], r["cell"]["size"]))
    for (variant, size), group in groups.items():
        for parameter in group[0]["fit"]["parameters"]:
            truth = group[0]["truth"][parameter]
            row: dict[str, Any] = {
                "case": CASES[variant],
                "transitions": size,
                "parameter": parameter,
                "truth": truth["mean"],
                "true_std": truth["std"],
                "resamples": len(group),
                "level": (len(group) - 1) / (len(group) + 1),
            }
            means = [r["fit"]["parameters"][parameter]["mean"] for r in group]
            for key, values in (("mean", means), ("std", [drawn_std(r, parameter) for r in group])):
                row |= {key: float(np.median(values)), f"{key}_low": min(values), f"{key}_high": max(values)}
            rows.append(row)
    return rows


def cma_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return one row for each optimizer on the same short log."""
    return [
        {
            "optimizer": r["fit"]["optimizer"],
            "log_likelihood": r["fit"]["log_likelihood"],
            "largest_error_percent": 100 * largest_error(r),
            "simulated_per_logged": r["fit"]["simulated_transitions"] / r["transitions"],
            "seconds": r["wall_seconds"],
        }
        for r in pick(results, "cma")
    ]


def table_findings(results: Sequence[Result]) -> list[Finding]:
    """Return what the paper finds in its Table 1, and whether it holds here."""
    point = {m: pick(results, "table", variant="point", method=m) for m in ("dropo", "droid", "bayessim")}
    error = {m: 100 * max(map(largest_error, point[m])) for m in ("dropo", "droid")}
    droid = max(widest(r) for r in results if r["cell"]["method"] == "droid")
    unmodeled = pick(results, "table", variant="unmodeled", method="dropo")
    before, after = (float(np.mean([widest(r) for r in group])) for group in (point["dropo"], unmodeled))
    wide = min(widest(r) for r in results if r["cell"]["method"] == "bayessim")
    off = max(map(farthest_off, pick(results, "table", variant="unmodeled", method="bayessim")))
    return [
        Finding(
            "DROPO and DROID find the point dynamics",
            max(error.values()) < 2,
            f"largest error of a mean {error['dropo']:.2g} % and {error['droid']:.2g} %",
        ),
        Finding(
            "DROID's standard deviations collapse in every case",
            droid < COLLAPSED,
            f"widest standard deviation {100 * droid:.2g} % of the search box",
        ),
        Finding(
            "DROPO widens under the unmodeled torso",
            after > max(10 * before, COLLAPSED),
            f"widest standard deviation {100 * before:.2g} % of the search box without noise, {100 * after:.2g} % here",
        ),
        Finding(
            "BayesSim is wide in every case",
            wide > WIDE,
            f"its widest parameter's standard deviation is {100 * wide:.2g} % of the search box or more; "
            f"under the unmodeled torso means are up to {off:.2g} σ off",
        ),
    ]


def all_findings(results: Sequence[Result]) -> list[Finding]:
    """Return the paper's qualitative findings, and whether they hold here."""
    found = table_findings(results)
    ends, every = "ends of transitions", "every measurement"
    for ends_only, noisy_starts, key, of in (
        (True, False, "ratio", f"the noise variance, noise on {ends}"),
        (False, True, "ratio", f"the noise variance, noise on {every} and ε standing for every one"),
        (False, False, "ratio", f"the noise variance, noise on {every} and ε standing for the ends"),
        (False, False, "caused_ratio", f"the variance that noise on {every} causes in the {ends}"),
    ):
        swept = sweep_rows(pick(results, "noise", ends_only=ends_only, noisy_starts=noisy_starts))
        ratios = [row[key] for row in swept]
        found.append(
            Finding(
                f"the sweep picks ε within a factor 10 of {of}",
                all(0.099 <= ratio <= 10.1 for ratio in ratios),
                f"ε over variance: {', '.join(f'{ratio:.2g}' for ratio in ratios)}",
            )
        )
    return found


def sections(tables: dict[str, list[dict[str, Any]]]) -> list[Section]:
    """Return the tables as people read them."""
    sizes = [
        [r["case"], str(r["transitions"]), r["parameter"], number(r["truth"])]
        + [f"{number(r[k])} [{number(r[k + '_low'])}, {number(r[k + '_high'])}]" for k in ("mean", "std")]
        for r in tables["size"]
    ]
    level = min((r["level"] for r in tables["size"]), default=0.0)
    bootstrap = f"mean [{100 * level:.0f} % of bootstrap]"
    cma = [[v if isinstance(v, str) else number(v) for v in r.values()] for r in tables["cma"]]
    return [
        methods_section("Table 1: mean ± std of draws, averaged over seeds", tables["table"], draws),
        methods_section("Table 1: largest error of a mean, of all seeds (%)", tables["table"], mean_error),
        methods_section("Recovery of a distribution: mean ± std of draws", tables["recovery"], draws, "recovery.png"),
        methods_section("Recovery: largest error of a mean, of all seeds (%)", tables["recovery"], mean_error),
        _sweeps("Sweeps over ε", tables["sweep"], "sweep.png"),
        _sweeps("ε against the noise", tables["noise"], "noise.png"),
        Section(
            "Number of transitions",
            ["case", "transitions", "parameter", "truth", bootstrap, "std of draws"],
            sizes,
            "size.png",
        ),
        Section(
            "CMA-ES on a part",
            ["optimizer", "log-likelihood", "largest error (%)", "simulated per logged", "s"],
            cma,
        ),
    ]


def _sweeps(title: str, rows: Sequence[dict[str, Any]], figure: str) -> Section:
    head = ["case", "noise variance", "noise on", "ε stands for", "ε chosen", "ratio"]
    lines = [
        [r["case"], number(r["noise_variance"]), r["noise_on"] or "–", r["stands_for"], number(r["chosen"])]
        + [number(r[k]) for k in ("ratio", "caused_variance", "caused_ratio")]
        for r in rows
    ]
    return Section(title, [*head, "variance it causes in the ends", "ratio"], lines, figure)
