"""Joint-space forces: springs, dampers and actuators, with their adjoints.

Every ``..._adjoint`` adds the derivatives of −λ·τ to the adjoints of position (in the tangent space), velocity,
control and θ.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.spatial import inverse_right_jacobian_t, quat_log, quat_mul
from dropo_torch.simulators.warp.types import (
    BALL,
    MINVAL,
    SLIDE,
    THREE,
    TRANSLATION,
    TWO,
    ZERO,
    Reals,
    Reals2,
    Scratch,
    Tables,
    f64,
    vec3,
    vec4,
)


@wp.func(inline=True)
def spring_deflection(m: Tables, th: Reals, qpos: Reals2, r: int, k: int) -> vec3:
    """Deflection of spring ``k`` (a joint, or a half of a free joint): x, or a vector of three."""
    iq = m.link_qpos[k]
    o = m.o_spring + iq
    kind = m.link_kind[k]
    if kind == BALL:
        q = vec4(qpos[r, iq], qpos[r, iq + 1], qpos[r, iq + 2], qpos[r, iq + 3])
        ref = vec4(th[o], -th[o + 1], -th[o + 2], -th[o + 3])
        return quat_log(quat_mul(ref, q / wp.length(q)))
    if kind == TRANSLATION:
        return vec3(qpos[r, iq] - th[o], qpos[r, iq + 1] - th[o + 1], qpos[r, iq + 2] - th[o + 2])
    return vec3(qpos[r, iq] - th[o], ZERO, ZERO)


@wp.func(inline=True)
def add_springs(m: Tables, s: Scratch, t: int, th: Reals, qpos: Reals2, r: int):
    """Load from springs: F = −x (k + p0 |x| + p1 |x|²); a hinge's or slide's |x| is signed."""
    for k in range(m.nlink):
        j = m.link_jnt[k]
        stiff = th[m.o_stiffness + j]
        p0 = th[m.o_stiffnesspoly + 2 * j]
        p1 = th[m.o_stiffnesspoly + 2 * j + 1]
        if stiff != ZERO or p0 != ZERO or p1 != ZERO:
            d = m.link_dof[k]
            x = spring_deflection(m, th, qpos, r, k)
            kind = m.link_kind[k]
            if kind <= SLIDE:
                s.load[t, d] += x[0] * (stiff + x[0] * (p0 + x[0] * p1))
            else:
                n = wp.length(x)
                f = x * (stiff + n * (p0 + n * p1))
                for i in range(3):
                    s.load[t, d + i] += f[i]


@wp.func(inline=True)
def springs_adjoint(m: Tables, s: Scratch, t: int, th: Reals, qpos: Reals2, r: int):
    """Adjoint of :func:`add_springs`."""
    for k in range(m.nlink):
        j = m.link_jnt[k]
        ip = m.o_stiffnesspoly + 2 * j
        stiff = th[m.o_stiffness + j]
        p0 = th[ip]
        p1 = th[ip + 1]
        d = m.link_dof[k]
        x = spring_deflection(m, th, qpos, r, k)
        kind = m.link_kind[k]
        if kind <= SLIDE:
            y = x[0]
            jl = s.lam[t, d]
            slope = jl * (stiff + y * (TWO * p0 + y * THREE * p1))
            s.tangent[t, d] += slope
            s.grad[t, m.o_spring + m.link_qpos[k]] -= slope
            s.grad[t, m.o_stiffness + j] += jl * y
            s.grad[t, ip] += jl * y * y
            s.grad[t, ip + 1] += jl * y * y * y
        else:
            lam = vec3(s.lam[t, d], s.lam[t, d + 1], s.lam[t, d + 2])
            n = wp.length(x)
            lx = wp.dot(lam, x)
            s.grad[t, m.o_stiffness + j] += lx
            s.grad[t, ip] += lx * n
            s.grad[t, ip + 1] += lx * n * n
            g = lam * (stiff + n * (p0 + n * p1))
            if n > MINVAL:
                g += x * (lx * (p0 + TWO * n * p1) / n)
            if kind == TRANSLATION:
                for i in range(3):
                    s.tangent[t, d + i] += g[i]
                    s.grad[t, m.o_spring + m.link_qpos[k] + i] -= g[i]
            else:
                g = inverse_right_jacobian_t(x, g)
                for i in range(3):
                    s.tangent[t, d + i] += g[i]


@wp.func(inline=True)
def add_dampers(m: Tables, s: Scratch, t: int, th: Reals, qvel: Reals2, r: int):
    """Load from dampers: F = −v (b + p0 |v| + p1 v²)."""
    for i in range(m.nv):
        v = qvel[r, i]
        n = wp.abs(v)
        ip = m.o_dampingpoly + 2 * i
        s.load[t, i] += v * (th[m.o_damping + i] + n * (th[ip] + n * th[ip + 1]))


@wp.func(inline=True)
def damping_slope(m: Tables, th: Reals, v: f64, i: int) -> f64:
    """B = b + 2 p0 |v| + 3 p1 v²: what the implicit integrators take of the damper."""
    n = wp.abs(v)
    ip = m.o_dampingpoly + 2 * i
    return th[m.o_damping + i] + n * (TWO * th[ip] + THREE * n * th[ip + 1])


@wp.func(inline=True)
def dampers_adjoint(m: Tables, s: Scratch, t: int, th: Reals, qvel: Reals2, r: int):
    """Adjoint of :func:`add_dampers`."""
    for i in range(m.nv):
        v = qvel[r, i]
        n = wp.abs(v)
        jl = s.lam[t, i]
        ip = m.o_dampingpoly + 2 * i
        s.vel_bar[t, i] += jl * damping_slope(m, th, v, i)
        s.grad[t, m.o_damping + i] += jl * v
        s.grad[t, ip] += jl * v * n
        s.grad[t, ip + 1] += jl * v * n * n


@wp.func(inline=True)
def control(m: Tables, th: Reals, ctrl: Reals2, w: int, i: int) -> f64:
    """Control of an actuator, clamped to its range."""
    u = ctrl[w, i]
    if m.clampctrl != 0 and m.act_ctrllimited[i] != 0:
        o = m.o_ctrlrange + 2 * i
        u = wp.min(wp.max(u, th[o]), th[o + 1])
    return u


@wp.func(inline=True)
def actuator_force(m: Tables, th: Reals, i: int, u: f64, length: f64, rate: f64) -> f64:
    """gain(jl, jl̇) u + bias(jl, jl̇), before the force range."""
    og = m.o_gain + 3 * i
    ob = m.o_bias + 3 * i
    gain = th[og]
    if m.act_affine_gain[i] != 0:
        gain += th[og + 1] * length + th[og + 2] * rate
    force = gain * u
    if m.act_affine_bias[i] != 0:
        force += th[ob] + th[ob + 1] * length + th[ob + 2] * rate
    return force


@wp.func(inline=True)
def add_actuators(m: Tables, s: Scratch, t: int, th: Reals, qpos: Reals2, qvel: Reals2, r: int, ctrl: Reals2, w: int):
    """Load from actuators: τ = gear · force, clamped per joint where the joint says so."""
    if m.has_frclimit != 0:
        for i in range(m.nv):
            s.work[t, i] = ZERO
    for i in range(m.nu):
        d = m.act_dof[i]
        gear = th[m.o_gear + i]
        f = actuator_force(m, th, i, control(m, th, ctrl, w, i), gear * qpos[r, m.act_qpos[i]], gear * qvel[r, d])
        if m.act_frclimited[i] != 0:
            o = m.o_forcerange + 2 * i
            f = wp.min(wp.max(f, th[o]), th[o + 1])
        if m.has_frclimit != 0:
            s.work[t, d] += gear * f
        else:
            s.load[t, d] -= gear * f
    if m.has_frclimit != 0:
        for j in range(m.nlink):
            if m.link_kind[j] <= SLIDE:
                d = m.link_dof[j]
                f = s.work[t, d]
                if m.link_frclimited[j] != 0:
                    o = m.o_actfrcrange + 2 * m.link_jnt[j]
                    f = wp.min(wp.max(f, th[o]), th[o + 1])
                s.load[t, d] -= f


@wp.func(inline=True)
def actuators_adjoint(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    r: int,
    ctrl: Reals2,
    w: int,
    ctrl_bar: Reals2,
    wb: int,
):
    """Adjoint of :func:`add_actuators`; ``s.work`` holds ∂(−λτ)/∂τ after the joints' clamps."""
    for i in range(m.nv):
        s.work[t, i] = -s.lam[t, i]
    if m.has_frclimit != 0:
        _frclimit_adjoint(m, s, t, th, qpos, qvel, r, ctrl, w)
    for i in range(m.nu):
        d = m.act_dof[i]
        og = m.o_gain + 3 * i
        ob = m.o_bias + 3 * i
        q = qpos[r, m.act_qpos[i]]
        v = qvel[r, d]
        gear = th[m.o_gear + i]
        u = control(m, th, ctrl, w, i)
        f = actuator_force(m, th, i, u, gear * q, gear * v)
        fbar = gear * s.work[t, d]  # ∂/∂force
        if m.act_frclimited[i] != 0:
            o = m.o_forcerange + 2 * i
            if f < th[o]:
                s.grad[t, o] += fbar
                f = th[o]
                fbar = ZERO
            elif f > th[o + 1]:
                s.grad[t, o + 1] += fbar
                f = th[o + 1]
                fbar = ZERO
        s.grad[t, m.o_gear + i] += f * s.work[t, d]
        gain = th[og]
        slope_l = ZERO
        slope_v = ZERO
        s.grad[t, og] += fbar * u
        if m.act_affine_gain[i] != 0:
            gain += th[og + 1] * gear * q + th[og + 2] * gear * v
            slope_l += th[og + 1] * u
            slope_v += th[og + 2] * u
            s.grad[t, og + 1] += fbar * u * gear * q
            s.grad[t, og + 2] += fbar * u * gear * v
        if m.act_affine_bias[i] != 0:
            slope_l += th[ob + 1]
            slope_v += th[ob + 2]
            s.grad[t, ob] += fbar
            s.grad[t, ob + 1] += fbar * gear * q
            s.grad[t, ob + 2] += fbar * gear * v
        s.tangent[t, d] += fbar * slope_l * gear
        s.vel_bar[t, d] += fbar * slope_v * gear
        s.grad[t, m.o_gear + i] += fbar * (slope_l * q + slope_v * v)
        ubar = fbar * gain
        if m.clampctrl != 0 and m.act_ctrllimited[i] != 0:
            o = m.o_ctrlrange + 2 * i
            if ctrl[w, i] < th[o]:
                s.grad[t, o] += ubar
                ubar = ZERO
            elif ctrl[w, i] > th[o + 1]:
                s.grad[t, o + 1] += ubar
                ubar = ZERO
        ctrl_bar[wb, i] += ubar


@wp.func(inline=True)
def _frclimit_adjoint(
    m: Tables, s: Scratch, t: int, th: Reals, qpos: Reals2, qvel: Reals2, r: int, ctrl: Reals2, w: int
):
    """Zero ``s.work`` of the dofs whose total actuator force is clamped, passing it to the range."""
    for j in range(m.nlink):
        if m.link_frclimited[j] != 0:
            d = m.link_dof[j]
            total = ZERO
            for i in range(m.nu):
                if m.act_dof[i] == d:
                    gear = th[m.o_gear + i]
                    u = control(m, th, ctrl, w, i)
                    f = actuator_force(m, th, i, u, gear * qpos[r, m.act_qpos[i]], gear * qvel[r, d])
                    if m.act_frclimited[i] != 0:
                        o = m.o_forcerange + 2 * i
                        f = wp.min(wp.max(f, th[o]), th[o + 1])
                    total += gear * f
            o = m.o_actfrcrange + 2 * m.link_jnt[j]
            if total < th[o]:
                s.grad[t, o] += s.work[t, d]
                s.work[t, d] = ZERO
            elif total > th[o + 1]:
                s.grad[t, o + 1] += s.work[t, d]
                s.work[t, d] = ZERO
