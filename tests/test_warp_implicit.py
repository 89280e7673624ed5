"""The implicit integrators: slopes of velocity products, of all bodies or of those that float freely, as in C MuJoCo.

Steps are long and velocities high, so that what an integrator leaves out would show.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.simulators.warp.tables import turning_bodies
from dropo_torch.testing import Tolerance, check_simulator, converged, mujoco_reference

CHAIN = """<mujoco><option timestep="0.01" integrator="{integrator}"/><default><geom contype="0" conaffinity="0"/>
</default><worldbody><body name="a" pos="0 0 1" euler="10 20 30"><joint type="slide" axis="1 .2 0"/>
<joint name="a" axis="0 1 .3" pos=".1 0 0" damping=".2"/><joint axis="1 0 0" armature=".1"/>
<geom type="box" size=".1 .2 .05" pos=".1 .1 0"/>
<body name="b" pos=".3 0 .1"><joint type="ball" damping=".1"/><geom type="capsule" size=".05 .2" pos=".1 0 .1"/>
<body name="c" pos="0 .3 0"><joint name="c" axis="0 0 1"/><geom type="ellipsoid" size=".1 .2 .05" pos="0 .1 .05"/>
</body><body pos=".2 0 0"><geom size=".05"/></body></body></body>
<body name="d" pos="2 0 1"><freejoint/><geom type="box" size=".1 .2 .3" pos=".05 0 0"/>
<body name="e" pos="0 0 .4"><joint axis="0 1 0" damping=".3"/><geom type="box" size=".1 .1 .2" pos=".1 0 .1"/></body>
</body></worldbody><actuator><position joint="a" kp="5" kv="2"/><motor joint="c"/></actuator></mujoco>"""
AFLOAT = """<mujoco><option timestep="0.01" integrator="{integrator}"/><default><geom contype="2"/></default><worldbody>
<geom name="floor" type="plane" size="5 5 1" zaxis=".1 0 1" contype="1"/>
<body name="a" pos="0 0 .3"><freejoint/><geom name="a" type="box" size=".1 .2 .3" pos=".05 0 0"/></body>
<body name="b" pos="1 0 .4"><freejoint/><geom type="box" size=".3 .1 .1"/>
<body name="c" pos=".2 0 .2" euler="0 30 0"><geom type="box" size=".1 .2 .05"/></body></body>
<body name="d" pos="3 0 .4"><freejoint/><geom type="capsule" size=".1 .1"/>
<body name="e" pos=".2 0 0"><joint axis="0 1 0"/><geom type="box" size=".1 .1 .2" pos=".1 0 0"/></body></body>
</worldbody></mujoco>"""


def space_of(xml: str, integrator: str, bodies: str) -> ParameterSpace:
    model = mujoco.MjModel.from_xml_string(xml.format(integrator=integrator))
    entries = {f"mass {b}": {"field": "body_mass", "name": b} for b in bodies}
    entries |= {f"inertia {b}": {"field": "body_inertia", "name": b, "index": 1} for b in bodies}
    entries |= {f"ipos {b}": {"field": "body_ipos", "name": b, "index": 2} for b in bodies}
    return ParameterSpace(model, {name: {**entry, "bounds": [1e-6, 1e3]} for name, entry in entries.items()})


def agrees(space: ParameterSpace, speed: float, median: float = 1e-6) -> None:
    model, rng = space.model, np.random.default_rng(2)
    assert model is not None
    states = np.zeros((8, model.nq + model.nv))
    for row in states:
        row[: model.nq] = model.qpos0
        mujoco.mj_integratePos(model, row[: model.nq], rng.normal(0, 0.3, model.nv), 1.0)
        row[model.nq :] = rng.normal(0, speed, model.nv)
    controls = torch.from_numpy(rng.uniform(-1, 1, (8, 1, model.nu)))
    simulator = WarpSimulator(model, parameters=space, frame_skip=2, num_threads=1)
    check_simulator(
        simulator, torch.from_numpy(states), controls, torch.from_numpy(space.nominal[None]),
        reference=mujoco_reference(converged(space), 2),
        tolerance=Tolerance(states=1e-9, worst=1e-6, gradient=median, most=1e-3),
    )  # fmt: skip


@pytest.mark.parametrize("integrator", ["implicit", "implicitfast"])
def test_chains(integrator: str) -> None:
    agrees(space_of(CHAIN, integrator, "abcde"), speed=5.0)


@pytest.mark.parametrize("integrator", ["implicit", "implicitfast"])
def test_free_bodies_in_contact(integrator: str) -> None:
    """One alone, one with a body fixed to it, and one with a joint."""
    agrees(space_of(AFLOAT, integrator, "abd"), speed=3.0, median=1e-5)


def test_which_bodies_turn_implicitly() -> None:
    names = {"Euler": "", "implicitfast": "abc", "implicit": "abcde"}
    for integrator, bodies in names.items():
        model = space_of(AFLOAT, integrator, "a").model
        assert model is not None
        found = "".join(model.body(int(b)).name for b in np.flatnonzero(turning_bodies(model)))
        assert found == bodies
