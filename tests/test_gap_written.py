"""What a search writes is what it found: its model and config simulate the same, in fits, in trainings, in MuJoCo."""

from __future__ import annotations

import dataclasses
import functools
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml

from dropo_torch.config import load_config
from dropo_torch.data.features import Features
from dropo_torch.data.observation import parse_observation
from dropo_torch.effects import VOCABULARY, Placed, find_effect
from dropo_torch.effects.base import Setting
from dropo_torch.effects.engine import ModelRefused, Variant, VariantEngine
from dropo_torch.effects.export import write_model
from dropo_torch.effects.placing import plain_setting
from dropo_torch.errors import InputError
from dropo_torch.gap import Gap, add, find_gap, prepare
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import cut_windows, make_setting
from dropo_torch.gap.refit import Hypothesis, refit
from dropo_torch.gap.result import NamedEffect, Score, Strength
from dropo_torch.gap.twin import Twin, Windows
from dropo_torch.gap.verify import Held, score
from dropo_torch.likelihood import gaussian_log_density
from dropo_torch.models.load import load_model
from dropo_torch.parameters import ParameterSpace
from dropo_torch.problem import Problem, make_problem
from dropo_torch.testing.effects import RIG

SKIP, STEP = 4, 0.005
EPISODES, ROWS = 2, 40
MASS = {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.5], "unit": "kg"}
LIGHT = 0.75
#: Measurement noise of positions and velocities; less would show that MJCF has six digits.
NOISE = (2e-5, 5e-4)
FINER = Placed(find_effect("integration"), None, (STEP / 8,))
#: Numbers at which an effect acts on the rig, beside those from which a search begins.
NUMBERS = {
    "joint_limit": {"lower": 0.4, "upper": -0.4}, "joint_stop": {"lower": 0.0, "upper": 0.1},
    "actuator_saturation": {"limit": 0.3},
    "actuator_delay": {"delay": 2.375 * STEP}, "sensor_delay": {"delay": 1.375 * STEP},
}  # fmt: skip
PENDULUM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="swing" type="hinge" axis="0 1 0"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1"/>
    </body>
  </worldbody>
</mujoco>"""
DRIVEN = PENDULUM.replace("</mujoco>", '<actuator><motor name="drive" joint="swing"/></actuator></mujoco>')
#: Two jaws that only slide, of which one follows the other, up to its stop.
GRIPPER = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="palm"><geom size=".03" mass=".5" contype="0"/>
    <body name="left" pos="0 .1 0">
      <joint name="left" type="slide" axis="0 1 0" limited="true" range="-.02 .02" damping="4" armature=".3"/>
      <geom type="box" size=".01 .02 .03" mass=".12" contype="0"/>
    </body>
    <body name="right" pos="0 -.1 0">
      <joint name="right" type="slide" axis="0 -1 0" damping="4"/>
      <geom type="box" size=".01 .02 .03" mass=".2" contype="0"/>
    </body>
  </body></worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0 1 0 0 0" solref=".01 1"/></equality>
  <actuator><motor name="grip" joint="left" gear="3"/></actuator>
</mujoco>"""
TASK = """
import mujoco, torch
from pathlib import Path
from dropo_torch.rl import Task

class Rig(Task):
    name, frame_skip, max_episode_steps, num_observations = "rig", 4, 20, 9
    action_low, action_high = -torch.ones(3).numpy(), torch.ones(3).numpy()
    def __init__(self):
        self.model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("rig.xml")))
    def initial_states(self, count, generator):
        rest = torch.from_numpy(self.model.qpos0)
        return torch.cat([rest, torch.zeros(self.model.nv, dtype=torch.float64)]).repeat(count, 1)
    def observe(self, states):
        return states[:, -9:]
    def reward(self, states, actions, next_states):
        return next_states[:, 0]
    def terminated(self, next_states):
        return torch.zeros(len(next_states), dtype=torch.bool)
"""


@functools.cache
def plain() -> Setting:
    spec = mujoco.MjSpec.from_string(RIG)
    for body in spec.bodies[1:]:
        body.simple = 0
    model = spec.compile()
    return plain_setting(model, parse_observation(model, None), SKIP, 0.3)


