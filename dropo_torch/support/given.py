"""What a user gives, checked: keys that are known, numbers in their range, files that can be read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dropo_torch.errors import InputError, choices

#: Characters of a library's own message that are passed on.
_LONGEST = 300
#: Bytes of a text file, and of one array in memory.
MOST_TEXT, MOST_BYTES = 10_000_000, 2**31


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


def read_text(path: Path, what: str) -> str:
    """Return the text of a file of at most :data:`MOST_TEXT` bytes.

    Raises:
        InputError: a larger file, or one that is no UTF-8.
    """
    with reading(f"{what}: {path}", "text in UTF-8"), path.open("rb") as file:
        content = file.read(MOST_TEXT + 1)
        if len(content) > MOST_TEXT:
            raise InputError(f"{what}: {path} has more than {MOST_TEXT:,} bytes; expected a text file")
        return content.decode("utf-8-sig")


def user_path(base: Path, given: object) -> Path:
    """Return a path that a user gave, seen from a folder; ``~`` and ``~name`` are homes.

    Raises:
        InputError: no text, or a path that no file can have.
    """
    if not isinstance(given, str | Path) or "\0" in str(given):
        raise InputError(f"{given!r} given; expected a path")
    try:
        return base / Path(given).expanduser()
    except RuntimeError:
        raise InputError(f"{given}: there is no such home folder; expected a path") from None


def check_size(count: int, itemsize: int, where: object) -> None:
    """Raise an :class:`InputError` for an array that would take more than :data:`MOST_BYTES`.

    Args:
        count: its elements, as its file declares them: a small file may declare many.
        itemsize: bytes of each, as the file holds them; in memory a number has eight.
        where: names it in messages.
    """
    if (size := count * max(itemsize, 8)) > MOST_BYTES:
        raise InputError(
            f"{where}: declares {size / 2**30:.3g} GiB; at most {MOST_BYTES / 2**30:g} GiB of one array are read: "
            "cut the log into several files, or keep every n-th row"
        )


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
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if isinstance(value, bool) or not math.isfinite(found) or found < least or found <= above:
        expected = "a positive number" if above == 0 else "0 or a positive number" if least == 0 else "a finite number"
        raise InputError(f"{what} is {value!r}; expected {expected}")
    return found
