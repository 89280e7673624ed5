"""How the base of a robot moves that no column of a log places: by the feet that stand on the ground.

Leg odometry: a foot that stands does not move, so that orientation, joints and their velocities tell how the base does.
One linear smoother over an episode holds the place and velocity of the base and the places of all feet. An
accelerometer says how the velocity changes. Which feet stand follows from how they move and how high they are (Bloesch
et al., "State estimation for legged robots", 2012, there as a filter).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from dropo_torch.data.observation import joint_name
from dropo_torch.errors import InputError
from dropo_torch.shooting.chain import Chain
from dropo_torch.support.rows import evenly

#: Height above the lowest foot up to which others may stand, in m, and share of the rows in which a foot does.
NEAR, OFTEN = 0.01, 0.01
#: Height, in m, and speed, in m/s, from which on a foot rather does not stand; rows over which its speed is averaged.
LIFTED, MOVING, SPAN = 0.004, 0.15, 5
#: Times that the feet that stand are found anew.
ROUNDS = 5
#: Standard deviations: of a foot's place about the base, m; of its height, m; of its speed along the ground and
#: across it while it stands, and of it in the air, m/s.
PLACED, HEIGHT, SLIDING, SINKING, FLYING = 2e-4, 1e-3, 0.02, 0.1, 3.0
#: Standard deviation of accelerations, m/s²: the least of what an accelerometer misses between rows, and without one.
LEAST, UNKNOWN = 1.0, 5.0
#: Standard errors of velocities, m/s, and of heights, m, from which on the log does not tell them.
UNTOLD_SPEED, UNTOLD_HEIGHT = 0.1, 0.01
#: Time after which feet have sunk into the ground as far as they do, s, and windows that show how far.
SUNK, WINDOWS = 0.06, 40


@dataclass(frozen=True)
class Base:
    """A body that floats, the ground, and what of the robot touches it.

    Attributes:
        model: the model.
        joint: the free joint.
        plane: the ground's geom.
    """

    model: mujoco.MjModel
    joint: int
    plane: int

    @property
    def name(self) -> str:
        """The body's name, or the joint's where it has none."""
        return str(self.model.body(int(self.model.jnt_bodyid[self.joint])).name) or joint_name(self.model, self.joint)

    @property
    def place(self) -> slice:
        """Its place in qpos."""
        first = int(self.model.jnt_qposadr[self.joint])
        return slice(first, first + 3)

    @property
    def turn(self) -> slice:
        """Its orientation in qpos."""
        return slice(self.place.stop, self.place.stop + 4)

    @property
    def speed(self) -> slice:
        """Its linear velocity in qvel."""
        first = int(self.model.jnt_dofadr[self.joint])
        return slice(first, first + 3)

    @property
    def rate(self) -> slice:
        """Its angular velocity in qvel."""
        return slice(self.speed.stop, self.speed.stop + 3)

    @property
    def columns(self) -> list[int]:
        """Place and linear velocity as columns of ``[qpos, qvel]``."""
        place, speed, nq = self.place, self.speed, int(self.model.nq)
        return [*range(place.start, place.stop), *range(nq + speed.start, nq + speed.stop)]

    def sensors(self, kind: mujoco.mjtSensor) -> list[int]:
        """Return the sensors of a kind that sit on the base, and are relative to nothing."""
        found = np.flatnonzero(self.model.sensor_type == int(kind))
        return [int(i) for i in found if self.model.sensor_refid[i] < 0 and self.seat(int(i)) is not None]

    def seat(self, sensor: int) -> Rotation | None:
        """Return how the site, or the body, of a sensor is turned in the base; ``None`` where it is elsewhere."""
        model, own = self.model, int(self.model.jnt_bodyid[self.joint])
        number, kind = int(model.sensor_objid[sensor]), int(model.sensor_objtype[sensor])
        if kind not in (int(mujoco.mjtObj.mjOBJ_SITE), int(mujoco.mjtObj.mjOBJ_XBODY)):
            return None
        is_site = kind == mujoco.mjtObj.mjOBJ_SITE
        if model.body_weldid[model.site_bodyid[number] if is_site else number] != model.body_weldid[own]:
            return None
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        there = np.reshape(data.site_xmat[number] if is_site else data.xmat[number], (3, 3))
        return Rotation.from_matrix(np.reshape(data.xmat[own], (3, 3)).T @ there)

    @cached_property
    def axes(self) -> np.ndarray:
        """The ground's axes, its normal last, as columns in the world, ``(3, 3)``."""
        data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, data)
        return np.array(data.geom_xmat[self.plane]).reshape(3, 3)

    @cached_property
    def level(self) -> float:
        """Where the ground is along its normal."""
        data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, data)
        return float(data.geom_xpos[self.plane] @ self.axes[:, 2])

    @cached_property
    def feet(self) -> tuple[int, ...]:
        """Geoms of the robot that may touch the ground."""
        model, root = self.model, int(self.model.jnt_bodyid[self.joint])
        own = [g for g in range(model.ngeom) if int(model.body_rootid[model.geom_bodyid[g]]) == root]
        return tuple(g for g in own if _collide(model, g, self.plane))


