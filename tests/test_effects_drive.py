"""Effects that depend on what actuators give: friction under load, transmissions that give."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from test_effects import simulator_of

from dropo_torch.data.observation import parse_observation
from dropo_torch.effects import find_effect
from dropo_torch.effects.base import applied
from dropo_torch.effects.drive import Drive, Drives, detach, driven_joints
from dropo_torch.effects.placing import plain_setting

SKIP = 4
ARM = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
<joint name="shoulder" axis="0 1 0" armature="{armature}" damping="0.4"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1.2"/>
<body pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.6"/></body></body>{rotor}</worldbody>
{spring}<actuator>{actuator}</actuator></mujoco>"""
MOTOR = """<motor name="shoulder" joint="{0}" gear="2"/>"""
SERVO = """<position name="shoulder" joint="{0}" kp="300" kv="6" forcerange="-30 30"/>"""
STIFFNESS, DAMPING, ROTOR = 150.0, 0.8, 0.06


def rigid(actuator: str, armature: float = 0.0, step: float = 0.001) -> mujoco.MjModel:
    xml = ARM.format(armature=armature, rotor="", spring="", actuator=actuator.format("shoulder"))
    return mujoco.MjModel.from_xml_string(xml.replace('timestep="0.001"', f'timestep="{step}"'))


def with_rotor(actuator: str) -> mujoco.MjModel:
    """The same arm, whose motor turns a rotor of its own, with a tendon for the spring; in finer steps."""
    rotor = f"""<body pos="0 1 0"><joint name="rotor" axis="0 1 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.01 {ROTOR} 0.06"/></body>"""
    spring = f"""<tendon><fixed stiffness="{STIFFNESS}" damping="{DAMPING}" springlength="0 0">
    <joint joint="rotor" coef="1"/><joint joint="shoulder" coef="-1"/></fixed></tendon>"""
    xml = ARM.format(armature=0.0, rotor=rotor, spring=spring, actuator=actuator.format("rotor"))
    model = mujoco.MjModel.from_xml_string(xml.replace('timestep="0.001"', 'timestep="0.00005"'))
    return model


def true_path(actuator: str, commands: np.ndarray, position: tuple[float, float]) -> np.ndarray:
    """States of shoulder and elbow after each logged step, which begin at rest with the spring in equilibrium."""
    model = with_rotor(actuator)
    data = mujoco.MjData(model)
    data.qpos[:2], data.ctrl[0] = position, commands[0]
    data.qpos[2] = position[0]
    for _ in range(20):  # the rotor where the spring holds what the actuator gives
        mujoco.mj_forward(model, data)
        slope = 300.0 if "kp" in actuator else 0.0
        missing = data.qfrc_actuator[2] - STIFFNESS * (data.qpos[2] - data.qpos[0])
        data.qpos[2] += missing / (STIFFNESS + slope)
    found = []
    for command in commands:
        data.ctrl[0] = command
        for _ in range(80):
            mujoco.mj_step(model, data)
        found.append(np.concatenate([data.qpos[:2], data.qvel[:2]]))
    return np.array(found)


def simulated(model: mujoco.MjModel, effect: dict, commands: np.ndarray, state: tuple[float, ...]) -> np.ndarray:
    damping = {"d": {"field": "dof_damping", "name": "elbow", "bounds": [0.0, 1.0]}}
    simulator, _ = simulator_of(model, [effect], damping, skip=round(SKIP * 0.001 / model.opt.timestep))
    padded = np.concatenate([np.repeat(commands[:1], simulator.history), commands])
    start, controls = torch.tensor([state], dtype=torch.float64), torch.from_numpy(padded[None, :, None])
    return simulator.rollout(start, controls, torch.tensor([[0.05]], dtype=torch.float64))[0, 0].numpy()


@pytest.mark.parametrize("actuator", [MOTOR, SERVO], ids=["motor", "servo"])
def test_a_transmission_that_gives_is_a_rotor_behind_a_spring(actuator: str) -> None:
    rng = np.random.default_rng(3)
    size = 1.5 if actuator is MOTOR else 0.4
    commands = np.repeat(rng.uniform(-size, size, 15), 8)
    start = (0.3, -0.4)
    true = true_path(actuator, commands, start)
    effect = {"effect": "joint_elasticity", "target": "shoulder", "compliance": 1 / STIFFNESS, "damping": DAMPING}
    state, effect = (*start, 0.0, 0.0), {**effect, "inertia": ROTOR}
    error, finer = (np.abs(simulated(rigid(actuator, 0.0, step), effect, commands, state) - true)[:, :2].max()
                    for step in (0.001, 0.00025))  # fmt: skip
    stiff = simulated(rigid(actuator, ROTOR), {**effect, "compliance": 1 / 3e4}, commands, state)
    assert error < 0.02 * np.ptp(true[:, :2])
    assert finer < 0.35 * error
    assert np.abs(stiff - true)[:, :2].max() > 5 * error


