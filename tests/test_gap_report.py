"""The page of a gap says what is missing in its first sentence, hides nothing, and stands on its own."""

import io
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from matplotlib.colors import to_rgb
from rich.console import Console

from dropo_torch.commands.gap import _show
from dropo_torch.effects import VOCABULARY
from dropo_torch.gap.result import (
    Course,
    Gap,
    LeftOut,
    NamedEffect,
    Place,
    Ranked,
    Remaining,
    Residuals,
    Score,
    Strength,
)
from dropo_torch.report import gap_picture, gap_words, write_gap_picture, write_gap_report
from dropo_torch.report.figures.drawing import BLUE, ORANGE
from dropo_torch.report.figures.gap import running_median

JOINTS = ("shoulder", "elbow", "wrist")
LABELS = tuple(f"{kind}:{joint}" for kind in ("position", "velocity") for joint in JOINTS)
UNITS = ("rad",) * 3 + ("rad/s",) * 3
NOISE = (2.1e-4, 1.9e-4, 2.3e-4, 4.1e-3, 3.8e-3, 6.2e-3)


def score(size: float, likelihood: float) -> Score:
    rollout = tuple(size * f for f in (0.6, 1.5, 0.9, 4.0, 9.0, 7.0))
    return Score((0.04 * size) ** 2, likelihood, size, rollout)


def force(kind: str, seed: int = 0) -> Residuals:
    """A missing force of one kind, as a search would find it."""
    rng = np.random.default_rng(seed)
    speed = 2.5 * np.sin(np.linspace(0, 40, 1800)) * rng.uniform(0.3, 1, 1800)
    shape = {"dry": 0.15 * np.tanh(speed / 0.04), "spring": 0.3 * speed / 2.5, "odd": 0.1 * np.sin(3 * speed) ** 3}
    noise = 0.012 * rng.standard_normal((2, 1800))
    before = shape[kind] + noise[0]
    label = "position of wrist (rad)" if kind == "spring" else "velocity of elbow (rad/s)"
    return Residuals("wrist" if kind == "spring" else "elbow", label, "N·m", speed, before, noise[1])


FRICTION = NamedEffect(
    "joint_friction", "elbow", {"friction": Strength(0.1502, 0.1481, 0.1519, "N·m")}, 0.9991, (),
    "dry (Coulomb) friction in elbow: a constant force against any motion",
)  # fmt: skip


def single() -> Gap:
    ranking = [
        Ranked("joint_friction", "elbow", {"friction": 0.1502}, 9e-4),
        Ranked("joint_stribeck", "elbow", {"coulomb": 0.149, "static": 0.152, "velocity": 0.11}, 1.2e-3),
        Ranked("joint_damping", "elbow", {"damping": 0.31}, 0.21),
        Ranked("joint_friction", "*", {"friction": 0.05}, 0.44),
        Ranked("actuator_damping", "elbow_motor", {"damping": 0.29}, 0.22),
        Ranked("payload", "forearm", {"mass": 0.12, "x": 0.01, "y": 0.0, "z": -0.1}, 0.83),
        Ranked("gravity_tilt", None, {"roll": 0.01, "pitch": 0.002}, 0.97),
    ]
    silent = [(e, j) for e in ("joint_limit", "joint_coupling") for j in JOINTS] + [("ground_slope", None)]
    return Gap(
        where=(
            Place("joint", "elbow", 0.9994, "when the velocity of elbow is low and changes its sign"),
            Place("actuator", "elbow_motor", 0.87, "when the velocity of elbow is low"),
            Place("joint", "wrist", 0.31, "when wrist accelerates"),
            Place("world", None, 0.03, "always"),
        ),
        effects=(FRICTION,),
        before=score(0.1824, -52310.4),
        after=score(0.0121, 8142.7),
        noise_floor=score(0.0113, 8151.2),
        next_experiment="Hold shoulder still and turn wrist slowly, at less than 0.2 rad/s, back and forth.",
        found=True,
        declared={"elbow damping": (0.1, 0.3412, 0.1031), "forearm mass": (1.2, 1.31, 1.201)},
        noise=NOISE,
        labels=LABELS,
        units=UNITS,
        reduced=(412.31, 1.034),
        ranking=tuple(ranking),
        residuals=(force("dry"),),
        cannot_judge=tuple(silent),
        rollout_seconds=2.0,
        window=5,
        simulated_transitions=1_843_220,
        seconds=93.4,
        seed=3,
        notes=("The noise was estimated from windows of 5 steps.",),
    )