def acting(name: str) -> Placed:
    """An effect at the first place where it acts, with numbers that matter there."""
    effect, setting = find_effect(name), plain()
    targets = [t for t in effect.targets(setting) if t not in ("upper", "cart", "root.position[x]")]
    target = targets[0]
    values = np.array(effect.starts(setting, target)[-1], dtype=np.float64)
    for i, q in enumerate(effect.quantities(setting, target)):
        if values[i] == q.neutral:
            values[i] = np.clip(q.neutral + 0.3 * q.scale, q.low, q.high)
        values[i] = NUMBERS.get(name, {}).get(q.name, values[i])
    return Placed(effect, target, tuple(values.tolist()))


def log_of(placed: tuple[Placed, ...]) -> dict[str, Any]:
    """A log of the rig with effects in it, as the search's own simulation has them."""
    setting, rng = plain(), np.random.default_rng(0)
    model, chart = setting.model, Features.of(setting.observation)
    space = ParameterSpace(model, {"mass": MASS})
    starts = np.tile(np.concatenate([model.qpos0, np.zeros(model.nv)]), (EPISODES, 1))
    starts[:, [0, 1, 9]] += rng.uniform(-0.5, 0.5, (EPISODES, 3))
    starts[:, model.nq :] += rng.normal(0, 0.5, (EPISODES, model.nv))
    time = np.arange(ROWS + 1) * SKIP * STEP
    phase = rng.uniform(0, 6, (EPISODES, 1, model.nu))
    commands = np.sin(2 * np.pi * 1.5 * time[None, :, None] + phase)
    commands[:, :6] = commands[:, 6:7]  # at rest before the motion
    windows = Windows(
        np.repeat(starts[:, None], ROWS + 1, 1), np.zeros_like(starts), np.arange(EPISODES),
        np.zeros(EPISODES, dtype=int), commands,
    )  # fmt: skip
    shown, _ = Twin(setting, space, num_threads=1).predict([Variant((LIGHT,), placed)], windows)
    columns = np.array([NOISE[c >= model.nq] for c in range(model.nq + model.nv)])
    noise = chart.feature_noise(columns)
    measured = chart.move(shown[0], noise * rng.standard_normal((EPISODES, ROWS + 1, chart.size)))
    ends = np.zeros((EPISODES, ROWS), dtype=bool)
    ends[:, -1] = True
    rows = {"observations": measured[:, :-1], "next_observations": measured[:, 1:], "actions": commands[:, :-1]}
    flat = {k: v.reshape(EPISODES * ROWS, -1) for k, v in rows.items()}
    return {**flat, "terminals": ends.ravel(), "dt": SKIP * STEP}


def problem_of(folder: Path, placed: tuple[Placed, ...], xml: str = RIG, **changes: Any) -> Problem:
    (folder / "rig.xml").write_text(xml)
    (folder / "rig_task.py").write_text(TASK)
    np.savez(folder / "log.npz", **log_of(placed))
    document = {
        "model": "rig.xml", "data": "log.npz", "frame_skip": SKIP, "parameters": {"mass": MASS}, "threads": 1,
        "task": "rig_task.py:Rig", "train": {"num_envs": 2}, **changes,
    }  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump({k: v for k, v in document.items() if v is not ...}))
    return make_problem(load_config(folder / "config.yaml"), general=True)


def gap_of(problem: Problem, hypothesis: Hypothesis) -> Gap:
    """What a search would say that has found a hypothesis."""
    setting = make_setting(problem, problem.trajectories)
    columns = np.array([NOISE[c >= setting.model.nq] for c in setting.observation.columns])
    nothing, effects = Score(0, 0, 0), []
    for p in hypothesis.placed:
        quantities = p.effect.quantities(setting, p.target)
        strengths = {
            q.name: Strength(v, v - 0.02 * q.scale, v + 0.02 * q.scale, q.unit)
            for q, v in zip(quantities, p.values, strict=True)
        }
        effects.append(NamedEffect(*p.key, strengths, 0.5))
    names = problem.space.names
    features = Features.of(problem.observation)
    return Gap(
        (), tuple(effects), nothing, nothing, nothing, None, True,
        {n: (v, v, v) for n, v in zip(names, hypothesis.declared, strict=True)},
        tuple(features.feature_noise(columns)), features.labels, features.units, (10.0, 1.0),
    )  # fmt: skip


