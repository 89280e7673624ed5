"""What moves a model besides its state and its controls: filters of actuators, and bodies whose pose is prescribed.

A first-order filter's activation follows from the controls so far, so that it is found by replaying them. The pose of
a mocap body is an input of every step, and stands in the log beside the controls. Whatever else a model remembers is
in no log, and is refused by name.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import mujoco
import numpy as np

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace

#: Share of its start that a filter may still remember when it counts as forgotten.
FORGOTTEN = 1e-9
#: Columns of a mocap body's pose: position, and quaternion (w, x, y, z).
POSE = 7


@dataclass(frozen=True)
class Filters:
    """The first-order filters of a model's actuators, F of them.

    Attributes:
        actuators: their actuators, ``(F,)``.
        activations: where their activation is, ``(F,)``.
        controls: the control that each follows, ``(F,)``.
        exact: which decay exactly, and not by an Euler step, ``(F,)`` bool.
        ranges: lowest and highest activation, ``(2, F)``.
    """

    actuators: np.ndarray
    activations: np.ndarray
    controls: np.ndarray
    exact: np.ndarray
    ranges: np.ndarray

    def __len__(self) -> int:
        """Return the number of filters F."""
        return len(self.actuators)

    def clipped(self, model: mujoco.MjModel, controls: np.ndarray) -> np.ndarray:
        """Return of controls ``(..., nu)`` what the filters follow, ``(..., F)``."""
        return np.clip(controls[..., : model.nu], *control_range(model))[..., self.controls]

    def settled(self, model: mujoco.MjModel, control: np.ndarray) -> np.ndarray:
        """Return the activations ``(..., F)`` of filters that have long followed a control ``(..., nu)``."""
        return np.clip(self.clipped(model, control), *self.ranges)

    def replayed(self, model: mujoco.MjModel, controls: np.ndarray, skip: int, constants: np.ndarray) -> np.ndarray:
        """Return the activations after controls, of filters that had settled at the first of them, ``(R, F)``.

        Args:
            model: the model; its time step counts.
            controls: held for ``skip`` physics steps each, ``(R, H, nu)``; H of 1 or more.
            skip: physics steps of a control.
            constants: time constants, ``(F,)`` or ``(R, F)``.
        """
        wanted, decay = self.clipped(model, controls), self.decay(model, constants) ** skip
        activation = np.clip(wanted[:, 0], *self.ranges)
        for step in range(wanted.shape[1]):
            moved = wanted[:, step] + (activation - wanted[:, step]) * decay
            activation = np.clip(moved, *self.ranges)
        return activation

    def decay(self, model: mujoco.MjModel, constants: np.ndarray) -> np.ndarray:
        """Return the share of an activation's distance to its control that a physics step leaves, as MuJoCo has it."""
        x = float(model.opt.timestep) / np.maximum(constants, mujoco.mjMINVAL)
        stages = 1 - x / 2 + x**2 / 6 - x**3 / 24  # Runge-Kutta's mean rate, relative to that at the step's start
        rate = stages if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 1.0
        return 1 - rate * np.where(self.exact, -np.expm1(-x), x)

    def memory(self, model: mujoco.MjModel, constants: np.ndarray) -> int:
        """Return the physics steps after which filters with time constants ``(..., F)`` have forgotten their start.

        Raises:
            InputError: a time constant that is too short for the model's step.
        """
        if not len(self):
            return 0
        decay = np.abs(self.decay(model, constants))
        if (decay >= 1).any():
            raise InputError(
                f"model: a filter's time constant of {np.min(constants):g} s is unstable with steps of "
                f"{model.opt.timestep:g} s; use dyntype filterexact"
            )
        return max(1, math.ceil(math.log(FORGOTTEN) / math.log(max(float(decay.max()), 1e-3))))


