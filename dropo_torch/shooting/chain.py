"""Least squares over a chain: unknowns of windows, each coupled with those of the window before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: What is added to each pivot, relative to its diagonal: a state that nothing shows stays where it is.
RIDGE = 1e-12


@dataclass(frozen=True, eq=False)
class Chain:
    """A block tridiagonal normal matrix, factored from its first window on.

    Attributes:
        below: block of each window with the one before, zero where it begins a chain, ``(W, s, s)``.
        inverse: inverse pivots, ``(W, s, s)``.
    """

    below: np.ndarray
    inverse: np.ndarray

    @classmethod
    def of(cls, diagonal: np.ndarray, below: np.ndarray) -> Chain:
        """Factor the matrix of blocks ``(W, s, s)`` on the diagonal and below it."""
        inverse, eye = np.empty_like(diagonal), np.eye(diagonal.shape[-1])
        for w, block in enumerate(diagonal):
            pivot = block + RIDGE * np.diag(block).max() * eye
            if w:
                pivot = pivot - below[w] @ inverse[w - 1] @ below[w].T
            inverse[w] = np.linalg.inv(0.5 * (pivot + pivot.T))
        return cls(below, inverse)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution ``(W, s, k)`` of right-hand sides ``(W, s, k)``."""
        out = right.copy()
        for w in range(1, len(out)):
            out[w] -= self.below[w] @ (self.inverse[w - 1] @ out[w - 1])
        for w in reversed(range(len(out))):
            if w + 1 < len(out):
                out[w] -= self.below[w + 1].T @ out[w + 1]
            out[w] = self.inverse[w] @ out[w]
        return out

    def covariances(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the inverse's blocks on the diagonal, and of each window with the one before, ``(W, s, s)`` each."""
        own, before = self.inverse.copy(), np.zeros_like(self.inverse)
        for w in reversed(range(len(own) - 1)):
            gain = self.inverse[w] @ self.below[w + 1].T
            before[w + 1] = -own[w + 1] @ gain.T
            own[w] = self.inverse[w] + gain @ own[w + 1] @ gain.T
        return own, before
