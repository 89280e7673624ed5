"""Entries that a user gives, checked one by one: keys that are known, numbers in their range."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from dropo_torch.errors import InputError, choices


def check_keys(given: Iterable[object], known: Iterable[str], where: str) -> None:
    """Raise an :class:`InputError` for the first key that is not known, with the nearest that is."""
    known = tuple(known)
    for key in given:
        if key not in known:
            raise InputError(f"{where}: unknown key {key!r}{choices(key, known)}")


def number(value: Any, what: str, *, least: float = -math.inf, above: float = -math.inf) -> float:
    """Return a finite number, also where YAML reads ``1e-3`` as text.

    Args:
        value: what was given.
        what: names it in messages.
        least, above: the number is at least the one and more than the other; 0 where given.

    Raises:
        InputError: anything else.
    """
    try:
        found = float(value)
    except (TypeError, ValueError):
        found = math.nan
    if isinstance(value, bool) or not math.isfinite(found) or found < least or found <= above:
        expected = "a positive number" if above == 0 else "0 or a positive number" if least == 0 else "a finite number"
        raise InputError(f"{what} is {value!r}; expected {expected}")
    return found
