"""Laws of the forces at the joints: what they name, with which numbers, and when they have nothing to say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import dropo_torch as dropo
from dropo_torch.effects import VOCABULARY, Effect, find_effect
from dropo_torch.gap import add, find_gap, run
from dropo_torch.gap.forces import regression
from dropo_torch.gap.forces.motion import has_forces, highest_frequency, low_pass
from dropo_torch.gap.forces.terms import LINEAR
from dropo_torch.gap.forces.view import ForceView, force_view
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.log import make_setting
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.rules import Forces
from dropo_torch.gap.search import Ended, Naming, start
from dropo_torch.gap.verify import hold_out
from dropo_torch.problem import Problem
from dropo_torch.report import write_gap_report
from dropo_torch.report.gap_words import answer

ARM = """
<mujoco>
  <option timestep="0.0025" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="base" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".04" mass="2"/>
      <body name="fore" pos=".3 0 0">
        <joint name="shoulder" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1.2"/>
        <body name="hand" pos=".3 0 0">
          <joint name="elbow" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".03" mass=".6"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m1" joint="base"/><motor name="m2" joint="shoulder" gear="2"/><motor name="m3" joint="elbow"/>
  </actuator>
</mujoco>
"""
HAND = '<geom type="capsule" fromto="0 0 0 .2 0 0" size=".03" mass=".6"/>'
#: What the hand carries, beside its own middle.
CARRIED = '<geom type="sphere" pos=".15 .04 .03" size=".001" mass="{}"/>'
JOINTS, GEARS = ("base", "shoulder", "elbow"), np.array([1.0, 2.0, 1.0])


def recorded(
    seed: int, *, friction: tuple[float, ...] = (0, 0, 0), offset: float = 0.0, center: float = 0.0,
    ripple: float = 0.03, dt: float = 0.005, seconds: float = 40.0, gives: tuple[float, ...] = (0, 0, 0),
    at_rest: float = 0.01, carried: float = 0.0, noise: float = 1e-5,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return rows of positions and velocities, and torques, of joints that follow sines exactly.

    Nothing is simulated: the torques are those that the motion needs, with dry friction, less a constant force at the
    shoulder, with the fore arm's center of mass elsewhere, and with ripple relative to each joint's largest torque.
    Friction falls below a speed, or gives over a displacement before the joint slides.
    """
    draw, n = np.random.default_rng(seed), int(seconds / dt)
    times, speed = np.arange(2 * n + 1) * 0.5 * dt, 2 * np.pi * np.array([0.13, 0.29, 0.53])
    size, phase = draw.uniform(0.1, 0.35, (3, 3)), draw.uniform(0, 6.28, (3, 3))
    waves = [size * speed**k * np.sin(speed * times[:, None, None] + phase + 0.5 * k * np.pi) for k in range(3)]
    position, velocity, acceleration = (w.sum(-1) for w in waves)
    model = mujoco.MjModel.from_xml_string(ARM.replace(HAND, HAND + CARRIED.format(carried) if carried else HAND))
    model.body("fore").ipos[2] += center
    model.body_sameframe[model.body("fore").id] = 0
    data, torque = mujoco.MjData(model), np.empty((n, 3))
    for row, at in enumerate(range(1, 2 * n, 2)):
        data.qpos[:], data.qvel[:], data.qacc[:] = position[at], velocity[at], acceleration[at]
        mujoco.mj_inverse(model, data)
        torque[row] = data.qfrc_inverse + friction * np.tanh(velocity[at] / at_rest) - [0, offset, 0]
    for joint in np.flatnonzero(gives):
        bent = dahl(position[:, joint], 0.5 * dt, gives[joint])[1::2]
        torque[:, joint] += friction[joint] * (bent - np.tanh(velocity[1::2, joint] / at_rest))
    middle, waves = times[1::2, None], draw.uniform(0.3, 3, 12)
    rough = sum(draw.normal(0, 1, 3) * np.sin(2 * np.pi * f * middle + draw.uniform(0, 6, 3)) for f in waves) / 6**0.5
    rows = np.concatenate([position[::2] + draw.normal(0, noise, (n + 1, 3)),
                           velocity[::2] + draw.normal(0, 1e-3, (n + 1, 3))], 1)  # fmt: skip
    return rows, (torque + ripple * np.abs(torque).max(0) * rough) / GEARS