def filters_of(model: mujoco.MjModel) -> Filters:
    """Return the first-order filters of a model's actuators.

    Raises:
        InputError: actuators that remember otherwise, by name: integrators, muscles, motors with a current, delays.
    """
    found, hidden, kinds = [], [], mujoco.mjtDyn
    for i in range(model.nactuator):
        kind = int(model.actuator_dyntype[i])  # a numpy integer equals no enum on the left
        if kind in (kinds.mjDYN_FILTER, kinds.mjDYN_FILTEREXACT) and model.actuator_delay[i] == 0:
            limits = model.actuator_actrange[i] if model.actuator_actlimited[i] else (-np.inf, np.inf)
            places = int(model.actuator_actadr[i]), int(model.actuator_ctrladr[i])
            found.append((i, *places, kind == kinds.mjDYN_FILTEREXACT, *limits))
        elif model.actuator_actnum[i] > 0 or model.actuator_delay[i] > 0:
            hidden.append(model.actuator(i).name or f"actuator{i}")
    if hidden:
        raise InputError(
            f"model: actuators {', '.join(hidden)} keep a hidden state (integrator, muscle or delay) which a log of "
            "positions and velocities does not hold; model them as motors, servos or first-order filters"
        )
    table = np.array(found).reshape(-1, 6).T
    actuators, activations, controls = table[:3].astype(int)
    return Filters(actuators, activations, controls, table[3].astype(bool), table[4:])


def filter_memory(space: ParameterSpace) -> int:
    """Return the physics steps that the filters of a space's model remember, at whatever values within its bounds."""
    model, found = space.model, 0
    if model is not None and (filters := filters_of(model)):
        for vector in (space.nominal, space.low, space.high):
            own = copy.copy(model)
            space.write_into(own, np.where(np.isfinite(vector), vector, space.high))
            found = max(found, filters.memory(own, own.actuator_dynprm[filters.actuators, 0]))
    return found


def filters_known(memory: int, frame_skip: int, lengths: np.ndarray) -> np.ndarray:
    """Return the logged steps of each episode after which filters have forgotten what was before it, ``(E,)``.

    At most half of an episode: nothing would be left of short ones.

    Args:
        memory: physics steps that the filters remember; see :func:`filter_memory`.
        frame_skip: physics steps of a logged one.
        lengths: logged steps of the episodes, ``(E,)``.
    """
    return np.minimum(math.ceil(memory / frame_skip), lengths // 2)


def control_range(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest control that acts, ``(nu,)`` each."""
    clamps = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    limited = model.actuator_ctrllimited.astype(bool) & clamps
    low, high = model.actuator_ctrlrange.T
    return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)


def prescribed_bodies(model: mujoco.MjModel) -> list[int]:
    """Return the mocap bodies that act on the rest: by a joint below, a constraint, or something to be touched."""
    above = np.full(model.nbody, -1)  # the mocap body that carries a body
    for body in range(1, model.nbody):
        above[body] = body if model.body_mocapid[body] >= 0 else above[model.body_parentid[body]]
    acting = set(above[(model.body_jntnum > 0)])
    acting |= set(above[model.geom_bodyid[(model.geom_contype != 0) | (model.geom_conaffinity != 0)]])
    for kind, *ends in zip(model.eq_objtype, model.eq_obj1id, model.eq_obj2id, strict=True):
        bodies = {
            int(mujoco.mjtObj.mjOBJ_BODY): np.arange(model.nbody),
            int(mujoco.mjtObj.mjOBJ_SITE): model.site_bodyid,
        }
        if int(kind) in bodies:
            acting |= {above[bodies[int(kind)][end]] for end in ends if end >= 0}
    return sorted(int(b) for b in acting - {-1})


def refuse_prescribed(model: mujoco.MjModel, where: str) -> None:
    """Raise an :class:`InputError` for a model with :func:`prescribed_bodies`, where effects are to be added to it."""
    if prescribed_bodies(model):
        raise InputError(f"{where}: mocap bodies ({prescribed_names(model)}) cannot be had together with effects")


def prescribed_names(model: mujoco.MjModel) -> str:
    """Return the names of :func:`prescribed_bodies`, for messages."""
    return ", ".join(model.body(b).name or f"body{b}" for b in prescribed_bodies(model))
