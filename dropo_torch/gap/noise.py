"""The noise of the measurement, and where the simulation pushes amiss, from short windows with free forces.

Over a few logged steps almost any missing effect looks like a generalised force that changes smoothly. A window is
fitted with its start and a quadratic force of time for each degree of freedom left free, all to first order. What
even this cannot explain is noise; the forces that it needed tell where the simulation is wrong, and when.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dropo_torch.effects.engine import Variant
from dropo_torch.effects.twin import Twin, Windows
from dropo_torch.gap.evidence import Evidence

#: Logged steps of a window, and coefficients of a force in it.
LENGTH, ORDER = 6, 3
#: First guess of the noise, and its floor, relative to a feature's deviation.
GUESS, FLOOR = 1e-3, 1e-9
#: Median of χ² of ν degrees over ν, nearly, for the median over windows.
ROUNDS = 8


@dataclass(frozen=True)
class FreeForces:
    """What short windows needed.

    Attributes:
        noise: standard deviation of each feature's measurement, ``(m,)``.
        forces: mean free force in each window, ``(W, nv)``.
        errors: their standard errors at that noise, ``(W, nv)``.
        windows: the short windows.
    """

    noise: np.ndarray
    forces: np.ndarray
    errors: np.ndarray
    windows: Windows


def free_forces(twin: Twin, windows: Windows, variant: Variant, noise: np.ndarray | None = None) -> FreeForces:
    """Estimate the noise and the forces that are missing.

    Args:
        twin: simulates windows.
        windows: short windows, spread over the log.
        variant: the hypothesis beside which the forces are free.
        noise: the noise where it is known, ``(m,)``.
    """
    sizes = np.maximum(_deviation(twin, windows), 1e-12)
    evidence = Evidence(twin, windows, GUESS * sizes if noise is None else noise, rough=False)
    m, nv, length = evidence.chart.size, twin.setting.model.nv, windows.length
    scale = 0.05 * twin.setting.signals.force
    time = (np.arange(length) + 0.5) / length - 0.5
    basis = np.stack([np.ones(length), time * 2, (time * 2) ** 2 - 1 / 3])[:ORDER]
    pushes = np.zeros((1 + m + ORDER * nv, length, nv))
    for dof in range(nv):
        for i in range(ORDER):
            pushes[1 + m + dof * ORDER + i, :, dof] = basis[i] * scale[dof]
    moved = np.zeros((len(pushes), 1, m))
    moved[1 : 1 + m, 0] = np.eye(m)
    found, _ = evidence.residuals([variant] * len(pushes), moved, pushes)
    usable = np.isfinite(found).all((0, 2))
    residual, slope = found[0, usable], np.moveaxis(found[1:, usable] - found[:1, usable], 0, -1)
    factor, estimate = _weigh(residual, slope, m, evidence.noise if noise is None else None)
    coefficients, errors = _solve(residual, slope, m, factor, m + ORDER * nv)
    at = m + np.arange(nv) * ORDER
    forces, deviations = np.full((len(windows), nv), np.nan), np.full((len(windows), nv), np.nan)
    forces[usable], deviations[usable] = coefficients[:, at] * scale, errors[:, at] * scale
    return FreeForces(
        np.maximum(estimate if noise is None else noise, FLOOR * sizes), forces, deviations, windows
    )  # fmt: skip


def _deviation(twin: Twin, windows: Windows) -> np.ndarray:
    """Deviation of each feature over the windows, ``(m,)``."""
    evidence = Evidence(twin, windows, np.ones(1), rough=False)
    first = windows.measured[:1, :1]
    return evidence.chart.difference(windows.measured, np.broadcast_to(first, windows.measured.shape)).std((0, 1))


def _weigh(residual: np.ndarray, slope: np.ndarray, m: int, noise: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Reweighted least squares: factors that whiten the features ``(N,)``, and the noise itself ``(m,)``."""
    num_rows = residual.shape[1]
    factor = np.ones(num_rows)
    if noise is None:
        return factor, np.ones(m)
    relative = np.ones(m)
    for _ in range(ROUNDS):
        factor = np.tile(1 / relative, num_rows // m)
        basis, _ = np.linalg.qr(slope * factor[:, None])
        weighted = residual * factor
        left = weighted - np.einsum("wnq,wq->wn", basis, np.einsum("wnq,wn->wq", basis, weighted))
        free = 1 - (basis**2).sum(-1)
        by_feature = (left**2).reshape(len(left), -1, m).sum(1)
        degrees = free.reshape(len(left), -1, m).sum(1)
        mean_degrees = np.maximum(degrees.mean(0), 1e-9)
        middle = np.maximum(1 - 2 / (9 * mean_degrees), 0.1) ** 3
        relative = relative * np.sqrt(np.maximum(np.median(by_feature / np.maximum(degrees, 1e-9), 0) / middle, 1e-16))
        relative = np.clip(relative, 1e-6, 1e4)
    return np.tile(1 / relative, num_rows // m), noise * relative


def _solve(
    residual: np.ndarray, slope: np.ndarray, m: int, factor: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of each window: coefficients and their standard errors, ``(W, size)`` each."""
    weighted = slope * factor[:, None]
    normal = np.einsum("wna,wnb->wab", weighted, weighted)
    diagonal = np.einsum("waa->wa", normal)
    ridge = 1e-9 * np.maximum(diagonal, 1e-12 * diagonal.max(1, keepdims=True))
    inverse = np.linalg.inv(normal + np.einsum("wa,ab->wab", ridge, np.eye(size)))
    coefficients = -np.einsum("wab,wnb,wn->wa", inverse, weighted, residual * factor)
    return coefficients, np.sqrt(np.maximum(np.einsum("waa->wa", inverse), 0.0))
