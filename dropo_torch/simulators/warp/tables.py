"""Compiles an MjModel into the tables of the kernels."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
import warp as wp

from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.hidden import POSE, prescribed_bodies
from dropo_torch.simulators.warp import collide
from dropo_torch.simulators.warp.couplings import (
    acting_tendons,
    active_equalities,
    equality_bodies,
    equality_sites,
    has_any,
    has_dofs,
    is_spatial,
    segments,
    tendon_columns,
    welds,
)
from dropo_torch.simulators.warp.layout import FIELDS
from dropo_torch.simulators.warp.meshes import mesh_tables
from dropo_torch.simulators.warp.pairs import contact_dimension, joins_branches, relative_dofs
from dropo_torch.simulators.warp.types import BALL, EULER, HINGE, IMPLICITFAST, RK4, SLIDE, TRANSLATION, Tables, fill
from dropo_torch.simulators.warp.varied import varied

#: Arrays that are kept for other models with the same content, and bytes above which none is.
KEPT, LARGE = 4096, 1 << 16
_JNT, _GEOM, _DISABLE, _EQ = mujoco.mjtJoint, mujoco.mjtGeom, mujoco.mjtDisableBit, mujoco.mjtEq
_INTEGRATOR = {
    mujoco.mjtIntegrator.mjINT_EULER: EULER, mujoco.mjtIntegrator.mjINT_RK4: RK4,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST: IMPLICITFAST, mujoco.mjtIntegrator.mjINT_IMPLICIT: IMPLICITFAST,
}  # fmt: skip
#: Links of a joint: kind, and how far after the joint's first dof and position the link's are.
_LINKS = {
    _JNT.mjJNT_HINGE: ((HINGE, 0),),
    _JNT.mjJNT_SLIDE: ((SLIDE, 0),),
    _JNT.mjJNT_BALL: ((BALL, 0),),
    _JNT.mjJNT_FREE: ((TRANSLATION, 0), (BALL, 3)),
}
#: Contacts of a world that memory is kept for, at most.
MOST_CONTACTS = 512
#: Kinds of pairs by the geoms' types, the smaller first: constant of the kernels, points that may touch, most
#: contacts; 0 points where contacts are found together.
KINDS = {
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_SPHERE): (collide.PLANE_SPHERE, 1, 1),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_CAPSULE): (collide.PLANE_CAPSULE, 2, 2),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_BOX): (collide.PLANE_BOX, 8, 4),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_MESH): (collide.PLANE_MESH, 0, 4),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_CYLINDER): (collide.PLANE_CYLINDER, 4, 4),
    (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_ELLIPSOID): (collide.PLANE_ELLIPSOID, 1, 1),
    (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_SPHERE): (collide.ROUND, 1, 1),
    (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE): (collide.ROUND, 1, 1),
    (_GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_CAPSULE): (collide.ROUND, 2, 2),
    (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_BOX): (collide.CAPSULE_BOX, 1, 1),
    (_GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_BOX): (collide.CAPSULE_BOX, 2, 2),
    (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CYLINDER): (collide.SPHERE_CYLINDER, 1, 1),
    (_GEOM.mjGEOM_BOX, _GEOM.mjGEOM_BOX): (collide.BOX_BOX, 0, 8),
}  # fmt: skip
#: Pairs of MuJoCo's general convex collision: a shape, and the shapes of larger types that it meets there.
_CONVEX = {
    _GEOM.mjGEOM_SPHERE: (_GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_MESH),
    _GEOM.mjGEOM_CAPSULE: (_GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_MESH),
    _GEOM.mjGEOM_ELLIPSOID: (
        _GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_BOX, _GEOM.mjGEOM_MESH,
    ),
    _GEOM.mjGEOM_CYLINDER: (_GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_BOX, _GEOM.mjGEOM_MESH),
    _GEOM.mjGEOM_BOX: (_GEOM.mjGEOM_MESH,),
    _GEOM.mjGEOM_MESH: (_GEOM.mjGEOM_MESH,),
}  # fmt: skip
#: Shapes that touch at one point only.
_SMOOTH = (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID)
KINDS |= {
    (one, two): (collide.CONVEX, 0, 1 if one in _SMOOTH or two in _SMOOTH else 4)
    for one, others in _CONVEX.items()
    for two in others
}


def build_tables(
    model: mujoco.MjModel,
    space: ParameterSpace,
    pairs: list[tuple[int, int, int]],
    sections: dict[str, tuple[int, int]],
    device: str,
) -> Tables:
    """Return the tables of a supported model on a device."""
    columns = _bodies(model) | _links(model) | _actuators(model) | _constraints(model, space) | _frames(model, space)
    columns |= _pairs(model, pairs, space) | mesh_tables(model, pairs) | _welds(model) | _tendons(model, space)
    columns["always_dense"] |= columns["quad_dense"] | columns.pop("tendons_dense")
    columns["maxrow"] += columns["nteneq"] + 3 * columns["nten"]
    columns |= _ellipsoids(model)
    columns |= _switches(model, space) | {f"o_{name}": offset for name, (offset, _size) in sections.items()}
    return fill(Tables(), {k: _to_warp(x, device) if isinstance(x, np.ndarray) else x for k, x in columns.items()})


def _to_warp(array: np.ndarray, device: str) -> Any:
    """A Warp array: integers, reals, or vectors and matrices of three by the shape of a row; to be read only."""
    array = np.ascontiguousarray(array, dtype=np.int32 if array.dtype.kind in "iub" else np.float64)
    if array.nbytes > LARGE:
        return _array(array, device)
    return _shared(array.tobytes(), array.dtype, array.shape, device)


@lru_cache(maxsize=KEPT)
def _shared(content: bytes, kind: np.dtype, shape: tuple[int, ...], device: str) -> Any:
    """The array of some content: variants of a model share most of their tables, and making them takes as long."""
    return _array(np.frombuffer(content, dtype=kind).reshape(shape).copy(), device)


def _array(array: np.ndarray, device: str) -> Any:
    """A Warp array with the content of another one."""
    if array.dtype == np.int32:
        return wp.array(array, dtype=wp.int32, device=device)
    dtype = {(): wp.float64, (3,): wp.vec3d, (3, 3): wp.mat33d}[array.shape[1:]]
    return wp.array(array, dtype=dtype, device=device)


def _disabled(model: mujoco.MjModel, *bits: Any) -> bool:
    return any(model.opt.disableflags & int(b) for b in bits)


def _matrices(quats: np.ndarray) -> np.ndarray:
    """Rotations of unit quaternions ``(n, 4)``."""
    out = np.zeros((len(quats), 9))
    for i, q in enumerate(quats):
        mujoco.mju_quat2Mat(out[i], q / np.linalg.norm(q))
    return out.reshape(-1, 3, 3)


def _bodies(model: mujoco.MjModel) -> dict[str, Any]:
    poses = np.full(model.nbody, -1)  # where in the inputs of a step the pose of a mocap body begins
    prescribed = prescribed_bodies(model)
    poses[prescribed] = model.nu + POSE * np.arange(len(prescribed))
    pos, quat = model.body_pos.copy(), model.body_quat.copy()
    last = np.full(model.nbody, -1)
    for b in range(1, model.nbody):
        last[b] = last[model.body_parentid[b]]
        if model.body_dofnum[b]:
            last[b] = model.body_dofadr[b] + model.body_dofnum[b] - 1
        if model.body_jntnum[b] and model.jnt_type[model.body_jntadr[b]] == _JNT.mjJNT_FREE:
            pos[b], quat[b] = 0.0, (1.0, 0.0, 0.0, 0.0)
    moving = np.array([has_dofs(model, b) for b in range(model.nbody)])
    return {
        "nb": model.nbody, "nv": model.nv, "nq": model.nq, "nh": model.nv * (model.nv + 1) // 2,
        "body_parent": model.body_parentid, "body_ndof": model.body_dofnum,
        "body_dof": np.maximum(model.body_dofadr, 0),
        "body_lastdof": last, "body_massive": moving.astype(np.int32), "body_pose": poses,
        "body_pos": pos, "body_mat": _matrices(quat),
        "dof_body": model.dof_bodyid, "dof_ndof": _link_dofs(model),
        "dof_alone": model.M_rownnz == 1,
        "dof_parent": np.stack([model.dof_parentid, np.arange(model.nv) - 1]),
    }  # fmt: skip


def link_table(model: mujoco.MjModel) -> np.ndarray:
    """Kind, joint, dof and position of each link, ``(4, n)``."""
    rows = [
        (kind, j, model.jnt_dofadr[j] + offset, model.jnt_qposadr[j] + offset)
        for j in range(model.njnt)
        for kind, offset in _LINKS[_JNT(model.jnt_type[j])]
    ]
    return np.array(rows, dtype=int).reshape(-1, 4).T


def _link_dofs(model: mujoco.MjModel) -> np.ndarray:
    """How many dofs the link of each dof has, ``(nv,)``."""
    kinds, _joints, dofs, _qs = link_table(model)
    counts = np.ones(model.nv, dtype=int)
    for start in dofs[kinds > SLIDE]:
        counts[start : start + 3] = 3
    return counts


def _links(model: mujoco.MjModel) -> dict[str, Any]:
    kinds, joints, dofs, qs = link_table(model)
    bodies = model.jnt_bodyid[joints]
    scalar, free = kinds <= SLIDE, model.jnt_type[joints] == _JNT.mjJNT_FREE
    table = {
        "nlink": len(kinds), "has_ball": int(bool(np.any(kinds == BALL))), "link_body": bodies, "link_kind": kinds,
        "body_link": np.searchsorted(bodies, np.arange(model.nbody)),
        "body_nlink": np.bincount(bodies, minlength=model.nbody),
        "link_dof": dofs, "link_ndof": np.where(scalar, 1, 3), "link_qpos": qs, "link_jnt": joints,
        "link_frclimited": model.jnt_actfrclimited[joints], "link_axis": model.jnt_axis[joints],
        "link_pos": np.where(free[:, None], 0.0, model.jnt_pos[joints]),
        "link_ref": np.where(scalar, model.qpos0[qs], 0.0),
    }  # fmt: skip
    return table | _origin(model, table)


def _origin(model: mujoco.MjModel, links: dict[str, Any]) -> dict[str, Any]:
    """Where the origin of the sweep is: it travels with the translations of the first body that moves."""
    origin: list[tuple[int, np.ndarray]] = []
    body = int(np.argmax(model.body_dofnum != 0))  # 0 where none moves
    rooted = body and model.body_parentid[body] == 0
    base = model.body_pos[body].copy() if rooted else np.zeros(3)
    turned = _matrices(model.body_quat[body : body + 1])[0]
    for k in np.flatnonzero(links["link_body"] == body) if body else ():
        q, axis = int(links["link_qpos"][k]), turned @ links["link_axis"][k]
        if links["link_kind"][k] == TRANSLATION:
            origin, base = [(q + i, np.eye(3)[i]) for i in range(3)], np.zeros(3)
        elif links["link_kind"][k] == SLIDE and rooted:
            origin.append((q, axis))
            base = base - axis * links["link_ref"][k]
        else:
            break
    return {
        "norigin": len(origin), "origin_qpos": np.array([q for q, _ in origin], dtype=int),
        "origin_axis": np.array([axis for _, axis in origin]).reshape(-1, 3), "origin_base": wp.vec3d(*base),
    }  # fmt: skip


def joint_dofs(model: mujoco.MjModel) -> np.ndarray:
    """Return how many dofs each joint has, ``(njnt,)``."""
    return np.array([6, 3, 1, 1])[model.jnt_type]


def _frames(model: mujoco.MjModel, space: ParameterSpace) -> dict[str, Any]:
    """Where in θ frames stand that vary, and −1 of those in the tables."""
    rows = varied(space, model)

    def places(kind: str, count: int) -> np.ndarray:
        out = np.full(count, -1)
        out[rows[kind]] = np.arange(len(rows[kind]))
        return out

    return {
        "body_frame": places("body", model.nbody), "geom_frame": places("geom", model.ngeom),
        "link_frame": places("jnt", model.njnt)[link_table(model)[1]], "want_geoms": int(bool(rows["geom"])),
        "want_frames": int(bool(rows["body"] or rows["jnt"])),
    }  # fmt: skip


def _actuators(model: mujoco.MjModel) -> dict[str, Any]:
    acting = not _disabled(model, _DISABLE.mjDSBL_ACTUATION)
    by_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    at_site = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_SITE)
    joints = np.where(by_tendon | at_site, 0, model.actuator_trnid[:, 0])
    sites = np.where(at_site, model.actuator_trnid[:, 0], 0)[: None if model.nsite else 0]
    dofs, starts, qs = joint_dofs(model), model.jnt_dofadr, model.jnt_qposadr
    if not model.njnt:
        dofs, starts, qs = (np.zeros(1, dtype=int) for _ in range(3))
    return {
        "nu": model.nu if acting else 0, "act_dof": starts[joints], "act_qpos": qs[joints],
        "act_tendon": np.where(by_tendon, model.actuator_trnid[:, 0], -1),
        "act_ndof": np.where(by_tendon | at_site, 0, dofs[joints]),
        "has_thrust": int(acting and bool(at_site.any())), "act_pos": model.site_pos[sites],
        "act_mat": _matrices(model.site_quat[sites]),
        "act_body": np.where(at_site, model.site_bodyid[sites] if model.nsite else -1, -1),
        "act_affine_gain": model.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE,
        "act_affine_bias": model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE,
        "act_ctrllimited": model.actuator_ctrllimited * (not _disabled(model, _DISABLE.mjDSBL_CLAMPCTRL)),
        "act_frclimited": model.actuator_forcelimited,
        "na": model.na if acting else 0, "act_state": model.actuator_actadr, "act_dyn": model.actuator_dyntype,
        "act_early": model.actuator_actearly, "act_statelimited": model.actuator_actlimited,
        "state_act": np.flatnonzero(model.actuator_actnum),
        "has_frclimit": int(acting and bool(model.jnt_actfrclimited.any())),
    }  # fmt: skip


def _targets(space: ParameterSpace, field: str) -> set[int]:
    """Numbers of a field that some parameter writes."""
    return {t.index for p in space.parameters for t in p.targets if t.field == field}


def _constraints(model: mujoco.MjModel, space: ParameterSpace) -> dict[str, Any]:
    def on(bit: Any) -> bool:
        return not _disabled(model, _DISABLE.mjDSBL_CONSTRAINT, bit)

    loses = (model.dof_frictionloss > 0) | np.isin(np.arange(model.nv), list(_targets(space, "dof_frictionloss")))
    friction = np.flatnonzero(loses & on(_DISABLE.mjDSBL_FRICTIONLOSS))
    limited = model.jnt_limited.astype(bool) & (model.jnt_type != _JNT.mjJNT_FREE)  # of a free joint there is no limit
    limited = np.flatnonzero(limited & on(_DISABLE.mjDSBL_LIMIT))
    ids = active_equalities(model, _EQ.mjEQ_JOINT)
    joints = np.stack([model.eq_obj1id[ids], model.eq_obj2id[ids]], axis=1)
    first, second = model.jnt_bodyid[joints].T
    coupled = [
        joins_branches(model, int(a), int(b)) for a, b, j in zip(first, second, joints[:, 1], strict=True) if j >= 0
    ]
    pairs = joints.reshape(-1)
    qs = np.where(pairs >= 0, model.jnt_qposadr[pairs], 0)
    return {
        "nfriction": len(friction), "friction_dof": friction, "nlimit": len(limited),
        "limit_link": np.searchsorted(link_table(model)[1], limited), "neq": len(ids), "eq_id": ids,
        "eq_dof": np.where(pairs >= 0, model.jnt_dofadr[pairs], -1), "eq_qpos": qs, "eq_ref": model.qpos0[qs],
        "always_dense": int(any(coupled)), "maxrow": len(ids) + len(friction) + 2 * len(limited),
    }  # fmt: skip


def _welds(model: mujoco.MjModel) -> dict[str, Any]:
    ids = welds(model)
    bodies, (sites, pos, quat) = equality_bodies(model, ids), equality_sites(model, ids)
    dense = np.array([joins_branches(model, int(a), int(b)) for a, b in bodies], dtype=int)
    return {
        "nweld": len(ids), "weld_id": ids, "weld_body": bodies.ravel(),
        "weld_turns": model.eq_type[ids] == int(_EQ.mjEQ_WELD), "weld_sites": sites,
        "weld_pos": pos.reshape(-1, 3), "weld_mat": _matrices(quat.reshape(-1, 4)),
        "weld_dense": dense, "quad_dense": int(dense.any()),
    }  # fmt: skip


def _tendons(model: mujoco.MjModel, space: ParameterSpace) -> dict[str, Any]:
    n, varied = model.ntendon, {t.field for p in space.parameters for t in p.targets}
    acts = acting_tendons(model, varied)
    spatial = is_spatial(model) & acts
    columns = [tendon_columns(model, k) if acts[k] else np.zeros(0, dtype=int) for k in range(n)]
    lines = [segments(model, k) if spatial[k] else [] for k in range(n)]
    flat = [line for own in lines for line in own]
    ends = np.array([site for a, b, _scale in flat for site in (a, b)], dtype=int)
    return _tendon_arms(model, acts & ~spatial, columns) | _tendon_constraints(model, varied, columns) | {
        "nten": n if acts.any() else 0, "ten_spatial": spatial, "ten_segment": np.cumsum([0, *map(len, lines)]),
        "seg_body": model.site_bodyid[ends], "seg_pos": model.site_pos[ends].reshape(-1, 3),
        "seg_scale": np.array([scale for _a, _b, scale in flat], dtype=float), "ten_ref": model.tendon_length0,
        "ten_sprung": has_any(model, varied, "tendon_stiffness", "tendon_stiffnesspoly")
        & (not _disabled(model, _DISABLE.mjDSBL_SPRING)),
        "ten_damped": has_any(model, varied, "tendon_damping", "tendon_dampingpoly")
        & (not _disabled(model, _DISABLE.mjDSBL_DAMPER)),
        "ten_frclimited": model.tendon_actfrclimited,
    }  # fmt: skip


def _tendon_arms(model: mujoco.MjModel, fixed: np.ndarray, columns: list[np.ndarray]) -> dict[str, Any]:
    """Where the moment arms of tendons stand, and those of fixed tendons."""
    place = np.full((model.ntendon, model.nv), -1)
    start = np.cumsum([0, *map(len, columns)])
    for row, own in enumerate(columns):
        place[row, own] = start[row] + np.arange(len(own))
    dofs = np.concatenate([np.zeros(0, dtype=int), *columns])
    coef, q = np.zeros(len(dofs)), np.zeros(len(dofs), dtype=int)
    for k in np.flatnonzero(fixed).tolist():
        for j in range(model.tendon_adr[k], model.tendon_adr[k] + model.tendon_num[k]):
            joint = model.wrap_objid[j]
            c = place[k, model.jnt_dofadr[joint]]
            coef[c] += model.wrap_prm[j]
            q[c] = model.jnt_qposadr[joint]
    return {"ten_start": start, "ten_dof": dofs, "ten_qpos": q, "ten_coef": coef, "ten_column": place.ravel()}


def _tendon_constraints(model: mujoco.MjModel, varied: set[str], columns: list[np.ndarray]) -> dict[str, Any]:
    def on(bit: Any) -> bool:
        return not _disabled(model, _DISABLE.mjDSBL_CONSTRAINT, bit)

    limited = model.tendon_limited.astype(bool) & on(_DISABLE.mjDSBL_LIMIT)
    frictional = has_any(model, varied, "tendon_frictionloss") & on(_DISABLE.mjDSBL_FRICTIONLOSS)
    ids = active_equalities(model, _EQ.mjEQ_TENDON)
    equal = np.stack([model.eq_obj1id[ids], model.eq_obj2id[ids]], axis=1)
    sets = [columns[k] for k in np.flatnonzero(limited | frictional)]
    sets += [np.concatenate([columns[k] for k in pair if k >= 0]) for pair in equal]
    return {
        "ten_frictional": frictional, "ten_limited": limited, "nteneq": len(ids), "teneq_id": ids,
        "teneq_tendon": equal.ravel(), "tendons_dense": int(any(_branches(model, own) for own in sets)),
    }  # fmt: skip


def _branches(model: mujoco.MjModel, dofs: np.ndarray) -> bool:
    """Whether some of these dofs are not on one chain to the root."""
    chain, i = set(), int(max(dofs, default=-1))
    while i >= 0:
        chain.add(i)
        i = int(model.dof_parentid[i])
    return not set(dofs.tolist()) <= chain


def _pairs(model: mujoco.MjModel, pairs: list[tuple[int, int, int]], space: ParameterSpace) -> dict[str, Any]:
    table = np.array(pairs, dtype=int).reshape(-1, 3)
    kinds = [KINDS[_GEOM(model.geom_type[g1]), _GEOM(model.geom_type[g2])] for g1, g2, _pair in pairs]
    kind, points, most = (np.array([int(k[i]) for k in kinds], dtype=int) for i in range(3))
    if _disabled(model, _DISABLE.mjDSBL_MULTICCD):
        most[kind == collide.CONVEX] = 1
    bodies = model.geom_bodyid[table[:, :2]]
    size = model.geom_size.copy()
    size[model.geom_type == _GEOM.mjGEOM_SPHERE, 1:] = 0.0
    moving = [relative_dofs(model, int(a), int(b)) for a, b in bodies]
    dofs = np.array([dof for pair in moving for dof in pair], dtype=int).reshape(-1, 2)
    gap = model.geom_gap[table[:, 0]] + model.geom_gap[table[:, 1]]
    explicit = table[:, 2] >= 0
    gap[explicit] = model.pair_gap[table[explicit, 2]]
    bound = model.geom_rbound.copy()
    bound[[index // 3 for index in _targets(space, "geom_size")]] = 1e5  # wherever it may be
    return {
        "npair": len(pairs), "maxcon": min(int(most.sum()), MOST_CONTACTS), "pair_kind": kind, "pair_points": points,
        "pair_most": most, "pair_dofadr": np.cumsum([0, *map(len, moving)]), "pair_dof": dofs[:, 0],
        "pair_sign": dofs[:, 1], "pair_gap": gap,
        "pair_bound": (bound[table[:, 1]] + bound[table[:, 0]]) * (1 + 1e-9),
        "pair_body1": bodies[:, 0], "pair_body2": bodies[:, 1], "pair_geom1": table[:, 0], "pair_geom2": table[:, 1],
        "pair_dim": np.array([contact_dimension(model, *p) for p in pairs], dtype=int),
        "pair_dense": np.array([joins_branches(model, int(a), int(b)) for a, b in bodies], dtype=int),
        "touching": np.unique(table[:, :2]), "ntouching": len(np.unique(table[:, :2])),
        "geom_body": model.geom_bodyid, "geom_pos": model.geom_pos, "geom_mat": _matrices(model.geom_quat),
        "geom_mid": model.geom_aabb[:, :3], "geom_half": model.geom_aabb[:, 3:] * (1 + 1e-9),
        "geom_size": size, "geom_kind": model.geom_type,
        "ccd_iterations": model.opt.ccd_iterations, "ccd_tolerance": model.opt.ccd_tolerance,
        "nclip_normal": max(3, model.nmeshdegmax),
    }  # fmt: skip


def convex_sizes(model: mujoco.MjModel, pairs: list[tuple[int, int, int]], maxcon: int) -> dict[str, int]:
    """Return the sizes of the memory that contacts of convex geoms take: none if there are no such pairs."""
    kinds = [tuple(_GEOM(model.geom_type[g]) for g in pair[:2]) for pair in pairs]
    convex = [pair for pair, kind in zip(pairs, kinds, strict=True) if KINDS[kind][0] == collide.CONVEX]
    names = ("convex", "convex2", "convex3", "convex_few", "epa_vertex", "epa_face", "clip_normals", "clip_corners",
             "clip_polygon")  # fmt: skip
    if not convex:
        return dict.fromkeys(names, 0)
    meshes = {int(model.geom_dataid[g]) for pair in convex for g in pair[:2] if model.geom_type[g] == _GEOM.mjGEOM_MESH}
    corners = [16]  # of the polygon that stands for a disk
    for mesh in meshes:
        first = model.mesh_polyadr[mesh]
        corners.extend(model.mesh_polyvertnum[first : first + model.mesh_polynum[mesh]])
    steps, most = max(int(model.opt.ccd_iterations), 1), int(max(corners))
    sizes = (maxcon, 2 * maxcon, 3 * maxcon, 8, 5 + steps, max(6 * steps, 8) + 8, max(3, model.nmeshdegmax), most,
             8 * most)  # fmt: skip
    return dict(zip(names, sizes, strict=True))


def _ellipsoids(model: mujoco.MjModel) -> dict[str, Any]:
    """Geoms on which the medium acts as on ellipsoids, by bodies: their semi-axes and coefficients."""
    geoms = np.flatnonzero(model.geom_fluid[:, 0] > 0)  # geoms stand in the order of their bodies
    bodies = model.geom_bodyid[geoms]
    size, kind = model.geom_size[geoms], model.geom_type[geoms]
    axes = size.copy()
    round_ = np.isin(kind, [int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_CAPSULE), int(_GEOM.mjGEOM_CYLINDER)])
    axes[round_, 1] = size[round_, 0]
    axes[round_, 2] = np.where(kind[round_] == _GEOM.mjGEOM_SPHERE, size[round_, 0], size[round_, 1])
    axes[kind == _GEOM.mjGEOM_CAPSULE, 2] += size[kind == _GEOM.mjGEOM_CAPSULE, 0]
    _on, drag, lift, mass, inertia = np.split(model.geom_fluid[geoms], (1, 4, 6, 9), axis=1)
    return {
        "body_fluid": np.searchsorted(bodies, np.arange(model.nbody)),
        "body_nfluid": np.bincount(bodies, minlength=model.nbody), "fluid_geom": geoms, "fluid_size": axes,
        "fluid_drag": drag, "fluid_lift": np.pad(lift, ((0, 0), (0, 1))), "fluid_mass": mass, "fluid_inertia": inertia,
    }  # fmt: skip


def turning_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Bodies whose velocity products the integrator takes implicitly, ``(nbody,)`` bool.

    All under implicit; under implicitfast those of trees that move as one free rigid body.
    """
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICIT:
        return np.arange(model.nbody) > 0
    dofs = np.bincount(model.body_rootid, model.body_dofnum, model.nbody)
    free = np.zeros(model.nbody, dtype=bool)
    free[model.jnt_bodyid[model.jnt_type == _JNT.mjJNT_FREE]] = True
    fast = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return fast & free[model.body_rootid] & (dofs[model.body_rootid] == 6)


