"""ROS 1 and ROS 2 bags and MCAP files: the numbers in messages as signals that have time stamps of their own.

A signal is called ``TOPIC.FIELD``, as ``ros2 topic echo --field`` does: ``/joint_states.position``, ``/odom.pose``,
``/imu.angular_velocity.z``; what its columns are called is in :mod:`dropo_torch.data.messages`. Time is that of the
messages' header. A topic whose messages have none takes the time at which the recorder received them, or that of a
clock, if told so.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.data.messages import Part, kind, parts
from dropo_torch.data.streams import Matrix, Stream, aligned, check_finite
from dropo_torch.data.tables import Choice, Table, pick, split_index
from dropo_torch.errors import InputError, choices
from dropo_torch.support.extras import extra
from dropo_torch.support.given import check_size, reading

RECEIVED = "received"
#: Seconds of a nanosecond.
NANO = 1e-9
#: Nanoseconds by which a message may overtake others on its way, and two clocks differ at least.
_OVERTAKING, _OTHER_CLOCK = 10**9, 3600 * 10**9
_CLOCK = "rosgraph_msgs/msg/Clock"
_MEND = "`ros2 bag reindex`, `mcap recover` and `rosbag reindex` mend a recording that was cut off"
#: Bytes that a number takes while messages are read.
_BYTES = 64


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        kind: the type of its messages.
        fields: their fields that may hold numbers.
        messages: how many there are.
    """

    kind: str
    fields: tuple[str, ...]
    messages: int


@dataclass(frozen=True)
class Bag:
    """A bag.

    Attributes:
        path: the file, or the folder of a ROS 2 bag.
        topics: what is in it.
        stamps: topics that do not take the time of their headers: ``received``, or a topic that is a clock.
    """

    path: Path
    topics: Mapping[str, Topic]
    stamps: Mapping[str, str]

    def named(self, entry: str) -> tuple[str, list[str]]:
        """Return the topic that an entry names, and the path of the field."""
        found = [topic for topic in self.topics if entry == topic or entry.startswith(f"{topic}.")]
        if not found:
            raise InputError(f"{self.path}: no topic is called {entry!r}; expected TOPIC.FIELD ({self.listed})")
        topic = max(found, key=len)
        if not self.topics[topic].messages:
            raise InputError(f"{self.path}: {topic} has no messages ({self.listed})")
        return topic, entry[len(topic) + 1 :].split(".") if entry != topic else []

    @property
    def listed(self) -> str:
        """The topics, for messages."""
        shown = [f"{name} with {topic.messages} {topic.kind}" for name, topic in self.topics.items()]
        return f"there are: {', '.join(shown[:20])}{', ...' if len(shown) > 20 else ''}" if shown else "there are none"


def is_bag(folder: Path) -> bool:
    """Return whether a folder is a ROS 2 bag."""
    return (folder / "metadata.yaml").is_file()


def open_bag(path: Path, stamps: Any) -> list[Table]:
    """The topics of a bag; ``stamps`` says which of them do not take the time of their headers.

    Raises:
        InputError: a file that is no bag, one without messages, stamps that name no topic.
    """
    with _opened(path) as reader:
        types = reader.typestore.fielddefs
        topics = {
            name: Topic(str(info.msgtype), _fields(types, info.msgtype), info.msgcount)
            for name, info in reader.topics.items()
        }
    bag = Bag(path, topics, {})
    if not any(topic.messages for topic in topics.values()):
        raise InputError(f"{path}: the bag is empty: no topic has messages ({bag.listed})")
    bag = replace(bag, stamps=_checked_stamps(path, topics, stamps))
    names = [f"{name}.{below}" for name, topic in topics.items() if topic.messages for below in topic.fields]
    return [Table(str(path), tuple(names), _unread, choose=partial(choose, bag))]


