"""Conditional mixture densities p(θ | x): learned from pairs, evaluated at one x."""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import nn

from dropo_torch.baselines.mixture import Mixture
from dropo_torch.baselines.settings import BayesSimSettings
from dropo_torch.errors import InputError
from dropo_torch.objective import single_thread

_LEARNING_RATE = 5e-3
#: Epochs without a better validation loss after which training stops.
_PATIENCE = 60
#: Smallest deviation of a component, as a share of the search box.
_LEAST_DEVIATION = 1e-3
#: Standardised inputs are cut off here, so that a log unlike all simulations is not extrapolated to without bound.
_FARTHEST = 5.0
#: Share of the pairs by which training is stopped.
_VALIDATION = 0.1


class MixtureDensityNetwork(nn.Module):
    """Inputs ``(n, q)`` to a mixture of M Gaussians over d outputs, with full covariance.

    Args:
        body: makes features of the inputs.
        width: number of features.
        components: M.
        outputs: d.
    """

    def __init__(self, body: nn.Module, width: int, components: int, outputs: int) -> None:
        super().__init__()
        self._shape = (components, outputs)
        self.body = body
        triangle = outputs * (outputs - 1) // 2
        self.head = nn.Linear(width, components * (1 + 2 * outputs + triangle), dtype=torch.float64)
        with torch.no_grad():
            self.head.weight.mul_(0.1)
            start = self.head.bias[components : components * (1 + outputs)]
            start.uniform_(0.1, 0.9)  # components begin apart from each other
            self.head.bias[components * (1 + outputs) : components * (1 + 2 * outputs)].fill_(-1.5)

    def forward(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return log weights ``(n, M)``, means ``(n, M, d)`` and Cholesky factors ``(n, M, d, d)``."""
        m, d = self._shape
        logits, means, logs, lower = self.head(self.body(inputs)).split([m, m * d, m * d, m * d * (d - 1) // 2], -1)
        factor = torch.diag_embed(_LEAST_DEVIATION + torch.exp(logs.reshape(-1, m, d).clamp(max=2.0)))
        rows, columns = torch.tril_indices(d, d, -1)
        factor = factor.index_put(
            (
                torch.arange(len(inputs))[:, None, None],
                torch.arange(m)[:, None],
                rows,
                columns,
            ),
            lower.reshape(len(inputs), m, len(rows)) * 0.3,
        )
        return torch.log_softmax(logits, -1), means.reshape(-1, m, d), factor


class FourierFeatures(nn.Module):
    """Quasi-random Fourier features of a Gaussian kernel: cosines and sines at Halton frequencies, ``(n, 2F)``."""

    def __init__(self, inputs: int, frequencies: int, lengthscale: float, seed: int) -> None:
        super().__init__()
        from scipy.stats import qmc  # takes a while to import

        halton = torch.from_numpy(qmc.Halton(inputs, seed=seed).random(frequencies))
        normal = torch.special.ndtri(halton.clamp(1e-6, 1 - 1e-6))
        self.omega: torch.Tensor
        self.register_buffer("omega", normal.T / lengthscale)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return the features."""
        phase = inputs @ self.omega
        return torch.cat([phase.cos(), phase.sin()], -1)


def mixture_log_density(parts: tuple[torch.Tensor, torch.Tensor, torch.Tensor], targets: torch.Tensor) -> torch.Tensor:
    """Return log p(θ | x) of targets ``(n, d)`` under the network's mixtures, ``(n,)``."""
    weights, means, factor = parts
    white = torch.linalg.solve_triangular(factor, (targets[:, None] - means)[..., None], upper=False)[..., 0]
    log_det = torch.diagonal(factor, dim1=-2, dim2=-1).log().sum(-1)
    constant = 0.5 * targets.shape[-1] * float(np.log(2 * np.pi))
    return torch.logsumexp(weights - 0.5 * white.square().sum(-1) - log_det - constant, -1)


def fit_mixture(
    inputs: np.ndarray,
    shares: np.ndarray,
    at: np.ndarray,
    *,
    settings: BayesSimSettings,
    seed: int,
    low: np.ndarray,
    width: np.ndarray,
) -> Mixture:
    """Learn p(θ | x) from pairs and return it at one x, in coordinates.

    Args:
        inputs: x of each pair, ``(n, q)``; rows that are not finite are left out.
        shares: θ of each pair as shares of the search box, ``(n, d)``.
        at: the x of the log, ``(q,)``.
        settings: features, components and size.
        seed: seeds network and split.
        low, width: the search box, in coordinates, ``(d,)`` each.

    Raises:
        InputError: fewer than ten simulations that did not diverge.
    """
    alive = np.isfinite(inputs).all(1)
    if alive.sum() < 10:
        raise InputError(
            f"method: bayessim: only {alive.sum()} of {len(inputs)} replays did not diverge; "
            "narrow the bounds, or shorten method_options.horizon"
        )
    inputs, shares = inputs[alive], shares[alive]
    center, scale = inputs.mean(0), inputs.std(0)
    moves = scale > 1e-12 * (1 + np.abs(center))
    x = ((inputs - center) / np.where(moves, scale, 1))[:, moves].clip(-_FARTHEST, _FARTHEST)
    here = ((at - center) / np.where(moves, scale, 1))[moves].clip(-_FARTHEST, _FARTHEST)
    with torch.random.fork_rng(devices=[]), single_thread():
        torch.manual_seed(seed)
        network = _network(x, shares.shape[1], settings, seed)
        _train(network, torch.from_numpy(x), torch.from_numpy(shares), settings.epochs)
        with torch.no_grad():
            weights, means, factor = (p[0] for p in network(torch.from_numpy(here)[None]))
    root = factor.numpy() * width[:, None]
    return Mixture(
        weights=np.exp(weights.numpy()),
        means=low + means.numpy() * width,
        covariances=root @ root.transpose(0, 2, 1),
        low=low,
        high=low + width,
    )


def _network(x: np.ndarray, outputs: int, settings: BayesSimSettings, seed: int) -> MixtureDensityNetwork:
    """An untrained network with the features of the settings."""
    inputs, hidden = x.shape[1], settings.hidden
    if settings.features == "mdrff":
        lengthscale = float(torch.pdist(torch.from_numpy(x[:500])).median()) or 1.0
        body: nn.Module = FourierFeatures(inputs, hidden, lengthscale, seed)
        return MixtureDensityNetwork(body, 2 * hidden, settings.components, outputs)
    first, second = (nn.Linear(n, hidden, dtype=torch.float64) for n in (inputs, hidden))
    body = nn.Sequential(first, nn.Tanh(), second, nn.Tanh())
    return MixtureDensityNetwork(body, hidden, settings.components, outputs)


def _train(network: MixtureDensityNetwork, x: torch.Tensor, targets: torch.Tensor, epochs: int) -> None:
    """Maximise the likelihood by Adam over all pairs at once; keep the weights that are best on those held out."""
    order = torch.randperm(len(x))
    held = order[: max(1, int(_VALIDATION * len(x)))]
    kept = order[len(held) :]
    optimizer = torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE, weight_decay=1e-4)
    best, best_state, since = float("inf"), copy.deepcopy(network.state_dict()), 0
    for _ in range(epochs):
        optimizer.zero_grad()
        loss = -mixture_log_density(network(x[kept]), targets[kept]).mean()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        with torch.no_grad():
            value = float(-mixture_log_density(network(x[held]), targets[held]).mean())
        if value < best:
            best, best_state, since = value, copy.deepcopy(network.state_dict()), 0
        else:
            since += 1
        if since > _PATIENCE:
            break
    network.load_state_dict(best_state)
