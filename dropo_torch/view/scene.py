"""A model as simple shapes, the poses of its bodies in some states, and from where to look at them.

A shape is the convex hull of some points of a body, inflated by a radius: spheres are one point, capsules two, boxes
eight. Its outline on a screen is the hull of the projected points, drawn with a round pen, so that a page draws every
geom by the same few lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from dropo_torch.simulators.hidden import POSE, prescribed_bodies
from dropo_torch.support.rows import evenly

#: Points of a circle, of an ellipsoid's circles, and of a mesh.
CIRCLE, RINGS, MESH = 16, 5, 40
#: Groups of geoms that MuJoCo's viewer shows.
GROUPS = 3
#: Thickness of links without geoms, relative to the model's size.
THIN = 0.012
#: States from which the camera's place is found, at most.
SAMPLES = 60
#: Share of the motion's variance across a plane below which the motion is planar.
FLAT = 0.02
#: Elevation of the camera where the motion is not planar, and how far it is turned, in degrees.
ELEVATION, TURN = -18.0, 25.0
#: How far a robot may travel, relative to its own size, before the camera follows it.
TRAVEL = 1.5
#: How far from the logged robot simulated ones are seen, relative to what is seen without them.
REACH = 2.0
#: Lines of a floor, and share of the picture that is left free around the robot.
LINES, MARGIN = 24, 0.12


@dataclass(frozen=True, eq=False)
class Shape:
    """A part of a body: the convex hull of points in the body's frame, ``(P, 3)``, inflated by a radius.

    Attributes:
        body: the body, as a number of the model; 0 is the world.
        points: in the body's frame, ``(P, 3)``.
        radius: of the round pen.
    """

    body: int
    points: np.ndarray
    radius: float = 0.0


@dataclass(frozen=True, eq=False)
class Scene:
    """What of a model is drawn.

    Attributes:
        shapes: of moving and of fixed bodies.
        bodies: the moving bodies, ``(B,)``.
        rods: those of the shapes that are no geoms: they show bodies and joints where geoms do not.
        hidden: whether geoms of the groups that a viewer hides are shown, since no others move.
        walks: whether a body moves freely that carries joints: from straight above, one would not see its legs.
    """

    shapes: tuple[Shape, ...]
    bodies: np.ndarray
    rods: tuple[Shape, ...]
    hidden: bool
    walks: bool = False


@dataclass(frozen=True, eq=False)
class Camera:
    """From where a scene is seen, without perspective.

    Attributes:
        azimuth, elevation: direction of view as MuJoCo has it, in degrees.
        centers: point that is looked at in each frame, ``(F, 3)``.
        width, height: of what must be seen there, in m, in the picture's directions.
    """

    azimuth: float
    elevation: float
    centers: np.ndarray
    width: float
    height: float


def make_scene(model: mujoco.MjModel) -> Scene:
    """Return the shapes of a model's geoms; where none of a moving body is visible, those of its bodies and joints."""
    bodies = moving_bodies(model)
    moves = np.isin(model.geom_bodyid, bodies)
    visible = (model.geom_rgba[:, 3] > 0) & (model.geom_group < GROUPS)
    hidden = not (visible & moves).any() and bool(moves.any())
    if hidden:
        visible = np.ones(model.ngeom, dtype=bool)
    shapes = [Shape(int(model.geom_bodyid[g]), *geom_points(model, g)) for g in np.flatnonzero(visible).tolist()]
    rods = arms(model, shapes) if moves.any() else link_shapes(model, bodies)
    return Scene((*(s for s in shapes if len(s.points)), *rods), bodies, tuple(rods), hidden, _walks(model))


def _walks(model: mujoco.MjModel) -> bool:
    """Whether a body moves freely that carries joints."""
    free = model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)
    carried = model.body_rootid[model.jnt_bodyid[~free]]
    return bool(np.isin(model.body_rootid[model.jnt_bodyid[free]], carried).any())


