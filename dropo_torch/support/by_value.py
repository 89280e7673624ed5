"""Equality of frozen data that holds arrays."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, ClassVar

import numpy as np


class ByValue:
    """A dataclass, declared with ``eq=False``, that equals another whose fields have the same values; NaN equals NaN.

    The equality that ``dataclass`` makes compares arrays as truth values, which is an error.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        """Return whether the other is of the same class and has the same values."""
        if type(other) is not type(self):
            return NotImplemented
        own = fields(self)  # type: ignore[arg-type]
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in own if f.compare)


def _same(one: Any, other: Any) -> bool:
    """Whether two values, which may be arrays, are the same."""
    if not (isinstance(one, np.ndarray) and isinstance(other, np.ndarray)):
        return one is other or bool(type(one) is type(other) and one == other)
    return np.array_equal(one, other, equal_nan=one.dtype.kind in "fc" and other.dtype.kind in "fc")
