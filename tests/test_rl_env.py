"""Batched environments: against MuJoCo, Gymnasium and the effects' own simulator, row by row."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import mujoco.batch
import numpy as np
import pytest
import torch
from cartpole import CART_POLE, CartPole
from dropo_sims.hopper import SIM
from dropo_sims.hopper.task import HopperTask
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torchrl.envs.utils import check_env_specs

from dropo_torch.data.observation import parse_observation
from dropo_torch.distribution import Distribution
from dropo_torch.effects import VOCABULARY, find_effect, register
from dropo_torch.effects.actuator import ActuatorDeadband
from dropo_torch.effects.placing import EffectSet, place_effects, plain_setting
from dropo_torch.effects.sensor import SensorBias
from dropo_torch.effects.simulator import effect_simulator
from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl import (
    ParameterSource,
    PointSource,
    RandomizedEnv,
    RandomizedVectorEnv,
    Task,
    load_source,
    load_task,
)
from dropo_torch.rl.stepper import MujocoStepper
from dropo_torch.simulators import make_simulator

MASSES = ParameterSpace(SIM.model, SIM.parameters)
CART = {
    "cart_mass": {"field": "body_mass", "name": "cart", "bounds": [0.5, 3.0]},
    "damping": {"field": "dof_damping", "name": "slide", "bounds": [0.0, 2.0]},
}


def cart_space() -> ParameterSpace:
    return ParameterSpace(CartPole().model, CART)


class Rows(ParameterSource):
    """Row i of a table for the i-th episode that begins, over and over."""

    def __init__(self, names: tuple[str, ...], table: np.ndarray) -> None:
        self.names, self.table, self.next = names, torch.from_numpy(table), 0

    def sample(self, count: int, generator: torch.Generator) -> torch.Tensor:
        at = (self.next + torch.arange(count)) % len(self.table)
        self.next += count
        return self.table[at]


def starting(task: Task, states: np.ndarray) -> Task:
    """The task with given start states."""
    other = copy.copy(task)
    other.initial_states = lambda count, generator: torch.from_numpy(states)[:count]  # type: ignore[method-assign]
    return other


def actions_of(env: RandomizedEnv, steps: int, seed: int = 0) -> torch.Tensor:
    low, high = env.action_spec.space.low, env.action_spec.space.high
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(steps, *low.shape, generator=generator)


def driven(env: RandomizedEnv, actions: torch.Tensor, *, resets: bool = True, td: Any = None) -> tuple[Any, Any]:
    """Steps under actions, stacked, and the tensordict to go on from."""
    td, steps = env.reset() if td is None else td, []
    for action in actions:
        td = td.clone(False).set("action", action)
        if resets:
            after, td = env.step_and_maybe_reset(td)
        else:
            after = env.step(td)
            td = env.step_mdp(after)
        steps.append(after)
    return torch.stack(steps), td


def random_states(model: mujoco.MjModel, count: int, size: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rest = np.concatenate([model.qpos0, np.zeros(model.nv)])
    return rest + rng.uniform(-size, size, (count, len(rest)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_hopper_is_gymnasiums(seed: int) -> None:
    reference = gymnasium.make("Hopper-v5", xml_file=str(SIM.model), frame_skip=4).unwrapped
    reference.reset(seed=0)
    task = HopperTask()
    start = random_states(task.model, 1, 0.05, seed)
    env = RandomizedEnv(starting(task, start), 1)
    reference.set_state(start[0, :6], start[0, 6:])
    reference.data.qacc_warmstart[:] = 0  # set_state has run the solver; an episode starts it cold
    actions = actions_of(env, 60, seed)
    steps, _ = driven(env, actions, resets=False)
    assert not steps["next", "truncated"].any()
    fell = 0
    for t, action in enumerate(actions):
        observation, reward, terminated, _, _ = reference.step(action[0].double().numpy())
        now = steps[t]["next"]
        np.testing.assert_array_equal(now["observation"][0].numpy(), observation.astype(np.float32))
        np.testing.assert_allclose(float(now["reward"]), reward, rtol=2e-6)
        assert bool(now["terminated"]) == terminated
        fell += terminated
    assert fell > 0


def test_the_hopper_starts_as_gymnasiums() -> None:
    task = HopperTask()
    found = task.initial_states(4000, torch.Generator().manual_seed(0)).numpy()
    noise = found - np.concatenate([task.model.qpos0, np.zeros(6)])
    assert np.abs(noise).max() <= 5e-3
    np.testing.assert_allclose(noise.mean(0), 0.0, atol=3e-4)
    np.testing.assert_allclose(noise.std(0), 5e-3 / np.sqrt(3), rtol=0.05)
    assert task.action_low.tolist() == [-1, -1, -1]
    assert task.timestep == pytest.approx(0.008)


def test_the_hopper_observes_and_ends_as_gymnasiums() -> None:
    reference = gymnasium.make("Hopper-v5", xml_file=str(SIM.model), frame_skip=4).unwrapped
    reference.reset(seed=0)
    task = HopperTask()
    states = random_states(task.model, 200, 0.4, 5)
    states[::3, 6:] *= 100.0  # beyond the clip
    states[:, 1] -= 0.3
    states[5::20, [1, 2, 4]] = [1.2, 0.0, 120.0]  # upright, and beyond all health
    observed, ended = task.observe(torch.from_numpy(states)), task.terminated(torch.from_numpy(states))
    for state, observation, end in zip(states, observed, ended, strict=True):
        reference.data.qpos[:], reference.data.qvel[:] = np.split(state, 2)
        np.testing.assert_array_equal(observation.numpy(), reference._get_obs())
        assert bool(end) == (not reference.is_healthy)
    assert 20 < ended.sum() < 180
    assert ended[5::20].all()
    assert (observed[:, 5:].abs() == 10).any()


LAGGED = CART_POLE.replace(
    '<motor name="push" joint="slide" gear="10" ctrlrange="-1 1"/>',
    '<general name="push" joint="slide" gear="10" ctrlrange="-1 1" dyntype="filterexact" dynprm="0.05"/>',
)


def lagged() -> Task:
    """The cart and pole with an actuator that has a state of its own."""
    return CartPole().on(mujoco.MjModel.from_xml_string(LAGGED))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("task", [HopperTask(), lagged()], ids=["hopper", "lagged"])
def test_every_row_is_one_simulation_of_its_own_model(task: Task, threads: int) -> None:
    num, steps = 9, 40
    space = ParameterSpace(task.model, SIM.parameters if task.name == "hopper" else CART)
    table = np.random.default_rng(1).uniform(space.low, space.high, (400, len(space)))
    env = RandomizedEnv(task, num, space=space, source=Rows(space.names, table), num_threads=threads)
    td, begun, resets = env.reset(), 0, -num
    sims = [(task.model, mujoco.MjData(task.model)) for _ in range(num)]
    begin = torch.ones(num, dtype=torch.bool)
    for action in actions_of(env, steps):
        for row in begin.nonzero()[:, 0].tolist():
            model = space.apply(table[begun])
            sims[row] = model, mujoco.MjData(model)
            sims[row][1].qpos[:], sims[row][1].qvel[:] = np.split(env.states[row].numpy(), 2)
            begun, resets = begun + 1, resets + 1
        after = env.step(td.set("action", action))
        for row, (model, data) in enumerate(sims):
            data.ctrl[:] = action[row].double().numpy()
            mujoco.mj_step(model, data, nstep=task.frame_skip)
            np.testing.assert_array_equal(env.states[row].numpy(), np.concatenate([data.qpos, data.qvel]))
        observed = task.observe(env.states).float()
        assert torch.equal(after["next", "observation"], observed)
        begin = after["next", "done"][:, 0]
        td = env.maybe_reset(env.step_mdp(after))
    assert resets > 5
    np.testing.assert_array_equal(td["parameters"].numpy(), env.values.float().numpy())


def test_a_simulation_that_mujoco_gives_up_is_a_divergence(monkeypatch: pytest.MonkeyPatch) -> None:
    env = RandomizedEnv(CartPole(), 4)
    batch, td = env._stepper._batch, env.reset()  # type: ignore[attr-defined]

    def step(*args: Any, **kwargs: Any) -> None:
        raise mujoco.batch.SimulationError(np.array([2]), "arena is full")

    with monkeypatch.context() as patch:
        patch.setattr(batch, "step", step)
        after, td = env.step_and_maybe_reset(td.set("action", torch.zeros(4, 1)))
    assert after["next", "diverged"][:, 0].tolist() == [False, False, True, False]
    assert env.num_diverged == 1
    after, _ = env.step_and_maybe_reset(td.set("action", torch.zeros(4, 1)))
    assert not after["next", "diverged"].any()


def test_threads_and_company_do_not_matter() -> None:
    paths = []
    for num, threads in ((3, 1), (3, 2), (5, 2)):
        table = np.tile(MASSES.low + 1.0, (9, 1))
        states = random_states(MASSES.model, 5, 0.01)
        env = RandomizedEnv(
            starting(HopperTask(), states), num, space=MASSES, source=Rows(MASSES.names, table), num_threads=threads
        )
        paths.append(driven(env, actions_of(RandomizedEnv("hopper", 5), 10)[:, :num], resets=False)[0][:, :3])
    for path in paths[1:]:
        assert torch.equal(paths[0]["next", "observation"], path["next", "observation"])


@pytest.mark.parametrize("backend", ["mujoco", "warp"])
def test_a_reset_touches_its_own_rows_and_nothing_handed_out(backend: str) -> None:
    env = RandomizedEnv("hopper", 6, space=MASSES, backend=backend)
    steps, td = driven(env, actions_of(env, 4), resets=False)
    kept = steps.clone()
    before = copy.deepcopy(env.state_dict())["_extra_state"]
    mask = torch.tensor([False, True, False, False, True, False])
    after = env.reset(td.clone(False).set("_reset", mask[:, None]))
    now = env.state_dict()["_extra_state"]
    for key in ("values", "states", "observation", "count"):
        assert torch.equal(before[key][~mask], now[key][~mask])
        assert (before[key][mask] != now[key][mask]).any(1).all()
    for key, value in now["stepper"].items():
        if key != "failed":
            assert torch.equal(before["stepper"][key][~mask], value[~mask])
    assert torch.equal(after["observation"][~mask], steps[-1]["next", "observation"][~mask])
    assert after["step_count"][:, 0].tolist() == [4, 0, 4, 4, 0, 4]
    assert (steps == kept).all()


def test_what_was_handed_out_stays_through_automatic_resets() -> None:
    env = RandomizedEnv("hopper", 8, space=MASSES)
    td, seen, kept = env.reset(), [], []
    for action in actions_of(env, 40):
        after, td = env.step_and_maybe_reset(td.set("action", action))
        seen.append(after)
        kept.append(after.clone())
    assert any(s["next", "done"].any() for s in seen)
    assert all((s == k).all() for s, k in zip(seen, kept, strict=True))


def test_seeds_repeat() -> None:
    runs = []
    for seed in (3, 3, 4):
        env = RandomizedEnv("hopper", 5, space=MASSES, seed=seed)
        runs.append(driven(env, actions_of(env, 30))[0])
    assert (runs[0] == runs[1]).all()
    assert (runs[0]["observation"] != runs[2]["observation"]).any()
    env.set_seed(3)
    assert (driven(env, actions_of(env, 30))[0] == runs[0]).all()


MANY = [
    {"effect": "actuator_delay", "target": "thigh_motor", "delay": 0.011},
    {"effect": "actuator_lag", "target": "leg_motor", "time_constant": 0.02},
    {"effect": "actuator_backlash", "target": "foot_motor", "width": 0.2},
    {"effect": "sensor_delay", "target": "thigh_joint.position", "delay": 0.013},
    {"effect": "sensor_bias", "target": "leg_joint.position", "bias": 0.05},
]


def effects_on(space: ParameterSpace, given: list[dict], frame_skip: int, columns: tuple[str, ...]) -> EffectSet:
    observation = parse_observation(space.model, columns)
    return place_effects(given, space, plain_setting(space.model, observation, frame_skip), find_effect)


@pytest.mark.parametrize(
    ("backend", "given"),
    [
        ("mujoco", []),
        ("mujoco", [*MANY, {"effect": "joint_cogging", "target": "leg_joint", "amplitude": 5, "poles": 4, "phase": 0}]),
        ("warp", MANY),
    ],
    ids=["plain", "effects", "warp"],
)
def test_a_saved_state_goes_on_to_the_bit(backend: str, given: list, tmp_path: Path) -> None:
    def make(seed: int) -> RandomizedEnv:
        effects = effects_on(MASSES, given, 4, SIM.observation) if given else None
        return RandomizedEnv("hopper", 5, space=MASSES, effects=effects, seed=seed, backend=backend)

    env = make(0)
    actions = actions_of(env, 40)
    _, td = driven(env, actions[:17])
    torch.save({"env": env.state_dict(), "td": td}, tmp_path / "state.pt")
    straight, _ = driven(env, actions[17:], td=td)
    saved = torch.load(tmp_path / "state.pt", weights_only=False)
    other = make(9)
    driven(other, actions[:3])
    other.load_state_dict(saved["env"])
    resumed, _ = driven(other, actions[17:], td=saved["td"])
    assert straight["next", "done"].any()
    assert (straight == resumed).all()
    with pytest.raises(InputError, match=r"5 environments with 4 parameters; these are 2 with 4"):
        RandomizedEnv("hopper", 2, space=MASSES).load_state_dict(saved["env"])


@pytest.mark.parametrize("backend", ["mujoco", "warp"])
@pytest.mark.parametrize("varies", [False, True])
def test_specs(backend: str, varies: bool) -> None:
    check_env_specs(RandomizedEnv(CartPole(), 3, space=cart_space() if varies else None, backend=backend))
    check_env_specs(RandomizedEnv("hopper", 2, space=MASSES if varies else None, backend=backend))


def test_backends_agree() -> None:
    paths = []
    for backend in ("mujoco", "warp"):
        env = RandomizedEnv("hopper", 6, space=MASSES, backend=backend, seed=2)
        td, states = env.reset(), []
        for action in actions_of(env, 12):
            _, td = env.step_and_maybe_reset(td.set("action", action))
            states.append(env.states)
        paths.append(torch.stack(states))
    np.testing.assert_allclose(paths[0].numpy(), paths[1].numpy(), atol=1e-6)
    assert not torch.equal(*paths)


def test_a_time_limit_truncates() -> None:
    env = RandomizedEnv(starting(CartPole(), np.zeros((3, 4))), 3)
    steps, td = driven(env, torch.zeros(20, 3, 1))
    assert not steps["next", "terminated"].any()
    assert steps["next", "truncated"][..., 0].tolist() == [[False] * 3] * 19 + [[True] * 3]
    assert torch.equal(steps["next", "done"], steps["next", "truncated"])
    assert steps["next", "step_count"][:, 0, 0].tolist() == list(range(1, 21))
    assert td["step_count"].tolist() == [[0]] * 3


@pytest.mark.parametrize("backend", ["mujoco", "warp"])
def test_a_divergence_ends_its_episode_and_is_counted(backend: str) -> None:
    gear = {"gear": {"field": "actuator_gear", "name": "push", "bounds": [1.0, 1e30]}}
    space = ParameterSpace(CartPole().model, gear)
    source = Rows(("gear",), np.array([[1.0], [1e25], [1.0], [1.0], [1.0]]))
    env = RandomizedEnv(CartPole(), 3, space=space, source=source, backend=backend)
    begin = env.reset()
    steps, _ = driven(env, torch.ones(12, 3, 1), td=begin)
    assert env.num_diverged == 1
    first = steps[0]["next"]
    assert first["diverged"][:, 0].tolist() == [False, True, False]
    assert first["terminated"][1]
    assert first["reward"][1] == 0
    assert torch.equal(first["observation"][1], begin["observation"][1])
    assert not steps[1:]["next", "diverged"].any()
    for key in ("observation", "reward"):
        assert torch.isfinite(steps["next", key]).all()
        assert torch.isfinite(steps["observation"]).all()


def test_parameters_are_beside_the_observation() -> None:
    env = RandomizedEnv("hopper", 4, space=MASSES)
    td = env.reset()
    assert td["observation"].shape == (4, 11)
    assert torch.equal(td["parameters"], env.values.float())
    assert "parameters" not in RandomizedEnv("hopper", 4, space=MASSES, expose_parameters=False).reset()
    assert "parameters" not in RandomizedEnv("hopper", 4).reset()


def test_actions_must_be_numbers() -> None:
    env = RandomizedEnv(CartPole(), 3)
    action = torch.tensor([[0.0], [float("nan")], [0.0]])
    with pytest.raises(InputError, match=r"action: \[nan\] in environment 1 is not finite"):
        env.step(env.reset().set("action", action))


# ---------------------------------------------------------------------------------------------------------------------
# where parameters come from


def draw(source: ParameterSource, count: int = 2000) -> np.ndarray:
    return source.sample(count, torch.Generator().manual_seed(0)).numpy()


def test_sources(tmp_path: Path) -> None:
    logs = ParameterSpace(CartPole().model, {**CART, "cart_mass": {**CART["cart_mass"], "scale": "log"}})
    found = draw(load_source("uniform", logs))
    assert (found >= logs.low).all()
    assert (found <= logs.high).all()
    np.testing.assert_allclose(np.median(found, 0), [np.sqrt(1.5), 1.0], rtol=0.05)
    space = cart_space()
    assert draw(load_source("nominal", space), 2).tolist() == [[1.0, 0.1]] * 2
    assert draw(load_source({"damping": 0.3, "cart_mass": 2.0}, space), 2).tolist() == [[2.0, 0.3]] * 2
    fitted = Distribution.over(space, np.array([1.2, 0.5]), np.array([0.1, 0.05]))
    fitted.save(tmp_path / "fit.json")
    turned = ParameterSpace(CartPole().model, dict(reversed(CART.items())))
    for given in (fitted, tmp_path / "fit.json", str(tmp_path / "fit.json")):
        source = load_source(given, turned)
        assert source.names == ("damping", "cart_mass")
        np.testing.assert_array_equal(draw(source)[:, ::-1], draw(load_source(fitted, space)))
    np.testing.assert_allclose(draw(source).mean(0), [0.5, 1.2], rtol=0.01)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cart_mas": 1.0, "damping": 1.0}, r"unknown name 'cart_mas'; did you mean 'cart_mass'"),
        ({"damping": 1.0}, r"no value given for 'cart_mass'"),
        ("fit.json", r"distribution: no file fit.json"),
        (PointSource({"mass": 1.0}), r"distribution: parameter 'mass' is not in the model; did you mean 'cart_mass'"),
        (PointSource({"damping": 1.0}), r"distribution: it says nothing about parameter 'cart_mass'"),
        (Distribution.over(MASSES, MASSES.nominal, np.ones(4)), r"parameter 'torso_mass' is not in the model"),
    ],
)
def test_names_that_do_not_fit(given: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_source(given, cart_space())


def test_a_source_must_be_the_spaces() -> None:
    with pytest.raises(InputError, match="'mass' is not in the model"):
        RandomizedEnv(CartPole(), 2, space=cart_space(), source=PointSource({"mass": 1.0}))
    with pytest.raises(InputError, match="source: given without a space"):
        RandomizedEnv(CartPole(), 2, source=PointSource({"mass": 1.0}))


# ---------------------------------------------------------------------------------------------------------------------
# tasks


def test_tasks_are_found(tmp_path: Path) -> None:
    assert isinstance(load_task("hopper"), HopperTask)
    assert isinstance(load_task("dropo_sims.hopper.task:HopperTask"), HopperTask)
    code = (Path(__file__).parent / "cartpole.py").read_text()
    (tmp_path / "pole.py").write_text(code)
    assert load_task("pole.py:CartPole", base=tmp_path).name == "cartpole"
    task = CartPole()
    assert load_task(task) is task


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hoper", r"task: no bundled simulation 'hoper'; did you mean 'hopper'"),
        ("nowhere.py:A", r"task: no file .*nowhere.py"),
        ("pole.py:Cart", r"task: pole.py has no class 'Cart' that is a Task; did you mean 'CartPole'"),
        ("pole.py:fails", r"task: pole.py:fails fails, .*pole.py line \d+: ZeroDivisionError"),
        ("pole.py:number", r"task: pole.py:number makes a int; expected a subclass of dropo_torch.rl.Task"),
        ("pole.py:Half", r"task: pole.py:Half has no frame_skip"),
    ],
)
def test_tasks_that_cannot_be(name: str, message: str, tmp_path: Path) -> None:
    code = (Path(__file__).parent / "cartpole.py").read_text()
    code += "\ndef fails():\n    return 1 / 0\n\ndef number():\n    return 3\n"
    code += "\nclass Half(Task):\n    name, num_observations = 'half', 4\n"
    code += "    initial_states = observe = reward = terminated = CartPole.observe\n    model = CartPole().model\n"
    (tmp_path / "pole.py").write_text(code)
    with pytest.raises(InputError, match=message):
        load_task(name, base=tmp_path)


@pytest.mark.parametrize(
    ("method", "wrong", "message"),
    [
        ("initial_states", lambda n, g: torch.zeros(n, 3), r"initial_states\(1\) returns shape \(1, 3\).*\(1, 4\)"),
        ("observe", lambda s: s[:, :2], r"observe returns shape \(1, 2\) for one environment; expected \(1, 4\)"),
        ("reward", lambda s, a, n: s[:, :1], r"reward returns shape \(1, 1\) for one environment; expected \(1,\)"),
        ("reward", lambda s, a, n: 1.0, r"reward returns a float; expected a tensor"),
        ("terminated", lambda s: s[:, 0], r"terminated returns torch.float64; expected torch.bool"),
        ("controls", lambda a: a.repeat(1, 2), r"controls returns shape \(1, 2\)"),
        ("controls", lambda a: a[:, None].repeat(1, 2, 2), r"controls returns shape \(1, 2, 2\).*\(1, 2, 1\)"),
        ("controls", lambda a: a[:, None].repeat(1, 3, 1), r"controls returns 3 controls in a row.*frame_skip, 2"),
        ("observe", lambda s: s / s.nowhere, r"task: cartpole fails, .*test_rl_env.py line \d+: AttributeError"),
    ],
)
def test_what_a_task_returns_is_checked_at_once(method: str, wrong: Any, message: str) -> None:
    task = CartPole()
    setattr(task, method, wrong)
    with pytest.raises(InputError, match=message):
        RandomizedEnv(task, 2)


def test_controls_without_a_range_need_one() -> None:
    task = CartPole()
    task.model = mujoco.MjModel.from_xml_string(CART_POLE.replace('ctrlrange="-1 1"', ""))
    with pytest.raises(InputError, match=r"task: cartpole: actuator 'push' has no ctrlrange"):
        RandomizedEnv(task, 2)


def test_a_task_is_of_its_model() -> None:
    with pytest.raises(InputError, match=r"task: hopper is for a model with nq 6; this one has 2"):
        RandomizedEnv("hopper", 2, space=cart_space())
    heavier = HopperTask().on(MASSES.apply(MASSES.high))
    assert heavier.model.body_mass[1] == MASSES.high[0]
    for bad in (0, -1):
        with pytest.raises(InputError, match="num_envs"):
            RandomizedEnv("hopper", bad)
    with pytest.raises(InputError, match=r"backend: unknown 'mujocco'.*did you mean 'mujoco'"):
        RandomizedEnv("hopper", 2, backend="mujocco")


# ---------------------------------------------------------------------------------------------------------------------
# effects


class Mean(ActuatorDeadband):
    """An effect of a user's own: the mean of the last three commands, times a number."""

    name = "own_command_test"

    def settled(self, command: torch.Tensor, values: torch.Tensor, step: float) -> torch.Tensor:
        return command.expand(-1, 2)

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        known = torch.cat([state, signal], 1)
        return known.unfold(1, 3, 1).sum(-1) * (values[:, :1] / 3), known[:, -2:]

    def memory(self, values: np.ndarray) -> float:
        return 0.02


