"""Speed of the Warp backend beside mujoco.batch on one core, in one run.

Hopper, worlds × 4 RK4 substeps, in flight and in contact: forward; forward and backward to states, controls and all
inertial, damping and gear parameters; and what the same gradient costs by differences of mujoco.batch.

    python benchmarks/warp_speed.py [--worlds 10000] [--repeats 5]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import mujoco
import mujoco.batch
import numpy as np
import torch

from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator

SKIP = 4


def parameters(model: mujoco.MjModel, size: int) -> ParameterSpace:
    """The first ``size`` of the Hopper's masses, dampings, armatures, gears and frictions."""
    fields: dict[str, dict] = {}
    for body in ("torso", "thigh", "leg", "foot"):
        fields[f"mass {body}"] = {"field": "body_mass", "name": body, "bounds": [0.5, 20]}
    for field in ("dof_damping", "dof_armature"):
        for joint in ("thigh_joint", "leg_joint", "foot_joint"):
            fields[f"{field} {joint}"] = {"field": field, "name": joint, "bounds": [0.1, 5]}
    for joint in ("thigh_joint", "leg_joint", "foot_joint"):
        fields[f"gear {joint}"] = {"field": "actuator_gear", "name": joint, "bounds": [50, 400]}
    for geom in ("torso_geom", "thigh_geom", "leg_geom", "foot_geom"):
        fields[f"friction {geom}"] = {"field": "geom_friction", "name": geom, "bounds": [0.1, 4]}
    fields["gravity"] = {"field": "opt.gravity", "index": 2, "bounds": [-20, -1]}
    return ParameterSpace(model, dict(list(fields.items())[:size]))


def worlds(model: mujoco.MjModel, count: int, contact: bool) -> tuple[np.ndarray, np.ndarray]:
    """States of random controls, near the ground or a metre above it, and controls."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    states = np.zeros((count, model.nq + model.nv))
    i = 0
    while i < count:
        mujoco.mj_resetData(model, data)
        data.qpos[:] += rng.uniform(-0.05, 0.05, model.nq)
        data.qpos[1] += 0.0 if contact else 1.5
        data.qvel[:] = rng.uniform(-0.5, 0.5, model.nv)
        for _ in range(10 if contact else 2):
            data.ctrl[:] = rng.uniform(-1, 1, model.nu)
            for _ in range(SKIP):
                mujoco.mj_step(model, data)
        for _ in range(20 if contact else 5):
            data.ctrl[:] = rng.uniform(-1, 1, model.nu)
            for _ in range(SKIP):
                mujoco.mj_step(model, data)
            if i < count:
                states[i] = np.r_[data.qpos, data.qvel]
                i += 1
    return states, rng.uniform(-1, 1, (count, 1, model.nu))


def best(work: Callable[[], object], repeats: int) -> float:
    """Shortest of several runs, in seconds of one core (others may be using the rest)."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def run(count: int, repeats: int, contact: bool) -> None:
    """Measure one kind of state and print the ratios."""
    assets = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
    model = mujoco.MjModel.from_xml_path(str(assets / "hopper.xml"))
    states, controls = worlds(model, count, contact)

    batch = mujoco.batch.Batch(model, nsim=count, nthread=1)
    views = {name: batch.bind(name) for name in ("qpos", "qvel", "ctrl", "qacc_warmstart")}

    def reference() -> np.ndarray:
        views["qpos"][:], views["qvel"][:] = states[:, : model.nq], states[:, model.nq :]
        views["ctrl"][:], views["qacc_warmstart"][:] = controls[:, 0], 0.0
        batch.step(nstep=SKIP)
        return np.concatenate([views["qpos"], views["qvel"]], axis=1)

    start, inputs = torch.tensor(states), torch.tensor(controls)
    base = best(reference, repeats)
    print(f"{'contact' if contact else 'flight'}: mujoco.batch forward {base:.3f} s")
    for size in (4, 18):
        space = parameters(model, size)
        simulator = WarpSimulator(model, parameters=space, frame_skip=SKIP, num_threads=1)
        values = torch.tensor(space.nominal[None])
        error = np.abs(simulator.simulate(start, inputs, values)[:, 0].numpy() - reference()).max()
        forward = best(lambda s=simulator, v=values: s.simulate(start, inputs, v), repeats)

        def gradient(s: WarpSimulator = simulator, v: torch.Tensor = values) -> None:
            leaves = [x.clone().requires_grad_() for x in (start, inputs, v)]
            s.simulate(*leaves).square().sum().backward()

        both = best(gradient, repeats)
        print(
            f"  d = {size}: max difference {error:.1e}; Warp forward {forward:.3f} s ({base / forward:.2f} × faster);"
            f" forward + backward {both:.3f} s ({both / forward:.2f} × its forward);"
            f" one-sided differences would take {(size + 1) * base:.2f} s ({(size + 1) * base / both:.1f} ×)"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for contact in (False, True):
        run(arguments.worlds, arguments.repeats, contact)


if __name__ == "__main__":
    main()
