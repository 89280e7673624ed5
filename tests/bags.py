"""Small ROS bags, written by rosbags."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

KINDS = ("bag", "mcap", "db3", "folder")
START = 1_700_000_000.0  # seconds at which bags begin

#: topic, message type, time of receipt in seconds, message (made of a store of types)
Sent = tuple[str, str, float, Any]


def store(kind: str = "mcap") -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    header, point = "std_msgs/Header header", "trajectory_msgs/JointTrajectoryPoint"
    state = f"{header}\nstring[] joint_names\n{point} reference\n{point} feedback\n"
    types.register(get_types_from_msg(state, "control_msgs/msg/JointTrajectoryControllerState"))
    motors = "uint8 level\nfloat32 q\nfloat32 dq"
    types.register(get_types_from_msg(motors, "quad_msgs/msg/Motor"))
    types.register(get_types_from_msg(f"{header}\nquad_msgs/Motor[] motors", "quad_msgs/msg/LowState"))
    return types


def write(path: Path, sent: Iterable[Sent], topics: Sequence[tuple[str, str]] = (), kind: str = "mcap") -> Path:
    """Write a bag of some kind; return the path that is read. Topics may be there without messages."""
    types, sent = store(kind), list(sent)
    if kind == "bag":
        from rosbags.rosbag1 import Writer as Writer1

        path, serialize = path.with_suffix(".bag"), types.serialize_ros1
        writer: Any = Writer1(path)
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        serialize = types.serialize_cdr
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(path, version=9, storage_plugin=plugin)
    with writer:
        known = dict.fromkeys([*topics, *((topic, name) for topic, name, _, _ in sent)])
        connections = {topic: writer.add_connection(topic, name, typestore=types) for topic, name in known}
        for topic, name, received, message in sorted(sent, key=lambda one: one[2]):
            writer.write(connections[topic], round(1e9 * received), serialize(message, name))
    if kind in ("mcap", "db3"):
        return next(path.glob(f"*.{kind}"))
    return path


class Messages:
    """Messages of a store of types, made of plain numbers."""

    def __init__(self, kind: str = "mcap") -> None:
        self.kind, self.types = kind, store(kind).types

    def new(self, name: str, *given: Any, **named: Any) -> Any:
        return self.types[name](*given, **named)

    def time(self, seconds: float) -> Any:
        whole = round(1e9 * seconds)
        return self.new("builtin_interfaces/msg/Time", sec=whole // 10**9, nanosec=whole % 10**9)

    def header(self, stamp: float, frame: str = "world") -> Any:
        given = {"stamp": self.time(stamp), "frame_id": frame}
        return self.new("std_msgs/msg/Header", **given, **({"seq": 0} if self.kind == "bag" else {}))

    def joint_state(
        self, stamp: float, names: Sequence[str], position: Sequence[float], velocity: Sequence[float] = ()
    ) -> Any:
        numbers = (np.array(of, dtype=float) for of in (position, velocity, ()))
        return self.new("sensor_msgs/msg/JointState", self.header(stamp), list(names), *numbers)

    def numbers(self, data: Sequence[float]) -> Any:
        layout = self.new("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        return self.new("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(data, dtype=float))

    def point(self, positions: Sequence[float]) -> Any:
        empty = np.zeros(0)
        zero = self.new("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
        return self.new(
            "trajectory_msgs/msg/JointTrajectoryPoint", np.array(positions, dtype=float), empty, empty, empty, zero
        )

    def trajectory(self, stamp: float, names: Sequence[str], *points: Sequence[float]) -> Any:
        made = [self.point(point) for point in points]
        return self.new("trajectory_msgs/msg/JointTrajectory", self.header(stamp), list(names), made)

    def controller(self, stamp: float, names: Sequence[str], reference: Sequence[float]) -> Any:
        name = "control_msgs/msg/JointTrajectoryControllerState"
        return self.new(name, self.header(stamp), list(names), self.point(reference), self.point([]))

    def vector(self, xyz: Sequence[float], name: str = "Vector3") -> Any:
        return self.new(f"geometry_msgs/msg/{name}", *map(float, xyz))

    def quaternion(self, wxyz: Sequence[float]) -> Any:
        w, x, y, z = map(float, wxyz)
        return self.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, xyz: Sequence[float], wxyz: Sequence[float]) -> Any:
        return self.new("geometry_msgs/msg/Pose", self.vector(xyz, "Point"), self.quaternion(wxyz))

    def pose_stamped(self, stamp: float, xyz: Sequence[float], wxyz: Sequence[float]) -> Any:
        return self.new("geometry_msgs/msg/PoseStamped", self.header(stamp), self.pose(xyz, wxyz))

    def transform(
        self, stamp: float, child: str, xyz: Sequence[float], wxyz: Sequence[float], parent: str = "world"
    ) -> Any:
        moved = self.new("geometry_msgs/msg/Transform", self.vector(xyz), self.quaternion(wxyz))
        return self.new("geometry_msgs/msg/TransformStamped", self.header(stamp, parent), child, moved)

    def transforms(self, *transforms: Any) -> Any:
        return self.new("tf2_msgs/msg/TFMessage", list(transforms))

    def odometry(
        self, stamp: float, xyz: Sequence[float], wxyz: Sequence[float], linear: Sequence[float],
        angular: Sequence[float],
    ) -> Any:  # fmt: skip
        zero = np.zeros(36)
        pose = self.new("geometry_msgs/msg/PoseWithCovariance", self.pose(xyz, wxyz), zero)
        twist = self.new("geometry_msgs/msg/Twist", self.vector(linear), self.vector(angular))
        twist = self.new("geometry_msgs/msg/TwistWithCovariance", twist, zero)
        return self.new("nav_msgs/msg/Odometry", self.header(stamp), "base", pose, twist)

    def imu(self, stamp: float, wxyz: Sequence[float], angular: Sequence[float], linear: Sequence[float]) -> Any:
        zero = np.zeros(9)
        return self.new(
            "sensor_msgs/msg/Imu", self.header(stamp), self.quaternion(wxyz), zero, self.vector(angular), zero,
            self.vector(linear), zero,
        )  # fmt: skip

    def low_state(self, stamp: float, q: Sequence[float], dq: Sequence[float]) -> Any:
        motors = [self.new("quad_msgs/msg/Motor", 1, float(a), float(b)) for a, b in zip(q, dq, strict=True)]
        return self.new("quad_msgs/msg/LowState", self.header(stamp), motors)

    def clock(self, shown: float) -> Any:
        return self.new("rosgraph_msgs/msg/Clock", self.time(shown))


def sent(
    topic: str, name: str, times: Iterable[float], make: Callable[[float], Any], late: float = 0.002
) -> list[Sent]:
    """Messages made at given times, received a little later."""
    return [(topic, name, START + t + late, make(t)) for t in times]
