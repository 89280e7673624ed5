"""What the study's tables and findings say of cells whose results are known."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest
from dropo_sims.hopper.study import Cell
from dropo_sims.hopper.study_tables import all_findings, sections, size_rows, sweep_rows, table_rows

from dropo_torch.distribution import DRAWN_STD


def result(cell: Cell, mean: float, std: float, *, truth: float = 4.0, **about: Any) -> dict[str, Any]:
    """A cell's result with one mass, searched for from 0 to 10 kg."""
    fitted = {"parameters": {"foot_mass": {"mean": mean, "std": std, "low": 0.0, "high": 10.0}}, "mse": 1e-6}
    return {
        "cell": asdict(cell), "truth": {"foot_mass": {"mean": truth, "std": 0.0}}, "mse_at_truth": 1e-6,
        "transitions": 10, "wall_seconds": 1.0, "fit": {**fitted, **about},
    }  # fmt: skip


def study(**changes: tuple[float, float]) -> list[dict[str, Any]]:
    """Table 1 and the sweeps as the paper has them; ``changes`` sets mean and σ of ``method_variant``."""
    usual = {"dropo": 1e-5, "droid": 1e-5, "bayessim": 0.5}
    found = []
    for method, std in usual.items():
        for variant in ("point", "noisy", "unmodeled"):
            wide = 1.0 if (method, variant) == ("dropo", "unmodeled") else std
            found.append(result(Cell("table", variant, method), *changes.get(f"{method}_{variant}", (4.0, wide))))
    for ends, starts in ((True, False), (False, False), (False, True)):
        for epsilon in (1e-6, 1e-5, 1e-4):
            cell = Cell("noise", "point", epsilon=epsilon, noise=1e-5, ends_only=ends, noisy_starts=starts)
            errors = {"mse": 1.0 if epsilon < 1e-5 else 1e-5}
            likely = {"robust_log_likelihood": -abs(epsilon - 1e-5)} if starts else {}
            found.append({**result(cell, 4.0, 1e-5, **errors), **likely})
    return found


def verdicts(results: list[dict[str, Any]]) -> list[bool]:
    return [finding.holds for finding in all_findings(results)]


def test_the_papers_findings_hold_where_they_should() -> None:
    found = all_findings(study())
    assert [f.holds for f in found] == [True] * 7 + [True]
    assert "up to 0 σ off" in found[3].measured
    assert "ε over variance: 1" in found[4].measured


@pytest.mark.parametrize(
    ("change", "fails"),
    [
        ({"dropo_point": (4.1, 1e-5)}, 0),  # 2.5 % off
        ({"droid_point": (3.8, 1e-5)}, 0),
        ({"droid_noisy": (4.0, 0.1)}, 1),  # 1 % of the box is no collapse
        ({"dropo_unmodeled": (4.0, 1e-5)}, 2),
        ({"bayessim_unmodeled": (4.0, 0.01)}, 3),
    ],
)
def test_a_finding_that_does_not_hold_is_told(change: dict[str, tuple[float, float]], fails: int) -> None:
    assert [i for i, holds in enumerate(verdicts(study(**change))) if not holds] == [fails]


def test_errors_do_not_cancel_over_seeds() -> None:
    """Means 10 % too high and 10 % too low are 10 % off, though their average is right."""
    rows = table_rows([result(Cell("table", "point", seed=s), mean, 0.2) for s, mean in enumerate((4.4, 3.6))], "table")
    assert rows[0]["mean"] == pytest.approx(4.0)
    assert rows[0]["largest_error_percent"] == pytest.approx(10)
    assert rows[0]["std"] == pytest.approx(DRAWN_STD * 0.2)
    tables = {"table": rows, "recovery": [], "sweep": [], "noise": [], "size": [], "cma": []}
    by_title = {s.title: s for s in sections(tables)}
    errors = by_title["Table 1: largest error of a mean, of all seeds (%)"]
    assert errors.rows == [["noiseless", "foot_mass", "4.000", "10"]]


def test_bootstrap_samples_give_median_and_range() -> None:
    cells = [Cell("size", "noisy", size=10, resample=b, knows_noise=True) for b in range(9)]
    (row,) = size_rows([result(cell, 4 + 0.1 * b, 0.1) for b, cell in enumerate(cells)])
    assert (row["mean"], row["mean_low"], row["mean_high"]) == pytest.approx((4.4, 4.0, 4.8))
    assert row["level"] == pytest.approx(0.8)


def test_a_sweep_is_ordered_and_compared_with_the_noise() -> None:
    """Given out of order, the elbow is found all the same."""
    errors = {1e-4: 1e-3, 1e-6: 1.0, 1e-3: 1e-3, 1e-5: 1e-1}
    cells = [(Cell("noise", "point", epsilon=e, noise=1e-5, ends_only=True), mse) for e, mse in errors.items()]
    (row,) = sweep_rows([result(cell, 4.0, 0.1, mse=mse) for cell, mse in cells])
    assert row["epsilons"] == sorted(errors)
    assert row["chosen"] == 1e-4
    assert row["ratio"] == pytest.approx(10)
    assert row["noise_on"] == "ends of transitions"
