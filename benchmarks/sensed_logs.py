"""Fits of logs that show sensors and not the state: masses of a Hopper, and the friction of a pendulum.

    python benchmarks/sensed_logs.py [--seeds 3] [--systems hopper pendulum]

Each log is simulated by plain ``mj_step`` with other numbers than the model's, and has noise on every column:

``hopper``     an IMU in the torso (orientation, gyroscope, accelerometer), encoders of the joints, the contact force;
``pendulum``   the position of a marker, as a camera sees it at 50 Hz; damping and dry friction are searched.

Printed are the true and the fitted values, their difference in percent and in standard errors, and the seconds taken.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))

import dropo_torch as dropo

HOPPER = Path(__file__).parents[1] / "sims" / "hopper" / "hopper.xml"
PENDULUM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.01" frictionloss="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5"/>
      <site name="marker" pos=".03 .02 -.4"/>
    </body>
  </worldbody>
  <sensor><framepos name="marker" objtype="site" objname="marker"/></sensor>
</mujoco>"""
#: Standard deviations of the noise: rad/s, m/s², rad, N, m.
NOISE = {"orientation": 0.005, "gyro": 0.01, "accelerometer": 0.1, "encoder": 0.001, "touch": 2.0, "marker": 0.001}


@dataclass(frozen=True)
class System:
    """A model as given, what is searched, and how a log of the true one is made."""

    xml: Callable[[], str]
    frame_skip: int
    observation: tuple[str, ...]
    noise: tuple[float, ...]
    parameters: dict[str, dict[str, Any]]
    set_truth: Callable[[mujoco.MjModel, dict[str, float]], None]
    truth: Callable[[np.random.Generator], dict[str, float]]
    episodes: int
    steps: int

    def start(self, data: mujoco.MjData, rng: np.random.Generator) -> None:
        """Begin an episode somewhere."""
        data.qpos[:] += rng.uniform(-0.005, 0.005, data.qpos.shape)
        if not len(data.ctrl):
            data.qpos[:] = rng.uniform(1.0, 2.8) * rng.choice([-1, 1])


def hopper_xml() -> str:
    """The Hopper with an IMU in its torso, encoders and a touch sensor around its foot."""
    spec = mujoco.MjSpec.from_file(str(HOPPER))
    torso, foot = spec.body("torso"), spec.body("foot")
    torso.add_site(name="imu", pos=[0.05, 0, 0.1])
    foot.add_site(
        name="sole", type=mujoco.mjtGeom.mjGEOM_BOX, pos=[-0.065, 0, 0.1], size=[0.3, 0.1, 0.1],
    )  # fmt: skip
    site, joint = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_JOINT
    kinds = mujoco.mjtSensor
    spec.add_sensor(name="orientation", type=kinds.mjSENS_FRAMEQUAT, objtype=site, objname="imu")
    spec.add_sensor(name="gyro", type=kinds.mjSENS_GYRO, objtype=site, objname="imu")
    spec.add_sensor(name="accelerometer", type=kinds.mjSENS_ACCELEROMETER, objtype=site, objname="imu")
    for name in ("thigh", "leg", "foot"):
        spec.add_sensor(name=f"{name}_encoder", type=kinds.mjSENS_JOINTPOS, objtype=joint, objname=f"{name}_joint")
    spec.add_sensor(name="touch", type=kinds.mjSENS_TOUCH, objtype=site, objname="sole")
    spec.compile()
    return spec.to_xml()


def _masses(model: mujoco.MjModel, truth: dict[str, float]) -> None:
    for name, mass in truth.items():
        model.body(name.removesuffix("_mass")).mass = mass


def _friction(model: mujoco.MjModel, truth: dict[str, float]) -> None:
    model.dof_damping[0], model.dof_frictionloss[0] = truth["damping"], truth["friction"]


