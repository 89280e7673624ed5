"""Friction, inertia, offset and delay at all joints of a leg: found together, and only where several joints lack them.

The log is made by plain MuJoCo: a leg with servos, of which the model given has neither friction nor rotors.
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import dropo_torch as dropo
from benchmarks.hidden.systems import SERVO_ARM
from benchmarks.hidden.truths import Effect, simulate_truth
from dropo_torch.effects import VOCABULARY, Placed
from dropo_torch.errors import InputError
from dropo_torch.gap import Gap, NamedEffect, Strength, find_gap, open_loop
from dropo_torch.gap import family as members
from dropo_torch.gap.evidence import Cost, Linearization
from dropo_torch.gap.family import base_family
from dropo_torch.gap.ground import Ground
from dropo_torch.gap.limbs import alike, by_limbs, joint_of
from dropo_torch.gap.refit import Hypothesis, Refit
from dropo_torch.gap.rules import Rules, family_accounts
from dropo_torch.gap.scene import prepare
from dropo_torch.gap.search import Naming, leaves_wrong, resort, start
from dropo_torch.gap.shares import shares_of
from dropo_torch.gap.spare import excesses, not_needed, of_all_joints, pushing, without_steps
from dropo_torch.report.gap_words import answer, by_joint

Triple = tuple[float, ...]
NONE: Triple = (0.0, 0.0, 0.0)
JOINTS = ("hip", "knee", "ankle")
DAMPING, FRICTION, ROTOR, OFFSET = (0.3, 0.25, 0.1), (0.5, 0.4, 0.2), (0.02, 0.03, 0.01), (0.2, -0.3, 0.1)
NOISE, STEP, ROWS = (4e-4, 1e-2), 0.0025, 1600


def leg(damping: Triple = NONE, friction: Triple = NONE, rotor: Triple = NONE, offset: Triple = NONE) -> str:
    """MJCF of a hanging leg of three joints with position servos."""
    inside = ""
    for i in (2, 1, 0):
        inside = (
            f'<body pos="0 0 {-0.25 if i else 0}"><joint name="{JOINTS[i]}" axis="0 1 0" damping="{damping[i]}" '
            f'frictionloss="{friction[i]}" armature="{rotor[i]}"/>'
            f'<geom type="capsule" size=".03" fromto="0 0 0 0 0 -.2" mass="{1.2 - 0.3 * i}"/>{inside}</body>'
        )
    servos = "".join(
        f'<general name="{n}_servo" joint="{n}" biastype="affine" gainprm="25" biasprm="{offset[i]} -25 -1"/>'
        for i, n in enumerate(JOINTS)
    )
    return (
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/>'
        '<default><geom contype="0" conaffinity="0"/></default>'
        f"<worldbody>{inside}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def record(
    folder: Path, seed: int, *, slope: Triple = NONE, late: Triple = NONE, pushed: Triple = NONE, **truth: Triple
) -> Path:
    """Write a noisy log of chirps of a leg with some truth, and a config with the leg as given.

    Dry friction that changes along the range, by a slope, is written into the model before each step. Commands act some
    logged rows ``late``. Joints are ``pushed`` by forces of that size which wander, as nothing that has a name does.
    """
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(leg(**truth))
    data = mujoco.MjData(model)
    friction = model.dof_frictionloss.copy()
    time = 0.005 * np.arange(ROWS + 1)
    phase = 2 * np.pi * (0.3 * time + 0.15 * time**2)
    targets = 0.5 * np.sin(phase[:, None] * rng.uniform(0.8, 1.2, 3) + rng.uniform(0, 6, 3))
    rows, wander = [], np.random.default_rng(seed + 1)
    rate, phases = wander.uniform(1, 12, (8, 3)), wander.uniform(0, 6, (8, 3))
    for row in range(len(targets)):
        rows.append(np.concatenate([data.qpos, data.qvel]))
        data.qfrc_applied[:] = pushed * np.sin(rate * time[row] + phases).mean(0)
        data.ctrl[:] = targets[np.maximum(row - np.array(late, dtype=int), 0), range(3)]
        for _ in range(2):
            model.dof_frictionloss[:] = friction + slope * data.qpos
            mujoco.mj_step(model, data)
    observations = np.array(rows) + rng.standard_normal((len(rows), 6)) * np.repeat(NOISE, 3)
    np.savez(folder / "leg.npz", observations=observations, actions=targets, terminals=np.arange(len(rows)) == ROWS)
    (folder / "leg.xml").write_text(leg())
    path = folder / "leg.yaml"
    path.write_text("model: leg.xml\ndata: {path: leg.npz, dt: 0.005}\nobservation: ['qpos', 'qvel']\nthreads: 1\n")
    return path


@functools.cache
def found(**truth: Triple) -> Gap:
    with tempfile.TemporaryDirectory() as folder:
        path = record(Path(folder), 11, **truth)
        return find_gap(dropo.make_problem(dropo.load_config(path), general=True))


def everything() -> Gap:
    return found(damping=DAMPING, friction=FRICTION, rotor=ROTOR, offset=OFFSET)


def told(gap: Gap) -> dict[tuple[str, str], float]:
    """The first number of each named effect, by effect and joint."""
    numbers: dict[tuple[str, str], float] = {}
    for e in gap.effects:
        members = e.parameters if e.target == "*" else {str(e.target): next(iter(e.parameters.values()))}
        numbers |= {(e.effect, t.removesuffix("_servo")): s.value for t, s in members.items()}
    return numbers


@pytest.mark.parametrize(
    ("effect", "true", "within"),
    [("joint_damping", DAMPING, 0.1), ("joint_friction", FRICTION, 0.05), ("armature", ROTOR, 0.1)],
)
def test_what_every_joint_lacks_is_found_at_every_joint(effect: str, true: Triple, within: float) -> None:
    numbers = told(everything())
    assert [numbers.get((effect, j)) for j in JOINTS] == pytest.approx(true, rel=within)


def test_the_offsets_of_a_leg_are_found_and_no_delay_is() -> None:
    numbers = told(everything())
    assert [numbers.get(("actuator_bias", j)) for j in JOINTS] == pytest.approx(OFFSET, rel=0.1)
    assert not any(effect == "actuator_delay" for effect, _ in numbers)


def test_a_delay_of_one_servo_is_found_there_and_no_inertia_or_damping_in_its_place() -> None:
    numbers = told(found(damping=DAMPING, friction=FRICTION, rotor=ROTOR, offset=OFFSET, late=(0, 3, 0)))
    assert {key: n for key, n in numbers.items() if key[0] == "actuator_delay"} == {
        ("actuator_delay", "knee"): pytest.approx(0.015, rel=0.1)
    }
    assert [numbers["joint_damping", j] for j in JOINTS] == pytest.approx(DAMPING, rel=0.1)
    assert [numbers["armature", j] for j in JOINTS] == pytest.approx(ROTOR, rel=0.15)


def test_no_delay_is_found_where_what_has_no_name_would_be_a_little_less_with_one() -> None:
    """The friction, the inertia and the offsets are, although more is left than noise."""
    gap = found(damping=DAMPING, friction=FRICTION, rotor=ROTOR, offset=OFFSET, pushed=(0.12, 0.12, 0.05))
    numbers = told(gap)
    assert gap.reduced[1] > 2
    assert not any(effect == "actuator_delay" for effect, _ in numbers)
    for effect, true, within in (
        ("joint_damping", DAMPING, 0.3),
        ("joint_friction", FRICTION, 0.2),
        ("armature", ROTOR, 0.4),
    ):
        assert [numbers[effect, j] for j in JOINTS] == pytest.approx(true, rel=within)


@pytest.mark.parametrize(("count", "whole"), [(6, True), (5, True), (4, False), (2, False)])
def test_what_nearly_all_joints_need_all_joints_have(count: int, whole: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = [VOCABULARY["armature"], VOCABULARY["joint_damping"]]
    monkeypatch.setattr(type(kinds[0]), "targets", lambda effect, setting: list("abcdef"))
    monkeypatch.setattr(type(kinds[1]), "targets", lambda effect, setting: list("abcdef"))
    placed: Any = [SimpleNamespace(effect=kind, key=(n, joint)) for n, kind in enumerate(kinds) for joint in "abcdef"]
    idle = [*placed[count:6], *placed[6:]]
    ground: Any = SimpleNamespace(setting=None, rules=Rules())
    assert of_all_joints(ground, placed, idle) == ({p.key for p in placed[:6]} if whole else set())


def test_what_a_family_does_without_is_limited() -> None:
    """The limits hold the truth: nothing of a rotor where there is none, and what is too little for a name."""
    gap = found(damping=DAMPING, friction=FRICTION, rotor=(0.02, 2e-5, 0.0), offset=(0.2, -0.3, 2e-4))
    allowed = {(e.effect, str(e.target).removesuffix("_servo")): e.parameters for e in gap.left_out}
    assert not {*allowed} & {*told(gap)}
    wide = {"armature": 2e-3, "actuator_bias": 0.01, "actuator_delay": 2e-3}
    for effect, joint, true in (
        ("armature", "knee", 2e-5), ("armature", "ankle", 0.0), ("actuator_bias", "ankle", 2e-4),
        ("actuator_delay", "hip", 0.0), ("joint_friction_slope", "knee", 0.0),
    ):  # fmt: skip
        (limit,) = allowed[effect, joint].values()
        assert limit.low - 1e-9 <= true <= limit.high
        assert limit.high - limit.low < wide.get(effect, 0.1)
    assert gap.document()["left_out"][0].keys() == {"effect", "target", "parameters"}


def test_a_leg_with_its_base_family_predicts_nearly_as_well_as_its_sensors_allow() -> None:
    gap = everything()
    assert gap.after.rollout_rmse < 3 * gap.noise_floor.rollout_rmse < 0.1 * gap.before.rollout_rmse
    assert gap.reduced[1] < 1.1 < 100 < gap.reduced[0]


def test_dry_friction_that_changes_along_the_range_is_found_where_it_does() -> None:
    gap = found(damping=DAMPING, friction=FRICTION, rotor=ROTOR, offset=OFFSET, slope=(0, 0.35, 0))
    numbers = told(gap)
    assert numbers["joint_friction_slope", "knee"] == pytest.approx(0.35, rel=0.1)
    assert [numbers["joint_friction", j] for j in JOINTS] == pytest.approx(FRICTION, rel=0.1)
    assert [key for key in numbers if key[0] == "joint_friction_slope"] == [("joint_friction_slope", "knee")]
    assert not any(effect == "joint_friction_slope" for effect, _ in told(everything()))
    assert gap.after.rollout_rmse < 4 * gap.noise_floor.rollout_rmse


@pytest.mark.parametrize(("slope", "pushes"), [(0.7, False), (0.9, True), (-0.7, False), (-0.9, True)])
def test_dry_friction_never_pushes(slope: float, pushes: bool, tmp_path: Path) -> None:
    setting = prepare(dropo.make_problem(dropo.load_config(record(tmp_path, 3)), general=True)).setting
    far = float(np.abs(setting.signals.position[setting.coordinate("knee")]).max())
    members = [Placed(VOCABULARY["joint_friction"], "knee", (0.8 * far,)),
               Placed(VOCABULARY["joint_friction_slope"], "knee", (slope,))]  # fmt: skip
    assert pushing(setting, Hypothesis((), tuple(members))) == (members[1:] if pushes else [])


def test_open_loop_errors_beside_those_of_constant_velocity(tmp_path: Path) -> None:
    scene = prepare(dropo.make_problem(dropo.load_config(record(tmp_path, 5)), general=True))
    (near, still), (far, later) = (open_loop(scene, scene.begin, seconds) for seconds in (0.1, 1.0))
    assert near < 2e-3 < still < later
    assert far < 0.01 * later
    with pytest.raises(InputError, match=r"open loop: no trajectory of .* lasts 60 s; at most"):
        open_loop(scene, scene.begin, 60)


def test_what_one_joint_lacks_makes_no_family() -> None:
    gap = found(damping=(0, 0.25, 0), friction=(0, 0.4, 0))
    assert {joint for _, joint in told(gap)} == {"knee"}


def test_what_only_makes_up_for_the_step_is_no_member() -> None:
    """Dry friction is resolved by the model's step only so well: beside it, an offset seems to be needed."""
    truth = [Effect("joint_friction", "shoulder", {"friction": 1.0}),
             Effect("actuator_delay", "elbow_servo", {"delay": 0.003})]  # fmt: skip
    case = simulate_truth(SERVO_ARM, truth, 3, noise=0.3, episodes=4, transitions=100)
    with tempfile.TemporaryDirectory() as folder:
        scene = prepare(dropo.make_problem(dropo.load_config(case.write(folder)), general=True))
    evidence = dataclasses.replace(scene.evidence, noise=np.array(case.noise))
    ground = Ground(evidence, tuple(VOCABULARY.values()))
    true = [(e.name, e.target, tuple(e.parameters.values())) for e in truth]
    more = [("actuator_bias", "shoulder_servo", (0.0,)), ("armature", "elbow", (0.0,))]
    placed = tuple(Placed(VOCABULARY[effect], target, values) for effect, target, values in (*true, *more))
    whole = ground.refit(Hypothesis(tuple(case.declared.values()), placed))
    least = 4 * whole.cost.sigma / np.sqrt(ground.part.chart.size)
    assert not_needed(ground, whole, excesses(ground, whole) + least) == []
    assert {p.key for p in without_steps(ground, whole).hypothesis.placed} == {p.key for p in placed[:2]}


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(
    ("truth", "is_family"),
    [({"damping": DAMPING, "friction": FRICTION, "rotor": ROTOR}, True), ({"friction": (0, 0.4, 0)}, False)],
)
def test_the_family_is_the_last_resort(truth: dict[str, Triple], is_family: bool, named: bool, tmp_path: Path) -> None:
    """Where no search has names, or one that leaves what is wrong, what all joints lack has them.

    What one joint lacks has none.
    """
    scene = prepare(dropo.make_problem(dropo.load_config(record(tmp_path, 11, **truth)), general=True))
    ground = Ground(scene.evidence, tuple(VOCABULARY.values()), short=scene.noisy)
    begun = start(ground, scene.begin)
    nameless = Naming(ground.at(begun).evidence, begun.base, begun.first, begun.base, gap=True, refused="no")
    if named:
        rubbing = Placed(VOCABULARY["joint_friction"], "knee", (0.1,))
        final = ground.at(begun).refit(begun.base.hypothesis.with_effects([rubbing]))
        nameless = dataclasses.replace(nameless, named=True, final=final)
        assert leaves_wrong(nameless, ground) == is_family
        assert not leaves_wrong(dataclasses.replace(nameless, partial=True), ground)
    naming = resort(ground, nameless)
    assert naming.family == is_family
    assert naming.named == (is_family or named)
    if is_family:
        assert naming.refused == ""
        assert {p.effect.name for p in naming.final.hypothesis.placed} >= {"armature", "joint_soft_friction"}
    else:
        assert naming is nameless


