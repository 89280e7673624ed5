"""Roll, pitch and yaw: three columns of a log that tell the orientation of a free body, or of a ball joint."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from dropo_torch.data.angles import LABELS, ROLL_PITCH_YAW, quaternions
from dropo_torch.data.observation import joint_name
from dropo_torch.proposal.columns import Column, Columns
from dropo_torch.proposal.motions import SAME, turning
from dropo_torch.proposal.words import Words, called, object_words, split, unit_role

#: Words of the three angles.
ANGLES = (("roll", "pitch", "yaw"), ("phi", "theta", "psi"))
#: Words that say no more of an angle than that it is one of three.
_EMPTY = frozenset(("euler", "eul", "rpy", "attitude", "att", "ahrs"))
#: Sequences of which angles may be, the usual one first.
SEQUENCES = (ROLL_PITCH_YAW, "XYZ", "zyx", "ZYX")
#: Units of angles, for people.
UNITS = {math.pi / 180: "degrees", 1e-3: "mrad", 1.0: "rad"}
#: Pitch beyond which angles are not in rad: it is a quarter turn at most, with some noise.
STEEPEST = 1.65
#: Share of what the usual sequence leaves of a gyroscope's turns at which another one is clearly the log's.
CLEARLY = 0.5


@dataclass(frozen=True)
class Angles:
    """Three columns that tell an orientation.

    Attributes:
        name: what the orientation is called in the config.
        columns: roll, pitch and yaw.
        scale: by which they become rad.
        sequence: the axes about which they turn.
        words: what their names have in common.
    """

    name: str
    columns: tuple[Column, ...]
    scale: float
    sequence: str
    words: Words

    @property
    def entries(self) -> str:
        """The names of the columns."""
        return ", ".join(c.entry for c in self.columns)

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of a config's ``orientations``."""
        return {"angles": [c.as_map(self.scale) for c in self.columns], "sequence": self.sequence}

    @property
    def quaternion(self) -> tuple[Column, ...]:
        """The orientation as columns w, x, y, z."""
        values = quaternions(_in_rad(self.columns, self.scale), self.sequence)
        return tuple(
            Column(
                f"{self.name}[{label}]", self.name, i, values[:, i], values[:, i], False,
                replace(self.words, axis=label), label, self.entries,
            )
            for i, label in enumerate(LABELS)
        )  # fmt: skip

    def said_of(self, body: str) -> str:
        """Return what the columns are, in a sentence."""
        fixed = "the fixed axes" if self.sequence.islower() else "axes that turn with it,"
        axes = f"{fixed} {', '.join(self.sequence.lower())}"
        seen = "" if self.sequence == ROLL_PITCH_YAW else f" ({self.sequence}), as the gyroscope shows"
        unit = UNITS.get(self.scale, "rad")
        return f"{self.entries} are {body}'s orientation: roll, pitch, yaw in {unit} about {axes}{seen}"


def find_angles(columns: Columns, model: mujoco.MjModel, starts: np.ndarray) -> tuple[Angles, ...]:
    """Return the columns that may be orientations of free bodies and ball joints, where the log has no quaternions.

    Args:
        columns: the log.
        model: the robot's.
        starts: rows at which an episode begins, ``(N,)`` bool.
    """
    turned = np.isin(model.jnt_type, [int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)])
    if columns.apart is not None or len(_groups(columns.numeric, quaternion=True)) >= turned.sum():
        return ()
    names = {frozenset(object_words(joint_name(model, int(j)))[0]) for j in np.flatnonzero(~turned)}
    found: dict[tuple, Angles] = {}
    for three in _threes(columns):
        words = _in_common(three)
        if not any(_is_called(c, names) for c in three) and (words.objects, words.numbers) not in found:
            scale = _scale(three)
            sequence = _sequence(_in_rad(three, scale), _groups(columns.numeric, quaternion=False), starts)
            taken = {c.array for c in columns.columns} | {a.name for a in found.values()}
            found[words.objects, words.numbers] = Angles(_name(words, taken), three, scale, sequence, words)
    return tuple(found.values())


def with_angles(columns: Columns, found: Sequence[Angles]) -> Columns:
    """Return a log with quaternions in the place of angles."""
    if not found:
        return columns
    rest = [c for c in columns.columns if not any(c is angle for a in found for angle in a.columns)]
    made = [c for a in found for c in a.quaternion]
    return replace(columns, columns=(*rest, *made), orientations=tuple(found))


