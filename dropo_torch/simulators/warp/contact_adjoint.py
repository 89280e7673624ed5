"""Adjoint of the contacts: of −f Jλ in the spatial vectors of the two bodies, their poses, and θ.

A leaf gives the gradient in J a, J q̇, Jλ and the distance; what follows is how these and the contact's point and
frame hang on the bodies. A quantity fixed in the world (Y, ``f_pose``) takes X ×* F_X for every F_X it gave, so that
the sweep inwards can treat all bodies beyond a joint as displaced together.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.collide import (
    CAPSULE_BOX,
    PLANE_BOX,
    PLANE_CAPSULE,
    PLANE_CYLINDER,
    PLANE_ELLIPSOID,
    PLANE_SPHERE,
    SPHERE_BOX,
    box_dual,
    capsule_box_dual,
    column,
    corner,
    cylinder_dual,
    cylinder_point,
    ellipsoid_dual,
    ellipsoid_point,
    round_dual,
)
from dropo_torch.simulators.warp.cone import cone_force, cone_piece, elliptic_power, normal_d
from dropo_torch.simulators.warp.contact import geom_centre, geom_rotation, half_axis, in_frame
from dropo_torch.simulators.warp.impedance import damping, impedance_slope, regularisation, stiffness
from dropo_torch.simulators.warp.rows import soft_adjoint, theta_vec2, theta_vec5
from dropo_torch.simulators.warp.spatial import ang, cross_force, join, nothing, wrench
from dropo_torch.simulators.warp.types import (
    HALF,
    MINVAL,
    ONE,
    ZERO,
    Tables,
    World,
    f64,
    mat33,
    vec3,
    vec6,
)


@wp.func
def _row(frame: mat33, i: int) -> vec3:
    return vec3(frame[i, 0], frame[i, 1], frame[i, 2])


@wp.func(inline=True)
def contacts_adjoint(m: Tables, w: World, ncon: int):
    """Add the gradient of Σ −f Jλ over the contacts to the bodies' F and Y and to θ."""
    _late = wp.grad(nothing)(ONE)
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
def _elliptic_adjoint(m: Tables, w: World, c: int, ju: vec6, jv: vec6, jl: vec6):
    """Adjoints of J a, J q̇, Jλ and the distance of a contact with an elliptic cone; adds that of θ."""
    _late = wp.grad(nothing)(ONE)
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
    for i in range(2):
        w.grad[w.t, o_ref + i] += refbar[i]
        w.grad[w.t, o_fref + i] += frefbar[i]
    for i in range(5):
        w.grad[w.t, o_mu + i] += mubar[i]
        w.grad[w.t, o_imp + i] += impbar[i]
    return ub, vb, lb, distbar


@wp.func(inline=True)
def _pyramid_adjoint(m: Tables, w: World, c: int, ju: vec6, jv: vec6, jl: vec6):
    """Adjoints of J a, J q̇, Jλ and the distance of a contact with a pyramid, or without friction; adds that of θ.

    With the force f and the Hessian C of the cost at jar6 = J a − aref, −f Jλ has the gradient C Jλ in jar6.
    """
    _late = wp.grad(nothing)(ONE)
    k = w.con_pair[w.t, c]
    dim = m.pair_dim[k]
    o_mu = m.o_pair_friction + 5 * k
    o_ref = m.o_pair_solref + 2 * k
    o_imp = m.o_pair_solimp + 5 * k
    mu1 = w.th[o_mu]
    solref = theta_vec2(w.th, o_ref)
    solimp = theta_vec5(w.th, o_imp)
    margin = w.th[m.o_pair_margin + k]
    weight = w.th[m.o_pair_invweight + k]
    x = w.con_dist[w.t, c] - margin
    imp = impedance_slope(x, solimp)
    b = damping(solref, solimp, m.h, m.refsafe)
    stiff = stiffness(solref, solimp, m.h, m.refsafe)
    jar6 = ju + jv * b
    jar6[0] += stiff * imp[0] * x
    d = normal_d(dim, 0, regularisation(imp[0], ONE), weight, mu1, m.impratio)
    wbar = vec6()
    lbar = vec6()
    distbar = f64(0.0)
    if cone_piece(dim, 0, w.th, o_mu, m.impratio, jar6) != 0:
        f = cone_force(dim, 0, d, w.th, o_mu, m.impratio, jar6)
        lbar = -f
        if dim == 1:
            wbar[0] = d * jl[0]
        for i in range(1, dim):
            mu = w.th[o_mu + i - 1]
            for sign in range(2):
                e = mu * f64(1.0 - 2.0 * float(sign))
                jar = jar6[0] + e * jar6[i]
                if jar < ZERO:
                    slope = d * (jl[0] + e * jl[i])
                    wbar[0] += slope
                    wbar[i] += e * slope
                    w.grad[w.t, o_mu + i - 1] += (e / mu) * (jar6[i] * slope + jl[i] * d * jar)
        distbar, weightbar, mubar = soft_adjoint(
            m, w, o_ref, o_imp, dim, x, mu1, solref, solimp, weight, imp[0], imp[1], stiff, d,
            -wp.dot(f, jl) / d, wp.dot(jv, wbar), wbar[0],
        )  # fmt: skip
        w.grad[w.t, m.o_pair_margin + k] -= distbar
        w.grad[w.t, m.o_pair_invweight + k] += weightbar
        w.grad[w.t, o_mu] += mubar
    return wbar, wbar * b, lbar, distbar


