"""Fit the measured EMPS drive and predict the quarter of the log that the fit has not seen.

    python examples/emps/emps.py path/to/DATA_EMPS.mat

The log is that of Janot, Gautier and Brunot, "Data Set and Reference Models of EMPS" (Nonlinear System
Identification Benchmarks, 2019), whose reference model is found by inverse dynamics and least squares.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dropo_torch as dropo

CONFIG = Path(__file__).parent / "emps.yaml"
#: The published reference model; its offset is a force against the motor's, hence the sign.
REFERENCE = {"mass": 95.1, "viscous_friction": 203.5, "coulomb_friction": 20.4, "force_offset": 3.2}
HELD_OUT_FROM = 18.63
HORIZON = 3.0


def fit_emps(data: Path, overrides: dict[str, Any] | None = None) -> tuple[dropo.Fit, dropo.Problem]:
    """Fit the first three quarters of the log."""
    config = dropo.load_config(CONFIG, {"data.path": str(data.resolve()), **(overrides or {})})
    problem = dropo.make_problem(config)
    return dropo.fit(problem.objective, config.fit_settings()), problem


def open_loop_error(problem: dropo.Problem, values: np.ndarray) -> np.ndarray:
    """Root mean square position error (m) of open-loop predictions over the held-out quarter, ``(K,)``.

    Args:
        problem: the fitted problem.
        values: parameter vectors, ``(K, d)``.
    """
    data = dict(problem.config.data)
    data["preprocess"] = {**data["preprocess"], "start": HELD_OUT_FROM, "stop": None}
    held_out = dropo.read_trajectories(data, base=problem.config.base)
    lag = round(HORIZON / held_out.dt)
    windows = dropo.make_transitions(held_out, problem.observation, lag=lag)
    predicted = problem.simulator.rollout(
        torch.from_numpy(windows.states), torch.from_numpy(windows.controls), torch.from_numpy(values)
    )[..., 0].numpy()
    measured = np.stack([held_out.next_observations[row : row + lag, 0] for row in windows.rows])
    return np.sqrt(np.mean((predicted - measured[:, None]) ** 2, axis=(0, 2)))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="DATA_EMPS.mat")
    parser.add_argument("--backend", choices=["mujoco", "warp"], default="mujoco")
    given = parser.parse_args(arguments)
    fit, problem = fit_emps(given.data, {"backend": given.backend})
    print(f"{'':<18}{'found':>10}{'published':>11}{'difference':>12}")
    for name, entry in fit.distribution.summary().items():
        published = REFERENCE[name]
        difference = 100 * (entry["mean"] / published - 1)
        print(f"{name:<18}{entry['mean']:>10.2f}{published:>11.1f}{difference:>+11.2f} %  {entry['unit']}")
    values = np.stack([fit.distribution.center, problem.space.vector(REFERENCE)])
    ours, theirs = 1e3 * open_loop_error(problem, values)
    print(f"open-loop error over {HORIZON:g} s windows of the unseen quarter: {ours:.2f} mm, published {theirs:.2f} mm")


if __name__ == "__main__":
    main()
