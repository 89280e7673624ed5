"""Speed of the Warp backend beside mujoco.batch on one core, in one run.

Worlds × 4 substeps, forward; forward and backward to states, controls and parameters; and what the same gradient costs
by differences of mujoco.batch: of the Hopper in flight and in contact, with its inertial, damping and gear parameters,
and of the systems in ``warp_models.py``, with their masses, gears and frictions.

    python benchmarks/warp_speed.py [--worlds 10000] [--repeats 5] [--models hopper ant humanoid arm hand]
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import mujoco
import mujoco.batch
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.warp_models import MODELS
from dropo_torch.parameters import ParameterSpace, object_names
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


def common(model: mujoco.MjModel, size: int) -> ParameterSpace:
    """The first ``size`` of a system's masses, gears and frictions, taken in turn."""
    kinds = {"body_mass": ("body", range(1, model.nbody)), "actuator_gear": ("actuator", range(model.nu)),
             "geom_friction": ("geom", range(model.ngeom))}  # fmt: skip
    found = [
        [(field, object_names(model, kind)[i]) for i in numbers if field != "body_mass" or model.body_mass[i] > 0]
        for field, (kind, numbers) in kinds.items()
    ]
    turns = [entry for turn in itertools.zip_longest(*found) for entry in turn if entry]
    fields = {f"{field} {name}": {"field": field, "name": name, "bounds": [1e-3, 1e3]} for field, name in turns[:size]}
    return ParameterSpace(model, fields)


def worlds(model: mujoco.MjModel, count: int, lift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """States of random controls, the second coordinate lifted at the start, and controls."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    states = np.zeros((count, model.nq + model.nv))
    i = 0
    while i < count:
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.uniform(-0.05, 0.05, model.nv), 1.0)
        data.qpos[1] += lift
        data.qvel[:] = rng.uniform(-0.5, 0.5, model.nv)
        for _ in range(2 if lift else 10):
            data.ctrl[:] = rng.uniform(-1, 1, model.nu)
            for _ in range(SKIP):
                mujoco.mj_step(model, data)
        for _ in range(5 if lift else 20):
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


def run(name: str, count: int, repeats: int, lift: float = 0.0) -> None:
    """Measure a system and print the ratios."""
    if name == "hopper":
        assets = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
        model, choose = mujoco.MjModel.from_xml_path(str(assets / "hopper.xml")), parameters
    else:
        model, choose = mujoco.MjModel.from_xml_string(MODELS[name]()), common
    states, controls = worlds(model, count, lift)

    batch = mujoco.batch.Batch(model, nsim=count, nthread=1)
    views = {name: batch.bind(name) for name in ("qpos", "qvel", "ctrl", "qacc_warmstart")}

    def reference() -> np.ndarray:
        views["qpos"][:], views["qvel"][:] = states[:, : model.nq], states[:, model.nq :]
        views["ctrl"][:], views["qacc_warmstart"][:] = controls[:, 0], 0.0
        batch.step(nstep=SKIP)
        return np.concatenate([views["qpos"], views["qvel"]], axis=1)

    start, inputs = torch.tensor(states), torch.tensor(controls)
    base = best(reference, repeats)
    print(f"{name}{' in flight' if lift else ''}: mujoco.batch forward {base:.3f} s", flush=True)
    for size in (4, 18):
        space = choose(model, size)
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
            f" one-sided differences would take {(size + 1) * base:.2f} s ({(size + 1) * base / both:.1f} ×)",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=3)
    names = ["hopper", *MODELS]
    parser.add_argument("--models", nargs="+", default=names, choices=names)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for name in arguments.models:
        if name == "hopper":
            run(name, arguments.worlds, arguments.repeats, lift=1.5)
        run(name, arguments.worlds, arguments.repeats)


if __name__ == "__main__":
    main()
