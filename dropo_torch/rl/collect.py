"""Experience: a policy acts in a batch of environments, and what happens is kept."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

#: Finished episodes whose returns are averaged into the learning curve.
WINDOW = 100

#: Maps observations ``(N, n)`` and parameters ``(N, d)`` to actions in [-1, 1], and what else is to be kept.
Act = Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, Mapping[str, torch.Tensor]]]


class Collector:
    """Steps a batch of environments, and goes on where it stopped.

    Args:
        env: N environments that reset on their own time limits and terminations, and give finite numbers only.
        to_action: maps actions in [-1, 1] to the environment's units.
    """

    def __init__(self, env: EnvBase, to_action: Callable[[torch.Tensor], torch.Tensor]) -> None:
        self._env, self._to_action = env, to_action
        self._now: TensorDictBase | None = None
        self._return = torch.zeros(env.batch_size[0], dtype=torch.float64)
        self._length = torch.zeros(env.batch_size[0], dtype=torch.int64)
        self.returns: deque[float] = deque(maxlen=WINDOW)
        self.lengths: deque[int] = deque(maxlen=WINDOW)
        self.episodes = 0

    @torch.no_grad()
    def collect(self, act: Act, horizon: int) -> TensorDict:
        """Return ``horizon`` steps of every environment, batch ``(N, horizon)``.

        Entries: observation, parameters, action (in [-1, 1]), what ``act`` adds, and below next: observation, reward,
        done and terminated.
        """
        rows = []
        now = self._env.reset() if self._now is None else self._now
        for _ in range(horizon):
            observation, parameters = now.get("observation"), _parameters(now)
            unit, extra = act(observation, parameters)
            now.set("action", self._to_action(unit).to(self._env.action_spec.dtype))
            after, now = self._env.step_and_maybe_reset(now)
            found = after.get("next")
            self._count(found.get("reward")[:, 0], found.get("done")[:, 0])
            ends = {key: found.get(key) for key in ("observation", "reward", "done", "terminated")}
            step = {"observation": observation, "parameters": parameters, "action": unit, **extra}
            step["next"] = TensorDict._new_unsafe(ends, batch_size=unit.shape[:1])
            rows.append(TensorDict._new_unsafe(step, batch_size=unit.shape[:1]))
        self._now = now
        return torch.stack(rows, 1)

    def _count(self, reward: torch.Tensor, done: torch.Tensor) -> None:
        """Add up returns, and note those of finished episodes."""
        self._return += reward.cpu()
        self._length += 1
        if not bool(done.any()):
            return
        ended = done.cpu()
        self.returns.extend(self._return[ended].tolist())
        self.lengths.extend(self._length[ended].tolist())
        self.episodes += int(ended.sum())
        self._return[ended] = 0.0
        self._length[ended] = 0

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, the environments' state too."""
        now = self._now
        return {
            "now": None if now is None else {k: v.clone() for k, v in now.items()},
            "return": self._return.clone(),
            "length": self._length.clone(),
            "returns": list(self.returns),
            "lengths": list(self.lengths),
            "episodes": self.episodes,
            "env": self._env.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that :meth:`state_dict` returned."""
        self._env.load_state_dict(state["env"])
        self._now = None
        if state["now"] is not None:
            self._now = TensorDict(state["now"], batch_size=self._env.batch_size, device=self._env.device)
        self._return, self._length = state["return"].clone(), state["length"].clone()
        self.returns, self.lengths = deque(state["returns"], WINDOW), deque(state["lengths"], WINDOW)
        self.episodes = state["episodes"]


def _parameters(now: TensorDictBase) -> torch.Tensor:
    """The episodes' parameters ``(N, d)``; of width 0 where nothing varies."""
    found = now.get("parameters", None)
    return now.get("observation")[:, :0] if found is None else found
