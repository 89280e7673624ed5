"""Where an episode's parameters come from: one point, the bounds, or a fitted distribution."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dropo_torch.distribution import Distribution, SearchBox, to_values
from dropo_torch.errors import InputError, choices
from dropo_torch.parameters import ParameterSpace
from dropo_torch.support.random import base_uniforms


class ParameterSource(abc.ABC):
    """Draws parameter vectors.

    Attributes:
        names: the parameters, d of them.
    """

    names: tuple[str, ...]

    @abc.abstractmethod
    def sample(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return parameter values ``(count, d)``, in their units, float64."""

    def document(self) -> dict[str, Any]:
        """Return what is drawn from as plain data: its ``kind`` and an entry for each of its ``parameters``."""
        return {"kind": type(self).__name__, "parameters": {name: {} for name in self.names}}

    def over(self, space: ParameterSpace) -> ParameterSource:
        """Return the same source with its columns in a space's order.

        Raises:
            InputError: names that are not the space's.
        """
        for name in self.names:
            if name not in space.names:
                raise InputError(f"distribution: parameter {name!r} is not in the model" + choices(name, space.names))
        missing = [n for n in space.names if n not in self.names]
        if missing:
            raise InputError(f"distribution: it says nothing about parameter {missing[0]!r}; it has {self.names}")
        return self if self.names == space.names else _Ordered(self, space.names)


class _Ordered(ParameterSource):
    """Another source's columns in another order."""

    def __init__(self, source: ParameterSource, names: tuple[str, ...]) -> None:
        self.names = names
        self._source, self._columns = source, [source.names.index(n) for n in names]

    def sample(self, count: int, generator: torch.Generator) -> torch.Tensor:
        return self._source.sample(count, generator)[:, self._columns]

    def document(self) -> dict[str, Any]:
        return self._source.document()


class PointSource(ParameterSource):
    """The same values in every episode.

    Args:
        values: name → value.
        units: name → unit, where it has one.
        kind: ``point``, or ``nominal`` for the model's own values.
    """

    def __init__(
        self, values: Mapping[str, float], units: Mapping[str, str] | None = None, kind: str = "point"
    ) -> None:
        self.names, self._units, self._kind = tuple(values), dict(units or {}), kind
        self._values = torch.tensor([float(v) for v in values.values()], dtype=torch.float64)

    @classmethod
    def nominal(cls, space: ParameterSpace) -> PointSource:
        """Return the model's own values of a space's parameters.

        Raises:
            InputError: a parameter that the model has no value of.
        """
        unknown = [n for n, v in zip(space.names, space.nominal, strict=True) if not np.isfinite(v)]
        if unknown:
            raise InputError(f"distribution: the model has no nominal value of {unknown[0]!r}; give name: value of all")
        return cls(space.named(space.nominal), _units(space), "nominal")

    def sample(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return the values ``(count, d)``."""
        return self._values.repeat(count, 1)

    def document(self) -> dict[str, Any]:
        """Return each parameter's value and unit."""
        values = zip(self.names, self._values.tolist(), strict=True)
        return {"kind": self._kind, "parameters": {n: {"value": v, "unit": self._units.get(n, "")} for n, v in values}}


class UniformSource(ParameterSource):
    """Values spread evenly over the search bounds, in the logarithm for log-scaled parameters.

    Args:
        space: the parameters.
    """

    def __init__(self, space: ParameterSpace) -> None:
        self.names, self._space = space.names, space
        self._box = SearchBox.of(space)

    def sample(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return values ``(count, d)`` inside the bounds."""
        uniforms = base_uniforms(count, len(self.names), generator).numpy()
        return torch.from_numpy(self._box.values(self._box.low + uniforms * self._box.width))

    def document(self) -> dict[str, Any]:
        """Return each parameter's bounds, unit and scale."""
        entries = {
            p.name: {"low": float(p.low), "high": float(p.high), "unit": p.unit, "scale": p.scale}
            for p in self._space.parameters
        }
        return {"kind": "uniform", "parameters": entries}


class DistributionSource(ParameterSource):
    """A fitted distribution.

    Args:
        distribution: the distribution.
    """

    def __init__(self, distribution: Distribution) -> None:
        self.names = distribution.names
        self.distribution = distribution

    def sample(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return independent values ``(count, d)``."""
        return self.distribution.sample(count, generator)

    def document(self) -> dict[str, Any]:
        """Return each parameter's entry in a ``fit.json``, and the correlation, where there is one."""
        correlation = self.distribution.correlation
        together = {} if correlation is None else {"correlation": correlation.tolist()}
        return {"kind": "fitted", "parameters": self.distribution.summary(), **together}


def load_source(
    given: str | Path | Mapping[str, float] | Distribution | ParameterSource, space: ParameterSpace
) -> ParameterSource:
    """Return where an episode's parameters come from, in the order of a space.

    Args:
        given: ``"uniform"``, ``"nominal"`` (the model's own values), name → value, a distribution or the path of one
            (a ``fit.json`` or a saved distribution), or a source.
        space: the parameters.

    Raises:
        InputError: a missing file, or names that are not the space's.
    """
    if isinstance(given, ParameterSource):
        return given.over(space)
    if isinstance(given, Mapping):
        vector = space.vector(given)
        _check_limits(vector, vector, space)
        return PointSource(space.named(vector), _units(space))
    if given == "uniform":
        return UniformSource(space)
    if given == "nominal":
        return PointSource.nominal(space)
    found = given if isinstance(given, Distribution) else Distribution.load(given)
    ordered = DistributionSource(found).over(space)
    for name, unit in zip(found.names, found.units, strict=True):
        own = space.parameters[space.names.index(name)].unit
        if unit and own and unit != own:
            raise InputError(f"distribution: {name} is in {unit!r} there and in {own!r} here; expected the same unit")
    columns = [found.names.index(n) for n in space.names]
    low, high = (to_values(end, found.is_log)[columns] for end in found.ends)
    _check_limits(low, high, space)
    return ordered


def _units(space: ParameterSpace) -> dict[str, str]:
    return {p.name: p.unit for p in space.parameters}


def _check_limits(low: np.ndarray, high: np.ndarray, space: ParameterSpace) -> None:
    """Raise for values from ``low`` to ``high``, ``(d,)`` each, of which the model does not allow some."""
    for name, a, b, (least, most) in zip(space.names, low, high, space.limits, strict=True):
        slack = 1e-9 * max(abs(a), abs(b))
        if not (least - slack <= a and b <= most + slack):
            reaches = f"is {a:g}" if a == b else f"reaches from {a:g} to {b:g}"
            raise InputError(f"distribution: {name} {reaches}; the model allows {least:g} to {most:g}")
