"""The model as given first: its parameters are fitted only where that leaves more than noise, or no names.

Parameters that were chosen because a log tells them, as ``dropo init`` does, are free to make up for what is missing:
each takes a part of a payload, and friction at one joint is a fitted number among twenty. Held where the model has
them, what is missing must have a name.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from dropo_torch.effects import Effect
from dropo_torch.gap.ground import count_refitted
from dropo_torch.gap.limit import share_of
from dropo_torch.gap.refit import refit
from dropo_torch.gap.result import Gap
from dropo_torch.gap.run import find_gap
from dropo_torch.gap.scene import Scene, prepare, with_parameters
from dropo_torch.problem import Problem, make_problem
from dropo_torch.shooting.posing import posed
from dropo_torch.support.report import Report

#: Verdicts, the better ones first; two that explain the log are as good as each other.
_RANKS = {"no gap": 0, "explained": 0, "partly explained": 1, "unnamed": 2}
#: Share of the open-loop error above the noise floor by which names are an answer although something remains.
ENOUGH = 0.9
#: Effects that change what a body weighs, or where; and χ² per degree of freedom, relative to what they leave, up to
#: which the body's own mass does as well.
MASSIVE, AS_GOOD = ("payload", "center_of_mass", "inertia"), 1.05
_HELD = (
    "The config's parameters are as the model has them: names without them close most of the gap. To have the rest "
    "tried with the parameters fitted, add --as_given false."
)
_UNFITTED = (
    "The config's parameters are as the model has them. To fit them, too, would take {} s at least, where {} s were "
    "left: --resume with a longer --time-limit does."
)
#: Hypotheses that are simulated to see how long that takes.
BATCH = 8
#: Fits of the declared parameters that a search takes as long as, at least.
FITS = 40


def as_given(problem: Problem, free: Collection[str] = ()) -> Problem:
    """Return a problem in which the model's own parameters are as the model has them; effects keep theirs.

    Args:
        problem: the model, its parameters, and the log.
        free: names of parameters that are fitted all the same.
    """
    config = problem.config
    kept = {name: entry for name, entry in (config.parameters or {}).items() if "effect" in entry or name in free}
    held = config.model_copy(update={"parameters": kept, "as_given": False})
    made = make_problem(
        held.model_copy(update={"trajectories": None, "leave_out": []}), log=problem.trajectories, general=True
    )
    sensed = problem.sensed
    if sensed is not None:
        sensed = sensed.model_copy(update={"parameters": kept or None, "as_given": False})
    return replace(made, config=held, sensed=sensed, derived=problem.derived)


def find_gap_as_given(
    problem: Problem,
    *,
    effects: Sequence[Effect] | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    report: Report = lambda stage, share: None,
    scene: Scene | None = None,
    time_limit: float = math.inf,
) -> tuple[Problem, Gap]:
    """Return what is missing in the model as given; where that has no answer, with its parameters fitted, if better.

    Names that leave something are an answer where they close :data:`ENOUGH` of the gap in open loop. Where the mass of
    a body does as well as what was named there, it is the answer.

    Args:
        problem: the model, its parameters, and the log.
        effects, checkpoint, resume, report, time_limit: those of :func:`~dropo_torch.gap.run.find_gap`; of the time,
            the second search has what the first one leaves.
        scene: what :func:`prepare` made of :func:`as_given` of the problem; made here by default.

    Returns:
        The problem on which it was found, and the gap.

    Raises:
        InputError: as :func:`~dropo_torch.gap.run.find_gap` raises it.
    """
    problem = posed(problem)
    held, end = as_given(problem) if scene is None else scene.problem, time.monotonic() + time_limit
    path = None if checkpoint is None else checkpoint.with_stem(f"{checkpoint.stem}-given")

    def sought(problem: Problem, path: Path | None, scene: Scene, end: float) -> Gap:
        return find_gap(
            problem, effects=effects, checkpoint=path, resume=resume, report=report, scene=scene,
            time_limit=max(end - time.monotonic(), 0.0),
        )  # fmt: skip

    scene = scene or prepare(held)
    first = sought(held, path, scene, end if _takes_too_long(problem, scene, end) else share_of(end, 1))
    if _RANKS[first.verdict] == 0:
        if (plain := as_own(problem, first, scene)) is None:
            return held, first
        other = None if checkpoint is None else checkpoint.with_stem(f"{checkpoint.stem}-own")
        second = sought(plain, other, with_parameters(scene, plain), end)
        return (plain, _both(first, second)) if _RANKS[second.verdict] == 0 else (held, first)
    if first.verdict == "partly explained" and first.closed >= ENOUGH:
        return held, replace(first, notes=(*first.notes, _HELD))
    report("fitting the config's parameters", 0.0)
    free, left = prepare(problem), end - time.monotonic()
    if (needed := _seconds(free, first)) > left:
        return held, replace(first, notes=(*first.notes, _UNFITTED.format(int(needed), max(int(left), 0))))
    second = sought(problem, checkpoint, free, end)
    if _standing(second) < _standing(first):
        return problem, _both(first, second)
    return held, _both(second, first)


def as_own(problem: Problem, gap: Gap, scene: Scene) -> Problem | None:
    """Return a problem in which masses that the config has make up for what was named at their bodies, if they do.

    What sits on a body has more numbers than the mass of the body itself, which may just be another than the model's.
    Where several bodies' are, names at one of them stand for all: so all masses are tried, unless these are more
    numbers than what was named has. A mass and its center together have as many: they are no simpler answer.

    Args:
        problem: the model, its parameters, and the log.
        gap: what explains the log in the model as given.
        scene: what that was found on.
    """
    bodies = {e.target for e in gap.effects if e.effect in MASSIVE}
    if not bodies:
        return None
    parameters = problem.config.parameters or {}
    masses = {n: p.get("name") for n, p in parameters.items() if p.get("field") == "body_mass"}
    own = [n for n, at in masses.items() if bodies.intersection(at if isinstance(at, list) else [at])]
    every = list(masses)
    named = sum(len(e.parameters) for e in gap.effects)
    for free in (own, every if len(own) < len(every) <= named else []):
        if free and (plain := _as_good(problem, free, gap, scene)) is not None:
            return plain
    return None


def _as_good(problem: Problem, free: Sequence[str], gap: Gap, scene: Scene) -> Problem | None:
    """A problem in which some parameters are free, if with these it leaves no more than what was named."""
    plain = as_given(problem, free)
    scene = with_parameters(scene, plain)
    left = refit(scene.evidence, scene.begin, slopes=False).cost.reduced
    named = max(gap.reduced[1], 0.0 if gap.own_step is None else gap.own_step[0])
    return plain if left <= AS_GOOD * named else None


def _seconds(scene: Scene, first: Gap) -> float:
    """Seconds that a search with the declared parameters takes at the least, by what simulations took so far."""
    return _transitions(scene, len(scene.begin.declared)) * first.seconds / max(first.simulated_transitions, 1)


def _takes_too_long(problem: Problem, scene: Scene, end: float) -> bool:
    """Whether a search with the declared parameters would not end in the time that a first one leaves it."""
    if math.isinf(end):
        return False
    evidence, variant = scene.evidence, scene.begin.variant
    for _ in range(2):  # kernels are compiled or loaded in the first
        begun = time.perf_counter()
        evidence.residuals([variant] * BATCH)
    took, simulated = time.perf_counter() - begun, BATCH * len(evidence.windows) * evidence.windows.length
    return _transitions(scene, len(problem.space.names)) * took / simulated > end - share_of(end, 1)


def _transitions(scene: Scene, numbers: int) -> int:
    """Transitions that a search with so many declared parameters simulates at the least."""
    return FITS * (1 + numbers) * count_refitted(scene.evidence) * scene.evidence.windows.length


def _both(other: Gap, gap: Gap) -> Gap:
    """An answer, with what it took to find another one, too."""
    count = other.simulated_transitions + gap.simulated_transitions
    return replace(gap, seconds=other.seconds + gap.seconds, simulated_transitions=count)


def _standing(gap: Gap) -> tuple[int, float]:
    """What answers are compared by: the verdict, then open-loop errors on unseen data."""
    return _RANKS[gap.verdict], gap.after.rollout_rmse