@pytest.mark.parametrize(
    ("left", "reduced", "enough"), [(0.04, 10.0, True), (0.06, 10.0, False), (0.04, 100.0, True), (0.06, 100.0, False)]
)
def test_a_family_leaves_little_of_what_is_missing(left: float, reduced: float, enough: bool) -> None:
    def fitted(excess: float, degrees: float) -> Refit:
        empty = np.zeros((1, 0))
        linear = Linearization(np.zeros((1, 0, 0)), empty, empty, 0.0)
        cost = Cost(np.array([excess + degrees]), np.zeros(1), degrees)
        return Refit(Hypothesis((), ()), cost, empty, np.zeros((0, 1, 0)), linear, np.zeros(0), np.ones(1))

    degrees = 1e3
    whole = fitted((reduced - 1) * degrees, degrees)
    assert family_accounts(whole, fitted(whole.cost.excess / left, degrees), Rules()) == enough


CRANK = """<mujoco><option timestep=".0025" integrator="implicitfast"/><worldbody><body>
  <joint name="crank" axis="0 1 0" damping="{}" frictionloss="{}" armature="{}"/>
  <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.3" mass="1" contype="0"/></body></worldbody>
  <actuator><general name="motor" joint="crank" biastype="affine" biasprm="{}"/></actuator></mujoco>"""


