"""The generator of logs with hidden effects, against MuJoCo's own fields and closed forms."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from benchmarks.hidden import cases, truths
from benchmarks.hidden.systems import CART_POLE, DT, HOPPER, PUCK, SERVO_ARM, SYSTEMS, TORQUE_ARM, System
from benchmarks.hidden.truths import Effect
from benchmarks.hidden_effects import judge, reductions
from dropo_torch.config import load_config
from dropo_torch.problem import make_problem

SMOOTH = [s for s in SYSTEMS if not SYSTEMS[s].coarse]


def short(system: System, *effects: Effect, seed: int = 3, transitions: int = 40, **given) -> truths.Case:
    return truths.simulate_truth(system, effects, seed, episodes=1, transitions=transitions, **given)


def one_step(system: System, model: mujoco.MjModel, case: truths.Case) -> np.ndarray:
    """What a model makes of each logged transition of a log without noise, observed columns."""
    observation, data, out = truths.observed(system), mujoco.MjData(model), []
    log = case.trajectories
    for state, command in zip(observation.states(log.observations), log.actions, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[: model.nq], state[model.nq :], command
        mujoco.mj_step(model, data, system.frame_skip)
        out.append(np.concatenate([data.qpos, data.qvel])[observation.index])
    return np.array(out)


def error(system: System, model: mujoco.MjModel, case: truths.Case) -> np.ndarray:
    """The rms of a model's misfit, in units of the smallest noise that a log has."""
    positions = truths.observed(system).index < model.nq
    noise = 0.5 * np.where(positions, truths.POSITION_NOISE, truths.VELOCITY_NOISE)
    misfit = one_step(system, model, case) - case.trajectories.next_observations
    return np.sqrt((misfit**2).mean(0)) / noise


@pytest.mark.parametrize("name", SMOOTH)
def test_null_is_mujoco_with_the_true_values(name: str) -> None:
    system = SYSTEMS[name]
    case = short(system, noise=0.0, transitions=80)
    assert error(system, truths.true_model(system, case.declared), case).max() < 0.1
    assert error(system, mujoco.MjModel.from_xml_string(system.xml), case).max() > 1.0


@pytest.mark.parametrize("name", [s for s in SYSTEMS if s not in SMOOTH])
def test_coarse_models_err(name: str) -> None:
    system = SYSTEMS[name]
    case = short(system, noise=0.0)
    assert error(system, truths.true_model(system, case.declared), case).max() > 5.0


def _with_payload(model: mujoco.MjModel, mass: float, place: np.ndarray) -> None:
    """A point mass merged into a body: parallel axes by hand."""
    body = model.body("fore")
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, body.iquat)
    turn = turn.reshape(3, 3)
    centre = (body.mass[0] * body.ipos + mass * place) / (body.mass[0] + mass)
    tensor = turn @ np.diag(body.inertia) @ turn.T
    for m, at in ((body.mass[0], body.ipos - centre), (mass, place - centre)):
        tensor += m * (at @ at * np.eye(3) - np.outer(at, at))
    inertia, axes = np.linalg.eigh(tensor)
    axes[:, 0] *= np.linalg.det(axes)
    body.ipos[:], body.inertia[:] = centre, inertia
    mujoco.mju_mat2Quat(body.iquat, axes.reshape(-1))
    body.mass[0] += mass


def _spring(model: mujoco.MjModel) -> None:
    model.joint("shoulder").stiffness[0], model.qpos_spring[1] = 3.0, 0.4


def _servo(model: mujoco.MjModel, gain: float = 1.0, damping: float = 0.0, bias: float = 0.0) -> None:
    servo = model.actuator("elbow_servo")
    servo.gainprm[0] *= gain
    servo.biasprm[:3] *= gain
    servo.biasprm[0] += bias
    servo.biasprm[2] -= damping


