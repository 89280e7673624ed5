"""Residuals of windows, and the normal equations of their initial states and the parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.optimizers.gauss_newton import DIFFERENCE_STEP
from dropo_torch.optimizers.least_squares import bounded_step
from dropo_torch.shooting.chain import Chain
from dropo_torch.shooting.windows import Windows

#: Scales from which on a residual counts linearly, and the share of a normal's variance that is left of it by that.
FAR, LEFT = 2.0, 0.9545
#: Standard deviation of an episode's first state, in sizes of moves, about the model's own, at rest, and what is seen.
FIRST = 0.05


def huber(residual: np.ndarray) -> np.ndarray:
    """Return the costs of scaled residuals: half their squares, linear from afar."""
    far = np.abs(residual)
    return np.where(far < FAR, 0.5 * far**2, FAR * far - 0.5 * FAR**2)


def huber_weight(residual: np.ndarray) -> np.ndarray:
    """Return the factors of scaled residuals under which squares have the gradient of :func:`huber`."""
    return np.sqrt(np.minimum(1.0, FAR / np.maximum(np.abs(residual), 1e-300)))


@dataclass(frozen=True)
class Point:
    """What is estimated: parameters in coordinates, ``(d,)``, and the windows' initial states, ``(W, nq + nv)``."""

    mean: np.ndarray
    states: np.ndarray


@dataclass(frozen=True)
class Scales:
    """By what residuals are weighed.

    Attributes:
        noise: standard deviation of each measured feature, ``(m,)``.
        link: that of a state at a window's start about the end of the window before, in sizes of moves, ``(s,)``.
    """

    noise: np.ndarray
    link: np.ndarray


