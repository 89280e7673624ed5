"""Laws that the Warp backend must keep whatever the reference says, and random trees against it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator

JOINTS = ("hinge", "slide", "ball", "free")


def random_tree(
    seed: int, bodies: int, *, floor: bool, dissipative: bool, integrator: str, gravity: bool = True, root: str = ""
) -> str:
    """Trees of capsules, boxes and spheres with random joints; they touch a floor, if any, and not each other."""
    rng = np.random.default_rng(seed)
    contact = 'contype="0"' if floor else 'contype="0" conaffinity="0"'
    names = iter(range(1, bodies + 1))

    def vector(scale: float) -> str:
        return " ".join(f"{x:.4f}" for x in rng.uniform(-scale, scale, 3))

    def joint(name: int, *, may_be_free: bool) -> str:
        kind = str(rng.choice(JOINTS[: 4 if may_be_free else 3]))
        if kind == "free":
            return "<freejoint/>"
        extra = ""
        if dissipative:
            extra = f'damping="{rng.uniform(0, 0.5):.3f}" armature="{rng.uniform(0, 0.05):.3f}"'
            extra += f' frictionloss="{rng.uniform(0, 0.2):.3f}"' if rng.random() < 0.3 else ""
            extra += ' limited="true" range="-30 40"' if kind == "hinge" and rng.random() < 0.5 else ""
        return f'<joint name="j{name}" type="{kind}" axis="{vector(1)}" pos="{vector(0.05)}" {extra}/>'

    def body(depth: int) -> str:
        name = next(names)
        shape = rng.choice(['type="capsule" size=".05 .12"', 'type="sphere" size=".1"', 'type="box" size=".1 .06 .08"'])
        out = f'<body name="b{name}" pos="{vector(0.25)}" quat="1 {vector(0.3)}">'
        out += joint(name, may_be_free=depth == 0 and not root)
        out += f'<geom {shape} pos="{vector(0.1)}" quat="1 {vector(0.5)}" {contact}/>'
        while rng.random() < 0.75:
            try:
                out += body(depth + 1)
            except StopIteration:
                break
        return out + "</body>"

    trees = ""
    while True:
        try:
            trees += body(0)
        except StopIteration:
            break
    plane = '<geom name="floor" type="plane" size="5 5 1" pos="0 0 -.35"/>' if floor else ""
    pull = "" if gravity else 'gravity="0 0 0"'
    inside = f"{root}{trees}</body>" if root else trees
    return (
        f'<mujoco><option timestep="0.003" integrator="{integrator}" {pull}/>'
        f"<worldbody>{plane}{inside}</worldbody></mujoco>"
    )


def start(model: mujoco.MjModel, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    states = np.zeros((count, model.nq + model.nv))
    for row in states:
        qpos = model.qpos0.copy()
        mujoco.mj_integratePos(model, qpos, rng.uniform(-0.4, 0.4, model.nv), 1.0)
        row[: model.nq], row[model.nq :] = qpos, rng.uniform(-2, 2, model.nv)
    return states


def stepped(model: mujoco.MjModel, states: np.ndarray, steps: int) -> np.ndarray:
    data = mujoco.MjData(model)
    out = np.full(states.shape, np.inf)
    for row, state in zip(out, states, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
        mujoco.mj_step(model, data, steps)
        row[:] = np.r_[data.qpos, data.qvel]
    return out


def simulator_of(model: mujoco.MjModel, steps: int) -> tuple[WarpSimulator, torch.Tensor]:
    space = ParameterSpace(
        model, {"mass": {"field": "body_mass", "name": model.body(1).name or "body1", "bounds": [1e-3, 1e3]}}
    )
    return WarpSimulator(model, parameters=space, frame_skip=steps, num_threads=1), torch.tensor(space.nominal[None])


def simulate(simulator: WarpSimulator, states: np.ndarray, values: torch.Tensor) -> np.ndarray:
    controls = torch.zeros(len(states), 1, simulator.num_controls, dtype=torch.float64)
    return simulator.simulate(torch.tensor(states), controls, values)[:, 0].numpy()


@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 10_000), bodies=st.integers(1, 9), floor=st.booleans(), dissipative=st.booleans(),
    integrator=st.sampled_from(["Euler", "RK4", "implicitfast"]),
)  # fmt: skip
def test_random_trees(seed, bodies, floor, dissipative, integrator):
    xml = random_tree(seed, bodies, floor=floor, dissipative=dissipative, integrator=integrator)
    model = mujoco.MjModel.from_xml_string(xml)
    free = any(model.jnt_type == 0)
    if integrator == "implicitfast" and free:
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 200, 200
    states = start(model, 5, seed)
    simulator, values = simulator_of(model, 2)
    got, want = simulate(simulator, states, values), stepped(model, states, 2)
    scale = 1 + np.abs(want).max(1, keepdims=True)
    np.testing.assert_array_less(np.abs(got - want) / scale, 1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_energy_is_kept_without_dissipation(seed):
    model = mujoco.MjModel.from_xml_string(random_tree(seed, 6, floor=False, dissipative=False, integrator="RK4"))
    model.opt.timestep = 2e-4
    simulator, values = simulator_of(model, 100)
    states = start(model, 3, seed)

    def energy(rows: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(model)
        out = []
        for row in rows:
            data.qpos[:], data.qvel[:] = row[: model.nq], row[model.nq :]
            mujoco.mj_forward(model, data)
            mujoco.mj_energyPos(model, data)
            mujoco.mj_energyVel(model, data)
            out.append(data.energy.sum())
        return np.array(out)

    before, after = energy(states), energy(simulate(simulator, states, values))
    np.testing.assert_allclose(after, before, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_momentum_is_kept_without_gravity(seed):
    root = '<body name="root"><freejoint/><geom size=".1" contype="0" conaffinity="0"/>'
    xml = random_tree(seed, 5, floor=False, dissipative=False, integrator="RK4", gravity=False, root=root)
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = 5e-4
    simulator, values = simulator_of(model, 40)
    states = start(model, 3, seed)

    def momentum(rows: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(model)
        out = []
        for row in rows:
            data.qpos[:], data.qvel[:] = row[: model.nq], row[model.nq :]
            mujoco.mj_forward(model, data)
            mujoco.mj_subtreeVel(model, data)
            linear = data.subtree_linvel[0] * model.body_subtreemass[0]
            out.append(np.r_[linear, data.subtree_angmom[0]])
        return np.array(out)

    np.testing.assert_allclose(momentum(simulate(simulator, states, values)), momentum(states), rtol=1e-7, atol=1e-7)


def test_a_mirrored_state_moves_mirrored():
    xml = """<mujoco><option cone="elliptic" timestep="0.004"/><worldbody><geom type="plane" size="5 5 1"/>
    <body pos="0 0 .1"><freejoint/><geom type="box" size=".15 .1 .1" condim="4"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    simulator, values = simulator_of(model, 10)
    rng = np.random.default_rng(0)
    states = start(model, 8, 0)
    states[:, :2], states[:, 2] = 0.0, rng.uniform(0.1, 0.14, 8)
    # reflection in the plane y = 0: positions flip y; rotations and angular rates flip x and z
    signs = np.array([1, -1, 1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1.0])
    mirrored = simulate(simulator, states * signs, values)
    np.testing.assert_allclose(mirrored, simulate(simulator, states, values) * signs, atol=1e-8)


def test_far_from_the_origin_nothing_is_lost():
    xml = """<mujoco><option gravity="0 0 0" timestep="0.002"/><worldbody><body name="a">
    <joint type="slide" axis="1 0 0"/><joint axis="0 1 0"/><geom type="capsule" size=".05 .2"/>
    <body pos="0 0 .3"><joint axis="0 1 0"/><geom type="capsule" size=".05 .2" pos="0 0 .2"/></body></body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    simulator, values = simulator_of(model, 20)
    states = start(model, 5, 1)
    far = states.copy()
    far[:, 0] += 1000.0
    near, away = simulate(simulator, states, values), simulate(simulator, far, values)
    np.testing.assert_allclose(away[:, 1:], near[:, 1:], atol=1e-12)
