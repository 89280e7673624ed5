"""Which motion would tell two effects apart that this log cannot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.effects.base import Placed, Setting
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import spread
from dropo_torch.gap.refit import LEAST_DAMPING, RIDGE, STEP, Hypothesis, Refit, beside, derivatives, limits_of, refit
from dropo_torch.gap.rules import near
from dropo_torch.gap.twin import Twin, Windows
from dropo_torch.optimizers.least_squares import bounded_step

#: Windows of a motion that is tried, of these in a row, and of the log to which a rival is fitted.
WINDOWS, IN_A_ROW, LOGGED = 16, 4, 40
#: χ² that a motion must show, in units of what hypotheses may differ by and still explain a log alike.
SURELY = 2.0
#: Steps in which a rival adapts to the log, and to a motion.
ADAPTED = 4
#: The motion of the log.
AGAIN = "the same motion again"
#: Commands ``(N, nu)`` for motions like that of a log, by what they are called.
COMMANDS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    AGAIN: lambda u: u,
    "the same motion with commands half as large": lambda u: 0.5 * u,
    "the same motion with commands twice as large": lambda u: 2 * u,
    "the same motion at half the speed": lambda u: np.repeat(u, 2, axis=0)[: len(u)],
    "the same motion at twice the speed": lambda u: np.concatenate([u[::2], u[1::2]]),
    "a motion without commands": np.zeros_like,
}
#: Factors of the velocities at the start, where nothing is commanded.
STARTS: Mapping[str, float] = {
    AGAIN: 1.0,
    "motions that start half as fast": 0.5,
    "motions that start twice as fast": 2.0,
}
#: What a motion must do to show an effect, by its name or else by its kind; a body or the world just has to move more.
MOTIONS = {
    "joint_limit": "reaches the stops",
    "joint_stop": "",  # nothing says that there are any
    "armature": "accelerates these joints",
    "joint": "moves these joints further, faster and to and fro",
    "tendon": "moves these tendons further and to and fro",
    "actuator_saturation": "asks for larger forces",
    "actuator": "commands these actuators more, and changes the commands faster",
    "sensor": "moves these columns further",
    "geom": "slides and presses on these geoms",
    "ground_slope": "slides and presses on the ground",
    "fluid_drag": "moves these bodies fast",
    "linear_drag": "moves these bodies fast",
    "quadratic_drag": "moves these bodies fast",
    "axis_drag": "moves these bodies fast along all of their axes",
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
    commanded. The first hypothesis is taken for the truth there, so that windows lie along the motion as it would be;
    the second may adapt all of its numbers to it, as far as the log lets it, so that what is the same thing stays so.

    Args:
        evidence: the windows of the log.
        first: what was named, fitted.
        second: the same with a rival in the place of one effect.
        one, other: the effect, and its rival.
    """
    names = f"{_called(one)} from {_called(other)}"
    log = evidence.on(spread(evidence.windows, LOGGED))
    own = refit(log, first, iterations=0, slopes=False).cost
    begins = [second, second.at(first.vector)] if one.effect is other.effect else [second]  # it may be the same thing
    rival = min((refit(log, start, iterations=ADAPTED) for start in begins), key=lambda fitted: fitted.loss)
    share = len(evidence.windows) / max(len(log.windows), 1)
    found = []
    for words, windows in motions(evidence, first):
        apart = separation(evidence.on(windows), first, rival, share)
        if apart is not None:
            found.append((apart, words, len(windows)))
    if not found:
        return Advice(f"No motion that was tried tells {names}.", tells=False)
    most, words, count = max(found)
    needed = max(evidence.rules.shown.apart, float(np.sqrt(SURELY * near(own, evidence.rules))))
    if most < needed:
        why = "on this robot they may be the same thing"
        if most > evidence.rules.shown.apart:
            why = f"with errors as large as this log has beside both, it would take {needed:.0f} σ"
        return Advice(
            f"None of {len(found)} motions that were tried would tell {names} (at best {most:.1f} σ): {why}.",
            tells=False,
        )
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
    linear, shown = motion.linearize(true.variant), motion.residuals([true.variant])[0][0]
    vector, least = start, np.inf
    for _ in range(ADAPTED):
        there = rival.hypothesis.at(vector)
        moved, along = beside(there, limits, free, STEP)
        found = motion.residuals([there.variant, *(h.variant for h in moved)])[0]
        if not (np.isfinite(found).all() and np.isfinite(shown).all()):
            return None if least == np.inf else float(np.sqrt(least))
        apart = motion.project_slope(found[0] - shown, linear).ravel()
        slope = np.zeros((len(vector), apart.size))
        moves = motion.project_slope(derivatives(found[1:] - found[0], along), linear)
        slope[free] = moves.reshape(len(free), apart.size)
        change = (vector - start) / limits.scale
        least = min(least, float(apart @ apart + change @ cost @ change))
        force, (low, high) = -(slope @ apart + cost @ change), limits.moves(vector)
        step = bounded_step(slope @ slope.T + cost, force, low, high, LEAST_DAMPING, RIDGE, np.ones(len(vector)))
        vector = np.clip(vector + step * limits.scale, limits.low, limits.high)
    return float(np.sqrt(least))


