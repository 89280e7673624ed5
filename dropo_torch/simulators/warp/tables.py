"""Compiles an MjModel into the tables of the kernels."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import warp as wp

from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import collide
from dropo_torch.simulators.warp.layout import Layout
from dropo_torch.simulators.warp.pairs import condim, joins_branches
from dropo_torch.simulators.warp.types import Tables, mat33, vec3

_JNT, _GEOM, _DISABLE = mujoco.mjtJoint, mujoco.mjtGeom, mujoco.mjtDisableBit
_INTEGRATOR = {
    mujoco.mjtIntegrator.mjINT_EULER: 0, mujoco.mjtIntegrator.mjINT_RK4: 1, mujoco.mjtIntegrator.mjINT_IMPLICITFAST: 2,
}  # fmt: skip
#: Fields of how soft a constraint is.
SOFT = (
    "jnt_solref", "jnt_solimp", "dof_solref", "dof_solimp", "eq_solref", "eq_solimp", "geom_solref", "geom_solimp",
    "pair_solref", "pair_solreffriction", "pair_solimp",
)  # fmt: skip
#: Kinds of pairs by the geoms' types, the smaller first: constant of the kernels, points that may touch, most contacts.
KINDS = {
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_SPHERE): (collide.PLANE_SPHERE, 1, 1),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_CAPSULE): (collide.PLANE_CAPSULE, 2, 2),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_BOX): (collide.PLANE_BOX, 8, 4),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_CYLINDER): (collide.PLANE_CYLINDER, 4, 4),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_ELLIPSOID): (collide.PLANE_ELLIPSOID, 1, 1),
    (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_SPHERE): (collide.ROUND, 1, 1),
    (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE): (collide.ROUND, 1, 1),
    (_GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_CAPSULE): (collide.ROUND, 2, 2),
    (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_BOX): (collide.CAPSULE_BOX, 1, 1),
    (_GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_BOX): (collide.CAPSULE_BOX, 2, 2),
}  # fmt: skip


def build_tables(
    model: mujoco.MjModel, space: ParameterSpace, pairs: list[tuple[int, int, int]], layout: Layout, device: str
) -> Tables:
    """Return the tables of a supported model on a device."""
    columns: dict[str, Any] = {}
    columns |= _bodies(model)
    columns |= _links(model)
    columns |= _actuators(model)
    columns |= _constraints(model, space)
    columns |= _pairs(model, pairs)
    columns |= _switches(model, space)
    tables = Tables()
    for name, value in columns.items():
        setattr(tables, name, _to_warp(value, device) if isinstance(value, np.ndarray) else value)
    for name, (offset, _size) in layout.sections.items():
        setattr(tables, f"o_{name}", offset)
    return tables


def _to_warp(array: np.ndarray, device: str) -> Any:
    """A Warp array: integers, reals, or vectors and matrices of three by the shape of a row."""
    if array.dtype.kind in "iub":
        return wp.array(array.astype(np.int32), dtype=wp.int32, device=device)
    dtype = {(): wp.float64, (3,): vec3, (3, 3): mat33}[array.shape[1:]]
    return wp.array(np.ascontiguousarray(array, dtype=np.float64), dtype=dtype, device=device)


def _disabled(model: mujoco.MjModel, *bits: Any) -> bool:
    return any(model.opt.disableflags & int(b) for b in (*bits, 0))


def _matrices(quats: np.ndarray) -> np.ndarray:
    """Rotations of unit quaternions ``(n, 4)``."""
    out = np.zeros((len(quats), 9))
    for i, q in enumerate(quats):
        mujoco.mju_quat2Mat(out[i], q / np.linalg.norm(q))
    return out.reshape(-1, 3, 3)


def _bodies(model: mujoco.MjModel) -> dict[str, Any]:
    pos, quat = model.body_pos.copy(), model.body_quat.copy()
    last = np.full(model.nbody, -1)
    for b in range(1, model.nbody):
        last[b] = last[model.body_parentid[b]]
        if model.body_dofnum[b]:
            last[b] = model.body_dofadr[b] + model.body_dofnum[b] - 1
        if model.body_jntnum[b] and model.jnt_type[model.body_jntadr[b]] == _JNT.mjJNT_FREE:
            pos[b], quat[b] = 0.0, (1.0, 0.0, 0.0, 0.0)
    moving = model.body_weldid != 0
    return {
        "nb": model.nbody, "nv": model.nv, "nq": model.nq, "nh": model.nv * (model.nv + 1) // 2,
        "body_parent": model.body_parentid, "body_ndof": model.body_dofnum,
        "body_dof": np.maximum(model.body_dofadr, 0),
        "body_lastdof": last, "body_massive": moving.astype(np.int32), "body_pos": pos, "body_mat": _matrices(quat),
        "body_imat": _matrices(model.body_iquat), "dof_body": model.dof_bodyid,
        "dof_parent": np.stack([model.dof_parentid, np.arange(model.nv) - 1]),
    }  # fmt: skip


def _links(model: mujoco.MjModel) -> dict[str, Any]:
    rows: list[tuple[Any, ...]] = []  # kind, joint, dof, qpos, axis, pos, ref
    first, count = np.zeros(model.nbody, int), np.zeros(model.nbody, int)
    origin: list[tuple[int, np.ndarray]] = []
    base = np.zeros(3)
    for b in range(model.nbody):
        first[b] = len(rows)
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            kind, d, q = model.jnt_type[j], int(model.jnt_dofadr[j]), int(model.jnt_qposadr[j])
            axis, pos = model.jnt_axis[j], model.jnt_pos[j]
            if kind == _JNT.mjJNT_FREE:
                rows.append((2, j, d, q, axis, np.zeros(3), 0.0))
                rows.append((3, j, d + 3, q + 3, axis, np.zeros(3), 0.0))
            else:
                number = {_JNT.mjJNT_HINGE: 0, _JNT.mjJNT_SLIDE: 1, _JNT.mjJNT_BALL: 3}[_JNT(kind)]
                rows.append((number, j, d, q, axis, pos, model.qpos0[q] if number < 2 else 0.0))
        count[b] = len(rows) - first[b]
    moving = [b for b in range(model.nbody) if model.body_weldid[b]]
    if moving:
        b = moving[0]
        turned = _matrices(model.body_quat[b : b + 1])[0]
        base = model.body_pos[b].copy() if model.body_parentid[b] == 0 else base
        for kind, _j, _d, q, axis, _p, ref in rows[first[b] : first[b] + count[b]]:
            if kind == 2:
                origin, base = [(q + i, np.eye(3)[i]) for i in range(3)], np.zeros(3)
            elif kind == 1 and model.body_parentid[b] == 0:
                origin.append((q, turned @ axis))
                base = base - turned @ axis * ref
            else:
                break
    kinds, joints, dofs, qs = (np.array([r[i] for r in rows], dtype=int) for i in range(4))
    return {
        "nlink": len(rows), "has_ball": int(bool(np.any(kinds == 3))), "body_link": first, "body_nlink": count,
        "link_kind": kinds, "link_dof": dofs, "link_ndof": np.where(kinds < 2, 1, 3), "link_qpos": qs,
        "link_jnt": joints, "link_body": model.jnt_bodyid[joints] if len(rows) else joints,
        "link_frclimited": model.jnt_actfrclimited[joints].astype(int) if len(rows) else joints,
        "link_axis": np.array([r[4] for r in rows]).reshape(-1, 3),
        "link_pos": np.array([r[5] for r in rows]).reshape(-1, 3),
        "link_ref": np.array([r[6] for r in rows], dtype=float),
        "norigin": len(origin), "origin_qpos": np.array([q for q, _a in origin], dtype=int),
        "origin_axis": np.array([a for _q, a in origin]).reshape(-1, 3), "origin_base": vec3(*base),
    }  # fmt: skip


def _actuators(model: mujoco.MjModel) -> dict[str, Any]:
    acting = not _disabled(model, _DISABLE.mjDSBL_ACTUATION)
    joints = model.actuator_trnid[:, 0]
    return {
        "nu": model.nu if acting else 0, "act_dof": model.jnt_dofadr[joints], "act_qpos": model.jnt_qposadr[joints],
        "act_affine_gain": model.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE,
        "act_affine_bias": model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE,
        "act_ctrllimited": model.actuator_ctrllimited, "act_frclimited": model.actuator_forcelimited,
        "clampctrl": int(not _disabled(model, _DISABLE.mjDSBL_CLAMPCTRL)),
        "has_frclimit": int(acting and bool(model.jnt_actfrclimited.any())),
    }  # fmt: skip


def _targets(space: ParameterSpace, field: str) -> set[int]:
    """Numbers of a field that some parameter writes."""
    return {t.index for p in space.parameters for t in p.targets if t.field == field}


def _constraints(model: mujoco.MjModel, space: ParameterSpace) -> dict[str, Any]:
    off = _disabled(model, _DISABLE.mjDSBL_CONSTRAINT)
    loses = (model.dof_frictionloss > 0) | np.isin(np.arange(model.nv), list(_targets(space, "dof_frictionloss")))
    friction = np.flatnonzero(loses) if not off and not _disabled(model, _DISABLE.mjDSBL_FRICTIONLOSS) else np.zeros(0)
    limited = []
    k = 0
    for j in range(model.njnt):
        if model.jnt_limited[j] and not off and not _disabled(model, _DISABLE.mjDSBL_LIMIT):
            limited.append(k)
        k += 2 if model.jnt_type[j] == _JNT.mjJNT_FREE else 1
    active = model.eq_active0.astype(bool) & (not off and not _disabled(model, _DISABLE.mjDSBL_EQUALITY))
    ids = np.flatnonzero(active)
    pairs = np.stack([model.eq_obj1id[ids], model.eq_obj2id[ids]], axis=1).reshape(-1)
    dofs = np.where(pairs >= 0, model.jnt_dofadr[pairs], -1) if len(pairs) else np.zeros(0, int)
    qs = np.where(pairs >= 0, model.jnt_qposadr[pairs], 0) if len(pairs) else np.zeros(0, int)
    dense = any(
        b >= 0 and joins_branches(model, int(model.jnt_bodyid[a]), int(model.jnt_bodyid[b]))
        for a, b in pairs.reshape(-1, 2)
    )
    return {
        "nfriction": len(friction), "friction_dof": friction.astype(int), "nlimit": len(limited),
        "limit_link": np.array(limited, dtype=int), "neq": len(ids), "eq_id": ids, "eq_dof": dofs, "eq_qpos": qs,
        "eq_ref": model.qpos0[qs] if len(qs) else np.zeros(0), "always_dense": int(dense),
        "maxrow": len(ids) + len(friction) + 2 * len(limited),
    }  # fmt: skip


def _pairs(model: mujoco.MjModel, pairs: list[tuple[int, int, int]]) -> dict[str, Any]:
    table = np.array(pairs, dtype=int).reshape(-1, 3)
    kinds = [KINDS[_GEOM(model.geom_type[g1]), _GEOM(model.geom_type[g2])] for g1, g2, _pair in pairs]
    kind, points, most = (np.array([int(k[i]) for k in kinds], dtype=int) for i in range(3))
    bodies = model.geom_bodyid[table[:, :2]]
    size = model.geom_size.copy()
    size[model.geom_type == _GEOM.mjGEOM_SPHERE, 1:] = 0.0
    return {
        "npair": len(pairs), "maxcon": int(most.sum()), "pair_kind": kind, "pair_points": points,
        "pair_bound": (model.geom_rbound[table[:, 1]] + model.geom_rbound[table[:, 0]]) * (1 + 1e-9),
        "pair_body1": bodies[:, 0], "pair_body2": bodies[:, 1], "pair_geom1": table[:, 0], "pair_geom2": table[:, 1],
        "pair_dim": np.array([condim(model, *p) for p in pairs], dtype=int),
        "pair_dense": np.array([joins_branches(model, int(a), int(b)) for a, b in bodies], dtype=int),
        "geom_body": model.geom_bodyid, "geom_pos": model.geom_pos, "geom_mat": _matrices(model.geom_quat),
        "geom_size": size,
    }  # fmt: skip


def _switches(model: mujoco.MjModel, space: ParameterSpace) -> dict[str, Any]:
    integrator = _INTEGRATOR[mujoco.mjtIntegrator(model.opt.integrator)]

    def acts(field: str, array: np.ndarray) -> bool:
        return bool(np.any(array)) or bool(_targets(space, field))

    damper = acts("dof_damping", model.dof_damping) or acts("dof_dampingpoly", model.dof_dampingpoly)
    damper = damper and not _disabled(model, _DISABLE.mjDSBL_DAMPER)
    spring = acts("jnt_stiffness", model.jnt_stiffness) or acts("jnt_stiffnesspoly", model.jnt_stiffnesspoly)
    fluid = acts("opt.density", np.array(model.opt.density)) or acts("opt.viscosity", np.array(model.opt.viscosity))
    # without springs and dampers MuJoCo leaves out all passive forces
    passive = not (_disabled(model, _DISABLE.mjDSBL_SPRING) and _disabled(model, _DISABLE.mjDSBL_DAMPER))
    implicit = integrator == 2 or (integrator == 0 and damper and not _disabled(model, _DISABLE.mjDSBL_EULERDAMP))
    return {
        "want_inertial": int(any(_targets(space, f) for f in ("body_mass", "body_inertia", "body_ipos"))),
        "want_inertia": int(bool(_targets(space, "body_inertia"))),
        "want_ipos": int(bool(_targets(space, "body_ipos"))),
        "want_soft": int(any(_targets(space, f) for f in SOFT)),
        "integrator": integrator, "nstage": 4 if integrator == 1 else 1, "h": model.opt.timestep,
        "impratio": max(model.opt.impratio, 1e-15), "elliptic": int(model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC),
        "refsafe": int(not _disabled(model, _DISABLE.mjDSBL_REFSAFE)), "implicit": int(implicit),
        "implicit_actuators": int(integrator == 2), "has_damper": int(damper),
        "has_spring": int(spring and not _disabled(model, _DISABLE.mjDSBL_SPRING)),
        "has_gravcomp": int(passive and acts("body_gravcomp", model.body_gravcomp)),
        "has_fluid": int(passive and fluid),
    }  # fmt: skip
