"""The whole workflow: locate, name, and verify on held-out data."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.effects import VOCABULARY, Effect
from dropo_torch.effects.base import Setting
from dropo_torch.effects.twin import Twin, Windows
from dropo_torch.errors import InputError
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.intervals import deviations
from dropo_torch.gap.locate import dof_names, guilty, places, regime, residual_pictures
from dropo_torch.gap.log import Chart, cut_windows, make_setting, start_values
from dropo_torch.gap.naming import Naming, Report, Rules, Search
from dropo_torch.gap.noise import LENGTH, FreeForces, free_forces
from dropo_torch.gap.refit import Hypothesis, Refit, refit
from dropo_torch.gap.result import Gap, NamedEffect, Ranked, Strength
from dropo_torch.gap.suggest import excite, suggest
from dropo_torch.gap.symbolic import describe
from dropo_torch.gap.verify import Held, constant_velocity, cut_held, floor_score, hold_out, score, spread
from dropo_torch.observation import joint_name
from dropo_torch.problem import Problem
from dropo_torch.trajectory import Trajectories

#: Logged steps of a window that are tried, the longest first, and the roughness that ends the search.
LENGTHS = (30, 15, 8, 4)
ROUGH = 0.03
#: Roughness from which on windows are linearised statistically.
BENT = 0.001
#: Typical error at a window's end, relative to the motion, from which on contacts come at other times than measured.
FAR_OFF = 0.08
#: Windows of the last fit, at most, and short ones for the noise.
MOST, SHORT = 120, 160
#: Half-width of a 90 % interval in standard errors.
Z90 = 1.6449


@dataclass(frozen=True)
class Scene:
    """What a search works on: made once from a problem by :func:`prepare`.

    Attributes:
        problem: the config's model, parameters and log.
        setting: the model, its columns, the sizes of the log.
        twin: simulates windows.
        train, held: the log's two parts.
        noise: standard deviation of each feature, ``(m,)``.
        evidence: all windows of the training part.
        begin: the declared parameters as given.
    """

    problem: Problem
    setting: Setting
    twin: Twin
    train: Trajectories
    held: Trajectories
    noise: np.ndarray
    evidence: Evidence
    begin: Hypothesis


def prepare(problem: Problem) -> Scene:
    """Cut the log, estimate its noise, and choose windows.

    Raises:
        InputError: a simulator without a MuJoCo model; a log too short to judge anything.
    """
    if problem.space.model is None or problem.observation.size == 0:
        raise InputError("gap: this simulator is no MuJoCo model; effects can only be looked for in one")
    _check_observed(problem)
    train, held = hold_out(problem.trajectories)
    setting = make_setting(problem, train)
    twin = Twin(
        setting, problem.space, num_threads=problem.config.threads, warp=problem.config.backend == "warp",
        standing=None if problem.effects is None else problem.effects.at,
    )  # fmt: skip
    begin = Hypothesis(tuple(float(v) for v in start_values(problem)))
    noise = _noise(problem, twin, train, begin)
    length, rough = _choose_window(twin, train, begin, noise)
    windows = spread(cut_windows(train, problem.observation, length), MOST)
    return Scene(problem, setting, twin, train, held, noise, Evidence(twin, windows, noise, rough=rough), begin)


def _check_observed(problem: Problem) -> None:
    """A window needs its start: where a position is observed, its velocity must be, too."""
    model, columns = problem.space.model, set(problem.observation.columns)
    assert model is not None
    for joint in range(model.njnt):
        width = {0: (7, 6), 1: (4, 3)}.get(int(model.jnt_type[joint]), (1, 1))
        positions = range(int(model.jnt_qposadr[joint]), int(model.jnt_qposadr[joint]) + width[0])
        velocities = range(int(model.jnt_dofadr[joint]), int(model.jnt_dofadr[joint]) + width[1])
        missing = [v for v in velocities if model.nq + v not in columns]
        if columns.intersection(positions) and missing:
            raise InputError(
                f"gap: the velocity of {joint_name(model, joint)} is not observed; derive velocities from positions "
                "(data: preprocess), and name them in observation"
            )


def _noise(problem: Problem, twin: Twin, train: Trajectories, begin: Hypothesis) -> np.ndarray:
    """The noise of each feature, as given or estimated."""
    chart = Chart.of(problem.observation)
    if problem.objective.noise is not None:
        given = problem.objective.noise.numpy()
        plain = given[list(chart.plain)]
        turned = [np.repeat(2 * given[list(q)].mean(), 3) for q in chart.quaternions]
        return np.concatenate([plain, *turned])
    return free_forces(twin, _short(problem, train), begin.variant).noise


def _short(problem: Problem, log: Trajectories) -> Windows:
    windows = spread(cut_windows(log, problem.observation, LENGTH), SHORT)
    if len(windows) < 5:
        raise InputError(
            f"data: {log.source} has {len(windows)} stretches of {LENGTH} steps; expected at least 5, "
            "longer episodes or more of them"
        )
    return windows


def _choose_window(twin: Twin, train: Trajectories, begin: Hypothesis, noise: np.ndarray) -> tuple[int, bool]:
    """The longest window over which the simulation is still nearly linear in its start, and whether it is rough."""
    longest = int(np.diff(np.append(-1, np.flatnonzero(train.terminals))).max())
    touches = bool(twin.setting.signals.contacts.any())
    for length in LENGTHS:
        if length > longest:
            continue
        windows = spread(cut_windows(train, twin.setting.observation, length), 24)
        evidence = Evidence(twin, windows, noise, rough=True)
        rough = evidence.linearise(begin.variant).roughness
        if rough < ROUGH and (not touches or _end_error(evidence, begin) < FAR_OFF):
            return length, rough > BENT
    return min(LENGTHS[-1], longest), True


def _end_error(evidence: Evidence, begin: Hypothesis) -> float:
    """Typical error at the windows' ends, relative to the motion's own deviation; the median over features."""
    found, _ = evidence.residuals([begin.variant])
    end = found[0, :, -evidence.chart.size :] * evidence.noise
    measured = evidence.windows.measured
    size = evidence.chart.difference(measured[:, 0], np.broadcast_to(measured[:1, 0], measured[:, 0].shape)).std(0)
    return float(np.median(np.nanmedian(np.abs(end), axis=0) / np.maximum(size, 1e-12)))


def find_gap(
    problem: Problem,
    *,
    effects: Sequence[Effect] | None = None,
    rules: Rules | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    report: Report = lambda stage, share: None,
    scene: Scene | None = None,
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

    Raises:
        InputError: a log or simulator in which nothing can be looked for.
    """
    started = time.perf_counter()
    rules = rules or Rules()
    report("preparing", 0.0)
    scene = scene or prepare(problem)
    vocabulary = list(effects or VOCABULARY.values())
    search = Search(
        scene.evidence, vocabulary, rules=rules, report=report, checkpoint=checkpoint, resume=resume,
        fingerprint=f"{problem.fingerprint} {rules} {[e.name for e in vocabulary]}",
    )  # fmt: skip
    naming = search.run(scene.begin)
    shorter = _shorter(scene)
    if naming.gap and not naming.named and shorter is not None:
        second = Search(shorter, vocabulary, rules=rules, report=report)
        found = second.run(scene.begin)
        if found.named:
            search, naming = second, found
    report("verifying", 0.0)
    return _result(scene, search, naming, started)