def vector(problem: Problem, hypothesis: Hypothesis, setting: Setting, model: mujoco.MjModel | None) -> np.ndarray:
    """The numbers of a hypothesis in the parameters of a written config."""
    numbers = {(p.effect.name, p.target): p.summary(setting) for p in hypothesis.placed}
    found = []
    for parameter in problem.space.parameters:
        if parameter.name == "mass":
            found.append(hypothesis.declared[0])
        elif parameter.effect:
            own = numbers[parameter.effect, next(iter(parameter.objects), None)]
            found.append(own[parameter.quantity] if parameter.quantity else next(iter(own.values())))
        else:
            found.append(parameter.nominal(model))
    return np.array(found)


def likelihood(problem: Problem, values: np.ndarray) -> np.ndarray:
    """The objective of a fit at one parameter vector, of each row, with the noise as it is given, ``(T,)``."""
    objective = problem.objective
    initial = objective.initial_noise(values, widen=False)
    out: list[torch.Tensor] = []

    def reduce(features: torch.Tensor, measured: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
        out.append(gaussian_log_density(measured - features[:, 0], covariance))
        return torch.zeros(1)

    objective.map(values[None], reduce, initial=initial)
    return torch.cat(out).numpy()


#: Those that are tried always: the model's own numbers, forces, commands, sensors, and the step.
QUICK = (("payload",), ("joint_stribeck", "integration"), ("actuator_delay", "integration"), ("sensor_bias",))
PLACED = [n for n, effect in VOCABULARY.items() if effect.targets(plain())]
EVERY = [(n,) for n in PLACED] + [(n, "integration") for n in PLACED if not VOCABULARY[n].steps]


@pytest.mark.parametrize("names", QUICK, ids="+".join)
def test_what_is_written_is_what_was_found(names: tuple[str, ...], tmp_path: Path) -> None:
    require_same_everywhere(names, tmp_path)


@pytest.mark.parametrize("names", [n for n in EVERY if n not in QUICK], ids="+".join)
def test_of_every_effect_what_is_written_is_what_was_found(names: tuple[str, ...], tmp_path: Path) -> None:
    require_same_everywhere(names, tmp_path)


def require_same_everywhere(names: tuple[str, ...], tmp_path: Path) -> None:
    """The law: what was found gives a fit's likelihood, steps in training, and MuJoCo's next states."""
    placed = tuple(FINER if n == "integration" else acting(n) for n in names)
    problem = problem_of(tmp_path, placed)
    hypothesis, out = Hypothesis((LIGHT,), placed), tmp_path / "out"
    out.mkdir()
    gap = gap_of(problem, hypothesis)
    notes = add(problem, gap, out)
    setting = make_setting(problem, problem.trajectories)
    twin = Twin(setting, problem.space, num_threads=1)
    windows = cut_windows(problem.trajectories, problem.observation, 1, stride=1)
    evidence = Evidence(twin, windows, np.array(gap.noise), hypothesis.variant, rough=False)
    # a fit
    written = make_problem(load_config(out / "config.yaml"))
    values = vector(written, hypothesis, setting, VariantEngine(setting, problem.space).model(hypothesis.variant))
    assert (values >= written.space.low).all()
    assert (values <= written.space.high).all()
    assert "timestep" not in " ".join(written.space.names)
    rows, found = written.objective.transitions.rows, likelihood(written, values)  # those whose commands are known
    assert len(found) == len(rows) == len(windows) - written.left_out > 0
    after = score(
        evidence, Held(problem.trajectories, rows, windows, 0.0, np.zeros(0), np.zeros(0, int)), hypothesis
    ).log_likelihood
    assert abs(found.sum() - after) <= len(found) / 100, notes
    # a training
    from dropo_torch.rl.problem import make_training

    training = make_training(load_config(out / "config.yaml"))
    env = training.env(training.training, 2, 0)
    after_step = env.step(env.reset().set("action", torch.full((2, 3), 0.1)))
    assert env.num_diverged == 0
    assert torch.isfinite(after_step["next", "observation"]).all()
    assert env.task.timestep == pytest.approx(SKIP * STEP)
    # MuJoCo
    if all(p.effect.in_mjcf for p in placed):
        model = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
        data, steps = mujoco.MjData(model), round(SKIP * STEP / model.opt.timestep)
        ours, _ = twin.predict([hypothesis.variant], windows)
        theirs = []
        for window in range(len(windows)):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = np.split(windows.measured[window, 0], [model.nq])
            data.ctrl[:] = windows.commands[windows.episodes[window], windows.steps[window]]
            mujoco.mj_step(model, data, nstep=steps)
            theirs.append(np.concatenate([data.qpos, data.qvel]))
        size = ours[0, :, 1].std(0)
        assert (np.median(np.abs(np.array(theirs) - ours[0, :, 1]), axis=0) <= 1e-4 * np.maximum(size, 1e-2)).all()
        assert (steps > SKIP) == any(VOCABULARY[n].steps for n in names)


@pytest.mark.parametrize("warp", [False, True])
def test_a_late_command_acts_within_a_step_that_was_made_finer(warp: bool) -> None:
    model = mujoco.MjModel.from_xml_string(DRIVEN)
    setting = plain_setting(model, parse_observation(model, None), SKIP)
    rng, late = np.random.default_rng(0), 3
    commands = rng.uniform(-1, 1, (1, ROWS + 1, 1))
    windows = Windows(np.zeros((1, ROWS + 1, 2)), np.zeros((1, 2)), np.array([0]), np.array([0]), commands)
    delay = Placed(find_effect("actuator_delay"), "drive", (late * STEP / 8,))
    twin = Twin(setting, ParameterSpace.empty(model), num_threads=1, warp=warp)
    others = [Variant((), placed) for placed in ((), (FINER,), (delay,), (FINER, delay))]
    found, known = twin.predict(others, windows)
    assert known.all()
    assert twin.simulated_transitions == len(others) * ROWS
    alone = [twin.predict([variant], windows)[0][0] for variant in others]
    np.testing.assert_array_equal(found, alone)
    model.opt.timestep, model.opt.integrator = STEP / 8, mujoco.mjtIntegrator.mjINT_RK4
    data, truth, fine = mujoco.MjData(model), [], np.repeat(commands[0, :-1], 8 * SKIP, axis=0)
    for command in np.concatenate([fine[:1]] * late + [fine[:-late]]):
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        truth.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(found[3, 0, 1:], truth[8 * SKIP - 1 :: 8 * SKIP], rtol=1e-9, atol=1e-12)
    assert np.abs(found[3] - found[1]).max() > 1e-3


@pytest.mark.parametrize("passive", [False, True])
@pytest.mark.parametrize(
    "flags", ['settotalmass="5"', 'boundmass="2" boundinertia="0.05"', 'settotalmass="5" balanceinertia="true"']
)
def test_a_model_that_the_compiler_rescales_is_written_as_it_is(flags: str, passive: bool, tmp_path: Path) -> None:
    xml = RIG.replace("<mujoco>", f"<mujoco><compiler {flags}/>")
    if passive:
        xml = re.sub("<actuator>.*</actuator>", "", xml, flags=re.DOTALL)
    (tmp_path / "rig.xml").write_text(xml)
    added = Placed(find_effect("payload"), "lower", (0.2, 0.05, 0.0, -0.1))
    assert write_model(tmp_path / "rig.xml", [added], tmp_path / "model.xml") == []
    before, after = (load_model(tmp_path / f"{n}.xml") for n in ("rig", "model"))
    grown = np.where(np.array(plain().names("body")) == "lower", 0.2, 0.0)
    np.testing.assert_allclose(after.body_mass, before.body_mass + grown, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "values", "moved"),
    [
        ("joint_friction", (0.0,), False), ("joint_friction", (0.3,), False), ("inertia", (1.5,), False),
        ("center_of_mass", (0.0, 0.0, 0.01), True), ("payload", (0.1, 0.0, 0.0, 0.0), True),
    ],
)  # fmt: skip
def test_bodies_that_only_slide_are_written_as_they_are(
    name: str, values: tuple[float, ...], moved: bool, tmp_path: Path
) -> None:
    """Of a body whose center or axes are elsewhere, the weight is another one, as in the search's simulation."""
    source, path = tmp_path / "gripper.xml", tmp_path / "model.xml"
    source.write_text(GRIPPER)
    placed = Placed(find_effect(name), "left", values)
    write_model(source, [placed], path)
    written, plain_one = load_model(path), load_model(source)
    assert written.body("right").simple == plain_one.body("right").simple == 2
    assert written.body("left").simple == (0 if moved else 2)
    general = load_model(source, general=True)
    setting = plain_setting(general, parse_observation(general, None), SKIP)
    found = VariantEngine(setting, ParameterSpace.empty(general)).model(Variant((), (placed,)))
    np.testing.assert_allclose(written.body_invweight0, found.body_invweight0, rtol=1e-5)
    paths, controls = [], np.repeat([1.0, -1.0, 1.0], 150)
    for model in (found, written, plain_one):
        data, path_of = mujoco.MjData(model), []
        for control in controls:
            data.ctrl[0] = control
            mujoco.mj_step(model, data)
            path_of.append(np.concatenate([data.qpos, data.qvel]))
        paths.append(path_of)
    np.testing.assert_allclose(paths[0], paths[1], rtol=0, atol=1e-5)
    assert np.abs(np.array(paths[0])[:, 0]).max() > 0.019
    if placed.is_neutral(setting):
        np.testing.assert_allclose(paths[1], paths[2], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("masked", "derived"), [(False, {}), (True, {}), (True, {"velocities": [], "derive": ["angle"]})]
)
def test_an_encoder_that_is_late_is_late_in_the_velocity_that_is_derived_from_it(
    masked: bool, derived: dict[str, list[str]], tmp_path: Path
) -> None:
    """One effect explains both columns, and what is written has it as it was found."""
    late, rng = 0.03, np.random.default_rng(5)
    model = mujoco.MjModel.from_xml_string(DRIVEN)
    data, fine, count = mujoco.MjData(model), [], round(late / STEP)
    data.qpos[0] = 0.5
    commands = np.repeat(rng.uniform(-2, 2, 60), 10)
    for step in range(600 * SKIP):
        data.ctrl[0] = commands[step // SKIP]
        fine.append(data.qpos[0])
        mujoco.mj_step(model, data)
    angles = np.array(fine)[np.maximum(np.arange(600) * SKIP - count, 0)] + 1e-5 * rng.standard_normal(600)
    rows = np.column_stack([np.arange(600) * SKIP * STEP, angles, commands])[5:]
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,angle,drive", comments="")
    (tmp_path / "pendulum.xml").write_text(DRIVEN)
    document = {
        "model": "pendulum.xml", "frame_skip": SKIP, "threads": 1, "mask": ["swing.velocity"] if masked else [],
        "data": {
            "path": "log.csv", "time": "t", "observations": ["angle"], "actions": ["drive"],
            "preprocess": {"dt": SKIP * STEP, "actions": "hold"} | derived,
        },
    }  # fmt: skip
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    problem = make_problem(load_config(tmp_path / "config.yaml"), general=True)
    gap = find_gap(problem, effects=[find_effect(n) for n in ("joint_friction", "sensor_delay", "sensor_scale")])
    assert [(e.effect, e.target) for e in gap.effects] == [("sensor_delay", "swing.position")]
    assert gap.effects[0].parameters["delay"].value == pytest.approx(late, rel=0.01)
    (tmp_path / "out").mkdir()
    add(problem, gap, tmp_path / "out")
    effects = make_problem(load_config(tmp_path / "out" / "config.yaml")).effects
    assert effects is not None
    assert effects.setting.differentiated


def test_a_step_is_never_a_parameter(tmp_path: Path) -> None:
    step = {"effect": "integration", "bounds": [STEP / 8, STEP]}
    with pytest.raises(InputError, match=r"parameters.step: timestep of integration is a choice.*give it in effects"):
        problem_of(tmp_path, (), parameters={"mass": MASS, "step": step})


@pytest.mark.parametrize("ratio", [1.5, 6.5])
def test_steps_that_do_not_fill_the_models_are_refused(ratio: float) -> None:
    setting = plain()
    engine = VariantEngine(setting, ParameterSpace(setting.model, {"mass": MASS}))
    with pytest.raises(ModelRefused, match="no whole number"):
        engine.model(Variant((LIGHT,), (Placed(find_effect("integration"), None, (STEP / ratio,)),)))


def test_a_fit_of_the_search_leaves_the_step_where_it_is(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, (FINER,))
    setting = make_setting(problem, problem.trajectories)
    windows = cut_windows(problem.trajectories, problem.observation, 8)
    noise = Features.of(problem.observation).feature_noise(np.array([NOISE[c >= 10] for c in range(19)]))
    evidence = Evidence(Twin(setting, problem.space, num_threads=1), windows, noise, Variant((0.9,)), rough=False)
    found = refit(evidence, Hypothesis((0.9,), (FINER,)), iterations=4).hypothesis
    assert found.placed == (FINER,)
    assert found.declared[0] == pytest.approx(LIGHT, rel=1e-2)


def test_what_the_config_has_already_is_told(tmp_path: Path) -> None:
    own = acting("joint_friction")
    given = {"effect": "joint_friction", "target": own.target, "friction": 0.1}
    problem = problem_of(tmp_path, (), effects=[given])
    (tmp_path / "out").mkdir()
    notes = add(problem, gap_of(problem, Hypothesis((LIGHT,), (own,))), tmp_path / "out")
    assert "the config has joint_friction of shoulder already" in notes[-1]
    assert not (tmp_path / "out" / "config.yaml").exists()


def test_a_log_that_cannot_be_simulated_or_does_not_move_is_refused(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, ())
    log = problem.trajectories
    far = dataclasses.replace(log, observations=1e8 * log.observations, next_observations=1e8 * log.next_observations)
    with pytest.raises(InputError, match=r"diverges within 6 steps from every state of the log; .* reaches"):
        prepare(dataclasses.replace(problem, trajectories=far))
    still = np.tile(log.observations[:1], (len(log), 1))
    with pytest.raises(InputError, match="nothing moves"):
        prepare(dataclasses.replace(problem, trajectories=dataclasses.replace(log, observations=still)))


def test_a_passive_system_is_searched(tmp_path: Path) -> None:
    """No actuator, one episode: what is missing is found, and what is written fits."""
    rng, space = np.random.default_rng(2), {"damping": {"field": "dof_damping", "name": "swing", "bounds": [0.0, 0.2]}}
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    data, rows = mujoco.MjData(model), []
    model.dof_frictionloss[:] = 0.05
    data.qvel[0] = 3.0
    for _ in range(161):
        rows.append(np.concatenate([data.qpos, data.qvel]))
        mujoco.mj_step(model, data, nstep=4)
    states = np.array(rows) + rng.standard_normal((161, 2)) * NOISE
    ends = np.arange(160) == 159
    log = {"observations": states[:-1], "next_observations": states[1:], "actions": np.zeros((160, 0))}
    np.savez(tmp_path / "log.npz", **log, terminals=ends, dt=SKIP * STEP)
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    document = {"model": "pendulum.xml", "data": "log.npz", "frame_skip": SKIP, "parameters": space, "threads": 1}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    problem = make_problem(load_config(tmp_path / "config.yaml"), general=True)
    gap = find_gap(problem, effects=[find_effect(n) for n in ("joint_friction", "gravity_tilt")])
    assert ("joint_friction", "swing") in [(e.effect, e.target) for e in gap.effects]
    (tmp_path / "out").mkdir()
    assert add(problem, gap, tmp_path / "out") == []
    make_problem(load_config(tmp_path / "out" / "config.yaml"))
