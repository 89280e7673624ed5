"""Features: what of the observed columns is compared, with orientations as rotation vectors.

The columns of an observation mix numbers that may be subtracted with unit quaternions that may not. A feature is a
column of the first kind, divided by its scale, or one of the three components of a rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from dropo_torch.data.observation import Observation
from dropo_torch.errors import InputError, choices


@dataclass(frozen=True, eq=False)
class Features:
    """The m features of n observed columns: the plain columns, then a rotation vector for each quaternion.

    Attributes:
        plain: observed columns that are compared as they are, but for their scale.
        quaternions: columns (w, x, y, z) of each observed quaternion.
        labels: names of the features, m of them.
        units: their units before scaling.
        scale: by which each is divided, ``(m,)``; 1 for rotations.
        masked: columns whose features are never known.
    """

    plain: tuple[int, ...]
    quaternions: tuple[tuple[int, int, int, int], ...]
    labels: tuple[str, ...]
    units: tuple[str, ...]
    scale: np.ndarray
    masked: frozenset[int] = frozenset()

    @classmethod
    def of(cls, observation: Observation, masked: frozenset[int] = frozenset()) -> Features:
        """Return all features of an observation, unscaled; those of ``masked`` columns are never known."""
        taken = {c for q in observation.quaternions for c in q}
        plain = tuple(c for c in range(observation.size) if c not in taken)
        stems = [observation.labels[q[0]].split("[")[0] for q in observation.quaternions]
        turned = tuple(f"{stem}.rotation[{axis}]" for stem in stems for axis in "xyz")
        return cls(
            plain=plain,
            quaternions=observation.quaternions,
            labels=tuple(observation.labels[c] for c in plain) + turned,
            units=tuple(observation.units[c] for c in plain) + ("rad",) * len(turned),
            scale=np.ones(len(plain) + len(turned)),
            masked=masked,
        )

    def scaled(self, measured: np.ndarray) -> Features:
        """Return the same features in units of their standard deviation over measured columns ``(T, n)``."""
        std = torch.from_numpy(measured[:, list(self.plain)]).std(0, unbiased=False).numpy()
        return replace(self, scale=np.concatenate([np.where(std > 0, std, 1.0), np.ones(3 * len(self.quaternions))]))

    def compared(self) -> Features:
        """Return the same features without those that are never known.

        Raises:
            InputError: no feature is left.
        """
        columns = [{c} for c in self.plain] + [set(q) for q in self.quaternions for _ in range(3)]
        kept = [i for i, own in enumerate(columns) if not own & self.masked]
        if not kept:
            raise InputError("mask: every column is masked; leave at least one column unmasked")
        return Features(
            plain=tuple(c for c in self.plain if c not in self.masked),
            quaternions=tuple(q for q in self.quaternions if not self.masked & set(q)),
            labels=tuple(self.labels[i] for i in kept),
            units=tuple(self.units[i] for i in kept),
            scale=self.scale[kept],
        )

    @property
    def size(self) -> int:
        """Number of features m."""
        return len(self.labels)

    def values(self, columns: torch.Tensor, about: torch.Tensor) -> torch.Tensor:
        """Return features ``(..., m)`` of columns ``(..., n)``, orientations as rotations from those of ``about``.

        Differentiable; of the same ``about``, features of measured and of simulated columns may be subtracted.
        """
        parts = [columns[..., list(self.plain)]]
        parts += [rotation_vector(about[..., list(q)], columns[..., list(q)]) for q in self.quaternions]
        return torch.cat(parts, -1) / torch.from_numpy(self.scale)

    def difference(self, measured: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """Return measured minus simulated features, ``(..., m)``, of columns ``(..., n)``; shapes broadcast."""
        parts = [(measured - simulated)[..., list(self.plain)]]
        parts += [_rotation(simulated[..., list(q)], measured[..., list(q)]) for q in self.quaternions]
        return np.concatenate(parts, -1) / self.scale

    def move(self, columns: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Return columns ``(..., n)`` moved by features ``(..., m)``: what :meth:`difference` is to undo."""
        delta = delta * self.scale
        out = np.broadcast_to(columns, (*delta.shape[:-1], columns.shape[-1])).copy()
        plain, turns = np.split(delta, [len(self.plain)], -1)
        out[..., list(self.plain)] += plain
        for i, q in enumerate(self.quaternions):
            out[..., list(q)] = _turned(out[..., list(q)], turns[..., 3 * i : 3 * i + 3])
        return out

    def known(self, valid: np.ndarray) -> np.ndarray:
        """Return which features ``(..., m)`` are known, of columns ``(..., n)``."""
        valid = valid & ~np.isin(np.arange(valid.shape[-1]), list(self.masked))
        parts = [valid[..., list(self.plain)]]
        parts += [np.repeat(valid[..., list(q)].all(-1, keepdims=True), 3, -1) for q in self.quaternions]
        return np.concatenate(parts, -1)

    def gains(self, columns: np.ndarray) -> np.ndarray:
        """Return of features ``(..., m)`` what relates the noise of each to its usual one, from that of columns."""
        parts = [columns[..., list(self.plain)]]
        parts += [np.repeat(columns[..., list(q)].mean(-1, keepdims=True), 3, -1) for q in self.quaternions]
        return np.concatenate(parts, -1)

    def feature_noise(self, columns: np.ndarray) -> np.ndarray:
        """Return σ of the features ``(m,)`` from those of columns ``(n,)``; a quaternion's ν turns by 2ν."""
        turned = [np.repeat(2 * columns[list(q)].mean(), 3) for q in self.quaternions]
        return np.concatenate([columns[list(self.plain)], *turned]) / self.scale

    def column_noise(self, features: np.ndarray) -> np.ndarray:
        """Return σ of the columns ``(n,)`` that gives those of all features ``(m,)``; one to a quaternion."""
        features = features * self.scale
        columns = np.empty(len(self.plain) + 4 * len(self.quaternions))
        columns[list(self.plain)] = features[: len(self.plain)]
        for q, turned in zip(self.quaternions, features[len(self.plain) :].reshape(-1, 3), strict=True):
            columns[list(q)] = 0.5 * np.sqrt(np.mean(turned**2))
        return columns