def test_the_only_joint_of_a_robot_has_the_family_at_once(tmp_path: Path) -> None:
    """No round adds one member after another."""
    truth, rng = (0.15, 0.4, 0.02, 0.25), np.random.default_rng(8)
    model, time = mujoco.MjModel.from_xml_string(CRANK.format(*truth)), 0.005 * np.arange(ROWS + 1)
    model.dof_solimp[:], model.dof_solref[:] = (0.999, 0.9999, 0.001, 0.5, 2.0), (0.005, 1.0)
    data, rows = mujoco.MjData(model), []
    torque = (2.2 * np.sin(np.outer(time, rng.uniform(1, 9, 5)) + rng.uniform(0, 6, 5))).mean(1, keepdims=True) * 1.6
    for row in range(ROWS + 1):
        rows.append([data.qpos[0], data.qvel[0]])
        data.ctrl[:] = torque[row]
        mujoco.mj_step(model, data, 2)
    observations = np.array(rows) + NOISE * rng.standard_normal((ROWS + 1, 2))
    np.savez(tmp_path / "crank.npz", observations=observations, actions=torque, terminals=np.arange(ROWS + 1) == ROWS)
    (tmp_path / "crank.xml").write_text(CRANK.format(0, 0, 0, 0))
    (tmp_path / "crank.yaml").write_text("model: crank.xml\ndata: {path: crank.npz, dt: 0.005}\nthreads: 1\n")
    gap = find_gap(dropo.make_problem(dropo.load_config(tmp_path / "crank.yaml"), general=True))
    names = ("joint_damping", "joint_friction", "armature", "actuator_bias")
    values = {e.effect: next(iter(e.parameters.values())).value for e in gap.effects}
    assert values == pytest.approx(dict(zip(names, truth, strict=True)), rel=0.1)
    assert set(gap.joints.values()) == {"crank"}
    assert {r.round for r in gap.ranking} == {0}


