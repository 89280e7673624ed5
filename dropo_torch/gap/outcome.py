"""From what a search found to the result that people and programs read."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.effects import VOCABULARY
from dropo_torch.effects.base import Placed, Quantity, Setting, all_of
from dropo_torch.gap.course import courses
from dropo_torch.gap.evidence import Cost, Evidence
from dropo_torch.gap.family import joint_names
from dropo_torch.gap.forces.view import ForceView
from dropo_torch.gap.locate import dof_names, force_unit, guilty, places, residual_pictures, told_when
from dropo_torch.gap.noise import FreeForces, free_forces
from dropo_torch.gap.refit import Z90, Hypothesis, Refit, Resolved, half_widths, refit, resolved, standard_errors
from dropo_torch.gap.renew import moved, noise_beside
from dropo_torch.gap.result import (
    FAMILY,
    Gap,
    JointForce,
    LeftOut,
    NamedEffect,
    Ranked,
    Remaining,
    Residuals,
    Score,
    Strength,
)
from dropo_torch.gap.rules import Rules, remains, significant
from dropo_torch.gap.scene import Scene
from dropo_torch.gap.search import Naming
from dropo_torch.gap.shares import offsets
from dropo_torch.gap.sound import absurd, has_skill
from dropo_torch.gap.spare import is_absent, pushing
from dropo_torch.gap.starts import straightened
from dropo_torch.gap.suggest import excite, suggest
from dropo_torch.gap.symbolic import describe
from dropo_torch.gap.twin import Windows
from dropo_torch.gap.verify import Held, constant_velocity, cut_held, score, scores
from dropo_torch.parameters import ParameterSpace
from dropo_torch.support.report import Report

#: Fits after the last one, at most, each with the weights that the one before suggests.
ROUNDS = 3
#: Joints of which forces are shown, where these decide.
PICTURES = 4
#: Share of a log's transitions below which it is said that no more were compared.
SPARSE = 0.2
#: Pairs of tied effects for which a motion is sought that tells them apart; of a family, whose motions cost more, one.
RIVALS = 4
#: Why a model that is right where it is compared may still lack something.
UNSEEN = (
    "the stretches that were compared show no more than noise, but open-loop errors on unseen data are {:.0f} times "
    "what noise makes"
)
#: Why unseen data refute names.
UNSKILLED = "the model still predicts unseen data no better than constant velocity does"
WORSE = "the model predicts unseen data worse than without them"
#: Why a base family has no names of which none is sure.
NOTHING_SURE = "of friction, inertia, offset and delay, the log may as well lack each"
#: Open-loop error on unseen data, relative to that of constant velocity, from which on no last fit would do better.
HOPELESS = 1.5
#: Share that better starts of windows must leave by themselves for a fit with them to be of use.
NEARER = 0.25
#: Windows on which that is tried first: those with the largest misfit.
WORST = 12
#: Median of χ² of one degree of freedom.
MEDIAN = 0.455


@dataclass(frozen=True)
class _Fitted:
    """What was named, fitted on all windows.

    Attributes:
        evidence: all windows, with the noise that they show.
        weighed: the same with the weights of the last fit.
        final: the last fit.
        last: the same as the step of the simulation leaves it; ``None`` where nothing is named.
        rest: the fit as noise alone weighs the residuals.
        alone: the declared parameters alone, weighed alike.
        own_step: χ² per degree of freedom with the model's own step and a finer one, where that is all that remains.
        halves: half-widths of the 90 % intervals of all numbers, ``(q,)``; empty where nothing is named.
    """

    evidence: Evidence
    weighed: Evidence
    final: Refit
    last: Resolved | None
    rest: Refit
    alone: Refit
    own_step: tuple[float, float] | None
    halves: np.ndarray

    @property
    def of_names(self) -> list[np.ndarray]:
        """Half-widths of the numbers of each name, ``(p,)`` each."""
        hypothesis = self.final.hypothesis
        sizes = [len(hypothesis.declared), *(len(p.values) for p in hypothesis.placed)]
        return np.split(self.halves, np.cumsum(sizes)[:-1])[1:]


#: A last fit, the same as noise alone weighs the residuals, their misfit with the model's own step, and the weights.
_Last = tuple[Resolved, Refit, Cost, Evidence]


@dataclass(frozen=True)
class _Checked:
    """What unseen data say.

    Attributes:
        held: the unseen data.
        given: the declared parameters alone.
        after: with what was named.
        floor: what noise alone would leave.
        constant: the open-loop error of constant velocity.
    """

    held: Held
    given: Score
    after: Score
    floor: Score
    constant: float

    @property
    def astray(self) -> float:
        """The open-loop error in units of what noise alone makes."""
        return self.after.rollout_rmse / max(self.floor.rollout_rmse, 1e-300)


def make_result(
    scene: Scene, naming: Naming, started: float, report: Report = lambda stage, share: None,
    weighed: Evidence | None = None, end: float = math.inf,
) -> Gap:  # fmt: skip
    """Fit what was named on all windows, score it on held-out data, and put everything together.

    Args:
        scene: what the search worked on.
        naming: what it found.
        started: when it began, by ``time.perf_counter``.
        report: called with a stage and its share done.
        weighed: all windows with the weights that a last fit with more names ended with; found here by default.
        end: when what only refines the last fit is left out, by ``time.monotonic``.
    """
    if naming.named and weighed is None and (unnamed := _hopeless(scene, naming)) is not None:
        return make_result(scene, unnamed, started, report, end=end)
    fitted = _fitted_on_all(scene, naming, report, weighed, end)
    if fitted.last is not None and (fewer := _without_unsure(scene.setting, naming, fitted, scene.rules)) is not None:
        return make_result(scene, fewer, started, report, fitted.weighed, end)
    checked = _checked(scene, naming, fitted, report)
    if not naming.gap and checked.astray > scene.rules.sound.astray:
        naming = replace(naming, gap=True, refused=UNSEEN.format(checked.astray))
    if (unnamed := _refuted(naming, fitted, checked, scene.rules)) is not None:
        return make_result(scene, unnamed, started, report, end=end)
    return _put_together(scene, naming, fitted, checked, started, report, end)


def _hopeless(scene: Scene, naming: Naming) -> Naming | None:
    """What was found, without names, where no last fit would give these skill; else ``None``."""
    evidence, best = naming.evidence, naming.final.hypothesis
    held = cut_held(evidence, scene.held, best)
    constant, (after, floor) = constant_velocity(evidence, held.rollouts), scores(evidence, held, best)
    if has_skill(after, floor, HOPELESS * constant, scene.rules.sound):
        return None
    return _without_names(naming, UNSKILLED, after, constant)


def _fitted_on_all(scene: Scene, naming: Naming, report: Report, weighed: Evidence | None, end: float) -> _Fitted:
    """The last fit, with weights that are found or given, and the declared parameters alone."""
    evidence, alone = naming.evidence, naming.base
    if not naming.named:
        return _Fitted(evidence, evidence, naming.final, None, naming.final, alone, None, np.zeros(0))
    report("fitting on all windows", 0.0)
    hypothesis = naming.final.hypothesis
    found = _last_fit(evidence, scene.noisy, hypothesis, end) if weighed is None else _as_weighed(weighed, hypothesis)
    last, rest, own, weighed = found
    if not np.array_equal(last.evidence.noise, evidence.noise):
        evidence = replace(evidence, noise=last.evidence.noise)
        alone = refit(evidence, alone.hypothesis, iterations=0, slopes=False)
    step = _own_step(own, rest.cost, scene.rules)
    return _Fitted(evidence, weighed, last.fit, last, rest, alone, step, half_widths(last))


def _checked(scene: Scene, naming: Naming, fitted: _Fitted, report: Report) -> _Checked:
    """The scores on unseen data."""
    evidence, best = fitted.evidence, fitted.final.hypothesis
    report("verifying", 0.0)
    held = cut_held(evidence, scene.held, best)
    report("verifying", 0.4)
    after, floor = scores(evidence, held, best)
    report("verifying", 0.7)
    given = score(evidence, held, naming.base.hypothesis) if naming.named else after
    return _Checked(held, given, after, floor, constant_velocity(evidence, held.rollouts))


def _refuted(naming: Naming, fitted: _Fitted, checked: _Checked, rules: Rules) -> Naming | None:
    """What was found, without names, where unseen data or the bounds of physics refute these; else ``None``."""
    after, given, constant = checked.after, checked.given, checked.constant
    if fitted.last is None:
        return None
    if found := list(absurd(fitted.last.evidence, fitted.last.fit, rules.sound)):  # on all windows, it may be elsewhere
        return _spared(naming, found)
    if not has_skill(after, checked.floor, constant, rules.sound):
        return _without_names(naming, UNSKILLED, after, constant)
    if remains(fitted.rest.cost, rules) and after.rollout_rmse > given.rollout_rmse:
        return _without_names(naming, WORSE, after, given.rollout_rmse)
    return None


def _put_together(
    scene: Scene, naming: Naming, fitted: _Fitted, checked: _Checked, started: float, report: Report, end: float
) -> Gap:
    """The result that people and programs read."""
    problem, twin, setting, rules = scene.problem, scene.twin, scene.setting, scene.rules
    evidence, noise, best = fitted.evidence, fitted.evidence.noise, fitted.final.hypothesis
    base, skill = naming.base.hypothesis, has_skill(checked.given, checked.floor, checked.constant, rules.sound)
    report("verifying", 0.8)
    before = free_forces(twin, scene.short, base.variant, noise)
    after = free_forces(twin, scene.short, best.variant, noise) if naming.named else before
    shown: tuple[NamedEffect, ...] = ()
    if naming.gap:
        shown = (_unnamed(setting, before),) if fitted.last is None else _named(setting, naming, fitted)
    remaining = None
    if naming.named and (fitted.own_step is None or naming.partial):
        remaining = _remaining(setting, naming, fitted.alone.cost, fitted.rest, after, checked.astray, rules)
    declared = zip(scene.begin.declared, base.declared, best.declared, strict=True)
    return Gap(
        where=places(setting, before, naming.first, rules.shown) if naming.gap else (),
        effects=shown,
        before=checked.given,
        after=checked.after,
        noise_floor=checked.floor,
        next_experiment=_next_experiment(naming, fitted.final, report, end),
        found=naming.gap,
        declared=dict(zip(problem.space.names, declared, strict=True)),
        fitted=_fitted(problem.space, evidence, best, fitted),
        noise=tuple(noise.tolist()),
        labels=evidence.chart.labels,
        units=evidence.chart.units,
        reduced=(fitted.alone.cost.reduced, fitted.rest.cost.reduced),
        ranking=_ranking(naming.attempts),
        residuals=residual_pictures(setting, before, after, 2 if naming.gap else 0),
        courses=courses(evidence, checked.held, base, best),
        cannot_judge=tuple(p.key for p in naming.first.silent),
        rollout_seconds=checked.held.seconds,
        window=evidence.windows.length,
        simulated_transitions=twin.simulated_transitions,
        seconds=time.perf_counter() - started,
        backend=problem.config.backend,
        seed=problem.config.seed,
        notes=tuple(_notes(setting, naming, skill, len(scene.train))),
        skill=skill,
        remaining=remaining,
        refused=naming.refused,
        unfinished=naming.unfinished,
        own_step=fitted.own_step,
        lasting=naming.lasting and not naming.gap,
        joints=joint_names(setting) if naming.family else {},
        left_out=_left_out(setting, naming.left_out),
        symbolic=describe(setting, before, guilty(before), rules.shown) if naming.gap and not naming.named else "",
    )


def with_forces(scene: Scene, gap: Gap, view: ForceView) -> Gap:
    """Put what the forces at the joints say in the place of what predictions said, and score it as everything is.

    Args:
        scene: what the search worked on.
        gap: a result by predictions.
        view: what the forces say, with names.
    """
    setting, evidence = scene.setting, scene.evidence
    model, hypothesis = setting.model, scene.begin.with_effects(view.placed)
    held = cut_held(evidence, scene.held, hypothesis)
    chi2 = [refit(evidence, h, iterations=0, slopes=False).cost.reduced for h in (scene.begin, hypothesis)]
    named = []
    for placed, halves, share, tied in zip(view.placed, view.halves, view.shares, view.ties, strict=True):
        named.append(NamedEffect.of(placed, _strengths(setting, placed, halves), share, tied))
    kinds = {n: max(e.share_of_gap for e in named if e.effect == n) for n in {e.effect for e in named}}
    after_score, constant = score(evidence, held, hypothesis), constant_velocity(evidence, held.rollouts)
    skill = has_skill(after_score, gap.noise_floor, constant, scene.rules.sound)
    left = zip(dof_names(model), view.before.tolist(), view.after.tolist(), strict=True)
    return replace(
        gap,
        effects=merge_families(tuple(sorted(named, key=lambda e: -kinds[e.effect])), setting),
        before=score(evidence, held, scene.begin),
        after=after_score,
        declared={n: (given, alone, given) for n, (given, alone, _) in gap.declared.items()},
        reduced=(chi2[0], chi2[1]),
        residuals=_force_pictures(setting, view),
        courses=(),
        simulated_transitions=scene.twin.simulated_transitions,
        refused="",
        symbolic="",
        remaining=None,
        own_step=None,
        joints={},
        left_out=_left_out(setting, view.left_out),
        fitted={},
        next_experiment=None,
        notes=(
            f"Constant velocity has an open-loop error of {constant:.3g} on held-out data, the model with the effects "
            f"{after_score.rollout_rmse:.3g}: {'it has' if skill else 'not even then has it'} skill.",
        ),
        forces=tuple(JointForce(j, force_unit(model, dof), b, a) for dof, (j, b, a) in enumerate(left)),
    )


def _force_pictures(setting: Setting, view: ForceView) -> tuple[Residuals, ...]:
    """The forces that a simulation would need besides, where most is explained, against the joints' velocity."""
    gained = 1 - view.after / np.maximum(view.before, 1e-300)
    return tuple(
        Residuals(
            f"Missing force at {dof_names(setting.model)[dof]}, on held-out data",
            f"velocity ({'m/s' if force_unit(setting.model, dof) == 'N' else 'rad/s'})", force_unit(setting.model, dof),
            view.velocity[:, dof], -view.missing[:, dof], -view.left[:, dof],
        )
        for dof in np.argsort(-gained)[:PICTURES].tolist()
    )  # fmt: skip


