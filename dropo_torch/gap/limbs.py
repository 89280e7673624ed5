"""Which joints of a robot are alike: the same joint of each leg, arm or finger."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from dropo_torch.effects.actuator import driven_joint
from dropo_torch.effects.base import Placed, Setting, object_number

#: Digits to which numbers of joints that are alike agree.
DIGITS = 3


def joint_of(setting: Setting, placed: Placed) -> int | None:
    """Return the joint at which an effect of a joint, or of what drives one, sits; ``None`` for others."""
    if placed.effect.kind == "joint":
        return setting.joint(placed.target)
    if placed.effect.kind == "actuator":
        return driven_joint(setting.model, object_number(setting.model, "actuator", placed.target))
    return None


def joint_of_column(setting: Setting, label: str | None) -> int | None:
    """Return the hinge or slide joint of which an observed column has the position or velocity; ``None`` for none."""
    model, place = setting.model, int(setting.observation.index[setting.column(label)])
    if place < 0:
        return None
    of = model.jnt_dofadr == place - model.nq if place >= model.nq else model.jnt_qposadr == place
    found = np.flatnonzero(of & np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)))
    return int(found[0]) if found.size else None


def alike(model: mujoco.MjModel) -> list[list[int]]:
    """Return groups of two or more joints that are the same joint of several limbs.

    They are as many joints away from the world, of one type, with one damping, dry friction, rotor inertia and spring
    in the model, and carry equally much. Which way they turn and how far may differ, as between left and right.
    """
    groups: dict[tuple, list[int]] = {}
    depths = [_depth(model, joint) for joint in range(model.njnt)]
    for joint, depth in enumerate(depths):
        dof, body = model.jnt_dofadr[joint], model.jnt_bodyid[joint]
        numbers = (
            model.dof_damping[dof], model.dof_frictionloss[dof], model.dof_armature[dof], model.jnt_stiffness[joint],
            model.body_subtreemass[body],
        )  # fmt: skip
        key = (int(model.jnt_type[joint]), depth, *(f"{float(np.ravel(n)[0]):.{DIGITS}g}" for n in numbers))
        groups.setdefault(key, []).append(joint)
    return [group for group in groups.values() if len(group) > 1]


def by_limbs(setting: Setting, placed: Sequence[Placed]) -> list[list[int]]:
    """Return which of several effects of one kind sit at joints that are alike, all of such a group each."""
    joints = [joint_of(setting, p) for p in placed]
    whole = ([joints.index(j) for j in group if j in joints] for group in alike(setting.model))
    return [rows for rows in whole if 1 < len(rows) < len(placed)]


def _depth(model: mujoco.MjModel, joint: int) -> int:
    """The number of joints between a joint and the world."""
    body = int(model.jnt_bodyid[joint])
    above = joint - int(model.body_jntadr[body])
    while body := int(model.body_parentid[body]):
        above += int(model.body_jntnum[body])
    return above