def double() -> Gap:
    spring = NamedEffect(
        "joint_stiffness", "wrist",
        {"stiffness": Strength(0.812, 0.774, 0.851, "N·m/rad"), "reference": Strength(0.31, 0.28, 0.34, "rad")}, 0.141,
        (("joint_coupling", "wrist"), ("external_force", "hand")),
        "a spring at wrist, such as a cable harness, that pulls it towards a rest position",
    )  # fmt: skip
    delay = NamedEffect(
        "actuator_delay", "*", {"delay": Strength(0.0121, 0.0118, 0.0123, "s")}, 0.854, (("actuator_lag", "*"),),
        "commands reach all actuators late",
    )  # fmt: skip
    first = [
        Ranked("actuator_delay", "*", {"delay": 0.0119}, 0.146),
        Ranked("actuator_lag", "*", {"time_constant": 0.014}, 0.15),
    ]
    for i, name in enumerate(("damping", "friction", "stiffness", "cogging", "stribeck")):
        first += [Ranked(f"joint_{name}", joint, {name: 0.1}, 0.4 + 0.1 * i) for joint in JOINTS]
    second = [
        Ranked("joint_stiffness", "wrist", {"stiffness": 0.812, "reference": 0.31}, 0.031, 1),
        Ranked("joint_coupling", "wrist", {"stiffness": 0.79}, 0.034, 1),
        Ranked("payload", "hand", {"mass": 0.2}, 1.3, 1),
    ]
    return replace(
        single(), effects=(delay, spring), after=score(0.0151, 8011.0), reduced=(96.2, 1.12),
        ranking=tuple(first + second), residuals=(force("spring"), force("dry", 1)), declared={},
        where=(
            Place("actuator", "*", 0.86, "while commands change fast"),
            Place("joint", "wrist", 0.2, "far from 0.31 rad"),
        ),
    )  # fmt: skip


def null() -> Gap:
    floor = score(0.0113, 8151.2)
    before = score(0.0115, 8149.9)
    return replace(
        single(), where=(), effects=(), found=False, before=before, after=before, noise_floor=floor,
        reduced=(1.02, 1.02), ranking=(), residuals=(), next_experiment=None, notes=(),
        declared={"elbow damping": (0.1, 0.1007, 0.1007)},
    )  # fmt: skip


def unnamed() -> Gap:
    base = single()
    effect = NamedEffect("unnamed", "elbow", {}, float("nan"), (), "a force at elbow that no known effect gives")
    ranking = tuple(replace(r, left=min(1.0, 0.5 + 0.1 * i)) for i, r in enumerate(base.ranking))
    return replace(
        base, effects=(effect,), after=base.before, reduced=(412.31, 412.31), ranking=ranking,
        residuals=(force("odd"),), symbolic="force(elbow) = 0.101 · sin(3.00 · velocity(elbow))³",
    )  # fmt: skip


def test_without_names_a_picture_shows_where_predictions_are_worst() -> None:
    right, wrong = (
        replace(c, before=c.measured + off, after=c.measured + off)
        for c, off in ((course("shoulder"), 0.01), (course("elbow"), 0.2))
    )
    assert gap_picture._gained(wrong) > gap_picture._gained(right) > 0


def course(label: str, seed: int = 0) -> Course:
    """Three stretches of an oscillation, which the model as given damps too little, and once blows up."""
    time = 0.01 * np.arange(101) + np.arange(3)[:, None]
    measured, drift = np.sin(4 * time + seed), 0.3 * (time - time[:, :1]) ** 2
    before = measured + np.where((time > 2.5) & (seed > 0), np.nan, drift)
    return Course(label, "rad", time, measured, before, measured + 0.01 * drift)