NATIVE = [
    (TORQUE_ARM, Effect("joint_damping", "elbow", {"damping": 0.3}), lambda m: m.dof_damping.__setitem__(2, 0.5)),
    (
        TORQUE_ARM,
        Effect("joint_quadratic_damping", "shoulder", {"coefficient": 0.2}),
        lambda m: m.dof_dampingpoly.__setitem__((1, 0), 0.2),
    ),
    (TORQUE_ARM, Effect("joint_stiffness", "shoulder", {"stiffness": 3.0, "reference": 0.4}), _spring),
    (
        TORQUE_ARM,
        Effect("gravity_tilt", None, {"roll": 0.05, "pitch": -0.08}),
        lambda m: m.opt.gravity.__setitem__(slice(None), truths.tilt(0.05, -0.08) @ m.opt.gravity),
    ),
    (
        TORQUE_ARM,
        Effect("payload", "fore", {"mass": 0.3, "x": 0.05, "y": 0.03, "z": -0.25}),
        lambda m: _with_payload(m, 0.3, np.array([0.05, 0.03, -0.25])),
    ),
    (
        TORQUE_ARM,
        Effect("inertia", "fore", {"factor": 2.5}),
        lambda m: m.body("fore").inertia.__imul__(2.5),
    ),
    (SERVO_ARM, Effect("actuator_gain", "elbow_servo", {"gain": 0.8}), lambda m: _servo(m, gain=0.8)),
    (SERVO_ARM, Effect("actuator_bias", "elbow_servo", {"force": 1.5}), lambda m: _servo(m, bias=1.5)),
    (SERVO_ARM, Effect("actuator_damping", "elbow_servo", {"damping": 0.9}), lambda m: _servo(m, damping=0.9)),
    (
        CART_POLE,
        Effect("external_force", "cart", {"x": 2.0, "y": 0.0, "z": 0.0}),
        lambda m: (m.actuator_biastype.fill(1), m.actuator_biasprm.__setitem__((0, 0), 0.2)),
    ),
    (
        CART_POLE,
        Effect("fluid_drag", "cart", {"coefficient": 3.0}),
        lambda m: m.dof_dampingpoly.__setitem__((0, 0), 3.0 * 0.05 / 0.12),  # the side that faces the rail's way
    ),
    (CART_POLE, Effect("payload", "cart", {"mass": 0.4, "x": 0.0, "y": 0.0, "z": 0.1}), lambda m: _arm(m, 0.4)),
    (PUCK, Effect("gravity_tilt", None, {"roll": 0.02, "pitch": 0.03}), lambda m: _tilted(m, 0.02, 0.03)),
]


def _arm(model: mujoco.MjModel, armature: float) -> None:
    model.dof_armature[0] = armature


def _tilted(model: mujoco.MjModel, roll: float, pitch: float) -> None:
    model.opt.gravity[:] = truths.tilt(roll, pitch) @ model.opt.gravity


@pytest.mark.parametrize(("system", "effect", "change"), NATIVE, ids=lambda x: getattr(x, "name", ""))
def test_forces_are_those_of_mujocos_fields(system: System, effect: Effect, change) -> None:
    case = short(system, effect, noise=0.0)
    model = truths.true_model(system, case.declared)
    assert error(system, model, case).max() > 3.0
    change(model)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    assert error(system, model, case).max() < 0.1


@pytest.mark.parametrize("effect", [e for e in cases.OPTIONS if e not in ("integration", "dropout")])
def test_an_effect_of_no_strength_changes_nothing_and_a_strong_one_much(effect: str) -> None:
    name, targets = next(iter(cases.OPTIONS[effect].items()))
    system, target = SYSTEMS[name], targets[-1]
    draw = cases.DRAWS[effect](system, target, np.random.default_rng(1))
    seed = 5 if effect != "joint_limit" else 6
    without, none, strong = (
        short(system, *hidden, seed=seed, noise=0.0, transitions=60).trajectories.next_observations
        for hidden in ((), (Effect(effect, target, draw(1e-9)),), (Effect(effect, target, draw(0.5)),))
    )
    noise = np.array(short(system, seed=seed, transitions=2).noise)
    assert (np.abs(none - without) / noise).max() < 0.05
    assert (np.abs(strong - without) / noise).max() > 5.0