def _last_fit(evidence: Evidence, short: Windows | None, hypothesis: Hypothesis, end: float) -> _Last:
    """Fit the named effects on all windows, as they are weighted and stepped in the end.

    And as noise alone weighs them, the misfit that they have so with the model's own step, and the weights.

    Where the model's own error and not the noise decides, each residual weighs by its own size over the windows: the
    error of a real model grows with the lead, and differs between columns. The noise is told once more, by all windows
    and beside a finer step where that is better, for what the model's own step leaves passes for noise. After the
    ``end``, better starts of windows are not looked for, and weights are found once.
    """
    own = refit(evidence, hypothesis, iterations=6)
    if time.monotonic() < end:
        evidence, own = _straight(evidence, own)
    final = resolved(evidence, own, anew=True)
    noise = noise_beside(final.evidence, short, final.fit)
    if moved(noise, evidence.noise, evidence.rules):
        evidence = replace(evidence, noise=noise)
        own = refit(evidence, own.hypothesis, iterations=2)
        final = resolved(evidence, own, anew=True)
    rest, with_own_step = final.fit, own.cost
    for _ in range(ROUNDS):
        weighed = rest is not final.fit
        if final.fit.cost.reduced < evidence.rules.sound.model_error or (weighed and time.monotonic() > end):
            break
        size = np.sqrt(np.median(final.fit.residual**2, axis=0) / MEDIAN) * evidence.model_error
        lead = size.reshape(-1, evidence.chart.size)
        smooth = np.maximum(np.maximum.accumulate(lead, axis=0), 1.0)
        smooth[0] = 1.0
        evidence = replace(evidence, model_error=smooth.ravel())
        own = refit(evidence, own.hypothesis, iterations=6)
        final = resolved(evidence, own, anew=True)
    return final, rest, with_own_step, evidence


