"""The pages are complete, warn where they should, and stand on their own."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dropo_torch.diagnostics import Diagnostics
from dropo_torch.distribution import Distribution
from dropo_torch.fit import Fit, HistoryEntry
from dropo_torch.report import words, write_fit_report, write_sweep_report
from dropo_torch.report.figures import drawing, to_svg
from dropo_torch.report.figures.sweep import epsilon_panel
from dropo_torch.report.fit import shown_columns, worst_stretch
from dropo_torch.report.formatting import number
from dropo_torch.studies.sweep import Sweep, SweepPoint

NAMES = ("torso", "damping", "foot")


def make_distribution(names: tuple[str, ...] = NAMES) -> Distribution:
    d = len(names)
    is_log = np.arange(d) == 1
    low, high = np.where(is_log, 0.01, 0.5), np.where(is_log, 1.0, 8.0)
    mean = np.where(is_log, np.log(0.1), 3.5)
    limits = np.stack([0.1 * low, np.full(d, np.inf)], 1)
    return Distribution(names, mean, np.full(d, 0.1), low, high, limits, is_log, ("kg",) * d)


def make_fit(distribution: Distribution) -> Fit:
    stages = ["Gauss-Newton on the means"] * 3 + ["Fisher scoring on sigma points"] * 4
    values = [np.nan] * 3 + [-np.inf, -1e5, 900.0, 1000.0]
    history = tuple(
        HistoryEntry(i + 1, 50 * (i + 1), 0.1 * i, value, stage, distribution.mean, distribution.std)
        for i, (stage, value) in enumerate(zip(stages, values, strict=True))
    )
    return Fit(
        distribution, 1000.0, 1e-4, (1e-5, 1e-5), "mujoco", "fisher", 20, 7, 12, 3456, 0, 1.5, "it was done", history
    )  # fmt: skip


def make_diagnostics(distribution: Distribution, count: int = 50, columns: int = 2, factor: float = 1.0) -> Diagnostics:
    rng = np.random.default_rng(0)
    d, shape = len(distribution), (count, columns)
    simulated = np.sin(np.arange(count) / 5)[:, None] + np.zeros(shape)
    expected = np.full(shape, 0.02)
    return Diagnostics(
        labels=tuple(f"column{j}" for j in range(columns)),
        units=("rad",) * columns,
        rows=np.arange(count),
        episodes=np.arange(count) // 30,
        measured=simulated + factor * 0.02 * rng.standard_normal(shape),
        mean=simulated,
        spread=0.5 * expected,
        expected=expected,
        given=expected,
        change=np.ones(shape),
        follows=np.arange(count) < count - 1,
        at_center=simulated,
        sensitivity=np.full((d, columns), 0.004),
        standard_error=np.full(d, 0.01),
        std_error=np.full(d, 0.01),
        correlation=np.eye(d),
        confounded=(),
        diverged=0,
    )


def page(path: Path, fit: Fit | None = None, diagnostics: Diagnostics | None = None, **options: object) -> str:
    fit = fit or make_fit(make_distribution())
    diagnostics = diagnostics or make_diagnostics(fit.distribution)
    given = {"config": {"epsilon": 1e-5}, "title": "A fit"} | options
    write_fit_report(path / "report.html", fit=fit, diagnostics=diagnostics, **given)
    return (path / "report.html").read_text()


def said(fit: Fit, diagnostics: Diagnostics) -> str:
    """All that a page warns of, as text."""
    return " ".join(
        [words.judgment(fit, diagnostics).reason, *(f"{f.title}. {f.text}" for f in words.findings(fit, diagnostics))]
    )


def moved(**changes: np.ndarray) -> Fit:
    return make_fit(replace(make_distribution(), **changes))


def check_references(text: str) -> None:
    ids = re.findall(r'\bid="([^"]+)"', text)
    used = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', text))
    assert {a or b for a, b in used} <= set(ids)
    assert all(i.startswith("s") for i in ids)


def test_page_stands_on_its_own(tmp_path: Path) -> None:
    text = page(tmp_path)
    assert "http" not in text
    assert "<script" not in text
    assert not re.findall(r"<(?:link|iframe|img)\b|@import", text)
    assert all(url.startswith(("#", "data:")) for url in re.findall(r'(?:href|src)="(?!view\.html")([^"]*)"', text))
    check_references(text)
    assert text == page(tmp_path)  # the same input, the same page
    assert all(url.startswith("#") for url in re.findall(r"url\(([^)]*)\)", text))


def test_page_says_everything(tmp_path: Path) -> None:
    config = {"parameters": {"torso": {"field": "body_mass", "name": "trunk"}}, "noise": None, "data": Path("log.h5")}
    text = page(tmp_path, config=config, notes=["mind the gap"], versions={"mujoco": "4.0.1"})
    for name in NAMES:
        assert text.count(name) >= 3
    for part in ("body_mass of trunk", "data: log.h5", "mind the gap", "4.0.1", "it was done", "3,456", "column1"):
        assert part in text
    assert "The simulator explains the log." in text
    assert '<div class="card attention">' not in text
    assert text.count("<svg") == text.count("</svg>") == 3 + 2 * 2 + 2 + 3


@pytest.mark.parametrize(
    ("fit", "expected"),
    [
        (moved(mean=np.array([0.5, np.log(0.1), 3.5])), ["Mean at its lower search bound", "torso (0.5 kg)"]),
        (moved(mean=np.array([3.5, np.log(1.0), 3.5])), ["Mean at its upper search bound", "damping (1 kg)"]),
        (moved(std=np.array([0.1, 0.1, 7.5 / 4])), ["deviation at its upper bound", "only if parameters vary"]),
        (moved(std=np.array([1e-5, 0.1, 0.1])), ["deviation at its floor", "point estimate"]),
        (replace(moved(), diverged=3), ["3 simulations diverged"]),
        (replace(moved(), log_likelihood=np.nan), ["No finite likelihood"]),
    ],
)
def test_fit_warnings(fit: Fit, expected: list[str]) -> None:
    text = said(fit, make_diagnostics(fit.distribution))
    for part in expected:
        assert part in text


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"confounded": (("torso", "foot", -0.99),)}, ["torso and foot (−0.99)"]),
        ({"diverged": 1}, ["1 simulation diverged"]),
        ({"at_rest": ("elbow",)}, ["Velocities missing from the log", "elbow"]),
        ({"standard_error": np.array([0.01, 0.01, 9.0])}, ["Poorly identified means"]),
        ({"expected": np.full((50, 2), 0.002)}, ["does not explain the log in 2 of 2 columns"]),
        ({"expected": np.full((50, 2), 1.0)}, ["with margin to spare"]),  # by a wide distribution: ε is not to blame
        ({"given": np.full((50, 2), 1.0)}, ["Columns that barely count"]),
    ],
)
def test_diagnostic_warnings(changes: dict[str, object], expected: list[str]) -> None:
    fit = make_fit(make_distribution())
    text = said(fit, replace(make_diagnostics(fit.distribution), **changes))
    for part in expected:
        assert part in text


def test_warnings_stand_on_the_page(tmp_path: Path) -> None:
    distribution = make_distribution()
    fit = make_fit(replace(distribution, mean=distribution.low, std=np.array([7.5 / 4, 1e-5, 0.1])))
    pairs = tuple((f"a{i}", f"b{i}", -0.99) for i in range(30))
    diagnostics = make_diagnostics(distribution, factor=3.0)
    diagnostics = replace(diagnostics, confounded=pairs, diverged=2, standard_error=np.full(3, 9.0))
    text = page(tmp_path, fit, diagnostics)
    found = words.findings(fit, diagnostics)
    assert len(found) >= 6
    for finding in found:
        assert f"<b>{finding.title}.</b> {finding.text}" in text
    assert "Not fully explained" in text
    assert "by lowering the other" in text
    assert "and 20 more pairs" in text


def test_text_is_escaped(tmp_path: Path) -> None:
    nasty = ("<b>&$x_1$", "$", "日本 %s {{ 7 * 7 }}")
    distribution = make_distribution(nasty)
    diagnostics = replace(make_diagnostics(distribution), labels=("<i>", "a&b$c$"), confounded=((*nasty[:2], 0.99),))
    text = page(
        tmp_path, make_fit(distribution), diagnostics,
        title="<script>", notes=["<em>"], config={"<k>": "</pre>"}, versions={"<v>": "&"},
    )  # fmt: skip
    for raw in ("<script", "<i>", "<em>", "<k>", "<v>", "<b>&$", "a&b"):
        assert raw not in text
    assert text.count("</pre>") == 1
    assert "&lt;b&gt;&amp;$x_1$" in text
    assert "{{ 7 * 7 }}" in text


@pytest.mark.parametrize("count", [1, 2])
def test_few_transitions_and_no_history(tmp_path: Path, count: int) -> None:
    distribution = make_distribution(("only",))
    fit = replace(make_fit(distribution), history=())
    text = page(tmp_path, fit, make_diagnostics(distribution, count), config=None)
    assert "The parameter only was fitted" in text
    assert "Convergence" not in text
    assert "Correlation of the estimated means" not in text


def test_what_is_not_finite(tmp_path: Path) -> None:
    distribution = make_distribution()
    broken = make_diagnostics(distribution)
    measured, mean, expected = broken.measured.copy(), broken.mean.copy(), broken.expected.copy()
    mean[3, 0], measured[4, 0], expected[5, 0], expected[6, 0] = np.nan, np.inf, 0.0, np.nan
    mean[:, 1] = np.nan
    broken = replace(
        broken, measured=measured, mean=mean, expected=expected,
        sensitivity=np.array([[np.nan, 0.0], [np.inf, 1.0], [0.0, 0.0]]),
        standard_error=np.array([np.nan, np.inf, 0.0]), correlation=np.full((3, 3), np.nan),
    )  # fmt: skip
    fit = make_fit(replace(distribution, mean=np.array([np.nan, -1.0, 3.0]), std=np.array([np.nan, np.inf, 0.0])))
    text = page(tmp_path, replace(fit, log_likelihood=-np.inf, mse=np.nan, seconds=np.nan), broken)
    assert "Columns without a finite residual" in text
    assert "nan" not in re.sub(r"base64,[^\"]*", "", re.sub(r"<style>.*?</style>", "", text, flags=re.DOTALL)).lower()


def test_long_logs_and_many_columns_stay_small(tmp_path: Path) -> None:
    distribution = make_distribution()
    text = page(tmp_path, diagnostics=make_diagnostics(distribution, 10_000, 1))
    assert len(text) < 120_000
    diagnostics = make_diagnostics(distribution, 10, 60)
    diagnostics.measured[:, 50] += 1.0
    assert len(shown_columns(diagnostics)) == 24
    assert 50 in shown_columns(diagnostics)


def test_worst_stretch_finds_the_misfit() -> None:
    z = np.ones((1000, 2))
    z[700:720] = 9.0
    z[5] = np.nan  # counts, but does not hide a finite misfit's place for ever
    stretch = worst_stretch(np.delete(z, 5, axis=0), 50)
    assert stretch.start <= 699
    assert stretch.stop >= 719
    assert worst_stretch(z, 50).start <= 5


@pytest.mark.parametrize(
    ("value", "uncertainty", "text"),
    [
        (3.69374, 0.3827, "3.69"), (0.97202, 0.00029, "0.97202"), (0.0, 0.1, "0"), (-2.5, np.nan, "−2.500"),
        (np.nan, 1.0, "n/a"), (np.inf, 1.0, "∞"), (1.234e-7, np.nan, "1.234e-7".replace("-", "−")), (45.0, 12.0, "45"),
    ],
)  # fmt: skip
def test_numbers(value: float, uncertainty: float, text: str) -> None:
    assert number(value, uncertainty) == text


def test_ticks_keep_their_digits() -> None:
    figure = epsilon_panel(np.array([1e-4, 1e-2]), np.array([1.121, 1.139]), 1e-4, "y", log=False)
    assert ">1.125<" in to_svg(figure)


@pytest.mark.parametrize("first", ["plot", "scale"])
@pytest.mark.parametrize("step", [0.0, 1e-16, 3e-16, 1e-12])
@pytest.mark.parametrize("value", [1e-3, 1.0, 7.3e5])
def test_values_that_rest_but_for_rounding_are_drawn(value: float, step: float, first: str) -> None:
    """No warning that an axis has no length, and the axis has one."""
    _, axes = drawing.new_panel(340, 225, "value", (58, 36, 12, 34))
    steps: list[Callable[[], object]] = [
        lambda: axes.plot([0, 1, 2], value * np.array([1, 1 + step, 1 - step])),
        lambda: drawing.log_scale(axes, "y"),
    ]
    for act in steps if first == "plot" else steps[::-1]:
        act()
    drawing.few_ticks(axes, y=6)
    low, high = axes.get_ylim()
    assert low < 0.7 * value
    assert high > 1.4 * value


def test_sweep(tmp_path: Path) -> None:
    path = tmp_path / "sweep.html"
    of = ((1e-4, 1.0, 5.0), (1e-3, np.nan, 6.0), (1e-2, 3.0, -np.inf))
    points = tuple(SweepPoint(epsilon=e, mse=m, log_likelihood=v, mean={}, std={}) for e, m, v in of)
    sweep = Sweep(points, 1e-4, "it is <best>")
    write_sweep_report(path, sweep, use={"epsilon": 1e-4}, config={"epsilon": 1e-4}, versions={"mujoco": "4"})
    text = path.read_text()
    assert "http" not in text
    assert "it is &lt;best&gt;" in text
    assert "<pre>epsilon: 0.0001</pre>" in text
    rows = re.findall(
        r'<td class="n">([^<]*)</td><td class="n">([^<]*)</td><td class="n">([^<]*)</td><td>(.*?)</td>', text
    )
    assert rows == [("0.0001", "1.000", "5.0", "← chosen"), ("0.001", "n/a", "6.0", ""), ("0.01", "3.000", "−∞", "")]
