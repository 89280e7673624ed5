"""Wrong logs are told with what is wrong with them, good ones are left in peace, and cures cure."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from arm import XML, Folder, record
from conftest import BOX_XML
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from benchmarks.measured_logs import measured_logs
from benchmarks.wrong_logs import FAULTS, THROWN, Fault, Log, examined, good
from dropo_torch.commands.cli import main
from dropo_torch.data.examination import Finding, Rules, examine
from dropo_torch.data.examination.lag import find_lag
from dropo_torch.data.examination.record import Record
from dropo_torch.data.observation import generic_observation, parse_observation
from dropo_torch.data.readers import read_trajectories
from dropo_torch.data.trajectory import Origin, Trajectories
from dropo_torch.errors import InputError

ROOT = Path(__file__).parents[1]
SYSTEMS = ("servo_arm", "cart_pole", "hopper", "thrown", "puck")


def names(findings: tuple[Finding, ...]) -> list[tuple[str, str]]:
    return [(f.name, f.confidence) for f in findings]


def arm_log(**arrays: np.ndarray) -> Trajectories:
    return Trajectories(**{**record(steps=400, noise=1e-4), **arrays})


def arm_findings(log: Trajectories, frame_skip: int = 2, **options: Any) -> tuple[Finding, ...]:
    model = mujoco.MjModel.from_xml_string(XML)
    return examine(log, parse_observation(model, None, 4), model, frame_skip, **options)


# --- every fault, on systems that the thresholds were not chosen for one by one ---

good_log = cache(lambda system: good(system, (5, 7)))


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_good_log_is_left_in_peace(system: str, tmp_path: Path) -> None:
    found, _ = examined(good_log(system).config(tmp_path), tmp_path)
    assert names(found) == []


def test_a_log_in_which_nothing_moves_is_told() -> None:
    states = np.zeros((300, 4))
    rested = arm_log(observations=states[:100], next_observations=states[:100], actions=np.zeros((100, 2)),
                     terminals=np.arange(1, 101) == 100)  # fmt: skip
    (found,) = arm_findings(rested)
    assert (found.name, found.sure) == ("frozen", True)
    assert "no column changes in 100 rows" in found.what


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_is_told_and_cured(fault: Fault, tmp_path: Path) -> None:
    log = fault.make(good_log(fault.systems[0]), np.random.default_rng(3))
    config = log.config(tmp_path)
    found, _ = examined(config, tmp_path)
    assert found[0].name in fault.told, names(found)
    if found[0].cure:
        assert [f.name for f in cured(config, found[0].cure, tmp_path) if f.sure] == []
    assert found[0].cure or found[0].advice


def cured(config: Mapping[str, Any], cure: Mapping[str, Any], folder: Path) -> tuple[Finding, ...]:
    """What is found once the lines of a cure, read as YAML, are in the config."""
    lines = yaml.safe_load(yaml.safe_dump(dict(cure)))
    data = {**config["data"], **lines.pop("data", {})}
    if isinstance(data.get("time"), dict):
        data["time"]["signal"] = "time"
    return examined({**config, **lines, "data": data}, folder)[0]


# --- what kinematics leave open, the model decides or nobody does ---


@pytest.mark.parametrize("columns", [(0, 1), (2, 3)])
def test_of_positions_and_velocities_those_are_exchanged_that_the_model_says(columns: tuple[int, int]) -> None:
    """The likeness of velocities to positions is the same either way; the cure gives the log that was."""
    arrays = record(steps=400, noise=1e-4)
    order = np.arange(4)
    order[list(columns)] = order[list(columns[::-1])]
    log = Trajectories(**{**arrays, **{name: arrays[name][:, order] for name in ("observations", "next_observations")}})
    (found,) = arm_findings(log)
    assert names((found,)) == [("order", "sure")]
    entries = found.cure["observation"]
    right = parse_observation(mujoco.MjModel.from_xml_string(XML), entries, 4)
    assert right.columns == tuple(order.tolist())


TWINS = """<mujoco><option timestep="0.005"/><worldbody>
  <body><joint name="left" stiffness="3"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/></body>
  <body pos="0 1 0"><joint name="right" stiffness="3"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/></body>
  </worldbody></mujoco>"""


def test_an_exchange_that_the_model_cannot_decide_is_told_with_both_readings() -> None:
    """Of twins that swing by themselves nothing tells which is which: no cure is as good as another."""
    model = mujoco.MjModel.from_xml_string(TWINS)
    data, rows, rng = mujoco.MjData(model), [], np.random.default_rng(0)
    data.qpos[:], data.qvel[:] = (0.5, -0.3), (0.0, 4.0)
    for _ in range(401):
        rows.append(np.concatenate([data.qpos[::-1], data.qvel]))
        mujoco.mj_step(model, data, 2)
    path = np.array(rows) + 1e-4 * rng.standard_normal((401, 4))
    log = Trajectories(path[:-1], path[1:], np.zeros((400, 0)), np.arange(400) == 399)
    found = examine(log, parse_observation(model, None, 4), model, 2)
    assert names(found) == [("order", "doubtful")]
    assert not found[0].cure
    for reading in ("[left.position, right.position, right.velocity, left.velocity]",
                    "[right.position, left.position, left.velocity, right.velocity]"):  # fmt: skip
        assert reading in found[0].advice


WAGON = """<mujoco><option timestep="0.005"/><worldbody>
  <body><joint name="rail" type="slide" axis="1 0 0"{spring}/><geom size=".1" mass="1"/></body></worldbody>
  <actuator><motor name="pull" joint="rail"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("spring", "negated", "told"),
    [
        ("", "joint", ("action_sign", "doubtful")),  # a mass alone goes either way alike
        (' springref="1" stiffness="9"', "joint", ("joint_sign", "sure")),
        (' springref="1" stiffness="9"', "command", ("action_sign", "sure")),
    ],
)
def test_a_command_against_its_sign_may_be_the_joints(spring: str, negated: str, told: tuple[str, str]) -> None:
    """Which of the two was negated the model says, or both are told and neither is a cure."""
    model = mujoco.MjModel.from_xml_string(WAGON.format(spring=spring))
    data, path, actions, rng = mujoco.MjData(model), [], [], np.random.default_rng(0)
    for row in range(401):
        path.append([data.qpos[0], data.qvel[0]])
        data.ctrl[0] = 3 * np.sin(0.13 * row) + rng.standard_normal()
        actions.append([data.ctrl[0]])
        mujoco.mj_step(model, data, 2)
    states = np.array(path) + 1e-4 * rng.standard_normal((401, 2))
    commands = np.array(actions[:-1]) * (-1 if negated == "command" else 1)
    states *= -1 if negated == "joint" else 1
    log = Trajectories(states[:-1], states[1:], commands, np.arange(400) == 399)
    (found,) = examine(log, parse_observation(model, None, 2), model, 2)
    assert (found.name, found.confidence) == told
    scale = dict(found.cure["data"]["scale"]) if found.cure else {}
    joint, command = {"observations[0]": -1.0, "observations[1]": -1.0}, {"actions": -1.0}
    assert scale == ({} if not found.sure else joint if negated == "joint" else command)
    if not found.sure:
        assert "{actions: -1}" in found.advice
        assert "{observations[0]: -1, observations[1]: -1}" in found.advice


