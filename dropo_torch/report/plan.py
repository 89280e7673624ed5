"""The page on a planned motion: what is commanded, how the robot is expected to move, and what that is to tell."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from dropo_torch.planning import Plan
from dropo_torch.report.figures import plan as figures
from dropo_torch.report.formatting import duration, percent, plain, score, short, whole
from dropo_torch.report.page import Frame, write_page

#: Panels of the state that are drawn at most.
PANELS = 36
#: What errors rest on, in words.
WORDS = {"log": "the log so far", "plan": "the motion alone", "both": "both together"}


def write_plan_report(path: str | Path, plan: Plan, *, video: str = "", **frame: Unpack[Frame]) -> None:
    """Write the page on a planned motion.

    Args:
        path: the HTML file; written whole or not at all.
        plan: what it shows.
        video: file beside the page with the motion expected; empty for none.
        frame: the page's title and versions.
    """
    ground, document = plan.ground, plan.document()
    errors = {kind: e for kind, e in plan.errors.items() if e is not None and (ground.has_log or kind != "both")}
    space, width = ground.problem.space, ground.width * np.where(ground.problem.space.is_log, ground.values[0], 1.0)
    shares = {kind: np.minimum(e / width, 1.0) for kind, e in errors.items()}
    known = "both" if ground.has_log else "plan"
    seconds, labels = ground.steps * ground.timestep, plan.columns[0]
    content: dict[str, Any] = {
        "lead": _lead(plan, shares),
        "tiles": [
            (duration(seconds), "of motion"),
            (whole(len(plan.actuators), "actuator"), f"commanded every {1000 * ground.timestep:.4g} ms"),
            (percent(float(np.median(shares[known]))), "of its bounds is the median standard error"),
            (f"{len(space) - len(plan.unidentified)} of {len(space)}", "parameters will be known"),
            (whole(len(ground.values), "model"), "that keep all limits"),
            (percent(_least_room(document)), "least margin of a limit"),
        ],
        "remarks": plan.remarks, "video": video,
        "bars": figures.error_bars(space.names, shares),
        "keys": [(WORDS[kind], figures.COLORS[kind]) for kind in errors],
        "kinds": [WORDS[kind] for kind in errors],
        "parameters": [_parameter(name, p, errors) for name, p in document["parameters"].items()],
        "commands": _commands(plan),
        "states": _states(plan),
        "start": [
            (name, short(value)) for name, value in zip(labels, ground.starts[0, : ground.model.nq], strict=False)
        ],
        "limits": [_limit(x) for x in document["limits"]],
        "noise": None if document["noise"] is None else [(k, short(v)) for k, v in document["noise"].items()],
        "noise_source": ground.noise_source,
        "facts": [
            ("Motions tried", f"{plan.found.evaluations:,}"),
            ("The search ended because", plan.found.why),
            ("Amplitude that other models leave", percent(plan.scale)),
            ("Seed", str(ground.config.seed)),
            ("Seconds", f"{plan.seconds:.1f}"),
        ],
    }  # fmt: skip
    write_page(path, "plan.html", content, {"title": "The motion to record next", **frame})


def _lead(plan: Plan, shares: dict[str, np.ndarray]) -> str:
    """What the motion gains, in a sentence."""
    seconds = plan.ground.steps * plan.ground.timestep
    if "log" not in shares:
        return f"Recorded for {duration(seconds)}, this motion tells the parameters as well as the bars show."
    gain = shares["log"] / shares["both"]
    most = int(np.argmax(gain))
    return (
        f"Recorded for {duration(seconds)} and added to the log, this motion makes standard errors "
        f"{short(float(np.median(gain)))} times smaller (median), that of {plan.ground.problem.space.names[most]} "
        f"{short(float(gain[most]))} times."
    )


def _least_room(document: dict[str, Any]) -> float:
    """The least margin of all limits, relative to the limit."""
    rooms = [
        x["margin"] / ((x["high"] - x["low"]) / 2) for x in document["limits"]
        if np.isfinite(x["margin"]) and np.isfinite(x["high"] - x["low"])
    ]  # fmt: skip
    return min(rooms, default=float("nan"))


def _parameter(name: str, p: dict[str, Any], kinds: Collection[str]) -> dict[str, Any]:
    errors = [
        {"error": score(e), "relative": "" if p["relative"][kind] is None else percent(p["relative"][kind])}
        for kind, e in p["standard_error"].items() if kind in kinds
    ]  # fmt: skip
    return {
        "name": name, "value": plain(p["value"]), "unit": p["unit"], "low": plain(p["low"]), "high": plain(p["high"]),
        "errors": errors,
    }  # fmt: skip


def _commands(plan: Plan) -> list[dict[str, Any]]:
    ends = {x.column: (x.low, x.high) for x in plan.ground.limits.limits if x.kind == "command"}
    return [
        {"name": name, "figure": figures.time_panel(plan.times[:-1], plan.commands[:, a], ends.get(a), name)}
        for a, name in enumerate(plan.actuators)
    ]


def _states(plan: Plan) -> list[dict[str, Any]]:
    """What moves, with limits, the driven joints first."""
    ends = {x.column: (x.low, x.high) for x in plan.ground.limits.limits if x.kind in ("position", "velocity")}
    labels, units = plan.columns
    moves = [c for c in range(len(labels)) if np.ptp(plan.states[:, c]) > 0]
    order = sorted(moves, key=lambda c: (c not in ends, c))[:PANELS]
    return [
        {
            "name": labels[c], "unit": units[c],
            "figure": figures.time_panel(plan.times, plan.states[:, c], ends.get(c), labels[c]),
        }
        for c in order
    ]  # fmt: skip


def _limit(x: dict[str, Any]) -> dict[str, str]:
    return {
        "kind": x["kind"], "name": x["name"], "unit": x["unit"], "source": x["source"],
        "allowed": f"{short(x['low'])} to {short(x['high'])}",
        "reached": f"{short(x['lowest'])} to {short(x['highest'])}",
        "margin": short(x["margin"]),
    }  # fmt: skip
