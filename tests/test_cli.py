"""What a person types wrong, each a single line on stderr and exit code 2; and what stays of their files."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from arm import ADAPTER, CONFIG, PARAMETERS, XML, Folder, record

from dropo_torch.commands.cli import COMMANDS, main
from dropo_torch.commands.folder import claimed
from dropo_torch.config import KEYS

RESULTS = {"fit.json", "report.html", "distribution.yaml", "fitted_config.yaml", "model.xml", "checkpoint.bin"}
MASS = PARAMETERS["upper_mass"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return Folder(tmp_path_factory.mktemp("robot"))


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must fail with exit code 2 and one line; return the line."""

    def run(*arguments: object) -> str:
        code = main([str(a) for a in arguments])
        _, error = capfd.readouterr()
        assert code == 2, error
        assert error.startswith("dropo: ")
        assert error.count("\n") == 1
        assert error.endswith("\n")
        return error

    return run


def mass(**changes: Any) -> dict[str, Any]:
    """The config's ``parameters`` with the mass's entry changed."""
    return {"parameters": {"mass": {k: v for k, v in {**MASS, **changes}.items() if v is not ...}}}


WRONG_CONFIGS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "unknown key": ({"modle": "x"}, ("unknown key 'modle'", "did you mean 'model'")),
    "epsilon is text": ({"epsilon": "abc"}, ("epsilon is 'abc'", "expected a number or a list")),
    "epsilon is negative": ({"epsilon": -1}, ("epsilon: -1", "expected positive")),
    "epsilon is a flag": ({"epsilon": True}, ("epsilon is true", "variance")),
    "epsilon of another width": ({"epsilon": [1, 2]}, ("epsilon: 2 values", "shoulder.position")),
    "epsilon is NaN": ({"epsilon": float("nan")}, ("epsilon: nan", "expected positive")),
    "samples": ({"samples": -1}, ("samples is -1", "expected 2 or more")),
    "samples beyond memory": ({"samples": 10**12}, ("samples is 1000000000000", "or less")),
    "lag of zero": ({"lag": 0}, ("lag is 0", "expected 1 or more")),
    "lag is a word": ({"lag": "two"}, ("lag is 'two'", "expected a whole number")),
    "log too short for lag": ({"lag": 31}, ("log.npz: too short for lag 31", "at most 30")),
    "backend": ({"backend": "mujco"}, ("backend is 'mujco'", "did you mean 'mujoco'")),
    "optimizer": ({"optimizer": "fischer"}, ("optimizer is 'fischer'", "did you mean 'fisher'")),
    "frame_skip": ({"frame_skip": 1.5}, ("frame_skip is 1.5", "expected a whole number")),
    "no frame_skip": ({"frame_skip": ...}, ("no frame_skip", "0.01 s")),
    "frame_skip against dt": (
        {"frame_skip": 3, "data": {"path": "log.npz", "dt": 0.02}},
        ("frame_skip: 3 steps of 0.01 s", "every 0.02 s", "expected frame_skip 2"),
    ),
    "observation": ({"observation": ["shouldr.position"]}, ("no joint 'shouldr'", "did you mean 'shoulder'")),
    "observation of another width": ({"observation": ["qpos"]}, ("[qpos] has 2 columns and the log has 4",)),
    "mask": ({"mask": ["elbow.velocty"]}, ("elbow.velocty", "did you mean 'elbow.velocity'")),
    "everything masked": ({"mask": [0, 1, 2, 3]}, ("every column is masked; leave at least one column unmasked",)),
    "trajectories": ({"trajectories": 3}, ("trajectories: 3 asked for", "has 2")),
    "trajectory outside": ({"trajectories": [5]}, ("episode 5", "2 episodes")),
    "trajectory of text": ({"trajectories": [1.5]}, ("trajectories.0 is 1.5", "whole number")),
    "no parameters": ({"parameters": ...}, ("no parameters given", "bounds")),
    "parameters are a list": ({"parameters": [1]}, ("parameters is [1]", "expected keys and values")),
    "field": (mass(field="bodymass"), ("parameters.mass", "'bodymass'", "did you mean 'body_mass'")),
    "body": (mass(name="uper"), ("no body 'uper'", "did you mean 'upper'")),
    "joint": (mass(field="dof_damping", name="shouldr"), ("no joint 'shouldr'", "did you mean 'shoulder'")),
    "key of a parameter": (mass(bouns=[1, 2]), ("unknown key 'bouns'", "did you mean 'bounds'")),
    "bounds turned round": (mass(bounds=[3, 1]), ("bounds is [3, 1]", "the first must be below the second")),
    "bounds of one number": (mass(bounds=[1]), ("bounds is [1]", "expected [low, high]")),
    "bounds NaN": (mass(bounds=[float("nan"), 1]), ("bounds is [nan, 1]", "expected finite")),
    "no bounds": (mass(bounds=...), ("bounds is None", "expected [low, high]")),
    "mass of zero": (mass(bounds=[0, 1]), ("allow a mass that is not positive", "start above 0")),
    "two parameters of one number": (
        {"parameters": {"a": MASS, "b": MASS}},
        ("parameters.b: writes the same body_mass as 'a'",),
    ),
    "a parameter without effect": (
        {"parameters": {"grip": {"field": "geom_friction", "name": "upper", "bounds": [0.1, 2]}}},
        ("'grip' (geom_friction[0] of upper)", "leave it out"),
    ),
    "no model": ({"model": ...}, ("neither model nor sim", "model: robot.xml")),
    "model and sim": ({"sim": "hopper"}, ("both model and sim",)),
    "unknown sim": ({"model": ..., "sim": "hoper"}, ("'hoper'", "did you mean 'hopper'")),
    "model is missing": ({"model": "amr.xml"}, ("model: no file", "amr.xml")),
    "no data": ({"data": ...}, ("no data given", "log.npz")),
    "data is missing": ({"data": "lgo.npz"}, ("lgo.npz", "did you mean 'log.npz'")),
    "data of no known kind": ({"data": "arm.xml"}, ("unknown kind of log", ".npz")),
    "option of data": ({"data": {"path": "log.npz", "epsiode": 1}}, ("'epsiode'", "did you mean 'episode'")),
    "environment without backend": ({"environment": "adapter.py:make"}, ("backend: gymnasium",)),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_CONFIGS)
