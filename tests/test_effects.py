"""Effects: each against its own physics, in simulators, configs, fits and files."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml
from conftest import HOPPER
from dropo_sims.hopper import SIM

from dropo_torch.certify import certify
from dropo_torch.commands.cli import main
from dropo_torch.config import load_config, make_config
from dropo_torch.data.observation import generic_observation, parse_observation
from dropo_torch.data.trajectory import Trajectories, make_transitions
from dropo_torch.effects import VOCABULARY, Effect, Placed, find_effect, register
from dropo_torch.effects.actuator import ActuatorDeadband
from dropo_torch.effects.base import Quantity, Setting
from dropo_torch.effects.base import applied as with_effects
from dropo_torch.effects.engine import Variant
from dropo_torch.effects.export import write_model
from dropo_torch.effects.filters import Filter, extended, filtered, observed_rates, sensed, settled_after
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.placing import lowest, place_effects, plain_setting
from dropo_torch.effects.sensor import SensorScale
from dropo_torch.effects.simulator import EffectSimulator, effect_simulator
from dropo_torch.errors import InputError
from dropo_torch.fit import fit
from dropo_torch.gap.add import search_box, write_config
from dropo_torch.gap.ties import varieties
from dropo_torch.gap.twin import Twin, Windows
from dropo_torch.optimizers import FitSettings
from dropo_torch.parameters import ParameterSpace
from dropo_torch.problem import make_problem
from dropo_torch.simulators import make_simulator
from dropo_torch.testing.effects import RIG, check_effect

SKIP = 4
STEP = 0.005
COLUMNS = ("shoulder", "elbow", "root", "rail")


def general(xml: str = RIG) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(xml)
    for body in spec.bodies[1:]:
        body.simple = 0
    return spec.compile()


def setting_of(model: mujoco.MjModel) -> Setting:
    return plain_setting(model, parse_observation(model, None), SKIP)


def some_states(model: mujoco.MjModel, number: int = 3) -> torch.Tensor:
    rng = np.random.default_rng(0)
    states = np.tile(np.concatenate([model.qpos0, np.zeros(model.nv)]), (number, 1))
    for c in [0, 1, 9]:
        states[:, c] += rng.uniform(-0.9, 0.9, number)
    states[:, model.nq :] += rng.normal(0, 1.0, (number, model.nv))
    return torch.from_numpy(states)


def some_controls(model: mujoco.MjModel, steps: int, number: int = 3) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(1).uniform(-1, 1, (number, steps, model.nu)))


def simulator_of(
    model: mujoco.MjModel,
    effects: list[dict],
    parameters: dict | None = None,
    backend: str = "mujoco",
    skip: int = SKIP,
    differentiated: bool = False,
) -> tuple[Any, int]:
    """A simulator with effects; the cart's damping varies unless other parameters are given."""
    given = parameters or {
        "d": {"field": "dof_damping", "name": model.joint(model.njnt - 1).name, "bounds": [0.0, 1.0]}
    }
    space = ParameterSpace(model, given)
    setting = plain_setting(model, parse_observation(model, None), skip, differentiated=differentiated)
    found = place_effects(effects, space, setting, find_effect)
    space = space.with_limits(lowest(found, space))

    def make(changed: mujoco.MjModel, frame_skip: int, parameters: ParameterSpace) -> Any:
        return make_simulator(backend, changed, parameters=parameters, frame_skip=frame_skip, num_threads=1)

    step = float(model.opt.timestep)
    simulator = effect_simulator(backend, found, space, make, timestep=skip * step, longest=1000, num_threads=1)
    return simulator, simulator.history


def entry(effect: Effect, target: str | None, values: np.ndarray, setting: Setting) -> dict:
    names = [q.name for q in effect.quantities(setting, target)]
    document: dict = {"effect": effect.name, **dict(zip(names, map(float, values), strict=True))}
    return document if target is None else {**document, "target": target}


def placements() -> list[Any]:
    setting = setting_of(general())
    return [
        pytest.param(effect, target, id=f"{effect.name}-{target}")
        for effect in VOCABULARY.values()
        for target in effect.targets(setting)
    ]


#: Places where an effect does nothing: what does not turn has no use for its center or inertia, no force depends on
#: where something is, and a geom may touch nothing.
IDLE: dict[str, tuple[str, ...]] = {
    "center_of_mass": ("cart",), "inertia": ("cart",),
    "sensor_bias": ("root.position[x]", "root.position[y]", "rail.position"),
    **dict.fromkeys(
        ("contact_friction", "contact_rolling", "contact_stiffness", "contact_margin", "contact_sole"),
        ("upper", "lower", "cart"),
    ),
}  # fmt: skip
#: Numbers at which an effect acts on the rig, where those from which a search begins are too small for it.
NUMBERS = {"joint_limit": {"lower": 0.8, "upper": -0.8}, "joint_stop": {"lower": 0.0, "upper": 0.0}}


@pytest.mark.parametrize("unseen", [(), ("shoulder",), ("rail", "elbow")])
def test_every_number_of_every_candidate_is_one(unseen: tuple[str, ...]) -> None:
    """Also where the positions of joints are not measured; what depends on them is no candidate there."""
    setting = setting_of(general())
    joints = [setting.joint(name) for name in unseen]
    position = setting.signals.position.copy()
    position[setting.model.jnt_qposadr[joints]] = np.nan
    blind = replace(setting, signals=replace(setting.signals, position=position))
    for effect in VOCABULARY.values():
        for target in effect.targets(blind):
            numbers = [[q.neutral, q.low, q.high, q.scale] for q in effect.quantities(blind, target)]
            assert np.isfinite(np.array(numbers, dtype=float)[:, [0, 3]]).all(), (effect.name, target)
            assert not np.isnan(numbers).any(), (effect.name, target)
            assert np.isfinite(effect.starts(blind, target)).all(), (effect.name, target)
    for name in ("joint_stiffness", "joint_cogging", "joint_limit", "joint_coupling"):
        effect = find_effect(name)
        lacking = set(effect.targets(setting)) - set(effect.targets(blind))
        assert lacking >= set(unseen) & set(effect.targets(setting))


@pytest.mark.parametrize("friction", [0.0, 1e-4, 0.8])
def test_friction_can_be_found_however_little_the_model_has(friction: float) -> None:
    """It has a size, and searches begin near what slippery things have, or near what the model has."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><geom name="floor" type="plane" size="9 9 1" friction="{friction}"/>
        <body pos="0 0 .1"><freejoint/><geom name="box" size=".1" friction="{friction}"/></body></worldbody></mujoco>"""
    )
    effect, setting = find_effect("contact_friction"), setting_of(model)
    for target in ("floor", "box"):
        (number,) = effect.quantities(setting, target)
        assert number.neutral == pytest.approx(friction)
        assert number.scale >= 0.03
        starts = np.concatenate(effect.starts(setting, target))
        assert (np.abs(starts - friction) >= 0.3 * number.scale).all()
        assert (starts <= number.high).all()


