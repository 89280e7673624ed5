"""What a search works on: the log's two parts, its noise, and windows over which the simulation can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dropo_torch.data.features import Features
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects.base import Setting
from dropo_torch.effects.twin import Twin, Windows
from dropo_torch.errors import InputError
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import cut_windows, make_setting, start_values
from dropo_torch.gap.noise import LENGTH, free_forces
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.verify import hold_out, spread
from dropo_torch.problem import Problem

#: Logged steps of a window that are tried, the longest first, and the roughness that ends the search.
LENGTHS = (30, 15, 8, 4)
ROUGH = 0.03
#: Roughness from which on windows are linearised statistically.
BENT = 0.001
#: Typical error at a window's end, relative to the motion, from which on contacts come at other times than measured.
FAR_OFF = 0.08
#: Windows of the last fit, at most, and short ones for the noise.
MOST, SHORT = 120, 160


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
    if blind := problem.observation.at_rest:
        raise InputError(
            f"gap: the velocity of {blind[0]} is not observed; derive velocities from positions "
            "(data: preprocess), and name them in observation"
        )


def _noise(problem: Problem, twin: Twin, train: Trajectories, begin: Hypothesis) -> np.ndarray:
    """The noise of each feature, as given or estimated."""
    if problem.objective.noise is not None:
        return Features.of(problem.observation).feature_noise(problem.objective.noise.numpy())
    return free_forces(twin, short_windows(problem, train), begin.variant).noise


def short_windows(problem: Problem, log: Trajectories) -> Windows:
    """Return short windows, spread over a log, in which forces may be left free.

    Raises:
        InputError: a log with too few of them.
    """
    windows = spread(cut_windows(log, problem.observation, LENGTH), SHORT)
    if len(windows) < 5:
        raise InputError(
            f"data: {log.source} has {len(windows)} stretches of {LENGTH} steps; expected at least 5, "
            "longer episodes or more of them"
        )
    return windows


def shorter_windows(scene: Scene) -> Evidence | None:
    """Windows a quarter as long, in which a large gap bends the simulation less; ``None`` if they are short."""
    length = scene.evidence.windows.length // 4
    if length < LENGTHS[-1]:
        return None
    windows = spread(cut_windows(scene.train, scene.problem.observation, length), MOST)
    return Evidence(scene.twin, windows, scene.noise, rough=scene.evidence.rough)


def contact_windows(scene: Scene) -> Evidence | None:
    """The shortest windows with a robust cost, for logs in which contacts part the windows into right and far off."""
    if not scene.setting.signals.contacts.any():
        return None
    windows = spread(cut_windows(scene.train, scene.problem.observation, LENGTHS[-1]), MOST)
    return Evidence(scene.twin, windows, scene.noise, rough=True, robust=True)


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
