"""The randomization distribution p_φ: independent truncated normals, one a parameter.

Each parameter follows a normal of mean μ and standard deviation σ, truncated at μ ± 2σ and redrawn until it
falls inside its physical limits: together, a normal truncated to the intersection of both intervals.
Samples come from the inverse of its cumulative distribution, so that they are differentiable in μ
and σ, and the same base uniforms give common random numbers.

The logarithm of a log-scaled parameter is distributed so. *Coordinates* are values, or
logarithms of values for log-scaled parameters; μ and σ live there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from dropo_torch.errors import InputError, choices
from dropo_torch.parameters import ParameterSpace
from dropo_torch.support.by_value import ByValue
from dropo_torch.support.given import read_text, reading
from dropo_torch.support.random import base_uniforms
from dropo_torch.support.yaml_text import load_yaml

_YAML = (".yaml", ".yml")
SCHEMA = "dropo-torch/distribution/1"
#: A truncated normal reaches this many σ from its mean.
TRUNCATION = 2.0
#: Eigenvalue of a correlation up to which it counts as zero.
SINGULAR = 1e-9
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


def truncated_interval(
    mean: torch.Tensor, std: torch.Tensor, low: torch.Tensor, high: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the truncation interval ``(a, b)`` in σ from the mean, all shapes broadcast.

    Where the limits lie outside μ ± 2σ altogether, the interval hugs the nearer end of the limits.
    """
    # an infinite limit, divided by σ, would make the gradient in σ 0 · ∞
    lower, upper = (torch.where(torch.isfinite(x), x, torch.zeros_like(x)) for x in (low, high))
    a = torch.clamp(torch.where(torch.isfinite(low), (lower - mean) / std, -TRUNCATION), min=-TRUNCATION)
    b = torch.clamp(torch.where(torch.isfinite(high), (upper - mean) / std, TRUNCATION), max=TRUNCATION)
    a = torch.minimum(a, torch.full_like(a, TRUNCATION) - 1e-9)
    return a, torch.maximum(b, a + 1e-9)


def truncated_normal_icdf(
    uniforms: torch.Tensor, mean: torch.Tensor, std: torch.Tensor, low: torch.Tensor, high: torch.Tensor
) -> torch.Tensor:
    """Map uniforms in (0, 1) to the truncated normal; differentiable in ``mean`` and ``std``.

    All shapes broadcast; ``low`` and ``high`` are the physical limits, which may be infinite.
    """
    a, b = truncated_interval(mean, std, low, high)
    below, above = torch.special.ndtr(a), torch.special.ndtr(b)
    z = torch.special.ndtri(below + uniforms * (above - below))
    return mean + std * torch.clamp(z, a.detach(), b.detach())


