"""The noise of the measurement, and where the simulated forces are wrong, from short windows with free forces.

Over a few logged steps almost any missing effect looks like a generalized force that changes smoothly. A window is
fitted with its initial state and a quadratic force of time for each degree of freedom left free, all to first order.
What even this cannot explain is noise; the forces that it needed tell where the simulation is wrong, and when.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from dropo_torch.data.resolution import resolution
from dropo_torch.effects.base import Placed, find_effect
from dropo_torch.effects.engine import Variant
from dropo_torch.errors import InputError
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import feature_sizes, spread
from dropo_torch.gap.twin import Twin, Windows

#: Logged steps of a window, and coefficients of a force in it.
LENGTH, ORDER = 6, 3
#: Size of a trial force, relative to the log's typical one.
TRIAL = 0.05
#: First guess of the noise, and its floor, relative to a feature's standard deviation.
GUESS, FLOOR = 1e-3, 1e-9
#: Times that the noise is estimated anew, each feature weighted by the noise before: of the quietest windows, of all.
QUIET_ROUNDS, ROUNDS = 8, 16
#: Share of windows that are quiet; and of windows without anything but noise that pass for such.
QUIET, CALM = 0.25, 0.98
#: Windows that tell the noise, at least.
ENOUGH = 5
#: By how much a uniform distribution is wider than its standard deviation.
UNIFORM = 12**0.5
#: Share of fourth differences that are no larger than noise makes beside contacts; of them that must not be zero; by
#: how much noise that is nearly white may show less in them.
LOUD, SHOWN, MARGIN = 0.9, 0.5, 1.5
#: Rows by which commands are tried late, where they bend by this share of what white noise of their size would; and how
#: much lower noise must then be.
LATE, JUMPS, QUIETER = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0), 0.05, 0.8
#: Windows that tell whether they are late, at most, and the effect by which they are.
FEW, DELAY = 40, "actuator_delay"
#: Least degrees of freedom that a feature is taken to have in a window; and in all of them, to tell its noise.
LEAST_DEGREES, TELLING = 0.3, 5.0


@dataclass(frozen=True)
class FreeForces:
    """What short windows needed.

    Attributes:
        noise: standard deviation of each feature's measurement, ``(m,)``.
        unsure: its relative standard error, ``(m,)``; zero where the noise is known, infinite where nothing tells it.
        forces: mean free force in each window, ``(W, nv)``.
        errors: their standard errors at that noise, ``(W, nv)``.
        windows: the short windows.
        left: χ² per degree of freedom that they leave in each window at that noise, ``(W,)``.
    """

    noise: np.ndarray
    unsure: np.ndarray
    forces: np.ndarray
    errors: np.ndarray
    windows: Windows
    left: np.ndarray


class Diverges(InputError):
    """No short window can be simulated."""


def free_forces(twin: Twin, windows: Windows, variant: Variant, noise: np.ndarray | None = None) -> FreeForces:
    """Estimate the noise and the forces that are missing.

    Beside contacts, a model that is wrong about the ground begins windows within it, and no free force explains how
    they go on: what then is left counts as noise no further than the log's own fourth differences allow.

    Masked columns are not compared, but the windows start where they say; their noise is told as if they were. Of a
    sensor that counts, slow motion shows less than its resolution leaves open, which is the least that its noise is.

    Args:
        twin: simulates windows.
        windows: short windows, spread over the log.
        variant: the hypothesis beside which the forces are free.
        noise: the noise where it is known, ``(m,)``.

    Raises:
        InputError: the simulation diverges in all windows.
    """
    sizes = np.maximum(feature_sizes(twin.setting, windows.measured), 1e-12)
    evidence = Evidence(twin, windows, GUESS * sizes if noise is None else noise, variant, rough=False)
    found = _free_forces(evidence, sizes, known=noise is not None)
    if noise is not None:
        return found
    quieter = _quieter(evidence, sizes, found.noise, twin.setting.signals.late)
    found = replace(found, noise=np.maximum(np.minimum(quieter, _most(evidence)), _rounding(evidence)))
    if not twin.setting.masked:
        return found
    whole = _free_forces(replace(evidence, whole=True), sizes, known=False)
    told = evidence.chart.known(np.ones(twin.setting.observation.size, dtype=bool))
    noise = np.where(told, found.noise, whole.noise)
    for column, error in twin.setting.derived:  # errors that follow on each other do not show in short windows
        noise[evidence.chart.plain.index(column)] = error
    return replace(found, noise=noise, unsure=np.where(told, found.unsure, whole.unsure))


def late_rows(twin: Twin, windows: Windows, variant: Variant) -> tuple[float, ...]:
    """Return by how many rows commands may act late: those with which the noise of a column is clearly lower.

    What a jump of a command does in another row than the model says is no smooth force, and passes for noise. Commands
    that hardly bend from row to row leave that to smooth forces.

    Args:
        twin: simulates windows.
        windows: short windows, spread over the log.
        variant: the hypothesis beside which the forces are free.
    """
    windows = spread(windows, FEW)
    sizes = np.maximum(feature_sizes(twin.setting, windows.measured), 1e-12)
    evidence = Evidence(twin, windows, GUESS * sizes, variant, rough=False)
    if not _jumping(evidence):
        return ()
    own = _free_forces(evidence, sizes, known=False).noise
    return tuple(rows for rows in LATE if (_quieter(evidence, sizes, own, (rows,)) < own).any())


def _quieter(evidence: Evidence, sizes: np.ndarray, noise: np.ndarray, late: Iterable[float]) -> np.ndarray:
    """The noise of each feature ``(m,)``, where it is clearly lower if all commands that jump act some rows late."""
    twin, variant, jumping = evidence.twin, evidence.begin, _jumping(evidence)
    for rows in late if jumping else ():
        seconds = (rows * twin.setting.signals.timestep,)
        placed = (*variant.placed, *(Placed(find_effect(DELAY), target, seconds) for target in jumping))
        try:
            there = _free_forces(evidence, sizes, known=False, variant=replace(variant, placed=placed))
        except Diverges:
            continue
        noise = np.where(np.isfinite(there.unsure) & (there.noise < QUIETER * noise), there.noise, noise)
    return noise


def _jumping(evidence: Evidence) -> list[str | None]:
    """Actuators whose commands bend from row to row by a share of their size, and that have no delay so far."""
    twin, variant = evidence.twin, evidence.begin
    known = {p.target for p in twin.effects(variant) if p.effect.name == DELAY}
    return [t for t in find_effect(DELAY).targets(twin.setting) if t not in known and _jumps(evidence, t)]


def _jumps(evidence: Evidence, actuator: str | None) -> bool:
    """Whether a command bends from row to row by a share of its size that counts."""
    commands = evidence.windows.commands[..., evidence.twin.setting.command_column(actuator)]
    bends = np.diff(commands, 2, axis=1)
    return float(np.sqrt((bends**2).mean())) > JUMPS * 6**0.5 * float(commands.std())


def _rounding(evidence: Evidence) -> np.ndarray:
    """The standard deviation of what the resolution of each feature's column rounds off, ``(m,)``; 0 without one."""
    chart, measured = evidence.chart, evidence.windows.measured
    found = np.zeros(chart.size)
    found[: len(chart.plain)] = [resolution(measured[..., c].ravel()) / UNIFORM for c in chart.plain]
    return found / chart.scale


