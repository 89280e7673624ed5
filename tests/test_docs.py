"""The documentation is run: its configs, Python, commands, links and examples."""

from __future__ import annotations

import importlib.util
import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import bags
import h5py
import mujoco
import numpy as np
import pandas as pd
import pytest
import scipy.io
import torch
import yaml
from dropo_sims.push.guided import record_guided, write_model

import dropo_torch as dropo
from benchmarks.sensed_logs import PENDULUM
from dropo_torch.commands import cli
from dropo_torch.config import make_config, parse_overrides
from dropo_torch.data.readers import read_trajectories
from dropo_torch.fit import refuse_dead_parameters
from dropo_torch.problem import make_problem
from dropo_torch.rl.policy import Policy
from dropo_torch.rl.task import load_task
from dropo_torch.support.yaml_text import load_yaml

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
API = ROOT / "docs" / "api.md"
ROWS = 120

#: The robot that the pages speak of: a two-joint arm whose fingers slide over the floor.
ROBOT_XML = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body name="upper_arm" pos="0 0 .22">
      <joint name="shoulder" axis="0 0 1" damping=".3"/>
      <geom name="upper_arm" type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
      <body name="forearm" pos=".3 0 0">
        <joint name="elbow" axis="0 1 0" damping=".2"/>
        <geom name="forearm" type="capsule" fromto="0 0 0 .2 0 -.15" size=".02" mass=".8"/>
        <body name="hand" pos=".2 0 -.2">
          <geom name="left_finger" type="sphere" pos="0 .03 0" size=".02" mass=".1" friction=".8"/>
          <geom name="right_finger" type="sphere" pos="0 -.03 0" size=".02" mass=".1" friction=".8"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder_servo" joint="shoulder" kp="20" kv="1"/>
    <position name="elbow_servo" joint="elbow" kp="20" kv="1"/>
  </actuator>
</mujoco>"""

BASE: dict[str, Any] = {
    "model": "robot.xml",
    "data": "log.npz",
    "frame_skip": 5,
    "parameters": {"forearm_mass": {"field": "body_mass", "name": "forearm", "bounds": [0.5, 3.0]}},
    "threads": 1,
}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def every(language: str) -> list[Any]:
    numbered = ((page, i, text) for page in PAGES for i, text in enumerate(blocks(page, language)))
    return [pytest.param(page, text, id=f"{page.stem}-{i}") for page, i, text in numbered]


def commands() -> list[str]:
    """Every ``dropo ...`` of the pages, in code blocks and in sentences."""
    found = []
    for page in PAGES:
        text = page.read_text()
        lines = [line.split("#")[0].strip() for block in blocks(page, "sh") for line in block.splitlines()]
        inline = re.findall(r"(?<!`)`(dropo [^`]+)`(?!`)", text)
        found += [line for line in lines if line.startswith("dropo ")] + [c for c in inline if "..." not in c]
    return sorted(set(found))


def load_example(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_every_benchmark_begins(
    path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With all that it imports; one that is a program says how it is used."""
    monkeypatch.syspath_prepend(str(path.parent))  # as Python does for a program
    program = load_example(path)
    if hasattr(program, "main"):
        monkeypatch.setattr(sys, "argv", [path.name, "--help"])
        with pytest.raises(SystemExit) as ended:
            program.main()
        assert ended.value.code == 0
        assert "usage:" in capsys.readouterr().out


