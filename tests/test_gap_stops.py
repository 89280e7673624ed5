"""Stops that a model lacks, or has elsewhere, are found where the motion hits them."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.gap import find_gap_as_given

ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body pos="0 0 1"><joint name="elbow" axis="0 1 0" damping="0.15" armature="0.01"{stops}/>
    <geom type="capsule" size=".025" fromto="0 0 0 0 0 -.3" mass="0.9"/></body></worldbody>
  <actuator><motor name="bend" joint="elbow"/></actuator></mujoco>"""
NOISE = np.array([2e-4, 5e-3])


@pytest.mark.parametrize(("given", "variant"), [("", "joint_stop"), (' range="-0.9 0.9"', "")])
def test_stops_are_found_where_they_are(given: str, variant: str, tmp_path: Path) -> None:
    true = mujoco.MjModel.from_xml_string(ARM.format(stops=' range="-0.9 0.7"'))
    true.opt.timestep = 0.0005
    data, rows, rng = mujoco.MjData(true), [], np.random.default_rng(1)
    for row in range(1500):
        goal = 0.9 * np.sin(0.03 * row) + 0.5 * np.sin(0.011 * row)
        data.ctrl[0] = np.clip(12 * (np.clip(goal, -0.8, 2.0) - data.qpos[0]) - 0.8 * data.qvel[0], -8, 8)
        rows.append([0.01 * row, *(np.r_[data.qpos, data.qvel] + NOISE * rng.standard_normal(2)), *data.ctrl])
        mujoco.mj_step(true, data, 20)
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,elbow_q,elbow_dq,elbow_tau", comments="")
    (tmp_path / "arm.xml").write_text(ARM.format(stops=given))
    found = dropo.propose_config(tmp_path / "arm.xml", tmp_path / "log.csv", out=tmp_path / "arm.yaml")
    _, gap = find_gap_as_given(dropo.make_problem(found.config, general=True))
    named = [e for e in gap.effects if e.effect != "integration"]
    assert [(e.effect, e.variant, e.target) for e in named] == [("joint_limit", variant, "elbow")]
    upper = named[0].parameters["upper"].value
    assert upper == pytest.approx(0.7 if variant else -0.2, abs=1e-3)
    assert gap.remaining is None
