"""Whether `dropo plan` keeps what it promises, on six systems whose truth is known, as plain MuJoCo simulates them.

    python benchmarks/plan_systems.py --out out/plan                    # all of it; --systems cartpole,servo for some
    python benchmarks/plan_systems.py --out out/plan --limits 100       # besides, so many plans of random limits

Each system has a short, gentle first log, to which its parameters are fitted. A motion is planned at that fit, with the
log, recorded by the true model, and fitted alone, several times with fresh noise. Told are

- kept: root mean square over parameters and recordings of (fitted - true) / promised standard error; 1 is ideal,
- stated: the same by the standard errors that the fits state themselves, median of stated / promised,
- gain: standard errors of a multi-sine of the same seconds and limits by those of the plan: the geometric mean over
  parameters, and over multi-sines. A multi-sine has five sines a joint of equal amplitude, from the lowest to the
  highest frequency that a plan may use, with phases at random, about where the robot starts; it is made as large as the
  same limits let it, by the same code.

Limits are looked at in the true model's motion, too, at every physics step: 3 % of a limit count as kept there, as the
true model is none of those that the plan was checked with.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.init.systems import ROBOTS
from dropo_torch.baselines import fit_problem
from dropo_torch.config import Config, make_config
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.diagnostics import diagnose
from dropo_torch.errors import InputError
from dropo_torch.planning import Ground, Plan, make_plan, prepare
from dropo_torch.planning.plan import finished
from dropo_torch.planning.search import Found
from dropo_torch.problem import make_problem

#: Sines of a joint of the multi-sine, and how many of these are compared.
SINES, COMPARED = 5, 4
#: Share of a limit that the true model may be beyond it.
BEYOND = 0.03

ARM, CARTPOLE, PUSHER, SERVO = ((ROBOTS / f"{name}.xml").read_text() for name in ("arm", "cartpole", "pusher", "servo"))

DRIVE = """
<mujoco model="drive">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="lever">
      <joint name="axle" type="hinge" axis="0 1 0" damping=".05" frictionloss=".05" armature=".02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".6" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="axle" gear="2" ctrllimited="true" ctrlrange="-2 2"/></actuator>
