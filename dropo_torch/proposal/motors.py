"""A model that has no actuators, given motors for the forces that a log commands."""

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


def write_with_motors(path: Path, joints: Sequence[str], out: Path) -> None:
    """Write a model with motors at joints as MJCF."""
    spec = motor_spec(path, joints)
    spec.compile()
    write_atomically(out, spec.to_xml().encode())
