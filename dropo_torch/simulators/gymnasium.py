"""The backend for any other simulator: a Gymnasium environment, or an adapter of the user's own."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import mujoco
import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.models.constants import derive
from dropo_torch.models.load import quiet_mujoco, show_divergence
from dropo_torch.parameters import ParameterSpace, read_field, unmark_frames
from dropo_torch.simulators.base import DIVERGED, Numbers, Simulator
from dropo_torch.simulators.hidden import filters_of, prescribed_bodies
from dropo_torch.support.usercode import user_code

if TYPE_CHECKING:
    import gymnasium


class Adapter(Protocol):
    """What a simulator must do to be fitted. States and controls are flat float64 arrays.

    Attributes:
        num_states: width of a state.
        num_controls: width of a control.
        timestep: seconds of one step, or ``None``.
    """

    num_states: int
    num_controls: int
    timestep: float | None

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Give the simulator named parameter values, in their units."""

    def set_state(self, state: np.ndarray) -> None:
        """Put the simulator into a state ``(num_states,)``, with nothing left of an earlier one."""

    def step(self, control: np.ndarray) -> np.ndarray:
        """Apply a control ``(num_controls,)`` for one logged transition; return the state after it."""


class MujocoEnvAdapter:
    """Drives a Gymnasium MuJoCo environment; states are ``[qpos, qvel]``.

    The environment's own actions are applied through its ``do_simulation``, so that a wrapper's or the
    environment's treatment of actions counts, and its rewards and terminations do not.

    Raises:
        InputError: an environment that is none of MuJoCo's, or a parameter that its model cannot vary.
    """

    def __init__(self, environment: gymnasium.Env, parameters: ParameterSpace) -> None:
        self._env: Any = environment.unwrapped
        if not hasattr(self._env, "do_simulation") or not isinstance(getattr(self._env, "model", None), mujoco.MjModel):
            raise InputError(
                f"environment: {environment} is no Gymnasium MuJoCo environment; write an adapter with "
                "set_parameters, set_state and step, and name it as file.py:function"
            )
        own = self._env.model
        if len(filters_of(own)) or prescribed_bodies(own):
            raise InputError(
                f"environment: {environment} has actuators with filters, or mocap bodies, whose state an environment "
                "cannot be put into; simulate its model with backend: mujoco"
            )
        self._env.reset(seed=0)
        unmark_frames(show_divergence(own), parameters)
        self._parameters = parameters
        self._own = copy.copy(own)
        self._data = mujoco.MjData(self._env.model)
        self.num_states = int(self._env.model.nq + self._env.model.nv)
        self.num_controls = int(self._env.model.nu)
        self.timestep: float | None = float(self._env.dt)

    def use_model(self, model: mujoco.MjModel) -> None:
        """Let the environment simulate another model of the same robot."""
        self._env.model = show_divergence(copy.copy(model))
        self._own = copy.copy(self._env.model)

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Write the parameters into the environment's model, and everything derived from them.

        Raises:
            mujoco.FatalError: values that MuJoCo refuses.
        """
        model = self._env.model
        for field in self._parameters.fields:  # directions of length 1 depend on the components that do not vary
            read_field(model, field)[...] = read_field(self._own, field)
        self._parameters.write_into(model, self._parameters.vector(values))
        mujoco.mj_resetData(model, self._data)
        with quiet_mujoco():
            derive(model, self._data)

    def set_state(self, state: np.ndarray) -> None:
        """Reset the physics and set positions and velocities."""
        model, data = self._env.model, self._env.data
        mujoco.mj_resetData(model, data)
        with quiet_mujoco():
            self._env.set_state(state[: model.nq].copy(), state[model.nq :].copy())
        data.qacc_warmstart[:] = 0  # set_state has run the solver; each transition starts it cold

    def step(self, control: np.ndarray) -> np.ndarray:
        """Apply an action for the environment's own frame skip; NaN where the physics has diverged."""
        with quiet_mujoco():
            self._env.do_simulation(control, self._env.frame_skip)
        after = np.concatenate([self._env.data.qpos, self._env.data.qvel])
        return after if (np.abs(after) < DIVERGED).all() else np.full_like(after, np.nan)