</mujoco>"""

#: The torque arm, whose motors carry its weight.
FLOATING = ARM.replace('model="arm"', 'model="floating"').replace(
    '<body name="upper"', '<body name="upper" gravcomp="1"'
).replace('<body name="lower"', '<body name="lower" gravcomp="1"')  # fmt: skip


def _mass(body: str, low: float, high: float) -> dict[str, Any]:
    return {"field": "body_mass", "name": body, "bounds": [low, high], "scale_inertia": True, "unit": "kg"}


def _of(field_: str, name: str, low: float, high: float) -> dict[str, Any]:
    return {"field": field_, "name": name, "bounds": [low, high]}


@dataclass(frozen=True)
class System:
    """A robot, what is fitted, its truth, and its limits.

    Attributes:
        model: as XML.
        parameters: as a config has them.
        truth: their true values.
        noise: standard deviation of positions and velocities.
        plan: the config's ``plan``.
        gentle: amplitude of the first log's commands.
        every: physics steps of a row.
    """

    model: str
    parameters: Mapping[str, Mapping[str, Any]]
    truth: Mapping[str, float]
    noise: tuple[float, float]
    plan: Mapping[str, Any]
    gentle: Sequence[float]
    every: int = 10
    extra: Mapping[str, Any] = field(default_factory=dict)


_TWO_JOINTS = {
    "upper_mass": _mass("upper", 0.75, 3.0), "lower_mass": _mass("lower", 0.4, 1.6),
    "shoulder_damping": _of("dof_damping", "shoulder", 0, 0.5), "elbow_damping": _of("dof_damping", "elbow", 0, 0.3),
    "shoulder_friction": _of("dof_frictionloss", "shoulder", 0, 0.5),
    "elbow_friction": _of("dof_frictionloss", "elbow", 0, 0.3),
}  # fmt: skip
_TWO_TRUE = {
    "upper_mass": 1.8, "lower_mass": 0.65, "shoulder_damping": 0.15, "elbow_damping": 0.08, "shoulder_friction": 0.2,
    "elbow_friction": 0.1,
}  # fmt: skip
_TWO_LIMITS = {"position": {"shoulder": [-1.5, 1.5], "elbow": [-2, 2]}, "velocity": 4, "force": 15}

SYSTEMS: dict[str, System] = {
    "cartpole": System(
        CARTPOLE,
        {"cart_mass": _mass("cart", 0.5, 2), "pole_mass": _mass("pole", 0.1, 0.5),
         "slider_damping": _of("dof_damping", "slider", 0, 1.5), "hinge_damping": _of("dof_damping", "hinge", 0, 0.02)},
        {"cart_mass": 1.3, "pole_mass": 0.2, "slider_damping": 0.5, "hinge_damping": 0.004},
        (1e-3, 1e-2), {"position": {"slider": [-0.6, 0.6]}, "velocity": 2, "force": 12}, (2.0,), every=5,
    ),
    "torque_arm": System(ARM, _TWO_JOINTS, _TWO_TRUE, (1e-3, 1e-2), _TWO_LIMITS, (1.5, 0.6)),
    "servo_arm": System(
        SERVO,
        {"link2_mass": _mass("link2", 0.35, 1.4), "link3_mass": _mass("link3", 0.2, 0.8),
         "damping1": _of("dof_damping", "joint1", 0, 1), "damping2": _of("dof_damping", "joint2", 0, 1),
         "damping3": _of("dof_damping", "joint3", 0, 0.8), "armature1": _of("dof_armature", "joint1", 0, 0.1)},
        {"link2_mass": 0.9, "link3_mass": 0.5, "damping1": 0.5, "damping2": 0.4, "damping3": 0.3, "armature1": 0.03},
        (1e-3, 1e-2), {"velocity": 2.5}, (0.3, 0.2, 0.2),
    ),
    "drive": System(
        DRIVE,
        {"lever_mass": _mass("lever", 0.3, 1.2), "damping": _of("dof_damping", "axle", 0, 0.2),
         "friction": _of("dof_frictionloss", "axle", 0, 0.2), "armature": _of("dof_armature", "axle", 0, 0.06)},
        {"lever_mass": 0.5, "damping": 0.07, "friction": 0.06, "armature": 0.025},
        (1e-3, 1e-2), {"position": {"axle": [-2, 2]}, "velocity": 6}, (0.25,),
    ),
    "pushed_box": System(
        PUSHER,
        {"box_mass": _mass("box", 0.3, 1.2), "hand_mass": _mass("hand", 0.25, 1.0),
         "box_friction": {"field": "geom_friction", "name": ["box", "table"], "index": 0, "bounds": [0.2, 0.8]}},
        {"box_mass": 0.7, "hand_mass": 0.55, "box_friction": 0.45},
        (5e-4, 5e-3),
        {"position": {"hand_x": [-0.1, 0.3], "hand_y": [-0.1, 0.1]}, "velocity": 0.5, "touch": [["hand", "box"]]},
        (0.12, 0.01),
    ),
    "floating_arm": System(FLOATING, _TWO_JOINTS, _TWO_TRUE, (1e-3, 1e-2), _TWO_LIMITS, (1.0, 0.4)),
}  # fmt: skip


def config_of(system: System, folder: Path, evaluations: int | None, **changes: Any) -> Config:
    """Return the config of a system whose model is written to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.xml").write_text(system.model)
    model = mujoco.MjModel.from_xml_string(system.model)
    noise = [system.noise[0]] * model.nq + [system.noise[1]] * model.nv
    document = {
        "model": "robot.xml", "frame_skip": system.every, "noise": noise, "epsilon": 1e-10, "samples": 10, "threads": 1,
        "parameters": {k: dict(v) for k, v in system.parameters.items()},
        "plan": {**system.plan, "evaluations": evaluations, "models": 2}, **system.extra, **changes,
    }  # fmt: skip
    return make_config(document, base=folder)


def true_model(config: Config, system: System, still: Trajectories) -> mujoco.MjModel:
    """Return the model with the true values."""
    space = make_problem(config, log=still).space
    return space.apply(space.vector(system.truth))