def test_a_leg_that_lacks_nothing_has_no_gap() -> None:
    assert not found().found


def test_the_answer_speaks_joint_by_joint() -> None:
    _, items = answer(everything())
    assert len(items) == len(JOINTS)
    assert [item.split(":")[0] for item in items] == list(JOINTS)
    assert all("friction" in item and "inertia" in item for item in items)


def test_each_member_of_the_family_sits_at_a_joint(tmp_path: Path) -> None:
    path = record(tmp_path, 3)
    setting = prepare(dropo.make_problem(dropo.load_config(path), general=True)).setting
    family = base_family(setting)
    assert len(family) == 5 * len(JOINTS)
    assert {joint_of(setting, p) for p in family} == {0, 1, 2}
    assert all(len(p.values) == 1 and p.effect.name in VOCABULARY for p in family)


def test_what_the_model_has_too_much_of_is_said_at_its_joint() -> None:
    """A model with published rotors and frictions may have more of them than the robot."""
    less = NamedEffect(
        "armature", "*", {"hip": Strength(-0.1, -0.2, -0.05, "kg·m²"), "knee": Strength(0.1, 0, 1, "")}, 0
    )
    items = by_joint([less], {"hip": "hip", "knee": "knee"})
    assert items[0].startswith("hip: rotor inertia too much in the model, −0.1")
    assert "too much" not in items[1]


