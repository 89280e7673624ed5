"""What an evaluation of the objective costs beside the bare simulation that it contains.

python benchmarks/objective_cost.py            # cost, T = 998, K = 100, in turn on the same cores
python benchmarks/objective_cost.py --memory   # peak memory at T K = 10 million (half an hour)
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Sequence

import mujoco.batch
import numpy as np
import torch
from dropo_sims.hopper import SIM
from dropo_sims.hopper.record import record

import dropo_torch as dropo
from dropo_torch.support.random import draw_uniforms


def make_objective(transitions: int) -> dropo.Objective:
    """A Hopper log of as many transitions as asked for (repeated where the recorded ones do not suffice)."""
    log = record(episodes=2, steps=500)
    rows = np.arange(transitions) % len(log.actions)
    trajectories = dropo.Trajectories(
        log.observations[rows], log.next_observations[rows], log.actions[rows], np.ones(transitions, dtype=bool)
    )
    space = dropo.ParameterSpace(SIM.model, SIM.parameters)
    simulator = dropo.make_simulator("mujoco", SIM.model, parameters=space, frame_skip=SIM.frame_skip)
    observation = dropo.parse_observation(simulator.model, SIM.observation)
    return dropo.Objective(simulator, dropo.make_transitions(trajectories, observation), observation)


def evaluate(objective: dropo.Objective, samples: int) -> None:
    space = objective.simulator.parameters
    mean, std = space.nominal[None], np.full((1, len(space)), 0.1)
    objective.evaluate(mean, std, draw_uniforms(samples, len(space), 0))


def bare_rollout(objective: dropo.Objective, samples: int, rows: int = 100) -> Callable[[], None]:
    """The same simulations on ``mujoco.batch`` and nothing else: state in, four steps."""
    model, windows = objective.simulator.model, objective.transitions
    space = objective.simulator.parameters
    uniforms = draw_uniforms(samples, len(space), 0)
    values = dropo.Distribution.over(space, space.nominal, np.full(len(space), 0.1)).rsample(uniforms)
    batch = mujoco.batch.Batch(model, rows * samples)
    space.write({f: batch.expand(f) for f in space.fields}, np.tile(values.numpy(), (rows, 1)))
    batch.set_const()

    def run() -> None:
        for start in range(0, len(windows), rows):
            part = windows.select(slice(start, start + rows))
            count = len(part) * samples
            batch.state[:] = 0
            batch.bind("qpos")[:count] = np.repeat(part.states[:, : model.nq], samples, axis=0)
            batch.bind("qvel")[:count] = np.repeat(part.states[:, model.nq :], samples, axis=0)
            batch.bind("ctrl")[:count] = np.repeat(part.controls[:, 0], samples, axis=0)
            batch.step(np.arange(count, dtype=np.int32), nstep=SIM.frame_skip)

    return run


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--transitions", type=int)
    parser.add_argument("--samples", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args(arguments)
    transitions = given.transitions or (100_000 if given.memory else 998)
    objective = make_objective(transitions)
    if given.memory:
        evaluate(objective, given.samples)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(f"T = {transitions}, K = {given.samples}: peak memory {peak:.2f} GB")
        return
    bare = bare_rollout(objective, given.samples)
    bare()
    ratios = []
    for _ in range(given.repeats):
        t0 = time.perf_counter()
        bare()
        t1 = time.perf_counter()
        evaluate(objective, given.samples)
        t2 = time.perf_counter()
        ratios.append((t2 - t1) / (t1 - t0))
        print(f"bare rollout {t1 - t0:.2f} s, objective {t2 - t1:.2f} s, ratio {ratios[-1]:.3f}")
    cores = torch.get_num_threads()
    print(f"T = {transitions}, K = {given.samples}, {cores} cores: median ratio {np.median(ratios):.3f}")


if __name__ == "__main__":
    main()
