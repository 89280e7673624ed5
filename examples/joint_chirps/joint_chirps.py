"""What do the joints of a measured robot have that its model lacks?

    python examples/joint_chirps/joint_chirps.py FOLDER --robot z1 --out out/z1

FOLDER holds the logs of a Unitree Z1 arm and of a Go2 quadruped in the air whose joints follow chirps under PD control,
each with its MJCF (see docs/real-robots.md). The model given is the published one without its rotor inertias and
frictions: geometry, masses, kp and kd. The search sees the first three quarters of the log; the table compares
open-loop predictions of the last one, where the chirps are fastest.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch

import dropo_torch as dropo
from dropo_torch.effects import VOCABULARY, Placed
from dropo_torch.gap import Hypothesis, Scene, name, open_loop, prepare
from dropo_torch.problem import Problem

#: Joints of which position and velocity were measured: all but the arm's gripper.
JOINTS = {"go2": 12, "z1": 6}
SECONDS = (0.1, 0.3, 1.0, 3.0)
#: Beside the log of some robots.
LIST = "isaaclab_identified_parameters.py"
DT, STEP = 0.005, 0.0025
#: What the tensor file holds besides tensors; nothing else of it is run.
PLAIN = [
    np._core.multiarray._reconstruct, np.ndarray, np.dtype, np._core.multiarray.scalar,
    *(type(np.dtype(t)) for t in ("f4", "f8", "i8", "?")),
]  # fmt: skip


def read_log(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a log."""
    with torch.serialization.safe_globals(PLAIN):
        return {key: np.asarray(value) for key, value in torch.load(path, weights_only=True).items()}


def bare_model(xml: str, kp: np.ndarray, kd: np.ndarray, *, published: bool) -> str:
    """Return a robot's MJCF on a fixed base, without meshes, with servos; its own rotors and frictions if published."""
    for tag in ("mesh", "material", "texture"):
        xml = re.sub(rf"<{tag}\b[^>]*/>", "", xml)
    xml = re.sub(r"<geom[^>]*(mesh=|class=\"visual\")[^>]*/>", "", xml)
    xml = re.sub(r"<(freejoint|keyframe|actuator|sensor|contact)\b[^>]*>.*?</\1>", "", xml, flags=re.S)
    spec = mujoco.MjSpec.from_string(re.sub(r"<freejoint[^>]*/>", "", xml))
    spec.option.timestep = STEP
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # nothing touches anything in these logs
    joints = list(spec.joints)
    for joint in [] if published else joints:
        joint.armature, joint.frictionloss, joint.damping = 0.0, 0.0, 0.0 * np.asarray(joint.damping)
    for joint, p, d in zip(joints, kp, kd, strict=False):
        servo = spec.add_actuator(name=f"{joint.name}_servo", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=float(p), kv=float(d))
    spec.compile()
    return str(spec.to_xml())


def write(folder: Path, robot: str, out: Path, *, published: bool) -> Path:
    """Write model, log and config of a robot, and return the config's path."""
    count, log = JOINTS[robot], read_log(folder / robot / "traj_0.pt")
    kp, kd = (log[k].ravel()[:count] for k in ("kp", "kd"))
    kind = "published" if published else "bare"
    (out / f"{kind}.xml").write_text(
        bare_model((folder / robot / f"{robot}.xml").read_text(), kp, kd, published=published)
    )
    rows = np.hstack([log["dof_pos"][:, :count], log["dof_vel"][:, :count]])
    ends = np.arange(len(rows)) == len(rows) - 1
    np.savez(out / "log.npz", observations=rows, actions=log["des_dof_pos"][:, :count], terminals=ends)
    config = out / f"{kind}.yaml"
    config.write_text(
        f"model: {kind}.xml\ndata: {{path: log.npz, dt: {DT}}}\nframe_skip: {round(DT / STEP)}\n"
        f"observation: ['qpos[:{count}]', 'qvel[:{count}]']\nbackend: warp\n"
    )
    return config


def make(folder: Path, robot: str, out: Path, *, published: bool) -> Problem:
    """Write model, log and config of a robot, and return its problem."""
    return dropo.make_problem(dropo.load_config(write(folder, robot, out, published=published)), general=True)


def errors(scene: Scene, hypothesis: Hypothesis) -> list[float]:
    """Return the errors over all horizons, in thousandths."""
    return [1e3 * open_loop(scene, hypothesis, s)[0] for s in SECONDS]


def listed(path: Path, scene: Scene) -> Hypothesis:
    """Return the publishers' list of joint parameters; offsets have the sign that predicts better."""
    found = {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    names = {"armature": ("armature", 1), "joint_damping": ("viscous_friction", 1),
             "joint_friction": ("dynamic_friction", 1), "actuator_bias": ("bias", -1)}  # fmt: skip
    return scene.begin.with_effects(
        [
            Placed(VOCABULARY[effect], target, (sign * value,))
            for effect, (name, sign) in names.items()
            for target, value in zip(VOCABULARY[effect].targets(scene.setting), found[name], strict=True)
        ]
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="holds go2/ and z1/, each with traj_0.pt and an MJCF")
    parser.add_argument("--robot", choices=sorted(JOINTS), default="z1")
    parser.add_argument("--out", type=Path, default=Path("out/joint_chirps"))
    given = parser.parse_args(arguments)
    for needed in ("traj_0.pt", f"{given.robot}.xml"):
        if not (path := given.folder / given.robot / needed).is_file():
            parser.error(f"{path}: no such file; expected the folder with go2/ and z1/ of the publishers")
    given.out.mkdir(parents=True, exist_ok=True)
    bare, theirs = (prepare(make(given.folder, given.robot, given.out, published=p)) for p in (False, True))
    print("looking for what the model lacks", file=sys.stderr, flush=True)
    naming = name(bare)
    for placed in naming.final.hypothesis.placed if naming.named else ():
        numbers = placed.summary(bare.setting)
        print(f"{placed.effect.name} of {placed.target}: " + ", ".join(f"{k} {v:.4g}" for k, v in numbers.items()))
    print(f"\nopen-loop error of positions, mrad, over {', '.join(f'{s:g}' for s in SECONDS)} s of the unseen quarter")
    rows = {
        "constant velocity": [1e3 * open_loop(bare, bare.begin, s)[1] for s in SECONDS],
        "model as given": errors(bare, bare.begin),
        "published rotors and frictions": errors(theirs, theirs.begin),
    }
    if (extra := given.folder / given.robot / LIST).is_file():
        rows["published list of parameters"] = errors(bare, listed(extra, bare))
    rows["with what was found"] = errors(bare, naming.final.hypothesis)
    for label, values in rows.items():
        print(f"{label:<32}" + "".join(f"{v:>9.1f}" for v in values))


if __name__ == "__main__":
    main()
