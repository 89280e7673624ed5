"""The bundled arms that manipulate: logs that are what they say, and one physics on both backends."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import dropo_sims.puck.record
import dropo_sims.push.record
import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.data.readers import read_trajectories
from dropo_torch.errors import InputError
from dropo_torch.models.bundled import BundledSim, bundled_sim
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators import make_simulator
from dropo_torch.testing import converged

#: The recorders, and the command that recorded the bundled log.
RECORDERS = {
    "push": (dropo_sims.push.record, ["--seed", "1"]),
    "puck": (dropo_sims.puck.record, ["--seed", "1", "--episodes", "2", "--steps", "400"]),
}
each = pytest.mark.parametrize("name", RECORDERS)


def recorder(name: str) -> tuple[ModuleType, BundledSim]:
    return RECORDERS[name][0], bundled_sim(name)


@each
def test_it_is_found_by_name_and_its_truth_is_not_the_model(name: str) -> None:
    module, sim = recorder(name)
    assert sim is module.SIM
    assert set(sim.truth) == set(sim.parameters)
    space = ParameterSpace(sim.model, sim.parameters)
    for parameter in space.names:
        low, high = sim.parameters[parameter]["bounds"]
        assert low < sim.truth[parameter] < high
    assert space.named(space.nominal) != sim.truth


@each
@pytest.mark.parametrize("variant", ["point", "noisy", "distribution"])
def test_a_seed_decides_a_log(name: str, variant: str) -> None:
    record = recorder(name)[0].record
    first, again, other = (record(variant=variant, episodes=2, steps=15, seed=seed) for seed in (5, 5, 6))
    for column in ("observations", "next_observations", "actions", "terminals", "parameters"):
        np.testing.assert_array_equal(getattr(first, column), getattr(again, column))
    drawn = "parameters" if variant == "distribution" else "observations"
    assert variant == "point" or not np.array_equal(getattr(first, drawn), getattr(other, drawn))
    assert first.observations.shape == (30, 27)
    assert np.flatnonzero(first.terminals).tolist() == [14, 29]


@each
def test_each_transition_is_one_of_the_recorded_robot(name: str) -> None:
    module, sim = recorder(name)
    log = module.record(episodes=1, steps=30, truth=sim.truth)
    space = ParameterSpace(sim.model, sim.parameters)
    model = space.apply(sim.truth)
    np.testing.assert_array_equal(log.observations[1:], log.next_observations[:-1])
    for before, action, after in zip(log.observations, log.actions, log.next_observations, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = before[:14], before[14:], action
        mujoco.mj_step(model, data, sim.frame_skip)
        np.testing.assert_allclose(np.concatenate([data.qpos, data.qvel]), after, rtol=1e-9, atol=1e-9)


@each
def test_noise_and_parameters_spread_as_they_say(name: str) -> None:
    module, sim = recorder(name)
    clean, noisy = (module.record(variant=variant, episodes=3, steps=100, seed=2) for variant in ("point", "noisy"))
    noise = (noisy.observations - clean.observations).std(0)
    np.testing.assert_allclose(noise[:10], module.NOISE[0], rtol=0.3)
    np.testing.assert_allclose(noise[14:], module.NOISE[1], rtol=0.3)
    np.testing.assert_allclose(np.linalg.norm(noisy.observations[:, 10:14], axis=1), 1, atol=1e-12)
    drawn = module.record(variant="distribution", episodes=80, steps=1, truth={"mass": 0.14}).parameters
    spread = [module.SPREAD.get(parameter, 0.0) for parameter in sim.parameters]
    bounds = np.array([sim.parameters[parameter]["bounds"] for parameter in sim.parameters])
    free = np.array(spread) < 0.2 * (bounds[:, 1] - bounds[:, 0]) / 2  # not cut by their bounds
    np.testing.assert_allclose(drawn.std(0)[free], np.array(spread)[free], rtol=0.25, atol=1e-12)
    assert ((drawn > bounds[:, 0]) & (drawn < bounds[:, 1])).all()


@each
def test_the_bundled_log_is_what_the_documented_command_records(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (module, sim), path = recorder(name), tmp_path / "log"
    module.main([str(path), "--robot", *RECORDERS[name][1]])
    with np.load(path) as ours, np.load(sim.log) as bundled:
        assert set(ours.files) == set(bundled.files)
        count = len(bundled["actions"])
        for column in ours.files:
            np.testing.assert_allclose(ours[column], bundled[column], rtol=1e-6, atol=1e-6)
    assert capsys.readouterr().out == f"{count} transitions in {path}\n"
    assert len(read_trajectories(sim.log)) == count


@each
def test_both_backends_simulate_the_same(name: str) -> None:
    pytest.importorskip("warp")
    sim = bundled_sim(name)
    log = read_trajectories(sim.log)
    chosen = np.linspace(0, len(log) - 1, 150).astype(int)
    states, after = (torch.from_numpy(x[chosen]) for x in (log.observations, log.next_observations))
    values = torch.tensor([[sim.truth[parameter] for parameter in sim.parameters]], dtype=torch.float64)
    rows = states, torch.from_numpy(log.actions[chosen])[:, None], values
    space = converged(ParameterSpace(sim.model, sim.parameters))
    ours, theirs = (
        make_simulator(backend, space.model, parameters=space, frame_skip=sim.frame_skip).simulate(*rows)
        for backend in ("warp", "mujoco")
    )
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)
    np.testing.assert_allclose(theirs[:, 0], after, rtol=0, atol=1e-5)  # as the model has it


@each
def test_recording_refuses_what_cannot_be(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    module, _ = recorder(name)
    with pytest.raises(InputError, match="variant"):
        module.record(variant="nosy")
    with pytest.raises(InputError, match="episodes 0"):
        module.record(episodes=0)
    with pytest.raises(InputError, match="did you mean 'friction_x'"):
        module.record(truth={"frictionx": 1.0})
    for arguments in (["x.npz", "--steps", "0"], [str(tmp_path)], ["x.npz", "--variant", "nosy"]):
        with pytest.raises(SystemExit) as stop:
            module.main(arguments)
        assert stop.value.code == 2
        assert "Traceback" not in capsys.readouterr().err
