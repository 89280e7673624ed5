"""A proposed config as commented YAML."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import yaml

from dropo_torch.proposal.choice import Told
from dropo_torch.proposal.matches import Match

if TYPE_CHECKING:
    from dropo_torch.proposal.propose import Proposal

#: Characters of a line.
WIDTH = 118


def config_text(proposal: Proposal) -> str:
    """Return the config with a comment on each choice."""
    document, choice = proposal.document, proposal.choice
    lines = [
        f"# Proposed by `dropo init` from {document['model']} and {_logs(document['data']['path'])}.",
        "# Paths are relative to this file. `dropo check`, `fit` and `gap` take it as it is.",
        "",
        _key("model", document["model"]),
        "",
        *(line for turned in proposal.draft.turned for line in _comment(turned)),
        *(f"# {line}" for line in _columns(proposal)),
        _key("data", document["data"]),
        "",
        *_comment(proposal.rate),
        _key("frame_skip", document["frame_skip"]),
        _key("observation", document["observation"]),
        *([_key("mask", document["mask"])] if "mask" in document else []),
        "",
        *_noise(document),
        "",
        *_comment(proposal.window),
        _key("lag", document["lag"]),
        *(_key(name, document[name]) for name in ("seed", "threads") if document.get(name)),
        "",
        "# `dropo gap` first looks for what the model lacks with these parameters as the model has them.",
        _key("as_given", document["as_given"]),
        *_comment(f"Of {len(choice.told)} physical candidates, {choice.summary}."),
        "# Errors are those to expect of a fit to this log, relative to the model's value.",
        "parameters:" if choice.chosen else "parameters: {}",
        *(line for t in choice.chosen for line in _parameter(t)),
    ]
    left = [t for t in choice.told if not t.is_in]
    if left:
        lines += ["", "# Left out; each fits in above if its cause is known better or a log shows more:"]
        lines += [f"#   {line}" for t in left for line in (_left(t),)]
    return "\n".join(lines) + "\n"


def _logs(path: str | list[str]) -> str:
    """The logs in words."""
    return path if isinstance(path, str) else f"{path[0]} and {len(path) - 1} more"


def _noise(document: dict[str, Any]) -> list[str]:
    """The noise, where a fit does not estimate it."""
    if "noise" not in document:
        return ["# A fit estimates the noise of every column, beside the states."]
    return [
        "# Standard deviation of the noise of each observed column, estimated from the log: what short stretches show",
        "# although forces are free." + (" ε, a variance, is small beside it." if "epsilon" in document else ""),
        *(_key(name, document[name]) for name in ("noise", "epsilon") if name in document),
    ]


def _key(name: str, value: Any) -> str:
    """One key of the config, in as few lines as it takes."""
    flow = None if isinstance(value, dict | list) else False
    return yaml.safe_dump(
        {name: value}, default_flow_style=flow, sort_keys=False, allow_unicode=True, width=WIDTH
    ).rstrip("\n")  # fmt: skip


def _comment(text: str) -> list[str]:
    """Text as lines of a comment."""
    lines, line = [], "#"
    for word in text.split():
        if len(line) + len(word) + 1 > WIDTH:
            lines.append(line)
            line = "#"
        line += f" {word}"
    return [*lines, line]


def _columns(proposal: Proposal) -> Sequence[str]:
    found = []
    for m in proposal.matching.matches:
        found.append(f"{m.column.entry} is {m.place.label} in {m.unit}: {m.sureness}, by {m.why}")
    width = max((line.index(":") for line in found), default=0)
    return [line.replace(":", ":" + " " * (min(width, 60) - min(line.index(":"), 60)), 1) for line in found]


def _parameter(told: Told) -> list[str]:
    note = f"expected error {error_text(told)}; {told.candidate.why}"
    if told.with_:
        note += f"; stands for {', '.join(name for name, _ in told.with_)} too"
    entry = yaml.safe_dump(
        told.candidate.spec, default_flow_style=True, sort_keys=False, allow_unicode=True, width=10**6
    ).strip()  # fmt: skip
    return [f"  {told.candidate.name}: {entry}  # {note}"]


def _left(told: Told) -> str:
    c = told.candidate
    if told.state == "unseen":
        return f"{c.name}: hardly moves anything in this log"
    if told.with_:
        verb = "makes" if len(told.with_) == 1 else "make"
        return f"{c.name}: {', '.join(name for name, _ in told.with_)} {verb} up for it"
    return f"{c.name}: not told apart from the others (expected error {error_text(told)})"


def error_text(told: Told) -> str:
    """Return the error to expect of a parameter: in percent of the model's value, or in its unit where that is 0."""
    if told.candidate.nominal and told.candidate.kind != "center":
        return f"{100 * told.percent:.2g} %"
    return f"{told.error:.2g} {told.candidate.unit}".rstrip()


def described(match: Match) -> tuple[str, ...]:
    """Return a match as a row of a table: column, place, unit, how sure, by what."""
    return match.column.entry, match.place.label, match.unit, match.sureness, match.why
