"""Advice on what to record: of the motions that were tried, the one that tells two hypotheses apart."""

from __future__ import annotations

import functools
import tempfile
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from dropo_torch.config import load_config
from dropo_torch.effects import VOCABULARY, Placed
from dropo_torch.gap import Hypothesis, Scene, prepare
from dropo_torch.gap.refit import refit
from dropo_torch.gap.suggest import COMMANDS, IN_A_ROW, STARTS, Advice, excite, motions, separation, suggest
from dropo_torch.problem import make_problem

PENDULUM = """
<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="rod" pos="0 0 1">
    <joint name="pivot" axis="0 1 0" damping=".1"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1"/>
  </body></worldbody>
  {actuators}
</mujoco>"""
MOTOR = '<actuator><motor name="motor" joint="pivot" gear="2" ctrlrange="-1 1"/></actuator>'
LINEAR, QUADRATIC = "joint_damping", "joint_quadratic_damping"


def recorded(actuators: str = MOTOR, size: float = 0.1) -> Scene:
    """A log of slow pushes of a pendulum, or of one that is let go."""
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(actuators=actuators))
    rng, rows = np.random.default_rng(0), []
    for _ in range(4):
        data = mujoco.MjData(model)
        data.qpos[0], data.qvel[0] = 0.3 * rng.standard_normal(2)
        for t in range(150):
            data.ctrl[:] = size * np.sin(0.02 * t)
            state = np.concatenate([data.qpos, data.qvel])
            mujoco.mj_step(model, data, 2)
            rows.append((state, np.concatenate([data.qpos, data.qvel]), data.ctrl.copy()))
    before, after, commands = (np.array(part) for part in zip(*rows, strict=True))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "model.xml").write_text(PENDULUM.format(actuators=actuators))
        np.savez(
            folder / "log.npz", observations=before, next_observations=after, actions=commands,
            terminals=np.arange(1, len(before) + 1) % 150 == 0, dt=0.01,
        )  # fmt: skip
        document = {"model": "model.xml", "data": "log.npz", "frame_skip": 2, "noise": [1e-3, 1e-2]}
        (folder / "config.yaml").write_text(yaml.safe_dump(document))
        return prepare(make_problem(load_config(folder / "config.yaml"), general=True))


@functools.cache
def scene() -> Scene:
    return recorded()


def placed(effect: str, target: str, value: float) -> Placed:
    return Placed(VOCABULARY[effect], target, (value,))


def advice(one: Placed, other: Placed) -> Advice:
    """What is said where one effect is in the log, and another one may be."""
    evidence = scene().evidence
    shown = evidence.twin.predict([Hypothesis((), (one,)).variant], evidence.windows)[0][0]
    evidence = replace(evidence, windows=replace(evidence.windows, measured=shown))
    return suggest(evidence, Hypothesis((), (one,)), Hypothesis((), (other,)), one, other)


def test_a_motion_is_proposed_that_separates_what_a_slow_one_does_not() -> None:
    found = advice(placed(QUADRATIC, "pivot", 0.3), placed(LINEAR, "pivot", 0.01))
    assert found.tells
    assert found.sentence.startswith(
        "To tell joint_quadratic_damping of pivot from joint_damping of pivot, record the same motion with commands "
        "twice as large: over 12 windows"
    )


def test_no_motion_is_proposed_between_two_names_of_one_thing() -> None:
    """Damping of a joint and of its motor are the same on every motion, once their numbers are the same."""
    found = advice(placed(LINEAR, "pivot", 0.2), placed("actuator_damping", "motor", 0.01))
    assert not found.tells
    assert found.sentence.startswith("None of 6 motions that were tried would tell joint_damping of pivot from actuat")


def test_a_rival_adapts_to_a_motion_as_far_as_the_log_lets_it() -> None:
    evidence = scene().evidence
    truth, rival = Hypothesis((), (placed(LINEAR, "pivot", 0.2),)), Hypothesis((), (placed(LINEAR, "pivot", 0.1),))
    motion = evidence.on(dict(motions(evidence, truth))["the same motion again"])
    wrong = refit(evidence, rival, iterations=0)
    free, tied = separation(motion, truth, wrong, share=0.0), separation(motion, truth, wrong, share=1e6)
    assert free is not None
    assert tied is not None
    assert free < 0.01 < 1 < tied


