"""From a model and a log, and nothing else, to a config that runs: what ``dropo init`` does."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import mujoco
import numpy as np

from dropo_torch.config import Config, make_config
from dropo_torch.data.examination import Finding
from dropo_torch.data.loops import Loops, find_loops
from dropo_torch.data.observation import joint_name
from dropo_torch.errors import InputError, choices
from dropo_torch.models.load import load_model
from dropo_torch.problem import make_problem
from dropo_torch.proposal.angles import find_angles, with_angles
from dropo_torch.proposal.candidates import Candidate, all_candidates
from dropo_torch.proposal.choice import Choice, choose
from dropo_torch.proposal.clock import FASTEST, SLOWEST, Clock, find_clock
from dropo_torch.proposal.columns import Columns, read_columns
from dropo_torch.proposal.copies import drivable, motor_spec, out_of, write_copy
from dropo_torch.proposal.draft import Draft, Reading, as_read, is_whole, make_draft
from dropo_torch.proposal.drives import left_over
from dropo_torch.proposal.floating import base_note, floating_base, with_base
from dropo_torch.proposal.information import Information, Noise, information_of, measure_noise, noise_keys
from dropo_torch.proposal.markers import with_markers
from dropo_torch.proposal.matches import Matching
from dropo_torch.proposal.matching import match_columns
from dropo_torch.proposal.places import Place, known_names, places_of
from dropo_torch.proposal.text import config_text
from dropo_torch.proposal.units import nearest_unit, rows_apart, with_velocity_units
from dropo_torch.proposal.words import COUNTS, split
from dropo_torch.shooting.odometry import SUNK
from dropo_torch.shooting.posing import column_noise, is_placeable, posed
from dropo_torch.simulators.hidden import prescribed_bodies, prescribed_names
from dropo_torch.support.report import Report


class Review(Protocol):
    """Somebody who looks at each step of a proposal, and may correct it."""

    def columns(self, columns: Columns, matching: Matching, places: Sequence[Place]) -> Matching:
        """Return which column is which number of the model."""

    def clock(self, clock: Clock) -> Clock:
        """Return when the rows were taken."""

    def parameters(self, choice: Choice) -> Sequence[str] | None:
        """Return the names of the parameters to fit; ``None`` for those that were chosen."""


@dataclass(frozen=True)
class Proposal:
    """A config for a model and a log, and why it is as it is.

    Attributes:
        document: the config's keys; paths are relative to ``base``.
        base: folder of the config.
        matching: which column is which number of the model.
        clock: when the rows were taken.
        draft: how the log is read, and what its examination still finds.
        noise: standard deviation of each observed column, ``(n,)``.
        choice: what is fitted of all physical candidates, and why.
        windows: of the log, of the chosen length.
        rate: how the rate was found, in a sentence.
        window: why windows have their length, in a sentence.
    """

    document: dict[str, Any]
    base: Path
    matching: Matching
    clock: Clock
    draft: Draft
    noise: np.ndarray
    choice: Choice
    windows: int
    rate: str
    window: str

    @property
    def config(self) -> Config:
        """The config."""
        return make_config(self.document, base=self.base)

    @property
    def text(self) -> str:
        """The config as commented YAML."""
        return config_text(self)

    @property
    def labels(self) -> tuple[str, ...]:
        """The observed columns."""
        return self.draft.logged.observation.labels

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        return self.draft.logged.observation.units

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What an examination still finds in the log."""
        return self.draft.findings


