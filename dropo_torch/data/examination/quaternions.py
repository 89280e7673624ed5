"""Quaternions: their order, their length, and the frame of the angular velocity."""

from __future__ import annotations

import itertools

import numpy as np

from dropo_torch.data.examination.finding import Finding, confidence, first_rows
from dropo_torch.data.examination.record import Orientation, Record, entry
from dropo_torch.data.examination.rules import Rules

#: How a log may order (w, x, y, z): for each, where w, x, y and z stand.
ORDERS = {"wxyz": (0, 1, 2, 3), "xyzw": (3, 0, 1, 2)}
FRAMES = ("body", "world")


def quaternions(record: Record, rules: Rules) -> list[Finding]:
    """Return what is wrong with the log's orientations."""
    found = []
    for o in record.orientations:
        lengths = _lengths(record, o, rules)
        found += lengths
        if not any(f.sure for f in lengths):
            found += _readings(record, o, rules) if o.velocity is not None else _pose(record, o)
    return found


def _lengths(record: Record, o: Orientation, rules: Rules) -> list[Finding]:
    columns = list(o.quaternion)
    both = np.concatenate([record.before[:, columns], record.after[:, columns]])
    length = np.linalg.norm(both, axis=1)
    off = np.abs(length - 1)
    rows = np.flatnonzero(off.reshape(2, -1).max(axis=0) > rules.norm)
    if rows.size == 0:
        return []
    empty = bool((length < 1e-6).any())
    sure = empty or float(np.median(off)) > rules.sure_norm
    what = (
        f"the quaternion of {o.name} has lengths from {length.min():.3g} to {length.max():.3g} instead of 1, off by "
        f"more than {rules.norm:.0%} in {len(rows)} rows"
    )
    advice = "these columns are no quaternion: see observation" if sure else "noise, or an average of several rows"
    return [Finding(
        "quaternion_length", tuple(record.label(c) for c in columns), what, confidence(sure), rows=first_rows(rows),
        evidence={"least": float(length.min()), "most": float(length.max()), "median_deviation": float(np.median(off))},
        advice=advice,
    )]  # fmt: skip


def _readings(record: Record, o: Orientation, rules: Rules) -> list[Finding]:
    """Whether the angular velocity turns the quaternion as it is read, or as it may be meant."""
    assert o.velocity is not None
    rows = np.flatnonzero(~record.cut)
    mean = 0.5 * (record.before[rows][:, list(o.velocity)] + record.after[rows][:, list(o.velocity)])
    left = {}
    for (order, places), frame in itertools.product(ORDERS.items(), FRAMES):
        columns = [o.quaternion[i] for i in places]
        turned = rotations(record.before[rows][:, columns], record.after[rows][:, columns], frame)
        left[order, frame] = _left(turned, mean)
    own, best = left["wxyz", "body"], min(left, key=lambda key: left[key])
    evidence = {f"{order}, {frame}": value for (order, frame), value in left.items()}
    if best == ("wxyz", "body") or left[best] > rules.turned or own < rules.turned_worse * left[best]:
        return []
    labels = tuple(record.label(i) for i in (*o.quaternion, *o.velocity))
    if best[0] == "xyzw":
        what = f"the quaternion of {o.name} is in the order x, y, z, w; MuJoCo's is w, x, y, z"
        if best[1] == "world":
            what += ", and its angular velocity is in the world's frame; MuJoCo's is the body's"
        return [Finding("quaternion_order", labels, what, "sure", evidence=evidence, cure=_reordered(record, o))]
    what = f"the angular velocity of {o.name} is in the world's frame; MuJoCo's is the body's"
    names = [record.signal(i) for i in o.quaternion]
    advice = f"leave it out and let it be derived: data: {{preprocess: {{dt: {record.step}, quaternions: [{names}]}}}}"
    return [Finding("angular_frame", labels, what, "sure", evidence=evidence, advice=advice.replace("'", ""))]


def _reordered(record: Record, o: Orientation) -> dict[str, object]:
    """The observation with the quaternion's columns as they are meant."""
    listed = ["skip"] * record.observation.log_width
    for i, place in enumerate(record.observation.columns):
        listed[record.observation.log_columns[i]] = entry(record, place)
    for component, column in zip((1, 2, 3, 0), o.quaternion, strict=True):
        listed[record.observation.log_columns[column]] = f"qpos[{o.qpos + component}]"
    return {"observation": listed}


def _pose(record: Record, o: Orientation) -> list[Finding]:
    """Without an angular velocity: whether the first poses are those of the model in the other order alone."""
    assert record.model is not None
    own = record.model.qpos0[o.qpos : o.qpos + 4]
    starts = np.flatnonzero(np.append(True, record.parted[:-1]))
    near = {}
    for order, places in ORDERS.items():
        first = record.before[starts][:, [o.quaternion[i] for i in places]]
        dot = np.abs(first @ own) / np.maximum(np.linalg.norm(first, axis=1), 1e-12)
        near[order] = float(np.median(2 * np.arccos(np.clip(dot, 0, 1))))
    if near["xyzw"] > 0.5 or near["wxyz"] < 1.5:
        return []
    what = (
        f"the quaternion of {o.name} begins {np.rad2deg(near['wxyz']):.0f}° from the model's pose, and read as "
        f"x, y, z, w {np.rad2deg(near['xyzw']):.0f}° from it"
    )
    labels = tuple(record.label(i) for i in o.quaternion)
    return [Finding("quaternion_order", labels, what, "doubtful", evidence=near, cure=_reordered(record, o))]


def rotations(before: np.ndarray, after: np.ndarray, frame: str) -> np.ndarray:
    """Return the rotation vectors ``(T, 3)`` between quaternions ``(T, 4)``, in the body's or the world's frame."""
    inverse = before * np.array([1.0, -1.0, -1.0, -1.0])
    between = product(inverse, after) if frame == "body" else product(after, inverse)
    between = between * np.where(between[:, :1] < 0, -1.0, 1.0)
    size = np.linalg.norm(between[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(size, between[:, :1])
    return np.asarray(between[:, 1:] * np.divide(angle, size, out=np.full_like(size, 2.0), where=size > 1e-12))


def product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the products of quaternions ``(T, 4)``."""
    w, v, a, b = first[:, :1], first[:, 1:], second[:, :1], second[:, 1:]
    return np.concatenate([w * a - (v * b).sum(axis=1, keepdims=True), w * b + a * v + np.cross(v, b)], axis=1)


def _left(turned: np.ndarray, mean: np.ndarray) -> float:
    """Share of rotations that angular velocities leave unexplained, with the best time step; 1 for none."""
    whole, size = float((turned**2).sum()), float((mean**2).sum())
    if whole == 0 or size == 0:
        return 1.0
    slope = max(float((turned * mean).sum()) / size, 0.0)
    off = ((turned - slope * mean) ** 2).sum(axis=1)
    kept = off <= np.quantile(off, 0.95)
    whole = float((turned[kept] ** 2).sum())
    return float(off[kept].sum()) / whole if whole > 0 else 1.0