FINGER = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody>
  <body><joint name="knuckle" type="hinge" axis="0 1 0" stiffness=".1" damping="{damping}" armature="2e-5"/>
    <geom type="capsule" size=".009" fromto="0 0 0 .05 0 0" mass=".03"/></body></worldbody>
  <actuator><motor name="pull" joint="knuckle"/></actuator></mujoco>"""


@pytest.mark.parametrize("missing", [0.01, 0.03, 0.1])
def test_missing_damping_is_no_earlier_command(missing: float) -> None:
    """Where inertia is next to nothing, what a motion leaves of damping that the model lacks leads the commands."""
    model, true = (mujoco.MjModel.from_xml_string(FINGER.format(damping=d)) for d in (0.004, 0.004 + missing))
    data, path, rng = mujoco.MjData(true), [], np.random.default_rng(0)
    time, waves = 0.005 * np.arange(1204), rng.uniform(2, 16, 6)
    actions = 0.05 * np.sin(time[:, None] * waves + rng.uniform(0, 6, 6)).sum(1, keepdims=True)
    for action in actions:
        path.append(data.qpos[0])
        data.ctrl[:] = action
        mujoco.mj_step(true, data, 5)
    measured = np.array(path) + 1e-3 * rng.standard_normal(len(path))
    smooth = savgol_filter(measured, 25, 3)
    states = np.column_stack([smooth, np.gradient(smooth, 0.005)])[2:1203]
    log = Trajectories(states[:-1], states[1:], actions[2:1202], np.arange(1200) == 1199)
    found = examine(log, parse_observation(model, None, 2), model, 5)
    assert not [f.name for f in found if f.sure]


@pytest.mark.parametrize("seen", [False, True])
def test_a_spike_is_told_with_its_row_unless_the_velocity_shows_it(seen: bool) -> None:
    """A position that leaves for a row and comes back was not there, if nothing moved so fast."""
    arrays = record(steps=400, noise=1e-4)
    path = np.concatenate([arrays["observations"], arrays["next_observations"][-1:]])
    path[120, 1] += 9.7
    if seen:
        step = 2 * mujoco.MjModel.from_xml_string(XML).opt.timestep
        path[119, 3] += 9.7 / step
        path[120, 3] += 9.7 / step
        path[121, 3] -= 3 * 9.7 / step
    log = Trajectories(path[:-1], path[1:], arrays["actions"], arrays["terminals"])
    found = [f for f in arm_findings(log) if f.name == "spike"]
    assert len(found) == (not seen)
    for finding in found:
        assert (finding.confidence, finding.rows) == ("doubtful", (120,))
        assert finding.where == (parse_observation(mujoco.MjModel.from_xml_string(XML), None, 4).labels[1],)
        assert "row 120" in finding.what
        assert "NaN" in finding.advice


@pytest.mark.parametrize(("high", "told"), [(0.6, True), (0.8, True), (2.0, False)])
def test_a_sensor_whose_range_ends_is_told(high: float, told: bool) -> None:
    arrays = record(steps=400, noise=1e-4)
    share = high * np.ptp(arrays["observations"][:, 1]) + arrays["observations"][:, 1].min()
    for name in ("observations", "next_observations"):
        arrays[name] = np.array(arrays[name])
        arrays[name][:, 1] = np.minimum(arrays[name][:, 1], share)
    found = {f.name for f in arm_findings(Trajectories(**arrays))}
    assert bool(found & {"clipped", "frozen"}) == told  # frozen where it is so for long


@pytest.mark.parametrize(("limit", "told"), [(0.7, False), (0.9, True)])
def test_a_joint_at_its_stop_is_not_clipped(limit: float, told: bool) -> None:
    rail = f'range="-1 {limit}" limited="true"'
    model = mujoco.MjModel.from_xml_string(WAGON.format(spring=rail).replace("{spring}", ""))
    path = np.minimum(np.sin(0.1 * np.arange(401)), 0.7)
    states = np.stack([path, np.zeros(401)], 1) + 1e-9
    log = Trajectories(states[:-1], states[1:], np.zeros((400, 1)), np.arange(400) == 399)
    found = {f.name for f in examine(log, parse_observation(model, None, 2), model, 2)}
    assert ("clipped" in found) == told


@pytest.mark.parametrize("quantum", [0.0, 2e-3])
def test_what_comes_to_rest_at_the_end_of_its_motion_is_not_clipped(quantum: float) -> None:
    """A joint that is moved up and down, and rests at both ends, by a sensor with or without noise of its own."""
    model = mujoco.MjModel.from_xml_string(WAGON.format(spring=""))
    phase = np.clip(np.abs((np.arange(401) / 60) % 2 - 1) * 1.6 - 0.3, 0, 1)
    path = 0.5 - 0.5 * np.cos(np.pi * phase)
    path = np.round(path / quantum) * quantum if quantum else path
    states = np.stack([path, np.gradient(path, 0.01)], 1)
    log = Trajectories(states[:-1], states[1:], np.zeros((400, 1)), np.arange(400) == 399)
    assert "clipped" not in {f.name for f in examine(log, parse_observation(model, None, 2), model, 2)}


# --- what only a robot can look like is never sure ---


def delayed(log: Log, rows: int) -> Log:
    """A log of actuators that answer so many rows late."""
    return next(f for f in FAULTS if f.name == "the next command").make(log, np.random.default_rng(0)) if rows else log


@pytest.mark.parametrize("system", ["servo_arm", "cart_pole", "hopper", "thrown"])
def test_an_actuator_that_answers_late_stops_nothing(system: str, tmp_path: Path) -> None:
    found, _ = examined(delayed(good_log(system), 1).config(tmp_path), tmp_path)
    assert all(f.name == "action_shift" and not f.sure for f in found)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("change", ["mass", "friction", "stiffness", "gain", "filter"])
def test_a_wrong_model_is_no_finding(change: str, seed: int) -> None:
    """A robot with another mass, friction, spring, gain, or with velocities through a filter."""
    xml = {
        "friction": XML.replace('damping=".1"', 'damping=".1" frictionloss=".15"'),
        "stiffness": XML.replace('damping=".1"', 'damping=".1" stiffness="2" springref="20"'),
        "gain": XML.replace('gear="3"', 'gear="4"'),
    }.get(change, XML)
    arrays = record(steps=400, noise=1e-4, seed=seed, xml=xml, **({"lower_mass": 1.1} if change == "mass" else {}))
    if change == "filter":
        path = np.concatenate([arrays["observations"], arrays["next_observations"][-1:]])
        path[1:, 2:] = 0.7 * path[1:, 2:] + 0.3 * path[:-1, 2:]
        arrays |= {"observations": path[:-1], "next_observations": path[1:]}
    assert [f for f in arm_findings(Trajectories(**arrays)) if f.sure] == []


@pytest.mark.skipif("DROPO_DATA" not in os.environ, reason="DROPO_DATA names no folder of measured logs")
def test_no_measured_log_is_stopped() -> None:
    for name, config, folder in measured_logs(Path(os.environ["DROPO_DATA"])):
        found, _ = examined(config, folder)
        assert [f.what for f in found if f.sure] == [], name


# --- laws ---


@given(data=st.data())
def test_whatever_a_log_holds_it_is_examined(data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    xml = data.draw(st.sampled_from((XML, THROWN, BOX_XML, "<mujoco/>", BALL)))
    model = mujoco.MjModel.from_xml_string(xml)
    rows, width = data.draw(st.sampled_from((1, 2, 3, 5, 40, 150))), max(model.nq + model.nv, 1)
    table = rng.standard_normal((rows + 1, width)) * data.draw(st.sampled_from((0.0, 1e-9, 1.0, 1e5, 1e160, 1e300)))
    shape = data.draw(st.sampled_from(("white", "walk", "whole", "held")))
    with np.errstate(all="ignore"):
        table = {"walk": np.cumsum(table, 0), "whole": np.round(table), "held": table[np.arange(rows + 1) // 2]}.get(
            shape, table
        )  # fmt: skip
    if not np.isfinite(table).all():
        return
    log = Trajectories(
        table[:-1], table[1:] if data.draw(st.booleans()) else rng.standard_normal((rows, width)),
        rng.standard_normal((rows, model.nu)) * data.draw(st.sampled_from((0.0, 1.0, 1e4))),
        rng.uniform(size=rows) < data.draw(st.sampled_from((0.0, 0.2, 1.0))), data.draw(st.sampled_from((None, 0.01))),
    )  # fmt: skip
    known = model if width == model.nq + model.nv else None
    observation = generic_observation(width) if known is None else parse_observation(known, None, width)
    for finding in examine(log, observation, known, data.draw(st.sampled_from((1, 5)))):
        json.dumps(finding.document(), allow_nan=True)
        assert finding.what


BALL = """
<mujoco>
  <worldbody>
    <body>
      <joint name="ball" type="ball"/><geom size=".1"/>
      <body pos="0 0 .3"><joint name="slide" type="slide" range="-1 1" limited="true"/><geom size=".05"/></body>
    </body>
  </worldbody>
  <actuator><position joint="slide" kp="3" ctrlrange="-1 1"/></actuator>