def find_base(model: mujoco.MjModel) -> Base | None:
    """Return the one free body of a model that stands on a plane; ``None`` where there is none, or several are."""
    planes = [
        g for g in range(model.ngeom)
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE and model.body_weldid[model.geom_bodyid[g]] == 0
    ]  # fmt: skip
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    up = -np.asarray(model.opt.gravity)
    if len(free) != 1 or not planes or not up.any():
        return None
    bases = [Base(model, int(free[0]), plane) for plane in planes]
    base = max(bases, key=lambda b: float(b.axes[:, 2] @ up))
    return base if base.feet and float(base.axes[:, 2] @ up) > 0 else None


def _collide(model: mujoco.MjModel, a: int, b: int) -> bool:
    """Whether two geoms are tested for contact."""
    paired = any({int(model.pair_geom1[p]), int(model.pair_geom2[p])} == {a, b} for p in range(model.npair))
    first, second = (int(model.geom_contype[g]) for g in (a, b))
    return paired or bool(first & int(model.geom_conaffinity[b]) or second & int(model.geom_conaffinity[a]))


@dataclass(frozen=True)
class Motion:
    """How a base moves over an episode.

    Attributes:
        places: in the world, ``(T, 3)``; along the ground, from where the model has it.
        velocities: ``(T, 3)``.
        height_error: standard error of the height, m.
        speed_error: standard errors of the velocities, ``(3,)``.
    """

    places: np.ndarray
    velocities: np.ndarray
    height_error: float
    speed_error: np.ndarray


def base_motion(
    base: Base, positions: np.ndarray, velocities: np.ndarray, dt: float, *, accelerations: np.ndarray | None,
    site: int = -1,
) -> Motion:  # fmt: skip
    """Return how a base moves, of which the log shows the orientation, the joints, and how they turn.

    Args:
        base: the base.
        positions: of an episode, ``(T, nq)``; the base's place does not matter.
        velocities: of it, ``(T, nv)``; the base's linear ones do not matter.
        dt: seconds between rows.
        accelerations: what an accelerometer shows, ``(T, 3)``, or ``None``.
        site: where that is.

    Raises:
        InputError: feet that hardly stand.
    """
    calm = smoothed(base, positions, velocities, dt)
    legs = _legs(base, calm, velocities, site)
    told, error = _pulls(base, calm, accelerations, site)
    smoother = _Smoother(legs, told @ base.axes, error, dt, base.level)
    stands = np.exp(-(((legs.heights - legs.heights.min(1, keepdims=True)) / LIFTED) ** 2))
    for _ in range(ROUNDS):
        state, chain = smoother.solved(stands)
        stands = smoother.standing(state)
    height, speed = smoother.errors(chain)
    if speed.max() > UNTOLD_SPEED or height > UNTOLD_HEIGHT:
        raise InputError(
            f"observation: where {base.name} is, is not in the log, and its feet stand too rarely to tell: its speed "
            f"to {speed.max():.2g} m/s and its height to {1e3 * height:.2g} mm; log its position, such as by motion "
            "capture"
        )
    places, moving = smoother.motion(state)
    places, moving = places @ base.axes.T, moving @ base.axes.T
    along = base.axes[:, :2]
    start = base.model.qpos0[base.place]
    places += along @ (along.T @ (start - places[0]))
    return Motion(places, moving, height, np.sqrt((base.axes**2) @ speed**2))