def test_programs_that_pages_name_are_there() -> None:
    program = re.compile(r"python ((?:benchmarks|examples)/[\w./-]+\.py)")
    named = {name for page in PAGES for name in program.findall(page.read_text())}
    assert len(named) > 20
    assert sorted(name for name in named if not (ROOT / name).is_file()) == []


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the model and with its log in every format that the pages name."""
    folder = tmp_path_factory.mktemp("robot")
    (folder / "robot.xml").write_text(ROBOT_XML)
    time = 0.01 * np.arange(ROWS)
    controls = np.stack([0.8 * np.sin(9 * time), 0.25 * np.sin(14 * time) - 0.1], 1)
    model = mujoco.MjModel.from_xml_string(ROBOT_XML)
    data = mujoco.MjData(model)
    states = []
    for u in controls:
        states.append(np.concatenate([data.qpos, data.qvel]))
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=5)
    write_logs(folder, time, np.array(states), controls)
    shutil.copy(ROOT / "sims" / "hopper" / "log.npz", folder / "hopper.npz")
    record_guided(steps=400).save(folder / "guided.npz")
    write_model(folder / "guided.xml")
    (folder / "cart.py").write_text(blocks(ROOT / "docs" / "adapters.md", "python")[0])
    (folder / "robot.yaml").write_text(blocks(ROOT / "docs" / "config.md", "yaml")[0])
    (folder / "out" / "policy").mkdir(parents=True)
    network = {"num_observations": 4, "num_actions": 2, "hidden": [4], "head": "tanh", "activation": "relu"}
    Policy(network).save(folder / "out" / "policy" / "policy.pt")
    return folder


def write_logs(folder: Path, time: np.ndarray, states: np.ndarray, controls: np.ndarray) -> None:
    ends = np.arange(len(time) - 1) == len(time) - 2
    arrays = {
        "observations": states[:-1], "next_observations": states[1:], "actions": controls[:-1], "terminals": ends,
    }  # fmt: skip
    (folder / "runs").mkdir()
    (folder / "log_folder").mkdir()
    for path in ("log.npz", "runs/1.npz"):
        np.savez(folder / path, **arrays)
    for name, array in arrays.items():
        np.save(folder / "log_folder" / f"x_{name.replace('_', '')}.npy", array)
    with h5py.File(folder / "d4rl.hdf5", "w") as file:
        for name in ("observations", "actions", "terminals"):
            file[name] = arrays[name]
    with h5py.File(folder / "robomimic.hdf5", "w") as file:
        for demo in range(2):
            group = file.create_group(f"data/demo_{demo}")
            group["obs/q"], group["obs/dq"], group["actions"] = states[:, :2], states[:, 2:], controls
    columns = ["q1", "q2", "dq1", "dq2", "u1", "u2"]
    frame = pd.DataFrame(np.concatenate([states, controls], 1), columns=columns)
    frame.to_csv(folder / "german.csv", sep=";", index=False)
    frame.insert(0, "stamp", time)
    frame["run"] = np.arange(len(time)) // 60
    frame["q1_deg"], frame["q2_deg"] = np.rad2deg(states[:, 0]), np.rad2deg(states[:, 1])
    frame.to_csv(folder / "log.csv", index=False)
    lists = {"stamp": time, "q": list(states[:, :2]), "dq": list(states[:, 2:]), "u": list(controls)}
    pd.DataFrame(lists).to_parquet(folder / "log.parquet")
    pd.DataFrame(lists).to_feather(folder / "log.feather")
    write_bags(folder, time, states, controls)
    write_lerobot(folder, time, states, controls)
    sysid = {"control_times": time, "control_data": controls, "sensordata_times": time, "sensordata_data": states}
    np.savez(folder / "trajectory.npz", **sysid)
    variables = {"t": time, "q": states[:, :2].T, "dq": states[:, 2:].T, "log": {"u": controls}}
    scipy.io.savemat(folder / "log.mat", variables)
    velocity = np.cumsum(0.01 * np.append(0, controls[:-1, 0]) / 2)
    position = np.cumsum(0.01 * velocity)
    cart = {"stamp": time, "x": position, "v": velocity, "force": controls[:, 0]}
    pd.DataFrame(cart).to_csv(folder / "cart.csv", index=False)
    (folder / "pendulum.xml").write_text(PENDULUM)
    marker = {"stamp": 2 * time, "x": 0.4 * np.sin(time), "y": 0 * time, "z": 1 - 0.4 * np.cos(time)}
    pd.DataFrame(marker).to_csv(folder / "camera.csv", index=False)


def write_bags(folder: Path, time: np.ndarray, states: np.ndarray, controls: np.ndarray) -> None:
    """The log as an MCAP file and as a folder, with joints in the order of the alphabet."""
    m, names, state = bags.Messages(), ["elbow", "shoulder"], "control_msgs/msg/JointTrajectoryControllerState"
    sent = []
    for t, row, u in zip(time, states, controls, strict=True):
        at = bags.START + t
        measured = m.joint_state(at, names, row[[1, 0]], row[[3, 2]])
        sent.append(("/joint_states", "sensor_msgs/msg/JointState", at + 0.002, measured))
        sent.append(("/servo_controller/commands", "std_msgs/msg/Float64MultiArray", at, m.numbers(u)))
        sent.append(("/trajectory_controller/state", state, at, m.controller(at, names, u[::-1])))
    bags.write(folder / "bag", sent).rename(folder / "run.mcap")
    bags.write(folder / "bag_folder", sent, kind="folder")


def write_lerobot(folder: Path, time: np.ndarray, states: np.ndarray, controls: np.ndarray) -> None:
    """The log as a dataset in degrees, of positions only."""
    names = {"names": ["shoulder.pos", "elbow.pos"], "dtype": "float32", "shape": [2]}
    plain = {"dtype": "float32", "shape": [1], "names": None}
    features = {"observation.state": names, "action": names, "timestamp": plain, "episode_index": plain}
    (folder / "lerobot_dataset" / "meta").mkdir(parents=True)
    info = {"codebase_version": "v3.0", "fps": 100, "total_frames": len(time), "features": features}
    (folder / "lerobot_dataset" / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "lerobot_dataset" / "data" / "chunk-000").mkdir(parents=True)
    columns = {"observation.state": list(np.rad2deg(states[:, :2])), "action": list(np.rad2deg(controls))}
    columns |= {"timestamp": time, "episode_index": 0 * time, "index": np.arange(len(time))}
    pd.DataFrame(columns).to_parquet(folder / "lerobot_dataset" / "data" / "chunk-000" / "file-000.parquet")


def write_minari(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    if (folder / "minari").exists():
        return
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer

    with np.load(folder / "log.npz") as log:
        observations = np.concatenate([log["observations"], log["next_observations"][-1:]])
        actions = log["actions"]
    length = len(actions)
    buffer = EpisodeBuffer(
        observations=observations, actions=actions, rewards=np.zeros(length),
        terminations=np.zeros(length, dtype=bool), truncations=np.arange(length) == length - 1,
    )  # fmt: skip
    minari.create_dataset_from_buffers(
        "arm/random-v0",
        buffer=[buffer],
        observation_space=Box(-np.inf, np.inf, (4,), np.float64),
        action_space=Box(-np.inf, np.inf, (2,), np.float64),
    )


def completed(document: Mapping[str, Any]) -> dict[str, Any]:
    """A fragment of a config with what it leaves out; a complete one as it is."""
    if "sim" in document or document.get("backend") == "gymnasium" or {"model", "parameters"} <= set(document):
        return dict(document)
    return {**BASE, **document}


@pytest.mark.parametrize(("page", "text"), every("yaml"))
@pytest.mark.filterwarnings("ignore")
def test_yaml_is_a_config_that_a_fit_accepts(
    page: Path, text: str, robot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "minari:" in text:
        write_minari(robot, monkeypatch)
    document = completed(load_yaml(text, "docs"))
    problem = make_problem(make_config(document, base=robot))
    assert len(problem.objective) > 20
    if not problem.observation.is_sensed:  # such a fit looks at them once it has states
        refuse_dead_parameters(problem.objective)


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=lambda p: p.stem)
def test_python_runs(page: Path, robot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "robot"
    shutil.copytree(robot, folder)
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {"__name__": "documentation"}
    for text in blocks(page, "python"):
        exec(compile(text, page.name, "exec"), names)


def test_shortest_config_is_fitted_by_its_command(robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "out"
    assert cli.main(["fit", str(robot / "robot.yaml"), "--out", str(out), "--samples", "10", "--threads", "1"]) == 0
    written = {p.name for p in out.iterdir()}
    assert written == {
        "fit.json", "distribution.yaml", "model.xml", "fitted_config.yaml", "report.html", "checkpoint.bin",
    }  # fmt: skip
    documented = (ROOT / "docs" / "config.md").read_text()
    assert not [name for name in written if f"`{name}`" not in documented]
    keys = yaml.safe_load((out / "fit.json").read_text())
    assert not [key for key in keys if f"`{key}`" not in documented]


def test_every_key_is_documented() -> None:
    from dropo_torch.config import KEYS
    from dropo_torch.data.preprocess import Preprocess
    from dropo_torch.data.readers import ReadOptions
    from dropo_torch.parameters import _KEYS

    config, data = ((ROOT / "docs" / name).read_text() for name in ("config.md", "data.md"))
    assert not [key for key in (*KEYS, *_KEYS) if f"`{key}`" not in config]
    options = (*ReadOptions.__dataclass_fields__, *Preprocess.__dataclass_fields__)
    assert not [key for key in options if f"`{key}`" not in data]


@pytest.mark.parametrize("command", commands())
def test_command_parses(command: str) -> None:
    words = shlex.split(command.partition(" > ")[0])[1:]
    if words[0].startswith("--"):
        cli._parser(()).parse_args(words)
        return
    assert words[0] in cli.COMMANDS
    if len(words) > 1 or words[0] == "demo":  # otherwise it is named in passing
        _, rest = cli._parser([words[0]]).parse_known_args(words)
        parse_overrides(rest)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_links_and_files_exist(page: Path) -> None:
    text = page.read_text()
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} links to {target}"
        headings = re.findall(r"^#+ (.+)$", file.read_text(), re.MULTILINE) if anchor else []
        assert not anchor or anchor in {h.lower().replace(" ", "-") for h in headings}, f"{page.name}: {target}"
    for name in re.findall(r"\b(?:examples|benchmarks|sims|tests|dropo_torch)/[\w./-]+\.\w+", text):
        assert (ROOT / name).exists(), f"{page.name} names {name}"


def test_recover_hopper(capsys: pytest.CaptureFixture) -> None:
    load_example(ROOT / "examples" / "recover_hopper.py").main(["point", "--steps", "30", "--seeds", "1"])
    assert "torso_mass" in capsys.readouterr().out


def test_transfer_hopper(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    small = {"num_envs": 2, "horizon": 8, "minibatch": 16, "epochs": 1, "evaluations": 1}
    options = [word for k, v in small.items() for word in ("--train", k, str(v))]
    path = ROOT / "examples" / "transfer_hopper.py"
    example = load_example(path)
    arguments = ["--out", str(tmp_path), "--seeds", "2", "--steps", "16", "--episodes", "2", "--log-steps", "30"]
    arguments += options
    told = subprocess.run(
        [sys.executable, path, *arguments, "--workers", "2"], capture_output=True, text=True, timeout=300
    )
    assert "target's own masses" in told.stdout, told.stderr
    found = json.loads((tmp_path / "transfer.json").read_text())
    assert {(r["method"], r["seed"]) for r in found["runs"]} == {(m, s) for m in example.METHODS for s in (0, 1)}
    assert (tmp_path / "transfer.png").stat().st_size > 0
    before = (tmp_path / "true-1" / "train.json").stat().st_mtime_ns
    example.main(arguments)
    assert "target's own masses" in capsys.readouterr().out
    assert (tmp_path / "true-1" / "train.json").stat().st_mtime_ns == before


def test_gradient_vs_gradient_free(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    example = load_example(ROOT / "examples" / "gradient_vs_gradient_free.py")
    small = ["--steps", "10", "--samples", "8", "--adam-steps", "5", "--budget", "12"]
    example.main(["--out", str(tmp_path), "--systems", "hopper", "walker", *small])
    for name in ("hopper", "walker"):
        assert (tmp_path / f"{name}.html").exists()
        assert "cma-warp" in (tmp_path / f"{name}.json").read_text()
    assert (tmp_path / "gradients.png").stat().st_size > 10_000
    assert "13 parameters" in capsys.readouterr().out


def test_demo_figure(tmp_path: Path) -> None:
    load_example(ROOT / "examples" / "demo_figure.py").main(["--out", str(tmp_path / "demo.png")])
    assert (tmp_path / "demo.png").stat().st_size > 10_000


def test_own_simulator(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    example = load_example(ROOT / "examples" / "own_simulator" / "pendulum.py")
    example.main(["--out", str(tmp_path), "--samples", "60"])
    found = yaml.safe_load((tmp_path / "fit" / "fit.json").read_text())["parameters"]
    for name, truth in example.TRUTH.items():
        assert found[name]["mean"] == pytest.approx(truth, rel=1e-3)


def test_own_effect(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    example = load_example(ROOT / "examples" / "own_effect.py")
    example.main(["--out", str(tmp_path), "--samples", "200"])
    gap = yaml.safe_load((tmp_path / "gap" / "gap.json").read_text())
    assert [(e["effect"], e["target"]) for e in gap["effects"]] == [("magnetic_catch", "hinge")]
    found = yaml.safe_load((tmp_path / "fit" / "fit.json").read_text())["parameters"]
    assert found["hinge_torque"]["mean"] == pytest.approx(example.TRUTH["torque"], rel=1e-3)
    assert found["hinge_reach"]["mean"] == pytest.approx(example.TRUTH["reach"], rel=1e-3)


def test_crane(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Its gap is the one that the page tells of; the true strengths lie in the intervals."""
    from dropo_torch.effects import find_effect
    from dropo_torch.gap import find_gap

    example = load_example(ROOT / "examples" / "crane.py")
    example.main(["--out", str(tmp_path)])
    problem = make_problem(make_config(yaml.safe_load((tmp_path / "crane.yaml").read_text()), base=tmp_path))
    gap = find_gap(problem, effects=[find_effect("joint_damping"), find_effect("actuator_delay")])
    found = {(e.effect, e.target): next(iter(e.parameters.values())) for e in gap.effects}
    friction, delay = found[("joint_damping", "rail")], found[("actuator_delay", "drive")]
    assert len(found) == 2
    assert friction.value == pytest.approx(example.FRICTION, rel=2e-3)
    assert delay.value == pytest.approx(5e-3 * example.LATE, rel=2e-3)
    assert gap.after.mse < 1.1 * gap.noise_floor.mse < 0.1 * gap.before.mse


