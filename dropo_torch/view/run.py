"""What there is to see in a run's folder: the models that it compared with a log, each with its parameters' values."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dropo_torch.config import Config, load_config, make_config
from dropo_torch.distribution import Distribution
from dropo_torch.errors import InputError
from dropo_torch.problem import Problem, make_problem
from dropo_torch.shooting.posing import posed
from dropo_torch.support.given import read_text

#: Files by which a folder is known to hold something to see.
RUNS = ("fit.json", "gap.json", "check.json")
#: What a model with its own parameters is called.
AS_IT_IS = "the model as it is"


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model that is compared with the log.

    Attributes:
        name: what a person calls it, such as ``"before"``.
        problem: the model, its parameters and the log.
        values: of the parameters, ``(d,)``.
    """

    name: str
    problem: Problem
    values: np.ndarray

    @cached_property
    def model(self) -> mujoco.MjModel | None:
        """The model with these values, by which the robot is drawn; ``None`` for another simulator."""
        space = self.problem.space
        return (
            None
            if space.model is None or self.problem.simulator.num_states != space.model.nq + space.model.nv
            else space.apply(self.values)
        )


@dataclass(frozen=True, eq=False)
class Run:
    """What there is to see.

    Attributes:
        title: of the page.
        candidates: one model, or two that are compared, the one that was improved first.
        noise: standard deviation of the features by their labels, where the run estimated it.
        noise_source: what the residuals' unit is, in words.
        folder: where the run's files are; ``None`` for a config alone.
    """

    title: str
    candidates: tuple[Candidate, ...]
    noise: Mapping[str, float] | None
    noise_source: str
    folder: Path | None


def read_run(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Run:
    """Read the folder of ``dropo fit``, ``gap`` or ``check``, or a config of which the model is taken as it is.

    Args:
        path: the folder, or the config.
        overrides: dotted keys of the config that differ.

    Raises:
        InputError: nothing that can be shown, or a config that cannot be used.
    """
    path, overrides = Path(path), overrides or {}
    if path.is_file():
        return _as_given(_problem(load_config(path, overrides)), f"{path.name}: the model as it is", None)
    if not path.is_dir():
        raise InputError(f"view: no folder {path}; expected that of a run of dropo fit, gap or check, or a config")
    present = [name for name in RUNS if (path / name).is_file()]
    if not present:
        raise InputError(
            f"view: {path} has none of {', '.join(RUNS)}; expected the folder of a finished run, or a config"
        )
    return {"fit.json": _fit, "gap.json": _gap, "check.json": _check}[present[0]](path, overrides)


def _fit(folder: Path, overrides: Mapping[str, Any]) -> Run:
    problem = _problem(load_config(folder / "fitted_config.yaml", overrides))
    distribution = Distribution.load(folder / "fit.json")
    if set(distribution.names) != set(problem.space.names):
        raise InputError(
            f"view: the parameters of {folder / 'fit.json'} are not those of fitted_config.yaml beside it; fit again"
        )
    fitted = problem.space.vector(dict(zip(distribution.names, distribution.center, strict=True)))
    candidates = [Candidate("fitted", problem, fitted)]
    own = problem.space.nominal
    if np.isfinite(own).all() and not np.allclose(own, fitted, rtol=1e-6):
        candidates.insert(0, Candidate("the model's own values", problem, own))
    return Run("The fitted model beside the log", tuple(candidates), None, _given_noise(problem), folder)


def _gap(folder: Path, overrides: Mapping[str, Any]) -> Run:
    """Before: the declared parameters fitted alone. After: the config that was written, with the numbers found."""
    document = _document(folder / "gap.json")
    problem, declared = _recorded(folder, document, "gap.json", overrides), document.get("declared") or {}
    alone = {name: entry["alone"] for name, entry in declared.items()}
    has_names = (folder / "config.yaml").is_file()
    name = "before" if has_names else "fitted" if alone else AS_IT_IS
    candidates = [Candidate(name, problem, _values(problem, alone))]
    if has_names:
        amended = _problem(load_config(folder / "config.yaml", overrides))
        found = {name: entry["with_effects"] for name, entry in declared.items()}
        candidates.append(Candidate("after", amended, _values(amended, found)))
    noise = {name: float(value) for name, value in (document.get("noise") or {}).items() if value}
    return Run("What the model lacks, seen", tuple(candidates), noise, "the log's noise as dropo gap has it", folder)


def _check(folder: Path, overrides: Mapping[str, Any]) -> Run:
    problem = _recorded(folder, _document(folder / "check.json"), "check.json", overrides)
    return _as_given(problem, "The model as it is beside the log", folder)


def _as_given(problem: Problem, title: str, folder: Path | None) -> Run:
    candidates = (Candidate(AS_IT_IS, problem, _values(problem, {})),)
    return Run(title, candidates, None, _given_noise(problem), folder)


def _given_noise(problem: Problem) -> str:
    given = problem.config.noise is not None
    return "the noise that the config gives" if given else "√ε, since the config gives no noise"


def _problem(config: Config) -> Problem:
    """A problem on MuJoCo, which Warp equals to rounding and which needs no kernels; parameters may be missing."""
    problem = make_problem(
        config.model_copy(update={"backend": "mujoco"}) if config.backend == "warp" else config, general=True
    )
    return posed(problem)


def _recorded(folder: Path, document: Mapping[str, Any], name: str, overrides: Mapping[str, Any]) -> Problem:
    """The problem of the config that a result holds."""
    if not isinstance(document.get("config"), Mapping):
        raise InputError(f"view: {folder / name} does not hold its config (an earlier version wrote it); run it again")
    return _problem(make_config(document["config"], overrides, base=folder, source=str(folder / name)))


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(read_text(path, "view"))
    except ValueError as error:
        raise InputError(f"view: {path} is no JSON ({error}); run it again") from None
    if not isinstance(document, dict):
        raise InputError(f"view: {path} holds no keys; run it again")
    return document


def _values(problem: Problem, known: Mapping[str, float]) -> np.ndarray:
    """Parameter values ``(d,)``: those known, else those of the model or of the config's effects, else mid-box."""
    space = problem.space
    found = np.where(np.isfinite(space.nominal), space.nominal, 0.5 * (space.low + space.high))
    for entry in () if problem.effects is None else problem.effects.entries:
        setting = problem.effects.setting  # type: ignore[union-attr]
        numbers = zip(entry.effect.quantities(setting, entry.target), entry.columns, strict=True)
        for given in problem.config.effects:
            here = given.get("effect") == entry.effect.name and fnmatch(str(entry.target), str(given.get("target")))
            for quantity, column in numbers if here else ():
                if column >= 0 and quantity.name in given:
                    found[column] = given[quantity.name]
    return np.array([known.get(name, value) for name, value in zip(space.names, found, strict=True)])
