"""From what a search found to the result that people and programs read."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from dropo_torch.effects import VOCABULARY
from dropo_torch.effects.base import Setting
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.intervals import deviations, step_errors
from dropo_torch.gap.locate import dof_names, guilty, places, regime, residual_pictures
from dropo_torch.gap.naming import Naming, Search
from dropo_torch.gap.noise import FreeForces, free_forces
from dropo_torch.gap.refit import Hypothesis, Refit, refit
from dropo_torch.gap.result import FAMILY, Gap, NamedEffect, Place, Ranked, Strength
from dropo_torch.gap.rules import FAR_OFF
from dropo_torch.gap.scene import Scene, short_windows
from dropo_torch.gap.suggest import excite, suggest
from dropo_torch.gap.symbolic import describe
from dropo_torch.gap.verify import Held, constant_velocity, cut_held, floor_score, score

#: Half-width of a 90 % interval in standard errors.
Z90 = 1.6449


def make_result(scene: Scene, search: Search, naming: Naming, started: float) -> Gap:
    """Fit what was named on all windows, score it on held-out data, and put everything together.

    Args:
        scene: what the search worked on.
        search: the search, after its run.
        naming: what it found.
        started: when it began, by ``time.perf_counter``.
    """
    problem, twin = scene.problem, scene.twin
    noise = search.evidence.noise
    final, weighted = naming.final, search.evidence
    if naming.named:
        final, weighted = _last_fit(search.evidence, naming.final.hypothesis)
    short = short_windows(problem, scene.train)
    before = free_forces(twin, short, naming.base.hypothesis.variant, noise)
    after = free_forces(twin, short, final.hypothesis.variant, noise) if naming.named else before
    evidence = search.evidence
    held = cut_held(twin, scene.held, problem.observation, final.hypothesis, noise, scene.setting.signals.timestep)
    shown = _named(scene, naming, final, before, weighted) if naming.gap else ()
    dofs = _telling(scene.setting, shown, before) if naming.gap else []
    return Gap(
        where=found_places(scene, search, before) if naming.gap else (),
        effects=shown,
        before=score(evidence, held, naming.base.hypothesis),
        after=score(evidence, held, final.hypothesis if naming.named else naming.base.hypothesis),
        noise_floor=floor_score(evidence, held, final.hypothesis if naming.named else naming.base.hypothesis),
        next_experiment=_next_experiment(scene, search, naming, final),
        found=naming.gap,
        declared=_declared(scene, naming, final),
        noise=tuple(noise.tolist()),
        labels=evidence.chart.labels,
        units=evidence.chart.units,
        reduced=(naming.base.cost.reduced, naming.final.cost.reduced),
        ranking=_ranking(scene.setting, naming),
        residuals=residual_pictures(scene.setting, before, after, dofs),
        cannot_judge=naming.silent,
        rollout_seconds=held.seconds,
        window=evidence.windows.length,
        simulated_transitions=twin.simulated_transitions,
        seconds=time.perf_counter() - started,
        backend=problem.config.backend,
        seed=problem.config.seed,
        notes=(
            *_rest(naming, final, dof_names(scene.setting.model)[guilty(after)]),
            *_notes(scene, evidence, held, final.hypothesis),
        ),
        symbolic=describe(scene.setting, before, guilty(before)) if naming.gap and not naming.named else "",
    )


def found_places(scene: Scene, search: Search, free: FreeForces) -> tuple[Place, ...]:
    """Return where a change could explain the gap, by the search's first screening."""
    return places(scene.setting, free, search.first, search.first_chi2, search.first_degrees)


def _last_fit(evidence: Evidence, hypothesis: Hypothesis) -> tuple[Refit, Evidence]:
    """Fit the named effects on all windows; return with it the evidence as it was weighted.

    Where the model's own error and not the noise decides, each residual weighs by its own size over the windows: the
    error of a real model grows with the lead, and differs between columns.
    """
    final = refit(evidence, hypothesis, iterations=6)
    for _ in range(3):
        if final.cost.reduced < 3:
            break
        size = np.sqrt(np.median(final.residual**2, axis=0) / 0.455) * evidence.model_error
        lead = size.reshape(-1, evidence.chart.size)
        smooth = np.maximum(np.maximum.accumulate(lead, axis=0), 1.0)
        smooth[0] = 1.0
        evidence = evidence.with_model_error(smooth.ravel())
        final = refit(evidence, final.hypothesis, iterations=6)
    return final, evidence


def _rest(naming: Naming, final: Refit, where: str) -> tuple[str, ...]:
    """What a partial explanation leaves."""
    if not naming.partial:
        return ()
    chi2 = (final.residual**2).sum(-1) * len(final.residual) / final.cost.degrees
    share = float(np.mean(chi2 > FAR_OFF))
    return (
        f"This leaves no more than noise in most of the log; in {100 * share:.0f} % of the windows something else "
        f"remains, which none of the known effects explains, mostly at {where}.",
    )


