"""What the studies of arms that manipulate make of cells whose results are known."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dropo_sims.manipulation import Cell, all_cells, config_of, identifiability, realized
from dropo_sims.manipulation_tables import all_findings, beyond_box, label, optimizer_rows, sections, write_results
from dropo_sims.puck.study import STUDY as PUCK
from dropo_sims.push.study import STUDY as PUSH

from dropo_torch.baselines import make_search
from dropo_torch.config import make_config
from dropo_torch.distribution import DRAWN_STD
from dropo_torch.models.bundled import bundled_study
from dropo_torch.problem import make_problem
from dropo_torch.studies.recovery import pick, recovery_rows

STUDIES = {"push": PUSH, "puck": PUCK}
each = pytest.mark.parametrize("name", STUDIES)
TRUTH, PARAMETERS = PUSH.truth, PUSH.about.sim.parameters
STD = 0.1


def result(cell: Cell, factor: float = 1.0, width: float = 1.0) -> dict[str, Any]:
    """A cell's result: means off by a factor, standard deviations of the draws by another."""
    varies = cell.variant == "distribution"
    found = {}
    for name, value in TRUTH.items():
        low, high = PARAMETERS[name]["bounds"]
        found[name] = {"mean": factor * value, "std": width * STD * value / DRAWN_STD, "low": low, "high": high}
    fit = {"parameters": found, "mse": 1e-6, "optimizer": cell.optimizer, "log_likelihood": 12.34}
    return {
        "cell": asdict(cell), "transitions": 10, "wall_seconds": 1.0, "fit": {**fit, "simulated_transitions": 70},
        "truth": {name: {"mean": value, "std": STD * value * varies} for name, value in TRUTH.items()},
    }  # fmt: skip


def study(**changes: dict[str, float]) -> list[dict[str, Any]]:
    """All cells as they should be; ``changes`` by ``method_variant``."""
    identified = [
        {"parameter": n, "standard_error": 0.1, "share_of_box_percent": 2.0, "correlated_with": "mass",
         "correlation": 0.5} for n in TRUTH
    ]  # fmt: skip
    found: list[dict[str, Any]] = []
    for cell in all_cells(replace(PUSH.plan, seeds=2)):
        usual = {"width": 1e-6} if cell.method == "droid" else {}
        change = changes.get(f"{cell.method}_{cell.variant}", usual)
        found.append(
            {"cell": asdict(cell), "identifiability": identified}
            if cell.block == "identify"
            else result(cell, **change)
        )
    return found


def test_the_papers_findings_hold_where_they_should() -> None:
    assert [f.holds for f in all_findings(study())] == [True] * 5


@pytest.mark.parametrize(
    ("change", "fails"),
    [
        ({"dropo_point": {"factor": 1.03}}, 0),
        ({"droid_point": {"factor": 0.97, "width": 1e-6}}, 0),
        ({"dropo_distribution": {"factor": 1.06}}, 1),
        ({"dropo_distribution": {"width": 0.7}}, 2),
        ({"droid_distribution": {"width": 0.5}}, 3),
        ({"bayessim_distribution": {"factor": 3.3}}, 4),
    ],
)
def test_a_finding_that_does_not_hold_is_told(change: dict[str, dict[str, float]], fails: int) -> None:
    assert [i for i, f in enumerate(all_findings(study(**change))) if not f.holds] == [fails]


def test_adam_is_left_out_where_there_are_no_gradients() -> None:
    assert {c.optimizer for c in all_cells(replace(PUSH.plan, backend="mujoco"))} == {"fisher", "cma", ""}


def test_means_outside_of_the_box_are_named() -> None:
    outside = beyond_box(result(Cell("table", "distribution", "bayessim", 4, features="mdnn"), factor=-4.0))
    assert outside[0] == "mass -2.8 with seed 4"
    assert len(outside) == len(TRUTH)
    assert beyond_box(result(Cell("table", "distribution"))) == []


def test_the_page_has_every_method_and_the_papers_numbers(tmp_path: Path) -> None:
    plan = replace(PUSH.plan, seeds=2)
    sentences = write_results(tmp_path, PUSH.about, study(), asdict(plan))
    assert all(sentence.startswith("holds: ") for sentence in sentences)
    page = (tmp_path / "tables.md").read_text()
    for words in ("dropo (fisher)", "bayessim (mdrff)", "simopt", "udr", "0.788 ± 0.11", "one box", "12.3"):
        assert words in page
    for name in ("study.json", "report.html", "recovery.png"):
        assert (tmp_path / name).stat().st_size > 1000


def test_widths_are_judged_only_where_something_varies() -> None:
    rows = recovery_rows(pick(study(), "table"), {"point": "p", "distribution": "d"}, label)
    assert {row["case"] for row in rows if "largest_std_error_percent" in row} == {"d"}
    errors = [
        row["largest_std_error_percent"] for row in rows if row["method"] == "dropo (fisher)" and row["case"] == "d"
    ]
    np.testing.assert_allclose(errors, 0, atol=1e-9)
    assert optimizer_rows(study())[0]["simulated_per_logged"] == 7
    assert len(sections({"table": rows, "paper": [], "optimizers": [], "identify": []}, [])) == 6


@each
def test_it_is_found_by_name_and_every_size_is_one_of_its_logs(name: str) -> None:
    study = STUDIES[name]
    assert bundled_study(name) == study.run
    assert set(study.truth) == set(study.about.sim.parameters)
    assert study.about.sim.name == name
    for plan in (study.plan, study.reduced):
        assert plan.small_episodes <= plan.episodes
        assert plan.horizon <= plan.steps
    for values in study.about.published.values():
        assert len(values) <= len(study.truth)


@each
@pytest.mark.parametrize("cell", all_cells(replace(PUSH.reduced, seeds=1)), ids=lambda cell: cell.name)
def test_every_cell_has_a_config_that_is_understood(name: str, cell: Cell, tmp_path: Path) -> None:
    pytest.importorskip("sbi")
    study, path = STUDIES[name], tmp_path / "log.npz"
    log = study.record(variant=cell.variant, episodes=2, steps=study.reduced.steps, truth=study.truth)
    log.save(path)
    assert {n: value["mean"] for n, value in realized(log.parameters, study).items()} == pytest.approx(
        dict(zip(study.truth, log.parameters.mean(0), strict=True))
    )
    document = config_of(cell, study, replace(study.reduced, backend="mujoco"))
    problem = make_problem(make_config({**document, "data": str(path)}))
    if cell.optimizer != "adam":  # which needs gradients
        make_search(problem)
    if cell.block == "identify":
        rows = identifiability(problem, study)
        assert [row["parameter"] for row in rows] == list(study.truth)
        assert all(row["standard_error"] > 0 and row["correlated_with"] != row["parameter"] for row in rows)
