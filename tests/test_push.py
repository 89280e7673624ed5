"""The bundled arm that pushes a box: logs that are what they say, one physics on both backends, a box that is found."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from dropo_sims.push import SIM
from dropo_sims.push.guided import InstrumentLog, record_guided, write_model
from dropo_sims.push.policy import START, Push, Pusher
from dropo_sims.push.record import main
from dropo_sims.push.task import TARGETS, PushTask

from dropo_torch.baselines import fit_problem
from dropo_torch.config import make_config
from dropo_torch.data.preprocess import Preprocess, signal_delays
from dropo_torch.data.readers import read_recording, read_trajectories
from dropo_torch.errors import InputError
from dropo_torch.models.load import load_model
from dropo_torch.parameters import ParameterSpace
from dropo_torch.problem import make_problem
from dropo_torch.rl import load_task
from dropo_torch.simulators import make_simulator


def model_of(**values: float) -> mujoco.MjModel:
    space = ParameterSpace(SIM.model, SIM.parameters)
    return space.apply(space.named(space.nominal) | values)


@pytest.mark.parametrize(("axis", "name"), [(0, "friction_x"), (1, "friction_y")])
def test_friction_along_an_axis_stops_what_slides_along_it(axis: int, name: str) -> None:
    other = {"friction_x": "friction_y", "friction_y": "friction_x"}[name]
    model = model_of(**{name: 0.3, other: 1.5})
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7], data.qvel[7 + axis] = START, 0.9, 1.0
    speeds = []
    for _ in range(100):
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[7 + axis])
    slowed = (speeds[20] - speeds[80]) / (60 * model.opt.timestep)
    assert slowed == pytest.approx(0.3 * 9.81, rel=0.06)


def test_the_tip_follows_its_line_upright() -> None:
    model = model_of()
    pusher, push = Pusher(model), Push(side=0.02, heading=0.2, speed=0.3)
    qpos = pusher.start(push)
    for step in range(60):
        qpos = qpos + 0.01 * pusher.velocities(qpos, push, 0.01 * step)
    data = mujoco.MjData(model)
    data.qpos[:7] = qpos
    mujoco.mj_kinematics(model, data)
    tip, turn = data.site("tip").xpos, data.site("tip").xmat.reshape(3, 3)
    across = (tip[:2] - [0.46, 0.02]) @ [-np.sin(0.2), np.cos(0.2)]
    assert across == pytest.approx(0, abs=1e-3)
    assert tip[0] > 0.5
    assert tip[2] == pytest.approx(push.height, abs=2e-3)
    assert turn[2, 2] < -0.999


def test_the_box_is_found() -> None:
    pytest.importorskip("warp")
    config = make_config({"sim": "push", "backend": "warp", "epsilon": 1e-8, "trajectories": [0, 1, 2, 3]})
    result = fit_problem(make_problem(config))
    for name, mean in zip(SIM.parameters, result.distribution.mean, strict=True):
        assert float(mean) == pytest.approx(SIM.truth[name], abs=2e-4), name


def test_the_task_knows_where_the_tip_and_the_box_are() -> None:
    task = load_task("push")
    assert isinstance(task, PushTask)
    model, generator = task.model, torch.Generator().manual_seed(1)
    states = task.initial_states(20, generator)
    states[:, :7] += 0.3 * torch.randn(20, 7, generator=generator, dtype=torch.float64)
    angles = torch.rand(20, generator=generator, dtype=torch.float64) * 6 - 3
    states[:, 10], states[:, 13] = (angles / 2).cos(), (angles / 2).sin()
    seen, data = task.observe(states), mujoco.MjData(model)
    assert seen.shape == (20, task.num_observations)
    for state, row, angle in zip(states.numpy(), seen.numpy(), angles.tolist(), strict=True):
        data.qpos[:], data.qvel[:] = state[:14], state[14:]
        mujoco.mj_forward(model, data)
        box = data.body("box").xpos
        np.testing.assert_allclose(row[14:16], 10 * (np.array(TARGETS[0]) - box[:2]), atol=1e-12)
        np.testing.assert_allclose(row[16:19], 10 * (box - data.site("tip").xpos), atol=1e-12)
        np.testing.assert_allclose(row[19:21], [np.sin(angle), np.cos(angle)], atol=1e-12)
    np.testing.assert_array_equal(
        task.initial_states(4, torch.Generator().manual_seed(3)),
        task.initial_states(4, torch.Generator().manual_seed(3)),
    )


@pytest.mark.parametrize("target", range(len(TARGETS)))
def test_the_reward_is_largest_with_the_box_at_the_target_and_the_arm_at_rest(target: int) -> None:
    task = PushTask(target=target)
    states = task.initial_states(3, torch.Generator().manual_seed(0))
    states[0, 7:9] = torch.tensor(TARGETS[target], dtype=torch.float64)
    states[1, 7:9] = states[0, 7:9] + torch.tensor([0.03, 0.04], dtype=torch.float64)
    reward = task.reward(states, torch.zeros(3, 7), states)
    np.testing.assert_allclose(task.distance(states)[:2], [0, 0.05], atol=1e-12)
    np.testing.assert_allclose(reward[:2], [-np.log(1e-3), -0.0025 - np.log(0.0035)], rtol=1e-12)
    assert reward[0] > reward[1] > reward[2]
    assert (task.reward(states, torch.full((3, 7), 0.5), states) < reward).all()
    assert not task.terminated(states).any()
    states[:, 10:14] = torch.tensor([0.7, 0.7, 0.0, 0.0], dtype=torch.float64) / 0.98**0.5
    assert task.terminated(states).all()


#: How docs/manipulation.md reads a guided log.
PREPROCESS = {
    "dt": 0.01, "cutoff": 20, "max_gap": 0.05, "start": 0.5, "stop": 3.5, "positions": ["q", "box"],
    "quaternions": [[f"box[{i}]" for i in range(3, 7)]], "align": ["hand[0]"], "reference": "tip[0]",
    "same_clock": ["box"], "actions": "velocity", "controlled": ["q"],
}  # fmt: skip
COLUMNS = {"time": "stamp", "terminals": [], "observations": ["q", "tip", "box", "hand"]}


@pytest.fixture(scope="module")
def guided(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, InstrumentLog]:
    path, log = tmp_path_factory.mktemp("guided") / "log.npz", record_guided(steps=300, seed=3, truth=SIM.truth)
    log.save(path)
    return path, log


def test_a_guided_log_holds_what_instruments_tell(guided: tuple[Path, InstrumentLog]) -> None:
    path, log = guided
    with np.load(path) as file:
        assert set(file.files) == {"episode", "stamp", "q", "tip", "box", "hand"}
    encoders, frames = ~np.isnan(log.q[:, 0]), ~np.isnan(log.box[:, 0])
    assert (encoders ^ frames).all()
    np.testing.assert_allclose(np.diff(log.stamp[encoders]), 1e-3, atol=1e-9)
    np.testing.assert_allclose(np.diff(log.stamp[frames]), 1 / 120, atol=1e-9)
    again, other = (record_guided(steps=20, seed=seed) for seed in (3, 4))
    np.testing.assert_array_equal(again.q, record_guided(steps=20, seed=3).q)
    assert again.offset == log.offset != other.offset


def test_the_offset_between_the_clocks_is_found(guided: tuple[Path, InstrumentLog]) -> None:
    path, log = guided
    found = signal_delays(read_recording(path, actions=[], **COLUMNS), Preprocess(**PREPROCESS))
    assert {name for name in found if name != "hand[0]"} == {f"box[{i}]" for i in range(7)}
    for delay in found.values():
        assert delay == pytest.approx(log.offset, abs=3e-4)


def test_the_arm_goes_where_a_guided_log_has_it(guided: tuple[Path, InstrumentLog], tmp_path: Path) -> None:
    log, lag = read_trajectories(guided[0], **COLUMNS, preprocess=Preprocess(**PREPROCESS)), 10
    assert (len(log), log.dt) == (300, 0.01)
    write_model(tmp_path / "model.xml")
    space = ParameterSpace(load_model(tmp_path / "model.xml"), SIM.parameters)
    simulator = make_simulator("mujoco", space.model, parameters=space, frame_skip=5)
    truth = torch.tensor([[SIM.truth[name] for name in space.names]], dtype=torch.float64)
    states, actions = torch.from_numpy(log.observations[::lag].copy()), torch.from_numpy(log.actions.copy())
    after = simulator.simulate(states, actions.reshape(-1, lag, 7), truth)[:, 0].numpy()
    ends = log.next_observations[lag - 1 :: lag]
    off, moved = np.abs(after - ends), np.abs(ends - log.observations[::lag])
    assert moved[:, 7:9].sum(0).max() > 0.05
    assert off[:, :7].max() < 0.01 * moved[:, :7].max()
    assert np.median(off[:, 7:9]) < 5e-4  # m: the camera's noise, at both ends


def test_the_recorders_command_guides_the_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log"
    main([str(path), "--variant", "guided", "--episodes", "2", "--steps", "5"])
    with np.load(path) as file:
        assert capsys.readouterr().out == f"{len(file['stamp'])} samples in {path}\n"
        assert set(file["episode"]) == {0, 1}
    with pytest.raises(InputError, match="did you mean 'friction_x'"):
        record_guided(truth={"frictionx": 1.0})
    with pytest.raises(InputError, match="steps 0"):
        record_guided(steps=0)
