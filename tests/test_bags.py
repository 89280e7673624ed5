"""Bags of ROS 1 and 2: what is read of known motions, and what is said about bags that cannot be read as asked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bags
import numpy as np
import pytest
from bags import START, Messages, sent, write

from dropo_torch.data.readers import read_recording, read_trajectories
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.errors import InputError

STATE, NUMBERS = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
DT = 0.02
NAMES = ("shoulder", "elbow")
RNG = np.random.default_rng(0)
#: An encoder at 200 Hz with jitter, and commands at 20 Hz.
SAMPLED = 0.005 * np.arange(400) + RNG.uniform(-1e-3, 1e-3, 400)
COMMANDED = 0.0105 + 0.05 * np.arange(40)
M = Messages()


def position(t: float | np.ndarray) -> np.ndarray:
    return np.stack([np.sin(3 * np.asarray(t)), 0.5 * np.cos(2 * np.asarray(t))], -1)


def velocity(t: float | np.ndarray) -> np.ndarray:
    return np.stack([3 * np.cos(3 * np.asarray(t)), -np.sin(2 * np.asarray(t))], -1)


def joint_states(m: Messages = M, **options: Any) -> list[bags.Sent]:
    """Positions of two joints, named in an order that changes from message to message."""

    def make(t: float) -> Any:
        order = [0, 1] if round(t / 0.005) % 3 else [1, 0]
        return m.joint_state(START + t, [NAMES[i] for i in order], position(t)[order], velocity(t)[order])

    return sent("/joint_states", STATE, SAMPLED, make, **options)


def commands(m: Messages = M) -> list[bags.Sent]:
    return sent("/effort/commands", NUMBERS, COMMANDED, lambda t: m.numbers([t, -t]), late=0.0)


ASKED: dict[str, Any] = {
    "observations": "/joint_states.position",
    "actions": "/effort/commands.data",
    "joints": NAMES,
    "stamps": {"/effort/commands": "received"},
    "preprocess": {"dt": DT},
}


def check(log: Trajectories, first: float = COMMANDED[0], atol: float = 1e-4) -> None:
    """The motion, its derivative and the commands that are in force, on the grid."""
    t = first + DT * np.arange(len(log) + 1)
    seen = np.concatenate([log.observations, log.next_observations[-1:]])
    np.testing.assert_allclose(seen[:, :2], position(t), atol=atol)
    np.testing.assert_allclose(seen[:, 2:], velocity(t), atol=100 * atol)
    last = np.floor((t[:-1] - COMMANDED[0]) / 0.05 + 1e-6)
    held = COMMANDED[0] + 0.05 * np.minimum(last, len(COMMANDED) - 1)
    np.testing.assert_allclose(log.actions, np.stack([held, -held], 1), atol=1e-8)
    assert len(log) > 90


@pytest.mark.parametrize("kind", bags.KINDS)
def test_every_kind_of_bag_gives_the_motion(tmp_path: Path, kind: str) -> None:
    m = Messages(kind)
    path = write(tmp_path / "run", [*joint_states(m), *commands(m)], kind=kind)
    log = read_trajectories(path, **ASKED)
    check(log)
    assert log.origin is not None
    assert log.origin.observation_names[:2] == ("/joint_states.position[shoulder]", "/joint_states.position[elbow]")
    check(read_trajectories({"path": str(path), **ASKED}))


def test_what_was_received_out_of_order_is_sorted_by_its_stamps(tmp_path: Path) -> None:
    late = RNG.uniform(0.001, 0.3, len(SAMPLED))
    delayed = [(topic, name, at + more, m) for (topic, name, at, m), more in zip(joint_states(), late, strict=True)]
    check(read_trajectories(write(tmp_path / "run", [*delayed, *commands()]), **ASKED))


def test_messages_that_were_recorded_twice_count_once(tmp_path: Path) -> None:
    states = joint_states()
    check(read_trajectories(write(tmp_path / "run", [*states, *states[::2], *commands()]), **ASKED))


def test_joints_of_several_senders_on_one_topic(tmp_path: Path) -> None:
    """A gripper publishes on the arm's topic, at a rate of its own, and another robot on one beside it."""
    grip = sent("/joint_states", STATE, 0.001 + 0.03 * np.arange(66), lambda t: M.joint_state(START + t, ["jaw"], [t]))
    other = sent("/left/joint_states", STATE, SAMPLED, lambda t: M.joint_state(START + t, NAMES, [9.0, 9.0]))
    path = write(tmp_path / "run", [*joint_states(), *grip, *other, *commands()])
    check(read_trajectories(path, **ASKED))
    log = read_trajectories(
        path, **{**ASKED, "observations": ["/joint_states.position[jaw]", "/left/joint_states.position"]}
    )
    t = log.observations[:, 0]
    np.testing.assert_allclose(np.diff(t), DT, atol=1e-6)
    np.testing.assert_allclose(log.observations[:, 1:3], 9.0)


