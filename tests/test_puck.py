"""The bundled arm that hits a puck: hits that are what they say, and eighteen parameters that are found."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from dropo_sims.puck import SIM, generator
from dropo_sims.puck.generator import LATENT, STEPS, load_decoder, scripted_hits, train_decoder
from dropo_sims.puck.policy import FASTEST, HEIGHT, HOME, PUCK, STEP, Hit, hit_targets
from dropo_sims.puck.record import record
from dropo_sims.puck.task import TARGET, PuckTask
from safetensors.torch import save_file

from dropo_torch.baselines import fit_problem
from dropo_torch.config import make_config
from dropo_torch.parameters import ParameterSpace
from dropo_torch.problem import make_problem
from dropo_torch.rl import RandomizedEnv, load_task


def model_of(**values: float) -> mujoco.MjModel:
    space = ParameterSpace(SIM.model, SIM.parameters)
    return space.apply(space.named(space.nominal) | values)


@pytest.mark.parametrize(("axis", "name"), [(0, "friction_x"), (1, "friction_y")])
def test_friction_along_an_axis_stops_what_slides_along_it(axis: int, name: str) -> None:
    other = {"friction_x": "friction_y", "friction_y": "friction_x"}[name]
    model = model_of(**{name: 0.3, other: 0.7})
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7], data.qvel[7 + axis], data.ctrl[:] = HOME, 1.2, 1.0, HOME
    speeds = []
    for _ in range(250):
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[7 + axis])
    slowed = (speeds[50] - speeds[200]) / (150 * model.opt.timestep)
    assert slowed == pytest.approx(0.3 * 9.81, rel=0.06)


def test_the_stick_strikes_along_its_line_and_returns() -> None:
    model, hit = model_of(), Hit(heading=0.2, side=0.01, speed=0.6)
    targets, data = hit_targets(model, hit, 750), mujoco.MjData(model)
    assert np.abs(np.diff(targets, axis=0)).max() <= FASTEST * STEP * (1 + 1e-9)
    np.testing.assert_allclose(targets[-1], HOME, atol=0.15)  # of many poses with this tip
    places = []
    for target in targets:
        data.qpos[:7] = target
        mujoco.mj_kinematics(model, data)
        places.append(data.site("tip").xpos.copy())
        assert data.site("tip").xmat[8] < -0.999
    path = np.array(places)
    along, across = ((path[:, :2] - PUCK) @ v for v in ([np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]))
    near = (along > -0.1) & (along < -0.04) & (np.arange(750) < 300)  # on its way to the puck
    assert near.sum() > 5
    across, heights = across[near], path[near, 2]
    np.testing.assert_allclose(across, 0.01, atol=4e-3)
    np.testing.assert_allclose(heights, HEIGHT, atol=3e-3)
    np.testing.assert_allclose(path[-1], path[0], atol=2e-3)


def test_a_hit_sends_the_puck_along_its_heading() -> None:
    log = record(episodes=6, steps=400, seed=3, truth=SIM.truth)
    states = log.observations.reshape(6, 400, 27)
    way = states[:, -1, 7:9] - states[:, 0, 7:9]
    assert (np.linalg.norm(way, axis=1) > 0.05).all()
    assert (way[:, 0] > 0).all()
    assert np.linalg.norm(states[:, -1, 21:24], axis=1).max() < 1e-2  # it has come to rest
    assert states[:, :, 9].max() < 0.0132  # and has never left the board


def test_puck_and_servos_are_found() -> None:
    pytest.importorskip("warp")
    config = make_config({"sim": "puck", "backend": "warp", "epsilon": 1e-8, "trajectories": [0]})
    result = fit_problem(make_problem(config))
    for name, mean in zip(SIM.parameters, result.distribution.mean, strict=True):
        assert float(mean) == pytest.approx(SIM.truth[name], rel=1e-3), name


def test_the_generator_makes_hits_within_the_arms_limits() -> None:
    decoder = load_decoder()
    corners = torch.cartesian_prod(*[torch.tensor([-2.0, 0.0, 2.0])] * LATENT)
    motions = decoder(corners).double()
    assert motions.shape == (27, STEPS, 7)
    speeds = motions.diff(dim=1).abs().amax((0, 1)) / STEP
    assert (speeds < torch.tensor([110, 110, 128, 128, 204, 184, 184]) * np.pi / 180).all()
    model = model_of()
    limits = torch.from_numpy(model.jnt_range[:7])
    assert ((motions > limits[:, 0]) & (motions < limits[:, 1])).all()
    np.testing.assert_allclose(motions[:, 0], np.tile(HOME, (27, 1)), atol=0.02)


def test_a_generator_is_trained_from_hits(tmp_path: Path) -> None:
    hits = scripted_hits(6, seed=1)
    assert not torch.equal(hits, scripted_hits(6, seed=2))
    first, error = train_decoder(hits, epochs=200, seed=4)
    again, _ = train_decoder(hits, epochs=200, seed=4)
    z = torch.zeros(1, LATENT)
    torch.testing.assert_close(first(z), again(z), rtol=0, atol=0)
    assert error < 0.01
    save_file(first.state_dict(), str(tmp_path / "own.safetensors"))
    torch.testing.assert_close(load_decoder(tmp_path / "own.safetensors")(z), first(z), rtol=0, atol=0)


def test_an_action_is_a_whole_hit() -> None:
    """An environment's step is the same as its motion's targets, one after the other."""
    task = load_task("puck")
    assert isinstance(task, PuckTask)
    env = RandomizedEnv(task, 2, seed=1)
    before = env.reset()
    action = torch.tensor([[0.3, -1.0, 0.5], [-0.5, 0.2, 1.0]])
    start = env.states
    after = env.step(before.set("action", action))["next"]
    targets, data = task.controls(action.double()), mujoco.MjData(task.model)
    data.qpos[:], data.qvel[:] = np.split(start[1].numpy(), [14])
    for target in targets[1].numpy():
        data.ctrl[:] = target
        mujoco.mj_step(task.model, data, SIM.frame_skip)
    np.testing.assert_allclose(env.states[1], np.concatenate([data.qpos, data.qvel]), rtol=0, atol=1e-12)
    distance = np.linalg.norm(data.qpos[7:9] - TARGET)
    assert float(after["reward"][1]) == pytest.approx(-(distance**2) - np.log(distance + 1e-3), rel=1e-5)
    assert after["terminated"].all()
    assert distance < np.linalg.norm(start[1, 7:9].numpy() - TARGET)  # it has been hit


@pytest.mark.parametrize("arguments", [["--hits", "0"], ["--epochs", "-1"], ["--out", "nowhere/x.safetensors"]])
def test_a_generator_that_cannot_be_trained_is_refused(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        generator.main(arguments)
    assert stop.value.code == 2
    assert "error: " in capsys.readouterr().err
