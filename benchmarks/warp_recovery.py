"""Does `dropo fit` with `backend: warp` recover a mass and a friction of robots that people have?

Each task is a model of a public package, or is put together from its parts. C MuJoCo, its solver run to convergence,
makes a short log of it with another mass and another friction, and the fit begins from the middle of their bounds.

    python benchmarks/warp_recovery.py [--tasks 'fetch*'] [--from FOLDER] [--seed 0]

The packages are those of the extra ``coverage-models``; ``--from`` names a folder that holds them, a folder each.
"""

from __future__ import annotations

import argparse
import fnmatch
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import dropo_torch as dropo
from benchmarks.warp_coverage import package_folder, take_hold
from dropo_torch.errors import InputError
from dropo_torch.models.load import quiet_mujoco
from dropo_torch.simulators.hidden import prescribed_bodies

#: Trajectories of a log and logged steps of each; logged steps for which a control is held.
EPISODES, LENGTH, HELD = 10, 10, 5
#: True values, relative to the model's, and bounds of the search.
MASS, FRICTION = 1.25, 1.3
BOUNDS = (0.5, 2.5)
#: Distance of a hand from the cube that it is to push.
CLOSE = 0.01
#: Speed in m/s at which it goes there.
TOWARDS = 0.5
#: Damping from which on a joint is one that is not meant to move.
STUCK = 1e5
#: Time constants after which a filter has forgotten its state, to rounding.
FORGOTTEN = 37
#: Relative error up to which a number is recovered.
RECOVERED = 0.01


@dataclass(frozen=True)
class Task:
    """A model, and what of it is hidden.

    Attributes:
        package: where its file is from.
        path: of the file, from the package's folder.
        body: whose mass is hidden.
        geoms: whose friction is, all of them alike.
        skip: physics steps of a logged one.
        speed: of random velocities at the start: of free joints in m/s and rad/s, of others relative to their range.
        settling: seconds of motion before a trajectory begins.
        build: makes the model of its file and the package's folder; by default it is loaded.
        place: changes the state in which all trajectories begin.
    """

    package: str
    path: str
    body: str
    geoms: tuple[str, ...]
    skip: int = 5
    speed: tuple[float, float] = (0.3, 0.3)
    settling: float = 0.3
    build: Callable[[Path], mujoco.MjModel] = lambda path: mujoco.MjModel.from_xml_path(str(path))
    place: Callable[[mujoco.MjModel, mujoco.MjData], None] = lambda model, data: None


def lift(path: Path) -> mujoco.MjModel:
    """Return robosuite's Panda with its gripper beside a table with a cube, of ``robots/panda/robot.xml``."""
    spec = _on_table(path, 0.02)
    assets = path.parents[2]
    gripper = mujoco.MjSpec.from_file(str(assets / "grippers" / "panda_gripper.xml"))
    spec.body("robot0_right_hand").add_frame().attach_body(gripper.worldbody.first_body(), "gripper0_", "")
    return spec.compile()


def push(path: Path) -> mujoco.MjModel:
    """Return the Panda without a gripper, whose hand stands beside a box on a table."""
    return _on_table(path, 0.05).compile()


def level(path: Path) -> mujoco.MjModel:
    """Return dm_control's quadruped on even ground, as its walking tasks have it."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.delete(spec.geom("terrain"))
    return spec.compile()


def _on_table(path: Path, half: float) -> mujoco.MjSpec:
    """A table, a Panda at its edge and a cube of half a side ``half`` on it."""
    assets = path.parents[2]
    spec = mujoco.MjSpec.from_file(str(assets / "arenas" / "table_arena.xml"))
    robot = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.add_frame(pos=[-0.56, 0, 0.912]).attach_body(robot.body("base"), "robot0_", "")
    cube = spec.worldbody.add_body(name="cube", pos=[0, 0, 0.8 + half])
    cube.add_freejoint(name="cube")
    cube.add_geom(name="cube", type=mujoco.mjtGeom.mjGEOM_BOX, size=[half] * 3, density=400, friction=[1, 0.005, 1e-4])
    return spec


def bent(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Put a Panda into the pose from which robosuite begins."""
    data.qpos[:7] = [0, np.pi / 16, 0, -np.pi / 2 - np.pi / 3, 0, np.pi - 0.2, np.pi / 4]


