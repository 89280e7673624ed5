"""The numbers in a ROS message: those of a field, and what each is called.

A field is found by its path, ``pose.position``. Its numbers are called

* by joints, where the message names as many as there are numbers (``name``, ``joint_names``);
* by child frames in a list of transforms, and below them ``translation.x`` to ``rotation.z``;
* otherwise by the fields below it, ``position.x`` to ``orientation.z``, or ``0``, ``1``, ... in a plain list.

Quaternions come as (w, x, y, z), as in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dropo_torch.errors import InputError, choices

_QUATERNION = "geometry_msgs/msg/Quaternion"
_ODOMETRY = "nav_msgs/msg/Odometry"
_POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
_NAMES = ("name", "joint_names", "dof_names", "interface_names")
_NO_NUMBERS = ("header", "layout", *_NAMES)


@dataclass(frozen=True)
class Part:
    """The numbers of a field in one message; a list of transforms has one part for each.

    Attributes:
        labels: what the numbers are called; none where the field is empty.
        values: the numbers.
        header: the header that they are stamped by, or ``None``.
        keyed: whether the labels are joints or frames, whose order is the sender's.
        frame: the child frame of a transform.
        quaternions: labels at which a unit quaternion begins.
    """

    labels: tuple[str, ...]
    values: list[float]
    header: Any = None
    keyed: bool = False
    frame: str = ""
    quaternions: tuple[str, ...] = ()


def parts(value: Any, path: Sequence[str], where: str, header: Any = None, names: Sequence[str] = ()) -> Iterator[Part]:
    """Yield the numbers of the field at a path below a message.

    Args:
        value: the message, or what is there on the way down.
        path: names of fields.
        where: names the field in messages.
        header: the one above.
        names: the joints that are named above.

    Raises:
        InputError: a field that is not there or holds no numbers, more or fewer numbers than joints.
    """
    header = getattr(value, "header", header)
    names = next((found for key in _NAMES if isinstance(found := getattr(value, key, None), list)), names)
    if not path:
        yield _leaf(value, where, header, names)
        return
    if path[0] not in getattr(value, "__dict__", {}):
        raise InputError(f"{where}: {kind(value)} has no field {path[0]!r}{choices(path[0], numeric_fields(value))}")
    below = getattr(value, path[0])
    if kind(value) == _ODOMETRY and list(path) == ["twist"]:
        yield _leaf(_free_velocity(value), where, header, ())
    elif isinstance(below, list) and (not below or hasattr(below[0], "__msgtype__")):
        yield from _of_list(below, path[1:], where, header, names)
    else:
        yield from parts(below, path[1:], where, header, names)


def kind(value: Any) -> str:
    """Return a message's type, such as ``sensor_msgs/msg/JointState``."""
    return str(getattr(value, "__msgtype__", type(value).__name__))


def numeric_fields(value: Any) -> tuple[str, ...]:
    """Return the fields of a message that hold numbers, or messages; covariances are none."""
    given: Mapping[str, Any] = value if isinstance(value, Mapping) else getattr(value, "__dict__", {})
    return tuple(
        name
        for name, below in given.items()
        if name not in _NO_NUMBERS and not name.endswith("covariance") and not isinstance(below, str)
    )


def _of_list(elements: list[Any], path: Sequence[str], where: str, header: Any, names: Sequence[str]) -> Iterator[Part]:
    """Yield the numbers below a path in a list of messages: transforms by frame, others by joint or number."""
    if not elements:
        return
    if hasattr(elements[0], "child_frame_id"):
        for element in elements:
            frame = element.child_frame_id
            for part in parts(element, path, where, header):
                labels, turned = (tuple(f"{frame}.{label}" for label in of) for of in (part.labels, part.quaternions))
                yield replace(part, labels=labels, keyed=True, frame=frame, quaternions=turned)
        return
    if kind(elements[0]) == _POINT:
        if len(elements) > 1:
            raise InputError(
                f"{where}: a message has {len(elements)} points, between which the controller interpolates; expected "
                "one point a message: use the set-points in the state that the controller publishes"
            )
        yield from parts(elements[0], path, where, header, names)
        return
    keyed = len(names) == len(elements)
    found = [
        (f"{names[i] if keyed else i}" + ("" if len(part.labels) == 1 and label == "0" else f".{label}"), number)
        for i, element in enumerate(elements)
        for part in parts(element, path, where, header)
        for label, number in zip(part.labels, part.values, strict=True)
    ]
    yield Part(tuple(label for label, _ in found), [number for _, number in found], header, keyed)


def _leaf(value: Any, where: str, header: Any, names: Sequence[str]) -> Part:
    """The numbers of a field, by joints where as many are named above it."""
    if isinstance(value, np.ndarray) and len(names):
        if len(value) not in (0, len(names)):
            raise InputError(f"{where} has {len(value)} numbers for {len(names)} joints ({', '.join(names[:20])})")
        if len(set(names)) < len(names):
            raise InputError(f"{where}: two joints of one message have the same name ({', '.join(names[:20])})")
        return Part(tuple(names) if len(value) else (), value.astype(np.float64).tolist(), header, keyed=True)
    turned: list[str] = []
    pairs = list(_numbers(value, "", turned, where))
    return Part(tuple(label or "0" for label, _ in pairs), [n for _, n in pairs], header, quaternions=tuple(turned))


def _numbers(value: Any, label: str, turned: list[str], where: str) -> Iterator[tuple[str, float]]:
    """Yield all numbers of a value with their labels; add the first labels of quaternions to ``turned``."""
    dot = f"{label}." if label else ""
    if isinstance(value, bool | int | float | np.generic):
        yield label, float(value)
    elif isinstance(value, np.ndarray):
        yield from ((f"{dot}{i}", float(number)) for i, number in enumerate(value.reshape(-1)))
    elif kind(value) == _QUATERNION:
        turned.append(f"{dot}w")
        yield from ((f"{dot}{axis}", float(getattr(value, axis))) for axis in "wxyz")
    elif keys := numeric_fields(value):
        below = {key: value[key] if isinstance(value, Mapping) else getattr(value, key) for key in keys}
        only = len(keys) == 1 and hasattr(below[keys[0]], "__msgtype__")  # PoseStamped is its pose
        for key in keys:
            yield from _numbers(below[key], label if only else f"{dot}{key}", turned, where)
    else:
        raise InputError(f"{where} holds no numbers, but {kind(value)}; expected a field of numbers")


def _free_velocity(odometry: Any) -> dict[str, Any]:
    """The velocity of an odometry as MuJoCo has it for free joints: linear in the world's axes, angular in the body's.

    ROS gives both in the body's.
    """
    q, twist = odometry.pose.pose.orientation, odometry.twist.twist
    axis, linear = np.array([q.x, q.y, q.z]), np.array([twist.linear.x, twist.linear.y, twist.linear.z])
    across = 2 * np.cross(axis, linear)
    angular = np.array([twist.angular.x, twist.angular.y, twist.angular.z])
    return {"linear": linear + q.w * across + np.cross(axis, across), "angular": angular}
