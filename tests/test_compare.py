"""Comparisons and certificates: what is recorded, what is kept, what is refused."""

import json
from pathlib import Path

import pytest

from dropo_torch.commands.cli import main
from dropo_torch.errors import InputError
from dropo_torch.studies.compare import METHODS, compare

CONFIG = "sim: hopper\ntrajectories: [0]\nsamples: 6\nbudget: 14\nadam: {steps: 4, samples: 4}\n"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "hopper.yaml"
    path.write_text(CONFIG)
    return path


def test_a_comparison_runs_every_method_on_one_log(config: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["compare", str(config), "--out", str(out), "--seeds", "1"]) == 0
    document = json.loads((out / "compare.json").read_text())
    assert document["schema"] == "dropo-torch/compare/1"
    runs = {run["method"]: run for run in document["runs"]}
    assert set(runs) == set(METHODS)
    assert runs["fisher-mujoco"]["to_permille"] <= runs["fisher-mujoco"]["simulated_transitions"]
    assert runs["cma-warp"]["to_permille"] is None  # fourteen evaluations find nothing
    assert runs["cma-warp"]["log_likelihood"] == pytest.approx(runs["cma-mujoco"]["log_likelihood"], rel=1e-3)
    assert runs["fisher-warp"]["mean"]["leg_mass"] == pytest.approx(document["reference"]["leg_mass"], rel=1e-4)
    page = (out / "report.html").read_text()
    assert all(method in page for method in METHODS)
    assert "http" not in page.replace("http://www.w3.org", "")


def test_an_interrupted_comparison_repeats_no_finished_run(config: Path, tmp_path: Path) -> None:
    out, methods = tmp_path / "out", "fisher-mujoco"
    assert main(["compare", str(config), "--out", str(out), "--methods", methods, "--seeds", "1"]) == 0
    first = json.loads((out / "compare.json").read_text())["runs"][0]
    again = [
        "compare",
        str(config),
        "--out",
        str(out),
        "--methods",
        "fisher-mujoco,adam-warp",
        "--seeds",
        "1",
        "--resume",
    ]
    assert main(again) == 0
    runs = json.loads((out / "compare.json").read_text())["runs"]
    assert runs[0] == first  # to the last digit of its seconds
    assert [run["method"] for run in runs] == ["fisher-mujoco", "adam-warp"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--methods", "adam-mujoco"], "unknown 'adam-mujoco'"),
        (["--methods", "fischer-warp"], "did you mean 'fisher-warp'"),
        (["--seeds", "0"], "expected a whole number, 1 or more"),
    ],
)
def test_what_cannot_be_compared_is_one_line(
    config: Path, tmp_path: Path, arguments: list[str], words: str, capsys: pytest.CaptureFixture
) -> None:
    assert main(["compare", str(config), "--out", str(tmp_path / "out"), *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_a_record_of_another_comparison_is_refused(tmp_path: Path) -> None:
    store = tmp_path / "store.json"
    store.write_text('{"fingerprint": "another", "results": {}}')
    with pytest.raises(InputError, match="belongs to another config or log"):
        compare(lambda *_: None, methods=["fisher-warp"], seeds=[0], reference=None, store=store)  # type: ignore[arg-type]
    store.write_text("not json")
    with pytest.raises(InputError, match="cannot be read as the record of a comparison"):
        compare(lambda *_: None, methods=["fisher-warp"], seeds=[0], reference=None, store=store)  # type: ignore[arg-type]


def test_the_certificate_of_the_hopper_is_exact(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    assert main(["certify", str(config), "--out", str(out)]) == 0
    document = json.loads((out / "certificate.json").read_text())
    assert document["schema"] == "dropo-torch/certificate/1"
    assert {p["verdict"] for p in document["parameters"]} == {"exact"}
    assert document["state_error"] < 1e-10
    assert "exact" in capsys.readouterr().out


def test_a_model_outside_the_subset_names_what_is_outside(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    parameters = "{step: {field: opt.timestep, bounds: [0.001, 0.004]}}"
    assert main(["certify", str(config), "--out", str(tmp_path / "out"), "--parameters", parameters]) == 2
    assert "gradients of opt.timestep" in capsys.readouterr().err
