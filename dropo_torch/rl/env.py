"""Environments with parameters of their own, as one TorchRL environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from dropo_torch.effects.placing import EffectSet
from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl.effects import Commands, Sensors, no_effects
from dropo_torch.rl.sampling import ParameterSource, UniformSource
from dropo_torch.rl.stepper import make_stepper
from dropo_torch.rl.task import Task, check_model, check_task, load_task
from dropo_torch.simulators.base import DIVERGED


class RandomizedEnv(EnvBase):
    """N environments of one task that step as one batch; each episode has parameters of its own.

    Keys: ``observation`` float32 ``(N, n)``, ``parameters`` float32 ``(N, d)`` (in their units; for critics and
    analysis, not for a policy that is to run on the robot), ``step_count`` int64 ``(N, 1)``, ``diverged`` bool
    ``(N, 1)``, ``action`` float32, ``reward`` float32, ``done``, ``terminated`` and ``truncated``, ``(N, 1)``.

    The model that is simulated is the one that ``space`` (or ``effects``) belongs to, and the task's where there is
    neither. A simulation that diverges ends its episode: it is terminated with reward 0 and its last good observation,
    and counted in ``num_diverged``. So is a step for which the task gives a number that is not finite, counted in
    ``num_repaired``. A time limit truncates.

    Args:
        task: the task, or what :func:`~dropo_torch.rl.task.load_task` understands.
        num_envs: environments N.
        space: what varies; nothing by default.
        source: where an episode's parameters come from; by default the bounds of ``space``, uniformly.
        effects: physical effects, understood over ``space``. Those of sensors change what is observed; reward and
            termination see the true states.
        backend: ``"mujoco"`` or ``"warp"``.
        seed: of initial states and parameters.
        num_threads: threads of a CPU, 0 for all processors; results do not depend on it.
        device: of the tensors; with ``backend="warp"`` also of the simulation.
        expose_parameters: whether ``parameters`` is among the keys.

    Attributes:
        num_diverged: simulations that have diverged so far.
        num_repaired: steps so far whose reward or observation was not finite.

    Raises:
        InputError: a task, parameters, effects and a backend that do not fit each other.
    """

    #: What is kept of every environment, beside the simulations and effects; replaced in each step, never written to.
    _KEPT = ("values", "states", "observation", "count")

    def __init__(
        self,
        task: Task | str,
        num_envs: int,
        *,
        space: ParameterSpace | None = None,
        source: ParameterSource | None = None,
        effects: EffectSet | None = None,
        backend: str = "mujoco",
        seed: int = 0,
        num_threads: int = 0,
        device: str | torch.device = "cpu",
        expose_parameters: bool = True,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs: {num_envs} given; expected 1 or more")
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.task = load_task(task)
        check_task(self.task)
        self.num_envs, self.num_diverged, self.num_repaired = num_envs, 0, 0
        self.space = _checked_space(self.task, space, source, effects)
        if self.space.model is not self.task.model and self.space.model is not None:
            self.task = self.task.on(self.space.model)
        self.source = (UniformSource(self.space) if source is None else source).over(self.space)
        effects = effects or no_effects(self.space, self.task.frame_skip)
        self._stepper = make_stepper(
            backend, self.space, num_envs, frame_skip=self.task.frame_skip, effects=effects, num_threads=num_threads,
            device=str(device),
        )  # fmt: skip
        self._commands = Commands(effects, num_envs, device=self.device)
        self._sensors = Sensors(effects, num_envs, space=self.space, device=self.device)
        self._exposed = expose_parameters and len(self.space) > 0
        self._generator = torch.Generator()
        self._values = torch.zeros(num_envs, len(self.space), dtype=torch.float64, device=self.device)
        self._states = torch.zeros(num_envs, self._stepper.num_states, dtype=torch.float64, device=self.device)
        self._observation = torch.zeros(num_envs, self.task.num_observations, device=self.device)
        self._count = torch.zeros(num_envs, 1, dtype=torch.int64, device=self.device)
        self._make_specs()
        self.set_seed(seed)

    def _make_specs(self) -> None:
        batch, column = (self.num_envs,), (self.num_envs, 1)
        flag = Binary(1, shape=column, dtype=torch.bool)
        entries = {"observation": Unbounded((*batch, self.task.num_observations)), "diverged": flag}
        entries["step_count"] = Unbounded(column, dtype=torch.int64)
        if self._exposed:
            entries["parameters"] = Unbounded((*batch, len(self.space)))
        self.observation_spec = Composite(entries, shape=batch).to(self.device)
        bounds = (torch.as_tensor(x, dtype=torch.float32) for x in (self.task.action_low, self.task.action_high))
        low, high = (x.expand(*batch, -1).clone() for x in bounds)
        self.action_spec = Bounded(low, high, shape=low.shape, dtype=torch.float32).to(self.device)
        self.reward_spec = Unbounded(column).to(self.device)
        ends = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(ends, shape=batch).to(self.device)

    @property
    def values(self) -> torch.Tensor:
        """The parameters of each environment's episode, in their units, ``(N, d)`` float64, on the CPU."""
        return self._values.cpu().clone()

    @property
    def states(self) -> torch.Tensor:
        """The true states ``[qpos, qvel]``, ``(N, nq + nv)`` float64; the last good ones where one diverged."""
        return self._states.clone()

    def now(self) -> TensorDictBase:
        """Return what the environments show at present, all of them in the midst of an episode."""
        flags = ("terminated", "truncated", "done", "diverged")
        return self._tensordict({key: torch.zeros_like(self._count, dtype=torch.bool) for key in flags})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict.get("action").detach().to(torch.float64)
        controls = self.task.motion(actions)
        if not torch.isfinite(controls).all():
            row = int((~torch.isfinite(controls)).flatten(1).any(1).nonzero()[0])
            raise InputError(f"action: {tensordict.get('action')[row].tolist()} in environment {row} is not finite")
        signals = self._commands(controls) if self._commands or self._sensors else controls
        path = self._stepper.step(signals).to(self.device)
        good = (path.abs() < DIVERGED).flatten(1).all(1)
        if not bool(good.all()):
            path = torch.where(good[:, None, None], path, self._states[:, None])
            self.num_diverged += int((~good).sum())
        before, self._states = self._states, path[:, -1]
        if self._sensors:
            self._sensors.record(path)
        observation = self._observed()
        reward = self.task.reward(before, actions, self._states).to(torch.float32)
        terminated = self.task.terminated(self._states)
        sound = good & torch.isfinite(reward) & torch.isfinite(observation).all(1)
        if not bool(sound.all()):
            self.num_repaired += int((good & ~sound).sum())
            observation = torch.where(sound[:, None], observation, self._observation)
            reward, terminated = torch.where(sound, reward, 0.0), terminated | ~sound
        self._observation, self._count = observation, self._count + 1
        truncated, terminated = self._count >= self.task.max_episode_steps, terminated[:, None]
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return self._tensordict({"reward": reward[:, None], **ends, "diverged": ~good[:, None]})

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = torch.arange(self.num_envs) if mask is None else mask.reshape(self.num_envs).nonzero()[:, 0].cpu()
        if len(rows):
            self._restart(rows)
        return self.now()

    def _tensordict(self, entries: dict[str, torch.Tensor]) -> TensorDictBase:
        entries |= {"observation": self._observation, "step_count": self._count}
        if self._exposed:
            entries["parameters"] = self._values.to(torch.float32)
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _observed(self, rows: torch.Tensor | slice = slice(None)) -> torch.Tensor:
        """What the task observes of some environments, ``(k, n)`` float32."""
        shown = self._sensors.show(self._states) if self._sensors else self._states
        return self.task.observe(shown[rows]).to(torch.float32)

    def _restart(self, rows: torch.Tensor) -> None:
        """Begin new episodes in environments ``rows``; what was handed out before is not written to."""
        values = self.source.sample(len(rows), self._generator)
        start = self.task.initial_states(len(rows), self._generator).to(self.device, torch.float64)
        self._stepper.reset(rows, start, values)
        at = rows.to(self.device)
        self._values = self._values.index_copy(0, at, values.to(self.device))
        self._states = self._states.index_copy(0, at, start)
        self._count = self._count.index_fill(0, at, 0)
        self._reset_effects(at)
        observation = self._observed(at)
        if not bool(torch.isfinite(observation).all()):
            raise InputError(f"task: {self.task.name}: observe gives a number that is not finite for a start state")
        self._observation = self._observation.index_copy(0, at, observation)

    def _reset_effects(self, rows: torch.Tensor) -> None:
        """Tell the effects outside the simulation that episodes begin in environments ``rows``."""
        values = self._values[rows].cpu().numpy()
        self._commands.reset(rows, values)
        if self._sensors:
            self._sensors.reset(rows, self._states[rows], values)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(seed)

    def get_extra_state(self) -> dict[str, Any]:
        """Return all that the next steps depend on; it is what ``state_dict`` holds."""
        return {
            "stepper": self._stepper.state_dict(), "commands": self._commands.state_dict(),
            "sensors": self._sensors.state_dict(), "generator": self._generator.get_state(),
            "num_diverged": self.num_diverged, "num_repaired": self.num_repaired,
            **{name: getattr(self, f"_{name}") for name in self._KEPT},
        }  # fmt: skip

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of :meth:`get_extra_state`."""
        if state["states"].shape != self._states.shape or state["values"].shape != self._values.shape:
            raise InputError(
                f"environments: the saved state is of {len(state['states'])} environments with "
                f"{state['values'].shape[1]} parameters; these are {self.num_envs} with {len(self.space)}"
            )
        for name in self._KEPT:
            setattr(self, f"_{name}", state[name].to(self.device))
        self.num_diverged, self.num_repaired = state["num_diverged"], state["num_repaired"]
        self._generator.set_state(state["generator"])
        self._stepper.load_state_dict(state["stepper"], self._values)
        self._reset_effects(torch.arange(self.num_envs, device=self.device))
        self._commands.load_state_dict(state["commands"])
        self._sensors.load_state_dict(state["sensors"])


def _checked_space(
    task: Task, space: ParameterSpace | None, source: ParameterSource | None, effects: EffectSet | None
) -> ParameterSpace:
    """The parameters over the model that is simulated."""
    if space is None:
        if source is not None:
            raise InputError("source: given without a space; give the parameters that it draws, too")
        space = ParameterSpace.empty(task.model if effects is None else effects.setting.model)
    model = space.model
    if model is None:
        raise InputError("space: these parameters belong to no MuJoCo model")
    check_model(task, model, "this one")
    if effects is None:
        named = [p.name for p in space.parameters if p.effect]
        if named:
            raise InputError(f"parameters.{named[0]}: a number of an effect, but no effects are given")
    elif effects.setting.frame_skip != task.frame_skip:
        raise InputError(
            f"effects: understood with frame_skip {effects.setting.frame_skip}; task {task.name} has {task.frame_skip}"
        )
    return space