def test_a_wrong_entry_gives_one_line_that_says_what_is_right(
    name: str, folder: Folder, refused: Callable[..., str], tmp_path: Path
) -> None:
    changes, expected = WRONG_CONFIGS[name]
    line = refused("fit", folder.config(**changes), "--out", tmp_path)
    for words in expected:
        assert words in line
    assert not (tmp_path / "fit.json").exists()


WRONG_FILES = {
    "not YAML": (b"a: [1, 2", "no valid YAML"),
    "slice in a flow list": (b"observation: [qpos[1:], qvel]", "quote entries with brackets"),
    "a list": (b"- 1\n- 2", "holds no keys"),
    "empty": (b"", "holds no keys"),
    "not text": (b"\xff\xfe\x00", "cannot be read as text in UTF-8"),
    "a key twice": (b"samples: 3\nsamples: 4\n", "'samples' stands there twice"),
    "an entry in itself": (b"data: &a [*a]\nmodel: arm.xml", "contains itself"),
    "code": (b"model: !!python/object:os.system x", "no valid YAML"),
}


@pytest.mark.parametrize("name", WRONG_FILES)
def test_a_config_that_is_none_gives_one_line(name: str, refused: Callable[..., str], tmp_path: Path) -> None:
    content, expected = WRONG_FILES[name]
    path = tmp_path / "config.yaml"
    path.write_bytes(content)
    line = refused("fit", path, "--out", tmp_path / "out")
    assert expected in line
    assert "config.yaml" in line


@pytest.mark.parametrize("name", ["absent.yaml", ".", "x" * 300])
def test_a_config_that_cannot_be_opened_gives_one_line(name: str, refused: Callable[..., str], tmp_path: Path) -> None:
    assert name in refused("fit", tmp_path / name, "--out", tmp_path / "out") or name == "."