def propose_config(
    model: str | Path,
    log: str | Path | Sequence[str | Path],
    *,
    out: str | Path = "robot.yaml",
    dt: float | None = None,
    seed: int = 0,
    threads: int = 0,
    review: Review | None = None,
    report: Report | None = None,
) -> Proposal:
    """Return a config for a robot's model and log: columns, units, rate, episodes, noise and parameters.

    Nothing is written, except a copy of the model beside ``out``: ``…_motors.xml`` where the log has forces for a model
    without actuators, ``…_step.xml`` where its rows are no whole number of the model's steps apart.

    Args:
        model: an MJCF or URDF.
        log: a log of any format that the package reads, or a pattern such as ``runs/*.csv``; or several, which have the
            same columns and follow on each other as episodes.
        out: the config to be written, from whose folder paths are told.
        dt: seconds between rows, for a log that does not say.
        seed: of the config.
        threads: of the simulator, 0 for all processors.
        review: looks at each step and may correct it.
        report: is told the stage and its share.

    Raises:
        InputError: a position that no column is, commands that no column is, a rate that nothing tells; and whatever a
            model or log is refused for.
    """
    tell = report or (lambda stage, share: None)
    path = Path(model)
    tell("reading the model and the log", 0.0)
    compiled = load_model(path)
    columns = read_columns(log, known_names(compiled))
    robot = _robot(compiled, path, Path(out), columns)
    reading = _reading(robot, columns, dt, review)
    tell("examining the log", 0.1)
    draft = _drafted(reading, robot)
    document = draft.document | {"seed": seed} | ({"threads": threads} if threads else {})
    tell("estimating the noise", 0.2)
    noise, candidates, document = _with_noise(document, draft, reading.base)
    skip, step = document["frame_skip"], reading.timestep
    least = 1 if draft.smooth is None else math.ceil(0.5 / (draft.smooth.cutoff * skip * step))
    if floating_base(reading.matching, robot.model) is not None:
        least = max(least, math.ceil(SUNK / (skip * step)))
    found = information_of(noise.config, candidates, least=least, report=tell, log=noise.log)
    choice = _chosen(candidates, found, review)
    if not choice.chosen:
        raise InputError(
            f"{columns.source}: the log tells none of the model's {len(candidates)} physical parameters; log a motion"
        )
    document |= {"lag": found.lag, "as_given": True}
    document |= {"parameters": {t.candidate.name: t.candidate.spec for t in choice.chosen}}
    return Proposal(
        document, reading.base, as_read(reading.matching, reading.places, draft), reading.clock, draft, noise.columns,
        choice, found.windows, _rate(reading.clock, document, step), _window(found, skip * step),
    )  # fmt: skip


@dataclass(frozen=True)
class _Robot:
    """The model, and where the config finds it.

    Attributes:
        given: its file as given.
        out: the config to be written.
        path: its file as the config names it: the one that was given, or where a copy will stand.
        model: with motors where it gets some.
        commanded: whether it has actuators as given.
    """

    given: Path
    out: Path
    path: Path
    model: mujoco.MjModel
    commanded: bool

    @property
    def step(self) -> float:
        """Seconds of a step of the model as given."""
        return float(self.model.opt.timestep)

    def driven(self, matching: Matching) -> list[str]:
        """Return the joints at which a model that has no actuators gets motors."""
        return [] if self.commanded else [m.place.label for m in matching.of("command")]


def _robot(model: mujoco.MjModel, path: Path, out: Path, columns: Columns) -> _Robot:
    """The model with motors at all joints where it has no actuators and the log has forces."""
    if len(prescribed_bodies(model)):
        raise InputError(
            f"model: {prescribed_names(model)}: mocap bodies act in this model, and their poses belong to the "
            "actions; write the config by hand (docs/data.md)"
        )
    forces = [c for c in columns.numeric if c.words.role in ("effort", "command") and c.moves]
    joints = drivable(model)
    if model.nu or not forces or not joints or path.suffix == ".mjb":
        return _Robot(path, out, path, model, bool(model.nu))
    return _Robot(path, out, out_of(out, path, "motors"), motor_spec(path, joints).compile(), False)