def test_a_stiff_transmission_is_none() -> None:
    rng = np.random.default_rng(4)
    commands = np.repeat(rng.uniform(-0.3, 0.3, 10), 8)
    effect = {
        "effect": "joint_elasticity",
        "target": "shoulder",
        "compliance": 1 / 2e4,
        "damping": 3.0,
        "inertia": ROTOR,
    }
    model = rigid(SERVO, ROTOR)
    path = simulated(model, effect, commands, (0.3, -0.4, 0.0, 0.0))
    data = mujoco.MjData(model)
    data.qpos[:], found = (0.3, -0.4), []
    for command in commands:
        data.ctrl[0] = command
        mujoco.mj_step(model, data, SKIP)
        found.append(data.qpos.copy())
    assert np.abs(path[:, :2] - np.array(found)).max() < 0.02 * np.ptp(found)


def test_friction_grows_with_the_load() -> None:
    """At a steady speed a motor's force is less by a share of it, whichever way it drives."""
    model, share = rigid(MOTOR), 0.2
    effect = {"effect": "joint_load_friction", "target": "shoulder", "coefficient": share}
    for force, speed in ((3.0, 1.0), (3.0, -1.0), (-1.0, 1.0)):
        state, command = (0.2, 0.1, speed, 0.0), np.array([force / 2])
        braked = simulated(model, effect, command, state)
        less = force - np.sign(speed) * share * abs(force)
        plain = simulated(model, {**effect, "coefficient": 0.0}, np.array([less / 2]), state)
        assert np.allclose(braked, plain, atol=1e-9)


@pytest.mark.parametrize(("share", "holds"), [(0.9, True), (0.5, False)])
def test_friction_under_load_holds_at_rest(share: float, holds: bool) -> None:
    """The motor gives 0.6 of what gravity takes: a friction of 0.9 of what it gives holds the rest, half of it not."""
    model = rigid(MOTOR)
    data = mujoco.MjData(model)
    data.qpos[:] = (0.4, np.pi / 2 - 0.4)  # the forearm hangs
    mujoco.mj_forward(model, data)
    command = np.full(60, 0.5 * 0.6 * data.qfrc_bias[0])
    effect = {"effect": "joint_load_friction", "target": "shoulder", "coefficient": share}
    path = simulated(model, effect, command, (*data.qpos, 0.0, 0.0))
    assert (np.abs(path[-1, 0] - 0.4) < 2e-3) == holds


def test_friction_under_load_only_brakes() -> None:
    model = rigid(MOTOR)
    effect = {"effect": "joint_load_friction", "target": "shoulder", "coefficient": 0.9}
    path = simulated(model, effect, np.full(60, 0.0), (0.4, np.pi / 2 - 0.4, -1.0, 0.0))
    free = simulated(model, {**effect, "coefficient": 0.0}, np.full(60, 0.0), (0.4, np.pi / 2 - 0.4, -1.0, 0.0))
    assert np.array_equal(path, free)  # nothing drives it
    path = simulated(model, effect, np.full(60, 2.0), (0.4, np.pi / 2 - 0.4, -1.0, 0.0))
    speed = path[:, 2]
    assert (np.diff(np.sign(np.round(speed, 3))) != 0).sum() <= 2  # it does not rattle


def test_drives_give_what_mujoco_says() -> None:
    xml = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" actuatorfrcrange="-3 3"/><geom size=".1"/>
    <body pos=".2 0 0"><joint name="b" axis="0 1 0"/><geom size=".1"/></body></body></worldbody><actuator>
    <position joint="a" kp="30" kv="1" gear="2" ctrlrange="-1 1" forcerange="-2 2"/><motor joint="b" gear="3"/>
    <motor joint="a" gear="0.5"/><velocity joint="b" kv="2"/></actuator></mujoco>"""
    model, rng = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(0)
    drives, data = Drives.of([model], 40), mujoco.MjData(model)
    q, v, u = rng.normal(0, 0.1, (40, 2)), rng.normal(size=(40, 2)), rng.normal(size=(40, 4))
    given = [Drive(drives, u, 0.002).given(dof, q[:, dof], v[:, dof]) for dof in (0, 1)]
    for row in range(40):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q[row], v[row], u[row]
        mujoco.mj_forward(model, data)
        assert data.qfrc_actuator == pytest.approx([force[row] for force, _, _ in given], abs=1e-12)
    small = 1e-7
    force, stiff, damp = given[0]
    later = Drive(drives, u, 0.002).given(0, q[:, 0] + small, v[:, 0])[0]
    faster = Drive(drives, u, 0.002).given(0, q[:, 0], v[:, 0] + small)[0]
    assert stiff == pytest.approx(-(later - force) / small, abs=1e-4)
    assert damp == pytest.approx(-(faster - force) / small, abs=1e-4)


def test_what_is_detached_moves_nothing_and_still_gives() -> None:
    model = rigid(SERVO)
    free = applied(model, [])
    detach(free, 0)
    data = mujoco.MjData(free)
    data.ctrl[0] = 0.5
    mujoco.mj_forward(free, data)
    assert not data.qfrc_actuator.any()
    here = np.zeros(1)
    forces = [Drive(Drives.of([m]), np.array([[0.05]]), 0.001).given(0, here, here)[0] for m in (model, free)]
    assert forces[0] == forces[1] == pytest.approx(15.0)


def test_only_joints_with_a_known_law_have_them() -> None:
    model = rigid("""<general name="shoulder" joint="{0}" dyntype="filter" dynprm="0.1" gainprm="3"/>""")
    assert not driven_joints(model)
    setting = plain_setting(model, parse_observation(model, None), SKIP)
    assert not find_effect("joint_elasticity").targets(setting)
    assert driven_joints(rigid(SERVO)) == {0}
