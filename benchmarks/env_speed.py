"""Speed of a task under random actions beside TorchRL's and Gymnasium's own, and the bare mujoco.batch, in one run.

Every contestant steps the same model with the same frame skip on the same cores; repeats are interleaved. Gymnasium's
AsyncVectorEnv is tried with several numbers of processes, and the fastest counts; for the Hopper its environments are
Gymnasium's own, for others plain MuJoCo whose observation is the state and whose reward a number, which is less than
the task's. The Hopper has TorchRL's beside it, too: as its default ParallelEnv, a process a core and twice as many, and
as a SerialEnv; and the bare rollout, with parameters of its own in each simulation, which begins anew after as many
steps as a random episode has on average.

    python benchmarks/env_speed.py [--sim push] [--envs 1024] [--cores 2] [--repeats 5] [--seconds 3]
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Callable
from functools import partial

import gymnasium
import mujoco.batch
import numpy as np
import torch
from dropo_sims.hopper import SIM
from dropo_sims.hopper.task import HopperTask
from torchrl.envs import EnvBase, HopperEnv

from dropo_torch.models.bundled import bundled_sim
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl import MujocoStepper, RandomizedEnv
from dropo_torch.rl.task import load_task

SKIP = SIM.frame_skip
#: A contestant: makes environment steps until the given time has passed; returns steps per second.
Contestant = Callable[[float], float]


def timed(step: Callable[[], int], seconds: float) -> float:
    """Steps per second of calls that each make some."""
    step()
    count, begin = 0, time.perf_counter()
    while (passed := time.perf_counter() - begin) < seconds:
        count += step()
    return count / passed


def torchrl(env: EnvBase) -> Contestant:
    """A TorchRL environment under random actions, with automatic resets."""
    state = {"td": env.reset()}

    def step() -> int:
        td = env.rand_action(state["td"])
        _, state["td"] = env.step_and_maybe_reset(td)
        return env.batch_size.numel()

    return lambda seconds: timed(step, seconds)


class Plain(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment of a bundled task, stepped by plain MuJoCo."""

    def __init__(self, sim: str) -> None:
        self.task = load_task(sim)
        self.model = self.task.model
        self.data = mujoco.MjData(self.model)
        size = self.model.nq + self.model.nv
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.action_space = gymnasium.spaces.Box(self.task.action_low, self.task.action_high, dtype=np.float64)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, object] | None = None) -> tuple[np.ndarray, dict]:
        """Begin at one of the task's initial states."""
        super().reset(seed=seed)
        state = self.task.initial_states(1, torch.Generator().manual_seed(int(self.np_random.integers(1 << 31))))[0]
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = state[: self.model.nq], state[self.model.nq :]
        self.steps = 0
        return self._state(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Make a step; the reward is the state's first number."""
        self.data.ctrl[:] = self.task.controls(torch.from_numpy(action)[None])[0]
        mujoco.mj_step(self.model, self.data, self.task.frame_skip)
        self.steps += 1
        return self._state(), float(self.data.qpos[0]), False, self.steps >= self.task.max_episode_steps, {}

    def _state(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])


def asynchronous(processes: int, sim: str) -> tuple[Contestant, Callable[[], None]]:
    """Gymnasium's environments in a number of processes, and what ends them."""
    if sim == "hopper":
        env = gymnasium.make_vec(
            "Hopper-v5", num_envs=processes, vectorization_mode="async", xml_file=str(SIM.model), frame_skip=SKIP
        )
    else:
        env = gymnasium.vector.AsyncVectorEnv([partial(Plain, sim)] * processes)
    env.reset(seed=0)

    def step() -> int:
        env.step(env.action_space.sample())
        return processes

    return (lambda seconds: timed(step, seconds)), env.close