#: Models with what an effect needs and others lack.
MODELS = {
    "actuator_time_constant": RIG.replace(
        '<motor name="push"', '<general name="push" dyntype="filterexact" dynprm=".05"'
    ),
    "tendon_friction": RIG.replace(
        "</mujoco>", '<tendon><fixed name="cable"><joint joint="shoulder" coef=".1"/></fixed></tendon></mujoco>'
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", VOCABULARY)
def test_every_effect_keeps_its_laws(name: str) -> None:
    model = mujoco.MjModel.from_xml_string(MODELS[name]) if name in MODELS else None
    check_effect(VOCABULARY[name], model, idle=IDLE.get(name, ()), numbers=NUMBERS.get(name))


def applied(xml: str, name: str, target: str | None, *values: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = general(xml)
    find_effect(name).apply(model, target, np.array(values))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model, mujoco.MjData(model)


@pytest.mark.parametrize(
    ("geom", "facing"),
    [
        ('type="sphere" size=".1"', (1, 1, 1)),
        ('type="capsule" size=".05 .2"', (1, 1, 0.2)),
        ('type="box" size=".1 .2 .3"', (1, 1 / 2, 1 / 3)),
    ],
)
def test_drag_is_the_square_of_the_speed_and_brakes_no_rotation(geom: str, facing: tuple[float, ...]) -> None:
    xml = f"""<mujoco><worldbody><body name="b"><freejoint/><geom {geom} mass="2"/></body>
      <body name="other" pos="3 0 0"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    model, data = applied(xml, "fluid_drag", "b", 0.7)
    for axis, area in enumerate(facing):  # the share of the broadest side that faces a motion along an axis
        data.qvel[:] = np.random.default_rng(0).normal(0, 2, 12)
        data.qvel[:3] = 1.7 * np.eye(3)[axis]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qfrc_passive[:3], -0.7 * area * 1.7**2 * np.eye(3)[axis], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(data.qfrc_passive[3:], 0, atol=1e-6)  # nor does the other body feel anything


def test_linear_drag_slows_a_free_body_in_proportion_to_its_speed() -> None:
    xml = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
      <body name="drone"><freejoint/><geom type="box" size=".1 .2 .3" mass="2"/></body>
      <body name="link" pos="9 0 0"><joint/><geom size=".1" pos=".3 0 0"/></body></worldbody></mujoco>"""
    model, data = applied(xml, "linear_drag", "drone", 0.4)
    data.qvel[:6] = 1.0, -2.0, 0.5, 3.0, 1.0, -1.0
    spin = float(np.linalg.norm(np.diag(model.body_inertia[1]) @ data.qvel[3:6]))
    mujoco.mj_step(model, data, 1000)
    np.testing.assert_allclose(data.qvel[:3], np.exp(-0.4 / 2) * np.array([1.0, -2.0, 0.5]), rtol=1e-3)
    after = float(np.linalg.norm(np.diag(model.body_inertia[1]) @ data.qvel[3:6]))
    assert after == pytest.approx(spin, rel=1e-2)  # it turns as before
    assert find_effect("linear_drag").targets(setting_of(general(xml))) == ["drone"]


@pytest.mark.parametrize(("name", "speed"), [("linear_drag", 1.0), ("quadratic_drag", 2.0)])
def test_drag_slows_what_slides_in_a_plane_but_not_what_a_carriage_holds(name: str, speed: float) -> None:
    slides = '<joint type="slide" axis="0 1 0"/><joint type="slide" axis="{}"/><joint axis="0 0 1"/><geom size=".1"/>'
    xml = f"""<mujoco><worldbody>
      <body name="sled">{slides.format("3 0 0")}
        <body name="rider" pos="0 0 .3">{slides.format("1 0 0")}</body></body>
      <body name="skew" pos="2 0 0">{slides.format("1 1 0")}</body>
      <body name="car" pos="4 0 0"><joint type="slide" axis="1 0 0"/><geom size=".1"/></body></worldbody></mujoco>"""
    plain, effect = general(xml), find_effect(name)
    assert effect.targets(setting_of(plain)) == ["sled"]
    model = with_effects(plain, [Placed(effect, "sled", (0.4,))])
    data = mujoco.MjData(model)
    data.qvel[:3] = qvel = np.array([1.2, -1.6, 5.0])  # at 2 m/s, and turning
    mujoco.mj_forward(model, data)
    own = effect.force(setting_of(plain), "sled", np.array([[0.4]]), data.qpos[None], data.qvel[None])
    force = data.qfrc_passive + own[0]
    np.testing.assert_allclose(force[:2], -0.4 * speed * qvel[:2], rtol=1e-9)
    np.testing.assert_allclose(force[2:], 0, atol=1e-12)


def test_axis_drag_is_along_the_axes_of_the_body() -> None:
    xml = """<mujoco><option gravity="0 0 0"/><worldbody><body name="hull"><freejoint/>
      <geom type="box" size=".1 .2 .3" mass="2"/></body></worldbody></mujoco>"""
    model, effect = general(xml), find_effect("axis_drag")
    turned = np.array([[0, 0, 0, np.cos(0.4), 0, 0, np.sin(0.4)]])  # about z, by 0.8 rad
    speed = 1.5 * np.array([[np.cos(0.8), np.sin(0.8), 0, 0, 0, 0]])  # ahead
    force = effect.force(setting_of(model), "hull", np.array([[2.0, 9.0, 5.0]]), turned, speed)
    np.testing.assert_allclose(force, -2.0 * 1.5 * speed, atol=1e-12)
    sideways = np.array([[-np.sin(0.8), np.cos(0.8), 0, 0, 0, 0]])
    force = effect.force(setting_of(model), "hull", np.array([[2.0, 9.0, 5.0]]), turned, sideways)
    np.testing.assert_allclose(force, -9.0 * sideways, atol=1e-12)


TENDONS = """<mujoco><worldbody><site name="anchor" pos="0 .1 .5"/>
  <body><joint name="knuckle" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".4"/>
    <body pos=".3 0 0"><joint name="tip" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".2"/>
      <site name="end" pos=".2 0 0"/></body></body></worldbody>
  <tendon><fixed name="flexor"><joint joint="knuckle" coef=".1"/><joint joint="tip" coef="-.06"/></fixed>
    <spatial name="cable"><site site="anchor"/><site site="end"/></spatial></tendon>
  <actuator><motor name="flex" tendon="flexor" gear="3"/><motor name="pull" tendon="cable"/></actuator></mujoco>"""


@pytest.mark.parametrize(("actuator", "tendon", "gear"), [("flex", "flexor", 3.0), ("pull", "cable", 1.0)])
def test_damping_of_an_actuator_is_that_of_the_tendon_it_pulls(actuator: str, tendon: str, gear: float) -> None:
    model, effect = mujoco.MjModel.from_xml_string(TENDONS), find_effect("actuator_damping")
    setting = plain_setting(model, parse_observation(model, None), 4, 0.3)
    assert actuator in effect.targets(setting)
    (quantity,) = effect.quantities(setting, actuator)
    assert 0 < quantity.scale < 1e3
    damped, braked = (mujoco.MjModel.from_xml_string(TENDONS) for _ in range(2))
    damped.tendon_damping.reshape(damped.ntendon, -1)[damped.tendon(tendon).id, 0] = 2.0 * gear**2
    effect.apply(braked, actuator, np.array([2.0]))
    forces = []
    for own in (damped, braked):
        data = mujoco.MjData(own)
        data.qpos[:], data.qvel[:] = (0.4, -0.7), (1.5, -2.0)
        mujoco.mj_forward(own, data)
        forces.append(data.qfrc_passive + data.qfrc_actuator)
    assert np.abs(forces[0]).max() > 1e-3
    np.testing.assert_allclose(forces[0], forces[1], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("tendon", ["flexor", "cable"])
def test_friction_of_a_tendon_holds_it_and_brakes_it(tendon: str) -> None:
    """It stops short pulls that are weaker, and takes its own force off stronger ones."""
    effect, loss = find_effect("tendon_friction"), 5.0
    model = mujoco.MjModel.from_xml_string(TENDONS.replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>'))
    setting = plain_setting(model, parse_observation(model, None), 4, 0.3)
    assert tendon in effect.targets(setting)
    actuator, gear = ("flex", 3.0) if tendon == "flexor" else ("pull", 1.0)
    speeds = {}
    for friction, pull in ((loss, 0.9 * loss), (loss, 3 * loss), (0.0, 2 * loss)):
        own = copy.copy(model)
        effect.apply(own, tendon, np.array([friction]))
        data = mujoco.MjData(own)
        data.ctrl[own.actuator(actuator).id] = pull / gear
        mujoco.mj_step(own, data, 5)
        speeds[friction, pull] = data.ten_velocity[own.tendon(tendon).id]
    held, braked, free = speeds.values()
    assert abs(held) < 2e-3 * abs(free)
    assert braked == pytest.approx(free, rel=0.02)


def test_quadratic_drag_is_alike_in_all_directions() -> None:
    """A free body that nothing else moves slows down as 1/(1 + c·v₀·t/m), in a straight line."""
    xml = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
      <body name="drone"><freejoint/><geom type="box" size=".1 .2 .3" mass="2"/></body>
      <body name="link" pos="9 0 0"><joint/><geom size=".1" pos=".3 0 0"/></body></worldbody></mujoco>"""
    model, effect = general(xml), find_effect("quadratic_drag")
    setting, data = setting_of(model), mujoco.MjData(model)
    data.qvel[:3] = begin = np.array([1.0, -2.0, 0.5])
    for _ in range(1000):
        force = effect.force(setting, "drone", np.array([[0.4]]), data.qpos[None], data.qvel[None])
        data.qfrc_applied[:] = force[0]
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qvel[:3], begin / (1 + 0.4 * np.linalg.norm(begin) / 2), rtol=1e-3)
    assert effect.targets(setting) == ["drone"]


def holding(name: str, target: str, values: np.ndarray) -> np.ndarray:
    """Generalized forces at rest, away from the model's rest position, ``(nv,)``."""
    plain = general()
    placed = Placed(find_effect(name), target, tuple(float(v) for v in values))
    model = with_effects(plain, [placed])
    data = mujoco.MjData(model)
    data.qpos[:2] += 0.3, -0.4
    mujoco.mj_forward(model, data)
    free = placed.effect.force(setting_of(plain), target, values[None], data.qpos[None], data.qvel[None])
    return np.asarray(data.qfrc_passive - data.qfrc_bias + free[0])


@pytest.mark.parametrize(
    ("name", "target", "start", "end"),
    [
        ("joint_stiffness", "elbow", (0.5, 0.2), (2.0, 1.7)),
        ("joint_stiffness", "elbow", (2.0, 0.2), (1.5, -0.6)),
        ("payload", "lower", (0.1, 0.02, 0.0, -0.1), (0.5, 0.1, -0.07, -0.4)),
        ("joint_cogging", "elbow", (0.3, 4.0, 0.5), (0.9, 4.0, 2.5)),
    ],
)
def test_numbers_that_multiply_move_what_acts_as_predicted(name: str, target: str, start: tuple, end: tuple) -> None:
    effect, a, b = find_effect(name), np.array(start), np.array(end)
    before, step = holding(name, target, a), 1e-6
    slopes = [
        (holding(name, target, a + step * e) - holding(name, target, a - step * e)) / (2 * step) for e in np.eye(len(a))
    ]
    predicted = before + np.transpose(slopes) @ (b - a)
    assert np.abs(predicted - before).max() > 0.05
    np.testing.assert_allclose(holding(name, target, effect.settle(a, b)), predicted, atol=1e-6)
    assert np.array_equal(effect.settle(a, a), a)


def test_an_amount_that_vanishes_moves_its_place_as_predicted() -> None:
    effect = find_effect("payload")
    for gone in (0.0, -0.1):
        assert effect.settle(np.array([0.1, 0.0, 0.0, -0.1]), np.array([gone, 0.0, 0.0, -0.2]))[3] == pytest.approx(
            -0.2
        )


def test_a_payload_is_a_welded_point_mass() -> None:
    loaded, data = applied(RIG, "payload", "lower", 0.4, 0.05, 0.02, -0.3)
    inertial = '<body pos=".05 .02 -.3"><inertial pos="0 0 0" mass="0.4" diaginertia="1e-12 1e-12 1e-12"/></body>'
    welded = general(RIG.replace('mass=".7"/>', f'mass=".7"/>{inertial}'))
    other = mujoco.MjData(welded)
    state = some_states(loaded)[0].numpy()
    for m, d in ((loaded, data), (welded, other)):
        d.qpos[:], d.qvel[:] = state[: m.nq], state[m.nq :]
        mujoco.mj_forward(m, d)
    np.testing.assert_allclose(data.qacc, other.qacc, rtol=1e-6, atol=1e-9)


def test_a_payload_may_sit_on_a_free_body_off_its_center() -> None:
    model, _ = applied(RIG, "payload", "ball", 0.5, 0.05, 0.0, 0.0)
    assert model.body("ball").mass[0] == pytest.approx(1.5)
    np.testing.assert_allclose(model.body("ball").ipos, [0.05 / 3, 0, 0], atol=1e-12)


SLIDE = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom name="cart" size=".1" mass="2"/></body>
</worldbody><actuator><motor name="push" joint="rail"/></actuator></mujoco>"""


def driven(
    entries: list[dict], command: np.ndarray, start: tuple[float, float] = (0.0, 0.0), xml: str = SLIDE, **options: Any
) -> np.ndarray:
    """States ``(S, 2)`` of the cart under one command per physics step."""
    model = general(xml)
    simulator, history = simulator_of(model, entries, skip=1, **options)
    before = np.repeat(command[:1], history)
    controls = torch.from_numpy(np.concatenate([before, command])[None, :, None].astype(float))
    values = torch.zeros(1, 1, dtype=torch.float64)
    return simulator.rollout(torch.tensor([start], dtype=torch.float64), controls, values)[0, 0].numpy()


def forces(path: np.ndarray, start: float = 0.0) -> np.ndarray:
    """The force in every physics step of the 2 kg cart."""
    return 2 * np.diff(path[:, 1], prepend=start) / STEP


_NOTHING = {"effect": "actuator_delay", "target": "push"}
COMMAND = np.repeat(np.random.default_rng(3).uniform(-1, 1, 8), 5)


def test_dry_friction_slides_and_sticks() -> None:
    held = driven([{"effect": "joint_friction", "target": "rail", "friction": 0.5}], np.full(200, 0.4))
    assert abs(held[-1, 1]) < 1e-3  # MuJoCo's dry friction creeps
    slid = driven([{"effect": "joint_friction", "target": "rail", "friction": 0.5}], np.full(400, 2.0))
    assert forces(slid)[-1] == pytest.approx(1.5, rel=1e-3)


#: A cart of 2 kg on a rail, whose friction gives over a centimeter.
PRESLIDING = {"effect": "joint_presliding", "target": "rail", "coulomb": 0.5, "displacement": 0.01}


def bristled(push: np.ndarray, fine: int = 100, larger: float = 1.0, falls: float = 1.0) -> np.ndarray:
    """Positions of the cart after each physics step, by small Euler steps of the bristles' equation in time.

    They hold ``larger`` times as much at rest as in motion, and less from a velocity ``falls`` on; as much for Dahl's.
    """
    x = v = z = 0.0
    found = []
    for force in push:
        for _ in range(fine):
            v += STEP / fine * (force - 0.5 * z) / 2
            x += STEP / fine * v
            level = 1 + (larger - 1) * np.exp(-((v / falls) ** 2))
            z += STEP / fine * (v - abs(v) * z / level) / 0.01
        found.append(x)
    return np.array(found)


def test_presliding_gives_and_slides() -> None:
    """As Dahl's equation has it, over many reversals; at rest a spring, and in motion dry friction."""
    push = np.repeat(np.random.default_rng(1).uniform(-1, 1, 12), 50)
    expected = bristled(push)
    np.testing.assert_allclose(driven([PRESLIDING], push)[:, 0], expected, atol=0.02 * np.abs(expected).max())
    light, spring = driven([PRESLIDING], np.full(200, 0.002))[:, 0], 0.002 / 50  # N by N/m, under 2 kg
    np.testing.assert_allclose(light, spring * (1 - np.cos(5 * STEP * np.arange(1, 201))), atol=0.1 * spring)
    assert forces(driven([PRESLIDING], np.full(400, 2.0)))[-1] == pytest.approx(2 - 0.5, rel=1e-3)


def test_friction_that_gives_may_be_larger_when_slow() -> None:
    """As LuGre's equation has it; without that, it is friction that gives and no more."""
    push = np.repeat(np.random.default_rng(1).uniform(-1.5, 1.5, 12), 50)
    lugre = {**PRESLIDING, "effect": "joint_lugre", "static": 0.9, "velocity": 0.15}
    expected = bristled(push, larger=1.8, falls=0.15)
    np.testing.assert_allclose(driven([lugre], push)[:, 0], expected, atol=0.03 * np.abs(expected).max())
    assert np.abs(expected - bristled(push)).max() > 0.2 * np.abs(expected).max()
    plain = driven([{**lugre, "static": 0.5}], push)
    np.testing.assert_allclose(plain, driven([PRESLIDING], push), atol=1e-12)


def test_presliding_begins_as_the_joint_moves() -> None:
    """A simulation that begins in motion has its friction at once; one that begins at rest has none."""
    for speed, friction in ((1.0, -0.5), (-1.0, 0.5), (0.0, 0.0)):
        first = forces(driven([PRESLIDING], np.zeros(1), start=(0.0, speed)), speed)[0]
        assert first == pytest.approx(friction, abs=1e-3)


def test_presliding_is_no_stiffer_than_a_physics_step_can_hold() -> None:
    """A displacement of nothing is dry friction, which holds the cart."""
    hard = {**PRESLIDING, "displacement": 0.0}
    held = driven([hard], np.full(400, 0.2))
    assert np.abs(held[:, 0]).max() < 1e-4
    assert np.abs(held[-1, 1]) < 1e-4
    assert forces(driven([hard], np.full(400, 2.0)))[-1] == pytest.approx(1.5, rel=1e-3)


@pytest.mark.parametrize("speed", [-1.5, 0.5])
def test_passive_forces_of_a_joint(speed: float) -> None:
    def passive(name: str, *values: float) -> float:
        model, data = applied(
            SLIDE.replace('type="slide"', 'type="slide" stiffness="2" springref="0.1"'), name, "rail", *values
        )
        data.qpos[0], data.qvel[0] = 0.3, speed
        mujoco.mj_forward(model, data)
        return float(data.qfrc_passive[0]) + 2 * (0.3 - 0.1)

    assert passive("joint_damping", 0.7) == pytest.approx(-0.7 * speed)
    assert passive("joint_quadratic_damping", 0.7) == pytest.approx(-0.7 * abs(speed) * speed)
    assert passive("joint_stiffness", 5.0, -0.2) == pytest.approx(-5 * (0.3 + 0.2))
    model, _ = applied(SLIDE, "armature", "rail", 0.4)
    assert model.dof_M0[0] == pytest.approx(2.4)


def test_inertia_and_center_and_stops() -> None:
    model, _ = applied(RIG, "inertia", "lower", 1.5)
    np.testing.assert_allclose(model.body("lower").inertia, 1.5 * general().body("lower").inertia)
    model, _ = applied(RIG, "center_of_mass", "lower", 0.01, 0.02, -0.03)
    np.testing.assert_allclose(model.body("lower").ipos - general().body("lower").ipos, [0.01, 0.02, -0.03], atol=1e-12)
    model, _ = applied(RIG, "joint_limit", "shoulder", 0.2, -0.1)
    np.testing.assert_allclose(model.joint("shoulder").range, np.deg2rad([-60, 60]) + [0.2, -0.1])


FEET = """<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="5 5 1" quat=".99 .1 0 0"/>
<body pos="0 0 {height}"><freejoint/><geom name="foot" {foot} friction=".4"/></body>{other}</worldbody></mujoco>"""
OTHER = '<body pos="1 0 .2"><freejoint/><geom name="other" size=".1"/></body>'


@pytest.mark.parametrize(
    ("foot", "larger", "sinks"),
    [
        ('type="sphere" size=".1" mass="1"', 'type="sphere" size=".11" mass="1"', 0.0),
        ('type="capsule" size=".1 .2" mass="1"', 'type="capsule" size=".11 .2" mass="1"', 0.0),
        ('type="box" size=".1 .2 .1" mass="1"', 'type="box" size=".1 .2 .1" mass="1" margin=".02"', 0.01),
        ('type="cylinder" size=".1 .1" mass="1"', 'type="cylinder" size=".1 .1" mass="1" margin=".02"', 0.01),
    ],
)
def test_a_sole_touches_where_its_surface_is(foot: str, larger: str, sinks: float) -> None:
    def simulate(model: mujoco.MjModel) -> np.ndarray:
        data = mujoco.MjData(model)
        data.qvel[:3] = 0.8, 0.3, -0.2
        mujoco.mj_step(model, data, 150)
        return np.concatenate([data.qpos, data.qvel])

    sole = find_effect("contact_sole")
    plain = mujoco.MjModel.from_xml_string(FEET.format(foot=foot, height=0.115, other=""))
    truth = mujoco.MjModel.from_xml_string(FEET.format(foot=larger, height=0.115, other=""))
    truth.body_mass[:], truth.body_inertia[:] = plain.body_mass, plain.body_inertia
    normal = np.zeros(3)
    mujoco.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), truth.geom_quat[0])
    truth.geom_pos[0] -= sinks * normal
    for model in (plain, truth):
        mujoco.mj_setConst(model, mujoco.MjData(model))
    here = with_effects(plain, [Placed(sole, "foot", (0.01,))])
    np.testing.assert_allclose(simulate(here), simulate(truth), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(simulate(with_effects(plain, [Placed(sole, "foot", (0.0,))])), simulate(plain))
    raised = with_effects(plain, [Placed(sole, "floor", (0.01,))])
    np.testing.assert_allclose(raised.geom_pos[0], 0.01 * normal, atol=1e-15)


def test_what_is_never_looked_for_alone_is_tried_as_a_tie_beside_its_kind() -> None:
    """A sole where a margin may be what ties, at its size; nothing beside friction, nor a sole beside itself."""
    foot = 'type="sphere" size=".1" mass="1"'
    setting = setting_of(mujoco.MjModel.from_xml_string(FEET.format(foot=foot, height=0.115, other="")))
    ground: Any = SimpleNamespace(effects=tuple(VOCABULARY.values()), setting=setting)
    margin, friction, sole = (find_effect(f"contact_{name}") for name in ("margin", "friction", "sole"))
    near, own = [Placed(margin, "floor", (0.01,)), Placed(friction, "floor", (2.0,))], Placed(friction, "foot", (2.0,))
    assert [(p.key, p.values) for p in varieties(ground, near, own)] == [(("contact_sole", "floor"), (0.01,))]
    assert varieties(ground, near, Placed(sole, "foot", (0.01,))) == []


def test_planes_sink_only_under_a_geom_that_alone_touches_them() -> None:
    for other, targets in (("", ["floor", "foot"]), (OTHER, ["floor", "other"])):
        model = mujoco.MjModel.from_xml_string(
            FEET.format(foot='type="box" size=".1 .2 .1"', height=0.115, other=other)
        )
        sole, setting = find_effect("contact_sole"), setting_of(model)
        assert sole.targets(setting) == targets
        for name, starts in (("contact_margin", [[0.01]]), ("contact_friction", [])):
            assert np.array_equal(sole.extends(setting, Placed(find_effect(name), "floor", (0.01,))), starts)
        assert sole.extends(setting, Placed(find_effect("contact_margin"), "nothing", (0.01,))) == []


ROVER = """<mujoco><option timestep="0.002"/><worldbody>
  <geom name="floor" type="plane" size="50 50 1" friction="0.9"/>
  <body name="chassis" pos="0 0 .0999"><freejoint/>
    <geom name="hull" type="box" size=".2 .1 .03" mass="2" friction="{hull}"/>
    <geom name="caster" type="sphere" size=".1" pos=".2 0 0" mass=".1" friction="{caster}" {first} solref="{soft} 1"/>
    <body pos="-.1 .15 0"><joint name="left" axis="0 1 0"/>
      <geom name="left_tire" type="sphere" size=".1" mass=".3"/></body>
    <body pos="-.1 -.15 0"><joint name="right" axis="0 1 0"/>
      <geom name="right_tire" type="sphere" size=".1" mass=".3"/></body>
  </body></worldbody>
  <actuator><motor joint="left"/><motor joint="right"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    "rover",
    [
        {"first": 'condim="1" priority="1"', "caster": 0.01, "soft": 0.02, "hull": 1.0},
        {"first": 'condim="1" priority="-1"', "caster": 0.01, "soft": 0.02, "hull": 1.0},
        {"first": "", "caster": 1.4, "soft": 0.05, "hull": 0.5},
        {"first": 'solmix="3"', "caster": 0.3, "soft": 0.03, "hull": 1.2},
    ],
)
def test_contacts_stay_as_they_are_with_the_numbers_of_the_model(rover: dict[str, object]) -> None:
    """Whatever touches, of whichever priority and kind; with other numbers, they do not."""

    def driven(model: mujoco.MjModel) -> np.ndarray:
        data = mujoco.MjData(model)
        for _ in range(150):
            data.ctrl[:] = 2.0, 3.0  # they slip
            mujoco.mj_step(model, data)
        return np.array(data.qpos)

    model = mujoco.MjModel.from_xml_string(ROVER.format(**rover))
    before, setting = driven(model), setting_of(model)
    for name in ("contact_friction", "contact_stiffness"):
        effect = find_effect(name)
        for geom in ("floor", "caster", "left_tire", "right_tire"):
            neutral = [q.neutral for q in effect.quantities(setting, geom)]
            changed = mujoco.MjModel.from_xml_string(ROVER.format(**rover))
            effect.apply(changed, geom, np.array(neutral))
            np.testing.assert_allclose(driven(changed), before, rtol=0, atol=1e-12)
            effect.apply(changed, geom, 0.5 * np.array(neutral))
            assert geom == "caster" or not np.allclose(driven(changed), before, rtol=0, atol=1e-9)


def test_the_friction_of_one_geom_of_a_robot_is_not_that_of_its_others() -> None:
    """A foot that is rougher than the ground stays so when the friction of what is above it changes."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom name="floor" type="plane" size="9 9 1" friction=".9"/><body pos="0 0 1"><freejoint/>
        <geom name="torso" size=".1" friction="1.1"/><body pos="0 0 -.4"><joint axis="0 1 0"/>
        <geom name="shank" size=".05"/><body pos="0 0 -.4"><joint axis="0 1 0"/>
        <geom name="foot" size=".05" friction="2"/></body></body></body></worldbody></mujoco>"""
    )
    effect, before = find_effect("contact_friction"), model.geom_friction[:, 0].copy()
    for name in ("torso", "shank", "foot"):
        changed = with_effects(model, [Placed(effect, name, (0.4,))])
        own = changed.geom(name).id
        others = np.arange(model.ngeom) != own
        np.testing.assert_array_equal(changed.geom_friction[others, 0], before[others])
        assert changed.geom_friction[own, 0] == 0.4
        assert changed.geom_priority[own] > changed.geom_priority[0]


def test_a_geom_alone_decides_its_friction_and_softness() -> None:
    """A box slides with the friction given, whatever the floor's; softness leaves the friction as it was."""
    xml = """<mujoco><option timestep="0.001"/><worldbody>
      <geom name="floor" type="plane" size="50 50 1" friction="1.3"/>
      <body name="box" pos="0 0 .099">
        <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
        <geom name="box" type="box" size=".1 .1 .1" friction="0.7"/>
      </body></worldbody></mujoco>"""
    for name, values, friction in (("contact_friction", (0.4,), 0.4), ("contact_stiffness", (0.03, 1.0), 1.3)):
        model, data = applied(xml, name, "box", *values)
        mujoco.mj_step(model, data, 1000)
        assert np.allclose(data.contact[0].solref, values) == (name == "contact_stiffness")
        assert data.contact[0].friction[0] == pytest.approx(friction)
        if name == "contact_stiffness":
            continue  # what is soft also slips before it holds
        data.qvel[0] = 0.5
        mujoco.mj_step(model, data, 20)
        assert (0.5 - float(data.qvel[0])) / 0.02 == pytest.approx(9.81 * friction, rel=0.1)


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.5])
def test_stribeck_friction_at_a_steady_speed(speed: float) -> None:
    numbers = {"coulomb": 0.3, "static": 0.8, "velocity": 0.1}
    path = driven([{"effect": "joint_stribeck", "target": "rail", **numbers}], np.full(3, 2.0), (0.0, speed))
    wanted = 0.3 + 0.5 * np.exp(-((speed / 0.1) ** 2))
    assert 2.0 - forces(path, speed)[0] == pytest.approx(wanted, rel=0.02)


def test_stribeck_friction_holds_what_is_below_its_static_value() -> None:
    numbers = {"coulomb": 0.3, "static": 0.8, "velocity": 0.1}
    assert abs(driven([{"effect": "joint_stribeck", "target": "rail", **numbers}], np.full(400, 0.7))[-1, 1]) < 1e-3
    assert driven([{"effect": "joint_stribeck", "target": "rail", **numbers}], np.full(400, 0.9))[-1, 1] > 0.1


def test_cogging_ripples_with_the_position() -> None:
    numbers = {"amplitude": 0.7, "poles": 9.0, "phase": 0.4}
    path = driven([{"effect": "joint_cogging", "target": "rail", **numbers}], np.zeros(50), (0.1, 1.0))
    middle = np.append(0.1, path[:-1, 0]) + 0.5 * STEP * np.append(1.0, path[:-1, 1])
    np.testing.assert_allclose(forces(path, 1.0), 0.7 * np.sin(9 * middle + 0.4), atol=1e-9)


def test_coupling_is_a_spring_between_neighbors() -> None:
    model = general()
    setting = setting_of(model)
    states = some_states(model).numpy()
    found = find_effect("joint_coupling").force(
        setting, "elbow", np.array([[2.0]]), states[:, : model.nq], states[:, model.nq :]
    )
    assert found is not None
    stretch = states[:, 1] - states[:, 0]
    np.testing.assert_allclose(found[:, 1], -2 * stretch)
    np.testing.assert_allclose(found[:, 0], 2 * stretch)


def test_an_external_force_pushes_the_center() -> None:
    path = driven([{"effect": "external_force", "target": "cart", "x": 0.6, "y": 3.0, "z": 1.0}], np.zeros(5))
    np.testing.assert_allclose(forces(path), 0.6, atol=1e-9)


def test_gravity_and_ground_tilt_alike() -> None:
    xml = """<mujoco><worldbody><geom name="floor" type="plane" size="5 5 1" condim="1"/><body name="ball" pos="0 0 .1">
      <freejoint/><geom size=".1" condim="1"/></body></worldbody></mujoco>"""
    for name, factor in (("gravity_tilt", -1.0), ("ground_slope", 1.0)):
        model, data = applied(xml, name, None, 0.0, 0.1)
        for _ in range(500):
            mujoco.mj_step(model, data)
        assert data.qvel[0] == pytest.approx(factor * 9.81 * np.sin(0.1) * (np.cos(0.1) if factor > 0 else 1), rel=0.01)


@pytest.mark.parametrize("backend", ["mujoco", "warp"])
def test_a_delay_of_whole_steps_shifts_commands(backend: str) -> None:
    path = driven([{"effect": "actuator_delay", "target": "push", "delay": 7 * STEP}], COMMAND, backend=backend)
    late = np.concatenate([np.repeat(COMMAND[:1], 7), COMMAND[:-7]])
    np.testing.assert_allclose(forces(path), late, atol=1e-9)


def test_a_delay_of_part_of_a_step_gives_the_steps_mean() -> None:
    path = driven([{"effect": "actuator_delay", "target": "push", "delay": 2.25 * STEP}], COMMAND)
    padded = np.concatenate([np.repeat(COMMAND[:1], 3), COMMAND])
    np.testing.assert_allclose(forces(path), 0.75 * padded[1:-2] + 0.25 * padded[:-3], atol=1e-9)


def test_a_lag_answers_a_step_exponentially() -> None:
    command = np.concatenate([np.zeros(10), np.ones(60)])
    path = driven([{"effect": "actuator_lag", "target": "push", "time_constant": 0.05}], command)
    begin, end = (np.arange(60) + np.array([[0], [1]])) * STEP / 0.05
    mean = 1 - (np.exp(-begin) - np.exp(-end)) * 0.05 / STEP
    np.testing.assert_allclose(forces(path)[10:], mean, atol=1e-9)


def test_a_dead_band_swallows_and_play_holds() -> None:
    path = driven([{"effect": "actuator_deadband", "target": "push", "width": 0.3}], np.array([0.2, 0.5, -0.9, -0.1]))
    np.testing.assert_allclose(forces(path), [0, 0.2, -0.6, 0], atol=1e-9)
    path = driven([{"effect": "actuator_backlash", "target": "push", "width": 0.4}], np.array([0.0, 1, 0.7, 0.5, 0.9]))
    np.testing.assert_allclose(forces(path), [0, 0.8, 0.8, 0.7, 0.7], atol=1e-9)


@pytest.mark.parametrize(
    "effects",
    [
        [{"effect": "actuator_delay", "target": "push", "delay": 3.4 * STEP}],
        [{"effect": "actuator_lag", "target": "push", "time_constant": 0.4 * STEP}],
        [
            {"effect": "actuator_delay", "target": "push", "delay": 3.4 * STEP},
            {"effect": "actuator_backlash", "target": "push", "width": 0.3},
        ],
    ],
)
def test_the_past_reaches_into_a_window(effects: list) -> None:
    """Windows with their history continue what a whole episode does."""
    whole = driven(effects, COMMAND)
    simulator, history = simulator_of(general(SLIDE), effects, skip=1)
    padded = np.concatenate([np.repeat(COMMAND[:1], history), COMMAND])
    for at in range(20, 30):
        controls = torch.from_numpy(padded[at : at + history + 5][None, :, None])
        path = simulator.rollout(torch.from_numpy(whole[at - 1 : at]), controls, torch.zeros(1, 1, dtype=torch.float64))
        tolerance = 1e-5 if len(effects) == 1 and "time_constant" in effects[0] else 1e-12
        np.testing.assert_allclose(path[0, 0].numpy(), whole[at : at + 5], atol=tolerance)


def test_only_a_first_number_is_absent_at_a_bound() -> None:
    """At any other bound a number is as far as physics goes, and no name: half a wave over the range is no ripple."""
    setting = setting_of(general())
    shapes = [
        (effect.name, q.name)
        for effect in VOCABULARY.values()
        for target in effect.targets(setting)
        for q in effect.quantities(setting, target)[1:]
        if q.neutral in (q.low, q.high)
    ]
    # friction at rest, as at speed; what rolls with resistance and turns on the spot without
    drag = {("axis_drag", axis) for axis in "yz"}  # of a body that only moves ahead
    rotor = {
        ("joint_elasticity", "damping"),
        ("joint_elasticity", "inertia"),
    }  # a spring without, or beside the model's
    rest = {("joint_stribeck", "static"), ("joint_lugre", "static"), ("contact_rolling", "torsional")}
    assert {*shapes} <= drag | rotor | rest


@pytest.mark.parametrize("backend", ["mujoco", "warp"])
def test_a_limit_of_force_takes_the_place_of_the_models(backend: str) -> None:
    """A real limit may be below the model's or above it; a range of one side stays one."""
    limited = SLIDE.replace("/></actuator>", ' forcelimited="true" forcerange="-0.3 0.6"/></actuator>')
    effect, setting = find_effect("actuator_saturation"), setting_of(general(limited))
    (limit,) = effect.quantities(setting, "push")
    assert effect.targets(setting) == ["push"]
    assert (limit.neutral, limit.low < 0.6 < limit.high) == (0.6, True)
    for value, expected in ((0.6, [0.6, -0.3]), (0.2, [0.2, -0.1]), (1.2, [1.0, -0.6])):
        entry = {"effect": effect.name, "target": "push", "limit": value}
        path = driven([entry], np.array([1.0, -1.0]), xml=limited, backend=backend)
        np.testing.assert_allclose(forces(path), expected, atol=1e-9)


def test_saturation_and_gain_and_back_emf() -> None:
    path = driven([{"effect": "actuator_saturation", "target": "push", "limit": 0.4}], np.array([1.0, -1, 0.2]))
    np.testing.assert_allclose(forces(path), [0.4, -0.4, 0.2], atol=1e-9)
    path = driven([{"effect": "actuator_gain", "target": "push", "gain": 0.7}], np.array([1.0, -1]))
    np.testing.assert_allclose(forces(path), [0.7, -0.7], atol=1e-9)
    path = driven([{"effect": "actuator_bias", "target": "push", "force": 0.2}], np.array([1.0, -1]))
    np.testing.assert_allclose(forces(path), [1.2, -0.8], atol=1e-9)
    path = driven([{"effect": "actuator_damping", "target": "push", "damping": 0.5}], np.array([1.0]), (0.0, 2.0))
    assert forces(path, 2.0)[0] == pytest.approx(0.0, abs=1e-2)


@pytest.mark.parametrize("backend", ["mujoco", "warp"])
def test_sensors_show_what_they_show(backend: str) -> None:
    plain = driven([{"effect": "actuator_delay", "target": "push", "delay": 0.0}], COMMAND, (0.3, 1.0))
    off = driven(
        [{"effect": "sensor_bias", "target": "rail.position", "bias": 0.2}], COMMAND, (0.5, 1.0), backend=backend
    )
    np.testing.assert_allclose(off, plain + [0.2, 0.0], atol=1e-12)
    off = driven([{"effect": "sensor_scale", "target": "rail.velocity", "factor": 2.0}], COMMAND, (0.3, 2.0))
    np.testing.assert_allclose(off, plain * [1.0, 2.0], atol=1e-12)


def test_a_late_sensor_shows_the_past() -> None:
    command, delay = np.full(30, 1.5), 3.5 * STEP
    path = driven([{"effect": "sensor_delay", "target": "rail.velocity", "delay": delay}], command, (0.0, 1.0))
    times = STEP * np.arange(1, 31)
    np.testing.assert_allclose(path[:, 1], 1.0 + 0.75 * times, atol=1e-9)  # 1.5 N on 2 kg, as it would be without delay
    path = driven([{"effect": "sensor_delay", "target": "rail.position", "delay": delay}], np.zeros(30), (0.2, 1.0))
    np.testing.assert_allclose(path[:, 0], 0.2 + times, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "values", "both"),
    [("sensor_delay", {"delay": 3.5 * STEP}, True), ("sensor_scale", {"factor": 1.2}, True),
     ("sensor_bias", {"bias": 0.2}, False)],
)  # fmt: skip
def test_a_velocity_derived_from_a_measured_position_shows_what_that_shows(name: str, values: dict, both: bool) -> None:
    """As two sensors would; only a constant has no derivative. It is no target of its own."""
    columns = ("rail.position", "rail.velocity")
    own = [{"effect": name, "target": column, **values} for column in columns]
    expected = driven(own[: 1 + both], COMMAND, (0.3, 1.0))
    found = driven(own[:1], COMMAND, (0.3, 1.0), differentiated=True)
    np.testing.assert_array_equal(found, expected)
    assert np.abs(found - driven(own[:1], COMMAND, (0.3, 1.0))).max() > 1e-3 or not both
    setting = setting_of(general(SLIDE))
    assert find_effect(name).targets(setting) == [*columns]
    assert find_effect(name).targets(replace(setting, differentiated=True)) == [*columns[:1]]


@pytest.mark.parametrize("late", [(3, 0), (0, 2), (3, 2)])
def test_a_window_of_late_measurements_begins_where_they_were_taken(late: tuple[int, int]) -> None:
    """Under one command up to a window's start and another from there on, every late measurement is foretold."""
    command = np.concatenate([np.full(20, 1.5), np.full(10, -2.0)])
    true = np.concatenate([[[0.2, 1.0]], driven([{**_NOTHING, "delay": 0.0}], command, (0.2, 1.0))])
    shown = np.stack([true[20 - late[i] : 31 - late[i], i] for i in (0, 1)], 1)
    effects = [
        {"effect": "sensor_delay", "target": f"rail.{column}", "delay": n * STEP}
        for column, n in zip(("position", "velocity"), late, strict=True)
    ]
    simulator, history = simulator_of(general(SLIDE), effects, skip=1)
    assert history == 1
    controls = torch.from_numpy(command[20 - history :][None, :, None])
    path = simulator.rollout(torch.from_numpy(shown[:1]), controls, torch.zeros(1, 1, dtype=torch.float64))
    np.testing.assert_allclose(path[0, 0], shown[1:], atol=1e-9)


def test_each_parameter_vector_has_its_own_numbers() -> None:
    parameters = {
        "delay": {"effect": "actuator_delay", "name": "push", "bounds": [0.0, 0.05]},
        "friction": {"effect": "joint_friction", "name": "rail", "index": "friction", "bounds": [0.0, 0.5]},
    }
    simulator, history = simulator_of(general(SLIDE), [], parameters, skip=1)
    controls = torch.from_numpy(np.concatenate([np.repeat(COMMAND[:1], history), COMMAND])[None, :, None])
    values = torch.tensor([[0.0, 0.0], [2 * STEP, 0.0], [2 * STEP, 0.3]], dtype=torch.float64)
    start = torch.tensor([[0.0, 3.0]], dtype=torch.float64)
    path = simulator.rollout(start, controls, values)
    for k, value in enumerate(values):
        alone = simulator.simulate(start, controls, value[None])
        assert torch.equal(alone[0, 0], path[0, k, -1])
    shifted = np.concatenate([np.repeat(COMMAND[:1], 2), COMMAND[:-2]])
    np.testing.assert_allclose(forces(path[0, 1].numpy(), 3.0), shifted, atol=1e-9)
    np.testing.assert_allclose(forces(path[0, 2].numpy(), 3.0), shifted - 0.3, atol=1e-3)


# Laws of the kernels


class Mean(ActuatorDeadband):
    """A user's own filter: the mean of the last three commands, times a number."""

    name = "own_mean"

    def settled(self, command: torch.Tensor, values: torch.Tensor, step: float) -> torch.Tensor:
        return command.expand(-1, 2)

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        known = torch.cat([state, signal], 1)
        return known.unfold(1, 3, 1).sum(-1) * (values[:, :1] / 3), known[:, -2:]


class Mixed(SensorScale):
    """A user's own sensor, late and scaled."""

    name = "own_mixed"

    def memory(self, values: np.ndarray) -> float:
        return 0.5 * float(values[0])

    def sense(self, path: SensedPath, column: int, values: torch.Tensor) -> torch.Tensor:
        return values[:, :1] * path.ago(column, 0.5 * values[:, :1])


def filters_of(method: str) -> list[Any]:
    own: list[Effect] = [Mean() if method == "command" else Mixed()]
    return [pytest.param(e, id=e.name) for e in [*VOCABULARY.values(), *own] if e.has(method)]


def drawn(rows: int, high: float) -> torch.Tensor:
    values = high * torch.rand(rows, 1, generator=torch.Generator().manual_seed(rows), dtype=torch.float64)
    values[0] = 0.0 if rows > 1 else 0.3 * high
    return values


@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("effect", filters_of("command"))
def test_commands_of_an_episode_are_those_of_its_steps(effect: Effect, alike: bool) -> None:
    """At once, in parts of any length with the state handed on, or a row at a time."""
    rows, steps = 5, 130
    signal = torch.from_numpy(np.random.default_rng(2).standard_normal((rows, steps)))
    values = drawn(1 if alike else rows, 0.06)
    whole, _ = effect.command(signal, values, STEP, effect.settled(signal[:, :1], values, STEP))
    for lengths in ((1,), (4,), (7, 1, 30)):
        state, parts, at = effect.settled(signal[:, :1], values, STEP), [], 0
        while at < steps:
            part = signal[:, at : at + lengths[len(parts) % len(lengths)]]
            out, state = effect.command(part, values, STEP, state)
            parts.append(out)
            at += part.shape[1]
        torch.testing.assert_close(torch.cat(parts, 1), whole, rtol=0, atol=1e-13)
    own = values.expand(rows, -1)
    alone = [
        filtered(signal[i : i + 1, :, None].numpy(), [Filter(effect, 0, own[i : i + 1])], STEP) for i in range(rows)
    ]
    np.testing.assert_allclose(np.concatenate(alone)[..., 0], whole.numpy(), rtol=0, atol=1e-13)
    held = torch.ones(rows, 9, dtype=torch.float64)
    out, _ = effect.command(held, values, STEP, effect.settled(held[:, :1], values, STEP))
    torch.testing.assert_close(out, out[:, :1].expand(-1, 9), rtol=0, atol=1e-13)  # what has settled stays


@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("effect", filters_of("sense"))
def test_what_sensors_show_of_an_episode_is_what_they_show_in_its_steps(effect: Effect, alike: bool) -> None:
    rows, instants, rates = 4, 12, (1, -1)
    rng = np.random.default_rng(3)
    truth = torch.from_numpy(rng.standard_normal((rows, SKIP * instants + 1, 2)).cumsum(1))
    values = drawn(1 if alike else rows, 0.07)
    fine = extended(truth, torch.from_numpy(rng.standard_normal((rows, 2))), 0.0, 5 * SKIP, STEP)
    sensors = [Filter(effect, 0, values)]
    whole = sensed(SensedPath.of(fine, instants + 1, SKIP, STEP, rates), sensors)
    for t in range(instants + 1):
        past = fine[:, t * SKIP : 5 * SKIP + t * SKIP + 1]  # as long as the longest delay
        now = sensed(SensedPath.of(past, 1, SKIP, STEP, rates), sensors)
        torch.testing.assert_close(now[:, 0], whole[:, t], rtol=0, atol=1e-12)
    known = SensedPath.of(truth, instants + 1, SKIP, STEP, rates).known(effect.memory(np.array([0.03])))
    late = 0 if effect.memory(np.array([0.03])) == 0 else int(np.ceil(effect.memory(np.array([0.03])) / STEP / SKIP))
    assert known.tolist() == [t >= late for t in range(instants + 1)]


def test_search_and_fit_know_the_velocities_of_the_same_columns() -> None:
    setting = setting_of(general())
    labels = setting.observation.labels
    found = {labels[i]: labels[rate] for i, rate in enumerate(observed_rates(setting)) if rate >= 0}
    simple = {f"{joint}.position": f"{joint}.velocity" for joint in ("shoulder", "elbow", "rail")}
    assert found == simple | {f"root.position[{x}]": f"root.velocity[v{x}]" for x in "xyz"}
    assert Twin(setting, ParameterSpace.empty(setting.model)).rates.tolist() == list(observed_rates(setting))


@pytest.mark.parametrize("delay", [0.4 * STEP, 3.7 * STEP])
def test_search_and_fit_show_the_same_late_measurement(delay: float) -> None:
    """Once both know it: without acceleration before the window, a late sensor shows the same in both."""
    model = general(SLIDE)
    simulator, history = simulator_of(model, [{"effect": "sensor_delay", "target": "rail.position", "delay": delay}])
    space, setting = ParameterSpace.empty(model), setting_of(model)
    start, command = np.array([[0.2, 1.0]]), np.concatenate([[0.0], COMMAND[:9]])[None, :, None]
    fitted = simulator.rollout(*(torch.from_numpy(x) for x in (start, command, np.zeros((1, 1)))))[0, 0].numpy()
    windows = Windows(np.repeat(start[None], 10, 1), start[:, ::-1] * [1.0, 0.0], np.array([0]), np.array([1]), command)
    placed = Placed(find_effect("sensor_delay"), "rail.position", (delay,))
    found, valid = Twin(setting, space).predict([Variant((), (placed,))], windows)
    assert history == 1
    assert valid[0, 0, 1:].all()
    np.testing.assert_allclose(found[0, 0, 1:], fitted, rtol=0, atol=1e-12)


# In configs


XML = (Path(__file__).parent / "arm.py").read_text().split('XML = """')[1].split('"""')[0]


def record_arm(folder: Path, *, delay: int = 0, friction: float = 0.0, steps: int = 150) -> dict:
    """Write an arm and its log, with what its model lacks: a delay of the elbow's command in steps, and friction."""
    model = mujoco.MjModel.from_xml_string(XML)
    find_effect("joint_friction").apply(model, "elbow", np.array([friction]))
    data = mujoco.MjData(model)
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (steps // 5, 2)), 5, 0)
    fine = np.repeat(actions, 2, 0)
    fine[delay:, 1] = fine[: len(fine) - delay, 1].copy()
    fine[:delay, 1] = actions[0, 1]
    path = [np.concatenate([data.qpos, data.qvel])]
    for s, control in enumerate(fine):
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        if s % 2:
            path.append(np.concatenate([data.qpos, data.qvel]))
    rows = np.array(path)
    np.savez(
        folder / "log.npz", observations=rows[:-1], next_observations=rows[1:], actions=actions,
        terminals=np.arange(steps) == steps - 1,
    )  # fmt: skip
    (folder / "arm.xml").write_text(XML)
    return {
        "model": str(folder / "arm.xml"), "data": str(folder / "log.npz"), "frame_skip": 2, "samples": 20,
        "threads": 1, "epsilon": 1e-9,
    }  # fmt: skip


DELAY = {"effect": "actuator_delay", "name": "bend", "index": "delay", "bounds": [0.0, 0.08], "unit": "s"}


@pytest.mark.parametrize("backend", ["mujoco", "warp"])
def test_a_fit_recovers_a_hidden_delay_and_friction(tmp_path: Path, backend: str) -> None:
    document = {**record_arm(tmp_path, delay=3, friction=0.15), "backend": backend, "parameters": {"delay": DELAY}}
    if backend == "mujoco":
        document["parameters"]["friction"] = {"effect": "joint_friction", "name": "elbow", "bounds": [0.0, 0.5]}
    else:
        document["effects"] = [{"effect": "joint_friction", "target": "elbow", "friction": 0.15}]
    problem = make_problem(make_config(document))
    assert isinstance(problem.simulator, EffectSimulator)
    mean = fit(problem.objective, FitSettings(samples=20)).distribution.summary()
    assert mean["delay"]["mean"] == pytest.approx(0.03, abs=1e-5)
    assert backend == "warp" or mean["friction"]["mean"] == pytest.approx(0.15, abs=1e-4)


@pytest.mark.parametrize("names", [["shoulder", "elbow"], ["*"], ["elbow", "*"], "*"])
def test_a_number_that_several_places_share_is_one_parameter(tmp_path: Path, names: list[str] | str) -> None:
    shared = {"friction": {"effect": "joint_friction", "name": names, "bounds": [0.0, 0.5]}}
    problem = make_problem(make_config({**record_arm(tmp_path, friction=0.15), "parameters": shared}))
    assert problem.effects is not None
    found = problem.effects.at(np.array([0.2]))
    assert sorted((p.effect.name, p.target, p.values) for p in found) == [
        ("joint_friction", "elbow", (0.2,)), ("joint_friction", "shoulder", (0.2,)),
    ]  # fmt: skip


def test_where_velocities_are_not_observed_a_late_sensor_saw_rest_before(tmp_path: Path) -> None:
    """A window begins at rest there, however hard something pushes at its start."""
    late = [{"effect": "sensor_delay", "target": "elbow.position", "delay": 0.05}]
    mass = {"mass": {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.0]}}
    document = {**record_arm(tmp_path, steps=20), "parameters": mass, "effects": late}
    log = np.load(document["data"])
    np.savez(document["data"], **{**log, "observations": log["observations"][:, :2],
                                  "next_observations": log["next_observations"][:, :2]})  # fmt: skip
    problem = make_problem(make_config({**document, "observation": ["qpos"]}))
    start, push = torch.tensor([[0.3, -0.4, 0.0, 0.0]], dtype=torch.float64), torch.full((1, 8, 2), 3.0)
    shown = problem.simulator.rollout(start, push.double(), torch.tensor([[0.5]], dtype=torch.float64))[0, 0]
    assert shown[0, 1].item() == pytest.approx(-0.4, abs=1e-12)
    assert (shown[:, 0] - 0.3).abs().max() > 0.1


REMEMBERING = [
    ("actuator_delay", "bend", {"delay": 0.033}), ("actuator_lag", "bend", {"time_constant": 0.02}),
    ("actuator_backlash", "bend", {"width": 0.5}), ("sensor_delay", "elbow.velocity", {"delay": 0.013}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "target", "numbers"), REMEMBERING, ids=[e[0] for e in REMEMBERING])
@pytest.mark.parametrize("varies", [False, True])
def test_what_was_commanded_before_the_log_does_not_matter(
    tmp_path: Path, name: str, target: str, numbers: dict[str, float], varies: bool
) -> None:
    """The end of a recording is compared as it is within the whole of it."""
    base, whole = record_arm(tmp_path, friction=0.15), np.load(tmp_path / "log.npz")
    np.savez(tmp_path / "end.npz", **{k: whole[k][40:] for k in whole.files})
    ((key, value),) = numbers.items()
    quantity = {"effect": name, "name": target, "index": key, "bounds": [0.5 * value, value], "unit": "s"}
    mass = {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.0]}
    document = {**base, "parameters": {"mass": mass}, "effects": [{"effect": name, "target": target, **numbers}]}
    if varies:
        document = {**base, "parameters": {"x": quantity}}
    problems = [make_problem(make_config({**document, "data": str(tmp_path / f)})) for f in ("log.npz", "end.npz")]
    vector = np.array([[0.9 * value if varies else 0.7]])
    known, end = (p.objective.simulated(vector)[:, 0].numpy() for p in problems)
    rows = [p.objective.transitions.rows for p in problems]
    assert 0 < problems[1].left_out < 40
    np.testing.assert_array_equal(rows[1], np.arange(problems[1].left_out, 150 - 40))
    np.testing.assert_allclose(end, known[np.searchsorted(rows[0], rows[1] + 40)], atol=1e-3)


