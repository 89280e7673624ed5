"""The part of the Hopper study with the paper's own numbers: its cells, and what its tables say of known results."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from dropo_sims.hopper import SIM
from dropo_sims.hopper.fits import METHODS, UNMODELED
from dropo_sims.hopper.paper import (
    EPSILON,
    FULL,
    GIVEN,
    LIGHT,
    MASSES,
    PARAMETERS,
    REDUCED,
    WHY,
    Cell,
    all_cells,
    config_of,
    light_torso,
    log_of,
    run_cell,
)
from dropo_sims.hopper.paper_tables import PUBLISHED, all_findings, noise_rows, published_rows, sections, why_rows

from dropo_torch.config import make_config
from dropo_torch.distribution import DRAWN_STD
from dropo_torch.models.load import load_model
from dropo_torch.studies.recovery import recovery_rows

TINY = replace(REDUCED, steps=40, samples=10)


def result(cell: Cell, off: float = 0.0, std: float = 1e-5, **about: Any) -> dict[str, Any]:
    """A cell's result whose means are all too high by ``off`` kg."""
    fitted = {
        name: {"mean": MASSES[name] + off, "std": std, "low": p["bounds"][0], "high": p["bounds"][1]}
        for name, p in PARAMETERS.items()
        if cell.variant != "unmodeled" or name != UNMODELED
    }
    truth = {name: {"mean": mass, "std": 0.0} for name, mass in MASSES.items()}
    return {"cell": asdict(cell), "truth": truth, "fit": {"parameters": fitted, "mse": 1e-5}, **about}


def study(**changes: tuple[float, float]) -> list[dict[str, Any]]:
    """Results as the paper has them; ``changes`` sets error and σ of ``method_variant`` or of what differs."""
    spreads = {"dropo": 1e-5, "droid": 1e-9, "bayessim": 0.5}
    found = []
    for method, features in METHODS:
        for variant in EPSILON:
            wide = {"dropo_noisy": 1.2, "dropo_unmodeled": 0.7}.get(f"{method}_{variant}", spreads[method])
            given = changes.get(f"{method}_{variant}", (0.0, wide))
            found.append(result(Cell("table", variant, method, features), *given))
    found += [result(Cell("why", "ends", differs=words), *changes.get(words, (0.0, 1e-5))) for words in WHY]
    told = {"standard_error": dict.fromkeys(MASSES, 0.003)}
    return [*found, *(result(Cell("noises", "ends", seed=s), off, **told) for s, off in enumerate((0.003, -0.004)))]


def test_masses_and_boxes_are_the_papers() -> None:
    boxes = ((1.767, 7.069), (1.963, 7.854), (1.357, 5.429), (2.545, 10.18))
    assert tuple(MASSES.values()) == (3.534, 3.927, 2.714, 5.089)
    np.testing.assert_allclose(
        [p["bounds"] for p in PARAMETERS.values()], boxes, atol=2.5e-3
    )  # of masses before rounding
    assert (LIGHT, EPSILON["point"], EPSILON["ends"], EPSILON["unmodeled"]) == (2.534, 1e-8, 1e-5, 1e-3)
    assert (FULL.episodes, FULL.steps, FULL.seeds) == (2, 500, 3)


def test_of_the_model_that_is_wrong_nothing_is_but_the_torsos_mass() -> None:
    light, ours = light_torso(), load_model(SIM.model)
    assert light.body("torso").mass[0] == LIGHT
    for field in ("body_inertia", "geom_size", "dof_damping", "actuator_gear"):
        np.testing.assert_array_equal(getattr(light, field), getattr(ours, field))
    others = np.arange(light.nbody) != light.body("torso").id
    np.testing.assert_array_equal(light.body_mass[others], ours.body_mass[others])
    log = log_of(Cell("table", "unmodeled"), TINY)  # of the Hopper as it is
    np.testing.assert_array_equal(log.masses, np.tile(list(MASSES.values()), (80, 1)))


def test_the_policy_hops() -> None:
    """It stays up for a second and gets ahead, on the paper's Hopper."""
    log = log_of(Cell("table", "point"), replace(REDUCED, episodes=1, steps=125))
    upright = (log.observations[:, 0] > 0.7) & (np.abs(log.observations[:, 1]) < 0.2)
    assert upright.all()
    assert log.observations[60:, 5].mean() > 1.0
    assert np.ptp(log.actions, axis=0).min() > 0.5


def test_cells_have_names_of_their_own_and_configs_that_are_understood() -> None:
    for plan in (FULL, REDUCED):
        cells = all_cells(plan)
        assert len({cell.name for cell in cells}) == len(cells)
        for cell in cells:
            config = make_config({"sim": "hopper", "data": "log.npz", **config_of(cell, plan)})
            assert (UNMODELED in (config.parameters or {})) == (cell.variant != "unmodeled")
    assert not any(cell.optimizer == "adam" for cell in all_cells(REDUCED))  # which runs without Warp


