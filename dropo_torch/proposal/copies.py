"""Copies of a model that suit a log: with motors for the forces that it commands, with steps that divide its rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco

from dropo_torch.data.observation import joint_name
from dropo_torch.models.export import read_spec
from dropo_torch.support.files import write_atomically


def motor_spec(path: Path, joints: Sequence[str]) -> mujoco.MjSpec:
    """Return a model with a motor of gear 1 at each of some joints, called as they are."""
    spec = read_spec(path)
    for name in joints:
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    return spec


def drivable(model: mujoco.MjModel) -> list[str]:
    """Return the joints of a model that a motor can drive by name."""
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return [joint_name(model, j) for j in range(model.njnt) if int(model.jnt_type[j]) in kinds and model.joint(j).name]


def out_of(config: Path, model: Path, what: str) -> Path:
    """Return where a copy of a model stands: beside the config, called after what it has."""
    return config.resolve().parent / f"{model.stem}_{what}.xml"


def write_copy(path: Path, joints: Sequence[str], timestep: float, out: Path) -> None:
    """Write a model as MJCF, with motors at joints and with a step of its own, in seconds."""
    spec = motor_spec(path, joints)
    spec.option.timestep = timestep
    spec.compile()
    write_atomically(out, spec.to_xml().encode())
