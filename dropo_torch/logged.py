"""The log that a config names, with its model and what its columns are: all that an examination needs.

Nothing heavy is imported for it, so that it takes no longer than it must.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dropo_torch.config import Config
from dropo_torch.data.examination import Finding, examine
from dropo_torch.data.observation import Observation, generic_observation, parse_observation
from dropo_torch.data.readers import read_trajectories
from dropo_torch.data.recording import TOLERANCE
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.errors import InputError
from dropo_torch.models.bundled import bundled_sim
from dropo_torch.models.load import load_model

#: Relative difference between the log's time step and the simulator's that is still called equal.
TIME_TOLERANCE = 1e-3
#: Relative deviation of time stamps that an examination reads, so as to tell it.
UNEVEN = 1e9
#: Seconds between rows beyond which stamps are rather in another unit.
SLOWEST = 1.0


@dataclass(frozen=True)
class LoggedData:
    """A log and what its columns are: what is examined before anything is fitted.

    Attributes:
        model_path: path of the model, where there is one.
        model: the model, or ``None`` for another simulator.
        trajectories: the log, or the part of it that is used.
        observation: what its columns are.
        frame_skip: physics steps of one logged transition.
        tolerance: relative deviation of time stamps that the reader refuses.
    """

    model_path: Path | None
    model: mujoco.MjModel | None
    trajectories: Trajectories
    observation: Observation
    frame_skip: int
    tolerance: float = np.inf

    def examined(self) -> tuple[Finding, ...]:
        """Return what is wrong with the log, the sure findings first."""
        return examine(
            self.trajectories, self.observation, self.model, self.frame_skip, tolerance=self.tolerance
        )  # fmt: skip


def read_log(config: Config, *, uneven: bool = False) -> LoggedData:
    """Read the log that a config names, and its model; no parameters are needed.

    Args:
        config: the config.
        uneven: read uneven time stamps, too, which the examination then tells.

    Raises:
        InputError: anything that does not fit, by key.
    """
    config, tolerance = completed(config), np.inf
    if config.backend == "gymnasium":
        trajectories = log_of(config, None)
        width = trajectories.observations.shape[1]
        return LoggedData(None, None, trajectories, generic_observation(width), config.frame_skip or 1)
    path = config.path(str(config.model))
    model = load_model(path)
    if uneven and not (isinstance(config.data, dict) and "tolerance" in config.data):
        tolerance = TOLERANCE
    trajectories = log_of(config, model, UNEVEN if np.isfinite(tolerance) else TOLERANCE)
    frame_skip = frame_skip_of(config, model, trajectories)
    observation = parse_observation(model, config.observation, trajectories.observations.shape[1])
    return LoggedData(path, model, trajectories, observation, frame_skip, tolerance)


def completed(config: Config) -> Config:
    """Return the config with what its bundled simulation says of the keys that it leaves out.

    An environment has a model and a step of its own, an adapter without a model names of its own, too.
    """
    sim = None if config.sim is None else bundled_sim(config.sim)
    own: dict[str, Any] = {}
    if sim is not None:
        own["data"] = str(sim.log)
        if config.backend != "gymnasium" or is_registered(config.environment) or config.model is not None:
            own |= {"parameters": dict(sim.parameters), "observation": list(sim.observation)}
    if config.backend != "gymnasium":
        if config.environment is not None:
            raise InputError("config: environment belongs to backend: gymnasium; add that, or leave environment out")
        if (config.model is None) == (sim is None):
            both = "both model and sim are" if sim else "neither model nor sim is"
            raise InputError(f"config: {both} given; expected one: model: robot.xml, or sim: hopper")
        if sim is not None:
            own |= {"model": str(sim.model), "frame_skip": sim.frame_skip}
    return config.model_copy(update={key: value for key, value in own.items() if getattr(config, key) is None})


def is_registered(environment: str | None) -> bool:
    """Return whether a name is one of Gymnasium's ids, and no adapter."""
    return environment is not None and re.search(r"-v\d+$", environment) is not None