def test_a_cell_finds_what_its_log_has(tmp_path: Path) -> None:
    cell = Cell("table", "point", epsilon=1e-8)
    found = run_cell(cell, plan=TINY, logs=tmp_path)
    for name, mass in MASSES.items():
        assert found["truth"][name]["mean"] == pytest.approx(mass, rel=1e-12)
        assert found["fit"]["parameters"][name]["mean"] == pytest.approx(mass, rel=1e-6)
    assert not list(tmp_path.iterdir())


def test_without_the_torso_the_masses_are_off(tmp_path: Path) -> None:
    """A model that is a kilogram short cannot have the true masses, and says so by its spread."""
    found = run_cell(Cell("table", "unmodeled", epsilon=1e-3), plan=TINY, logs=tmp_path)["fit"]["parameters"]
    assert UNMODELED not in found
    assert max(abs(p["mean"] / MASSES[name] - 1) for name, p in found.items()) > 0.02


def test_the_papers_findings_hold_where_they_should() -> None:
    assert [f.holds for f in all_findings(study())] == [True] * 7


@pytest.mark.parametrize(
    ("change", "fails"),
    [
        ({"dropo_point": (0.2, 1e-5)}, 0),
        ({"droid_noisy": (0.0, 0.1)}, 1),
        ({"dropo_unmodeled": (0.0, 1e-5)}, 2),
        ({"bayessim_ends": (0.0, 0.01)}, 3),
        ({"dropo_ends": (0.06, 1e-5)}, 4),  # 2 % of the leg
        ({"dropo_noisy": (0.0, 1e-5)}, 5),
        ({GIVEN: (0.06, 1e-5)}, 6),
    ],
)
def test_a_finding_that_does_not_hold_is_told(change: dict[str, tuple[float, float]], fails: int) -> None:
    assert [i for i, f in enumerate(all_findings(study(**change))) if not f.holds] == [fails]


def test_the_papers_numbers_stand_beside_ours() -> None:
    results = study(dropo_ends=(0.01, 0.02))
    tables = {
        "table": recovery_rows([r for r in results if r["cell"]["block"] == "table"], dict.fromkeys(EPSILON, "x"), str),
        "paper": published_rows(), "why": why_rows(results), "noises": noise_rows(results),
    }  # fmt: skip
    assert len(tables["paper"]) == sum(len(v) for methods in PUBLISHED.values() for v in methods.values()) == 33
    tables["table"] = [{**row, "case": "noise on the ends", "method": "dropo"} for row in tables["table"][:1]]
    first, _, why, noises = sections(tables)
    row = dict(zip(first.head, first.rows[0], strict=True))
    assert (row["parameter"], row["truth"], row["dropo, paper"]) == ("torso_mass", "3.534", "3.531 ± 0.0081")
    assert first.head[3:] == ["dropo", "dropo, paper", "droid, paper", "bayessim, paper"]
    assert why.rows[0] == ["the paper", "3.531 ± 0.0081", "3.931 ± 0.0013", "2.717 ± 0.0013", "5.093 ± 0.00024"] + [
        "0.11",
        "–",
    ]
    assert [line[0] for line in why.rows[1:]] == list(WHY)
    assert "2 noises" in noises.title


def test_the_spread_over_noises_is_that_of_the_means_around_the_truth() -> None:
    rows = noise_rows(study())
    assert [row["parameter"] for row in rows] == list(MASSES)
    assert rows[0]["spread"] == pytest.approx(np.sqrt((0.003**2 + 0.004**2) / 2))
    assert rows[0]["published_error"] == pytest.approx(-0.003)
    assert rows[0]["std_median"] == pytest.approx(DRAWN_STD * 1e-5)
    assert rows[3]["published_std"] == 2.4e-4


def test_mujoco_is_the_engine_of_the_log() -> None:
    """One transition of a log of the policy is MuJoCo's, with its action at what it observed."""
    log = log_of(Cell("table", "point"), replace(REDUCED, episodes=1, steps=5))
    model = load_model(SIM.model)
    model.body_mass[1:] = list(MASSES.values())
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data = mujoco.MjData(model)
    data.qpos[1:], data.qvel[:], data.ctrl[:] = log.observations[3, :5], log.observations[3, 5:], log.actions[3]
    mujoco.mj_step(model, data, SIM.frame_skip)
    np.testing.assert_allclose(np.append(data.qpos[1:], data.qvel), log.next_observations[3], rtol=1e-9, atol=1e-9)
