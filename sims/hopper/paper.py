"""Table 1 of the DROPO paper with its own masses, search boxes and a log of a semi-converged policy.

The policy that is bundled, ``policy.pt``, was trained by PPO on a Hopper of these masses, by
``dropo train policy.yaml --out FOLDER``. Where the paper's simulator lacks a kilogram of the torso, so does the model
here.

One of the paper's numbers needs a second look: what it finds under noise. So one thing after the other is varied
there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dropo_torch.config import make_config
from dropo_torch.diagnostics import diagnose
from dropo_torch.distribution import Distribution
from dropo_torch.models.load import load_model
from dropo_torch.problem import Problem, make_problem
from dropo_torch.rl.policy import load_policy
from dropo_torch.studies.recovery import Result

from . import SIM
from .fits import METHODS, UNMODELED, Size, fitted, method_keys, mse_at
from .record import NOISE_VARIANCE, HopperLog, record

POLICY = Path(__file__).parent / "policy.pt"
#: kg, the paper's.
MASSES = {"torso_mass": 3.534, "thigh_mass": 3.927, "leg_mass": 2.714, "foot_mass": 5.089}
#: Half to double of them, as in the paper.
PARAMETERS = {name: {**SIM.parameters[name], "bounds": [mass / 2, 2 * mass]} for name, mass in MASSES.items()}
#: Mass of the torso in the model that is wrong, kg.
LIGHT = 2.534
#: Cases of Table 1 and of the recovery of a distribution, with the paper's ε where it says so.
EPSILON = {"point": 1e-8, "ends": NOISE_VARIANCE, "noisy": NOISE_VARIANCE, "unmodeled": 1e-3, "distribution": 1e-7}


@dataclass(frozen=True)
class PaperPlan(Size):
    """How large this part is.

    Attributes:
        noises: noises of one log whose estimates are compared.
    """

    noises: int = 10


#: Of the study.
FULL = PaperPlan()
#: A minute or two.
REDUCED = PaperPlan(
    seeds=1, steps=60, samples=40, droid_budget=300, simulations=100, horizon=20, noises=2, backend="mujoco"
)


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes:
        block: what it is part of: ``table``; ``why``, where one thing differs from the paper's noisy case; or
            ``noises``, of one log with one noise after the other.
        variant: of the log.
        method: of the fit.
        features: of BayesSim.
        seed: of the log and the fit; in ``noises`` of the noise alone.
        epsilon: ε; 0 for the variance that the noise causes in the ends of transitions at the truth.
        knows_noise: whether the fit is given the standard deviation of the noise of every measurement.
        scripted: whether the log is of random torques, not of the policy.
        lag: λ.
        optimizer: of DROPO.
        differs: what does from the paper's noisy case, in words.
    """

    block: str
    variant: str
    method: str = "dropo"
    features: str = ""
    seed: int = 0
    epsilon: float = NOISE_VARIANCE
    knows_noise: bool = False
    scripted: bool = False
    lag: int = 1
    optimizer: str = "fisher"
    differs: str = ""

    @property
    def name(self) -> str:
        """The cell's file, without suffix."""
        parts = [self.block, self.variant, self.method + self.features, f"seed{self.seed}", f"eps{self.epsilon:g}"]
        parts += ["known"] * self.knows_noise + ["scripted"] * self.scripted
        parts += [f"lag{self.lag}"] * (self.lag > 1) + [self.optimizer] * (self.optimizer != "fisher")
        return "-".join(parts)


GIVEN = "noise on every measurement, given as noise"
#: What differs from the paper's noisy case, in words and as entries of its cell.
WHY: dict[str, dict[str, Any]] = {
    "noise on the ends alone, ε its variance": {},
    "λ = 5": {"lag": 5},
    "ε a hundredth of it": {"epsilon": NOISE_VARIANCE / 100},
    "ε a hundred times it": {"epsilon": NOISE_VARIANCE * 100},
    "Adam instead of Fisher scoring": {"optimizer": "adam"},
    "a log of random torques": {"scripted": True},
    "noise on the initial states alone": {"variant": "starts"},
    "noise on every measurement": {"variant": "noisy"},
    "noise on every measurement, ε what it causes in the ends": {"variant": "noisy", "epsilon": 0.0},
    GIVEN: {"variant": "noisy", "epsilon": 1e-8, "knows_noise": True},
}