def test_measured_velocities_are_taken_where_they_are_named(tmp_path: Path) -> None:
    path = write(tmp_path / "run", [*joint_states(), *commands()])
    observations = {"q": "/joint_states.position", "dq": {"signal": "/joint_states.velocity", "scale": 2.0}}
    log = read_trajectories(
        path, **{**ASKED, "observations": observations, "preprocess": {"dt": DT, "velocities": ["dq"]}}
    )
    t = COMMANDED[0] + DT * np.arange(len(log))
    np.testing.assert_allclose(log.observations[:, 2:], 2 * velocity(t), atol=1e-4)
    assert log.origin is not None
    assert log.origin.observation_names == ("q[shoulder]", "q[elbow]", "dq[shoulder]", "dq[elbow]")


def test_one_topic_with_even_stamps_needs_no_preprocessing(tmp_path: Path) -> None:
    times = DT * np.arange(50)
    state = lambda t: M.joint_state(START + t, NAMES, position(t), velocity(t))  # noqa: E731
    path = write(tmp_path / "run", sent("/joint_states", STATE, times, state))
    both = ["/joint_states.position", "/joint_states.velocity"]
    log = read_trajectories(path, observations=both, actions=[], joints=NAMES)
    np.testing.assert_allclose(log.observations, np.hstack([position(times), velocity(times)])[:-1], atol=1e-9)
    assert log.dt == pytest.approx(DT)


def test_a_pause_ends_an_episode(tmp_path: Path) -> None:
    kept = [one for one in joint_states() if not 0.8 < one[2] - START < 1.2]
    path = write(tmp_path / "run", [*kept, *commands()])
    with pytest.raises(
        InputError, match=r"has no sample for 0\.\d+ s from 0\.79\d* s on.*or begin an episode there with data: pause"
    ):
        read_trajectories(path, **ASKED)
    log = read_trajectories(path, **ASKED, pause=0.1)
    assert log.num_episodes == 2
    second = log.select_episodes([1])
    t = np.arcsin(second.observations[0, 0]) / 3
    t = np.pi / 3 - t if second.observations[0, 2] < 0 else t
    assert 1.19 < t < 1.27  # with the first command after the pause
    np.testing.assert_allclose(second.observations[:, :2], position(t + DT * np.arange(len(second))), atol=1e-4)


def test_a_value_that_is_no_number_is_told_or_left_out(tmp_path: Path) -> None:
    states = joint_states()
    right = position(SAMPLED[100:102])[:, 1]
    states[100] = (*states[100][:3], M.joint_state(START + SAMPLED[100], NAMES, [np.nan, right[0]]))
    states[101] = (*states[101][:3], M.joint_state(START + SAMPLED[101], ["elbow", "jaw"], [right[1], np.nan]))
    path = write(tmp_path / "run", [*states, *commands()])
    message = r"position\[shoulder\] is nan in sample 100 .*0\.4\d* s after its first.*max_gap"
    with pytest.raises(InputError, match=message):
        read_trajectories(path, **ASKED)
    read_trajectories(path, **{**ASKED, "joints": ["elbow"]})  # in which nothing is missing
    check(read_trajectories(path, **{**ASKED, "preprocess": {"dt": DT, "max_gap": 0.03}}))


def test_a_single_command_holds(tmp_path: Path) -> None:
    path = write(
        tmp_path / "run", [*joint_states(), *sent("/effort/commands", NUMBERS, [0.1], lambda _: M.numbers([7.0]))]
    )
    log = read_trajectories(path, **ASKED)
    assert (log.actions == 7).all()
    np.testing.assert_allclose(log.observations[0, :2], position(0.102), atol=1e-4)


# --- other messages ---


