"""How far hypotheses are from the log: windows with free starts, whitened by the noise.

Each window's start is unknown: what was measured there is one more noisy observation. Of the residuals
r = [(y₀ − x₀)/σ, (y_k − f_k(x₀, θ))/σ] the part that a change of x₀ explains to first order is projected away, with
P = I − QQᵀ from the QR factors of ∂r/∂x₀. What is left, P r, is compared between hypotheses.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dropo_torch.data.features import Features
from dropo_torch.effects.engine import Variant
from dropo_torch.effects.twin import Twin, Windows

#: Antithetic pairs of start noise by which rough windows are linearised, and their seed.
PAIRS, SEED = 16, 11
#: Whitened residual of a window whose simulation diverged.
LOST = 1e3
#: Largest share of all windows' χ² that one window may have.
CAP = 0.03
#: Expected χ² of a window, times this: from there on a robust cost grows with the logarithm only.
TAIL = 3.0


@dataclass(frozen=True)
class Starts:
    """The linearisation of a hypothesis by its windows' starts.

    Attributes:
        basis: orthonormal columns that a change of the starts spans, ``(W, N, m)``; N = (L + 1)·m.
        weights: factors of the whitened residuals, ``(W, N)``: below 1 where noise at the start bends the simulation,
            0 where nothing is known.
        shift: mean residual minus the residual at the measured start, ``(W, N)``.
        roughness: share of residuals whose variance the linear part does not explain.
    """

    basis: np.ndarray
    weights: np.ndarray
    shift: np.ndarray
    roughness: float


class Evidence:
    """Residuals of hypotheses on windows of a log.

    Args:
        twin: simulates hypotheses.
        windows: the stretches of the log.
        noise: standard deviation of the measurement of each feature, ``(m,)``.
        rough: linearise statistically, over draws of the start noise, as contacts need it.
        model_error: by how much the model's own error exceeds the noise in each residual of a window, ``(N,)``; 1 by
            default.
        robust: whether windows that are far off count by the logarithm of their χ² only (a Cauchy cost).
    """

    def __init__(
        self, twin: Twin, windows: Windows, noise: np.ndarray, *, rough: bool,
        model_error: np.ndarray | None = None, robust: bool = False,
    ) -> None:  # fmt: skip
        self.twin, self.windows, self.noise, self.rough = twin, windows, np.asarray(noise, dtype=float), rough
        self.chart = Features.of(twin.setting.observation, twin.setting.masked)
        self.model_error = np.ones(self.num_rows) if model_error is None else model_error
        self.robust = robust

    def on(self, windows: Windows) -> Evidence:
        """Return the same over other windows."""
        other = self._with(windows=windows)
        return other if windows.length == self.windows.length else other._with(model_error=np.ones(other.num_rows))

    def with_noise(self, noise: np.ndarray) -> Evidence:
        """Return the same with another noise."""
        return self._with(noise=np.asarray(noise, dtype=float))

    def with_model_error(self, model_error: np.ndarray) -> Evidence:
        """Return the same with another weight of each residual."""
        return self._with(model_error=model_error)

    def with_twin(self, twin: Twin) -> Evidence:
        """Return the same by another simulation."""
        return self._with(twin=twin)

    def _with(self, **changes: object) -> Evidence:
        other = copy.copy(self)
        for name, value in changes.items():
            setattr(other, name, value)
        return other

    def tail(self, starts: Starts) -> float | None:
        """χ² of a window from which on the cost grows slowly; ``None`` where it never does."""
        return TAIL * self.degrees(starts) / len(self.windows) if self.robust else None

    @property
    def num_rows(self) -> int:
        """Residuals of a window."""
        return (self.windows.length + 1) * self.chart.size

    def residuals(
        self, variants: Sequence[Variant], moved: np.ndarray | None = None, pushes: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals ``(K, W, N)``, NaN where lost, and whether each is known.

        Args:
            variants: hypotheses.
            moved: changes of the starts in units of the noise, ``(K, W, m)`` or ``(K, 1, m)``.
            pushes: see :meth:`Twin.predict`.
        """
        measured = self.windows.measured
        starts = None
        if moved is not None:
            starts = self.chart.move(measured[:, 0], np.broadcast_to(
                moved * self.noise, (len(variants), len(self.windows), self.chart.size)))  # fmt: skip
        columns, valid = self.twin.predict(variants, self.windows, starts, pushes)
        with np.errstate(invalid="ignore"):
            residual = self.chart.difference(measured, columns) / self.noise
        shape = (len(variants), len(self.windows), self.num_rows)
        known = self.chart.known(valid).reshape(shape)
        return np.where(known, residual.reshape(shape) / self.model_error, 0.0), known

    def linearise(self, variant: Variant) -> Starts:
        """Return how a hypothesis' residuals depend on the starts."""
        return self._statistical(variant) if self.rough else self._differences(variant)

    def _differences(self, variant: Variant) -> Starts:
        m = self.chart.size
        moved = np.concatenate([np.zeros((1, m)), np.eye(m)])[:, None]
        found, known = self.residuals([variant] * (m + 1), moved)
        slope = np.moveaxis(np.nan_to_num(found[1:] - found[:1]), 0, -1)
        basis, _ = np.linalg.qr(slope)
        weights = known[0].astype(float)
        return Starts(basis, weights, np.zeros(weights.shape), 0.0)

    def _statistical(self, variant: Variant) -> Starts:
        """Regress the residuals on draws of the start noise; what is left over adds to the noise."""
        m = self.chart.size
        half = np.random.default_rng(SEED).standard_normal((PAIRS, m))
        draws = np.concatenate([half, -half])
        found, known = self.residuals([variant] * (len(draws) + 1), np.concatenate([np.zeros((1, m)), draws])[:, None])
        found = np.nan_to_num(found, nan=LOST)
        center = found[1:].mean(0)
        flat = found[1:] - center
        slope = np.einsum("dk,dwn->wnk", np.linalg.pinv(draws).T, flat)
        left = flat - np.einsum("wnk,dk->dwn", slope, draws)
        variance = (left**2).sum(0) / (len(draws) - m)
        variance[variance < 0.01] = 0.0
        weights = known[0] / np.sqrt(1 + 1.5 * variance)
        basis, _ = np.linalg.qr(slope * weights[..., None])
        shift = np.where(variance > 0, center - found[0], 0.0)
        return Starts(basis, weights, np.clip(shift, -LOST, LOST), float((variance > 1).mean()))

    def project(self, residuals: np.ndarray, starts: Starts) -> np.ndarray:
        """Return the part ``(..., W, N)`` of residuals that the starts do not explain; lost ones count as LOST."""
        lost = ~np.isfinite(residuals)
        weighted = np.where(lost, LOST, residuals + (starts.shift if not lost.all() else 0.0)) * starts.weights
        return weighted - _along(starts.basis, weighted)

    def project_slope(self, slope: np.ndarray, starts: Starts) -> np.ndarray:
        """Return :meth:`project` of derivatives ``(..., W, N)``."""
        weighted = np.nan_to_num(slope) * starts.weights
        return weighted - _along(starts.basis, weighted)

    def degrees(self, starts: Starts) -> float:
        """Return the degrees of freedom that the windows have beside their starts."""
        return float((starts.weights > 0).sum() - len(self.windows) * self.chart.size)


