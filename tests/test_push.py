"""The bundled arm that pushes a box: logs that are what they say, one physics on both backends, a box that is found."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from dropo_sims.push import SIM
from dropo_sims.push.policy import START, Push, Pusher
from dropo_sims.push.record import NOISE, SPREAD, VARIANTS, main, record
from dropo_sims.push.task import TARGETS, PushTask

from dropo_torch.baselines import fit_problem
from dropo_torch.config import make_config
from dropo_torch.data.readers import read_trajectories
from dropo_torch.errors import InputError
from dropo_torch.models.bundled import bundled_sim
from dropo_torch.parameters import ParameterSpace
from dropo_torch.problem import make_problem
from dropo_torch.rl import load_task
from dropo_torch.simulators import make_simulator
from dropo_torch.testing import converged


def model_of(**values: float) -> mujoco.MjModel:
    space = ParameterSpace(SIM.model, SIM.parameters)
    return space.apply(space.named(space.nominal) | values)


def test_it_is_found_by_name_and_its_truth_is_not_the_model() -> None:
    assert bundled_sim("push") is SIM
    assert set(SIM.truth) == set(SIM.parameters)
    space = ParameterSpace(SIM.model, SIM.parameters)
    for name in space.names:
        low, high = SIM.parameters[name]["bounds"]
        assert low < SIM.truth[name] < high
    assert space.named(space.nominal) != SIM.truth


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


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_seed_decides_a_log(variant: str) -> None:
    first, again, other = (record(variant=variant, episodes=2, steps=15, seed=seed) for seed in (5, 5, 6))
    for name in ("observations", "next_observations", "actions", "terminals", "parameters"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not np.array_equal(first.actions, other.actions)
    assert first.observations.shape == (30, 27)
    assert np.flatnonzero(first.terminals).tolist() == [14, 29]
    assert (np.abs(first.actions) <= 2).all()


def test_each_transition_is_one_of_the_recorded_box() -> None:
    log, model = record(episodes=1, truth=SIM.truth), model_of(**SIM.truth)
    np.testing.assert_array_equal(log.observations[1:], log.next_observations[:-1])
    for before, action, after in zip(log.observations, log.actions, log.next_observations, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = before[:14], before[14:], action
        mujoco.mj_step(model, data, SIM.frame_skip)
        np.testing.assert_allclose(np.concatenate([data.qpos, data.qvel]), after, rtol=1e-9, atol=1e-9)
    assert log.next_observations[-1, 7] - log.observations[0, 7] > 0.03


def test_noise_and_parameters_spread_as_they_say() -> None:
    clean, noisy = (record(variant=variant, episodes=3, seed=2) for variant in ("point", "noisy"))
    noise = (noisy.observations - clean.observations).std(0)
    np.testing.assert_allclose(noise[:10], NOISE[0], rtol=0.3)
    np.testing.assert_allclose(noise[14:], NOISE[1], rtol=0.3)
    np.testing.assert_allclose(np.linalg.norm(noisy.observations[:, 10:14], axis=1), 1, atol=1e-12)
    drawn = record(variant="distribution", episodes=80, steps=1, truth={"mass": 1.0}).parameters
    np.testing.assert_allclose(drawn.std(0), [SPREAD[name] for name in SIM.parameters], rtol=0.25)
    bounds = np.array([SIM.parameters[name]["bounds"] for name in SIM.parameters])
    assert ((drawn > bounds[:, 0]) & (drawn < bounds[:, 1])).all()


def test_the_bundled_log_is_what_the_documented_command_records(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log"
    main([str(path), "--robot", "--seed", "1"])
    assert capsys.readouterr().out == f"600 transitions in {path}\n"
    with np.load(path) as ours, np.load(SIM.log) as bundled:
        assert set(ours.files) == set(bundled.files)
        for name in ours.files:
            np.testing.assert_allclose(ours[name], bundled[name], rtol=1e-6, atol=1e-6)
    assert len(read_trajectories(SIM.log)) == 600


def test_both_backends_simulate_the_same_pushes() -> None:
    pytest.importorskip("warp")
    log = record(episodes=3, seed=3, truth=SIM.truth)
    values = torch.tensor([[SIM.truth[name] for name in SIM.parameters]], dtype=torch.float64)
    rows = torch.from_numpy(log.observations), torch.from_numpy(log.actions)[:, None], values
    space = converged(ParameterSpace(SIM.model, SIM.parameters))
    ours, theirs = (
        make_simulator(backend, space.model, parameters=space, frame_skip=SIM.frame_skip).simulate(*rows)
        for backend in ("warp", "mujoco")
    )
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        theirs.reshape(log.next_observations.shape), log.next_observations, rtol=0, atol=1e-5
    )  # as the model has it


def test_the_box_is_found() -> None:
    pytest.importorskip("warp")
    config = make_config({"sim": "push", "backend": "warp", "epsilon": 1e-8, "trajectories": [0, 1, 2, 3]})
    result = fit_problem(make_problem(config))
    for name, mean in zip(SIM.parameters, result.distribution.mean, strict=True):
        assert float(mean) == pytest.approx(SIM.truth[name], abs=2e-4), name


def test_recording_refuses_what_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="variant"):
        record(variant="nosy")
    with pytest.raises(InputError, match="episodes 0"):
        record(episodes=0)
    with pytest.raises(InputError, match="did you mean 'friction_x'"):
        record(truth={"frictionx": 1.0})
    for arguments in (["x.npz", "--steps", "0"], [str(tmp_path)], ["x.npz", "--variant", "nosy"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
        assert "Traceback" not in capsys.readouterr().err


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
