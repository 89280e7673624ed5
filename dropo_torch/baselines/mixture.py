"""Mixtures of Gaussians cut off at the search box and how one is learned: p(θ | x) by ``sbi`` from pairs, at one x."""

from __future__ import annotations

import contextlib
import functools
import io
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.signal
import scipy.spatial
import scipy.special
import torch
from torch import nn

from dropo_torch.baselines.settings import BayesSimSettings
from dropo_torch.errors import InputError
from dropo_torch.support.threads import single_thread

if TYPE_CHECKING:
    from sbi.neural_nets.estimators.mixture_density_estimator import MixtureDensityEstimator

#: Training stops after so many epochs without a better loss on the share of the pairs that is held out.
_TRAINING = {"training_batch_size": 100, "learning_rate": 2e-3, "validation_fraction": 0.1, "stop_after_epochs": 40}
#: Standardized inputs are cut off here, so that a log unlike all simulations is not extrapolated to without bound.
FARTHEST = 5.0
#: The neighbor to which distances are measured.
_NEIGHBORS = 5
#: Directions in which simulations differ by less than this share of the largest count as none, as the smallest noise
#: would be far there; and there is at most one for so many simulations, as few do not show how far apart they are.
_FLAT, _ROWS_PER_DIRECTION = 1e-2, 5
#: Interquartile range of a standard normal.
_QUARTILES = 1.349
#: Added to the precisions, as by the network itself: no component is wider than a hundred σ of the prior.
_PRECISION_FLOOR = 1e-4
#: Standard deviation of a share that is uniform in [0, 1].
_UNIFORM = 12**-0.5

#: Draws of the truncated mixture from which its moments are taken.
_MOMENT_DRAWS = 20_000
#: Points of a coordinate's box at which its density is looked at.
_GRID = 400

Bounds = tuple[np.ndarray, np.ndarray]


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


