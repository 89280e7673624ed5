"""What a model wants columns for: positions and velocities of its joints, and commands of its actuators."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, cast

import mujoco
import numpy as np

from dropo_torch.data.observation import joint_name
from dropo_torch.effects.actuator import is_servo, unit_of
from dropo_torch.effects.base import Setting, object_number
from dropo_torch.parameters import object_names
from dropo_torch.proposal.words import object_words, says_kind

Kind = Literal["position", "velocity", "command", "marker", "sensor"]
#: Kinds of a place by what is measured there: an angle, a length, a component of a quaternion; of a command that turns
#: and slides at once, both.
Measure = Literal["angle", "length", "quaternion", "both"]

#: Units of speeds, in SI: radians or meters, degrees, turns a minute, millimeters.
SPEEDS = (1.0, np.pi / 180, np.pi / 30, 1e-3)


@dataclass(frozen=True)
class Place:
    """One number of a state or a command.

    Attributes:
        label: what it is called, such as ``shoulder.position``.
        kind: position, velocity or command; marker, a coordinate of a thing's place; or sensor, a value of one.
        measure: what is measured there.
        entry: its entry of a config's ``observation``; empty for a command.
        number: its column in ``[qpos, qvel]``, its actuator, or a marker's axis.
        joint: the joint's number, -1 for none.
        words, numbers: by which the object is known.
        aliases: words by which it may be known besides: its body's, its axis.
        axis: of a joint with several coordinates: ``x``, ``y``, ``z`` or ``w``.
        angular: whether it turns about that axis.
        limits: of a position or a command, or ``None``.
        takes: of a command, what it is: ``position``, ``velocity`` or ``effort``.
        optional: whether a log may lack it, as nothing depends on it.
        partner: of a velocity, the place of its position, by label; of a command, that of its joint.
        is_base: whether it is of slides and hinges by which all of a robot moves, as in a plane.
    """

    label: str
    kind: Kind
    measure: Measure
    entry: str
    number: int
    joint: int
    words: tuple[str, ...]
    numbers: tuple[int, ...]
    aliases: tuple[str, ...] = ()
    axis: str = ""
    angular: bool = False
    limits: tuple[float, float] | None = None
    takes: Literal["position", "velocity", "effort"] = "effort"
    optional: bool = False
    partner: str = ""
    is_base: bool = False


def known_names(model: mujoco.MjModel) -> list[str]:
    """Return the names of a model's objects of which columns may speak: joints, and actuators not called by a kind."""
    joints = [joint_name(model, j) for j in range(model.njnt)]
    return joints + [name for name in object_names(model, "actuator") if name and not says_kind(name)]


def places_of(model: mujoco.MjModel) -> tuple[Place, ...]:
    """Return all places of a model: positions, velocities and commands, each in the model's order."""
    positions: list[Place] = []
    velocities: list[Place] = []
    for j in range(model.njnt):
        own, rates = _of_joint(model, j)
        positions += own
        velocities += rates
    return (*positions, *velocities, *_commands(model))


def _of_joint(model: mujoco.MjModel, j: int) -> tuple[list[Place], list[Place]]:
    """The positions and velocities of a joint."""
    kind, name = int(model.jnt_type[j]), joint_name(model, j)
    first, dof = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
    words, numbers = object_words(name)
    aliases = object_words(model.body(int(model.jnt_bodyid[j])).name)[0]
    if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        turns = kind == mujoco.mjtJoint.mjJNT_HINGE
        axis = "xyz"[int(np.argmax(np.abs(model.jnt_axis[j])))]
        low, high = model.jnt_range[j].tolist()
        position = Place(
            f"{name}.position", "position", "angle" if turns else "length", f"{name}.position", first, j, words,
            numbers, aliases=(*aliases, {"x": "roll", "y": "pitch", "z": "yaw"}[axis] if turns else axis),
            limits=(low, high) if model.jnt_limited[j] else None, optional=not turns and _moves_nothing(model, j),
            is_base=_is_base(model, j),
        )  # fmt: skip
        label = f"{name}.velocity"
        velocity = replace(
            position, label=label, kind="velocity", entry=label, number=model.nq + dof, optional=False,
            partner=position.label,
        )  # fmt: skip
        return [position], [velocity]

    def component(rest: str, measure: Measure, axis: str, column: int, *, moving: bool) -> Place:
        kind: Kind = "velocity" if moving else "position"
        entry = f"qvel[{column}]" if moving else f"qpos[{column}]"
        number = column + (model.nq if moving else 0)
        return Place(f"{name}.{rest}", kind, measure, entry, number, j, words, numbers, aliases, axis)

    own: list[Place] = []
    rates: list[Place] = []
    for i, axis in enumerate("xyz" if kind == mujoco.mjtJoint.mjJNT_FREE else ""):
        own.append(component(f"position[{axis}]", "length", axis, first + i, moving=False))
        rate = component(f"velocity[v{axis}]", "length", axis, dof + i, moving=True)
        rates.append(replace(rate, partner=own[-1].label))
    skip = len(own)
    own += [
        component(f"position[q{axis}]", "quaternion", axis, first + skip + i, moving=False)
        for i, axis in enumerate("wxyz")
    ]
    turning = [
        component(f"velocity[w{axis}]", "angle", axis, dof + skip + i, moving=True) for i, axis in enumerate("xyz")
    ]
    return own, [*rates, *(replace(p, angular=True) for p in turning)]


