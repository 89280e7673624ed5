"""How noisy measurements are and how exactly windows join, from residuals and what the fit has taken off them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dropo_torch.diagnostics import estimates
from dropo_torch.shooting.equations import LEFT, Normal, Residuals, Scales, Slopes

#: Share of a kind of residuals that must be left to them for their size to be told.
REDUNDANT = 0.02
#: The smallest noise, as a share of a column's spread, and the smallest link.
LEAST_NOISE, LEAST_LINK = 1e-6, 1e-6
#: Median of a standard normal's absolute values.
MEDIAN = 0.6745
#: Power by which links shrink at a look, since exact ones are approached slowly; and the largest factor of a scale.
HASTE, FASTEST = 1.8, 4.0
#: Share of links' variance that must be their own, the typical link as a share of their scale, and links, for windows
#: that do not join: where the model is right they have 0.1 to 0.2 and 0.2 to 0.3, with a few windows over contacts 0.8
#: and 0.6; without a pendulum's friction 0.9 and 0.9.
OWN, TYPICAL, FEWEST = 0.5, 0.75, 10


@dataclass(frozen=True, eq=False)
class Posterior:
    """Covariances at a point, in sizes of moves and widths of the parameters' box.

    Attributes:
        parameters: ``(d, d)``, with a normal of the box's width for what the log does not tell.
        states: of each window's initial state, ``(W, s, s)``.
        before: of that with the one of the window before, ``(W, s, s)``.
        shared: of that with the parameters, ``(W, s, d)``.
    """

    parameters: np.ndarray
    states: np.ndarray
    before: np.ndarray
    shared: np.ndarray

    @classmethod
    def of(cls, normal: Normal) -> Posterior:
        """Return that of undamped normal equations."""
        error, correlation = estimates(normal.schur + np.eye(len(normal.schur)))
        parameters = correlation * np.outer(error, error)
        own, before = normal.chain.covariances()
        shared = normal.shift @ parameters
        own = own + shared @ normal.shift.swapaxes(1, 2)
        before = before + shared @ np.roll(normal.shift, 1, axis=0).swapaxes(1, 2)
        return cls(parameters, own, before, shared)


def components(
    at: Residuals, slope: Slopes, scales: Scales, normal: Normal, spread: np.ndarray, noise: np.ndarray | None
) -> Scales:
    """Return the scales that the residuals show: squares over the degrees of freedom that the fit leaves each kind.

    Args:
        at: residuals at the fit.
        slope: their derivatives.
        scales: by which they were weighed.
        normal: the undamped normal equations.
        spread: of each feature over the log, ``(m,)``.
        noise: of each feature where it is known, ``(m,)``; of those with 0 it is estimated.
    """
    posterior, kept = Posterior.of(normal), ~at.lost
    weight, of_link = at.weights(scales)
    joined = kept & at.follows
    explained = _of_links(at, slope, posterior)[joined] * of_link[joined] ** 2
    link = _updated(at.links[joined] * of_link[joined], explained, scales.link, LEAST_LINK, HASTE)
    m = len(scales.noise)
    explained, off = (
        x[kept].reshape(-1, m) for x in (_of_measured(slope, posterior) * weight**2, at.measured * weight)
    )
    found = _updated(off, explained, scales.noise, LEAST_NOISE * spread)
    return Scales(found if noise is None else np.where(noise > 0, noise, found), link)


def _updated(
    residual: np.ndarray, explained: np.ndarray, scale: np.ndarray, least: np.ndarray | float, haste: float = 1.0
) -> np.ndarray:
    """Scales ``(k,)`` of weighted residuals ``(N, k)``, of whose variance the fit explains so much."""
    left = LEFT * len(residual) - explained.sum(0)
    told = left > REDUNDANT * len(residual)
    ratio = np.sqrt((residual**2).sum(0) / np.where(told, left, 1.0))
    found = scale * np.clip(np.where(ratio < 1, ratio**haste, ratio), 1 / FASTEST, FASTEST)
    return np.where(told, np.maximum(found, least), scale)


def _of_measured(slope: Slopes, posterior: Posterior) -> np.ndarray:
    """Variance that the posterior gives each simulated feature, ``(W, H m)``."""
    parameters = np.broadcast_to(posterior.parameters, (len(slope.measured), *posterior.parameters.shape))
    joint = np.block([[posterior.states, posterior.shared], [posterior.shared.swapaxes(1, 2), parameters]])
    return ((slope.measured @ joint) * slope.measured).sum(-1)


def _of_links(at: Residuals, slope: Slopes, posterior: Posterior) -> np.ndarray:
    """Variance that the posterior gives each link, ``(W, s)``."""
    before, s = slope.of_links(at.follows), at.links.shape[1]
    earlier, shared = (np.roll(x, 1, axis=0) for x in (posterior.states, posterior.shared))
    by_state, by_parameter = before[..., :s], before[..., s:]
    covariance = posterior.states + by_state @ earlier @ by_state.swapaxes(1, 2)
    covariance = covariance + by_parameter @ posterior.parameters @ by_parameter.swapaxes(1, 2)
    cross = posterior.before @ by_state.swapaxes(1, 2) + posterior.shared @ by_parameter.swapaxes(1, 2)
    cross = cross + by_state @ shared @ by_parameter.swapaxes(1, 2)
    return np.asarray(np.diagonal(covariance + cross + cross.swapaxes(1, 2), axis1=1, axis2=2))


def uncertainty(at: Residuals, slope: Slopes, scales: Scales, normal: Normal) -> tuple[np.ndarray, np.ndarray]:
    """Return standard errors of the parameters, in widths of their box, ``(d,)``, and their correlation ``(d, d)``.

    The larger of two: by the residuals' scales, and by how much the windows disagree (the sandwich of cluster-robust
    errors), which also counts what the model lacks.
    """
    error, correlation = estimates(normal.schur + np.eye(len(normal.schur)))
    covariance, s = correlation * np.outer(error, error), at.links.shape[1]
    weight, of_link = at.weights(scales)
    moved = normal.shift
    own = (slope.measured[..., s:] + slope.measured[..., :s] @ moved) * weight[..., None]
    before = slope.of_links(at.follows)
    joins = moved + before[..., s:] + before[..., :s] @ np.roll(moved, 1, axis=0)
    score = np.einsum("wnd,wn->wd", own, at.measured * weight)
    score = score + np.einsum("wsd,ws->wd", joins * of_link[..., None], at.links * of_link)
    count = len(score)
    middle = score.T @ score * count / max(count - 1, 1)
    clustered = np.sqrt(np.maximum(np.diag(covariance @ middle @ covariance), 0.0))
    return np.maximum(error, clustered), correlation


def unjoined(at: Residuals, slope: Slopes, scales: Scales, normal: Normal) -> np.ndarray:
    """Return of which moves the links are no accident, ``(s,)`` bool: the model leads elsewhere in most windows."""
    joined, (_, of_link) = at.follows & ~at.lost, at.weights(scales)
    if joined.sum() < FEWEST:
        return np.zeros(len(scales.link), dtype=bool)
    explained = (_of_links(at, slope, Posterior.of(normal))[joined] * of_link[joined] ** 2).mean(0)
    typical = np.median(np.abs(at.links[joined]), axis=0) / MEDIAN / scales.link
    return (1 - explained > OWN) & (typical > TYPICAL)
