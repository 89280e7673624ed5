"""A physical effect of one's own, found and fitted: a door whose model lacks its magnetic catch.

    python examples/own_effect.py       # records a log; finds what is missing; fits it: out/door/*/report.html

The class :class:`MagneticCatch` is all that the package has to know of the effect, in search, fit and training alike;
``own_effects`` in the config names it, so that ``dropo gap out/door/door.yaml --out DIR`` does the same.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import yaml

from dropo_torch.commands.cli import main as command
from dropo_torch.effects import Quantity, Setting
from dropo_torch.effects.joint import JointEffect

DOOR = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="door">
      <joint name="hinge" axis="0 0 1" damping="0.2"/>
      <geom name="door" type="box" size=".4 .02 1" pos=".4 0 0" mass="8"/>
    </body>
  </worldbody>
  <actuator><position name="closer" joint="hinge" kp="40" kv="6"/></actuator>
</mujoco>"""
FRAME_SKIP = 5
#: What the log is recorded with: the catch's largest torque in N m, and how far it reaches in rad.
TRUTH = {"torque": 3.0, "reach": 0.06}


class MagneticCatch(JointEffect):
    """A magnet that pulls a joint towards position zero, and lets go a little away from it."""

    name = "magnetic_catch"
    sentence = "a magnet catches {target} where its position is zero"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        """Return its numbers; ``scale`` is a size that matters, ``neutral`` where the effect is absent."""
        force = float(setting.signals.force[setting.dof(str(target))])
        return (
            Quantity("torque", "N·m", neutral=0.0, low=0.0, high=20 * force, scale=force),
            Quantity("reach", "rad", neutral=0.1, low=0.001, high=1.0, scale=0.1),
        )

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return generalized forces, one row a state; each may have numbers of its own, or all share one row."""
        out = np.zeros_like(velocity)
        torque, reach = values.T
        away = position[:, setting.coordinate(str(target))] / reach
        out[:, setting.dof(str(target))] = -torque * away * np.exp(0.5 - 0.5 * away**2)  # largest one reach away
        return out


def record(path: Path, samples: int) -> None:
    """Write a log of the true door, whose catch is written out here by hand."""
    model = mujoco.MjModel.from_xml_string(DOOR)
    data = mujoco.MjData(model)
    data.qpos[0] = 0.3
    states, command = [], 0.25 * np.cos(0.03 * np.arange(samples)) + 0.08 * np.sin(0.19 * np.arange(samples))
    for u in command:
        states.append([data.qpos[0], data.qvel[0]])
        data.ctrl[0] = u
        for _ in range(FRAME_SKIP):
            away = data.qpos[0] / TRUTH["reach"]
            data.qfrc_applied[0] = -TRUTH["torque"] * away * np.exp(0.5 - 0.5 * away**2)
            mujoco.mj_step(model, data)
    ends = np.arange(samples - 1) == samples - 2
    np.savez(path, observations=states[:-1], next_observations=states[1:], actions=command[:-1], terminals=ends)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/door"))
    parser.add_argument("--samples", type=int, default=400, help="rows of the log")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "door.xml").write_text(DOOR)
    record(given.out / "log.npz", given.samples)
    document = {
        "model": "door.xml",
        "data": "log.npz",
        "frame_skip": FRAME_SKIP,
        "own_effects": [f"{Path(__file__).resolve()}:MagneticCatch"],
        "parameters": {"damping": {"field": "dof_damping", "name": "hinge", "bounds": [0.05, 1.0]}},
    }
    config = given.out / "door.yaml"
    config.write_text(yaml.safe_dump(document, sort_keys=False))
    command(["gap", str(config), "--out", str(given.out / "gap")])
    command(["fit", str(given.out / "gap" / "config.yaml"), "--epsilon", "1e-8", "--out", str(given.out / "fit")])
    print("recorded with:", ", ".join(f"{name} {value:g}" for name, value in TRUTH.items()))


if __name__ == "__main__":
    main()
