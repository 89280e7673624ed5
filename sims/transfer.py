"""From a raw log of a target to policies that act in it: what each method's policies reach, and what ``gap`` adds.

The way of a user, seed by seed. The arm is logged alone and then with the object, and both logs are examined. ``gap``
is asked first what the arm's model lacks, and then, with that in it, what else does. Distributions are fitted by each
method to the model with all of it, and by DROPO to the model as it was; a policy is trained over each and carries out
a few rollouts in the target.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import yaml

from dropo_torch.baselines import fit_problem
from dropo_torch.commands.check import told
from dropo_torch.config import Config, load_config, make_config
from dropo_torch.distribution import Distribution
from dropo_torch.effects import find_effect
from dropo_torch.gap import add, find_gap
from dropo_torch.logged import read_log
from dropo_torch.models.bundled import BundledSim
from dropo_torch.models.load import load_model
from dropo_torch.problem import make_problem
from dropo_torch.report.gap_words import answer
from dropo_torch.rl.policy import Policy
from dropo_torch.rl.problem import make_training
from dropo_torch.rl.train import EvaluationPoint, TrainEntry, train
from dropo_torch.studies.study import run_cells
from dropo_torch.support.extras import require
from dropo_torch.support.files import write_atomically, write_json
from dropo_torch.support.parallel import Workers

from .target import Arm, Run, Target, arm_config, log_config, write_raw
from .transfer_tables import write_results

#: What the logs' columns are, of the arm alone and with the object. That lies on the table: how high it is, and how it
#: moves up, is measured less well than the model knows it.
ALONE = ("qpos[0:7]", "qvel[0:7]")
TOGETHER = ("qpos[0:9]", "skip", "qpos[10:14]", "qvel[0:9]", "skip", "qvel[10:13]")
#: Where the part of a log of the arm alone that is used begins, s.
FIRST = 0.06

#: Whose policies are compared, in the order of tables; those after the first two have a fit of their own.
OWN, POINT = "own", "point"
METHODS = (OWN, "dropo", POINT, "droid", "bayessim", "udr", "plain")


@dataclass(frozen=True)
class Plan:
    """How large a study is.

    Attributes:
        seeds: logs, each with fits and policies of its own.
        methods: of :data:`METHODS`, those whose policies are trained.
        boxes: of uniform randomization, each with a policy.
        runs: episodes of a log.
        rollouts: of a policy in the target.
        gap_seconds: after which no more effects are looked for.
        samples: K.
        droid_budget: simulations of the log by DROID.
        simulations, horizon: of BayesSim, and logged steps that it replays.
        algorithm, train: how policies are trained.
        backend: of gap and fits, where the effects that are found allow it; policies are trained with MuJoCo.
    """

    seeds: int
    methods: tuple[str, ...]
    boxes: int
    runs: int
    rollouts: int = 5
    gap_seconds: float = 600.0
    samples: int = 100
    droid_budget: int = 300
    simulations: int = 300
    horizon: int = 50
    algorithm: str = "ppo"
    train: Mapping[str, Any] = field(default_factory=dict)
    backend: Literal["mujoco", "warp"] = "warp"


@dataclass(frozen=True)
class Robot:
    """A target and the model that a user has of it.

    Attributes:
        sim: the model and its parameters, as a user has them.
        make_target: makes the target.
        record: returns runs of it: ``record(count, seed, alone=...)``, with the object or the arm alone.
        distances: how far from its goal the object lies after each rollout, m: ``distances(policy, count, seed)``.
        start: where the part of a run that is fitted begins, s; see :func:`~dropo_sims.target.log_config`.
        own: what a config says of the model that is as near to the target as the library allows: ``effects``,
            and ``distribution`` with a value for each parameter.
        title, lead: of the page.
        plan, reduced: its whole and its reduced size.
    """

    sim: BundledSim
    make_target: Callable[[], Target]
    record: Callable[..., list[Run]]
    distances: Callable[[Policy, int, int], list[float]]
    start: float
    own: Mapping[str, Any]
    title: str
    lead: str
    plan: Plan
    reduced: Plan

    def run(
        self, out: Path, *, reduced: bool = False, resume: bool = False,
        report: Callable[[str, float], None] = lambda stage, share: None, plan: Plan | None = None,
        workers: Workers = 1,
    ) -> Sequence[str]:  # fmt: skip
        """Run every cell that is not there yet, then write tables and figures; return what was found.

        Args:
            out: the folder: ``cells/``, a folder for each seed, and at the end ``study.json``, ``tables.md``,
                ``report.html`` and figures.
            reduced: the small plan.
            resume: keep finished cells of the same plan, or of one with other methods, boxes or seeds; an interrupted
                training goes on.
            report: called with what is being done and the share that is.
            plan: a size of one's own.
            workers: processes that compute cells side by side, or ``"ray"``. Fits and gaps do not depend on it.

        Raises:
            InputError: a folder with another study, or with one that is not to be resumed; a package that is missing.
        """
        plan = plan or (self.reduced if reduced else self.plan)
        require("rl", "a policy")
        if "bayessim" in plan.methods:
            require("baselines", "method: bayessim")
        run = functools.partial(run_cell, robot=self, plan=plan, out=out)
        cells, stages, claim = all_cells(plan), ("gap", "fit", "policy"), replace(plan, seeds=0, methods=(), boxes=0)
        for stage in stages:  # each needs the one before it
            until = [c for c in cells if stages.index(c.stage) <= stages.index(stage)]
            resume = resume or stage != stages[0]
            results = run_cells(out, claim, until, run, resume=resume, workers=workers, report=report)
        report("tables and figures", 1.0)
        return write_results(out, self, results, asdict(plan))


@dataclass(frozen=True)
class Cell:
    """One step of the way.

    Attributes:
        stage: ``gap``, ``fit`` or ``policy``.
        method: of :data:`METHODS`; none of a gap.
        seed: of the log and all that follows.
        box: of uniform randomization.
    """

    stage: str
    method: str = ""
    seed: int = 0
    box: int = 0

    @property
    def name(self) -> str:
        """The cell's file, without suffix."""
        return "-".join(part for part in (self.stage, self.variant, f"seed{self.seed}") if part)

    @property
    def variant(self) -> str:
        """The method, and which box."""
        return f"{self.method}{self.box}" if self.method == "udr" else self.method