def _as_weighed(weighed: Evidence, hypothesis: Hypothesis) -> _Last:
    """The last fit with the weights that one of more effects has found."""
    own = refit(weighed, hypothesis, iterations=6)
    final = resolved(weighed, own, anew=True)
    stepped, plain = (
        refit(replace(e, model_error=np.ones_like(e.model_error)), f.hypothesis, iterations=0, slopes=False)
        for e, f in ((final.evidence, final.fit), (weighed, own))
    )
    return final, stepped, plain.cost, weighed


def _straight(evidence: Evidence, own: Refit) -> tuple[Evidence, Refit]:
    """Windows that begin where they fit best, and the fit on them, if that leaves nothing where something is left."""
    if not significant(own.cost, evidence.rules) or not _helps_the_worst(evidence, own):
        return evidence, own
    if (windows := straightened(evidence, own.hypothesis.variant)) is None:
        return evidence, own
    straight = replace(evidence, windows=windows)
    there = refit(straight, own.hypothesis, iterations=6)
    return (evidence, own) if significant(there.cost, evidence.rules) else (straight, there)


def _helps_the_worst(evidence: Evidence, own: Refit) -> bool:
    """Return whether better starts take much of the misfit of the windows that have the most."""
    few = evidence.select(np.sort(np.argsort(-own.cost.windows)[:WORST]))
    if (windows := straightened(few, own.hypothesis.variant)) is None:
        return False
    here = refit(few, own.hypothesis, iterations=0, slopes=False).cost
    there = refit(replace(few, windows=windows), own.hypothesis, iterations=6, slopes=False).cost
    return there.left_of(here) <= NEARER


