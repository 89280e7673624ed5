"""Whether a fitted model explains its log: the verdict of a fit, and when it is hopeless to go on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import compress
from typing import Literal

import numpy as np
import torch

from dropo_torch.diagnostics import Diagnostics
from dropo_torch.distribution import Distribution, SearchBox, to_values
from dropo_torch.initial_noise import parameter_covariance
from dropo_torch.objective import Objective
from dropo_torch.support.rows import evenly

#: Units of what is a position.
POSITIONS = ("m", "rad", "-")
#: How reasons end for which a search has stopped that may not have converged.
SPENT = ("is spent", "are taken")
Verdict = Literal["explained", "not_explained", "hopeless"]


@dataclass(frozen=True)
class Thresholds:
    """When a verdict changes, and why there.

    Attributes:
        unexplained: root mean square of standardized residuals, in a column, above which it is not explained. A model
            that misses by as much as it expects has 1; one that lacks an effect of the size of its σ has 1.4.
        chance: standard errors of that root mean square which a short log has on top.
        autocorrelation: of the standardized residuals of consecutive windows, from which on they are no accident:
            right models have 0, friction that is lacking gives 0.5 to 0.8, whatever σ covers it.
        autocorrelation_errors: standard errors, 1/√T, by which it must differ from 0.
        counts: root mean square below which a column's residuals are so far within ε that their order does not matter.
        drowned: root mean square below which ε or the noise given, not the parameters, dominates what is expected.
        position_skill: share of a position's change over a window that must be predicted. From measured velocities
            every model predicts 0.95 and more; a frame_skip that is wrong by a quarter leaves 0.75.
        skill: the same of a velocity; in degrees instead of radians it is 0.06 and less, without friction 0.8.
        half: share of columns which must lack skill, and of simulations which must diverge.
        far: changes, in units of ε and noise, that count as more than noise.
        fewest: windows in which a column must move for its skill to be judged.
        windows: of the log, spread over it, that are looked at before a fit goes on.
        at_bound: share of the search box within which a mean is at its bound.
        at_std_bound: factor within which a σ is at a bound of its own.
    """

    unexplained: float = 1.5
    chance: float = 3.0
    autocorrelation: float = 0.2
    autocorrelation_errors: float = 4.0
    counts: float = 0.5
    drowned: float = 0.3
    position_skill: float = 0.8
    skill: float = 0.1
    half: float = 0.5
    far: float = 3.0
    fewest: int = 10
    windows: int = 200
    at_bound: float = 2e-3
    at_std_bound: float = 1.02


THRESHOLDS = Thresholds()


@dataclass(frozen=True)
class Judgment:
    """Whether the model explains the log.

    Attributes:
        verdict: ``"explained"``, ``"not_explained"`` or ``"hopeless"``.
        reason: why, and what is at a bound, in words.
        standard_errors: parameter → standard errors of its ``mean`` and ``std``, in its unit; ``None`` where the log
            gives none.
    """

    verdict: Verdict
    reason: str
    standard_errors: dict[str, dict[str, float | None]]


def judge(
    distribution: Distribution, method: str, diagnostics: Diagnostics, diverged: float, stop_reason: str = ""
) -> Judgment:
    """Return the verdict on a fitted distribution.

    Args:
        distribution: the fit.
        method: how it was found; only DROPO's σ says how much must vary, and a random box is not judged.
        diagnostics: of the fit.
        diverged: share of simulations that diverge under it.
        stop_reason: why the search has stopped; one that has spent what it was given may not have converged.
    """
    is_dropo = method == "dropo"
    errors = _standard_errors(distribution, diagnostics)
    residual = diagnostics.measured - diagnostics.at_center
    sizes = diagnostics.change, diagnostics.given, diagnostics.expected
    hopeless = _without_skill(diagnostics.units, residual, *sizes, diverged)
    wider = "method: laplace" if diagnostics.is_sensed else "entropy: 1"
    notes = [*_at_bounds(distribution), *([spread_note(distribution, wider)] if is_dropo else [])]
    verdict: Verdict = "explained"
    if method == "udr":
        reason = f"this is a box drawn at random; the log was not used. {scale_of(diagnostics)}"
    elif hopeless:
        spent = f" Or the search has not converged, for {stop_reason}: give it more, or try optimizer: fisher."
        verdict, reason = "hopeless", hopeless + (spent if stop_reason.endswith(SPENT) else "")
    elif doubt := _doubt(distribution, diagnostics, is_dropo):
        verdict, reason = "not_explained", f"{doubt}. {scale_of(diagnostics)}"
    else:
        margin = ", with margin to spare" if overall_rms(diagnostics) < THRESHOLDS.drowned else ""
        reason = f"the simulator explains the log{margin}. {scale_of(diagnostics)}"
    return Judgment(verdict, " ".join([reason, *filter(None, notes)]), errors)


def hopeless_at(objective: Objective, mean: np.ndarray) -> str:
    """Return why it is hopeless to fit σ around μ, in coordinates; empty where it is not, or where the largest σ helps.

    It looks at some windows of the log, which count as none.
    """
    rows = evenly(len(objective), THRESHOLDS.windows)
    part = objective.on(objective.transitions.select(rows))
    run = part.evaluator
    center = run.after(slice(None), torch.from_numpy(objective.box.values(mean)[None]))[:, 0]
    change = part.measured - part.features.values(run.columns_at_start, run.columns)
    base = part.base_covariance(slice(None))
    widest = base + parameter_covariance(run, objective.box, slice(None), mean, objective.box.max_std)
    given, expected = (torch.diagonal(c, dim1=1, dim2=2).sqrt().numpy() for c in (base, widest))
    lost = float((~center.isfinite().all(-1)).double().mean())
    residual = (part.measured - center).numpy()
    return _without_skill(part.features.units, residual, change.numpy(), given, expected, lost)


def _without_skill(
    units: tuple[str, ...],
    residual: np.ndarray,
    change: np.ndarray,
    given: np.ndarray,
    expected: np.ndarray,
    diverged: float,
) -> str:
    """Why a model predicts nothing of a log, in words; empty where it does.

    Args:
        units: of the m columns.
        residual: measured minus simulated next states, ``(T, m)``.
        change: over the windows, measured, ``(T, m)``.
        given: standard deviation by ε and noise, ``(T, m)``.
        expected: the same with that by parameters that vary, ``(T, m)``.
        diverged: share of simulations that diverge.
    """
    t = THRESHOLDS
    check = "check the log's units, the order of its columns (observation), frame_skip and the bounds"
    if diverged >= t.half:
        return f"{100 * diverged:.0f} % of the simulations diverge, wherever in the bounds: {check}."
    columns = zip(residual.T, change.T, given.T, expected.T, strict=True)
    skills = np.array([_skill(*column) for column in columns])
    is_position = np.array([unit in POSITIONS for unit in units])
    for name, kind, least in (("positions", is_position, t.position_skill), ("columns", ~is_position, t.skill)):
        own = skills[kind & np.isfinite(skills)]
        if len(own) and (own < least).mean() >= t.half:
            name = "velocities" if name == "columns" and is_position.any() else name
            return (
                f"the simulator predicts {100 * max(0.0, float(np.median(own))):.0f} % of how far {name} move over a "
                f"window, median over columns, even at the best parameters (100 is perfect, 0 is to say that nothing "
                f"moves): {check}."
            )
    return ""


def _skill(residual: np.ndarray, change: np.ndarray, given: np.ndarray, expected: np.ndarray) -> float:
    """Share of a column's change that is predicted, where it moves: all if expected; NaN where it hardly moves."""
    t = THRESHOLDS
    moves = (np.abs(change) > t.far * given) & np.isfinite(residual) & (expected > 0)
    if moves.sum() < t.fewest:
        return math.nan
    error = np.abs(residual[moves])
    if np.median(error / expected[moves]) < t.unexplained:
        return 1.0
    return float(1 - np.median(error) / np.median(np.abs(change[moves])))


