"""Tendons: lengths, moment arms and their springs, dampers and armature.

A fixed tendon has constant moment arms; a spatial one is a chain of straight segments between sites. J holds the
moment arms of the degrees of freedom that a tendon can see. An adjoint adds to the lengths' and to J's own, from which
:func:`tendons_adjoint` goes on to the positions: J is the gradient of the length, so that what hangs on J takes the
length's second derivative.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.kinematics import packed
from dropo_torch.simulators.warp.parts import num_tendons
from dropo_torch.simulators.warp.spatial import ang, at, cross_motion
from dropo_torch.simulators.warp.types import MINVAL, ONE, THREE, TWO, ZERO, Reals2, Tables, World, f64, vec3, vec6


@wp.func(inline=True)
def tendon_dot(m: wp.ref[Tables], w: wp.ref[World], k: int, x: Reals2, r: int) -> f64:
    """J x of tendon ``k``."""
    y = f64(0.0)
    for c in range(m.ten_start[k], m.ten_start[k + 1]):
        y += w.ten_jac[w.t, c] * x[r, m.ten_dof[c]]
    return y


@wp.func(inline=True)
def tendon_add(m: wp.ref[Tables], w: wp.ref[World], k: int, y: f64, x: Reals2, r: int):
    """x += Jᵀ y of tendon ``k``."""
    for c in range(m.ten_start[k], m.ten_start[k + 1]):
        x[r, m.ten_dof[c]] += w.ten_jac[w.t, c] * y


@wp.func(inline=True)
def tendon_bar(m: wp.ref[Tables], w: wp.ref[World], k: int, y: f64, x: Reals2, r: int):
    """Adjoint of J of tendon ``k`` in y J x."""
    for c in range(m.ten_start[k], m.ten_start[k + 1]):
        w.ten_jac_bar[w.t, c] += y * x[r, m.ten_dof[c]]


@wp.func(inline=True)
def segment_end(m: wp.ref[Tables], w: wp.ref[World], g: int) -> vec3:
    """An end of a segment."""
    b = m.seg_body[g]
    return w.xpos[w.t, b] + w.xmat[w.t, b] * m.seg_pos[g]


@wp.func(inline=False)
def along(x: vec3) -> vec3:
    """Direction of a segment."""
    n = wp.length(x)
    return wp.where(n < MINVAL, vec3(ONE, ZERO, ZERO), x / n)


@wp.func(inline=True)
def make_tendons(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Length, J and velocity of every tendon."""
    for k in range(num_tendons(m)):
        length = f64(0.0)
        for c in range(m.ten_start[k], m.ten_start[k + 1]):
            w.ten_jac[w.t, c] = m.ten_coef[c]
            if m.ten_spatial[k] == 0:
                length += m.ten_coef[c] * w.qpos[r, m.ten_qpos[c]]
        for g in range(m.ten_segment[k], m.ten_segment[k + 1]):
            p0 = segment_end(m, w, 2 * g)
            p1 = segment_end(m, w, 2 * g + 1)
            length += m.seg_scale[g] * wp.length(p1 - p0)
            _pull_along(m, w, k, 2 * g, p0, along(p1 - p0) * -m.seg_scale[g])
            _pull_along(m, w, k, 2 * g + 1, p1, along(p1 - p0) * m.seg_scale[g])
        w.ten_length[w.t, k] = length
        w.ten_rate[w.t, k] = tendon_dot(m, w, k, w.qvel, r)
        w.ten_force[w.t, k] = ZERO
        w.ten_sum[w.t, k] = ZERO


@wp.func(inline=True)
def _pull_along(m: wp.ref[Tables], w: wp.ref[World], k: int, g: int, p: vec3, f: vec3):
    """Add the moment arms of the force ``f`` at a segment's end to those of tendon ``k``."""
    i = m.body_lastdof[m.seg_body[g]]
    while i >= 0:
        c = m.ten_column[k * m.nv + i]
        w.ten_jac[w.t, c] = w.ten_jac[w.t, c] + wp.dot(f, at(w.motion[w.t, i], p))
        i = m.dof_parent[0, i]


@wp.func(inline=True)
def clear_tendon_bars(m: wp.ref[Tables], w: wp.ref[World]):
    """Adjoints of lengths and of J, empty."""
    for k in range(num_tendons(m)):
        w.ten_length_bar[w.t, k] = ZERO
        for c in range(m.ten_start[k], m.ten_start[k + 1]):
            w.ten_jac_bar[w.t, c] = ZERO


