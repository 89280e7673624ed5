"""A simulator of one's own, fitted: a driven pendulum in plain numpy.

    python examples/own_simulator/pendulum.py       # checks it, records a log, fits it, ends with a report

The config pendulum.yaml names this file's :func:`make`. Replace the class by a wrapper of your simulator.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
import yaml

import dropo_torch as dropo
from dropo_torch.commands import cli
from dropo_torch.testing import Report, check_simulator

TIMESTEP = 0.02
LENGTH = 0.5
GRAVITY = 9.81
#: What the log is recorded with: mass in kg, viscous friction in N m s/rad, Coulomb friction in N m.
TRUTH = {"mass": 0.8, "viscous": 0.06, "coulomb": 0.03}


class Pendulum:
    """A point mass on a rod with a motor; a state is angle and angular velocity, a control is a torque."""

    num_states = 2
    num_controls = 1
    timestep = TIMESTEP

    def __init__(self) -> None:
        self.parameters = dict(TRUTH)
        self.state = np.zeros(2)

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Take the values of the config's parameters, by their names there."""
        self.parameters = dict(values)

    def set_state(self, state: np.ndarray) -> None:
        """Start from a logged state; nothing of an earlier simulation may be left."""
        self.state = np.array(state, dtype=np.float64)

    def step(self, control: np.ndarray) -> np.ndarray:
        """Hold a torque for one logged transition and return the state after it."""
        substeps = 4
        h = TIMESTEP / substeps
        for _ in range(substeps):  # semi-implicit Euler
            angle, velocity = self.state
            velocity = velocity + h * self._acceleration(angle, velocity, float(control[0]))
            self.state = np.array([angle + h * velocity, velocity])
        return self.state.copy()

    def _acceleration(self, angle: float, velocity: float, torque: float) -> float:
        p = self.parameters
        friction = p["viscous"] * velocity + p["coulomb"] * math.tanh(velocity / 0.05)
        gravity = p["mass"] * GRAVITY * LENGTH * math.sin(angle)
        return (torque - friction - gravity) / (p["mass"] * LENGTH**2)


def make(parameters: dropo.ParameterSpace) -> Pendulum:
    """Return the adapter; called once, with the config's parameters."""
    return Pendulum()


def check(config: Path) -> Report:
    """Try the laws that a fit relies on, on states as varied as a log's."""
    space = dropo.ParameterSpace(None, yaml.safe_load(config.read_text())["parameters"])
    simulator = dropo.make_simulator("gymnasium", make, parameters=space)
    rng = np.random.default_rng(0)
    states, torques = rng.uniform(-2, 2, (8, 2)), rng.uniform(-3, 3, (8, 3, 1))
    return check_simulator(simulator, torch.from_numpy(states), torch.from_numpy(torques))


def record(path: Path, samples: int = 200) -> None:
    """Write a log as a robot's logger would: one row a sample, the command that is in force from it on."""
    pendulum = Pendulum()
    time = TIMESTEP * np.arange(samples)
    torque = 2.0 * np.sin(2 * np.pi * 0.7 * time) + 1.0 * np.sin(2 * np.pi * 2.3 * time)
    states = [pendulum.state]
    for u in torque[:-1]:
        states.append(pendulum.step(np.array([u])))
    table = np.column_stack([time, states, torque])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, table, delimiter=",", header="time,angle,velocity,torque", comments="", fmt="%.9g")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/pendulum"))
    parser.add_argument("--samples", type=int, default=200, help="rows of the log")
    given = parser.parse_args(arguments)
    config = Path(__file__).with_name("pendulum.yaml")
    print(check(config))
    log = given.out / "log.csv"
    record(log, given.samples)
    if cli.main(["fit", str(config), "--out", str(given.out / "fit"), "--data.path", str(log.resolve())]):
        raise SystemExit(2)
    print("recorded with:", ", ".join(f"{name} {value:g}" for name, value in TRUTH.items()))


if __name__ == "__main__":
    main()