def test_curves_and_picture_show_what_was_predicted(tmp_path: Path) -> None:
    gap = replace(double(), courses=(course("elbow.position"), course("wrist.position", 1)))
    html = page(tmp_path, gap)
    assert html.count("as measured and as predicted") == 2
    assert "every 2.00 s" in html
    assert write_gap_picture(tmp_path / "picture.png", gap)
    drawn = image.imread(tmp_path / "picture.png")
    assert drawn.shape[:2] == (1080, 1920)
    for color in (ORANGE, BLUE):
        assert (np.abs(drawn[..., :3] - to_rgb(color)).max(-1) < 0.02).sum() > 1000
    before = (tmp_path / "picture.png").read_bytes()
    write_gap_picture(tmp_path / "picture.png", gap)
    assert (tmp_path / "picture.png").read_bytes() == before
    assert not write_gap_picture(tmp_path / "other.png", double())
    assert not (tmp_path / "other.png").exists()


def test_a_position_that_rests_but_for_rounding_is_drawn(tmp_path: Path) -> None:
    still = course("elbow.position")
    level = 0.7 + 1e-16 * np.arange(still.time.size).reshape(still.time.shape)
    resting = replace(still, measured=level, before=level + 1e-17, after=level)
    assert "as measured and as predicted" in page(tmp_path, replace(double(), courses=(resting,)))


def test_what_comes_closest_to_a_gap_without_a_name_is_told(tmp_path: Path) -> None:
    gap = unnamed()
    assert "closest" not in gap_words.answer(gap)[0]
    later = Ranked("armature", "elbow", {"armature": 0.1}, 0.01, 1)  # of what another effect has left
    near = replace(gap, ranking=(*gap.ranking, Ranked("integration", None, {"step": 5e-4}, 0.052), later))
    for gap_without in (near, replace(near, unfinished="refitting")):
        said = gap_words.answer(gap_without)[0]
        assert "(the closest, a finer integration step, leaves 5.2\N{NO-BREAK SPACE}% of it)" in said
    pair = Ranked("armature", "elbow", {"armature": 0.1}, 0.04, together=(("joint_friction", "elbow"),))
    names = "rotor or gear inertia (armature) at elbow and dry (Coulomb) friction in elbow"
    with_pair = replace(near, ranking=(*near.ranking, pair))
    assert f"(the closest, {names}, leave 4\N{NO-BREAK SPACE}% of it)" in gap_words.answer(with_pair)[0]
    assert "with dry (Coulomb) friction in elbow" in text_of(page(tmp_path, with_pair))


CASES = {"single": single, "double": double, "null": null, "unnamed": unnamed}


def page(path: Path, gap: Gap, **options: object) -> str:
    given: dict[str, object] = {
        "config": {"model": "arm.xml", "data": "log.h5", "gap": {"effects": "all"}},
        "versions": {"mujoco": "4.0.1"},
        "title": "arm: model against log",
    }
    write_gap_report(path / "report.html", gap, **(given | options))  # type: ignore[arg-type]
    return (path / "report.html").read_text()


