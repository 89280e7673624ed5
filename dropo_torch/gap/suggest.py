"""Which motion would tell two effects apart that this log cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dropo_torch.effects.base import Placed
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import spread
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.twin import Windows

#: Windows of a motion that is tried.
WINDOWS = 16
#: What a motion must do to show an effect, by its name or else by its kind; a body or the world just has to move more.
MOTIONS = {
    "joint_limit": "reaches the stops",
    "armature": "accelerates these joints",
    "joint": "moves these joints further, faster and to and fro",
    "actuator_saturation": "asks for larger forces",
    "actuator": "commands these actuators more, and changes the commands faster",
    "sensor": "moves these columns further",
    "geom": "slides and presses on these geoms",
    "ground_slope": "slides and presses on the ground",
    "fluid_drag": "moves these bodies fast",
}


def suggest(evidence: Evidence, first: Hypothesis, second: Hypothesis, one: Placed, other: Placed) -> str:
    """Return advice: of several motions the one that separates two hypotheses most, and by how many σ.

    The motions are those of the log with other commands; each is simulated under both hypotheses.
    """
    names = f"{_called(one)} from {_called(other)}"
    found = []
    for words, windows in _motions(evidence):
        here = evidence.on(windows)
        residuals, _ = here.residuals([first.variant, second.variant])
        if np.isfinite(residuals).all():
            apart = here.project_slope(residuals[1] - residuals[0], here.linearise(first.variant))
            found.append((float(np.sqrt((apart**2).sum())), words))
    if not found:
        return f"No motion that was tried tells {names}."
    most, words = max(found)
    if most < evidence.rules.shown.apart:
        return (
            f"None of {len(found)} motions that were tried would tell {names} (at best {most:.1f} σ): "
            "on this robot they may be the same thing."
        )
    return f"To tell {names}, record {words}: over {WINDOWS} windows it would separate them by {most:.0f} σ."


def excite(silent: Sequence[Placed]) -> str | None:
    """Return what a log would have to show so that candidates that it cannot judge can be judged."""
    if not silent:
        return None
    wanted: dict[str, list[str]] = {}
    for placed in silent:
        motion = MOTIONS.get(placed.effect.name) or MOTIONS.get(placed.effect.kind, "moves more")
        wanted.setdefault(motion, []).append(_called(placed))
    parts = []
    for motion, names in wanted.items():
        more = " and others" if len(names) > 4 else ""
        parts.append(f"{motion} (for {', '.join(names[:4])}{more})")
    return "To judge what this log cannot, record a motion that " + "; ".join(parts) + "."


def _called(placed: Placed) -> str:
    return placed.effect.name + ("" if placed.target is None else f" of {placed.target}")


def _motions(evidence: Evidence) -> list[tuple[str, Windows]]:
    """Motions to try, in words, from the log's own."""
    base = spread(evidence.windows, WINDOWS)
    commands, model = base.commands, evidence.twin.setting.model
    twice_as_large = 2 * commands
    if model.nactuator == model.nu:
        clipped = np.clip(twice_as_large, *model.actuator_ctrlrange.T)
        twice_as_large = np.where(model.actuator_ctrllimited.astype(bool), clipped, twice_as_large)
    found = {
        "the same motion again": commands,
        "the same motion with commands half as large": 0.5 * commands,
        "the same motion with commands twice as large": twice_as_large,
        "the same motion at half the speed": np.repeat(commands, 2, axis=1)[:, : commands.shape[1]],
        "the same motion at twice the speed": np.concatenate([commands[:, ::2], commands[:, 1::2]], axis=1),
        "a motion without commands": np.zeros_like(commands),
    }
    return [(words, replace(base, commands=np.ascontiguousarray(signal))) for words, signal in found.items()]
