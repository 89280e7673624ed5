"""What a fit may be told: the keys of a config that its optimizers read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from dropo_torch.errors import InputError, choices
from dropo_torch.support.given import check_keys

OPTIMIZERS = ("fisher", "cma", "adam")
#: Adam's first learning rate of the second stage, as a share of the first stage's.
JOINT_RATE = 0.2
#: The largest values of Adam's settings, whole ones of whole numbers.
LIMITS = {
    "steps": 10_000_000, "batch": 1_000_000, "samples": 100_000, "learning_rate": 4.0, "refresh": 10_000_000,
    "clip": 1e9,
}  # fmt: skip


@dataclass(frozen=True)
class AdamSettings:
    """How Adam steps, in φ scaled to [0, 4] as for CMA-ES.

    Attributes:
        steps: of each of its two stages: μ alone, then μ and σ.
        batch: transitions of a minibatch while μ and σ move, twice as many for the means alone;
            the whole log where that is shorter.
        samples: parameter vectors of each step of the second stage; the first simulates μ only.
        learning_rate: the first of the means alone, falling linearly to 0; a fifth of it for μ and σ.
        refresh: steps after which the basis of the means is computed anew.
        clip: largest entry of a minibatch's gradient, in multiples of that entry's running root mean square:
            a single transition at a stiff contact must not slow the steps that follow.
        common_random_numbers: the same samples at every step instead of fresh ones.
    """

    steps: int = 200
    batch: int = 25
    samples: int = 16
    learning_rate: float = 0.5
    refresh: int = 20
    clip: float = 3.0
    common_random_numbers: bool = False

    def __post_init__(self) -> None:
        for name, most in LIMITS.items():
            value = getattr(self, name)
            if not 0 < value <= most:
                raise InputError(f"adam.{name}: {value} given; expected a positive number of at most {most:g}")
            if isinstance(most, int) and value != int(value):
                raise InputError(f"adam.{name}: {value} given; expected a whole number")
        if self.samples < 2:
            raise InputError("adam.samples: 1 given; a covariance needs 2 or more")

    def rate(self, step: int) -> float:
        """Return the learning rate of a step, counted from 0 over both stages."""
        first = self.learning_rate * (1.0 if step < self.steps else JOINT_RATE)
        return first * (1 - step % self.steps / self.steps)


def adam_settings(given: Mapping[str, Any]) -> AdamSettings:
    """Return the settings of a config's ``adam``.

    Raises:
        InputError: an unknown key, or a value that is no positive number.
    """
    check_keys(given, [f.name for f in fields(AdamSettings)], "adam")
    for key, value in given.items():
        if not isinstance(value, (int, float)):
            raise InputError(f"adam.{key}: {value!r} given; expected a number")
    return AdamSettings(**given)


@dataclass(frozen=True)
class FitSettings:
    """How a distribution is searched.

    Attributes:
        optimizer: ``"fisher"``, ``"cma"`` or, on a differentiable simulator, ``"adam"``.
        samples: K, parameter vectors of each φ.
        seed: seeds every random number.
        budget: with CMA-ES, evaluations of the objective after which it stops.
        population: with CMA-ES, φ per generation; ``None`` for pycma's choice.
        common_random_numbers: with CMA-ES, the same base uniforms in every generation instead of fresh ones.
        adam: how Adam steps.
        entropy: weight β of Σ log σ, the entropy of p_φ but for a constant, beside the log-likelihood.
        covariance: ``"full"`` lets parameters vary together, with ``"fisher"``; else ``"diagonal"``.

    Raises:
        InputError: an unknown optimizer, or one that cannot do what is asked of it.
    """

    optimizer: str = "fisher"
    samples: int = 100
    seed: int = 0
    budget: int = 1000
    population: int | None = None
    common_random_numbers: bool = False
    adam: AdamSettings = AdamSettings()
    entropy: float = 0.0
    covariance: str = "diagonal"

    def __post_init__(self) -> None:
        if self.optimizer not in OPTIMIZERS:
            raise InputError(f"optimizer: unknown {self.optimizer!r}" + choices(self.optimizer, OPTIMIZERS))
        if self.covariance not in ("diagonal", "full"):
            raise InputError(f"covariance: {self.covariance!r} given; expected diagonal or full")
        if self.covariance == "full" and self.optimizer != "fisher":
            raise InputError(
                f"covariance: full needs optimizer: fisher; {self.optimizer} has independent parameters only"
            )
        if self.entropy and self.optimizer == "adam":
            raise InputError("entropy: adam has no entropy bonus; use optimizer: fisher or cma")