def _reading(robot: _Robot, columns: Columns, dt: float | None, review: Review | None) -> Reading:
    """Which column is which number of the model and when rows were taken, with the model of which they are rows."""
    places = places_of(robot.model)
    columns, matching, clock = _turned(columns, robot, places, find_clock(columns, robot.step, dt))
    matching = with_base(_without_dependent(matching, robot.model), robot.model, places)
    matching, path = _marked(robot, columns, matching, clock)
    if review is not None:
        matching, clock = review.columns(columns, matching, places), review.clock(clock)
        matching = with_base(_without_dependent(matching, robot.model), robot.model, places)
    if not robot.commanded:
        matching = _without_motors(matching)
    _check(matching, columns, robot.model, clock)
    path, step = _with_whole_steps(robot, path, columns, matching, clock)
    if not robot.commanded:
        keep = {m.place.label for m in matching.matches} | {p.label for p in places if p.kind != "command"}
        places = tuple(p for p in places if p.label in keep)
        matching = replace(matching, missing=tuple(p for p in matching.missing if p.kind != "command"))
    base = robot.out.resolve().parent
    data = [_relative(p, base) for p in columns.paths]
    return Reading(_relative(path, base), data, columns, matching, places, clock, step, base)


def _turned(columns: Columns, robot: _Robot, places: Sequence[Place], clock: Clock) -> tuple[Columns, Matching, Clock]:
    """Columns, with quaternions in the place of the angles that tell an orientation, what they are, and the clock."""
    found = find_angles(columns, robot.model, clock.starts(len(columns), columns.parts))
    told = with_angles(columns, found)
    matching, checked = _matched(told, places, clock, robot.step)
    used = [a for a in found if matching.array(a.name)]
    if len(used) < len(found):
        told = with_angles(columns, used)
        matching, checked = _matched(told, places, clock, robot.step)
    return told, matching, checked


def _loops(matching: Matching, model: mujoco.MjModel) -> Loops | None:
    """The joints without columns that equality constraints determine from those that have some."""
    return find_loops(model, [m.place.number for m in (*matching.of("position"), *matching.of("velocity"))])


def _without_dependent(matching: Matching, model: mujoco.MjModel) -> Matching:
    """The matching without those places among the missing that closed loops and couplings determine."""
    loops = _loops(matching, model)
    if loops is None:
        return matching
    held = {("position", int(c)) for c in loops.positions} | {("velocity", int(c)) for c in loops.velocities}
    return replace(matching, missing=tuple(p for p in matching.missing if (p.kind, p.number) not in held))


def _without_motors(matching: Matching) -> Matching:
    """The matching without made-up motors whose joints no force is logged of, where all forces of the log are used."""
    spare = any(c.words.role in ("effort", "command") for c in matching.unused)
    if spare or left_over(matching) or not matching.of("command"):
        return matching
    return replace(matching, missing=tuple(p for p in matching.missing if p.kind != "command"))


def _drafted(reading: Reading, robot: _Robot) -> Draft:
    """The config's keys but noise and parameters, with notes of what it does that the log does not say by itself."""
    draft = make_draft(reading)
    draft = replace(draft, turned=_orientations(reading, robot.model))
    if (loops := _loops(reading.matching, robot.model)) is not None:
        draft = draft.noted(
            f"{', '.join(loops.names)}: no column shows them; they are where the model's equality constraints are met"
        )
    if (base := floating_base(reading.matching, robot.model)) is not None:
        draft = draft.noted(base_note(reading.matching, base))
    driven = robot.driven(reading.matching)
    if driven and (idle := [name for name in drivable(robot.model) if name not in driven]):
        draft = draft.noted(f"{', '.join(idle)}: no column is a force there; no motor was added")
    if reading.timestep == robot.step:
        return draft
    return draft.noted(
        f"rows {reading.clock.dt:.6g} s apart are no whole number of the model's steps of {robot.step:g} s: "
        f"{Path(reading.model).name} is the model with steps of {reading.timestep:g} s"
    )


