"""Velocities that are derived from positions lead a simulation through these positions."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from dropo_torch.config import load_config
from dropo_torch.effects import Placed, find_effect
from dropo_torch.effects.engine import Variant
from dropo_torch.gap import find_gap, prepare
from dropo_torch.problem import Problem, make_problem

STEP, ROWS = 0.004, 1500
ARM = """<mujoco><option timestep="{step}" integrator="{integrator}"/><worldbody><body pos="0 0 1">
<joint name="shoulder" axis="0 1 0" damping="0.2"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1.5"/>
<body pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8"/></body></body></worldbody>
<actuator><motor name="one" joint="shoulder"/><motor name="two" joint="elbow"/></actuator></mujoco>"""


def log_of(model: mujoco.MjModel, seed: int) -> tuple[np.ndarray, ...]:
    """Positions, velocities and torques of a smooth motion, row by row."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    skip = round(STEP / model.opt.timestep)
    time = STEP * np.arange(ROWS)[:, None]
    torque = sum(
        a * np.sin(2 * np.pi * f * time + rng.uniform(0, 6, 2)) for f, a in ((0.4, (4.0, 1.0)), (1.1, (3.0, 0.8)))
    )
    positions, velocities = np.empty((2, ROWS, 2))
    for row in range(ROWS):
        positions[row], velocities[row] = data.qpos, data.qvel
        data.ctrl[:] = torque[row]
        mujoco.mj_step(model, data, skip)
    return positions, velocities, torque


def problem_of(folder: Path, integrator: str, noise: float, skip: int, seed: int = 0) -> tuple[Problem, np.ndarray]:
    """The problem of a log of positions alone, and the velocities that it lacks."""
    xml = ARM.format(step=STEP / skip, integrator=integrator)
    positions, velocities, torque = log_of(mujoco.MjModel.from_xml_string(xml), seed)
    measured = positions + noise * np.random.default_rng(seed + 1).standard_normal(positions.shape)
    (folder / "arm.xml").write_text(xml)
    table = np.column_stack([STEP * np.arange(ROWS), measured, torque])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="time,q1,q2,u1,u2", comments="", fmt="%.9f")
    preprocess = {"dt": STEP, "velocities": [], "derive": ["q1", "q2"]} | ({"cutoff": 12.0} if noise else {})
    config = {
        "model": "arm.xml", "frame_skip": skip,
        "data": {"path": "log.csv", "time": "time", "observations": ["q1", "q2"], "actions": ["u1", "u2"],
                 "preprocess": preprocess},
        "observation": ["shoulder.position", "elbow.position", "shoulder.velocity", "elbow.velocity"],
        "parameters": {},
        "mask": ["shoulder.velocity", "elbow.velocity"],
        "noise": [max(noise, 1e-6), max(noise, 1e-6), 20 * noise + 1e-5, 20 * noise + 1e-5],
    }  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    problem = make_problem(load_config(folder / "config.yaml"), general=True)
    kept = len(problem.trajectories)
    first = (ROWS - 1 - kept) // 2
    return problem, velocities[first : first + kept]


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("skip", [1, 4])
def test_they_are_those_of_the_simulation(integrator: str, skip: int, tmp_path: Path) -> None:
    problem, velocities = problem_of(tmp_path, integrator, 0.0, skip)
    found = problem.trajectories.observations[:, 2:]
    late = 0.5 * STEP / skip * np.gradient(velocities, STEP, axis=0)
    error = np.sqrt(np.mean((found - velocities) ** 2, axis=0))
    assert (error < 0.25 * np.sqrt(np.mean(late**2, axis=0))).all()
    assert np.array_equal(problem.trajectories.next_observations[:-1, 2:], found[1:])


def test_a_finer_step_begins_with_those_of_its_own(tmp_path: Path) -> None:
    """Its half step is shorter: simulated without noise, it stays on the motion that it made."""
    xml = ARM.format(step=STEP / 8, integrator="RK4")
    problem, _ = problem_of(tmp_path, "Euler", 0.0, 1)
    positions, _, torque = log_of(mujoco.MjModel.from_xml_string(xml), 0)
    table = np.column_stack([STEP * np.arange(ROWS), positions, torque])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="time,q1,q2,u1,u2", comments="", fmt="%.9f")
    problem = make_problem(load_config(tmp_path / "config.yaml"), general=True)
    scene = prepare(problem)
    finer = Variant((), (Placed(find_effect("integration"), None, (STEP / 8,)),))
    shown, _ = scene.twin.predict([Variant(()), finer], scene.evidence.windows)
    plain, fine = np.sqrt(np.mean((shown - scene.evidence.windows.measured)[..., :2] ** 2, axis=(1, 2, 3)))
    assert fine < 0.1 * plain


def test_nothing_is_told_of_a_log_of_positions_in_which_nothing_is_missing(tmp_path: Path) -> None:
    problem, _ = problem_of(tmp_path, "implicitfast", 2e-4, 1, seed=3)
    gap = find_gap(problem)
    assert not gap.found
    assert gap.after.rollout_rmse < 2 * gap.noise_floor.rollout_rmse
