"""Windows that bend in the noise of their initial states begin where they fit the log best."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.data.observation import parse_observation
from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Placed
from dropo_torch.effects.engine import Variant
from dropo_torch.gap import Hypothesis, find_gap, outcome, prepare, renew
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.ground import FEWER, Ground, State
from dropo_torch.gap.log import cut_windows
from dropo_torch.gap.refit import refit
from dropo_torch.gap.rules import significant
from dropo_torch.gap.scene import _cut
from dropo_torch.gap.search import NOTHING
from dropo_torch.gap.smooth import WIDTHS, begun_smoothly, half_widths
from dropo_torch.gap.starts import begun, merged, straightened, table_of
from dropo_torch.gap.twin import Windows

BALL = """<mujoco><option timestep="0.001"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1" solref="-4000 -6"/>
  <body name="ball" pos="0 0 .3"><joint name="x" type="slide" axis="1 0 0" damping="0.01"/>
    <joint name="z" type="slide" axis="0 0 1"/><geom name="shell" type="sphere" size=".05" mass=".2" solref="-4000 -6"/>
  </body></worldbody></mujoco>"""
NOISE = np.array([5e-4, 5e-4, 0.08, 0.08])


TRUE = Hypothesis(())


def write_ball(folder: Path, damping: float = 0.01) -> Path:
    """Write the log of a ball that bounces, seen with noisy velocities, and its config; return the config's path.

    Args:
        folder: where to.
        damping: of the ball in the log; the model has 0.01.
    """
    rng, model, rows = np.random.default_rng(0), mujoco.MjModel.from_xml_string(BALL), []
    model.dof_damping[0] = damping
    for episode in range(12):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = (0, rng.uniform(0.0, 0.3)), rng.uniform(-0.5, 0.5, 2) * (4, 1)
        for row in range(90):
            rows.append([episode, row / 100, *data.qpos, *data.qvel])
            mujoco.mj_step(model, data, 10)
    log = np.array(rows)
    log[:, 2:] += NOISE * rng.standard_normal((len(log), 4))
    np.savetxt(folder / "log.csv", log, delimiter=",", header="episode,t,x,z,vx,vz", comments="")
    (folder / "ball.xml").write_text(BALL)
    config = folder / "ball.yaml"
    config.write_text(
        "model: ball.xml\ndata: {path: log.csv, time: t, episode: episode, observations: [x, z, vx, vz], actions: []}\n"
        "frame_skip: 10\nobservation: [x.position, z.position, x.velocity, z.velocity]\n"
    )
    return config


@pytest.fixture(scope="module")
def bouncing(tmp_path_factory: pytest.TempPathFactory) -> Evidence:
    """The ball's log in windows with an impact or two each."""
    problem = dropo.make_problem(dropo.load_config(write_ball(tmp_path_factory.mktemp("ball"))), general=True)
    scene = prepare(problem)
    return _cut(dataclasses.replace(scene.evidence, noise=NOISE), scene.train, scene.since, 30, rough=False)


def test_true_model_leaves_noise_where_impacts_bend_windows(bouncing: Evidence) -> None:
    bent = refit(bouncing, TRUE, iterations=0)
    windows = straightened(bouncing, TRUE.variant)
    assert windows is not None
    straight = refit(dataclasses.replace(bouncing, windows=windows), TRUE, iterations=0)
    assert bent.cost.reduced > 2
    assert straight.cost.reduced < 1.15
    assert straight.typical.max() < 2
    moved = (windows.starts != windows.measured[:, 0]).any(-1)
    assert 0 < moved.sum() < len(windows)  # the others begin as they were measured, to the last bit
    np.testing.assert_allclose(straight.typical[~moved], bent.typical[~moved], rtol=1e-12)
    assert (np.abs(windows.starts - windows.measured[:, 0]) < 5 * NOISE).all()


def test_windows_of_a_simulation_without_impacts_stay(bouncing: Evidence, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(bouncing.twin.setting), "has_impacts", False)
    assert straightened(bouncing, TRUE.variant) is None


@pytest.mark.parametrize("force", [0.0, 2.0])
def test_last_fit_begins_windows_anew_only_where_that_helps_the_worst(bouncing: Evidence, force: float) -> None:
    push = Placed(find_effect("external_force"), "ball", (force, 0.0, 0.0))
    own = refit(bouncing, TRUE.with_effects([push]), iterations=0)
    assert significant(own.cost, bouncing.rules)
    evidence, there = outcome._straight(bouncing, own)
    assert (evidence.windows.starts is None) == (there is own) == (force > 0)