def text_of(page: str) -> str:
    """What a reader sees, figures apart."""
    body = re.sub(r"<(style|svg).*?</\1>", " ", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", body)).replace("\u00a0", " ")


def headline(page: str) -> str:
    found = re.findall(r'<p class="answer">(.*?)</p>', page)
    assert len(found) == 1
    return str(found[0]).replace("\u00a0", " ")


@pytest.mark.parametrize("case", CASES)
def test_page_stands_on_its_own(tmp_path: Path, case: str) -> None:
    text = page(tmp_path, CASES[case]())
    assert "http" not in text
    assert "<script" not in text
    assert not re.findall(r"<(?:link|iframe|img)\b|@import", text)
    assert all(url.startswith(("#", "data:")) for url in re.findall(r'(?:href|src)="(?!view\.html")([^"]*)"', text))
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert {a or b for a, b in re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', text)} <= set(ids)
    assert not re.findall(r"\{\{|\}\}|\{%|%\}|\bNone\b", text)
    assert "nan" not in re.findall(r"[a-z]+", text_of(text).lower())
    assert str(tmp_path.parent) not in text
    assert len(text) < 250_000
    assert text == page(tmp_path, CASES[case]())  # the same input, the same page


def test_single(tmp_path: Path) -> None:
    text = page(tmp_path, single(), model_note="The model with the effect is in the file model.xml.")
    assert headline(text) == "Your model lacks dry (Coulomb) friction in elbow: 0.150 N·m (0.148 to 0.152)."
    seen = text_of(text)
    for part in (
        "With it in the model, the open-loop error over 2 s on held-out data falls from 0.182 rad to 0.0121 rad "
        "(noise floor 0.0113 rad): the gap shrank by 99.5 %.",
        "a constant force against any motion",
        "No other known effect was found that explains this log as well.",
        "99.91 %",
        "It was 412 before, and is 1.03 with the effects.",
        "joint limit : shoulder, elbow and wrist",
        "ground slope : the whole model",
        "Hold shoulder still",
        "The model with the effect is in the file model.xml.",
        "0.3412",
        f"dropo fit {tmp_path.name}/config.yaml --out DIR",
        "1,843,220",
        "4.0.1",
        "data: log.h5",
        "joint friction all joints",
    ):
        assert part in seen
    assert text.count("<svg") == text.count("</svg>") == 3 + 2
    assert text.count('class="bar wide log cold"') == 1
    assert "attention" not in re.sub(r"<style>.*?</style>", "", text, flags=re.DOTALL)


def test_what_was_not_needed_is_limited(tmp_path: Path) -> None:
    limit = LeftOut("armature", "wrist", {"armature": Strength(0.001, 0.0, 0.0042, "kg·m²")})
    gap = replace(single(), left_out=(limit,))
    text = page(tmp_path, gap)
    assert "Not needed" in text
    assert re.search(r"0\.0000? to 0\.0042?0?", text)
    assert "Not needed" not in page(tmp_path, single())


def test_double_with_ties(tmp_path: Path) -> None:
    text = page(tmp_path, double())
    assert headline(text) == "Your model lacks two things:"
    seen = text_of(text)
    for part in (
        "a delay of the commands to all actuators: 12.1 ms (11.8 to 12.3)",
        "a spring at wrist: stiffness 0.81 N·m/rad (0.77 to 0.85), reference 0.31 rad (0.28 to 0.34)",
        "This log is explained equally well by a first-order lag of all actuators, in place of a delay of the commands",
        "a spring between wrist and its parent joint or a constant external force on hand",
        "With them in the model",
        "First round",
        "Second round",
        "… and 5 more that left at least as much.",
        "more than before",
        "The config declares none",
    ):
        assert part in seen
    assert "No other known effect" not in seen
    assert text.count("<svg") == 3 + 4


def test_values_that_the_model_has_wrong_are_the_answer_where_nothing_else_is_missing(tmp_path: Path) -> None:
    fitted = {"damping": Strength(0.341, 0.33, 0.352, "N·m·s/rad"), "mass": Strength(1.21, 1.19, 1.23, "kg")}
    gap = replace(null(), declared={"damping": (0.1, 0.341, 0.341), "mass": (1.2, 1.21, 1.21)}, fitted=fitted)
    text = page(tmp_path, gap)
    assert headline(text).replace("\u00a0", " ") == (
        "Nothing is missing beside other values of parameters: damping is 0.341 N·m·s/rad (0.330 to 0.352), not 0.1."
    )
    assert "0.330 to 0.352" in text_of(text)
    beside = replace(gap, found=True, effects=single().effects)
    others = "other values of parameters: damping is 0.341 N·m·s/rad (0.330 to 0.352), not 0.1"
    sentence, items = gap_words.answer(beside)
    assert sentence.replace("\u00a0", " ").endswith(f"And it has {others}.")
    assert not items
    _, items = gap_words.answer(replace(beside, effects=double().effects))
    assert items[-1].replace("\u00a0", " ") == f"and {others}"
    assert gap.document()["declared"]["mass"] == {
        "given": 1.2, "alone": 1.21, "with_effects": 1.21, "low": 1.19, "high": 1.23
    }  # fmt: skip


def test_null(tmp_path: Path) -> None:
    text = page(tmp_path, null())
    fitted = "once the parameters of the config are fitted"
    assert headline(text) == f"Nothing is missing {fitted}: what remains is measurement noise."
    plain, _ = gap_words.answer(replace(null(), declared={}))
    assert plain == "Nothing is missing: what remains is measurement noise."
    seen = text_of(text)
    for part in (
        "The open-loop error of your model over 2 s on held-out data is 0.0115 rad (noise floor 0.0113 rad).",
        "cannot be ruled out",
        "It is 1.02 for your model",
        "fit your config as is",
        "No further motion is proposed.",
    ):
        assert part in seen
    for part in ("config.yaml", "After :", "Where it shows", "90 % interval", "gap shrank"):
        assert part not in seen


def test_unnamed(tmp_path: Path) -> None:
    text = page(tmp_path, unnamed())
    assert headline(text) == (
        f"Something is missing that none of the {len(VOCABULARY)} known effects explains; "
        "it shows at joint elbow, when the velocity of elbow is low and changes its sign."
    )
    seen = text_of(text)
    for part in ("No name", "a hint, not a claimed cause", "0.101 · sin", "no known effect gives", "not known"):
        assert part in seen
    assert "config.yaml" not in seen
    assert text.count("<svg") == 3 + 1


LEFT = Remaining(1354.7, 0.0075, 0.83, "wrist", "when wrist accelerates", 2.0)


@pytest.mark.parametrize("effects", [(FRICTION,), (FRICTION, replace(FRICTION, target="wrist"))])
def test_what_remains_is_said_in_the_first_sentence(tmp_path: Path, effects: tuple[NamedEffect, ...]) -> None:
    gap = replace(single(), effects=effects, remaining=LEFT)
    faint = gap_words.left(replace(LEFT, chi2_per_degree=1.02, open_loop=8.0))
    words = "short stretches show no more than noise, but open-loop errors are 8 times what noise makes"
    assert faint.startswith(words)
    text = page(tmp_path, gap)
    for part in (
        "not explain everything",
        "1,350 times what noise would leave",
        "mostly at wrist, when wrist accelerates",
    ):
        assert part in headline(text)
    assert "Partly explained" in text
    assert gap.document()["verdict"] == "partly explained"
    assert gap.document()["remaining"]["where"] == "wrist"
    assert "1.35e+03" in gap.document()["verdict_reason"]
    assert "everything" not in headline(page(tmp_path, replace(gap, remaining=None)))


def test_what_was_refused_a_name_is_said_in_the_first_sentence(tmp_path: Path) -> None:
    gap = replace(unnamed(), refused="inertia of hand fits best at the bound of what is physical (factor of 30)")
    text = page(tmp_path, gap)
    assert headline(text).startswith(
        "Something is missing that has no name yet: inertia of hand fits best at the bound"
    )
    assert "Inertia of hand fits best" in text_of(text)
    document = gap.document()
    assert (document["verdict"], document["verdict_reason"]) == ("unnamed", gap.refused)


def test_what_is_not_known(tmp_path: Path) -> None:
    nothing = Score(float("nan"), float("-inf"), float("inf"))
    vague = replace(FRICTION, parameters={"friction": Strength(0.15, float("nan"), float("inf"), "N·m")})
    broken = force("dry")
    broken.before[::2] = np.nan
    empty = replace(broken, after=np.full(1800, np.nan), title="nothing")
    gap = replace(
        single(), effects=(vague, replace(vague, parameters={}, share_of_gap=float("nan"), sentence="")),
        before=nothing, after=replace(nothing, rollout_rmse=float("nan")), noise_floor=nothing,
        noise=(float("nan"),) * 6, reduced=(float("inf"), float("nan")),
        residuals=(broken, empty, replace(empty, variable=np.zeros(0), before=np.zeros(0), after=np.zeros(0))),
        ranking=tuple(Ranked("payload", "hand", {"mass": v}, v) for v in (float("nan"), float("inf"), 0.0, -0.1, 2.0)),
        declared={"mass": (float("nan"), 1.0, float("inf"))}, where=(Place("joint", "elbow", float("nan"), ""),),
        seconds=float("nan"), rollout_seconds=0.0,
    )  # fmt: skip
    text = page(tmp_path, gap, config=None, versions=None)
    seen = text_of(text)
    for part in ("interval not known", "strength not known", "more than before", "∞"):
        assert part in seen
    assert "goes from ∞ (it diverges) to not known" in seen
    assert "no finite value" in text
    assert "nan" not in re.findall(r"[a-z]+", seen.lower())
    page(tmp_path, replace(gap, effects=(), where=(), residuals=(), ranking=(), labels=(), units=(), noise=()))


def test_many_places_and_long_names(tmp_path: Path) -> None:
    name = "left_arm_" + "very_long_link_name_" * 6
    places = tuple(Place("joint", f"{name}{i}", 1 / (i + 1), "at low speed") for i in range(24))
    effect = replace(FRICTION, target=name)
    gap = replace(
        single(), where=places, effects=(effect,), cannot_judge=tuple(("armature", f"j{i}") for i in range(40))
    )
    text = page(tmp_path, gap)
    assert f"{name}19" in text
    assert f"{name}20" not in text
    assert "4 more places" in text
    assert "and 28 more" in text


def test_text_is_escaped(tmp_path: Path) -> None:
    nasty = "<b>&$x_1$ {{ 7 * 7 }}"
    residuals = replace(force("dry"), title=nasty, label=nasty, unit="<i>")
    gap = replace(
        single(), effects=(replace(FRICTION, target=nasty, sentence=nasty),), residuals=(residuals,), notes=(nasty,),
        where=(Place("joint", nasty, 0.5, nasty),), symbolic=nasty, next_experiment=nasty,
    )  # fmt: skip
    text = page(tmp_path, gap, title=nasty, model_note=nasty, config={"<k>": "</pre>"})
    assert "<b>&" not in text
    assert "<i>" not in re.sub(r"<i style=[^>]*>", "", text)
    assert text.count("</pre>") == 3
    assert "&lt;b&gt;&amp;$x_1$ {{ 7 * 7 }}" in text


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (Strength(0.1502, 0.1481, 0.1519, "N·m"), "0.150 N·m (0.148 to 0.152)"),
        (Strength(0.0121, 0.0118, 0.0123, "s"), "12.1 ms (11.8 to 12.3)"),
        (Strength(1.254, 1.1, 1.4, "-"), "1.25 (1.10 to 1.40)"),
        (Strength(-0.25, -0.31, -0.19, "N"), "−0.25 N (−0.31 to −0.19)"),
        (Strength(0.0, -0.004, 0.004, "N"), "0.000 N (−0.004 to 0.004)"),
        (Strength(1234.0, 1200.0, 1270.0, "N"), "1,230 N (1,200 to 1,270)"),
        (Strength(0.15, float("nan"), 0.2, "kg"), "0.1500 kg (interval not known)"),
        (Strength(0.15, 0.1, float("inf"), "kg"), "0.1500 kg (0.1000 to ∞)"),
        (Strength(3.2e-8, 3.1e-8, 3.3e-8, "kg·m²"), "3.20e-8 kg·m² (3.10e-8 to 3.30e-8)"),
    ],
)
def test_numbers_have_the_digits_of_their_interval(number: Strength, text: str) -> None:
    assert gap_words.with_interval(number).replace("\u00a0", " ") == text.replace("e-", "e−")


