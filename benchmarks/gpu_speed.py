"""The Warp backend on a GPU beside one core of the processor, in one run: the same numbers, and how fast.

    python benchmarks/gpu_speed.py [--device cuda:0] [--worlds 1000 10000 100000] [--envs 1024 16384 65536]

Hoppers in contact, four physics steps each, by their four masses: next states beside those of the processor and of C
MuJoCo, gradients beside those of the processor, and seconds of both; then random steps of that many environments. The
first run compiles the kernels, which takes long on a GPU.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from dropo_sims.hopper import SIM

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.warp_speed import SKIP, worlds
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl import RandomizedEnv
from dropo_torch.simulators import MujocoSimulator
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.testing import converged

#: Worlds that are compared in all numbers.
COMPARED = 256


def simulator(space: ParameterSpace, device: str, count: int) -> WarpSimulator:
    """One that holds all worlds at once, on a GPU or one core."""
    return WarpSimulator(space.model, parameters=space, frame_skip=SKIP, device=device, chunk_size=count, num_threads=1)


def gradient(own: WarpSimulator, *given: torch.Tensor) -> list[torch.Tensor]:
    """Derivatives of the sum of squares by states, controls and masses."""
    leaves = [x.clone().requires_grad_() for x in given]
    own.simulate(*leaves).square().sum().backward()
    return [x.grad for x in leaves if x.grad is not None]


def best(work: Callable[[], object], device: str, repeats: int) -> float:
    """Shortest of several runs in seconds, the first not counted."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        work()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def compare(space: ParameterSpace, device: str, values: torch.Tensor) -> None:
    """Print how far the device is from the processor and from C MuJoCo."""
    states, controls = map(torch.tensor, worlds(space.model, COMPARED))
    own, cpu = (simulator(space, d, COMPARED) for d in (device, "cpu"))
    exact = MujocoSimulator(space.model, parameters=converged(space), frame_skip=SKIP, num_threads=1)
    found = own.simulate(states, controls, values)
    for name, other in (("the processor's", cpu), ("C MuJoCo's", exact)):
        off = (found - other.simulate(states, controls, values)).abs().max()
        print(f"states are {name} within {off:.1e}", flush=True)
    pairs = zip(gradient(own, states, controls, values), gradient(cpu, states, controls, values), strict=True)
    off = max(float((a - b).norm() / b.norm()) for a, b in pairs)
    print(f"gradients are the processor's within {off:.1e} of their size", flush=True)


def measure(space: ParameterSpace, device: str, values: torch.Tensor, count: int, repeats: int) -> None:
    """Print the time of many worlds on the device and on one core, forward and with the gradient."""
    given = (*map(torch.tensor, worlds(space.model, count)), values)
    for what, work in (("forward", lambda s: s.simulate(*given)), ("with the gradient", lambda s: gradient(s, *given))):
        own, core = (
            best(partial(work, simulator(space, d, count)), d, repeats) for d in (device, "cpu")
        )  # fmt: skip
        print(
            f"{count} worlds {what}: {1e3 * own:.1f} ms on {device}, {1e3 * core:.0f} ms on one core "
            f"({core / own:.1f} times as long)", flush=True,
        )  # fmt: skip


def rate(space: ParameterSpace, device: str, count: int, seconds: float) -> float:
    """Random steps a second of so many environments."""
    env = RandomizedEnv("hopper", space=space, num_envs=count, backend="warp", device=device, num_threads=1)
    state, steps, start = env.reset(), -2, 0.0
    while steps <= 0 or time.perf_counter() - start < seconds:
        if steps == 0:
            start = time.perf_counter()
        _, state = env.step_and_maybe_reset(env.rand_action(state))
        steps += 1
    return steps * count / (time.perf_counter() - start)


def main() -> None:
    """Print what is the same, and how fast."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--envs", type=int, nargs="*", default=[1024, 16_384, 65_536])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    space = ParameterSpace(SIM.model, SIM.parameters)
    values = torch.tensor(space.nominal[None])
    compare(space, given.device, values)
    for count in given.worlds:
        measure(space, given.device, values, count, given.repeats)
    for count in given.envs:
        print(f"{count} environments on {given.device}: {rate(space, given.device, count, given.seconds):,.0f} steps/s")
    print(f"1024 on one core: {rate(space, 'cpu', 1024, given.seconds):,.0f} steps/s")


if __name__ == "__main__":
    main()