def test_crane_task(tmp_path: Path) -> None:
    """Nothing is better than rest at the target, and the command that pages name trains on it."""
    load_example(ROOT / "examples" / "crane.py").main(["--out", str(tmp_path)])
    name = f"{ROOT / 'examples' / 'crane_task.py'}:Deliver"
    task, still = load_task(name), torch.zeros(4, dtype=torch.float64)
    still[0] = load_example(ROOT / "examples" / "crane_task.py").TARGET
    states = torch.cat([still[None], still + task.initial_states(50, torch.Generator().manual_seed(0))])
    rewards = task.reward(states, torch.zeros(51, 1), states)
    assert rewards[0] == 1
    assert ((rewards[1:] > 0) & (rewards[1:] < 1)).all()
    small = {"num_envs": 2, "steps": 32, "horizon": 8, "minibatch": 16, "epochs": 1, "evaluations": 1, "episodes": 1}
    options = [word for key, value in small.items() for word in (f"--train.{key}", str(value))]
    command = ["train", str(tmp_path / "crane.yaml"), "--out", str(tmp_path / "policy"), "--task", name, *options]
    assert cli.main([*command, "--threads", "1"]) == 0
    assert (tmp_path / "policy" / "policy.pt").is_file()


def test_functions_that_fit_and_search_say_what_they_take_and_raise() -> None:
    """Every argument, and in which cases they raise an InputError."""
    searches = [getattr(dropo.gap, name) for name in re.findall(r"^   gap\.([a-z_]+)$", API.read_text(), re.MULTILINE)]
    functions = [dropo.fit_problem, dropo.fit, dropo.make_problem, dropo.gap.find_gap_as_given, *searches]
    for function in filter(inspect.isfunction, functions):
        told, _, raised = (inspect.getdoc(function) or "").partition("Raises:")
        given = {name.strip() for line in re.findall(r"^ *([\w, ]+): ", told, re.MULTILINE) for name in line.split(",")}
        assert set(inspect.signature(function).parameters) <= given, function.__name__
        assert "InputError: " in raised or function is dropo.gap.add, function.__name__