def test_dry_friction_stops_in_closed_form_and_holds() -> None:
    bare = CART_POLE.xml.replace('damping="1.0"', "").replace("<motor", '<motor ctrlrange="0 1"')
    bare = bare.replace('integrator="RK4"', 'integrator="RK4" gravity="0 0 0"')
    system = dataclasses.replace(CART_POLE, xml=bare)
    declared = {"pole_mass": 1e-3}
    plant = truths.make_plant(system, declared, [Effect("joint_friction", "rail", {"friction": 1.5})], 40)
    plant.reset(np.zeros(2), np.array([0.4, 0.0]), np.zeros(1))
    for _ in range(60):
        plant.advance(np.zeros(1), None)
    assert plant.q[0] == pytest.approx(0.4**2 / 2 * 1.501 / 1.5, rel=1e-3)  # v² m / 2F
    assert abs(plant.v[0]) < 1e-12
    held = plant.q[0]
    for _ in range(30):
        plant.advance(np.array([0.149]), None)  # 1.49 N push, 1.5 N hold
    assert abs(plant.q[0] - held) < 1e-6
    for _ in range(30):
        plant.advance(np.array([0.2]), None)
    assert plant.v[0] == pytest.approx(0.3 * 0.5 / 1.501, rel=1e-2)


class _Clock:
    """The part of a plant that a command path sees."""

    h = DT / 10

    def __init__(self, commands: list[float]) -> None:
        self.t, self.commands, self.memories = 0.0, [np.array([c]) for c in commands], []


def path(commands: list[float], effect: str, **parameters: float) -> np.ndarray:
    """What a command path makes of commands, of which the first was held before; ten values each."""
    clock = _Clock(commands)
    along = truths.CommandPath(clock, 0, [Effect(effect, "motor", parameters)])
    out = []
    for n in range(10 * (len(commands) - 1)):
        clock.t = n * clock.h
        out.append(along(clock))
    return np.array(out)


def test_command_filters() -> None:
    delayed = path([0, 1, 2, 3], "actuator_delay", delay=0.0125)
    np.testing.assert_allclose(delayed, [0] * 12 + [0.5] + [1] * 9 + [1.5] + [2] * 7, atol=1e-6)
    middle = DT / 10 * (np.arange(20) + 0.5)
    lagged = path([0, 1, 1], "actuator_lag", time_constant=0.02)
    np.testing.assert_allclose(lagged, 1 - np.exp(-middle / 0.02))
    np.testing.assert_allclose(path([0, 0.5, -0.7, 0.1], "actuator_deadband", width=0.2)[::10], [0.3, -0.5, 0.0])
    played = path([0, 1, 0.9, 0.3, 0.6], "actuator_backlash", width=0.4)[::10]
    np.testing.assert_allclose(played, [0.8, 0.8, 0.5, 0.5])


def test_sensors() -> None:
    hidden = [
        Effect("sensor_delay", "elbow.position", {"delay": DT}),
        Effect("sensor_scale", "yaw.velocity", {"factor": 1.1}),
        Effect("sensor_bias", "shoulder.position", {"bias": 0.02}),
    ]
    # nothing is fed back through these sensors
    true = short(TORQUE_ARM, noise=0.0).trajectories
    seen = short(TORQUE_ARM, *hidden, noise=0.0).trajectories
    np.testing.assert_allclose(seen.next_observations[:, 2], true.observations[:, 2], atol=1e-12)
    np.testing.assert_allclose(seen.observations[:, 3], 1.1 * true.observations[:, 3])
    np.testing.assert_allclose(seen.observations[:, 1], 0.02 + true.observations[:, 1])


def test_neighbours() -> None:
    arm = mujoco.MjModel.from_xml_string(TORQUE_ARM.xml)
    assert [truths.neighbour(arm, j) for j in ("yaw", "shoulder", "elbow")] == ["shoulder", "yaw", "shoulder"]


def test_equivalents_follow_the_mechanism() -> None:
    damping = truths.equivalents(TORQUE_ARM, Effect("joint_damping", "elbow", {}))
    assert damping == (("actuator_damping", "elbow_motor"),)
    assert ("external_force", "cart") in truths.equivalents(CART_POLE, Effect("actuator_bias", "push", {}))
    assert truths.equivalents(CART_POLE, Effect("actuator_delay", "push", {})) == ()
    alike = Effect("joint_stribeck", "hinge", {"coulomb": 1.0, "static": 1.05, "velocity": 0.1})
    assert ("joint_friction", "hinge") in truths.equivalents(CART_POLE, alike)