def excite(silent: Sequence[Placed]) -> str | None:
    """Return what a log would have to show so that candidates that it cannot judge can be judged."""
    silent = [p for p in silent if not p.effect.steps]  # whatever moves, the model's step is the same
    silent = [p for p in silent if MOTIONS.get(p.effect.name) != ""]
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


def motions(evidence: Evidence, true: Hypothesis) -> list[tuple[str, Windows]]:
    """Return motions to try, in words and as windows: the log's own, and others as they would be by a hypothesis.

    These go on from a few states of the log, with other commands, or with other velocities where nothing is commanded.

    Args:
        evidence: the windows of the log.
        true: what is taken for the truth.
    """
    windows, twin = evidence.windows, evidence.twin
    row = IN_A_ROW if windows.unseen is None else 1  # a position that no column has is known at a window's start only
    room = windows.commands.shape[1] - windows.steps
    if not (long := room >= row * windows.length).any():
        row, long = 1, room >= windows.length
    begins = spread(windows.select(long), WINDOWS // row)
    if windows.commands.any():
        others = [(words, _commanded(begins, twin.setting, vary)) for words, vary in COMMANDS.items()]
    else:
        others = [(words, _faster(begins, twin.setting, factor)) for words, factor in STARTS.items()]
    played = [(words, _played(twin, true, other, row)) for words, other in others if words != AGAIN]
    return [(AGAIN, spread(windows, WINDOWS)), *((words, motion) for words, motion in played if len(motion))]


def _commanded(begins: Windows, setting: Setting, vary: Callable[[np.ndarray], np.ndarray]) -> Windows:
    """The same starts, each with an episode of its own, in which commands change from there on, within their ranges."""
    model, commands = setting.model, begins.commands[begins.episodes].copy()
    for own, step in zip(commands, begins.steps, strict=True):
        own[step:] = vary(own[step:])
    if model.nactuator == model.nu:
        limited = model.actuator_ctrllimited.astype(bool)
        commands = np.where(limited, np.clip(commands, *model.actuator_ctrlrange.T), commands)
    return replace(_apart(begins), commands=np.ascontiguousarray(commands))


def _faster(begins: Windows, setting: Setting, factor: float) -> Windows:
    """The same starts with velocities so many times as large, before which nothing was."""
    measured, apart = begins.measured.copy(), _apart(begins)
    measured[:, 0, setting.observation.index >= setting.model.nq] *= factor
    begun = replace(apart, measured=measured, rates=factor * begins.rates, starts=None)
    nothing = None if apart.observed is None else np.full_like(apart.observed, np.nan)
    return replace(begun, observed=_gone_on(replace(begun, observed=nothing), measured[:, :1]))


def _apart(begins: Windows) -> Windows:
    """The same starts, each with an episode of its own."""
    observed = None if begins.observed is None else begins.observed[begins.episodes]
    return replace(
        begins, episodes=np.arange(len(begins)), commands=begins.commands[begins.episodes], observed=observed
    )


def _gone_on(begins: Windows, shown: np.ndarray) -> np.ndarray | None:
    """What is observed of every episode ``(E, N, n)`` that goes on along a path ``(E, P, n)`` from its start."""
    if begins.observed is None:
        return None
    observed = begins.observed.copy()
    for own, step, path in zip(observed, begins.steps, shown, strict=True):
        own[step : step + len(path)] = path[: len(own) - step]
    return observed


def _played(twin: Twin, true: Hypothesis, begins: Windows, row: int) -> Windows:
    """Windows of motions that go on from the starts of others, so many of each in a row; none of one that diverges."""
    length = begins.length
    path = np.repeat(begins.measured[:, :1], row * length + 1, axis=1)
    shown = twin.predict([true.variant], replace(begins, measured=path, starts=None))[0][0]
    rates = np.gradient(shown, twin.setting.signals.timestep, axis=1)
    rates[:, 0] = begins.rates
    at = length * np.arange(row)
    cut = Windows(
        measured=shown[:, at[:, None] + np.arange(length + 1)].reshape(-1, length + 1, shown.shape[-1]),
        rates=rates[:, at].reshape(-1, shown.shape[-1]),
        episodes=np.repeat(begins.episodes, row),
        steps=(begins.steps[:, None] + at).ravel(),
        commands=begins.commands,
        unseen=begins.unseen,
        observed=_gone_on(begins, shown),
    )
    return cut.select(np.isfinite(shown).all((1, 2)).repeat(row))
