"""What effects add to the forces that a motion needs: a column for each of their numbers."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from dropo_torch.effects.actuator import driven_joint
from dropo_torch.effects.base import Effect, Placed, Setting, find_effect, object_number
from dropo_torch.gap.forces.motion import Stretch

#: The effects in whose numbers the forces are linear.
FRICTION, OFFSET, CENTER = "joint_friction", "actuator_bias", "center_of_mass"
#: Friction that gives before it slides: linear, too, once its displacement is known.
PRESLIDING = "joint_presliding"
LINEAR = (FRICTION, "joint_damping", OFFSET, CENTER, "armature")
#: Speed, by a joint's root mean square, at which dry friction is three quarters of what it is in full motion.
AT_REST = 0.02
#: Difference step, by a number's scale; forces are quadratic in a center of mass at most, so any size will do.
STEP = 0.1


@dataclass(frozen=True)
class Terms:
    """Forces of a log and the columns that could explain what is missing in them, in the order of the effects.

    Attributes:
        placed: the effects, with neutral values.
        missing: logged force minus the force that the motion needs in the model as it is, ``(N, nv)``.
        columns: what a unit of each number takes of it, ``(P, N, nv)``.
        owner: the effect of each number, ``(P,)``.
        low, high: bounds of the numbers, relative to their neutral values, ``(P,)``.
        prior: standard deviation of each number about its neutral value where the log may not show it, ``(P,)``.
        episodes: episode of each row, ``(N,)``.
    """

    placed: tuple[Placed, ...]
    missing: np.ndarray
    columns: np.ndarray
    owner: np.ndarray
    low: np.ndarray
    high: np.ndarray
    prior: np.ndarray
    episodes: np.ndarray


def linear_effects(setting: Setting, known: Sequence[Effect]) -> tuple[Placed, ...]:
    """Return the effects that can be told from forces, at all their places, with neutral values."""
    effects = [e for e in map(find_effect, LINEAR) if e in known]
    return tuple(
        Placed(e, t, tuple(q.neutral for q in e.quantities(setting, t))) for e in effects for t in e.targets(setting)
    )


def terms(setting: Setting, parts: Sequence[Stretch], placed: Sequence[Placed]) -> Terms:
    """Return the missing forces of a log and their columns.

    Args:
        setting: the model as it is.
        parts: the motion.
        placed: of :func:`linear_effects`.
    """
    quantities = [q for p in placed for q in p.effect.quantities(setting, p.target)]
    owner = np.repeat(np.arange(len(placed)), [len(p.values) for p in placed])
    names = np.array([p.effect.name for p in placed])[owner]
    neutral, low, high, scale = np.array([(q.neutral, q.low, q.high, q.scale) for q in quantities]).T
    missing, columns = [], []
    for part in parts:
        missing.append(part.compared(part.force - needed(setting.model, part)))
        columns.append(np.stack([part.compared(c) for p in placed for c in columns_of(setting, part, p)]))
    return Terms(
        tuple(placed), np.concatenate(missing), np.concatenate(columns, 1), owner, low - neutral, high - neutral,
        np.where(names == CENTER, scale, np.inf), np.repeat(np.arange(len(parts)), [len(m) for m in missing]),
    )  # fmt: skip


def needed(model: mujoco.MjModel, part: Stretch) -> np.ndarray:
    """Return the joint forces that a motion needs in a model that touches nothing, ``(N, nv)``."""
    free = copy.copy(model)
    free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    data, found = mujoco.MjData(free), np.empty(part.velocity.shape)
    for row in range(len(found)):
        data.qpos[:], data.qvel[:] = part.position[row], part.velocity[row]
        data.qacc[:] = part.acceleration[row]
        mujoco.mj_inverse(free, data)
        found[row] = data.qfrc_inverse
    return found


def columns_of(setting: Setting, part: Stretch, placed: Placed) -> list[np.ndarray]:
    """Return the forces ``(N, nv)`` that a unit of each of an effect's numbers needs, from its values on."""
    model, zero = setting.model, np.zeros(part.velocity.shape)
    if placed.effect.name == FRICTION:
        return [_against(setting, part, placed.target, AT_REST)]
    if placed.effect.name == OFFSET:  # a force that is there and not logged: so much less is missing
        actuator = object_number(model, "actuator", placed.target)
        joint = driven_joint(model, actuator)
        assert joint is not None
        zero[:, model.jnt_dofadr[joint]] = -model.actuator_gear[actuator, 0]
        return [zero]
    return [_slope(setting, part, placed, i) for i in range(len(placed.values))]


def sharp(setting: Setting, parts: Sequence[Stretch], joint: str | None, at_rest: float) -> np.ndarray:
    """Return the forces ``(N, nv)`` that a unit of friction needs which falls below a share of the joint's speed."""
    return np.concatenate([part.compared(_against(setting, part, joint, at_rest)) for part in parts])


def _against(setting: Setting, part: Stretch, joint: str | None, at_rest: float) -> np.ndarray:
    """Forces ``(N, nv)`` that a unit of dry friction needs."""
    found, dof = np.zeros(part.velocity.shape), setting.dof(joint)
    found[:, dof] = np.tanh(part.velocity[:, dof] / (at_rest * max(float(setting.signals.speed[dof]), 1e-12)))
    return found


def _slope(setting: Setting, part: Stretch, placed: Placed, number: int) -> np.ndarray:
    """Forces ``(N, nv)`` that a unit of one of an effect's numbers needs, by a difference within its bounds."""
    quantity = placed.effect.quantities(setting, placed.target)[number]
    steps = STEP * quantity.scale * np.array([-1.0, 1.0])
    ends = np.clip(placed.values[number] + steps, quantity.low, quantity.high)
    found = []
    for end in ends:
        values, moved = np.array(placed.values), copy.copy(setting.model)
        values[number] = end
        placed.effect.apply(moved, placed.target, values)
        found.append(needed(moved, part))
    return (found[1] - found[0]) / (ends[1] - ends[0])