def test_every_effect_is_documented() -> None:
    from dropo_torch.effects import VOCABULARY

    rows = re.findall(r"^\| `(\w+)` \|.*\| (yes|no) \|$", (ROOT / "docs" / "effects.md").read_text(), re.MULTILINE)
    ours = {n: e for n, e in VOCABULARY.items() if type(e).__module__.startswith("dropo_torch.")}
    assert dict(rows) == {name: "yes" if effect.in_mjcf else "no" for name, effect in ours.items()}


@pytest.mark.skipif("DROPO_DATA" not in os.environ, reason="DROPO_DATA names no folder with DATA_EMPS.mat")
def test_emps(capsys: pytest.CaptureFixture) -> None:
    found = sorted(Path(os.environ["DROPO_DATA"]).rglob("DATA_EMPS.mat"))
    if not found:
        pytest.skip("no DATA_EMPS.mat in DROPO_DATA")
    load_example(ROOT / "examples" / "emps" / "emps.py").main([str(found[0])])
    assert "open-loop error" in capsys.readouterr().out


def measured(name: str) -> Path:
    """Return a folder of DROPO_DATA, or skip the test."""
    folder = Path(os.environ.get("DROPO_DATA", "")) / name
    if "DROPO_DATA" not in os.environ or not folder.is_dir():
        pytest.skip(f"DROPO_DATA names no folder with {name}")
    return folder