def _most(evidence: Evidence) -> np.ndarray:
    """The most that each feature's noise may be, ``(m,)``: fourth differences of it have 70 times its variance.

    Motion only adds to them. Infinite where nothing touches, and where a sensor is too coarse to show any.
    """
    chart, measured = evidence.chart, evidence.windows.measured
    if not evidence.twin.setting.signals.contacts.any() or measured.shape[1] < 5:
        return np.full(chart.size, np.inf)
    away = chart.difference(measured, np.broadcast_to(measured[:, :1], measured.shape))
    fourth = np.abs(np.diff(away, 4, axis=1)).reshape(-1, chart.size)
    size = np.quantile(fourth, LOUD, axis=0) / (stats.norm.ppf(0.5 + 0.5 * LOUD) * 70**0.5)
    return np.where((fourth > 0).mean(0) > SHOWN, MARGIN * size, np.inf)


def _free_forces(evidence: Evidence, sizes: np.ndarray, *, known: bool, variant: Variant | None = None) -> FreeForces:
    """The forces, and the noise of features of given sizes ``(m,)`` unless that of the evidence is known."""
    twin, windows, variant = evidence.twin, evidence.windows, variant or evidence.begin
    m, nv, length = len(sizes), twin.setting.model.nv, windows.length
    scale = TRIAL * twin.setting.signals.force
    time = (np.arange(length) + 0.5) / length - 0.5
    basis = np.stack([np.ones(length), time * 2, (time * 2) ** 2 - 1 / 3])[:ORDER]
    pushes = np.zeros((m + ORDER * nv, length, nv))
    for dof in range(nv):
        pushes[m + dof * ORDER :, :, dof][:ORDER] = basis * scale[dof]
    (own,), (seen,) = evidence.residuals([variant])
    moved = np.eye(len(pushes), m)[:, None]
    changes = evidence.changes(variant, own, [variant] * len(pushes), moved, pushes)
    usable = np.isfinite(own).all(1) & np.isfinite(changes).all((0, 2))
    if not usable.any():
        raise Diverges(_lost(twin, windows))
    if (told := usable & twin.knows(variant, windows)).any():
        usable = told
    residual, slope, counted = own[usable], np.moveaxis(changes[:, usable], 0, -1), seen[usable]
    relative, unsure = np.ones(m), np.zeros(m)
    if not known:
        telling = shows_noise(windows.measured[usable])
        relative, unsure = _relative_noise(residual[telling], slope[telling], counted[telling], m)
    factor = np.tile(1 / relative, residual.shape[1] // m)
    coefficients, errors = _solve(residual, slope, factor)
    forces, standard_errors = np.full((2, len(windows), nv), np.nan)
    forces[usable], standard_errors[usable] = (x[:, m::ORDER] * scale for x in (coefficients, errors))
    left, rest = np.full(len(windows), np.nan), residual + np.einsum("wnq,wq->wn", slope, coefficients)
    left[usable] = ((rest * factor) ** 2).sum(-1) / np.maximum(counted.sum(-1) - slope.shape[-1], 1)
    noise = np.maximum(evidence.noise * relative, FLOOR * sizes)
    return FreeForces(noise, unsure, forces, standard_errors, windows, left)


def shows_noise(measured: np.ndarray) -> np.ndarray:
    """Return which of windows ``(W, L + 1, n)`` show noise, ``(W,)`` bool; all, where hardly any would.

    Where a column stands exactly still that moves elsewhere, its sensor is too coarse to show any.
    """
    still = np.ptp(measured, axis=1) == 0
    moving = ~(still & ~still.all(0)).any(1)
    return moving if moving.sum() >= ENOUGH else np.ones(len(measured), dtype=bool)


def _lost(twin: Twin, windows: Windows) -> str:
    """What is wrong where no window can be simulated."""
    largest = np.abs(windows.measured).max((0, 1))
    column = int(largest.argmax())
    return (
        f"data: the simulation diverges within {windows.length} steps from every state of the log; "
        f"{twin.setting.observation.labels[column]} reaches {largest[column]:.3g} "
        f"{twin.setting.observation.units[column]}; are all columns in these units (data: scale)?"
    )


def _relative_noise(
    residual: np.ndarray, slope: np.ndarray, counted: np.ndarray, m: int
) -> tuple[np.ndarray, np.ndarray]:
    """The noise of each feature relative to the guess ``(m,)``, and the relative standard errors, ``(m,)``.

    Only residuals that are ``counted`` tell it, ``(W, N)``: what a late sensor shows first is from before the window.
    By reweighted least squares, each feature weighted by the noise before. Windows in which a force changes too fast,
    at contacts and where dry friction reverses, stand out: the noise begins with that of the quietest windows, and
    takes in whatever is then no more than chance. Nothing tells the noise of a feature whose residuals the forces
    explain whatever they are, such as of sensors that are late by more than most of a window: it stays the guess.
    """
    repeats, relative, error = residual.shape[1] // m, np.ones(m), np.zeros(m)
    for turn in range(QUIET_ROUNDS + ROUNDS):
        factor = np.tile(1 / relative, repeats)
        basis, _ = np.linalg.qr(slope * factor[:, None])
        weighted = residual * factor
        left = weighted - np.einsum("wnq,wq->wn", basis, np.einsum("wnq,wn->wq", basis, weighted))
        chi2 = (left**2).reshape(-1, repeats, m).sum(1)
        degrees = np.maximum((counted * (1 - (basis**2).sum(-1))).reshape(-1, repeats, m).sum(1), 1e-6)
        if turn < QUIET_ROUNDS:
            typical = np.maximum(degrees.mean(0), LEAST_DEGREES)
            ratio = np.quantile(chi2 / degrees, QUIET, axis=0) / (stats.chi2.ppf(QUIET, typical) / typical)
        else:
            ratio, error = _of_calm_windows(chi2, degrees)
        told = degrees.sum(0) >= TELLING
        relative = np.where(told, np.clip(relative * np.sqrt(np.maximum(ratio, 1e-16)), 1e-6, 1e4), 1.0)
    return relative, np.where(told, error, np.inf)


def _of_calm_windows(chi2: np.ndarray, degrees: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variances ``(m,)`` from χ² of features in windows ``(W, m)`` that chance allows, relative to the ones before.

    With them come the relative standard errors of standard deviations, ``(m,)``.
    """
    typical = np.maximum(degrees.mean(0), LEAST_DEGREES)
    largest = stats.chi2.ppf(CALM, typical)
    reduced = chi2 / degrees
    calm = reduced * typical < largest
    count = np.maximum(calm.sum(0), 1)
    mean = np.where(calm, reduced, 0.0).sum(0) / count
    share = stats.chi2.cdf(largest, typical + 2) / stats.chi2.cdf(largest, typical)  # of the mean that is left of it
    return np.where(calm.any(0), mean / share, 1.0), np.sqrt(0.5 / (typical * count))


def _solve(residual: np.ndarray, slope: np.ndarray, factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of each window: coefficients and their standard errors, ``(W, q)`` each."""
    weighted = slope * factor[:, None]
    normal = np.einsum("wna,wnb->wab", weighted, weighted)
    diagonal = np.einsum("waa->wa", normal)
    ridge = 1e-9 * np.maximum(diagonal, 1e-12 * diagonal.max(1, keepdims=True))
    inverse = np.linalg.inv(normal + ridge[:, :, None] * np.eye(ridge.shape[1]))
    coefficients = -np.einsum("wab,wnb,wn->wa", inverse, weighted, residual * factor)
    return coefficients, np.sqrt(np.maximum(np.einsum("waa->wa", inverse), 0.0))
