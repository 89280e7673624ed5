from __future__ import annotations

import mujoco
import numpy as np
import pytest
from conftest import ARM_XML, BOX_XML, TENDON_XML, compiled, random_states
from hypothesis import given
from hypothesis import strategies as st

from dropo_torch.data.observation import parse_observation
from dropo_torch.errors import InputError

ARM = compiled(ARM_XML)  # qpos: shoulder, elbow, wrist; qvel the same
BOX = compiled(BOX_XML)  # qpos: root (7), hang; qvel: root (6), hang


@pytest.mark.parametrize(
    ("entries", "columns"),
    [
        (None, range(6)),
        (["qpos", "qvel"], range(6)),
        (["qvel", "qpos"], [3, 4, 5, 0, 1, 2]),
        (["qpos[1:]", "qvel"], [1, 2, 3, 4, 5]),
        (["qpos[:-1]"], [0, 1]),
        (["qpos[::2]"], [0, 2]),
        (["qpos[::-1]"], [2, 1, 0]),
        (["qvel[0:2]", "qpos[2]"], [3, 4, 2]),
        (["qpos[-1]", "qvel[-3]"], [2, 3]),
        (["qpos[elbow]", "qvel[elbow]"], [1, 4]),
        (["elbow.velocity", " elbow.position "], [4, 1]),
    ],
)
def test_entries_name_state_columns_in_the_order_given(entries, columns):
    observation = parse_observation(ARM, entries)
    assert observation.columns == tuple(columns)
    assert observation.log_columns == tuple(range(len(observation.columns)))
    assert observation.log_width == observation.size


@given(st.lists(st.sampled_from([0, 1, 2, 3, 4, 5, "skip"]), min_size=1, max_size=12), st.integers(1, 4))
def test_states_put_every_observed_column_where_it_belongs_and_the_rest_at_the_default(entries, rows):
    named = [e for e in entries if e != "skip"]
    written = ["skip" if e == "skip" else f"qpos[{e}]" if e < 3 else f"qvel[{e - 3}]" for e in entries]
    if not named or len(set(named)) < len(named):
        with pytest.raises(InputError, match="twice" if named else "no state column"):
            parse_observation(ARM, written)
        return
    observation = parse_observation(ARM, written, log_width=len(written))
    log = np.random.default_rng(0).normal(size=(rows, len(written)))
    states = observation.states(log)
    default = np.concatenate([ARM.qpos0, np.zeros(ARM.nv)])
    for column in range(6):
        expected = log[:, entries.index(column)] if column in named else np.full(rows, default[column])
        np.testing.assert_array_equal(states[:, column], expected)
    np.testing.assert_array_equal(states[:, observation.index], observation.observed(log))


def test_skip_counts_columns_of_the_log():
    observation = parse_observation(ARM, ["skip[2]", "qpos[1]", "skip", "qvel[0]"], log_width=5)
    assert observation.columns == (1, 3)
    assert observation.log_columns == (2, 4)


def test_labels_and_units_name_joint_and_quantity():
    observation = parse_observation(ARM, None)
    assert observation.labels == (
        "shoulder.position", "elbow.position", "wrist.position",
        "shoulder.velocity", "elbow.velocity", "wrist.velocity",
    )  # fmt: skip
    assert observation.units == ("rad", "rad", "m", "rad/s", "rad/s", "m/s")
    box = parse_observation(BOX, ["root.position", "root.velocity"])
    assert box.labels[2:5] == ("root.position[z]", "root.position[qw]", "root.position[qx]")
    assert box.labels[9:11] == ("root.velocity[vz]", "root.velocity[wx]")
    assert box.units == ("m",) * 3 + ("-",) * 4 + ("m/s",) * 3 + ("rad/s",) * 3


def test_labels_of_unnamed_joints_number_them():
    model = compiled("<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>")
    assert parse_observation(model, None).labels == ("joint0.position", "joint0.velocity")
    assert parse_observation(model, ["joint0.velocity"]).columns == (1,)


@pytest.mark.parametrize("xml", [BOX_XML, TENDON_XML])
def test_quaternion_columns_are_found_whatever_their_order(xml):
    model = compiled(xml)
    joint = next(j for j in range(model.njnt) if model.jnt_type[j] <= 1)
    start = int(model.jnt_qposadr[joint]) + (3 if model.jnt_type[joint] == 0 else 0)
    entries = [f"qpos[{start + i}]" for i in (2, 0)] + ["qvel"] + [f"qpos[{start + i}]" for i in (3, 1)]
    observation = parse_observation(model, entries)
    nv = model.nv
    assert observation.quaternions == ((1, nv + 3, 0, nv + 2),)
    assert [observation.columns[i] for i in observation.quaternions[0]] == list(range(start, start + 4))


