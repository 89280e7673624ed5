"""From a config to what training needs: task, parameters, their distribution, effects, and a target."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dropo_torch.config import Config
from dropo_torch.data.observation import parse_observation
from dropo_torch.effects import find_effect, load_effects
from dropo_torch.effects.placing import EffectSet, lowest, place_effects, plain_setting
from dropo_torch.errors import InputError, choices
from dropo_torch.models.bundled import BundledSim, bundled_sim
from dropo_torch.models.load import load_model
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl.env import RandomizedEnv
from dropo_torch.rl.sampling import ParameterSource, PointSource, load_source
from dropo_torch.rl.settings import Settings, train_settings
from dropo_torch.rl.task import Task, check_model, load_task
from dropo_torch.support.given import number

#: Keys of a config that a training does not depend on, or whose meaning is told otherwise.
_FITTING = (
    "data", "trajectories", "optimizer", "budget", "population", "adam", "samples", "epsilon", "noise", "mask",
    "scaling", "lag", "common_random_numbers", "distribution", "train", "algorithm", "method", "method_options",
    "entropy", "covariance", "environment",
)  # fmt: skip


@dataclass(frozen=True)
class World:
    """A model of the robot with parameters that come from somewhere, as :class:`RandomizedEnv` takes them.

    Attributes:
        task: what is to be done, on its model.
        space: what varies; may be empty.
        source: where an episode's parameters come from.
        effects: the physical effects of the config, or ``None``.
    """

    task: Task
    space: ParameterSpace
    source: ParameterSource
    effects: EffectSet | None


@dataclass(frozen=True)
class TrainingProblem:
    """Everything that a config says about training.

    Attributes:
        config: the config.
        algorithm: ppo or sac.
        settings: how it learns.
        model_path: path of the model, where it has one.
        training: the world in which the policy learns.
        nominal: the model as it is; ``None`` where a number of an effect has no value of its own.
        target: the world of the config's ``target``, or ``None``.
        distribution_path: file of the distribution, or ``None``.
        fingerprint: identifies all of it; an interrupted run goes on only with the same.
    """

    config: Config
    algorithm: str
    settings: Settings
    model_path: Path | None
    training: World
    nominal: World | None
    target: World | None
    distribution_path: Path | None
    fingerprint: str

    def env(self, world: World, num_envs: int, seed: int) -> RandomizedEnv:
        """Return environments of one of the worlds, on the config's backend."""
        config, where = self.config, self.device
        engine: dict[str, Any] = {"backend": config.backend, "num_threads": config.threads, "device": where}
        return RandomizedEnv(**vars(world), num_envs=num_envs, seed=seed, **engine)

    @property
    def device(self) -> str:
        """Where environments and networks live."""
        return self.config.device if self.config.backend == "warp" else "cpu"


def make_training(config: Config) -> TrainingProblem:
    """Read, build and check everything that a config names for training; no log is needed.

    Raises:
        InputError: anything that does not fit, by key.
    """
    if config.backend == "gymnasium":
        raise InputError("backend: gymnasium steps one environment at a time; train with backend mujoco or warp")
    load_effects(config.own_effects, config.path)
    algorithm = config.algorithm or "ppo"
    settings = train_settings(algorithm, config.train)
    sim = None if config.sim is None else bundled_sim(config.sim)
    full = _completed(config, sim)
    task, model_path = _task(full)
    given = _given_distribution(full)
    space, effects = _space_and_effects(full, task)
    training = World(task, space, load_source(given, space), effects)
    nominal = replace(training, source=PointSource.nominal(space)) if np.isfinite(space.nominal).all() else None
    target = _target_world(full, {} if sim is None else sim.parameters, task) if config.target else None
    path, digest = given if isinstance(given, Path) else None, _fingerprint(config, algorithm, settings, training)
    return TrainingProblem(config, algorithm, settings, model_path, training, nominal, target, path, digest)


def _completed(config: Config, sim: BundledSim | None) -> Config:
    """The config with what its bundled simulation says of the keys that it leaves out."""
    if sim is None:
        return config
    if config.model is not None:
        raise InputError("config: both model and sim are given; expected one: model: robot.xml, or sim: hopper")
    own = {"task": config.sim, "model": str(sim.model), "parameters": sim.parameters, "observation": sim.observation}
    return config.model_copy(update={key: value for key, value in own.items() if getattr(config, key) is None})


