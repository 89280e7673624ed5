"""From a log to the missing effect: each stage by its laws, and the whole on logs in which effects are hidden."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import json
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml
from arm import Folder

import dropo_torch as dropo
import dropo_torch.gap as gap_package
from benchmarks.hidden.cases import cases, select
from benchmarks.hidden.systems import CART_POLE, FURUTA, SERVO_ARM, TORQUE_ARM, Command, Scale, System, coarse, mass
from benchmarks.hidden.truths import Before, Case, Effect, make_case, make_recording, simulate_truth
from dropo_torch.commands.cli import main
from dropo_torch.config import load_config
from dropo_torch.effects import VOCABULARY, Placed, Quantity, Setting, find_effect
from dropo_torch.effects.engine import Variant
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.sensor import SensorEffect
from dropo_torch.errors import InputError
from dropo_torch.gap import (
    Gap,
    Scene,
    accept,
    add,
    find_gap,
    find_gap_as_given,
    given,
    name,
    outcome,
    prepare,
)
from dropo_torch.gap import refit as refitting
from dropo_torch.gap import search as searching
from dropo_torch.gap import ties as tying
from dropo_torch.gap.accept import accounts_finely, extend, imitates, is_done, is_needed, paired
from dropo_torch.gap.course import courses
from dropo_torch.gap.evidence import Cost, Evidence, Linearization, cost_of, robust_factors
from dropo_torch.gap.ground import Ground, Screening, State
from dropo_torch.gap.locate import guilty, middles, part_of_log, regime, slopes
from dropo_torch.gap.log import cut_windows
from dropo_torch.gap.noise import Diverges, FreeForces, _relative_noise, free_forces
from dropo_torch.gap.outcome import _notes
from dropo_torch.gap.refit import (
    Z90,
    Hypothesis,
    Refit,
    half_widths,
    limits_of,
    refit,
    resolved,
    standard_errors,
    step_may_explain,
)
from dropo_torch.gap.renew import noise_beside, noise_left
from dropo_torch.gap.result import NamedEffect, Score, Strength
from dropo_torch.gap.rules import Rules, Sound, Tried, accounts, allowance, beyond_free, clears, most_left, significant
from dropo_torch.gap.scene import outstanding, searched, short_windows
from dropo_torch.gap.screen import Candidate, Focus, all_candidates, promised, screen
from dropo_torch.gap.search import Ended, Naming, believed, instead_of_one, leaves_wrong, start
from dropo_torch.gap.sound import absurd, has_skill
from dropo_torch.gap.symbolic import describe
from dropo_torch.gap.ties import as_good
from dropo_torch.gap.time_left import TimeLeft
from dropo_torch.gap.twin import Windows, secants
from dropo_torch.gap.verify import cut_held, hold_out, rollout_floor, score, scores
from dropo_torch.problem import Problem, make_problem
from dropo_torch.report.gap_words import answer
from dropo_torch.support.checkpoint import dumps
from dropo_torch.support.files import plain_numbers

#: The vocabulary of searches that are not about the whole of it.
FEW = (
    "joint_damping", "joint_friction", "joint_stiffness", "gravity_tilt", "actuator_gain", "actuator_delay",
    "actuator_lag",
)  # fmt: skip
#: What cannot take energy out of a joint.
WITHOUT_FRICTION = ("joint_stiffness", "actuator_gain", "actuator_lag")
DAMPING = Effect("joint_damping", "hinge", {"damping": 0.02})
DELAY = Effect("actuator_delay", "push", {"delay": 0.012})
LAG = Effect("actuator_lag", "push", {"time_constant": 0.02})
FRICTION = Effect("joint_friction", "rail", {"friction": 0.3})
STIFFNESS = Effect("joint_stiffness", "hinge", {"stiffness": 0.2, "reference": 0.0})
UNEVEN = {"friction": 1.0, "waves": 6.0, "phase": 0.3}
PRESLIDING = Effect("joint_presliding", "hinge", {"coulomb": 0.2, "displacement": 0.4})
SIZE = {"episodes": 4, "transitions": 100}
#: By how much a noise is too large with which more than one effect leaves no more.
LOUD = 40.0
FILES = {"gap.json", "report.html", "picture.png", "model.xml", "config.yaml", "gap-progress.bin"}


@functools.cache
def hidden(*names: str) -> Case:
    """A cart-pole's log with effects hidden in it."""
    known = {e.name: e for e in (DAMPING, DELAY, LAG, FRICTION, STIFFNESS, PRESLIDING)}
    return simulate_truth(CART_POLE, [known[n] for n in names], 3, **SIZE)


def load(case: Case, **changes: Any) -> Problem:
    with tempfile.TemporaryDirectory() as folder:
        config = {**case.config, "threads": 1, **changes}
        path = dataclasses.replace(case, config=config).write(folder)
        return make_problem(load_config(path), general=True)


@functools.cache
def scene_of(*names: str) -> Scene:
    return prepare(load(hidden(*names)))


def search(case: Case, effects: tuple[str, ...], report: Callable = lambda *_: None, **given: Any) -> Gap:
    changes = {k: given.pop(k) for k in ("threads", "noise") if k in given}
    return find_gap(load(case, **changes), effects=[VOCABULARY[e] for e in effects], report=report, **given)


@functools.cache
def found(names: tuple[str, ...], effects: tuple[str, ...] = FEW) -> Gap:
    return search(hidden(*names), effects)


def lasting(gap: Gap) -> dict[str, Any]:
    """What a result says, without what it took."""
    return {k: v for k, v in plain_numbers(gap.document()).items() if k not in ("seconds", "simulated_transitions")}


def true(case: Case) -> Hypothesis:
    """What is hidden, as a hypothesis."""
    placed = [Placed(find_effect(e.name), e.target, tuple(e.parameters.values())) for e in case.effects]
    return Hypothesis(tuple(case.declared.values()), tuple(placed))


# --- the model as given ---------------------------------------------------------------------------------------


def as_given(case: Case, folder: Path, **changes: Any) -> Problem:
    config = {**case.config, "threads": 1, "as_given": True, **changes}
    return make_problem(load_config(dataclasses.replace(case, config=config).write(folder)), general=True)


def test_what_a_parameter_would_make_up_for_has_a_name_in_the_model_as_given(tmp_path: Path) -> None:
    """A log tells the hinge's damping, so that a config lists it; but that the model lacks it is the answer."""
    case, free = hidden("joint_damping"), {"field": "dof_damping", "name": "hinge", "bounds": [0.0, 0.1]}
    heavier, model = case.declared["pole_mass"] / 0.5, case.model
    for kilograms in (0.4, 0.1):  # what the pole weighs is known
        model = model.replace(f'mass="{kilograms:g}"'.replace("0.", "."), f'mass="{kilograms * heavier}"')
    parameters = {**case.config["parameters"], "damping": free}
    problem = as_given(dataclasses.replace(case, model=model), tmp_path, parameters=parameters)
    few = [VOCABULARY[e] for e in FEW]
    assert find_gap(problem, effects=few).verdict == "no gap"
    held, gap = find_gap_as_given(problem, effects=few)
    (named,) = gap.effects
    assert (named.effect, named.target) == ("joint_damping", "hinge")
    assert named.parameters["damping"].low < 0.02 < named.parameters["damping"].high
    assert (gap.declared, held.config.parameters, held.config.as_given) == ({}, {}, False)


def test_parameters_are_fitted_where_the_model_as_given_has_no_answer(tmp_path: Path) -> None:
    """A pole of another mass is none of these effects: without it, nothing explains the log."""
    problem, store = as_given(hidden(), tmp_path), tmp_path / "gap-progress.bin"
    few = [VOCABULARY[e] for e in FEW]
    found, gap = find_gap_as_given(problem, effects=few, checkpoint=store)
    assert found is problem
    assert gap.verdict == "no gap"
    assert gap.declared["pole_mass"][2] == pytest.approx(hidden().declared["pole_mass"], rel=1e-3)
    assert {"gap-progress.bin", "gap-progress-given.bin"} <= {path.name for path in tmp_path.iterdir()}


def test_parameters_are_not_fitted_where_no_time_is_left_for_it(tmp_path: Path) -> None:
    """As long as it takes, it cannot be broken off; with a longer limit, a search that is resumed goes on with it."""
    problem, store = as_given(hidden(), tmp_path), tmp_path / "gap-progress.bin"
    few = [VOCABULARY[e] for e in FEW]
    held, gap = find_gap_as_given(problem, effects=few, checkpoint=store, time_limit=0.01)
    assert not held.config.parameters
    assert gap.verdict != "no gap"
    assert any("longer --time-limit" in note for note in gap.notes)
    found, gap = find_gap_as_given(problem, effects=few, checkpoint=store, resume=True)
    assert found is problem
    assert gap.verdict == "no gap"


@pytest.mark.parametrize(("after", "answered"), [(0.02, True), (0.5, False)])
def test_names_that_close_most_of_a_gap_are_an_answer_in_the_model_as_given(
    after: float, answered: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What then remains is not worth a second search, which a person would wait for; the notes say how to have it."""
    problem, gap = as_given(hidden("joint_damping"), tmp_path), found(("joint_damping",))
    left = dataclasses.replace(
        gap, remaining=gap.reduced[1], effects=gap.effects,
        before=dataclasses.replace(gap.before, rollout_rmse=1.0),
        after=dataclasses.replace(gap.after, rollout_rmse=after),
        noise_floor=dataclasses.replace(gap.noise_floor, rollout_rmse=0.0),
    )  # fmt: skip
    searched: list[Problem] = []
    monkeypatch.setattr(given, "find_gap", lambda own, **_: searched.append(own) or left)
    _, answer = find_gap_as_given(problem)
    assert answer.verdict == "partly explained"
    assert len(searched) == (1 if answered else 2)
    assert any("--as_given false" in note for note in answer.notes) == answered


def test_a_mass_that_is_another_is_no_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the model as given something on the pole may make up for the pole's own mass, which the config declares."""
    few, problem = [VOCABULARY["joint_damping"]], as_given(hidden(), tmp_path)
    body = problem.config.parameters["pole_mass"]["name"]  # type: ignore[index]
    (named,) = found(("joint_damping",)).effects
    load = dataclasses.replace(
        found(("joint_damping",)), effects=(dataclasses.replace(named, effect="payload", target=body),)
    )
    assert load.verdict == "explained"
    searches = iter([lambda *_, **__: load, find_gap])
    monkeypatch.setattr(given, "find_gap", lambda own, **options: next(searches)(own, **options))
    held, gap = find_gap_as_given(problem, effects=few)
    assert gap.verdict == "no gap"
    assert gap.declared["pole_mass"][2] == pytest.approx(hidden().declared["pole_mass"], rel=1e-3)
    assert list(held.config.parameters or ()) == ["pole_mass"]
    center = {"field": "body_ipos", "index": 2, "name": body, "bounds": [-0.5, 0.5]}
    both = problem.config.model_copy(update={"parameters": {**(problem.config.parameters or {}), "center": center}})
    scene = prepare(given.as_given(problem))
    plain = given.as_own(dataclasses.replace(problem, config=both), load, scene)  # a mass and its center: no simpler
    assert plain is not None
    assert list(plain.config.parameters or ()) == ["pole_mass"]
    shared = problem.config.model_copy(deep=True)  # one number for several bodies, as of what is fixed to each other
    assert shared.parameters is not None
    shared.parameters["pole_mass"]["name"] = [body]
    of_several = given.as_own(dataclasses.replace(problem, config=shared), load, scene)
    assert of_several is not None
    assert list(of_several.config.parameters or ()) == ["pole_mass"]
    elsewhere = dataclasses.replace(load, effects=(named,))
    assert given.as_own(problem, elsewhere, scene) is None
    better = dataclasses.replace(load, reduced=(load.reduced[0], 0.5))  # what the mass alone cannot do
    assert given.as_own(problem, better, scene) is None


@pytest.mark.parametrize(("numbers", "is_simpler"), [(1, False), (4, True)])
def test_masses_of_several_bodies_that_are_others_are_no_load(numbers: int, is_simpler: bool, tmp_path: Path) -> None:
    """A load on one body makes up for the masses of others, but has more numbers than these."""
    problem = as_given(hidden(), tmp_path)
    parameters = problem.config.parameters or {}
    model = problem.space.model
    assert model is not None
    carriage = next(n for i in range(1, model.nbody) if (n := model.body(i).name) != parameters["pole_mass"]["name"])
    cart = {"field": "body_mass", "name": carriage, "bounds": [0.1, 10.0]}
    config = problem.config.model_copy(update={"parameters": {**parameters, "cart_mass": cart}})
    (named,) = found(("joint_damping",)).effects
    strengths = dict.fromkeys("abcd"[:numbers], next(iter(named.parameters.values())))
    load = dataclasses.replace(named, effect="payload", target=carriage, parameters=strengths)
    gap, scene = dataclasses.replace(found(("joint_damping",)), effects=(load,)), prepare(given.as_given(problem))
    plain = given.as_own(dataclasses.replace(problem, config=config), gap, scene)
    assert (plain is not None) == is_simpler
    assert plain is None or set(plain.config.parameters or ()) == {"cart_mass", "pole_mass"}


def test_a_fit_that_would_not_come_near_at_its_pace_ends_early() -> None:
    """A rival is of interest only where it comes near what is known; one that does goes on as if nothing were asked."""
    scene = scene_of("joint_damping", "joint_friction")
    ground = Ground(scene.evidence, (VOCABULARY["joint_damping"],))
    (target, *_) = VOCABULARY["joint_damping"].targets(scene.setting)
    begin = scene.begin.with_effects([Placed(VOCABULARY["joint_damping"], target, (0.0,))])
    twin, spent, linear = scene.twin, list[int](), ground.part.linearize(begin.variant)

    def fitted(goal: float) -> Refit:
        before = twin.simulated_transitions
        found = refit(ground.part, begin, linear=linear, target=goal)
        spent.append(twin.simulated_transitions - before)
        return found

    whole = fitted(math.inf)
    assert fitted(whole.loss * 1.01).loss == whole.loss
    hopeless = fitted(1e-6 * whole.loss)
    assert hopeless.loss >= whole.loss
    assert spent[2] < spent[1] == spent[0]


def test_of_one_effects_starts_the_best_is_fitted_in_full() -> None:
    scene = scene_of("joint_damping")
    ground, effect = Ground(scene.evidence, (VOCABULARY["joint_damping"],)), VOCABULARY["joint_damping"]
    base = ground.refit(scene.begin)
    state = State(scene.noise, scene.since, 1.0, base, NOTHING, base)
    groups = [[Placed(effect, t, (value,))] for t in effect.targets(scene.setting) for value in (0.01, 0.3)]
    full, after = ground.refits(state, base, groups, "refitting")
    keys = [r.hypothesis.placed[-1].key for r in full]
    assert len(keys) == len(set(keys))
    assert len(after.attempts) == len(groups)


# --- the whole ------------------------------------------------------------------------------------------------


def test_nothing_is_named_where_nothing_is_missing() -> None:
    gap = found(())
    assert not gap.found
    assert gap.effects == ()
    assert gap.where == ()
    assert gap.before == gap.after
    assert gap.reduced[0] == pytest.approx(1, abs=0.1)
    assert gap.declared["pole_mass"][2] == pytest.approx(hidden().declared["pole_mass"], rel=1e-3)


def placed(name: str, *values: float, target: str = "rail") -> Placed:
    return Placed(find_effect(name), target, values)


def test_a_finer_step_is_no_number_that_imitates() -> None:
    cogging = placed("joint_cogging", 0.1, 3.0, 0.0)
    free = Hypothesis((), (cogging, placed("joint_stiffness", 1.0, 0.0)))
    with_step = dataclasses.replace(free, placed=(*free.placed, Placed(find_effect("integration"), None, (0.001,))))
    assert beyond_free(with_step, Rules()) == beyond_free(free, Rules()) > 0


@pytest.mark.parametrize(
    ("name", "left", "told"), [("integration", 1.05, True), ("integration", 1.2, False), ("joint_damping", 1.05, False)]
)
def test_the_models_own_step_may_leave_more_of_a_small_gap(name: str, left: float, told: bool) -> None:
    """What it leaves is no more than noise then, and it claims nothing of the robot."""

    def fitted(reduced: float, *placed: Placed) -> Any:
        cost = Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3)
        return SimpleNamespace(cost=cost, hypothesis=Hypothesis((), placed))

    placed = Placed(VOCABULARY[name], None, (0.001,))
    assert accounts(fitted(left, placed), fitted(1.4), Rules()) == told