def _threes(columns: Columns) -> list[tuple[Column, ...]]:
    """Columns of positions whose names differ by the angle alone: roll, pitch and yaw."""
    groups: dict[tuple, dict[str, Column]] = {}
    for c in columns.numeric:
        name = f"{c.array} {c.label}" if c.label else c.entry
        every = split(name)
        for kind in ANGLES:
            at = [i for i, word in enumerate(every) if word in kind]
            if len(at) == 1 and c.words.role in ("", "position") and unit_role(name) in ("", "position"):
                rest = tuple("" if i == at[0] else word for i, word in enumerate(every))
                groups.setdefault((kind, rest), {}).setdefault(every[at[0]], c)
    return [tuple(group[word] for word in kind) for (kind, _), group in groups.items() if len(group) == len(kind)]


def _in_common(three: Sequence[Column]) -> Words:
    """What the names of three angles say of what turns."""
    words, angles = three[0].words, {word for kind in ANGLES for word in kind}
    objects = tuple(word for word in words.objects if word not in angles | _EMPTY)
    return Words("position", objects=objects, numbers=words.numbers, quaternion=True)


def _is_called(column: Column, names: set[frozenset[str]]) -> bool:
    """Whether a column has the name of one of the model's joints, by words."""
    every = called(f"{column.array} {column.label}" if column.label else column.entry, column.words)
    return any(frozenset(object_words(" ".join(said))[0]) in names for said in every)


def _name(words: Words, taken: set[str]) -> str:
    """What an orientation is called in the config: after what turns, and as nothing else in the log."""
    whose = "_".join([*words.objects, *(str(number) for number in words.numbers)])
    own = [whose, f"{whose}_orientation"] if words.objects else []
    numbered = (f"orientation_{i}" for i in itertools.count(1))
    return next(name for name in itertools.chain(own, ["orientation"], numbered) if name not in taken)


def _in_rad(three: Sequence[Column], scale: float) -> np.ndarray:
    """Roll, pitch and yaw, ``(N, 3)``."""
    return scale * np.stack([c.values for c in three], axis=1)


def _scale(three: Sequence[Column]) -> float:
    """The unit of angles, by their names, or by how large they are."""
    if three[0].words.scale is not None:
        return three[0].words.scale
    values = _in_rad(three, 1.0)
    steep, large = np.abs(values[:, 1]) > STEEPEST, np.abs(values) > 2 * math.pi
    return math.pi / 180 if steep.any() or large.any() else 1.0


def _sequence(angles: np.ndarray, gyroscopes: Sequence[Sequence[Column]], starts: np.ndarray) -> str:
    """The sequence in which a gyroscope clearly turns as the orientation does; the usual one where none does."""
    for group in gyroscopes:
        rates = np.stack([c.values for c in group], axis=1)
        left = {sequence: _left(quaternions(angles, sequence), rates, starts) for sequence in SEQUENCES}
        best = min(SEQUENCES, key=lambda sequence: left[sequence])
        if left[best] < 1 - SAME and left[best] < CLEARLY * left[ROLL_PITCH_YAW]:
            return best
    return ROLL_PITCH_YAW


def _left(quaternion: np.ndarray, rates: np.ndarray, starts: np.ndarray) -> float:
    """Share of the turns of an orientation that a gyroscope leaves unexplained."""
    share, slope = turning(quaternion, rates, starts)
    return 1 - share if slope > 0 else 1.0


def _groups(columns: Sequence[Column], *, quaternion: bool) -> list[list[Column]]:
    """The quaternions of a log, or its gyroscopes, by their components."""
    groups: dict[tuple, list[Column]] = {}
    for c in columns:
        w = c.words
        fits = w.quaternion and w.role == "position" if quaternion else w.angular and w.role == "velocity"
        if fits and (w.axis or w.numbers):
            groups.setdefault((w.objects, w.numbers if w.axis else w.numbers[:-1], bool(w.axis)), []).append(c)
    whole = [sorted(group, key=lambda c: (c.words.axis, c.words.numbers)) for group in groups.values()]
    return [group for group in whole if len(group) == (4 if quaternion else 3)]
