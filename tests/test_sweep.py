"""Choosing ε: where the elbow lies, and a sweep that is interrupted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import Folder
from dropo_sims.hopper.record import record

from dropo_torch.commands.cli import main
from dropo_torch.errors import InputError
from dropo_torch.studies.sweep import SweepPoint, default_epsilons, elbow, epsilon_keys, likeliest, sweep_epsilon

EPSILONS = [1e-8, 1e-7, 1e-6, 1e-5, 1e-4]


@pytest.mark.parametrize(
    ("errors", "chosen", "words"),
    [
        ([9, 5, 2, 2, 2], 1e-6, "no larger value lowers it"),
        ([9, 5, 2.09, 2, 2], 1e-6, "no larger value lowers it"),  # within five percent
        ([9, 5, 2.2, 2, 2], 1e-5, "no larger value lowers it"),
        ([2, 2, 2, 3, 9], 1e-8, "or less"),
        ([9, 7, 5, 3, 1], 1e-4, "sweep further"),
        ([9, 5, 2, 3, 4], 1e-6, "no larger value lowers it"),  # too much ε worsens the fit again
        ([float("nan"), 5, 2, 2, float("inf")], 1e-6, "no larger value lowers it"),
        ([0, 0, 0, 0, 0], 1e-8, "or less"),
        ([9, 2.09, 3, 2, 2], 1e-5, "no larger value lowers it"),  # as small by chance, where σ covers the noise
    ],
)
def test_the_elbow_is_where_the_error_stops_falling(errors: list[float], chosen: float, words: str) -> None:
    found, reason = elbow(EPSILONS, errors)
    assert found == chosen
    assert words in reason


def test_there_is_no_elbow_without_a_finite_error() -> None:
    with pytest.raises(InputError, match="no fit"):
        elbow(EPSILONS, [float("nan")] * 5)


@pytest.mark.parametrize(
    ("values", "chosen", "words"),
    [
        ([1, 5, 9, 7, 2], 1e-6, "by 4 nats against 1e-07 and 2 against 1e-05"),
        ([9, 5, 4, 3, 2], 1e-8, "or less"),
        ([1, 2, 3, 4, 5], 1e-4, "sweep further"),
        ([float("nan"), 5, float("inf"), 4, 3], 1e-7, "likeliest"),
    ],
)
def test_the_noise_is_where_the_log_is_likeliest(values: list[float], chosen: float, words: str) -> None:
    found, reason = likeliest(EPSILONS, values)
    assert found == chosen
    assert words in reason


def test_no_noise_is_likeliest_where_no_fit_predicts_the_log() -> None:
    with pytest.raises(InputError, match="no fit"):
        likeliest(EPSILONS, [float("nan")] * 5)


def test_default_values_span_ten_decades_below_the_logs_variance() -> None:
    measured = np.random.default_rng(0).normal(0, 3, (500, 4))
    values = default_epsilons(measured)
    assert len(values) == 9
    assert 0.05 < values[-1] / 9 < 1
    np.testing.assert_allclose(np.diff(np.log10(values)), 1)
    assert all(v > 0 for v in default_epsilons(np.zeros((5, 2))))


def point_at(epsilon: float, threads: int = 0) -> SweepPoint:
    mse = max(1e-6, 1e-12 / epsilon)
    return SweepPoint(epsilon=epsilon, mse=mse, log_likelihood=-epsilon, mean={"m": 1 / 3}, std={"m": epsilon})


def test_an_interrupted_sweep_repeats_no_finished_fit(tmp_path: Path) -> None:
    whole = sweep_epsilon(point_at, EPSILONS)
    done: list[float] = []

    def interrupted(epsilon: float, threads: int) -> SweepPoint:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(epsilon)
        return point_at(epsilon)

    with pytest.raises(KeyboardInterrupt):
        sweep_epsilon(interrupted, EPSILONS, fingerprint="f", store=tmp_path / "store")
    later: list[float] = []
    resumed = sweep_epsilon(
        lambda e, threads: later.append(e) or point_at(e), EPSILONS, fingerprint="f", store=tmp_path / "store"
    )
    assert sorted(done + later) == EPSILONS
    assert resumed == whole


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"results": 3}', '{"fingerprint": "f", "results": {"1e-08": {"x": 1}}}']
)
def test_a_damaged_record_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "store").write_text(content)
    with pytest.raises(InputError, match="cannot be read as the record of a sweep"):
        sweep_epsilon(point_at, EPSILONS, fingerprint="f", store=tmp_path / "store")


def test_the_record_of_another_log_is_refused(tmp_path: Path) -> None:
    sweep_epsilon(point_at, EPSILONS, fingerprint="f", store=tmp_path / "store")
    with pytest.raises(InputError, match="another config or log"):
        sweep_epsilon(point_at, EPSILONS, fingerprint="g", store=tmp_path / "store")


@pytest.mark.parametrize("values", [[1, 2], [1, 1, 1], [-1, 1, 2], [0, 1, 2], [1, 2, float("nan")], []])
def test_three_positive_values_are_needed(values: list[float]) -> None:
    with pytest.raises(InputError, match="three or more positive"):
        sweep_epsilon(point_at, values)


def test_the_command_writes_what_it_chose_and_why(tmp_path: Path) -> None:
    config = Folder(tmp_path / "robot").config()
    out = tmp_path / "out"
    assert main(["sweep-epsilon", str(config), "--out", str(out), "--epsilons", "1e-4,1e-6,1e-5"]) == 0
    found = json.loads((out / "sweep.json").read_text())
    assert found["schema"] == "dropo-torch/sweep/1"
    assert [p["epsilon"] for p in found["points"]] == [1e-6, 1e-5, 1e-4]
    assert found["chosen"] == 1e-6  # the simulation explains this log
    assert {p.name for p in out.iterdir()} == {"sweep.json", "report.html", "sweep-progress.json"}
    assert main(["sweep-epsilon", str(config), "--out", str(out), "--epsilons", "[1e-6, 1e-5, 1e-4]", "--resume"]) == 0
    assert json.loads((out / "sweep.json").read_text()) == found


@pytest.mark.parametrize("variance", [1e-7, 1e-5])
def test_the_noise_of_every_measurement_is_found(variance: float, tmp_path: Path) -> None:
    """The elbow would find what noisy starts do to the ends instead."""
    log = record(steps=60)
    noise = variance**0.5 * np.random.default_rng(0).standard_normal((2, *log.observations.shape))
    moved = replace(log, observations=log.observations + noise[0], next_observations=log.next_observations + noise[1])
    moved.save(tmp_path / "log.npz")
    config = tmp_path / "config.yaml"
    config.write_text("{sim: hopper, data: log.npz, samples: 40, threads: 1}")
    epsilons = ",".join(f"{variance * 10.0**k:g}" for k in range(-2, 3))
    out = tmp_path / "out"
    command = ["sweep-epsilon", str(config), "--out", str(out), "--epsilons", epsilons, "--noisy-starts"]
    assert main(command) == 0
    found = json.loads((out / "sweep.json").read_text())
    assert found["noisy_starts"]
    assert found["chosen"] == pytest.approx(variance)
    assert found["use"] == {"noise": pytest.approx(variance**0.5), "epsilon": pytest.approx(1e-3 * variance)}
    assert f"noise: {variance**0.5}" in (out / "report.html").read_text()
    assert main([*command, "--resume"]) == 0
    assert json.loads((out / "sweep.json").read_text()) == found


def test_an_epsilon_of_each_column_is_swept_in_its_ratios(tmp_path: Path) -> None:
    assert epsilon_keys(1e-5, 1e-3) == {"epsilon": 1e-3}
    assert epsilon_keys([1e-6, 1e-4], 1e-3) == {"epsilon": [1e-4, 1e-2]}
    config = Folder(tmp_path / "robot").config(epsilon=[1e-6, 1e-6, 1e-4, 1e-4])
    out = tmp_path / "out"
    assert main(["sweep-epsilon", str(config), "--out", str(out), "--epsilons", "1e-4,1e-6,1e-5"]) == 0
    found = json.loads((out / "sweep.json").read_text())
    assert found["chosen"] == 1e-6
    assert found["use"] == {"epsilon": [1e-7, 1e-7, 1e-5, 1e-5]}


def test_what_is_to_be_used_says_that_it_is_scaled(tmp_path: Path) -> None:
    config = Folder(tmp_path / "robot").config(scaling=True)
    out = tmp_path / "out"
    command = ["sweep-epsilon", str(config), "--out", str(out), "--epsilons", "1e-8,1e-7,1e-6", "--noisy-starts"]
    assert main(command) == 0
    use = json.loads((out / "sweep.json").read_text())["use"]
    assert use["scaling"] is True
    assert len(set(use["noise"])) == 4  # one share of each column's variance


@pytest.mark.parametrize(
    "wrong",
    [["--epsilons", "1e-6,1e-5"], ["--parameters.idle", "{field: qpos_spring, name: shoulder, bounds: [-1, 1]}"]],
)
def test_a_sweep_that_is_refused_leaves_an_earlier_one_alone(wrong: list[str], tmp_path: Path) -> None:
    """Too few values; a parameter that moves nothing."""
    config = Folder(tmp_path / "robot").config()
    out = tmp_path / "out"
    out.mkdir()
    (out / "sweep.json").write_text("{}")
    assert main(["sweep-epsilon", str(config), "--out", str(out), *wrong]) == 2
    assert {p.name for p in out.iterdir()} == {"sweep.json"}


def test_a_given_noise_is_not_to_be_found(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config = Folder(tmp_path / "robot").config(noise=1e-3)
    assert main(["sweep-epsilon", str(config), "--out", str(tmp_path / "out"), "--noisy-starts"]) == 2
    assert "noise: 0.001 given, which --noisy-starts is to find" in capfd.readouterr().err