class Alternating(Effect):
    """A user's filter that remembers the sign of the last large command."""

    name, kind, sentence = "alternating", "actuator", "{target} sticks to a side"

    def targets(self, setting: Setting) -> list[str | None]:
        return list(setting.names("actuator"))

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("size", "-", 0.0, 0.0, 1.0, 1.0),)

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        out, side = [], state.sign()
        for c in signal.T[..., None]:
            side = torch.where(c.abs() > 0.8, c.sign(), side)
            out.append(c + values[:, :1] * side)
        return torch.cat(out, 1), side


def test_any_filter_tells_from_when_on_the_past_does_not_matter() -> None:
    ramp = np.tile(0.1 * np.array([0, 1, 2, 3, 4, 5, 4, 3, 2, -1, -9, -1, 0, 9, 0.0]), (2, 1))[..., None]
    ramp[1] *= 0.5

    def after(effect: Effect, *values: float, skip: int = 1) -> list[int]:
        own = Filter(effect, 0, torch.tensor([values], dtype=torch.float64))
        return settled_after(ramp, [own], skip, 0.01 / skip).tolist()

    late = find_effect("actuator_delay")
    assert [after(late, t)[0] for t in (0.0, 0.02, 0.021, 0.03)] == [0, 2, 3, 3]
    assert after(late, 0.021, skip=4) == [3, 3]
    assert after(late, 0.0201, skip=4) == [3, 3]
    assert after(find_effect("actuator_deadband"), 0.1) == [0, 0]
    assert after(find_effect("actuator_backlash"), 1.6) == [13, 15]  # where the play was crossed both ways, if ever
    assert after(Alternating(), 0.3) == [10, 15]
    lag = after(find_effect("actuator_lag"), 0.01)
    assert lag == [7, 7]  # e⁻⁷ is the thousandth of the range that passes for the same