@wp.func(inline=True)
def tendons_adjoint(m: wp.ref[Tables], w: wp.ref[World]):
    """From the adjoints of lengths and J to that of the position."""
    for k in range(num_tendons(m)):
        tendon_add(m, w, k, w.ten_length_bar[w.t, k], w.tangent, w.t)
        for g in range(m.ten_segment[k], m.ten_segment[k + 1]):
            p0 = segment_end(m, w, 2 * g)
            p1 = segment_end(m, w, 2 * g + 1)
            z0 = _bar_motion(m, w, k, 2 * g)
            z1 = _bar_motion(m, w, k, 2 * g + 1)
            e = along(p1 - p0)
            change = at(z1, p1) - at(z0, p0)
            # e' of a segment that changes by x is (x − e e·x) / length
            ebar = (change - e * wp.dot(e, change)) * (m.seg_scale[g] / wp.max(MINVAL, wp.length(p1 - p0)))
            _turn_arms(m, w, k, 2 * g, p0, -ebar, e * -m.seg_scale[g], z0)
            _turn_arms(m, w, k, 2 * g + 1, p1, ebar, e * m.seg_scale[g], z1)


@wp.func(inline=True)
def _bar_motion(m: wp.ref[Tables], w: wp.ref[World], k: int, g: int) -> vec6:
    """Motion of a segment's end if the joints move with the adjoint of J."""
    z = vec6()
    i = m.body_lastdof[m.seg_body[g]]
    while i >= 0:
        z += w.motion[w.t, i] * w.ten_jac_bar[w.t, m.ten_column[k * m.nv + i]]
        i = m.dof_parent[0, i]
    return z


@wp.func(inline=False)
def _turn_arms(m: wp.ref[Tables], w: wp.ref[World], k: int, g: int, p: vec3, pbar: vec3, f: vec3, z: vec6):
    """Tangent of f · (z at p) with the adjoint ``pbar`` of p: a joint displaces p and turns all of z beyond it."""
    force = pbar + wp.cross(f, ang(z))
    beyond = vec6()
    i = m.body_lastdof[m.seg_body[g]]
    while i >= 0:
        n = m.dof_ndof[i]  # of its link, of which it is the last
        for j in range(n):
            beyond = beyond + w.motion[w.t, i - j] * w.ten_jac_bar[w.t, m.ten_column[k * m.nv + i - j]]
        for j in range(n):
            s = w.motion[w.t, i - j]
            w.tangent[w.t, i - j] += wp.dot(force, at(s, p)) + wp.dot(f, at(cross_motion(s, beyond), p))
        i = m.dof_parent[0, i - n + 1]


@wp.func(inline=True)
def spring_stretch(m: wp.ref[Tables], w: wp.ref[World], k: int) -> f64:
    """How far tendon ``k`` is outside the range in which its spring does nothing."""
    length = w.ten_length[w.t, k]
    low = w.th[m.o_ten_lengthspring + 2 * k]
    high = w.th[m.o_ten_lengthspring + 2 * k + 1]
    return wp.where(length > high, length - high, wp.min(length - low, ZERO))


@wp.func(inline=True)
def add_tendon_forces(m: wp.ref[Tables], w: wp.ref[World]):
    """Load from springs, F = −x (k + p0 x + p1 x²), and dampers, F = −v (b + p0 |v| + p1 v²)."""
    for k in range(num_tendons(m)):
        x = ZERO
        if m.ten_sprung[k] != 0:
            x = spring_stretch(m, w, k)
        ip = m.o_ten_stiffnesspoly + 2 * k
        f = x * (w.th[m.o_ten_stiffness + k] + x * (w.th[ip] + x * w.th[ip + 1]))
        if m.ten_damped[k] != 0:
            v = w.ten_rate[w.t, k]
            n = wp.abs(v)
            ip = m.o_ten_dampingpoly + 2 * k
            f += v * (w.th[m.o_ten_damping + k] + n * (w.th[ip] + n * w.th[ip + 1]))
        if f != ZERO:
            tendon_add(m, w, k, f, w.load, w.t)


@wp.func(inline=True)
def tendon_forces_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Adjoint of :func:`add_tendon_forces`."""
    for k in range(num_tendons(m)):
        jl = ZERO
        if m.ten_sprung[k] + m.ten_damped[k] != 0:
            jl = tendon_dot(m, w, k, w.lam, w.t)
        force = ZERO
        if m.ten_sprung[k] != 0:
            x = spring_stretch(m, w, k)
            ip = m.o_ten_stiffnesspoly + 2 * k
            stiff = w.th[m.o_ten_stiffness + k]
            force += x * (stiff + x * (w.th[ip] + x * w.th[ip + 1]))
            slope = jl * (stiff + x * (TWO * w.th[ip] + x * THREE * w.th[ip + 1]))
            if x != ZERO:
                w.ten_length_bar[w.t, k] += slope
                w.grad[w.t, m.o_ten_lengthspring + 2 * k + wp.where(x > ZERO, 1, 0)] -= slope
            w.grad[w.t, m.o_ten_stiffness + k] += jl * x
            w.grad[w.t, ip] += jl * x * x
            w.grad[w.t, ip + 1] += jl * x * x * x
        if m.ten_damped[k] != 0:
            v = w.ten_rate[w.t, k]
            n = wp.abs(v)
            ip = m.o_ten_dampingpoly + 2 * k
            force += v * (w.th[m.o_ten_damping + k] + n * (w.th[ip] + n * w.th[ip + 1]))
            rate_bar(m, w, k, jl * tendon_damping_slope(m, w, k), w.vel_bar, r)
            w.grad[w.t, m.o_ten_damping + k] += jl * v
            w.grad[w.t, ip] += jl * v * n
            w.grad[w.t, ip + 1] += jl * v * n * n
        tendon_bar(m, w, k, force, w.lam, w.t)


@wp.func(inline=True)
def rate_bar(m: wp.ref[Tables], w: wp.ref[World], k: int, bar: f64, vel_bar: Reals2, r: int):
    """Adjoint of the velocity of tendon ``k``, in row ``r``: that of the joints' velocities, and of J."""
    tendon_add(m, w, k, bar, vel_bar, w.t)
    tendon_bar(m, w, k, bar, w.qvel, r)


