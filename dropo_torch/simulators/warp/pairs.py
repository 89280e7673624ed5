"""Which geoms may touch: MuJoCo's filters, once, for all configurations."""

from __future__ import annotations

import mujoco

from dropo_torch.models.contacts import condim, never_touch
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
    for g1 in range(model.ngeom):
        for g2 in range(g1 + 1, model.ngeom):
            key = _ordered(model, g1, g2)
            if key not in found and _dynamic(model, g1, g2):
                found[key] = -1
    plane = [all(model.geom_type[g] == _PLANE for g in key) for key in found]
    moving = [any(has_dofs(model, int(model.geom_bodyid[g])) for g in key) for key in found]
    return [(*key, i) for (key, i), p, m in zip(found.items(), plane, moving, strict=True) if m and not p]


def _ordered(model: mujoco.MjModel, g1: int, g2: int) -> tuple[int, int]:
    return (g1, g2) if model.geom_type[g1] <= model.geom_type[g2] else (g2, g1)


def _dynamic(model: mujoco.MjModel, g1: int, g2: int) -> bool:
    """Whether two geoms without an explicit pair pass MuJoCo's filters."""
    one = model.geom_contype[g1] & model.geom_conaffinity[g2]
    two = model.geom_contype[g2] & model.geom_conaffinity[g1]
    return bool(one or two) and not never_touch(model, int(model.geom_bodyid[g1]), int(model.geom_bodyid[g2]))


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


def contact_dimension(model: mujoco.MjModel, g1: int, g2: int, pair: int) -> int:
    """Return the dimension of a contact: the explicit pair's own, or that of its geoms."""
    return int(model.pair_dim[pair]) if pair >= 0 else condim(model, g1, g2)