def test_a_load_is_told_of_the_outermost_of_bodies_that_tie() -> None:
    setting = scene_of().setting
    load, damping = VOCABULARY["payload"], VOCABULARY["joint_damping"]
    names = {n: Placed(load, n, (0.1, 0.0, 0.0, 0.0)) for n in load.targets(setting)}
    found = {n: tying._outward(setting, placed) for n, placed in names.items()}
    assert found["pole"] == found["cart"] + 1
    assert tying._outward(setting, Placed(damping, "hinge", (0.1,))) == 0


def test_many_numbers_may_leave_less_of_the_gap() -> None:
    rules = Rules(accounted=0.97, free=3)
    friction, spring = placed("joint_friction", 0.3), placed("joint_stiffness", 0.2, 0.0)
    ripple = placed("joint_cogging", 0.1, 6.0, 0.0)
    left = [allowance(Hypothesis((), p), rules) for p in ((friction,), (friction, spring), (ripple, spring))]
    assert left == pytest.approx([0.03, 0.03, 0.0075])
    family = tuple(placed("joint_friction", 0.1, target=j) for j in ("rail", "hinge", "a", "b", "c"))
    assert allowance(Hypothesis((), family), rules) == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("left", "reduced", "names", "enough"),
    [(0.04, 19.0, ("joint_friction",), True), (0.06, 1.3, ("joint_friction",), True),
     (0.06, 1.7, ("joint_friction",), False), (0.11, 1.3, ("joint_friction",), False),
     (0.06, 1.3, ("joint_cogging", "joint_stiffness"), False)],
)  # fmt: skip
def test_what_a_misjudged_noise_makes_is_no_rest(
    left: float, reduced: float, names: tuple[str, ...], enough: bool
) -> None:
    """Of a gap that is little more than the noise, an error of a tenth in σ is more than a twentieth."""
    base = refit(scene_of().evidence, scene_of().begin, iterations=0)
    few = tuple(placed(n, *[0.1] * len(find_effect(n).quantities(scene_of().setting, "rail"))) for n in names)
    excess = 1e3 * (reduced - 1)
    named = dataclasses.replace(
        base, hypothesis=Hypothesis((), few), cost=Cost(np.array([1e3 + excess]), np.zeros(1), 1e3)
    )
    missing = dataclasses.replace(base, cost=Cost(np.array([1e3 + excess / left]), np.zeros(1), 1e3))
    assert accounts(named, missing, Rules()) == enough


@pytest.mark.parametrize(
    ("names", "reduced", "enough"),
    [(("joint_friction",), 100.0, True), (("joint_cogging", "joint_stiffness"), 1.1, True),
     (("joint_cogging", "joint_stiffness"), 100.0, False)],
)  # fmt: skip
def test_many_numbers_account_for_nothing_while_much_remains(
    names: tuple[str, ...], reduced: float, enough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A far spring is imitated by a force, a coupling and a stiffness, up to a hundredth of the misfit.

    Unless what remains is the model's own step; and while it is not, what comes beside them must halve it.
    """
    base = refit(scene_of().evidence, scene_of().begin, iterations=0)
    many = tuple(placed(n, *[0.1] * len(find_effect(n).quantities(scene_of().setting, "rail"))) for n in names)
    named = dataclasses.replace(
        base, hypothesis=Hypothesis((), many), cost=Cost(np.array([1e3 * reduced]), np.zeros(1), 1e3)
    )
    wrong = dataclasses.replace(base, cost=Cost(np.array([1e9]), np.zeros(1), 1e3))
    assert accounts(named, wrong, Rules()) == enough
    assert most_left(named, Rules()) == (Rules().hopeless if enough else Rules().imitating)
    ground = Ground(scene_of().evidence, (VOCABULARY["joint_friction"],))
    for finer in (1.1, 100.0):
        last = SimpleNamespace(fit=SimpleNamespace(cost=SimpleNamespace(reduced=finer)))
        monkeypatch.setattr("dropo_torch.gap.accept.resolved", lambda *_, last=last, **__: last)
        assert accounts_finely(ground, named, wrong) == (enough or finer < 2)
        assert not accounts_finely(ground, named, named)


@pytest.mark.parametrize(
    ("own", "finer", "without", "enough"),
    [(1.0, 1.0, 400.0, True), (40.0, 1.0, 400.0, True), (40.0, 30.0, 400.0, False), (1.0, 1.0, 1.0, False)],
)  # fmt: skip
def test_a_rest_of_the_own_step_hides_no_small_effect_and_needs_none(
    own: float, finer: float, without: float, enough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A late sensor explains two thousandths of a gap, which is all that friction leaves but for the model's step.

    Unless a finer step leaves no more than noise without it.
    """

    def fitted(reduced: float) -> SimpleNamespace:
        return SimpleNamespace(cost=Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3), hypothesis=Hypothesis(()))

    monkeypatch.setattr(accept, "change_of_step", lambda *_: None)
    bare, fine = fitted(500), {True: fitted(without), False: fitted(finer)}
    ground = SimpleNamespace(rules=Rules(), part=None, resolved=lambda r: SimpleNamespace(fit=fine[r is bare]))
    assert accept.matters(ground, fitted(180_000), fitted(own), bare) == enough
    assert not accept.matters(ground, fitted(180_000), fitted(400), bare)


@pytest.mark.parametrize(("step", "friction", "named"), [(0.01, 2.0, True), (0.005, 4.0, False)])
def test_a_step_is_named_where_it_is_no_small_part_of_the_gap(step: float, friction: float, named: bool) -> None:
    """Four hundredths of it, or two thousandths: with either step friction leaves many times what noise makes."""
    truth = Effect("joint_friction", "rail", {"friction": friction})
    scene = prepare(load(simulate_truth(coarse(CART_POLE, step), [truth], 3, **SIZE)))
    own, finer = find_effect("joint_friction"), find_effect("integration")
    ground = Ground(scene.evidence, (own, finer), short=scene.noisy, few=16)
    state = start(ground, scene.begin)
    ground = ground.at(state)
    without = ground.refit(scene.begin.with_effects([Placed(own, "rail", (friction,))]))
    whole = ground.refit(without.hypothesis.with_effects([Placed(finer, None, (step / 8,))]))
    assert without.cost.reduced > 10
    assert not significant(whole.cost, ground.rules)
    assert accept.matters(ground, state.base, whole, without) == named
    assert accept.is_of_step(ground, without)
    assert not accept.is_of_step(ground, state.base)
    assert accept.step_shows(ground, state.base)


def test_what_only_a_finer_step_parts_are_no_ties() -> None:
    """Friction that is larger near rest, and plain friction: a step that is too coarse for it hides the peak."""
    peaked, plain = find_effect("joint_stribeck"), find_effect("joint_friction")
    law = {"coulomb": 0.06, "static": 0.094, "velocity": 0.49}
    scene = prepare(load(simulate_truth(TORQUE_ARM, [Effect("joint_stribeck", "elbow", law)], 4, **SIZE)))
    ground = Ground(scene.evidence, (peaked, plain), short=scene.noisy, few=16)
    state = start(ground, scene.begin)
    ground = ground.at(state)
    rival = ground.refit(scene.begin.with_effects([Placed(plain, "elbow", (0.06,))]))
    own = ground.refit(rival.hypothesis.instead(0, Placed(peaked, "elbow", (0.06, 0.066, 0.9))))
    assert ground.as_good(rival, own)
    assert not as_good(ground, dataclasses.replace(state, current=own), rival)


def test_a_step_that_only_named_effects_show_has_no_name() -> None:
    """Friction that is larger near rest, resolved by a step that is fine enough for the model without it."""
    law = dict(zip(("coulomb", "static", "velocity"), (0.0015, 0.0026, 0.52), strict=True))
    scene = prepare(load(simulate_truth(SERVO_ARM, [Effect("joint_stribeck", "wrist", law)], 3, **SIZE)))
    own, finer = find_effect("joint_stribeck"), find_effect("integration")
    ground = Ground(scene.evidence, (own, finer), short=scene.noisy, few=16)
    state = start(ground, scene.begin)
    ground = ground.at(state)
    without = ground.refit(scene.begin.with_effects([Placed(own, "wrist", (0.0015, 0.0022, 0.7))]))
    step = finer.quantities(scene.setting, None)[0].low
    whole = ground.refit(without.hypothesis.with_effects([Placed(finer, None, (step,))]))
    assert significant(without.cost, ground.rules)
    assert without.cost.excess - whole.cost.excess > 2 * ground.rules.least * state.base.cost.above(whole.cost)
    assert not accept.step_shows(ground, state.base)
    assert not accept.matters(ground, state.base, whole, without)
    assert accept.matters(ground, state.base, without, state.base)
    assert accept.is_done(ground, dataclasses.replace(state, current=without))


@pytest.mark.parametrize(
    ("best", "finer", "taken"),
    [("actuator_delay", 200.0, True), ("actuator_delay", 1.0, False), ("integration", 200.0, False)],
)
def test_a_family_takes_no_place_of_what_a_finer_step_makes_as_good(
    best: str, finer: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Late sensors, one for each column, may do what a model's step leaves beside a late command."""

    def fitted(reduced: float, *names: str) -> SimpleNamespace:
        placed = tuple(Placed(find_effect(n), None, (0.0,)) for n in names)
        cost = Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3)
        return SimpleNamespace(cost=cost, hypothesis=Hypothesis((), placed))

    single, family, late = fitted(300, best), fitted(4, *["sensor_delay"] * 4), find_effect("sensor_delay")
    monkeypatch.setattr(late, "targets", lambda setting: list("abcd"))
    monkeypatch.setattr(accept, "sound", lambda ground, found: found)
    monkeypatch.setattr(accept, "promising_families", lambda *_: [tuple(Placed(late, c, (0.0,)) for c in "abcd")])
    fine = {id(single): finer, id(family): 1.0}
    ground = SimpleNamespace(
        rules=Rules(), setting=None, focus=lambda current: None,
        refits=lambda state, current, groups, stage, known: ([family] if groups else [], state),
        resolved=lambda r: SimpleNamespace(fit=fitted(fine[id(r)])),
    )  # fmt: skip
    state = SimpleNamespace(current=fitted(12_000))
    found, _ = accept._among_several(ground, state, [], single, pairs=False)
    assert found is (family if taken else single)


@pytest.mark.parametrize(("name", "named"), [("integration", True), ("actuator_delay", False)])
def test_a_finer_step_may_leave_something(name: str, named: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """It removes most of what is left, a small part of the gap: it is no guess about the robot, and stands."""

    def fitted(reduced: float, *names: str) -> SimpleNamespace:
        placed = tuple(Placed(find_effect(n), None, (0.0,)) for n in names)
        cost = Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3)
        return SimpleNamespace(cost=cost, hypothesis=Hypothesis((), placed))

    monkeypatch.setattr(accept, "is_of_step", lambda *_: False)
    monkeypatch.setattr(accept, "step_shows", lambda *_: True)
    ground, without = SimpleNamespace(rules=Rules()), fitted(20, "joint_friction")
    assert accept.matters(ground, fitted(300_000), fitted(2.8, "joint_friction", name), without) == named
    monkeypatch.setattr(accept, "step_shows", lambda *_: False)
    assert not accept.matters(ground, fitted(300_000), fitted(2.8, "joint_friction", name), without)


@pytest.mark.parametrize(("name", "needed"), [("integration", False), ("actuator_delay", True)])
def test_an_effect_that_is_a_finer_step_needs_no_other_one(
    name: str, needed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What leaves no more than noise with it leaves no more with a finer step, wherever else a fit with one ends."""

    def fitted(reduced: float, *names: str) -> SimpleNamespace:
        placed = tuple(Placed(find_effect(n), None, (0.0,)) for n in names)
        cost = Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3)
        return SimpleNamespace(cost=cost, hypothesis=Hypothesis((), placed))

    monkeypatch.setattr(accept, "is_of_step", lambda *_: False)
    without, whole = fitted(40.0, "joint_friction"), fitted(1.0, "joint_friction", name)
    assert accept.matters(SimpleNamespace(rules=Rules()), fitted(180_000), whole, without) == needed


@pytest.mark.parametrize(("finer", "of_step"), [(1.08, False), (1.06, False), (1.01, True)])
def test_of_what_is_no_more_than_noise_a_finer_step_must_leave_less(
    finer: float, of_step: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second moment of inertia, of a gap that is little more than the noise: the first leaves no more than that."""

    def leaving(reduced: float) -> SimpleNamespace:
        return SimpleNamespace(cost=Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3), hypothesis=Hypothesis(()))

    monkeypatch.setattr(accept, "change_of_step", lambda *_: None)
    ground = SimpleNamespace(rules=Rules(), part=None, resolved=lambda _: SimpleNamespace(fit=leaving(finer)))
    assert accept.is_of_step(ground, leaving(1.08)) == of_step


@pytest.mark.parametrize(("stale", "fitted", "of_step"), [(20.0, 1.0, True), (20.0, 15.0, False), (300.0, 1.0, False)])
def test_what_a_finer_step_mostly_explains_is_fitted_there(
    stale: float, fitted: float, of_step: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Derivatives that the own step distorts may leave more than noise where the finer step's own do not."""

    def leaving(reduced: float) -> SimpleNamespace:
        cost = Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3)
        return SimpleNamespace(cost=cost, hypothesis=Hypothesis(()), linear=None)

    last = SimpleNamespace(fit=leaving(stale), evidence=None)
    monkeypatch.setattr(accept, "change_of_step", lambda *_: None)
    monkeypatch.setattr(accept, "refit", lambda *_, **__: leaving(fitted))
    ground = SimpleNamespace(rules=Rules(), part=None, resolved=lambda _: last)
    assert accept.is_of_step(ground, leaving(500.0)) == of_step


def test_many_numbers_that_leave_more_than_the_step_imitate() -> None:
    """A spring from far away is imitated by a force and a ripple, up to four times the noise."""
    spring, ripple = placed("joint_stiffness", 0.0, 0.0), placed("joint_cogging", 0.0, 6.0, 0.0)
    case, evidence = sharp()
    right = refit(evidence, true(case).with_effects((spring, ripple)))
    assert right.cost.reduced > 3
    assert not imitates(Ground(evidence, ()), right)
    lacking = refit(evidence, Hypothesis(tuple(case.declared.values()), (spring, ripple)))
    assert imitates(Ground(evidence, ()), lacking)
    assert not imitates(Ground(evidence, ()), refit(evidence, Hypothesis(tuple(case.declared.values()), (spring,))))


def test_coupling_of_joints_cannot_push_them_apart() -> None:
    setting = scene_of().setting
    effect = find_effect("joint_coupling")
    assert all(effect.quantities(setting, t)[0].low == 0 for t in ("rail", "hinge"))


def test_friction_that_is_larger_at_rest_is_found_from_plain_friction() -> None:
    stribeck, setting = find_effect("joint_stribeck"), scene_of().setting
    assert stribeck.extends(setting, placed("joint_damping", 0.3)) == []
    for begun in stribeck.extends(setting, placed("joint_friction", 0.3)):
        assert begun[0] < 0.3 < begun[1]
    truth = Effect("joint_stribeck", "rail", {"coulomb": 0.2, "static": 0.45, "velocity": 0.3})
    gap = search(simulate_truth(CART_POLE, [truth], 3, **SIZE), ("joint_friction", "joint_damping", "joint_stribeck"))
    assert [e.effect for e in gap.effects] == ["joint_stribeck"]
    assert gap.effects[0].parameters["coulomb"].value == pytest.approx(0.2, rel=0.05)


def test_friction_that_is_larger_at_rest_is_told_from_what_the_step_leaves() -> None:
    truth = Effect("joint_stribeck", "shoulder", {"coulomb": 0.3, "static": 0.4, "velocity": 0.3})
    case = simulate_truth(TORQUE_ARM, [truth], 3, noise=0.25, **SIZE)
    gap = search(case, ("joint_friction", "joint_stribeck"))
    assert [e.effect for e in gap.effects] == ["joint_stribeck"]


def test_what_is_absurd_gives_way_to_what_contains_it() -> None:
    """A heavy tool shifts the center of mass beyond the hand itself: it is a tool, not a shift."""
    tool = Effect("payload", "hand", {"mass": 0.8, "x": 0.15, "y": 0.0, "z": -0.016})
    only_the_best = dataclasses.replace(Rules(), tried=dataclasses.replace(Rules().tried, refits=1))
    case = simulate_truth(SERVO_ARM, [tool], 3, **SIZE)
    gap = search(case, ("center_of_mass", "payload"), rules=only_the_best)
    assert next(r.effect for r in gap.ranking) == "payload"
    assert [(e.effect, e.target) for e in gap.effects] == [("payload", "hand")]
    assert gap.effects[0].parameters["mass"].value == pytest.approx(0.8, rel=0.02)