@wp.func(inline=True)
def tendon_damping_slope(m: wp.ref[Tables], w: wp.ref[World], k: int) -> f64:
    """b + 2 p0 |v| + 3 p1 v² of tendon ``k``."""
    n = wp.abs(w.ten_rate[w.t, k])
    ip = m.o_ten_dampingpoly + 2 * k
    return w.th[m.o_ten_damping + k] + n * (TWO * w.th[ip] + THREE * n * w.th[ip + 1])


@wp.func(inline=False)
def add_outer(m: wp.ref[Tables], w: wp.ref[World], k: int, y: f64, matrix: Reals2, r: int):
    """Add y JᵀJ of tendon ``k`` to a packed matrix, where MuJoCo's M has room for it.

    It has that for dofs of which one is beyond the other, unless M is diagonal there.
    """
    for c in range(m.ten_start[k], m.ten_start[k + 1]):
        i = m.ten_dof[c]
        yi = y * w.ten_jac[w.t, c]
        j = i
        while j >= 0:
            other = m.ten_column[k * m.nv + j]
            if other >= 0:
                matrix[r, packed(i, j)] += yi * w.ten_jac[w.t, other]
            j = wp.where(m.dof_alone[i] != 0, -1, m.dof_parent[0, j])


@wp.func(inline=False)
def outer_dot(m: wp.ref[Tables], w: wp.ref[World], k: int, x: Reals2, rx: int, y: Reals2, ry: int, bar: f64) -> f64:
    """xᵀ (JᵀJ) y with what :func:`add_outer` leaves of JᵀJ; adds ``bar`` times its gradient to the adjoint of J."""
    total = f64(0.0)
    for c in range(m.ten_start[k], m.ten_start[k + 1]):
        i = m.ten_dof[c]
        ji = w.ten_jac[w.t, c]
        j = i
        while j >= 0:
            other = m.ten_column[k * m.nv + j]
            if other >= 0:
                power = x[rx, i] * y[ry, j]
                if i != j:
                    power += x[rx, j] * y[ry, i]
                jj = w.ten_jac[w.t, other]
                total += power * ji * jj
                w.ten_jac_bar[w.t, c] += bar * power * jj
                w.ten_jac_bar[w.t, other] += bar * power * ji
            j = wp.where(m.dof_alone[i] != 0, -1, m.dof_parent[0, j])
    return total


@wp.func(inline=False)
def outer_mul(m: wp.ref[Tables], w: wp.ref[World], k: int, scale: f64, x: Reals2, rx: int, y: Reals2, ry: int):
    """y += scale (JᵀJ) x with what :func:`add_outer` leaves of JᵀJ."""
    for c in range(m.ten_start[k], m.ten_start[k + 1]):
        i = m.ten_dof[c]
        ji = w.ten_jac[w.t, c] * scale
        j = i
        while j >= 0:
            other = m.ten_column[k * m.nv + j]
            if other >= 0:
                jij = ji * w.ten_jac[w.t, other]
                y[ry, i] += jij * x[rx, j]
                if i != j:
                    y[ry, j] += jij * x[rx, i]
            j = wp.where(m.dof_alone[i] != 0, -1, m.dof_parent[0, j])


@wp.func(inline=True)
def add_tendon_armature(m: wp.ref[Tables], w: wp.ref[World]):
    """Add the armature of tendons to M."""
    for k in range(num_tendons(m)):
        armature = w.th[m.o_ten_armature + k]
        if armature != ZERO:
            add_outer(m, w, k, armature, w.mass, w.t)


@wp.func(inline=True)
def tendon_armature_adjoint(m: wp.ref[Tables], w: wp.ref[World]):
    """Gradient of λᵀ M a in the armature of tendons, whose J is constant."""
    for k in range(num_tendons(m)):
        if m.ten_spatial[k] == 0:
            w.grad[w.t, m.o_ten_armature + k] += outer_dot(m, w, k, w.lam, w.t, w.qacc, w.t, ZERO)