def truncated_moments(a: torch.Tensor, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return E[z], E[z²] and E[z⁴] of a standard normal truncated to ``[a, b]``, shapes broadcast."""
    density_a, density_b = (torch.exp(-0.5 * z * z - _LOG_SQRT_2PI) for z in (a, b))
    mass = torch.clamp(torch.special.ndtr(b) - torch.special.ndtr(a), min=1e-300)
    second = 1 + (a * density_a - b * density_b) / mass
    fourth = 3 * second + (a**3 * density_a - b**3 * density_b) / mass
    return (density_a - density_b) / mass, second, fourth


#: Standard deviation of draws from a normal that ends :data:`TRUNCATION` σ from its mean, as a share of σ: 0.8796.
DRAWN_STD = float(truncated_moments(*torch.tensor([-TRUNCATION, TRUNCATION], dtype=torch.float64))[1].sqrt())


@dataclass(frozen=True, eq=False)
class Distribution(ByValue):
    """A fitted (or given) distribution over a simulator's parameters.

    Attributes:
        names: the parameters, d of them.
        mean, std: μ and σ in coordinates, ``(d,)`` float64.
        low, high: the search box of the mean, in the parameters' units, ``(d,)``.
        limits: physical limits in the parameters' units, ``(d, 2)``.
        is_log: whether the logarithm of each parameter is distributed so, ``(d,)`` bool.
        units: the parameters' units.
        correlation: of the underlying normals (a Gaussian copula), ``(d, d)``; ``None`` where they are independent.
        is_uniform: uniform over μ ± √3 σ instead, so that μ and σ are still mean and standard deviation.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    std: np.ndarray
    low: np.ndarray
    high: np.ndarray
    limits: np.ndarray
    is_log: np.ndarray
    units: tuple[str, ...]
    correlation: np.ndarray | None = None
    is_uniform: bool = False

    def __len__(self) -> int:
        """Return the number of parameters d."""
        return len(self.names)

    @classmethod
    def over(
        cls,
        space: ParameterSpace,
        mean: np.ndarray,
        std: np.ndarray,
        *,
        correlation: np.ndarray | None = None,
        is_uniform: bool = False,
    ) -> Distribution:
        """Return the distribution over ``space`` with μ and σ in coordinates, ``(d,)`` each."""
        mean, std = np.array(mean, dtype=np.float64), np.array(std, dtype=np.float64)
        correlation = None if correlation is None else np.array(correlation, dtype=np.float64)
        units = tuple(p.unit for p in space.parameters)
        box = space.low, space.high, space.limits, space.is_log
        return cls(space.names, mean, std, *box, units, correlation, is_uniform)

    @property
    def center(self) -> np.ndarray:
        """The value at μ, in the parameters' units, ``(d,)``: the median of a log-scaled parameter."""
        return to_values(self.mean, self.is_log)

    @property
    def spread(self) -> np.ndarray:
        """σ in the parameters' units, ``(d,)``; for a log-scaled parameter σ times the value at μ."""
        return np.where(self.is_log, self.std * self.center, self.std)

    def rsample(self, uniforms: torch.Tensor) -> torch.Tensor:
        """Return parameter values ``(K, d)``, in units, for base uniforms ``(K, d)`` in (0, 1)."""
        if self.correlation is not None:
            uniforms = correlate(uniforms, torch.as_tensor(self.correlation))
        if self.is_uniform:
            low, high = (torch.as_tensor(x) for x in self.ends)
            return tensor_values(low + uniforms * (high - low), self.is_log)
        return tensor_values(truncated_normal_icdf(uniforms, *self._normals), self.is_log)

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest value that occurs, in coordinates, ``(d,)`` each."""
        half = math.sqrt(3)
        a, b = (-half, half) if self.is_uniform else (x.numpy() for x in truncated_interval(*self._normals))
        return self.mean + self.std * a, self.mean + self.std * b

    @property
    def _normals(self) -> tuple[torch.Tensor, ...]:
        """μ, σ, and the low and high limits of the normals, in coordinates, ``(d,)`` each."""
        limits = coordinate_limits(self.limits, self.is_log)
        return tuple(map(torch.as_tensor, (self.mean, self.std, *limits)))

    def sample(self, num_samples: int, generator: torch.Generator) -> torch.Tensor:
        """Return ``num_samples`` independent parameter vectors ``(num_samples, d)``, in units."""
        return self.rsample(base_uniforms(num_samples, len(self), generator))

    def log_prob(self, values: torch.Tensor) -> torch.Tensor:
        """Return the log-density of values ``(..., d)``, in units; ``(...)``, -inf outside the support.

        Raises:
            InputError: a singular correlation, such as that of two parameters which always move together: draws fill no
                volume, so that there is no density.
        """
        density, share = self._marginals(values)
        total = density.sum(-1)
        if self.correlation is None:
            return total
        within = torch.where(torch.isfinite(total)[..., None], share, 0.5).clamp(1e-12, 1 - 1e-12)
        return total + copula_log_density(torch.special.ndtri(within), torch.as_tensor(self.correlation))

    def _marginals(self, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-density of each value by itself, -inf outside its support, and the probability below it, ``(..., d)``."""
        is_log = torch.as_tensor(self.is_log)
        x = torch.where(is_log, torch.log(values), values)
        stretch = torch.where(is_log, x, 0.0)  # d(log v)/dv = 1/v
        if self.is_uniform:
            low, high = (torch.as_tensor(e) for e in self.ends)
            density, share = -torch.log(high - low) - stretch, (x - low) / (high - low)
            return torch.where((x >= low) & (x <= high), density, -torch.inf), share
        mean, std, *_ = self._normals
        a, b = truncated_interval(*self._normals)
        z = (x - mean) / std
        below = torch.special.ndtr(a)
        mass = torch.special.ndtr(b) - below
        density = -0.5 * z * z - _LOG_SQRT_2PI - torch.log(std) - torch.log(mass) - stretch
        return torch.where((z >= a) & (z <= b), density, -torch.inf), (torch.special.ndtr(z) - below) / mass

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return name → mean, std, low, high, unit, limits (and ``log_mean``, ``log_std`` where log-scaled)."""
        entries: dict[str, dict[str, Any]] = {}
        columns = {"mean": self.center, "std": self.spread, "low": self.low, "high": self.high}
        for i, name in enumerate(self.names):
            limits = [None if math.isinf(x) else float(x) for x in self.limits[i]]
            numbers = {key: float(column[i]) for key, column in columns.items()}
            entries[name] = numbers | {"unit": self.units[i], "limits": limits}
            if self.is_uniform:
                entries[name]["law"] = "uniform"
            if self.is_log[i]:
                entries[name] |= {"scale": "log", "log_mean": float(self.mean[i]), "log_std": float(self.std[i])}
        return entries

    def save(self, path: str | Path) -> None:
        """Write the distribution as JSON, or as YAML where the path ends in ``.yaml`` or ``.yml``."""
        document: dict[str, Any] = {"schema": SCHEMA, "parameters": self.summary()}
        if self.correlation is not None:
            document["correlation"] = self.correlation.tolist()
        if Path(path).suffix in _YAML:
            text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
        else:
            text = json.dumps(document, indent=2) + "\n"
        Path(path).write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Distribution:
        """Read a distribution written by :meth:`save`, or the one inside a ``fit.json``.

        Raises:
            InputError: a missing file, or one that holds no distribution.
        """
        path = Path(path)
        if not path.is_file():
            raise InputError(f"distribution: no file {path}; expected a fit.json or a saved distribution")
        is_yaml = path.suffix in _YAML  # JSON is not quite YAML 1.1, which reads 1e-05 as text
        text = read_text(path, "distribution")
        with reading(f"distribution: {path}", "the distribution of a fit"):
            document = load_yaml(text, f"distribution: {path}") if is_yaml else json.loads(text)
        entries = document.get("parameters") if isinstance(document, Mapping) else None
        if not isinstance(entries, Mapping) or not entries:
            raise InputError(f"distribution: {path} has no 'parameters'; expected name → mean, std, low, high, unit")
        with reading(f"distribution: {path}", "the distribution of a fit"):
            return cls._read(document, entries, path)

    @classmethod
    def _read(cls, document: Mapping[str, Any], entries: Mapping[str, Any], path: Path) -> Distribution:
        correlation = _correlation(document.get("correlation"), len(entries), path)
        laws = {str(entry.get("law", "normal")) for entry in entries.values() if isinstance(entry, Mapping)}
        rows = [_numbers(path, name, entry) for name, entry in entries.items()]
        if laws not in ({"normal"}, {"uniform"}):
            raise InputError(f"distribution: {path}: law {', '.join(sorted(laws))}; expected all normal or all uniform")
        mean, std, low, high = np.array(rows).T
        limits = np.array([entry.get("limits") or [None, None] for entry in entries.values()], dtype=np.float64)
        limits = limits.reshape(len(entries), 2)
        limits = np.where(np.isnan(limits), [-np.inf, np.inf], limits)
        is_log = np.array([entry.get("scale") == "log" for entry in entries.values()])
        units = tuple(str(entry.get("unit", "")) for entry in entries.values())
        return cls(tuple(entries), mean, std, low, high, limits, is_log, units, correlation, laws == {"uniform"})


def _numbers(path: Path, name: str, entry: Any) -> list[float]:
    """μ and σ in coordinates, and the search box, of one of a document's parameters."""
    have = entry if isinstance(entry, Mapping) else {}
    is_log = have.get("scale") == "log"
    keys = ("mean", "std", "low", "high", *(("log_mean", "log_std") if is_log else ()))
    for key in keys:
        if not isinstance(have.get(key), (int, float)):
            what = f"scale: log and no number {key!r}" if key.startswith("log_") else f"no number {key!r}"
            raise InputError(f"distribution: {path}: parameters.{name} has {what}" + choices(key, have))
    mean, std, low, high, *logs = (float(have[key]) for key in keys)
    found = [*(logs or (mean, std)), low, high]
    if not np.isfinite([mean, std, *found]).all() or found[1] <= 0:
        raise InputError(
            f"distribution: {path}: parameters.{name} has mean {entry['mean']} and std {entry['std']}; "
            "expected finite numbers, and a std above 0"
        )
    return found


def _correlation(given: Any, size: int, path: Path) -> np.ndarray | None:
    """A document's correlation matrix, checked."""
    if given is None:
        return None
    try:
        matrix = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    fits = matrix.shape == (size, size) and np.allclose(matrix, matrix.T) and np.allclose(np.diag(matrix), 1)
    if not fits or np.linalg.eigvalsh(matrix).min() < -SINGULAR:
        raise InputError(f"distribution: {path}: correlation is no correlation matrix of {size} parameters")
    return matrix


def correlate(uniforms: torch.Tensor, correlation: torch.Tensor) -> torch.Tensor:
    """Return uniforms ``(..., d)`` whose normal scores have the given correlation, of independent ones."""
    values, vectors = torch.linalg.eigh(correlation)
    root = vectors * values.clamp(min=0).sqrt() @ vectors.T  # semidefinite is enough
    return torch.special.ndtr(torch.special.ndtri(uniforms) @ root).clamp(1e-15, 1 - 1e-15)


def copula_log_density(scores: torch.Tensor, correlation: torch.Tensor) -> torch.Tensor:
    """Return the log-density of a Gaussian copula at normal scores ``(..., d)``, ``(...)``.

    Raises:
        InputError: a singular correlation.
    """
    if float(torch.linalg.eigvalsh(correlation).min()) <= SINGULAR:
        raise InputError("distribution: its correlation is singular, so that it has no density; it can be drawn from")
    inverse, log_det = torch.linalg.inv(correlation), torch.linalg.slogdet(correlation)[1]
    pull = inverse - torch.eye(len(correlation), dtype=correlation.dtype)
    return -0.5 * log_det - 0.5 * torch.einsum("...i,ij,...j->...", scores, pull, scores)


def tensor_values(coordinates: torch.Tensor, is_log: np.ndarray) -> torch.Tensor:
    """Do what :func:`to_values` does for a tensor; differentiable."""
    return torch.where(torch.as_tensor(is_log), torch.exp(coordinates), coordinates) if is_log.any() else coordinates


def to_values(coordinates: np.ndarray, is_log: np.ndarray) -> np.ndarray:
    """Return values, in units, of coordinates ``(..., d)``."""
    return np.where(is_log, np.exp(np.where(is_log, coordinates, 0.0)), coordinates)


def to_coordinates(values: np.ndarray, is_log: np.ndarray) -> np.ndarray:
    """Return coordinates of values ``(..., d)``, in units."""
    return np.where(is_log, np.log(np.where(is_log, values, 1.0)), values)


def coordinate_limits(limits: np.ndarray, is_log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return physical limits ``(d, 2)`` in coordinates, as low ``(d,)`` and high ``(d,)``."""
    with np.errstate(divide="ignore"):
        low = to_coordinates(np.maximum(limits[:, 0], np.where(is_log, 0.0, -np.inf)), is_log)
        return low, to_coordinates(limits[:, 1], is_log)


@dataclass(frozen=True, eq=False)
class SearchBox:
    """Where μ and σ are searched, in coordinates, and the normalized form that CMA-ES sees.

    Means are linear and standard deviations logarithmic, both scaled to [0, 4], so that one initial step size
    fits all of them. σ lies between 1e-5 (or 1e-5 of the width where that is less) and a quarter of
    the width of the mean's interval.

    Attributes:
        low, high: bounds of μ, ``(d,)``.
        min_std, max_std: bounds of σ, ``(d,)``.
        limits: physical limits, low and high, ``(d,)`` each.
        is_log: whether each coordinate is the logarithm of a value, ``(d,)`` bool.
    """

    low: np.ndarray
    high: np.ndarray
    min_std: np.ndarray
    max_std: np.ndarray
    limits: tuple[np.ndarray, np.ndarray]
    is_log: np.ndarray

    WIDTH = 4.0

    @classmethod
    def of(cls, space: ParameterSpace | Distribution) -> SearchBox:
        """Return the search box of a parameter space, or of a distribution over one."""
        low, high = to_coordinates(space.low, space.is_log), to_coordinates(space.high, space.is_log)
        width, limits = high - low, coordinate_limits(space.limits, space.is_log)
        return cls(low, high, 1e-5 * np.minimum(width, 1.0), width / 4, limits, space.is_log)

    @property
    def width(self) -> np.ndarray:
        """Widths of the intervals of μ, ``(d,)``."""
        return self.high - self.low

    @property
    def middle(self) -> np.ndarray:
        """Middle of the box of μ, ``(d,)``."""
        return 0.5 * (self.low + self.high)

    def values(self, coordinates: np.ndarray) -> np.ndarray:
        """Return values, in units, of coordinates ``(..., d)``."""
        return to_values(coordinates, self.is_log)

    def draw_coordinates(self, uniforms: torch.Tensor, mean: torch.Tensor, std: torch.Tensor) -> torch.Tensor:
        """Return what base uniforms are under μ and σ, all in coordinates; differentiable, shapes broadcast."""
        return truncated_normal_icdf(uniforms, mean, std, *map(torch.as_tensor, self.limits))

    def draw(self, uniforms: torch.Tensor, mean: torch.Tensor, std: torch.Tensor) -> torch.Tensor:
        """Return the parameter values of base uniforms, in units, under μ and σ; differentiable, shapes broadcast."""
        return tensor_values(self.draw_coordinates(uniforms, mean, std), self.is_log)

    def varying(self, std: np.ndarray) -> np.ndarray | None:
        """Return σ ``(d,)``; ``None`` where each is at its floor: a point estimate."""
        return None if (std <= 2 * self.min_std).all() else std

    def normalize(self, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
        """Return φ in [0, 4]: d means, then d logarithms of σ, ``(..., 2d)``."""
        means = (mean - self.low) / self.width
        logs = np.log(std / self.min_std) / np.log(self.max_std / self.min_std)
        return self.WIDTH * np.concatenate([means, logs], axis=-1)

    def denormalize(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return μ and σ, ``(..., d)`` each, of normalized φ ``(..., 2d)``."""
        unit = np.clip(np.asarray(phi) / self.WIDTH, 0.0, 1.0)
        means, logs = np.split(unit, 2, axis=-1)
        return self.low + means * self.width, self.min_std * (self.max_std / self.min_std) ** logs
