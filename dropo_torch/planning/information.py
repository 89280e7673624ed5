"""What a log, or a planned one, tells of the parameters: Fisher information of the likelihood that a fit maximizes."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats

from dropo_torch.data.features import Features
from dropo_torch.likelihood import STUDENT_DOF
from dropo_torch.objective import Objective

#: Step of the differences, as a share of a parameter's bounds.
STEP = 1e-4
#: Windows that pull so much harder than the median one are no information: solvers make it up in contacts.
TOO_HARD = 100.0
#: Part of the noise's standard deviation by which initial states are moved to see what it does, to first order.
DRAW = 0.1
#: Least share of the variance without shared measurements that they leave: what is less is rounding.
LEAST = 1e-4


@dataclass(frozen=True)
class Information:
    """What windows tell of the parameters' means, to first order, in coordinates.

    Attributes:
        gram: AᵀΣ⁻¹A, summed, ``(d, d)``.
        shared: by what the variance of their pull is less: measurements that end a window and begin the next pull in
            both; and a likelihood with heavy tails does not use all of the information, ``(d, d)``.
    """

    gram: np.ndarray
    shared: np.ndarray

    def __add__(self, other: Information) -> Information:
        """Return what both tell."""
        return Information(self.gram + other.gram, self.shared + other.shared)

    @classmethod
    def none(cls, size: int) -> Information:
        """Return what nothing tells."""
        return cls(np.zeros((size, size)), np.zeros((size, size)))

    def covariance(self, width: np.ndarray) -> np.ndarray:
        """Return the covariance of the means, ``(d, d)``.

        Args:
            width: of the search box, ``(d,)``: what the log does not tell is known by a normal of that width, as a fit
                has it.
        """
        scale = np.outer(width, width)
        known = self.gram * scale + np.eye(len(width))
        inverse = np.linalg.inv(known)
        inverse = 0.5 * (inverse + inverse.T)
        values, vectors = np.linalg.eigh(inverse - inverse @ (self.shared * scale) @ inverse)
        least = LEAST * np.einsum("ij,ik,kj->j", vectors, inverse, vectors)
        return np.asarray((vectors * np.maximum(values, least)) @ vectors.T) * scale

    def errors(self, width: np.ndarray) -> np.ndarray:
        """Return the standard errors of the means, ``(d,)``."""
        return np.asarray(np.sqrt(np.diag(self.covariance(width))))

    def volume(self, width: np.ndarray) -> float:
        """Return half the logarithm of the determinant of the covariance in units of the bounds."""
        return float(0.5 * np.linalg.slogdet(self.covariance(width) / np.outer(width, width))[1])


def information_of(objective: Objective, point: np.ndarray, *, quick: bool = False) -> list[Information]:
    """Return what each episode of a log tells around a point.

    Args:
        objective: of the log, or of some of its windows.
        point: parameters in coordinates, ``(d,)``.
        quick: propagate the noise of initial states to first order, by one simulation a column.
    """
    jacobian, covariance, carried = _linearized(objective, point, quick)
    pull = torch.linalg.solve(covariance, jacobian.mT)
    each = torch.nan_to_num(jacobian @ pull)
    pull = torch.nan_to_num(pull)
    log = objective.transitions
    follows = (np.diff(log.rows) == log.lag) & (np.diff(log.episodes) == 0)
    usual = each.diagonal(dim1=1, dim2=2).sum(1)
    found = []
    for episode in np.unique(log.episodes):
        own = torch.from_numpy(log.episodes == episode)
        size = usual[own]
        soft = usual <= TOO_HARD * size[size > 0].median() if bool((size > 0).any()) else usual >= 0
        kept = own & soft
        gram, shared = each[kept].sum(0), torch.zeros_like(each[0])
        if carried is not None and len(log) > 1:
            pairs = kept[:-1] & kept[1:] & torch.from_numpy(follows)
            half = (pull[:-1][pairs].mT @ carried[1:][pairs] @ pull[1:][pairs]).sum(0)
            shared = half + half.T
        wasted = 0.0 if objective.noise is None else inefficiency(objective.features.size) - 1
        found.append(Information(gram.numpy(), (shared - wasted * gram).numpy()))
    return found


@functools.cache
def inefficiency(size: int) -> float:
    """Return by what the variance of an estimate by Student's likelihood is larger than by a normal's.

    Of normal residuals of so many features: E[w²χ²/m] / E[w + 2χ²w'/m]², with the weight w(χ²) of a residual.
    """
    chi2 = stats.chi2.ppf((np.arange(4000) + 0.5) / 4000, size)
    weight = (STUDENT_DOF + size) / (STUDENT_DOF + chi2)
    slope = -weight / (STUDENT_DOF + chi2)
    return float((weight**2 * chi2 / size).mean() / (weight + 2 * chi2 * slope / size).mean() ** 2)


def _linearized(
    objective: Objective, point: np.ndarray, quick: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """Derivatives of the features ``(T, d, m)``, their covariance ``(T, m, m)``, and what noise carries over."""
    box, run = objective.box, objective.evaluator
    step = STEP * box.width * np.where(point + STEP * box.width > box.high, -1.0, 1.0)
    points = np.concatenate([point[None], point + np.diag(step)])
    values = torch.from_numpy(box.values(points))
    simulated = torch.cat([run.after(block, values) for block in run.blocks(len(points))])
    jacobian = torch.nan_to_num((simulated[:, 1:] - simulated[:, :1]) / torch.from_numpy(step)[:, None])
    if quick and objective.noise is not None:
        return jacobian, *_to_first_order(objective, values[:1], simulated[:, 0])
    initial = objective.initial_noise(point, None, widen=False)
    return jacobian, objective.base_covariance(slice(None), initial), None if initial is None else initial.carried


def _to_first_order(
    objective: Objective, values: torch.Tensor, simulated: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The features' covariance by ε and noise, and what noise carries over, ``(T, m, m)`` each.

    Args:
        objective: with noise.
        values: of the parameters, ``(1, d)``.
        simulated: features without noise, ``(T, m)``.
    """
    run, every, own = objective.evaluator, Features.of(objective.observation), objective.features
    assert objective.noise is not None
    size = every.feature_noise(objective.noise.numpy())
    noisy = np.flatnonzero(size)
    moves = np.zeros((len(noisy), every.size))
    moves[np.arange(len(noisy)), noisy] = DRAW * size[noisy]
    index, parts = objective.observation.index, []
    for block in run.blocks(len(noisy)):
        states = run.states[block][:, None].repeat(1, len(noisy), 1)
        moved = every.move(states[..., index].numpy(), np.broadcast_to(moves, (*states.shape[:2], every.size)))
        states[..., index] = torch.from_numpy(moved)
        after = run.after(block, values, states)[:, 0].reshape(-1, len(noisy), own.size)
        parts.append(torch.nan_to_num((after - simulated[block][:, None]) / DRAW).mT)
    gain = torch.cat(parts)  # of the features by draws, (T, m, c)
    same = np.array([[label == every.labels[j] for j in noisy] for label in own.labels])
    sizes = torch.from_numpy(same / own.scale[:, None] * size[noisy])
    return objective.base_covariance(slice(None)) + gain @ gain.mT, sizes @ gain.mT