def test_a_log_of_which_nothing_is_known_is_refused(tmp_path: Path) -> None:
    width = {"effect": "actuator_backlash", "target": "bend", "width": 50.0}
    mass = {"mass": {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.0]}}
    with pytest.raises(InputError, match="longer episodes"):
        make_problem(make_config({**record_arm(tmp_path), "parameters": mass, "effects": [width]}))


def test_fixed_native_effects_become_part_of_the_model_and_keep_gradients(tmp_path: Path) -> None:
    base = record_arm(tmp_path, friction=0.15)
    mass = {"mass": {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.0]}}
    effects = [{"effect": "joint_friction", "target": "elbow", "friction": 0.15}]
    errors = []
    for backend in ("mujoco", "warp"):
        problem = make_problem(make_config({**base, "backend": backend, "parameters": mass, "effects": effects}))
        assert problem.simulator.differentiable == (backend == "warp")
        assert not isinstance(problem.simulator, EffectSimulator)
        if backend == "warp":
            certify(problem.objective, max_transitions=10, points=1).check()
        shown = problem.objective.simulated(np.array([[0.7]]))[:, 0]
        errors.append(float((shown - torch.from_numpy(problem.objective.transitions.measured)).abs().max()))
    assert max(errors) < 1e-6


@pytest.mark.parametrize(
    ("name", "target", "values"),
    [
        ("payload", "lower", (0.2, 0.05, 0.0, -0.3)), ("payload", "ball", (0.2, 0.05, 0.0, 0.0)),
        ("gravity_tilt", None, (0.1, 0.2)), ("ground_slope", None, (0.1, -0.05)), ("integration", None, (STEP / 8,)),
        ("integration_own", None, (STEP / 4,)), ("fluid_medium", None, (300.0,)), ("joint_stop", "elbow", (-0.3, 0.4)),
        ("contact_friction", "floor", (0.3,)), ("joint_limit", "shoulder", (0.8, -0.8)),
        ("actuator_saturation", "bend", (0.5,)),
    ],
)  # fmt: skip
def test_warp_has_native_effects_as_mujoco_has(name: str, target: str | None, values: tuple[float, ...]) -> None:
    model = general(RIG.replace('name="cart" type="box" size=".1 .1 .1"', 'name="cart" type="sphere" size=".1"'))
    document = entry(find_effect(name), target, np.array(values), setting_of(model))
    states, controls = some_states(model), some_controls(model, 3)
    found = [
        simulator_of(model, [document], backend=backend)[0].rollout(
            states, controls, torch.full((1, 1), 0.1, dtype=torch.float64)
        )
        for backend in ("mujoco", "warp")
    ]
    torch.testing.assert_close(*found, rtol=0, atol=1e-9)


