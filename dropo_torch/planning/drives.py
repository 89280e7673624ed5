"""What moves a robot: its driven joints, and what their actuators are told so that the joints follow a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from dropo_torch.data.observation import joint_name
from dropo_torch.errors import InputError
from dropo_torch.parameters import object_names
from dropo_torch.proposal.places import command_kind
from dropo_torch.simulators.hidden import control_range

#: Natural frequency of the tracking of a path by forces, in rad/s, and its most times a command's duration.
BANDWIDTH, PER_STEP = 15.0, 0.35
#: Share of a command's range, and of a force's, that is used.
USED = 0.98


@dataclass(frozen=True)
class Drive:
    """A joint that actuators move, or an actuator whose command itself is planned.

    Attributes:
        name: of the joint, or of the actuator.
        joint: its number; -1 for an actuator that moves no single hinge or slide.
        position, velocity: its columns in the state; -1 where there is no joint.
        actuators: which ones move it.
        takes: what each of them is told: ``position``, ``velocity``, ``effort``; ``command`` where there is no joint.
        inertia: what a force at the joint accelerates, others left free.
    """

    name: str
    joint: int
    position: int
    velocity: int
    actuators: tuple[int, ...]
    takes: tuple[Literal["position", "velocity", "effort", "command"], ...]
    inertia: float


def drives_of(model: mujoco.MjModel, start: np.ndarray) -> tuple[Drive, ...]:
    """Return what moves a model.

    Args:
        model: the model.
        start: positions and velocities about which inertias are taken, ``(nq + nv,)``.

    Raises:
        InputError: a model without actuators.
    """
    if not model.nu:
        raise InputError("model: it has no actuators, so that no motion can be commanded; add motors or servos")
    inertia = _inertias(model, start)
    names, single = object_names(model, "actuator"), (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    at: dict[int, list[int]] = {}
    found: list[Drive] = []
    for a in range(model.nu):
        by_joint = int(model.actuator_trntype[a]) in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        joint = int(model.actuator_trnid[a, 0]) if by_joint else -1
        if joint >= 0 and int(model.jnt_type[joint]) in single and model.actuator_gear[a, 0] != 0:
            at.setdefault(joint, []).append(a)
        else:
            found.append(Drive(names[a], -1, -1, -1, (a,), ("command",), 1.0))
    for joint, actuators in at.items():
        dof = int(model.jnt_dofadr[joint])
        found.append(Drive(
            joint_name(model, joint), joint, int(model.jnt_qposadr[joint]), model.nq + dof, tuple(actuators),
            tuple(command_kind(model, a) for a in actuators), float(inertia[dof]),
        ))  # fmt: skip
    return tuple(sorted(found, key=lambda d: d.actuators))


def _inertias(model: mujoco.MjModel, start: np.ndarray) -> np.ndarray:
    """What a force at each degree of freedom accelerates where the others are free, ``(nv,)``."""
    data, inverse = mujoco.MjData(model), np.eye(model.nv)
    data.qpos[:] = start[: model.nq]
    mujoco.mj_forward(model, data)
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return np.asarray(1 / np.maximum(np.diag(inverse), 1e-12))


class Tracker:
    """Turns paths of drives into commands.

    Servos are told the path. Where actuators are told forces or velocities, the commands are those by which the model's
    joints follow the path: critically damped, from the simulated state.

    Args:
        model: the model.
        drives: what moves it.
        timestep: seconds of a command.
        force: largest force of each actuator, ``(nu,)``; infinite where there is no limit.
    """

    def __init__(self, model: mujoco.MjModel, drives: Sequence[Drive], timestep: float, force: np.ndarray) -> None:
        self._drives, self._count = drives, model.nu
        self._gear, self._gain = model.actuator_gear[:, 0], model.actuator_gainprm[:, 0]
        low, high = control_range(model)
        efforts = [a for d in drives for a, kind in zip(d.actuators, d.takes, strict=True) if kind == "effort"]
        strong = np.full(model.nu, np.inf)
        strong[efforts] = force[efforts] / np.maximum(np.abs(self._gain[efforts]), 1e-12)
        middle = 0.5 * (np.nan_to_num(low, neginf=0.0) + np.nan_to_num(high, posinf=0.0))
        self._low = np.maximum(middle + USED * (low - middle), -USED * strong)
        self._high = np.minimum(middle + USED * (high - middle), USED * strong)
        self._omega = min(BANDWIDTH, PER_STEP / timestep)

    @property
    def needs_states(self) -> bool:
        """Whether commands depend on the simulated state."""
        return any(kind in ("effort", "velocity") for drive in self._drives for kind in drive.takes)

    def commands(
        self, paths: np.ndarray, rates: np.ndarray, curvatures: np.ndarray, states: np.ndarray | None
    ) -> np.ndarray:
        """Return commands ``(..., nu)``.

        Args:
            paths: of the drives, ``(..., D)``.
            rates, curvatures: their first and second derivatives in time, ``(..., D)`` each.
            states: simulated states at the same time, ``(..., nq + nv)``; ``None`` where they are not needed.
        """
        out, omega = np.zeros((*paths.shape[:-1], self._count)), self._omega
        for d, drive in enumerate(self._drives):
            path, rate = paths[..., d], rates[..., d]
            for a, kind in zip(drive.actuators, drive.takes, strict=True):
                gear = self._gear[a]
                if kind in ("command", "position"):
                    out[..., a] = path * (gear if kind == "position" else 1.0)
                    continue
                assert states is not None
                off, slow = path - states[..., drive.position], rate - states[..., drive.velocity]
                if kind == "velocity":
                    out[..., a] = gear * (rate + 0.5 * omega * off)
                elif kind == "effort" and drive.takes[0] == kind and drive.actuators[0] == a:
                    force = drive.inertia * (curvatures[..., d] + 2 * omega * slow + omega**2 * off)
                    out[..., a] = force / (gear * self._gain[a])
        return np.clip(out, self._low, self._high)