def bare(space: ParameterSpace, envs: int, cores: int, length: int) -> Contestant:
    """Open-loop rollouts of ``length`` environment steps, nothing else."""
    stepper = MujocoStepper(space, envs, frame_skip=SKIP, num_threads=cores)
    generator = torch.Generator().manual_seed(0)
    values = space.low + (space.high - space.low) * np.random.default_rng(0).random((envs, len(space)))
    states = HopperTask().initial_states(envs, generator)
    stepper.reset(torch.arange(envs), states, torch.from_numpy(values))
    batch: mujoco.batch.Batch = stepper._batch
    begin = batch.state.copy()
    controls = np.random.default_rng(0).uniform(-1, 1, (envs, length, 3)).repeat(SKIP, 1)

    def step() -> int:
        batch.state[:] = begin
        batch.rollout(SKIP * length, controls)
        return envs * length

    return lambda seconds: timed(step, seconds)


def mean_length(space: ParameterSpace, envs: int) -> int:
    """Steps of a random episode, on average."""
    env = RandomizedEnv("hopper", envs, space=space)
    path = env.rollout(100, break_when_any_done=False)
    return max(1, round(path.numel() / int(path["next", "done"].sum())))


def fastest(
    name: str, makers: dict[str, Callable[[], tuple[Contestant, Callable[[], None]]]], seconds: float
) -> tuple[Contestant, Callable[[], None]]:
    """The fastest of several contestants, and what ends it."""
    rates = {}
    for kind, make in makers.items():
        contestant, close = make()
        rates[kind] = contestant(seconds)
        close()
    print(f"{name}, steps/s: " + ", ".join(f"{n} {r:,.0f}" for n, r in rates.items()), flush=True)
    return makers[max(rates, key=lambda n: rates[n])]()


def hoppers(number: int, *, parallel: bool) -> tuple[Contestant, Callable[[], None]]:
    """TorchRL's own Hopper, several times, and what ends it."""
    env = HopperEnv(backend="mujoco", num_workers=number, parallel=parallel, frame_skip=SKIP, seed=0)
    return torchrl(env), env.close


def contestants_of(
    sim: str, envs: int, cores: int, seconds: float
) -> tuple[dict[str, Contestant], list[Callable[[], None]]]:
    """The contestants of a bundled system, and what ends those that have processes."""
    theirs, close = fastest(
        "Gymnasium AsyncVectorEnv",
        {f"{n} processes": partial(asynchronous, int(n), sim) for n in cores * np.array([1, 2, 4])},
        seconds / 2,
    )
    found = bundled_sim(sim)
    space = ParameterSpace(found.model, found.parameters)
    own = torchrl(RandomizedEnv(sim, envs, space=space, num_threads=cores))
    if sim != "hopper":
        return {"RandomizedEnv": own, "Gymnasium AsyncVectorEnv": theirs}, [close]
    length = mean_length(space, envs)
    print(f"a random episode has {length} steps on average")
    torchrls, close_torchrls = fastest(
        "TorchRL HopperEnv",
        {f"{n} processes": partial(hoppers, n, parallel=True) for n in (cores, 2 * cores)}
        | {"16 serial": partial(hoppers, 16, parallel=False)},
        seconds / 2,
    )
    return {
        "RandomizedEnv": own,
        "mujoco.batch rollout": bare(space, envs, cores, length),
        "TorchRL HopperEnv": torchrls,
        "Gymnasium AsyncVectorEnv": theirs,
    }, [close, close_torchrls]


def main() -> None:
    """Print rates and ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sim", choices=("hopper", "push"), default="hopper")
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0)
    given = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: given.cores])
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    contestants, closes = contestants_of(given.sim, given.envs, given.cores, given.seconds)
    rates = {name: [] for name in contestants}
    for _ in range(given.repeats):
        for name, contestant in contestants.items():
            rates[name].append(contestant(given.seconds))
    for close in closes:
        close()
    own = np.array(rates["RandomizedEnv"])
    for name, found in rates.items():
        ratio = own / np.array(found)
        shown = f"{np.median(ratio):.2f} ({ratio.min():.2f} to {ratio.max():.2f})"
        print(f"{name:26s} {np.median(found):10,.0f} steps/s; RandomizedEnv has {shown} times as many")
    if given.sim == "hopper":
        over = np.array(rates["mujoco.batch rollout"]) / own - 1
        print(f"overhead over the bare rollout: {np.median(over):.1%} ({over.min():.1%} to {over.max():.1%})")


if __name__ == "__main__":
    main()