class FourierFeatures(nn.Module):
    """Quasi-random Fourier features of a Gaussian kernel: cosines and sines at Halton frequencies, ``(n, 2F)``."""

    def __init__(self, inputs: int, frequencies: int, lengthscale: float, seed: int) -> None:
        super().__init__()
        from scipy.stats import qmc  # takes a while to import

        halton = torch.from_numpy(qmc.Halton(inputs, seed=seed).random(frequencies))
        normal = torch.special.ndtri(halton.clamp(1e-6, 1 - 1e-6))
        self.omega: torch.Tensor
        self.register_buffer("omega", (normal.T / lengthscale).to(torch.float32))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return the features."""
        phase = inputs @ self.omega
        return torch.cat([phase.cos(), phase.sin()], -1)


def fit_mixture(
    inputs: np.ndarray, shares: np.ndarray, at: np.ndarray, *, settings: BayesSimSettings, seed: int, bounds: Bounds
) -> Mixture:
    """Learn p(θ | x) from pairs and return it at one x, in coordinates.

    Args:
        inputs: x of each pair, ``(n, q)``; rows that are not finite are left out.
        shares: θ of each pair as shares of the search box, ``(n, d)``.
        at: the x of the log, ``(q,)``.
        settings: features, components and size.
        seed: seeds network and split.
        bounds: low and high of the search box, in coordinates, ``(d,)`` each.

    Raises:
        InputError: fewer than ten simulations did not diverge.
    """
    alive = np.isfinite(inputs).all(1)
    if alive.sum() < 10:
        raise InputError(
            f"method: bayessim: only {alive.sum()} of {len(inputs)} replays did not diverge; "
            "narrow the bounds, or shorten method_options.horizon"
        )
    inputs, shares = inputs[alive], shares[alive]
    center, scale, moves = _standard(inputs)
    x, here = (((rows - center) / scale)[..., moves].clip(-FARTHEST, FARTHEST) for rows in (inputs, at))
    with torch.random.fork_rng(devices=[]), single_thread():
        torch.manual_seed(seed)
        estimator = _train(_float(x), _float((shares - 0.5) / _UNIFORM), settings, seed)
        with torch.no_grad():
            mixture = estimator.net(_float(here)[None])
    low, width = bounds[0], bounds[1] - bounds[0]
    factor = mixture.precision_factors[0].double().numpy()
    precision = factor.transpose(0, 2, 1) @ factor + _PRECISION_FLOOR * np.eye(len(width))
    covariance = np.linalg.inv(precision) * _UNIFORM**2 * np.outer(width, width)
    weights = torch.softmax(mixture.logits[0].double(), -1).numpy()
    means = low + (0.5 + mixture.means[0].double().numpy() * _UNIFORM) * width
    return Mixture(weights, means, 0.5 * (covariance + covariance.transpose(0, 2, 1)), low, low + width)


def unlikeness(inputs: np.ndarray, at: np.ndarray) -> float:
    """Return how far a log's x is from the simulations', compared with how far they are from each other.

    That is its distance to the fifth nearest simulation over the distance that 99 % of them have to theirs: a log that
    the simulator explains is seldom above 1. Distances are those of standardized and then whitened columns, so that a
    summary between the simulations, but off the surface on which they lie, is far. Columns that no simulation moves do
    not count, as the network does not see them.

    Args:
        inputs: x of the simulations, ``(n, q)``; rows that are not finite are left out.
        at: the log's, ``(q,)``.
    """
    alive = inputs[np.isfinite(inputs).all(1)]
    if len(alive) <= _NEIGHBORS:
        return float("inf")
    center, scale, moves = _standard(alive)
    if not moves.any():
        return 0.0
    rows, here = ((alive - center) / scale)[:, moves].clip(-FARTHEST, FARTHEST), ((at - center) / scale)[moves]
    mean = rows.mean(0)
    _, size, directions = np.linalg.svd(rows - mean, full_matrices=False)
    kept = (size > _FLAT * size[0]) & (np.arange(len(size)) < max(1, len(rows) // _ROWS_PER_DIRECTION))
    white = directions[kept].T / size[kept] * math.sqrt(len(rows))
    tree = scipy.spatial.KDTree((rows - mean) @ white)
    among = tree.query(tree.data, k=_NEIGHBORS + 1)[0][:, -1]  # the nearest of all is the point itself
    nearest = tree.query((here - mean) @ white, k=_NEIGHBORS)[0][-1]
    return float(nearest / np.quantile(among, 0.99))


def _standard(inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median and robust σ of each column, which a few wild simulations do not move, and which columns vary."""
    center = np.median(inputs, axis=0)
    quartiles = np.diff(np.quantile(inputs, [0.25, 0.75], axis=0), axis=0)[0] / _QUARTILES
    scale = np.where(quartiles > 0, quartiles, inputs.std(0))
    moves = scale > 1e-12 * (1 + np.abs(center))
    return center, np.where(moves, scale, 1.0), moves


def _train(x: torch.Tensor, theta: torch.Tensor, settings: BayesSimSettings, seed: int) -> MixtureDensityEstimator:
    """The network, trained on all pairs but those held out; the weights that are best on those are kept."""
    build = functools.partial(_estimator, settings=settings, seed=seed)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")  # that ``epochs`` came first, and imports of old names
        from sbi.inference import NPE
        from sbi.sbi_types import Tracker

        silent = type("NoTracker", (Tracker,), {})()  # sbi would otherwise write into the working directory
        trainer = NPE(density_estimator=build, show_progress_bars=False, tracker=silent)
        trainer.append_simulations(theta, x)
        return trainer.train(**_TRAINING, max_num_epochs=settings.epochs)


def _estimator(theta: torch.Tensor, x: torch.Tensor, settings: BayesSimSettings, seed: int) -> MixtureDensityEstimator:
    """An untrained network with the features of the settings."""
    from sbi.neural_nets.estimators.mixture_density_estimator import MixtureDensityEstimator, MultivariateGaussianMDN

    body, features = None, settings.hidden
    if settings.features == "mdrff":
        lengthscale = float(torch.pdist(x[:500]).median()) or 1.0
        body, features = FourierFeatures(x.shape[1], settings.hidden, lengthscale, seed), 2 * settings.hidden
    sizes = {"features": theta.shape[1], "context_features": x.shape[1], "hidden_features": features}
    sizes["num_components"] = settings.components
    network = MultivariateGaussianMDN(**sizes, hidden_net=body, custom_initialization=True)
    return MixtureDensityEstimator(network, input_shape=theta[0].shape, condition_shape=x[0].shape)


def _float(values: np.ndarray) -> torch.Tensor:
    """The network's single precision."""
    return torch.from_numpy(values).to(torch.float32)
