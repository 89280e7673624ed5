"""Rolling bodies: ground that is not as in the model is no noise, and resistance to rolling has a name."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.gap import find_gap, prepare
from dropo_torch.problem import Problem

RADIUS = 0.1
BALL = f"""<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="9 9 .1"/>
  <body name="ball" pos="0 0 {RADIUS}"><freejoint/><geom name="shell" type="sphere" size="{RADIUS}" mass="1.5"/></body>
</worldbody></mujoco>"""
#: Of the position and orientation, and of their velocities.
NOISE = np.repeat([2e-4, 1e-3, 2e-3, 1e-2], 3)


def rolling(folder: Path, tilt: float = 0.0, lever: float = 0.0, speeds: tuple[float, float] = (0.6, 0.6)) -> Problem:
    """The log of a ball on ground that slopes by ``tilt`` rad and resists rolling with a lever arm of some meters."""
    spec, rng, rows = mujoco.MjSpec.from_string(BALL), np.random.default_rng(0), []
    floor = spec.geom("floor")
    mujoco.mju_euler2Quat(floor.quat, [0.0, tilt, 0.0], "xyz")
    if lever:
        floor.condim, floor.priority, floor.friction = 6, 1, [1.0, 0.005, lever]
    model = spec.compile()
    for episode in range(8):
        data, speed = mujoco.MjData(model), rng.uniform(-1, 1, 2) * speeds
        data.qvel[:2], data.qvel[3:5] = speed, speed[::-1] * (-1, 1) / RADIUS
        mujoco.mj_step(model, data, 50)
        for row in range(100):
            noise, seen = NOISE * rng.standard_normal(12), data.qpos.copy()
            mujoco.mj_integratePos(model, seen, noise[:6], 1.0)
            rows.append([episode, row / 50, *seen, *(data.qvel + noise[6:])])
            mujoco.mj_step(model, data, 10)
    names = [f"p{i}" for i in range(7)] + [f"v{i}" for i in range(6)]
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=",".join(["episode", "t", *names]), comments="")
    (folder / "ball.xml").write_text(BALL)
    config = folder / "ball.yaml"
    config.write_text(
        f"model: ball.xml\ndata: {{path: log.csv, time: t, episode: episode, observations: [{', '.join(names)}], "
        "actions: []}\nframe_skip: 10\nobservation: [qpos, qvel]\n"
    )
    return dropo.make_problem(dropo.load_config(config), general=True)


def test_ground_that_slopes_makes_no_noise(tmp_path: Path) -> None:
    """From states within the model's ground, nothing is predicted; white noise may be no more than differences show."""
    scene = prepare(rolling(tmp_path, tilt=0.04))
    true = np.concatenate([NOISE[[0, 1, 2]], NOISE[6:], NOISE[3:6]])
    assert (scene.noise < 2.5 * true).all()
    gap = find_gap(scene.problem)
    assert [e.effect for e in gap.effects][:1] == ["ground_slope"]
    assert gap.effects[0].parameters["pitch"].value == pytest.approx(0.04, rel=0.02)


def test_what_hardly_moves_makes_windows_no_shorter(tmp_path: Path) -> None:
    assert prepare(rolling(tmp_path, speeds=(0.6, 0.0))).evidence.windows.length == 30  # all but x is noise


def test_resistance_to_rolling_is_found(tmp_path: Path) -> None:
    gap = find_gap(rolling(tmp_path, lever=0.003))
    named = [e for e in gap.effects if e.effect != "integration"]
    assert [(e.effect, e.target) for e in named] in ([("contact_rolling", "shell")], [("contact_rolling", "floor")])
    assert named[0].parameters["rolling"].value == pytest.approx(0.003, rel=0.03)
    assert gap.verdict == "explained"
    assert "they may be the same thing" in str(gap.next_experiment)  # of two that touch nothing else