LINKS = {"torso": 3.665, "thigh": 4.058, "leg": 2.781, "foot": 5.316}
SYSTEMS = {
    "hopper": System(
        hopper_xml, 4, ("sensor",),
        (*[NOISE["orientation"]] * 4, *[NOISE["gyro"]] * 3, *[NOISE["accelerometer"]] * 3, *[NOISE["encoder"]] * 3,
         NOISE["touch"]),
        {f"{name}_mass": {"field": "body_mass", "name": name, "bounds": [0.5 * m, 1.7 * m], "unit": "kg"}
         for name, m in LINKS.items()},
        _masses, lambda rng: {f"{name}_mass": m * rng.uniform(0.75, 1.3) for name, m in LINKS.items()}, 6, 70,
    ),
    "pendulum": System(
        lambda: PENDULUM, 4, ("sensor[marker]",), (NOISE["marker"],) * 3,
        {"damping": {"field": "dof_damping", "name": "hinge", "bounds": [0.001, 0.1], "scale": "log"},
         "friction": {"field": "dof_frictionloss", "name": "hinge", "bounds": [0.0, 0.1]}},
        _friction,
        lambda rng: {"damping": 0.02 * rng.uniform(0.5, 2), "friction": 0.03 * rng.uniform(0.5, 1.5)}, 2, 250,
    ),
}  # fmt: skip


def record(system: System, truth: dict[str, float], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Simulate a log of sensors by plain MuJoCo; commands are low-pass filtered noise."""
    model = mujoco.MjModel.from_xml_string(system.xml())
    system.set_truth(model, truth)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    before, after, actions = [], [], []
    for _ in range(system.episodes):
        data, command, shown = mujoco.MjData(model), np.zeros(model.nu), []
        system.start(data, rng)
        for step in range(system.steps + 1):
            if step:
                command = np.clip(0.9 * command + 0.1 * rng.standard_normal(model.nu), -1, 1)
                actions.append(command)
                data.ctrl[:] = command
                mujoco.mj_step(model, data, system.frame_skip)
            mujoco.mj_forward(model, data)
            shown.append(data.sensordata + system.noise * rng.standard_normal(model.nsensordata))
        before += shown[:-1]
        after += shown[1:]
    ends = np.arange(len(before)) % system.steps == system.steps - 1
    arrays = {"observations": before, "next_observations": after, "actions": actions, "terminals": ends}
    return {name: np.array(values, dtype=float) for name, values in arrays.items()}


def write(system: System, folder: Path, seed: int) -> tuple[Path, dict[str, float]]:
    """Write model, log and config of a system; return the config's path and the truth."""
    rng = np.random.default_rng(seed)
    truth = system.truth(rng)
    (folder / "model.xml").write_text(system.xml())
    np.savez(folder / "log.npz", **record(system, truth, rng))
    config = folder / "config.yaml"
    config.write_text(yaml.safe_dump({
        "model": "model.xml", "data": "log.npz", "frame_skip": system.frame_skip, "threads": 1,
        "observation": list(system.observation), "parameters": system.parameters,
    }, sort_keys=False))  # fmt: skip
    return config, truth


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=list(SYSTEMS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    for name in given.systems:
        for seed in range(given.first, given.first + given.seeds):
            with tempfile.TemporaryDirectory() as folder:
                config, truth = write(SYSTEMS[name], Path(folder), seed)
                began = time.process_time()
                fit = dropo.fit_problem(dropo.make_problem(dropo.load_config(config)))
                assert fit.estimated is not None
                seconds = time.process_time() - began
            for i, (key, value) in enumerate(truth.items()):
                found, error = fit.distribution.center[i], fit.estimated.standard_error[i]
                error *= found if fit.distribution.is_log[i] else 1.0
                print(
                    f"{name:9} seed {seed}  {key:13} true {value:8.5f}  found {found:8.5f}  "
                    f"{100 * (found / value - 1):+6.2f} %  {(found - value) / error:+5.2f} standard errors  "
                    f"{seconds:.0f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
