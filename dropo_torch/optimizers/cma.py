"""CMA-ES over normalised φ, as in the paper, by pycma."""

from __future__ import annotations

import pickle
from typing import Any

import cma
import numpy as np
import torch

from dropo_torch.distribution import Distribution, SearchBox, values_from_uniforms
from dropo_torch.objective import Objective, draw_uniforms
from dropo_torch.optimizers.base import Optimizer, Progress, Request, entropy_of
from dropo_torch.parameters import ParameterSpace


class Normals:
    """Standard normals for pycma from a generator of their own, which travels with a checkpoint."""

    def __init__(self, seed: int) -> None:
        self.generator = np.random.default_rng(seed)

    def __call__(self, *shape: int) -> np.ndarray:
        """Return standard normals of a shape."""
        return self.generator.standard_normal(shape)


class CMAOptimizer(Optimizer):
    """CMA-ES on the sampled objective: means linear, deviations logarithmic, all in [0, 4], step 1.

    Args:
        objective: gives the reduction; it is not evaluated here.
        samples: parameter vectors K of each φ.
        seed: seeds the search and the samples.
        budget: evaluations of the objective after which it stops.
        population: φ per generation; ``None`` for pycma's choice.
        common_random_numbers: the same base uniforms in every generation instead of fresh ones.
        entropy: weight of Σ log σ, which is added to the log-likelihood.
    """

    name = "cma"

    def __init__(
        self,
        objective: Objective,
        *,
        samples: int,
        seed: int,
        budget: int,
        population: int | None = None,
        common_random_numbers: bool = False,
        entropy: float = 0.0,
    ) -> None:
        self._entropy = entropy
        self._objective = objective
        self._space: ParameterSpace = objective.simulator.parameters
        self._box = SearchBox.of(self._space)
        self._samples, self._seed, self._budget = samples, seed, budget
        self._common = common_random_numbers
        self._noisy = objective.noise is not None
        options = {
            "bounds": [0, SearchBox.WIDTH],
            "randn": Normals(seed),
            "seed": np.nan,  # the generator above is the only source of randomness
            "verbose": -9,
            "verb_log": 0,
            "verb_disp": 0,
            "maxfevals": budget,
            "tolfun": 1e-3,
            "tolfunhist": 1e-4,
            "tolstagnation": 200,
        }
        if population is not None:
            options["popsize"] = population
        dim = 2 * len(self._space)
        self._search = cma.CMAEvolutionStrategy(np.full(dim, SearchBox.WIDTH / 2), 1.0, options)
        self._asked: list[np.ndarray] | None = None
        self._best = -np.inf
        self._best_phi: np.ndarray | None = None

    def ask(self) -> Request:
        """Return the samples of a generation, ``(population · K, d)``."""
        if self._asked is None:
            self._asked = self._search.ask()
        mean, std = self._box.denormalise(np.array(self._asked))
        generation = 0 if self._common else self._search.countiter
        uniforms = draw_uniforms(self._samples, len(self._space), self._seed, 1, generation)
        mu, sigma = (torch.from_numpy(x)[:, None] for x in (mean, std))
        values = values_from_uniforms(uniforms, mu, sigma, self._space.limits, self._space.is_log)
        return Request(
            values=values.reshape(-1, len(self._space)).numpy(),
            reduce=self._objective.likelihood_reduction(len(mean)),
            evaluations=len(mean),
            linearise_at=self._center() if self._noisy else None,
        )

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Rank the generation by its log-likelihoods."""
        assert self._asked is not None
        std = self._box.denormalise(np.array(self._asked))[1]
        values = sums[: len(self._asked)].numpy() + self._entropy * np.log(std).sum(-1)
        best = int(np.argmax(values))
        if values[best] > self._best:
            self._best, self._best_phi = float(values[best]), np.array(self._asked[best])
        self._search.tell(self._asked, list(-values))
        self._asked = None

    @property
    def stop_reason(self) -> str | None:
        """Pycma's termination conditions, in words."""
        met = self._search.stop()
        if not met:
            return None
        words = {
            "maxfevals": f"the budget of {self._budget} evaluations is spent",
            "tolfun": "the likelihood no longer differs within a generation",
            "tolfunhist": "the best likelihood no longer changes",
            "tolx": "the search distribution has shrunk to a point",
            "tolstagnation": "the likelihood has not improved for long",
            "tolflatfitness": "the likelihood is flat",
        }
        return "; ".join(words.get(k, f"pycma stopped: {k}") for k in met)

    @property
    def progress(self) -> Progress:
        """Best sampled log-likelihood and the share of the budget that is spent."""
        best = self._best if np.isfinite(self._best) else float("nan")
        return Progress("CMA-ES", best, min(1.0, self._search.countevals / self._budget))

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the search distribution's mean and the best φ that was evaluated."""
        found = [np.asarray(self._search.result.xfavorite)]
        if self._best_phi is not None:
            found.append(self._best_phi)
        return [self._box.denormalise(phi) for phi in found]

    def extras(self) -> dict[str, Any]:
        """Return the weight of the entropy, where there is one."""
        return {"entropy": self._entropy} if self._entropy else {}

    def bonus(self, distribution: Distribution) -> float:
        """Return the weighted entropy."""
        return self._entropy * entropy_of(distribution) if self._entropy else 0.0

    def state(self) -> dict[str, Any]:
        """Return pycma's own pickle and what stands beside it."""
        return {
            "search": self._search.pickle_dumps(),
            "asked": self._asked,
            "best": self._best,
            "best_phi": self._best_phi,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self._search = pickle.loads(state["search"])
        self._asked, self._best, self._best_phi = state["asked"], state["best"], state["best_phi"]

    def _center(self) -> np.ndarray:
        """Return μ of the search distribution, in coordinates."""
        return self._box.denormalise(np.asarray(self._search.mean))[0]
