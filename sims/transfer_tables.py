"""What the cells of a study of transfer say together: distances in the target, what was missing, what was fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.stats

from dropo_torch.commands.folder import versions
from dropo_torch.report import figures
from dropo_torch.report.figures.drawing import BLUE, GRAY, INK, ORANGE, name_rows
from dropo_torch.report.recovery import write_recovery_study
from dropo_torch.studies.study import Finding, Section, grouped

if TYPE_CHECKING:
    from .transfer import Robot

Result = dict[str, Any]
LABELS = {
    "own": "the target's own",
    "dropo": "DROPO",
    "point": "its mean alone",
    "droid": "DROID",
    "bayessim": "BayesSim",
    "udr": "UDR",
    "plain": "DROPO without gap",
}
#: A policy after gap and fit is to come this near to the target's own, by the ratio of their distances.
NEAR = 1.5
CONFIDENCE = 0.9


def write_results(out: Path, robot: Robot, results: Sequence[Result], plan: Mapping[str, Any]) -> list[str]:
    """Write ``study.json``, ``tables.md``, ``report.html`` and the figures; return the findings as sentences."""
    stages = grouped(results, lambda r: r["cell"]["stage"])
    rows = distance_rows(stages["policy"])
    tables = {
        "distances": rows,
        "gap": stages["gap"],
        "fits": fit_rows(stages.get("fit", []), robot.make_target().truth),
    }
    pictures = {"transfer.png": [r for r in rows if r["method"] != "plain"]}
    both = [r for r in rows if r["method"] in ("own", "dropo", "plain")]
    if {"dropo", "plain"} <= {r["method"] for r in both}:
        pictures["gap.png"] = both
    return write_recovery_study(
        out, title=robot.title, lead=robot.lead, plan=plan, findings=all_findings(rows), tables=tables,
        sections=sections(tables, list(pictures)), drawn={n: draw_distances(r) for n, r in pictures.items()},
        versions=versions(),
    )  # fmt: skip


def distance_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return one row a method: final distances of all its rollouts, in cm, with mean and interval."""
    rows = []
    for method, own in grouped(results, lambda r: r["cell"]["method"]).items():
        policies = [[100 * d for d in r["distances"]] for r in own]
        means = [float(np.mean(p)) for p in policies]
        low, high = interval(means if len(means) > 2 else np.concatenate(policies).tolist())
        rows.append({
            "method": method, "policies": policies, "mean": float(np.mean(means)), "low": low, "high": high,
            "training_return": float(np.mean([r["training_return"] for r in own])),
            "minutes": float(np.mean([r["seconds"] for r in own])) / 60,
        })  # fmt: skip
    return sorted(rows, key=lambda row: list(LABELS).index(row["method"]))


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of a mean's interval by Student's t; NaN of one value. No distance is below 0."""
    if len(values) < 2:
        return float("nan"), float("nan")
    half = scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, len(values) - 1) * scipy.stats.sem(values)
    return max(0.0, float(np.mean(values) - half)), float(np.mean(values) + half)


def fit_rows(results: Sequence[Result], truth: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return one row for each parameter: its truth, where it has one, and mean and std by method, of the first seed."""
    first = {
        r["cell"]["method"] + str(r["cell"]["box"] or ""): r["fit"]["parameters"]
        for r in results
        if not r["cell"]["seed"]
    }
    names = dict.fromkeys(name for fit in first.values() for name in fit)
    return [
        {
            "parameter": name,
            "truth": truth.get(name),
            **{m: (fit[name]["mean"], fit[name]["std"]) for m, fit in first.items() if name in fit},
        }
        for name in names
    ]


def all_findings(rows: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Return what the study tests, as far as the methods are there."""
    means = {row["method"]: row["mean"] for row in rows}

    def tested(claim: str, first: str, second: str, most: float) -> list[Finding]:
        if first not in means or second not in means:
            return []
        told = f"{means[first]:.2f} cm and {means[second]:.2f} cm"
        return [Finding(claim, means[first] <= most * means[second], told)]

    return [
        *tested(f"After gap and fit, policies come within {NEAR:g} times the target's own", "dropo", "own", NEAR),
        *tested("Without gap, they do", "plain", "own", NEAR),
        *tested("With gap, they come nearer than without", "dropo", "plain", 1.0),
        *tested("DROPO's policies come nearer than DROID's", "dropo", "droid", 1.0),
        *tested("DROID's policies come nearer than those of uniform boxes", "droid", "udr", 1.0),
        *tested("DROPO's policies come nearer than those of uniform boxes", "dropo", "udr", 1.0),
    ]


def sections(tables: Mapping[str, Any], drawn: Sequence[str]) -> list[Section]:
    """Return the tables as people read them."""
    rows = [
        [
            LABELS[r["method"]], "; ".join(", ".join(f"{d:.1f}" for d in p) for p in r["policies"]),
            f"{r['mean']:.2f} [{r['low']:.2f}, {r['high']:.2f}]", f"{r['training_return']:.2f}", f"{r['minutes']:.1f}",
        ]
        for r in tables["distances"]
    ]  # fmt: skip
    head = [
        "trained over",
        "each rollout, cm",
        f"mean [{100 * CONFIDENCE:.0f} % interval], cm",
        "return in training",
        "min",
    ]
    found = [Section("Final distance in the target; policies are parted by semicolons", head, rows, drawn[0])]
    if len(drawn) > 1:
        both = [r for r, d in zip(rows, tables["distances"], strict=True) if d["method"] in ("own", "dropo", "plain")]
        found.append(Section("With and without gap before the fit", head[:3], [r[:3] for r in both], drawn[1]))
    said = [
        [str(r["cell"]["seed"]), log, r[log]["gap"]["verdict"], " ".join(r[log]["answer"])]
        + ["; ".join(r[log]["check"]) or "nothing is wrong"]
        for r in tables["gap"]
        for log in ("arm", "object")
    ]
    head = ["seed", "log", "verdict", "gap", "check"]
    found.append(Section("What dropo gap and dropo check say: of the arm alone, then with the object", head, said))
    methods = list(dict.fromkeys(key for row in tables["fits"] for key in row if key not in ("parameter", "truth")))
    lines = [
        [row["parameter"], "–" if row["truth"] is None else f"{row['truth']:.4g}"]
        + [f"{row[m][0]:.4g} ± {row[m][1]:.2g}" if m in row else "–" for m in methods]
        for row in tables["fits"]
    ]
    if lines:
        found.append(
            Section("Fits to the first log, mean ± standard deviation", ["parameter", "truth", *methods], lines)
        )
    return found


def draw_distances(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Draw a row a method: a dot each rollout, mean and interval."""
    figure = figures.new_figure(560, 60 + 34 * len(rows))
    axes = figures.new_axes(figure, (130, 44, 16, 12), grid="x")
    for y, row in enumerate(rows):
        color = {"own": INK, "dropo": ORANGE, "plain": BLUE}.get(row["method"], GRAY)
        values = np.concatenate(row["policies"])
        axes.plot([row["low"], row["high"]], [y, y], color=color, linewidth=4, alpha=0.35, solid_capstyle="butt")
        axes.plot(values, np.full(len(values), y), "o", color=color, markersize=4, alpha=0.8)
        axes.plot([row["mean"]] * 2, [y - 0.28, y + 0.28], color=color, linewidth=2)
    name_rows(axes, [LABELS[row["method"]] for row in rows])
    axes.set_xlim(left=0)
    axes.set_xlabel(f"final distance, cm (dots: rollouts; bars: mean and its {100 * CONFIDENCE:.0f} % interval)")
    return figure