def all_cells(plan: PaperPlan) -> list[Cell]:
    """Return the cells, in the order in which they run."""
    cells: list[Cell] = []
    for seed in range(plan.seeds):
        cells += [
            Cell("table", variant, method, features, seed, epsilon)
            for method, features in METHODS
            for variant, epsilon in EPSILON.items()
        ]
        cells += [Cell("why", **{"variant": "ends", "seed": seed, "differs": words, **of}) for words, of in WHY.items()]
    cells += [Cell("noises", "ends", seed=seed) for seed in range(plan.noises)]
    return [cell for cell in cells if cell.optimizer != "adam" or plan.backend == "warp"]  # it climbs gradients


def run_cell(cell: Cell, *, plan: PaperPlan, logs: Path, threads: int = 0) -> Result:
    """Record the cell's log, fit it, and return what was found beside what is true."""
    log, folder = log_of(cell, plan), logs / cell.name
    folder.mkdir(parents=True, exist_ok=True)
    log.save(folder / "log.npz")
    document = {**config_of(cell, plan), "data": "log.npz", "threads": threads}
    if cell.variant == "unmodeled":
        document |= {"model": "light.mjb", "frame_skip": SIM.frame_skip, "observation": list(SIM.observation)}
        mujoco.mj_saveModel(light_torso(), str(folder / "light.mjb"))
    else:
        document["sim"] = "hopper"
    problem = make_problem(make_config(document, base=folder))
    if cell.epsilon == 0:
        problem = make_problem(make_config({**document, "epsilon": mse_at(problem, MASSES)}, base=folder))
    found = fitted(problem, log)
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    return found | ({"standard_error": told(problem)} if cell.block == "noises" else {})


def config_of(cell: Cell, plan: PaperPlan) -> dict[str, Any]:
    """Return the config of a cell's fit, but for its model and its log."""
    document = {
        **method_keys(cell.method, cell.features, plan),
        "parameters": {k: v for k, v in PARAMETERS.items() if cell.variant != "unmodeled" or k != UNMODELED},
        "seed": cell.seed,
        "lag": cell.lag,
        "epsilon": cell.epsilon or NOISE_VARIANCE,
    }
    if cell.method == "dropo":
        document["optimizer"] = cell.optimizer
    if cell.knows_noise:
        document["noise"] = NOISE_VARIANCE**0.5
    return document


def log_of(cell: Cell, plan: PaperPlan) -> HopperLog:
    """Return the log of a cell: where the torso is not modeled, the model is wrong, not the log."""
    about: dict[str, Any] = {"episodes": plan.episodes, "steps": plan.steps, "masses": MASSES}
    about["policy"] = None if cell.scripted else load_policy(POLICY)
    if cell.block == "noises":
        log, generator = record(**about), np.random.default_rng([cell.seed, 31])
        noise = np.sqrt(NOISE_VARIANCE) * generator.standard_normal(log.next_observations.shape)
        return HopperLog(**{**vars(log), "next_observations": log.next_observations + noise})
    return record(variant="point" if cell.variant == "unmodeled" else cell.variant, seed=cell.seed, **about)


def light_torso() -> mujoco.MjModel:
    """Return the Hopper whose torso's mass is wrong, and nothing else of it, as in the paper's simulator."""
    model = load_model(SIM.model)
    model.body("torso").mass[0] = LIGHT
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def told(problem: Problem) -> dict[str, float]:
    """Return the standard errors of the means at the truth: the least that an unbiased estimate can have."""
    space = problem.simulator.parameters
    truth = np.array([MASSES[name] for name in space.names])
    found = diagnose(problem.objective, Distribution.over(space, truth, problem.objective.box.min_std))
    return dict(zip(space.names, map(float, found.standard_error), strict=True))
