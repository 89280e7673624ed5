"""Actuators at sites: a force and a torque of six gears in a site's frame, such as a propeller's thrust."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.spatial import add_at, ang, at, pull, theta_vec3
from dropo_torch.simulators.warp.types import Tables, World, f64, vec6


@wp.func(inline=True)
def thrust(m: wp.ref[Tables], w: wp.ref[World], i: int) -> vec6:
    """The wrench of a unit force of actuator ``i`` as a spatial force."""
    b = m.act_body[i]
    p = w.xpos[w.t, b] + w.xmat[w.t, b] * m.act_pos[i]
    rot = w.xmat[w.t, b] * m.act_mat[i]
    o = m.o_gear + 6 * i
    return pull(rot * theta_vec3(w.th, o), p, rot * theta_vec3(w.th, o + 3))


@wp.func(inline=True)
def thrust_adjoint(m: wp.ref[Tables], w: wp.ref[World], i: int, f: f64):
    """Adjoint of −Λ · (wrench of the force ``f``), which turns with its body, in Λ and the gears."""
    b = m.act_body[i]
    dual = w.dual[w.t, b]
    p = w.xpos[w.t, b] + w.xmat[w.t, b] * m.act_pos[i]
    back = wp.transpose(w.xmat[w.t, b] * m.act_mat[i])
    w.f_dual[w.t, b] = w.f_dual[w.t, b] - thrust(m, w, i) * f
    add_at(w.grad, w.t, m.o_gear + 6 * i, back * at(dual, p) * -f)
    add_at(w.grad, w.t, m.o_gear + 6 * i + 3, back * ang(dual) * -f)