def _without_names(naming: Naming, why: str, after: Score, rival: float) -> Naming:
    """What was found, without names: with them, open loop on unseen data is no better than a rival's."""
    names = _names_of(naming.final.hypothesis.placed)
    if naming.family:
        names = "friction, inertia, offset and delay of all joints"
    sizes = f"open loop {after.rollout_rmse:.3g} against {rival:.3g}"
    return _nameless(naming, f"with {names}, which would account for most of the misfit, {why} ({sizes})")


def _names_of(placed: Sequence[Placed]) -> str:
    """Effects and their places, as a sentence has them."""
    return " and ".join(p.effect.name.replace("_", " ") + (f" of {p.target}" if p.target else "") for p in placed)


def _spared(naming: Naming, absurd: Sequence[tuple[Placed, str]]) -> Naming:
    """What was found without what is at a bound of physics: a family without these members, other names not at all."""
    out = {placed.key for placed, _ in absurd}
    kept = [k for k, p in enumerate(naming.final.hypothesis.placed) if p.key not in out]
    return _keeping(naming, kept) if naming.family and kept else _nameless(naming, absurd[0][1])


def _keeping(naming: Naming, kept: Sequence[int], near: Hypothesis | None = None) -> Naming:
    """What was found, with some of its names only; ``near`` that, with all of them, is the best fit already."""
    hypothesis = near or naming.final.hypothesis
    rest = replace(hypothesis, placed=tuple(hypothesis.placed[k] for k in kept))
    ties, shares = tuple(naming.ties[k] for k in kept), tuple(naming.shares[k] for k in kept)
    faint = tuple(n for n, k in enumerate(kept) if k in naming.faint)
    final = refit(naming.evidence, rest, iterations=6 if near is None else 1, slopes=False)
    return replace(naming, final=final, ties=ties, shares=shares, faint=faint)