def _doubt(distribution: Distribution, diagnostics: Diagnostics, is_dropo: bool) -> str:
    """What speaks against a model, in words; empty where nothing does."""
    size, limit, labels = column_rms(diagnostics), unexplained_above(diagnostics), diagnostics.labels
    if not np.isfinite(size).any():
        return "no residual is finite, so the fit cannot be judged"
    if (bad := size > limit).any():
        where = "" if len(size) == 1 else f" in {bad.sum()} of {len(size)} columns"
        return f"the simulator does not explain the log{where}"
    if is_dropo and (top := at_largest_std(distribution)).any():
        names = ", ".join(compress(distribution.names, top))
        return f"the simulator explains the log only if parameters vary as much as the search allows ({names})"
    if diagnostics.unjoined:
        return (
            "the simulator does not lead from one window's state to the next one's, in most windows "
            f"(rms {', '.join(diagnostics.unjoined)}): an effect is missing"
        )
    together, least = autocorrelation(diagnostics)
    if (kept := (together > least) & (size > THRESHOLDS.counts)).any():
        worst = int(np.argmax(np.where(kept, together, -np.inf)))
        return (
            f"residuals of consecutive windows go together (correlation {together[worst]:.2f} in {labels[worst]}): "
            "an effect is missing, which σ covers, or a parameter drifts"
        )
    return ""


def autocorrelation(diagnostics: Diagnostics) -> tuple[np.ndarray, float]:
    """Return the correlation of standardized residuals of consecutive windows, ``(m,)``, and where it is no accident.

    Where initial states are noisy, consecutive windows share a measurement: windows that lie two apart are compared.
    """
    t, apart = THRESHOLDS, 2 if diagnostics.noisy_starts else 1
    z, follows = standardized_residual(diagnostics), diagnostics.follows
    pairs = np.all([follows[i : len(z) - apart + i] for i in range(apart)], axis=0)
    first, second = (np.nan_to_num(part[pairs]) for part in (z[: len(z) - apart], z[apart:]))
    with np.errstate(invalid="ignore", divide="ignore"):
        found = (first * second).sum(0) / np.sqrt((first**2).sum(0) * (second**2).sum(0))
    return np.nan_to_num(found), max(t.autocorrelation, t.autocorrelation_errors / math.sqrt(max(int(pairs.sum()), 1)))