class CheckedAdapter:
    """An adapter of the user's own: what it lacks, raises or returns wrongly becomes one line.

    Args:
        adapter: the adapter.
        name: what messages call it.

    Raises:
        InputError: a method or a width that it lacks.
    """

    def __init__(self, adapter: Adapter, name: str) -> None:
        has = (
            "; an adapter has num_states, num_controls, timestep, set_parameters(values), set_state(state) and "
            "step(control)"
        )
        for method in ("set_parameters", "set_state", "step"):
            if not callable(getattr(adapter, method, None)):
                raise InputError(f"environment: {name} has no method {method}{has}")
        for width in ("num_states", "num_controls"):
            given = getattr(adapter, width, None)
            if not isinstance(given, int | np.integer):
                raise InputError(f"environment: {width} of {name} is {given!r}; expected a number{has}")
        timestep = getattr(adapter, "timestep", None)
        if timestep is not None and not (isinstance(timestep, int | float | np.number) and timestep > 0):
            raise InputError(f"environment: timestep of {name} is {timestep!r}; expected seconds of a step, or None")
        self._adapter, self._name = adapter, name
        self.num_states, self.num_controls = int(adapter.num_states), int(adapter.num_controls)
        self.timestep = None if timestep is None else float(timestep)

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Hand the values on."""
        with user_code("environment", self._name):
            self._adapter.set_parameters(values)

    def set_state(self, state: np.ndarray) -> None:
        """Hand the state on."""
        with user_code("environment", self._name):
            self._adapter.set_state(state)

    def step(self, control: np.ndarray) -> np.ndarray:
        """Step, and check what comes back."""
        with user_code("environment", self._name):
            given: Any = self._adapter.step(control)
        try:
            after = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            after = np.empty(0)
        if given is None or after.shape != (self.num_states,):
            shape = repr(given) if given is None or isinstance(given, str) else f"shape {np.shape(given)}"
            what = f"step of {self._name} returns {shape}"
            raise InputError(f"environment: {what}; expected ({self.num_states},) numbers")
        return after


class GymnasiumSimulator(Simulator):
    """Transitions on one environment, one after the other.

    Args:
        adapter: the simulator, or a function of the parameter space that makes it.
        parameters: what varies.
        frame_skip: steps of the adapter per logged transition.
    """

    name = "gymnasium"

    def __init__(
        self, adapter: Adapter | Callable[[ParameterSpace], Adapter], *, parameters: ParameterSpace, frame_skip: int = 1
    ) -> None:
        made: Adapter = adapter(parameters) if callable(adapter) else adapter
        own = isinstance(made, CheckedAdapter | MujocoEnvAdapter)
        self._adapter: Adapter = made if own else CheckedAdapter(made, type(made).__name__)
        self.parameters = parameters
        self.frame_skip = frame_skip
        self.num_states, self.num_controls = self._adapter.num_states, self._adapter.num_controls
        step = self._adapter.timestep
        self.timestep = None if step is None else step * frame_skip

    def rollout(self, states: Numbers, controls: Numbers, values: Numbers) -> torch.Tensor:
        """Return the states after each transition; see :meth:`Simulator.rollout`."""
        start, control, vectors = self.arrays(states, controls, values)
        out = np.full((len(start), len(vectors), control.shape[1], self.num_states), np.nan)
        for k, vector in enumerate(vectors):
            with contextlib.suppress(mujoco.FatalError):
                self._adapter.set_parameters(self.parameters.named(vector))
                for t in range(len(start)):
                    out[t, k] = self._transition(start[t], control[t])
        return torch.from_numpy(out)

    def _transition(self, state: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """States of one transition, ``(lag, num_states)``; NaN where the simulator fails."""
        after = np.full((len(controls), self.num_states), np.nan)
        with contextlib.suppress(mujoco.FatalError):
            self._adapter.set_state(state)
            for step, control in enumerate(controls):
                for _ in range(self.frame_skip):
                    after[step] = self._adapter.step(control)
        return after if np.isfinite(after).all() else np.full_like(after, np.nan)