@dataclass(frozen=True)
class _Legs:
    """The feet about the base, in the ground's axes.

    Attributes:
        seat: of the site from the base, ``(T, 3)``.
        centers: of F feet from the base, ``(T, F, 3)``.
        heights: of their lowest points, ``(T, F)``.
        rolling: by which a foot's center moves that does not slide, m/s, ``(T, F, 3)``.
    """

    seat: np.ndarray
    centers: np.ndarray
    heights: np.ndarray
    rolling: np.ndarray


def _legs(base: Base, positions: np.ndarray, velocities: np.ndarray, site: int) -> _Legs:
    """The feet that are ever near the ground."""
    model, data, feet = base.model, mujoco.MjData(base.model), base.feet
    lift = 10 * float(model.stat.extent) * base.axes[:, 2]
    seat, centers = np.zeros((len(positions), 3)), np.empty((len(positions), len(feet), 3))
    points, turning = np.empty_like(centers), np.empty_like(centers)
    velocity, between, geom = np.empty(6), np.empty(6), int(mujoco.mjtObj.mjOBJ_GEOM)
    for t, (position, rate) in enumerate(zip(positions, velocities, strict=True)):
        data.qpos[:], data.qvel[:] = position, rate
        data.qpos[base.place] = lift
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        if site >= 0:
            seat[t] = data.site_xpos[site] - lift
        for i, foot in enumerate(feet):
            mujoco.mj_geomDistance(model, data, foot, base.plane, 1e3 * float(model.stat.extent), between)
            mujoco.mj_objectVelocity(model, data, geom, foot, velocity, 0)
            centers[t, i], points[t, i], turning[t, i] = data.geom_xpos[foot] - lift, between[:3] - lift, velocity[:3]
    rolling = np.cross(turning, centers - points)
    heights = points @ base.axes[:, 2]
    often = (heights - heights.min(1, keepdims=True) < NEAR).mean(0) > OFTEN
    return _Legs(
        seat @ base.axes, centers[:, often] @ base.axes, heights[:, often], rolling[:, often] @ base.axes
    )  # fmt: skip


def _pulls(base: Base, positions: np.ndarray, shown: np.ndarray | None, site: int) -> tuple[np.ndarray, float]:
    """Accelerations in the world as an accelerometer shows them, ``(T, 3)``, and their standard deviation."""
    if shown is None:
        return np.zeros((len(positions), 3)), UNKNOWN
    model, data, found = base.model, mujoco.MjData(base.model), np.empty_like(shown)
    for t, (position, own) in enumerate(zip(positions, shown, strict=True)):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        found[t] = data.site_xmat[site].reshape(3, 3) @ own
    between = np.diff(shown, 2, axis=0) / np.sqrt(6)  # noise, and what changes within a row, such as in impacts
    return found + model.opt.gravity, max(LEAST, float(np.sqrt(np.mean(between**2, axis=0)).max()))