def test_states_hold_unit_quaternions():
    observation = parse_observation(BOX, None)
    log = random_states(BOX, 5).numpy()
    scaled = log.copy()
    scaled[:, 3:7] *= np.array([0.5, 1.7, -1, 3, 1.001])[:, None]
    states = observation.states(scaled)
    np.testing.assert_allclose(np.linalg.norm(states[:, 3:7], axis=1), 1, rtol=1e-15)
    np.testing.assert_allclose(np.abs((states[:, 3:7] * log[:, 3:7]).sum(1)), 1, rtol=1e-14)
    np.testing.assert_array_equal(np.delete(states, range(3, 7), 1), np.delete(log, range(3, 7), 1))


def test_a_zero_quaternion_is_refused_with_its_row():
    log = random_states(BOX, 3).numpy()
    log[1, 3:7] = 0
    with pytest.raises(InputError, match=r"row 1 of observations has a zero quaternion in root\.position\[qw\]"):
        parse_observation(BOX, None).states(log)


def test_part_of_a_quaternion_is_refused():
    with pytest.raises(InputError, match="3 of the 4 quaternion columns of joint 'root'"):
        parse_observation(BOX, ["qpos[0:6]", "qvel"])


def test_a_quaternion_that_is_not_observed_starts_at_the_models_own():
    observation = parse_observation(BOX, ["qpos[:3]", "qvel"])
    state = observation.states(np.ones((1, 10)))
    np.testing.assert_array_equal(state[0, 3:7], [1, 0, 0, 0])
    assert observation.quaternions == ()


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (["qpos[elbw]"], r"no joint 'elbw'; did you mean 'elbow'\? \(there are: shoulder, elbow, wrist\)"),
        (["elbov.velocity"], "no joint 'elbov'; did you mean 'elbow'"),
        (["qpso"], "'qpso' is not understood.*did you mean 'qpos'"),
        (["qpos[7]"], r"qpos\[7\] is outside qpos, which has 3 entries"),
        (["qvel[5:]"], r"qvel\[5:\] is empty; qvel has 3 entries"),
        (["qpos[::0]"], r"qpos\[::0\]"),
        (["qpos", "qpos[1]"], r"elbow\.position stands there twice"),
        (["skip[4]"], "no state column is named"),
        ([], "no state column is named"),
    ],
)
def test_an_entry_that_cannot_be_is_refused_with_what_would_be_right(entries, message):
    with pytest.raises(InputError, match=message):
        parse_observation(ARM, entries)


def test_a_width_that_does_not_fit_says_both_widths_and_the_models_sizes():
    with pytest.raises(InputError, match=r"\[qpos\[1:\], qvel\] has 5 columns and the log has 11.*nq=3, nv=3"):
        parse_observation(ARM, ["qpos[1:]", "qvel"], log_width=11)
    with pytest.raises(InputError, match=r"\[qpos, qvel\] has 6 columns and the log has 5"):
        parse_observation(ARM, None, log_width=5)


def test_the_default_state_is_a_state_of_the_model():
    observation = parse_observation(BOX, ["hang.position"])
    data = mujoco.MjData(BOX)
    np.testing.assert_array_equal(observation.default_state, np.concatenate([data.qpos, data.qvel]))


def test_joints_whose_velocity_is_not_observed_start_at_rest() -> None:
    assert parse_observation(ARM, None).at_rest == ()
    assert parse_observation(ARM, ["qvel"]).at_rest == ()
    first, *_, last = [ARM.joint(i).name for i in range(ARM.njnt)]
    assert parse_observation(ARM, ["qpos", f"{last}.velocity"]).at_rest[0] == first
    assert last not in parse_observation(ARM, ["qpos", f"{last}.velocity"]).at_rest
    assert parse_observation(BOX, ["root.position", "qvel[0:5]"]).at_rest == ("root",)
    assert parse_observation(BOX, ["qpos[0:2]", "qpos[3:7]", "qvel[0:2]", "qvel[3:6]"]).at_rest == ()  # it lies flat
    assert parse_observation(BOX, ["qpos[0:3]", "qvel[0:2]"]).at_rest == ("root",)
    assert parse_observation(BOX, ["qpos[0:2]", "qvel[0:2]"]).at_rest == ()