def beside_hand(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Put the cube onto the table, close to the hand, which moves towards it: a mass shows where it is pushed."""
    data.qpos[:7] = [0, 1.2, 0, -1.6, 0, 2.8, np.pi / 4]
    mujoco.mj_kinematics(model, data)
    hand, cube = data.body("robot0_right_hand").xpos.copy(), model.geom("cube").id
    others = [g for g in range(model.ngeom) if chosen([model.geom(g).name], ["robot0_*collision"])]
    for ahead in np.arange(0.3, 0.0, -0.005):
        data.joint("cube").qpos[:2] = hand[0] + ahead, hand[1]
        mujoco.mj_kinematics(model, data)
        if min(mujoco.mj_geomDistance(model, data, g, cube, 1.0, None) for g in others) < CLOSE:
            break
    mujoco.mj_comPos(model, data)
    jac = np.zeros((6, model.nv))
    mujoco.mj_jacBody(model, data, jac[:3], jac[3:], model.body("robot0_right_hand").id)
    data.qvel[:7] = np.linalg.pinv(jac[:, :7]) @ [TOWARDS, 0, 0, 0, 0, 0]


def at_table(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Put Fetch where Gymnasium-Robotics does, and the object onto its table."""
    for name, value in {"slide0": 0.405, "slide1": 0.48, "slide2": 0.0}.items():
        data.joint(f"robot0:{name}").qpos[:] = value
    data.joint("object0:joint").qpos[:3] = [1.25, 0.53, 0.42]


def in_palm(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Let the block lie in the palm."""
    data.joint("object:joint").qpos[:3] = [1.0, 0.87, 0.2]


_PANDA = "models/assets/robots/panda/robot.xml"
TASKS = {
    "fetch-push": Task(
        "gymnasium_robotics",
        "envs/assets/fetch/push.xml",
        "robot0:gripper_link",
        ("object0",),
        speed=(0.3, 0.05),
        place=at_table,
    ),
    "robosuite-lift": Task("robosuite", _PANDA, "robot0_link5", ("cube",), build=lift, place=bent),
    "metaworld-push": Task(
        "metaworld", "assets/sawyer_xyz/sawyer_push_v3.xml", "right_l6", ("objGeom",), speed=(1.0, 0.2)
    ),
    "metaworld-push-back": Task(
        "metaworld", "assets/sawyer_xyz/sawyer_push_back_v3.xml", "right_l6", ("objGeom",), speed=(1.0, 0.2)
    ),
    "manipulator": Task(
        "dm_control", "suite/manipulator.xml", "lower_arm", ("ball", "thumb*", "finger*", "palm*"), skip=10
    ),
    "quadruped": Task("dm_control", "suite/quadruped.xml", "torso", ("toe_*",), skip=2, build=level),
    "franka-box": Task(
        "robosuite", _PANDA, "cube", ("cube",), build=push, place=beside_hand, settling=0.0, speed=(0.3, 0.02)
    ),
    "hand-block": Task(
        "gymnasium_robotics", "envs/assets/hand/manipulate_block.xml", "object", ("object",), place=in_palm
    ),
}


def load(task: Task, root: Path | None) -> mujoco.MjModel:
    """Return a task's model.

    Raises:
        InputError: its package is not there.
    """
    folder = package_folder(task.package, root)
    files = [] if folder is None else sorted(folder.rglob(task.path))
    if not files:
        raise InputError(f"{task.package}: there is no {task.path}; pip install -e '.[coverage-models]'")
    with quiet_mujoco():
        model = task.build(files[0])
    data = mujoco.MjData(model)
    task.place(model, data)
    take_hold(model, data)
    model.opt.iterations, model.opt.tolerance = max(model.opt.iterations, 100), 1e-12
    return model


def chosen(names: Sequence[str], patterns: Sequence[str]) -> list[str]:
    """Return names that match any of some patterns."""
    return [name for name in names if any(fnmatch.fnmatch(name, pattern) for pattern in patterns)]


def changed(model: mujoco.MjModel, task: Task) -> mujoco.MjModel:
    """Return a copy of a model with the true mass and friction."""
    model = mujoco.MjModel.from_binary_path(_saved(model))
    body = model.body(task.body).id
    model.body_mass[body] *= MASS
    model.body_inertia[body] *= MASS
    for g in range(model.ngeom):
        if chosen([model.geom(g).name], task.geoms):
            model.geom_friction[g, 0] *= FRICTION
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _saved(model: mujoco.MjModel) -> str:
    path = Path(tempfile.mkdtemp()) / "model.mjb"
    mujoco.mj_saveModel(model, str(path))
    return str(path)


def record(model: mujoco.MjModel, task: Task, seed: int) -> dict[str, np.ndarray]:
    """Return a log of a model: ``observations``, ``next_observations``, ``actions``, ``terminals``."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    free = np.isin(model.dof_jntid, np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)))
    span = np.where(model.jnt_limited, model.jnt_range[:, 1] - model.jnt_range[:, 0], 1.0)[model.dof_jntid]
    span *= model.dof_damping < STUCK
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    episodes, length = EPISODES, LENGTH
    if model.na:  # one motion, whose first half is long enough for filters to forget what was before
        memory = FORGOTTEN * model.actuator_dynprm[:, 0].max() / (model.opt.timestep * task.skip)
        episodes, length = 1, 2 * int(memory) + EPISODES * LENGTH
    log: dict[str, list[np.ndarray]] = {k: [] for k in ("observations", "next_observations", "actions", "terminals")}
    for _ in range(episodes):
        mujoco.mj_resetData(model, data)
        task.place(model, data)
        mujoco.mj_step(model, data, nstep=round(task.settling / model.opt.timestep))
        data.qvel += rng.normal(0, np.where(free, task.speed[0], task.speed[1] * span))
        for step in range(length):
            if step % HELD == 0:
                data.ctrl[:] = rng.uniform(low, high) * 0.3
            log["observations"].append(np.concatenate([data.qpos, data.qvel]))
            held = model.body_mocapid[prescribed_bodies(model)]
            poses = np.concatenate([data.mocap_pos[held], data.mocap_quat[held]], axis=1)
            log["actions"].append(np.concatenate([data.ctrl, poses.ravel()]))
            mujoco.mj_step(model, data, nstep=task.skip)
            log["next_observations"].append(np.concatenate([data.qpos, data.qvel]))
            log["terminals"].append(np.array(step == length - 1))
    return {k: np.array(v) for k, v in log.items()}


def recover(name: str, task: Task, root: Path | None, seed: int) -> str:
    """Return what a fit recovers, in a line."""
    model = load(task, root)
    truth = changed(model, task)
    with tempfile.TemporaryDirectory() as folder:
        mujoco.mj_saveModel(model, f"{folder}/model.mjb")
        np.savez(f"{folder}/log.npz", **record(truth, task, seed))
        config = {
            "model": "model.mjb", "data": "log.npz", "frame_skip": task.skip, "backend": "warp", "epsilon": 1e-8,
            "seed": seed, "parameters": {
                "mass": {"field": "body_mass", "name": task.body, "scale_inertia": True, "relative": True,
                         "bounds": list(BOUNDS)},
                "friction": {"field": "geom_friction", "name": list(task.geoms), "relative": True,
                             "bounds": list(BOUNDS)},
            },
        }  # fmt: skip
        started = time.perf_counter()
        try:
            problem = dropo.make_problem(dropo.make_config(config, base=Path(folder)))
            fit = dropo.fit_problem(problem)
        except InputError as error:
            return f"{name:16s} refused: {error}"
    errors = np.abs(np.array(fit.distribution.center) / [MASS, FRICTION] - 1)
    verdict = "recovered" if errors.max() < RECOVERED else "MISSED"
    return (
        f"{name:16s} {verdict}: mass {100 * errors[0]:.3f} % off, friction {100 * errors[1]:.3f} % off, "
        f"nv {model.nv}, {time.perf_counter() - started:.0f} s"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", default="*", metavar="PATTERN", help="only the tasks whose name matches")
    parser.add_argument("--from", dest="root", type=Path, help="folder of the packages, instead of installed ones")
    parser.add_argument("--seed", type=int, default=0, help="of the log and the fit")
    given = parser.parse_args(arguments)
    for name in chosen(list(TASKS), [given.tasks]):
        print(recover(name, TASKS[name], given.root, given.seed), flush=True)


if __name__ == "__main__":
    main()