def test_joint_chirps(tmp_path: Path) -> None:
    """Published rotors and frictions predict better than none, on the model and the log as the example makes them."""
    folder = measured("joint_chirps")
    from dropo_torch.gap import open_loop, prepare

    example = load_example(ROOT / "examples" / "joint_chirps" / "joint_chirps.py")
    bare, theirs = (prepare(example.make(folder, "z1", tmp_path, published=p)) for p in (False, True))
    assert not bare.setting.model.dof_frictionloss.any()
    (given, still), (published, _) = (open_loop(scene, scene.begin, 0.3) for scene in (bare, theirs))
    assert published < 0.3 * given < given < still


def test_pendulums(tmp_path: Path) -> None:
    """The publishers' best model predicts better than a bare one, and best with the torques that it was made for."""
    folder = measured("double_pendulum")
    example = load_example(ROOT / "examples" / "pendulums" / "pendulums.py")
    theirs = example.published(folder, tmp_path)
    bare, commanded, best = (
        example.errors(scene, scene.begin)[1]
        for scene in (
            example.scene_of("double", folder),
            *(theirs[f"identified_model_h1.0, {torque} torque"] for torque in ("commanded", "measured")),
        )
    )
    assert best < 0.5 * commanded < 0.25 * bare


def test_panda(tmp_path: Path) -> None:
    """Forces tell the friction of all joints, offsets and masses, and leave less than the publishers' friction does."""
    from dropo_torch.effects import VOCABULARY
    from dropo_torch.gap import prepare
    from dropo_torch.gap.forces.view import force_view

    example = load_example(ROOT / "examples" / "panda" / "panda.py")
    problem = example.make(measured("panda_excitation"), tmp_path)
    scene = prepare(problem)
    effects = list(VOCABULARY.values())
    view = force_view(scene.setting, scene.train, scene.held, effects, scene.rules.forces)
    friction = {p.target: p for p in view.placed if p.effect.kind == "joint"}
    sizes = [friction[f"joint{n}"].values[0] for n in range(1, 8)]
    assert sizes == pytest.approx([0.31, 0.29, 0.27, 0.59, 0.28, 0.16, 0.28], abs=0.05)
    gives = {j: 1e3 * p.values[1] for j, p in friction.items() if p.effect.name == "joint_presliding"}
    expected = {"joint1": 19, "joint2": 6.7, "joint4": 4.4, "joint5": 2.2, "joint6": 8.8, "joint7": 2.2}
    assert gives == pytest.approx(expected, rel=0.3)
    assert {p.effect.name for p in view.placed} == {"joint_friction", "joint_presliding", "actuator_bias",
                                                    "center_of_mass"}  # fmt: skip
    assert (view.after <= example.published(problem)).all()
    assert np.mean(view.after**2) < np.mean(view.before**2) / 15
    plain = [e for e in effects if e.name != "joint_presliding"]
    sharp = force_view(scene.setting, scene.train, scene.held, plain, scene.rules.forces)
    assert np.mean(view.after**2) < 0.8 * np.mean(sharp.after**2)


