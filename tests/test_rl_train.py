"""Training: exact resumption, known optima, what is refused, and the files of a run."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import dropo_torch as dropo
from dropo_torch.commands.cli import main
from dropo_torch.errors import InputError
from dropo_torch.rl.collect import Collector, evaluate
from dropo_torch.rl.policy import Normalizer, Policy, load_policy
from dropo_torch.rl.ppo import PPO, ReturnScale
from dropo_torch.rl.problem import TrainingProblem, make_training
from dropo_torch.rl.sac import Memory
from dropo_torch.rl.settings import PPOSettings
from dropo_torch.rl.train import train
from dropo_torch.rl.video import chosen_frames, draw

#: A block on a rail; its task rewards one action in every state, and its episodes last eight steps.
TASK = '''
import mujoco, torch
from dropo_torch.rl import Task

XML = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body name="block">
<inertial mass="2" pos="0 0 0" diaginertia="1 1 1"/><joint name="rail" type="slide" axis="1 0 0"/></body></worldbody>
<actuator><motor name="push" joint="rail" ctrllimited="true" ctrlrange="-2 4"/></actuator></mujoco>"""

class Push(Task):
    name, frame_skip, max_episode_steps, num_observations = "push", 2, 8, 2
    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
    def initial_states(self, count, generator):
        return torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.5
    def observe(self, states):
        return states
    def reward(self, states, actions, next_states):
        return 1 - (actions[:, 0] - 1.9) ** 2
    def terminated(self, next_states):
        return torch.zeros(len(next_states), dtype=torch.bool)

class Heavy(Push):
    """Rewards the speed that a full push gives: the heavier, the less."""
    name = "heavy"
    def reward(self, states, actions, next_states):
        return next_states[:, 1] - states[:, 1]
