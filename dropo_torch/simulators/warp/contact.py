"""Contacts: their Jacobians and softness, and the adjoint of −f Jλ in the two bodies' motions, their poses, and θ.

A leaf gives the gradient in J a, J q̇, Jλ and the distance; what follows is how these and the contact's point and
frame hang on the bodies. A quantity fixed in the world (Y, ``f_pose``) takes X ×* F_X for every F_X it gave, so that
the sweep inwards can treat all bodies beyond a joint as displaced together.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.cone import cone_force, cone_of, cone_piece, elliptic_power, normal_d
from dropo_torch.simulators.warp.impedance import damping, regularization
from dropo_torch.simulators.warp.soft import Soft, soft_adjoint, softness
from dropo_torch.simulators.warp.spatial import add_at, ang, at, cross_force, join, late, pull, theta_vec2, theta_vec5
from dropo_torch.simulators.warp.touch import geometry_adjoint
from dropo_torch.simulators.warp.types import ONE, ZERO, Tables, World, f64, mat33, vec3, vec6


@wp.func(inline=False)
def in_frame(frame: mat33, x: vec6, p: vec3) -> vec6:
    """The motion ``x`` at ``p`` along the contact's axes, then its rotation about them."""
    return join(frame * at(x, p), frame * ang(x))


@wp.func(inline=True)
def fills_in(m: wp.ref[Tables], w: wp.ref[World], ncon: int) -> int:
    """1 if H has entries beyond the tree's, because a contact joins two branches."""
    dense = m.always_dense
    for c in range(ncon):
        if m.pair_dense[w.con_pair[w.t, c]] != 0:
            dense = 1
    return dense


@wp.func(inline=True)
def contact_softness(m: wp.ref[Tables], w: wp.ref[World], c: int) -> Soft:
    """The softness of a contact along its normal."""
    k = w.con_pair[w.t, c]
    x = w.con_dist[w.t, c] - w.th[m.o_pair_margin + k]
    return softness(m, w, m.o_pair_solref + 2 * k, m.o_pair_solimp + 5 * k, w.th[m.o_pair_invweight + k], x)


@wp.func(inline=True)
def make_contacts(m: wp.ref[Tables], w: wp.ref[World], ncon: int):
    """Jacobian, reference acceleration and D of each contact."""
    for c in range(ncon):
        k = w.con_pair[w.t, c]
        b1 = m.pair_body1[k]
        b2 = m.pair_body2[k]
        p = w.con_point[w.t, c]
        frame = w.con_frame[w.t, c]
        first = m.pair_dofadr[k]
        for a in range(m.pair_dofadr[k + 1] - first):
            motion = w.motion[w.t, m.pair_dof[first + a]]
            w.con_jac[w.t, c * m.nv + a] = in_frame(frame, motion, p) * f64(m.pair_sign[first + a])
        v = in_frame(frame, w.velocity[w.t, b2] - w.velocity[w.t, b1], p)
        soft = contact_softness(m, w, c)
        friction_ref = theta_vec2(w.th, m.o_pair_solreffriction + 2 * k)
        bf = soft.b
        if m.elliptic != 0 and (friction_ref[0] != ZERO or friction_ref[1] != ZERO):
            bf = damping(friction_ref, theta_vec5(w.th, soft.o_imp), m.h, m.refsafe)
        aref = v * -bf
        aref[0] = -soft.b * v[0] - soft.k * soft.imp * soft.x
        w.con_aref[w.t, c] = aref
        mu = w.th[m.o_pair_friction + 5 * k]
        w.con_d[w.t, c] = normal_d(
            m.pair_dim[k], m.elliptic, regularization(soft.imp, ONE), soft.weight, mu, m.impratio
        )


