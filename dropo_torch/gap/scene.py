"""What a search works on: the log's two parts, its noise, and windows over which the simulation can be trusted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from dropo_torch.data.features import Features
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects import VOCABULARY
from dropo_torch.effects.base import Setting
from dropo_torch.effects.engine import Variant
from dropo_torch.errors import InputError
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.ground import work
from dropo_torch.gap.log import (
    cut_windows,
    episode_bounds,
    feature_sizes,
    longest_episode,
    make_setting,
    spread,
    start_values,
)
from dropo_torch.gap.noise import LENGTH, free_forces, late_rows
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.ripple import ripples
from dropo_torch.gap.rules import Rules
from dropo_torch.gap.screen import all_candidates
from dropo_torch.gap.smooth import begun_smoothly, half_widths
from dropo_torch.gap.twin import Twin, Windows
from dropo_torch.gap.verify import hold_out
from dropo_torch.problem import Problem
from dropo_torch.shooting.posing import posed
from dropo_torch.simulators.hidden import refuse_prescribed
from dropo_torch.support.rows import evenly
from dropo_torch.support.threads import single_thread

#: Windows of the last fit, at most, those that try a length, and short ones for the noise.
MOST, FEW, SHORT = 120, 24, 160
#: Residuals of a short window from which on fewer of them tell as much, and the share that there are at least.
RICH, SCARCE = 120, 0.4
#: Windows among which those that stand out are looked for, at most; of these that are searched, and with others beside.
ALL, RARE, BESIDE = 600, 20, 60
#: Evaluations of forces in a simulation of the windows that refits use from which on it is worth to compile kernels.
LARGE = 8000
#: Logged steps, and share of an episode, that are left out at its beginning for what candidates remember, at most.
LEAD, LEAD_SHARE = 20, 0.1
#: Windows of an episode from which on one of them is not missed.
MANY = 6
#: Times its noise by which a feature's standard deviation shows that it moves.
MOVING = 5.0


@dataclass(frozen=True)
class Scene:
    """What a search works on: made once from a problem by :func:`prepare`.

    Attributes:
        problem: the config's model, parameters and log.
        setting: the model, its columns, the sizes of the log.
        twin: simulates windows.
        train, held: the log's two parts.
        since: logged step of each episode of the training part from which on the commands that act are known, ``(E,)``.
        noise: standard deviation of each feature, ``(m,)``.
        evidence: all windows of the training part.
        begin: the declared parameters as given.
    """

    problem: Problem
    setting: Setting
    twin: Twin
    train: Trajectories
    held: Trajectories
    since: np.ndarray
    noise: np.ndarray
    evidence: Evidence
    begin: Hypothesis

    @property
    def rules(self) -> Rules:
        """Thresholds."""
        return self.evidence.rules

    @property
    def short(self) -> Windows:
        """Short windows of the training part, in which forces may be left free."""
        return short_windows(self.setting, self.train, self.since)

    @property
    def noisy(self) -> Windows | None:
        """The short windows by which the noise is estimated; ``None`` where it is given."""
        return None if self.problem.objective.noise is not None else self.short


@single_thread()
def prepare(problem: Problem, rules: Rules | None = None) -> Scene:
    """Cut the log, estimate its noise, and choose windows.

    Args:
        problem: the model, its declared parameters, and the log; of sensors, it is made one of states.
        rules: thresholds.

    Raises:
        InputError: a simulator without a MuJoCo model; a model in which mocap bodies act; a log too short to judge
            anything, or one with a position whose velocity is not observed: a window needs its initial state.
    """
    if problem.space.model is None or problem.observation.size == 0:
        raise InputError("gap: this simulator is no MuJoCo model; effects can only be looked for in one")
    refuse_prescribed(problem.space.model, "gap")
    problem = posed(problem)
    if blind := problem.observation.at_rest:
        raise InputError(
            f"gap: the velocity of {blind[0]} is not observed; derive velocities from positions "
            "(data: preprocess), and name them in observation"
        )
    log = problem.trajectories  # without time stamps, it is sampled as the simulator steps
    train, held = hold_out(replace(log, dt=log.dt or problem.simulator.timestep))
    if not np.ptp(train.observations, axis=0).any():
        raise InputError(f"data: nothing moves in {train.source}: no observed column ever changes")
    return _scene(problem, train, held, rules or Rules())


def _scene(problem: Problem, train: Trajectories, held: Trajectories, rules: Rules) -> Scene:
    """What a search works on, of a log that is cut into its two parts."""
    begin, plain = Hypothesis(tuple(start_values(problem).tolist())), make_setting(problem, train)
    waves = ripples(_twin(problem, plain), train, begin.variant)
    smoothed = half_widths(train, plain.observation, _noisy_starts(problem, plain))
    setting = replace(plain, signals=replace(plain.signals, ripples=waves, smoothed=smoothed))
    twin = _twin(problem, setting)
    given, since = problem.objective.noise, first_steps(twin, train, begin)
    if given is None:
        short = short_windows(setting, train, since)
        setting = replace(setting, signals=replace(setting.signals, late=late_rows(twin, short, begin.variant)))
        twin = _twin(problem, setting)
        noise = free_forces(twin, short, begin.variant).noise
    else:
        noise = Features.of(problem.observation).feature_noise(given.numpy())
    shortest = cut_windows(train, setting.observation, rules.cut.lengths[-1], since=since)
    whole = Evidence(twin, shortest, noise, begin.variant, rough=True, rules=rules)
    evidence = _choose_windows(whole, train, begin, since)
    if problem.config.backend == "mujoco" and work(evidence) >= LARGE:
        twin = _twin(problem, setting, fast=True)
        evidence = replace(evidence, twin=twin)
    return Scene(problem, setting, twin, train, held, since, noise, evidence, begin)


def without_rows(scene: Scene, train: np.ndarray, held: np.ndarray) -> Scene:
    """Return what a search works on without some rows of the log: the scene is made anew, the model's sizes, too.

    Args:
        scene: of the log.
        train, held: which rows of its two parts stay, bool.
    """
    return _scene(scene.problem, scene.train.select(train), scene.held.select(held), scene.rules)


def with_parameters(scene: Scene, problem: Problem) -> Scene:
    """Return a scene with the declared parameters of another problem of the same model and log; windows and noise stay.

    Args:
        scene: of the log.
        problem: with the other parameters.
    """
    begin = Hypothesis(tuple(start_values(problem).tolist()))
    twin = _twin(problem, scene.setting, fast=scene.twin.warp)
    evidence = replace(scene.evidence, twin=twin, begin=begin.variant)
    return replace(scene, problem=problem, twin=twin, evidence=evidence, begin=begin)


def _noisy_starts(problem: Problem, setting: Setting) -> list[int]:
    """Columns of joints whose velocities are masked, where contacts or stops bend what begins at single rows."""
    if not (problem.config.keeps_noise and setting.has_impacts):
        return []
    model, index = setting.model, np.asarray(setting.observation.index)
    joints = {int(model.dof_jntid[index[c] - model.nq]) for c in setting.masked if index[c] >= model.nq}
    ends = np.append(model.jnt_qposadr, model.nq)
    positions = [(c, place) for c, place in enumerate(index) if 0 <= place < model.nq]
    return [c for c, place in positions if np.searchsorted(ends, place, "right") - 1 in joints]


def _twin(problem: Problem, setting: Setting, *, fast: bool = False) -> Twin:
    """What simulates a problem's windows, with the effects of its config; with Warp where that is faster."""
    return Twin(
        setting, problem.space, num_threads=problem.config.threads, warp=fast or problem.config.backend == "warp",
        standing=None if problem.effects is None else problem.effects.at,
    )  # fmt: skip