def dahl(position: np.ndarray, step: float, displacement: float, fine: int = 40) -> np.ndarray:
    """Return the deflection of bristles along a path, by small Euler steps of Dahl's equation in time."""
    times = np.arange(len(position)) * step
    speed = np.gradient(CubicSpline(times, position)(np.arange(fine * len(times)) * step / fine), step / fine)
    bent, found = 0.0, np.empty(len(position))
    for i, v in enumerate(speed):
        if i % fine == 0:
            found[i // fine] = bent
        bent += step / fine * (v - abs(v) * bent) / displacement
    return found


def problem_of(folder: Path, seed: int, model: str = ARM, **truth: Any) -> Problem:
    rows, torque = recorded(seed, **truth)
    (folder / "arm.xml").write_text(model)
    ends, dt = np.arange(len(rows)) == len(rows) - 1, truth.get("dt", 0.005)
    np.savez(folder / "log.npz", observations=rows, actions=np.vstack([torque, torque[-1:]]), terminals=ends)
    (folder / "arm.yaml").write_text(
        f"model: arm.xml\ndata: {{path: log.npz, dt: {dt}}}\nframe_skip: {round(dt / 0.0025)}\n"
        "observation: ['qpos[:3]', 'qvel[:3]']\nthreads: 1\n"
    )
    return dropo.make_problem(dropo.load_config(folder / "arm.yaml"), general=True)


def view_of(
    problem: Problem, effects: Sequence[Effect] = tuple(VOCABULARY.values()), noise: dict[int, float] | None = None
) -> ForceView | None:
    log = problem.trajectories
    train, held = hold_out(replace(log, dt=log.dt or problem.simulator.timestep))
    return force_view(make_setting(problem, train), train, held, effects, Forces(), (), noise)


@pytest.mark.parametrize("seed", range(3))
def test_friction_offset_and_center_are_named(tmp_path: Path, seed: int) -> None:
    """Each at its joint and with its number; a unit of the motor makes two of the joint with a gear ratio of two."""
    truth = {"friction": (0.5, 0.8, 0.3), "offset": 0.4, "center": 0.05, "ripple": 0.02}
    view = view_of(problem_of(tmp_path, seed, **truth))
    found = {p.key: np.array(p.values) for p in view.placed}
    assert {*found} == {*(("joint_friction", j) for j in JOINTS), ("actuator_bias", "m2"), ("center_of_mass", "fore")}
    friction = [found["joint_friction", j][0] for j in JOINTS]
    assert friction == pytest.approx(truth["friction"], rel=0.02)
    assert found["actuator_bias", "m2"] == pytest.approx(0.2, abs=0.02)
    assert found["center_of_mass", "fore"][2] == pytest.approx(0.05, abs=0.005)
    assert (view.after < 0.2 * view.before).all()


@pytest.mark.parametrize("seed", range(2))
def test_what_a_hand_carries_is_one_mass_in_one_place(tmp_path: Path, seed: int) -> None:
    """It shifts the center of mass of everything from a body on: no such shifts of several bodies are named."""
    truth = {"friction": (0.5, 0.8, 0.3), "carried": 0.4, "ripple": 0.02}
    view = view_of(problem_of(tmp_path, seed, **truth))
    found = {p.key: np.array(p.values) for p in view.placed}
    assert {*found} == {*(("joint_friction", j) for j in JOINTS), ("payload", "hand")}
    assert [found["joint_friction", j][0] for j in JOINTS] == pytest.approx(truth["friction"], rel=0.03)
    mass, along, _, above = found["payload", "hand"]  # how far it is beside, the elbow's torque does not say
    assert mass == pytest.approx(0.4, rel=0.05)
    assert (along, above) == pytest.approx((0.15, 0.03), abs=0.01)
    (halves,) = (h for p, h in zip(view.placed, view.halves, strict=True) if p.key == ("payload", "hand"))
    assert (np.abs(found["payload", "hand"] - [0.4, 0.15, 0.04, 0.03]) < 3 * halves).all()


@pytest.mark.parametrize("seed", range(2))
def test_a_displacement_that_the_noise_of_positions_hides_is_none(tmp_path: Path, seed: int) -> None:
    """Where positions are noisy, friction that turns a little late beats one that turns with every row of noise."""
    problem = problem_of(tmp_path, seed, friction=(0.5, 0.8, 0.3), at_rest=1e-4, ripple=0.02, noise=2e-4)
    told = view_of(problem, noise=dict.fromkeys(range(3), 2e-4))
    assert {p.key for p in told.placed} == {("joint_friction", j) for j in JOINTS}


@pytest.mark.parametrize("seed", range(2))
def test_friction_that_gives_is_named_with_its_displacement(tmp_path: Path, seed: int) -> None:
    """Where it gives, and nowhere else, also beside other effects."""
    truth = {"friction": (0.5, 0.8, 0.3), "gives": (0.02, 0, 0.03), "offset": 0.4, "ripple": 0.02}
    view = view_of(problem_of(tmp_path, seed, **truth))
    found = {p.key: np.array(p.values) for p in view.placed if p.effect.kind == "joint"}
    assert {*found} == {("joint_presliding", "base"), ("joint_friction", "shoulder"), ("joint_presliding", "elbow")}
    assert found["joint_presliding", "base"][0] == pytest.approx(0.5, rel=0.03)
    assert found["joint_presliding", "elbow"][0] == pytest.approx(0.3, rel=0.03)
    for joint, displacement in (("base", 0.02), ("elbow", 0.03)):
        assert found["joint_presliding", joint][1] == pytest.approx(displacement, rel=0.1)
    sharp = [e for e in VOCABULARY.values() if e.name != "joint_presliding"]
    problem = problem_of(tmp_path, seed, **truth)
    assert (view.after < view_of(problem, sharp).after)[[0, 2]].all()


@pytest.mark.parametrize("at_rest", [0.01, 0.1])
def test_friction_that_depends_on_the_velocity_does_not_give(tmp_path: Path, at_rest: float) -> None:
    """However slowly it builds up with the velocity."""
    view = view_of(problem_of(tmp_path, 2, friction=(0.5, 0.8, 0.3), at_rest=at_rest, ripple=0.02))
    assert {p.key for p in view.placed} >= {("joint_friction", j) for j in JOINTS}
    assert "joint_presliding" not in {p.effect.name for p in view.placed}


@pytest.mark.parametrize("gives", [(0, 0, 0), (0.02, 0, 0.03), (0.006, 0.006, 0.006)])
def test_halves_of_a_log_say_the_same_of_friction(tmp_path: Path, gives: tuple[float, ...]) -> None:
    """Whether it gives or not: what either half names is the truth or has it as a tie, and the other half tells it."""
    told = []
    for half in halves(problem_of(tmp_path, 1, friction=(0.5, 0.8, 0.3), gives=gives, ripple=0.05), blocks=8):
        view = view_of(half)
        assert view is not None
        told.append({p.target: (p.effect.name, *(t.effect.name for t in tied if t.target == p.target))
                     for p, tied in zip(view.placed, view.ties, strict=True) if p.effect.kind == "joint"})  # fmt: skip
    for joint, displacement in zip(JOINTS, gives, strict=True):
        kinds = [half[joint] for half in told]
        assert all(("joint_presliding" if displacement else "joint_friction") in kind for kind in kinds)
        assert kinds[0][0] in kinds[1]
        assert kinds[1][0] in kinds[0]


def halves(problem: Problem, blocks: int) -> list[Problem]:
    """Return a problem with every other of a log's blocks, and with the rest."""
    log = problem.trajectories
    ends = np.linspace(-1, len(log) - 1, blocks + 1).astype(int)[1:]
    log = replace(log, terminals=np.isin(np.arange(len(log)), ends))
    return [replace(problem, trajectories=log.select_episodes(range(half, blocks, 2))) for half in (0, 1)]


def test_what_did_the_same_as_what_has_gone_comes_back(linear: Callable) -> None:
    """Of two groups that explain the same, one is chosen; without it, the other."""
    problem = linear(3)
    columns = np.concatenate([problem.columns, problem.columns[:1] + 0.05 * problem.columns[5:]])
    every, groups = np.full(7, np.inf), np.arange(7)
    twice = replace(problem, columns=columns, low=-every, high=every, prior=every)
    chosen = regression.select(twice, groups, groups)
    assert chosen[[0, 6]].sum() == 1
    other = chosen & ~np.isin(groups, [0, 6])
    assert regression.refined(twice, other, groups, ~chosen)[[0, 6]].sum() == 1
    assert not regression.refined(twice, other, groups, groups == 3)[[0, 6]].any()


def test_intervals_hold_the_truth(tmp_path: Path) -> None:
    truth, inside = (0.5, 0.8, 0.3), []
    for seed in range(10, 18):
        view = view_of(problem_of(tmp_path, seed, friction=truth, ripple=0.05))
        assert [p.key for p in view.placed] == [("joint_friction", j) for j in JOINTS]
        inside += [abs(p.values[0] - t) < h[0] for p, h, t in zip(view.placed, view.halves, truth, strict=True)]
    assert np.mean(inside) >= 0.7


def test_limits_of_what_is_not_needed_hold_the_truth(tmp_path: Path) -> None:
    """Offsets, dampings and rotors that are not there, beside friction that is, and centers that only a prior holds."""
    inside, wide = [], []
    for seed in range(20, 26):
        view = view_of(problem_of(tmp_path, seed, friction=(0.5, 0.8, 0.3), ripple=0.05))
        assert not {p.key for p in view.placed} & {p.key for p, _ in view.left_out}
        for p, half in view.left_out:
            if p.effect.name == "center_of_mass":
                wide += half.tolist()
            else:
                inside.append(abs(p.values[0]) <= half[0])
    assert {len(p.values) == len(h) for p, h in view.left_out} == {True}
    assert np.mean(inside) >= 0.8
    assert min(wide) > 1e-4


@pytest.mark.parametrize("ripple", [0.0, 0.003, 0.1])
def test_a_right_model_has_nothing_named(tmp_path: Path, ripple: float) -> None:
    view = view_of(problem_of(tmp_path, 3, ripple=ripple))
    assert view is None or not view.placed


def test_what_ties_is_told(tmp_path: Path) -> None:
    """A shoulder that moves little cannot tell a constant force from a center of mass further out."""
    view = view_of(problem_of(tmp_path, 1, friction=(0.5, 0.8, 0.3), offset=0.4, center=0.05, ripple=0.06))
    told = {p.key: {other.key for other in tied} for p, tied in zip(view.placed, view.ties, strict=True)}
    assert ("actuator_bias", "m2") in told or ("actuator_bias", "m2") in told["center_of_mass", "upper"]


def test_a_log_that_is_too_coarse_says_nothing(tmp_path: Path) -> None:
    """At two rows in a period of the fastest sine, differences of positions make forces of their own."""
    truth = {"friction": (0.05, 0.05, 0.05), "ripple": 0.0}
    assert view_of(problem_of(tmp_path, 0, dt=0.3, seconds=600, **truth)) is None
    assert view_of(problem_of(tmp_path, 0, **truth)).placed


def test_a_log_of_short_episodes_says_nothing(tmp_path: Path) -> None:
    """Episodes of a few rows have no frequencies, nor has a robot that rests."""
    problem = problem_of(tmp_path, 0, friction=(0.5, 0.8, 0.3))
    log = problem.trajectories
    ends = np.arange(len(log.terminals)) % 4 == 3
    assert view_of(replace(problem, trajectories=replace(log, terminals=ends))) is None
    resting = replace(log, observations=0 * log.observations, next_observations=0 * log.next_observations)
    assert view_of(replace(problem, trajectories=resting)) is None


def test_a_joint_that_turns_steadily_is_slow(tmp_path: Path) -> None:
    """Over a short stretch a slow motion is a steady one: its frequency is not that of the noise beside it."""
    problem = problem_of(tmp_path, 0, seconds=8.0)
    log, setting = problem.trajectories, make_setting(problem, problem.trajectories)
    time = 0.005 * np.arange(len(log.terminals) + 1)[:, None]

    def turned(path: np.ndarray) -> float:
        path = path + np.random.default_rng(0).normal(0, 2e-5, (len(time), 3))
        columns = np.hstack([path, np.full_like(path, 0.5)])
        return highest_frequency(replace(log, observations=columns[:-1], next_observations=columns[1:]), setting)

    assert 0 < turned(0.5 * time) < 1
    assert 1.9 < turned(3 * time - 0.02 * np.cos(4 * np.pi * time)) < 2.6  # and what it does besides is a motion


def test_an_episode_of_one_transition_changes_nothing(tmp_path: Path) -> None:
    """It was aborted: it has no frequency, whether other episodes have one or not."""
    problem = problem_of(tmp_path, 0, seconds=8.0)
    log, setting = problem.trajectories, make_setting(problem, problem.trajectories)
    aborted = log.terminals.copy()
    aborted[-2] = True
    found = [highest_frequency(x, setting) for x in (log, replace(log, terminals=aborted))]
    assert 0 < found[0] == pytest.approx(found[1], rel=0.05)
    assert highest_frequency(replace(log, terminals=np.ones_like(aborted)), setting) == 0


def test_a_joint_that_rests_leaves_the_names_of_others(tmp_path: Path) -> None:
    """Nothing at all is missing there, which is neither a reason for an effect elsewhere nor against it."""
    rest = '<body><joint name="rest" type="slide" axis="1 0 0"/><geom size=".02" mass="1" pos="0 9 0"/></body>'
    model = ARM.replace("</worldbody>", f"{rest}</worldbody>").replace(
        "</actuator>", '<motor joint="rest"/></actuator>'
    )
    plain = problem_of(tmp_path, 0, friction=(0.5, 0.8, 0.3))
    held = np.load(tmp_path / "log.npz")
    rows = np.insert(held["observations"], [3, 6], 0.0, axis=1)
    arrays = {**held, "observations": rows, "actions": np.insert(held["actions"], 3, 0.0, axis=1)}
    (tmp_path / "arm.xml").write_text(model)
    np.savez(tmp_path / "log.npz", **arrays)
    config = plain.config.path("arm.yaml")
    config.write_text(config.read_text().replace("[:3]", "[:4]"))
    found = view_of(dropo.make_problem(dropo.load_config(config), general=True))
    expected = view_of(plain)
    assert found is not None
    assert expected is not None
    assert [p.key for p in found.placed] == [p.key for p in expected.placed] != []
    assert found.shares == pytest.approx(expected.shares, rel=0.05)
    assert found.share(found.left) == pytest.approx(expected.share(expected.left), rel=0.05)


def test_only_logs_with_all_forces_are_judged(tmp_path: Path) -> None:
    def holds(old: str, new: str) -> bool:
        assert old in ARM
        problem = problem_of(tmp_path, 0, ARM.replace(old, new), seconds=4)
        return has_forces(make_setting(problem, problem.trajectories))

    assert holds("<mujoco>", "<mujoco>")
    assert not holds('<motor name="m3" joint="elbow"/>', '<position name="m3" joint="elbow" kp="10"/>')
    assert not holds('<motor name="m3" joint="elbow"/>', '<motor name="m3" joint="shoulder"/>')
    assert not holds("<actuator>", '<equality><joint joint1="base" joint2="elbow"/></equality><actuator>')


@pytest.fixture
def linear() -> Callable[..., regression.Regression]:
    def make(
        seed: int, *, columns: int = 6, effects: int = 2, blocks: int = 12, rows: int = 20
    ) -> regression.Regression:
        draw, n = np.random.default_rng(seed), rows * blocks
        basis, truth = draw.normal(size=(columns, n, 2)), np.zeros(columns)
        truth[:effects] = draw.uniform(0.5, 1.5, effects)
        signal = np.einsum("p,pnj->nj", truth, basis) + draw.normal(size=(n, 2)) * [0.3, 2.0]
        every = np.full(columns, np.inf)
        return regression.Regression(signal, basis, -every, every, every, np.repeat(np.arange(blocks), rows))

    return make


def test_unseen_blocks_are_predicted_by_the_others(linear: Callable) -> None:
    problem, chosen = linear(0), np.array([True, True, True, False, False, False])
    found = regression.unseen(problem, chosen)
    for block in (0, 7):
        rows = problem.blocks != block
        rest = replace(problem, signal=problem.signal[rows], columns=problem.columns[:, rows],
                       blocks=problem.blocks[rows])  # fmt: skip
        left = problem.left(regression.fit(rest, chosen))[~rows]
        assert found[block] == pytest.approx((left**2).mean(0), rel=1e-9)


def test_every_output_weighs_by_its_own_noise(linear: Callable) -> None:
    """Coefficients are those of weighted least squares with the noise of the outputs, and lie within bounds."""
    problem, chosen = linear(1), np.ones(6, dtype=bool)
    found = regression.fit(problem, chosen)
    size = np.sqrt((problem.left(found) ** 2).mean(0))
    matrix = (problem.columns / size).reshape(6, -1).T
    best = np.linalg.lstsq(matrix, (problem.signal / size).ravel(), rcond=None)[0]
    assert found == pytest.approx(best, abs=1e-3)
    bounded = regression.fit(replace(problem, high=np.full(6, 0.4)), chosen)
    assert bounded.max() <= 0.4 + 1e-9
    assert bounded[:2] == pytest.approx(0.4, abs=1e-6)


def test_a_prior_holds_what_the_signal_does_not_show(linear: Callable) -> None:
    problem = linear(2)
    columns = problem.columns.copy()
    columns[5] = columns[0] + 1e-6 * columns[5]
    told = np.full(6, np.inf)
    told[5] = 1e-3
    found = regression.fit(replace(problem, columns=columns, prior=told), np.ones(6, dtype=bool))
    assert abs(found[5]) < 3e-3


def test_an_output_without_a_signal_has_no_say(linear: Callable) -> None:
    """Chances and shares are those of the other outputs."""
    problem, chosen = linear(4), np.arange(6) < 2
    none = np.zeros((6, len(problem.signal), 1))
    more = replace(problem, signal=np.insert(problem.signal, 2, 0.0, axis=1),
                   columns=np.concatenate([problem.columns, none], 2))  # fmt: skip
    parts = [np.arange(6) == p for p in range(2)]
    assert regression.chances(more, chosen, parts) == pytest.approx(regression.chances(problem, chosen, parts))
    whole = [regression.unseen(p, chosen).mean(0) for p in (problem, more)]
    first = [regression.unseen(p, ~chosen & chosen).mean(0) for p in (problem, more)]
    found = [regression.share_left(*pair) for pair in zip(whole, first, strict=True)]
    assert 0 < found[0] == pytest.approx(found[1])
    assert regression.share_left(np.zeros(2), np.zeros(2)) == 0


def test_chance_chooses_rarely(linear: Callable) -> None:
    """Of logs with noise alone, few keep a column that chance does not explain at one in a hundred."""
    kept = 0
    for seed in range(60):
        problem = linear(100 + seed, effects=0)
        chosen = regression.select(problem, np.arange(6), np.arange(6))
        parts = [np.arange(6) == p for p in np.flatnonzero(chosen)]
        kept += any(p < 0.01 for p in regression.chances(problem, chosen, parts))
    assert kept <= 6


def test_half_widths_cover(linear: Callable) -> None:
    inside = []
    for seed in range(60):
        problem, chosen = linear(200 + seed, effects=0), np.ones(6, dtype=bool)
        found = regression.fit(problem, chosen)
        inside.append(np.abs(found) < regression.half_widths(problem, chosen))
    assert 0.85 <= np.mean(inside) <= 0.96


@pytest.mark.parametrize("columns", [6, 18, 30])
def test_half_widths_cover_however_many_columns_there_are(linear: Callable, columns: int) -> None:
    """A fit of many numbers to few blocks leaves little of each: what it leaves is no measure of its errors."""
    inside = []
    for seed in range(60):
        problem, chosen = linear(300 + seed, columns=columns, effects=0, blocks=8, rows=8), np.ones(columns, dtype=bool)
        found = regression.fit(problem, chosen)
        inside.append(np.abs(found) < regression.half_widths(problem, chosen))
    assert 0.87 <= np.mean(inside) <= 0.97


def test_low_pass_keeps_phase_and_constants() -> None:
    times = np.arange(2000) * 0.005
    slow, fast = np.sin(2 * np.pi * times)[:, None], np.sin(2 * np.pi * 40 * times)[:, None]
    assert low_pass(slow + fast + 1, 200, 10)[200:-200] == pytest.approx((slow + 1)[200:-200], abs=2e-3)
    assert low_pass(fast, 200, 90) is fast


def test_forces_overrule_what_predictions_reward(tmp_path: Path) -> None:
    """An arm under torques drifts, and predictions name rotor inertias that slow it down: the forces know better."""
    truth = {"friction": (0.5, 0.8, 0.3), "center": 0.05, "ripple": 0.02, "seconds": 20}
    problem = problem_of(tmp_path, 5, **truth)
    gap = find_gap(problem, effects=[find_effect(name) for name in LINEAR])
    assert not gap.skill
    assert gap.verdict == "partly explained"
    assert {(e.effect, e.target) for e in gap.effects} == {("joint_friction", "*"), ("center_of_mass", "fore")}
    friction = next(e.parameters for e in gap.effects if e.effect == "joint_friction")
    assert [friction[j].value for j in JOINTS] == pytest.approx(truth["friction"], rel=0.05)
    assert [f.joint for f in gap.forces] == list(JOINTS)
    assert all(f.after < 0.3 * f.before for f in gap.forces)
    assert gap.after.rollout_rmse < 0.1 * gap.before.rollout_rmse
    headline, items = answer(gap)
    assert "forces at its joints decide" in headline
    assert any("base 0.5" in item and "elbow 0.3" in item for item in items)
    assert "by the forces at the joints" in gap.document()["verdict_reason"]
    add(problem, gap, tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert model.dof_frictionloss == pytest.approx([friction[j].value for j in JOINTS], rel=1e-4)
    write_gap_report(tmp_path / "report.html", gap)
    assert "Unexplained force at the joints" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("forces", [True, False])
def test_forces_decide_before_shorter_windows_are_searched(
    forces: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where predictions have no skill and the first search no names; without forces, shorter windows are next."""
    lengths = []

    def fruitless(ground: Ground, begin: Hypothesis, *_: Any, **__: Any) -> Ended:
        lengths.append(ground.evidence.windows.length)
        state = start(ground, begin)
        return Ended(ground, state, Naming(ground.evidence, state.base, state.first, state.base, gap=True))

    monkeypatch.setattr(run, "search", fruitless)
    if not forces:
        monkeypatch.setattr(run, "force_view", lambda *_: None)
    gap = find_gap(
        problem_of(tmp_path, 5, friction=(0.5, 0.8, 0.3), seconds=20), effects=[find_effect("joint_friction")]
    )
    assert len(lengths) == (1 if forces else 2)
    assert [e.effect for e in gap.effects] == ["joint_friction" if forces else "unnamed"]


def test_names_without_skill_are_no_rivals_of_the_forces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what predictions name, and unseen data refute, forces cannot even judge a delay."""

    def astray(ground: Ground, begin: Hypothesis, *_: Any, **__: Any) -> Ended:
        state = start(ground, begin)
        wrong = (next(p for p in ground.candidates if p.effect.name == "actuator_delay"),)
        final = ground.refit(begin.with_effects(wrong), iterations=0)
        found = Naming(ground.evidence, state.base, state.first, final, gap=True, named=True, ties=((),), shares=(1.0,))
        return Ended(ground, state, found)

    monkeypatch.setattr(run, "search", astray)
    monkeypatch.setattr(run, "with_ties", lambda ended, end: ended.naming)
    problem = problem_of(tmp_path, 5, friction=(0.5, 0.8, 0.3), seconds=20)
    gap = find_gap(problem, effects=[find_effect(e) for e in ("joint_friction", "actuator_delay")])
    assert [e.effect for e in gap.effects] == ["joint_friction"]


def test_friction_that_gives_is_told_and_written(tmp_path: Path) -> None:
    """With both its numbers; and the config that is written simulates it."""
    truth = {"friction": (0.5, 0.8, 0.3), "gives": (0.02, 0.02, 0.03), "ripple": 0.02, "seconds": 20}
    problem = problem_of(tmp_path, 5, **truth)
    gap = find_gap(problem, effects=[find_effect(name) for name in ("joint_friction", "joint_presliding", "armature")])
    assert {(e.effect, e.target) for e in gap.effects} == {("joint_presliding", joint) for joint in JOINTS}
    base = next(e.parameters for e in gap.effects if e.target == "base")
    assert base["coulomb"].value == pytest.approx(0.5, rel=0.03)
    assert base["displacement"].low < base["displacement"].value < base["displacement"].high
    assert base["displacement"].value == pytest.approx(0.02, rel=0.15)
    assert base["displacement"].unit == "rad"
    assert any("dry friction in base that gives elastically before it slides" in item for item in answer(gap)[1])
    add(problem, gap, tmp_path)
    written = dropo.make_problem(dropo.load_config(tmp_path / "config.yaml"))
    assert {e.effect.name for e in written.effects.entries} == {"joint_presliding"}
    assert gap.after.rollout_rmse < 0.1 * gap.before.rollout_rmse
