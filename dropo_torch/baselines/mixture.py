"""Mixtures of Gaussians in coordinates, cut off at the search box: what BayesSim's posterior is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy.signal
import scipy.special

from dropo_torch.errors import InputError

#: Draws of the truncated mixture from which its moments are taken.
_MOMENT_DRAWS = 20_000
#: Points of a coordinate's box at which its density is looked at.
_GRID = 400


@dataclass(frozen=True)
class Mixture:
    """A mixture of M Gaussians over d coordinates, cut off at a box.

    Attributes:
        weights: ``(M,)``, summing to 1.
        means: ``(M, d)``.
        covariances: ``(M, d, d)``.
        low, high: the box, ``(d,)`` each; infinite where there is none.
    """

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def sample(self, count: int, seed: int) -> np.ndarray:
        """Return draws inside the box, ``(count, d)``.

        A mixture with next to no mass in its box is drawn from at the box's nearest points.
        """
        generator = np.random.default_rng(seed)
        kept: list[np.ndarray] = []
        for _ in range(50):
            draws = self._draws(2 * count, generator)
            kept.append(draws[self._inside(draws)])
            if sum(map(len, kept)) >= count:
                break
        else:
            kept.append(np.clip(draws, self.low, self.high))
        return np.concatenate(kept)[:count]

    @property
    def share_inside(self) -> float:
        """Share of the mixture's mass that is inside its box, from draws."""
        return float(self._inside(self._draws(_MOMENT_DRAWS, np.random.default_rng(0))).mean())

    @property
    def shares_inside(self) -> np.ndarray:
        """Share of each coordinate's own density between its bounds, ``(d,)``, exact."""
        std = np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))
        below, above = (scipy.special.ndtr((end - self.means) / std) for end in (self.low, self.high))
        return np.asarray(self.weights @ (above - below))

    def _draws(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Draws of the mixture without its box, ``(count, d)``."""
        which = generator.choice(len(self.weights), size=count, p=self.weights)
        normal = generator.standard_normal((count, self.means.shape[1]))
        return self.means[which] + np.einsum("nij,nj->ni", np.linalg.cholesky(self.covariances)[which], normal)

    def _inside(self, draws: np.ndarray) -> np.ndarray:
        return np.all((draws >= self.low) & (draws <= self.high), axis=1)

    def marginal_density(self, index: int, points: np.ndarray) -> np.ndarray:
        """Return the density of one coordinate, without its box, at points ``(n,)``, ``(n,)``."""
        std = np.sqrt(self.covariances[:, index, index])
        z = (points[:, None] - self.means[:, index]) / std
        return np.asarray(np.exp(-0.5 * z**2) / std @ self.weights / np.sqrt(2 * np.pi))

    def peaks(self, index: int) -> np.ndarray:
        """Return where one coordinate's density has peaks in its box, twice as high as what parts them or more."""
        points = np.linspace(self.low[index], self.high[index], _GRID)
        density = np.concatenate([[0.0], self.marginal_density(index, points), [0.0]])
        found, about = scipy.signal.find_peaks(density, prominence=0)
        clear = (about["prominences"] >= 0.5 * density[found]) & (density[found] > 0.1 * density.max())
        return np.asarray(points[found[clear] - 1])

    @property
    def moments_inside(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean ``(d,)`` and covariance ``(d, d)`` of the mixture inside its box, from draws."""
        draws = self.sample(_MOMENT_DRAWS, seed=0)
        return draws.mean(0), np.atleast_2d(np.cov(draws.T))

    def document(self) -> dict[str, Any]:
        """Return the mixture as plain data."""
        return {field.name: getattr(self, field.name).tolist() for field in fields(self)}

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Mixture:
        """Return the mixture of a ``fit.json``'s ``mixture``.

        Raises:
            InputError: no such entry.
        """
        names = [field.name for field in fields(cls)]
        try:
            return cls(*(np.asarray(document[name], dtype=np.float64) for name in names))
        except (KeyError, TypeError, ValueError):
            raise InputError(f"mixture: expected {', '.join(names)}, as in the fit.json of method: bayessim") from None