def unstamped(path: Path) -> dict[str, str]:
    """Return the topics of a bag whose messages have no header, as ``stamps`` takes them.

    They have the time of their receipt, or where the bag has a clock, the simulated time that it showed then, which
    headers follow.
    """
    with _opened(path) as reader:
        types = reader.typestore.fielddefs
        fields = {name: types.get(str(info.msgtype), ((), ()))[1] for name, info in reader.topics.items()}
        clocks = [name for name, info in reader.topics.items() if info.msgtype == _CLOCK and info.msgcount > 1]
    whence = clocks[0] if clocks else RECEIVED
    bare = [name for name, of in fields.items() if of and all(label != "header" for label, _ in of)]
    return {name: whence for name in bare if name not in clocks}


def choose(bag: Bag, choice: Choice) -> Table:
    """Return the fields that some entries name, with a row for every time stamp.

    Raises:
        InputError: a topic, field or joint that is not there, stamps that cannot be, values that are not finite.
    """
    wanted: dict[str, set[str]] = defaultdict(set)
    for entry in choice.entries:
        name, index = split_index(entry)
        wanted[name] |= set(index) if isinstance(index, tuple) else {""}
    found = _gathered(bag, list(wanted))
    matrices = {name: found[name].matrix(bag, name, wanted[name], choice) for name in wanted}
    _check_clocks(bag, matrices)
    return aligned(str(bag.path), matrices, unit=NANO, joints=choice.joints)


@dataclass
class _Field:
    """The samples of a field as they are read, in the order in which they were received."""

    keyed: bool = False
    quaternions: set[str] = field(default_factory=set)
    parents: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    #: Columns of a message → its stamps and values.
    layouts: dict[tuple[str, ...], tuple[list[int], list[list[float]]]] = field(
        default_factory=lambda: defaultdict(lambda: ([], []))
    )

    def add(self, part: Part, stamp: int) -> None:
        """Add the numbers of a message."""
        if part.frame:
            self.parents[part.frame].add(str(part.header.frame_id))
        self.keyed |= part.keyed
        self.quaternions |= set(part.quaternions)
        if part.labels:
            stamps, values = self.layouts[part.labels]
            stamps.append(stamp)
            values.append(part.values)

    def check_order(self, where: str, topic: str) -> None:
        """Raise an :class:`InputError` where header stamps go back by more than messages overtake each other."""
        for stamps, _ in self.layouts.values():
            times = np.array(stamps, dtype=np.int64)
            back = int((np.maximum.accumulate(times) - times).max())
            if back > _OVERTAKING:
                raise InputError(
                    f"{where}: the header stamps go back by {back * NANO:.4g} s; are these two runs, or was the clock "
                    f"set? Cut the bag in two, or take the times of receipt with stamps: {{{topic}: received}}"
                )

    def matrix(self, bag: Bag, name: str, wanted: set[str], choice: Choice) -> Matrix:
        """Return the columns that are wanted, of all that messages have, or ``""`` for those that an entry means."""
        where = f"{bag.path}: {name}"
        labels = list(dict.fromkeys(label for layout in self.layouts for label in layout))
        if not labels:
            raise InputError(f"{where} is empty in all messages; leave it out (velocities are derived by preprocess)")
        if not self.keyed and len(self.layouts) > 1:
            lengths = sorted({len(layout) for layout in self.layouts})
            raise InputError(f"{where} has {lengths[0]} numbers in some messages and {lengths[-1]} in others")
        if "" in wanted:
            meant = choice.joints if self.keyed else ()
            if self.keyed and not meant and len(labels) > 1 and not choice.every:
                raise InputError(
                    f"{where} has {len(labels)} columns in the sender's order; say which, in the model's order, with "
                    f"joints: [NAME, ...] or {name}[NAME, ...] (there are: {', '.join(labels[:20])})"
                )
            wanted = wanted - {""} | set(meant or labels)
        kept = sorted({column for one in wanted for column in pick(one, labels, where)})
        for frame, parents in self.parents.items():
            if len(parents) > 1 and any(labels[column].startswith(f"{frame}.") for column in kept):
                raise InputError(f"{where}: {frame} is given in several frames ({', '.join(sorted(parents))})")
        columns = {labels[c]: self._stream(labels[c], f"{where}[{labels[c]}]", choice) for c in kept}
        first = tuple(i for i, label in enumerate(columns) if label in self.quaternions)
        return Matrix(columns, self.keyed, tuple(i for i in first if _whole(list(columns), i)))

    def _stream(self, label: str, where: str, choice: Choice) -> Stream:
        """The samples of a column, in the order of their stamps."""
        found = [
            (np.array(stamps, dtype=np.int64), np.array([row[layout.index(label)] for row in values]))
            for layout, (stamps, values) in self.layouts.items()
            if label in layout
        ]
        time, values = (np.concatenate(of) for of in zip(*found, strict=True))
        order = np.argsort(time, kind="stable")
        time, values = time[order], values[order]
        same = np.flatnonzero(np.diff(time) == 0)
        differ = same[(values[same] != values[same + 1]) & ~(np.isnan(values[same]) & np.isnan(values[same + 1]))]
        if differ.size:
            row = int(differ[0])
            raise InputError(
                f"{where} is both {values[row]:.6g} and {values[row + 1]:.6g} at the same stamp, "
                f"{(time[row] - time[0]) * NANO:.6g} s after its first; if two nodes publish it, choose one; if stamps "
                "are coarse, stamps: {TOPIC: received} takes the time at which messages were received"
            )
        kept = np.append(True, np.diff(time) > 0)
        stream = Stream(time[kept], values[kept])
        check_finite(where, stream, NANO, missing_allowed=choice.missing_allowed)
        return stream