'''
NETWORK = {"num_observations": 2, "num_actions": 1, "hidden": [4], "head": "normal", "activation": "tanh"}
MASS = {"field": "body_mass", "name": "block", "bounds": [1.0, 4.0], "unit": "kg"}
TINY: dict[str, dict[str, Any]] = {
    "ppo": {"steps": 640, "num_envs": 4, "horizon": 16, "minibatch": 32, "epochs": 2, "hidden": [8], "episodes": 2},
    "sac": {"steps": 160, "num_envs": 4, "warmup": 40, "minibatch": 16, "hidden": [8], "buffer": 100, "episodes": 2},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("push")
    (path / "push.py").write_text(TASK)
    return path


def problem(
    folder: Path, algorithm: str = "ppo", *, train: dict[str, Any] | None = None, **keys: Any
) -> TrainingProblem:
    document = {"task": "push.py:Push", "parameters": {"mass": MASS}, "algorithm": algorithm, "threads": 1, **keys}
    settings = {"evaluations": 2, "checkpoint_seconds": 0, **TINY[algorithm], **(train or {})}
    return make_training(dropo.make_config({**document, "train": settings}, base=folder))


class Stop(Exception):
    """Ends a training from within."""


def stopping_at(number: int) -> Callable[..., None]:
    calls = []

    def stop(*_: object) -> None:
        calls.append(1)
        if len(calls) == number:
            raise Stop

    return stop


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_an_interrupted_training_ends_with_the_very_weights_of_a_whole_one(
    algorithm: str, folder: Path, tmp_path: Path
) -> None:
    whole = train(problem(folder, algorithm))
    for number in (3, 4):  # the second interruption falls on a run that was resumed
        with pytest.raises(Stop):
            train(
                problem(folder, algorithm), checkpoint=tmp_path / "c.pt", resume=True, on_progress=stopping_at(number)
            )
    resumed = train(problem(folder, algorithm), checkpoint=tmp_path / "c.pt", resume=True)
    first, second = whole.policy.state_dict(), resumed.policy.state_dict()
    assert all(torch.equal(first[k], second[k]) for k in first)
    assert whole.training == resumed.training
    assert [(e.steps, repr(e.mean_return), repr(e.scalars)) for e in whole.history] == [
        (e.steps, repr(e.mean_return), repr(e.scalars)) for e in resumed.history
    ]
    assert resumed.steps == TINY[algorithm]["steps"]


def test_a_seed_decides_the_weights_and_leaves_the_callers_random_numbers_alone(folder: Path) -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second, other = (train(problem(folder, seed=s)).policy.actor.state_dict() for s in (1, 1, 2))
    assert torch.equal(torch.rand(3), expected)
    assert all(torch.equal(first[k], second[k]) for k in first)
    assert not all(torch.equal(first[k], other[k]) for k in first)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_the_action_that_is_best_in_every_state_is_found(algorithm: str, folder: Path) -> None:
    settings = {
        "ppo": {"steps": 12_000, "num_envs": 16, "horizon": 16, "minibatch": 64, "epochs": 8, "learning_rate": 3e-3},
        "sac": {"steps": 1600, "num_envs": 8, "warmup": 200, "minibatch": 64, "buffer": 2000, "learning_rate": 5e-3,
                "hidden": [32], "gamma": 0.5, "target_entropy": -3.0},
    }  # fmt: skip
    result = train(problem(folder, algorithm, train={**settings[algorithm], "evaluations": 4, "episodes": 8}))
    states = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))
    assert result.policy(states) == pytest.approx(1.9, abs=0.25)  # of [-2, 4]
    assert result.training.mean == pytest.approx(8, abs=0.4)


def test_evaluations_are_whole_episodes_in_the_world_they_name(folder: Path) -> None:
    given = problem(folder, task="push.py:Heavy", distribution={"mass": 2.0}, target={"mass": 4.0})
    policy = Policy({**NETWORK, "head": "tanh"})
    with torch.no_grad():
        policy.actor.network[-1].bias.fill_(50.0)  # full push, whatever it sees
    policy.low.fill_(-2.0)
    policy.high.fill_(4.0)
    for world, mass in ((given.training, 2.0), (given.nominal, 2.0), (given.target, 4.0)):
        found = evaluate(policy, given.env(world, 5, seed=3))
        assert found.lengths == (8,) * 5
        assert found.returns == pytest.approx([4.0 / mass * 0.02 * 8] * 5, rel=1e-5)
        assert found.std == pytest.approx(0, abs=1e-5)
    assert evaluate(policy, given.env(given.target, 5, seed=3)) == found


def test_the_critic_sees_the_parameters_and_the_policy_does_not(folder: Path) -> None:
    for privileged in (True, False):
        given = problem(folder, train={"privileged_critic": privileged})
        policy = Policy(NETWORK)
        learner = PPO(policy, 1, given.settings)
        assert learner.num_features == 2 + privileged
        assert policy.num_observations == 2
        rollout = Collector(given.env(given.training, 4, seed=0), policy.to_action).collect(learner.act, 16)
        assert rollout["parameters"].shape == (4, 16, 1)
        assert np.isfinite(learner.update(rollout, 0.0)["loss_critic"])


def test_the_policy_that_learns_is_the_one_that_acted(folder: Path) -> None:
    given = problem(folder, train={"learning_rate": 1e-12, "epochs": 3})
    entries = []
    train(given, on_progress=lambda entry, _: entries.append(entry))
    assert max(abs(e.scalars["kl"]) for e in entries) < 1e-6
    assert max(e.scalars["clip_fraction"] for e in entries) == 0


def test_running_statistics_are_those_of_all_rows_however_they_come() -> None:
    rows = torch.from_numpy(np.random.default_rng(0).normal(3, 2, (1000, 4))) * torch.tensor([1.0, 1e-3, 1e3, 0.0])
    normalizer = Normalizer(4)
    assert normalizer(rows[:3]).tolist() == rows[:3].clamp(-10, 10).float().tolist()
    for part in rows.split([1, 200, 0, 799]):
        normalizer.update(part)
    scaled = normalizer(rows)
    assert scaled[:, :3].mean(0).tolist() == pytest.approx([0] * 3, abs=1e-6)
    assert scaled[:, [0, 2]].std(0, correction=0).tolist() == pytest.approx([1, 1], rel=1e-4)
    assert scaled[:, 3].abs().max() == 0
    assert float(normalizer(1e9 * rows[:1]).abs().max()) == 10


def test_rewards_are_scaled_by_the_deviation_of_discounted_returns() -> None:
    reward = torch.from_numpy(np.random.default_rng(1).normal(0, 7, (3, 40)))
    done = torch.rand(3, 40, generator=torch.Generator().manual_seed(0)) < 0.1
    returns, running = [], np.zeros(3)
    for t in range(40):
        running = 0.9 * running + reward[:, t].numpy()
        returns.append(running.copy())
        running = np.where(done[:, t], 0, running)
    scale = ReturnScale(3, 0.9)
    assert float(scale.factor) == pytest.approx(1, rel=1e-6)
    for a, b in ((0, 13), (13, 40)):
        scale.update(reward[:, a:b], done[:, a:b])
    assert float(scale.factor) == pytest.approx(1 / np.std(returns), rel=1e-5)


def test_a_number_that_is_not_finite_reaches_no_loss(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = problem(folder)
    task = type(given.training.task)
    sound, calls = task.reward, [0]

    def broken(self: Any, states: torch.Tensor, actions: torch.Tensor, next_states: torch.Tensor) -> torch.Tensor:
        calls[0] += 1
        reward = sound(self, states, actions, next_states)
        return torch.where(torch.arange(len(reward)) == calls[0] % 7, torch.nan, reward)

    monkeypatch.setattr(task, "reward", broken)
    result = train(given)
    assert result.repaired > 0
    assert result.skipped == 0
    assert all(torch.isfinite(v).all() for v in result.policy.state_dict().values())


def test_an_update_whose_loss_is_not_finite_is_left_out_and_many_end_the_training() -> None:
    policy = Policy(NETWORK)
    learner = PPO(policy, 0, PPOSettings(num_envs=2, minibatch=8, epochs=1))
    entries = {
        "observation": torch.zeros(2, 4, 2), "parameters": torch.zeros(2, 4, 0), "action": torch.zeros(2, 4, 1),
        "log_prob": torch.full((2, 4), torch.nan),
        "next": {
            "observation": torch.zeros(2, 4, 2), "reward": torch.ones(2, 4, 1),
            "done": torch.zeros(2, 4, 1, dtype=torch.bool), "terminated": torch.zeros(2, 4, 1, dtype=torch.bool),
        },
    }  # fmt: skip
    before = {k: v.clone() for k, v in policy.actor.state_dict().items()}
    for _ in range(19):
        learner.update(TensorDict(entries, batch_size=[2, 4]), 0.0)
    assert learner.skipped == 19
    assert all(torch.equal(before[k], v) for k, v in policy.actor.state_dict().items())
    with pytest.raises(dropo.InputError, match=r"not finite for 20 updates.*learning_rate"):
        learner.update(TensorDict(entries, batch_size=[2, 4]), 0.0)


@pytest.mark.parametrize("count", [0, 3, 10, 16, 20, 27])
def test_the_memory_forgets_the_oldest_and_goes_on_where_it_was(count: int) -> None:
    def steps(first: int, number: int) -> TensorDict:
        value = torch.arange(first, first + number, dtype=torch.float32)[:, None]
        return TensorDict({"action": value, "next": TensorDict({"reward": -value}, [number])}, [number])

    memory, other = Memory(10, 4), Memory(10, 4)
    for i in range(count):
        memory.extend(steps(i, 1))
    state = memory.state_dict()
    other.load_state_dict(state)
    if count:
        assert sorted(state["steps"]["action"][:, 0].tolist()) == list(range(max(0, count - 10), count))
    samples = []
    for one in (memory, other):
        one.extend(steps(count, 3))
        assert len(one) == min(count + 3, 10)
        torch.manual_seed(0)
        samples.append(one.sample())
    first, second = samples
    assert torch.equal(first["action"], second["action"])
    assert torch.equal(first["next", "reward"], -first["action"])


def test_a_checkpoint_of_another_training_is_refused(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    with pytest.raises(Stop):
        train(problem(folder), checkpoint=path, on_progress=stopping_at(1))
    others = [
        {"seed": 1}, {"algorithm": "sac"}, {"task": "push.py:Heavy"}, {"distribution": "nominal"},
        {"train": {"gamma": 0.9}}, {"parameters": {"mass": {**MASS, "bounds": [1.0, 3.0]}}},
    ]  # fmt: skip
    for other in others:
        with pytest.raises(dropo.InputError, match="belongs to another config, model, log or method"):
            train(problem(folder, **other), checkpoint=path, resume=True)
    train(problem(folder, threads=2, train={"checkpoint_seconds": 9}), checkpoint=path, resume=True)
    for content in (b"", b"hello", path.read_bytes()[:1000]):
        path.write_bytes(content)
        with pytest.raises(dropo.InputError, match="is no checkpoint of a training"):
            train(problem(folder), checkpoint=path, resume=True)
        assert path.read_bytes() == content


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "key of train": ({"train": {"stepz": 1}}, r"train of ppo: unknown key 'stepz'; did you mean 'steps'"),
    "key of the other algorithm": ({"train": {"tau": 0.1}}, "train of ppo: unknown key 'tau'"),
    "number": ({"train": {"gamma": 2}}, r"train.gamma is 2; expected 1(.0)? or less"),
    "positive": ({"train": {"learning_rate": 0}}, r"train.learning_rate is 0; expected more than 0"),
    "flag": ({"train": {"steps": True}}, r"train.steps is true; expected a number"),
    "text": ({"train": {"steps": "many"}}, r"train.steps is 'many'; expected a whole number"),
    "widths": ({"train": {"hidden": []}}, r"train.hidden is \[\]; expected"),
    "algorithm": ({"algorithm": "pppo"}, r"algorithm is 'pppo'; expected 'ppo' or 'sac'"),
    "no task": ({"task": None}, "no task given; expected task: file.py:Class of a Task, or sim: hopper"),
    "task": ({"task": "push.py:Pull"}, "Pull"),
    "distribution": ({"distribution": "fitt.json"}, r"distribution: no file .*fitt.json; expected a fit.json, uniform"),
    "names": ({"distribution": {"mas": 1.0}}, r"unknown name 'mas'; did you mean 'mass'"),
    "value": ({"distribution": {"mass": "x"}}, r"distribution.mass is 'x'; expected a finite number"),
    "target": ({"target": {"mas": 1.0}}, r"target: unknown parameter 'mas'; did you mean 'mass'"),
    "target's value": ({"target": {"mass": None}}, r"target.mass is None; expected a finite number"),
    "target beyond the limits": ({"target": {"mass": -1.0}}, r"target.mass is -1; the model allows"),
    "backend": ({"backend": "gymnasium"}, "train with backend mujoco or warp"),
    "nothing varies": ({"parameters": {}, "distribution": "uniform"}, "no parameters are given"),
    "too few steps": ({"train": {"steps": 10}}, r"train.steps: 10 given, but one iteration takes 64"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_refused_by_key(name: str, folder: Path) -> None:
    keys, expected = WRONG[name]
    keys = dict(keys)
    document = {"task": "push.py:Push", "parameters": {"mass": MASS}, **keys}
    document["train"] = {**TINY["ppo"], **keys.get("train", {})}
    with pytest.raises(dropo.InputError, match=expected):
        train(make_training(dropo.make_config({k: v for k, v in document.items() if v is not None}, base=folder)))


def test_a_distribution_of_other_parameters_is_refused_and_the_one_beside_the_config_is_taken(
    folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "push.py").write_text(TASK)
    entry = {"mean": 2.5, "std": 0.1, "low": 1.0, "high": 4.0, "unit": "kg"}
    (tmp_path / "fit.json").write_text(json.dumps({"parameters": {"mass": entry}}))
    given = problem(tmp_path)
    assert given.training.source.document()["kind"] == "fitted"
    values = given.env(given.training, 200, seed=0)
    values.reset()
    assert values.values.mean() == pytest.approx(2.5, abs=0.03)
    (tmp_path / "fit.json").write_text(json.dumps({"parameters": {"weight": entry}}))
    with pytest.raises(dropo.InputError, match="'weight' is not in the model"):
        problem(tmp_path)
    assert problem(folder).training.source.document()["kind"] == "uniform"


def test_a_target_may_differ_in_what_does_not_vary_in_training(folder: Path) -> None:
    damping = {"field": "dof_damping", "name": "rail", "value": 3.0}
    given = problem(folder, target={"mass": 3.0, "damping": damping})
    assert given.training.space.names == ("mass",)
    env = given.env(given.target, 2, seed=0)
    env.reset()
    assert env.values.tolist() == [[3.0, 3.0]] * 2
    hopper = make_training(
        dropo.make_config({"sim": "hopper", "target": {"torso_mass": 2.6}, "distribution": "nominal",
                           "parameters": {"leg_mass": {"field": "body_mass", "name": "leg", "bounds": [1, 4]}}})
    )  # fmt: skip
    assert hopper.target.space.names == ("leg_mass", "torso_mass")
    assert hopper.target.source.sample(1, torch.Generator())[0].tolist() == pytest.approx([2.7813567, 2.6])


def test_a_policy_is_loaded_in_three_lines_and_takes_arrays_and_tensors(folder: Path, tmp_path: Path) -> None:
    result = train(problem(folder))
    result.policy.save(tmp_path / "policy.pt")
    policy = dropo.load_policy(tmp_path / "policy.pt")
    observation = np.random.default_rng(0).normal(size=(3, 5, 2))
    assert np.array_equal(policy(observation), result.policy(observation))
    assert policy(torch.from_numpy(observation)).shape == (3, 5, 1)
    assert policy(observation[0, 0]).shape == (1,)
    assert policy.config["task"] == "push.py:Push"
    assert policy.distribution["parameters"]["mass"] == {"low": 1.0, "high": 4.0, "unit": "kg", "scale": "linear"}
    assert np.all((policy(1e6 * observation) >= -2) & (policy(1e6 * observation) <= 4))
    with pytest.raises(dropo.InputError, match=r"observation of shape \(3,\) given; expected \(..., 2\)"):
        policy(np.zeros(3))
    for content in (b"", b"hello", (tmp_path / "policy.pt").read_bytes()[:2000]):
        (tmp_path / "broken.pt").write_bytes(content)
        with pytest.raises(dropo.InputError, match="cannot be read as a policy"):
            load_policy(tmp_path / "broken.pt")
    with pytest.raises(dropo.InputError, match="no file"):
        load_policy(tmp_path / "absent.pt")


@pytest.mark.parametrize("number", [float("nan"), 3e38])
def test_a_policy_whose_actions_are_no_numbers_is_refused(tmp_path: Path, number: float) -> None:
    shape = {"num_observations": 3, "num_actions": 1, "hidden": [4], "activation": "tanh", "head": "normal"}
    policy = Policy({**shape, "initial_std": 0.5}, config={}, distribution={})
    policy.low, policy.high = -policy.high * number, policy.high * number
    policy.save(tmp_path / "policy.pt")
    with pytest.raises(InputError, match=r"policy\.pt is damaged: its actions are no numbers"):
        load_policy(tmp_path / "policy.pt")


RESULTS = {"train.json", "report.html", "policy.pt", "train-progress.bin"}


def command(folder: Path, out: Path, *more: str) -> list[str]:
    (folder / "push.yaml").write_text("task: push.py:Push\nparameters: {mass: " + json.dumps(MASS) + "}\n")
    options = [f"--train.{k}={json.dumps(v)}" for k, v in {**TINY["ppo"], "evaluations": 2}.items()]
    return ["train", str(folder / "push.yaml"), "--out", str(out), "--target", "{mass: 3.5}", *options, *more]


def test_a_run_writes_its_files_and_moves_an_earlier_one_aside(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(folder, tmp_path, "--log", "tensorboard")) == 0
    assert {p.name for p in tmp_path.iterdir()} == RESULTS | {"tensorboard"}
    assert list((tmp_path / "tensorboard").glob("events*"))
    found = json.loads((tmp_path / "train.json").read_text())
    assert found["schema"] == "dropo-torch/train/1"
    assert found["steps"] == 640
    assert found["seed"] == found["diverged"] == 0
    assert [e["steps"] for e in found["evaluations"]] == [320, 640]
    assert found["returns"][-1]["steps"] == 640
    assert set(found["evaluation"]) == {"distribution", "nominal", "target"}
    assert len(found["evaluation"]["target"]["returns"]) == 2
    page = (tmp_path / "report.html").read_text()
    for words in ("Learning curve", "Evaluation", "the target model", "Training distribution", "load_policy"):
        assert words in page
    assert "An episode" in page or "MUJOCO_GL" in page
    assert "the target model" in capsys.readouterr().out
    assert main(command(folder, tmp_path)) == 0
    assert {p.name for p in tmp_path.iterdir()} == RESULTS | {"previous-1"}
    assert {p.name for p in (tmp_path / "previous-1").iterdir()} == RESULTS | {"tensorboard"}


def test_the_distribution_of_a_run_is_not_moved_aside(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = {"mean": 2.5, "std": 0.1, "low": 1.0, "high": 4.0, "unit": "kg"}
    (tmp_path / "fit.json").write_text(json.dumps({"parameters": {"mass": entry}}))
    assert main(command(folder, tmp_path, "--distribution", str(tmp_path / "fit.json"))) == 2
    assert "is the distribution of this run and would be moved aside" in capsys.readouterr().err
    assert (tmp_path / "fit.json").exists()


def test_kill_9_and_resume_give_the_policy_of_a_run_never_interrupted(folder: Path, tmp_path: Path) -> None:
    more = ["--train.steps=3200", "--train.checkpoint_seconds=0"]
    assert main(command(folder, tmp_path / "whole", *more)) == 0
    arguments = command(folder, tmp_path / "pieces", *more, "--resume")
    process = subprocess.Popen([sys.executable, "-m", "dropo_torch", *arguments], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 100
    while not (tmp_path / "pieces" / "train-progress.bin").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() in (-signal.SIGKILL, 0)
    assert main(arguments) == 0
    first, second = (load_policy(tmp_path / x / "policy.pt").state_dict() for x in ("whole", "pieces"))
    assert all(torch.equal(first[k], second[k]) for k in first)
    documents = [json.loads((tmp_path / x / "train.json").read_text()) for x in ("whole", "pieces")]
    assert documents[0]["evaluation"] == documents[1]["evaluation"]
    assert {p.name for p in (tmp_path / "pieces").iterdir()} == RESULTS


def test_without_gl_a_note_says_how_to_get_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = problem(folder).training.task.model
    monkeypatch.setenv("MUJOCO_GL", "disable")
    strip, note = draw(model, np.zeros((2, 2)))
    assert strip is None
    assert "MUJOCO_GL" in note
    frames = chosen_frames(101, 0.01)
    assert len(frames) == 16
    assert frames[0] == 0
    assert max(frames) == 100
    assert chosen_frames(1, 0.01) == [0] * 16


def test_an_evaluation_that_is_no_number_is_never_the_best(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first evaluation gives NaN: a later one is kept all the same."""
    from dropo_torch.rl import train as module

    found, count = module.evaluate, [0]

    def first_is_nan(*arguments: Any) -> Any:
        count[0] += 1
        evaluation = found(*arguments)
        return dataclasses.replace(evaluation, returns=(float("nan"),)) if count[0] == 1 else evaluation

    monkeypatch.setattr(module, "evaluate", first_is_nan)
    result = train(problem(folder, train={**TINY["ppo"], "evaluations": 4}))
    assert [e.kept for e in result.evaluations][:2] == [True, True]


def test_what_could_learn_nothing_is_refused_before_anything_is_moved(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "c.yaml"
    config.write_text(json.dumps({"task": f"{folder}/push.py:Push"}))
    out = tmp_path / "out"
    out.mkdir()
    for name in ("train.json", "policy.pt"):
        (out / name).write_text("mine")
    for options, message in (
        (["--train.steps", "10"], "one iteration takes"),
        (["--algorithm", "sac", "--train.steps", "5000"], "learning begins after train.warmup 10000"),
    ):
        assert main(["train", str(config), "--out", str(out), *options]) == 2
        assert message in capsys.readouterr().err
        assert sorted(p.name for p in out.iterdir()) == ["policy.pt", "train.json"]


def test_a_correlation_is_part_of_the_training(folder: Path, tmp_path: Path) -> None:
    """Two distributions that differ in it alone have different fingerprints, and the policy tells it."""
    entry = {"mean": 2.0, "std": 0.1, "low": 1.0, "high": 4.0, "unit": "kg"}
    drag = {"mean": 0.5, "std": 0.1, "low": 0.1, "high": 1.0, "unit": ""}
    found = []
    for name, correlation in (("a", 0.0), ("b", 0.9)):
        path = tmp_path / f"{name}.json"
        matrix = [[1.0, correlation], [correlation, 1.0]]
        path.write_text(json.dumps({"parameters": {"mass": entry, "drag": drag}, "correlation": matrix}))
        drags = {"field": "dof_damping", "name": "rail", "bounds": [0.1, 1.0]}
        found.append(problem(folder, parameters={"mass": MASS, "drag": drags}, distribution=str(path)))
    assert found[0].fingerprint != found[1].fingerprint
    assert found[1].training.source.document()["correlation"][0][1] == 0.9


def test_a_seed_of_any_size_trains(folder: Path) -> None:
    train(problem(folder, seed=20250101123000))


FLY = '''
import mujoco, torch
from dropo_torch.rl import Task

