"""Which motion would tell two effects apart that this log cannot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.effects.base import Placed, Setting
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import spread
from dropo_torch.gap.refit import LEAST_DAMPING, RIDGE, STEP, Hypothesis, Refit, beside, limits_of, refit
from dropo_torch.gap.rules import near
from dropo_torch.gap.twin import Windows
from dropo_torch.optimizers.least_squares import bounded_step

#: Windows of a motion that is tried, and of the log to which a rival is fitted.
WINDOWS, LOGGED = 16, 40
#: χ² that a motion must show, in units of what hypotheses may differ by and still explain a log alike.
SURELY = 2.0
#: Steps in which a rival adapts to the log, and to a motion.
ADAPTED = 4
#: Other commands ``(E, N, nu)`` for the motions of a log, by what they are called.
COMMANDS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "the same motion again": lambda u: u,
    "the same motion with commands half as large": lambda u: 0.5 * u,
    "the same motion with commands twice as large": lambda u: 2 * u,
    "the same motion at half the speed": lambda u: np.repeat(u, 2, axis=1)[:, : u.shape[1]],
    "the same motion at twice the speed": lambda u: np.concatenate([u[:, ::2], u[:, 1::2]], axis=1),
    "a motion without commands": np.zeros_like,
}
#: Factors of the velocities at the start, where nothing is commanded.
STARTS: Mapping[str, float] = {
    "the same motion again": 1.0,
    "motions that start half as fast": 0.5,
    "motions that start twice as fast": 2.0,
}
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


@dataclass(frozen=True)
class Advice:
    """What to record, or that nothing helps.

    Attributes:
        sentence: in words.
        tells: whether a motion is proposed.
    """

    sentence: str
    tells: bool


def suggest(evidence: Evidence, first: Hypothesis, second: Hypothesis, one: Placed, other: Placed) -> Advice:
    """Return advice: of several motions the one that separates two hypotheses most, and by how many σ.

    The motions are those of the log with other commands, or with other velocities at the start where nothing is
    commanded. The first hypothesis is taken for the truth there; the second may adapt all of its numbers to the
    motion, as far as the log lets it, so that what is the same thing stays so.

    Args:
        evidence: the windows of the log.
        first: what was named, fitted.
        second: the same with a rival in the place of one effect.
        one, other: the effect, and its rival.
    """
    names = f"{_called(one)} from {_called(other)}"
    log = evidence.on(spread(evidence.windows, LOGGED))
    rival, own = refit(log, second, iterations=ADAPTED), refit(log, first, iterations=0, slopes=False).cost
    share = len(evidence.windows) / max(len(log.windows), 1)
    found = []
    for words, windows in motions(evidence.windows, evidence.twin.setting):
        apart = separation(evidence.on(windows), first, rival, share)
        if apart is not None:
            found.append((apart, words))
    if not found:
        return Advice(f"No motion that was tried tells {names}.", tells=False)
    most, words = max(found)
    if most < max(evidence.rules.shown.apart, float(np.sqrt(SURELY * near(own, evidence.rules)))):
        return Advice(
            f"None of {len(found)} motions that were tried would tell {names} (at best {most:.1f} σ): "
            "on this robot they may be the same thing.",
            tells=False,
        )
    count = min(WINDOWS, len(evidence.windows))
    sentence = f"To tell {names}, record {words}: over {count} windows it would separate them by {most:.0f} σ."
    return Advice(sentence, tells=True)


def separation(motion: Evidence, true: Hypothesis, rival: Refit, share: float = 1.0) -> float | None:
    """Return by how many σ a motion shows one hypothesis and not another that adapts; ``None`` where one diverges.

    The square is the least, over the rival's numbers, of χ² on the motion and of what the change of the numbers
    costs on the log: Gauss and Newton's method on both together.

    Args:
        motion: windows of the motion.
        true: what is taken for the truth.
        rival: the other, as fitted to the log, with derivatives.
        share: windows of the log, by those that it was fitted to.
    """
    limits, log = limits_of(rival.hypothesis, motion.twin), rival.weighted(1.0)[0]
    free, start, cost = np.flatnonzero(limits.free), rival.hypothesis.vector, share * log @ log.T
    linear, shown = motion.linearise(true.variant), motion.residuals([true.variant])[0][0]
    vector, least = start, np.inf
    for _ in range(ADAPTED):
        there = rival.hypothesis.at(vector)
        moved, steps = beside(there, limits, free, STEP)
        found = motion.residuals([there.variant, *(h.variant for h in moved)])[0]
        if not (np.isfinite(found).all() and np.isfinite(shown).all()):
            return None if least == np.inf else float(np.sqrt(least))
        apart = motion.project_slope(found[0] - shown, linear).ravel()
        slope = np.zeros((len(vector), apart.size))
        moves = motion.project_slope((found[1:] - found[0]) / steps[:, None, None], linear)
        slope[free] = moves.reshape(len(free), apart.size)
        change = (vector - start) / limits.scale
        least = min(least, float(apart @ apart + change @ cost @ change))
        force, (low, high) = -(slope @ apart + cost @ change), limits.moves(vector)
        step = bounded_step(slope @ slope.T + cost, force, low, high, LEAST_DAMPING, RIDGE, np.ones(len(vector)))
        vector = np.clip(vector + step * limits.scale, limits.low, limits.high)
    return float(np.sqrt(least))


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


def motions(windows: Windows, setting: Setting) -> list[tuple[str, Windows]]:
    """Return motions to try, in words and as windows, from those of a log."""
    base, model = spread(windows, WINDOWS), setting.model
    if base.commands.any():
        ranges = model.actuator_ctrlrange.T if model.nactuator == model.nu else None
        limited = model.actuator_ctrllimited.astype(bool)
        found = []
        for words, vary in COMMANDS.items():
            commands = vary(base.commands)
            if ranges is not None:
                commands = np.where(limited, np.clip(commands, *ranges), commands)
            found.append((words, replace(base, commands=np.ascontiguousarray(commands))))
        return found
    fast = setting.observation.index >= model.nq
    found = []
    for words, factor in STARTS.items():
        measured = base.measured.copy()
        measured[:, 0, fast] *= factor
        found.append((words, replace(base, measured=measured, rates=factor * base.rates)))
    return found
