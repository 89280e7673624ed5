"""Studies from a raw log to policies in a target: what they say of known results, and a small one from end to end."""

from __future__ import annotations

import copy
import functools
import importlib.util
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml
from dropo_sims import transfer
from dropo_sims.puck.transfer import ROBOT as PUCK
from dropo_sims.push.transfer import ROBOT as PUSH
from dropo_sims.target import log_config, write_raw
from dropo_sims.transfer import METHODS, TOGETHER, Cell, Plan, Robot, all_cells, with_arm
from dropo_sims.transfer_tables import LABELS, all_findings, distance_rows, draw_distances, interval, write_results

from dropo_torch.config import make_config
from dropo_torch.effects import VOCABULARY
from dropo_torch.errors import InputError
from dropo_torch.problem import make_problem
from dropo_torch.rl.policy import load_policy
from dropo_torch.rl.problem import make_training

ROBOTS = {"puck": PUCK, "push": PUSH}
each = pytest.mark.parametrize("name", ROBOTS)


def policy_result(method: str, *distances: float, seed: int = 0, box: int = 0) -> dict[str, Any]:
    cell = asdict(Cell("policy", method, seed, box))
    return {"cell": cell, "distances": [d / 100 for d in distances], "training_return": 4.0, "seconds": 60.0}


def all_results(**means: float) -> list[dict[str, Any]]:
    """Results in which every method's policies come to 2 cm, or to those given."""
    parameters = {"mass": {"mean": 0.1, "std": 0.01}, "gravity_tilt_roll": {"mean": -0.01, "std": 1e-4}}
    gap = {"gap": {"verdict": "explained"}, "answer": ["Your model lacks a tilt."], "check": []}
    found: list[dict[str, Any]] = [{"cell": asdict(Cell("gap")), "arm": gap, "object": gap}]
    for method in METHODS:
        near = means.get(method, 2.0)
        for box in range(3 if method == "udr" else 1):
            found.append(policy_result(method, near - 0.5, near + 0.5, box=box))
            if method not in ("own", "point"):
                found.append({"cell": asdict(Cell("fit", method, 0, box)), "fit": {"parameters": parameters}})
    return found


def policies(**means: float) -> list[dict[str, Any]]:
    """Those of the policies alone."""
    return [r for r in all_results(**means) if r["cell"]["stage"] == "policy"]


def test_distances_are_averaged_over_policies_and_their_interval_is_of_what_varies() -> None:
    rows = {r["method"]: r for r in distance_rows([*policies(own=1.0), policy_result("own", 3.0, seed=1)])}
    assert list(rows) == list(LABELS)
    assert rows["own"]["mean"] == pytest.approx(2.0)  # of 1 and 3, though one has two rollouts
    assert rows["dropo"]["policies"] == [pytest.approx([1.5, 2.5])]
    assert rows["udr"]["low"] == rows["udr"]["high"] == pytest.approx(2.0)  # its three policies agree
    low, high = interval([1.0, 2.0, 3.0])
    assert (low, high) == pytest.approx((2 - 2.92 / np.sqrt(3), 2 + 2.92 / np.sqrt(3)), rel=1e-3)
    assert np.isnan(interval([1.0])).all()
    assert interval([0.1, 5.0])[0] == 0


@pytest.mark.parametrize(
    ("means", "fails"),
    [({"own": 1.0, "udr": 9.0, "droid": 3.0, "plain": 3.0}, [0, 1]), ({"plain": 1.0, "own": 1.4}, [2]),
     ({"droid": 1.0}, [3]), ({"udr": 1.0}, [4, 5])],
)  # fmt: skip
def test_a_finding_that_does_not_hold_is_told(means: dict[str, float], fails: list[int]) -> None:
    assert [i for i, f in enumerate(all_findings(distance_rows(policies(**means)))) if not f.holds] == fails
    rows = [r for r in distance_rows(policies(**means)) if r["method"] in ("own", "udr")]
    assert all_findings(rows) == []  # nothing is said of methods that are not there


def test_the_page_has_every_method_and_both_figures(tmp_path: Path) -> None:
    sentences = write_results(tmp_path, PUCK, all_results(own=1.8), asdict(PUCK.plan))
    assert all(line.startswith("holds: ") for line in sentences)
    page = (tmp_path / "tables.md").read_text()
    for words in (
        *LABELS.values(),
        "Your model lacks a tilt.",
        "nothing is wrong",
        "1.3, 2.3",
        "0.125",
        "-0.01 ± 0.0001",
    ):
        assert words in page
    for name in ("study.json", "report.html", "transfer.png", "gap.png"):
        assert (tmp_path / name).stat().st_size > 1000
    labels = [t.get_text() for t in draw_distances(distance_rows(policies())).axes[0].get_yticklabels()]
    assert labels == list(LABELS.values())


@each
def test_every_plan_has_the_cells_that_its_policies_need(name: str) -> None:
    robot = ROBOTS[name]
    for plan in (robot.plan, robot.reduced, Plan(1, ("point",), 1, 6)):
        cells = all_cells(plan)
        assert len({c.name for c in cells}) == len(cells)
        for cell in cells:
            if cell.stage == "policy" and cell.method != "own":
                needed = "dropo" if cell.method == "point" else cell.method
                assert Cell("fit", needed, cell.seed, cell.box) in cells
                assert Cell("gap", seed=cell.seed) in cells


