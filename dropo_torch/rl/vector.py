"""The same environments as a Gymnasium vector environment, for trainers other than TorchRL's."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from dropo_torch.errors import InputError
from dropo_torch.rl.env import RandomizedEnv


class RandomizedVectorEnv(gymnasium.vector.VectorEnv):
    """A :class:`~dropo_torch.rl.RandomizedEnv` as Gymnasium has it: NumPy arrays, automatic resets in the same step.

    Where an episode ends, the observation that :meth:`step` returns is the next one's first; the last one is in
    ``infos["final_obs"]``. ``infos["parameters"]`` ``(N, d)`` are those of the episodes that go on, and
    ``infos["diverged"]`` ``(N,)`` says which simulations have just diverged.

    Args:
        env: the environments; they are used by this alone from now on.
    """

    def __init__(self, env: RandomizedEnv) -> None:
        self.env, self.num_envs = env, env.num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.render_mode = None
        low, high = (np.asarray(x, dtype=np.float32) for x in (env.task.action_low, env.task.action_high))
        self.single_action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        width = (env.task.num_observations,)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, width, dtype=np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin new episodes, in all environments or where ``options["reset_mask"]`` ``(N,)`` is true.

        Raises:
            InputError: several seeds; one seeds all environments.
        """
        if seed is not None and not isinstance(seed, int):
            raise InputError("seed: several given; expected one, which seeds all environments")
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        mask = (options or {}).get("reset_mask")
        observations = self._reset(np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask, dtype=bool))
        return observations, self._infos(np.zeros(self.num_envs, dtype=bool))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Make a step in every environment, and begin new episodes where one ends."""
        given = torch.as_tensor(np.asarray(actions, dtype=np.float32), device=self.env.device)
        after = self.env.step(self.env.now().set("action", given)).get("next")
        keys = ("observation", "reward", "terminated", "truncated", "diverged")
        observations, *columns = (_array(after.get(key)) for key in keys)
        rewards, terminated, truncated, diverged = (column[:, 0] for column in columns)
        done = terminated | truncated
        infos: dict[str, Any] = {}
        if done.any():
            final = np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(done):
                final[row] = observations[row].copy()
            infos |= {"final_obs": final, "_final_obs": done.copy()}
            observations = self._reset(done)
        return observations, rewards.astype(np.float64), terminated, truncated, infos | self._infos(diverged)

    def _infos(self, diverged: np.ndarray) -> dict[str, Any]:
        every = np.ones(self.num_envs, dtype=bool)
        infos = {"diverged": diverged, "_diverged": every}
        if len(self.env.space):
            infos |= {"parameters": self.env.values.numpy(), "_parameters": every.copy()}
        return infos

    def _reset(self, mask: np.ndarray) -> np.ndarray:
        """Begin new episodes where ``mask`` is true, and return the observations of all environments ``(N, n)``."""
        rows = torch.from_numpy(mask)[:, None].to(self.env.device)
        return _array(self.env._reset(self.env.now().set("_reset", rows)).get("observation"))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environments."""
        self.env.close(raise_if_closed=False)


def _array(tensor: torch.Tensor) -> np.ndarray:
    """A copy of a tensor."""
    return tensor.cpu().numpy().copy()