@dataclass(frozen=True, eq=False)
class Residuals:
    """How far a point is off.

    Attributes:
        measured: measured minus simulated features, ``(W, H m)``; 0 in windows that diverge.
        links: moves from the end of the window before to the start of each, ``(W, s)``; of windows that follow on
            none, those from where the log and the model have them.
        ends: states at the ends, ``(W, nq + nv)``.
        lost: windows that diverge, ``(W,)`` bool.
        follows: of the windows.
    """

    measured: np.ndarray
    links: np.ndarray
    ends: np.ndarray
    lost: np.ndarray
    follows: np.ndarray

    @classmethod
    def of(
        cls, windows: Windows, states: np.ndarray, measured: np.ndarray, ends: np.ndarray, lost: np.ndarray
    ) -> Residuals:
        """Return those of initial states ``(W, nq + nv)`` with what came of them."""
        ends = np.where(lost[:, None], states, ends)
        about = np.where(windows.follows[:, None], np.roll(ends, 1, axis=0), windows.starts)
        links = windows.between(states, about)
        links[np.roll(lost, 1) & windows.follows] = 0.0
        return cls(np.where(lost[:, None], 0.0, measured), links, ends, lost, windows.follows)

    def weights(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors of both kinds of residuals, ``(W, H m)`` and ``(W, s)``, squares of which are least.

        They are inverse scales, less for what lies :data:`FAR` off: a contact that a wrong state misses must not count
        for all that moves smoothly (Huber).
        """
        repeats = self.measured.shape[1] // len(scales.noise)
        link = np.where(self.follows[:, None], scales.link, FIRST)
        kinds = (self.measured, np.tile(scales.noise, repeats)), (self.links, link)
        measured, links = (huber_weight(r / s) / s for r, s in kinds)
        return measured, links

    def costs(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """Return ½ χ² of each window's measurements and of its link, linear from afar, ``(W,)`` each."""
        repeats = self.measured.shape[1] // len(scales.noise)
        link = np.where(self.follows[:, None], scales.link, FIRST)
        kinds = (self.measured, np.tile(scales.noise, repeats)), (self.links, link)
        measured, links = (huber(residual / scale).sum(1) for residual, scale in kinds)
        return np.where(self.lost, np.inf, measured), links

    def cost(self, scales: Scales) -> tuple[int, float]:
        """Return what points compare by, smallest best: windows that diverge, then the others' costs."""
        measured, links = self.costs(scales)
        return int(self.lost.sum()), float(measured[~self.lost].sum() + links.sum())


def residuals(windows: Windows, point: Point) -> Residuals:
    """Simulate windows at a point."""
    values, parts, ends = windows.box.values(point.mean)[None], [], []
    for rows in windows.blocks(1):
        path = windows.paths(rows, point.states[rows][:, None], values)[:, 0, 0]
        parts.append(windows.residuals(rows, path).reshape(len(rows), -1))
        ends.append(path[:, -1, : point.states.shape[1]])
    found = np.concatenate(parts)
    lost = ~np.isfinite(found).all(1)
    return Residuals.of(windows, point.states, found, np.concatenate(ends), lost)


@dataclass(frozen=True, eq=False)
class Slopes:
    """Derivatives at a point, in sizes of moves and of the parameters' box.

    Attributes:
        measured: of the measured features, by the own state and the parameters, ``(W, H m, s + d)``.
        ends: of the states at the windows' ends, as moves, ``(W, s, s + d)``.
    """

    measured: np.ndarray
    ends: np.ndarray

    @property
    def simulations(self) -> int:
        """Simulations of each window that they took."""
        return int(self.measured.shape[-1])

    def of_links(self, follows: np.ndarray) -> np.ndarray:
        """Return the derivatives of links by the state of the window before and the parameters, ``(W, s, s + d)``."""
        return np.where(follows[:, None, None], -np.roll(self.ends, 1, axis=0), 0.0)


def slopes(windows: Windows, point: Point, at: Residuals) -> Slopes:
    """Take derivatives by forward differences, one simulation of each window for each number."""
    s, box, width = len(windows.sizes), windows.box, point.states.shape[1]
    step = np.where(point.mean + DIFFERENCE_STEP * box.width > box.high, -DIFFERENCE_STEP, DIFFERENCE_STEP)
    base, beside = box.values(point.mean)[None], box.values(point.mean + np.diag(step * box.width))
    measured, ends = [], []
    for rows in windows.blocks(s + len(step)):
        states, own = point.states[rows], at.measured[rows]
        tried = windows.moved(np.repeat(states[:, None], s, axis=1), DIFFERENCE_STEP * np.eye(s))
        paths = np.concatenate([
            windows.paths(rows, tried, base)[:, :, 0], windows.paths(rows, states[:, None], beside)[:, 0],
        ], axis=1)  # fmt: skip
        by = np.concatenate([np.full(s, DIFFERENCE_STEP), step])[:, None]
        found = windows.residuals(rows, paths).reshape(len(rows), len(by), -1)
        moved = windows.between(paths[:, :, -1, :width], at.ends[rows][:, None])
        good = np.isfinite(found).all(-1, keepdims=True) & ~at.lost[rows][:, None, None]
        measured.append(np.where(good, (found - own[:, None]) / by, 0.0).swapaxes(1, 2))
        ends.append(np.where(good, moved / by, 0.0).swapaxes(1, 2))
    return Slopes(np.concatenate(measured), np.concatenate(ends))


@dataclass(frozen=True, eq=False)
class Normal:
    """The normal equations of all moves and parameters, states eliminated (Schur complement).

    Attributes:
        chain: of the states.
        border: states with parameters, ``(W, s, d)``.
        force: negative gradient of the states, ``(W, s)``.
        schur: information of the parameters once states are unknown, ``(d, d)``, in widths of their box.
        pull: their negative gradient, ``(d,)``.
        shift: by which states follow the parameters, ``(W, s, d)``: −A⁻¹B.
    """

    chain: Chain
    border: np.ndarray
    force: np.ndarray
    schur: np.ndarray
    pull: np.ndarray
    shift: np.ndarray

    @classmethod
    def of(cls, at: Residuals, slope: Slopes, scales: Scales, damping: np.ndarray | float = 0.0) -> Normal:
        """Assemble them; states are damped by a share of their diagonal, one or each window's, ``(W,)``."""
        s = at.links.shape[1]
        weight, of_link = at.weights(scales)
        own, off = slope.measured * weight[..., None], at.measured * weight
        before = slope.of_links(at.follows) * of_link[..., None]
        link, both = at.links * of_link, own.swapaxes(1, 2) @ own
        pulled = -np.einsum("wni,wn->wi", own, off)
        diagonal, border, corner = both[:, :s, :s].copy(), both[:, :s, s:].copy(), both[:, s:, s:].sum(0)
        force, pull = pulled[:, :s].copy(), pulled[:, s:].sum(0)
        index = np.arange(s)
        diagonal[:, index, index] += of_link**2
        below = of_link[..., None] * before[..., :s]
        back = before.swapaxes(1, 2) @ before
        diagonal[:-1] += back[1:, :s, :s]
        border += of_link[..., None] * before[..., s:]
        border[:-1] += back[1:, :s, s:]
        corner = corner + back[:, s:, s:].sum(0)
        force -= of_link * link
        passed = np.einsum("wis,wi->ws", before, link)
        force[:-1] -= passed[1:, :s]
        pull = pull - passed[:, s:].sum(0)
        diagonal[:, index, index] *= 1 + np.reshape(damping, (-1, 1))
        chain = Chain.of(diagonal, below)
        found = chain.solve(np.concatenate([border, force[..., None]], axis=2))
        flat = border.reshape(-1, border.shape[2])
        reduced = found.reshape(-1, found.shape[2])
        schur = corner - flat.T @ reduced[:, :-1]
        return cls(chain, border, force, 0.5 * (schur + schur.T), pull - flat.T @ reduced[:, -1], -found[..., :-1])

    def step(self, windows: Windows, point: Point, damping: float) -> Point:
        """Return the point after a damped step, parameters within their box."""
        box = windows.box
        low, high = (box.low - point.mean) / box.width, (box.high - point.mean) / box.width
        change = np.clip(bounded_step(self.schur, self.pull, low, high, damping), low, high)
        moves = self.chain.solve((self.force - self.border @ change)[..., None])[..., 0]
        moves = np.clip(moves, -1.0, 1.0)
        mean = np.clip(point.mean + change * box.width, box.low, box.high)
        return replace(point, mean=mean, states=windows.moved(point.states, moves))