def first_steps(twin: Twin, log: Trajectories, begin: Hypothesis) -> np.ndarray:
    """Return the logged step of each episode at which its first window starts, ``(E,)``.

    A log may begin in motion, and what was commanded before is not in it. Windows begin where nothing is left of it
    under the config's own effects, and under what candidates for the gap begin with as far as the episode's length
    allows.
    """
    commands, lengths = log.commands, np.array([b - a for a, b in episode_bounds(log)])
    remembering = [e for e in VOCABULARY.values() if e.has("command")]
    starts = [Variant(begin.declared, (placed,)) for placed in all_candidates(twin.setting, remembering)]
    needed = np.max([twin.settled(v, commands) for v in starts], axis=0) if starts else np.zeros(len(lengths))
    allowed = np.minimum(LEAD, LEAD_SHARE * lengths)
    return np.maximum(twin.settled(begin.variant, commands), np.minimum(needed, allowed)).astype(int)


def short_windows(setting: Setting, log: Trajectories, since: np.ndarray | None = None) -> Windows:
    """Return short windows, spread over a log, in which forces may be left free.

    Args:
        setting: the model and its columns.
        log: the log.
        since: logged step of each episode at which its first window starts, ``(E,)``.

    Raises:
        InputError: a log with too few of them.
    """
    share = np.clip(RICH / ((LENGTH + 1) * setting.observation.size), SCARCE, 1.0)
    windows = spread(cut_windows(log, setting.observation, LENGTH, since=since), round(SHORT * share))
    if len(windows) < 5:
        raise InputError(
            f"data: {log.source} has {len(windows)} stretches of {LENGTH} steps; expected at least 5, "
            "longer episodes or more of them"
        )
    return windows