class Offset(SensorBias):
    """A sensor of a user's own."""

    name = "own_sensor_test"


RAIL = ("qpos", "qvel")
OWN = {name: {"effect": name, "target": "push"} for name in ("actuator_delay", "actuator_lag", "actuator_deadband")}
CASES: dict[str, tuple[list[dict], Mapping[str, Mapping[str, Any]]]] = {
    "delay": ([], {"x": {"effect": "actuator_delay", "name": "push", "bounds": [0.0, 0.07]}}),
    "lag": ([], {"x": {"effect": "actuator_lag", "name": "push", "bounds": [0.0, 0.05]}}),
    "deadband": ([], {"x": {"effect": "actuator_deadband", "name": "push", "bounds": [0.0, 0.6]}}),
    "backlash": ([], {"x": {"effect": "actuator_backlash", "name": "push", "bounds": [0.0, 0.9]}}),
    "chain": (
        [{**OWN["actuator_lag"], "time_constant": 0.015}, {**OWN["actuator_deadband"], "width": 0.1}],
        {"x": {"effect": "actuator_delay", "name": "push", "bounds": [0.0, 0.05]}},
    ),
    "own command": ([], {"x": {"effect": "own_command_test", "name": "push", "bounds": [0.2, 1.0]}}),
    "native": ([{"effect": "actuator_gain", "target": "push", "gain": 0.7}], CART),
    "native varies": ([], {"x": {"effect": "joint_friction", "name": "slide", "bounds": [0.0, 3.0]}, **CART}),
    "payload": (
        [{"effect": "payload", "target": "cart", "mass": 0.5, "x": 0.0, "y": 0.0, "z": 0.1}],
        CART,
    ),
    "finer": ([{"effect": "integration", "timestep": 0.0025}], CART),
    "finer varies": (
        [{"effect": "integration", "timestep": 0.0025}],
        {"x": {"effect": "joint_friction", "name": "slide", "bounds": [0.0, 3.0]}},
    ),
    "force": (
        [{"effect": "joint_cogging", "target": "slide", "poles": 9.0, "phase": 0.4}],
        {"x": {"effect": "joint_cogging", "name": "slide", "index": "amplitude", "bounds": [0.0, 4.0]}, **CART},
    ),
    "stribeck": (
        [{"effect": "joint_stribeck", "target": "slide", "coulomb": 1.0, "static": 2.0}],
        {"x": {"effect": "joint_stribeck", "name": "slide", "index": "velocity", "bounds": [0.05, 0.5]}},
    ),
    "presliding": (
        [{"effect": "joint_presliding", "target": "slide", "coulomb": 1.0}],
        {"x": {"effect": "joint_presliding", "name": "slide", "index": "displacement", "bounds": [0.002, 0.05]}},
    ),
    "wrench": (
        [{"effect": "external_force", "target": "cart", "y": 0.0, "z": 0.0}],
        {"x": {"effect": "external_force", "name": "cart", "index": "x", "bounds": [-3.0, 3.0]}},
    ),
    "sensors": (
        [{"effect": "sensor_scale", "target": "hinge.velocity", "factor": 1.3}],
        {"x": {"effect": "sensor_bias", "name": "slide.position", "bounds": [-0.5, 0.5]}},
    ),
    "own sensor": ([], {"x": {"effect": "own_sensor_test", "name": "slide.position", "bounds": [-0.5, 0.5]}}),
}  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def own_effects() -> None:
    for effect in (Mean(), Offset()):
        if effect.name not in VOCABULARY:
            register(effect)


