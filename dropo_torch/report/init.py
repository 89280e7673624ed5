"""The page on a proposed config: which column is what, how fast and noisy the log is, and what it can tell."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Unpack

import numpy as np

from dropo_torch.proposal import Proposal, Told
from dropo_torch.proposal.choice import TOLD
from dropo_torch.proposal.matches import Match
from dropo_torch.report.figures import init as figures
from dropo_torch.report.formatting import joined, plain, score
from dropo_torch.report.page import Frame, write_page

#: Rows of a column that are drawn, and columns at most.
DRAWN, PANELS = 600, 24
#: What a state means, in words.
STATES = {
    "chosen": "told apart from all others",
    "stands for": "told, but only together with what it is confused with",
    "confounded": "left out: the chosen ones make up for it",
    "unseen": "left out: it hardly moves anything in this log",
}


def write_init_report(path: str | Path, proposal: Proposal, *, seconds: float, **frame: Unpack[Frame]) -> None:
    """Write the page that explains a proposed config.

    Args:
        path: the HTML file; written whole or not at all.
        proposal: what it explains.
        seconds: what it took.
        frame: the page's title and versions.
    """
    choice = proposal.choice
    log = proposal.draft.logged.trajectories
    step = proposal.document["frame_skip"] * float(_model(proposal).opt.timestep)
    chosen, left = ([t for t in choice.told if t.is_in is wanted] for wanted in (True, False))
    tiles = [
        (f"{len(chosen)} of {len(choice.told)}", "physical candidates are fitted"),
        (f"{len(proposal.matching.matches)}", "columns are the model's"),
        (f"{1 / step:.4g} Hz", f"rows {step:.4g} s apart"),
        (f"{log.num_episodes}", "episodes" if log.num_episodes > 1 else "episode"),
        (f"{proposal.document['lag']}", f"rows a window, {proposal.windows:,} of them"),
        (f"{sum(f.sure for f in proposal.findings)}", "things that stop a fit"),
    ]
    content: dict[str, Any] = {
        "lead": f"Of {len(choice.told)} physical parameters, {choice.summary}.",
        "tiles": tiles,
        "columns": [_column(m) for m in proposal.matching.matches],
        "missing": [p.label for p in proposal.matching.missing],
        "unused": [c.entry for c in proposal.matching.unused],
        "notes": [proposal.rate, proposal.window, *proposal.draft.turned, *proposal.draft.notes],
        "found": proposal.findings,
        "noise": list(zip(proposal.labels, proposal.units, proposal.noise.tolist(), strict=True)),
        "panels": _panels(proposal, step),
        "chosen": [_parameter(t) for t in chosen],
        "left": [_parameter(t) for t in sorted(left, key=lambda t: t.state)],
        "groups": [_group(g) for g in choice.groups],
        "told": TOLD,
        "text": proposal.text,
        "facts": [
            ("Transitions", f"{len(log):,}"),
            ("Episodes", f"{log.num_episodes:,}"),
            ("Seconds", f"{seconds:.1f}"),
        ],
    }
    write_page(path, "init.html", content, {"title": "A config for this robot and log", **frame})


def _model(proposal: Proposal) -> Any:
    assert proposal.draft.logged.model is not None
    return proposal.draft.logged.model


def _column(match: Match) -> dict[str, Any]:
    return {
        "column": match.column.entry, "place": match.place.label, "unit": match.unit,
        "sureness": match.sureness, "why": match.why,
    }  # fmt: skip


def _parameter(told: Told) -> dict[str, Any]:
    c = told.candidate
    relative = c.nominal != 0 and c.kind != "center"
    low, high = c.spec["bounds"]
    return {
        "name": c.name, "where": _where(told), "own": plain(c.nominal), "unit": c.unit, "low": plain(low),
        "high": plain(high), "why": c.why, "state": STATES[told.state], "good": told.state == "chosen",
        "error": "not told" if told.error > c.size else f"{score(100 * told.percent)} %" if relative
        else f"{score(told.error)} {c.unit}".rstrip(),
        "share": min(1.0, told.error / c.size / (3 * TOLD)), "hot": told.error > 0.1 * c.size,
        "with_": [(name, plain(float(f"{weight:.2g}"))) for name, weight in told.with_],
    }  # fmt: skip


def _where(told: Told) -> str:
    spec = told.candidate.spec
    name = spec.get("name", "")
    component = f"[{spec['index']}]" if "index" in spec else ""
    return f"{spec['field']}{component} of {name if isinstance(name, str) else joined(name, 3)}"


def _group(group: Any) -> dict[str, Any]:
    directions = [
        (" ".join(f"{'+' if w > 0 else '−'} {abs(w):.2f} {name}" for name, w in weights).removeprefix("+ "), error)
        for weights, error in group.directions
    ]
    return {"names": group.names, "directions": [(words, f"{100 * error:.2g} %") for words, error in directions]}


def _panels(proposal: Proposal, step: float) -> list[dict[str, Any]]:
    """The beginnings of the columns, as the config reads them."""
    logged = proposal.draft.logged
    log, observation = logged.trajectories, logged.observation
    first = int(np.flatnonzero(log.terminals)[0]) + 1
    rows = slice(0, min(DRAWN, first))
    observed = observation.observed(log.observations[rows])
    time = step * np.arange(len(observed))
    place = {c: i for i, c in enumerate(observation.columns)}
    panels = []
    for i, label in enumerate(observation.labels[:PANELS]):
        derived = None
        if label.endswith(".velocity"):
            position = observation.labels.index(own) if (own := label.replace(".velocity", ".position")) in (
                observation.labels
            ) else None  # fmt: skip
            if position is not None and len(time) > 2:
                derived = np.gradient(observed[:, position], step)
        figure = figures.column_panel(time, observed[:, i], derived, label)
        panels.append({"name": label, "unit": observation.units[i], "figure": figure})
    names = [m.place.label for m in proposal.matching.of("command")]
    for j, name in enumerate(names[: max(0, PANELS - len(panels))]):
        figure = figures.column_panel(time, log.actions[rows][:, j], None, name)
        panels.append({"name": name, "unit": "command", "figure": figure})
    assert len(place) == len(observation.columns)
    return panels
