"""Uniform domain randomization: random boxes inside the search space, without a look at the log."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from dropo_torch.baselines.settings import UdrSettings
from dropo_torch.distribution import Distribution
from dropo_torch.objective import Objective
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.parameters import ParameterSpace


class UdrOptimizer(Optimizer):
    """Draws boxes whose ends are uniform in the search box, and returns one of them; nothing is simulated.

    A policy is usually trained on each of the boxes and their results are averaged: the same config with
    ``method_options.box`` from 0 to ``boxes`` − 1 gives them all.

    Args:
        objective: gives what varies.
        settings: how many boxes, and which.
        seed: seeds the boxes.
    """

    name = "udr"
    method = "udr"
    stop_reason = "the boxes are random: nothing is searched"
    progress = Progress("drawing boxes", float("nan"), 1.0)

    def __init__(self, objective: Objective, *, settings: UdrSettings, seed: int) -> None:
        self._space, self._box, self._chosen = objective.simulator.parameters, objective.box, settings.box
        ends = np.random.default_rng(seed).uniform(size=(settings.boxes, 2, len(self._space)))
        self._ends = self._box.low + np.sort(ends, axis=1) * self._box.width  # (boxes, 2, d), coordinates

    def ask(self) -> Request:
        """Nothing is asked."""
        raise RuntimeError("uniform domain randomization simulates nothing")

    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        """Nothing is told."""
        raise RuntimeError("uniform domain randomization simulates nothing")

    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return mean and standard deviation of the chosen box."""
        low, high = self._ends[self._chosen]
        return [(0.5 * (low + high), (high - low) / np.sqrt(12))]

    def distributions(self, space: ParameterSpace) -> list[Distribution]:
        """Return the chosen box."""
        mean, std = self.candidates()[0]
        return [Distribution.over(space, mean, std, is_uniform=True)]

    def extras(self) -> dict[str, Any]:
        """Return all boxes, in the parameters' units."""
        ends = self._box.values(self._ends).swapaxes(1, 2).tolist()  # (boxes, d, 2)
        return {"boxes": [dict(zip(self._space.names, box, strict=True)) for box in ends], "box": self._chosen}
