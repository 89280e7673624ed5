"""BayesSim (Ramos, Possas, Fox 2019): a mixture-density network from summaries of replays to parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from dropo_torch.baselines.mixture import Mixture, fit_mixture, unlikeness
from dropo_torch.baselines.settings import BayesSimSettings
from dropo_torch.data.trajectory import Replay
from dropo_torch.distribution import DRAWN_STD, Distribution
from dropo_torch.errors import InputError
from dropo_torch.evaluator import ReplayReduce
from dropo_torch.objective import Objective
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.parameters import ParameterSpace
from dropo_torch.support.extras import require
from dropo_torch.support.random import derived_seed, draw_uniforms

#: Unlikeness above which the network has guessed outside what it was trained on.
_UNLIKE = 1.5
#: Simulations of a batch.
_BATCH = 100
#: Share of a parameter's posterior between its bounds below which the network has guessed outside its training data.
_LEAST_INSIDE = 0.01


def summary_sums(features: torch.Tensor, measured: torch.Tensor, controls: torch.Tensor) -> torch.Tensor:
    """Return the sums behind the summary statistics, of each replay and last of the log, ``((P + 1) · q,)``.

    With Δ the change of the m columns over a step and u its n controls: ΣΔ, ΣΔ² and ΣΔuᵀ, so q = 2m + mn.

    Args:
        features: replayed, ``(w, P, H, m)``.
        measured: ``(w, H, m)``.
        controls: ``(w, H, n)``.
    """
    paths = torch.cat([features, measured[:, None]], 1)
    change = paths.diff(dim=2)
    crossed = torch.einsum("wphm,whn->pmn", change, controls[:, 1:])
    return torch.cat([change.sum((0, 2)), change.square().sum((0, 2)), crossed.flatten(1)], 1).flatten()


def summaries(sums: np.ndarray, columns: int, count: int) -> np.ndarray:
    """Return mean, variance and control correlation of ``count`` changes, ``(P, q)``, from their sums ``(P, q)``."""
    first, second, crossed = np.split(sums / count, [columns, 2 * columns], axis=1)
    return np.concatenate([first, second - first**2, crossed], axis=1)


class BayesSimOptimizer(Optimizer):
    """Simulation-based inference from a uniform prior over the search box.

    The log is cut into windows of ``horizon`` steps, which are replayed *open loop* from their logged states with the
    logged actions, under parameter vectors of the prior. A replay is summarized by mean and variance of the columns'
    changes per step and their correlation with the controls, over all windows together. A network learns the
    parameters' distribution given the summary, a mixture of Gaussians; put to the log's own summary it gives the
    posterior. The result is the normal whose draws have the posterior's mean and covariance inside the box, its
    correlation included; the mixture is kept beside it. Where the log has noise, replays are measured as the log was.

    Args:
        objective: gives what varies, the compared columns and their noise.
        replay: the windows, of two steps or more.
        settings: features, simulations and size of the network.
        seed: seeds simulations and network.

    Raises:
        InputError: windows of one step; ``sbi`` is not installed.
    """

    name = "mixture-density network"
    method = "bayessim"
    STATE = ("_sums", "_logged", "_mixture", "_distance")
    KINDS = (Mixture,)

    def __init__(self, objective: Objective, replay: Replay, *, settings: BayesSimSettings, seed: int) -> None:
        require("baselines", "method: bayessim")
        if replay.horizon < 2:
            raise InputError("method: bayessim needs an episode of two transitions or more; this log has none")
        self._space, self._box, self._noise = objective.simulator.parameters, objective.box, objective.feature_noise
        self._replay, self._settings, self._seed = replay, settings, seed
        self._num_columns = objective.features.size
        self._sums: list[np.ndarray] = []  # of each batch, (n, q)
        self._logged = np.zeros(0)
        self._mixture: Mixture | None = None
        self._distance = 0.0

    def ask(self) -> Request:
        """Return the next batch of the prior, ``(n, d)``."""
        points = self._box.low + self._shares(len(self._sums)) * self._box.width
        values, reduce = self._box.values(points), self._measured(len(self._sums))
        return Request(values=values, reduce=reduce, evaluations=len(points), replay=self._replay)

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Keep the summaries; train the network on the last batch's."""
        table = sums.numpy().reshape(len(self._shares(len(self._sums))) + 1, -1)
        self._sums.append(table[:-1].copy())
        self._logged = table[-1].copy()
        if len(self._sums) * _BATCH >= self._settings.simulations:
            self._mixture, self._distance = self._infer()

    @property
    def stop_reason(self) -> str | None:
        """The network is trained; where it had to guess, this says so."""
        if self._mixture is None:
            return None
        reason = f"{self._settings.simulations} simulations of the prior are used"
        return f"{reason}; but {self.caveat}" if self.caveat else reason

    @property
    def caveat(self) -> str:
        """That the network had to guess, where it had to."""
        if self._mixture is None:
            return ""
        if self._distance > _UNLIKE:
            return (
                f"the log is unlike every simulation: its summary is {self._distance:.3g} times as far from the "
                "nearest ones as those are from each other, so the posterior is a guess"
            )
        shares = zip(self._space.names, self._mixture.shares_inside, strict=True)
        outside = ", ".join(name for name, share in shares if share < _LEAST_INSIDE)
        return outside and (
            f"that of {outside} lies outside the search box: the log is unlike every simulation, so the posterior is "
            "a guess"
        )

    @property
    def progress(self) -> Progress:
        """The share of the prior's simulations that is done."""
        return Progress("BayesSim", float("nan"), min(1.0, len(self._sums) * _BATCH / self._settings.simulations))

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return mean and standard deviations of the posterior, before it is known the prior's."""
        if self._mixture is None:
            return [(self._box.middle, self._box.width / np.sqrt(12))]
        mean, covariance = self._mixture.moments_inside
        return [(mean, np.maximum(np.sqrt(np.diag(covariance)), self._box.min_std))]

    def distributions(self, space: ParameterSpace) -> list[Distribution]:
        """Return the normal with the posterior's moments."""
        assert self._mixture is not None
        (mean, std), (_, covariance) = self.candidates()[0], self._mixture.moments_inside
        spread = np.sqrt(np.diag(covariance))
        spread = np.where(spread > 0, spread, 1.0)  # nothing correlates with what is pressed to the box's side
        correlation = covariance / np.outer(spread, spread)
        np.fill_diagonal(correlation, 1.0)
        # draws end two σ from the mean: so wide that theirs have the posterior's standard deviation
        return [Distribution.over(space, mean, std / DRAWN_STD, correlation=correlation)]

    def extras(self) -> dict[str, Any]:
        """Return the whole mixture, in coordinates, and what it was learned from."""
        assert self._mixture is not None
        return {
            "mixture": {"parameters": list(self._space.names), **self._mixture.document()},
            "share_inside": self._mixture.share_inside,
            "summary_distance": self._distance,
            "extrapolates": bool(self.caveat),
            "windows": len(self._replay.states),
            "features": self._settings.features,
            "horizon": self._replay.horizon,
            "simulations": self._settings.simulations,
        }

    def _measured(self, batch: int) -> ReplayReduce:
        """The sums of a batch's summaries, noise added to what is simulated."""
        if self._noise is None:
            return summary_sums
        noise, generator = self._noise, torch.Generator().manual_seed(derived_seed(self._seed, 19, batch))

        def reduce(features: torch.Tensor, measured: torch.Tensor, controls: torch.Tensor) -> torch.Tensor:
            drawn = noise * torch.randn(features.shape, generator=generator, dtype=features.dtype)
            return summary_sums(features + drawn, measured, controls)

        return reduce

    def _shares(self, batch: int) -> np.ndarray:
        """A batch of the prior, as shares of the search box, ``(n, d)``."""
        count = min(_BATCH, self._settings.simulations - batch * _BATCH)
        return draw_uniforms(count, len(self._space), self._seed, 13, batch).numpy()

    def _infer(self) -> tuple[Mixture, float]:
        """The posterior at the log's summary, and how far that is from the simulations'."""
        shares = np.concatenate([self._shares(i) for i in range(len(self._sums))])
        count = len(self._replay.states) * (self._replay.horizon - 1)
        found = summaries(np.concatenate([*self._sums, self._logged[None]]), self._num_columns, count)
        seed, bounds = derived_seed(self._seed, 29), (self._box.low, self._box.high)
        mixture = fit_mixture(found[:-1], shares, found[-1], settings=self._settings, seed=seed, bounds=bounds)
        return mixture, unlikeness(found[:-1], found[-1])