@pytest.mark.parametrize("how", ["trajectory", "state"])
def test_set_points_of_trajectory_controllers(tmp_path: Path, how: str) -> None:
    """The joints of commands are found by their names, too."""
    order = NAMES[::-1]
    made: dict[str, tuple[str, str, Callable[[float], Any]]] = {
        "trajectory": (
            "trajectory_msgs/msg/JointTrajectory", "/effort/commands.points.positions",
            lambda t: M.trajectory(START + t, order, [-t, t]),
        ),
        "state": (
            "control_msgs/msg/JointTrajectoryControllerState", "/effort/commands.reference.positions",
            lambda t: M.controller(START + t, order, [-t, t]),
        ),
    }  # fmt: skip
    name, entry, make = made[how]
    path = write(tmp_path / "run", [*joint_states(), *sent("/effort/commands", name, COMMANDED, make)])
    check(read_trajectories(path, **{**ASKED, "actions": entry, "stamps": None}))


def turned(t: float) -> np.ndarray:
    """A body that turns about its z axis by t rad/s, after a quarter about x; q and −q are the same to a sender."""
    half = np.array([np.cos(t / 2), 0, 0, np.sin(t / 2)])
    w, z = half[0], half[3]
    about = np.sqrt(0.5) * np.array([w, w, -z, z])
    return about if round(100 * t) % 7 else -about


def where(t: float) -> np.ndarray:
    return np.array([t, t**2, 0.5])


