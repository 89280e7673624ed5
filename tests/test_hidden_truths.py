"""The generator of logs with hidden effects, against MuJoCo's own fields and closed forms."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from benchmarks.hidden import cases, ties, truths
from benchmarks.hidden.systems import (
    CART_POLE,
    CORE,
    DOUBLE_PENDULUM,
    DT,
    HOPPER,
    PASSIVE_PUCK,
    PUCK,
    RUNNER,
    SERVO_ARM,
    SYSTEMS,
    TORQUE_ARM,
    TUMBLER,
    WALKING,
    System,
    load,
)  # fmt: skip
from benchmarks.hidden.truths import Before, Effect
from benchmarks.hidden_effects import by_trait, interval, judge, main, noise_ratios, reductions, scores
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
    assert error(system, truths.true_model(system, case.declared), case).max() < (0.2 if system in WALKING else 0.1)
    assert error(system, mujoco.MjModel.from_xml_string(system.xml), case).max() > 1.0


@pytest.mark.parametrize("name", [s for s in SYSTEMS if s not in SMOOTH])
def test_coarse_models_err(name: str) -> None:
    system = SYSTEMS[name]
    case = short(system, noise=0.0)
    assert error(system, truths.true_model(system, case.declared), case).max() > 5.0


def _with_payload(model: mujoco.MjModel, mass: float, place: np.ndarray, name: str = "fore") -> None:
    """A point mass merged into a body: parallel axes by hand."""
    body = model.body(name)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, body.iquat)
    turn = turn.reshape(3, 3)
    center = (body.mass[0] * body.ipos + mass * place) / (body.mass[0] + mass)
    tensor = turn @ np.diag(body.inertia) @ turn.T
    for m, at in ((body.mass[0], body.ipos - center), (mass, place - center)):
        tensor += m * (at @ at * np.eye(3) - np.outer(at, at))
    inertia, axes = np.linalg.eigh(tensor)
    axes[:, 0] *= np.linalg.det(axes)
    body.ipos[:], body.inertia[:] = center, inertia
    mujoco.mju_mat2Quat(body.iquat, axes.reshape(-1))
    body.mass[0] += mass


def test_a_payload_touches_as_part_of_its_body() -> None:
    """What stiffens contacts is the inertia of a body with its payload, not of the body beside a welded one."""
    mass, place, values = 0.4, np.array([0.1, 0.02, -0.03]), {"thigh_mass": 4.0, "leg_mass": 2.7}
    payload = Effect("payload", "foot", dict(zip(("mass", "x", "y", "z"), (mass, *place), strict=True)))
    truth, model = truths.true_model(HOPPER, values, [payload]), truths.true_model(HOPPER, values)
    body = truth.body("foot").id
    bare = model.body_invweight0[body, 0]
    _with_payload(model, mass, place, "foot")
    mujoco.mj_setConst(model, mujoco.MjData(model))
    assert truth.body_invweight0[body, 0] == pytest.approx(model.body_invweight0[body, 0], rel=1e-9)
    assert truth.body_invweight0[body, 0] < 0.99 * bare


def _spring(model: mujoco.MjModel) -> None:
    model.joint("shoulder").stiffness[0], model.qpos_spring[1] = 3.0, 0.4


def _servo(model: mujoco.MjModel, gain: float = 1.0, damping: float = 0.0, bias: float = 0.0, kp: float = 1.0) -> None:
    servo = model.actuator("elbow_servo")
    servo.gainprm[0] *= gain * kp
    servo.biasprm[:3] *= gain
    servo.biasprm[1] *= kp
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
    (SERVO_ARM, Effect("actuator_stiffness", "elbow_servo", {"factor": 0.8}), lambda m: _servo(m, kp=0.8)),
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


def test_a_rotor_behind_a_spring_changes_much() -> None:
    """It has no strength at which it does nothing, for its rotor stays."""
    numbers = {"compliance": 1 / 400, "damping": 2.0, "inertia": 0.3}
    case, rigid = (
        short(CART_POLE, *hidden, noise=0.0, transitions=60)
        for hidden in ((Effect("joint_elasticity", "rail", numbers),), ())
    )
    noise = np.array(short(CART_POLE, transitions=2).noise)
    found, without = (c.trajectories.next_observations for c in (case, rigid))
    assert (np.abs(found - without) / noise).max() > 5.0


#: Not those that are switched, and not what has a rotor of its own.
GRADUAL = [e for e in cases.OPTIONS if e not in ("integration", "dropout", "joint_elasticity")]


@pytest.mark.parametrize("effect", GRADUAL)
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


def test_neighbors() -> None:
    arm = mujoco.MjModel.from_xml_string(TORQUE_ARM.xml)
    assert [truths.neighbor(arm, j) for j in ("yaw", "shoulder", "elbow")] == ["shoulder", "yaw", "shoulder"]


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
    assert set(cases.DRAWS) == (set(cases.OPTIONS) - {"integration"}) | {"payload_on_roll_axis"}


def test_unusual_cases_follow_the_plain_ones() -> None:
    specs = cases.cases(4)
    first = next(i for i, spec in enumerate(specs) if spec.trait)
    plain, unusual = specs[:first], specs[first:]
    assert len(plain) >= 90
    assert {s.system for s in plain} <= {s.name for s in CORE}
    assert all(s.name.startswith(f"{s.trait}-") for s in unusual)
    count = {
        trait: sum(s.trait == trait for s in unusual)
        for trait in ("motion", "passive", "coarse", "unequal", "tie", "walking")
    }
    assert min(count.values()) >= 4
    assert sum(count.values()) == len(unusual) >= 20
    assert all(s.effects[0] == "integration" and len(s.effects) == 2 for s in unusual if s.trait == "coarse")
    assert {s.trait for s in unusual if s.kind == "null"} >= {"motion", "passive", "unequal", "walking"}


@pytest.mark.parametrize("system", [PASSIVE_PUCK, DOUBLE_PENDULUM, TUMBLER], ids=lambda s: s.name)
def test_passive_systems_have_no_actuators_and_move(system: System) -> None:
    case = short(system, noise=0.0)
    assert load(system.xml).nu == 0
    assert case.trajectories.actions.shape == (40, 0)
    assert np.ptp(case.trajectories.observations, axis=0).max() > 0.1
    assert {s.system for s in cases.cases(4) if s.trait == "passive"} >= {system.name}


@pytest.mark.parametrize("quiet", [True, False])
def test_a_log_that_begins_in_motion_has_a_history(quiet: bool) -> None:
    late = [Effect("actuator_delay", "push", {"delay": 0.025})]
    before = Before(quiet=quiet)
    log = truths.make_recording(CART_POLE, late, 3, episodes=2, transitions=40, before=before).log
    lengths = [len(u) - 1 for u in log.unlogged]  # the first of them was held before
    assert all(0.3 / DT - 1 <= n <= 1.0 / DT + 1 for n in lengths)
    assert [len(c) for c in log.commands] == [40, 40]
    for states, commands, unlogged in zip(log.states, log.commands, log.unlogged, strict=True):
        assert np.abs(states[0, 2:]).min() > 1e-3
        assert np.abs(unlogged[-3:] - commands[0]).max() > 1e-3
        assert (np.abs(unlogged).max() == 0) == quiet
        pushes = [_pushed(states[0], c, late) for c in (unlogged[-1], commands[0])]
        true = states[1] - states[0]
        noise = np.repeat([truths.POSITION_NOISE, truths.VELOCITY_NOISE], 2)
        errors = [np.abs((p - states[0] - true) / noise).max() for p in pushes]
        if quiet:
            assert errors[0] < 0.2  # what was commanded before is what acts
            assert errors[1] > 10.0  # and not the first command


def _pushed(state: np.ndarray, held: np.ndarray, effects: list[Effect]) -> np.ndarray:
    """The state a logged step after another, where a command was held all the while."""
    declared = truths.true_declared(CART_POLE, np.random.default_rng(3))
    plant = truths.make_plant(CART_POLE, declared, effects, 20)
    plant.reset(state[:2].copy(), state[2:].copy(), held)
    plant.advance(held, None)
    return np.concatenate([plant.q, plant.v])


def test_a_log_that_begins_at_its_first_command_is_as_before() -> None:
    log = truths.make_recording(CART_POLE, [], 3, episodes=1, transitions=5).log
    np.testing.assert_array_equal(log.unlogged[0], log.commands[0][:1])


@pytest.mark.parametrize("noise", [*truths.UNEQUAL, truths.ONE_ROUGH])
def test_unequal_noises_are_realized(noise: str) -> None:
    recording = truths.make_recording(SERVO_ARM, [], 3, noise=noise, episodes=2, transitions=300)
    case = truths.make_case(SERVO_ARM, [], recording)
    clean = np.concatenate([s[:-1] for s in recording.log.states])
    found = (case.trajectories.observations - clean).std(0)
    np.testing.assert_allclose(found, case.noise, rtol=0.15)
    if noise in truths.UNEQUAL:
        np.testing.assert_allclose(case.noise, np.repeat(truths.UNEQUAL[noise], 3))
    else:
        usual = truths.make_recording(SERVO_ARM, [], 3, episodes=1, transitions=2).noise
        assert sorted(np.round(np.array(case.noise) / usual, 6)) == [1, 1, 1, 1, 1, truths.ROUGHER]


def test_the_runner_runs() -> None:
    speeds = np.abs(short(RUNNER, noise=0.0, transitions=80).trajectories.observations[:, 9:]).max(0)
    assert speeds.min() > 4.0


def _ties(system: System, *effects: Effect) -> tuple:
    recording = truths.make_recording(system, effects, 3, episodes=2, transitions=150)
    return ties.exact_ties(system, effects, recording)


def test_ties_are_those_of_the_mechanism() -> None:
    force = Effect("external_force", "cart", {"x": 1.0, "y": 0.0, "z": 0.0})
    assert _ties(CART_POLE, force) == ((("actuator_bias", "push"),),)
    assert _ties(CART_POLE, Effect("actuator_delay", "push", {"delay": 0.02})) == ((),)


#: What is hidden, and its rival with the values that do the same.
SAME = [
    (
        CART_POLE,
        Effect("external_force", "cart", {"x": 2.0, "y": 0.0, "z": 0.0}),
        Effect("actuator_bias", "push", {"force": 0.2}),
    ),
    (
        TORQUE_ARM,
        Effect("actuator_damping", "shoulder_motor", {"damping": 0.01}),
        Effect("joint_damping", "shoulder", {"damping": 0.64}),
    ),
    (
        SERVO_ARM,
        Effect("payload", "hand", {"mass": 0.15, "x": 0.1, "y": 0.0, "z": 0.0}),
        Effect("payload", "fore", {"mass": 0.15, "x": 0.4, "y": 0.0, "z": 0.0}),
    ),
    (
        DOUBLE_PENDULUM,
        Effect("gravity_tilt", None, {"roll": 0.0, "pitch": 0.05}),
        Effect("sensor_bias", "pivot.position", {"bias": -0.05}),
    ),
    (
        TUMBLER,
        Effect("gravity_tilt", None, {"roll": 0.05, "pitch": 0.0}),
        Effect(
            "external_force",
            "brick",
            dict(zip("xyz", 0.6 * ((truths.tilt(0.05, 0) - np.eye(3)) @ [0, 0, -9.81]), strict=True)),
        ),
    ),
]


def test_ties_beside_an_integration_gap(monkeypatch) -> None:
    tried = [r for r in ties.rivals(CART_POLE) if r.effect in ("external_force", "gravity_tilt", "sensor_bias")]
    monkeypatch.setattr(ties, "rivals", lambda _: iter(tried))
    beside, bias = Effect("integration", None, {"timestep": 0.01}), Effect("actuator_bias", "push", {"force": 0.1})
    assert _ties(SYSTEMS["coarse_cart_pole"], beside, bias) == ((), (("external_force", "cart"),))


@pytest.mark.parametrize(("system", "effect", "rival"), SAME, ids=lambda x: getattr(x, "name", ""))
def test_ties_simulate_the_same_log(system: System, effect: Effect, rival: Effect, monkeypatch) -> None:
    one, other, none = (short(system, *e, noise=0.0).trajectories for e in ([effect], [rival], []))
    size = np.array(short(system, transitions=2).noise)
    if not rival.name.startswith("sensor"):  # with which the same readings are another start
        assert np.abs((other.next_observations - one.next_observations) / size).max() < 0.05
    assert np.abs((none.next_observations - one.next_observations) / size).max() > 5.0
    pair, others = (rival.name, rival.target), ("fluid_drag", "joint_damping", "sensor_scale")
    tried = [r for r in ties.rivals(system) if (r.effect, r.target) == pair or r.effect in others]
    monkeypatch.setattr(ties, "rivals", lambda _: iter(tried))
    assert _ties(system, effect) == ((pair,),)


def test_a_case_has_the_gap_that_was_asked_for() -> None:
    spec = cases.CaseSpec("push", "single", "cart_pole", ("actuator_gain",), (0, 1))
    case = spec.make()
    assert cases.LEAST_GAP < case.gap_ratio < 100
    assert case.effects[0].target == "push"
    assert case.name == "push"


def answer(*effects: tuple, equivalents: tuple = (), noise: dict | None = None) -> dict:
    return {
        "verdict": "explained",
        "noise": noise or {},
        "chi2_per_degree": {"before": 50.0, "after": 1.2},
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
    assert not judge(case, named_as_equivalent | {"verdict": "partly explained"})["right"]
    assert judge(case, answer(("actuator_damping", "leg_motor", {})) | {"verdict": "partly explained"})["right"]
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


def test_scores_of_noise_ties_and_intervals() -> None:
    force = Effect("external_force", "cart", {"x": 2.0, "y": 0.0, "z": 0.0})
    case = dataclasses.replace(
        short(CART_POLE, force, transitions=2), ties=((("actuator_bias", "push"),),), trait="tie"
    )
    labels, levels = truths.observed(CART_POLE).labels, np.array(case.noise)
    told = dict(zip(labels, 1.1 * levels, strict=True))
    named = ("external_force", "cart", {"x": 2.5, "z": 0.0})
    silent = judge(case, answer(named, noise=told))
    assert silent["right"]
    assert silent["noise_right"]
    assert silent["ties_missing"] == [[("actuator_bias", "push")]]
    assert silent["covered"] == [False, True]
    assert silent["deviations"]["external_force.x"] == pytest.approx(2.0)
    assert (silent["chi2"], silent["left"]) == (1.2, pytest.approx(1.05))
    complete = judge(case, answer(named, equivalents=(("actuator_bias", "push"),), noise={**told, labels[0]: 2.0}))
    assert complete["ties_missing"] == [[]]
    assert not complete["noise_right"]
    by_tie = judge(case, answer(("actuator_bias", "push", {"force": 0.2})))
    assert by_tie["ties_missing"] == [[("external_force", "cart")]]
    assert by_tie["noise_right"] is None
    common = {"kind": "single", "trait": "tie", "seconds": 1.0, "cpu_seconds": 2.0}
    results = [{**r, **common} for r in (silent, complete, by_tie)]
    table = scores(results)
    assert table["exact ties all told"] == " 33.3 %  (1 of 3)"
    assert table["noise within 15 %, effects named right"] == " 50.0 %  (1 of 2)"
    assert table["true value in the 90 % interval"].startswith(" 50.0 %  (2 of 4), ")
    assert by_trait([*results, {**common, "failure": "x"}]).splitlines()[1].split()[:4] == ["tie", "3", "of", "4"]


def test_noise_of_rotations_is_twice_that_of_quaternions() -> None:
    case = short(PUCK, transitions=2)
    level = case.noise[4]
    assert noise_ratios(case, {"noise": {"root.position.rotation[x]": 2 * level}}) == {
        "root.position.rotation[x]": pytest.approx(1.0)
    }


def test_amplitudes_and_phases_are_those_of_the_same_wave() -> None:
    hidden = Effect("joint_cogging", "elbow", {"amplitude": 0.5, "poles": 6.0, "phase": 3.0})
    case = short(TORQUE_ARM, hidden, transitions=2)
    told = {"amplitude": -0.5, "poles": 6.0, "phase": 3.0 - 3 * np.pi}
    found = judge(case, answer(("joint_cogging", "elbow", told)))
    assert found["deviations"]["joint_cogging.phase"] == pytest.approx(0.0, abs=1e-6)
    assert found["errors"] == pytest.approx([0.0])


def test_wilson_interval() -> None:
    low, high = interval(9, 10, z=1.96)
    assert (low, high) == pytest.approx((0.5958, 0.9821), abs=1e-4)


def test_results_of_an_earlier_run_are_not_overwritten(tmp_path, capsys) -> None:
    (tmp_path / "results.jsonl").write_text('{"name": "null-furuta", "seed": 4}\n')
    with pytest.raises(SystemExit):
        main(["--seed", "5", "--cases", "none", "--out", str(tmp_path)])
    assert "--resume" in capsys.readouterr().err
    assert (tmp_path / "results.jsonl").read_text() == '{"name": "null-furuta", "seed": 4}\n'
