"""What a user gives, checked: keys that are known, numbers in their range, files that can be read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from dropo_torch.errors import InputError, choices

#: Characters of a library's own message that are passed on.
_LONGEST = 300


@contextmanager
def reading(where: object, kind: str, remedy: str = "") -> Iterator[None]:
    """Turn what a library raises on something that it cannot read into an :class:`InputError` of one line.

    Args:
        where: what is read.
        kind: what it should be.
        remedy: what the user can do about it.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # on a corrupt file these libraries raise whatever comes up
        reason = " ".join(str(error).split())[:_LONGEST] or type(error).__name__
        raise InputError(f"{where}: cannot be read as {kind} ({reason}){remedy and '; '}{remedy}") from None


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
