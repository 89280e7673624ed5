"""Logs that were simulated by the model's own integrator with a finer step: neither exact nor as the model has it."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.effects import VOCABULARY, Placed, find_effect
from dropo_torch.effects.base import applied
from dropo_torch.gap import find_gap, prepare
from dropo_torch.gap.refit import Hypothesis, half_widths, refit, resolved
from dropo_torch.problem import Problem
from dropo_torch.report.gap_words import answer

STEP, SKIP = 0.004, 5
ARM = """<mujoco><option timestep="0.004" integrator="{integrator}"/><worldbody>
  <body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping="0.4"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1.2"/>
    <body name="lower" pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025" mass="0.8"/></body></body>
</worldbody><actuator><motor name="lift" joint="shoulder"/><motor name="bend" joint="elbow"/></actuator></mujoco>"""
NOISE = np.repeat([1e-4, 1e-3], 2)


def problem(
    folder: Path, step: float, *, damping: float = 0.1, integrator: str = "Euler", exact: bool = False, arm: str = ARM
) -> Problem:
    """The log of an arm by an elbow's damping that the model has as 0.1, simulated with a step of its own."""
    rng, rows = np.random.default_rng(4), []
    model = mujoco.MjModel.from_xml_string(arm.format(damping=damping, integrator="RK4" if exact else integrator))
    model.opt.timestep = step
    for episode in range(4):
        data, turns = mujoco.MjData(model), rng.uniform(0.5, 3.0, (2, 2))
        data.qpos[:] = rng.uniform(-1, 1, 2)
        for row in range(100):
            data.ctrl[:] = (3, 1) * np.sin(turns[:, 0] * row * STEP * SKIP * 3 + turns[:, 1])
            seen = np.concatenate([data.qpos, data.qvel]) + NOISE * rng.standard_normal(4)
            rows.append([episode, row * STEP * SKIP, *seen, *data.ctrl])
            mujoco.mj_step(model, data, round(SKIP * STEP / step))
    header = "episode,t,q0,q1,v0,v1,u0,u1"
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=header, comments="", fmt="%.12g")
    (folder / "arm.xml").write_text(arm.format(damping=0.1, integrator=integrator))
    config = folder / "arm.yaml"
    config.write_text(
        "model: arm.xml\ndata: {path: log.csv, time: t, episode: episode, observations: [q0, q1, v0, v1], "
        f"actions: [u0, u1]}}\nframe_skip: {SKIP}\nobservation: [qpos, qvel]\nnoise: {NOISE.tolist()}\nthreads: 1\n"
    )
    return dropo.make_problem(dropo.load_config(config), general=True)


@pytest.mark.parametrize("ratio", [2, 3, 5])
def test_the_step_is_told_where_the_integrator_stays(tmp_path: Path, ratio: int) -> None:
    """A servo's damping asks for the implicit integrator, which is then no nearer to the exact motion by itself."""
    servo = '<position name="bend" joint="elbow" kp="30" kv="2"/>'
    gap = find_gap(
        problem(
            tmp_path, STEP / ratio, integrator="implicitfast",
            arm=ARM.replace('<motor name="bend" joint="elbow"/>', servo),
        )
    )  # fmt: skip
    assert [e.effect for e in gap.effects] == ["integration"]
    assert gap.effects[0].parameters["timestep"].value == pytest.approx(STEP / ratio)
    assert gap.remaining is None


@pytest.mark.parametrize("ratio", [2, 4])
def test_a_finer_step_of_the_own_integrator_is_told(tmp_path: Path, ratio: int) -> None:
    gap = find_gap(problem(tmp_path, STEP / ratio))
    assert [(e.effect, e.variant) for e in gap.effects] == [("integration", "integration_own")]
    assert gap.effects[0].parameters["timestep"].value == pytest.approx(STEP / ratio)
    assert gap.remaining is None
    assert "simulated with a finer step" in answer(gap)[0]


@pytest.mark.parametrize("ratio", [3, 6, 8])
def test_numbers_are_those_of_the_log_s_own_step(tmp_path: Path, ratio: int) -> None:
    """Also of a step that is none of those that a search begins with."""
    gap = find_gap(problem(tmp_path, STEP / ratio, damping=0.13))
    (named,) = [e for e in gap.effects if e.effect != "integration"]
    assert (named.effect, named.target) == ("joint_damping", "elbow")
    found = named.parameters["damping"]
    assert found.value == pytest.approx(0.03, rel=2e-3)
    assert found.low < 0.03 < found.high


@pytest.mark.parametrize(("step", "exact", "own"), [(STEP / 5, False, True), (STEP / 20, True, False)])
def test_the_log_tells_how_it_was_made(tmp_path: Path, step: float, exact: bool, own: bool) -> None:
    scene = prepare(problem(tmp_path, step, damping=0.13, exact=exact))
    missing = Hypothesis(scene.begin.declared, (Placed(find_effect("joint_damping"), "elbow", (0.03,)),))
    fitted = refit(scene.evidence, missing)
    last = resolved(scene.evidence, fitted)
    option = last.evidence.twin.setting.model.opt
    assert (option.integrator == scene.setting.model.opt.integrator) == own
    assert not own or option.timestep == pytest.approx(step)
    assert abs(last.fit.hypothesis.vector[-1] - 0.03) < max(1e-4, half_widths(last)[-1])
    assert last.fit.loss < 0.9 * fitted.loss


def test_another_integrator_is_tried_only_where_there_is_one(tmp_path: Path) -> None:
    own, exact = find_effect("integration_own"), find_effect("integration")
    for integrator, there in (("Euler", True), ("implicitfast", True), ("RK4", False)):
        setting = prepare(problem(tmp_path, STEP / 2, integrator=integrator)).setting
        assert bool(own.targets(setting)) == there
        starts = own.extends(setting, Placed(exact, None, (STEP / 8,)))
        assert bool(starts) == there
        for start in starts:
            changed = applied(setting.model, [Placed(own, None, tuple(start))])
            assert changed.opt.integrator == setting.model.opt.integrator
            assert changed.opt.timestep < STEP
    assert own.extends(setting, Placed(VOCABULARY["joint_damping"], "elbow", (0.1,))) == []