def test_tosses(tmp_path: Path) -> None:
    """The published friction predicts tosses better than a guess; that of impacts is less than that of sliding."""
    folder = measured("cube_tosses") / "tosses"
    example = load_example(ROOT / "examples" / "tosses" / "tosses.py")
    tosses = [example.read(folder, number) for number in range(60)]
    problem = example.make(tosses[:5], tmp_path)
    given, published = example.guesses(problem)
    (far, _), (near, _) = (example.errors(problem, tosses, values).mean(0) for values in (given, published))
    assert near < far / 2
    where = example.windows(tosses)
    _, _, most = example.best_friction(problem, tosses, where["impacts"], published)
    _, least, _ = example.best_friction(problem, tosses, where["sliding"], published)
    assert most < least


def test_pushes(tmp_path: Path) -> None:
    """Friction and a late camera predict measured pushes at least twice as well as the model as given."""
    example = load_example(ROOT / "examples" / "pushing" / "pushing.py")
    pushes = example.chosen(list(example.read(measured("planar_pushing"), "20_neg30_90")), 1)
    assert len({p.group for p in pushes}) == len(pushes) == 3
    problem = example.make(pushes[:1], tmp_path, (0.0,), example.WINDOW)
    assert len(problem.objective.transitions) == 1
    given, better = np.nan_to_num(problem.space.nominal), np.array([1.3, 0.004, 0.12, -0.001])
    (far, _), (near, turned) = (
        example.errors(pushes, [p[0] for p in example.predict(problem, pushes, values)]).mean(0)
        for values in (given, better)
    )
    assert near < min(far / 2, 1.5)
    assert turned < 1.5