def _orientations(reading: Reading, model: mujoco.MjModel) -> tuple[str, ...]:
    """What the columns of angles are, in words."""
    found = [(a, reading.matching.array(a.name)) for a in reading.columns.orientations]
    return tuple(a.said_of(_body(model, matches[0].place.joint)) for a, matches in found if matches)


def _chosen(candidates: Sequence[Candidate], found: Information, review: Review | None) -> Choice:
    """The parameters to fit, as the log tells them or as a review names them."""
    choice = choose(candidates, found.gram)
    if review is not None and (names := review.parameters(choice)) is not None:
        choice = choose(candidates, found.gram, names)
    return choice


def _relative(path: Path, base: Path) -> str:
    """A path as the config has it: from its folder, or absolute where that is on another drive."""
    try:
        return Path(os.path.relpath(path.resolve(), base)).as_posix()
    except ValueError:
        return str(path.resolve())


def _marked(robot: _Robot, columns: Columns, matching: Matching, clock: Clock) -> tuple[Matching, Path]:
    """What columns are where markers show the positions that no column is, and the model that has sensors for them."""
    if all(p.optional for p in matching.lacks("position")):
        return matching, robot.path
    source = robot.given
    if driven := robot.driven(matching):
        source = robot.path
        write_copy(robot.given, driven, float(load_model(robot.given).opt.timestep), source)
    matching, copy = with_markers(load_model(source), source, robot.out, columns, matching, clock)
    return matching, copy if matching.of("marker") else robot.path


def _with_whole_steps(
    robot: _Robot, path: Path, columns: Columns, matching: Matching, clock: Clock
) -> tuple[Path, float]:
    """The model that the config names, written where it is a copy, and its step in seconds."""
    if matching.of("marker"):
        return path, float(load_model(path).opt.timestep)
    step = _whole_step(path, columns, clock, robot.step)
    if step != robot.step and path == robot.given:
        path = out_of(robot.out, path, "step")
    if path != robot.given:
        write_copy(robot.given, robot.driven(matching), step, path)
    return path, step


def _whole_step(path: Path, columns: Columns, clock: Clock, step: float) -> float:
    """The model's step, or a finer one of which rows are a whole number, in seconds.

    Rows that are even stay as they are logged, and so do the commands that acted in them. Others are resampled anyway.
    """
    assert clock.dt is not None
    if columns.apart is not None or not clock.even or path.suffix == ".mjb" or is_whole(clock.dt, step):
        return step
    return float(f"{clock.dt / math.ceil(clock.dt / step):.6g}")  # as MJCF is written


def _matched(columns: Columns, places: Sequence[Place], clock: Clock, timestep: float) -> tuple[Matching, Clock]:
    """Columns and their units, with the clock's unit as velocities show it."""
    starts = clock.starts(len(columns), columns.parts)
    taken = [c for c in (*clock.columns, clock.episode, *clock.terminals) if c is not None]
    matching = match_columns(columns, places, starts, taken)
    clock = _checked_clock(clock, matching, starts, timestep)
    if clock.dt is not None:
        matching = with_velocity_units(matching, starts, clock.dt)
    return matching, clock


def _checked_clock(clock: Clock, matching: Matching, starts: np.ndarray, timestep: float) -> Clock:
    """The clock with the unit, or the rate, that velocities make of positions, where its name does not tell it."""
    seconds = rows_apart(matching, starts)
    if not seconds:
        return clock
    usual = float(np.median(seconds))
    if clock.dt is None:
        whole = round(usual / timestep)
        near = whole >= 1 and abs(usual / timestep - whole) < 0.03 * whole
        dt = whole * timestep if near else usual
        return replace(clock, dt=dt, why=(*clock.why, f"velocities and positions say that rows are {dt:.4g} s apart"))
    if clock.column is None or not clock.column.values.size:
        return clock
    for power in (1e3, 1e-3, 1e6, 1e-6, 1e9, 1e-9):
        dt = clock.dt * power
        if abs(usual / dt - 1) < 0.25 and FASTEST <= dt <= SLOWEST and not _explained(usual / clock.dt, matching):
            why = f"velocities and positions say that rows are {dt:.4g} s apart"
            return replace(clock, unit=clock.unit * power, dt=dt, why=(*clock.why, why))
    return clock