def stretched() -> Task:
    """The cart and pole, never ending."""
    task = CartPole()
    task.max_episode_steps = 1000
    task.terminated = lambda states: torch.zeros(len(states), dtype=torch.bool)  # type: ignore[method-assign]
    return task


def rollout_of(case: str, backend: str, values: np.ndarray, shown: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """What the effects' own simulator makes of each row, ``(N, T, n)``."""
    given, parameters = CASES[case]
    space = ParameterSpace(CartPole().model, parameters)
    effects = effects_on(space, given, 2, RAIL)
    simulator = effect_simulator(
        backend, effects, space,
        lambda model, skip, inner: make_simulator(backend, model, parameters=inner, frame_skip=skip),
        timestep=0.02, longest=100,
    )  # fmt: skip
    controls = np.concatenate([np.repeat(actions[:, :1], simulator.history, 1), actions], 1)
    found = [
        simulator.rollout(*(torch.from_numpy(x[None]) for x in (shown[i], controls[i], values[i])))[0, 0]
        for i in range(len(values))
    ]
    return torch.stack(found).numpy()


WARP = ("delay", "lag", "deadband", "backlash", "chain", "own command", "native", "sensors", "own sensor")


@pytest.mark.parametrize(("case", "backend"), [(c, "mujoco") for c in CASES] + [(c, "warp") for c in WARP])
def test_effects_are_those_of_their_own_simulator(case: str, backend: str) -> None:
    given, parameters = CASES[case]
    num, steps = 3, 30
    space = ParameterSpace(CartPole().model, parameters)
    effects = effects_on(space, given, 2, RAIL)
    rng = np.random.default_rng(0)
    values = rng.uniform(space.low, space.high, (num, len(space)))
    values[0] = np.where([bool(p.effect) for p in space.parameters], space.low, values[0])
    states = 0.1 * rng.standard_normal((num, 4))
    env = RandomizedEnv(
        starting(stretched(), states), num, space=space, source=Rows(space.names, values), effects=effects,
        backend=backend,
    )  # fmt: skip
    # pushes that hold for a while, as a filter must outlast them
    actions = np.repeat(rng.uniform(-1, 1, (num, steps // 3, 1)), 3, 1).astype(np.float32)
    path, _ = driven(env, torch.from_numpy(actions).swapaxes(0, 1))
    for _ in range(2):  # an episode before leaves nothing behind
        env.source.next = 0  # type: ignore[attr-defined]
        path, _ = driven(env, torch.from_numpy(actions).swapaxes(0, 1))
    first = env.reset()["observation"].double().numpy() if case in ("sensors", "own sensor") else states
    expected = rollout_of(case, backend, values, first, actions.astype(np.float64))
    found = path["next", "observation"].swapaxes(0, 1)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=2e-6)
    plain, _ = driven(RandomizedEnv(starting(stretched(), states), num, backend=backend), path["action"].swapaxes(0, 0))
    assert (plain["next", "observation"] - path["next", "observation"]).abs().amax((0, 2))[1:].min() > 1e-3


def test_a_velocity_that_is_derived_from_a_late_position_is_late() -> None:
    delay = {"late": {"effect": "sensor_delay", "name": "slide.position", "bounds": [0, 0.08]}}
    space = ParameterSpace(CartPole().model, delay)
    given = [{"effect": "sensor_bias", "target": "hinge.position", "bias": 0.2}]
    effects = effects_on(space, given, 2, RAIL)
    effects = dataclasses.replace(effects, setting=dataclasses.replace(effects.setting, differentiated=True))
    source, states = Rows(("late",), np.array([[0.0], [0.04]])), np.tile([[0.1, 0.05, 0.5, -0.3]], (2, 1))
    env = RandomizedEnv(starting(stretched(), states), 2, space=space, source=source, effects=effects)
    td = env.reset()
    shown, true = [td["observation"]], [env.states]
    for action in actions_of(env, 10)[:, :1].expand(-1, 2, -1):
        td = env.step_mdp(env.step(td.set("action", action)))
        shown.append(td["observation"])
        true.append(env.states)
    shown, true = (torch.stack(x).double().numpy() for x in (shown, true))
    hidden = np.array([0.0, 0.2, 0.0, 0.0])
    np.testing.assert_allclose(shown[:, 0], true[:, 0] + hidden, atol=1e-6)
    late = true + hidden
    late[2:, :, [0, 2]] = true[:-2, :, [0, 2]]
    np.testing.assert_allclose(shown[2:, 1], late[2:, 1], atol=1e-6)
    assert np.abs(shown[2:, 1] - true[2:, 1]).min(0)[2] > 0


@pytest.mark.parametrize("column", ["slide.position", "hinge.velocity"])
def test_a_late_sensor_shows_what_was(column: str) -> None:
    space = ParameterSpace(CartPole().model, {"late": {"effect": "sensor_delay", "name": column, "bounds": [0, 0.08]}})
    effects = effects_on(space, [], 2, RAIL)
    source = Rows(("late",), np.array([[0.0], [0.04], [0.08]]))
    states = np.tile([[0.1, 0.05, 0.5, -0.3]], (3, 1))
    env = RandomizedEnv(starting(stretched(), states), 3, space=space, source=source, effects=effects)
    td = env.reset()
    at = RAIL_LABELS.index(column)
    shown, true = [td["observation"]], [env.states]
    for action in actions_of(env, 10)[:, :1].expand(-1, 3, -1):
        td = env.step_mdp(env.step(td.set("action", action)))
        shown.append(td["observation"])
        true.append(env.states)
    shown, true = (torch.stack(x).double().numpy() for x in (shown, true))
    others = [i for i in range(4) if i != at]
    np.testing.assert_allclose(shown[..., others], true[..., others], atol=1e-6)
    for row, late in ((0, 0), (1, 2), (2, 4)):
        np.testing.assert_allclose(shown[late:, row, at], true[: 11 - late, row, at], atol=1e-6)
        before = np.arange(-late, 0) * 0.02
        rate = true[0, row, 2] if at == 0 else 0.0
        np.testing.assert_allclose(shown[:late, row, at], true[0, row, at] + rate * before, atol=1e-6)


RAIL_LABELS = ("slide.position", "hinge.position", "slide.velocity", "hinge.velocity")


def test_sensors_deceive_the_observation_alone() -> None:
    space = ParameterSpace(CartPole().model, CART)
    given = [{"effect": "sensor_bias", "target": "hinge.position", "bias": 2.0}]
    plain, biased = (
        driven(RandomizedEnv(CartPole(), 3, space=space, effects=e), torch.zeros(10, 3, 1))[0]["next"]
        for e in (None, effects_on(space, given, 2, RAIL))
    )
    np.testing.assert_allclose(biased["observation"].numpy(), plain["observation"].numpy() + [0, 2.0, 0, 0], atol=1e-6)
    for key in ("reward", "terminated"):
        assert torch.equal(plain[key], biased[key])


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("force", r"backend warp cannot have joint_cogging at slide, a force in the simulation"),
        ("native varies", r"joint_friction at slide has a number that varies, which backend warp cannot"),
    ],
)
def test_what_warp_cannot_have(case: str, message: str) -> None:
    given, parameters = CASES[case]
    space = ParameterSpace(CartPole().model, parameters)
    effects = effects_on(space, given, 2, RAIL)
    with pytest.raises(InputError, match=message):
        RandomizedEnv(CartPole(), 2, space=space, effects=effects, backend="warp")


def test_effects_and_parameters_go_together() -> None:
    space = ParameterSpace(CartPole().model, CASES["delay"][1])
    with pytest.raises(InputError, match=r"parameters.x: a number of an effect, but no effects are given"):
        RandomizedEnv(CartPole(), 2, space=space)
    with pytest.raises(InputError, match=r"effects: understood with frame_skip 5; task cartpole has 2"):
        RandomizedEnv(CartPole(), 2, space=space, effects=effects_on(space, [], 5, RAIL))


# ---------------------------------------------------------------------------------------------------------------------
# Gymnasium


def test_gymnasiums_view_is_the_same_environment() -> None:
    vector = RandomizedVectorEnv(RandomizedEnv("hopper", 6, space=MASSES))
    env = RandomizedEnv("hopper", 6, space=MASSES, seed=5)
    observation, infos = vector.reset(seed=5)
    td = env.reset()
    assert vector.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP
    np.testing.assert_array_equal(observation, td["observation"].numpy())
    np.testing.assert_array_equal(infos["parameters"], env.values.numpy())
    assert observation in vector.observation_space
    finished = 0
    for action in actions_of(env, 40):
        after, td = env.step_and_maybe_reset(td.set("action", action))
        assert action.numpy() in vector.action_space
        observation, reward, terminated, truncated, infos = vector.step(action.numpy())
        np.testing.assert_array_equal(observation, td["observation"].numpy())
        np.testing.assert_array_equal(reward, after["next", "reward"][:, 0].double().numpy())
        np.testing.assert_array_equal(terminated, after["next", "terminated"][:, 0].numpy())
        np.testing.assert_array_equal(truncated, after["next", "truncated"][:, 0].numpy())
        np.testing.assert_array_equal(infos["parameters"], env.values.numpy())
        assert observation in vector.observation_space
        for row in np.flatnonzero(terminated | truncated):
            np.testing.assert_array_equal(infos["final_obs"][row], after["next", "observation"][row].numpy())
            assert infos["_final_obs"][row]
            finished += 1
    assert finished > 0


def test_gymnasiums_wrappers_understand_the_view() -> None:
    vector = RecordEpisodeStatistics(RandomizedVectorEnv(RandomizedEnv(starting(CartPole(), np.zeros((4, 4))), 4)))
    vector.reset(seed=0)
    for _ in range(20):
        *_, infos = vector.step(np.zeros((4, 1)))
    np.testing.assert_allclose(infos["episode"]["r"], 20.0, rtol=1e-6)
    assert infos["episode"]["l"].tolist() == [20] * 4
    mask = np.array([True, False, True, False])
    before = vector.env.env.states
    vector.reset(options={"reset_mask": mask})
    assert torch.equal(before[1::2], vector.env.env.states[1::2])
    with pytest.raises(InputError, match="seed: several given"):
        vector.env.reset(seed=[1, 2, 3, 4])
    vector.close()


# --- numbers that are not numbers -----------------------------------------------------------------------------


@pytest.mark.parametrize("broken", ["reward", "observe"])
def test_a_task_that_gives_no_number_ends_the_episode(broken: str) -> None:
    """Nothing that is not finite leaves the environment; the step is counted, and its episode is over."""
    task = stretched()
    sound, calls = getattr(task, broken), [0]

    def sometimes(*arguments: torch.Tensor) -> torch.Tensor:
        out = sound(*arguments)
        calls[0] += 1
        if calls[0] % 5 == 3 and len(out) == 4:
            out = out.clone()
            out[2] = torch.nan
        return out

    env = RandomizedEnv(task, 4)
    setattr(env.task, broken, sometimes)
    data = env.rollout(40, break_when_any_done=False)
    after = data["next"]
    assert torch.isfinite(after["reward"]).all()
    assert torch.isfinite(after["observation"]).all()
    ended = after["terminated"][..., 0].sum(1)
    assert ended[2] == env.num_repaired > 0
    assert ended[[0, 1, 3]].sum() == 0
    setattr(env.task, "observe", lambda states: torch.full((len(states), 4), torch.nan))  # noqa: B010
    with pytest.raises(InputError, match="observe gives a number that is not finite for a start state"):
        env.reset()


def test_a_state_in_memory_is_a_snapshot() -> None:
    """Episodes that begin after it was taken change nothing in it."""
    env = RandomizedEnv("hopper", 8, space=MASSES, seed=1)
    td = env.reset()
    actions = actions_of(env, 60)
    state = env.state_dict()
    first, _ = driven(env, actions, td=td.clone())
    driven(env, actions_of(env, 60, 5), td=env.reset())
    env.load_state_dict(state)
    again, _ = driven(env, actions, td=td.clone())
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a["next", "observation"], b["next", "observation"])