def log_of(config: Config, model: mujoco.MjModel | None, tolerance: float = TOLERANCE) -> Trajectories:
    """Return the part of a config's log that is used.

    Raises:
        InputError: no log, or one that cannot be read as the config says.
    """
    source = config.data
    if source is None:
        raise InputError("config: no data given; expected the path of a log, such as data: log.npz")
    if isinstance(source, dict) and isinstance(source.get("preprocess"), dict) and "dt" not in source["preprocess"]:
        if model is None or config.frame_skip is None:
            raise InputError("data: preprocess needs dt, the seconds of one transition (or frame_skip, and a model)")
        step = float(model.opt.timestep) * config.frame_skip
        source = {**source, "preprocess": {"dt": step, **source["preprocess"]}}
    return used(config, read_trajectories(source, base=config.base, tolerance=tolerance))


def used(config: Config, log: Trajectories) -> Trajectories:
    """Return the episodes of a log that a config uses, without the spans that it leaves out.

    Raises:
        InputError: episodes or spans that the log does not have, or spans that leave nothing.
    """
    wanted = config.trajectories
    if isinstance(wanted, int):
        if not 1 <= wanted <= log.num_episodes:
            raise InputError(f"trajectories: {wanted} asked for; {log.source} has {log.num_episodes}")
        wanted = list(range(wanted))
    log = log if wanted is None else log.select_episodes(wanted)
    return without_spans(log, config.leave_out) if config.leave_out else log


def without_spans(log: Trajectories, spans: Sequence[tuple[int, float, float]]) -> Trajectories:
    """Return a log without spans of its episodes, which end there and begin anew.

    Args:
        log: the log.
        spans: episode, counted from 0, and begin and end in seconds since it began.

    Raises:
        InputError: a span that the log does not have, spans that leave nothing, or rows whose time is unknown.
    """
    if log.dt is None:
        raise InputError(f"leave_out: {log.source} has no time stamps; say data: {{dt: SECONDS}}")
    episodes, kept = log.episodes, np.ones(len(log), dtype=bool)
    rows = np.arange(len(log)) - np.searchsorted(episodes, episodes)
    for episode, begin, end in spans:
        length = int((episodes == episode).sum()) * log.dt
        if not 0 <= begin < end or begin >= length:
            has = f"lasts {length:g} s" if length else f"is none of {log.num_episodes}"
            raise InputError(
                f"leave_out: [{episode}, {begin:g}, {end:g}] is no span of {log.source}: episode {episode} {has}"
            )
        kept &= (episodes != episode) | ((rows + 1) * log.dt <= begin + 1e-9) | (rows * log.dt >= end - 1e-9)
    if not kept.any():
        raise InputError(f"leave_out: nothing of {log.source} is left")
    return log.select(kept)


def frame_skip_of(config: Config, model: mujoco.MjModel | None, trajectories: Trajectories) -> int:
    """Return ``frame_skip`` as given, or as the log's time step says."""
    if config.frame_skip is not None:
        return config.frame_skip
    if config.backend == "gymnasium":
        return 1  # an environment's step is what its designer calls one
    assert model is not None
    step = float(model.opt.timestep)
    if trajectories.dt is None:
        raise InputError(
            f"config: no frame_skip given, and the log has no time stamps; the model's step is {step:g} s, "
            "so a log sampled every x seconds needs frame_skip: x / step"
        )
    if trajectories.dt > SLOWEST:
        raise InputError(
            f"data: sampled every {trajectories.dt:g} s by its time stamps; are they in seconds? Milliseconds are "
            "data: {time: {signal: NAME, scale: 1e-3}}. If they are, say frame_skip"
        )
    ratio = trajectories.dt / step
    if round(ratio) < 1 or abs(ratio - round(ratio)) > TIME_TOLERANCE * ratio:
        raise InputError(
            f"data: sampled every {trajectories.dt:g} s, which is no whole number of the model's steps of {step:g} s; "
            "resample the log (data: preprocess: dt) or change the model's timestep"
        )
    return round(ratio)