def shared_errors(
    rng: np.random.Generator, pushes: int, power: Sequence[float] = (0, 0, 0)
) -> tuple[np.ndarray, list[tuple[str, int]], np.ndarray]:
    """Errors of five repeats of each push, mostly those that its repeats have in common, and how far each went."""
    distance = np.repeat(rng.uniform(0.03, 0.15, pushes), 5)
    shared = np.repeat(rng.normal(size=(pushes, 3)) * [3, 2, 1], 5, axis=0)
    off = shared + rng.normal(size=shared.shape) * [1, 1, 0.5]
    return off * distance[:, None] ** power, [("push", n) for n in np.repeat(np.arange(pushes), 5)], distance


def test_an_error_term_holds_what_repeats_have_in_common() -> None:
    example, rng = load_example(ROOT / "examples" / "pushing" / "error_term.py"), np.random.default_rng(0)
    term = example.error_term(*shared_errors(rng, 400))
    assert term.scale**2 == pytest.approx([9 + 1.2, 4 + 1.2, 1 + 0.3], rel=0.15)
    assert not term.power.any()


def test_an_error_term_grows_as_the_errors_do() -> None:
    example, rng = load_example(ROOT / "examples" / "pushing" / "error_term.py"), np.random.default_rng(0)
    term = example.error_term(*shared_errors(rng, 50, power=(1, 1, 0)))
    assert term.power.tolist() == [1, 1, 0]
    assert term.scales(0.2) == pytest.approx([2, 2, 1] * term.scales(0.1))