def test_gymnasium_environments_have_effects_around_them() -> None:
    effects = [
        {"effect": "actuator_delay", "target": "leg_joint", "delay": 0.008},
        {"effect": "joint_friction", "target": "foot_joint", "friction": 0.3},
        {"effect": "sensor_bias", "target": "thigh_joint.position", "bias": 0.01},
    ]
    document = {
        "data": str(SIM.log), "observation": list(SIM.observation), "effects": effects, "threads": 1,
        "parameters": {n: dict(p) for n, p in SIM.parameters.items()},
    }  # fmt: skip
    ours = make_problem(make_config({**document, "model": str(HOPPER), "frame_skip": SIM.frame_skip}))
    theirs = make_problem(make_config({**document, "backend": "gymnasium", "environment": "Hopper-v5"}))
    values = 0.5 * (ours.space.low + ours.space.high)[None]
    few = np.arange(0, len(ours.objective), 20)
    found = [p.objective.on(p.objective.transitions.select(few)).simulated(values) for p in (ours, theirs)]
    torch.testing.assert_close(*found, rtol=0, atol=1e-8)
    force = [{"effect": "external_force", "target": "torso", "x": 1.0, "y": 0.0, "z": 0.0}]
    with pytest.raises(InputError, match=r"backend gymnasium cannot have external_force at torso.*backend: mujoco"):
        make_problem(make_config({**document, "backend": "gymnasium", "environment": "Hopper-v5", "effects": force}))