def _explained(factor: float, matching: Matching) -> bool:
    """Whether a unit of the velocities would do as well as another one of the stamps."""
    return any(nearest_unit(factor, m.place) is not None for m in matching.of("velocity")[:1])


def _check(matching: Matching, columns: Columns, model: mujoco.MjModel, clock: Clock) -> None:
    """Refuse a log that lacks what is needed, naming what there is instead."""
    free = _free(matching, columns, clock)
    lacking = [p for p in matching.lacks("position") if not p.optional and not matching.of("marker")]
    lacking += [
        p for p in matching.lacks("velocity")
        if any(o.optional and o.label == p.partner for o in matching.lacks("position"))
    ]  # fmt: skip
    if lacking:
        raise InputError(f"{columns.source}: {_lacking(lacking, model, free)}{_texts(columns)}")
    for m in (*matching.of("position"), *matching.of("velocity")):
        if COUNTS & set(split(m.column.label or m.column.entry)) and m.scale == 1.0:
            unit = "rad or degrees" if m.place.measure == "angle" else "m or mm"
            raise InputError(
                f"{columns.source}: {m.column.entry} ({m.place.label}) is what an encoder counts, and nothing says how "
                f"many make a {'turn' if m.place.measure == 'angle' else 'meter'}; log it in {unit}, with the unit in "
                "its name, such as " + ("theta_rad" if m.place.measure == "angle" else "x_m")
            )
    absent = matching.lacks("command")
    told, named = matching.of("command"), [c.entry for c in left_over(matching)]
    if absent and (told or named or any(p.takes != "position" for p in absent)):
        names = ", ".join(p.label for p in absent[:6]) + (", ..." if len(absent) > 6 else "")
        kind = {"position": "targets", "velocity": "target velocities", "effort": "commanded forces"}[absent[0].takes]
        though = f", although some are called after it: {', '.join(named[:3])}" if named else ""
        raise InputError(
            f"{columns.source}: no column is the command of {names} ({kind}){though}; rename one, or use --interactive"
            + _choices(absent[0].label, free) + _texts(columns)
        )  # fmt: skip
    if clock.dt is None:
        raise InputError(
            f"{columns.source}: nothing says how far rows are apart: neither time stamps nor velocities; give "
            "--dt SECONDS" + _choices("time", free)
        )


def _free(matching: Matching, columns: Columns, clock: Clock) -> list[str]:
    """The columns of numbers that are nothing yet, first those that move."""
    taken = [*(m.column for m in matching.matches), *clock.columns, clock.episode, *clock.terminals]
    used = {c.entry for c in taken if c is not None}
    return [c.entry for c in sorted(columns.numeric, key=lambda c: not c.moves) if c.entry not in used]


def _texts(columns: Columns) -> str:
    """Which columns hold text where numbers may be meant, such as with decimal commas."""
    told = [f"{c.entry} such as {str(c.labels[0])!r}" for c in columns.columns if not c.values.size and len(c.labels)]
    return f"; these hold text, and no numbers: {', '.join(told[:3])}{', ...' if len(told) > 3 else ''}" if told else ""


def _choices(name: str, free: Sequence[str]) -> str:
    """What there is for a name among the columns that are nothing yet."""
    return choices(name, free) if free else " (every column of numbers is something else already)"