def recorded(
    model: mujoco.MjModel, start: np.ndarray, commands: np.ndarray, every: int, noise: tuple[float, float], seed: int,
    settle: int = 0,
) -> tuple[Trajectories, np.ndarray]:  # fmt: skip
    """Return the noisy log of commands ``(N, nu)``, the first held before, and the states at every physics step."""
    data, rng = mujoco.MjData(model), np.random.default_rng([seed, 21])
    data.qpos[:], data.qvel[:] = start[: model.nq], start[model.nq :]
    data.ctrl[:] = commands[0]
    for _ in range(settle):
        mujoco.mj_step(model, data)
    fine = [np.concatenate([data.qpos, data.qvel])]
    for command in commands:
        data.ctrl[:] = command
        for _ in range(every):
            mujoco.mj_step(model, data)
            fine.append(np.concatenate([data.qpos, data.qvel]))
    states = np.array(fine)
    shown = states[::every] + np.array([noise[0]] * model.nq + [noise[1]] * model.nv) * rng.standard_normal(
        (len(commands) + 1, model.nq + model.nv)
    )
    dt = every * float(model.opt.timestep)
    return Trajectories.of_samples(shown, commands, dt=dt, source="recording"), states


def first_log(system: System, config: Config, seconds: float) -> Trajectories:
    """Return the gentle log that is there before anything is planned."""
    bare = mujoco.MjModel.from_xml_string(system.model)
    step, rows = system.every * bare.opt.timestep, 60
    still = Trajectories.of_samples(
        np.tile(np.concatenate([bare.qpos0, np.zeros(bare.nv)]), (rows + 1, 1)), np.zeros((rows, bare.nu)), dt=step,
        source="still",
    )  # fmt: skip
    model, time_ = true_model(config, system, still), step * np.arange(round(seconds / step))
    commands = np.stack([
        a * (np.sin(2 * np.pi * 0.5 * time_ + i) - np.sin(i) + 0.5 * np.sin(2 * np.pi * 1.3 * time_)) / 1.5
        for i, a in enumerate(system.gentle)
    ], 1)  # fmt: skip
    start = np.concatenate([bare.qpos0, np.zeros(bare.nv)])
    return recorded(model, start, commands, system.every, system.noise, seed=1, settle=500)[0]


def save(log: Trajectories, path: Path) -> None:
    """Write a log."""
    np.savez(
        path, observations=log.observations, next_observations=log.next_observations, actions=log.actions,
        terminals=log.terminals, dt=log.dt,
    )  # fmt: skip


def multisine(ground: Ground, seed: int) -> Plan:
    """Return a multi-sine within the same limits."""
    flat = ground.family.multisines(1, np.random.default_rng([seed, 31]))[0]
    return finished(ground, Found(flat, 0.0, 1, "a multi-sine"), lambda stage, share: None, time.perf_counter())


def beyond(plan: Plan, states: np.ndarray, model: mujoco.MjModel, every: int) -> float:
    """Return by what share of a limit the true model's motion is beyond it; 0 where it keeps all."""
    each = np.repeat(plan.commands[None], every, axis=1)
    kept = plan.ground.limits.kept([model], states[None, None], each, float(model.opt.timestep), per=every)
    return max(0.0, float(np.nanmax(kept.excess))) + float(kept.depth[0]) / 0.01