def _notes(scene: Scene, evidence: Evidence, held: Held, hypothesis: Hypothesis) -> tuple[str, ...]:
    """What a person should know before trusting the result."""
    notes = []
    still = [
        name
        for name, speed in zip(dof_names(scene.setting.model), scene.setting.signals.speed, strict=True)
        if speed <= 0
    ]
    if still:
        notes.append(f"No velocity of {', '.join(still)} is in this log: effects there cannot be judged.")
    simulated = score(evidence, held, hypothesis).rollout_rmse
    constant = constant_velocity(evidence, held)
    if simulated > constant:
        notes.append(
            f"The model predicts worse than constant velocity does (open loop {simulated:.3g} against {constant:.3g}): "
            "it has no skill on this log, and names should not be trusted."
        )
    return tuple(notes)


def _declared(scene: Scene, naming: Naming, final: Refit) -> Mapping[str, tuple[float, float, float]]:
    rows = zip(
        scene.problem.space.names, scene.begin.declared, naming.base.hypothesis.declared, final.hypothesis.declared,
        strict=True,
    )  # fmt: skip
    return {n: (a, b, c) for n, a, b, c in rows}


def _named(scene: Scene, naming: Naming, final: Refit, free: FreeForces, evidence: Evidence) -> tuple[NamedEffect, ...]:
    """The named effects, the strongest first; or the one that has no name."""
    setting = scene.setting
    if not naming.named:
        dof = guilty(free)
        force = float(np.sqrt(np.nanmean(free.forces[:, dof] ** 2)))
        words = regime(setting, free, dof)[0]
        name = dof_names(setting.model)[dof]
        slides = setting.model.jnt_type[setting.model.dof_jntid[dof]] == mujoco.mjtJoint.mjJNT_SLIDE
        strength = {"force": Strength(force, float("nan"), float("nan"), "N" if slides else "N·m")}
        text = f"something that no known effect explains, at {name}" + (f", {words}" if words else "")
        return (NamedEffect("unnamed", name, strength, 1.0, (), text),)
    errors = deviations(final, evidence.windows.episodes)
    biases = step_errors(evidence, final)
    position, found = len(final.hypothesis.declared), []
    excess = naming.base.cost.excess
    for index, placed in enumerate(final.hypothesis.placed):
        quantities = placed.effect.quantities(setting, placed.target)
        numbers = {}
        for i, (q, value) in enumerate(zip(quantities, placed.values, strict=True)):
            half = Z90 * errors[position + i] + biases[position + i]
            numbers[q.name] = Strength(value, max(value - half, q.low), min(value + half, q.high), q.unit)
        position += len(placed.values)
        share = naming.shares[index] / excess if naming.shares else 1.0
        ties = tuple(p.key for p in naming.ties[index])
        sentence = placed.effect.sentence.format(target=placed.target)
        found.append(
            NamedEffect(placed.effect.name, placed.target, numbers, float(np.clip(share, 0, 1)), ties, sentence)
        )
    return merge_families(tuple(sorted(found, key=lambda e: -e.share_of_gap)), setting)


def merge_families(effects: tuple[NamedEffect, ...], setting: Setting) -> tuple[NamedEffect, ...]:
    """Return effects that were named at every one of three or more targets as one, with target ``*``."""
    kept = list(effects)
    for name in dict.fromkeys(e.effect for e in effects):
        members = [e for e in kept if e.effect == name and len(e.parameters) == 1]
        effect = VOCABULARY.get(name)
        if effect is None or len(members) < 3 or len(members) < len(effect.targets(setting)):
            continue
        numbers = {str(e.target): next(iter(e.parameters.values())) for e in members}
        share = min(1.0, sum(e.share_of_gap for e in members))
        where = effect.kind + "s"
        whole = NamedEffect(name, FAMILY, numbers, share, (), effect.sentence.format(target=f"all {where}"))
        kept = [whole if e is members[0] else e for e in kept if e not in members[1:]]
    return tuple(kept)


def _telling(setting: Setting, shown: Sequence[NamedEffect], free: FreeForces) -> list[int]:
    """Degrees of freedom whose missing forces are shown: the guilty one first."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.nan_to_num(np.nanmedian(np.abs(free.forces) / free.errors, axis=0))
    order = list(np.argsort(-ratio))
    return [int(d) for d in order[: min(2, len(order))]]


def _next_experiment(scene: Scene, search: Search, naming: Naming, final: Refit) -> str | None:
    """What motion would tell tied effects apart, or would show what this log cannot."""
    for index, tied in enumerate(naming.ties):
        for other in tied:
            placed = list(final.hypothesis.placed)
            rival = Hypothesis(final.hypothesis.declared, (*placed[:index], other, *placed[index + 1 :]))
            return suggest(search.evidence, final.hypothesis, rival, placed[index], other)
    return excite(naming.silent)


def _ranking(setting: Setting, naming: Naming) -> tuple[Ranked, ...]:
    best: dict[tuple[int, str, str | None], Ranked] = {}
    for t in naming.trials:
        left = max(t.excess, 0.0) / max(t.before, 1e-12)
        entry = Ranked(t.placed.effect.name, t.placed.target, t.placed.summary(setting), left, t.round)
        key = (t.round, entry.effect, entry.target)
        if key not in best or best[key].left > left:
            best[key] = entry
    return tuple(sorted(best.values(), key=lambda r: (r.round, r.left)))
