"""Which equality constraints and tendons act, and what each of them holds together."""

from __future__ import annotations

import mujoco
import numpy as np

_CONNECT, _WELD = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
_SITE = int(mujoco.mjtObj.mjOBJ_SITE)


def active_equalities(model: mujoco.MjModel, *kinds: mujoco.mjtEq) -> np.ndarray:
    """Return the numbers of the equalities of these kinds that act from the start."""
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_EQUALITY):
        return np.zeros(0, dtype=int)
    return np.flatnonzero(model.eq_active0.astype(bool) & np.isin(model.eq_type, [int(kind) for kind in kinds]))


def welds(model: mujoco.MjModel) -> np.ndarray:
    """Return the numbers of the connect and weld equalities that hold a body that can move."""
    ids = active_equalities(model, mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    bodies = equality_bodies(model, ids)
    return ids[np.array([any(has_dofs(model, int(b)) for b in pair) for pair in bodies], dtype=bool)]


def equality_bodies(model: mujoco.MjModel, ids: np.ndarray) -> np.ndarray:
    """Return the two bodies of connect and weld equalities, of sites those that carry them, ``(n, 2)``."""
    bodies = np.stack([model.eq_obj1id[ids], model.eq_obj2id[ids]], axis=1)
    sites = model.eq_objtype[ids] == _SITE
    bodies[sites] = model.site_bodyid[bodies[sites]]
    return bodies


def equality_sites(model: mujoco.MjModel, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whether equalities are between sites, and these sites' positions ``(n, 2, 3)`` and quaternions."""
    sites = model.eq_objtype[ids] == _SITE
    objects = np.stack([model.eq_obj1id[ids], model.eq_obj2id[ids]], axis=1)
    pos, quat = np.zeros((len(ids), 2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(ids), 2, 1))
    pos[sites], quat[sites] = model.site_pos[objects[sites]], model.site_quat[objects[sites]]
    return sites, pos, quat


def has_dofs(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body moves with any degree of freedom; a mocap body does not."""
    return bool(model.body_dofnum[model.body_weldid[body]])


def has_any(model: mujoco.MjModel, varied: set[str], *fields: str) -> np.ndarray:
    """Return whether each tendon has any of these fields, or a parameter gives it one, ``(ntendon,)``."""
    found: np.ndarray = np.any([_nonzero(getattr(model, field)) | (field in varied) for field in fields], axis=0)
    return found


def acting_tendons(model: mujoco.MjModel, varied: set[str]) -> np.ndarray:
    """Return whether each tendon can exert a force, ``(ntendon,)``; ``varied`` has the fields that parameters write."""
    fields = ("limited", "stiffness", "stiffnesspoly", "damping", "dampingpoly", "frictionloss", "armature")
    acts = has_any(model, varied, *(f"tendon_{field}" for field in fields))
    acts[model.actuator_trnid[model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON), 0]] = True
    ids = active_equalities(model, mujoco.mjtEq.mjEQ_TENDON)
    pair = np.concatenate([model.eq_obj1id[ids], model.eq_obj2id[ids]])
    acts[pair[pair >= 0]] = True
    return acts


def _nonzero(values: np.ndarray) -> np.ndarray:
    """Whether any number of each row is not zero, ``(n,)``."""
    return np.asarray(np.asarray(values, dtype=bool).any(axis=tuple(range(1, np.ndim(values)))))


def is_spatial(model: mujoco.MjModel) -> np.ndarray:
    """Return whether each tendon runs through sites instead of being a sum of joints, ``(ntendon,)``."""
    return model.wrap_type[model.tendon_adr] != int(mujoco.mjtWrap.mjWRAP_JOINT)


def tendon_columns(model: mujoco.MjModel, tendon: int) -> np.ndarray:
    """Return the degrees of freedom that a tendon may have moment arms at, in order."""
    start = model.ten_J_rowadr[tendon]
    return np.unique(model.ten_J_colind[start : start + model.ten_J_rownnz[tendon]])


def segments(model: mujoco.MjModel, tendon: int) -> list[tuple[int, int, float]]:
    """Return the straight segments of a spatial tendon: two sites, and one over the pulley's divisor."""
    found, scale, last = [], 1.0, -1
    for j in range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon]):
        if model.wrap_type[j] == int(mujoco.mjtWrap.mjWRAP_PULLEY):
            scale, last = 1.0 / model.wrap_prm[j], -1
            continue
        site = int(model.wrap_objid[j])
        if last >= 0:
            found.append((last, site, scale))
        last = site
    return found
