"""What is raised when the user's input cannot be used, and how near misses are named."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

#: Characters of a message.
LONGEST = 1200


def one_line(text: object) -> str:
    """Return text as one line that any terminal can show: what is unprintable written out, its middle left out."""
    line = " ".join(str(text).split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    if len(line) <= LONGEST:
        return line
    return f"{line[: LONGEST - 400]} ... [{len(line) - LONGEST + 100:,} characters left out] ... {line[-300:]}"


class InputError(ValueError):
    """A config, log, model or option that cannot be used as given.

    The message is one line: what is wrong, where it stands, and what would be right. The command
    line prints it and exits with code 2; :func:`one_line` makes it one.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


class UnsupportedModel(InputError):
    """A model that the chosen backend does not simulate; another one may."""


def choices(name: object, available: Iterable[object]) -> str:
    """Return ``"; did you mean 'x'? (there are: x, y, z)"`` for an unknown ``name``."""
    names = [str(a) for a in available]
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.6 if len(str(name)) > 3 else 0.5)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    shown = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
    return f"{hint} (there are: {shown})" if names else f"{hint} (there are none)"