@wp.func(inline=True)
def _hang(m: Tables, w: World, c: int, u: vec6, v: vec6, dual: vec6, ub: vec6, vb: vec6, lb: vec6, distbar: f64):
    """Hang the adjoints of J a, J q̇, Jλ and the distance on the two bodies: F_U, F_V, F_Λ and Y."""
    _late = wp.grad(nothing)(ONE)
    k = w.con_pair[w.t, c]
    frame = w.con_frame[w.t, c]
    p = w.con_point[w.t, c]
    b1 = m.pair_body1[k]
    b2 = m.pair_body2[k]
    back = wp.transpose(frame)
    fu = _spread(back, ub, p)
    fv = _spread(back, vb, p)
    fl = _spread(back, lb, p)
    # p enters J x through x_lin + x_ang × p
    pbar = (
        wp.cross(back * vec3(ub[0], ub[1], ub[2]), ang(u))
        + wp.cross(back * vec3(vb[0], vb[1], vb[2]), ang(v))
        + wp.cross(back * vec3(lb[0], lb[1], lb[2]), ang(dual))
    )
    xu = vec3(u[3], u[4], u[5]) + wp.cross(ang(u), p)
    xv = vec3(v[3], v[4], v[5]) + wp.cross(ang(v), p)
    xl = vec3(dual[3], dual[4], dual[5]) + wp.cross(ang(dual), p)
    nbar = xu * ub[0] + xv * vb[0] + xl * lb[0] + ang(u) * ub[3] + ang(v) * vb[3] + ang(dual) * lb[3]
    t1bar = xu * ub[1] + xv * vb[1] + xl * lb[1] + ang(u) * ub[4] + ang(v) * vb[4] + ang(dual) * lb[4]
    t2bar = xu * ub[2] + xv * vb[2] + xl * lb[2] + ang(u) * ub[5] + ang(v) * vb[5] + ang(dual) * lb[5]
    y = _geometry_adjoint(m, w, c, distbar, pbar, nbar, t1bar, t2bar)
    y1 = y[0]
    y2 = y[1]
    if b1 > 0:
        y1 -= cross_force(w.total[w.t, b1], fu) + cross_force(w.velocity[w.t, b1], fv)
        y1 -= cross_force(w.dual[w.t, b1], fl)
        w.f_total[w.t, b1] = w.f_total[w.t, b1] - fu
        w.f_velocity[w.t, b1] = w.f_velocity[w.t, b1] - fv
        w.f_dual[w.t, b1] = w.f_dual[w.t, b1] - fl
        w.f_pose[w.t, b1] = w.f_pose[w.t, b1] + y1
    if b2 > 0:
        y2 += cross_force(w.total[w.t, b2], fu) + cross_force(w.velocity[w.t, b2], fv)
        y2 += cross_force(w.dual[w.t, b2], fl)
        w.f_total[w.t, b2] = w.f_total[w.t, b2] + fu
        w.f_velocity[w.t, b2] = w.f_velocity[w.t, b2] + fv
        w.f_dual[w.t, b2] = w.f_dual[w.t, b2] + fl
        w.f_pose[w.t, b2] = w.f_pose[w.t, b2] + y2


@wp.func
def _spread(back: mat33, x: vec6, p: vec3) -> vec6:
    """Adjoint of :func:`in_frame` in its motion."""
    return wrench(back * vec3(x[0], x[1], x[2]), p) + join(back * vec3(x[3], x[4], x[5]), vec3())


@wp.func
def _turned(r: mat33, rbar: mat33) -> vec3:
    """Torque that a rotation's adjoint is: Σ columns r × r̄."""
    return (
        wp.cross(column(r, 0), column(rbar, 0))
        + wp.cross(column(r, 1), column(rbar, 1))
        + wp.cross(column(r, 2), column(rbar, 2))
    )