class Fly(Task):
    name, frame_skip, max_episode_steps, num_observations = "fly", 2, 8, 13
    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body name="b"><freejoint/>
        <geom size=".1" mass="1"/></body></worldbody>
        <actuator><adhesion name="m" body="b" ctrlrange="0 1" gain="1"/></actuator></mujoco>""")
    def initial_states(self, count, generator):
        states = torch.zeros(count, 13, dtype=torch.float64)
        states[:, 3] = 1
        return states
    def observe(self, states):
        return states
    def reward(self, states, actions, next_states):
        return next_states[:, 2]
    def terminated(self, next_states):
        return torch.zeros(len(next_states), dtype=torch.bool)
'''


@pytest.mark.parametrize("varies", [False, True])
def test_a_free_body_that_was_compiled_as_simple_is_told(tmp_path: Path, varies: bool) -> None:
    """An effect on its mass needs a model that was compiled for it, which a task's own is not."""
    (tmp_path / "fly.py").write_text(FLY)
    payload = {"effect": "payload", "target": "b", "mass": 0.5, "x": 0.1, "y": 0.0, "z": 0.0}
    document: dict[str, Any] = {"task": "fly.py:Fly", "effects": [payload], "train": TINY["ppo"]}
    if varies:
        del payload["mass"]
        document["parameters"] = {"m": {"effect": "payload", "name": "b", "index": "mass", "bounds": [0.1, 0.5]}}
    with pytest.raises(InputError, match="compiled as simple"):
        train(make_training(dropo.make_config(document, base=tmp_path)))
