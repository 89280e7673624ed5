"""Orientations that a log tells by three angles, such as roll, pitch and yaw, as unit quaternions."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dropo_torch.data.tables import ColumnMap, Table
from dropo_torch.errors import InputError
from dropo_torch.support.given import check_keys

#: Roll, pitch and yaw: turns about the fixed axes x, y and z, in this order.
ROLL_PITCH_YAW = "xyz"
#: What the columns of a quaternion are called.
LABELS = ("w", "x", "y", "z")
_KEYS = ("angles", "sequence")


def quaternions(angles: np.ndarray, sequence: str = ROLL_PITCH_YAW) -> np.ndarray:
    """Return the unit quaternions w, x, y, z of angles ``(N, 3)`` in rad, ``(N, 4)``; NaN where an angle is.

    A quaternion and its negative are one orientation: of the two, each row has the one near the row before.

    Args:
        angles: of the three turns.
        sequence: their axes: ``xyz`` in any order, which are fixed, or ``XYZ``, which turn with the body.
    """
    found = np.full((len(angles), 4), np.nan)
    known = np.isfinite(angles).all(axis=1)
    if known.any():
        turned = Rotation.from_euler(sequence, angles[known]).as_quat(scalar_first=True)
        along = (turned[1:] * turned[:-1]).sum(axis=1)
        turned[1:] *= np.cumprod(np.where(along < 0, -1.0, 1.0))[:, None]
        found[known] = turned
    return found


def check_orientations(given: Any) -> None:
    """Raise an :class:`InputError` for orientations of another form than ``{NAME: {angles: ..., sequence: ...}}``."""
    if not isinstance(given, Mapping):
        raise InputError(
            f"data: orientations is {given!r}; expected names with their angles, such as "
            "{hull: {angles: [roll, pitch, yaw]}}"
        )
    for name, of in given.items():
        where = f"data: orientations: {name}"
        if not isinstance(name, str) or not name or set(name) & set("[]"):
            raise InputError(f"data: orientations: {name!r} is no name; expected text without brackets, such as hull")
        if not isinstance(of, Mapping):
            raise InputError(f"{where} is {of!r}; expected angles, such as {{angles: [roll, pitch, yaw]}}")
        check_keys(of, _KEYS, where)
        if "angles" not in of:
            raise InputError(f"{where} has no angles; expected three columns, such as angles: [roll, pitch, yaw]")
        sequence = of.get("sequence", ROLL_PITCH_YAW)
        if not isinstance(sequence, str) or not re.fullmatch(r"(?!.*(.)\1)([xyz]{3}|[XYZ]{3})", sequence):
            raise InputError(
                f"{where}: sequence is {sequence!r}; expected three axes, no two neighbours alike: xyz of fixed axes, "
                "XYZ of axes that turn with the body"
            )


def with_orientations(table: Table, given: Mapping[str, Mapping[str, Any]] | None, *, lenient: bool = False) -> Table:
    """Return a table with an array w, x, y, z more for each orientation that it tells by angles.

    Args:
        table: the log.
        given: name → ``angles``, a column map of three columns in rad, and their ``sequence``.
        lenient: whether text in a few cells of an angle counts as no sample.

    Raises:
        InputError: a name that the log has, or a log whose signals have time stamps of their own.
    """
    if not given:
        return table
    if table.choose is not None:
        raise InputError(
            f"{table.source}: orientations are made of angles in one row, and every signal of this log has time stamps "
            "of its own; leave them out, and take a quaternion's topic"
        )
    for name in given:
        if name in table.names:
            raise InputError(f"{table.source}: orientations: {name} is in the log already; expected another name")
    told = replace(table, lenient=lenient)
    made = {
        name: functools.cache(functools.partial(_read, told, name, of["angles"], of.get("sequence", ROLL_PITCH_YAW)))
        for name, of in given.items()
    }
    return replace(
        table,
        names=(*table.names, *made),
        read=lambda name: made[name]() if name in made else table.read(name),
        labels={**table.labels, **dict.fromkeys(made, LABELS)},
        quaternions={**table.quaternions, **dict.fromkeys(made, (0,))},
    )


def _read(table: Table, name: str, angles: ColumnMap, sequence: str) -> np.ndarray:
    """The quaternions of one orientation."""
    values, names = table.matrix(angles, f"orientations: {name}")
    if len(names) != 3:
        told = f" ({', '.join(names)})" if 0 < len(names) < 10 else ""
        raise InputError(
            f"{table.source}: orientations: {name}: angles are {len(names)} columns{told}; expected three, such as "
            "[roll, pitch, yaw]"
        )
    return quaternions(values, sequence)