def test_a_family_of_which_nothing_is_left_weighs_nothing(tmp_path: Path) -> None:
    """All members at bounds of physics are dropped: then there are neither numbers nor derivatives."""
    scene = prepare(dropo.make_problem(dropo.load_config(record(tmp_path, 3)), general=True))
    ground = Ground(scene.evidence, tuple(VOCABULARY.values()))
    assert not_needed(ground, ground.refit(scene.begin), np.inf) == []
    assert shares_of(ground, ground.refit(scene.begin)) == ()


@pytest.mark.parametrize(("softer", "judged"), [(False, 1), (True, 3)])
def test_members_are_judged_once_after_what_refines_them(
    softer: bool, judged: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each judgment may spare members that explain a few hundredths of what is left; slopes are judged as they come."""
    found: list[object] = []
    first, soft, sloped = (SimpleNamespace(hypothesis=None) for _ in range(3))
    monkeypatch.setattr(members, "fitted_family", lambda *_: first)
    monkeypatch.setattr(members, "needed", lambda _, fit: found.append(fit) or fit)
    monkeypatch.setattr(members, "with_soft_friction", lambda _, fit: soft if softer else fit)
    monkeypatch.setattr(members, "with_slopes", lambda *_: sloped)
    monkeypatch.setattr(members, "without_steps", lambda _, fit: fit)
    monkeypatch.setattr(members, "spread_out", lambda *_: True)
    ground: Any = SimpleNamespace(setting=None, rules=Rules())
    assert members.whole_family(ground, members.fitted_family(ground, Hypothesis(()))) is (soft if softer else sloped)
    assert len(found) == judged


@pytest.mark.parametrize(("left", "looked"), [(0.9, False), (0.2, True)])
def test_members_are_not_judged_where_all_of_them_leave_too_much(
    left: float, looked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: list[object] = []
    whole: Any = SimpleNamespace(cost=SimpleNamespace(left_of=lambda _: left))
    monkeypatch.setattr(members, "has_family", lambda _: True)
    monkeypatch.setattr(members, "joints_of", lambda _: {0, 1})
    monkeypatch.setattr(members, "significant", lambda *_: True)
    monkeypatch.setattr(members, "one_kind", lambda _: False)
    monkeypatch.setattr(members, "extend", lambda _, found: found)
    monkeypatch.setattr(members, "is_of_step", lambda *_: False)
    monkeypatch.setattr(members, "with_one_more", lambda *_: [])
    monkeypatch.setattr(members, "leaves_too_much", lambda *_: False)
    monkeypatch.setattr(members, "fitted_family", lambda *_: whole)
    monkeypatch.setattr(members, "whole_family", lambda _, fit: judged.append(fit))
    few: Any = SimpleNamespace(
        current=SimpleNamespace(cost=SimpleNamespace(left_of=lambda _: 0.5), hypothesis=None), done=False
    )
    before: Any = SimpleNamespace(base=SimpleNamespace(cost=None, hypothesis=None))
    assert members.with_family(SimpleNamespace(rules=Rules()), before, few) is few  # type: ignore[arg-type]
    assert bool(judged) == looked


@pytest.mark.parametrize(
    ("left", "next_one", "is_family"), [(0.1, 50.0, False), (0.1, 98.0, True), (0.1, 500.0, True), (0.5, 50.0, True)]
)
def test_the_family_is_none_where_one_effect_more_leaves_less(
    left: float, next_one: float, is_family: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A delay at all joints hides a payload, of which every member of the family would take a part.

    One that leaves about as much may be a member itself.
    """

    def fit(excess: float, left: float) -> Any:
        cost = SimpleNamespace(excess=excess, misfit=excess, sigma=1.0, left_of=lambda _: left)
        return SimpleNamespace(cost=cost, hypothesis=hypothesis)

    hypothesis: Any = SimpleNamespace(placed=(object(),))
    tried = [fit(next_one, 0.1)]
    for name, made in {
        "has_family": True, "significant": True, "one_kind": True, "is_of_step": False, "leaves_too_much": False,
        "nearer": None,
        "fitted_family": fit(100.0, 0.3), "whole_family": fit(100.0, 0.3), "sound": tried,
    }.items():  # fmt: skip
        monkeypatch.setattr(members, name, lambda *_, made=made: made)
    ground: Any = SimpleNamespace(
        rules=Rules(), screened=lambda _: [], focus=lambda _: None, refits=lambda *_: (tried, None)
    )
    base = SimpleNamespace(cost=None, hypothesis=None)
    first: Any = Ended(current=fit(1000.0, left), base=base)
    assert members.with_family(ground, SimpleNamespace(base=base), first).family == is_family  # type: ignore[arg-type]


@pytest.mark.parametrize(("numbers", "left", "is_plainer"), [(5, 0.3, True), (6, 0.3, False), (5, 0.5, False)])
def test_a_family_of_as_few_numbers_is_plainer(numbers: int, left: float, is_plainer: bool) -> None:
    """A payload takes in so much of what two joints lack that their family leaves a tenth of what it leaves."""

    def fit(numbers: int, left: float) -> Any:
        cost = SimpleNamespace(left_of=lambda _: left)
        return SimpleNamespace(cost=cost, hypothesis=SimpleNamespace(vector=np.zeros(numbers)))

    ground: Any = SimpleNamespace(rules=Rules())
    assert members.is_plainer(ground, [fit(4, 0.1)], fit(numbers, left)) == is_plainer
    assert not members.is_plainer(ground, [], fit(numbers, left))


def test_no_family_is_fitted_where_one_effect_more_leaves_noise_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Delays at all joints and one weak motor: as many members as joints would take most of the time."""

    def fit(excess: float) -> Any:
        return SimpleNamespace(
            cost=SimpleNamespace(excess=excess, left_of=lambda other: excess / other.excess), hypothesis=hypothesis
        )

    hypothesis: Any = SimpleNamespace(placed=(object(),))
    base, tried = fit(10_000.0), [fit(1.0)]
    for name, made in {"has_family": True, "one_kind": True, "is_of_step": False, "nearer": None}.items():
        monkeypatch.setattr(members, name, lambda *_, made=made: made)
    monkeypatch.setattr(members, "significant", lambda cost, rules: cost.excess > 2)
    monkeypatch.setattr(members, "sound", lambda *_: tried)
    monkeypatch.setattr(members, "beats", lambda *_: True)
    monkeypatch.setattr(members, "leaves_too_much", lambda *_: pytest.fail("a family was fitted"))
    ground: Any = SimpleNamespace(
        rules=Rules(), screened=lambda _: [], focus=lambda _: None, refits=lambda *_: (tried, None)
    )
    first: Any = Ended(current=fit(100.0), base=base)
    found = members.with_family(ground, SimpleNamespace(base=base), first)  # type: ignore[arg-type]
    assert found.current is tried[0]
    assert not found.family


def test_what_is_of_the_models_own_step_asks_for_no_family(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inertia, friction and delay of every joint make up for what a coarse step does to stiff servos."""
    for name in ("has_family", "significant", "one_kind", "is_of_step"):
        monkeypatch.setattr(members, name, lambda *_: True)
    monkeypatch.setattr(members, "fitted_family", lambda *_: pytest.fail("a family was fitted"))
    cost = SimpleNamespace(left_of=lambda _: 0.5)
    first: Any = SimpleNamespace(current=SimpleNamespace(cost=cost, hypothesis=None), done=False)
    before: Any = SimpleNamespace(base=SimpleNamespace(cost=None, hypothesis=None))
    assert members.with_family(SimpleNamespace(rules=Rules()), before, first) is first  # type: ignore[arg-type]


def test_a_delay_at_all_joints_and_a_payload_are_found_together(tmp_path: Path) -> None:
    """The payload explains most by itself, with wrong numbers; the delays then show as a family, and not one by one."""
    spec, late, rng = mujoco.MjSpec.from_string(leg()), 4, np.random.default_rng(3)
    spec.bodies[-1].add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.005, 0, 0], pos=[0.02, 0, -0.2], mass=0.5)
    model = spec.compile()
    data, time = mujoco.MjData(model), 0.005 * np.arange(ROWS + 1)
    phase = 2 * np.pi * (0.3 * time + 0.15 * time**2)
    targets = 0.5 * np.sin(phase[:, None] * rng.uniform(0.8, 1.2, 3) + rng.uniform(0, 6, 3))
    rows = []
    for i in range(len(targets)):
        rows.append(np.concatenate([data.qpos, data.qvel]))
        data.ctrl[:] = targets[max(i - late, 0)]
        mujoco.mj_step(model, data, 2)
    observations = np.array(rows) + rng.standard_normal((len(rows), 6)) * np.repeat(NOISE, 3)
    path = record(tmp_path, 0)
    np.savez(tmp_path / "leg.npz", observations=observations, actions=targets, terminals=np.arange(len(rows)) == ROWS)
    gap = find_gap(dropo.make_problem(dropo.load_config(path), general=True))
    found = {e.effect: {k: s.value for k, s in e.parameters.items()} for e in gap.effects}
    assert set(found) == {"actuator_delay", "payload"}
    assert list(found["actuator_delay"].values()) == pytest.approx([0.02] * 3, abs=1e-4)
    assert found["payload"]["mass"] == pytest.approx(0.5, rel=0.02)