WRONG_LINES: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown command": ("fitt CONFIG --out OUT", ("unknown command 'fitt'", "did you mean 'fit'")),
    "option before the command": (
        "--foo fit CONFIG --out OUT",
        ("--foo", "demo, init, check, gap, fit, view, plan, train, sweep-epsilon, compare"),
    ),
    "no command": ("--foo", ("--foo", "demo, init, check, gap, fit, view, plan, train, sweep-epsilon, compare")),
    "no config": ("fit --out OUT", ("CONFIG", "usage: dropo fit")),
    "no folder": ("fit CONFIG", ("--out", "usage: dropo fit")),
    "folder without value": ("fit CONFIG --out", ("--out: expected one argument",)),
    "shortened option": ("fit CONFIG --ou OUT", ("--out",)),
    "unknown option": ("fit CONFIG --out OUT --epsilonn 1", ("--epsilonn", "did you mean 'epsilon'")),
    "option without value": ("fit CONFIG --out OUT --epsilon", ("--epsilon: no value given",)),
    "option without value before another": ("fit CONFIG --out OUT --epsilon --seed 3", ("--epsilon: no value given",)),
    "two configs": ("fit CONFIG CONFIG --out OUT", ("not understood",)),
    "negative seed": ("fit CONFIG --out OUT --seed -3", ("seed is -3", "0 or more")),
    "value that is no YAML": ("fit CONFIG --out OUT --mask [1", ("--mask: '[1' is no valid YAML",)),
    "nested key of nothing": ("fit CONFIG --out OUT --parameters.x.bounds [1,2]", ("no 'x' to change",)),
    "nested key of a value": ("fit CONFIG --out OUT --model.x 1", ("model is 'arm.xml', which has no keys",)),
    "log": ("fit CONFIG --out OUT --log tensorbord", ("--log", "expected tensorboard")),
    "epsilons of text": ("sweep-epsilon CONFIG --out OUT --epsilons a,b", ("--epsilons: 'a,b'", "1e-6,1e-5,1e-4")),
    "too few epsilons": ("sweep-epsilon CONFIG --out OUT --epsilons 1,2", ("three or more",)),
    "epsilons NaN": ("sweep-epsilon CONFIG --out OUT --epsilons 1e-6,nan,1", ("positive",)),
    "demo with an argument": ("demo x", ("'x'",)),
}


@pytest.mark.parametrize("name", WRONG_LINES)
def test_a_wrong_command_line_gives_one_line(
    name: str, folder: Folder, refused: Callable[..., str], tmp_path: Path
) -> None:
    text, expected = WRONG_LINES[name]
    config = str(folder.config())
    line = refused(*({"CONFIG": config, "OUT": str(tmp_path / "out")}.get(word, word) for word in text.split()))
    for words in expected:
        assert words in line


def test_a_log_with_a_value_that_is_not_finite_is_refused_by_row_and_column(
    folder: Folder, refused: Callable[..., str], tmp_path: Path
) -> None:
    for array, value in (("observations", np.nan), ("next_observations", np.inf), ("actions", -np.inf)):
        broken = record()[array].copy()
        broken[7, 1] = value
        data = folder.log("broken.npz", **{array: broken})
        line = refused("fit", folder.config(data=data), "--out", tmp_path)
        assert f"{array}[1] is {value} at row 7" in line
        assert "broken.npz" in line


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"actions": record()["actions"][:, :1]}, "1 action column, but the simulator has 2 actuators"),
        ({"actions": record()["actions"][:-1]}, "actions has 59 rows"),
        ({"observations": record()["observations"][:, :3]}, "next_observations has 4 columns and observations has 3"),
        ({"terminals": None}, "there is no 'terminals'"),
        ({"actions": None}, "there is no 'actions'"),
    ],
    ids=["narrow actions", "short actions", "narrow observations", "no terminals", "no actions"],
)
def test_a_log_of_the_wrong_shape_is_refused(
    changes: dict[str, Any], expected: str, folder: Folder, refused: Callable[..., str], tmp_path: Path
) -> None:
    data = folder.log("shape.npz", **changes)
    assert expected in refused("fit", folder.config(data=data), "--out", tmp_path)