@pytest.mark.parametrize("name", sorted(VOCABULARY))
@pytest.mark.parametrize("target", ["base", "*", None])
def test_every_effect_has_words(name: str, target: str | None) -> None:
    number: Mapping[str, Strength] = {"size": Strength(0.5, 0.4, 0.6, "-")}
    gap = replace(single(), effects=(NamedEffect(name, target, number, 0.9),))
    sentence, items = gap_words.answer(gap)
    of_model = name in ("actuator_gain", "actuator_stiffness", "inertia")
    unit = " times the model's" if of_model else ""
    assert sentence.replace("\u00a0", " ").endswith(f": 0.50{unit} (0.40 to 0.60).")
    assert sentence[0].isupper()
    assert not items
    assert "{" not in sentence
    assert "actuator actuator" not in sentence
    assert gap_words.noun(name, target) != gap_words.title(name)


def test_too_much_of_an_effect() -> None:
    number = {"damping": Strength(-0.02, -0.03, -0.01, "N·m·s/rad")}
    sentence, _ = gap_words.answer(replace(single(), effects=(NamedEffect("joint_damping", "elbow", number, 0.9),)))
    assert sentence.startswith("Your model has too much viscous friction in elbow: −0.02")
    both = (FRICTION, NamedEffect("joint_damping", "elbow", number, 0.9))
    sentence, items = gap_words.answer(replace(single(), effects=both))
    assert sentence == "Your model and the robot differ in two things:"
    assert items[1].startswith("viscous friction in elbow: too much in the model, −0.02")