@wp.func(inline=True)
def contacts_adjoint(m: wp.ref[Tables], w: wp.ref[World], ncon: int):
    """Add the gradient of Σ −f Jλ over the contacts to the bodies' F and Y and to θ."""
    _late = wp.grad(late)(ONE)
    for c in range(ncon):
        k = w.con_pair[w.t, c]
        frame = w.con_frame[w.t, c]
        p = w.con_point[w.t, c]
        b1 = m.pair_body1[k]
        b2 = m.pair_body2[k]
        u = w.total[w.t, b2] - w.total[w.t, b1]
        v = w.velocity[w.t, b2] - w.velocity[w.t, b1]
        dual = w.dual[w.t, b2] - w.dual[w.t, b1]
        ju = in_frame(frame, u, p)
        jv = in_frame(frame, v, p)
        jl = in_frame(frame, dual, p)
        ub = vec6()
        vb = vec6()
        lb = vec6()
        distbar = f64(0.0)
        if m.elliptic != 0 and m.pair_dim[k] > 1:
            ub, vb, lb, distbar = _elliptic_adjoint(m, w, c, ju, jv, jl)
        else:
            ub, vb, lb, distbar = _pyramid_adjoint(m, w, c, ju, jv, jl)
        if wp.length_sq(ub) > ZERO or wp.length_sq(lb) > ZERO:
            _hang(m, w, c, u, v, dual, ub, vb, lb, distbar)


@wp.func(inline=True)
def _elliptic_adjoint(m: wp.ref[Tables], w: wp.ref[World], c: int, ju: vec6, jv: vec6, jl: vec6):
    """Adjoints of J a, J q̇, Jλ and the distance of a contact with an elliptic cone; adds that of θ."""
    k = w.con_pair[w.t, c]
    o_mu = m.o_pair_friction + 5 * k
    o_ref = m.o_pair_solref + 2 * k
    o_fref = m.o_pair_solreffriction + 2 * k
    o_imp = m.o_pair_solimp + 5 * k
    _d, ub, vb, lb, distbar, marginbar, mubar, refbar, frefbar, impbar, wbar, _r, _h, _s = wp.grad(elliptic_power)(
        m.pair_dim[k], ju, jv, jl, w.con_dist[w.t, c], w.th[m.o_pair_margin + k], theta_vec5(w.th, o_mu),
        theta_vec2(w.th, o_ref), theta_vec2(w.th, o_fref), theta_vec5(w.th, o_imp), w.th[m.o_pair_invweight + k],
        m.impratio, m.h, m.refsafe,
    )  # fmt: skip
    w.grad[w.t, m.o_pair_margin + k] += marginbar
    w.grad[w.t, m.o_pair_invweight + k] += wbar
    add_at(w.grad, w.t, o_ref, refbar)
    add_at(w.grad, w.t, o_fref, frefbar)
    add_at(w.grad, w.t, o_mu, mubar)
    add_at(w.grad, w.t, o_imp, impbar)
    return ub, vb, lb, distbar


@wp.func(inline=True)
def _pyramid_adjoint(m: wp.ref[Tables], w: wp.ref[World], c: int, ju: vec6, jv: vec6, jl: vec6):
    """Adjoints of J a, J q̇, Jλ and the distance of a contact with a pyramid, or without friction; adds that of θ.

    With the force f and the Hessian C of the cost at jar6 = J a − aref, −f Jλ has the gradient C Jλ in jar6.
    """
    _late = wp.grad(late)(ONE)
    k = w.con_pair[w.t, c]
    o_mu = m.o_pair_friction + 5 * k
    soft = contact_softness(m, w, c)
    jar6 = ju + jv * soft.b
    jar6[0] += soft.k * soft.imp * soft.x
    dim = m.pair_dim[k]
    d = normal_d(dim, 0, regularization(soft.imp, ONE), soft.weight, w.th[o_mu], m.impratio)
    cone = cone_of(m, w, k, d)
    wbar = vec6()
    lbar = vec6()
    distbar = f64(0.0)
    if cone_piece(cone, jar6) != 0:
        f = cone_force(cone, jar6)
        lbar = -f
        if dim == 1:
            wbar[0] = d * jl[0]
        for i in range(1, dim):
            mu = cone.mu[i - 1]
            for sign in range(2):
                e = mu * f64(1.0 - 2.0 * float(sign))
                jar = jar6[0] + e * jar6[i]
                if jar < ZERO:
                    slope = d * (jl[0] + e * jl[i])
                    wbar[0] += slope
                    wbar[i] += e * slope
                    w.grad[w.t, o_mu + i - 1] += (e / mu) * (jar6[i] * slope + jl[i] * d * jar)
        distbar, weightbar, mubar = soft_adjoint(
            m, w, soft, dim, cone.mu[0], d, -wp.dot(f, jl) / d, wp.dot(jv, wbar), wbar[0]
        )
        w.grad[w.t, m.o_pair_margin + k] -= distbar
        w.grad[w.t, m.o_pair_invweight + k] += weightbar
        w.grad[w.t, o_mu] += mubar
    return wbar, wbar * soft.b, lbar, distbar


