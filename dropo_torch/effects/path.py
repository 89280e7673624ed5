"""Simulated paths as sensors see them, with as much of the past as is known."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class SensedPath:
    """Observed columns of simulated paths, and what the sensors show of them so far.

    Attributes:
        fine: true columns at every physics step, from as early as is known up to the last instant, ``(R, F, n)``.
        shown: what the sensors show at T instants, the last of ``fine`` and those before it, ``(R, T, n)``.
        skip: physics steps from one instant to the next.
        step: seconds of a physics step.
        rates: for a column, the column that is its time derivative, or -1.
    """

    fine: torch.Tensor
    shown: torch.Tensor
    skip: int
    step: float
    rates: tuple[int, ...]

    @classmethod
    def of(cls, fine: torch.Tensor, instants: int, skip: int, step: float, rates: tuple[int, ...]) -> SensedPath:
        """Return true paths of which the sensors show nothing but the truth, at the last ``instants``."""
        return cls(fine, fine[:, fine.shape[1] - 1 - skip * (instants - 1) :: skip], skip, step, rates)

    def places(self, delay: torch.Tensor) -> torch.Tensor:
        """Return where in ``fine`` the instants are, ``delay`` seconds ``(R, 1)`` before them, ``(R, T)``."""
        instants = torch.arange(self.shown.shape[1], device=delay.device)
        return self.fine.shape[1] - 1 - self.skip * (self.shown.shape[1] - 1 - instants) - delay / self.step

    def ago(self, column: int, delay: torch.Tensor) -> torch.Tensor:
        """Return a true column ``delay`` seconds ``(R, 1)`` before the instants, ``(R, T)``.

        Between physics steps, by a cubic with the right slopes where the time derivative is observed. Before all that
        is known, the first known value.
        """
        rows, last = len(self.fine), self.fine.shape[1] - 1
        at = self.places(delay).clamp(min=0.0)
        whole = at.long().clamp(max=max(last - 1, 0))
        part = at - whole
        ends = whole.expand(rows, -1), (whole + 1).clamp(max=last).expand(rows, -1)
        left, right = (self.fine[..., column].gather(1, end) for end in ends)
        rate = self.rates[column]
        if rate < 0:
            return (1 - part) * left + part * right
        slope, next_slope = (self.fine[..., rate].gather(1, end) * self.step for end in ends)
        return hermite(left, right, slope, next_slope, part)

    def known(self, seconds: float) -> torch.Tensor:
        """Return whether all of the ``seconds`` before each instant is known, ``(T,)`` bool."""
        return self.places(torch.tensor([[seconds]], dtype=torch.float64))[0] >= -1e-9


def hermite(
    left: torch.Tensor, right: torch.Tensor, slope: torch.Tensor, next_slope: torch.Tensor, part: torch.Tensor
) -> torch.Tensor:
    """Return the cubic interpolation between two values with their slopes a step, at a part of the step."""
    t2, t3 = part**2, part**3
    ends = (2 * t3 - 3 * t2 + 1) * left + (3 * t2 - 2 * t3) * right
    return ends + (t3 - 2 * t2 + part) * slope + (t3 - t2) * next_slope