def test_a_family_of_either_sign_is_neither_missing_nor_too_much() -> None:
    values = {"left_knee": -0.1, "right_knee": 0.2, "left_hip": 0.3}
    given = {joint: Strength(v, v - 0.01, v + 0.01, "N·m") for joint, v in values.items()}
    family = NamedEffect("joint_friction", "*", given, 0.9)
    sentence, _ = gap_words.answer(replace(single(), effects=(family,)))
    assert sentence.startswith(
        "Your model has too little or too much dry (Coulomb) friction in all joints: left_knee −0.1"
    )
    all_less = {joint: Strength(-0.1, -0.11, -0.09, "N·m") for joint in values}
    sentence, _ = gap_words.answer(replace(single(), effects=(replace(family, parameters=all_less),)))
    assert sentence.startswith("Your model has too much dry (Coulomb) friction in all joints")
    gains = NamedEffect("actuator_gain", "*", {"m": Strength(0.9, 0.8, 1.0, "-")}, 0.9)
    assert gap_words.answer(replace(single(), effects=(gains,)))[0].startswith(
        "The force of all actuators for the same"
    )


def test_a_search_that_ran_out_of_time_does_not_say_that_no_effect_explains_it(tmp_path: Path) -> None:
    seen = text_of(page(tmp_path, replace(unnamed(), unfinished="refitting")))
    assert "The time for the search was over" in seen
    assert "no known effect, alone" not in seen
    assert "an effect outside" not in seen
    assert "--resume" in seen


