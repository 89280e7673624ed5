"""Which motion would tell two effects apart that this log cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.effects.base import Placed
from dropo_torch.effects.twin import Windows
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.refit import Hypothesis

#: Windows of a motion that is tried.
WINDOWS = 16
#: Separation, in standard deviations of the noise, from which on a motion is worth recording.
WORTH = 5.0


def suggest(evidence: Evidence, first: Hypothesis, second: Hypothesis, one: Placed, other: Placed) -> str:
    """Return advice: of several motions the one that separates two hypotheses most, and by how many σ.

    The motions are those of the log with other commands; each is simulated under both hypotheses.
    """
    names = f"{_called(one)} from {_called(other)}"
    found = []
    for words, windows in _motions(evidence):
        here = evidence.on(windows)
        residuals, _ = here.residuals([first.variant, second.variant])
        if not np.isfinite(residuals).all():
            continue
        starts = here.linearise(first.variant)
        apart = here.project_slope(residuals[1] - residuals[0], starts)
        found.append((float(np.sqrt((apart**2).sum())), words))
    if not found:
        return f"No motion that was tried tells {names}."
    most, words = max(found)
    if most < WORTH:
        return (
            f"None of {len(found)} motions that were tried would tell {names} (at best {most:.1f} σ): "
            "on this robot they may be the same thing."
        )
    return f"To tell {names}, record {words}: over {WINDOWS} windows it would separate them by {most:.0f} σ."


def excite(silent: Sequence[tuple[str, str | None]]) -> str | None:
    """Return what a log would have to show so that candidates that it cannot judge can be judged."""
    if not silent:
        return None
    wanted: dict[str, list[str]] = {}
    for name, target in silent:
        motion = next((words for start, words in _MOTIONS if name.startswith(start)), "moves more")
        wanted.setdefault(motion, []).append(f"{name} of {target}" if target else name)
    parts = []
    for motion, names in wanted.items():
        more = " and others" if len(names) > 4 else ""
        parts.append(f"{motion} (for {', '.join(names[:4])}{more})")
    return "To judge what this log cannot, record a motion that " + "; ".join(parts) + "."


#: What a motion must do to show effects whose names start so.
_MOTIONS = (
    ("joint_limit", "reaches the stops"),
    ("joint", "moves these joints further, faster and to and fro"),
    ("armature", "accelerates these joints"),
    ("actuator_saturation", "asks for larger forces"),
    ("actuator", "commands these actuators more, and changes the commands faster"),
    ("sensor", "moves these columns further"),
    ("contact", "slides and presses on these geoms"),
    ("ground", "slides and presses on the ground"),
    ("fluid_drag", "moves these bodies fast"),
)


def _called(placed: Placed) -> str:
    return placed.effect.name + ("" if placed.target is None else f" of {placed.target}")


def _motions(evidence: Evidence) -> list[tuple[str, Windows]]:
    """Motions to try, in words, from the log's own."""
    windows = evidence.windows
    rows = np.unique(np.linspace(0, len(windows) - 1, WINDOWS).astype(int))
    base = windows.select(rows)
    commands = base.commands
    model = evidence.twin.setting.model
    limited = model.actuator_ctrllimited.astype(bool)[: commands.shape[2]] if model.nactuator == model.nu else None
    low, high = model.actuator_ctrlrange.T if limited is not None else (None, None)

    def clipped(signal: np.ndarray) -> np.ndarray:
        if limited is None:
            return signal
        return np.where(limited, np.clip(signal, low, high), signal)

    half = np.repeat(commands, 2, axis=1)[:, : commands.shape[1]]
    twice = np.concatenate([commands[:, ::2], commands[:, 1::2]], axis=1)
    found = [
        ("the same motion again", commands),
        ("the same motion with commands half as large", 0.5 * commands),
        ("the same motion with commands twice as large", clipped(2 * commands)),
        ("the same motion at half the speed", half),
        ("the same motion at twice the speed", twice),
        ("a motion without commands", np.zeros_like(commands)),
    ]
    return [(words, replace(base, commands=np.ascontiguousarray(signal))) for words, signal in found]