def searched(scene: Scene) -> Iterator[tuple[str, Evidence]]:
    """Yield the windows of each search in turn, with a suffix for its checkpoint.

    After those of the scene come windows a quarter as long, in which a large gap bends the simulation less, unless they
    are too short; and where contacts part windows into right and wrong, the shortest ones with a robust cost.
    """
    yield "", scene.evidence
    length, shortest = scene.evidence.windows.length // 4, scene.rules.cut.lengths[-1]
    if length >= shortest:
        yield "-shorter", _cut(scene.evidence, scene.train, scene.since, length, rough=scene.evidence.rough)
    if scene.setting.signals.contacts.any():
        yield "-contact", replace(_cut(scene.evidence, scene.train, scene.since, shortest), robust=True)


def outstanding(scene: Scene, evidence: Evidence, base: Hypothesis) -> Evidence | None:
    """Return windows of which some show more than noise where those that were searched show none; ``None`` if none do.

    What is rare may lie between the windows of a long log, or among an episode's first rows, where a search does not
    begin because of what candidates may remember. Chance lets less than one log in a hundred have such a window.

    Args:
        scene: gives the log.
        evidence: of the search, with the noise that it found.
        base: the declared parameters as it found them.
    """
    train, rules, twin = scene.train, evidence.rules, evidence.twin
    since = twin.settled(base.variant, train.commands)
    observation = twin.setting.observation
    windows = spread(cut_windows(train, observation, evidence.windows.length, since=since), ALL)
    windows = begun_smoothly(windows, train, observation, twin.setting.signals.smoothed)
    chance = odds(evidence, windows, base.variant)[0]
    order = np.argsort(chance, kind="stable")
    far = order[chance[order] < np.log(rules.chance.error / max(len(order), 1))]
    if not far.size:
        return None
    others, count = np.sort(order[len(far) :]), BESIDE - min(RARE, len(far))
    beside = others[evenly(len(others), min(count, len(others)))]
    return evidence.on(windows.select(np.sort(np.concatenate([far[:RARE], beside]))))