@pytest.mark.parametrize(
    ("effects", "parameters", "message"),
    [
        ([{"effect": "actuator_dellay", "target": "bend"}], {}, r"effects\[0\]: .*did you mean 'actuator_delay'"),
        ([{"effect": "actuator_delay", "target": "bent", "delay": 0.1}], {}, "did you mean 'bend'"),
        ([{"effect": "actuator_delay", "delay": 0.1}], {}, "no target given; expected the actuator's name"),
        ([{"effect": "gravity_tilt", "target": "x", "roll": 0, "pitch": 0}], {}, "belongs to the whole world"),
        ([{"effect": "actuator_delay", "target": "bend", "delai": 0.1}], {}, "unknown key 'delai'.*'delay'"),
        ([{"effect": "actuator_delay", "target": "bend", "delay": "x"}], {}, "delay is 'x'; expected a number in s"),
        ([{"effect": "actuator_delay", "target": "bend"}], {}, "has no delay; give delay: a number in s"),
        ([{"target": "bend"}], {}, "no effect named"),
        ([{"effect": "actuator_delay", "target": "bend", "delay": 0.1}] * 2, {}, "stands there twice"),
        ([], {"x": {**DELAY, "index": "deley"}}, "parameters.x: .*did you mean 'delay'"),
        ([], {"x": {**DELAY, "field": "body_mass"}}, "field belongs to a field"),
        (
            [],
            {"x": {**DELAY, "bounds": [-0.1, 0.1]}},
            "parameters.x: bounds .* allow a delay of actuator_delay below 0",
        ),
        ([], {"x": DELAY, "y": DELAY}, "already a parameter"),
        ([], {"x": {**DELAY, "name": ["bend", "bent"]}}, "cannot be at 'bent'.*did you mean 'bend'"),
        ([], {"x": {**DELAY, "name": "q*"}}, r"parameters.x: actuator_delay cannot be at 'q\*'"),
        ([], {"x": {**DELAY, "name": 3}}, "parameters.x: name is 3; expected a name, or a list of them"),
        ([], {"x": {**DELAY, "effect": "delai", "name": "b*"}}, "parameters.x: effect: unknown 'delai'"),
        ([], {"x": {"effect": "joint_cogging", "name": "elbow", "bounds": [0, 1]}}, "several numbers; add index"),
        ([], {"x": {"effect": "joint_cogging", "name": "elbow", "index": "amplitude", "bounds": [0, 1]}}, "no poles"),
        ([{"effect": "integration", "timestep": 0.003}], {}, "no whole number"),
        (
            [{"effect": "joint_friction", "target": "elbow", "friction": -1e18}],
            {},
            "effects: friction of joint_friction at elbow is -1e\\+18 N·m; expected .* or more",
        ),
    ],
)
def test_errors_of_a_config(tmp_path: Path, effects: list, parameters: dict, message: str) -> None:
    mass = {"mass": {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.0]}}
    document = {**record_arm(tmp_path, steps=20), "effects": effects, "parameters": {**mass, **parameters}}
    with pytest.raises(InputError, match=message):
        make_problem(make_config(document))


