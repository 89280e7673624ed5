"""From a config to what a fit needs: model, parameters, simulator, log and objective."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dropo_torch.config import PLANNING_KEYS, TRAINING_KEYS, Config
from dropo_torch.data.observation import Observation, generic_observation, parse_observation
from dropo_torch.data.trajectory import Trajectories, make_transitions, with_slopes_before, with_unseen
from dropo_torch.effects import find_effect, load_effects
from dropo_torch.effects.base import applied
from dropo_torch.effects.placing import EffectSet, lowest, place_effects, plain_setting
from dropo_torch.effects.simulator import effect_simulator, first_known
from dropo_torch.errors import InputError
from dropo_torch.logged import (
    SLOWEST,
    TIME_TOLERANCE,
    LoggedData,
    completed,
    frame_skip_of,
    is_registered,
    log_of,
    used,
)
from dropo_torch.models.constants import velocity_lead
from dropo_torch.models.load import load_model
from dropo_torch.objective import Objective
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators import CheckedAdapter, MujocoEnvAdapter, Simulator, make_simulator
from dropo_torch.simulators.hidden import POSE, filter_memory, filters_known, prescribed_bodies, prescribed_names
from dropo_torch.support.extras import extra
from dropo_torch.support.usercode import load_callable, user_code


@dataclass(frozen=True)
class Problem:
    """Everything that a config stands for.

    Attributes:
        config: the config.
        model_path: path of the model, where there is one.
        space: what varies.
        simulator: simulates transitions.
        trajectories: the log, or the part of it that is used.
        observation: what its columns are.
        objective: the likelihood of the log.
        fingerprint: identifies config, model and log; an interrupted run continues only with the same.
        effects: the physical effects of the config, or ``None``.
        since: transition of each episode from which on the commands that act are known from the log, ``(E,)``; ``None``
            where all of them are.
        sensed: the config as given, where states of the log stand in place of its sensors.
        derived: columns that are derivatives of others, and their errors, where they are known.
    """

    config: Config
    model_path: Path | None
    space: ParameterSpace
    simulator: Simulator
    trajectories: Trajectories
    observation: Observation
    objective: Objective
    fingerprint: str
    effects: EffectSet | None = None
    since: np.ndarray | None = None
    sensed: Config | None = None
    derived: Mapping[str, float] = field(default_factory=dict)

    @property
    def left_out(self) -> int:
        """Transitions in which commands or motion from before the log act, so that the likelihood leaves them out."""
        return 0 if self.since is None else int(self.since.sum())


def logged_data(problem: Problem) -> LoggedData:
    """Return the log of a problem."""
    model = problem.space.model if problem.config.backend != "gymnasium" else None
    return LoggedData(
        problem.model_path, model, problem.trajectories, problem.observation, problem.simulator.frame_skip
    )  # fmt: skip


def make_problem(config: Config, *, log: Trajectories | None = None, general: bool = False) -> Problem:
    """Read, build and check everything that a config names.

    Args:
        config: the config.
        log: the log, such as one read from memory, in place of the config's ``data``.
        general: as the search for missing effects needs it: free bodies are compiled so that their mass and its center
            may change in any way, and a config may name no parameters.

    Raises:
        InputError: anything that does not fit, by key.
    """
    given, config = config, completed(config)
    load_effects(config.own_effects, config.path)
    if config.backend == "gymnasium":
        model_path, space, source = _gymnasium_source(config, general)
    else:
        model_path = config.path(str(config.model))
        space = _space(load_model(model_path, general=general or config.moves_centres), config, general)
        source = space.model
    trajectories = log_of(config, space.model) if log is None else used(config, log)
    frame_skip = frame_skip_of(config, space.model, trajectories)
    width = trajectories.observations.shape[1]
    effects, since = None, None
    sensed = _is_sensed(config, space.model, width)
    if config.has_effects:
        num_states = int(source.num_states if config.backend == "gymnasium" else source.nq + source.nv)
        observation = _observation(config, space.model, num_states, width)
        if space.model is None or len(observation.default_state) != space.model.nq + space.model.nv:
            raise InputError("effects: they need a MuJoCo model; this simulator has none")
        setting = plain_setting(space.model, observation, frame_skip, differentiated=config.derives_velocities)
        effects = place_effects(config.effects, space, setting, find_effect)
        space = space.with_limits(lowest(effects, space))
        simulator = _with_effects(config, source, effects, space, trajectories)
        since = first_known(effects, space, trajectories, simulator.timestep or 1.0)
    else:
        simulator = _backend(config, source, frame_skip, space, sensed)
    if config.backend != "gymnasium" and (memory := filter_memory(space)):
        known = filters_known(memory, frame_skip, np.bincount(trajectories.episodes))
        since = known if since is None else np.maximum(since, known)
    _check_log(trajectories, simulator, frame_skip)
    observation = _observation(config, space.model, simulator.num_states, width)
    trajectories = with_slopes_before(trajectories, _lead(space.model, effects))
    trajectories = with_unseen(trajectories, observation, simulator.timestep, _ahead(space.model, frame_skip))
    lag = 1 if sensed else config.lag
    transitions = make_transitions(
        trajectories, observation, lag=lag, history=simulator.history, past=simulator.past, since=since
    )
    likelihood = {key: getattr(config, key) for key in ("epsilon", "noise", "mask", "scaling", "orientation")}
    objective = Objective(simulator, transitions, observation, **likelihood)
    digest = _fingerprint(given, space.model, trajectories)
    return Problem(given, model_path, space, simulator, trajectories, observation, objective, digest, effects, since)


def _lead(model: mujoco.MjModel | None, effects: EffectSet | None) -> float:
    """By how many seconds the velocities of a simulation are those of before its positions, under the effects' step."""
    if model is None:
        return 0.0
    steps = () if effects is None else effects.matching(lambda effect: effect.steps).at(np.empty(0))
    return velocity_lead(applied(model, steps))