@wp.func(inline=True)
def _geometry_adjoint(m: Tables, w: World, c: int, distbar: f64, pbar: vec3, nbar0: vec3, t1bar0: vec3, t2bar: vec3):
    """From the adjoints of distance, point and frame to spatial forces on the two geoms' bodies."""
    k = w.con_pair[w.t, c]
    which = w.con_which[w.t, c]
    kind = m.pair_kind[k]
    g1 = m.pair_geom1[k]
    g2 = m.pair_geom2[k]
    frame = w.con_frame[w.t, c]
    n = _row(frame, 0)
    t1 = _row(frame, 1)
    hint = w.con_hint[w.t, c]
    # t2 = n × t1, t1 = (hint − n n·hint) / |...|
    nbar = nbar0 + wp.cross(t1, t2bar)
    t1bar = t1bar0 + wp.cross(t2bar, n)
    along = wp.dot(n, hint)
    length = wp.length(hint - n * along)
    ybar = vec3()
    if length > MINVAL:
        ybar = (t1bar - t1 * wp.dot(t1, t1bar)) / length
    nbar = nbar - ybar * along - hint * wp.dot(n, ybar)
    hintbar = ybar - n * wp.dot(n, ybar)
    c1 = geom_centre(m, w, g1)
    c2 = geom_centre(m, w, g2)
    size = m.geom_size[g2]
    y1 = vec6()
    y2 = vec6()
    if kind <= PLANE_ELLIPSOID:
        # dist = n·(x − c1) − r, p = x − n (r + dist/2), x a point of the second geom
        x = c2
        radius = ZERO
        rot = mat33()
        if kind == PLANE_SPHERE:
            radius = size[0]
        else:
            rot = geom_rotation(m, w, g2)
            if kind == PLANE_CAPSULE:
                radius = size[0]
                x = c2 + hint * (size[1] * (ONE - f64(2.0) * f64(float(which))))
            elif kind == PLANE_BOX:
                x = c2 + rot * corner(which, size)
            elif kind == PLANE_CYLINDER:
                x = cylinder_point(n, c2, rot, size, which)
            else:
                x = ellipsoid_point(n, c2, rot, size)
        slope = distbar - HALF * wp.dot(pbar, n)
        xbar = pbar + n * slope
        nbar = nbar + (x - c1) * slope - pbar * (radius + HALF * w.con_dist[w.t, c])
        torque2 = vec3()
        if kind == PLANE_CAPSULE:
            torque2 = wp.cross(hint, hintbar)
            y2 = wrench(xbar, x)
        elif kind == PLANE_CYLINDER:
            nb, cb, rb, _sb, _w, _x = wp.grad(cylinder_dual)(n, c2, rot, size, which, xbar)
            nbar = nbar + nb
            torque2 = _turned(rot, rb)
            y2 = wrench(cb, c2)
        elif kind == PLANE_ELLIPSOID:
            nb, cb, rb, _sb, _x = wp.grad(ellipsoid_dual)(n, c2, rot, size, xbar)
            nbar = nbar + nb
            torque2 = _turned(rot, rb)
            y2 = wrench(cb, c2)
        else:
            y2 = wrench(xbar, x)
        y2 = y2 + join(torque2, vec3())
        y1 = wrench(n * -slope, c1) + join(wp.cross(n, nbar), vec3())
    elif kind == SPHERE_BOX:
        rot = geom_rotation(m, w, g2)
        cb, rb, _sb, xb, _rb, _d, _p, _n = wp.grad(box_dual)(c2, rot, size, c1, m.geom_size[g1][0], distbar, pbar, nbar)
        y1 = wrench(xb, c1)
        y2 = wrench(cb, c2) + join(_turned(rot, rb), vec3())
    elif kind == CAPSULE_BOX:
        rot = geom_rotation(m, w, g2)
        a1 = half_axis(m, w, g1)
        c1b, a1b, _r1, cb, rb, _sb, _w, _d, _p, _n = wp.grad(capsule_box_dual)(
            c1, a1, m.geom_size[g1][0], c2, rot, size, which, distbar, pbar, nbar
        )
        y1 = wrench(c1b, c1) + join(wp.cross(a1, a1b), vec3())
        y2 = wrench(cb, c2) + join(_turned(rot, rb), vec3())
    else:
        a1 = half_axis(m, w, g1)
        a2 = half_axis(m, w, g2)
        c1b, a1b, _r1, c2b, a2b, _r2, _w, _d, _p, _n = wp.grad(round_dual)(
            c1, a1, m.geom_size[g1][0], c2, a2, size[0], which, distbar, pbar, nbar
        )
        y1 = wrench(c1b, c1) + join(wp.cross(a1, a1b), vec3())
        y2 = wrench(c2b, c2) + join(wp.cross(a2, a2b), vec3())
    return y1, y2