def _is_base(model: mujoco.MjModel, j: int) -> bool:
    """Whether a joint is one of several, slides among them, by which a body moves that hangs on nothing."""
    own = np.flatnonzero(model.jnt_bodyid == model.jnt_bodyid[j])
    slides = model.jnt_type[own] == mujoco.mjtJoint.mjJNT_SLIDE
    return len(own) > 1 and bool(slides.any()) and int(model.body_parentid[model.jnt_bodyid[j]]) == 0


def _moves_nothing(model: mujoco.MjModel, j: int) -> bool:
    """Whether a slide joint only moves all of the robot along a level direction of the world."""
    body = int(model.jnt_bodyid[j])
    if int(model.body_parentid[body]) != 0 or model.jnt_stiffness[j] != 0 or model.jnt_limited[j]:
        return False
    gravity = np.asarray(model.opt.gravity)
    down = abs(float(model.jnt_axis[j] @ gravity)) > 1e-6 * max(float(np.linalg.norm(gravity)), 1e-9)
    driven = any(
        int(model.actuator_trntype[a]) == mujoco.mjtTrn.mjTRN_JOINT and int(model.actuator_trnid[a, 0]) == j
        and int(model.actuator_biastype[a]) != mujoco.mjtBias.mjBIAS_NONE
        for a in range(model.nu)
    )  # fmt: skip
    return not down and not driven


def _commands(model: mujoco.MjModel) -> list[Place]:
    found = []
    for a, name in enumerate(object_names(model, "actuator")):
        by_joint = int(model.actuator_trntype[a]) in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        joint = int(model.actuator_trnid[a, 0]) if by_joint else -1
        words, numbers = object_words(name)
        aliases: tuple[str, ...] = ()
        if joint >= 0:
            others, more = object_words(joint_name(model, joint))
            aliases, numbers = others, numbers or more
        limits = tuple(model.actuator_ctrlrange[a].tolist()) if model.actuator_ctrllimited[a] else None
        partner = f"{joint_name(model, joint)}.position" if joint >= 0 else ""
        found.append(Place(
            name, "command", _driven(model, name), "", a, joint, words, numbers, aliases, limits=limits,
            takes=command_kind(model, a), partner=partner,
        ))  # fmt: skip
    return found


@dataclass(frozen=True)
class _Given:
    """The model as :func:`unit_of` takes it: the rule looks at nothing else of a setting."""

    model: mujoco.MjModel


def _driven(model: mujoco.MjModel, actuator: str) -> Measure:
    """Whether an actuator turns or slides what it acts on; of both, that of which its command is told in the unit."""
    found = unit_of(cast(Setting, _Given(model)), actuator, "angle", "length")
    if found:
        return "angle" if found == "angle" else "length"
    gear = model.actuator_gear[object_number(model, "actuator", actuator)]
    pulls, turns = (np.isclose(np.linalg.norm(part), 1.0) for part in (gear[:3], gear[3:]))
    return "both" if pulls == turns else "length" if pulls else "angle"


def command_kind(model: mujoco.MjModel, a: int) -> Literal["position", "velocity", "effort"]:
    """Return what an actuator takes as its command.

    A velocity servo's command is a velocity in a usual unit; a motor whose back-EMF brakes it takes an effort.
    """
    if is_servo(model, a):
        return "position"
    if int(model.actuator_biastype[a]) == mujoco.mjtBias.mjBIAS_AFFINE:
        gain = model.actuator_gainprm[a, 0]
        kv = -model.actuator_biasprm[a, 2]
        if model.actuator_biasprm[a, 1] == 0 and kv > 0 and np.isclose(gain / kv, SPEEDS).any():
            return "velocity"
    return "effort"
