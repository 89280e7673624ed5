"""How far hypotheses are from the log: windows with free initial states, whitened by the noise.

Each window's initial state is unknown: what was measured there is one more noisy observation. Of the residuals
r = [(y₀ − x₀)/σ, (y_k − f_k(x₀, θ))/σ] the part that a change of x₀ explains to first order is projected away, with
P = I − QQᵀ from the QR factors of ∂r/∂x₀. What is left, P r, is compared between hypotheses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dropo_torch.data.features import Features
from dropo_torch.effects.engine import Variant
from dropo_torch.gap.apart import Limbs
from dropo_torch.gap.rules import Rules, Weighed
from dropo_torch.gap.twin import Twin, Windows
from dropo_torch.support.rows import evenly

#: Antithetic pairs of noise on the initial states by which rough windows are linearized, and a few that are far off;
#: their seed.
PAIRS, MORE, SEED = 16, 48, 11
#: Share of the windows that may be odd; where more are, it is not the noise of their initial states.
ODD = 0.3
#: Whitened residual of a window whose simulation diverged, at least.
LOST = 1e3


@dataclass(frozen=True)
class Linearization:
    """A hypothesis to first order in its windows' initial states.

    Attributes:
        basis: orthonormal columns that a change of the initial states spans, ``(W, N, m)``; N = (L + 1)·m.
        weights: factors of the whitened residuals, ``(W, N)``: below 1 where noise on the initial state bends the
            simulation, 0 where nothing is known, such as all of a window under commands from before the log.
        shift: mean residual minus the residual at the measured initial state, ``(W, N)``.
        roughness: share of residuals whose variance the linear part does not explain.
    """

    basis: np.ndarray
    weights: np.ndarray
    shift: np.ndarray
    roughness: float

    @property
    def num_features(self) -> int:
        """Features m of which the windows have measurements."""
        return int(self.basis.shape[-1])

    @property
    def counted(self) -> np.ndarray:
        """Which windows count at all, ``(W,)`` bool."""
        return np.asarray((self.weights > 0).any(-1))

    def select(self, rows: np.ndarray) -> Linearization:
        """Return that of some of the windows."""
        return replace(self, basis=self.basis[rows], weights=self.weights[rows], shift=self.shift[rows])


@dataclass(frozen=True)
class Evidence:
    """Residuals of hypotheses on windows of a log.

    Attributes:
        twin: simulates hypotheses.
        windows: the stretches of the log.
        noise: standard deviation of the measurement of each feature, ``(m,)``.
        begin: the model as given: where a simulation diverges, this was no worse.
        rough: linearize statistically, over draws of noise on the initial states, as contacts need it.
        model_error: by how much the model's own error exceeds the noise in each residual of a window, ``(N,)``.
        robust: whether windows that are far off count by the logarithm of their χ² only (a Cauchy cost): what is named
            must then be right in most windows, and otherwise explain all of them together.
        caps: factors of the windows' residuals in fits, ``(W,)``, or 1.
        rules: thresholds.
        whole: whether masked columns are compared, too.
    """

    twin: Twin
    windows: Windows
    noise: np.ndarray
    begin: Variant
    rough: bool
    model_error: np.ndarray | float = 1.0
    robust: bool = False
    caps: np.ndarray | float = 1.0
    rules: Rules = field(default_factory=Rules)
    whole: bool = False

    def on(self, windows: Windows) -> Evidence:
        """Return the same over other windows, none of them capped."""
        same = windows.length == self.windows.length
        return replace(self, windows=windows, model_error=self.model_error if same else 1.0, caps=1.0)

    def select(self, rows: np.ndarray) -> Evidence:
        """Return the same over some of the windows."""
        return replace(self.on(self.windows.select(rows)), caps=np.broadcast_to(self.caps, len(self.windows))[rows])

    def few(self, most: int) -> Evidence:
        """Return the same over at most so many windows, evenly spread."""
        return self.select(evenly(len(self.windows), most))

    @cached_property
    def chart(self) -> Features:
        """The features that are compared."""
        setting = self.twin.setting
        return Features.of(setting.observation, frozenset() if self.whole else setting.masked)

    @cached_property
    def noises(self) -> np.ndarray:
        """Noise of each feature at each instant of the windows, ``(W, L + 1, m)``."""
        gains = 1.0 if self.windows.gains is None else self.chart.gains(self.windows.gains)
        return np.broadcast_to(self.noise * gains, (len(self.windows), self.windows.length + 1, self.chart.size))

    @property
    def num_rows(self) -> int:
        """Residuals of a window."""
        return (self.windows.length + 1) * self.chart.size

    @cached_property
    def lost(self) -> np.ndarray:
        """Whitened residual of each window where its simulation diverged: as large as the given model's, ``(W,)``.

        No hypothesis gains by diverging where it was only far off; where the given model itself diverges, that counts
        like the worst of the other windows.
        """
        found = np.abs(self.residuals([self.begin])[0][0]).max(-1)
        seen = found[np.isfinite(found)]
        return np.maximum(np.where(np.isfinite(found), found, seen.max(initial=0.0)), LOST)

    def tail(self, linear: Linearization) -> float | None:
        """χ² of a window from which on the cost grows slowly; ``None`` where it never does."""
        return self.rules.weighed.tail * self.degrees(linear) / len(self.windows) if self.robust else None

    def residuals(
        self, variants: Sequence[Variant], moved: np.ndarray | None = None, pushes: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals ``(K, W, N)``, NaN where lost, and whether each is known.

        Args:
            variants: hypotheses.
            moved: changes of the initial states in units of the noise, ``(K, W, m)`` or ``(K, 1, m)``.
            pushes: see :meth:`Twin.predict`.
        """
        measured, shape = self.windows.measured, (len(variants), len(self.windows))
        initial = None
        if moved is not None:
            change = np.broadcast_to(moved * self.noises[:, 0], (*shape, self.chart.size))
            initial = self.chart.move(self.windows.begins, change)
        columns, valid = self.twin.predict(variants, self.windows, initial, pushes)
        with np.errstate(invalid="ignore"):
            residual = self.chart.difference(measured, columns) / self.noises
        known = self.chart.known(valid).reshape(*shape, self.num_rows)
        return np.where(known, residual.reshape(known.shape) / self.model_error, 0.0), known

    def changes(
        self, own: Variant, at: np.ndarray, others: Sequence[Variant], moved: np.ndarray | None = None,
        pushes: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Return by how much residuals of hypotheses differ from those of one that is near, ``(K, W, N)``.

        They are taken where simulations cost less, if there is such a place: see :meth:`Effect.eased` and
        :attr:`Twin.eased`.

        Args:
            own: the one that is near.
            at: its residuals, ``(W, N)``.
            others: the hypotheses, K of them, with
            moved, pushes: see :meth:`residuals`.
        """
        setting, near = self.twin.setting, replace(self, twin=self.twin.eased)
        easy = own.eased(setting)
        if easy != own or near.twin is not self.twin:
            at = near.residuals([easy])[0][0]
        return near.beside(easy, at, [v.eased(setting) for v in others], moved, pushes) - at

    def beside(
        self, own: Variant, at: np.ndarray, others: Sequence[Variant], moved: np.ndarray | None = None,
        pushes: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Return residuals of hypotheses ``(K, W, N)`` near one, several at once where these change different limbs.

        Args:
            own: the one that is near.
            at: its residuals, ``(W, N)``.
            others: the hypotheses, K of them, with
            moved, pushes: see :meth:`residuals`.
        """
        limbs = None if pushes is not None else Limbs.of(self.twin.setting, self.chart, self.twin.effects(own))
        if limbs is None:
            return self.residuals(others, moved, pushes)[0]
        return limbs.residuals(own, at, others, moved, lambda some, starts: self.residuals(some, starts)[0])

    def linearize(self, variant: Variant) -> Linearization:
        """Return how a hypothesis' residuals depend on the initial states."""
        found = self._statistical(variant) if self.rough else self._where_needed(variant)
        return self.counting(found, variant)

    def counting(self, linear: Linearization, variant: Variant) -> Linearization:
        """Return a linearization without windows in which commands act that a hypothesis cannot know from the log."""
        known = self.twin.knows(variant, self.windows)
        return linear if known.all() else replace(linear, weights=linear.weights * known[:, None])

    def _where_needed(self, variant: Variant) -> Linearization:
        """By differences, but by draws the windows far off beside the others, where stops or contacts may be why.

        There, noise on the initial state that no derivative sees may move an impact from one step to the next. Where
        windows begin as fits them best, those count that have more than chance lets them have beside the others, and
        draws of what they leave open.
        """
        linear, _, residual = self._by_differences(variant)
        if not self.twin.setting.has_impacts:
            return linear
        chi2 = (self.project(residual, linear) ** 2).sum(-1)
        far = chi2 > self.rules.sound.wrong * max(float(np.median(chi2)), float(self.num_rows))
        linear = self._replaced(linear, np.flatnonzero(far), lambda part: part._statistical(variant, MORE))
        if self.windows.starts is None:
            return linear
        odd = ~far & ~are_calm(chi2, (linear.weights > 0).sum(-1) - self.chart.size, self.rules.weighed)
        few = odd.mean() <= ODD
        return self._replaced(linear, np.flatnonzero(odd & few), lambda part: part._as_far_as_known(variant))

    def _replaced(
        self, linear: Linearization, rows: np.ndarray, better: Callable[[Evidence], Linearization]
    ) -> Linearization:
        """A linearization with a better one of some windows."""
        if not rows.size:
            return linear
        bent = better(self.select(rows))
        arrays = {name: getattr(linear, name).copy() for name in ("basis", "weights", "shift")}
        for name, values in arrays.items():
            values[rows] = getattr(bent, name)
        return replace(linear, **arrays)

    def _by_differences(self, variant: Variant) -> tuple[Linearization, np.ndarray, np.ndarray]:
        """The linearization, derivatives ``(W, N, m)``, and residuals ``(W, N)`` at the windows' starts."""
        m = self.chart.size
        (residual,), (known,) = self.residuals([variant])
        changes = self.changes(variant, residual, [variant] * m, np.eye(m)[:, None])
        slope = np.moveaxis(np.nan_to_num(changes), 0, -1)
        weights = known.astype(float)
        linear = Linearization(np.linalg.qr(slope)[0], weights, np.zeros(weights.shape), 0.0)
        return linear, slope, np.nan_to_num(residual, nan=LOST)

    def _as_far_as_known(self, variant: Variant) -> Linearization:
        """Differences along what a window leaves open of its initial state, and what draws of it leave beside these.

        The whole window tells its initial state more precisely than the one row that was measured there; what the
        simulation bends within that adds to the noise.
        """
        linear, slope, here = self._by_differences(variant)
        _, sizes, axes = np.linalg.svd(slope, full_matrices=False)
        open_ = np.swapaxes(axes, 1, 2) / np.maximum(sizes, 1.0)[:, None]  # (W, m, m), no wider than the noise
        half = np.random.default_rng(SEED).standard_normal((PAIRS, slope.shape[-1]))
        draws = np.concatenate([half, -half])
        moved = np.concatenate([np.moveaxis(open_, -1, 0), np.einsum("wmk,dk->dwm", open_, draws)])
        found, _ = self.residuals([variant] * len(moved), moved)
        changes = np.nan_to_num(found, nan=LOST) - here
        along, left = np.moveaxis(changes[: len(open_[0])], 0, -1), changes[len(open_[0]) :]
        left = left - np.einsum("wnk,dk->dwn", along, draws)
        return _bent(along, left, linear.weights, len(draws))

    def _statistical(self, variant: Variant, pairs: int = PAIRS) -> Linearization:
        """Regress the residuals on draws of noise on the initial states; what is left over adds to the noise."""
        m = self.chart.size
        half = np.random.default_rng(SEED).standard_normal((pairs, m))
        draws = np.concatenate([half, -half])
        found, known = self.residuals([variant] * (len(draws) + 1), np.concatenate([np.zeros((1, m)), draws])[:, None])
        found = np.nan_to_num(found, nan=LOST)
        center = found[1:].mean(0)
        flat = found[1:] - center
        slope = np.einsum("dk,dwn->wnk", np.linalg.pinv(draws).T, flat)
        left = flat - np.einsum("wnk,dk->dwn", slope, draws) + center - found[0]
        return _bent(slope, left, known[0], len(draws) - m)

    def project(self, residuals: np.ndarray, linear: Linearization) -> np.ndarray:
        """Return the part ``(..., W, N)`` of residuals that no initial states explain; what diverges is lost."""
        finite = np.isfinite(residuals).all(-1, keepdims=True)
        found = _beside(linear, np.where(finite, residuals + linear.shift, 0.0))
        return found if finite.all() else np.where(finite, found, self.lost[:, None] * (linear.weights > 0))

    def project_slope(self, slope: np.ndarray, linear: Linearization) -> np.ndarray:
        """Return :meth:`project` of derivatives ``(..., W, N)``; none where a window diverges."""
        return _beside(linear, np.where(np.isfinite(slope).all(-1, keepdims=True), slope, 0.0))

    def degrees(self, linear: Linearization) -> float:
        """Return the degrees of freedom that the windows have beside their initial states, as if all were counted."""
        counted = float(linear.counted.sum())
        known = float((linear.weights > 0).sum()) - counted * self.chart.size
        return known * len(self.windows) / max(counted, 1.0)

    def cost(self, projected: np.ndarray, linear: Linearization, numbers: int = 0) -> Cost:
        """Return the cost of projected residuals ``(W, N)`` to which some numbers were fitted."""
        degrees, tail = self.degrees(linear) - numbers, self.tail(linear)
        return cost_of(projected, linear, degrees, self.caps, tail, self.rules.weighed)


def _bent(slope: np.ndarray, left: np.ndarray, known: np.ndarray, degrees: int) -> Linearization:
    """The linearization with slopes ``(W, N, k)``, where ``(D, W, N)`` is left of draws, of so many degrees."""
    center = left.mean(0)
    variance = ((left - center) ** 2).sum(0) / degrees
    variance[variance < 0.01] = 0.0
    weights = known / np.sqrt(1 + 1.5 * variance)
    basis, _ = np.linalg.qr(slope * weights[..., None])
    shift = np.where(variance > 0, center, 0.0)
    return Linearization(basis, weights, np.clip(shift, -LOST, LOST), float((variance > 1).mean()))


def _beside(linear: Linearization, vectors: np.ndarray) -> np.ndarray:
    """Return the part of weighted vectors ``(..., W, N)`` outside the span of the basis."""
    weighted = vectors * linear.weights
    (*others, num_w, size), basis = weighted.shape, linear.basis
    rows = weighted.reshape(math.prod(others), num_w, size).swapaxes(0, 1)  # by windows, which have a basis each
    along = (rows @ basis) @ basis.swapaxes(1, 2)
    return weighted - along.swapaxes(0, 1).reshape(weighted.shape)


@dataclass(frozen=True)
class Cost:
    """The misfit of a hypothesis: χ² of each window, with the cost of what the initial states left uncertain.

    Attributes:
        windows: of each window, ``(W,)``.
        penalty: 2 Σ log of the inflation of each window's noise, ``(W,)``.
        degrees: degrees of freedom; those of capped windows count as much as their χ².
    """

    windows: np.ndarray
    penalty: np.ndarray
    degrees: float

    @property
    def chi2(self) -> float:
        """χ² of all windows."""
        return float(self.windows.sum())

    @property
    def misfit(self) -> float:
        """χ² − degrees of freedom: what is left above noise, which the initial states may have inflated."""
        return float(self.windows.sum() - self.degrees)

    @property
    def excess(self) -> float:
        """E = χ² − degrees of freedom, with the penalty, by which hypotheses compare.

        One that is right has its penalty left, so by itself it says nothing: see :attr:`misfit` and :meth:`left_of`.
        """
        return self.misfit + float(self.penalty.sum())

    def above(self, other: Cost) -> float:
        """Return the excess over that of a hypothesis which is right and inflates the noise as another one does."""
        return self.excess - float(other.penalty.sum())

    def left_of(self, other: Cost) -> float:
        """Return the share of another hypothesis' excess that this one leaves; infinite where there is none."""
        whole = other.above(self)
        return max(self.misfit, 0.0) / whole if whole > 0 else np.inf

    @property
    def reduced(self) -> float:
        """χ² per degree of freedom."""
        return self.chi2 / max(self.degrees, 1.0)

    @property
    def sigma(self) -> float:
        """Standard deviation of χ² where only noise is left."""
        return float(np.sqrt(2 * max(self.degrees, 1.0)))


def cost_of(
    projected: np.ndarray, linear: Linearization, degrees: float, caps: np.ndarray | float = 1.0,
    tail: float | None = None, weighed: Weighed | None = None,
) -> Cost:  # fmt: skip
    """Return the cost of projected residuals ``(W, N)``.

    Windows that do not count cost as much as the others do on average, so that costs of the same windows compare.

    Args:
        projected: the residuals.
        linear: the linearization in the initial states.
        degrees: degrees of freedom of all windows.
        caps: factors of the windows' residuals, ``(W,)``.
        tail: of :meth:`Evidence.tail`; then a window with as much as noise makes still costs its degrees of freedom.
        weighed: thresholds; the defaults if not given.
    """
    weighed = weighed or Weighed()
    weights = np.where(linear.weights > 0, linear.weights, 1.0)
    chi2, penalty = (projected**2).sum(-1) * caps**2, -2 * np.log(weights).sum(-1) * caps**2
    degrees *= float(np.mean(np.square(caps)))  # as χ² itself: what is left is noise or not, however windows are capped
    if tail is not None:
        chi2 = robust_loss(chi2, tail) / (weighed.tail * np.log1p(1 / weighed.tail))
    counted = linear.counted
    if not counted.all():
        judged = counted.mean() >= weighed.known
        chi2 = np.where(counted, chi2, chi2[counted].mean() if judged else LOST**2 * projected.shape[-1])
        penalty = np.where(counted, penalty, penalty[counted].mean() if judged else 0.0)
    return Cost(chi2, penalty, degrees)


def robust_loss(chi2: np.ndarray, tail: float | None) -> np.ndarray:
    """Return the windows' Cauchy cost ``(W,)``; χ² itself without a tail."""
    return chi2 if tail is None else tail * np.log1p(chi2 / tail)


def robust_factors(chi2: np.ndarray, tail: float | None) -> np.ndarray:
    """Return factors of the windows' residuals ``(W,)`` under which least squares has the robust cost's gradient."""
    return np.ones(len(chi2)) if tail is None else 1 / np.sqrt(1 + chi2 / tail)


def caps_of(chi2: np.ndarray, degrees: float, cap: float) -> np.ndarray:
    """Return factors ``(W,)`` by which no window has more than its share ``cap`` of χ², however bad it is."""
    most = max(cap * float(chi2.sum()), 10 * degrees / len(chi2))
    return np.sqrt(np.minimum(1.0, most / np.maximum(chi2, 1e-300)))


def are_calm(chi2: np.ndarray, degrees: np.ndarray, weighed: Weighed) -> np.ndarray:
    """Return which windows have no more than chance lets them have beside the median one, ``(W,)`` bool.

    Args:
        chi2: of the windows, ``(W,)``.
        degrees: degrees of freedom of each, ``(W,)``.
        weighed: thresholds.
    """
    reduced = chi2 / np.maximum(degrees, 1)
    told = degrees > 0
    typical = np.median(reduced[told]) if told.any() else np.inf
    return np.asarray(told & (reduced <= typical * (1 + weighed.calm * np.sqrt(2 / np.maximum(degrees, 1)))))
