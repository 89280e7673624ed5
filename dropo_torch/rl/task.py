"""What a policy is to do: observation, reward and end of an episode, of many environments at once."""

from __future__ import annotations

import abc
import copy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.models.bundled import bundled_sim
from dropo_torch.support.usercode import load_callable, user_code


class _ControlRange:
    """An end of the model's ``ctrlrange``, as the model has it by then, unless the task sets the attribute itself."""

    def __init__(self, column: int) -> None:
        self._column = column

    def __get__(self, task: Task | None, kind: type | None = None) -> Any:
        if task is None:
            return self
        limited = task.model.actuator_ctrllimited.astype(bool)
        if not limited.all():
            name = task.model.actuator(int(np.flatnonzero(~limited)[0])).name
            raise InputError(
                f"task: {task.name}: actuator {name!r} has no ctrlrange; give it one in the model, or give the task "
                "action_low and action_high"
            )
        return task.model.actuator_ctrlrange[:, self._column].copy()


class Task(abc.ABC):
    """A task on a MuJoCo model. It holds no state: every method is a function of N environments' states.

    States are ``[qpos, qvel]``, ``(N, nq + nv)`` float64, on the environments' device.

    Attributes:
        name: what it is called.
        model: the model as the task knows it.
        frame_skip: physics steps of an environment step.
        max_episode_steps: environment steps after which an episode is cut off.
        num_observations: width of an observation.
        action_low, action_high: lowest and highest actions, ``(num_actions,)`` each; by default the model's
            ``ctrlrange``.
    """

    name: str
    model: mujoco.MjModel
    frame_skip: int
    max_episode_steps: int
    num_observations: int
    action_low = _ControlRange(0)
    action_high = _ControlRange(1)

    @abc.abstractmethod
    def initial_states(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Draw initial states ``(count, nq + nv)``, float64, on the CPU."""

    @abc.abstractmethod
    def observe(self, states: torch.Tensor) -> torch.Tensor:
        """Return observations ``(N, num_observations)`` of states as the sensors show them."""

    @abc.abstractmethod
    def reward(self, states: torch.Tensor, actions: torch.Tensor, next_states: torch.Tensor) -> torch.Tensor:
        """Return the rewards ``(N,)`` of transitions; actions are the policy's, ``(N, num_actions)``."""

    @abc.abstractmethod
    def terminated(self, next_states: torch.Tensor) -> torch.Tensor:
        """Return which episodes end in these states, ``(N,)`` bool."""

    def controls(self, actions: torch.Tensor) -> torch.Tensor:
        """Return the model's controls ``(N, nu)`` of actions; the actions themselves by default.

        Where an action is a whole motion, S controls in a row, ``(N, S, nu)``, each held for ``frame_skip / S`` physics
        steps.
        """
        return actions

    def motion(self, actions: torch.Tensor) -> torch.Tensor:
        """Return :meth:`controls` of an environment step in a row, ``(N, S, nu)``, one where they are one."""
        controls = self.controls(actions)
        return controls[:, None] if controls.ndim == 2 else controls

    @property
    def timestep(self) -> float:
        """Seconds of an environment step."""
        return float(self.model.opt.timestep) * self.frame_skip

    def on(self, model: mujoco.MjModel) -> Task:
        """Return the same task on another model of the same robot."""
        other = copy.copy(self)
        other.model = model
        return other


def load_task(task: str | Task, *, base: Path | None = None) -> Task:
    """Return a task: itself, a bundled simulation's by name, or the user's own.

    Args:
        task: a task, ``"hopper"``, ``"file.py:Class"`` or ``"module:Class"``; the class takes no arguments.
        base: folder against which a file's path counts, by default the current one.

    Raises:
        InputError: a name that leads to no task, or a class that fails or lacks something.
    """
    if isinstance(task, Task):
        return task
    name = task if ":" in task else bundled_sim(task, key="task").task
    if name is None:
        raise InputError(f"task: the bundled simulation {task!r} has none; expected file.py:Class of a Task")
    what, example = "class {} that is a Task", "a bundled simulation such as hopper, or file.py:Class of a Task"
    maker = load_callable("task", name, path=(base or Path()).joinpath, what=what, example=example)
    with user_code("task", name):
        made = maker()
    if not isinstance(made, Task):
        raise InputError(f"task: {name} makes a {type(made).__name__}; expected a subclass of dropo_torch.rl.Task")
    missing = [a for a in Task.__annotations__ if not hasattr(made, a)]
    if missing:
        raise InputError(f"task: {name} has no {missing[0]}; a task has {', '.join(Task.__annotations__)}")
    return made


def check_model(task: Task, model: mujoco.MjModel, called: str) -> None:
    """Raise an :class:`InputError` for a model of other sizes than the task's; ``called`` names it."""
    for size in ("nq", "nv", "nu"):
        ours, theirs = getattr(task.model, size), getattr(model, size)
        if ours != theirs:
            raise InputError(f"task: {task.name} is for a model with {size} {ours}; {called} has {theirs}")


def check_task(task: Task) -> None:
    """Raise an :class:`InputError` for a task whose methods fail, or return other shapes than they should."""
    width, where = task.model.nq + task.model.nv, f"task: {task.name}"
    for name in ("frame_skip", "max_episode_steps", "num_observations"):
        given = getattr(task, name)
        if isinstance(given, bool) or not isinstance(given, int | np.integer) or given < 1:
            raise InputError(f"{where}: {name} is {given!r}; expected a whole number, 1 or more")
    _check_bounds(task, where)
    with user_code("task", task.name):
        middle = torch.from_numpy(0.5 * (np.asarray(task.action_low) + np.asarray(task.action_high)))[None]
        states = task.initial_states(1, torch.Generator().manual_seed(0))
        _expect(f"{where}: initial_states(1)", states, (1, width))
        states = states.to(torch.float64)
        _check_controls(task, where, task.controls(middle))
        _expect(f"{where}: observe", task.observe(states), (1, task.num_observations))
        _expect(f"{where}: reward", task.reward(states, middle, states), (1,))
        ends = task.terminated(states)
        _expect(f"{where}: terminated", ends, (1,))
    if ends.dtype != torch.bool:
        raise InputError(f"{where}: terminated returns {ends.dtype}; expected torch.bool")


def _check_controls(task: Task, where: str, given: object) -> None:
    """Raise for controls of one environment that are neither one nor several in a row."""
    if not isinstance(given, torch.Tensor) or given.ndim != 3:
        _expect(f"{where}: controls", given, (1, task.model.nu))
        return
    count = given.shape[1]
    _expect(f"{where}: controls", given, (1, count, task.model.nu))
    if not count or task.frame_skip % count:
        raise InputError(
            f"{where}: controls returns {count} controls in a row; expected a number that divides frame_skip, "
            f"{task.frame_skip}"
        )


def _check_bounds(task: Task, where: str) -> None:
    """Raise for bounds of actions that are no bounds."""
    low, high = (np.asarray(getattr(task, name), dtype=np.float64) for name in ("action_low", "action_high"))
    if low.ndim != 1 or low.shape != high.shape:
        raise InputError(f"{where}: action_low and action_high have shapes {low.shape} and {high.shape}; expected one")
    fits = np.isfinite(low) & np.isfinite(high) & (low < high)
    if not fits.all():
        column = int(np.flatnonzero(~fits)[0])
        raise InputError(
            f"{where}: action {column} is between {low[column]:g} and {high[column]:g}; expected two finite numbers, "
            "the lower first"
        )


def _expect(what: str, given: object, shape: tuple[int, ...]) -> None:
    """Raise unless a method has returned a tensor of one environment's shape."""
    if not isinstance(given, torch.Tensor):
        raise InputError(f"{what} returns a {type(given).__name__}; expected a tensor")
    if tuple(given.shape) != shape:
        raise InputError(f"{what} returns shape {tuple(given.shape)} for one environment; expected {shape}")
