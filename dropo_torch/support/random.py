"""Random draws, each a pure function of its seeds or of the generator that is handed in."""

from __future__ import annotations

import numpy as np
import torch


def base_uniforms(num_samples: int, num_parameters: int, generator: torch.Generator) -> torch.Tensor:
    """Draw base uniforms ``(num_samples, num_parameters)``, float64."""
    return torch.rand(num_samples, num_parameters, generator=generator, dtype=torch.float64)


def draw_uniforms(num_samples: int, num_parameters: int, *seeds: int) -> torch.Tensor:
    """Draw base uniforms ``(num_samples, num_parameters)`` from a generator of their own."""
    return base_uniforms(num_samples, num_parameters, torch.Generator().manual_seed(derived_seed(*seeds)))


def derived_seed(*seeds: int) -> int:
    """Return a seed that torch accepts, of seeds of any size."""
    return int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0]) >> 1


def stratified_uniforms(num_samples: int, num_parameters: int, *seeds: int) -> torch.Tensor:
    """Return base uniforms ``(num_samples, num_parameters)`` of which each column is spread evenly over (0, 1).

    Latin hypercube sampling: moments of one parameter hardly depend on the draws.
    """
    generator = np.random.default_rng(derived_seed(*seeds))
    order = np.argsort(generator.random((num_samples, num_parameters)), axis=0)
    return torch.from_numpy((order + generator.random(order.shape)) / num_samples).clamp(1e-15, 1 - 1e-15)