def _gathered(bag: Bag, entries: Sequence[str]) -> dict[str, _Field]:
    """Return the samples of fields; the bag is read once."""
    paths = {entry: bag.named(entry) for entry in entries}
    topics = {topic for topic, _ in paths.values()}
    clocks = {bag.stamps[topic] for topic in topics & bag.stamps.keys()} - {RECEIVED}
    check_size(sum(bag.topics[topic].messages for topic in topics), _BYTES, bag.path)
    found = {entry: _Field() for entry in entries}
    ticks: dict[str, list[tuple[int, int]]] = {clock: [] for clock in clocks}
    for topic, message, received in _messages(bag, topics | clocks):
        if topic in clocks:
            ticks[topic].append((received, _nanoseconds(message.clock)))
        for entry in (entry for entry, (own, _) in paths.items() if own == topic):
            for part in parts(message, paths[entry][1], f"{bag.path}: {entry}"):
                stamp = received if topic in bag.stamps else _header_stamp(bag, topic, message, part)
                found[entry].add(part, stamp)
    for entry, (topic, _) in paths.items():
        whence = bag.stamps.get(topic)
        if whence is None:
            found[entry].check_order(f"{bag.path}: {topic}", topic)
        elif whence != RECEIVED:
            _use_clock(bag, topic, found[entry], ticks[whence])
    return found


def _messages(bag: Bag, topics: Iterable[str]) -> Iterator[tuple[str, Any, int]]:
    """Yield topic, message and time of receipt of all messages of some topics."""
    with _opened(bag.path) as reader:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        for connection in connections:
            if connection.msgtype not in reader.typestore.fielddefs:
                raise InputError(
                    f"{bag.path}: {connection.topic} is of unknown type {connection.msgtype}: the bag does not define "
                    "it, and it is none of ROS's common ones; record as MCAP, which keeps definitions"
                )
        for connection, received, raw in reader.messages(connections):
            yield connection.topic, reader.deserialize(raw, connection.msgtype), received


def _header_stamp(bag: Bag, topic: str, message: Any, part: Part) -> int:
    """The stamp of what a message holds, in ns."""
    if part.header is None:
        raise InputError(
            f"{bag.path}: {topic} is {kind(message)}, which has no header stamp; take the time at which the recorder "
            f"received it with stamps: {{{topic}: received}}"
        )
    stamp = _nanoseconds(part.header.stamp)
    if stamp == 0:
        raise InputError(
            f"{bag.path}: the header stamp of a message of {topic} is 0: its sender sets none; take the time at which "
            f"the recorder received it with stamps: {{{topic}: received}}"
        )
    return stamp