def test_a_snapshot_has_what_forces_remember() -> None:
    """Bristles that are bent stay so: the forces after a snapshot are those that follow it, whatever came between."""
    space = ParameterSpace.empty(CartPole().model)
    given = [{"effect": "joint_presliding", "target": "slide", "coulomb": 1.0, "displacement": 0.01}]
    stepper = MujocoStepper(space, 2, frame_skip=2, effects=effects_on(space, given, 2, RAIL), num_threads=1)
    rows, none, push = torch.arange(2), torch.zeros(2, 0, dtype=torch.float64), torch.full((2, 1, 1), 0.2)
    stepper.reset(rows, torch.zeros(2, 4, dtype=torch.float64), none)
    for _ in range(10):
        stepper.step(push)
    kept = stepper.state_dict()
    first = [stepper.step(-push) for _ in range(5)]
    stepper.reset(rows, torch.ones(2, 4, dtype=torch.float64), none)
    stepper.load_state_dict(kept, none)
    for expected in first:
        assert torch.equal(stepper.step(-push), expected)


def test_a_space_over_another_model_brings_its_bounds_and_its_time() -> None:
    spec = mujoco.MjSpec.from_file(str(SIM.model))
    spec.option.timestep = 0.001
    for actuator in spec.actuators:
        actuator.ctrlrange = [-3, 3]
    env = RandomizedEnv("hopper", 2, space=ParameterSpace.empty(spec.compile()))
    assert env.action_spec.high.tolist() == [[3, 3, 3]] * 2
    assert env.task.timestep == pytest.approx(0.001 * env.task.frame_skip)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("frame_skip", 2.0, "frame_skip is 2.0; expected a whole number"),
        ("frame_skip", 0, "frame_skip is 0"),
        ("max_episode_steps", float("inf"), "max_episode_steps is inf"),
        ("action_low", np.array([2.0]), "action 0 is between 2 and"),
        ("action_high", np.array([np.inf]), "expected two finite numbers"),
        ("action_low", -1.0, "have shapes"),
    ],
)
def test_numbers_of_a_task_are_checked(name: str, value: Any, message: str) -> None:
    task = CartPole()
    setattr(task, name, value)
    with pytest.raises(InputError, match=message):
        RandomizedEnv(task, 1)


def test_a_distribution_is_of_what_the_model_allows(tmp_path: Path) -> None:
    space = ParameterSpace(CartPole().model, {"mass": {"field": "body_mass", "name": "cart", "bounds": [0.5, 2.0],
                                                       "unit": "kg"}})  # fmt: skip
    with pytest.raises(InputError, match=r"distribution: mass is -2; the model allows 0"):
        load_source({"mass": -2.0}, space)
    good = {"mean": 1.0, "std": 0.1, "low": 0.5, "high": 2.0, "unit": "kg"}
    for change, message in {
        ("mean", -2.0): "mass reaches from",
        ("std", -0.1): "a std above 0",
        ("mean", float("nan")): "finite numbers",
        ("unit", "g"): "mass is in 'g' there and in 'kg' here",
        ("scale", "log"): "no number 'log_mean'",
    }.items():
        path = tmp_path / "d.json"
        path.write_text(json.dumps({"parameters": {"mass": {**good, change[0]: change[1]}}}))
        with pytest.raises(InputError, match=message):
            load_source(str(path), space)
