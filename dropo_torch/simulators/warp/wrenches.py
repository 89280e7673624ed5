"""Wrenches on bodies from outside, among a step's inputs: forces at the centers of mass, and torques.

In the world's axes, six numbers for each body as in ``xfrc_applied``; behind the controls, and before what is applied
to degrees of freedom.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.fluid import center_of_mass
from dropo_torch.simulators.warp.spatial import add_at, ang, at, join, vec3_at, wrench
from dropo_torch.simulators.warp.types import Tables, World, vec3, vec6


@wp.func(inline=True)
def wrench_column(m: wp.ref[Tables], w: wp.ref[World], b: int) -> int:
    """Column of the inputs in which a body's force begins; its torque follows."""
    return w.ctrl.shape[1] - m.nv * w.applied - 6 * (m.nb - b)


@wp.func(inline=True)
def outer_wrench(m: wp.ref[Tables], w: wp.ref[World], b: int) -> vec6:
    """The wrench on a body as a spatial force."""
    i = wrench_column(m, w, b)
    return wrench(vec3_at(w.ctrl, w.rc, i), center_of_mass(m, w, b)) + join(vec3_at(w.ctrl, w.rc, i + 3), vec3())


@wp.func(inline=True)
def outer_wrench_adjoint(m: wp.ref[Tables], w: wp.ref[World], b: int, dual: vec6):
    """Gradient of −Λ · (wrench on the body), which turns with nothing."""
    i = wrench_column(m, w, b)
    f = vec3_at(w.ctrl, w.rc, i)
    torque = vec3_at(w.ctrl, w.rc, i + 3)
    c = center_of_mass(m, w, b)
    u = at(dual, c)
    w.f_dual[w.t, b] = w.f_dual[w.t, b] - wrench(f, c) - join(torque, vec3())
    w.f_pose[w.t, b] = w.f_pose[w.t, b] + join(wp.cross(f, u) + wp.cross(torque, ang(dual)), vec3())
    add_at(w.grad, w.t, m.o_ipos + 3 * b, wp.transpose(w.xmat[w.t, b]) * wp.cross(ang(dual), f))
    add_at(w.ctrl_bar, w.rb, i, -u)
    add_at(w.ctrl_bar, w.rb, i + 3, -ang(dual))