def _use_clock(bag: Bag, topic: str, samples: _Field, ticks: Sequence[tuple[int, int]]) -> None:
    """Replace times of receipt by what a clock showed then; what it showed nothing for is cut."""
    received, shown = np.array(sorted(ticks), dtype=np.int64).reshape(-1, 2).T
    if not len(received):
        raise InputError(f"{bag.path}: stamps: {bag.stamps[topic]} has no messages, so that it tells no time")
    for layout, (stamps, values) in samples.layouts.items():
        times = np.array(stamps, dtype=np.int64)
        inside = (times >= received[0]) & (times <= received[-1])
        read = np.interp((times - received[0])[inside], received - received[0], (shown - shown[0]).astype(float))
        kept = [row for row, known in zip(values, inside, strict=True) if known]
        samples.layouts[layout] = (list(np.rint(read).astype(np.int64) + shown[0]), kept)
    if not any(stamps for stamps, _ in samples.layouts.values()):
        raise InputError(f"{bag.path}: no message of {topic} was received while {bag.stamps[topic]} ran")


def _check_clocks(bag: Bag, matrices: Mapping[str, Matrix]) -> None:
    """Raise an :class:`InputError` where two fields were stamped by clocks that cannot be one."""
    spans = {name: next(iter(matrix.columns.values())).time[[0, -1]] for name, matrix in matrices.items()}
    late = max(spans, key=lambda name: int(spans[name][0]))
    early = min(spans, key=lambda name: int(spans[name][1]))
    apart = int(spans[late][0]) - int(spans[early][1])
    if apart > _OTHER_CLOCK:
        raise InputError(
            f"{bag.path}: {late} begins {apart * NANO:.4g} s after {early} ends: their clocks differ, as where one "
            "follows simulated time; stamps: {TOPIC: /clock} takes the time that a clock in the bag shows"
        )


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A bag, open for reading."""
    with extra("ros", str(path)):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    common = get_typestore(Stores.LATEST)
    with reading(path, "a ROS bag", _MEND), AnyReader([path], default_typestore=common) as reader:
        yield reader


def _checked_stamps(path: Path, topics: Mapping[str, Topic], stamps: Any) -> Mapping[str, str]:
    if stamps is None:
        return {}
    if not isinstance(stamps, Mapping):
        raise InputError(f"data: stamps is {stamps!r}; expected TOPIC: received, or TOPIC: /clock")
    for topic, whence in stamps.items():
        for name in (topic, whence):
            if name != RECEIVED and name not in topics:
                raise InputError(f"{path}: stamps: there is no topic {name!r}{choices(name, topics)}")
        if whence != RECEIVED and topics[whence].kind != _CLOCK:
            raise InputError(f"{path}: stamps: {whence} is {topics[whence].kind}; expected received, or a {_CLOCK}")
    return dict(stamps)


def _fields(types: Mapping[str, Any], name: str | None) -> tuple[str, ...]:
    """The fields of a type that may hold numbers."""
    text = (("string",), ("wstring",))
    found = []
    for label, (shape, of) in types.get(str(name), ((), ()))[1]:
        inner = of[0] if shape >= 3 else (shape, of)  # of a list, its elements
        is_text = inner[0] == 1 and inner[1][:1] in text
        if label != "header" and not is_text and not label.endswith("covariance") and label != "layout":
            found.append(label)
    return tuple(found)


def _whole(labels: Sequence[str], first: int) -> bool:
    """Whether the four components of a quaternion stand one after the other from a column on."""
    stem = labels[first].removesuffix("w")
    return list(labels[first : first + 4]) == [f"{stem}{axis}" for axis in "wxyz"]


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * 10**9 + int(time.nanosec)


def _unread(name: str) -> np.ndarray:
    raise AssertionError(f"{name} is read by choice")