def test_what_warp_cannot_have_is_refused_in_one_line(tmp_path: Path) -> None:
    base = {**record_arm(tmp_path, steps=20), "backend": "warp"}
    mass = {"mass": {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.0]}}
    cogging = {"effect": "joint_cogging", "target": "elbow", "amplitude": 1.0, "poles": 3.0, "phase": 0.0}
    payload = {"effect": "payload", "target": "lower", "mass": 0.1, "x": 0, "y": 0, "z": -0.1}
    varying = {"f": {"effect": "joint_friction", "name": "elbow", "bounds": [0, 1]}}
    for extra, message in (
        (
            {"effects": [cogging], "parameters": mass},
            "backend warp cannot have joint_cogging at elbow.*backend: mujoco",
        ),
        ({"parameters": {**mass, **varying}}, "joint_friction at elbow has a number that varies"),
        ({"effects": [payload], "parameters": mass}, "payload at lower writes the same number.*'mass'"),
    ):
        with pytest.raises(InputError, match=message):
            make_problem(make_config({**base, **extra}))


def test_adam_says_why_it_has_no_gradients(tmp_path: Path) -> None:
    document = {**record_arm(tmp_path, steps=20), "backend": "warp", "parameters": {"delay": DELAY}}
    problem = make_problem(make_config(document))
    assert not hasattr(problem.simulator, "jacobian")
    with pytest.raises(InputError, match=r"adam needs gradients.*actuator_delay.*fisher or cma"):
        fit(problem.objective, FitSettings(optimizer="adam", samples=4))


def test_ones_own_effect_joins_the_vocabulary(monkeypatch: pytest.MonkeyPatch) -> None:
    class Wind(type(find_effect("external_force"))):  # type: ignore[misc]
        name = "wind_test"

    monkeypatch.setitem(VOCABULARY, "wind_test", VOCABULARY["payload"])
    with pytest.raises(InputError, match="taken"):
        register(Wind())
    del VOCABULARY["wind_test"]
    assert register(Wind()) is find_effect("wind_test")


OWN = """
from dropo_torch.effects.body import ExternalForce
class Wind(ExternalForce):
    name = "wind_of_config"
class Taken(ExternalForce):
    name = "payload"
def breaks():
    raise ValueError("no wind today")
"""


def test_a_config_names_effects_of_ones_own(tmp_path: Path) -> None:
    """Once or again: a file that is read a second time takes its own place."""
    (tmp_path / "wind.py").write_text(OWN)
    base = {**record_arm(tmp_path, steps=20), "parameters": {"delay": DELAY}}
    wind = {
        "effects": [{"effect": "wind_of_config", "target": "lower", "x": 1.0, "y": 0.0, "z": 0.0}],
        "own_effects": ["wind.py:Wind"],
    }
    for _ in range(2):
        config = make_config({**base, **wind}, base=tmp_path)
        make_problem(config)
    assert config.portable()["own_effects"] == [f"{tmp_path.resolve()}/wind.py:Wind"]
    for name, message in {
        "wind.py": "expected file.py:Class of an Effect",
        "breeze.py:Wind": "own_effects: no file .*breeze.py",
        "wind.py:Wnd": "no class 'Wnd'.*did you mean 'Wind'",
        "wind.py:breaks": r"own_effects: wind.py:breaks fails, .*line \d+: ValueError: no wind today",
        "wind.py:Taken": "the name 'payload' is taken",
        "builtins:dict": "makes a dict; expected a subclass",
    }.items():
        with pytest.raises(InputError, match=message):
            make_problem(make_config({**base, "own_effects": [name]}, base=tmp_path))


