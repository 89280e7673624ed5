"""What the implicit integrators take of velocity products and of the medium: A = M + h B with a full B.

The slope of the bias force is taken of all bodies (implicit), or of those whose tree moves as one free rigid body
(implicitfast), where MuJoCo takes the gyroscopic forces so, too; that of the medium's forces of all bodies. The matrix
keeps the sparsity of the tree, and is not symmetric.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.ellipsoid import ellipsoid_slope, ellipsoid_slope_power, fluid_center, fluid_frame
from dropo_torch.simulators.warp.fluid import box_slope_power, box_slopes, center_of_mass, inertial_frame
from dropo_torch.simulators.warp.kinematics import packed
from dropo_torch.simulators.warp.spatial import (
    add_at,
    ang,
    at,
    cross_force,
    cross_motion,
    inertia_mul,
    join,
    late,
    lin,
    theta_vec3,
    wrench,
)
from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, ZERO, Reals2, Tables, World, mat66, vec3, vec6, vec10


@wp.func(inline=False)
def unit(k: int) -> vec6:
    """The k-th unit vector."""
    x = vec6()
    x[k] = ONE
    return x


@wp.func(inline=False)
def turning_slope(i: vec10, v: vec6) -> mat66:
    """The operator x → I (x × V) + x ×* I V + V ×* I x of a body."""
    out = mat66()
    momentum = inertia_mul(i, v)
    for k in range(6):
        x = unit(k)
        y = inertia_mul(i, cross_motion(x, v)) + cross_force(x, momentum) + cross_force(v, inertia_mul(i, x))
        for j in range(6):
            out[j, k] = y[j]
    return out


@wp.func(inline=False)
def box_slope(m: wp.ref[Tables], w: wp.ref[World], b: int) -> mat66:
    """Minus the slope of the drag on the body's inertia box in its velocity V."""
    rot = inertial_frame(m, w, b)
    back = wp.transpose(rot)
    c = center_of_mass(m, w, b)
    v = w.velocity[w.t, b]
    turn, move = box_slopes(
        back * ang(v), back * (at(v, c) - theta_vec3(w.th, m.o_wind)), theta_vec3(w.th, m.o_inertia + 3 * b),
        w.th[m.o_mass + b], w.th[m.o_density], w.th[m.o_viscosity],
    )  # fmt: skip
    out = mat66()
    for k in range(6):
        x = unit(k)
        y = wrench(rot * wp.cw_mul(move, back * at(x, c)), c) + join(rot * wp.cw_mul(turn, back * ang(x)), vec3())
        for j in range(6):
            out[j, k] = y[j]
    return out


@wp.func(inline=False)
def ellipsoids_slope(m: wp.ref[Tables], w: wp.ref[World], b: int) -> mat66:
    """Minus the slope of the medium's forces on the body's ellipsoids in its velocity V."""
    out = mat66()
    v = w.velocity[w.t, b]
    first = m.body_fluid[b]
    for i in range(first, first + m.body_nfluid[b]):
        g = m.fluid_geom[i]
        rot = fluid_frame(m, w, b, g)
        back = wp.transpose(rot)
        c = fluid_center(m, w, b, g)
        local = mat66()
        for k in range(6):
            x = unit(k)
            y = ellipsoid_slope(
                back * ang(v), back * (at(v, c) - theta_vec3(w.th, m.o_wind)), ang(x), lin(x), m.fluid_size[i],
                m.fluid_drag[i], m.fluid_lift[i], m.fluid_mass[i], m.fluid_inertia[i], w.th[m.o_density],
                w.th[m.o_viscosity],
            )  # fmt: skip
            for j in range(6):
                local[j, k] = y[j]
        if m.symmetric_fluid != 0:
            local = (local + wp.transpose(local)) * HALF
        for k in range(6):
            x = unit(k)
            y = local * join(back * ang(x), back * at(x, c))
            z = wrench(rot * lin(y), c) + join(rot * ang(y), vec3())
            for j in range(6):
                out[j, k] -= z[j]
    return out


@wp.func(inline=False)
def body_slopes(m: wp.ref[Tables], w: wp.ref[World]):
    """Sums over subtrees of the operators that act on s in a column of B, into ``w.slope``."""
    for b in range(1, m.nb):
        out = mat66()
        if m.body_massive[b] != 0:
            if m.body_turning[b] != 0:
                out = turning_slope(w.inertia[w.t, b], w.velocity[w.t, b])
            if m.implicit_fluid != 0 and w.th[m.o_mass + b] >= MINVAL:
                if m.body_nfluid[b] != 0:
                    out += ellipsoids_slope(m, w, b)
                else:
                    out += box_slope(m, w, b)
        w.slope[w.t, b] = out
    for back in range(1, m.nb):
        b = m.nb - back
        p = m.body_parent[b]
        if p > 0:
            w.slope[w.t, p] = w.slope[w.t, p] + w.slope[w.t, b]