def attempt(name: str, folder: Path, seconds: float, evaluations: int | None, recordings: int) -> dict[str, Any]:
    """Plan, record and fit one system, and compare it with multi-sines."""
    system, began = SYSTEMS[name], time.perf_counter()
    config = config_of(system, folder, evaluations)
    log = first_log(system, config, 4.0)
    save(log, folder / "log.npz")
    config = config.model_copy(update={"data": "log.npz"})
    first = fit_problem(make_problem(config))
    first.save(folder / "fit.json")
    ground = prepare(config, seconds, at=folder / "fit.json")
    plan = make_plan(ground)
    space = ground.problem.space
    truth, model = space.vector(system.truth), space.apply(space.vector(system.truth))
    promised = plan.errors["plan"]
    assert promised is not None
    off, stated, most = [], [], 0.0
    settle = round(2.0 / model.opt.timestep) if ground.settled else 0
    for seed in range(100, 100 + recordings):
        again, states = recorded(
            model, ground.starts[0], plan.commands, system.every, system.noise, seed, settle=settle
        )
        most = max(most, beyond(plan, states, model, system.every))
        problem = make_problem(config.model_copy(update={"data": None}), log=again)
        fit = fit_problem(problem)
        off.append((fit.distribution.center - truth) / promised)
        stated.append(diagnose(problem.objective, fit.distribution).standard_error / promised)
    waves = prepare(
        config.model_copy(update={"plan": {**config.plan, "waves": SINES}}), seconds, at=folder / "fit.json"
    )
    gains = []
    for seed in range(COMPARED):
        errors = multisine(waves, seed).errors["plan"]
        assert errors is not None
        gains.append(errors / promised)
    return {
        "system": name, "kept": float(np.sqrt(np.mean(np.square(off)))) if off else None,
        "stated": float(np.median(stated)) if off else None,
        "off": [z.tolist() for z in off], "names": space.names,
        "promised": promised.tolist(), "gain": float(np.exp(np.mean(np.log(gains)))),
        "gains": np.exp(np.mean(np.log(gains), 1)).tolist(),
        "gain_by_parameter": np.exp(np.mean(np.log(gains), 0)).tolist(),
        "beyond": most, "scale": plan.scale, "nats": -plan.found.cost, "seconds": time.perf_counter() - began,
    }  # fmt: skip


def keeps_limits(number: int, folder: Path) -> dict[str, Any]:
    """Plan a short motion of a random system with random limits, and look at the limits in another integration.

    The motion is looked at in each of the plan's models with half the physics step; 3 % of a limit count as kept.
    """
    rng = np.random.default_rng([number, 41])
    name = str(rng.choice(list(SYSTEMS)))
    system = SYSTEMS[name]
    plan = {k: (v * float(rng.uniform(0.4, 1.5)) if isinstance(v, int | float) else v) for k, v in system.plan.items()}
    config = config_of(replace(system, plan=plan), folder, 12, seed=number)
    config = config.model_copy(update={"plan": {**config.plan, "models": int(rng.integers(0, 4))}})
    try:
        found = make_plan(prepare(config, float(rng.uniform(1.5, 3))))
    except InputError as error:
        return {"number": number, "system": name, "refused": str(error)}
    most, ground = 0.0, found.ground
    for model, start in zip(ground.models, ground.starts, strict=True):
        model.opt.timestep /= 2
        states = recorded(model, start, found.commands, 2 * system.every, system.noise, seed=0)[1]
        most = max(most, beyond(found, states, model, 2 * system.every))
    return {"number": number, "system": name, "beyond": most, "scale": found.scale}


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the results; what is there is not done again"
    )
    parser.add_argument("--systems", default=",".join(SYSTEMS), help="which ones")
    parser.add_argument("--seconds", type=float, default=8.0, help="of a motion")
    parser.add_argument("--evaluations", type=int, help="motions that are tried; the planner's choice by default")
    parser.add_argument("--recordings", type=int, default=6, help="of each plan, with fresh noise; 0 for gains alone")
    parser.add_argument("--limits", type=int, default=0, help="short plans of random limits")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    for name in filter(None, given.systems.split(",")):
        done = given.out / f"{name}.json"
        if not done.exists():
            result = attempt(name, given.out / name, given.seconds, given.evaluations, given.recordings)
            done.write_text(json.dumps(result, indent=1))
        r = json.loads(done.read_text())
        print(
            f"{name}: kept {_number(r['kept'])}, stated {_number(r['stated'])}, gain {r['gain']:.2f}, beyond limits "
            f"{100 * r['beyond']:.1f} %, {r['seconds']:.0f} s", flush=True,
        )  # fmt: skip
    store = given.out / "limits.jsonl"
    results = [json.loads(line) for line in store.read_text().splitlines()] if store.exists() else []
    for number in range(len(results), given.limits):
        results.append(keeps_limits(number, given.out / "limits"))
        with store.open("a") as stream:
            stream.write(json.dumps(results[-1]) + "\n")
    if given.limits:
        planned = [r for r in results if "beyond" in r]
        broken = [r for r in planned if r["beyond"] > BEYOND]
        print(f"{len(planned)} plans, {len(results) - len(planned)} refused, limits violated in {len(broken)}")
        for r in broken:
            print(f"  {r}")


if __name__ == "__main__":
    main()
