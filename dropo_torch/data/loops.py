"""Positions that no column shows, where a model's equality constraints determine them: closed loops, coupled joints.

A five-bar linkage has four joints and two encoders, a gripper one motor for two fingers. Where the log shows the other
joints, those that the constraints leave no choice are found by closing the loops: with c(q) = 0 the constraints and
J = ∂c/∂q, the dependent positions by Gauss–Newton steps -J_d⁺ c, their velocities by q̇_d = -J_d⁺ J_o q̇_o.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from dropo_torch.errors import InputError

#: By how much positions move at most from one closed state to the next, in radians or meters, so that a loop keeps its
#: way of bending; and into how many such moves a longer way is divided at most.
MOVE, MOVES = 0.05, 400
#: Gauss–Newton steps at most, the change below which they end, and the largest change of one of them.
STEPS, TOLERANCE, LARGEST = 30, 1e-11, 0.2
#: Share of a unit motion below which a joint is taken not to move while the others stand still.
STILL = 1e-6
#: What a loop may lack to be closed: as a share of the model's extent, and radians between coupled joints.
OPEN, APART = 0.01, 0.05
#: By how much a dependent joint moves at most where an observed one moves by one: beyond, it says little of it.
SINGULAR = 30.0
#: The change of a last step above which Gauss–Newton has not come to an end, as beside a pose that cannot be.
UNSETTLED = 1e-6


@dataclass(frozen=True, eq=False)
class Loops:
    """Hinges and slides that are not observed and that equality constraints determine from those that are.

    Attributes:
        model: the model, with equality constraints alone.
        joints: the dependent joints.
    """

    model: mujoco.MjModel
    joints: tuple[int, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the dependent joints."""
        return tuple(self.model.joint(j).name or f"joint{j}" for j in self.joints)

    @cached_property
    def positions(self) -> np.ndarray:
        """Their columns in the state ``[qpos, qvel]``, ``(k,)``."""
        return self.model.jnt_qposadr[list(self.joints)]

    @cached_property
    def velocities(self) -> np.ndarray:
        """The columns of their velocities, ``(k,)``."""
        return self.model.nq + self.dofs

    @cached_property
    def dofs(self) -> np.ndarray:
        """Their degrees of freedom, ``(k,)``."""
        return self.model.jnt_dofadr[list(self.joints)]

    def closed(self, states: np.ndarray, *, near: bool) -> np.ndarray:
        """Return states ``(T, nq + nv)`` in which the dependent joints are where they close the loops.

        Args:
            states: observed joints as they are.
            near: whether dependent positions are near the right ones. Otherwise each state is reached from the one
                before, and the first from the model's reference, in small moves.
        """
        states, data, nq = states.copy(), mujoco.MjData(self.model), self.model.nq
        before = self.model.qpos0.copy()
        for state in states:
            if not near:
                state[self.positions] = before[self.positions]
                for share in self._shares(before, state[:nq])[:-1]:
                    between = before + share * (state[:nq] - before)
                    between[self.positions] = state[self.positions]
                    mujoco.mj_normalizeQuat(self.model, between)
                    state[self.positions] = self._close(data, between)[self.positions]
            state[:nq] = before = self._close(data, state[:nq])
            state[self.velocities] = 0.0
            state[self.velocities] = self._solve(data, _jacobian(self.model, data) @ state[nq:])
        return states

    def check(self, states: np.ndarray, source: str) -> None:
        """Refuse states ``(T, nq + nv)`` whose loops stay open, or in which observed joints do not say how they close.

        Raises:
            InputError: the row, and what is wrong there.
        """
        data, extent = mujoco.MjData(self.model), float(self.model.stat.extent)
        others = np.delete(np.arange(self.model.nv), self.dofs)
        for row, state in enumerate(states):
            _place(self.model, data, state[: self.model.nq])
            most = np.where(np.isin(data.efc_id[: data.ne], self._connected), OPEN * extent, APART)
            left = np.abs(data.efc_pos[: data.ne])
            worst = int((left / most).argmax())
            where = f"{source}: row {row}: the model's equality constraint {self._called(int(data.efc_id[worst]))}"
            if left[worst] > most[worst]:
                raise InputError(
                    f"{where} cannot be met by {', '.join(self.names)}, which no column shows: with the other joints "
                    f"as logged it is off by {left[worst]:.3g}; check their units, signs and offsets"
                )
            jacobian = _jacobian(self.model, data)
            follows = np.linalg.lstsq(jacobian[:, self.dofs], jacobian[:, others], rcond=None)[0]
            unsettled = np.abs(self._solve(data, data.efc_pos[: data.ne])).max() > UNSETTLED
            if unsettled or np.abs(follows).max(initial=0.0) > SINGULAR:
                raise InputError(
                    f"{where} is near a singular pose, in which the other joints do not tell {', '.join(self.names)}: "
                    "log them, or leave out rows near it"
                )

    def _called(self, constraint: int) -> str:
        return str(self.model.equality(constraint).name) or str(constraint)

    @cached_property
    def _connected(self) -> np.ndarray:
        """Constraints between bodies, of which residuals are lengths."""
        kinds = [int(k) for k in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)]
        return np.flatnonzero(np.isin(self.model.eq_type, kinds))

    def _shares(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        count = int(np.clip(np.ceil(np.abs(after - before).max() / MOVE), 1, MOVES))
        return np.arange(1, count + 1) / count

    def _close(self, data: mujoco.MjData, qpos: np.ndarray) -> np.ndarray:
        """Return positions with the dependent ones where constraints are met best; ``data`` stands there."""
        qpos = qpos.copy()
        for _ in range(STEPS):
            _place(self.model, data, qpos)
            change = self._solve(data, data.efc_pos[: data.ne])
            qpos[self.positions] += change * min(1.0, LARGEST / max(np.abs(change).max(), LARGEST))
            if np.abs(change).max() < TOLERANCE:
                break
        return qpos

    def _solve(self, data: mujoco.MjData, residual: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(_jacobian(self.model, data)[:, self.dofs], -residual, rcond=1e-9)[0]


def find_loops(model: mujoco.MjModel, observed: Sequence[int]) -> Loops | None:
    """Return the joints that a model's equality constraints determine from the observed columns; ``None`` for none.

    Args:
        model: the simulated model.
        observed: columns of the state ``[qpos, qvel]`` that are observed.
    """
    if model.neq == 0 or not model.eq_active0.any():
        return None
    seen, kinds = set(observed), (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    blind = [
        j for j in range(model.njnt)
        if int(model.jnt_type[j]) in kinds
        and seen.isdisjoint((int(model.jnt_qposadr[j]), model.nq + int(model.jnt_dofadr[j])))
    ]  # fmt: skip
    if not blind:
        return None
    alone = _constraints_alone(model)
    dofs = alone.jnt_dofadr[blind]
    jacobian = _slopes(alone)[:, dofs]
    moves = np.abs(jacobian).max(0, initial=0.0) > STILL
    _, sizes, axes = np.linalg.svd(jacobian[:, moves])
    rank = int((sizes > STILL * sizes.max(initial=1.0)).sum())
    free = np.abs(axes[rank:]).max(0, initial=0.0) > STILL
    joints = tuple(int(j) for j in np.array(blind)[moves][~free])
    return Loops(alone, joints) if joints else None


def _constraints_alone(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with equality constraints alone, whose Jacobian is dense."""
    alone, flags = copy.copy(model), mujoco.mjtDisableBit
    for flag in (flags.mjDSBL_CONTACT, flags.mjDSBL_LIMIT, flags.mjDSBL_FRICTIONLOSS):
        alone.opt.disableflags |= int(flag)
    alone.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    return alone


def _slopes(model: mujoco.MjModel) -> np.ndarray:
    """The constraints' Jacobian ``(m, nv)`` beside the reference, where it may lose rank by chance."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(0.0, 1e-2, model.nv), 1.0)
    _place(model, data, qpos)
    return _jacobian(model, data)


def _place(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> None:
    """Put a model at positions, with its equality constraints and their Jacobian."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)
    mujoco.mj_makeConstraint(model, data)


def _jacobian(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    return data.efc_J.reshape(-1, model.nv)[: data.ne]
