"""The workflow: locate, name, verify; step by step, or as one call."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dropo_torch.effects import VOCABULARY, Effect, Placed
from dropo_torch.errors import InputError
from dropo_torch.gap.disturbed import undisturbed
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.forces.motion import has_forces
from dropo_torch.gap.forces.view import ForceView, force_view
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.limbs import joint_of_column
from dropo_torch.gap.limit import share_of
from dropo_torch.gap.locate import places
from dropo_torch.gap.noise import free_forces
from dropo_torch.gap.outcome import make_result, with_forces
from dropo_torch.gap.refit import Hypothesis, refit
from dropo_torch.gap.result import Gap, Place, Score
from dropo_torch.gap.rules import Rules, remains
from dropo_torch.gap.scene import Scene, outstanding, prepare, searched
from dropo_torch.gap.search import (
    Ended,
    Naming,
    believed,
    beside_noise,
    instead_of_one,
    kept,
    leaves_wrong,
    resort,
    search,
    start,
    with_ties,
)
from dropo_torch.gap.sound import has_skill
from dropo_torch.gap.verify import constant_velocity, cut_held, open_loop_error, scores
from dropo_torch.problem import Problem
from dropo_torch.support.report import Report
from dropo_torch.support.threads import single_thread

#: Suffix of the checkpoint of a search over the windows that stand out among others: of these, chance chooses too many.
RARE = "-rare"
#: Suffix of the checkpoint of a search without the spans in which something pushed.
CALM = "-calm"
#: Share of a time limit after which no more is looked for: what was found is then fitted and verified.
SEARCHED = 0.85


def locate(scene: Scene, *, effects: Sequence[Effect] | None = None, rules: Rules | None = None) -> tuple[Place, ...]:
    """Return where simulation and log disagree, the largest share first; nothing if what remains is noise.

    The declared parameters are fitted first; a place's share is the most that a change there could explain.

    Args:
        scene: of :func:`prepare`.
        effects: the vocabulary; all of the package's by default.
        rules: thresholds; the scene's by default.

    Raises:
        InputError: an empty vocabulary, a log with too few short windows, or a simulation that diverges in all of them.
    """
    scene = _ruled(scene, rules)
    state = start(_ground(scene, effects), scene.begin)
    if state.done:
        return ()
    return places(
        scene.setting,
        free_forces(scene.twin, scene.short, state.base.hypothesis.variant, state.noise),
        state.first,
        scene.rules.shown,
    )


def name(scene: Scene, *, effects: Sequence[Effect] | None = None, rules: Rules | None = None) -> Naming:
    """Return the effects that the log needs, with values, ties and the candidates that were tried.

    Args:
        scene: of :func:`prepare`.
        effects: the vocabulary; all of the package's by default.
        rules: thresholds; the scene's by default.

    Raises:
        InputError: an empty vocabulary, or a simulation that diverges in all windows.
    """
    scene = _ruled(scene, rules)
    return _name(scene, _ground(scene, effects))


def verify(scene: Scene, hypothesis: Hypothesis) -> tuple[Score, Score]:
    """Return how far a hypothesis is from held-out data, and how far noise alone would leave a perfect one.

    The units of the errors are those of :class:`Score`.

    Args:
        scene: of :func:`prepare`.
        hypothesis: such as ``name(scene).base.hypothesis`` and ``.final.hypothesis``.

    Raises:
        InputError: effects with values that MuJoCo refuses.
    """
    return scores(scene.evidence, cut_held(scene.evidence, scene.held, hypothesis), hypothesis)


def open_loop(scene: Scene, hypothesis: Hypothesis, seconds: float) -> tuple[float, float]:
    """Return the root mean square error of open-loop positions on held-out data, and that of constant velocity.

    Angles count in rad and lengths in m, and their squares are averaged as they are: of a robot with both, errors
    compare with each other, and mean neither.

    Args:
        scene: of :func:`prepare`.
        hypothesis: such as ``scene.begin`` and ``name(scene).final.hypothesis``.
        seconds: of a prediction.

    Raises:
        InputError: no held-out trajectory is that long.
    """
    return open_loop_error(scene.evidence, scene.held, hypothesis, seconds)


@single_thread()
def find_gap(
    problem: Problem,
    *,
    effects: Sequence[Effect] | None = None,
    rules: Rules | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    report: Report = lambda stage, share: None,
    scene: Scene | None = None,
    time_limit: float = math.inf,
) -> Gap:
    """Find where simulation and log disagree, name the missing effects, and verify them on held-out data.

    Args:
        problem: the model, its declared parameters, and the log.
        effects: the vocabulary; all of the package's by default.
        rules: thresholds.
        checkpoint: file in which the state between rounds is kept.
        resume: go on from it.
        report: called with a stage and its share done.
        scene: what :func:`prepare` made of the problem; made here by default.
        time_limit: seconds that it may take, about. After :data:`SEARCHED` of them no more effects are looked for: what
            was found until then is judged, and ``unfinished`` says what was not tried; it depends on how fast the
            machine is.

    Raises:
        InputError: a log or simulator in which nothing can be looked for (see :func:`prepare`), an empty vocabulary, or
            a checkpoint of another search.
    """
    started, end = time.perf_counter(), time.monotonic() + SEARCHED * time_limit
    report("preparing", 0.0)
    scene = _ruled(scene or prepare(problem, rules), rules)
    scene, pushes = undisturbed(scene, scene.begin, scene.noise)
    ground = replace(_ground(scene, effects), report=report)
    naming, gap = _found(scene, ground, checkpoint, resume, started, end)
    if not pushes and gap.verdict in ("unnamed", "partly explained") and time.monotonic() < end:
        calm, pushes = undisturbed(scene, naming.final.hypothesis, naming.evidence.noise)  # beside what was named
        if pushes:
            path = None if checkpoint is None else checkpoint.with_stem(f"{checkpoint.stem}{CALM}")
            ground = replace(_ground(calm, effects), report=report)
            naming, gap = _found(calm, ground, path, resume, started, end)
    return replace(gap, disturbances=pushes)


def _found(
    scene: Scene, ground: Ground, checkpoint: Path | None, resume: bool, started: float, end: float
) -> tuple[Naming, Gap]:
    """What a search named, and what is made of it: where predictions have no skill, forces at the joints may decide."""
    views: dict[tuple[Placed, ...], ForceView | None] = {}

    def view(named: tuple[Placed, ...]) -> ForceView | None:
        if named not in views:
            views[named] = _view(scene, ground, named)
        return views[named]

    def forces_decide(naming: Naming) -> bool:
        return has_forces(scene.setting) and not _has_skill(scene, naming) and view(()) is not None

    naming = _name(scene, ground, checkpoint, resume, end, forces_decide)
    gap = make_result(scene, naming, started, ground.report, end=end)
    if gap.skill or gap.verdict not in ("unnamed", "partly explained"):
        return naming, gap
    refused = gap.verdict == "unnamed"  # names that unseen data refute are no rivals
    if (decided := view(() if refused else naming.final.hypothesis.placed)) is None:
        return naming, gap
    return naming, replace(with_forces(scene, gap, decided), seconds=time.perf_counter() - started)


def _view(scene: Scene, ground: Ground, named: Sequence[Placed]) -> ForceView | None:
    """What the forces at the joints say, if the log has them, and they say more than the names that predictions gave.

    They decide where no prediction of the model as it is has skill: errors then grow so fast that what slows all motion
    down, such as inertia, makes them smaller. Names of predictions stay unless forces leave clearly less unexplained.
    """
    problem = scene.problem
    if problem.effects is not None:  # a delay or a late sensor of the config's would have to be undone first
        return None
    ground.report("comparing forces", 0.0)
    setting = replace(scene.setting, model=problem.space.apply(np.array(scene.begin.declared)))
    rules = scene.rules.forces
    view = force_view(setting, scene.train, scene.held, ground.effects, rules, named, _position_noise(scene))
    return None if view is None or not view.placed or (named and not view.beats_rival(rules)) else view


def _position_noise(scene: Scene) -> dict[int, float]:
    """The standard deviations of the joints' measured positions, by the joints' numbers."""
    setting, chart = scene.setting, scene.evidence.chart
    places = dict(zip(setting.observation.labels, setting.observation.index.tolist(), strict=True))
    told = dict(zip(chart.labels, scene.evidence.noise.tolist(), strict=True))
    positions = (label for label in chart.labels if 0 <= places.get(label, -1) < setting.model.nq)
    return {j: told[label] for label in positions if (j := joint_of_column(setting, label)) is not None}


def _has_skill(scene: Scene, naming: Naming) -> bool:
    """Return whether open-loop predictions of the declared parameters alone beat constant velocity on unseen data."""
    evidence, hypothesis = naming.evidence, naming.base.hypothesis
    held = cut_held(evidence, scene.held, hypothesis)
    after, floor = scores(evidence, held, hypothesis)
    return has_skill(after, floor, constant_velocity(evidence, held.rollouts), scene.rules.sound)


def _is_noise(scene: Scene, naming: Naming) -> bool:
    """Return whether what has no name is noise: nothing that was tried explains any of it, and nothing adds up.

    Noise that lasts over rows, or stamps that jitter, leave more in windows than the noise of single rows would, but
    in stretches of unseen data that are as long as open-loop predictions, from the best start, no more than in those.
    """
    evidence, sound, cost = naming.evidence, scene.rules.sound, naming.base.cost
    tried = [attempt.left for attempt in naming.attempts]
    if naming.unfinished or evidence.rough or evidence.robust or cost.reduced > sound.wrong:
        return False
    if not tried or min(tried) < sound.idle:
        return False
    hypothesis = naming.base.hypothesis
    stretches = cut_held(evidence, scene.held, hypothesis).rollouts
    if not len(stretches):
        return False
    there = refit(replace(evidence.on(stretches), caps=1.0), hypothesis, iterations=0, slopes=False)
    return there.cost.reduced <= sound.floor * cost.reduced


def _name(
    scene: Scene, ground: Ground, checkpoint: Path | None = None, resume: bool = False, end: float = math.inf,
    decided: Callable[[Naming], bool] = lambda naming: False,
) -> Naming:  # fmt: skip
    """Search; where nothing has a name, once more over shorter windows, and where there are contacts robustly.

    Where the windows show nothing, those that do are searched, if the log has any: but not for what remembers commands,
    which acts throughout. Where they show what is noise, nothing is missing.

    Where there are contacts, long windows bend, and what is most of the gap there may be an effect of the wrong kind:
    names that leave a rest are then believed only if they leave none in shorter windows, in most of the log at least,
    or if these find no others that do. Where no search has names, the base family of all joints is the last resort;
    where something else has ``decided`` by then, there are no more searches.
    """
    searches = _Searches(scene, ground, checkpoint, resume, end)
    found, waiting = list[Ended](), list(searched(scene))
    while waiting and (not found or searches.has_time):
        suffix, evidence = waiting.pop(0)
        if found:
            ground.report("searching over shorter windows", 0.0)
        found.append(searches.over(suffix, replace(ground, evidence=evidence), share_of(end, len(waiting))))
        last = found[-1].naming
        if not found[0].naming.gap:
            return searches.over_rare(last)
        if not last.named:
            if _is_noise(scene, last):
                return replace(last, gap=False, lasting=True, refused="")
            if decided(last):
                return last
        elif not searches.doubts(last):
            return searches.told(found[-1])
        elif (sure := searches.sure_of(found[-1], [other for _, other in waiting])) is not None:
            return sure
    return searches.best(found, len(waiting))


@dataclass(frozen=True)
class _Searches:
    """Searches of one log, over one choice of windows after the other.

    Attributes:
        scene: of the log.
        ground: what they stand on, but for the windows.
        checkpoint: file by which those are called that keep their states; ``None`` for nowhere.
        resume: whether they go on from there.
        end: when they are over, by ``time.monotonic``.
    """

    scene: Scene
    ground: Ground
    checkpoint: Path | None
    resume: bool
    end: float

    @property
    def has_time(self) -> bool:
        """Whether there is time for another one."""
        return time.monotonic() < self.end

    def over(self, suffix: str, ground: Ground, end: float) -> Ended:
        """Search some windows, with a checkpoint of their own."""
        path = None
        if self.checkpoint is not None:
            known = f"{self.scene.problem.fingerprint} {self.ground.rules} {[e.name for e in self.ground.effects]}"
            path = kept(self.checkpoint.with_stem(f"{self.checkpoint.stem}{suffix}"), known)
        ended = search(ground, self.scene.begin, path, resume=self.resume, end=end, latest=self.end)
        return beside_noise(ended, self.end) if suffix != RARE else ended

    def over_rare(self, nothing: Naming) -> Naming:
        """Search the windows that show something where others show nothing, if there are any."""
        rare = outstanding(self.scene, nothing.evidence, nothing.base.hypothesis)
        if rare is None:
            return nothing
        effects = tuple(e for e in self.ground.effects if not e.has("command"))
        return with_ties(self.over(RARE, replace(self.ground, evidence=rare, effects=effects), self.end), self.end)

    def doubts(self, naming: Naming) -> bool:
        """Whether names leave a rest where there are contacts."""
        touches = bool(self.scene.setting.signals.contacts.any())
        return touches and remains(naming.final.cost, self.ground.rules)

    def told(self, ended: Ended) -> Naming:
        """Return what a search named with what ties with it; two effects or the base family where it is wrong."""
        if self.has_time and leaves_wrong(ended.naming, self.ground):
            ended = instead_of_one(ended)
        if self.has_time and leaves_wrong(ended.naming, self.ground):
            naming = resort(ended.ground, ended.naming)
            return naming if naming.family else with_ties(ended, self.end)
        return with_ties(ended, self.end)

    def sure_of(self, ended: Ended, others: Sequence[Evidence]) -> Naming | None:
        """Return what a search named, if it leaves nothing in one of the other choices of windows."""
        for other in others:
            if not self.has_time:
                break
            sure = believed(replace(self.ground, evidence=other), self.scene.begin, ended)
            if sure is not None:
                naming = with_ties(sure, self.end)
                return replace(naming, unfinished=ended.naming.unfinished or naming.unfinished)
        return None

    def best(self, found: Sequence[Ended], waiting: int) -> Naming:
        """Return the best of what searches found of which none decides; so many more were waiting."""
        best = min(found, key=lambda e: (not e.naming.named, not e.naming.partial))
        for ended in () if best.naming.named else found:
            if self.has_time and (resorted := resort(self.ground, ended.naming)).named:
                return resorted
        late = next((e.naming.unfinished for e in found if e.naming.unfinished), "")
        if waiting:
            late = late or f"{waiting} more searches over shorter windows were waiting"
        refused = best.naming.refused or next((e.naming.refused for e in found if e.naming.refused), "")
        naming = with_ties(best, self.end)
        return replace(naming, refused="" if naming.named else refused, unfinished=late or naming.unfinished)


def _ruled(scene: Scene, rules: Rules | None) -> Scene:
    """A scene with other thresholds, where they are given."""
    return scene if rules is None else replace(scene, evidence=replace(scene.evidence, rules=rules))


def _ground(scene: Scene, effects: Sequence[Effect] | None) -> Ground:
    """What a search stands on, by default with the whole vocabulary.

    Raises:
        InputError: an empty vocabulary.
    """
    known = tuple(VOCABULARY.values() if effects is None else effects)
    if not known:
        raise InputError("effects: none given; name at least one, or leave effects out to look for all there are")
    return Ground(scene.evidence, known, short=scene.noisy)