@wp.func(inline=False)
def swings(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Slope of the bodies' acceleration in each velocity, less s × V: V₋ × s + V₊ × s of its joint, in ``w.swing``."""
    for b in range(1, m.nb):
        v = w.velocity[w.t, m.body_parent[b]]
        first = m.body_link[b]
        for k in range(first, first + m.body_nlink[b]):
            d = m.link_dof[k]
            after = v
            for i in range(d, d + m.link_ndof[k]):
                after += w.motion[w.t, i] * w.qvel[r, i]
            for i in range(d, d + m.link_ndof[k]):
                w.swing[w.t, i] = vec6()
                if m.body_turning[b] != 0:
                    w.swing[w.t, i] = cross_motion(v + after, w.motion[w.t, i])
            v = after


@wp.func(inline=False)
def fill_slopes(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """soft_hess[r] = M + h B, all of it, but for the part of B that is diagonal."""
    for i in range(m.nv * m.nv):
        w.soft_hess[r, i] = ZERO
    body_slopes(m, w)
    swings(m, w, r)
    for i in range(m.nv):
        b = m.dof_body[i]
        s = w.motion[w.t, i]
        composite = w.composite[w.t, b]
        own = w.slope[w.t, b] * s + inertia_mul(composite, w.swing[w.t, i])
        momentum = inertia_mul(composite, s)
        row = wp.transpose(w.slope[w.t, b]) * s
        w.soft_hess[r, i * m.nv + i] = w.mass[w.t, packed(i, i)] + m.h * wp.dot(s, own)
        j = m.dof_parent[0, i]
        while j >= 0:
            sj = w.motion[w.t, j]
            mij = w.mass[w.t, packed(i, 0) + j]
            w.soft_hess[r, i * m.nv + j] = mij + m.h * (wp.dot(row, sj) + wp.dot(momentum, w.swing[w.t, j]))
            w.soft_hess[r, j * m.nv + i] = mij + m.h * wp.dot(sj, own)
            j = m.dof_parent[0, j]


@wp.func(inline=False)
def factor_full(m: wp.ref[Tables], a: Reals2, r: int):
    """A = U L in place, from the last dof to the first: U has ones on its diagonal, and there is no fill-in."""
    n = m.nv
    for back in range(n):
        k = n - 1 - back
        inv = ONE / a[r, k * n + k]
        i = m.dof_parent[0, k]
        while i >= 0:
            u = a[r, i * n + k] * inv
            a[r, i * n + k] = u
            j = m.dof_parent[0, k]
            while j >= 0:
                a[r, i * n + j] -= u * a[r, k * n + j]
                j = m.dof_parent[0, j]
            i = m.dof_parent[0, i]


@wp.func(inline=False)
def solve_full(m: wp.ref[Tables], a: Reals2, r: int, x: Reals2, rx: int):
    """x ← A⁻¹ x with the factor of :func:`factor_full`."""
    n = m.nv
    for back in range(n):
        k = n - 1 - back
        xk = x[rx, k]
        i = m.dof_parent[0, k]
        while i >= 0:
            x[rx, i] -= a[r, i * n + k] * xk
            i = m.dof_parent[0, i]
    for k in range(n):
        xk = x[rx, k]
        j = m.dof_parent[0, k]
        while j >= 0:
            xk -= a[r, k * n + j] * x[rx, j]
            j = m.dof_parent[0, j]
        x[rx, k] = xk / a[r, k * n + k]


@wp.func(inline=False)
def solve_full_transposed(m: wp.ref[Tables], a: Reals2, r: int, x: Reals2, rx: int):
    """x ← A⁻ᵀ x with the factor of :func:`factor_full`."""
    n = m.nv
    for back in range(n):
        k = n - 1 - back
        xk = x[rx, k] / a[r, k * n + k]
        x[rx, k] = xk
        j = m.dof_parent[0, k]
        while j >= 0:
            x[rx, j] -= a[r, k * n + j] * xk
            j = m.dof_parent[0, j]
    for k in range(n):
        xk = x[rx, k]
        i = m.dof_parent[0, k]
        while i >= 0:
            xk -= a[r, i * n + k] * x[rx, i]
            i = m.dof_parent[0, i]
        x[rx, k] = xk


@wp.func(inline=True)
def fluid_slopes_adjoint(m: wp.ref[Tables], w: wp.ref[World]):
    """Gradient of Λᵀ G U of each body, G minus the slope of the medium's forces, in Λ, U, V, pose and θ."""
    _late = wp.grad(late)(ONE)
    for b in range(m.nb):
        w.f_velocity[w.t, b] = vec6()
        w.f_accel[w.t, b] = vec6()
        w.f_dual[w.t, b] = vec6()
        w.f_total[w.t, b] = vec6()
        w.f_pose[w.t, b] = vec6()
        if m.body_massive[b] != 0 and w.th[m.o_mass + b] >= MINVAL:
            if m.body_nfluid[b] != 0:
                _ellipsoids_slope_adjoint(m, w, b)
            else:
                _box_slope_adjoint(m, w, b)


@wp.func(inline=True)
def _box_slope_adjoint(m: wp.ref[Tables], w: wp.ref[World], b: int):
    rot = inertial_frame(m, w, b)
    back = wp.transpose(rot)
    c = center_of_mass(m, w, b)
    v = w.velocity[w.t, b]
    dual = w.dual[w.t, b]
    u = w.total[w.t, b]
    wind = theta_vec3(w.th, m.o_wind)
    wbar, vbar, lwbar, lvbar, uwbar, uvbar, xbar, massbar, denbar, visbar = wp.grad(box_slope_power)(
        back * ang(v), back * (at(v, c) - wind), back * ang(dual), back * at(dual, c), back * ang(u), back * at(u, c),
        theta_vec3(w.th, m.o_inertia + 3 * b), w.th[m.o_mass + b], w.th[m.o_density], w.th[m.o_viscosity],
    )  # fmt: skip
    fv = rot * vbar
    fl = rot * lvbar
    fu = rot * uvbar
    _push(m, w, b, c, fv, fl, fu, rot * wbar, rot * lwbar, rot * uwbar)
    w.grad[w.t, m.o_density] += denbar
    w.grad[w.t, m.o_viscosity] += visbar
    w.grad[w.t, m.o_mass + b] += massbar
    add_at(w.grad, w.t, m.o_inertia + 3 * b, xbar)
    cbar = wp.cross(fv, ang(v)) + wp.cross(fl, ang(dual)) + wp.cross(fu, ang(u))
    add_at(w.grad, w.t, m.o_ipos + 3 * b, wp.transpose(w.xmat[w.t, b]) * cbar)


@wp.func(inline=True)
def _ellipsoids_slope_adjoint(m: wp.ref[Tables], w: wp.ref[World], b: int):
    v = w.velocity[w.t, b]
    dual = w.dual[w.t, b]
    u = w.total[w.t, b]
    wind = theta_vec3(w.th, m.o_wind)
    first = m.body_fluid[b]
    for i in range(first, first + m.body_nfluid[b]):
        g = m.fluid_geom[i]
        rot = fluid_frame(m, w, b, g)
        back = wp.transpose(rot)
        c = fluid_center(m, w, b, g)
        wbar, vbar, lwbar, lvbar, uwbar, uvbar, _s, _d, _l, _m, _i, denbar, visbar, _y = wp.grad(ellipsoid_slope_power)(
            back * ang(v), back * (at(v, c) - wind), back * ang(dual), back * at(dual, c), back * ang(u),
            back * at(u, c), m.fluid_size[i], m.fluid_drag[i], m.fluid_lift[i], m.fluid_mass[i], m.fluid_inertia[i],
            w.th[m.o_density], w.th[m.o_viscosity], m.symmetric_fluid,
        )  # fmt: skip
        _push(m, w, b, c, rot * vbar, rot * lvbar, rot * uvbar, rot * wbar, rot * lwbar, rot * uwbar)
        w.grad[w.t, m.o_density] += denbar
        w.grad[w.t, m.o_viscosity] += visbar


@wp.func(inline=True)
def _push(
    m: wp.ref[Tables], w: wp.ref[World], b: int, c: vec3, fv: vec3, fl: vec3, fu: vec3, nv: vec3, nl: vec3, nu: vec3
):  # fmt: skip
    """Add adjoints of V, Λ and U at a point of body ``b``, linear and angular, and of its turning in the wind."""
    zero = vec3()
    w.f_velocity[w.t, b] = w.f_velocity[w.t, b] + wrench(fv, c) + join(nv, zero)
    w.f_dual[w.t, b] = w.f_dual[w.t, b] + wrench(fl, c) + join(nl, zero)
    w.f_total[w.t, b] = w.f_total[w.t, b] + wrench(fu, c) + join(nu, zero)
    w.f_pose[w.t, b] = w.f_pose[w.t, b] - join(wp.cross(fv, theta_vec3(w.th, m.o_wind)), zero)
    add_at(w.grad, w.t, m.o_wind, -fv)