def arm_effects(arm: Arm, actuators: str) -> list[dict[str, Any]]:
    """Return what a target's arm has beside its model, as a config's effects; actuators are numbered from 1."""
    found: list[dict[str, Any]] = []
    for i, (dry, viscous) in enumerate(zip(arm.dry, arm.viscous, strict=True), 1):
        found += [
            {"effect": "joint_friction", "target": f"joint{i}", "friction": dry},
            {"effect": "joint_damping", "target": f"joint{i}", "damping": viscous},
            {"effect": "actuator_delay", "target": f"{actuators}{i}", "delay": arm.delay},
        ]
    return found


def all_cells(plan: Plan) -> list[Cell]:
    """Return the study's cells, stage by stage."""
    cells = []
    for seed in range(plan.seeds):
        cells.append(Cell("gap", seed=seed))
        for method in plan.methods:
            for box in range(plan.boxes if method == "udr" else 1):
                cells += [Cell("fit", method, seed, box)] if method not in (OWN, POINT) else []
                cells.append(Cell("policy", method, seed, box))
        if POINT in plan.methods and "dropo" not in plan.methods:
            cells.append(Cell("fit", "dropo", seed))
    return cells


def run_cell(cell: Cell, *, robot: Robot, plan: Plan, out: Path, threads: int = 0) -> dict[str, Any]:
    """Take one step of the way; what later ones need is left in the seed's folder."""
    folder = out / f"seed{cell.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    step = {"gap": _gap, "fit": _fit, "policy": _policy}[cell.stage]
    return step(cell, robot, plan, folder, threads)


def _gap(cell: Cell, robot: Robot, plan: Plan, folder: Path, threads: int) -> dict[str, Any]:
    """Write raw logs and the user's configs; examine them and ask what the model lacks, first of the arm alone."""
    target, found = robot.make_target(), {}
    for kind, alone in (("arm", True), ("user", False)):
        write_raw(folder / f"{kind}.csv", target, robot.record(plan.runs, cell.seed, alone=alone))
    common = {"backend": plan.backend, "seed": cell.seed}
    arm = {
        "sim": robot.sim.name, "data": arm_config(folder.resolve() / "arm.csv", FIRST), "observation": list(ALONE),
        "parameters": {n: dict(s) for n, s in robot.sim.parameters.items() if _of_arm(s)}, **common,
    }  # fmt: skip
    user = {
        "sim": robot.sim.name, "data": log_config(folder.resolve() / "user.csv", robot.start),
        "observation": list(TOGETHER), **common,
    }  # fmt: skip
    _write(folder / "arm.yaml", arm)
    _write(folder / "user.yaml", user)
    found["arm"] = _searched(folder, "arm", plan, threads)
    _write(folder / "object.yaml", with_arm(robot, user, folder / "arm-gap"))
    found["object"] = _searched(folder, "object", plan, threads)
    return found


def _of_arm(specification: Mapping[str, Any]) -> bool:
    """Whether a parameter is one of the arm's drives."""
    return str(specification.get("field", "")).startswith("actuator_")


def with_arm(robot: Robot, user: Mapping[str, Any], found: Path) -> dict[str, Any]:
    """Return the user's config with the arm as it was found; only the object's numbers are parameters then.

    Args:
        robot: whose arm it is.
        user: the config of the log with the object.
        found: what was written of the arm's gap. Where that holds no model, the config is as it was.
    """
    if not (found / "model.xml").exists():
        return dict(user)
    arm = yaml.safe_load((found / "config.yaml").read_text())
    kept = [e for e in arm.get("effects", []) if not find_effect(e["effect"]).native or e["effect"] == "integration"]
    spec, model = mujoco.MjSpec.from_file(str(found / "model.xml")), load_model(robot.sim.model)
    spec.option.timestep, spec.option.integrator = model.opt.timestep, model.opt.integrator  # a finer one is an effect
    spec.compile()
    write_atomically(found / "arm.xml", spec.to_xml().encode())
    own = {
        "model": str((found / "arm.xml").resolve()), "task": robot.sim.name, "frame_skip": robot.sim.frame_skip,
        "parameters": {n: dict(s) for n, s in robot.sim.parameters.items() if not _of_arm(s)},
    }  # fmt: skip
    return {**{k: v for k, v in user.items() if k != "sim"}, **own, **({"effects": kept} if kept else {})}


