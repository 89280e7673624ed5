"""Known values recovered from logs, by every way to fit; the file a fit writes; and exact resume."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import PARAMETERS, TRUTH, XML, Folder, record
from conftest import LinearSimulator, linear_objective, space_of

from dropo_torch.config import load_config
from dropo_torch.errors import InputError
from dropo_torch.fit import Fit, fit
from dropo_torch.objective import Objective
from dropo_torch.optimizers import FitSettings
from dropo_torch.problem import make_problem

DRIVER = Path(__file__).with_name("killed.py")
#: Keys of ``fit.json`` on which other programs rely.
CONTRACT = {
    "schema": str, "parameters": dict, "log_likelihood": float, "mse": float, "epsilon": (float, list), "backend": str,
    "optimizer": str, "evaluations": int, "simulated_transitions": int, "seconds": float, "seed": int,
    "stop_reason": str,
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return Folder(tmp_path_factory.mktemp("robot"))


@pytest.fixture
def fitted(folder: Folder) -> Callable[..., Fit]:
    def run(**changes: Any) -> Fit:
        config = load_config(folder.config(**changes))
        return fit(make_problem(config).objective, config.fit_settings())

    return run


def found(result: Fit) -> dict[str, float]:
    return {name: entry["mean"] for name, entry in result.distribution.summary().items()}


ADAPTED = {
    "backend": "gymnasium", "model": ..., "frame_skip": ..., "environment": "adapter.py:make", "samples": 5,
    "parameters": {name: {"bounds": entry["bounds"]} for name, entry in PARAMETERS.items()},
}  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"lag": 2},
        {"scaling": True},
        {"epsilon": [1e-6, 1e-5, 1e-4, 1e-3]},
        {"mask": ["elbow.velocity"]},
        {"parameters": {name: {**entry, "scale": "log"} for name, entry in PARAMETERS.items()}},
        {"observation": ["qpos", "qvel"], "trajectories": 1},
        ADAPTED,
        {**ADAPTED, "lag": 2},
    ],
    ids=["plain", "lag", "scaling", "epsilon", "mask", "log scale", "one episode", "adapter", "adapter, lag"],
)
def test_known_masses_are_recovered(changes: dict[str, Any], fitted: Callable[..., Fit]) -> None:
    result = fitted(**changes)
    assert found(result) == pytest.approx(TRUTH, rel=1e-3)
    assert all(entry["std"] < 0.01 for entry in result.distribution.summary().values())
    assert result.mse < 1e-8
    assert result.diverged == 0


def test_a_known_damping_over_decades_is_recovered(folder: Folder, fitted: Callable[..., Fit]) -> None:
    folder.log("damped.npz", **record(xml=XML.replace('damping=".1"', 'damping=".004"')))
    damping = {"field": "dof_damping", "name": "elbow", "bounds": [1e-4, 10], "scale": "log"}
    result = fitted(data="damped.npz", parameters={**PARAMETERS, "damping": damping})
    assert found(result) == pytest.approx({**TRUTH, "damping": 0.004}, rel=2e-3)


def test_masses_are_recovered_from_noisy_measurements_of_states_and_starts(
    folder: Folder, fitted: Callable[..., Fit]
) -> None:
    folder.log("noisy.npz", **record(steps=300, noise=1e-3))
    result = fitted(data="noisy.npz", noise=1e-3, epsilon=1e-8)
    assert found(result) == pytest.approx(TRUTH, rel=0.05)
    assert len({entry.stage for entry in result.history}) >= 2


def test_cma_and_fisher_find_the_same_distribution() -> None:
    rng = np.random.default_rng(3)
    gain = np.array([[2.0, 0.3], [-0.5, 1.0], [0.2, 0.8]])
    measured = rng.normal([1.2, 4.0], [0.15, 0.4], (50, 2)) @ gain.T

    def result(**options: Any) -> Fit:
        simulator = LinearSimulator(space_of(a=[0.0, 3.0], b=[1.0, 9.0]), gain)
        return fit(linear_objective(simulator, measured, epsilon=1e-2), FitSettings(samples=60, **options))

    ours, theirs = result(), result(optimizer="cma", budget=500, common_random_numbers=True)
    assert ours.log_likelihood > theirs.log_likelihood - 1.0
    np.testing.assert_allclose(theirs.distribution.mean, ours.distribution.mean, rtol=0.02)
    np.testing.assert_allclose(theirs.distribution.std, ours.distribution.std, rtol=0.15)
    assert ours.evaluations < theirs.evaluations / 10


@pytest.mark.parametrize("changes", [{}, {"optimizer": "cma", "budget": 24, "population": 6}], ids=["fisher", "cma"])
def test_threads_and_chunks_do_not_change_a_result(changes: dict[str, Any], fitted: Callable[..., Fit]) -> None:
    first = replace(fitted(threads=1, **changes), seconds=0.0).document()
    assert replace(fitted(threads=2, **changes), seconds=0.0).document() == first
    assert replace(fitted(threads=1, chunk_size=37, **changes), seconds=0.0).document() == first


def test_fit_json_has_the_keys_of_the_contract(fitted: Callable[..., Fit]) -> None:
    result = fitted(epsilon=[1e-6, 1e-5, 1e-4, 1e-3])
    document = json.loads(json.dumps(result.document(), allow_nan=False))
    for key, kind in CONTRACT.items():
        assert isinstance(document[key], kind), key
    assert document["schema"] == "dropo-torch/fit/1"
    assert document["epsilon"] == [1e-6, 1e-5, 1e-4, 1e-3]
    assert list(document["parameters"]) == list(PARAMETERS)
    for name, entry in document["parameters"].items():
        assert {"mean", "std", "low", "high", "unit"} <= set(entry)
        assert [entry["low"], entry["high"]] == PARAMETERS[name]["bounds"]
        assert entry["unit"] == "kg"
        assert entry["low"] <= entry["mean"] <= entry["high"]
    assert document["simulated_transitions"] >= 60 * document["evaluations"]


def test_a_fit_leaves_no_trace_in_its_objective() -> None:
    gain = np.array([[2.0, 0.3], [-0.5, 1.0], [0.2, 0.8]])
    measured = np.random.default_rng(3).normal([1.2, 4.0], [0.15, 0.4], (50, 2)) @ gain.T
    simulator = LinearSimulator(space_of(a=[0.0, 3.0], b=[1.0, 9.0]), gain)
    objective = linear_objective(simulator, measured, epsilon=1e-4, noise=0.1)
    documents = [fit(objective, FitSettings(samples=20)).document() for _ in range(2)]
    assert [d.pop("seconds") >= 0 for d in documents] == [True, True]
    assert documents[0] == documents[1]


def test_an_unknown_optimizer_is_refused() -> None:
    objective = linear_objective(LinearSimulator(space_of(a=[0.0, 3.0]), np.eye(1)), np.ones((9, 1)))
    with pytest.raises(InputError, match="did you mean 'fisher'"):
        fit(objective, FitSettings(optimizer="fischer"))


def killed_and_resumed(folder: Folder, config: Path, kills: int, seed: int) -> dict[str, Any]:
    """Run a fit whole, and again with kills; both results and what happened on the way."""
    command = [sys.executable, str(DRIVER), str(config), str(folder.path / f"out-{config.stem}"), str(kills), str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def noisy_fisher(folder: Folder) -> Path:
    """Several refits of the means around the noise of the initial states, then σ."""
    folder.log("noisy.npz", **record(steps=120, noise=1e-2))
    return folder.config(data="noisy.npz", noise=1e-2, epsilon=1e-6)


def small_cma(folder: Folder) -> Path:
    return folder.config(optimizer="cma", budget=72, population=6)


def check_resume(folder: Folder, config: Path, kills: int, seed: int) -> None:
    told = killed_and_resumed(folder, config, kills, seed)
    whole, pieced = told["whole"], told["pieced"]
    assert whole.pop("seconds") > 0
    pieced.pop("seconds")
    assert pieced == whole
    assert told["same_files"] == {"distribution.yaml": True, "model.xml": True, "fitted_config.yaml": True}
    assert told["same_history"]
    assert told["leftovers"] == []
    assert len(told["deaths"]) >= kills // 2
    assert told["resumed"] >= len(told["deaths"]) // 3
    for death in told["deaths"]:
        assert death["code"] == (-9 if death["signal"] == "SIGKILL" else 130)
        assert death["stderr"].count("\n") == (0 if death["signal"] == "SIGKILL" else 1)


@pytest.mark.parametrize("make", [noisy_fisher, small_cma])
def test_a_fit_killed_at_any_moment_resumes_to_the_same_result(make: Callable[[Folder], Path], folder: Folder) -> None:
    check_resume(folder, make(folder), kills=4, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("make", [noisy_fisher, small_cma])
def test_a_fit_killed_twenty_times_resumes_to_the_same_result(make: Callable[[Folder], Path], folder: Folder) -> None:
    check_resume(folder, make(folder), kills=20, seed=2)


def test_a_checkpoint_of_another_log_is_refused_without_a_fingerprint(tmp_path: Path) -> None:
    path, settings = tmp_path / "checkpoint.bin", FitSettings(samples=10)

    def objective(truth: float) -> Objective:
        return linear_objective(LinearSimulator(space_of(a=[0.0, 3.0]), np.eye(1)), np.full((20, 1), truth))

    fit(objective(1.2), settings, checkpoint=path)
    with pytest.raises(InputError, match="belongs to another config, model, log or method"):
        fit(objective(1.7), settings, checkpoint=path, resume=True)
    with pytest.raises(InputError, match="resume: there is no checkpoint to go on from"):
        fit(objective(1.2), settings, resume=True)
