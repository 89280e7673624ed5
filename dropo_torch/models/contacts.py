"""Which geoms may touch, and how their contacts mix the properties of both, as MuJoCo does it."""

from __future__ import annotations

import mujoco
import numpy as np


def never_touch(model: mujoco.MjModel, body1: int, body2: int) -> bool:
    """Return whether geoms of two bodies never touch: they move as one, hang on each other, or are excluded."""
    weld1, weld2 = (int(model.body_weldid[b]) for b in (body1, body2))
    if weld1 == weld2:
        return True
    above1, above2 = (int(model.body_weldid[model.body_parentid[w]]) for w in (weld1, weld2))
    by_parent = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    if by_parent and weld1 and weld2 and (weld1 == above2 or weld2 == above1):
        return True
    low, high = sorted((body1, body2))
    return bool((model.exclude_signature == (low << 16) + high).any())


def condim(model: mujoco.MjModel, geom1: int, geom2: int) -> int:
    """Return the dimension of the contacts of two geoms: that of the higher priority, or the larger."""
    priority1, priority2 = model.geom_priority[[geom1, geom2]]
    if priority1 != priority2:
        return int(model.geom_condim[geom1 if priority1 > priority2 else geom2])
    return int(model.geom_condim[[geom1, geom2]].max())


def mixing(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Return the weight of the first geom of each pair ``(n, 2)`` in solref and solimp of its contacts, ``(n,)``."""
    (p1, p2), (s1, s2) = model.geom_priority[geoms].T, model.geom_solmix[geoms].T
    first, second = s1 >= 1e-15, s2 >= 1e-15
    mixed = s1 / np.where(first & second, s1 + s2, 1.0)
    return np.select([p1 != p2, first & second, ~first & ~second], [p1 > p2, mixed, 0.5], first).astype(float)
