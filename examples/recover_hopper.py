"""Recover what a simulated Hopper was recorded with: the paper's simulated experiments.

    python examples/recover_hopper.py point          # fixed masses, no noise
    python examples/recover_hopper.py noisy          # noise of variance 1e-5 on every measurement
    python examples/recover_hopper.py distribution   # masses redrawn every 25 steps

Each is repeated over seeds of the log. ``--optimizer cma --budget 600`` runs CMA-ES on the same logs.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from dropo_sims.hopper import SIM
from dropo_sims.hopper.record import NOISE_VARIANCE, SPREAD, record

import dropo_torch as dropo

#: Standard deviation of a normal with σ = 1 that is truncated at ±2.
TRUNCATED = 0.8796
EPSILON = {"point": 1e-5, "noisy": 1e-8, "distribution": 1e-7}


def recover(
    experiment: str, seed: int, *, optimizer: str, backend: str, budget: int, samples: int, steps: int
) -> dict[str, Any]:
    """Record a log of the experiment, fit it, and compare with what it was recorded with."""
    log = record(variant=experiment, seed=seed, steps=steps)
    space = dropo.ParameterSpace(SIM.model, SIM.parameters)
    simulator = dropo.make_simulator(backend, SIM.model, parameters=space, frame_skip=SIM.frame_skip)
    observation = dropo.parse_observation(space.model, SIM.observation)
    trajectories = dropo.Trajectories(log.observations, log.next_observations, log.actions, log.terminals)
    objective = dropo.Objective(
        simulator,
        dropo.make_transitions(trajectories, observation),
        observation,
        epsilon=EPSILON[experiment],
        noise=NOISE_VARIANCE**0.5 if experiment == "noisy" else None,
    )
    begun = time.monotonic()
    fit = dropo.fit(objective, dropo.FitSettings(optimizer=optimizer, samples=samples, budget=budget, seed=seed))
    seconds = time.monotonic() - begun
    realized = log.masses[::25] if experiment == "distribution" else log.masses
    return {
        "experiment": experiment,
        "optimizer": optimizer,
        "backend": backend,
        "seed": seed,
        "transitions": len(objective),
        "names": list(space.names),
        "mean": fit.distribution.mean.tolist(),
        "std": fit.distribution.std.tolist(),
        "true_mean": realized.mean(0).tolist(),
        "true_std": realized.std(0).tolist(),
        "log_likelihood": fit.log_likelihood,
        "simulated_per_logged": fit.simulated_transitions / len(objective),
        "to_percent": reached(fit, realized.mean(0), 1e-2),
        "to_permille": reached(fit, realized.mean(0), 1e-3),
        "seconds": seconds,
        "stop_reason": fit.stop_reason,
    }


def reached(fit: dropo.Fit, truth: np.ndarray, limit: float) -> int | None:
    """Simulated transitions from which every mean stays within a relative error ``limit``."""
    error = [np.max(np.abs(entry.mean / truth - 1)) for entry in fit.history]
    outside = np.flatnonzero(np.array(error) > limit)
    first = outside[-1] + 1 if outside.size else 0
    return fit.history[first].simulated_transitions if first < len(error) else None


def show(result: dict[str, Any]) -> None:
    error = 100 * (np.array(result["mean"]) / np.array(result["true_mean"]) - 1)
    print(
        f"{result['experiment']:<13}{result['optimizer']} on {result['backend']}, seed {result['seed']}: "
        f"{result['simulated_per_logged']:.0f} simulated per logged transition, {result['seconds']:.1f} s, "
        f"log-likelihood {result['log_likelihood']:.1f}, {result['stop_reason']}"
    )
    for limit, key in (("1 %", "to_percent"), ("0.1 %", "to_permille")):
        if result[key] is not None:
            cost = result[key] / result["transitions"]
            print(f"    every mean within {limit} from {cost:.1f} simulated per logged transition on")
    for i, name in enumerate(result["names"]):
        spread = ""
        if name in SPREAD and result["true_std"][i] > 1e-9:
            std = TRUNCATED * result["std"][i]
            spread = f", standard deviation {std:.3f}, realized {result['true_std'][i]:.3f}"
        print(f"    {name:<12} mean {result['mean'][i]:.4f} ({error[i]:+.3f} %)  std {result['std'][i]:.2g}{spread}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiment", choices=sorted(EPSILON))
    parser.add_argument("--seeds", type=int, default=3, help="logs to record and fit")
    parser.add_argument("--steps", type=int, default=500, help="transitions of each of the two episodes")
    parser.add_argument("--optimizer", choices=["fisher", "cma", "adam"], default="fisher")
    parser.add_argument("--backend", choices=["mujoco", "warp"], default="mujoco")
    parser.add_argument("--budget", type=int, default=1000, help="evaluations of CMA-ES")
    parser.add_argument("--samples", type=int, default=100, help="K")
    parser.add_argument("--json", type=Path, help="file to which the results are appended, a line each")
    given = parser.parse_args(arguments)
    for seed in range(given.seeds):
        result = recover(
            given.experiment,
            seed,
            optimizer=given.optimizer,
            backend=given.backend,
            budget=given.budget,
            samples=given.samples,
            steps=given.steps,
        )
        show(result)
        if given.json is not None:
            with given.json.open("a") as stream:
                stream.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