def test_a_damaged_file_is_refused(folder: Folder, refused: Callable[..., str], tmp_path: Path) -> None:
    whole = (folder.path / "log.npz").read_bytes()
    for name, content in (("cut.npz", whole[:900]), ("none.npz", b""), ("text.npz", b"hello")):
        (folder.path / name).write_bytes(content)
        assert name in refused("fit", folder.config(data=name), "--out", tmp_path)
    for name, content in (("text.xml", "hello"), ("foo.xml", "<mujoco><foo/></mujoco>"), ("none.xml", "")):
        (folder.path / name).write_text(content)
        line = refused("fit", folder.config(model=name), "--out", tmp_path)
        assert f"MuJoCo does not compile {folder.path / name}" in line


ADAPTED = {"backend": "gymnasium", "model": ..., "frame_skip": ..., "parameters": {"upper_mass": {"bounds": [1, 2]}}}
ADAPTERS = {
    "no method": ("class A(Arm): step = None\ndef f(space): return A()", "has no method step"),
    "no width": ("class A(Arm): num_states = 'four'\ndef f(space): return A()", "num_states"),
    "no adapter": ("def f(space): return None", "has no method set_parameters"),
    "no argument": ("def f(): return Arm()", "takes 0 positional arguments"),
    "raises when made": ("def f(space): raise RuntimeError('no\\ndevice')", "RuntimeError: no device"),
    "raises in step": ("class A(Arm):\n def step(self, u): 1 / 0\ndef f(space): return A()", "ZeroDivisionError"),
    "raises in set_parameters": (
        "class A(Arm):\n def set_parameters(self, v): v['masss']\ndef f(space): return A()",
        "KeyError: 'masss'",
    ),
    "exits": ("import sys\nsys.exit(5)", "SystemExit: 5"),
    "step of the wrong shape": (
        "class A(Arm):\n def step(self, u): return [1, 2]\ndef f(space): return A()",
        "returns shape (2,); expected (4,)",
    ),
    "step of nothing": ("class A(Arm):\n def step(self, u): pass\ndef f(space): return A()", "returns None"),
    "no function": ("def g(space): return Arm()", "no function 'f' that makes an adapter"),
    "syntax": ("def (:", "SyntaxError"),
    "import": ("import nonexistent_package", "No module named 'nonexistent_package'"),
}


@pytest.mark.parametrize("name", ADAPTERS)
def test_an_adapter_that_fails_gives_one_line_that_says_where(
    name: str, folder: Folder, refused: Callable[..., str], tmp_path: Path
) -> None:
    code, expected = ADAPTERS[name]
    path = tmp_path / "mine.py"
    path.write_text(f"PATH = {str(folder.path / 'arm.xml')!r}\n{ADAPTER}\n{code}\n")
    config = folder.config(**ADAPTED, environment=f"{path}:f")
    line = refused("fit", config, "--out", tmp_path / "out")
    assert expected in line
    assert "mine.py" in line


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ("Hoper-v5", "Hopper"),
        ("Hopper-v99", "v5"),
        ("CartPole-v1", "this simulator has none"),
        ("absent.py:make", "no file"),
        ("adapter.py", "file.py:function"),
        ("no_such_module:make", "No module named 'no_such_module'"),
        (None, "file.py:function"),
    ],
)
def test_an_environment_that_is_none_gives_one_line(
    environment: str | None, expected: str, folder: Folder, refused: Callable[..., str], tmp_path: Path
) -> None:
    config = folder.config(backend="gymnasium", environment=environment, model=...)
    assert expected in refused("fit", config, "--out", tmp_path)


def test_a_folder_that_cannot_be_written_gives_one_line(
    folder: Folder, refused: Callable[..., str], tmp_path: Path
) -> None:
    config = folder.config()
    (tmp_path / "file").write_text("mine")
    assert "is a file; expected a folder" in refused("fit", config, "--out", tmp_path / "file")
    assert "cannot write to folder" in refused("fit", config, "--out", tmp_path / "file" / "x")
    assert "cannot write to folder" in refused("fit", config, "--out", tmp_path / ("x" * 300))
    assert "no folder given" in refused("fit", config, "--out", "")
    assert (tmp_path / "file").read_text() == "mine"


