"""Logs of sensors: what columns mean, how they are simulated, and fits that estimate the states they do not show."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from arm import CONFIG, TRUTH, XML, record

from benchmarks.sensed_logs import SYSTEMS, write
from dropo_torch.baselines import fit_problem
from dropo_torch.commands.cli import main
from dropo_torch.config import load_config
from dropo_torch.data.observation import parse_observation
from dropo_torch.errors import InputError
from dropo_torch.fit import fit
from dropo_torch.logged import read_log
from dropo_torch.problem import Problem, make_problem
from dropo_torch.shooting.begin import first_states, rough_noise
from dropo_torch.shooting.chain import Chain
from dropo_torch.shooting.equations import Point, Scales, residuals
from dropo_torch.shooting.fusion import fused
from dropo_torch.shooting.windows import Windows
from dropo_torch.simulators import MujocoSimulator

#: The arm with encoders, an IMU in its hand, a camera that sees the hand, a clock and a force sensor in the elbow.
ARM_XML = XML.replace("</worldbody>", "</worldbody>" + """
  <sensor>
    <jointpos name="q1" joint="shoulder"/><jointpos name="q2" joint="elbow"/>
    <jointvel name="dq1" joint="shoulder"/><jointvel name="dq2" joint="elbow"/>
    <gyro name="gyro" site="hand"/><accelerometer name="accelerometer" site="hand"/>
    <framepos name="marker" objtype="site" objname="hand"/><framequat name="turned" objtype="site" objname="hand"/>
    <force name="force" site="hand"/><clock name="clock"/>
  </sensor>""").replace('mass=".7"/>', 'mass=".7"/><site name="hand" pos="0 0 -.25"/>')  # fmt: skip
ARM = mujoco.MjModel.from_xml_string(ARM_XML)


def seen(log: dict[str, np.ndarray], names: list[str], noise: float, seed: int = 1) -> dict[str, np.ndarray]:
    """A log of states as sensors show it."""
    model = mujoco.MjModel.from_xml_string(ARM_XML)
    for name, mass in TRUTH.items():
        model.body(name.removesuffix("_mass")).mass = mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    columns = np.concatenate([np.arange(s.adr[0], s.adr[0] + s.dim[0]) for s in map(model.sensor, names)])
    shown = []
    for state, action in zip(log["next_observations"], log["actions"], strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[:2], state[2:], action
        mujoco.mj_forward(model, data)
        shown.append(data.sensordata[columns] + noise * rng.standard_normal(len(columns)))
    before = np.array([shown[0], *shown[:-1]])
    return {**log, "observations": before, "next_observations": np.array(shown)}


def arm(folder: Path, log: dict[str, np.ndarray], **changes: Any) -> Path:
    (folder / "arm.xml").write_text(ARM_XML)
    np.savez(folder / "log.npz", **log)
    (folder / "config.yaml").write_text(yaml.safe_dump({**CONFIG, **changes}, sort_keys=False))
    return folder / "config.yaml"


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, float]]:
    return write(replace(SYSTEMS["pendulum"], steps=100), tmp_path_factory.mktemp("pendulum"), 3)


@pytest.fixture(scope="module")
def windows(pendulum: tuple[Path, dict[str, float]]) -> Windows:
    return Windows.of(make_problem(load_config(pendulum[0])))


# --- what columns are ---


@pytest.mark.parametrize(
    ("entries", "labels", "units"),
    [
        (["sensor[gyro]"], ["gyro[x]", "gyro[y]", "gyro[z]"], ["rad/s"] * 3),
        (["sensor[accelerometer][2]", "skip"], ["accelerometer[z]"], ["m/s²"]),
        (["sensor[marker][1:]", "qpos[elbow]"], ["marker[y]", "marker[z]", "elbow.position"], ["m", "m", "rad"]),
        (["sensor[turned]"], ["turned[qw]", "turned[qx]", "turned[qy]", "turned[qz]"], ["-"] * 4),
        (["sensor[q2]", "sensor[dq1]"], ["elbow.position", "shoulder.velocity"], ["rad", "rad/s"]),
        (["sensor[0:2]", "sensor[-1]"], ["shoulder.position", "elbow.position", "clock"], ["rad", "rad", "s"]),
    ],
)
def test_sensors_are_columns_with_names_and_units(entries, labels, units):
    observation = parse_observation(ARM, entries)
    assert (list(observation.labels), list(observation.units)) == (labels, units)
    assert observation.is_sensed
    assert bool(observation.quaternions) == (entries == ["sensor[turned]"])


def test_encoders_of_the_whole_state_are_the_state():
    state = parse_observation(ARM, ["qpos", "qvel"])
    assert parse_observation(ARM, ["sensor[q1]", "sensor[q2]", "sensor[dq1]", "sensor[dq2]"]) == state
    assert not state.is_sensed


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("sensor[gyros]", "no sensor 'gyros'; did you mean 'gyro'"),
        ("sensor[gyro][3]", "outside sensor.gyro., which has 3 entries"),
        ("sensor[gyro][x]", "'x' is no number or slice"),
        ("sensor[90]", "outside sensor, which has"),
        ("sensor[turned][1:]", "only 3 of the 4 quaternion columns of sensor 'turned'"),
    ],
)
def test_what_is_no_sensor_is_refused(entry, words):
    with pytest.raises(InputError, match=words):
        parse_observation(ARM, [entry])


def test_a_sensor_that_remembers_is_refused():
    delayed = mujoco.MjModel.from_xml_string(
        ARM_XML.replace('name="gyro"', 'name="gyro" delay=".02" nsample="4"'),
    )
    with pytest.raises(InputError, match="has a delay or an interval in the model"):
        parse_observation(delayed, ["sensor[gyro]"])


def test_sensors_are_simulated_as_mujoco_has_them(tmp_path):
    path = arm(tmp_path, record(), observation=["qpos", "qvel"])
    space = make_problem(load_config(path)).space
    simulator = MujocoSimulator(space.model, parameters=space, frame_skip=2, sensors=True)
    rng = np.random.default_rng(0)
    states, controls = rng.normal(size=(5, simulator.num_states)), rng.uniform(-1, 1, (5, 3, 2))
    values = np.array([[1.0, 0.4], [2.0, 0.9]])
    path = simulator.rollout(states, controls, values).numpy()
    for t, k in itertools.product(range(5), range(2)):
        model = space.apply(space.named(values[k]))
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = states[t, :2], states[t, 2:4]
        for step in range(3):
            data.ctrl[:] = controls[t, step]
            mujoco.mj_step(model, data, 2)
            mujoco.mj_forward(model, data)
            expected = np.concatenate([data.qpos, data.qvel, data.sensordata])
            is_clock = np.arange(len(expected)) == len(expected) - 1
            np.testing.assert_allclose(path[t, k, step][~is_clock], expected[~is_clock], rtol=1e-9, atol=1e-9)


# --- the parts of a fit ---


def test_a_chain_is_solved_and_inverted_as_a_dense_matrix_is():
    rng, w, s = np.random.default_rng(0), 5, 3
    dense = np.zeros((w * s, w * s))
    for i in range(w - 1):  # of two chains: the third window follows on none
        if i != 1:
            block = rng.normal(size=(7, 2 * s))
            dense[i * s : (i + 2) * s, i * s : (i + 2) * s] += block.T @ block
    dense += np.eye(w * s)
    blocks = dense.reshape(w, s, w, s).swapaxes(1, 2)
    below = np.array([np.zeros((s, s)), *(blocks[i, i - 1] for i in range(1, w))])
    chain = Chain.of(np.array([blocks[i, i] for i in range(w)]), below)
    right, inverse = rng.normal(size=(w, s, 2)), np.linalg.inv(dense)
    np.testing.assert_allclose(chain.solve(right).reshape(-1, 2), inverse @ right.reshape(-1, 2), rtol=1e-8)
    own, before = chain.covariances()
    inverse = inverse.reshape(w, s, w, s).swapaxes(1, 2)
    np.testing.assert_allclose(own, [inverse[i, i] for i in range(w)], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(before[1:], [inverse[i, i - 1] for i in range(1, w)], rtol=1e-8, atol=1e-12)


def test_of_several_states_each_window_takes_what_serves_the_chain(windows):
    few = np.flatnonzero(windows.episodes == 0)[-4:]
    part = replace(windows, **{
        name: getattr(windows, name)[few] for name in ("controls", "measured", "starts", "rows", "episodes")
    }, follows=windows.follows[few] & (np.arange(4) > 0))  # fmt: skip
    rng = np.random.default_rng(0)
    tried = [rng.normal(size=part.starts.shape) for _ in range(2)]
    scales = Scales(np.full(3, 0.3), np.full(2, 0.5))
    mean = part.box.middle
    point, found, choice = fused(part, mean, tried, scales)
    costs = {
        picked: residuals(part, Point(mean, np.array(tried)[picked, range(4)])).cost(scales)
        for picked in itertools.product(range(2), repeat=4)
    }
    assert min(costs, key=lambda picked: costs[picked]) == tuple(choice)
    assert found.cost(scales) == pytest.approx(min(costs.values()))
    np.testing.assert_array_equal(point.states, np.array(tried)[choice, range(4)])


def test_first_states_follow_the_log_from_wherever_it_begins(windows):
    noise = rough_noise(windows)[0]
    states = first_states(windows, windows.box.middle, noise, seed=0)
    off = residuals(windows, Point(windows.box.middle, states)).measured
    assert np.sqrt(np.mean(off**2)) < 0.005  # of a marker 0.4 m from the hinge, which begins up to 2.8 rad from rest


# --- fits ---


def test_the_friction_of_a_pendulum_is_found_by_a_marker(pendulum):
    path, truth = pendulum
    problem = make_problem(load_config(path))
    found = fit_problem(problem)
    assert found.estimated is not None
    values = dict(zip(found.distribution.names, found.distribution.center, strict=True))
    assert values["friction"] == pytest.approx(truth["friction"], rel=0.05)
    error = found.estimated.standard_error * np.where(found.distribution.is_log, found.distribution.center, 1.0)
    assert (np.abs(found.distribution.center - [truth[n] for n in values]) < 4 * error).all()
    assert list(found.extras["noise"].values()) == pytest.approx([0.001] * 3, rel=0.2)
    residual = (
        found.estimated.objective.measured - found.estimated.objective.simulated(found.distribution.center[None])[:, 0]
    )
    assert residual.std().item() == pytest.approx(0.001, rel=0.2)


@pytest.mark.slow
def test_the_masses_of_a_hopper_are_found_by_what_a_robot_has(tmp_path):
    path, truth = write(SYSTEMS["hopper"], tmp_path, 0)
    found = fit_problem(make_problem(load_config(path))).distribution
    assert found.center == pytest.approx([truth[name] for name in found.names], rel=0.02)


@pytest.mark.parametrize("names", [["q1", "q2"], ["gyro", "marker"], ["q1", "q2", "force", "accelerometer"]])
def test_masses_of_the_arm_are_found_by_what_it_has(names, tmp_path):
    noise = 1e-4
    log = seen(record(steps=120), names, noise)
    path = arm(tmp_path, log, observation=[f"sensor[{name}]" for name in names])
    found = fit_problem(make_problem(load_config(path)))
    assert found.estimated is not None
    off = found.distribution.center - list(TRUTH.values())
    assert (np.abs(off) < 4 * found.estimated.standard_error).all()
    assert (np.abs(off) < 0.02).all()


def test_a_state_that_is_seen_is_fitted_as_it_is_without_sensors(tmp_path):
    """A clock says nothing, but the states beside it are then estimated: the numbers must be those of Laplace."""
    noise, states = 1e-3, record(steps=120)
    plain = {**states}
    rng = np.random.default_rng(1)
    for name in ("observations", "next_observations"):
        plain[name] = plain[name] + noise * rng.standard_normal(plain[name].shape)
    rows = np.arange(120)[:, None]
    timed = {**plain, **{n: np.hstack([plain[n], rows]) for n in ("observations", "next_observations")}}
    found = []
    for log, more in ((plain, []), (timed, ["sensor[clock]"])):
        options = {"observation": ["qpos", "qvel", *more], "noise": [noise] * 4 + [1e3] * len(more)}
        path = arm(tmp_path, log, method="laplace", **options)
        found.append(fit_problem(make_problem(load_config(path))).distribution)
    by_transitions, by_windows = found
    assert (np.abs(by_windows.mean - by_transitions.mean) < 3 * by_transitions.std).all()
    assert (by_windows.std < by_transitions.std).all()  # windows of many steps tell more than single transitions


def test_the_center_of_a_tossed_box_is_found_by_a_marker_and_a_gyroscope(tmp_path):
    """Its states have an orientation, which no column shows."""
    xml = """
    <mujoco>
      <option timestep=".005"/>
      <worldbody>
        <body name="box" pos="0 0 1">
          <freejoint name="root"/>
          <inertial pos="{} 0 0" mass="1" diaginertia=".004 .006 .008"/>
          <geom type="box" size=".1 .08 .05" contype="0" conaffinity="0"/>
          <site name="corner" pos=".1 .08 .05"/>
        </body>
      </worldbody>
      <sensor><framepos name="marker" objtype="site" objname="corner"/><gyro name="gyro" site="corner"/></sensor>
    </mujoco>"""
    truth, noise, rng = 0.03, np.array([0.001] * 3 + [0.01] * 3), np.random.default_rng(0)
    model = mujoco.MjModel.from_xml_string(xml.format(truth))
    paths = []
    for _ in range(2):
        data = mujoco.MjData(model)
        data.qvel[:] = [*rng.normal(size=3), *(4 * rng.normal(size=3))]
        path = []
        for step in range(41):
            if step:
                mujoco.mj_step(model, data, 2)
            mujoco.mj_forward(model, data)
            path.append(data.sensordata + noise * rng.standard_normal(6))
        paths.append(np.array(path))
    log = {
        "observations": np.concatenate([p[:-1] for p in paths]),
        "next_observations": np.concatenate([p[1:] for p in paths]),
        "actions": np.zeros((80, 0)), "terminals": np.arange(80) % 40 == 39,
    }  # fmt: skip
    path = arm(
        tmp_path, log, model="box.xml", observation=["sensor"],
        parameters={"center": {"field": "body_ipos", "name": "box", "index": 0, "bounds": [-0.05, 0.05]}},
    )  # fmt: skip
    (tmp_path / "box.xml").write_text(xml.format(0))
    found = fit_problem(make_problem(load_config(path)))
    assert found.distribution.center[0] == pytest.approx(truth, abs=1e-3)
    assert list(found.extras["noise"].values()) == pytest.approx(noise, rel=0.35)


def test_a_fit_that_was_interrupted_goes_on_to_the_same_result(pendulum, tmp_path):
    problem, kept = make_problem(load_config(pendulum[0])), tmp_path / "checkpoint.bin"

    def interrupt(entry, progress):
        if entry.evaluations > 5:
            raise KeyboardInterrupt

    whole = fit_problem(problem)
    with pytest.raises(KeyboardInterrupt):
        fit_problem(problem, checkpoint=kept, on_progress=interrupt)
    again = fit_problem(problem, checkpoint=kept, resume=True)
    first, second = whole.document(), again.document()
    assert first.pop("seconds") >= 0 <= second.pop("seconds")
    assert first == second


def test_the_command_writes_what_it_always_writes(pendulum, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["fit", str(pendulum[0]), "--out", str(out), "--samples", "10"]) == 0
    document = json.loads((out / "fit.json").read_text())
    assert document["verdict"] == "explained"
    assert set(document["noise"]) == {"marker[x]", "marker[y]", "marker[z]"}
    assert set(document["standard_errors"]) == {"damping", "friction"}
    page = (out / "report.html").read_text()
    assert "The log does not show the states" in page
    assert "dropo view" not in page
    assert {p.name for p in out.iterdir()} >= {"report.html", "model.xml", "fitted_config.yaml", "checkpoint.bin"}
    assert "method: laplace" in capsys.readouterr().out


def test_a_model_that_lacks_friction_does_not_explain_what_a_camera_saw(pendulum, tmp_path):
    damping = json.dumps(load_config(pendulum[0]).parameters["damping"])
    assert (
        main(["fit", str(pendulum[0]), "--out", str(tmp_path / "out"), "--parameters", f"{{damping: {damping}}}"]) == 0
    )
    document = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert document["verdict"] == "not_explained"
    assert "hinge.velocity" in document["verdict_reason"]


# --- what is refused, and what is examined ---


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"backend": "warp"}, "backend: warp simulates no sensors"),
        ({"optimizer": "adam"}, "optimizer: adam needs logged states"),
        ({"optimizer": "cma"}, "optimizer: cma needs logged states"),
        ({"method": "bayessim"}, "method: bayessim needs logged states"),
        ({"covariance": "full"}, "covariance: 'full' given, which says nothing"),
        ({"epsilon": 1e-3}, "epsilon: 0.001 given, which says nothing"),
        ({"effects": [{"effect": "viscous", "target": "hinge"}]}, "effects: they do not go with sensors"),
    ],
)
def test_what_needs_states_is_refused(changes, words, pendulum):
    with pytest.raises(InputError, match=words):
        make_problem(load_config(pendulum[0], changes))


def test_whoever_needs_states_says_so(pendulum, tmp_path, capfd):
    problem: Problem = make_problem(load_config(pendulum[0]))
    with pytest.raises(InputError, match="fit_problem estimates it"):
        fit(problem.objective)
    assert main(["sweep-epsilon", str(pendulum[0]), "--out", str(tmp_path / "sweep")]) == 2
    assert "which sweep-epsilon needs" in capfd.readouterr().err


def test_a_parameter_that_moves_no_sensor_is_refused(pendulum):
    changes = {"parameters": {"friction": {"field": "geom_friction", "name": "geom0", "bounds": [0.1, 1.0]}}}
    with pytest.raises(InputError, match="moves no compared column"):
        fit_problem(make_problem(load_config(pendulum[0], changes)))


def test_a_sensor_that_is_not_connected_is_told(tmp_path):
    log = seen(record(), ["q1", "q2", "gyro"], 0.0)
    log = {**log, **{name: log[name] * [1, 1, 1, 0, 1] for name in ("observations", "next_observations")}}
    path = arm(tmp_path, log, observation=["sensor[q1]", "sensor[q2]", "sensor[gyro]"])
    found = [f for f in read_log(load_config(path)).examined() if f.name == "silent"]
    assert [f.where for f in found] == [("gyro[x]", "gyro[y]", "gyro[z]")] or "gyro[y]" in found[0].where
    assert not found[0].sure
