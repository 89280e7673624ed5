"""What actuators give at the joints that they drive, for effects that depend on it, such as friction under load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

_JOINT, _FIXED = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtGain.mjGAIN_FIXED)
_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
_SIMPLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
#: Component of an actuator's gear, unused at a hinge or slide, that keeps the ratio of one that is detached.
_KEPT = 5


def has_law(model: mujoco.MjModel, actuator: int) -> bool:
    """Return whether an actuator's force follows from its command and the state of its joint by a linear law."""
    law = model.actuator_gaintype[actuator] == _FIXED and model.actuator_biastype[actuator] in _BIASES
    prompt = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE and model.actuator_delay[actuator] == 0
    through = model.actuator_trntype[actuator] == _JOINT and model.actuator_ctrlnum[actuator] == 1
    return bool(law and prompt and through and model.jnt_type[model.actuator_trnid[actuator, 0]] in _SIMPLE)


def driven_joints(model: mujoco.MjModel) -> set[int]:
    """Return the joints all of whose actuators have such a law."""
    drives = {i: int(model.actuator_trnid[i, 0]) for i in range(model.nu) if model.actuator_trntype[i] == _JOINT}
    return {*drives.values()} - {joint for i, joint in drives.items() if not has_law(model, i)}


def detach(model: mujoco.MjModel, joint: int) -> None:
    """Take a joint's actuators off it: they no longer move it, but :class:`Drives` still has what they give."""
    own = (model.actuator_trntype == _JOINT) & (model.actuator_trnid[:, 0] == joint)
    attached = own & (model.actuator_gear[:, 0] != 0)
    model.actuator_gear[attached, _KEPT] = model.actuator_gear[attached, 0]
    model.actuator_gear[attached, 0] = 0.0


@dataclass(frozen=True)
class Drives:
    """The laws of A actuators in R simulations: gain·command + bias, within the limits of commands and forces.

    They are those that :func:`has_law` tells; others count for nothing.

    Attributes:
        commands: the command of each, ``(A,)``.
        dofs: the degree of freedom that each drives, ``(A,)``.
        numbers: gear ratio; gain; bias, and its factors of length and velocity; least and largest command, and force,
            and force of all of a joint's actuators, ``(11, R, A)``.
    """

    commands: np.ndarray
    dofs: np.ndarray
    numbers: np.ndarray

    @classmethod
    def of(cls, models: Sequence[mujoco.MjModel], each: int = 1) -> Drives:
        """Return those of models that differ in numbers only, each of them in ``each`` simulations."""
        model = models[0]
        own = np.array([i for i in range(model.nu) if has_law(model, i)], dtype=int)
        dofs = model.jnt_dofadr[model.actuator_trnid[own, 0]]
        return cls(model.actuator_ctrladr[own], dofs, np.stack([_numbers(m, own) for m in models], 1).repeat(each, 1))


@dataclass(frozen=True)
class Drive:
    """The actuators of R simulations under the commands of a step, or of several.

    Attributes:
        drives: their laws.
        command: the commands, ``(R, nu)``; or of P steps, ``(R, P, nu)``.
        step: seconds of a step.
    """

    drives: Drives
    command: np.ndarray
    step: float

    def at(self, rows: slice | np.ndarray) -> Drive:
        """Return those of some simulations."""
        numbers = Drives(self.drives.commands, self.drives.dofs, self.drives.numbers[:, rows])
        return Drive(numbers, self.command[rows], self.step)

    def given(self, dof: int, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what actuators give at a degree of freedom, and by how much less with position and velocity.

        Args:
            dof: its number.
            position, velocity: its own, or those of the rotor that drives it, ``(R,)``; or, under so many commands,
                ``(R, P)``.

        Returns:
            Generalized forces, and their derivatives by position and velocity with the other sign, like ``position``.
        """
        own = self.drives.dofs == dof
        numbers = self.drives.numbers[:, :, own]
        numbers = numbers.reshape(*numbers.shape[:2], *(1,) * (position.ndim - 1), -1)
        gear, gain, constant, stiff, damp, least, most, weakest, strongest, low, high = numbers
        commands = np.clip(self.command[..., self.drives.commands[own]], least, most)
        free = gain * commands + constant + gear * (stiff * position[..., None] + damp * velocity[..., None])
        total, low, high = (gear * np.clip(free, weakest, strongest)).sum(-1), low.max(-1), high.min(-1)
        within = (free > weakest) & (free < strongest) & ((total > low) & (total < high))[..., None]
        slopes = (-(within * gear**2 * factor).sum(-1) for factor in (stiff, damp))
        return (np.clip(total, low, high), *slopes)


def _numbers(model: mujoco.MjModel, own: np.ndarray) -> np.ndarray:
    """See :attr:`Drives.numbers`, ``(11, A)``."""
    joints, affine = model.actuator_trnid[own, 0], model.actuator_biastype[own] == _BIASES[1]
    bias = np.where(affine[:, None], model.actuator_biasprm[own, :3], 0.0)
    ranges = (
        (model.actuator_ctrllimited[own], model.actuator_ctrlrange[own]),
        (model.actuator_forcelimited[own], model.actuator_forcerange[own]),
        (model.jnt_actfrclimited[joints], model.jnt_actfrcrange[joints]),
    )
    limits = [np.where(there[:, None] > 0, ends, (-np.inf, np.inf)) for there, ends in ranges]
    gear = np.where(model.actuator_gear[own, 0] != 0, model.actuator_gear[own, 0], model.actuator_gear[own, _KEPT])
    return np.concatenate([[gear, model.actuator_gainprm[own, 0]], bias.T, *(x.T for x in limits)])
