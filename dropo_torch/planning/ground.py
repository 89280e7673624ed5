"""What a motion is planned on: the model and its simulator, where it starts, what limits it, and what is known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.config import Config, load_config
from dropo_torch.data.observation import joint_name, parse_observation
from dropo_torch.data.trajectory import Trajectories, make_transitions, with_unseen
from dropo_torch.distribution import Distribution, to_coordinates
from dropo_torch.errors import InputError
from dropo_torch.logged import completed
from dropo_torch.models.constants import velocity_lead
from dropo_torch.models.load import load_model
from dropo_torch.planning.drives import Drive, Tracker, drives_of
from dropo_torch.planning.information import Information, inefficiency, information_of
from dropo_torch.planning.limits import Limits, check_names, make_limits
from dropo_torch.planning.motion import Family, Paths
from dropo_torch.planning.separation import Ties, read_ties
from dropo_torch.planning.settings import PlanSettings, plan_settings
from dropo_torch.problem import Problem, make_problem
from dropo_torch.proposal.information import measure_noise, noise_keys
from dropo_torch.simulators import Simulator
from dropo_torch.simulators.hidden import control_range, prescribed_bodies, prescribed_names
from dropo_torch.view import read_run

#: Highest frequency in Hz, and times a command that its period has at least; lowest, and periods in the motion.
FASTEST, PERIOD, SLOWEST, PERIODS = 5.0, 10, 0.1, 2.0
#: Seconds in which a robot must come to rest where it starts, and speed that counts as rest, of the largest one.
SETTLE, REST = 4.0, 0.01
#: Windows of a motion that a search looks at, and how many follow on each other.
WINDOWS, RUN = 120, 4
#: Windows of a log from which on some stand for all, and how many of these follow on each other.
LOGGED, LONG_RUN = 3000, 50
#: Share of the bounds by which the model's own values are kept inside them.
INSIDE = 0.01
#: Commands of a motion at least.
FEWEST = 20


@dataclass(frozen=True, eq=False)
class Ground:
    """What a motion is planned on.

    Attributes:
        config: with the noise that is reckoned with, without the log.
        problem: of the log; of a robot at rest where there is none.
        has_log: whether there is one.
        noise_source: where the noise is from, in words.
        settings: what was given.
        model: at the point.
        point: where the parameters are taken to be, in coordinates, ``(d,)``.
        values: that point and other models that are possible, in units, ``(K, d)``.
        starts: states at which the motion starts: where each model rests under the first command, ``(K, nq + nv)``.
        settled: whether the model at the point is at rest there.
        drives, tracker, family, limits: what moves, how it follows paths, which ones, and within what.
        known: what is known before.
        steps: commands N.
        ties: effects that the motion is to tell apart; ``None`` where it is to tell the parameters.
    """

    config: Config
    problem: Problem
    has_log: bool
    noise_source: str
    settings: PlanSettings
    model: mujoco.MjModel
    point: np.ndarray
    values: np.ndarray
    starts: np.ndarray
    settled: bool
    drives: tuple[Drive, ...]
    tracker: Tracker
    family: Family
    limits: Limits
    known: Information
    steps: int
    ties: Ties | None = None

    @property
    def timestep(self) -> float:
        """Seconds of a command."""
        return _step(self.problem)

    @property
    def width(self) -> np.ndarray:
        """Width of the parameters' box in coordinates, ``(d,)``."""
        return self.problem.objective.box.width

    @cached_property
    def models(self) -> list[mujoco.MjModel]:
        """The model at each of :attr:`values`."""
        return [self.problem.space.apply(v) if self.problem.space.fields else self.model for v in self.values]

    def commands(self, paths: Paths) -> np.ndarray:
        """Return the commands by which the model at the point follows paths, ``(P, N, nu)``."""
        return follow(self.problem.simulator, self.tracker, paths, self.starts[0], self.values[:1])

    def states(self, commands: np.ndarray, models: int = 1) -> np.ndarray:
        """Return what so many models, that at the point first, do under commands, ``(P, models, N + 1, nq + nv)``."""
        return rollout(self.problem.simulator, self.starts[:models], commands, self.values[:models])

    def log_of(self, states: np.ndarray, commands: np.ndarray) -> Trajectories:
        """Return motions ``(P, N + 1, nq + nv)`` as a log of P episodes without noise."""
        observation, count = self.problem.observation, len(states)
        shown = np.zeros((count, states.shape[1], observation.log_width))
        shown[..., list(observation.log_columns)] = states[..., observation.index]
        ends = np.zeros((count, states.shape[1] - 1), dtype=bool)
        ends[:, -1] = True
        width = observation.log_width
        log = Trajectories(
            shown[:, :-1].reshape(-1, width), shown[:, 1:].reshape(-1, width), commands.reshape(-1, commands.shape[-1]),
            ends.ravel(), self.timestep, "the planned motion",
        )  # fmt: skip
        skip = self.problem.simulator.frame_skip
        return with_unseen(log, observation, self.timestep, 1 / skip if velocity_lead(self.model) else 0.0)

    def told(self, states: np.ndarray, commands: np.ndarray) -> list[Information]:
        """Return what motions ``(P, N + 1, nq + nv)`` tell, from some of their windows."""
        objective, simulator = self.problem.objective, self.problem.simulator
        since = np.full(len(states), min(math.ceil(simulator.history), self.steps // 10))
        every = make_transitions(
            self.log_of(states, commands), self.problem.observation, lag=self.config.lag, history=simulator.history,
            past=simulator.past, since=since,
        )  # fmt: skip
        whole = len(every) // len(states)
        runs = max(1, min(WINDOWS, whole) // RUN)
        begins = np.unique(np.linspace(0, whole - min(RUN, whole), runs).astype(int))
        rows = np.unique(begins[:, None] + np.arange(min(RUN, whole)))
        rows = rows[rows < whole]
        pairs = max(1, int((np.diff(rows) == 1).sum()))
        chosen = (np.arange(len(states))[:, None] * whole + rows).ravel()
        found = information_of(objective.on(every.select(chosen)), self.point, quick=True)
        share, together = whole / len(rows), (whole - 1) / pairs
        wasted = 0.0 if objective.noise is None else inefficiency(objective.features.size) - 1
        return [
            Information(share * i.gram, together * (i.shared + wasted * i.gram) - share * wasted * i.gram)
            for i in found
        ]  # fmt: skip

    def problem_of(self, states: np.ndarray, commands: np.ndarray) -> Problem:
        """Return the problem that a fit of one motion ``(N + 1, nq + nv)`` has."""
        return make_problem(self.config, log=self.log_of(states[None], commands[None]))


def prepare(config: Config, seconds: float, at: Path | None = None, gap: Path | None = None) -> Ground:
    """Return what a motion is planned on.

    Args:
        config: the model, its parameters with bounds, and a log and noise where there are any.
        seconds: how long the motion is.
        at: a fit at whose means it is planned; else at the model's own values, within the bounds.
        gap: folder of a ``dropo gap`` whose tied effects it is to tell apart; the model is then that with the effects.

    Raises:
        InputError: no MuJoCo model, no actuators, no parameters, a start outside the limits, or a motion too short.
    """
    if gap is not None and at is not None:
        raise InputError("--at: a plan with --gap is made at the numbers that dropo gap found; leave one of both out")
    given, ties, found = plan_settings(config.plan), None, None
    if gap is not None:
        ties = read_ties(gap)
        config, found = _amended(config, gap)
    model = _usable(config, given)
    config, problem, noise_source = _with_noise(config.model_copy(update={"backend": "mujoco"}), model)
    has_log, box = config.data is not None or config.sim is not None, problem.objective.box
    point, varies = _point(problem, at) if found is None else (np.clip(found, box.low, box.high), np.zeros(len(found)))
    center = box.values(point)
    model = problem.space.apply(center) if problem.space.fields else model
    known = _known(problem, point) if has_log else Information.none(len(point))
    certain = known if at is not None or gap is not None else Information.none(len(point))
    values = np.concatenate([center[None], _others(problem, point, certain, varies, given.models)])
    begin, starts, settled = _starts(problem, model, given, has_log, values)
    drives, step, log = drives_of(model, begin), _step(problem), problem.trajectories
    logged = problem.observation.states(log.observations, log.unseen) if has_log else None
    limits = make_limits(model, drives, given, starts[0], logged, log.actions if has_log else None)
    steps = round(seconds / step)
    if steps < FEWEST:
        raise InputError(
            f"--seconds: {seconds:g} s are {steps} commands; a motion needs {FEWEST} of {step:g} s at least"
        )
    family = Family(
        drives, limits.reach, _places(drives, model, begin), steps=steps, timestep=step, waves=given.waves,
        frequency=given.frequency or _frequency(seconds, step),
    )  # fmt: skip
    alone = config.model_copy(
        update={"data": None, "trajectories": None, "leave_out": [], "frame_skip": problem.simulator.frame_skip}
    )
    return Ground(
        alone, problem, has_log, noise_source, given, model, point, values, starts, settled, drives,
        Tracker(model, drives, step, limits.force), family, limits, known, steps, ties,
    )  # fmt: skip


def _usable(config: Config, settings: PlanSettings) -> mujoco.MjModel:
    """The model, if a motion can be planned for it.

    Raises:
        InputError: why none can.
    """
    if config.backend == "gymnasium":
        raise InputError("backend: gymnasium has a model of its own; a plan needs backend: mujoco or warp")
    own = completed(config)
    model = load_model(own.path(str(own.model)))
    if not own.parameters:
        raise InputError("parameters: none given, so that there is nothing to tell apart; dropo init proposes some")
    if own.data is None and own.frame_skip is None:
        raise InputError(
            "frame_skip: not given, and there is no log that tells it; give the physics steps of a command"
        )
    if prescribed_bodies(model):
        raise InputError(
            f"model: {prescribed_names(model)}: mocap bodies act in this model; a plan commands actuators only"
        )
    if parse_observation(model, own.observation).is_sensed:
        raise InputError(
            "observation: it names sensors and not the whole state, which a plan needs; name qpos and qvel for the plan"
        )
    check_names(model, drives_of(model, np.concatenate([model.qpos0, np.zeros(model.nv)])), settings)
    return model


def _with_noise(config: Config, model: mujoco.MjModel) -> tuple[Config, Problem, str]:
    """The config with the noise that is reckoned with, its problem, and where the noise is from."""
    source = "the config" if config.noise is not None else "√ε of the config, which gives no noise"
    own = completed(config)
    if own.data is None:
        return config, make_problem(config, log=_at_rest(own, model)), source
    problem = make_problem(config)
    if config.noise is not None:
        return config, problem, source
    config = _noisy(config, problem)
    return config, make_problem(config), "the log"


def _amended(config: Config, gap: Path) -> tuple[Config, np.ndarray]:
    """The config with the effects that a gap named, with the limits of another, and its numbers in coordinates."""
    found = load_config(gap / "config.yaml").model_copy(update={"plan": config.plan, "seed": config.seed})
    candidate = read_run(gap).candidates[-1]
    return found, to_coordinates(candidate.values, candidate.problem.space.is_log)


def follow(simulator: Simulator, tracker: Tracker, paths: Paths, start: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the commands by which a model follows paths ``(P, N, D)``, ``(P, N, nu)``.

    Args:
        simulator: of the model.
        tracker: turns paths into commands.
        paths: what is followed.
        start: state before, ``(nq + nv,)``.
        values: of the parameters, ``(1, d)``.
    """
    if not tracker.needs_states:
        return tracker.commands(paths.position, paths.rate, paths.curvature, None)
    count, steps = paths.position.shape[:2]
    states, history, out = np.tile(start, (count, 1)), simulator.history, []
    for n in range(steps):
        shown = np.nan_to_num(states)
        command = tracker.commands(paths.position[:, n], paths.rate[:, n], paths.curvature[:, n], shown)
        out.append(command)
        before = [out[max(0, n - k)] for k in range(history, -1, -1)]
        states = simulator.simulate(shown, np.stack(before, 1), values)[:, 0].numpy()
    return np.stack(out, 1)


def rollout(simulator: Simulator, starts: np.ndarray, commands: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return states under commands ``(P, N, nu)`` of models ``(K, d)``, ``(P, K, N + 1, nq + nv)``.

    Args:
        simulator: of the models.
        starts: state before the first command of each model, ``(K, nq + nv)``.
        commands: what acts, from long before on the first of them.
        values: of the parameters.
    """
    before = np.repeat(commands[:, :1], simulator.history, axis=1)
    given, found = np.concatenate([before, commands], 1), []
    for start, value in zip(starts, values, strict=True):
        begun = np.tile(start, (len(commands), 1))
        after = simulator.rollout(begun, given, value[None]).numpy()[:, 0]
        found.append(np.concatenate([begun[:, None], after], axis=1))
    return np.stack(found, 1)


def _step(problem: Problem) -> float:
    step = problem.simulator.timestep
    assert step is not None
    return step


def _frequency(seconds: float, step: float) -> tuple[float, float]:
    """Lowest and highest frequency of a motion in Hz."""
    high = min(FASTEST, 1 / (PERIOD * step))
    return min(max(SLOWEST, PERIODS / seconds), high / 2), high


def _noisy(config: Config, problem: Problem) -> Config:
    """The config with the noise that its log shows, and ε small beside it unless that is given."""
    found = noise_keys(problem, measure_noise(problem).columns)
    if "epsilon" in config.model_fields_set:
        del found["epsilon"]
    return config.model_copy(update=found)


def _at_rest(config: Config, model: mujoco.MjModel) -> Trajectories:
    """A log of a robot that does not move, for a config without one."""
    observation = parse_observation(model, config.observation)
    state, rows = np.concatenate([model.qpos0, np.zeros(model.nv)]), 2 * FEWEST + config.lag
    shown = np.zeros((rows + 1, observation.log_width))
    shown[:, list(observation.log_columns)] = state[observation.index]
    step = float(model.opt.timestep) * (config.frame_skip or 1)
    return Trajectories.of_samples(shown, np.zeros((rows, model.nu)), dt=step, source="no log")


def _point(problem: Problem, at: Path | None) -> tuple[np.ndarray, np.ndarray]:
    """Where the parameters are taken to be, in coordinates, and by what they vary, ``(d,)`` each."""
    box = problem.objective.box
    if at is None:
        with np.errstate(divide="ignore"):  # a friction of 0 with a logarithm
            own = to_coordinates(problem.space.nominal, problem.space.is_log)
        edge = INSIDE * (box.high - box.low)
        return np.where(np.isnan(own), box.middle, np.clip(own, box.low + edge, box.high - edge)), np.zeros(len(own))
    found = Distribution.load(at)
    if set(found.names) != set(problem.space.names):
        raise InputError(
            f"--at: {at} has the parameters {', '.join(found.names)}; the config has {', '.join(problem.space.names)}"
        )
    center, std = (
        problem.space.vector(dict(zip(found.names, x.tolist(), strict=True))) for x in (found.center, found.std)
    )
    return np.clip(to_coordinates(center, problem.space.is_log), box.low, box.high), std


def _known(problem: Problem, point: np.ndarray) -> Information:
    """What the log tells; of a long one, from runs of windows spread over it."""
    objective, share, total = problem.objective, 1.0, Information.none(len(point))
    if len(objective) > LOGGED:
        begins = np.linspace(0, len(objective) - LONG_RUN, LOGGED // LONG_RUN).astype(int)
        rows = np.unique(begins[:, None] + np.arange(LONG_RUN))
        share, objective = len(objective) / len(rows), objective.on(objective.transitions.select(rows))
    for found in information_of(objective, point):
        total = total + found
    return Information(share * total.gram, share * total.shared)


def _others(problem: Problem, point: np.ndarray, known: Information, varies: np.ndarray, count: int) -> np.ndarray:
    """Other parameters that are possible, ``(count, d)``: of a normal about a point, within the bounds.

    Args:
        problem: gives the bounds.
        point: in coordinates, ``(d,)``.
        known: what is known about it beside the bounds.
        varies: standard deviations by which parameters vary, ``(d,)``.
        count: of models.
    """
    box, rng = problem.objective.box, np.random.default_rng([problem.config.seed, 11])
    covariance = known.covariance(box.width / math.sqrt(12)) + np.diag(varies**2)
    values, vectors = np.linalg.eigh(covariance)
    draws = rng.standard_normal(((count + 1) // 2, len(point)))
    draws = np.concatenate([draws, -draws])[:count] * np.sqrt(np.maximum(values, 0))
    return box.values(np.clip(point + draws @ vectors.T, box.low, box.high)).reshape(count, len(point))


def _places(drives: tuple[Drive, ...], model: mujoco.MjModel, state: np.ndarray) -> np.ndarray:
    """Where drives are in a state, ``(D,)``; a command alone is in the middle of its range."""
    low, high = control_range(model)
    middle = 0.5 * (np.nan_to_num(low, neginf=0.0) + np.nan_to_num(high, posinf=0.0))
    return np.array([state[d.position] if d.joint >= 0 else middle[d.actuators[0]] for d in drives])


def _starts(
    problem: Problem, model: mujoco.MjModel, settings: PlanSettings, has_log: bool, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Where drives hold before a motion, where that leaves each model ``(K, nq + nv)``, and whether it rests there.

    Tried are what is given, where the log starts, and the model's own; the first at which the robot comes to rest
    counts. A model that does not come to rest where another one does starts like that.
    """
    log, own = problem.trajectories, np.concatenate([_key(model), np.zeros(model.nv)])
    tried = [own]
    if has_log:
        first = problem.observation.states(log.observations[:1], None if log.unseen is None else log.unseen[:1])[0]
        first[model.nq :] = 0.0
        tried.insert(0, first)
    joints = {joint_name(model, j): j for j in range(model.njnt)}
    for state in tried:
        for name, position in settings.start.items():
            state[model.jnt_qposadr[joints[name]]] = position
    for state in tried:
        ends = _held(problem, model, state, values)
        if ends[0] is not None:
            return state, np.stack([ends[0] if end is None else end for end in ends]), True
    return tried[-1], np.tile(tried[-1], (len(values), 1)), False


def _key(model: mujoco.MjModel) -> np.ndarray:
    return np.array(model.key_qpos[0] if model.nkey else model.qpos0)


def _held(problem: Problem, model: mujoco.MjModel, state: np.ndarray, values: np.ndarray) -> list[np.ndarray | None]:
    """Where models come to rest whose drives hold where the first starts; ``None`` for one that does not."""
    step, simulator = _step(problem), problem.simulator
    drives = drives_of(model, state)
    tracker = Tracker(model, drives, step, np.full(model.nu, np.inf))
    steps = max(FEWEST, round(SETTLE / step))
    place = np.tile(_places(drives, model, state), (1, steps, 1))
    still = np.zeros_like(place)
    commands = follow(simulator, tracker, Paths(place, still, still), state, values[:1])
    held = np.repeat(commands[:, -1:], steps, axis=1)
    first = rollout(simulator, state[None], commands, values[:1])[0, 0, -1]
    states = rollout(simulator, np.tile(first, (len(values), 1)), held, values)[0]
    ends: list[np.ndarray | None] = []
    for path in states:
        rests = np.isfinite(path).all() and np.abs(path[-max(2, steps // 10) :, model.nq :]).max() < REST
        ends.append(np.concatenate([path[-1, : model.nq], np.zeros(model.nv)]) if rests else None)
    return ends
