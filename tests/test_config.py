"""Laws of the config: numbers as people write them, overrides, paths, and what identifies a run."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from dropo_torch.config import KEYS, Config, load_config, make_config, parse_overrides
from dropo_torch.data.trajectory import Trajectories, concatenate
from dropo_torch.errors import InputError
from dropo_torch.logged import used


@pytest.mark.parametrize("text", ["1e-5", "1E-5", "1.0e-5", "1.e-05", "+1e-5", ".1e-4", "0.00001", "1e-5 # small"])
def test_a_number_is_one_however_it_is_written(text: str, tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(f"epsilon: {text}")
    assert load_config(path).epsilon == pytest.approx(1e-5, rel=1e-12)


@pytest.mark.parametrize("text", ["e5", "1e", "v1.2", "1-2", "0x"])
def test_what_is_no_number_stays_text(text: str) -> None:
    assert parse_overrides(["--data", text])["data"] == text


def test_every_key_can_be_overridden_in_both_forms() -> None:
    for key in KEYS:
        dashed = key.replace("_", "-")
        expected = {key: [1, "a"]}
        assert parse_overrides([f"--{key}", "[1, a]"]) == expected
        assert parse_overrides([f"--{dashed}=[1, a]"]) == expected


def test_the_last_of_several_overrides_counts() -> None:
    assert parse_overrides(["--seed", "1", "--seed=2"]) == {"seed": 2}


def test_an_override_leaves_the_callers_document_alone() -> None:
    document = {"parameters": {"a": {"bounds": [1, 2]}}, "data": {"path": "x"}}
    config = make_config(document, {"parameters.a.bounds": [3, 4], "data.dt": 0.1, "seed": 7})
    assert config.parameters == {"a": {"bounds": [3, 4]}}
    assert config.data == {"path": "x", "dt": 0.1}
    assert config.seed == 7
    assert document == {"parameters": {"a": {"bounds": [1, 2]}}, "data": {"path": "x"}}


def test_a_document_read_back_is_the_same_config() -> None:
    config = make_config({"model": "a.xml", "data": ["x", {"path": "y"}], "noise": [1e-3, 0.0], "mask": ["q", 1]})
    assert make_config(yaml.safe_load(yaml.safe_dump(config.document()))) == config


def test_paths_start_from_the_config_or_are_absolute(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("model: robot.xml")
    config = load_config(path)
    assert config.path("robot.xml") == tmp_path / "robot.xml"
    assert config.path("/robot.xml") == Path("/robot.xml")
    assert config.path("~/robot.xml") == Path.home() / "robot.xml"


def test_a_portable_document_names_the_same_files_from_anywhere(tmp_path: Path) -> None:
    document = {
        "model": "robot.xml", "environment": "adapter.py:make",
        "data": ["a.npz", {"path": "b.csv", "time": "t"}, "minari:x/y-v0"],
    }  # fmt: skip
    found = make_config(document, base=tmp_path).portable()
    assert found["model"] == str(tmp_path / "robot.xml")
    assert found["environment"] == f"{tmp_path / 'adapter.py'}:make"
    assert found["data"] == [str(tmp_path / "a.npz"), {"path": str(tmp_path / "b.csv"), "time": "t"}, "minari:x/y-v0"]
    assert make_config({"environment": "Hopper-v5"}).portable()["environment"] == "Hopper-v5"


def test_only_what_decides_the_result_identifies_a_run() -> None:
    own = make_config({"seed": 1}).fingerprint()
    assert make_config({"seed": 1, "threads": 3, "chunk_size": 7}).fingerprint() == own
    others = [{"seed": 2}, {"epsilon": 1e-4}, {"lag": 2}, {"optimizer": "cma"}, {"mask": ["q"]}, {"samples": 7}]
    assert len({make_config({"seed": 1, **other}).fingerprint() for other in others} | {own}) == len(others) + 1


@pytest.mark.parametrize("value", ["abc", {"a": 1}, None, [[1]], ["x"]])
def test_an_error_names_the_key_and_never_the_validators_types(value: object) -> None:
    with pytest.raises(InputError, match=r"^here: epsilon") as error:
        make_config({"epsilon": value}, source="here")
    assert "float" not in str(error.value).split("is", 1)[0]


def test_whole_numbers_may_be_written_as_powers_of_ten() -> None:
    assert make_config({"budget": 1e4}).budget == 10_000


def test_a_config_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Config().seed = 3
    assert math.isclose(Config().epsilon, 1e-5)


def test_an_input_error_is_one_line() -> None:
    assert str(InputError("a\n  b\t c ")) == "a b c"


@pytest.mark.parametrize(
    ("spans", "left", "episodes"),
    [([], 20, 2), ([(0, 0.2, 0.5)], 17, 3), ([(0, 0.25, 0.45)], 17, 3), ([(1, 0.0, 0.3), (1, 0.9, 9.0)], 16, 2)],
)
def test_spans_that_are_left_out_end_episodes(spans: list[tuple[int, float, float]], left: int, episodes: int) -> None:
    """Transitions that begin or end within a span are not used; those beside it are."""
    log = concatenate([Trajectories.of_samples(r := np.arange(11.0)[:, None], r[:-1], dt=0.1, source="log")] * 2)
    config = make_config({"model": "m.xml", "leave_out": spans})
    found = used(config, log)
    assert (len(found), found.num_episodes) == (left, episodes)
    assert set(found.observations.ravel()) <= set(range(10))
    if spans == [(0, 0.2, 0.5)]:
        assert found.observations.ravel().tolist() == [0, 1, 5, 6, 7, 8, 9, *range(10)]


@pytest.mark.parametrize(
    ("spans", "words"),
    [
        ([(2, 0.0, 1.0)], r"\[2, 0, 1\] is no span of log.*: episode 2 is none of 2"),
        ([(0, 1.2, 1.4)], r"\[0, 1.2, 1.4\] is no span of log.*: episode 0 lasts 1 s"),
        ([(0, 0.4, 0.4)], "no span"),
        ([(0, 0.0, 2.0), (1, 0.0, 2.0)], "nothing of log.* is left"),
    ],
)
def test_spans_that_a_log_does_not_have_are_refused(spans: list[tuple[int, float, float]], words: str) -> None:
    log = concatenate([Trajectories.of_samples(r := np.arange(11.0)[:, None], r[:-1], dt=0.1, source="log")] * 2)
    with pytest.raises(InputError, match=f"leave_out: .*{words}"):
        used(make_config({"model": "m.xml", "leave_out": spans}), log)