def _searched(folder: Path, kind: str, plan: Plan, threads: int) -> dict[str, Any]:
    """Examine a log and ask what the model of its config lacks; what is found is left in a folder beside it."""
    config = load_config(folder / f"{kind}.yaml", {"threads": threads})
    findings = [told(finding) for finding in read_log(config).examined()]
    problem, out = make_problem(config, general=True), folder / f"{kind}-gap"
    out.mkdir(exist_ok=True)
    kept: dict[str, Any] = {"checkpoint": out / "gap-progress.bin", "resume": True}
    show = functools.partial(_stage, f"{folder.name} {kind}", [""])
    found = find_gap(problem, time_limit=plan.gap_seconds, report=show, **kept)
    notes = add(problem, found, out)
    write_json(out / "gap.json", found.document())
    headline, items = answer(found)
    return {"check": findings, "answer": [headline, *items], "notes": notes, "gap": found.document()}


def _write(path: Path, document: Mapping[str, Any]) -> None:
    write_atomically(path, yaml.safe_dump(dict(document), sort_keys=False).encode())


def _document(folder: Path, *, amended: bool) -> tuple[dict[str, Any], Path]:
    """The config with what the model lacks, as far as anything has a name, or the user's own; and its folder."""
    path = folder / "object-gap" / "config.yaml"
    if not path.exists():
        path = folder / "object.yaml"
    path = path if amended else folder / "user.yaml"
    document: dict[str, Any] = yaml.safe_load(path.read_text())
    return document, path.parent


def _fit(cell: Cell, robot: Robot, plan: Plan, folder: Path, threads: int) -> dict[str, Any]:
    """Fit a distribution by a method."""
    document, base = _document(folder, amended=cell.method != "plain")
    options: dict[str, dict[str, Any]] = {
        "droid": {"budget": plan.droid_budget},
        "bayessim": {"simulations": plan.simulations, "horizon": plan.horizon},
        "udr": {"boxes": plan.boxes, "box": cell.box},
    }
    method = "dropo" if cell.method == "plain" else cell.method
    settings = {"method": method, "method_options": options.get(method, {}), "samples": plan.samples}
    config = make_config({**document, **settings, "seed": cell.seed, "threads": threads}, base=base)
    fit = fit_problem(make_problem(config))
    fit.save(folder / f"{cell.variant}.json")
    return {"fit": fit.document()}


def _policy(cell: Cell, robot: Robot, plan: Plan, folder: Path, threads: int) -> dict[str, Any]:
    """Train a policy, or go on with it, and let it act in the target."""
    problem = make_training(_training(cell, robot, plan, folder, threads))
    kept, tell = folder / f"{cell.variant}-progress.bin", functools.partial(_tell, f"{cell.variant} seed {cell.seed}")
    found = train(problem, checkpoint=kept, resume=True, on_progress=tell)
    found.policy.save(folder / f"{cell.variant}.pt")
    kept.unlink()
    return {
        "distances": robot.distances(found.policy, plan.rollouts, cell.seed),
        "training_return": found.training.mean,
        **{name: getattr(found, name) for name in ("steps", "episodes", "seconds", "simulating")},
        "evaluations": [asdict(e) for e in found.evaluations],
    }


def _training(cell: Cell, robot: Robot, plan: Plan, folder: Path, threads: int) -> Config:
    """The config of a training."""
    if cell.method == OWN:
        document, base = {"sim": robot.sim.name, **robot.own}, folder
    else:
        document, base = _document(folder, amended=cell.method != "plain")
    if cell.method == POINT:
        center = Distribution.load(folder / "dropo.json")
        document["distribution"] = dict(zip(center.names, center.center.tolist(), strict=True))
    elif cell.method != OWN:
        document["distribution"] = str((folder / f"{cell.variant}.json").resolve())
    learning = {"algorithm": plan.algorithm, "train": dict(plan.train), "backend": "mujoco"}
    return make_config({**document, **learning, "seed": cell.seed, "threads": threads}, base=base)


def _tell(name: str, entry: TrainEntry, evaluation: EvaluationPoint | None) -> None:
    """Print each evaluation on the way."""
    if evaluation is not None:
        print(f"{name}: {entry.steps:,} steps, return {evaluation.mean:.2f} in training", flush=True)


def _stage(name: str, last: list[str], stage: str, share: float) -> None:
    """Print each stage of a search once."""
    if stage != last[0]:
        last[0] = stage
        print(f"{name}: {stage}", flush=True)