</mujoco>"""


@pytest.mark.parametrize("seed", range(3))
def test_the_same_log_gives_the_same_findings(seed: int) -> None:
    log = arm_log(actions=-record(steps=400)["actions"])
    assert arm_findings(log) == arm_findings(log)


def test_findings_do_not_depend_on_where_an_episode_lies_in_the_log() -> None:
    log = arm_log()
    half = len(log) // 2
    turned = Trajectories(*(np.concatenate([a[half:], a[:half]]) for a in (
        log.observations, log.next_observations, log.actions, log.terminals,
    )))  # fmt: skip
    assert names(arm_findings(turned)) == names(arm_findings(log)) == []


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 4.0])
def test_the_frame_skip_of_a_log_is_found(factor: float) -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.timestep = 0.01 / 8
    found = examine(arm_log(), parse_observation(model, None, 4), model, round(16 * factor))
    assert names(found) == [("frame_skip", "sure")]
    assert found[0].cure == {"frame_skip": 16}


def test_a_sure_finding_hides_the_doubts_that_it_explains() -> None:
    arrays = record(steps=400, noise=1e-4)
    for name in ("observations", "next_observations"):
        arrays[name] = np.array(arrays[name])
        arrays[name][:, 3] *= -180 / np.pi
    found = arm_findings(Trajectories(**arrays))
    assert {f.name for f in found if f.sure} == {"sign", "units"}
    assert [f for f in found if not f.sure] == []


def test_independent_noise_of_next_observations_joins_nothing() -> None:
    rng = np.random.default_rng(0)
    log = arm_log()
    noisy = replace(log, next_observations=log.next_observations + 3e-4 * rng.standard_normal((len(log), 4)))
    assert arm_findings(noisy) == ()


def test_shuffled_transitions_are_told_and_stop_nothing() -> None:
    order = np.random.default_rng(0).permutation(400)
    log = arm_log()
    mixed = Trajectories(log.observations[order], log.next_observations[order], log.actions[order], np.zeros(400))
    assert names(arm_findings(mixed)) == [("unordered", "doubtful")]


def test_uneven_stamps_are_sure_only_where_they_are_refused() -> None:
    log = arm_log()
    times = np.cumsum(np.random.default_rng(0).uniform(0.012, 0.028, 401))
    origin = Origin(("a", "b", "c", "d"), ("u", "v"), np.arange(400), np.diff(times))
    stamped = replace(log, origin=origin, dt=0.02)
    assert ("jitter", "sure") in names(arm_findings(stamped, tolerance=0.05))
    assert [f for f in arm_findings(stamped) if f.sure] == []


@pytest.mark.parametrize(("late", "noise"), [(0.0, 1e-4), (1e-3, 1e-4), (4e-3, 1e-3)])
def test_by_how_much_a_velocity_comes_late_is_told_to_a_part_of_a_row(late: float, noise: float) -> None:
    """Whatever the noises of both are, and also where single rows show nothing but noise."""
    rng, time = np.random.default_rng(5), 0.008 * np.arange(4000)
    tones = rng.uniform(0.5, 6.0, (6, 3))

    def path(at: np.ndarray, order: int) -> np.ndarray:
        return sum(w**order * a * np.sin(w * at + p + order * np.pi / 2) for w, a, p in tones) / 6

    q = path(time, 0) + noise * rng.standard_normal(len(time))
    v = path(time - late, 1) + 10 * noise * rng.standard_normal(len(time))
    log = Trajectories.of_samples(np.stack([q, v], 1), np.zeros((len(time) - 1, 1)), dt=0.008, source="log")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    record_ = Record.of(log, parse_observation(model, ["j.position", "j.velocity"], 2), model, 4)
    lag = find_lag(record_, record_.pairs[0])
    assert lag is not None
    assert lag.seconds == pytest.approx(late, abs=4 * lag.error)
    assert lag.error < 4e-4


def test_thresholds_can_be_changed() -> None:
    late = delayed(Log("arm", XML, 2, ("qpos", "qvel"), record(steps=400, noise=1e-4)), 1).arrays
    assert names(arm_findings(Trajectories(**late))) == [("action_shift", "doubtful")]
    assert arm_findings(Trajectories(**late), rules=Rules(significance=1e9)) == ()


def test_every_finding_is_documented() -> None:
    source = "".join(path.read_text() for path in (ROOT / "dropo_torch" / "data" / "examination").glob("*.py"))
    found = set(re.findall(r"Finding\(\s*\"(\w+)\"", source))
    rows = re.findall(r"^\| (`.*?`) \|", (ROOT / "docs" / "check.md").read_text(), re.MULTILINE)
    documented = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert len(found) > 20
    assert found <= documented
    assert {told for fault in FAULTS for told in fault.told} <= found


# --- corrections ---


@given(offset=st.floats(-3, 3), slope=st.floats(-1.5, 1.5), low=st.sampled_from((-np.pi, 0.0)))
def test_unwrapping_undoes_wrapping(offset: float, slope: float, low: float) -> None:
    angle = offset + slope * np.arange(60)
    wrapped = low + np.mod(angle - low, 2 * np.pi)
    arrays = {"observations": wrapped[:-1, None], "next_observations": wrapped[1:, None], "actions": np.zeros((59, 0))}
    log = read(arrays | {"terminals": np.arange(59) == 58}, unwrap=["observations"])
    np.testing.assert_allclose(log.observations[:, 0], angle[:-1], atol=1e-9)
    np.testing.assert_allclose(log.next_observations[:, 0], angle[1:], atol=1e-9)


def read(arrays: Mapping[str, np.ndarray], **options: Any) -> Trajectories:
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "log.npz", **arrays)
        return read_trajectories(Path(folder) / "log.npz", **options)


def test_columns_are_scaled_before_and_after_a_transition() -> None:
    log, scaled = read(record()), read(record(), scale={"observations[2]": -2.0, "actions": 3.0})
    for name in ("observations", "next_observations"):
        np.testing.assert_array_equal(getattr(scaled, name), getattr(log, name) * [1, 1, -2, 1])
    np.testing.assert_array_equal(scaled.actions, 3 * log.actions)


@pytest.mark.parametrize("shift", [-2, 1])
@pytest.mark.parametrize("following", [True, False])
def test_commands_move_by_rows_within_episodes(shift: int, following: bool) -> None:
    arrays = record()
    arrays["actions"] = np.arange(60.0)[:, None]
    log = read(arrays if following else {k: v for k, v in arrays.items() if k != "next_observations"}, shift=shift)
    rows = np.array([np.flatnonzero((arrays["observations"] == o).all(axis=1))[0] for o in log.observations])
    np.testing.assert_array_equal(log.actions[:, 0], rows + shift)
    assert log.num_episodes == 2
    assert len(log) == 60 - 2 * abs(shift) - (0 if following else 2)
    assert log.origin is not None
    np.testing.assert_array_equal(log.origin.rows, rows)


def test_breaks_begin_episodes() -> None:
    arrays = record()
    arrays["terminals"] = np.arange(60) == 59
    log = read(arrays, breaks=[10, 30])
    np.testing.assert_array_equal(np.flatnonzero(log.terminals), [9, 29, 59])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scale": 2.0}, "scale is 2.0; expected signal: factor"),
        ({"scale": {"observations[0]": 0}}, "a factor is 0"),
        ({"scale": {"q": 2.0}}, "there is no signal 'q'"),
        ({"unwrap": "q"}, "expected a list of signals"),
        ({"unwrap": ["actions"]}, "is a command|there is no signal"),
        ({"shift": 0.5}, "expected a whole number of rows"),
        ({"shift": 40}, "no episode is longer"),
        ({"breaks": [0]}, "expected rows from 1 to 59"),
        ({"breaks": 3}, "expected a list of rows"),
    ],
)
def test_a_wrong_correction_is_refused(options: Mapping[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        read(record(), **options)


# --- the command ---


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "arm")


def wrong(folder: Folder) -> str:
    """A log of the arm whose second velocity has the wrong sign."""
    arrays = record(steps=200)
    changed = {n: arrays[n] * [1, 1, 1, -1] for n in ("observations", "next_observations")}
    return folder.log("wrong.npz", **{**arrays, **changed})


def test_a_good_log_exits_0_and_writes_nothing(folder: Folder, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(folder.path.iterdir())
    config = folder.config(parameters=...)
    assert main(["check", str(config)]) == 0
    assert "Nothing is wrong with the log" in capsys.readouterr().out
    assert sorted(folder.path.iterdir()) == sorted([*before, config])


def test_a_parameter_of_nothing_in_the_model_exits_2(folder: Folder, capsys: pytest.CaptureFixture[str]) -> None:
    misspelt = {"friction": {"field": "dof_damping", "name": "elbw", "bounds": [0.0, 1.0]}}
    assert main(["check", str(folder.config(parameters=misspelt))]) == 2
    output, error = capsys.readouterr()
    assert "Nothing is wrong with the log" in output
    assert "did you mean 'elbow'" in error
    assert error.count("\n") == 1


def test_a_wrong_log_exits_2_with_the_name_of_what_is_wrong(
    folder: Folder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["check", str(folder.config(data=wrong(folder), parameters=...)), "--out", str(out)]) == 2
    output, error = capsys.readouterr()
    assert error.startswith("dropo: data: sign: ")
    assert error.count("\n") == 1
    assert "cured by data: {scale: {'observations[3]': -1.0}}" in error
    assert "sign" in output
    told = json.loads((out / "check.json").read_text())
    assert (told["schema"], told["right"], told["transitions"]) == ("dropo-torch/check/1", False, 200)
    assert [(f["name"], f["confidence"], f["where"]) for f in told["findings"]] == [
        ("sign", "sure", ["elbow.velocity"])
    ]  # fmt: skip
    page = (out / "report.html").read_text()
    assert "elbow.velocity" in page
    assert "http" not in page.replace("http-equiv", "")


@pytest.mark.parametrize("command", ["fit", "gap", "train"])
def test_runs_stop_at_what_is_surely_wrong(
    command: str, folder: Folder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torchrl")
    (folder.path / "task.py").write_text(TASK)
    config = folder.config(data=wrong(folder), task="task.py:Arm")
    out = tmp_path / "out"
    assert main([command, str(config), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("dropo: data: sign: ")
    assert error.endswith("--force goes on\n")
    assert not out.exists()


TASK = f"""
import mujoco
import torch
from dropo_torch.rl import Task


