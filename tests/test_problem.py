"""From a config to a problem: what is taken from where, and what must agree with what."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from arm import DT, PARAMETERS, XML, Folder, record

from dropo_torch.config import load_config
from dropo_torch.data.readers import read_trajectories
from dropo_torch.errors import InputError
from dropo_torch.problem import Problem, make_problem

COLUMNS = ["shoulder", "elbow", "shoulder_speed", "elbow_speed"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return Folder(tmp_path_factory.mktemp("robot"))


@pytest.fixture
def problem(folder: Folder) -> Callable[..., Problem]:
    return lambda **changes: make_problem(load_config(folder.config(**changes)))


def table(folder: Folder, name: str, step: float = DT) -> dict[str, Any]:
    """The log as a CSV with time stamps, and how a config reads it."""
    log = record()
    frame = pd.DataFrame(log["observations"], columns=COLUMNS)
    frame[["lift", "bend"]] = log["actions"]
    frame["t"] = step * np.arange(len(frame))
    frame.to_csv(folder.path / name, index=False)
    return {"path": name, "observations": COLUMNS, "actions": ["lift", "bend"], "time": "t"}


def test_frame_skip_follows_from_the_logs_time_stamps(folder: Folder, problem: Callable[..., Problem]) -> None:
    data = table(folder, "stamped.csv")
    assert problem(data=data, frame_skip=...).simulator.frame_skip == 2
    assert problem(data=data, frame_skip=2).simulator.timestep == pytest.approx(DT)
    with pytest.raises(InputError, match="expected frame_skip 2"):
        problem(data=data, frame_skip=5)


def test_time_stamps_that_are_no_multiple_of_the_models_step_are_refused(
    folder: Folder, problem: Callable[..., Problem]
) -> None:
    data = table(folder, "odd.csv", step=0.0154)
    with pytest.raises(InputError, match=r"sampled every 0\.0154 s.*no whole number of the model's steps of 0\.01 s"):
        problem(data=data, frame_skip=...)
    with pytest.raises(InputError, match="resample the log"):
        problem(data=data)


def test_time_stamps_in_milliseconds_are_asked_about_not_believed(
    folder: Folder, problem: Callable[..., Problem]
) -> None:
    data = table(folder, "milliseconds.csv", step=1000 * DT)
    with pytest.raises(InputError, match=r"are they in seconds.*scale: 1e-3"):
        problem(data=data, frame_skip=...)
    with pytest.raises(InputError, match=r"not in seconds.*scale: 1e-3"):
        problem(data=data, frame_skip=2)
    right = {**data, "time": {"signal": data["time"], "scale": 1e-3}}
    assert problem(data=right, frame_skip=...).simulator.frame_skip == 2


def test_preprocessing_resamples_to_the_simulators_step(folder: Folder, problem: Callable[..., Problem]) -> None:
    data = {**table(folder, "fast.csv", step=0.0154), "observations": COLUMNS[:2], "preprocess": {}}
    found = problem(data=data)
    assert found.trajectories.dt == pytest.approx(DT)
    assert len(found.trajectories) == pytest.approx(60 * 0.0154 / DT, abs=2)


def test_a_sim_brings_model_log_columns_and_parameters(problem: Callable[..., Problem]) -> None:
    found = problem(model=..., data=..., frame_skip=..., parameters=..., sim="hopper")
    assert found.space.names == ("torso_mass", "thigh_mass", "leg_mass", "foot_mass")
    assert len(found.trajectories) == 200
    assert found.simulator.timestep == pytest.approx(0.008)
    assert found.observation.size == 11


def test_a_sim_may_run_on_an_environment_of_its_own_kind(problem: Callable[..., Problem]) -> None:
    bare = {"model": ..., "data": ..., "frame_skip": ..., "parameters": ..., "sim": "hopper"}
    ours = problem(**bare)
    theirs = problem(**bare, backend="gymnasium", environment="Hopper-v5")
    values = np.array([[3.0, 4.0, 2.5, 5.0]])
    expected = ours.objective.simulated(values)
    torch.testing.assert_close(theirs.objective.simulated(values), expected, rtol=1e-9, atol=1e-9)


def test_the_adapter_of_a_user_simulates_what_the_model_does(problem: Callable[..., Problem]) -> None:
    ours = problem(parameters=PARAMETERS)
    bounds = {name: {"bounds": entry["bounds"]} for name, entry in PARAMETERS.items()}
    theirs = problem(model=..., frame_skip=..., backend="gymnasium", environment="adapter.py:make", parameters=bounds)
    values = np.array([[1.0, 0.4], [2.0, 0.9]])
    torch.testing.assert_close(theirs.objective.simulated(values), ours.objective.simulated(values))


def test_an_adapter_may_import_what_lies_beside_it(folder: Folder, problem: Callable[..., Problem]) -> None:
    (folder.path / "beside_the_adapter.py").write_text("SIDES = 4\n")
    code = (folder.path / "adapter.py").read_text()
    (folder.path / "importing.py").write_text("from beside_the_adapter import SIDES\n" + code)
    found = problem(
        model=..., frame_skip=..., backend="gymnasium", environment="importing.py:make",
        parameters={"upper_mass": {"bounds": [1, 2]}},
    )  # fmt: skip
    assert found.simulator.num_states == 4


def test_some_of_a_logs_episodes_may_be_chosen(problem: Callable[..., Problem]) -> None:
    log = record()
    np.testing.assert_array_equal(problem(trajectories=1).trajectories.actions, log["actions"][:30])
    np.testing.assert_array_equal(problem(trajectories=[1]).trajectories.actions, log["actions"][30:])
    assert problem(trajectories=2).trajectories.num_episodes == 2


def test_a_run_is_identified_by_config_model_log_and_adapter(folder: Folder, problem: Callable[..., Problem]) -> None:
    own = problem().fingerprint
    assert problem(threads=2, chunk_size=7).fingerprint == own
    changed = record()["observations"] + 1e-12
    (folder.path / "other.xml").write_text(XML.replace('damping=".3"', 'damping=".31"'))
    seen = {own, problem(seed=1).fingerprint, problem(data=folder.log("other.npz", observations=changed)).fingerprint}
    (folder.path / "copy.xml").write_text(XML)
    seen.add(problem(model="other.xml").fingerprint)
    adapted = {
        "model": ..., "frame_skip": ..., "backend": "gymnasium", "environment": "changing.py:make",
        "parameters": {"upper_mass": {"bounds": [1, 2]}},
    }  # fmt: skip
    code = (folder.path / "adapter.py").read_text()
    for line in ("", "# changed"):
        (folder.path / "changing.py").write_text(f"{code}\n{line}\n")
        seen.add(problem(**adapted).fingerprint)
    assert len(seen) == 6


def test_a_problem_reads_a_log_of_any_folder(folder: Folder, problem: Callable[..., Problem], tmp_path: Path) -> None:
    np.savez(tmp_path / "elsewhere.npz", **record())
    assert len(problem(data=str(tmp_path / "elsewhere.npz")).trajectories) == 60


def test_a_log_in_memory_stands_for_the_configs(folder: Folder) -> None:
    """The same log from a file and from memory is the same problem; episodes are chosen of either."""
    made = record()
    arrays = {name: made[name] for name in ("observations", "next_observations", "actions", "terminals")}
    config = load_config(folder.config())
    from_file, from_memory = make_problem(config), make_problem(config, log=read_trajectories(arrays))
    assert from_memory.fingerprint == from_file.fingerprint
    assert len(from_memory.objective) == len(from_file.objective)
    without = load_config(folder.config(data=None, trajectories=1))
    assert make_problem(without, log=read_trajectories(arrays)).trajectories.num_episodes == 1