@dataclasses.dataclass(frozen=True)
class Ended:
    """As much of a state as the family looks at."""

    current: Any
    done: bool = False
    family: bool = False
    refused: str = ""
    base: Any = None


LEG = """
<body name="{n}_thigh" pos="{x} 0 0"><joint name="{n}_hip" axis="0 {s} 0" damping=".1" range="-{r} 1"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2" mass=".5"/>
  <body pos="0 0 -.2"><joint name="{n}_knee" axis="0 1 0" damping=".1"/>
    <geom type="capsule" size=".01" fromto="0 0 0 0 0 -.2" mass="{m}"/></body></body>"""


def legs(*masses: float) -> mujoco.MjModel:
    text = "".join(LEG.format(n=n, x=0.2 * n, s=(-1) ** n, r=1 + n, m=m) for n, m in enumerate(masses))
    servos = "".join(f'<motor name="{n}_servo" joint="{n}_knee"/>' for n in range(len(masses)))
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body><freejoint/><geom size=".1" mass="4"/>{text}</body></worldbody>
        <actuator>{servos}</actuator></mujoco>"""
    )


def test_joints_of_mirrored_legs_are_alike_and_those_of_another_leg_are_not() -> None:
    names = [[legs(0.2, 0.2, 0.2).joint(j).name for j in group] for group in alike(legs(0.2, 0.2, 0.2))]
    assert names == [["0_hip", "1_hip", "2_hip"], ["0_knee", "1_knee", "2_knee"]]
    model = legs(0.2, 0.3, 0.2)  # the middle leg has a heavier shank
    assert [[model.joint(j).name for j in group] for group in alike(model)] == [
        ["0_hip", "2_hip"],
        ["0_knee", "2_knee"],
    ]
    assert alike(legs(0.2)) == []


def test_effects_are_tried_at_one_joint_of_each_leg() -> None:
    model = legs(0.2, 0.2)
    setting: Any = SimpleNamespace(model=model, joint=lambda target: model.joint(target).id)
    friction = [Placed(VOCABULARY["joint_friction"], j, (0.1,)) for j in ("0_hip", "0_knee", "1_hip", "1_knee")]
    assert by_limbs(setting, friction) == [[0, 2], [1, 3]]
    assert by_limbs(setting, friction[:3]) == [[0, 2]]
    gains = [Placed(VOCABULARY["actuator_gain"], f"{n}_servo", (0.9,)) for n in range(2)]
    assert by_limbs(setting, gains) == []  # they are at all actuators
    assert by_limbs(setting, [Placed(VOCABULARY["gravity_tilt"], None, (0.0, 0.0))]) == []
