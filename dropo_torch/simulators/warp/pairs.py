"""Which geoms may touch: MuJoCo's filters, once, for all configurations."""

from __future__ import annotations

import mujoco
import numpy as np

from dropo_torch.simulators.warp.couplings import has_dofs

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


def candidate_pairs(model: mujoco.MjModel) -> list[tuple[int, int, int]]:
    """Return the geom pairs that may touch, as ``(geom1, geom2, pair)``.

    The geom of the smaller type comes first, as in MuJoCo; ``pair`` is the number of an explicit contact pair,
    or −1.
    """
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        return []
    found: dict[tuple[int, int], int] = {}
    for i in range(model.npair):
        found[_ordered(model, int(model.pair_geom1[i]), int(model.pair_geom2[i]))] = i
    excluded = {int(s) for s in model.exclude_signature}
    for g1 in range(model.ngeom):
        for g2 in range(g1 + 1, model.ngeom):
            key = _ordered(model, g1, g2)
            if key not in found and _dynamic(model, g1, g2, excluded):
                found[key] = -1
    plane = [all(model.geom_type[g] == _PLANE for g in key) for key in found]
    moving = [any(has_dofs(model, int(model.geom_bodyid[g])) for g in key) for key in found]
    return [(*key, i) for (key, i), p, m in zip(found.items(), plane, moving, strict=True) if m and not p]


def _ordered(model: mujoco.MjModel, g1: int, g2: int) -> tuple[int, int]:
    return (g1, g2) if model.geom_type[g1] <= model.geom_type[g2] else (g2, g1)


def _dynamic(model: mujoco.MjModel, g1: int, g2: int, excluded: set[int]) -> bool:
    """Whether two geoms without an explicit pair pass MuJoCo's filters."""
    one = model.geom_contype[g1] & model.geom_conaffinity[g2]
    two = model.geom_contype[g2] & model.geom_conaffinity[g1]
    if not (one or two):
        return False
    b1, b2 = sorted((int(model.geom_bodyid[g1]), int(model.geom_bodyid[g2])))
    if (b1 << 16) + b2 in excluded:
        return False
    w1, w2 = int(model.body_weldid[b1]), int(model.body_weldid[b2])
    if w1 == w2:
        return False
    parents = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    p1, p2 = (int(model.body_weldid[model.body_parentid[w]]) for w in (w1, w2))
    return not (parents and w1 and w2 and (w1 == p2 or w2 == p1))


def joins_branches(model: mujoco.MjModel, body1: int, body2: int) -> bool:
    """Whether a constraint between two bodies couples dofs that are not on one chain to the root."""
    one, two = chain(model, body1), chain(model, body2)
    return bool(one - two) and bool(two - one)


def chain(model: mujoco.MjModel, body: int) -> set[int]:
    """Return the dofs that move a body."""
    dofs = set()
    while body:
        first, count = int(model.body_dofadr[body]), int(model.body_dofnum[body])
        dofs |= set(range(first, first + count))
        body = int(model.body_parentid[body])
    return dofs


def relative_dofs(model: mujoco.MjModel, body1: int, body2: int) -> list[tuple[int, int]]:
    """Return the dofs that move one body relative to the other, in order, and −1 for the first's or 1."""
    one, two = chain(model, body1), chain(model, body2)
    return [(dof, 1 if dof in two else -1) for dof in sorted(one ^ two)]


def condim(model: mujoco.MjModel, g1: int, g2: int, pair: int) -> int:
    """Dimension of a contact: the pair's own, the higher priority's or the larger."""
    if pair >= 0:
        return int(model.pair_dim[pair])
    p1, p2 = model.geom_priority[g1], model.geom_priority[g2]
    d1, d2 = int(model.geom_condim[g1]), int(model.geom_condim[g2])
    if p1 != p2:
        return d1 if p1 > p2 else d2
    return max(d1, d2)


def mixing(model: mujoco.MjModel, pairs: list[tuple[int, int, int]]) -> np.ndarray:
    """Weight of the first geom in each pair's solref and solimp, ``(n,)``."""
    table = np.array(pairs, dtype=int).reshape(-1, 3)
    (p1, p2), (s1, s2) = model.geom_priority[table[:, :2]].T, model.geom_solmix[table[:, :2]].T
    first, second = s1 >= 1e-15, s2 >= 1e-15
    mixed = s1 / np.where(first & second, s1 + s2, 1.0)
    return np.select([p1 != p2, first & second, ~first & ~second], [p1 > p2, mixed, 0.5], first).astype(float)