def _lacking(lacking: Sequence[Place], model: mujoco.MjModel, free: Sequence[str]) -> str:
    """What is told of positions and velocities that no column is: whole orientations by their bodies."""
    turned = [
        j for j in dict.fromkeys(p.joint for p in lacking)
        if sum(p.joint == j and p.measure == "quaternion" for p in lacking) == 4
    ]  # fmt: skip
    nowhere = [
        j for j in dict.fromkeys(p.joint for p in lacking)
        if int(model.jnt_type[j]) == mujoco.mjtJoint.mjJNT_FREE and j not in turned
    ]  # fmt: skip
    rest = [p for p in lacking if not (p.measure == "quaternion" and p.joint in turned) and p.joint not in nowhere]
    said = []
    for j in turned:
        name = _body(model, j)
        free_joint = int(model.jnt_type[j]) == mujoco.mjtJoint.mjJNT_FREE
        slides = ", or give the model three slides along x, y and z instead of the free joint" if free_joint else ""
        columns = ", ".join(f"{name}_q{axis}" for axis in "wxyz") + f", or as {name}_roll, {name}_pitch, {name}_yaw"
        said.append(f"the orientation of {name} is not in the log; log it as {columns}{slides}")
    for j in nowhere:
        name = _body(model, j)
        said.append(
            f"where {name} is, is not in the log; log it as {name}_px, {name}_py, {name}_pz, such as by motion "
            "capture, or write a config whose observation names the model's sensors, [sensor[gyro], ...]: dropo fit "
            "then estimates it"
        )
    if rest:
        names = ", ".join(_called(p, model) for p in rest[:6]) + (", ..." if len(rest) > 6 else "")
        known = _choices(_called(rest[0], model).partition(".")[0], free)
        said.append(f"no column is {names}; rename one, or use --interactive{known}")
    return "; ".join(said)


def _body(model: mujoco.MjModel, joint: int) -> str:
    """The name of a joint's body, or the joint's own where that has none."""
    return str(model.body(int(model.jnt_bodyid[joint])).name) or joint_name(model, joint)


def _called(place: Place, model: mujoco.MjModel) -> str:
    """What a place is called, after its body where its joint has no name."""
    name, _, rest = place.label.partition(".")
    return place.label if model.joint(place.joint).name else f"{_body(model, place.joint)}.{rest}" if rest else name


def _with_noise(
    document: dict[str, Any], draft: Draft, base: Path
) -> tuple[Noise, tuple[Candidate, ...], dict[str, Any]]:
    """The noise, the candidates as the log sizes them, and the config's keys with the noise."""
    given = make_problem(make_config(document, base=base), general=True)
    problem = posed(given)
    noise = measure_noise(problem, draft.smooth)
    states = problem.observation.states(problem.trajectories.observations, problem.trajectories.unseen)
    candidates, keys = all_candidates(noise.setting, states), noise_keys(problem, noise.columns)
    noise = replace(noise, config=problem.config.model_copy(update=keys))
    if problem is given:
        return noise, candidates, document | keys
    own = column_noise(given.observation, given.trajectories)
    if is_placeable(given):  # columns of the state have the noise that they have there
        of_state = dict(zip(problem.observation.labels, noise.columns.tolist(), strict=True))
        own = np.array([of_state.get(label, x) for label, x in zip(given.observation.labels, own, strict=True)])
        document = document | {"noise": noise_keys(given, own)["noise"]}
    return replace(noise, columns=own, log=problem.trajectories), candidates, document


def _rate(clock: Clock, document: dict[str, Any], timestep: float) -> str:
    seconds = document["frame_skip"] * timestep
    told = "; ".join(clock.why)
    return f"{told[:1].upper()}{told[1:]}. A row is {document['frame_skip']} steps of {timestep:g} s, {seconds:.4g} s."


def _window(found: Information, step: float) -> str:
    if found.lag == 1:
        return (
            f"Every row is predicted from the one before: longer windows would tell no more ({found.windows} windows)."
        )
    return (
        f"Windows of {found.lag} rows ({found.lag * step:.3g} s), {found.windows} of them: over one row, noise hides "
        "what parameters do."
    )