def _shorter(scene: Scene) -> Evidence | None:
    """Windows a quarter as long, in which a large gap bends the simulation less; ``None`` if they are short."""
    length = scene.evidence.windows.length // 4
    if length < LENGTHS[-1]:
        return None
    windows = spread(cut_windows(scene.train, scene.problem.observation, length), MOST)
    return Evidence(scene.twin, windows, scene.noise, rough=scene.evidence.rough)


def _result(scene: Scene, search: Search, naming: Naming, started: float) -> Gap:
    problem, twin = scene.problem, scene.twin
    noise = search.evidence.noise
    final = naming.final
    if naming.named:
        final = _last_fit(search.evidence, naming.final.hypothesis)
    short = _short(problem, scene.train)
    before = free_forces(twin, short, naming.base.hypothesis.variant, noise)
    after = free_forces(twin, short, final.hypothesis.variant, noise) if naming.named else before
    evidence = search.evidence
    held = cut_held(twin, scene.held, problem.observation, final.hypothesis, noise, scene.setting.signals.timestep)
    shown = _named(scene, naming, final, before) if naming.gap else ()
    dofs = _telling(scene.setting, shown, before) if naming.gap else []
    return Gap(
        where=places(scene.setting, before, search.first, search.first_chi2, search.first_degrees)
        if naming.gap
        else (),
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
        notes=_notes(scene, evidence, held, final.hypothesis),
        symbolic=describe(scene.setting, before, guilty(before)) if naming.gap and not naming.named else "",
    )


def _last_fit(evidence: Evidence, hypothesis: Hypothesis) -> Refit:
    """Fit the named effects on all windows.

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
    return final


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


def _named(scene: Scene, naming: Naming, final: Refit, free: FreeForces) -> tuple[NamedEffect, ...]:
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
    errors = deviations(final, scene.evidence.windows.episodes)
    position, found = len(final.hypothesis.declared), []
    excess = naming.base.cost.excess
    for index, placed in enumerate(final.hypothesis.placed):
        quantities = placed.effect.quantities(setting, placed.target)
        numbers = {}
        for i, (q, value) in enumerate(zip(quantities, placed.values, strict=True)):
            half = Z90 * errors[position + i]
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
        whole = NamedEffect(name, "*", numbers, share, (), effect.sentence.format(target=f"all {where}"))
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