def test_ties_are_told_in_the_terminal(tmp_path: Path) -> None:
    console = Console(record=True, width=200, file=io.StringIO())
    _show(double(), tmp_path, console)
    text = console.export_text()
    assert (
        "This log is explained equally well by a spring between wrist and its parent joint or a constant external "
        "force on hand, in place of a spring at wrist; so may it be by a share of each."
    ) in " ".join(text.split())


@pytest.mark.parametrize(("effect", "target"), [("payload", "hand"), ("actuator_lag", "*")])
def test_the_terminal_has_all_numbers_of_which_the_sentence_gives_the_first(
    effect: str, target: str, tmp_path: Path
) -> None:
    console = Console(record=True, width=200, file=io.StringIO())
    numbers = {"mass": Strength(0.9, 0.89, 0.91, "kg")} | {a: Strength(v, v - 0.01, v + 0.01, "m") for a, v in
                                                           {"x": 0.01, "y": -0.02, "z": 0.12}.items()}  # fmt: skip
    _show(replace(single(), effects=(NamedEffect(effect, target, numbers, 1.0),)), tmp_path, console)
    text = console.export_text().replace("\u00a0", " ")
    assert "more in the table" in text
    assert all(value in text for value in ("0.900 kg (0.890 to 0.910)", "0.120 m (0.110 to 0.130)"))


@pytest.mark.parametrize(
    ("when", "text"),
    [
        ("when elbow is slow", ", when elbow is slow"),
        ("always", ", always"),
        ("", ""),
    ],
)
def test_when(when: str, text: str) -> None:
    gap = replace(single(), where=(Place("joint", "elbow", 0.5, when),))
    assert gap_words.shows(gap) == f"it shows at joint elbow{text}"


def test_the_command_to_go_on_names_the_folder_as_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs/arm").mkdir(parents=True)
    assert "dropo fit runs/arm/config.yaml --out DIR" in page(Path("runs/arm"), single())
    assert "config.yaml" not in page(Path("runs/arm"), single(), has_config=False)


def test_running_median_follows_a_step() -> None:
    x = np.linspace(-1, 1, 400)
    middle, median = running_median(x, np.sign(x))
    assert len(middle) == 40
    assert set(median) == {-1.0, 1.0}
    assert running_median(x[:3], x[:3])[1].shape == (1,)