def test_a_rival_without_numbers_is_compared_as_it_is() -> None:
    found = advice(placed(LINEAR, "pivot", 0.2), Placed(VOCABULARY["integration"], None, (0.00125,)))
    assert found.tells


def test_commands_stay_within_their_range() -> None:
    model = scene().setting.model
    evidence = scene().evidence
    strong = evidence.on(replace(evidence.windows, commands=np.full((4, 151, model.nu), 0.8)))
    found = dict(motions(strong, Hypothesis(())))
    assert set(found) == set(COMMANDS)
    windows = found["the same motion with commands twice as large"]
    for episode, step in zip(windows.episodes, windows.steps, strict=True):
        assert np.unique(windows.commands[episode, step:]) == pytest.approx([1.0])


def test_where_nothing_is_commanded_motions_start_faster() -> None:
    passive = recorded(actuators="")
    found = dict(motions(passive.evidence, Hypothesis(())))
    assert set(found) == set(STARTS)
    fast, logged = found["motions that start twice as fast"], passive.evidence.windows
    for i in range(0, len(fast), IN_A_ROW):
        assert np.isclose(logged.measured[:, 0] * [1, 2], fast.measured[i, 0], rtol=1e-12).all(1).sum() == 1
    idle = recorded(size=0.0)  # a motor that is off
    assert set(dict(motions(idle.evidence, Hypothesis(())))) == set(STARTS)


@pytest.mark.parametrize(
    ("effect", "numbers", "actuators"),
    [
        ("joint_presliding", (0.1, 0.003), MOTOR), ("joint_presliding", (0.01, 0.003), ""),
        ("joint_elasticity", (0.01, 0.3, 0.02), MOTOR),
    ],
)  # fmt: skip
def test_a_motion_goes_on_where_forces_remember(effect: str, numbers: tuple[float, ...], actuators: str) -> None:
    """What is remembered at a window's start is what the motion before has left."""
    evidence = recorded(actuators=actuators).evidence
    true = Hypothesis((), (Placed(VOCABULARY[effect], "pivot", numbers),))
    errors = []
    for words, windows in motions(evidence, true):
        if words != "the same motion again":
            later = windows.select(np.arange(len(windows)) % IN_A_ROW > 0)
            for own in (later, replace(later, observed=None)):
                shown = evidence.twin.predict([true.variant], own)[0][0]
                errors.append(np.abs(shown - later.measured).max())
    begun, anew = np.reshape(errors, (-1, 2)).max(0)
    assert begun < 0.3 * anew


def test_a_motion_goes_on_as_it_would_be() -> None:
    """Each of its windows starts where the one before has led, under the commands that are told."""
    evidence, damped = scene().evidence, Hypothesis((), (placed(LINEAR, "pivot", 0.2),))
    found = dict(motions(evidence, damped))
    for words in set(COMMANDS) - {"the same motion again"}:
        windows = found[words]
        np.testing.assert_array_equal(windows.measured[1::IN_A_ROW, 0], windows.measured[::IN_A_ROW, -1])
        there = evidence.twin.predict([damped.variant], windows)[0][0]
        np.testing.assert_allclose(there, windows.measured, rtol=0, atol=1e-9)
    slow, step = found["the same motion at half the speed"], evidence.windows.steps[0]
    own = evidence.windows.commands[slow.episodes[0], step:]
    np.testing.assert_array_equal(slow.commands[0, step : step + 40 : 2], own[:20])


@pytest.mark.parametrize(
    ("silent", "words"),
    [
        ([("joint_limit", "elbow")], "reaches the stops (for joint_limit of elbow)"),
        ([("ground_slope", None)], "slides and presses on the ground (for ground_slope)"),
        ([("payload", f"link{i}") for i in range(6)], "moves more (for payload of link0, payload of link1, payload of "
         "link2, payload of link3 and others)"),
    ],
)  # fmt: skip
def test_what_a_log_must_show_to_judge_the_rest(silent: list[tuple[str, str | None]], words: str) -> None:
    placed = [Placed(VOCABULARY[effect], target) for effect, target in silent]
    assert excite(placed) == f"To judge what this log cannot, record a motion that {words}."
    assert excite([Placed(VOCABULARY["integration"], None, (1e-3,)), *placed]) == excite(placed)
    assert excite([]) is None