def moving_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Return the bodies that move: by a joint of their own or above them, or because their pose is prescribed."""
    moves = np.zeros(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        own = model.body_jntnum[body] > 0 or model.body_mocapid[body] >= 0
        moves[body] = own or moves[model.body_parentid[body]]
    return np.flatnonzero(moves)


def geom_points(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Return a geom's points in its body's frame ``(P, 3)`` and its radius; no points for planes and height fields."""
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    kind, radius = int(model.geom_type[geom]), 0.0
    if kind == kinds.mjGEOM_SPHERE:
        points, radius = np.zeros((1, 3)), float(size[0])
    elif kind == kinds.mjGEOM_CAPSULE:
        points, radius = size[1] * np.array([[0, 0, -1.0], [0, 0, 1]]), float(size[0])
    elif kind == kinds.mjGEOM_BOX:
        points = size * _corners()
    elif kind == kinds.mjGEOM_CYLINDER:
        points = np.concatenate([size[[0, 0, 1]] * _ring(1.0, z) for z in (-1.0, 1.0)])
    elif kind == kinds.mjGEOM_ELLIPSOID:
        heights = np.sin(np.linspace(-0.5, 0.5, RINGS + 2) * np.pi)
        points = size * np.concatenate([_ring(np.sqrt(1 - z**2), z) for z in heights])
    elif kind == kinds.mjGEOM_MESH:
        points = mesh_points(model, int(model.geom_dataid[geom]))
    else:
        points = np.zeros((0, 3))
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return points @ rotation.reshape(3, 3).T + model.geom_pos[geom], radius


def mesh_points(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """Return corners of a mesh ``(P, 3)``: of many, those that lie farthest in evenly spread directions."""
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    points = np.asarray(model.mesh_vert[first : first + count], dtype=np.float64)
    if len(points) <= MESH:
        return points
    step = np.pi * (3 - np.sqrt(5)) * np.arange(MESH)
    heights = np.linspace(-1, 1, MESH)
    flat = np.sqrt(1 - heights**2)
    directions = np.stack([flat * np.cos(step), flat * np.sin(step), heights])
    return points[np.unique(np.argmax(points @ directions, axis=0))]


def link_shapes(model: mujoco.MjModel, bodies: np.ndarray) -> list[Shape]:
    """Return shapes of bodies without geoms: links to their children and centers of mass, and joints as balls."""
    radius = THIN * max(float(model.stat.extent), 1e-3)
    found = []
    for body in bodies:
        children = np.flatnonzero(model.body_parentid == body)
        tips = [model.body_pos[c] for c in children if c != body] + [model.body_ipos[body]]
        first = int(model.body_jntadr[body])
        anchor = model.jnt_pos[first] if model.body_jntnum[body] else np.zeros(3)
        found.append(Shape(int(body), anchor[None].copy(), 1.8 * radius))
        found += [
            Shape(int(body), np.stack([anchor, tip]), radius) for tip in tips if np.linalg.norm(tip - anchor) > 1e-9
        ]
    return found


def arms(model: mujoco.MjModel, shapes: Sequence[Shape]) -> list[Shape]:
    """Return thin links from hinges to what they carry where geoms do not reach them, such as a pendulum's bob."""
    radius, found = 0.5 * THIN * max(float(model.stat.extent), 1e-3), []
    for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)):
        body, anchor = int(model.jnt_bodyid[joint]), model.jnt_pos[joint]
        own = [s for s in shapes if s.body == body]
        gap = min((float(np.linalg.norm(s.points - anchor, axis=1).min()) - s.radius for s in own), default=0.0)
        inside = any((s.points.min(0) <= anchor).all() and (anchor <= s.points.max(0)).all() for s in own)
        if gap > radius and not inside:
            found.append(Shape(body, np.stack([anchor, np.mean([s.points.mean(0) for s in own], axis=0)]), radius))
    return found


def poses(model: mujoco.MjModel, scene: Scene, states: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """Return positions and quaternions (w, x, y, z) of the moving bodies, ``(F, B, 7)``, by forward kinematics.

    Args:
        model: the model.
        scene: its moving bodies.
        states: ``(F, nq + nv)``; one with a NaN has poses that are NaN.
        controls: those of the log; poses of mocap bodies stand after the actuators' commands.
    """
    data, out = mujoco.MjData(model), np.full((len(states), len(scene.bodies), POSE), np.nan)
    for frame, (state, control) in enumerate(zip(states, controls, strict=True)):
        if np.isfinite(state).all():
            set_state(model, data, state, control)
            out[frame] = np.concatenate([data.xpos[scene.bodies], data.xquat[scene.bodies]], 1)
    return out


def set_state(model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray, control: np.ndarray) -> None:
    """Put a simulation into a state ``(nq + nv,)``, with the prescribed poses that stand after the commands."""
    data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq : model.nq + model.nv]
    prescribed = np.asarray(control)[model.nu :].reshape(-1, POSE)
    for body, pose in zip(prescribed_bodies(model), prescribed, strict=False):
        data.mocap_pos[model.body_mocapid[body]], data.mocap_quat[model.body_mocapid[body]] = pose[:3], pose[3:]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)