def test_history_stays_inside_its_episode() -> None:
    actions = np.arange(8.0)[:, None]
    states = np.zeros((8, 2))
    log = Trajectories(states, states, actions, np.array([0, 0, 0, 0, 1, 0, 0, 1]))
    found = make_transitions(log, generic_observation(2), lag=1, history=3)
    assert found.lag == 1
    assert found.controls[2, :, 0].tolist() == [0, 0, 1, 2]
    assert found.controls[4, :, 0].tolist() == [1, 2, 3, 4]
    assert found.controls[6, :, 0].tolist() == [5, 5, 5, 6]
    assert found.select(slice(2, 4)).lag == 1


def test_backends_agree_where_all_parameters_are_of_effects(tmp_path: Path) -> None:
    effects = [
        {"effect": "sensor_delay", "target": "elbow.velocity", "delay": 0.013},
        {"effect": "sensor_scale", "target": "elbow.position", "factor": 1.1},
    ]
    document = {**record_arm(tmp_path, steps=40), "lag": 3, "parameters": {"delay": DELAY}, "effects": effects}
    values = np.array([[0.01], [0.033]])
    found = [
        make_problem(make_config({**document, "backend": b})).objective.simulated(values) for b in ("mujoco", "warp")
    ]
    torch.testing.assert_close(*found, rtol=0, atol=1e-7)


def test_a_sensor_shows_at_the_start_what_was_measured(tmp_path: Path) -> None:
    effects = [
        {"effect": "sensor_scale", "target": "rail.position", "factor": 1.3},
        {"effect": "sensor_bias", "target": "rail.position", "bias": 0.2},
    ]
    shown = driven(effects, np.zeros(1), (0.7, 0.0))
    np.testing.assert_allclose(shown[0], [0.7, 0.0], atol=1e-12)


def test_a_free_body_may_carry_a_payload_in_a_config(tmp_path: Path) -> None:
    (tmp_path / "rig.xml").write_text(RIG)
    model = general()
    states = some_states(model, 6).numpy()
    np.savez(
        tmp_path / "log.npz", observations=states[:-1], next_observations=states[1:], actions=np.zeros((5, model.nu)),
        terminals=np.ones(5, dtype=bool),
    )  # fmt: skip
    payload = {"effect": "payload", "target": "ball", "x": 0.05, "y": 0, "z": 0}
    parameters = {"mass": {"effect": "payload", "name": "ball", "index": "mass", "bounds": [0.1, 1.0]}}
    document = {"model": "rig.xml", "data": "log.npz", "frame_skip": 1, "effects": [payload], "parameters": parameters}
    problem = make_problem(make_config(document, base=tmp_path))
    shown = problem.objective.simulated(np.array([[0.1], [0.9]]))
    assert torch.isfinite(shown).all()
    assert float((shown[:, 0] - shown[:, 1]).abs().max()) > 1e-4


def test_a_run_says_what_its_model_file_lacks(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    effects = [{"effect": "joint_friction", "target": "elbow", "friction": 0.15}]
    document = {**record_arm(tmp_path, delay=3, friction=0.15), "parameters": {"delay": DELAY}, "effects": effects}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(document))
    assert main(["fit", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "out")]) == 0
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    assert written.joint("elbow").frictionloss[0] == pytest.approx(0.15)
    report = (tmp_path / "out" / "report.html").read_text()
    assert "actuator_delay at bend" in report
    assert "delay of actuator_delay at bend" in report
    again = make_problem(load_config(tmp_path / "out" / "fitted_config.yaml"))
    assert isinstance(again.simulator, EffectSimulator)


# In files


def native_placements() -> list[Any]:
    return [p for p in placements() if p.values[0].in_mjcf]


@pytest.mark.parametrize(("effect", "target"), native_placements())
def test_a_native_effect_survives_mjcf(effect: Effect, target: str | None, tmp_path: Path) -> None:
    source = tmp_path / "rig.xml"
    source.write_text(RIG)
    model = general()
    setting = setting_of(model)
    values = effect.starts(setting, target)[-1]
    for i, q in enumerate(effect.quantities(setting, target)):
        if values[i] == q.neutral:
            values[i] = np.clip(q.neutral + 0.1 * q.scale, q.low, q.high)
    assert write_model(source, [Placed(effect, target, tuple(values))], tmp_path / "model.xml") == []
    effect.apply(model, target, values)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    state, control = some_states(model)[0].numpy(), some_controls(model, 50)[0].numpy()
    paths = []
    for m in (model, written):
        data = mujoco.MjData(m)
        data.qpos[:], data.qvel[:] = state[: m.nq], state[m.nq :]
        for u in control:
            data.ctrl[:] = u
            mujoco.mj_step(m, data)
        paths.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(*paths, rtol=0, atol=2e-5 * max(1.0, np.abs(paths[0]).max()))


def test_an_activations_time_constant_is_written(tmp_path: Path) -> None:
    source = tmp_path / "rig.xml"
    source.write_text(MODELS["actuator_time_constant"])
    assert (
        write_model(source, [Placed(find_effect("actuator_time_constant"), "push", (0.12,))], tmp_path / "model.xml")
        == []
    )
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert written.actuator("push").dynprm[0] == pytest.approx(0.12)


def test_a_found_config_fits(tmp_path: Path) -> None:
    """The model and config that name a delay and a friction lead a fit to both."""
    base = record_arm(tmp_path, delay=3, friction=0.15)
    mass = {"mass": {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.0], "scale_inertia": True}}
    config = make_config({**base, "parameters": mass})
    problem = make_problem(config)
    setting = plain_setting(problem.space.model, problem.observation, 2)
    placed = [
        Placed(find_effect("joint_friction"), "elbow", (0.14,)),
        Placed(find_effect("actuator_delay"), "bend", (0.028,)),
    ]
    intervals = {placed[0].key: {"friction": (0.13, 0.15)}, placed[1].key: {"delay": (0.026, 0.030)}}
    rest = write_model(tmp_path / "arm.xml", placed, tmp_path / "model.xml", problem.space, np.array([0.7]))
    assert [p.effect.name for p in rest] == ["actuator_delay"]
    write_config(config, problem.space, setting, placed, intervals, tmp_path / "model.xml", tmp_path / "config.yaml")
    document = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert document["model"] == "model.xml"
    assert document["parameters"]["elbow_friction"] == {
        "field": "dof_frictionloss", "name": "elbow", "bounds": [0.1, 0.18], "unit": "N·m",
    }  # fmt: skip
    assert document["effects"] == [{"effect": "actuator_delay", "target": "bend", "delay": 0.028}]
    found = make_problem(load_config(tmp_path / "config.yaml"))
    result = fit(found.objective, FitSettings(samples=20)).distribution.summary()
    assert result["elbow_friction"]["mean"] == pytest.approx(0.15, abs=1e-4)
    assert result["bend_delay"]["mean"] == pytest.approx(0.03, abs=1e-5)
    assert result["mass"]["mean"] == pytest.approx(0.7, abs=1e-3)


_FRICTION = {"field": "dof_frictionloss", "name": "elbow", "bounds": [0.0, 0.5]}
_MASS = {"field": "body_mass", "name": "lower", "bounds": [0.3, 1.3]}


@pytest.mark.parametrize(
    ("declared", "name", "target", "numbers"),
    [
        pytest.param(_MASS, "payload", "lower", {"mass": 0.1, "x": 0, "y": 0, "z": 0}, id="several numbers"),
        pytest.param({**_MASS, "relative": True}, "joint_friction", "elbow", {"friction": 0.15}, id="relative"),
        pytest.param(_FRICTION, "joint_friction", "elbow", {"friction": 0.15}, id="the same number"),
    ],
)
def test_what_no_field_expresses_stays_an_effect_of_the_old_model(
    tmp_path: Path, declared: dict, name: str, target: str, numbers: dict
) -> None:
    config = make_config({**record_arm(tmp_path, friction=0.15), "parameters": {"declared": declared}})
    problem = make_problem(config)
    setting = plain_setting(problem.space.model, problem.observation, 2)
    placed = Placed(find_effect(name), target, tuple(numbers.values()))
    first = next(iter(numbers))
    write_config(
        config, problem.space, setting, [placed], {placed.key: {first: (0.05, 0.2)}}, tmp_path / "m.xml",
        tmp_path / "config.yaml",
    )  # fmt: skip
    document = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert document["model"] == str(tmp_path / "arm.xml")
    assert document["parameters"][f"{target}_{first}"]["effect"] == name
    make_problem(load_config(tmp_path / "config.yaml"))


def test_a_config_of_a_bundled_simulation_names_its_parts(tmp_path: Path) -> None:
    config = make_config({"sim": "hopper", "backend": "warp", "optimizer": "adam"})
    problem = make_problem(config)
    setting = plain_setting(problem.space.model, problem.observation, SIM.frame_skip)
    placed = [
        Placed(find_effect("actuator_backlash"), setting.names("actuator")[0], (0.1,)),
        Placed(find_effect("joint_friction"), "foot_joint", (0.2,)),
    ]
    intervals = {placed[0].key: {"width": (0.05, 0.15)}, placed[1].key: {"friction": (0.1, 0.3)}}
    write_model(SIM.model, placed, tmp_path / "model.xml")
    write_config(config, problem.space, setting, placed, intervals, tmp_path / "model.xml", tmp_path / "config.yaml")
    again = load_config(tmp_path / "config.yaml")
    assert (again.sim, again.model, again.backend, again.optimizer) == (None, "model.xml", "warp", "fisher")
    found = make_problem(again)
    assert found.space.names == (*problem.space.names, f"{placed[0].target}_width", "foot_joint_friction")
    assert found.objective.transitions.history == 100  # an episode's length


def test_a_search_box_is_wide_enough_and_physical() -> None:
    quantity = find_effect("actuator_delay").quantities(setting_of(general()), "push")[0]
    assert search_box(0.02, (0.019, 0.021), quantity) == (0.016, 0.024)
    assert search_box(0.02, (0.01, 0.03), quantity) == (0.0, 0.06)