POSES: dict[str, tuple[str, str, Callable[[float], Any]]] = {
    "pose": (
        "geometry_msgs/msg/PoseStamped", "/box.pose", lambda t: M.pose_stamped(START + t, where(t), turned(t)),
    ),
    "message": (
        "geometry_msgs/msg/PoseStamped", "/box", lambda t: M.pose_stamped(START + t, where(t), turned(t)),
    ),
    "transform": (
        "geometry_msgs/msg/TransformStamped", "/box.transform",
        lambda t: M.transform(START + t, "box", where(t), turned(t)),
    ),
    "frames": (
        "tf2_msgs/msg/TFMessage", "/box.transforms[box]",
        lambda t: M.transforms(
            M.transform(START + t - 0.3, "hand", [0, 0, t], [1, 0, 0, 0]),
            M.transform(START + t, "box", where(t), turned(t)),
        ),
    ),
    "odometry": (
        "nav_msgs/msg/Odometry", "/box.pose",
        lambda t: M.odometry(START + t, where(t), turned(t), [0, 0, 0], [0, 0, 0]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", POSES)
def test_a_free_body_is_read_as_mujoco_has_it(tmp_path: Path, kind: str) -> None:
    """Position and quaternion (w, x, y, z); from them the linear velocity and the angular one in the body's axes."""
    name, entry, make = POSES[kind]
    times = 0.01 * np.arange(100)
    log = read_trajectories(
        write(tmp_path / "run", sent("/box", name, times, make)), observations=entry, actions=[], preprocess={"dt": DT}
    )
    t = DT * np.arange(len(log))
    sign = np.sign((log.observations[:, 3:7] * [turned(at) for at in t]).sum(1))
    np.testing.assert_allclose(log.observations[:, :3], [where(at) for at in t], atol=1e-6)
    np.testing.assert_allclose(sign[:, None] * log.observations[:, 3:7], [turned(at) for at in t], atol=1e-6)
    inner = slice(2, -2)
    moved = np.stack([np.ones(len(t)), 2 * t, np.zeros(len(t))], 1)
    np.testing.assert_allclose(log.observations[inner, 7:10], moved[inner], atol=1e-4)
    np.testing.assert_allclose(log.observations[inner, 10:], np.tile([0, 0, 1.0], (len(t), 1))[inner], atol=1e-3)


def test_odometrys_twist_becomes_that_of_a_free_joint(tmp_path: Path) -> None:
    """ROS measures along the body's axes, MuJoCo the linear velocity along the world's."""
    quarter = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    odometry = lambda t: M.odometry(START + t, [0, 0, 0], quarter, [1, 2, 3], [4, 5, 6])  # noqa: E731
    path = write(tmp_path / "run", sent("/odom", "nav_msgs/msg/Odometry", DT * np.arange(10), odometry))
    log = read_trajectories(path, observations=["/odom.twist", "/odom.twist.twist.linear"], actions=[])
    np.testing.assert_allclose(log.observations[0], [-2, 1, 3, 4, 5, 6, 1, 2, 3], atol=1e-9)


def test_imu_and_motors_are_columns(tmp_path: Path) -> None:
    """Also one entry of a list of messages, or some of its entries."""
    imu = lambda t: M.imu(START + t, [1, 0, 0, 0], [t, 2, 3], [4, 5, 9.81])  # noqa: E731
    low = lambda t: M.low_state(START + t, [t, 1, 2, 3], [4, 5, 6, 7])  # noqa: E731
    times = DT * np.arange(10)
    rows = [*sent("/imu", "sensor_msgs/msg/Imu", times, imu), *sent("/low", "quad_msgs/msg/LowState", times, low)]
    path = write(tmp_path / "run", rows)
    asked = [
        "/imu.orientation", "/imu.angular_velocity", "/imu.linear_acceleration.z", "/low.motors.q[1:3]",
        "/low.motors.dq[3]",
    ]  # fmt: skip
    log = read_trajectories(path, observations=asked, actions=[])
    np.testing.assert_allclose(log.observations[3], [1, 0, 0, 0, times[3], 2, 3, 9.81, 1, 2, 7], rtol=1e-6)
    assert log.origin is not None
    assert log.origin.observation_names[:2] == ("/imu.orientation[w]", "/imu.orientation[x]")
    assert log.origin.observation_names[7:9] == ("/imu.linear_acceleration.z[0]", "/low.motors.q[1]")


def test_a_clock_in_the_bag_tells_when_commands_came(tmp_path: Path) -> None:
    """Joint states are stamped with simulated time, which runs at half the speed and begins at 0.5 s."""
    m, ran = M, lambda wall: 0.5 + wall / 2
    states = [
        ("/joint_states", STATE, START + 2 * t, m.joint_state(ran(2 * t), NAMES, position(t))) for t in SAMPLED + 0.002
    ]
    given = [("/effort/commands", NUMBERS, START + 2 * t, m.numbers([t, -t])) for t in COMMANDED]
    ticks = [("/clock", "rosgraph_msgs/msg/Clock", START + w, m.clock(ran(w))) for w in 0.01 * np.arange(450)]
    path = write(tmp_path / "run", [*states, *given, *ticks])
    check(read_trajectories(path, **{**ASKED, "stamps": {"/effort/commands": "/clock"}}))
    with pytest.raises(InputError, match=r"their clocks differ.*stamps: \{TOPIC: /clock\}"):
        read_trajectories(path, **ASKED)


def test_a_bag_as_samples_in_time(tmp_path: Path) -> None:
    rows = read_recording(
        write(tmp_path / "run", [*joint_states(), *commands()]), observations="/joint_states.position",
        actions="/effort/commands.data", joints=NAMES, stamps={"/effort/commands": "received"},
    )  # fmt: skip
    assert rows.sparse
    assert len(rows) == len(SAMPLED) + len(COMMANDED)
    assert np.isnan(rows.observations).all(1).sum() == len(COMMANDED)


# --- what cannot be read as asked ---

REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no observations": ({"observations": None}, r"say which columns .*/joint_states\.position"),
    "no topic": (
        {"observations": "/joint_state.position"},
        r"no topic is called '/joint_state\.position'; expected TOPIC\.FIELD .*/joint_states with 400 sensor_msgs",
    ),
    "no field": (
        {"observations": "/joint_states.positions"},
        r"JointState has no field 'positions'; did you mean 'position'\? \(there are: position, velocity, effort\)",
    ),
    "no joint": ({"joints": ["shoulder", "wrist"]}, r"there is no 'wrist' \(there are: \w+, \w+\)"),
    "joints not said": ({"joints": None}, r"has 2 columns in the sender's order.*joints: \[NAME, \.\.\.\]"),
    "empty field": ({"observations": "/joint_states.effort"}, "effort is empty in all messages; leave it out"),
    "text": ({"observations": "/joint_states.name"}, "holds no numbers"),
    "header": ({"observations": "/joint_states.header.frame_id"}, "holds no numbers"),
    "no stamps": (
        {"stamps": None}, r"Float64MultiArray, which has no header stamp; .* stamps: \{/effort/commands: received\}",
    ),
    "stamps of nothing": ({"stamps": {"/commands": "received"}}, r"there is no topic '/commands'"),
    "stamps by no clock": (
        {"stamps": {"/effort/commands": "/joint_states"}}, "expected received, or a rosgraph_msgs/msg/Clock",
    ),
    "stamps are a list": ({"stamps": ["/effort/commands"]}, "expected TOPIC: received"),
    "topic without messages": ({"observations": "/idle.data"}, r"/idle has no messages"),
    "time": ({"time": "/joint_states.header.stamp"}, "time has no meaning here"),
    "shift": ({"shift": 1}, "shift has no meaning here"),
    "no preprocessing": ({"preprocess": None}, r"stamps of their own; preprocess: \{dt: SECONDS\}"),
    "another format's option": ({"separator": ";"}, "separator is an option of text files"),
    "number of a missing column": ({"actions": "/effort/commands.data[2]"}, "outside .*which has 2 columns"),
    "name of a nameless column": ({"actions": "/effort/commands.data[elbow]"}, r"no 'elbow' \(there are: 0, 1\)"),
}  # fmt: skip


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("bag") / "run", [*joint_states(), *commands()], [("/idle", NUMBERS)])


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_not_there_is_told_in_one_line(bag: Path, what: str) -> None:
    change, message = REFUSED[what]
    with pytest.raises(InputError, match=message) as caught:
        read_trajectories(bag, **{**ASKED, **change})
    assert "\n" not in str(caught.value)
    assert str(bag) in str(caught.value) or "data: " in str(caught.value)


WRONG: dict[str, tuple[Callable[[], list[bags.Sent]], dict[str, Any], str]] = {
    "unset stamps": (
        lambda: sent("/joint_states", STATE, SAMPLED, lambda t: M.joint_state(0, NAMES, position(t))),
        {}, r"stamp of a message of /joint_states is 0.*stamps: \{/joint_states: received\}",
    ),
    "two runs": (
        lambda: [
            *sent("/joint_states", STATE, SAMPLED, lambda t: M.joint_state(START + t, NAMES, position(t))),
            *sent("/joint_states", STATE, SAMPLED + 5, lambda t: M.joint_state(START + t - 5, NAMES, position(t))),
        ], {}, r"/joint_states: the header stamps go back by \d",
    ),
    "two values": (
        lambda: joint_states() + [(
            "/joint_states", STATE, START + 0.1, M.joint_state(START + SAMPLED[9], NAMES, [8.0, 8.0]))],
        {}, r"is both .* at the same stamp",
    ),
    "more numbers than joints": (
        lambda: sent("/joint_states", STATE, SAMPLED, lambda t: M.joint_state(START + t, NAMES, [1, 2, 3])),
        {}, r"has 3 numbers for 2 joints \(shoulder, elbow\)",
    ),
    "a joint twice": (
        lambda: sent("/joint_states", STATE, SAMPLED, lambda t: M.joint_state(START + t, ["a", "a"], [1, 2])),
        {}, "two joints of one message have the same name",
    ),
    "a trajectory of many points": (
        lambda: sent("/joint_states", "trajectory_msgs/msg/JointTrajectory", SAMPLED,
                     lambda t: M.trajectory(START + t, NAMES, [0, 0], [1, 1])),
        {"observations": "/joint_states.points.positions"}, "2 points, between which the controller interpolates",
    ),
    "a frame in two others": (
        lambda: sent("/joint_states", "tf2_msgs/msg/TFMessage", SAMPLED, lambda t: M.transforms(
            M.transform(START + t, "box", [0, 0, 0], [1, 0, 0, 0], parent="map" if t > 1 else "odom"))),
        {"observations": "/joint_states.transforms[box]"}, r"box is given in several frames \(map, odom\)",
    ),
    "lists of other lengths": (
        lambda: sent("/joint_states", NUMBERS, SAMPLED, lambda t: M.numbers([1.0] * (1 if t > 1 else 2))),
        {"observations": "/joint_states.data", "stamps": {"/joint_states": "received"}}, "has 1 numbers in some .* 2",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_what_cannot_be_right_is_told_in_one_line(tmp_path: Path, what: str) -> None:
    rows, change, message = WRONG[what]
    path = write(tmp_path / "run", rows())
    with pytest.raises(InputError, match=message) as caught:
        read_trajectories(path, **{**ASKED, "actions": [], "stamps": None, **change})
    assert "\n" not in str(caught.value)


def test_an_empty_bag_and_one_of_topics_only(tmp_path: Path) -> None:
    for name, topics in (("none", []), ("idle", [("/idle", NUMBERS)])):
        with pytest.raises(InputError, match=r"the bag is empty: no topic has messages \(there are"):
            read_trajectories(write(tmp_path / name, [], topics), **ASKED)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfejunk\x80" * 50], ids=["empty", "junk"])
def test_what_is_no_bag(tmp_path: Path, suffix: str, content: bytes) -> None:
    (tmp_path / f"log{suffix}").write_bytes(content)
    with pytest.raises(InputError, match="cannot be read as a ROS bag") as caught:
        read_trajectories(tmp_path / f"log{suffix}", **ASKED)
    assert "\n" not in str(caught.value)


def test_a_recording_that_was_cut_off(tmp_path: Path) -> None:
    path = write(tmp_path / "run", [*joint_states(), *commands()])
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(InputError, match=r"cannot be read as a ROS bag .*mcap recover"):
        read_trajectories(path, **ASKED)
