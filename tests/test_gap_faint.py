"""Effects that all residuals together do not show, and logs in which there are none, however noisy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy import stats
from test_gap_plain import NOISE, RAIL, named, pushes, scene_of

from dropo_torch.gap import faint, find_gap
from dropo_torch.gap.chance import p_of_ratio, p_of_scores
from dropo_torch.gap.faint import is_shown, may_tell
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.refit import Refit, refit
from dropo_torch.gap.rules import Rules, significant
from dropo_torch.gap.run import _ground
from dropo_torch.gap.search import start_anywhere
from dropo_torch.report.gap_words import answer

ERROR = Rules().chance.error


def creaks(damping: float) -> Callable[[mujoco.MjModel], None]:
    def change(model: mujoco.MjModel) -> None:
        model.dof_damping[0] += damping

    return change


def nothing(model: mujoco.MjModel) -> None:
    """The user's model is right."""


def by_runge_kutta(model: mujoco.MjModel) -> None:
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4


def test_an_effect_below_the_gate_is_named_with_its_tie_and_said_to_be_faint() -> None:
    scene = scene_of(RAIL, creaks(0.01), pushes, seed=11)
    base = start_anywhere(_ground(scene, None), scene.begin).base
    assert not significant(base.cost, scene.rules)  # all residuals together look like noise
    gap = find_gap(scene.problem, scene=scene)
    assert named(gap) == [("joint_damping", "rail")]
    assert gap.effects[0].indistinguishable_from == (("actuator_damping", "push"),)
    assert gap.effects[0].parameters["damping"].low < 0.01 < gap.effects[0].parameters["damping"].high
    assert gap.found
    assert any("likelihood ratio" in note for note in gap.notes)


@pytest.mark.parametrize("seed", [21, 22])
def test_a_right_model_has_no_faint_effects(seed: int) -> None:
    scene = scene_of(RAIL, nothing, pushes, seed=seed)
    gap = find_gap(scene.problem, scene=scene)
    assert not gap.found
    assert named(gap) == []


def test_what_a_finer_step_explains_as_well_is_no_faint_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, size in {"position": 2.2e-3, "velocity": 2.2e-2}.items():
        monkeypatch.setitem(NOISE, kind, size)
    scene = scene_of(RAIL, by_runge_kutta, pushes, seed=23)
    asked: list[str] = []

    def asking(ground: Ground, without: Refit, better: Refit) -> bool:
        asked.append(better.hypothesis.placed[-1].effect.name)
        return is_shown(ground, without, better)

    monkeypatch.setattr(faint, "is_shown", asking)
    assert not find_gap(scene.problem, scene=scene).found
    assert asked == []  # what promised most, a late sensor, does no more than half of what the step does


def test_noise_that_lasts_over_rows_is_no_gap_and_hides_none() -> None:
    right = scene_of(RAIL, nothing, pushes, seed=31, lasting=0.6)
    assert significant(start_anywhere(_ground(right, None), right.begin).base.cost, right.rules)
    gap = find_gap(right.problem, scene=right)
    assert gap.lasting
    assert gap.verdict == "no gap"
    assert "last" in gap.document()["verdict_reason"]
    assert "Nothing is missing that predictions show" in answer(gap)[0]
    wrong = scene_of(RAIL, creaks(0.5), pushes, seed=31, lasting=0.6)
    gap = find_gap(wrong.problem, scene=wrong)
    assert not gap.lasting
    assert named(gap) == [("joint_damping", "rail")]


def test_a_ratio_is_trusted_only_beside_noise_that_bends_no_window() -> None:
    scene = scene_of(RAIL, creaks(0.2), pushes, seed=11)
    state = start_anywhere(ground := _ground(scene, None), scene.begin)
    assert significant(state.base.cost, scene.rules)
    assert not may_tell(ground, state.base)
    silent = replace(state.base, cost=replace(state.base.cost, windows=0 * state.base.cost.windows))
    assert may_tell(ground, silent)
    assert not may_tell(replace(ground, evidence=replace(ground.evidence, rough=True)), silent)


def test_a_few_blocks_alone_show_nothing() -> None:
    scene = scene_of(RAIL, creaks(0.02), pushes, seed=11)
    ground = _ground(scene, None)
    without, damping = start_anywhere(ground, scene.begin).base, ground.candidates[0].at((0.01,))
    assert damping.key == ("joint_damping", "rail")
    better = refit(ground.part, without.hypothesis.with_effects([damping]), linear=without.linear)
    assert is_shown(ground, without, better)
    assert not is_shown(ground, without, better, named=1e9)
    few = np.where(np.arange(len(without.residual))[:, None] < 2, without.residual, 0.0)
    assert not is_shown(ground, replace(without, residual=few), better)
    assert not is_shown(ground, replace(without, loss=better.loss + 0.01 * better.cost.degrees), better)


def test_noise_of_many_candidates_passes_for_a_ratio_no_more_often_than_stated() -> None:
    rng, candidates = np.random.default_rng(3), 100
    gains = rng.chisquare(2, (2000, candidates)).max(1)
    told = [p_of_ratio(gain, 2) * candidates <= ERROR for gain in gains]
    assert sum(told) <= stats.binom.ppf(0.99, len(told), ERROR)


@pytest.mark.parametrize("numbers", [1, 3])
def test_blocks_of_coloured_noise_have_scores_no_more_often_than_stated(numbers: int) -> None:
    rng, told = np.random.default_rng(4), 0
    for _ in range(1000):
        noise = np.cumsum(rng.standard_normal((20, 30)), 1)  # a walk within each block
        slope = np.cos(np.outer(np.arange(1, numbers + 1), np.linspace(0, 3, 30)))
        told += p_of_scores(noise @ slope.T) <= ERROR
    assert told <= stats.binom.ppf(0.99, 1000, ERROR)
    assert p_of_scores(np.ones((20, numbers)) + 0.1 * rng.standard_normal((20, numbers))) < 1e-9
    assert p_of_scores(np.zeros((20, numbers))) == 1.0
