"""What a conformance check is made of: laws tried one after the other, and the report of what was tried."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import torch

Case = TypeVar("Case")


class ConformanceError(AssertionError):
    """A law that does not hold.

    Attributes:
        subject: what was checked.
        law: the law's name, a sentence.
        found: what was found instead.
        expected: what would be right.
    """

    def __init__(self, subject: str, law: str, found: str, expected: str) -> None:
        super().__init__(f"{subject}: broken law {law!r}: found {found}; expected {expected}")
        self.subject, self.law, self.found, self.expected = subject, law, found, expected


@dataclass(frozen=True)
class Report:
    """What a check that found nothing has tried.

    Attributes:
        subject: what was checked.
        checked: names of the laws that hold.
        skipped: names of those that could not be tried, and why.
    """

    subject: str
    checked: tuple[str, ...]
    skipped: Mapping[str, str]

    def __str__(self) -> str:
        lines = [f"{self.subject}: {len(self.checked)} laws hold"]
        lines += [f"  holds    {law}" for law in self.checked]
        lines += [f"  skipped  {law}: {why}" for law, why in self.skipped.items()]
        return "\n".join(lines)


class Broken(Exception):
    """Raised inside a law: what was found, and what would be right."""

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(found, expected)
        self.found, self.expected = found, expected


class NotApplicable(Exception):
    """Raised inside a law that cannot be tried, with the reason."""


def require(holds: object, found: str, expected: str) -> None:
    """Raise :class:`Broken` unless a condition holds."""
    if not holds:
        raise Broken(found, expected)


def require_same(found: torch.Tensor, expected: torch.Tensor, what: str, like: str) -> None:
    """Raise :class:`Broken` unless two tensors are equal to the bit, NaN equal to NaN."""
    require(found.shape == expected.shape, f"{what} of shape {tuple(found.shape)}", f"shape {tuple(expected.shape)}")
    same = (found == expected) | (found.isnan() & expected.isnan())
    if not bool(same.all()):
        at = tuple(int(i) for i in (~same).nonzero()[0])
        raise Broken(
            f"{what} that differs in {int((~same).sum())} of {same.numel()} numbers, first at {list(at)}: "
            f"{float(found[at])!r} and {float(expected[at])!r}",
            f"{like}, to the bit",
        )


def try_laws(subject: str, case: Case, laws: Iterable[Callable[[Case], None]]) -> Report:
    """Try laws in turn; the first that is broken ends it.

    Args:
        subject: what is checked, for messages.
        case: handed to each law.
        laws: functions whose names are the laws.

    Raises:
        ConformanceError: a law that does not hold, or in which something raised.
    """
    checked: list[str] = []
    skipped: dict[str, str] = {}
    for law in laws:
        name = law.__name__.strip("_").replace("_", " ")
        try:
            law(case)
        except NotApplicable as reason:
            skipped[name] = str(reason)
        except Broken as broken:
            raise ConformanceError(subject, name, broken.found, broken.expected) from None
        except Exception as error:
            found = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ConformanceError(subject, name, found, "no exception") from error
        else:
            checked.append(name)
    return Report(subject, tuple(checked), skipped)