def scale_of(diagnostics: Diagnostics) -> str:
    """Return by how much next states are missed, in words."""
    size = column_rms(diagnostics)
    if not np.isfinite(size).any():
        return ""
    worst = int(np.nanargmax(size))
    return (
        f"Measured next states lie {overall_rms(diagnostics):.2g} expected σ from the simulated ones "
        f"(rms; 1 is ideal); {diagnostics.labels[worst]} is worst, at {size[worst]:.2g}."
    )


def spread_note(distribution: Distribution, wider: str = "entropy: 1") -> str:
    """Return what training would draw where σ is at its floor, and what key widens it; empty where none is."""
    floor = np.flatnonzero(at_floor(distribution))
    if not len(floor):
        return ""
    with np.errstate(invalid="ignore"):  # other parameters may be anything
        low, high = (to_values(end, distribution.is_log) for end in distribution.ends)
    drawn = [
        f"{distribution.names[i]} from {low[i]:.8g} to {high[i]:.8g} {distribution.units[i]}".rstrip()
        for i in floor[:5]
    ]
    more = f" and {len(floor) - 5} more likewise" if len(floor) > 5 else ""
    return (
        f"σ is at its floor: dropo train would draw {', '.join(drawn)}{more}, practically one value. "
        f"To train on more, fit with {wider}, or train with distribution: uniform."
    )


def _at_bounds(distribution: Distribution) -> list[str]:
    """Which means and standard deviations lie at a bound, in words."""
    lower, upper = means_at_bounds(distribution)
    found = [f"the mean of {n} at its lower bound" for n in compress(distribution.names, lower)]
    found += [f"the mean of {n} at its upper bound" for n in compress(distribution.names, upper)]
    found += [f"σ of {n} at its upper bound" for n in compress(distribution.names, at_largest_std(distribution))]
    return [f"At a bound: {', '.join(found)}."] if found else []


def _standard_errors(distribution: Distribution, diagnostics: Diagnostics) -> dict[str, dict[str, float | None]]:
    """Standard errors by name, in units."""
    unit = np.where(distribution.is_log, distribution.center, 1.0)
    columns = zip(
        distribution.names, (unit * diagnostics.standard_error).tolist(), (unit * diagnostics.std_error).tolist(),
        strict=True,
    )  # fmt: skip
    return {name: {"mean": mean, "std": None if math.isnan(std) else std} for name, mean, std in columns}


def column_rms(diagnostics: Diagnostics) -> np.ndarray:
    """Return the root mean square standardized residual of each column, over finite entries; NaN where none."""
    return root_mean_square(standardized_residual(diagnostics))


def overall_rms(diagnostics: Diagnostics) -> float:
    """Return the root mean square standardized residual over all columns; NaN where none is finite."""
    return float(root_mean_square(standardized_residual(diagnostics).ravel()))


def root_mean_square(values: np.ndarray) -> np.ndarray:
    """Return the root mean square over the first axis of what is finite; NaN where nothing is."""
    finite = np.isfinite(values)
    total = np.sum(np.where(finite, values, 0.0) ** 2, axis=0)
    return np.sqrt(np.where(finite.any(0), total / np.maximum(finite.sum(0), 1), np.nan))


def standardized_residual(diagnostics: Diagnostics) -> np.ndarray:
    """Return residual over expected standard deviation, ``(T, m)``."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(diagnostics.residual / diagnostics.expected)


def unexplained_above(diagnostics: Diagnostics) -> float:
    """Return the rms above which a column is not explained: larger for a short log, whose rms varies by chance."""
    return THRESHOLDS.unexplained + THRESHOLDS.chance / math.sqrt(2 * max(len(diagnostics.rows), 1))


def at_largest_std(distribution: Distribution) -> np.ndarray:
    """Return which standard deviations lie at their upper bound, ``(d,)`` bool."""
    return np.asarray(distribution.std >= SearchBox.of(distribution).max_std / THRESHOLDS.at_std_bound)


def at_floor(distribution: Distribution) -> np.ndarray:
    """Return which standard deviations lie at their lower bound, ``(d,)`` bool."""
    return np.asarray(distribution.std <= SearchBox.of(distribution).min_std * THRESHOLDS.at_std_bound)


def means_at_bounds(distribution: Distribution) -> tuple[np.ndarray, np.ndarray]:
    """Return which means lie at the lower and at the upper end of their search box, ``(d,)`` bool each."""
    box = SearchBox.of(distribution)
    share = (distribution.mean - box.low) / box.width
    return share < THRESHOLDS.at_bound, share > 1 - THRESHOLDS.at_bound
