"""Conditional mixture densities p(θ | x): learned from pairs by ``sbi``'s neural posterior estimation, put to one x."""

from __future__ import annotations

import contextlib
import functools
import io
import math
import warnings
from typing import TYPE_CHECKING

import numpy as np
import scipy.spatial
import torch
from torch import nn

from dropo_torch.baselines.mixture import Mixture
from dropo_torch.baselines.settings import BayesSimSettings
from dropo_torch.errors import InputError
from dropo_torch.support.threads import single_thread

if TYPE_CHECKING:
    from sbi.neural_nets.estimators.mixture_density_estimator import MixtureDensityEstimator

#: Training stops after so many epochs without a better loss on the share of the pairs that is held out.
_TRAINING = {"training_batch_size": 100, "learning_rate": 2e-3, "validation_fraction": 0.1, "stop_after_epochs": 40}
#: Standardised inputs are cut off here, so that a log unlike all simulations is not extrapolated to without bound.
FARTHEST = 5.0
#: The neighbour to which distances are measured.
_NEIGHBOURS = 5
#: Directions in which simulations differ by less than this share of the largest count as none, as the smallest noise
#: would be far there; and there is at most one for so many simulations, as few do not show how far apart they are.
_FLAT, _ROWS_PER_DIRECTION = 1e-2, 5
#: Interquartile range of a standard normal.
_QUARTILES = 1.349
#: Added to the precisions, as by the network itself: no component is wider than a hundred σ of the prior.
_PRECISION_FLOOR = 1e-4
#: Standard deviation of a share that is uniform in [0, 1].
_UNIFORM = 12**-0.5

Bounds = tuple[np.ndarray, np.ndarray]


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
    the simulator explains is seldom above 1. Distances are those of standardised and then whitened columns, so that a
    summary between the simulations, but off the surface on which they lie, is far. Columns that no simulation moves do
    not count, as the network does not see them.

    Args:
        inputs: x of the simulations, ``(n, q)``; rows that are not finite are left out.
        at: the log's, ``(q,)``.
    """
    alive = inputs[np.isfinite(inputs).all(1)]
    if len(alive) <= _NEIGHBOURS:
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
    among = tree.query(tree.data, k=_NEIGHBOURS + 1)[0][:, -1]  # the nearest of all is the point itself
    nearest = tree.query((here - mean) @ white, k=_NEIGHBOURS)[0][-1]
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
    network = MultivariateGaussianMDN(
        features=theta.shape[1],
        context_features=x.shape[1],
        hidden_features=features,
        num_components=settings.components,
        hidden_net=body,
        custom_initialization=True,
    )
    return MixtureDensityEstimator(network, input_shape=theta[0].shape, condition_shape=x[0].shape)


def _float(values: np.ndarray) -> torch.Tensor:
    """The network's single precision."""
    return torch.from_numpy(values).to(torch.float32)
