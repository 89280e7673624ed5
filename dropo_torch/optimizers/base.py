"""The ask/tell interface: an optimizer names parameter vectors, and never sees a simulator."""

from __future__ import annotations

import abc
import copy
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from dropo_torch.data.trajectory import Replay
from dropo_torch.distribution import Distribution, SearchBox
from dropo_torch.evaluator import ReplayReduce
from dropo_torch.objective import Objective, Reduce
from dropo_torch.optimizers.settings import FitSettings
from dropo_torch.parameters import ParameterSpace


@dataclass(frozen=True)
class Request:
    """A batch to simulate: every transition of the log under every one of these vectors.

    Attributes:
        values: parameter vectors in their units, ``(P, d)``.
        reduce: what to sum over transitions, as for :meth:`Objective.map`.
        evaluations: how many evaluations of the objective this counts as.
        linearise_at: μ in coordinates at which the noise of initial states is propagated, or ``None``.
        linearise_std: σ that then counts as explained when windows are widened, or ``None``.
        widen: whether windows that the noise does not explain are widened; else the noise is as given, as the
            objective has it.
        rows: the transitions to simulate, ascending; ``None`` for all of them.
        replay: windows that are replayed open loop in place of the log's transitions; ``reduce`` is then a
            :data:`~dropo_torch.evaluator.ReplayReduce`.
        is_stencil: whether all vectors lie so close to the first that the simulation is linear between them.
        gradient: whether ``tell`` wants the gradient of the first sum in ``values``.
    """

    values: np.ndarray
    reduce: Reduce | ReplayReduce
    evaluations: int
    linearise_at: np.ndarray | None = None
    linearise_std: np.ndarray | None = None
    widen: bool = True
    rows: np.ndarray | None = None
    gradient: bool = False
    is_stencil: bool = False
    replay: Replay | None = None


@dataclass(frozen=True)
class Progress:
    """Where an optimizer stands.

    Attributes:
        stage: what it is doing, for people.
        log_likelihood: the best found, in nats, as the optimizer itself measures it; NaN before the first.
        fraction: a guess of the share of work that is done, in [0, 1].
    """

    stage: str
    log_likelihood: float
    fraction: float


def entropy_of(distribution: Distribution) -> float:
    """Return the entropy of a distribution in coordinates, but for a constant and for its cut: ½ log det of C."""
    entropy = float(np.log(distribution.std).sum())
    if distribution.correlation is not None:
        entropy += 0.5 * float(np.log(np.maximum(np.linalg.eigvalsh(distribution.correlation), 1e-12)).sum())
    return entropy


class Optimizer(abc.ABC):
    """Moves φ = (μ, σ), in coordinates, towards the maximum of the likelihood.

    The state between a ``tell`` and the next ``ask`` is all there is: an optimizer restored from
    :meth:`state` goes on exactly as the one that was saved.
    """

    name: ClassVar[str]
    #: What stands as ``method`` in ``fit.json``.
    method: ClassVar[str] = "dropo"
    #: Whether candidates are meant to simulate the log well long before the search ends.
    improves: ClassVar[bool] = False
    #: Names of the attributes that change.
    STATE: ClassVar[tuple[str, ...]] = ()
    #: Dataclasses in the state: beside them it holds plain values, arrays and tensors.
    KINDS: ClassVar[tuple[type, ...]] = ()

    @abc.abstractmethod
    def ask(self) -> Request:
        """Return the next batch; the same one again until it was told."""

    @abc.abstractmethod
    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Take the sums that the batch's reduction gave, and their gradient ``(P, d)`` where it was asked for."""

    @property
    @abc.abstractmethod
    def stop_reason(self) -> str | None:
        """Why the optimizer has stopped, in words, or ``None`` while it goes on."""

    @property
    def caveat(self) -> str:
        """What to know before the result is used; empty where there is nothing."""
        return ""

    @property
    @abc.abstractmethod
    def progress(self) -> Progress:
        """Where the optimizer stands."""

    @abc.abstractmethod
    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the final φ to choose from, each μ and σ in coordinates, ``(d,)`` each."""

    def distributions(self, space: ParameterSpace) -> list[Distribution]:
        """Return the final distributions to choose from: normals of the candidates unless the method has others."""
        return [Distribution.over(space, mean, std) for mean, std in self.candidates()]

    def bonus(self, distribution: Distribution) -> float:
        """Return what the method adds to the log-likelihood by which final distributions are chosen."""
        return 0.0

    def extras(self) -> dict[str, Any]:
        """Return what the method found beside a distribution, as plain data for ``fit.json``."""
        return {}

    def state(self) -> dict[str, Any]:
        """Return everything needed to go on, as plain data."""
        return copy.deepcopy({name: getattr(self, name) for name in self.STATE})

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        for name, value in state.items():
            setattr(self, name, value)


class LikelihoodOptimizer(Optimizer):
    """What the optimizers of DROPO itself share.

    Args:
        objective: gives the reduction, the parameters and the size of the log; it is not evaluated here.
        settings: what the fit was told.
    """

    improves = True

    def __init__(self, objective: Objective, settings: FitSettings) -> None:
        self._objective, self._settings = objective, settings
        self._space: ParameterSpace = objective.simulator.parameters
        self._box: SearchBox = objective.box
        self._noisy = objective.noise is not None

    def extras(self) -> dict[str, Any]:
        """Return the weight of the entropy, where there is one."""
        return {"entropy": self._settings.entropy} if self._settings.entropy else {}

    def bonus(self, distribution: Distribution) -> float:
        """Return the weighted entropy."""
        return self._settings.entropy * entropy_of(distribution) if self._settings.entropy else 0.0