def _rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Do what :func:`rotation_vector` does for arrays of many windows; SciPy's takes seven times as long."""
    w0, x0, y0, z0 = np.moveaxis(start, -1, 0)
    w1, x1, y1, z1 = np.moveaxis(end, -1, 0)
    w = w0 * w1 + x0 * x1 + y0 * y1 + z0 * z1
    v = np.stack(
        [
            w0 * x1 - x0 * w1 - y0 * z1 + z0 * y1,
            w0 * y1 - y0 * w1 - z0 * x1 + x0 * z1,
            w0 * z1 - z0 * w1 - x0 * y1 + y0 * x1,
        ],
        -1,
    )
    v, w = np.where(w[..., None] < 0, -v, v), np.abs(w)
    sine = np.linalg.norm(v, axis=-1)
    angle = 2 * np.arctan2(sine, w)
    return v * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0)[..., None]


def _turned(quaternion: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Quaternion turned by a rotation vector in the body's frame."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    share = np.where(angle > 1e-12, np.sin(angle / 2) / np.maximum(angle, 1e-300), 0.5)
    w1, (x1, y1, z1) = np.cos(angle / 2)[..., 0], np.moveaxis(turn * share, -1, 0)
    w0, x0, y0, z0 = np.moveaxis(quaternion, -1, 0)
    return np.stack(
        [
            w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
            w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
            w0 * y1 + y0 * w1 + z0 * x1 - x0 * z1,
            w0 * z1 + z0 * w1 + x0 * y1 - y0 * x1,
        ],
        -1,
    )


def rotation_vector(start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """Return the rotation, in the frame of the first, between unit quaternions (w, x, y, z), ``(..., 3)`` in rad.

    Its length is the angle between the two orientations, in [0, π]. Differentiable.
    """
    w0, v0 = start[..., :1], start[..., 1:]
    w1, v1 = end[..., :1], end[..., 1:]
    scalar = w0 * w1 + (v0 * v1).sum(-1, keepdim=True)
    vector = w0 * v1 - w1 * v0 - torch.linalg.cross(v0.expand_as(v1), v1)
    sign = torch.where(scalar < 0, -1.0, 1.0)
    norm = vector.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(norm, scalar * sign)
    return sign * vector * torch.where(norm > 1e-12, angle / norm.clamp(min=1e-300), torch.full_like(norm, 2.0))


def masked_columns(observation: Observation, mask: Sequence[str | int]) -> frozenset[int]:
    """Return the observed columns that labels or numbers name; one column of a quaternion stands for all four.

    Raises:
        InputError: an entry that is no observed column.
    """
    found: set[int] = set()
    for entry in mask:
        if isinstance(entry, int) and not isinstance(entry, bool) and 0 <= entry < observation.size:
            column = entry
        elif str(entry) in observation.labels:
            column = observation.labels.index(str(entry))
        else:
            raise InputError(f"mask: no observed column {entry!r}" + choices(entry, observation.labels))
        found |= next((set(q) for q in observation.quaternions if column in q), {column})
    return frozenset(found)