def test_two_runs_do_not_share_a_folder(folder: Folder, refused: Callable[..., str], tmp_path: Path) -> None:
    out = tmp_path / "runs" / "robot"
    first = start("fit", folder.config(optimizer="cma", budget=1_000_000, samples=100), "--out", out)
    try:
        deadline = time.monotonic() + 100
        while not (out / "checkpoint.bin").exists():
            assert first.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert f"another run is using {out}" in refused("fit", folder.config(), "--out", out, "--resume")
    finally:
        first.kill()
        first.communicate()
    assert main(["fit", str(folder.config()), "--out", str(out)]) == 0  # a lock ends with its process
    assert {p.name for p in out.iterdir()} == RESULTS | {"previous-1"}


def test_a_folder_that_cannot_be_locked_is_left_to_whoever_writes_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("filelock.lock_descriptor", lambda *_, **__: os.fstat(-1))  # as on NFS, a bad descriptor
    with claimed(tmp_path / "new" / "one"):
        assert (tmp_path / "new" / "one").is_dir()
    assert list(tmp_path.iterdir()) == []


#: What each command is refused for, before and after it has read what it is given; other commands take a config.
REFUSED = {
    "demo": ("demo --out OUT --epsilonn 1", "demo --out OUT --backend none"),
    "init": ("init none.xml none.csv --out OUT/robot.yaml", "init MODEL none.csv --out OUT/robot.yaml"),
    "view": ("view none --out OUT", "view WRONG --out OUT"),
    "reproduce": ("reproduce hoper --out OUT", "reproduce hopper --out OUT --workers ray"),
}
WITH_CONFIG = ("{} none.yaml --out OUT", "{} WRONG --out OUT")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_refused_command_leaves_no_folder(
    command: str, folder: Folder, refused: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    wrong = folder.config(data="absent.npz", **mass(name="nothing"))
    (tmp_path / "there").mkdir()
    for line in REFUSED.get(command, WITH_CONFIG):
        for out in ("there/new/one", "there"):
            words = {"MODEL": folder.path / "arm.xml", "WRONG": wrong, "OUT": tmp_path / out}
            text = line.format(command).replace("OUT/", f"{tmp_path / out}/")
            refused(*(words.get(word, word) for word in text.split()))
            assert [p.name for p in tmp_path.rglob("*")] == ["there"], line


def test_a_run_touches_nothing_of_the_users_in_its_folder(
    folder: Folder, refused: Callable[..., str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "model.xml").write_text(XML)
    np.savez(tmp_path / "log.npz", **record())
    (tmp_path / "notes.txt").write_text("mine")
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump({**CONFIG, "model": "model.xml"}))
    assert "model.xml" in refused("fit", path, "--out", tmp_path)
    assert "no result of an earlier run" in refused("fit", folder.config(), "--out", tmp_path)
    (tmp_path / "model.xml").rename(tmp_path / "arm.xml")
    for _ in range(2):
        assert main(["fit", str(path), "--out", str(tmp_path), "--model", "arm.xml"]) == 0
    capfd.readouterr()
    assert "this run" in refused("fit", path, "--out", tmp_path)  # by now model.xml is a result
    names = {p.name for p in tmp_path.iterdir()}
    assert names == RESULTS | {"arm.xml", "log.npz", "notes.txt", "config.yaml", "previous-1"}
    assert {p.name for p in (tmp_path / "previous-1").iterdir()} == RESULTS
    assert (tmp_path / "arm.xml").read_text() == XML


def test_an_interrupted_run_is_moved_aside_by_a_fresh_one(folder: Folder, tmp_path: Path) -> None:
    """The state of every search of a gap among what it left, whatever the search is called."""
    left = ("checkpoint.bin", "gap-progress.bin", "gap-progress-given.bin", "gap-progress-given-other.bin")
    for name in left:
        (tmp_path / name).write_bytes(b"hours of work")
    (tmp_path / "progress.bin").write_bytes(b"mine")
    assert main(["fit", str(folder.config()), "--out", str(tmp_path)]) == 0
    assert {p.name: p.read_bytes() for p in (tmp_path / "previous-1").iterdir()} == dict.fromkeys(
        left, b"hours of work"
    )
    assert (tmp_path / "progress.bin").read_bytes() == b"mine"


def test_the_config_of_a_result_gives_the_same_result_from_any_folder(folder: Folder, tmp_path: Path) -> None:
    config = folder.config(data={"path": "log.npz", "dt": 0.02})
    assert main(["fit", str(config), "--out", str(tmp_path / "a"), "--epsilon", "1e-4", "--seed=3"]) == 0
    assert main(["fit", str(tmp_path / "a" / "fitted_config.yaml"), "--out", str(tmp_path / "b")]) == 0
    first, second = (json.loads((tmp_path / x / "fit.json").read_text()) for x in "ab")
    assert first.pop("seconds") > 0
    second.pop("seconds")
    assert first == second
    assert first["epsilon"] == 1e-4
    assert first["seed"] == 3


def test_resume_refuses_what_is_no_checkpoint_of_this_fit(
    folder: Folder, refused: Callable[..., str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = str(folder.config())
    command = ["fit", config, "--out", str(tmp_path)]
    assert main([*command, "--resume"]) == 0  # nothing to resume: a fresh run
    assert main([*command, "--resume", "--chunk-size", "50"]) == 0  # finished already
    capfd.readouterr()
    assert "another config" in refused(*command, "--resume", "--seed", 5)
    assert "another config" in refused(*command, "--resume", "--optimizer", "cma")
    path = tmp_path / "checkpoint.bin"
    whole = path.read_bytes()
    for content in (whole[:100], whole[:-1], b"", b"hello", whole[:200] + b"9" + whole[201:]):
        path.write_bytes(content)
        line = refused(*command, "--resume")
        assert f"{path} is no checkpoint" in line
        assert path.read_bytes() == content


def test_options_are_read_as_yaml_and_reach_nested_keys(folder: Folder, tmp_path: Path) -> None:
    config = str(folder.config())
    options = [
        "--parameters.upper_mass.bounds", "[1, 2]", "--parameters.upper_mass.unit=lb", "--epsilon", "1e-3",
        "--observation", "[qpos, qvel]", "--mask", '["elbow.velocity"]',
        "--common-random-numbers", "yes", "--samples", '"21"',
    ]  # fmt: skip
    assert main(["fit", config, "--out", str(tmp_path), *options]) == 0
    found = json.loads((tmp_path / "fit.json").read_text())
    assert found["parameters"]["upper_mass"]["unit"] == "lb"
    assert found["parameters"]["upper_mass"]["high"] == 2
    assert found["epsilon"] == 1e-3
    assert found["samples"] == 21


def test_paths_may_hold_spaces_brackets_and_any_script(tmp_path: Path) -> None:
    folder = Folder(tmp_path / "dä r ü [x]")
    for old, new in (("arm.xml", "ärm x.xml"), ("log.npz", "lög [1].npz")):
        (folder.path / old).rename(folder.path / new)
    config = folder.config(model="ärm x.xml", data="lög [1].npz")
    out = tmp_path / "öut [bold] put"
    assert main(["fit", str(config), "--out", str(out)]) == 0
    assert {p.name for p in out.iterdir()} == RESULTS
    assert main(["fit", str(out / "fitted_config.yaml"), "--out", str(tmp_path / "again")]) == 0


def test_simulations_that_diverge_are_counted_and_a_lost_window_leaves_no_likelihood(
    folder: Folder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.py"
    breaks = "class A(Arm):\n def step(self, u): return super().step(u) * (np.nan if u[0] > 0.9 else 1)"
    path.write_text(f"PATH = {str(folder.path / 'arm.xml')!r}\n{ADAPTER}\n{breaks}\ndef f(space): return A()\n")
    config = folder.config(**ADAPTED, environment=f"{path}:f")
    assert main(["fit", str(config), "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "fit.json").read_text())
    lost = int((record()["actions"][:, 0] > 0.9).sum())
    assert found["diverged_simulations"] == 20 * lost > 0
    assert found["log_likelihood"] is None
    assert "diverged" in capsys.readouterr().out


def help_of(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_a_command_tells_the_keys_that_matter_to_it(capsys: pytest.CaptureFixture[str]) -> None:
    keys = {
        c: {k for k in KEYS if f"\n  --{k} " in help_of(c, capsys)} for c in ("check", "fit", "gap", "plan", "train")
    }
    assert keys["fit"] | keys["plan"] | keys["train"] == set(KEYS)
    assert keys["check"] == keys["gap"] == keys["fit"] & keys["train"]
    assert {"model", "data", "threads"} <= keys["check"]
    assert "epsilon" in keys["fit"] - keys["train"]
    assert "algorithm" in keys["train"] - keys["fit"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_begins_with_what_it_does_and_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(command, capsys)
    summary, (example, *_) = COMMANDS[command].summary, COMMANDS[command].examples
    assert text.startswith(f"usage: dropo {command}")
    assert 0 < text.index(summary[1:]) < text.index(f"\n  {example}\n") < text.index("\noptions:")


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("dropo_torch ")


def test_without_a_command_there_is_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    text = capsys.readouterr().out
    assert all(command in text for command in COMMANDS)


def test_the_demo_finds_four_masses_within_two_percent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from dropo_sims.hopper import SIM

    assert main(["demo", "--out", str(tmp_path)]) == 0
    assert {p.name for p in tmp_path.iterdir()} == RESULTS
    found = json.loads((tmp_path / "fit.json").read_text())["parameters"]
    assert {name: entry["mean"] for name, entry in found.items()} == pytest.approx(dict(SIM.truth), rel=0.02)
    assert capsys.readouterr().out.splitlines()[-1].strip()


def test_the_demo_takes_other_parameters(tmp_path: Path) -> None:
    knee = "{damping: {field: dof_damping, name: leg_joint, bounds: [0.1, 5]}}"
    assert main(["demo", "--out", str(tmp_path), "--parameters", knee, "--lag", "10", "--samples", "9"]) == 0


def start(*arguments: object, **options: Any) -> subprocess.Popen[str]:
    """A command of its own, which Ctrl-C reaches even where the tests run in the background."""
    command = [sys.executable, "-m", "dropo_torch", *map(str, arguments)]
    listen = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=listen, **options)


def test_a_reader_that_has_seen_enough_does_not_stop_a_fit(folder: Folder, tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    process = start("fit", folder.config(), "--out", tmp_path, stdout=write)
    os.close(write)
    error = process.communicate(timeout=120)[1]
    assert (process.returncode, error) == (0, "")
    assert {p.name for p in tmp_path.iterdir()} == RESULTS


def test_ctrl_c_ends_with_130_and_one_line(folder: Folder, tmp_path: Path) -> None:
    config = folder.config(optimizer="cma", budget=1_000_000, samples=100)
    process = start("fit", config, "--out", tmp_path, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 100
    while not (tmp_path / "checkpoint.bin").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert error == "dropo: interrupted; the same command with --resume continues from there\n"
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.bin"]


def test_resuming_is_offered_where_it_is_possible(
    folder: Folder, tmp_path: Path, refused: Callable, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    """``certify`` and ``check`` begin anew each time: they have no ``--resume``, and Ctrl-C advises none."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dropo_torch.problem.make_problem", interrupted)
    monkeypatch.setattr("dropo_torch.commands.fit.make_problem", interrupted, raising=False)
    for command in ("certify", "fit"):
        arguments = (command, str(folder.config()), "--out", str(tmp_path / command))
        assert main(arguments) == 130
        offered = capfd.readouterr().err == "dropo: interrupted; the same command with --resume continues from there\n"
        assert offered == (command == "fit")
    assert "resume" in refused("certify", folder.config(), "--out", tmp_path / "certify", "--resume")