def _along(basis: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the part of vectors ``(..., W, N)`` in the span of the basis ``(W, N, m)``."""
    return np.einsum("wnm,...wm->...wn", basis, np.einsum("wnm,...wn->...wm", basis, vectors))


@dataclass(frozen=True)
class Cost:
    """The misfit of a hypothesis: χ² of each window, with the cost of what the starts' noise left uncertain.

    Attributes:
        windows: of each window, ``(W,)``.
        penalty: 2 Σ log of the inflation of each window's noise, ``(W,)``.
        degrees: degrees of freedom.
    """

    windows: np.ndarray
    penalty: np.ndarray
    degrees: float

    @property
    def chi2(self) -> float:
        """χ² of all windows."""
        return float(self.windows.sum())

    @property
    def excess(self) -> float:
        """E = χ² − degrees of freedom, with the penalty."""
        return float(self.windows.sum() + self.penalty.sum() - self.degrees)

    @property
    def reduced(self) -> float:
        """χ² per degree of freedom."""
        return self.chi2 / max(self.degrees, 1.0)


def cost_of(
    projected: np.ndarray, starts: Starts, degrees: float, caps: np.ndarray | None = None, tail: float | None = None
) -> Cost:
    """Return the cost of projected residuals ``(W, N)``.

    Args:
        projected: the residuals.
        starts: the linearisation by the starts.
        degrees: degrees of freedom of all windows.
        caps: factors of the windows' residuals, ``(W,)``.
        tail: of :meth:`Evidence.tail`; then a window with as much as noise makes still costs its degrees of freedom.
    """
    chi2 = (projected**2).sum(-1)
    weights = starts.weights
    penalty = -2 * np.log(np.where(weights > 0, weights, 1.0)).sum(-1)
    if caps is not None:
        chi2, penalty = chi2 * caps**2, penalty * caps**2
    if tail is not None:
        chi2 = tail * np.log1p(chi2 / tail) / (TAIL * np.log1p(1 / TAIL))
    return Cost(chi2, penalty, degrees)


def robust_factors(chi2: np.ndarray, tail: float | None) -> np.ndarray:
    """Return factors of the windows' residuals ``(W,)`` under which least squares has the robust cost's gradient."""
    return np.ones(len(chi2)) if tail is None else 1 / np.sqrt(1 + chi2 / tail)


def caps_of(chi2: np.ndarray, degrees: float) -> np.ndarray:
    """Return factors ``(W,)`` by which no window has more than its share of χ², however bad it is."""
    most = max(CAP * float(chi2.sum()), 10 * degrees / len(chi2))
    return np.sqrt(np.minimum(1.0, most / np.maximum(chi2, 1e-300)))