def test_starts_are_known_by_episode_and_step(bouncing: Evidence) -> None:
    windows, rng = bouncing.windows, np.random.default_rng(1)
    assert table_of(windows) is None
    assert begun(windows, None) is None
    starts = windows.measured[:, 0].copy()
    starts[[3, 5]] += rng.normal(size=(2, 4))
    table = table_of(dataclasses.replace(windows, starts=starts))
    assert table is not None
    assert len(table) == 2
    some = windows.select(np.array([7, 5, 0, 3]))
    np.testing.assert_array_equal(begun(some, table), starts[[7, 5, 0, 3]])
    newer = table[:1] + np.array([0, 0, 1, 1, 1, 1])
    np.testing.assert_array_equal(merged(table, newer), np.concatenate([newer, table[1:]]))
    assert merged(table, None) is table
    assert merged(None, newer) is newer


@pytest.mark.parametrize("damping", [0.01, 0.4])
def test_of_a_hypothesis_that_is_wrong_anyhow_few_windows_begin_anew(
    damping: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, asked = prepare(dropo.make_problem(dropo.load_config(write_ball(tmp_path, damping)), general=True)), []

    def watched(evidence: Evidence, variant: Variant) -> Windows | None:
        asked.append(len(evidence.windows))
        return straightened(evidence, variant)

    monkeypatch.setattr(renew, "straightened", watched)
    evidence = _cut(dataclasses.replace(scene.evidence, noise=NOISE), scene.train, scene.since, 30, rough=False)
    ground, since = Ground(evidence, ()), np.zeros(12, dtype=int)
    base = ground.refit(scene.begin)
    begun_anew, _ = renew.restarted(ground, State(NOISE, since, 1.0, base, NOTHING, base))
    is_wrong = damping != 0.01
    assert (begun_anew.evidence.windows.starts is None) == is_wrong
    assert asked == ([FEWER] if is_wrong else [FEWER, len(ground.part.windows)])


@pytest.mark.parametrize(("damping", "named"), [(0.01, []), (0.4, [("joint_damping", "x")])])
def test_noise_beside_impacts_is_no_gap_and_hides_none(
    damping: float, named: list[tuple[str, str]], tmp_path: Path
) -> None:
    gap = find_gap(dropo.make_problem(dropo.load_config(write_ball(tmp_path, damping)), general=True))
    assert [(e.effect, e.target) for e in gap.effects] == named
    assert gap.reduced[1] < 1.2
    for effect in gap.effects:
        assert effect.parameters["damping"].value == pytest.approx(damping - 0.01, rel=0.1)


def of_path(path: np.ndarray, episodes: int) -> tuple[np.ndarray, ...]:
    """Transitions along a path ``(T + 1, n)`` without commands, in so many episodes."""
    rows = len(path) - 1
    before, after = np.tile(path[:-1], (episodes, 1)), np.tile(path[1:], (episodes, 1))
    return before, after, np.zeros((len(before), 0)), np.arange(1, len(before) + 1) % rows == 0


@pytest.mark.parametrize("impacts", [False, True])
def test_starts_are_smoothed_as_far_as_the_log_follows_a_cubic(impacts: bool) -> None:
    """Noise becomes a half or less; where a path has corners, the row alone says where it was."""
    rng, t = np.random.default_rng(0), np.arange(400) / 100
    true = np.stack([np.sin(3 * t), np.abs(np.sin(12 * t)) if impacts else np.cos(2 * t)], 1)
    path = np.concatenate([true, np.zeros((400, 2))], 1) + 1e-3 * rng.standard_normal((400, 4))
    model = mujoco.MjModel.from_xml_string(BALL)
    observation, log = parse_observation(model, None, 4), dropo.Trajectories(*of_path(path, 3))
    widths = half_widths(log, observation, [0, 1])
    assert widths[0] == (WIDTHS[-1], pytest.approx(1e-3, rel=0.2))
    windows = cut_windows(log, observation, 10)
    smooth = begun_smoothly(windows, log, observation, widths)
    off = smooth.begins - np.concatenate([true, np.zeros((400, 2))], 1)[windows.steps]
    assert np.std(off[:, 0]) < 0.6e-3
    assert np.std(off[:, 1]) < (0.9e-3 if impacts else 0.6e-3)
    assert (smooth.begins[:, 2:] == windows.begins[:, 2:]).all()
    assert begun_smoothly(windows, log, observation, {}) is windows


def test_starts_that_are_found_stand_beside_smooth_ones(bouncing: Evidence) -> None:
    windows = dataclasses.replace(bouncing.windows, smooth=bouncing.windows.measured[:, 0] + 0.01)
    assert (windows.begins == windows.smooth).all()
    found = dataclasses.replace(windows, starts=windows.begins + np.eye(len(windows), 4)[:, :1])
    table = table_of(found)
    assert len(table) == 1
    assert (begun(windows, table) == found.starts).all()
    assert (windows.select(np.array([2])).begins == windows.smooth[2]).all()