def _switches(model: mujoco.MjModel, space: ParameterSpace) -> dict[str, Any]:
    integrator = _INTEGRATOR[mujoco.mjtIntegrator(model.opt.integrator)]
    damped, sprung = (not _disabled(model, bit) for bit in (_DISABLE.mjDSBL_DAMPER, _DISABLE.mjDSBL_SPRING))

    def wanted(*fields: str) -> bool:
        return any(_targets(space, field) for field in fields)

    def acts(*fields: str) -> bool:
        return wanted(*fields) or any(np.any(read_field(model, field)) for field in fields)

    damper = damped and acts("dof_damping", "dof_dampingpoly", "actuator_damping", "actuator_dampingpoly")
    implicit_damper = integrator == EULER and damper and not _disabled(model, _DISABLE.mjDSBL_EULERDAMP)
    turning = turning_bodies(model)
    passive = damped or sprung  # without springs and dampers MuJoCo leaves out all passive forces
    switches = {
        "want_inertial": wanted("body_mass", "body_inertia", "body_ipos"), "want_inertia": wanted("body_inertia"),
        "want_ipos": wanted("body_ipos"), "want_soft": wanted(*(f for f in FIELDS if "_sol" in f)),
        "elliptic": model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC,
        "refsafe": not _disabled(model, _DISABLE.mjDSBL_REFSAFE), "implicit_actuators": integrator == IMPLICITFAST,
        "implicit": integrator == IMPLICITFAST or implicit_damper, "has_damper": damper,
        "has_spring": sprung and acts("jnt_stiffness", "jnt_stiffnesspoly"),
        "has_gravcomp": passive and (wanted("body_gravcomp") or model.ngravcomp > 0),
        "has_fluid": passive and acts("opt.density", "opt.viscosity"), "has_turning": bool(turning.any()),
    }  # fmt: skip
    switches["implicit_fluid"] = integrator == IMPLICITFAST and switches["has_fluid"]
    switches["full"] = switches["implicit_fluid"] or switches["has_turning"]
    switches["symmetric_fluid"] = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return {name: int(on) for name, on in switches.items()} | {
        "body_turning": turning, "integrator": integrator, "nstage": 4 if integrator == RK4 else 1,
        "h": model.opt.timestep, "impratio": max(model.opt.impratio, 1e-15),
    }  # fmt: skip
