"""Bodies in a medium whose geoms are taken as ellipsoids, against C MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.testing import Tolerance, check_simulator, converged, mujoco_reference

SHAPES = ('type="sphere" size=".2"', 'type="capsule" size=".1 .2"', 'type="cylinder" size=".15 .1"',
          'type="ellipsoid" size=".3 .1 .2"', 'type="box" size=".02 .3 .1"')  # fmt: skip
SWIMMER = """<mujoco><option timestep="0.004" integrator="{integrator}" density="{density}" viscosity="{viscosity}"
wind=".5 -1 .3"/><default><geom contype="0" conaffinity="0" density="300"/></default><worldbody>
<body name="a" pos="0 0 1"><freejoint/><geom {shape} pos=".1 0 .05" euler="20 40 0" fluidshape="ellipsoid"
fluidcoef="{coefficients}"/><geom type="box" size=".1 .2 .1" pos="-.2 0 0"/>
<body name="b" pos="0 .3 0"><joint name="b" axis="1 .2 0" damping=".1"/><geom {shape} pos="0 .2 0"/></body>
<body name="c" pos="0 -.3 0"><joint type="ball"/><geom {shape} pos="0 -.2 0" fluidshape="ellipsoid"/>
<geom type="ellipsoid" size=".05 .2 .1" pos="0 .1 .2" fluidshape="ellipsoid" fluidcoef="{coefficients}"/></body></body>
</worldbody><actuator><motor joint="b"/></actuator></mujoco>"""


def swimmer(shape: str, **changes: str) -> ParameterSpace:
    settings = {"integrator": "Euler", "density": "80", "viscosity": ".5", "coefficients": ".4 .3 1.2 .8 .6"} | changes
    model = mujoco.MjModel.from_xml_string(SWIMMER.format(shape=shape, **settings))
    entries: dict[str, dict] = {f"mass {name}": {"field": "body_mass", "name": name} for name in "abc"}
    entries |= {field: {"field": f"opt.{field}"} for field in ("density", "viscosity")}
    entries["wind"] = {"field": "opt.wind", "index": 1}
    return ParameterSpace(model, {name: {**entry, "bounds": [1e-3, 1e3]} for name, entry in entries.items()})


def agrees(space: ParameterSpace, *, moving: float = 2.0) -> None:
    model, rng = space.model, np.random.default_rng(4)
    assert model is not None
    states = np.zeros((8, model.nq + model.nv))
    for row in states:
        row[: model.nq] = model.qpos0
        mujoco.mj_integratePos(model, row[: model.nq], rng.normal(0, 0.5, model.nv), 1.0)
        row[model.nq :] = rng.normal(0, moving, model.nv)
    controls = torch.from_numpy(rng.uniform(-1, 1, (8, 1, model.nu)))
    simulator = WarpSimulator(model, parameters=space, frame_skip=2, num_threads=1)
    check_simulator(
        simulator, torch.from_numpy(states), controls, torch.from_numpy(space.nominal[None]),
        reference=mujoco_reference(converged(space), 2),
        tolerance=Tolerance(states=1e-11, gradient=1e-6, most=1e-4),
    )  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_ellipsoids_of_every_shape(shape: str) -> None:
    agrees(swimmer(shape))


@pytest.mark.parametrize("integrator", ["RK4", "implicitfast", "implicit"])
def test_ellipsoids_under_other_integrators(integrator: str) -> None:
    agrees(swimmer(SHAPES[3], integrator=integrator))


@pytest.mark.parametrize("integrator", ["implicitfast", "implicit"])
def test_an_inertia_box_under_an_implicit_integrator(integrator: str) -> None:
    """The second body is one."""
    agrees(swimmer('type="box" size=".05 .3 .1"', integrator=integrator, viscosity="20"))


@pytest.mark.parametrize("coefficients", ["1 0 0 0 0", "0 1 0 0 0", "0 0 1 0 0", "0 0 0 1 0", "0 0 0 0 1"])
def test_each_coefficient_alone(coefficients: str) -> None:
    agrees(swimmer(SHAPES[3], coefficients=coefficients))


def test_gradients_are_finite_in_still_water_at_rest() -> None:
    space = swimmer(SHAPES[3])
    model = space.model
    assert model is not None
    model.opt.wind[:], model.opt.gravity[:] = 0, 0
    leaves = [
        torch.from_numpy(np.r_[model.qpos0, np.zeros(model.nv)][None]).requires_grad_(),
        torch.zeros(1, 1, model.nu, dtype=torch.float64).requires_grad_(),
        torch.from_numpy(space.nominal[None]).requires_grad_(),
    ]
    WarpSimulator(model, parameters=space, frame_skip=1).simulate(*leaves).sum().backward()
    assert all(bool(leaf.grad.isfinite().all()) for leaf in leaves if leaf.grad is not None)
