"""What was matched: a column of a log that is a number of a model, and the places that have none."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from dropo_torch.proposal.columns import Column
from dropo_torch.proposal.places import Place

#: Factors between a sensor's unit and the model's; the second kind are those of lengths.
ANGLES = {1.0: "rad", math.pi / 180: "degrees", math.pi / 30: "rpm"}
LENGTHS = {1.0: "m", 1e-3: "mm", 1e-2: "cm"}
Sureness = Literal["sure", "likely", "guess"]


def unit_name(scale: float, place: Place) -> str:
    """Return the unit of a column's values, for people."""
    known = ANGLES if place.measure == "angle" else LENGTHS
    if place.measure == "quaternion":
        return "–"
    if place.kind == "command" and place.takes == "effort":
        return {"angle": "N·m", "length": "N"}.get(place.measure, "SI") if scale == 1.0 else f"{scale:g} × SI"
    near = next((name for factor, name in known.items() if math.isclose(abs(scale), factor)), f"{abs(scale):g} × SI")
    per = "/s" if (place.kind == "velocity" or (place.takes == "velocity" and place.kind == "command")) else ""
    return near + ("" if near == "rpm" else per) + (", reversed" if scale < 0 else "")


@dataclass(frozen=True)
class Match:
    """A column that is a number of the model.

    Attributes:
        place: the number.
        column: the column.
        scale: by which its values are multiplied.
        sureness: how sure that is.
        why: by what it was found, in words.
        offset: what is then added.
        told_in: the unit of the values, where it is none of the usual.
    """

    place: Place
    column: Column
    scale: float
    sureness: Sureness
    why: str
    offset: float = 0.0
    told_in: str = ""

    @property
    def values(self) -> np.ndarray:
        """The values in the model's unit, ``(N,)``."""
        return self.scale * self.column.values + self.offset

    @property
    def entry(self) -> str | dict[str, Any]:
        """The entry of a column map, which makes them so."""
        return self.column.as_map(self.scale, self.offset)

    @property
    def unit(self) -> str:
        """The unit of the column's values, for people."""
        return self.told_in or unit_name(self.scale, self.place)


@dataclass(frozen=True)
class Matching:
    """The columns that were found, and the places that have none.

    Attributes:
        matches: what was matched, in the model's order: positions, velocities, commands.
        missing: places without a column.
        unused: columns of numbers that move and are none of the model's.
        otherwise: those of them that are velocities of a free body along other axes than the model has them.
    """

    matches: tuple[Match, ...]
    missing: tuple[Place, ...]
    unused: tuple[Column, ...]
    otherwise: tuple[Column, ...] = ()

    def of(self, kind: str) -> tuple[Match, ...]:
        """Return the matches of a kind, in the model's order."""
        return tuple(m for m in self.matches if m.place.kind == kind)

    def at(self, label: str) -> Match | None:
        """Return the match of a place, or ``None``."""
        return next((m for m in self.matches if m.place.label == label), None)

    def array(self, name: str) -> tuple[Match, ...]:
        """Return the matches whose columns are of an array."""
        return tuple(m for m in self.matches if m.column.array == name)

    def lacks(self, kind: str) -> tuple[Place, ...]:
        """Return the places of a kind that have no column."""
        return tuple(p for p in self.missing if p.kind == kind)


def orientation(joint: int, places: Sequence[Place], found: Mapping[str, Match]) -> np.ndarray | None:
    """Return the orientation of a free body as columns show it, ``(N, 4)``; ``None`` without them."""
    parts = [found.get(p.label) for p in places if p.joint == joint and p.measure == "quaternion"]
    return np.stack([m.values for m in parts if m], axis=1) if len(parts) == 4 and all(parts) else None


def is_taken(column: Column, found: Mapping[str, Match]) -> bool:
    """Return whether a column is a number of the model already."""
    return any(m.column is column for m in found.values())