def _without_unsure(setting: Setting, naming: Naming, fitted: _Fitted, rules: Rules) -> Naming | None:
    """What was found without names that may as well be absent: one, or of a family all, in turn; else ``None``.

    What remains that noise does not make is alike from row to row. It widens intervals, by which an effect of one
    number may be nothing that misfit alone takes for needed. Of two members of a family that do the same, one stays,
    and what all joints have, each does.
    """
    assert fitted.last is not None
    placed, family, idle = fitted.last.fit.hypothesis.placed, naming.family, list[int]()
    least, edge = rules.family.sure if family else 1.0, rules.sound.edge
    spared = {k for k, p in enumerate(placed) if p.key in naming.everywhere and not is_absent(setting, p, edge)}
    while len(idle) < len(placed) - 1:
        sure = {k: s for k, s in _sureness(setting, fitted, idle).items() if s < least and k not in spared}
        if not sure or (idle and not family):
            break
        idle.append(min(sure, key=sure.__getitem__))
    if not idle:
        return None
    if family:  # a slope of friction that is left without friction goes with it
        rest = replace(naming.final.hypothesis, placed=tuple(p for k, p in enumerate(placed) if k not in idle))
        lone = [p.key for p in pushing(setting, rest)]
        idle += [k for k, p in enumerate(placed) if p.key in lone]
        if len(idle) == len(placed):
            return _nameless(naming, NOTHING_SURE)
    kept = [k for k in range(len(placed)) if k not in idle]
    found = _keeping(naming, kept, fitted.last.fit.hypothesis)
    allowed = [(placed[k], fitted.of_names[k]) for k in idle if family]
    return replace(found, left_out=(*found.left_out, *allowed))