class _Smoother:
    """Places and velocities of a site, and of feet, along an episode: 6 + 3 F numbers a row, in the ground's axes."""

    def __init__(self, legs: _Legs, pulls: np.ndarray, error: float, dt: float, level: float) -> None:
        self._legs, self._dt, self._level = legs, dt, level
        self._rows, self._feet = legs.heights.shape
        self._size = 6 + 3 * self._feet
        self._lasting = max(1.0, SUNK / dt)  # rows over which a foot that sinks is off alike
        self._diagonal = np.zeros((self._rows, self._size, self._size))
        self._below, self._force = np.zeros_like(self._diagonal), np.zeros((self._rows, self._size))
        gain, eye, none = 0.5 * (pulls[1:] + pulls[:-1]) * dt, np.eye(3), np.zeros(3)
        place, speed = self._picks(0), self._picks(3)
        every = np.ones((self._rows - 1, 1))
        self._link(-speed, speed, gain, every / (error * dt) ** 2)
        self._link(-place - 0.5 * dt * speed, place - 0.5 * dt * speed, none, every / (error * dt**2) ** 2)
        for i in range(self._feet):
            own = legs.centers[:, i] - legs.seat
            self._own(self._foot(i) - place, own, np.full((self._rows, 3), PLACED**-2.0))
        self._diagonal[0, :3, :3] += 1e-4 * eye

    def _picks(self, first: int) -> np.ndarray:
        """Three numbers of a row's state, as a matrix, ``(3, s)``."""
        return np.eye(self._size)[first : first + 3]

    def _foot(self, i: int) -> np.ndarray:
        return self._picks(6 + 3 * i)

    def _link(self, before: np.ndarray, after: np.ndarray, value: np.ndarray, weight: np.ndarray) -> None:
        """Add squares of ``before x[t-1] + after x[t] - value``, weights ``(T - 1, 3)``."""
        weight = np.broadcast_to(weight, (self._rows - 1, 3))
        self._diagonal[:-1] += np.einsum("ka,tk,kb->tab", before, weight, before)
        self._diagonal[1:] += np.einsum("ka,tk,kb->tab", after, weight, after)
        self._below[1:] += np.einsum("ka,tk,kb->tab", after, weight, before)
        self._force[:-1] += (weight * value) @ before
        self._force[1:] += (weight * value) @ after

    def _own(self, at: np.ndarray, value: np.ndarray, weight: np.ndarray) -> None:
        """Add squares of ``at x[t] - value``, weights ``(T, k)``."""
        self._diagonal += np.einsum("ka,tk,kb->tab", at, weight, at)
        self._force += (weight * value) @ at

    def solved(self, stands: np.ndarray) -> tuple[np.ndarray, Chain]:
        """Return the states ``(T, s)`` and their normal matrix where feet stand by so much, ``(T, F)``, each 0 to 1."""
        kept = self._diagonal.copy(), self._below.copy(), self._force.copy()
        legs, dt = self._legs, self._dt
        still = np.array([SLIDING, SLIDING, SINKING * self._lasting**0.5])
        for i in range(self._feet):
            both = (stands[1:, i] * stands[:-1, i])[:, None]
            weight = both / (still * dt) ** 2 + (1 - both) / (FLYING * dt) ** 2
            self._link(-self._foot(i), self._foot(i), 0.5 * dt * (legs.rolling[1:, i] + legs.rolling[:-1, i]), weight)
            height = legs.centers[:, i, 2] - legs.heights[:, i] + self._level
            self._own(self._foot(i)[2:], height[:, None], stands[:, i, None] / (self._lasting * HEIGHT**2))
        chain = Chain.of(self._diagonal, self._below)
        state = chain.solve(self._force[..., None])[..., 0]
        self._diagonal, self._below, self._force = kept
        return state, chain

    def standing(self, state: np.ndarray) -> np.ndarray:
        """Return by how much each foot stands, ``(T, F)``, by its height and speed."""
        legs, (places, _) = self._legs, self.motion(state)
        moves = np.gradient(places[:, None] + legs.centers, self._dt, axis=0) - legs.rolling
        kernel, half = np.ones(SPAN) / SPAN, SPAN // 2
        padded = np.pad(moves, ((half, half), (0, 0), (0, 0)), mode="edge")
        calm = np.apply_along_axis(lambda own: np.convolve(own, kernel, "valid"), 0, padded)
        height = places[:, 2:] + legs.heights - self._level
        off = (calm**2).sum(-1) / MOVING**2 + np.maximum(height, 0) ** 2 / LIFTED**2
        return np.asarray(1 / (1 + off) ** 2)

    def motion(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the base's places and velocities, ``(T, 3)`` each."""
        seat = self._legs.seat
        return state[:, :3] - seat, state[:, 3:6] - np.gradient(seat, self._dt, axis=0)

    def errors(self, chain: Chain) -> tuple[float, np.ndarray]:
        """Return typical standard errors of the height, and of the velocities, ``(3,)``."""
        own, _ = chain.covariances()
        error = np.sqrt(np.maximum(np.diagonal(own, axis1=1, axis2=2), 0.0))
        size = np.sqrt(np.mean(error**2, axis=0))
        return float(size[2]), size[3:6]


def smoothed(base: Base, positions: np.ndarray, velocities: np.ndarray, dt: float) -> np.ndarray:
    """Return positions ``(T, nq)`` with joints and orientation as their own rows and all velocities say together.

    A gyroscope tells changes over a few rows far better than the orientations do.
    """
    model, found = base.model, positions.copy()
    for kind, first, dof in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            found[:, first] = _fused(positions[:, first], velocities[:, dof], dt)
    rate, measured = velocities[:, base.rate], Rotation.from_quat(positions[:, base.turn], scalar_first=True)
    turned = [measured[0]]
    for step in 0.5 * dt * (rate[1:] + rate[:-1]):
        turned.append(turned[-1] * Rotation.from_rotvec(step))
    turns = Rotation.concatenate(turned)
    off = (measured * turns.inv()).as_rotvec()
    still, error = np.zeros(len(off)), float(noise_of(rate).max())
    off = np.stack([_fused(o, still, dt, error) for o in off.T], axis=1)
    found[:, base.turn] = (Rotation.from_rotvec(off) * turns).as_quat(scalar_first=True)
    return found


def _fused(values: np.ndarray, rates: np.ndarray, dt: float, error: float | None = None) -> np.ndarray:
    """Values ``(T,)`` as they and their rates say together, each as sure as its noise allows."""
    size = max(float(np.ptp(values)), 1e-9)
    own = max(float(noise_of(values)), 1e-6 * size)
    of_rate = max(float(noise_of(rates)) if error is None else error, 1e-6 * size / dt)
    moved, weight, each = 0.5 * dt * (rates[1:] + rates[:-1]), (of_rate * dt) ** -2.0, own**-2.0
    bands = np.zeros((2, len(values)))
    bands[1] = each
    bands[1, :-1] += weight
    bands[1, 1:] += weight
    bands[0, 1:] = -weight
    right = each * values
    right[:-1] -= weight * moved
    right[1:] += weight * moved
    return np.asarray(solveh_banded(bands, right))


def noise_of(values: np.ndarray) -> np.ndarray:
    """Return the noise that fourth differences of values ``(T, ...)`` show, ``(...)``."""
    return scale_of(np.diff(values, 4, axis=0)) if len(values) > 4 else np.zeros(values.shape[1:])


def scale_of(fourth: np.ndarray) -> np.ndarray:
    """Return the noise that fourth differences ``(N, ...)`` show, ``(...)``."""
    return np.asarray(1.4826 * np.median(np.abs(fourth), 0) / np.sqrt(70))


def sinking(base: Base, positions: np.ndarray, velocities: np.ndarray, commands: np.ndarray, dt: float) -> float:
    """Return by how much the lowest foot is below the ground while the model stands, m, 0 where it never does.

    Args:
        base: the base.
        positions, velocities: of an episode, ``(T, nq)`` and ``(T, nv)``.
        commands: that act from each row on, ``(T - 1, nu)``.
        dt: seconds between rows.
    """
    model, data = base.model, mujoco.MjData(base.model)
    rows, steps = max(1, round(SUNK / dt)), max(1, round(dt / float(model.opt.timestep)))
    found, between = [], np.empty(6)
    for start in evenly(max(len(commands) - rows, 0), WINDOWS):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = positions[start], velocities[start]
        for row in range(start, start + rows):
            data.ctrl[:] = commands[row, : model.nu]
            mujoco.mj_step(model, data, nstep=steps)
        mujoco.mj_kinematics(model, data)
        far = 1e3 * float(model.stat.extent)
        lowest = min(mujoco.mj_geomDistance(model, data, foot, base.plane, far, between) for foot in base.feet)
        if np.isfinite(lowest) and lowest < 0:
            found.append(-lowest)
    return float(np.median(found)) if found else 0.0