def test_a_payload_begins_where_it_shifts_the_center_of_mass_as_far() -> None:
    payload, setting, shift = find_effect("payload"), scene_of().setting, np.array([0.004, 0.0, -0.003])
    moved = Placed(find_effect("center_of_mass"), "pole", tuple(shift))
    body = setting.model.body("pole").id
    starts = payload.extends(setting, moved)
    assert len(starts) == 5
    for values in starts:
        model = copy.copy(setting.model)
        payload.apply(model, "pole", values)
        np.testing.assert_allclose(model.body_ipos[body] - setting.model.body_ipos[body], shift, atol=1e-9)
    assert payload.extends(setting, placed("joint_friction", 0.3)) == []


@pytest.mark.parametrize(
    "names", [("joint_damping",), ("actuator_delay",), ("actuator_lag",), ("joint_damping", "actuator_lag")]
)
def test_hidden_effects_are_named(names: tuple[str, ...]) -> None:
    gap, case = found(names), hidden(*names)
    assert {(e.effect, e.target) for e in gap.effects} == {(e.name, e.target) for e in case.effects}
    for truth in case.effects:
        (told,) = [e for e in gap.effects if e.effect == truth.name]
        for number, value in truth.parameters.items():
            strength = told.parameters[number]
            assert strength.value == pytest.approx(value, rel=0.05)
            half = 0.5 * (strength.high - strength.low)
            assert strength.low - half <= value <= strength.high + half
            assert half < 0.05 * value
        assert told.share_of_gap > 0.3
        assert told.sentence
    assert gap.declared["pole_mass"][2] == pytest.approx(case.declared["pole_mass"], rel=5e-3)
    assert gap.reduced[0] > 50 > 1.2 > gap.reduced[1]


@pytest.mark.parametrize("names", [("joint_damping",), ("actuator_delay",), ("joint_damping", "actuator_lag")])
def test_held_out_scores_fall_to_noise(names: tuple[str, ...]) -> None:
    gap = found(names)
    assert gap.before.mse > 3 * gap.noise_floor.mse
    assert gap.after.mse < 1.3 * gap.noise_floor.mse
    assert gap.before.log_likelihood < gap.after.log_likelihood
    assert gap.after.log_likelihood == pytest.approx(gap.noise_floor.log_likelihood, rel=0.05)
    assert gap.after.rollout_rmse < 0.1 * gap.before.rollout_rmse


PUSHED = Effect("external_force", "cart", {"x": 3.0, "y": 0.0, "z": 0.0})
BIASED = Effect("actuator_bias", "push", {"force": 0.3})
COARSE = Effect("integration", None, {"timestep": 0.01})
ON_AXIS = Effect("payload", "hand", {"mass": 0.15, "x": 0.1, "y": 0.0, "z": 0.0})
PUSHES = ("joint_stiffness", "external_force", "integration", "gravity_tilt", "actuator_bias", "actuator_gain")


@pytest.mark.parametrize(
    ("system", "effects", "known", "named", "tied"),
    [
        (CART_POLE, [PUSHED], PUSHES, ("actuator_bias", "push"), ("external_force", "cart")),
        (CART_POLE, [BIASED], PUSHES, ("actuator_bias", "push"), ("external_force", "cart")),
        (coarse(CART_POLE, 0.01), [COARSE, PUSHED], PUSHES, ("actuator_bias", "push"), ("external_force", "cart")),
        (
            CART_POLE, [Effect("actuator_damping", "push", {"damping": 0.005})],
            ("joint_damping", "joint_friction", "fluid_drag", "actuator_damping"),
            ("joint_damping", "rail"), ("actuator_damping", "push"),
        ),
        (SERVO_ARM, [ON_AXIS], ("payload", "center_of_mass", "inertia"), ("payload", "fore"), ("payload", "hand")),
    ],
    ids=["force", "bias", "coarse", "damping", "payload"],
)  # fmt: skip
def test_whatever_explains_a_log_as_well_is_told(
    system: System, effects: list[Effect], known: tuple[str, ...], named: tuple[str, str], tied: tuple[str, str]
) -> None:
    """With more numbers or fewer, also once ``integration`` is named."""
    gap = search(simulate_truth(system, effects, 3, **SIZE), known)
    assert len(gap.effects) == len(effects)
    (told,) = [e for e in gap.effects if e.effect != "integration"]
    assert {(told.effect, told.target), *told.indistinguishable_from} == {named, tied}
    assert len(told.indistinguishable_from) == 1
    assert (told.effect, told.target) == named or named[0] == tied[0]  # of the same at two places, either


def test_what_the_vocabulary_lacks_has_no_name() -> None:
    gap = found(("joint_presliding",), WITHOUT_FRICTION)
    assert gap.found
    (told,) = gap.effects
    assert (told.effect, told.target) == ("unnamed", "hinge")
    assert told.parameters["force"].value > 0.05
    assert gap.after == gap.before
    assert gap.declared["pole_mass"][1] == gap.declared["pole_mass"][2]


def test_unnamed_force_has_the_unit_of_its_joint() -> None:
    case = simulate_truth(CART_POLE, [Effect("uneven_friction", "rail", UNEVEN)], 3, **SIZE)
    (told,) = search(case, ("joint_stiffness",)).effects
    assert (told.effect, told.target) == ("unnamed", "rail")
    assert told.parameters["force"].unit == "N"


FLAT_ARM = System(
    name="flat_arm",
    xml="""
<mujoco>
  <option integrator="RK4" timestep="0.002" gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="link"><joint name="yaw" type="hinge" axis="0 0 1" damping="0.001"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .4 0 0" mass="1"/>
      <body name="tip" pos=".02 0 0"><geom type="sphere" size=".02" mass=".1"/></body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="yaw"/></actuator>
</mujoco>""",
    declared={"tip_mass": mass("tip", 0.1)},
    commands=(Command(0.3, band=(0.5, 2.0)),),
    start={"yaw": (1.0, 1.0)},
    scales={"yaw": Scale(0.3, 1.0, 0.06)},
)


def test_inertia_that_freezes_the_model_has_no_name() -> None:
    """A motor with hardly any torque: a rotor of twenty times the arm's inertia leaves little, and has no skill."""
    case = simulate_truth(FLAT_ARM, [Effect("actuator_gain", "motor", {"gain": 0.01})], 3, **SIZE)
    gap = search(case, ("armature",))
    assert [e.effect for e in gap.effects] == ["unnamed"]
    assert gap.verdict == "unnamed"
    assert "armature of yaw fits best at the bound" in gap.refused
    assert gap.after == gap.before
    (tried,) = {r.effect for r in gap.ranking}
    assert tried == "armature"


def test_what_is_no_better_than_constant_velocity_has_no_name() -> None:
    def rollout(error: float) -> Score:
        return Score(0.0, 0.0, error)

    rules, floor = Rules().sound, rollout(0.001)
    assert has_skill(rollout(0.01), floor, 0.02, rules)
    assert not has_skill(rollout(0.03), floor, 0.02, rules)
    assert not has_skill(rollout(float("inf")), floor, 0.02, rules)
    assert has_skill(rollout(0.0011), floor, 0.0009, rules)  # nothing accelerates, and the model is perfect


@pytest.mark.parametrize(("missing", "is_absurd"), [(-0.01, False), (-0.03, True), (0.02, False)])
def test_number_is_absurd_that_pushes_beyond_its_bound(missing: float, is_absurd: bool) -> None:
    """The model's own damping is 0.01: that none is there is a number like others, that there is less is not."""
    case = simulate_truth(CART_POLE, [Effect("joint_damping", "hinge", {"damping": missing})], 3, **SIZE)
    scene = prepare(load(case))
    begin = Hypothesis((case.declared["pole_mass"],), (placed("joint_damping", 0.0, target="hinge"),))
    found = list(absurd(scene.evidence, refit(scene.evidence, begin), Rules().sound))
    assert [p.key for p, _ in found] == [("joint_damping", "hinge")] * is_absurd
    assert all("damping of -0.01 N·m·s/rad" in reason for _, reason in found)


def test_a_number_that_is_at_a_bound_on_all_windows_takes_no_name() -> None:
    """The search judges on some windows; on all of them, what it named may end at a bound."""
    case = simulate_truth(CART_POLE, [Effect("joint_damping", "hinge", {"damping": -0.03})], 3, **SIZE)
    scene, few = prepare(load(case)), [VOCABULARY["joint_damping"]]
    searched_for = name(scene, effects=few)
    at_bound = Hypothesis((case.declared["pole_mass"],), (placed("joint_damping", -0.01, target="hinge"),))
    fitted = refit(scene.evidence, at_bound)
    naming = dataclasses.replace(
        searched_for, gap=True, named=True, refused="", final=fitted, ties=((),), shares=(1.0,)
    )
    gap = outcome.make_result(scene, naming, 0.0)
    assert gap.verdict == "unnamed"
    assert "damping of -0.01 N·m·s/rad" in gap.refused


def test_a_member_of_a_family_that_is_at_a_bound_takes_its_own_name_only() -> None:
    missing = [("hinge", -0.03), ("rail", 2.0)]
    effects = [Effect("joint_damping", joint, {"damping": value}) for joint, value in missing]
    case = simulate_truth(CART_POLE, effects, 3, **SIZE)
    scene = prepare(load(case))
    both = Hypothesis(
        (case.declared["pole_mass"],),
        (placed("joint_damping", -0.01, target="hinge"), placed("joint_damping", 2.0, target="rail")),
    )
    naming = dataclasses.replace(
        name(scene, effects=[VOCABULARY["armature"]]), gap=True, named=True, family=True, refused="",
        final=refit(scene.evidence, both), ties=((), ()), shares=(1.0, 0.5),
    )  # fmt: skip
    gap = outcome.make_result(scene, naming, 0.0)
    assert [(e.effect, e.target) for e in gap.effects] == [("joint_damping", "rail")]


def test_what_named_effects_leave_is_said_first() -> None:
    """Friction beside an integration gap, which the vocabulary lacks: friction has its name, and the step is blamed."""
    truth = Effect("joint_friction", "rail", {"friction": 2.0})
    case = simulate_truth(coarse(CART_POLE, 0.01), [truth], 3, **SIZE)
    gap = search(case, ("joint_friction", "joint_damping", "actuator_lag"))
    assert [(e.effect, e.target) for e in gap.effects] == [("joint_friction", "rail")]
    assert gap.remaining is None
    assert gap.own_step == pytest.approx((gap.own_step[0], gap.reduced[1]))
    assert gap.own_step[0] > 3 > gap.own_step[1]
    assert "the model's own step leaves" in answer(gap)[0]
    assert "a finer step" in gap.document()["verdict_reason"]


def test_a_small_part_of_a_large_gap_is_named_where_it_leaves_nothing() -> None:
    """A delay, and beside it a damping that is 0.04 % of the misfit: without it the log is still not explained."""
    truth = [
        Effect("actuator_delay", "push", {"delay": 0.03}), Effect("joint_damping", "hinge", {"damping": 0.0005})
    ]  # fmt: skip
    case = simulate_truth(CART_POLE, truth, 3, **SIZE)
    gap = search(case, ("actuator_delay", "actuator_lag", "joint_damping", "actuator_gain"))
    assert {(e.effect, e.target) for e in gap.effects} == {(e.name, e.target) for e in truth}
    damping = next(e for e in gap.effects if e.effect == "joint_damping")
    assert damping.share_of_gap < Rules().least
    assert damping.parameters["damping"].value == pytest.approx(0.0005, rel=0.02)
    assert gap.verdict == "explained"