def test_an_error_term_of_few_pushes_holds_nine_in_ten_others() -> None:
    example, rng = load_example(ROOT / "examples" / "pushing" / "error_term.py"), np.random.default_rng(1)
    others, _, distance = shared_errors(rng, 100, power=(1, 1, 0))
    held = []
    for _ in range(40):
        term = example.error_term(*shared_errors(rng, 8, power=(1, 1, 0)))
        draws = term.draw(rng)[:4000]
        held += [example.holds(draws, off / term.scales(d)) for off, d in zip(others[::5], distance[::5], strict=True)]
    assert np.mean(held) == pytest.approx(0.9, abs=0.05)


def test_energy_scores_are_those_of_a_normal() -> None:
    """Of three independent axes of 1 mm, for its middle: 2 √(2/π) (1 − √½)."""
    example = load_example(ROOT / "examples" / "pushing" / "error_term.py")
    draws = example.point([1e-3, 1e-3, 1e-3 / example.ARM])
    scores = example.energy_scores(draws.draw(np.random.default_rng(0)) * draws.scale, np.zeros(3))
    assert scores.mean() == pytest.approx(2 * np.sqrt(2 / np.pi) * (1 - np.sqrt(0.5)), abs=3e-3)
    far = example.energy_scores(draws.draw(np.random.default_rng(0)) * draws.scale, np.full(3, 0.02))
    assert (far > 10 * scores).all()


def test_the_noisy_hoppers_noise_is_where_it_is() -> None:
    example = load_example(ROOT / "examples" / "noisy_hopper.py")
    log = read_trajectories(ROOT / "sims" / "hopper" / "log.npz")
    sigma, rng = np.sqrt(example.VARIANCE), np.random.default_rng(3)
    for starts, ends in ((False, True), (True, False), (True, True)):
        of_starts, of_ends, between = example.roughness(example.noisy(log, rng, starts=starts, ends=ends))
        smooth = slice(0, 5)  # the positions
        for found, there in ((of_starts, starts), (of_ends, ends)):
            assert ((found[smooth] > 0.6 * sigma) == there).all()
        np.testing.assert_allclose(between, sigma * np.sqrt(starts + ends), rtol=0.2)
    today = mujoco.MjModel.from_xml_path(str(example.SIM.model))
    assert list(example.factors(today).values()) == pytest.approx([0.893, 0.903, 0.927, 0.874], abs=5e-4)


def test_a_twin_begins_and_is_commanded_as_its_log() -> None:
    example = load_example(ROOT / "examples" / "noisy_hopper.py")
    log = read_trajectories(ROOT / "sims" / "hopper" / "log.npz")
    ends, free = example.simulate(mujoco.MjModel.from_xml_path(str(example.SIM.model)), log)
    assert 0 < free.sum() < len(log)
    error, change = (np.median(np.abs(x - log.next_observations)) for x in (ends, log.observations))
    assert error < 0.2 * change  # its masses are others


def test_authors_hopper_replays_a_log(capsys: pytest.CaptureFixture) -> None:
    log = str(ROOT / "sims" / "hopper" / "log.npz")
    load_example(ROOT / "examples" / "authors_hopper.py").main([log, "--transitions", "60"])
    told = capsys.readouterr().out
    assert "torso: mass 3.534 kg, moment of inertia 0.893 of today's" in told
    assert "(60 transitions)" in told or ("without contact" in told and "in contact" in told)


def test_authors_hopper_is_a_config() -> None:
    text = (ROOT / "examples" / "authors_hopper.yaml").read_text()
    make_config({**load_yaml(text, "docs"), "data": "hopper10000"})
