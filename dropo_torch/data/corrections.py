"""What a config corrects in a log as it is read: units and signs, angles that wrap, rows of the commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dropo_torch.data.recording import Recording, resolve_names
from dropo_torch.errors import InputError
from dropo_torch.support.given import number

TURN = 2 * np.pi


@dataclass(frozen=True)
class Corrections:
    """Corrections, in the order in which they are made.

    Attributes:
        scale: signal → factor, such as 0.0174532925 for degrees or -1 for a sign.
        unwrap: angles in rad that jump by a turn where they leave their range; they become continuous.
        shift: the command of row t is the one that the file has so many rows later (earlier where negative).
    """

    scale: Mapping[str, float] = field(default_factory=dict)
    unwrap: Sequence[str] = ()
    shift: int = 0

    @classmethod
    def of(cls, scale: Any, unwrap: Any, shift: Any) -> Corrections:
        """Return the corrections that a config gives, ``None`` for none of a kind.

        Raises:
            InputError: values of another form.
        """
        if not isinstance(scale or {}, Mapping):
            raise InputError(f"data: scale is {scale!r}; expected signal: factor")
        if isinstance(unwrap or [], str) or not isinstance(unwrap or [], Sequence):
            raise InputError(f"data: unwrap is {unwrap!r}; expected a list of signals")
        if isinstance(shift, bool) or not isinstance(shift or 0, int):
            raise InputError(f"data: shift is {shift!r}; expected a whole number of rows")
        factors = {str(name): number(factor, f"data: scale: {name}") for name, factor in (scale or {}).items()}
        if 0.0 in factors.values():
            raise InputError("data: scale: a factor is 0; expected another number")
        return cls(factors, tuple(str(name) for name in unwrap or ()), shift or 0)

    def __bool__(self) -> bool:
        """Return whether anything is corrected."""
        return bool(self.scale or self.unwrap or self.shift)


def corrected(
    recording: Recording, next_observations: np.ndarray | None, corrections: Corrections
) -> tuple[Recording, np.ndarray | None]:
    """Return a recording, and what the file holds as its next observations ``(N, n)``, with corrections.

    Raises:
        InputError: a signal that is not there, episodes no longer than the shift.
    """
    if not corrections:
        return recording, next_observations
    factors = _factors(recording, corrections.scale)
    width = len(recording.observation_names)
    following = None if next_observations is None else next_observations * factors[:width]
    recording = replace(
        recording, observations=recording.observations * factors[:width], actions=recording.actions * factors[width:]
    )
    recording, following = _unwrapped(recording, following, corrections.unwrap)
    return _shifted(recording, following, corrections.shift)


def _factors(recording: Recording, scale: Mapping[str, float]) -> np.ndarray:
    """The factor of each signal, ``(n + m,)``."""
    factors = np.ones(len(recording.names))
    for name, factor in scale.items():
        for found in resolve_names([name], recording.names, f"{recording.source}: scale"):
            factors[recording.names.index(found)] = factor
    return factors


def _unwrapped(
    recording: Recording, following: np.ndarray | None, names: Sequence[str]
) -> tuple[Recording, np.ndarray | None]:
    """The recording with continuous angles in each episode."""
    if not names:
        return recording, following
    for name in names:
        if name in recording.action_names:
            raise InputError(f"{recording.source}: unwrap: {name} is a command; expected an observation")
    found = resolve_names(names, recording.observation_names, f"{recording.source}: unwrap")
    columns = [recording.observation_names.index(name) for name in found]
    values = np.array(recording.observations)
    bounds = np.flatnonzero(np.diff(recording.episodes)) + 1
    for part in np.split(np.arange(len(values)), bounds):
        for column in columns:
            values[part, column] = continuous(values[part, column])
    if following is not None:
        following = np.array(following)
        turns = np.round((values[:, columns] - following[:, columns]) / TURN)
        following[:, columns] += TURN * turns
    return replace(recording, observations=values), following


def continuous(angle: np.ndarray) -> np.ndarray:
    """An angle ``(N,)`` without jumps by a turn, the first within half a turn of 0; NaN, which is no sample, stays."""
    angle, present = np.array(angle), ~np.isnan(angle)
    unwrapped = np.unwrap(angle[present])
    angle[present] = unwrapped - TURN * np.round(unwrapped[:1] / TURN)
    return angle


def _shifted(recording: Recording, following: np.ndarray | None, shift: int) -> tuple[Recording, np.ndarray | None]:
    """The recording with the commands of other rows; rows without one are left out."""
    if not shift:
        return recording, following
    row = np.arange(len(recording))
    taken = row + shift
    inside = (taken >= 0) & (taken < len(recording))
    taken = np.where(inside, taken, row)
    kept = row[inside & (recording.episodes[taken] == recording.episodes)]
    if kept.size == 0:
        raise InputError(f"{recording.source}: shift is {shift} rows; no episode is longer than that")
    assert recording.rows is not None
    rest = {name: getattr(recording, name)[kept] for name in ("observations", "episodes", "rows")}
    time = None if recording.time is None else recording.time[kept]
    moved = replace(recording, **rest, time=time, actions=recording.actions[taken[kept]])
    return moved, None if following is None else following[kept]


def break_rows(breaks: Any, rows: int, source: str) -> list[int]:
    """Return the rows at which episodes begin, as a config gives them.

    Raises:
        InputError: something else than rows of the file.
    """
    if breaks is None:
        return []
    if isinstance(breaks, str) or not isinstance(breaks, Sequence):
        raise InputError(f"{source}: breaks is {breaks!r}; expected a list of rows, counted from 0")
    for row in breaks:
        if isinstance(row, bool) or not isinstance(row, int) or not 0 < row < rows:
            raise InputError(f"{source}: breaks: {row!r}; expected rows from 1 to {rows - 1}, counted from 0")
    return list(breaks)