class Arm(Task):
    name, frame_skip, max_episode_steps, num_observations = "arm", 2, 20, 4

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string({XML!r})

    def initial_states(self, count, generator):
        return torch.zeros(count, 4, dtype=torch.float64)

    def observe(self, states):
        return states

    def reward(self, states, actions, next_states):
        return -next_states[:, 0] ** 2

    def terminated(self, next_states):
        return next_states[:, 0].abs() > 9
"""


def test_a_fit_that_is_forced_goes_on(folder: Folder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert (
        main(["fit", str(folder.config(data=wrong(folder))), "--out", str(out), "--force"]) == 3
    )  # it is hopeless, and says so
    assert "log: sure: sign: " in capsys.readouterr().out
    assert (out / "fit.json").exists()


def test_doubts_are_told_by_a_fit(folder: Folder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays = record(steps=200)
    rounded = {n: np.round(arrays[n], 1) for n in ("observations", "next_observations")}
    data = folder.log("coarse.npz", **{**arrays, **rounded})
    main(["fit", str(folder.config(data=data)), "--out", str(tmp_path / "out")])
    assert "log: doubtful: quantised: " in capsys.readouterr().out


def test_an_adapter_is_checked_for_what_needs_no_model(
    folder: Folder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays = record()
    data = folder.log("joined.npz", **{**arrays, "terminals": np.arange(60) == 59, "next_observations": np.roll(
        arrays["observations"], -1, axis=0) + 5.0 * (np.arange(60) == 30)[:, None]})  # fmt: skip
    config = folder.config(backend="gymnasium", environment="adapter.py:make", model=..., data=data)
    assert main(["check", str(config)]) == 2
    assert capsys.readouterr().err.startswith("dropo: data: joined: ")


def test_the_bundled_hopper_is_right(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    config = tmp_path / "hopper.yaml"
    config.write_text("sim: hopper")
    assert main(["check", str(config)]) == 0