def _sureness(setting: Setting, fitted: _Fitted, gone: Sequence[int]) -> dict[int, float]:
    """By how many half-widths of its interval each name of one number differs from none, without some others.

    To first order, by the derivatives of the last fit; none of names that are a choice, or of which nothing is known.
    """
    assert fitted.last is not None
    last, found, first = fitted.last, dict[int, float](), len(fitted.last.fit.hypothesis.declared)
    sizes = [len(p.values) for p in last.fit.hypothesis.placed]
    starts = first + np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    out = [n for k in gone for n in range(starts[k], starts[k + 1])]
    off, halves = offsets(setting, last.fit) * last.fit.scale, fitted.halves
    if out:
        off, halves = _beside_fewer(last, off, np.array(out))
    for index, p in enumerate(last.fit.hypothesis.placed):
        quantity, *more = p.effect.quantities(setting, p.target)
        at = starts[index]
        if index not in gone and np.isfinite(halves[at]) and not (more or quantity.discrete or p.effect.steps):
            found[index] = abs(float(off[at])) / max(float(halves[at]), 1e-300)
    return found


def _beside_fewer(last: Resolved, off: np.ndarray, out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets from none and half-widths ``(q,)`` of all numbers of a fit, where some are none; 0 of these."""
    rest = np.setdiff1d(np.arange(len(off)), out)
    slope, scale = last.fit.weighted(1.0)[0], last.fit.scale
    moved = np.linalg.lstsq(slope[rest].T, slope[out].T @ (off[out] / scale[out]), rcond=1e-12)[0] * scale[rest]
    fewer = replace(last.fit, slope=last.fit.slope[rest], scale=scale[rest])
    errors = Z90 * standard_errors(fewer, last.evidence.windows.episodes)
    offsets_there, halves = np.zeros(len(off)), np.zeros(len(off))
    offsets_there[rest], halves[rest] = off[rest] + moved, np.hypot(errors, last.error[rest])
    return offsets_there, halves


def _nameless(naming: Naming, reason: str) -> Naming:
    """What was found, without names, for a reason."""
    return replace(
        naming, final=naming.base, named=False, ties=(), shares=(), left_out=(), partial=False, refused=reason
    )


def _remaining(
    setting: Setting, naming: Naming, base: Cost, rest: Refit, after: FreeForces, astray: float, rules: Rules
) -> Remaining | None:
    """What the named effects leave, if it is more than noise; what only the step of the model leaves is no part."""
    cost, typical = rest.cost, rest.typical
    if not naming.partial and not remains(cost, rules) and not astray > rules.sound.astray:
        return None
    dof = guilty(after)
    share = float(np.clip(cost.left_of(base) * base.degrees / cost.degrees, 0, 1))
    off = float(np.mean(typical > rules.sound.rest))
    when = told_when(setting, after, dof, rules.shown)
    return Remaining(cost.reduced, share, off, dof_names(setting.model)[dof], when, astray)


def _own_step(own: Cost, best: Cost, rules: Rules) -> tuple[float, float] | None:
    """χ² per degree of freedom with the model's own step and with the best one, where that step is all that remains."""
    return (own.reduced, best.reduced) if remains(own, rules) and not remains(best, rules) else None


def _notes(setting: Setting, naming: Naming, skill: bool, transitions: int) -> Iterator[str]:
    """What a person should know besides; ``skill`` is that of the model as it is, on a log of so many transitions."""
    names, windows = dof_names(setting.model), naming.evidence.windows
    if (compared := len(windows) * windows.length) < SPARSE * transitions:
        yield (
            f"The log has more than the search needs: of {transitions:,} transitions, {compared:,} were compared, "
            f"{len(windows)} windows of {windows.length} spread over all of it."
        )
    still = [name for name, speed in zip(names, setting.signals.speed, strict=True) if speed <= 0]
    if naming.unfinished:
        yield (
            f"The time for the search was over ({naming.unfinished}): not everything was tried. "
            "--resume with a longer --time-limit goes on."
        )
    if naming.named and naming.faint:
        faint = _names_of([naming.final.hypothesis.placed[k] for k in naming.faint])
        yield (
            f"Without {faint}, the residuals as a whole would look like noise, too: only along the "
            "direction in which that changes the motion is there more than chance makes (a likelihood ratio)."
        )
    if still:
        yield f"No velocity of {', '.join(still)} is in this log: effects there cannot be judged."
    if naming.gap and not naming.named and not skill:
        yield "The model predicts unseen data no better than constant velocity does: it has no skill on this log."


def _unnamed(setting: Setting, free: FreeForces) -> NamedEffect:
    """What has no name, where its force stands out most."""
    dof = guilty(free)
    force = float(np.sqrt(np.nanmean(free.forces[:, dof] ** 2)))
    words, name = told_when(setting, free, dof), dof_names(setting.model)[dof]
    strength = Strength(force, float("nan"), float("nan"), force_unit(setting.model, dof))
    text = f"something without a name, at {name}" + (f", {words}" if words else "")
    return NamedEffect("unnamed", name, {"force": strength}, 1.0, (), text)


def _named(setting: Setting, naming: Naming, fitted: _Fitted) -> tuple[NamedEffect, ...]:
    """The named effects, the strongest first."""
    placed_all, found = fitted.final.hypothesis.placed, []
    for placed, halves, tied, excess in zip(placed_all, fitted.of_names, naming.ties, naming.shares, strict=True):
        numbers = _strengths(setting, placed, halves)
        share = float(np.clip(excess / naming.base.cost.above(naming.final.cost), 0, 1))
        found.append(NamedEffect.of(placed, numbers, share, tied))
    return merge_families(tuple(sorted(found, key=lambda e: -e.share_of_gap)), setting)


def _fitted(
    space: ParameterSpace, evidence: Evidence, hypothesis: Hypothesis, fitted: _Fitted
) -> Mapping[str, Strength]:
    """The declared parameters beside what was named, with their intervals."""
    if not len(space):
        return {}
    halves = fitted.halves
    if fitted.last is None:
        nothing = Resolved(refit(evidence, hypothesis, iterations=0), evidence, np.zeros(len(hypothesis.vector)))
        halves = half_widths(nothing)
    bounds = zip(space.parameters, hypothesis.declared, halves, space.low, space.high, strict=False)
    return {
        p.name: Strength(value, max(value - half, float(low)), min(value + half, float(high)), p.unit)
        for p, value, half, low, high in bounds
    }


def _left_out(setting: Setting, allowed: Iterable[tuple[Placed, np.ndarray]]) -> tuple[LeftOut, ...]:
    """What was not needed, by how large it may be all the same."""
    return tuple(LeftOut(*placed.key, _strengths(setting, placed, halves)) for placed, halves in allowed)


def _strengths(setting: Setting, placed: Placed, halves: Sequence[float] | np.ndarray) -> Mapping[str, Strength]:
    """The numbers of an effect with their intervals, by the half-widths of these."""
    found = zip(placed.effect.quantities(setting, placed.target), placed.values, halves, strict=True)
    return {q.name: _strength(q, value, float(half)) for q, value, half in found}


def _strength(quantity: Quantity, value: float, half: float) -> Strength:
    """A number with its interval, cut at its bounds; a discrete one has none."""
    if quantity.discrete:
        return Strength(value, float("nan"), float("nan"), quantity.unit)
    return Strength(value, max(value - half, quantity.low), min(value + half, quantity.high), quantity.unit)


def merge_families(effects: tuple[NamedEffect, ...], setting: Setting) -> tuple[NamedEffect, ...]:
    """Return effects that were named at every one of three or more targets as one, with target ``*``."""
    kept = list(effects)
    for name, variant in dict.fromkeys((e.effect, e.variant) for e in effects):
        members = [e for e in kept if (e.effect, e.variant) == (name, variant) and len(e.parameters) == 1]
        effect = VOCABULARY.get(variant or name)
        if effect is None or len(members) < max(3, len(effect.targets(setting))):
            continue
        numbers = {str(e.target): next(iter(e.parameters.values())) for e in members}
        share = min(1.0, sum(e.share_of_gap for e in members))
        sentence = effect.sentence.format(target=all_of(effect.kind))
        ties = tuple(dict.fromkeys(tie for e in members for tie in e.indistinguishable_from))
        whole = NamedEffect(name, FAMILY, numbers, share, ties, sentence, variant)
        kept = [whole if e is members[0] else e for e in kept if e not in members[1:]]
    return tuple(kept)


def _next_experiment(naming: Naming, final: Refit, report: Report, end: float) -> str | None:
    """What motion would tell tied effects apart, the first that are told so, or would show what this log cannot."""
    rivals: list[tuple[int, Placed]] = [(i, other) for i, tied in enumerate(naming.ties) for other in tied]
    if not rivals or time.monotonic() > end:
        return excite(naming.first.silent)
    best, said = final.hypothesis, ""
    rivals = rivals[: 1 if naming.family else RIVALS]
    for number, (index, other) in enumerate(rivals):
        report("proposing a motion", number / len(rivals))
        advice = suggest(naming.evidence, best, best.instead(index, other), best.placed[index], other)
        if advice.tells:
            return advice.sentence
        said = said or advice.sentence
    return said


def _ranking(attempts: Iterable[Ranked]) -> tuple[Ranked, ...]:
    """The best attempt of every candidate in every round, alone and together with others."""
    best: dict[tuple[int, str, str | None, tuple[tuple[str, str | None], ...]], Ranked] = {}
    for tried in attempts:
        key = (tried.round, tried.effect, tried.target, tried.together)
        best[key] = min(best.get(key, tried), tried, key=lambda r: r.left)
    return tuple(sorted(best.values(), key=lambda r: (r.round, r.left)))