@wp.func(inline=True)
def _hang(
    m: wp.ref[Tables],
    w: wp.ref[World],
    c: int,
    u: vec6,
    v: vec6,
    dual: vec6,
    ub: vec6,
    vb: vec6,
    lb: vec6,
    distbar: f64,
):
    """Hang the adjoints of J a, J q̇, Jλ and the distance on the two bodies: F_U, F_V, F_Λ and Y."""
    _late = wp.grad(late)(ONE)
    k = w.con_pair[w.t, c]
    p = w.con_point[w.t, c]
    back = wp.transpose(w.con_frame[w.t, c])
    # p enters J x through x_lin + x_ang × p
    pbar = (
        wp.cross(back * vec3(ub[0], ub[1], ub[2]), ang(u))
        + wp.cross(back * vec3(vb[0], vb[1], vb[2]), ang(v))
        + wp.cross(back * vec3(lb[0], lb[1], lb[2]), ang(dual))
    )
    xu = at(u, p)
    xv = at(v, p)
    xl = at(dual, p)
    nbar = xu * ub[0] + xv * vb[0] + xl * lb[0] + ang(u) * ub[3] + ang(v) * vb[3] + ang(dual) * lb[3]
    t1bar = xu * ub[1] + xv * vb[1] + xl * lb[1] + ang(u) * ub[4] + ang(v) * vb[4] + ang(dual) * lb[4]
    t2bar = xu * ub[2] + xv * vb[2] + xl * lb[2] + ang(u) * ub[5] + ang(v) * vb[5] + ang(dual) * lb[5]
    y1, y2 = geometry_adjoint(m, w, c, distbar, pbar, nbar, t1bar, t2bar)
    fu = _spread(back, ub, p)
    fv = _spread(back, vb, p)
    fl = _spread(back, lb, p)
    _hang_on(w, m.pair_body1[k], y1, -fu, -fv, -fl)
    _hang_on(w, m.pair_body2[k], y2, fu, fv, fl)


@wp.func(inline=True)
def _hang_on(w: wp.ref[World], b: int, y: vec6, fu: vec6, fv: vec6, fl: vec6):
    """Add to F_U, F_V, F_Λ and Y of a body."""
    if b > 0:
        pose = y + (cross_force(w.total[w.t, b], fu) + cross_force(w.velocity[w.t, b], fv))
        w.f_total[w.t, b] = w.f_total[w.t, b] + fu
        w.f_velocity[w.t, b] = w.f_velocity[w.t, b] + fv
        w.f_dual[w.t, b] = w.f_dual[w.t, b] + fl
        w.f_pose[w.t, b] = w.f_pose[w.t, b] + (pose + cross_force(w.dual[w.t, b], fl))


@wp.func(inline=False)
def _spread(back: mat33, x: vec6, p: vec3) -> vec6:
    """Adjoint of :func:`in_frame` in its motion."""
    return pull(back * wp.spatial_top(x), p, back * wp.spatial_bottom(x))