@each
def test_the_targets_own_model_moves_as_the_target_does(name: str) -> None:
    """The model with what effects can say ends where the target does; the one without does not."""
    robot = ROBOTS[name]
    run = robot.record(1, 2)[0]
    commands = torch.from_numpy(np.stack([c[1:] for c in run.commands]))
    start = torch.from_numpy(np.concatenate([run.qpos[0], np.zeros(13)]))
    ends = {}
    for what, document in {"own": robot.own, "model": {"distribution": "nominal"}}.items():
        problem = make_training(make_config({"sim": name, **document, "threads": 1}))
        task = copy.copy(problem.training.task)
        together = max(1, task.frame_skip // robot.sim.frame_skip)  # commands of an environment's step
        waiting = list(commands.split(together))
        task.initial_states = lambda count, generator: start.expand(count, -1)
        task.controls = lambda actions, w=waiting: w[0].expand(len(actions), -1, -1)
        env = problem.env(replace(problem.training, task=task), 1, 0)
        env.reset()
        while waiting:
            env.step(env.now().set("action", env.action_spec.zero()))
            waiting.pop(0)
        ends[what] = env.states[0, 7:9].numpy()
    off = {what: float(np.linalg.norm(end - run.final[7:9])) for what, end in ends.items()}
    assert off["own"] < 0.3 * off["model"]


@each
def test_the_arm_as_it_was_found_stays_while_the_object_is_searched(name: str, tmp_path: Path) -> None:
    """The model has what MJCF can say, effects the rest; the step is the model's own, and only the object varies."""
    robot, model = ROBOTS[name], mujoco.MjSpec.from_file(str(ROBOTS[name].sim.model))
    finer = model.option.timestep / 4
    model.option.timestep, model.option.integrator = finer, mujoco.mjtIntegrator.mjINT_RK4
    model.joint("joint2").damping = np.array([3.5, 0, 0])
    model.compile()
    (tmp_path / "model.xml").write_text(model.to_xml())
    drive = robot.make_target().model.actuator(1).name
    effects = [
        {"effect": "actuator_delay", "target": drive, "delay": 0.004},
        {"effect": "joint_damping", "target": "joint2", "damping": 2.5},
        {"effect": "integration", "timestep": finer},
    ]
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"effects": effects}))
    log, user = tmp_path / "log.csv", {"sim": name, "observation": list(TOGETHER), "backend": "mujoco"}
    write_raw(log, robot.make_target(), robot.record(1, 0)[:1])
    document = with_arm(robot, {**user, "data": log_config(log, robot.start)}, tmp_path)
    problem = make_problem(make_config(document))
    assert problem.space.model.opt.timestep == bundled_model(robot).opt.timestep
    assert problem.space.model.opt.integrator == bundled_model(robot).opt.integrator
    assert problem.space.model.joint("joint2").damping[0] == 3.5
    assert [e["effect"] for e in document["effects"]] == ["actuator_delay", "integration"]
    assert {"mass", "friction_x", "friction_y"} < set(problem.space.names)
    assert not any(n.startswith(("kp", "kd")) for n in problem.space.names)
    assert make_training(make_config({**document, "distribution": "nominal"})).training.task.name == name
    (tmp_path / "model.xml").unlink()
    assert with_arm(robot, user, tmp_path) == user  # nothing had a name


def bundled_model(robot: Robot) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(robot.sim.model))


def test_the_command_chooses_a_part(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, given = Path(__file__).parents[1] / "examples" / "transfer_manipulation.py", {}
    spec = importlib.util.spec_from_file_location("transfer_manipulation", path)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    monkeypatch.setattr(Robot, "run", lambda self, out, **options: given.update(options, robot=self) or ["holds: it"])
    example.main(["puck", "--out", str(tmp_path), "--seeds", "1", "--methods", "plain", "own", "--resume"])
    assert given["plan"] == replace(PUCK.plan, seeds=1, methods=("own", "plain"))
    assert given["robot"] == PUCK
    assert given["resume"]
    assert "holds: it" in capsys.readouterr().out
    example.main(["push", "--out", str(tmp_path), "--reduced", "--boxes", "2"])
    assert given["plan"] == replace(PUSH.reduced, boxes=2)
    for wrong in (["--boxes", "0"], ["--methods", "magic"]):
        with pytest.raises(SystemExit) as stop:
            example.main(["push", "--out", str(tmp_path), *wrong])
        assert stop.value.code == 2


def test_a_small_study_runs_from_the_log_to_the_page_and_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = functools.partial(transfer.find_gap, effects=[VOCABULARY["actuator_delay"]])  # the whole takes minutes
    monkeypatch.setattr(transfer, "find_gap", few)
    learning = {"steps": 512, "num_envs": 8, "horizon": 32, "evaluations": 1, "episodes": 2}
    plan = Plan(1, ("own", "dropo"), 1, runs=6, rollouts=2, gap_seconds=1, samples=10, train=learning, backend="mujoco")
    told: list[str] = []
    PUSH.run(tmp_path / "out", plan=plan, report=lambda stage, share: told.append(stage))
    page = tmp_path / "out" / "tables.md"
    assert "DROPO" in page.read_text()
    assert yaml.safe_load((tmp_path / "out" / "seed0" / "user.yaml").read_text())["sim"] == "push"
    assert len(load_policy(tmp_path / "out" / "seed0" / "own.pt").low) == 7
    with pytest.raises(InputError, match="add --resume"):
        PUSH.run(tmp_path / "out", plan=plan)
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "out" / "cells").iterdir()}
    PUSH.run(tmp_path / "out", plan=replace(plan, methods=("own", "dropo", "udr")), resume=True)
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert "UDR" in page.read_text()
    with pytest.raises(InputError, match="another size"):
        PUSH.run(tmp_path / "out", plan=replace(plan, runs=7), resume=True)