def test_a_seed_decides_everything() -> None:
    drag = Effect("fluid_drag", "fore", {"coefficient": 1.0})
    one, same, other = (short(TORQUE_ARM, drag, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.trajectories.next_observations, same.trajectories.next_observations)
    assert one.declared == same.declared != other.declared
    assert one.noise != other.noise


def test_noise_is_of_the_drawn_size() -> None:
    noisy, clean = (short(CART_POLE, noise=n, transitions=200) for n in (1.0, 0.0))
    found = (noisy.trajectories.observations - clean.trajectories.observations).std(0)
    np.testing.assert_allclose(found, noisy.noise, rtol=0.25)
    log = noisy.trajectories  # each instant is measured once
    np.testing.assert_array_equal(log.observations[1:], log.next_observations[:-1])


@pytest.mark.parametrize("name", SYSTEMS)
def test_written_cases_are_problems(name: str, tmp_path) -> None:
    case = short(SYSTEMS[name], transitions=12)
    problem = make_problem(load_config(case.write(tmp_path)))
    np.testing.assert_array_equal(problem.trajectories.observations, case.trajectories.observations)
    assert all(p.low < case.declared[p.name] < p.high for p in problem.space.parameters)


def test_the_list_of_cases() -> None:
    specs = cases.cases(4)
    kinds = [s.kind for s in specs]
    assert len({s.name for s in specs}) == len(specs)
    assert (kinds.count("null"), kinds.count("single")) >= (10, 50)
    assert kinds.count("double") >= 10
    assert kinds.count("outside") >= 5
    assert {e for s in specs if s.kind == "single" for e in s.effects} == set(cases.VOCABULARY)
    assert {s.name for s in specs} != {s.name for s in cases.cases(5)}
    assert len(cases.cases(4, "small")) < 15
    assert set(cases.DRAWS) == set(cases.OPTIONS) - {"integration"}


def test_a_case_has_the_gap_that_was_asked_for() -> None:
    spec = cases.CaseSpec("push", "single", "cart_pole", ("actuator_gain",), (0, 1))
    case = spec.make()
    assert cases.LEAST_GAP < case.gap_ratio < 100
    assert case.effects[0].target == "push"
    assert case.name == "push"


def answer(*effects: tuple, equivalents: tuple = ()) -> dict:
    return {
        "effects": [
            {
                "effect": e,
                "target": t,
                "parameters": {k: {"value": v, "low": 0.9 * v, "high": 1.1 * v} for k, v in p.items()},
                "indistinguishable_from": [{"effect": a, "target": b} for a, b in equivalents],
            }
            for e, t, p in effects
        ],
        "gap": {
            "before": {"mse": 10.0, "rollout_rmse": 5.0},
            "after": {"mse": 1.05, "rollout_rmse": 2.0},
            "noise_floor": {"mse": 1.0, "rollout_rmse": 1.0},
        },
    }


def test_judging() -> None:
    case = short(HOPPER, Effect("joint_damping", "leg_joint", {"damping": 2.0}), transitions=2)
    right = judge(case, answer(("joint_damping", "leg_joint", {"damping": 2.06})))
    assert right["right"]
    assert right["errors"] == pytest.approx([0.03])
    assert right["covered"] == [True]
    assert right["reduction"] == pytest.approx({"mse": 0.995, "rollout_rmse": 0.75}, abs=1e-3)
    assert judge(case, answer(("actuator_damping", "leg_motor", {"damping": 0.1})))["right"]
    named_as_equivalent = answer(("joint_friction", "leg_joint", {}), equivalents=(("joint_damping", "leg_joint"),))
    assert judge(case, named_as_equivalent)["right"]
    assert not judge(case, answer(("joint_damping", "foot_joint", {"damping": 2.0})))["right"]
    assert not judge(case, answer(("joint_damping", "leg_joint", {}), ("armature", "leg_joint", {})))["right"]
    assert not judge(case, answer())["right"]
    nothing = short(HOPPER, kind="null", transitions=2)
    assert judge(nothing, answer())["right"]
    assert not judge(nothing, answer(("unnamed", None, {})))["right"]
    outside = dataclasses.replace(case, kind="outside")
    assert judge(outside, answer(("unnamed", None, {})))["right"]
    assert not judge(outside, answer(("joint_damping", "leg_joint", {})))["right"]
    assert reductions({}) == {}