def _task(config: Config) -> tuple[Task, Path | None]:
    """The task on the config's model, and that model's path."""
    if config.task is None:
        raise InputError("config: no task given; expected task: file.py:Class of a Task, or sim: hopper")
    task = load_task(config.task, base=config.base)
    if config.model is None:
        return task, None
    path = config.path(config.model)
    model = load_model(path, general=config.moves_centres)
    check_model(task, model, str(path))
    return task.on(model), path


def _given_distribution(config: Config) -> str | dict[str, float] | Path:
    """What the config says of the distribution: a keyword, values, or a file."""
    given = config.distribution
    if not config.parameters and given not in (None, "nominal"):
        raise InputError(
            "distribution: no parameters are given that it could be of; give parameters, or distribution: nominal"
        )
    if isinstance(given, dict):
        return {name: number(value, f"distribution.{name}") for name, value in given.items()}
    if given is None and not (config.parameters and (config.base / "fit.json").is_file()):
        return "uniform" if config.parameters else "nominal"
    if given in ("uniform", "nominal"):
        return given
    path = config.path(given or "fit.json").resolve()
    if not path.is_file():
        raise InputError(
            f"distribution: no file {path}; expected a fit.json, uniform, nominal, or name: value of every parameter"
        )
    return path


def _space_and_effects(config: Config, task: Task) -> tuple[ParameterSpace, EffectSet | None]:
    space = ParameterSpace(task.model, config.parameters) if config.parameters else ParameterSpace.empty(task.model)
    if not config.has_effects:
        return space, None
    observation, differentiated = parse_observation(task.model, config.observation), config.derives_velocities
    setting = plain_setting(task.model, observation, task.frame_skip, differentiated=differentiated)
    effects = place_effects(config.effects, space, setting, find_effect)
    return space.with_limits(lowest(effects, space)), effects


def _target_world(config: Config, bundled: Mapping[str, Mapping[str, Any]], task: Task) -> World:
    """The world of the config's ``target``: the model's own values but for those given."""
    values: dict[str, float] = {}
    wanted: dict[str, Mapping[str, Any]] = {**(config.parameters or {})}
    known = {**bundled, **wanted}
    for name, entry in config.target.items():
        if isinstance(entry, dict):
            spec = {k: v for k, v in entry.items() if k != "value"}
            values[name] = number(entry.get("value"), f"target.{name}.value")
            bounds = sorted([0.5 * values[name], 2 * values[name]]) if values[name] else [0.0, 1.0]  # that hold it
            wanted[name] = {"bounds": bounds, **spec}
        elif name in known:
            values[name] = number(entry, f"target.{name}")
            wanted[name] = known[name]
        else:
            other = f"; any other is given as {name}: {{field: body_mass, name: BODY, value: 1.0}}"
            raise InputError(f"target: unknown parameter {name!r}{choices(name, known)}{other}")
    space, effects = _space_and_effects(config.model_copy(update={"parameters": wanted}), task)
    vector = {**space.named(space.nominal), **values}
    for name, (low, high) in zip(space.names, space.limits, strict=True):
        if not np.isfinite(vector[name]):
            raise InputError(f"target: no value given for {name!r}, which the model has none of")
        if name in values and not low <= values[name] <= high:
            raise InputError(f"target.{name} is {values[name]:g}; the model allows {low:g} to {high:g}")
    return World(task, space, PointSource(vector), effects)


def _fingerprint(config: Config, algorithm: str, settings: Settings, training: World) -> str:
    """A digest of what decides a training's course."""
    task, distribution = training.task, training.source.document()
    learning = settings.model_dump(mode="json", exclude={"checkpoint_seconds"})
    given = [config.fingerprint(*_FITTING), config.derives_velocities, algorithm, learning, distribution]
    text = json.dumps(given, sort_keys=True)
    text += f"{type(task).__name__} {task.name} {task.frame_skip} {task.max_episode_steps}"
    places = (name.rpartition(":")[0] for name in (config.task or "", *config.own_effects))
    code = [config.path(place).read_bytes() for place in places if place.endswith(".py")]
    buffer = np.empty(mujoco.mj_sizeModel(task.model), np.uint8)
    mujoco.mj_saveModel(task.model, None, buffer)
    return hashlib.sha256(b"".join([text.encode(), *code, buffer.tobytes()])).hexdigest()[:32]