@pytest.mark.parametrize(("excess", "done"), [(30.0, True), (98.0, False), (400.0, False)])
def test_search_goes_on_while_what_is_left_is_too_much_to_be_named(
    excess: float, done: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gap of 50 standard deviations of χ²: a tenth of it is no more than noise may be, and yet too much."""

    def fitted(excess: float) -> SimpleNamespace:
        cost = Cost(np.full(20, 10 + excess / 20), np.zeros(20), 200.0)
        return SimpleNamespace(cost=cost, hypothesis=Hypothesis(()))

    monkeypatch.setattr(accept, "step_shows", lambda *_: True)
    assert fitted(98.0).cost.excess == pytest.approx(4.9 * fitted(98.0).cost.sigma)
    ground = SimpleNamespace(rules=Rules(least_reduced=1.0), clears=lambda base, current: False)
    assert is_done(ground, SimpleNamespace(base=fitted(1000.0), current=fitted(excess))) == done


@dataclasses.dataclass(frozen=True)
class Judged:
    """What a search stands on, reduced to how sure a name is on how many windows."""

    chances: dict[int, float]
    few: int = 40
    caps: float = 1.0
    comparisons: int = 10
    rules: Rules = dataclasses.field(default_factory=Rules)
    windows: range = range(120)
    robust: bool = True
    report: Callable = lambda *_: None

    @property
    def evidence(self) -> Judged:
        return self

    @property
    def most(self) -> int:
        return self.few

    def chance(self, _whole: SimpleNamespace, _without: SimpleNamespace) -> float:
        return self.chances[self.few]

    def refit(self, hypothesis: Hypothesis, iterations: int) -> SimpleNamespace:
        excess = {0: 5000.0, 1: 20.0}[len(hypothesis.placed)] * self.few / 40
        return SimpleNamespace(hypothesis=hypothesis, cost=Cost(np.array([excess + 10]), np.zeros(1), 10.0))


@pytest.mark.parametrize(
    ("few", "every", "named"),
    [(0.0009, None, True), (0.0011, 0.0004, True), (0.0011, 0.0006, False), (0.09, 1e-9, True), (0.11, None, False)],
)
def test_all_windows_decide_where_few_leave_it_open(few: float, every: float | None, named: bool) -> None:
    ground = Judged({40: few, 120: every})
    without, whole = (ground.refit(Hypothesis((), effects), 1) for effects in ((), (placed("joint_friction", 0.3),)))
    assert is_needed(ground, SimpleNamespace(base=without), whole, without) == named


@pytest.mark.parametrize(("left", "named"), [(1.0, True), (1.04, True), (1.2, False)])
@pytest.mark.parametrize("inflated", [0.0, 30.0])
def test_noise_that_contacts_inflate_is_no_rest(
    left: float, named: bool, inflated: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether names account for a gap does not depend on by how much noise before a contact widens what follows."""

    def fitted(reduced: float, *effects: Placed) -> SimpleNamespace:
        penalty = np.full(120, inflated)
        return SimpleNamespace(
            cost=Cost(np.full(120, 15 * reduced), penalty, 1800.0), hypothesis=Hypothesis((), effects)
        )

    base, whole = fitted(2.0), fitted(left, placed("joint_friction", 0.3))
    assert accounts(whole, base, Rules()) == named
    assert whole.cost.left_of(base.cost) == pytest.approx(left - 1)
    monkeypatch.setattr(accept, "step_shows", lambda *_: True)
    ground = SimpleNamespace(rules=Rules(), clears=lambda base, current: False)
    assert is_done(ground, SimpleNamespace(base=base, current=whole)) == named


def test_what_adds_up_in_open_loop_is_said() -> None:
    """However little short windows show: an open-loop error far above that of noise is no full explanation."""
    names = ("joint_damping",)
    assert found(names).verdict == "explained"
    gap = search(hidden(*names), FEW, rules=Rules(sound=Sound(astray=0.01)))
    assert gap.verdict == "partly explained"
    assert gap.remaining.open_loop == pytest.approx(gap.after.rollout_rmse / gap.noise_floor.rollout_rmse)
    assert "open-loop errors are" in gap.document()["verdict_reason"]


def test_log_without_velocities_gives_no_false_alarm() -> None:
    log = hidden().trajectories
    positions = dataclasses.replace(
        log, observations=log.observations[:, :2], next_observations=log.next_observations[:, :2]
    )
    case = dataclasses.replace(hidden(), trajectories=positions, config={**hidden().config, "observation": ["qpos"]})
    with contextlib.suppress(InputError):
        assert not search(case, ("joint_damping",)).found


def test_masked_column_is_not_compared() -> None:
    case = hidden()
    spoiled = case.trajectories.next_observations.copy()
    spoiled[:, 0] += 0.01 * np.sin(np.arange(len(spoiled)))
    log = dataclasses.replace(case.trajectories, next_observations=spoiled)
    case = dataclasses.replace(
        case, trajectories=log, config={**case.config, "mask": ["rail.position"], "noise": list(case.noise)}
    )
    assert not search(case, ("joint_friction",)).found


def test_whole_vocabulary_names_one_effect(cart: Path) -> None:
    """The first run of :func:`cart` searches with all effects."""
    document = json.loads((cart / "out" / "gap.json").read_text())
    (told,) = document["effects"]
    assert (told["effect"], told["target"]) == ("joint_damping", "hinge")
    assert told["parameters"]["damping"]["value"] == pytest.approx(0.02, rel=0.05)
    assert {"effect": "sensor_delay", "target": "hinge.position"} not in document["cannot_judge"]


NUMBER = (int, float)
CONTRACT: dict[str, Any] = {
    "schema": str, "verdict": str, "verdict_reason": str, "remaining": (dict, type(None)), "where": list,
    "effects": list, "forces": (list, type(None)), "disturbances": list, "gap": dict,
    "next_experiment": (str, type(None)), "declared": dict,
    "noise": dict, "chi2_per_degree": dict, "own_step": (list, type(None)), "unfinished": (str, type(None)),
    "ranking": list, "left_out": list, "cannot_judge": list, "symbolic": (str, type(None)),
    "notes": list, "backend": str, "simulated_transitions": int, "seconds": float, "seed": int,
}  # fmt: skip


@pytest.mark.parametrize(
    "arguments",
    [((),), (("joint_damping", "actuator_lag"),), (("joint_presliding",), WITHOUT_FRICTION)],
    ids=["null", "two", "unnamed"],
)
def test_document_keeps_its_contract(arguments: tuple) -> None:
    document = json.loads(json.dumps(plain_numbers(found(*arguments).document()), allow_nan=False))
    assert document["schema"] == "dropo-torch/gap/1"
    assert set(document) == set(CONTRACT)
    assert not [key for key, kind in CONTRACT.items() if not isinstance(document[key], kind)]
    assert set(document["gap"]) == {"before", "after", "noise_floor"}
    for numbers in document["gap"].values():
        assert set(numbers) == {"mse", "log_likelihood", "rollout_rmse"}
        assert all(isinstance(v, NUMBER) for v in numbers.values())
    for e in document["effects"]:
        assert set(e) == {"effect", "target", "parameters", "share_of_gap", "indistinguishable_from"}
        assert 0 <= e["share_of_gap"] <= 1
        assert all(set(s) == {"value", "low", "high", "unit"} for s in e["parameters"].values())
        assert all(isinstance(s["value"], NUMBER) for s in e["parameters"].values())
    for place in document["where"]:
        assert set(place) == {"kind", "name", "share", "when"}
        assert place["kind"] in ("joint", "body", "actuator", "sensor", "contact", "world")
        assert 0 <= place["share"] <= 1
    shares = [place["share"] for place in document["where"]]
    assert shares == sorted(shares, reverse=True)
    assert all(set(r) == {"effect", "target", "values", "left", "round", "together"} for r in document["ranking"])
    assert set(document["declared"]["pole_mass"]) == {"given", "alone", "with_effects", "low", "high"}
    assert list(document["noise"]) == ["rail.position", "hinge.position", "rail.velocity", "hinge.velocity"]
    assert set(document["chi2_per_degree"]) == {"before", "after"}
    assert document["verdict"] == {0: "no gap", 1: "unnamed", 2: "explained"}[len(document["effects"])]
    assert document["verdict_reason"]
    assert document["remaining"] is None


def test_body_that_only_turns_is_no_body_at_rest() -> None:
    """The first link of an arm turns about its own center: what changes its inertia shows, a force on it does not."""
    case = simulate_truth(TORQUE_ARM, [Effect("armature", "yaw", {"armature": 0.008})], 3, **SIZE)
    setting = prepare(load(case)).setting
    assert {e for e in VOCABULARY if "turret" in VOCABULARY[e].targets(setting)} == {
        "payload", "center_of_mass", "inertia",
    }  # fmt: skip
    gap = search(case, ("armature", "joint_friction", "inertia", "payload"))
    (told,) = gap.effects
    assert {(told.effect, told.target), *told.indistinguishable_from} >= {
        ("armature", "yaw"), ("inertia", "turret"), ("payload", "turret"),
    }  # fmt: skip


def test_every_key_of_gap_json_is_documented() -> None:
    text = (Path(__file__).parents[1] / "docs" / "gap.md").read_text()
    assert not [key for key in CONTRACT if f"`{key}`" not in text]
    assert not [name for name in FILES if f"`{name}`" not in text]
    assert not [f"{g}{f.name}" for g, f in thresholds() if f"`{g}{f.name}`" not in text]


def thresholds() -> list[tuple[str, dataclasses.Field]]:
    """Every threshold, after the name of its group and a dot."""
    groups = {f.name: getattr(Rules(), f.name) for f in dataclasses.fields(Rules)}
    nested = {g: v for g, v in groups.items() if dataclasses.is_dataclass(v)}
    own = [("", f) for f in dataclasses.fields(Rules) if f.name not in nested]
    return own + [(f"{g}.", f) for g, v in nested.items() for f in dataclasses.fields(v)]


@pytest.mark.parametrize("threads", [1, 2])
def test_result_is_reproducible_and_independent_of_threads(threads: int) -> None:
    again = search(hidden("joint_damping"), FEW, threads=threads)
    assert lasting(again) == lasting(found(("joint_damping",)))
    assert again.simulated_transitions == found(("joint_damping",)).simulated_transitions


# --- the log --------------------------------------------------------------------------------------------------


def test_windows_share_no_measurement_and_cross_no_end() -> None:
    problem = load(hidden())
    log, length = problem.trajectories, 30
    windows = cut_windows(log, problem.observation, length)
    assert len(windows) == 4 * (100 // (length + 1))
    observed = problem.observation.observed(log.observations)
    ends = problem.observation.observed(log.next_observations)
    for measured, episode, step in zip(windows.measured, windows.episodes, windows.steps, strict=True):
        row = 100 * episode + step
        assert np.array_equal(measured[:-1], observed[row : row + length])
        assert np.array_equal(measured[-1], ends[row + length - 1])
    assert len(cut_windows(log, problem.observation, 101)) == 0


REMEMBERING = [
    Effect("actuator_delay", "push", {"delay": 0.025}), Effect("actuator_lag", "push", {"time_constant": 0.03}),
    Effect("actuator_backlash", "push", {"width": 0.6}),
]  # fmt: skip


@pytest.mark.parametrize("truth", REMEMBERING, ids=lambda e: e.name)
def test_what_was_commanded_before_the_log_is_no_gap(truth: Effect) -> None:
    """A log that begins in motion: until then the commands were zero, and are not in it."""
    case = simulate_truth(CART_POLE, [truth], 4, before=Before(quiet=True), **SIZE)
    gap = search(case, (*FEW, "actuator_backlash"))
    assert [(e.effect, e.target) for e in gap.effects] == [(truth.name, truth.target)]
    ((number, value),) = truth.parameters.items()
    told = gap.effects[0].parameters[number]
    half = 0.5 * (told.high - told.low)
    assert told.low - half <= value <= told.high + half
    assert half < 0.01 * value
    assert gap.reduced[1] == pytest.approx(1, abs=0.15)
    assert gap.after.log_likelihood > gap.noise_floor.log_likelihood - 25


@pytest.mark.parametrize("truth", REMEMBERING, ids=lambda e: e.name)
def test_windows_whose_commands_are_known_are_predicted_as_in_the_whole_log(truth: Effect) -> None:
    scene, hypothesis = scene_of(), true(dataclasses.replace(hidden(), effects=(truth,)))
    whole = cut_windows(scene.train, scene.setting.observation, 4, stride=1)
    late = whole.select((whole.steps >= 37) & (whole.episodes == 0))
    cut = dataclasses.replace(late, steps=late.steps - 37, commands=late.commands[:1, 37:], episodes=0 * late.episodes)
    known = scene.twin.knows(hypothesis.variant, cut)
    assert 0 < np.argmax(known) < 40
    assert known[np.argmax(known) :].all()
    (in_whole,), (in_cut,) = (scene.twin.predict([hypothesis.variant], w)[0] for w in (late, cut))
    np.testing.assert_allclose(in_cut[known], in_whole[known], atol=1e-4)
    assert np.abs(in_cut[0] - in_whole[0]).max() > 1e-3


# --- the noise ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [(), ("joint_damping",), ("actuator_lag",), ("joint_friction",)])
def test_noise_is_estimated_beside_a_missing_effect(names: tuple[str, ...]) -> None:
    assert scene_of(*names).noise == pytest.approx(np.array(hidden(*names).noise), rel=0.35)


LATE = Effect("sensor_delay", "hinge.position", {"delay": 0.004})


def test_noise_beside_what_is_named_is_that_of_the_log() -> None:
    """A late sensor passes for noise until it is named."""
    case = simulate_truth(CART_POLE, [LATE, DAMPING], 5, **SIZE)
    assert prepare(load(case)).noise[1] > 2 * case.noise[1]
    gap = search(case, ("joint_damping", "joint_stiffness", "actuator_gain", "sensor_delay"))
    assert {(e.effect, e.target) for e in gap.effects} == {(e.name, e.target) for e in (LATE, DAMPING)}
    assert gap.noise == pytest.approx(case.noise, rel=0.15)
    assert gap.reduced[1] == pytest.approx(1, abs=0.15)
    assert gap.after.log_likelihood > gap.noise_floor.log_likelihood - 25
    assert gap.after.rollout_rmse < 1.1 * gap.noise_floor.rollout_rmse


@pytest.mark.parametrize("factor", [0.4, 1.0, 3.0])
def test_noise_is_what_a_right_model_leaves(factor: float) -> None:
    """Whatever it was taken for; and of a wrong model it is no less."""
    scene, truth = scene_of(), np.array(hidden().noise)
    wrong = truth * np.array([factor, 1.0, 1.0, 1 / factor])
    fitted = refit(dataclasses.replace(scene.evidence, noise=wrong), true(hidden()), iterations=3)
    assert noise_left(fitted, wrong, Rules()) == pytest.approx(truth, rel=0.12)
    lacking = refit(scene_of("joint_damping").evidence, scene.begin, iterations=3)
    left, told = noise_left(lacking, scene_of("joint_damping").noise, Rules()), hidden("joint_damping").noise
    assert (left > 0.9 * np.array(told)).all()


def test_what_shows_in_the_first_rows_of_one_episode_is_found() -> None:
    """Searches begin where delays and lags know their commands; if they find nothing, the rows before are looked at."""
    case = hidden()
    log = case.trajectories
    first = np.flatnonzero(log.terminals)[0] + 1
    pushed = log.next_observations.copy()
    pushed[first : first + 5] += 0.05 * log.next_observations.std(0)
    later = log.observations.copy()
    later[first + 1 : first + 6] = pushed[first : first + 5]
    jolt = dataclasses.replace(
        case, trajectories=dataclasses.replace(log, observations=later, next_observations=pushed)
    )
    scene = prepare(load(jolt))
    rare = outstanding(scene, scene.evidence, true(case))
    assert rare is not None
    assert 0 in rare.windows.steps[rare.windows.episodes == 1]
    assert outstanding(scene_of(), scene_of().evidence, true(case)) is None
    for effects in (FEW, ("actuator_delay",)):  # also where nothing is left to look for
        assert [e.effect for e in search(jolt, effects).effects] == ["unnamed"]


def test_names_that_make_unseen_predictions_worse_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they leave more than noise: friction that is taken for damping, if damping predicted worse than nothing."""
    loose = Rules(accounted=0.3)
    named = search(hidden("joint_friction"), ("joint_damping",), rules=loose)
    assert named.verdict == "partly explained"
    known = outcome.score

    def perfect(*arguments: Any) -> Score:
        return dataclasses.replace(known(*arguments), rollout_rmse=0.0)

    monkeypatch.setattr(outcome, "score", perfect)
    refused = search(hidden("joint_friction"), ("joint_damping",), rules=loose)
    assert refused.verdict == "unnamed"
    assert "worse than without them" in refused.document()["verdict_reason"]
    assert search(hidden("joint_damping"), ("joint_damping",), rules=loose).verdict == "explained"


def test_windows_that_stand_out_tell_no_noise() -> None:
    """A rest in a fifth of the windows, beside a right model."""
    scene, truth = scene_of(), np.array(hidden().noise)
    fitted = refit(dataclasses.replace(scene.evidence, noise=truth), true(hidden()), iterations=3)
    residual = fitted.residual.copy()
    residual[::5] *= 3.0
    worse = dataclasses.replace(fitted, residual=residual)
    assert noise_left(worse, truth, Rules()) == pytest.approx(noise_left(fitted, truth, Rules()), rel=0.05)


@pytest.mark.parametrize("factor", [0.4, 3.0])
def test_noise_beside_a_right_model_is_found_from_above_and_from_below(factor: float) -> None:
    scene, truth = scene_of(), np.array(hidden().noise)
    evidence = dataclasses.replace(scene.evidence, noise=factor * truth)
    fitted = refit(evidence, true(hidden()), iterations=3)
    assert noise_beside(evidence, scene.short, fitted) == pytest.approx(truth, rel=0.15)


def test_windows_in_which_a_force_jumps_are_no_noise() -> None:
    rng = np.random.default_rng(0)
    slope, truth = rng.standard_normal((160, 14, 5)), np.tile([1.0, 3.0], 7)
    residual = truth * rng.standard_normal((160, 14)) + np.einsum("wnq,wq->wn", slope, rng.standard_normal((160, 5)))
    residual[:60] += 30 * rng.standard_normal((60, 14))
    relative, unsure = _relative_noise(residual, slope, np.ones(residual.shape, dtype=bool), 2)
    assert relative == pytest.approx([1, 3], rel=0.1)
    assert (np.abs(relative / [1, 3] - 1) < 3 * unsure).all()
    assert unsure == pytest.approx(0.03, abs=0.015)


def test_noise_beside_a_late_sensor_is_that_of_the_log() -> None:
    """What it shows first is from before a window: that this is not compared is no sign of little noise."""
    late = Effect("sensor_delay", "wrist.position", {"delay": 0.003})
    recording = make_recording(SERVO_ARM, [late], 3, episodes=8, transitions=150)
    fine = dataclasses.replace(recording, noise=np.repeat([2e-5, 5e-3], 3))
    case = make_case(SERVO_ARM, [late], fine, name="late", kind="single")
    scene = prepare(load(case))
    assert free_forces(scene.twin, scene.short, true(case).variant).noise == pytest.approx(case.noise, rel=0.1)


def test_short_windows_tell_no_noise_of_sensors_that_are_late_by_most_of_them() -> None:
    """What is left to compare, initial states and forces explain whatever it is: that is no sign of little noise."""
    scene, truth = scene_of(), np.array(hidden().noise)
    late = [Placed(VOCABULARY["sensor_delay"], c, (0.05,)) for c in scene.setting.observation.labels]
    wrong = refit(scene.evidence, scene.begin.with_effects(late), iterations=0)
    free = free_forces(scene.twin, scene.short, wrong.hypothesis.variant)
    assert np.isinf(free.unsure).all()
    evidence = dataclasses.replace(scene.evidence, noise=truth)
    beside = noise_beside(evidence, scene.short, dataclasses.replace(wrong, residual=50 * wrong.residual))
    assert (beside == truth).all()


def test_late_sensors_do_not_stand_for_a_late_command_and_a_coarse_step() -> None:
    truth = [Effect("integration", None, {"timestep": 0.01}), Effect("actuator_delay", "push", {"delay": 0.043})]
    gap = search(
        simulate_truth(coarse(CART_POLE, 0.01), truth, 1, **SIZE), ("actuator_delay", "sensor_delay", "integration")
    )
    assert {(e.effect, e.target) for e in gap.effects} == {("actuator_delay", "push"), ("integration", None)}


def two_joints(folder: Path, friction: tuple[float, float], seed: int) -> Path:
    """Write a log of an arm with MuJoCo's own ``frictionloss``, and a config with the arm that lacks it."""
    xml = (
        '<mujoco><default><geom type="capsule" size=".02" contype="0" conaffinity="0"/></default><worldbody>'
        '<body pos="0 0 1"><joint name="a" axis="0 1 0" damping=".05"/><geom fromto="0 0 0 0 0 -.3" mass="1"/>'
        '<body pos="0 0 -.3"><joint name="b" axis="0 1 0" damping=".02"/><geom fromto="0 0 0 0 0 -.25" mass=".6"/>'
        '</body></body></worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>'
    )
    model, rng, time = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(seed), 0.004 * np.arange(2000)
    model.dof_frictionloss[:], data, rows = friction, mujoco.MjData(model), []
    waves = [1.2 * np.sin(2 * np.pi * (0.4 + 0.025 * time) * time), 0.5 * np.sin(2 * np.pi * 0.9 * time + 1)]
    for data.ctrl[:] in np.stack(waves, 1):
        rows.append(np.concatenate([data.qpos, data.qvel]))
        mujoco.mj_step(model, data, 2)
    noisy = np.array(rows) + rng.standard_normal((2000, 4)) * [1e-4, 1e-4, 2e-3, 2e-3]
    ends = np.arange(2000) % 500 == 499
    np.savez(folder / "arm.npz", observations=noisy, actions=np.stack(waves, 1), terminals=ends)
    (folder / "arm.xml").write_text(xml)
    config = {"model": "arm.xml", "data": "arm.npz", "frame_skip": 2, "observation": ["qpos", "qvel"]}
    (folder / "arm.yaml").write_text(yaml.safe_dump(config))
    return folder / "arm.yaml"


@pytest.mark.parametrize("friction", [(0.08, 0.0), (0.08, 0.03)])
def test_the_friction_of_an_mjcf_is_dry_friction(friction: tuple[float, float], tmp_path: Path) -> None:
    """``frictionloss`` creeps at rest; that is neither Stribeck's friction nor a rest that has no name."""
    problem = make_problem(load_config(two_joints(tmp_path, friction, 7)), general=True)
    gap = find_gap(problem)
    truth = {("joint_friction", joint): f for joint, f in zip("ab", friction, strict=True) if f}
    found = {(e.effect, e.target): e.parameters["friction"].value for e in gap.effects}
    assert found == {key: pytest.approx(value, rel=0.01) for key, value in truth.items()}
    assert {e["variant"] for e in gap.document()["effects"]} == {"joint_soft_friction"}
    assert gap.verdict == "explained"
    assert gap.reduced[1] == pytest.approx(1, abs=0.1)
    add(problem, gap, tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert model.dof_frictionloss == pytest.approx(friction, rel=0.01)
    assert (model.dof_solref == problem.space.model.dof_solref).all()


@pytest.mark.parametrize(("transitions", "said"), [(3_600, False), (1_000_000, True)])
def test_what_of_a_long_log_was_compared_is_said(transitions: int, said: bool) -> None:
    windows = Windows(np.zeros((120, 31, 4)), *[np.zeros(120)] * 3, np.zeros((1, 1, 1)))
    naming = SimpleNamespace(evidence=SimpleNamespace(windows=windows), unfinished="", gap=False, named=False)
    notes = " ".join(_notes(scene_of().setting, naming, True, transitions))  # type: ignore[arg-type]
    assert ("of 1,000,000 transitions, 3,600 were compared, 120 windows of 30" in notes) == said


def test_what_the_step_leaves_is_no_noise() -> None:
    """A lag shorter than ten steps is resolved so badly that it shows among the noise, unless a finer step tells."""
    lag = Effect("actuator_lag", "wrist_servo", {"time_constant": 0.0048})
    case = simulate_truth(SERVO_ARM, [lag], 3, noise=0.5, **SIZE)
    gap = search(case, ("actuator_lag", "actuator_gain"))
    assert [(e.effect, e.target) for e in gap.effects] == [("actuator_lag", "wrist_servo")]
    assert gap.noise == pytest.approx(case.noise, rel=0.1)


def test_capped_windows_of_noise_are_noise() -> None:
    chi2, caps = np.full((40, 10), 1.0), np.linspace(0.1, 1, 40)
    linear = Linearization(np.zeros((40, 10, 2)), np.ones((40, 10)), np.zeros((40, 10)), 0.0)
    cost = cost_of(np.sqrt(0.8 * chi2), linear, 320.0, caps)
    assert cost.reduced == pytest.approx(1)
    assert cost.excess == pytest.approx(0)


def test_a_late_position_begins_where_it_was() -> None:
    """Single steps from states of which a sensor is late are as near as noise allows."""
    case = simulate_truth(CART_POLE, [Effect("sensor_delay", "hinge.position", {"delay": 0.008})], 3, **SIZE)
    scene = prepare(load(case, noise=list(case.noise)))
    held = cut_held(scene.evidence, scene.held, true(case))
    found, floor = scores(scene.evidence, held, true(case))
    assert found.log_likelihood > floor.log_likelihood - 40


def test_given_noise_is_used() -> None:
    assert prepare(load(hidden(), noise=[1e-4, 2e-4, 3e-3, 4e-3])).noise == pytest.approx([1e-4, 2e-4, 3e-3, 4e-3])


def test_free_forces_are_those_that_are_missing() -> None:
    scene = scene_of("joint_damping")
    variant = dataclasses.replace(true(hidden("joint_damping")), placed=()).variant
    free = free_forces(scene.twin, short_windows(scene.setting, scene.train), variant, scene.noise)
    speed = free.windows.measured[:, :, 3].mean(1)
    slope = (free.forces[:, 1] * speed).sum() / (speed**2).sum()
    assert slope == pytest.approx(-0.02, rel=0.05)
    assert guilty(free) == 1


# --- the evidence ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [(), ("joint_damping",), ("actuator_lag",), ("joint_damping", "actuator_lag")])
@pytest.mark.parametrize("rough", [False, True])
def test_true_model_leaves_the_noise_alone(names: tuple[str, ...], rough: bool) -> None:
    """χ² per degree of freedom is near 1 although every start is noisy; as measured they would dominate."""
    scene, case = scene_of(*names), hidden(*names)
    evidence = Evidence(scene.twin, scene.evidence.windows, np.array(case.noise), scene.begin.variant, rough=rough)
    starts = evidence.linearize(true(case).variant)
    residuals, _ = evidence.residuals([true(case).variant])
    cost = cost_of(evidence.project(residuals[0], starts), starts, evidence.degrees(starts))
    assert cost.reduced == pytest.approx(1, abs=5 * np.sqrt(2 / cost.degrees))
    assert (residuals**2).sum() > 1.5 * cost.chi2


def test_projection_is_one() -> None:
    """P² = P, and what the starts change to first order is gone."""
    evidence = scene_of().evidence
    starts = evidence.linearize(scene_of().begin.variant)
    vectors = np.random.default_rng(0).standard_normal((len(evidence.windows), evidence.num_rows))
    once = evidence.project(vectors, starts)
    assert evidence.project(once, starts) == pytest.approx(once, abs=1e-12)
    assert evidence.project_slope(np.moveaxis(starts.basis, -1, 0), starts) == pytest.approx(0, abs=1e-9)


def test_diverged_windows_stay_finite() -> None:
    evidence = scene_of().evidence
    starts = evidence.linearize(scene_of().begin.variant)
    lost = np.full((len(evidence.windows), evidence.num_rows), np.nan)
    assert np.isfinite(evidence.project(lost, starts)).all()
    assert (evidence.project(lost, starts) ** 2).sum() > 1e6


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("finer", [1.0, 1e-4, 1e-8])
def test_no_hypothesis_gains_by_diverging(robust: bool, finer: float) -> None:
    """However small the noise, and however far off the given model: what diverges costs as much, at least."""
    scene = scene_of("joint_damping")
    evidence = dataclasses.replace(scene.evidence, noise=finer * scene.noise, robust=robust)
    diverging = scene.begin.with_effects([Placed(find_effect("joint_stiffness"), "hinge", (-1e7, 0.0))])
    linear = evidence.linearize(scene.begin.variant)
    begin, there = (refit(evidence, h, linear=linear, iterations=0) for h in (scene.begin, diverging))
    assert not np.isfinite(evidence.residuals([diverging.variant])[0]).all()
    assert there.loss >= begin.loss
    assert there.cost.excess >= begin.cost.excess


def test_a_model_that_diverges_on_unseen_data_has_no_finite_error() -> None:
    """A single step that diverges is no large number: it is worse than any."""
    scene = scene_of("joint_damping")
    diverging = scene.begin.with_effects([Placed(find_effect("joint_stiffness"), "hinge", (-1e7, 0.0))])
    after, floor = gap_package.verify(scene, diverging)
    assert (after.mse, after.log_likelihood, after.rollout_rmse) == (np.inf, -np.inf, np.inf)
    assert not np.isnan([floor.mse, floor.log_likelihood, floor.rollout_rmse]).any()


def test_where_the_given_model_diverges_itself_that_counts_like_its_worst_window() -> None:
    scene = scene_of("joint_damping")
    measured = scene.evidence.windows.measured.copy()
    measured[0] = np.nan
    broken = dataclasses.replace(scene.evidence, windows=dataclasses.replace(scene.evidence.windows, measured=measured))
    assert np.isfinite(broken.lost).all()
    assert broken.lost[0] == broken.lost.max()
    assert broken.lost[1:] == pytest.approx(scene.evidence.lost[1:])


def test_noise_stays_beside_a_hypothesis_under_which_nothing_can_be_simulated() -> None:
    scene = scene_of("joint_damping")
    ground = Ground(scene.evidence, (), short=scene.short)
    fitted = ground.refit(scene.begin)
    diverging = scene.begin.with_effects([Placed(find_effect("joint_stiffness"), "hinge", (-1e7, 0.0))])
    with pytest.raises(Diverges, match="diverges"):
        free_forces(scene.twin, scene.short, diverging.variant)
    beside = noise_beside(scene.evidence, scene.short, dataclasses.replace(fitted, hypothesis=diverging))
    assert beside == pytest.approx(scene.noise)


@pytest.mark.parametrize("wrong", [0.85, 1.15])
def test_noise_that_is_told_is_that_of_all_windows(wrong: float) -> None:
    """Refits use a part of them, which may be off by chance; so may what the last fit starts with."""
    scene, truth = scene_of("joint_damping"), np.array(hidden("joint_damping").noise)
    evidence = dataclasses.replace(scene.evidence, noise=wrong * truth)
    last, rest, own, _ = outcome._last_fit(evidence, scene.noisy, true(hidden("joint_damping")), math.inf)
    assert last.evidence.noise == pytest.approx(truth, rel=0.07)
    assert outcome._own_step(own, rest.cost, scene.rules) is None  # it was the noise, and no step


def test_after_the_end_better_starts_of_windows_are_not_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, truth = scene_of("joint_damping"), true(hidden("joint_damping"))
    looked: list[Any] = []

    def straight(evidence: Any, own: Any) -> tuple[Any, Any]:
        looked.append(own)
        return evidence, own

    monkeypatch.setattr(outcome, "_straight", straight)
    (late, *_), (in_time, *_) = (
        outcome._last_fit(scene.evidence, scene.noisy, truth, e) for e in (-math.inf, math.inf)
    )
    assert len(looked) == 1
    assert late.fit.hypothesis.vector == pytest.approx(in_time.fit.hypothesis.vector)


def test_a_last_fit_with_known_weights_ends_where_one_that_finds_them_does() -> None:
    """Where the model's error and not the noise decides, and wherever it begins."""
    scene, truth = scene_of("joint_damping"), true(hidden("joint_damping"))
    wrong = dataclasses.replace(scene.evidence, noise=0.3 * np.array(hidden("joint_damping").noise))
    last, rest, own, weighed = outcome._last_fit(wrong, None, truth, math.inf)
    assert own.reduced > scene.rules.sound.model_error
    assert weighed.model_error.max() > 1.5
    again, stepped, plain, same = outcome._as_weighed(weighed, truth.at(0.7 * truth.vector))
    assert same is weighed
    assert again.fit.hypothesis.vector == pytest.approx(last.fit.hypothesis.vector, rel=1e-3)
    assert (stepped.cost.reduced, plain.reduced) == pytest.approx((rest.cost.reduced, own.reduced), rel=0.02)


def test_derivatives_by_many_numbers_are_carried_to_where_fresh_ones_lead(monkeypatch: pytest.MonkeyPatch) -> None:
    """With fewer simulations; and a fit ends only where fresh ones say so."""
    scene, truth, taken = scene_of("joint_damping"), true(hidden("joint_damping")), list[int]()
    begin, original = truth.at(0.6 * truth.vector), refitting._differences

    def counted(*args: Any) -> Any:
        taken.append(len(args[4]))
        return original(*args)

    monkeypatch.setattr(refitting, "_differences", counted)
    found = []
    for many in (99, 1):
        monkeypatch.setattr(refitting, "MANY", many)
        taken.clear()
        found.append((refitting.refit(scene.evidence, begin), len(taken)))
    (fresh, often), (carried, seldom) = found
    assert seldom < often
    assert carried.hypothesis.vector == pytest.approx(fresh.hypothesis.vector, rel=1e-3)
    assert carried.loss == pytest.approx(fresh.loss, rel=1e-4)
    assert carried.slope == pytest.approx(fresh.slope, rel=1e-2, abs=1e-2 * np.abs(fresh.slope).max())


def test_members_of_a_family_are_not_swapped() -> None:
    placed = [Placed(find_effect("joint_friction"), f"joint{i}", (0.1,)) for i in range(3)]
    other = Placed(find_effect("joint_damping"), "joint0", (0.1,))
    assert accept._single([*placed, other]) == [other.key]
    assert accept._single([*placed[:2], other]) == [p.key for p in (*placed[:2], other)]


def test_what_promises_no_number_comes_last() -> None:
    assert sorted([3.0, promised(float("nan")), 1.0, promised(2.0)]) == [1.0, 2.0, 3.0, np.inf]


#: A screening of no candidates.
NOTHING = Screening((), np.ones(1), np.zeros((0, 1)), 1.0)


def test_first_screening_tells_what_may_tie() -> None:
    """It leaves out what is away from what an effect explains, and is silent where it does not predict the effect."""
    size = 1000
    own, beside, away = (np.eye(size)[i] for i in range(3))
    slopes = {"own": own, "same": 3 * own, "half": own + away, "away": away, "beside": beside}
    residual = 60 * own + 40 * beside

    def candidate(target: str) -> Candidate:
        placed = Placed(find_effect("joint_damping"), target, (0.0,))
        return Candidate(placed, placed, 0.0, residual, slopes[target][None], dead=False)

    ranked = {target: candidate(target) for target in slopes}
    first = Screening(tuple(ranked.values()), residual, np.zeros((0, size)), 100.0)
    named, rules = [ranked["own"].placed, ranked["beside"].placed], Rules().alike
    found = first.rivals(named, 0, rules)
    assert found is not None
    assert {target for _, target in found} == {"own", "same", "half"}
    assert first.rivals(named[:1], 0, rules) is None  # alone, it leaves what the other explains
    assert first.rivals([*named, Placed(find_effect("payload"), "own", (0.0,) * 4)], 0, rules) is None


def ended(scene: Scene, excess: float, *, partial: bool = False, named: bool = True) -> Any:
    """The end of a search whose answer leaves a number of times its degrees of freedom as χ²."""
    base = refit(scene.evidence, scene.begin, iterations=0)
    cost = Cost(np.array([excess * 1e3]), np.zeros(1), 1e3)
    final = dataclasses.replace(base, cost=cost)
    found = Naming(scene.evidence, base, NOTHING, final, gap=True, named=named, partial=partial)
    return SimpleNamespace(naming=found)


@pytest.mark.parametrize(
    ("answers", "chosen", "asked"),
    [
        (((1.0, False, True), (1.0, False, True)), 0, 1),  # what explains everything needs no other
        (((1e5, False, True), (1.0, False, True)), 1, 2),  # names that leave a rest are no answer if others leave none
        (((1e5, False, True), (40.0, True, True)), 1, 2),  # nor if others leave none in most windows
        (((1e5, False, True), (40.0, False, True)), 0, 2),
        (((1e5, False, False), (40.0, False, True)), 1, 2),
        (((1e5, False, True), (40.0, False, False)), 0, 2),
    ],
)
def test_names_that_leave_nothing_are_believed_before_others(
    answers: tuple, chosen: int, asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of("joint_damping")
    signals = dataclasses.replace(scene.setting.signals, contacts=np.array([True]))
    scene = dataclasses.replace(scene, setting=dataclasses.replace(scene.setting, signals=signals))
    ready = [ended(scene, excess, partial=partial, named=named) for excess, partial, named in answers]
    waiting, sure = iter(ready), ended(scene, 1.0)
    monkeypatch.setattr("dropo_torch.gap.run.search", lambda *_, **__: next(waiting))
    monkeypatch.setattr("dropo_torch.gap.run.searched", lambda scene: ((str(n), scene.evidence) for n in range(2)))
    monkeypatch.setattr("dropo_torch.gap.run.with_ties", lambda ended, end: ended.naming)
    monkeypatch.setattr("dropo_torch.gap.run.believed", lambda *_: None)
    monkeypatch.setattr("dropo_torch.gap.run.beside_noise", lambda ended, end: ended)
    assert gap_package.name(scene).final is ready[chosen].naming.final
    assert len(list(waiting)) == len(ready) - asked
    late = dataclasses.replace(ready[0].naming, unfinished="refitting")
    monkeypatch.setattr("dropo_torch.gap.run.search", lambda *_, **__: SimpleNamespace(naming=late))
    monkeypatch.setattr("dropo_torch.gap.run.believed", lambda *_: sure)
    if asked == 2 and answers[0][2]:
        assert gap_package.name(scene).unfinished == "refitting"
    monkeypatch.setattr("dropo_torch.gap.run.search", lambda *_, **__: next(waiting))
    if asked == 2 and answers[0][2]:  # names that leave a rest are asked on shorter windows before these are searched
        waiting = iter(ready)
        monkeypatch.setattr("dropo_torch.gap.run.believed", lambda *_: sure)
        assert gap_package.name(scene).final is sure.naming.final
        assert len(list(waiting)) == 1


@pytest.mark.whole
def test_one_effect_that_explains_most_may_stand_for_two() -> None:
    """A lag removes 0.98 of what a delay and damping make, and no effect beside it removes most of the rest."""
    (spec,) = select(cases(738766, "all"), "motion-servo_arm-joint_damping-actuator_delay-quiet", None)
    scene = prepare(load(spec.make()))
    ground = Ground(scene.evidence, tuple(VOCABULARY.values()), short=scene.noisy)
    state = start(ground, scene.begin)
    ground = ground.at(state)
    wrong, damping = Placed(find_effect("actuator_lag"), "elbow_servo", (0.03,)), find_effect("joint_damping")
    current = ground.refit(scene.begin.with_effects([wrong]))
    named = Naming(ground.evidence, state.base, state.first, current, gap=True, named=True)
    assert leaves_wrong(named, ground)
    found = instead_of_one(Ended(ground, dataclasses.replace(state, current=current), named)).naming
    assert not leaves_wrong(found, ground)
    told = {p.effect.name for p in found.final.hypothesis.placed}
    assert told in ({"actuator_delay", "joint_damping"}, {"actuator_delay", "actuator_damping"})
    two = ground.refit(current.hypothesis.with_effects([Placed(damping, "elbow", (0.01,))]))
    of_two = Ended(ground, dataclasses.replace(state, current=two), named)
    assert instead_of_one(of_two) is of_two


@pytest.mark.whole
def test_what_the_own_step_distorts_is_fitted_with_a_finer_one() -> None:
    """Friction that is larger near rest: with the model's step, where it fits best is not where it is."""
    (spec,) = select(cases(251623, "all"), "single-torque_arm-joint_stribeck", None)
    scene, plain = prepare(load(spec.make())), find_effect("joint_friction")
    ground = Ground(scene.evidence, (plain, find_effect("joint_stribeck")), short=scene.noisy, few=16)
    state = start(ground, scene.begin)
    ground = ground.at(state)
    rough = ground.refit(scene.begin.with_effects([Placed(plain, "elbow", (0.06,))]))
    refined = extend(ground, dataclasses.replace(state, current=rough)).current
    assert [p.key for p in refined.hypothesis.placed] == [("joint_stribeck", "elbow")]
    finer = resolved(ground.part, refined, anew=True).fit
    assert finer.cost.reduced < 1.5 < resolved(ground.part, refined).fit.cost.reduced
    assert finer.hypothesis.placed[0].values == pytest.approx((0.06, 0.0975, 0.303), rel=0.1)


def test_what_too_large_a_noise_does_not_tell_apart_is_told_once_it_is_lower() -> None:
    """The search is on the noise as it first seems; beside what it accepts, that may fall by an order of magnitude."""
    names = ("joint_damping",)
    scene, right = scene_of(*names), true(hidden(*names))
    ground = Ground(scene.evidence, tuple(VOCABULARY[n] for n in FEW), short=scene.noisy)
    state = start(ground, scene.begin)
    ground = ground.at(state)
    loud = ground.on(LOUD * state.noise, state.since)
    base = loud.refit(scene.begin)
    begun = dataclasses.replace(state, noise=LOUD * state.noise, base=base, current=base, done=False)
    found = accept.add(loud, begun)
    told = [found.current.hypothesis, *found.rivals]
    assert len(told) > 1
    assert ("joint_damping", "hinge") in {h.placed[0].key for h in told}
    wrong = next(h for h in told if h.placed[0].key != ("joint_damping", "hinge"))
    mistaken = dataclasses.replace(found, current=ground.refit(wrong), rivals=tuple(h for h in told if h is not wrong))
    again = accept.reconsidered(ground, mistaken)
    assert [p.key for p in again.current.hypothesis.placed] == [p.key for p in right.placed]
    assert not again.rivals


def test_names_are_believed_on_other_windows_only_if_they_leave_nothing_there() -> None:
    """The right name is, a wrong one and one that is not needed are not."""
    names = ("joint_damping",)
    scene, case = scene_of(*names), hidden(*names)
    ground = Ground(scene.evidence, tuple(VOCABULARY[n] for n in FEW), short=scene.noisy)
    shorter = dataclasses.replace(ground, evidence=dict(searched(scene))["-shorter"])
    state = start(ground, scene.begin)

    def believes(hypothesis: Hypothesis) -> bool:
        found = dataclasses.replace(state, current=ground.refit(hypothesis))
        known = Naming(scene.evidence, state.base, state.first, found.current, gap=True, named=True)
        return believed(shorter, scene.begin, Ended(ground, found, known)) is not None

    right, wrong = true(case), scene.begin.with_effects([Placed(VOCABULARY["actuator_lag"], "push", (0.02,))])
    assert believes(right)
    assert not believes(wrong)
    assert not believes(right.with_effects(wrong.placed))


# --- fits and screening ---------------------------------------------------------------------------------------


def test_refit_finds_effect_and_declared_mass_together() -> None:
    scene, case = scene_of("joint_damping"), hidden("joint_damping")
    begin = Hypothesis((0.6,), (Placed(find_effect("joint_damping"), "hinge", (0.0,)),))
    fitted = refit(scene.evidence, begin)
    assert fitted.hypothesis.vector == pytest.approx(true(case).vector, rel=0.01)
    assert fitted.cost.reduced < 1.2


@pytest.mark.parametrize("begin", [(0.35, 0.5), (9.0, -4.0)])
def test_refit_stays_in_bounds(begin: tuple[float, float]) -> None:
    """The true mass is above its bounds, so the fit ends at the bound, wherever it begins."""
    parameters = {"pole_mass": {**CART_POLE.declared["pole_mass"], "bounds": [0.3, 0.4]}}
    scene = prepare(load(hidden(), parameters=parameters))
    hypothesis = Hypothesis(begin[:1], (Placed(find_effect("joint_friction"), "rail", begin[1:]),))
    limits, linear = limits_of(hypothesis, scene.twin), scene.evidence.linearize(scene.begin.variant)
    fitted = refit(scene.evidence, hypothesis, linear=linear)
    assert fitted.hypothesis.vector[0] == pytest.approx(0.4, rel=1e-9)
    assert np.all((limits.low <= fitted.hypothesis.vector) & (fitted.hypothesis.vector <= limits.high))


@pytest.mark.parametrize(
    ("name", "rank"),
    [("joint_damping", 1), ("joint_friction", 1), ("joint_stiffness", 1), ("actuator_lag", 1), ("actuator_delay", 2)],
)
def test_screening_ranks_the_true_effect_first(name: str, rank: int) -> None:
    """A delay is not linear in its length, so that a lag may promise as much; the refit decides."""
    scene, (truth,) = scene_of(name), hidden(name).effects
    base = refit(scene.evidence, scene.begin)
    candidates = list(all_candidates(scene.setting, [VOCABULARY[e] for e in FEW]))
    ranked = screen(Focus(scene.evidence, base), candidates, Rules().tried)
    assert (truth.name, truth.target) in [c.key for c in ranked[:rank]]
    assert len({c.key for c in ranked}) == len(ranked)


@pytest.mark.parametrize("poles", [9, 13])
def test_ripple_between_those_that_are_tried_is_ranked_first(poles: int) -> None:
    """On a joint whose inertia is small beside its load: what is tried must be small enough to be linear."""
    ripple = Effect("joint_cogging", "elbow", {"amplitude": 0.1, "poles": poles, "phase": 2.2})
    scene = prepare(load(simulate_truth(TORQUE_ARM, [ripple], 4, episodes=6, transitions=200)))
    names = ("joint_cogging", "joint_stiffness", "center_of_mass", "external_force", "actuator_bias")
    ground = Ground(scene.evidence, tuple(VOCABULARY[n] for n in names))
    assert ground.screened(ground.refit(scene.begin))[0].key == ("joint_cogging", "elbow")


def largest_force(problem: Problem, actuator: str) -> float:
    """Of an actuator of the model as given, at the states and commands of a log."""
    log, model = problem.trajectories, problem.space.model
    assert model is not None
    data, forces = mujoco.MjData(model), []
    for state, command in zip(problem.observation.states(log.observations), log.actions, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[: model.nq], state[model.nq :], command
        mujoco.mj_forward(model, data)
        forces.append(abs(data.actuator(actuator).force[0]))
    return max(forces)


def test_a_limit_that_binds_seldom_is_ranked_first() -> None:
    """Far from where the search for it begins: one such number does nothing on this log, the next only harm."""
    plain = load(simulate_truth(SERVO_ARM, [], 3, episodes=6, transitions=200))
    truth = 0.7 * largest_force(plain, "elbow_servo")
    limit = Effect("actuator_saturation", "elbow_servo", {"limit": truth})
    scene = prepare(load(simulate_truth(SERVO_ARM, [limit], 3, episodes=6, transitions=200)))
    names = ("joint_damping", "joint_friction", "armature", "actuator_gain", "actuator_saturation")
    ground = Ground(scene.evidence, tuple(VOCABULARY[n] for n in names))
    best = start(ground, scene.begin).first.ranked[0]
    assert best.key == ("actuator_saturation", "elbow_servo")
    assert best.placed.values[0] == pytest.approx(truth, rel=0.05)


class Echo(SensorEffect):
    """A sensor that shows a share of what it showed before, and knows nothing of what was before a window."""

    name, sentence = "test_echo", "the sensor of {target} shows an echo"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("share", "", 0.0, -1.0, 1.0, 0.1),)

    def memory(self, values: np.ndarray) -> float:
        return 0.1

    def sense(self, path: SensedPath, column: int, values: torch.Tensor) -> torch.Tensor:
        return path.shown[..., column] + values[:, :1] * path.ago(column, torch.full_like(values[:, :1], 0.1))


def test_slopes_of_the_screening_are_those_of_the_candidate() -> None:
    """Also at a neutral start, where a filter moves what it stands beside to a step of its own, and if it remembers."""
    scene = scene_of("joint_friction")
    beside = [
        Placed(find_effect("joint_friction"), "rail", (0.3,)),
        Placed(find_effect("integration"), None, (0.000625,)),
    ]
    fitted = refit(scene.evidence, scene.begin.with_effects(beside), iterations=0)
    focus, size = Focus(scene.evidence, fitted), 1e-4
    bias, damping = (
        Placed(find_effect("sensor_bias"), "hinge.position", (0.0,)),
        Placed(find_effect("joint_damping"), "hinge", (0.0,)),
    )
    echo = Placed(Echo(), "hinge.position", (0.0,))
    for candidate in screen(focus, [bias, damping, echo], Rules().tried):
        scale = candidate.placed.effect.quantities(scene.setting, candidate.placed.target)[0].scale
        there = [fitted.hypothesis.with_effects([candidate.start.at([v])]).variant for v in (0.0, size * scale)]
        begin, end = scene.evidence.project(scene.evidence.residuals(there)[0], fitted.linear)
        expected = (end - begin) / size
        error = candidate.slope.reshape(expected.shape) - expected
        assert np.linalg.norm(error) < 0.03 * np.linalg.norm(expected), candidate.key


def test_differences_are_taken_with_a_step_that_costs_less(monkeypatch: pytest.MonkeyPatch) -> None:
    """Derivatives, and what initial states explain, are nearly the same; residuals are those of the step itself."""
    scene, effect = scene_of("joint_friction"), find_effect("integration")
    step = scene.setting.model.opt.timestep
    hypothesis = true(hidden("joint_friction")).with_effects([Placed(effect, None, (step / 8,))])
    assert [hypothesis.variant.eased(scene.setting).placed[-1].values for _ in range(2)] == [(step / 2,)] * 2
    easy = refit(scene.evidence, hypothesis, iterations=0)
    monkeypatch.setattr(type(effect), "eased", lambda self, setting, values: values)
    full = refit(scene.evidence, hypothesis, iterations=0)
    assert np.linalg.norm(easy.slope - full.slope) < 0.05 * np.linalg.norm(full.slope)
    assert np.linalg.norm(easy.residual - full.residual) < 0.05 * np.linalg.norm(full.residual)
    assert not np.array_equal(easy.slope, full.slope)


@pytest.mark.parametrize("finer", [4, 8])
def test_so_are_those_of_a_log_that_is_compared_with_a_finer_step(finer: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, hypothesis = scene_of("joint_friction"), true(hidden("joint_friction"))
    step = scene.setting.model.opt.timestep
    fine, half = (scene.twin.finer(Placed(find_effect("integration"), None, (step / n,))) for n in (finer, 2))
    evidence = dataclasses.replace(scene.evidence, twin=fine)
    assert fine.eased is half
    assert half.eased is half
    assert scene.twin.eased is scene.twin
    easy = refit(evidence, hypothesis, iterations=0)
    monkeypatch.setattr(type(evidence.twin), "eased", property(lambda self: self))
    full = refit(evidence, hypothesis, iterations=0)
    assert np.linalg.norm(easy.slope - full.slope) < 0.05 * np.linalg.norm(full.slope)
    assert np.linalg.norm(easy.residual - full.residual) < 0.05 * np.linalg.norm(full.residual)
    assert not np.array_equal(easy.slope, full.slope)


@pytest.mark.parametrize("anew", [1, 3])
def test_pairs_are_tried_again_without_what_makes_the_best_one_nonsense(
    anew: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An arm without inertia stands for a motor that is half as strong again: where it promises most, it must go."""
    gain, damping = Effect("actuator_gain", "drive", {"gain": 1.5}), Effect("joint_damping", "turn", {"damping": 0.009})
    scene = prepare(load(simulate_truth(FURUTA, [damping, gain], 3, **SIZE)))
    rules = dataclasses.replace(Rules(), tried=dataclasses.replace(Rules().tried, anew=anew))
    known = tuple(map(find_effect, ("inertia", "joint_damping", "actuator_gain")))
    ground = Ground(dataclasses.replace(scene.evidence, rules=rules), known, short=scene.noisy)
    state = start(ground, scene.begin)

    def misled(focus: Focus, candidates: list[Candidate], tried: Tried) -> list[list[Placed]]:
        keys = ("inertia", "arm"), ("joint_damping", "turn"), ("actuator_gain", "drive")
        own = {c.key: c.placed for c in candidates if c.key in keys}
        return [[own[key] for key in keys if key in own][:2]]

    monkeypatch.setattr(accept, "promising_pairs", misled)
    found, _ = paired(ground.at(state), state, [c for c in state.first.ranked if not c.dead])
    keys = [{p.key for p in r.hypothesis.placed} for r in found]
    assert keys == ([{(e.name, e.target) for e in (gain, damping)}] if anew > 1 else [])


# --- outliers -------------------------------------------------------------------------------------------------


def spoilt(size: float, share: float, windows: int = 40, rows: int = 12) -> Refit:
    """A fit that leaves noise in its windows, and residuals of ``size`` in a share of them."""
    residual = np.random.default_rng(0).standard_normal((windows, rows))
    residual[: round(share * windows)] *= size
    starts = Linearization(np.zeros((windows, rows, 0)), np.ones((windows, rows)), np.zeros((windows, rows)), 0.0)
    cost = cost_of(residual, starts, windows * rows, tail=Rules().weighed.tail * rows)
    return Refit(Hypothesis(()), cost, residual, residual[None], starts, np.ones(1), np.ones(windows))


def test_robust_cost_is_that_of_noise_for_noise_and_a_logarithm_far_off() -> None:
    rows = 12
    starts = Linearization(np.zeros((1, rows, 0)), np.ones((1, rows)), np.zeros((1, rows)), 0.0)
    tail = Rules().weighed.tail * rows
    costs = [cost_of(np.full((1, rows), a), starts, rows, tail=tail).chi2 for a in (1.0, 1e4, 1e5, 1e6)]
    assert costs[0] == pytest.approx(rows)
    assert costs[3] - costs[2] == pytest.approx(costs[2] - costs[1], rel=1e-3)
    assert costs[3] < 100 * costs[0]  # of a misfit 1e12 times as large


def test_robust_factors_are_the_slope_of_the_robust_loss() -> None:
    chi2, tail, step = np.array([0.1, 30.0, 4000.0]), 36.0, 1e-4
    slope = tail * (np.log1p((chi2 + step) / tail) - np.log1p((chi2 - step) / tail)) / (2 * step)
    np.testing.assert_allclose(robust_factors(chi2, tail) ** 2, slope, rtol=1e-5)
    np.testing.assert_array_equal(robust_factors(chi2, None), 1.0)


def test_what_is_better_everywhere_and_right_nowhere_clears_nothing() -> None:
    base = spoilt(100.0, 1.0)
    assert clears(base, spoilt(1000.0, 0.4), Rules())  # right in six of ten windows, worse in the others
    assert not clears(base, spoilt(3.0, 1.0), Rules())  # imitates it everywhere
    assert not clears(spoilt(1000.0, 0.4), spoilt(1.0, 0.0), Rules())  # was right in most windows before


# --- intervals ------------------------------------------------------------------------------------------------

W, N, Q = 24, 10, 3


def linear_fit(rng: np.random.Generator, shared: float = 0.0) -> Refit:
    """Least squares on a linear model without a signal; ``shared`` errors are the same all over a block of windows."""
    slope = rng.standard_normal((Q, W, N)) + rng.standard_normal((Q, W, 1))
    error = rng.standard_normal((W, N)) + shared * np.repeat(rng.standard_normal((W // 3, 1)), 3, 0)
    flat = slope.reshape(Q, -1)
    values = np.linalg.solve(flat @ flat.T, flat @ error.ravel())
    residual = error - np.einsum("q,qwn->wn", values, slope)
    cost = Cost((residual**2).sum(1), np.zeros(W), W * N - Q)
    starts = Linearization(np.zeros((W, N, 0)), np.ones((W, N)), np.zeros((W, N)), 0.0)
    return Refit(Hypothesis(tuple(values)), cost, residual, slope, starts, np.ones(Q), np.ones(W))


@pytest.mark.parametrize("shared", [0.0, 2.0])
def test_intervals_cover_as_often_as_they_say(shared: float) -> None:
    rng, blocks = np.random.default_rng(0), np.repeat(np.arange(W // 3), 3)
    fits = [linear_fit(rng, shared) for _ in range(300)]
    errors = [standard_errors(f, blocks) for f in fits]
    inside = [np.abs(f.hypothesis.vector) < 1.6449 * e for f, e in zip(fits, errors, strict=True)]
    assert 0.84 < np.mean(inside) < 0.97


@functools.cache
def sharp() -> tuple[Case, Evidence]:
    """Dry friction, measured well, with the windows of its log."""
    case = simulate_truth(CART_POLE, [FRICTION], 3, noise=0.2, **SIZE)
    return case, dataclasses.replace(prepare(load(case)).evidence, noise=np.array(case.noise))


def test_numbers_are_not_those_of_the_step() -> None:
    """Dry friction is resolved by the model's step only so well, which biases it by more than the noise."""
    case, evidence = sharp()
    own = refit(evidence, true(case))
    last, truth = resolved(evidence, own), true(case).vector
    half = half_widths(last)
    assert own.cost.reduced > 3
    assert (np.abs(own.hypothesis.vector - truth) > 3 * half).any()
    assert (np.abs(last.fit.hypothesis.vector - truth) < half).all()
    assert (half < 1e-3 * truth).all()
    assert last.fit.cost.reduced < 1.2
    assert last.error.max() > 0
    np.testing.assert_allclose(half, np.hypot(half_widths(dataclasses.replace(last, error=0 * half)), last.error))


def test_late_sensor_leaves_nothing_but_noise() -> None:
    """A window starts from the truth that a late sensor shows later, however bent it is."""
    late = Effect("sensor_delay", "swing.velocity", {"delay": 0.016})
    case = simulate_truth(FURUTA, [late], 3, **SIZE)
    evidence = dataclasses.replace(prepare(load(case)).evidence, noise=np.array(case.noise))
    assert refit(evidence, true(case)).cost.reduced < 1.2


@pytest.mark.parametrize("steps", [0.3, 1.0, 2.6, 4.0])
def test_secant_of_a_cubic_is_exact(steps: float) -> None:
    def cubic(t: np.ndarray | float) -> np.ndarray:
        return np.polyval([0.3, -1.0, 2.0, 5.0], t) * np.ones(1)

    path = cubic(np.arange(5.0))[None]
    assert secants(path, steps) == pytest.approx(cubic(steps) - 5.0)


def test_log_of_the_own_step_stays_with_it() -> None:
    case, evidence = sharp()
    path, _ = evidence.twin.predict([true(case).variant], evidence.windows)
    measured = path[0] + evidence.noise * np.random.default_rng(0).standard_normal(path[0].shape)
    here = dataclasses.replace(evidence, windows=dataclasses.replace(evidence.windows, measured=measured))
    own = refit(here, true(case))
    last = resolved(here, own)
    assert last.fit is own
    assert not last.error.any()


def repeated(evidence: Evidence, variant: Variant, noise: float, seed: int = 0) -> Evidence:
    """The windows as a simulation with the model's own step has them, with noise that is so many times as large."""
    path, _ = evidence.twin.predict([variant], evidence.windows)
    measured = path[0] + noise * evidence.noise * np.random.default_rng(seed).standard_normal(path[0].shape)
    windows = dataclasses.replace(evidence.windows, measured=measured)
    return dataclasses.replace(evidence, windows=windows, noise=noise * evidence.noise)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_step_that_noise_hides_widens_intervals(seed: int) -> None:
    case, evidence = sharp()
    hidden, step = repeated(evidence, true(case).variant, 30.0, seed), evidence.twin.setting.signals.timestep
    own = refit(hidden, true(case))
    last = resolved(hidden, own)
    assert last.fit is own
    fine = hidden.twin.finer(Placed(find_effect("integration"), None, (step / 8,)))
    finer = refit(dataclasses.replace(hidden, twin=fine), true(case))
    np.testing.assert_allclose(last.error, np.abs(finer.hypothesis.vector - own.hypothesis.vector), rtol=0.5)


def test_numbers_beside_a_named_step_are_as_unsure_as_it() -> None:
    case, evidence = sharp()
    step, finer = evidence.twin.setting.signals.timestep, find_effect("integration")
    named = refit(evidence, true(case).with_effects([Placed(finer, None, (step / 4,))]))
    twice = refit(evidence, true(case).with_effects([Placed(finer, None, (step / 2,))])).hypothesis.vector
    change = np.abs(twice - named.hypothesis.vector)
    sure = Z90 * standard_errors(named, evidence.windows.episodes)
    half = half_widths(resolved(evidence, named))
    error = np.sqrt(half[:-1] ** 2 - sure[:-1] ** 2)
    assert 1 / 3 < np.linalg.norm(error / half[:-1]) / np.linalg.norm(change[:-1] / half[:-1]) < 3


@pytest.mark.parametrize(("size", "anew"), [(5.0, True), (300.0, False)])
def test_a_step_that_explains_next_to_nothing_of_a_misfit_is_not_fitted_anew(
    size: float, anew: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a push that the model lacks, which grows over each window up to so many times the noise."""
    case, evidence = sharp()
    push = size * evidence.noise * np.linspace(0, 1, evidence.windows.length + 1)[:, None] ** 3
    windows = dataclasses.replace(evidence.windows, measured=evidence.windows.measured + push)
    wrong, done = dataclasses.replace(evidence, windows=windows), []
    fitted = refit(wrong, true(case))
    assert step_may_explain(wrong, fitted) == anew
    monkeypatch.setattr("dropo_torch.gap.refit._anew", lambda last: done.append(last) or last)
    resolved(wrong, fitted, anew=True)
    assert bool(done) == anew


def test_number_without_influence_is_not_known() -> None:
    fitted = linear_fit(np.random.default_rng(0))
    silent = dataclasses.replace(fitted, slope=fitted.slope * np.array([1.0, 0.0, 1.0])[:, None, None])
    errors = standard_errors(silent, np.arange(W))
    assert np.isinf(errors[1])
    assert np.isfinite(errors[[0, 2]]).all()


# --- verification and places ----------------------------------------------------------------------------------


@pytest.mark.parametrize("episodes", [1, 3, 4, 9])
def test_last_quarter_is_held_out(episodes: int) -> None:
    log = simulate_truth(CART_POLE, (), 0, episodes=episodes, transitions=20).trajectories
    train, held = hold_out(log)
    assert np.array_equal(np.concatenate([train.observations, held.observations]), log.observations)
    assert 0.1 <= len(held) / len(log) <= 0.3
    assert train.terminals[-1]
    assert held.terminals[-1]
    if episodes >= 4:
        assert (train.num_episodes, held.num_episodes) == (episodes - episodes // 4, episodes // 4)


def test_scores_order_by_how_wrong_a_model_is() -> None:
    scene, case = scene_of("joint_damping"), hidden("joint_damping")
    right = true(case)
    held = cut_held(scene.evidence, scene.held, right)
    models = [right.at(np.array([right.declared[0], d])) for d in (0.02, 0.03, 0.05)]
    best, worse, worst = (score(scene.evidence, held, m) for m in models)
    floor = scores(scene.evidence, held, right)[1]
    assert best.mse < worse.mse < worst.mse
    assert best.rollout_rmse < worse.rollout_rmse < worst.rollout_rmse
    assert best.log_likelihood > worse.log_likelihood > worst.log_likelihood
    assert best.mse == pytest.approx(floor.mse, rel=0.2)
    assert best.log_likelihood == pytest.approx(floor.log_likelihood, rel=0.02)


def test_courses_are_of_the_log_and_typical_of_its_scores() -> None:
    scene, right = scene_of("joint_damping"), true(hidden("joint_damping"))
    held = cut_held(scene.evidence, scene.held, right)
    found = courses(scene.evidence, held, scene.begin, right)
    assert [c.label for c in found] == ["rail.position", "hinge.position"]
    for column, course in enumerate(found):
        logged = scene.held.observations[:, column]
        assert np.isin(course.measured[:, :-1], logged).all()
        assert np.allclose(np.diff(course.time), scene.problem.simulator.timestep)
        assert np.array_equal(course.time[1:, 0], course.time[:-1, -1])  # one begins where the last one ends
        assert np.array_equal(course.before[:, 0], course.measured[:, 0])
        before, after = (np.sqrt(np.mean((m - course.measured) ** 2)) for m in (course.before, course.after))
        assert after < 0.2 * before
    size = np.sqrt(np.mean([(c.before - c.measured)[:, 1:] ** 2 for c in found]))
    assert 0.4 < size / score(scene.evidence, held, scene.begin).rollout_rmse < 2.5


def test_open_loop_floor_is_that_of_many_draws() -> None:
    scene = scene_of()
    held = cut_held(scene.evidence, scene.held, scene.begin)
    evidence = scene.evidence.on(held.rollouts)
    shape = (400, len(held.rollouts), evidence.chart.size)
    draws = np.concatenate([np.zeros((1, *shape[1:])), np.random.default_rng(0).standard_normal(shape)])
    residuals, _ = evidence.residuals([scene.begin.variant] * len(draws), draws)
    change = (residuals[1:] - residuals[:1]).reshape(len(draws) - 1, shape[1], -1, shape[2])[:, :, 1:]
    expected = np.sqrt((change**2).mean((0, 1, 2)) + 1) * scene.noise
    assert rollout_floor(evidence, scene.begin) == pytest.approx(expected, rel=0.3)


@pytest.mark.parametrize(
    ("name", "dof", "words"),
    [
        ("joint_friction", 0, "with the direction in which rail moves"),
        ("joint_damping", 1, "in proportion to the velocity of hinge"),
        ("actuator_lag", 0, "when the command of push changes"),
        ("joint_stiffness", 1, "with the position of hinge"),
    ],
)
def test_regime_is_told(name: str, dof: int, words: str) -> None:
    scene = scene_of(name)
    base = refit(scene.evidence, scene.begin).hypothesis
    free = free_forces(scene.twin, short_windows(scene.setting, scene.train), base.variant, scene.noise)
    assert guilty(free) == dof
    assert regime(scene.setting, free, dof).words == words


@pytest.mark.parametrize(
    ("begins", "single", "words"),
    [
        (True, True, "from 0.48 s on"), (False, True, "until 0.46 s"), (True, False, "from episode 2 on"),
        (False, False, "up to episode 1"),
    ],
)  # fmt: skip
def test_a_force_that_is_missing_in_a_part_of_the_log_is_told_so(begins: bool, single: bool, words: str) -> None:
    """As of a load that is picked up or put down: by time where the log is one episode, else by the episode."""
    scene = scene_of()
    windows = cut_windows(scene.train, scene.setting.observation, 6, stride=2)
    windows = windows.select(windows.episodes == 0) if single else windows
    late = windows.steps >= 48 if single else windows.episodes >= 1
    wave = 30 * np.sin(np.arange(len(windows)))
    forces = wave * (late if begins else ~late) + np.random.default_rng(0).standard_normal(len(windows))
    found_at = np.stack([forces, wave], 1)
    free = FreeForces(scene.noise, scene.noise, found_at, np.ones((len(windows), 2)), windows, np.ones(len(windows)))
    assert part_of_log(scene.setting, free, 0) == words
    assert not part_of_log(scene.setting, free, 1)


def test_the_slope_of_a_line_is_the_same_over_however_many_windows() -> None:
    values, blocks = np.random.default_rng(0).normal(size=40), np.repeat([0, 1, 2], [3, 7, 30])
    assert slopes(values, 2.0 * values - 1.0, blocks) == pytest.approx([2.0, 2.0, 2.0], rel=1e-12)


def test_a_formula_says_of_what_it_is_a_share() -> None:
    """Of the mean square, a constant force being something to explain; which is a number by itself."""
    scene = scene_of()
    windows = cut_windows(scene.train, scene.setting.observation, 6, stride=2)
    draw = np.random.default_rng(0)
    velocity = middles(scene.setting, windows)[1][:, 0]
    for force, words in ((np.full(len(windows), 5.0), "≈ 5 (100 % "), (5 + 3 * velocity, "≈ 5 + 3·v(rail) (100 % ")):
        forces = np.stack([force + 1e-3 * draw.normal(size=len(force)), force], 1)
        free = FreeForces(scene.noise, scene.noise, forces, forces, windows, np.ones(len(windows)))
        assert describe(scene.setting, free, 0, Rules().shown) == f"force at rail {words}of its mean square)"


def test_place_is_told() -> None:
    place = found(("joint_damping",)).where[0]
    assert (place.kind, place.name, place.when) == ("joint", "hinge", "in proportion to the velocity of hinge")
    assert place.share > 0.99
    place = found(("actuator_lag",)).where[0]
    assert (place.kind, place.name, place.when) == ("actuator", "push", "when the command of push changes")


# --- resume ---------------------------------------------------------------------------------------------------

TWO = ("joint_damping", "actuator_lag")


class Stopped(Exception):
    pass


def test_interrupted_search_goes_on_to_the_same_result(tmp_path: Path) -> None:
    store = tmp_path / "gap-progress.bin"

    def stop(stage: str, _share: float) -> None:
        if store.exists() and b'"number":1' in store.read_bytes():
            raise Stopped(stage)

    with pytest.raises(Stopped):
        search(hidden(*TWO), FEW, stop, checkpoint=store)
    stages: list[str] = []
    gap = search(hidden(*TWO), FEW, lambda stage, _: stages.append(stage), checkpoint=store, resume=True)
    assert lasting(gap) == lasting(found(TWO))
    assert gap.simulated_transitions == found(TWO).simulated_transitions
    assert "fitting the declared parameters" not in stages
    assert all(TimeLeft().told(stage, 0.0, 0.0).visits for stage in stages)  # each has a plan


def test_second_search_over_shorter_windows_goes_on_too(tmp_path: Path) -> None:
    store, names = tmp_path / "gap-progress.bin", ("joint_stiffness",)
    plain = search(hidden("joint_presliding"), names, checkpoint=store)
    assert [e.effect for e in plain.effects] == ["unnamed"]
    stages: list[str] = []
    gap = search(
        hidden("joint_presliding"), names, lambda stage, _: stages.append(stage), checkpoint=store, resume=True
    )
    assert lasting(gap) == lasting(plain)
    assert gap.simulated_transitions == plain.simulated_transitions
    assert not any(stage.startswith(("fitting", "screening", "refitting")) for stage in stages)


def late_after(monkeypatch: pytest.MonkeyPatch, calls: int) -> None:
    """Let the time for searches be over once it was asked for some times."""
    asked = iter(range(10**6))
    clock = SimpleNamespace(monotonic=lambda: 0.0 if next(asked) < calls else 1e9, perf_counter=time.perf_counter)
    for module in ("limit", "run"):
        monkeypatch.setattr(f"dropo_torch.gap.{module}.time", clock)


@pytest.mark.parametrize("calls", [5, 9, 13, 10**6])
def test_answer_so_far_is_given_when_the_time_is_over(
    calls: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was found until then, what was not tried, and ``--resume`` goes on to the answer of a search without end."""
    store = tmp_path / "gap-progress.bin"
    late_after(monkeypatch, calls)
    gap = search(hidden(*TWO), FEW, checkpoint=store, time_limit=1e3)
    names = {e.effect for e in gap.effects}
    whole = {e.effect for e in found(TWO).effects}
    assert names <= whole | {"unnamed"}
    if calls == 10**6:
        assert lasting(gap) == lasting(found(TWO))
        return
    assert gap.unfinished
    assert gap.document()["unfinished"] == gap.unfinished
    assert any("not everything was tried" in note for note in gap.notes)
    assert "none of the" not in answer(gap)[0]
    monkeypatch.undo()
    on = search(hidden(*TWO), FEW, checkpoint=store, resume=True)
    assert lasting(on) == lasting(found(TWO))


@pytest.mark.parametrize(("left", "absurd", "named"), [(40.0, False, True), (60.0, False, False), (40.0, True, False)])
def test_what_was_accepted_is_the_answer_so_far_if_it_is_much_of_the_gap(
    left: float, absurd: bool, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fitted(reduced: float, *placed: Placed) -> SimpleNamespace:
        cost = Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3)
        return SimpleNamespace(cost=cost, hypothesis=Hypothesis((), placed))

    damping = Placed(VOCABULARY["joint_damping"], "hinge", (0.1,))
    state = SimpleNamespace(base=fitted(101.0), current=fitted(left, damping))
    nothing = Naming(None, None, None, state.base, True, refused="it leaves too much")
    monkeypatch.setattr(searching, "nonsense", lambda *_: ["it is at a bound"] * absurd)
    naming = searching.found_so_far(Ended(None, state, nothing))
    assert naming == (dataclasses.replace(nothing, final=state.current, named=True, refused="") if named else nothing)


@pytest.mark.parametrize(
    ("contacts", "shrinks", "move", "times"),
    [(True, 0.5, 1.0, 9), (True, 0.01, 1.0, 2), (True, 0.5, 1e-3, 2), (False, 0.5, 1.0, 2)],
)
def test_beside_contacts_a_fit_goes_on_as_long_as_another_linearization_of_the_initial_states_helps(
    contacts: bool, shrinks: float, move: float, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A heavy load of a walking robot: each linearization goes a part of the way, and one after the other all of it."""
    made = list[float]()

    def descent(evidence: Any, hypothesis: Hypothesis, linear: float, *_: Any) -> SimpleNamespace:
        made.append(linear)
        moved = hypothesis.at(hypothesis.vector + (1.0 if len(made) == 1 else move))
        begin = SimpleNamespace(hypothesis=hypothesis, cost=SimpleNamespace(misfit=100.0))
        return SimpleNamespace(begin=begin, here=SimpleNamespace(hypothesis=moved), gain=100 * shrinks, sloped=True)

    monkeypatch.setattr(refitting, "_descent", descent)
    monkeypatch.setattr(refitting, "limits_of", lambda *_: refitting.Limits(-np.ones(1), np.ones(1), np.ones(1)))
    touching = np.array([contacts])
    twin = SimpleNamespace(setting=SimpleNamespace(signals=SimpleNamespace(contacts=touching)))
    evidence = SimpleNamespace(twin=twin, linearize=lambda variant: variant.declared[0])
    refit(evidence, Hypothesis((0.0,)))
    assert len(made) == times
    assert len(set(made)) == times
    refit(evidence, Hypothesis((0.0,)), linear=-7.0)
    assert made[times:] == [-7.0]


@pytest.mark.parametrize(("left", "explained"), [(50.0, False), (3.0, True)])
def test_a_search_that_has_most_of_the_gap_ends_later(
    left: float, explained: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next effect of a walking robot takes minutes, and shorter windows would have to find the first one again."""

    @dataclasses.dataclass(frozen=True)
    class Found:
        base: Any
        current: Any
        number: int = 0
        done: bool = False

    def fitted(reduced: float) -> SimpleNamespace:
        return SimpleNamespace(cost=Cost(np.array([4e3 * reduced]), np.zeros(1), 4e3), hypothesis=Hypothesis(()))

    def step(ground: Ground, state: Found, on_found: Callable[[Any], None]) -> Found:
        on_found(dataclasses.replace(state, number=1))
        ground.report("swapping", 0.0)
        return dataclasses.replace(state, done=True)

    monkeypatch.setattr(searching, "start_anywhere", lambda *_: Found(fitted(94.0), fitted(left)))
    monkeypatch.setattr(searching, "step", step)
    monkeypatch.setattr(
        searching, "conclude", lambda _, state: Ended(None, state, Naming(None, None, None, None, True))
    )
    ground = Ground(SimpleNamespace(twin=None, rules=Rules()), ())
    monkeypatch.setattr(Ground, "at", lambda self, _: self)
    over = time.monotonic() - 1
    ended = searching.search(ground, Hypothesis(()), end=over, latest=math.inf)
    assert (ended.state.done, bool(ended.naming.unfinished)) == (explained, not explained)
    hurried = searching.search(ground, Hypothesis(()), end=over).state
    assert not hurried.done
    assert hurried.number == 1, "what was found before the swap is judged"


@pytest.mark.parametrize("given", ["0", "-3", "nan", "inf", "soon"])
def test_time_limit_that_is_none_is_refused(given: str, tmp_path: Path, refused: Callable[..., str]) -> None:
    hidden().write(tmp_path)
    line = refused("gap", tmp_path / "config.yaml", "--out", tmp_path / "out", f"--time-limit={given}")
    assert "expected seconds, above 0" in line


def test_checkpoint_of_another_problem_is_refused(tmp_path: Path) -> None:
    store = tmp_path / "gap-progress.bin"
    search(hidden(), ("joint_damping",), checkpoint=store)
    with pytest.raises(InputError, match="another config, model, log or method") as error:
        search(hidden("joint_damping"), ("joint_damping",), checkpoint=store, resume=True)
    assert "\n" not in str(error.value)


def test_checkpoint_of_another_vocabulary_gives_no_other_answer(tmp_path: Path) -> None:
    store, case = tmp_path / "gap-progress.bin", hidden("joint_damping")
    search(case, ("joint_damping",), checkpoint=store)
    with contextlib.suppress(InputError):
        gap = search(case, ("joint_stiffness",), checkpoint=store, resume=True)
        assert "joint_damping" not in {e.effect for e in gap.effects}


@pytest.mark.parametrize(
    "content",
    [
        b"", b"hello", pytest.param(b"garbage\n"),
        b"".join(dumps("fit", ("",), {})), b"".join(dumps("gap", ("",), {}))[:-1],
    ],
)  # fmt: skip
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, content: bytes) -> None:
    store = tmp_path / "gap-progress.bin"
    store.write_bytes(content)
    with pytest.raises(InputError, match="is no checkpoint"):
        search(hidden(), ("joint_damping",), checkpoint=store, resume=True)


# --- the command ----------------------------------------------------------------------------------------------


def run(*arguments: object) -> int:
    return main([str(a) for a in (*arguments, "--threads", 1)])


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the config of a log with hidden damping, and ``out`` with what the command made of it."""
    folder = tmp_path_factory.mktemp("cart")
    hidden("joint_damping").write(folder)
    assert run("gap", folder / "config.yaml", "--out", folder / "out") == 0
    return folder


@pytest.fixture
def one_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that is soon over."""
    monkeypatch.setattr("dropo_torch.gap.run.VOCABULARY", {"joint_damping": VOCABULARY["joint_damping"]})


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must fail with exit code 2 and one line; return the line."""

    def attempt(*arguments: object) -> str:
        code = run(*arguments)
        _, error = capfd.readouterr()
        assert code == 2, error
        assert error.startswith("dropo: ")
        assert error.count("\n") == 1
        return error

    return attempt


def test_command_writes_its_files(cart: Path) -> None:
    assert {p.name for p in (cart / "out").iterdir()} == FILES
    assert "hinge" in (cart / "out" / "report.html").read_text()


def test_model_is_taken_as_it_is_where_no_parameters_are_given(
    tmp_path: Path, one_effect: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = scene_of().problem.space.nominal[0]
    monkeypatch.setattr("benchmarks.hidden.truths.true_declared", lambda *_: {"pole_mass": float(given)})
    case = simulate_truth(CART_POLE, [DAMPING], 3, **SIZE)
    config = {k: v for k, v in case.config.items() if k != "parameters"}
    path = dataclasses.replace(case, config=config).write(tmp_path)
    assert run("gap", path, "--out", tmp_path / "out") == 0
    (told,) = json.loads((tmp_path / "out" / "gap.json").read_text())["effects"]
    assert (told["effect"], told["target"]) == ("joint_damping", "hinge")
    assert told["parameters"]["damping"]["value"] == pytest.approx(DAMPING.parameters["damping"], rel=0.02)
    assert list(load_config(tmp_path / "out" / "config.yaml").parameters or ()) == ["hinge_damping"]


def test_model_has_the_effect(cart: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(cart / "out" / "model.xml"))
    assert model.dof_damping[1] == pytest.approx(0.01 + 0.02, rel=0.02)
    assert model.body("pole").mass[0] == pytest.approx(hidden("joint_damping").declared["pole_mass"], rel=5e-3)


def test_config_is_one_that_a_fit_accepts(cart: Path, tmp_path: Path) -> None:
    noise = yaml.safe_load((cart / "out" / "config.yaml").read_text())["noise"]
    estimated = json.loads((cart / "out" / "gap.json").read_text())["noise"]
    assert noise == pytest.approx(list(estimated.values()), rel=1e-2)
    assert run("fit", cart / "out" / "config.yaml", "--out", tmp_path / "fit", "--samples", 20) == 0
    fitted = json.loads((tmp_path / "fit" / "fit.json").read_text())["parameters"]
    means = {name: entry["mean"] for name, entry in fitted.items()}
    assert means.pop("pole_mass") == pytest.approx(hidden("joint_damping").declared["pole_mass"], rel=0.05)
    assert means == {"hinge_damping": pytest.approx(0.01 + 0.02, rel=3e-3)}  # the model's own and what was missing


@pytest.mark.usefixtures("one_effect")
def test_earlier_run_is_moved_aside(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hidden().write(tmp_path)
    out = tmp_path / "out"
    assert run("gap", tmp_path / "config.yaml", "--out", out) == 0
    (out / "mine.txt").write_text("mine")
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    assert run("gap", tmp_path / "config.yaml", "--out", out) == 0
    assert (out / "mine.txt").read_text() == "mine"
    aside = {p.name: p.read_bytes() for p in (out / "previous-1").iterdir()}
    assert aside == {name: content for name, content in before.items() if name != "mine.txt"}
    assert (out / "gap.json").exists()
    assert "previous-2" not in {p.name for p in out.iterdir()}


@pytest.mark.usefixtures("one_effect")
def test_refused_log_leaves_an_earlier_run_in_place(tmp_path: Path) -> None:
    config = hidden().write(tmp_path)
    assert run("gap", config, "--out", tmp_path / "out") == 0
    simulate_truth(CART_POLE, (), 0, episodes=1, transitions=20).write(tmp_path)
    assert run("gap", config, "--out", tmp_path / "out") == 2
    assert (tmp_path / "out" / "gap.json").exists()


def test_no_data_is_refused(tmp_path: Path, refused: Callable[..., str]) -> None:
    config = hidden().write(tmp_path)
    (tmp_path / "log.npz").unlink()
    assert "log.npz" in refused("gap", config, "--out", tmp_path / "out")
    document = yaml.safe_load(config.read_text())
    del document["data"]
    config.write_text(yaml.safe_dump(document))
    assert "data" in refused("gap", config, "--out", tmp_path / "out")


def test_short_log_is_refused(tmp_path: Path, refused: Callable[..., str]) -> None:
    config = simulate_truth(CART_POLE, (), 0, episodes=1, transitions=20).write(tmp_path)
    assert "expected at least 5" in refused("gap", config, "--out", tmp_path / "out")


def test_simulator_without_a_model_is_refused(tmp_path: Path, refused: Callable[..., str]) -> None:
    config = Folder(tmp_path).config(
        backend="gymnasium", environment="adapter.py:make", model=..., frame_skip=...,
        parameters={"upper_mass": {"bounds": [1, 2]}},
    )  # fmt: skip
    assert "no MuJoCo model" in refused("gap", config, "--out", tmp_path / "out")


def test_folder_that_is_a_file_is_refused(cart: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "out").write_text("mine")
    assert "is a file" in refused("gap", cart / "config.yaml", "--out", tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


def test_own_config_is_not_replaced(cart: Path, refused: Callable[..., str]) -> None:
    before = {p: p.read_bytes() for p in cart.iterdir() if p.is_file()}
    assert "is the config of this run" in refused("gap", cart / "config.yaml", "--out", cart)
    assert {p: p.read_bytes() for p in cart.iterdir() if p.is_file()} == before


# --- from Python ----------------------------------------------------------------------------------------------


def test_functions_are_where_they_are_looked_for() -> None:
    assert dropo.gap.find_gap is find_gap
    assert dropo.gap.prepare is prepare
    assert dropo.gap.add is add


def test_add_writes_nothing_where_nothing_is_named(tmp_path: Path) -> None:
    assert add(load(hidden()), found(()), tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_a_family_is_added_member_by_member(tmp_path: Path) -> None:
    numbers = {"rail": Strength(0.7, 0.6, 0.8, "N·s/m"), "hinge": Strength(0.02, 0.01, 0.03, "N·m·s/rad")}
    family = NamedEffect("joint_damping", "*", numbers, 1.0, (), "")
    problem = make_problem(load_config(hidden("joint_damping").write(tmp_path)), general=True)
    out = tmp_path / "out"
    out.mkdir()
    assert add(problem, dataclasses.replace(found(("joint_damping",)), effects=(family,)), out) == []
    model, plain = mujoco.MjModel.from_xml_path(str(out / "model.xml")), problem.space.model
    assert plain is not None
    for joint, strength in numbers.items():
        (more,) = model.joint(joint).damping[:1] - plain.joint(joint).damping[:1]
        assert more == pytest.approx(strength.value)
    written = yaml.safe_load((out / "config.yaml").read_text())["parameters"]
    assert sum("damping" in str(entry) for entry in written.values()) >= 2


def test_the_steps_one_by_one_say_what_the_whole_says() -> None:
    problem = load(hidden("joint_damping"))
    few = [VOCABULARY[n] for n in ("joint_damping", "joint_stiffness")]
    whole = gap_package.find_gap(problem, effects=few)
    scene = gap_package.prepare(problem)
    assert gap_package.locate(scene, effects=few)[0].share > 0.9
    naming = gap_package.name(scene, effects=few)
    assert [p.key for p in naming.final.hypothesis.placed] == [(e.effect, e.target) for e in whole.effects]
    before, floor = gap_package.verify(scene, naming.base.hypothesis)
    after, _ = gap_package.verify(scene, naming.final.hypothesis)
    assert before.mse > 10 * floor.mse
    assert after.mse < 2 * floor.mse


def test_no_effects_are_not_all_effects() -> None:
    scene = scene_of()
    for step in (gap_package.locate, gap_package.name):
        with pytest.raises(InputError, match=r"^effects: none given; name at least one"):
            step(scene, effects=[])
    with pytest.raises(InputError, match=r"^effects: none given"):
        find_gap(scene.problem, effects=(), scene=scene)


def test_a_log_of_one_transition_is_told_what_is_needed() -> None:
    log = scene_of().train
    with pytest.raises(InputError, match=r"^data: .* has one transition; expected enough of them"):
        hold_out(log.select(slice(0, 1)))
    assert [len(part) for part in hold_out(log.select(slice(0, 2)))] == [1, 1]


@pytest.mark.slow
def test_a_family_of_friction_at_every_joint_is_one_effect() -> None:
    case = simulate_truth(
        TORQUE_ARM, [Effect("joint_friction", j, {"friction": f}) for j, f in FRICTION_EVERYWHERE.items()], 3, **SIZE
    )
    (told,) = search(case, ("joint_friction", "joint_damping", "actuator_delay")).effects
    assert (told.effect, told.target) == ("joint_friction", "*")
    for joint, friction in FRICTION_EVERYWHERE.items():
        assert told.parameters[joint].value == pytest.approx(friction, rel=0.05)


FRICTION_EVERYWHERE = {"yaw": 0.3, "shoulder": 0.4, "elbow": 0.2}
