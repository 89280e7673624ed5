"""Logs whose rows are not the grid's: what lies between two samples has less noise than a sample."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.gap import find_gap, prepare
from dropo_torch.problem import Problem

PENDULUM = """<mujoco><option timestep="0.001" integrator="RK4"/><worldbody>
  <body pos="0 0 1"><joint name="upper" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1.2"/>
    <body pos="0 0 -.4"><joint name="lower" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025" mass="0.8"/></body></body>
</worldbody></mujoco>"""
NOISE = np.array([1e-3, 1e-3, 5e-3, 5e-3])


def swinging(folder: Path, *, drift: float, jitter: float, damping: float = 0.02) -> Problem:
    """A double pendulum whose samples are 20 ms apart by a clock of their own, on a grid of 20 ms.

    Args:
        folder: for the files.
        drift: by how much the samples' clock is slow.
        jitter: by how many milliseconds each is early or late at most.
        damping: of the lower joint, which the model has as 0.02.
    """
    rng, rows = np.random.default_rng(7), []
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(damping=damping))
    for episode in range(4):
        data = mujoco.MjData(model)
        data.qpos[:] = rng.uniform(-1.5, 1.5, 2)
        due = 0.02 * (1 + drift) * np.arange(1, 201) + 1e-3 * jitter * rng.uniform(-1, 1, 200)
        for step in np.round(due / 0.001).astype(int):
            mujoco.mj_step(model, data, step - round(data.time / 0.001))
            rows.append([episode, data.time, *np.concatenate([data.qpos, data.qvel]) + NOISE * rng.standard_normal(4)])
    np.savetxt(folder / "log.csv", rows, delimiter=",", header="episode,t,q0,q1,v0,v1", comments="", fmt="%.10g")
    (folder / "pendulum.xml").write_text(PENDULUM.format(damping=0.02))
    config = folder / "pendulum.yaml"
    config.write_text(
        "model: pendulum.xml\ndata: {path: log.csv, time: t, episode: episode, observations: [q0, q1, v0, v1], "
        "actions: [], preprocess: {dt: 0.02, velocities: [v0, v1]}}\nframe_skip: 20\nobservation: [qpos, qvel]\n"
        "threads: 1\n"
    )
    return dropo.make_problem(dropo.load_config(config), general=True)


@pytest.mark.parametrize(("drift", "jitter"), [(0.002, 0.0), (0.0, 8.0)])
def test_the_noise_of_samples_is_told_wherever_the_grid_lies(tmp_path: Path, drift: float, jitter: float) -> None:
    noise = prepare(swinging(tmp_path, drift=drift, jitter=jitter)).noise
    np.testing.assert_allclose(noise, NOISE, rtol=0.13)  # neighbours share samples


@pytest.mark.parametrize("damping", [0.02, 0.03])
def test_resampled_logs_are_explained(tmp_path: Path, damping: float) -> None:
    gap = find_gap(swinging(tmp_path, drift=0.002, jitter=3.0, damping=damping))
    assert [(e.effect, e.target) for e in gap.effects] == ([("joint_damping", "lower")] if damping > 0.02 else [])
    assert gap.remaining is None
    assert gap.noise_floor.mse < 2 * np.mean(NOISE**2)  # of samples
    for entry in gap.effects:
        (number,) = entry.parameters.values()
        assert number.low < damping - 0.02 < number.high