def placed_points(scene: Scene, frames: np.ndarray) -> np.ndarray:
    """Return the points of the moving shapes in the world, ``(F, P, 3)``, with bodies at poses ``(F, B, 7)``."""
    place = {int(body): i for i, body in enumerate(scene.bodies)}
    found = [np.zeros((len(frames), 0, 3))]
    for shape in scene.shapes:
        if shape.body in place:
            pose = frames[:, place[shape.body]]
            found.append(turned(pose[:, None, 3:], shape.points[None]) + pose[:, None, :3])
    return np.concatenate(found, 1)


def turned(quaternions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points ``(..., 3)`` turned by unit quaternions (w, x, y, z), ``(..., 4)``."""
    w, v = quaternions[..., :1], quaternions[..., 1:]
    twice = 2 * np.cross(v, points)
    return points + w * twice + np.cross(v, twice)


def aim(scene: Scene, logged: np.ndarray, *simulated: np.ndarray) -> Camera:
    """Return a camera that sees a motion from where it shows most: across its plane, where it has one.

    It follows a robot that travels farther than it is large. Simulated robots are seen, too, unless they go far astray.

    Args:
        scene: the shapes.
        logged: poses of the moving bodies, ``(F, B, 7)``, all finite.
        simulated: other poses of them, NaN where they diverged.
    """
    count = len(logged)
    chosen = evenly(count, SAMPLES)
    points = placed_points(scene, logged[chosen])
    if not points.size:
        return Camera(90.0, ELEVATION, np.zeros((count, 3)), 1.0, 1.0)
    azimuth, elevation = direction(points, walks=scene.walks)
    sides = np.stack(axes_of(azimuth, elevation))
    radius = max((s.radius for s in scene.shapes if s.body in scene.bodies), default=0.0)
    middle = 0.5 * (points.min(1) + points.max(1))
    size = float(np.ptp(points @ sides.T, axis=1).max()) + 2 * radius
    follows = bool((np.ptp(middle, axis=0) > TRAVEL * size).any())
    middle = middle if follows else np.tile(0.5 * (points.min((0, 1)) + points.max((0, 1))), (len(chosen), 1))
    others = [placed_points(scene, poses[chosen]) for poses in simulated]
    seen = (np.concatenate([points, *others], 1) - middle[:, None]) @ sides.T
    reach = REACH * max(size, float(np.abs(seen[:, : points.shape[1]]).max()))
    seen = seen[(np.abs(seen) <= reach).all(-1)]
    low, high = seen.min(0) - radius, seen.max(0) + radius
    middle = middle + 0.5 * (low + high) @ sides
    centers = np.stack([np.interp(np.arange(count), chosen, middle[:, axis]) for axis in range(3)], 1)
    width, height = (1 + 2 * MARGIN) * np.maximum(high - low, 0.25 * (high - low).max())
    return Camera(azimuth, elevation, centers, float(width), float(height))


def direction(points: np.ndarray, *, walks: bool = False) -> tuple[float, float]:
    """Return azimuth and elevation from which the motion of points ``(S, P, 3)`` shows most.

    Across the plane in which they move; of a motion along a line, or of none, horizontally; of any other, and of a
    robot that ``walks`` over the ground, from obliquely above.
    """
    moved = (points - points.mean(0)).reshape(-1, 3)
    variance, vectors = np.linalg.eigh(moved.T @ moved / max(len(moved), 1))
    total = max(float(variance.sum()), 1e-300)
    if variance[0] > FLAT * total or (walks and abs(vectors[2, 0]) > 0.9):
        across = _horizontal(moved, points)
        azimuth = _azimuth(across) + TURN
        return azimuth, ELEVATION
    normal = vectors[:, 0]
    if variance[1] <= 1e-3 * total:
        line = vectors[:, 2] if variance[2] > 1e-18 else np.array([1.0, 0, 0])
        across = np.cross(line, [0, 0, 1.0])
        normal = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else np.array([0, 1.0, 0])
    if abs(normal[2]) > 0.9:
        return 90.0, -90.0
    azimuth = _azimuth(normal)
    elevation = -abs(float(np.degrees(np.arcsin(np.clip(normal[2], -1, 1)))))
    return azimuth, elevation if abs(elevation) > 1 else 0.0


def _horizontal(moved: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The horizontal direction in which least moves; of no difference, that across the robot's longer side."""
    plane = moved[:, :2]
    variance, vectors = np.linalg.eigh(plane.T @ plane)
    if variance[0] > 0.7 * variance[1]:
        body = (points - points.mean(1, keepdims=True)).reshape(-1, 3)[:, :2]
        vectors = np.linalg.eigh(body.T @ body)[1]
    return np.append(vectors[:, 0], 0.0)


def _azimuth(normal: np.ndarray) -> float:
    """Azimuth of a view along a horizontal direction, of its two signs that which looks along +y (or −x)."""
    towards = normal if normal[1] > 1e-9 or (abs(normal[1]) <= 1e-9 and normal[0] < 0) else -normal
    return float(np.degrees(np.arctan2(towards[1], towards[0])))


def axes_of(azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions in the world that a view shows as right and up."""
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    return right, np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])


def floor_lines(model: mujoco.MjModel, camera: Camera, lift: float = 0.0) -> list[np.ndarray]:
    """Return the lines of fixed planes and height fields around what is looked at, each ``(P, 3)``, in the world.

    Args:
        model: the model.
        camera: what is looked at.
        lift: how far they lie above their surface, in m.
    """
    data, centers, size = mujoco.MjData(model), camera.centers, max(camera.width, camera.height)
    mujoco.mj_kinematics(model, data)
    found: list[np.ndarray] = []
    for geom in range(model.ngeom):
        frame = data.geom_xmat[geom].reshape(3, 3)
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            local = (centers - data.geom_xpos[geom]) @ frame
            lines = _grid(local[:, :2], size, model.geom_size[geom, :2])
        elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD:
            lines = _relief(model, int(model.geom_dataid[geom]))
        else:
            continue
        found += [line @ frame.T + data.geom_xpos[geom] + lift * frame[:, 2] for line in lines]
    return found


def _grid(centers: np.ndarray, size: float, ends: np.ndarray) -> list[np.ndarray]:
    """Lines at round distances on a plane, around what is looked at and within the plane's ends."""
    low, high = centers.min(0) - size, centers.max(0) + size
    low, high = (np.where(ends > 0, np.clip(v, -ends, ends), v) for v in (low, high))
    raw = float(np.max(high - low)) / LINES
    if not raw > 0:
        return []
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw)
    found = []
    for axis in (0, 1):
        for at in np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1) * step:
            line = np.zeros((2, 3))
            line[:, axis], line[:, 1 - axis] = at, (low[1 - axis], high[1 - axis])
            found.append(line)
    return found


def _relief(model: mujoco.MjModel, field: int) -> list[np.ndarray]:
    """Lines along the rows and columns of a height field."""
    rows, columns, first = (int(a[field]) for a in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    size = model.hfield_size[field]
    heights = size[2] * model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    x, y = np.meshgrid(np.linspace(-size[0], size[0], columns), np.linspace(-size[1], size[1], rows))
    points = np.stack([x, y, heights], -1)
    every = [evenly(n, LINES // 2) for n in (rows, columns)]
    return [points[r][every[1]] for r in every[0]] + [points[every[0], c] for c in every[1]]


def _corners() -> np.ndarray:
    """Corners of the cube from −1 to 1, ``(8, 3)``."""
    return np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3)


def _ring(radius: float, height: float) -> np.ndarray:
    """Points of a circle about the vertical axis, ``(CIRCLE, 3)``."""
    angle = np.linspace(0, 2 * np.pi, CIRCLE, endpoint=False)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(CIRCLE, height)], 1)