def _ahead(model: mujoco.MjModel | None, frame_skip: int) -> float:
    """By what share of a transition positions follow later velocities: all integrators but RK4 are semi-implicit."""
    explicit = model is None or velocity_lead(model) == 0
    return 0.0 if explicit else 1 / frame_skip


def refuse_sensed(problem: Problem, what: str) -> None:
    """Raise an :class:`InputError` where states are to be estimated, which somebody has to know."""
    if problem.observation.is_sensed:
        raise InputError(
            f"observation: it names sensors and not the whole state, which {what} needs; dropo fit and dropo check "
            "take such a log"
        )


def _is_sensed(config: Config, model: mujoco.MjModel | None, width: int) -> bool:
    """Whether states are to be estimated from the log; refuse keys that then say nothing."""
    if (
        config.backend == "gymnasium"
        or model is None
        or not parse_observation(model, config.observation, width).is_sensed
    ):
        return False
    if config.effects:
        raise InputError("effects: they do not go with sensors in observation, between which states are estimated")
    if config.method not in ("dropo", "laplace") or config.optimizer != "fisher":
        key = "optimizer" if config.method == "dropo" else "method"
        raise InputError(
            f"{key}: {getattr(config, key)} needs logged states, and observation names sensors; use optimizer: fisher"
        )
    for key in ("epsilon", "covariance", "entropy", "scaling", "orientation"):
        if (given := getattr(config, key)) != Config.model_fields[key].default:
            raise InputError(
                f"{key}: {given!r} given, which says nothing where observation names sensors: columns are weighed by "
                "their noise, and parameters are one vector; leave it out"
            )
    return True


def _backend(config: Config, source: Any, frame_skip: int, space: ParameterSpace, sensors: bool = False) -> Simulator:
    """The simulator of the config's backend."""
    means: dict[str, Any] = {"num_threads": config.threads, "chunk_size": config.chunk_size, "device": config.device}
    if config.backend != "gymnasium":
        means["history"] = math.ceil(filter_memory(space) / frame_skip)
        means["sensors"] = sensors
    return make_simulator(config.backend, source, parameters=space, frame_skip=frame_skip, **means)


def _with_effects(
    config: Config, source: Any, effects: EffectSet, space: ParameterSpace, trajectories: Trajectories
) -> Simulator:
    """The simulator with effects in it."""
    other = config.backend == "gymnasium"
    step = source.timestep if other else float(source.opt.timestep)
    if step is None:
        raise InputError("effects: they need the adapter's timestep, the seconds of a step")

    def make(model: mujoco.MjModel, frame_skip: int, parameters: ParameterSpace) -> Simulator:
        if isinstance(source, MujocoEnvAdapter):
            source.use_model(model)
        return _backend(config, source if other else model, frame_skip, parameters)

    return effect_simulator(
        config.backend, effects, space, make, timestep=effects.setting.frame_skip * step,
        longest=int(np.bincount(trajectories.episodes).max()), num_threads=config.threads,
        chunk_size=config.chunk_size, owns_model=not other or isinstance(source, MujocoEnvAdapter),
    )  # fmt: skip