def odds(evidence: Evidence, windows: Windows, variant: Variant) -> tuple[np.ndarray, np.ndarray]:
    """Return how little chance leaves so much in each of many windows.

    Args:
        evidence: gives the noise.
        windows: stretches of the log; how many does not matter.
        variant: the hypothesis.

    Returns:
        Logarithms of the chance ``(W,)``, 0 where nothing is known, for noise that may be larger than was told; and χ²
        per degree of freedom, ``(W,)``.
    """
    chance, reduced = np.zeros(len(windows)), np.zeros(len(windows))
    for rows in np.array_split(np.arange(len(windows)), max(1, -(-len(windows) // MOST))):
        part = evidence.on(windows.select(rows))
        linear = part.linearize(variant)
        chi2 = (part.project(part.residuals([variant])[0][0], linear) ** 2).sum(-1)
        degrees = np.maximum((linear.weights > 0).sum(-1) - part.chart.size, 1)
        found = stats.chi2.logsf(chi2 / evidence.rules.sound.rest, degrees)
        chance[rows], reduced[rows] = np.where(linear.counted, (found, chi2 / degrees), 0.0)
    return chance, reduced


def _choose_windows(whole: Evidence, train: Trajectories, begin: Hypothesis, since: np.ndarray) -> Evidence:
    """The longest windows in whose initial states the simulation is still nearly linear.

    Where none are, as where noise presses what rests on a table into it, the longest than which no shorter ones are
    much more linear: these would show less of all that adds up, and gain nothing.
    """
    cut, bent, least = whole.rules.cut, dict[int, float](), np.inf
    longest, touches = longest_episode(train), bool(whole.twin.setting.signals.contacts.any())
    for length in (length for length in _lengths(whole, train) if length <= longest):
        evidence = _cut(whole, train, since, length, FEW)
        if not len(evidence.windows):
            continue
        rough = evidence.linearize(begin.variant).roughness
        least = min(least, rough)
        if touches and not _end_error(evidence, begin) < cut.astray:
            continue
        if rough < cut.rough:
            return _cut(whole, train, since, length, rough=rough > cut.bent)
        bent[length] = rough
    chosen = (length for length, rough in bent.items() if cut.gained * rough <= least)
    return _cut(whole, train, since, next(chosen, min(cut.lengths[-1], longest)))


def _lengths(whole: Evidence, train: Trajectories) -> tuple[int, ...]:
    """Lengths of windows that are tried: longer ones where velocities are unknown, as long as there are enough."""
    setting, cut = whole.twin.setting, whole.rules.cut
    known = setting.observation.index[[c for c in range(setting.observation.size) if c not in setting.masked]]
    if (known >= setting.model.nq).any():
        return cut.lengths
    blind = [n for n in cut.blind if n * setting.signals.timestep <= cut.seconds]
    count = [sum((b - a + 1) // (length + 1) for a, b in episode_bounds(train)) for length in blind]
    return (*(n for n, windows in zip(blind, count, strict=True) if windows >= cut.enough), *cut.lengths)


def _cut(
    evidence: Evidence, log: Trajectories, since: np.ndarray, length: int, most: int = MOST, *, rough: bool = True
) -> Evidence:
    setting = evidence.twin.setting
    windows = spread(cut_windows(log, setting.observation, length, since=spared(log, length, since)), most)
    windows = begun_smoothly(windows, log, setting.observation, setting.signals.smoothed)
    return replace(evidence.on(windows), rough=rough)


def spared(log: Trajectories, length: int, since: np.ndarray) -> np.ndarray:
    """Return the logged step of each episode at which its first window starts ``(E,)``, where it has few of them.

    Then no later than costs a window; hypotheses that do not know its commands go without it themselves.
    """
    episodes = np.array([b - a for a, b in episode_bounds(log)])
    count = (episodes + 1) // (length + 1)
    rest = episodes + 1 - count * (length + 1)
    return np.where(count < MANY, np.minimum(since, rest), since)


def _end_error(evidence: Evidence, begin: Hypothesis) -> float:
    """Typical error at the windows' ends, relative to the motion's own standard deviation; the median over features.

    Features that hardly move, of which the error is noise whatever the simulation does, count for nothing.
    """
    found, _ = evidence.residuals([begin.variant])
    end = found[0, :, -evidence.chart.size :] * evidence.noises[:, -1]
    size = feature_sizes(evidence.twin.setting, evidence.windows.measured[:, 0])
    moving = size > MOVING * evidence.noise
    relative = np.nanmedian(np.abs(end), axis=0) / np.maximum(size, 1e-12)
    return float(np.median(relative[moving] if moving.any() else relative))