def _space(model: mujoco.MjModel | None, config: Config, general: bool) -> ParameterSpace:
    if not config.parameters and general and model is not None:
        return ParameterSpace.empty(model)
    if config.parameters is None:
        raise InputError(
            "config: no parameters given; expected name: {field: body_mass, name: BODY, bounds: [low, high]}"
        )
    return ParameterSpace(model, config.parameters)


def _gymnasium_source(config: Config, general: bool) -> tuple[Path | None, ParameterSpace, Any]:
    """The parameter space and the adapter (or its maker) of a Gymnasium environment or of the user's own."""
    name = config.environment
    if name is None:
        raise InputError("config: backend gymnasium needs environment: an id such as Hopper-v5, or file.py:function")
    if is_registered(name):
        if config.model is not None:
            raise InputError(f"config: both model and environment {name} are given; the environment has its own model")
        with extra("gymnasium", f"environment: {name}"):
            import gymnasium
        try:
            with warnings.catch_warnings(action="ignore"):  # an outdated version says so on several lines
                environment = gymnasium.make(name)
        except Exception as error:  # whatever the maker of a registered environment raises
            raise InputError(f"environment: Gymnasium cannot make {name!r}: {error}") from None
        space = _space(getattr(environment.unwrapped, "model", None), config, general)
        return None, space, MujocoEnvAdapter(environment, space)
    maker = load_callable(
        "environment", name, path=config.path, what="function {} that makes an adapter",
        example="an id such as Hopper-v5, or file.py:function of an adapter",
    )  # fmt: skip
    path = None if config.model is None else config.path(config.model)
    space = _space(None if path is None else load_model(path), config, general)
    with user_code("environment", name):
        adapter = maker(space)
    return path, space, CheckedAdapter(adapter, name)


def _check_log(trajectories: Trajectories, simulator: Simulator, frame_skip: int) -> None:
    """The log's actions and time stamps must be the simulator's."""
    width = trajectories.actions.shape[1]
    if width != simulator.num_controls:
        model = simulator.parameters.model
        poses = 0 if model is None else POSE * len(prescribed_bodies(model))
        also = ""
        if poses and model is not None:
            also = (
                f" and {poses} numbers of mocap poses ({prescribed_names(model)}: position and quaternion w, x, y, z, "
                "after the actions)"
            )
        raise InputError(
            f"data: {width} action column{'s' * (width != 1)}, but the simulator has "
            f"{simulator.num_controls - poses} actuators{also}"
        )
    ours, theirs = simulator.timestep, trajectories.dt
    if ours is None or theirs is None or abs(ours - theirs) <= TIME_TOLERANCE * theirs:
        return
    step = ours / frame_skip
    right = theirs / step
    hint = f"expected frame_skip {round(right)}" if abs(right - round(right)) < 0.01 * right else "resample the log"
    if theirs > SLOWEST:
        hint = "if its time stamps are not in seconds, data: {time: {signal: NAME, scale: 1e-3}}; otherwise " + hint
    raise InputError(
        f"frame_skip: {frame_skip} steps of {step:g} s make {ours:g} s, "
        f"but the log is sampled every {theirs:g} s; {hint}"
    )


def _observation(config: Config, model: mujoco.MjModel | None, num_states: int, width: int) -> Observation:
    if model is not None and num_states in (model.nq + model.nv, model.nq + model.nv + model.nsensordata):
        return parse_observation(model, config.observation, width)
    if config.observation is not None:
        raise InputError("observation: this simulator's states have no names; leave the key out")
    if width != num_states:
        raise InputError(f"data: {width} observed columns, but the simulator's state has {num_states}")
    return generic_observation(width)


def _fingerprint(config: Config, model: mujoco.MjModel | None, trajectories: Trajectories) -> str:
    digest = hashlib.sha256(config.fingerprint(*TRAINING_KEYS, *PLANNING_KEYS).encode())
    for name in ("observations", "next_observations", "actions", "terminals"):
        digest.update(np.ascontiguousarray(getattr(trajectories, name)).tobytes())
    where, _, _ = (config.environment or "").rpartition(":")
    if where.endswith(".py"):
        digest.update(config.path(where).read_bytes())
    if model is not None:
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        digest.update(buffer.tobytes())
    return digest.hexdigest()[:32]
