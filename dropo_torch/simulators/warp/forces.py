"""Joint-space forces: springs, dampers and actuators, with their adjoints.

Every ``..._adjoint`` adds the derivatives of −λ·τ to the adjoints of position (in the tangent space), velocity,
control and θ.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.activations import clamp, clamp_adjoint, drive, drive_adjoint
from dropo_torch.simulators.warp.parts import is_thrust, num_tendons
from dropo_torch.simulators.warp.rotations import chart_rate, quat_log, quat_mul
from dropo_torch.simulators.warp.spatial import add_at, vec3_at, vec4_at
from dropo_torch.simulators.warp.tendons import (
    add_tendon_forces,
    rate_bar,
    tendon_add,
    tendon_bar,
    tendon_dot,
    tendon_forces_adjoint,
)
from dropo_torch.simulators.warp.thrust import thrust, thrust_adjoint
from dropo_torch.simulators.warp.types import BALL, MINVAL, ONE, THREE, TWO, ZERO, Tables, World, f64, vec3, vec4


@wp.func(inline=True)
def spring_deflection(m: wp.ref[Tables], w: wp.ref[World], r: int, k: int) -> vec3:
    """Deflection of spring ``k`` (a joint, or a half of a free joint): x, or a vector of three."""
    iq = m.link_qpos[k]
    o = m.o_spring + iq
    if m.link_kind[k] == BALL:
        q = vec4_at(w.qpos, r, iq)
        ref = vec4(w.th[o], -w.th[o + 1], -w.th[o + 2], -w.th[o + 3])
        return quat_log(quat_mul(ref, q / wp.length(q)))
    if m.link_ndof[k] == 3:
        return vec3(w.qpos[r, iq] - w.th[o], w.qpos[r, iq + 1] - w.th[o + 1], w.qpos[r, iq + 2] - w.th[o + 2])
    return vec3(w.qpos[r, iq] - w.th[o], ZERO, ZERO)


@wp.func(inline=True)
def add_springs(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Load from springs: F = −x (k + p0 |x| + p1 |x|²); a hinge's or slide's |x| is signed."""
    for k in range(m.nlink):
        j = m.link_jnt[k]
        stiff = w.th[m.o_stiffness + j]
        p0 = w.th[m.o_stiffnesspoly + 2 * j]
        p1 = w.th[m.o_stiffnesspoly + 2 * j + 1]
        if stiff != ZERO or p0 != ZERO or p1 != ZERO:
            d = m.link_dof[k]
            x = spring_deflection(m, w, r, k)
            if m.link_ndof[k] == 1:
                w.load[w.t, d] += x[0] * (stiff + x[0] * (p0 + x[0] * p1))
            else:
                n = wp.length(x)
                add_at(w.load, w.t, d, x * (stiff + n * (p0 + n * p1)))


@wp.func(inline=True)
def springs_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Adjoint of :func:`add_springs`."""
    for k in range(m.nlink):
        j = m.link_jnt[k]
        ip = m.o_stiffnesspoly + 2 * j
        stiff = w.th[m.o_stiffness + j]
        p0 = w.th[ip]
        p1 = w.th[ip + 1]
        d = m.link_dof[k]
        x = spring_deflection(m, w, r, k)
        if m.link_ndof[k] == 1:
            y = x[0]
            jl = w.lam[w.t, d]
            slope = jl * (stiff + y * (TWO * p0 + y * THREE * p1))
            w.tangent[w.t, d] += slope
            w.grad[w.t, m.o_spring + m.link_qpos[k]] -= slope
            w.grad[w.t, m.o_stiffness + j] += jl * y
            w.grad[w.t, ip] += jl * y * y
            w.grad[w.t, ip + 1] += jl * y * y * y
        else:
            lam = vec3_at(w.lam, w.t, d)
            n = wp.length(x)
            lx = wp.dot(lam, x)
            w.grad[w.t, m.o_stiffness + j] += lx
            w.grad[w.t, ip] += lx * n
            w.grad[w.t, ip + 1] += lx * n * n
            g = lam * (stiff + n * (p0 + n * p1))
            if n > MINVAL:
                g += x * (lx * (p0 + TWO * n * p1) / n)
            if m.link_kind[k] == BALL:
                g = chart_rate(-x, g)
            else:
                add_at(w.grad, w.t, m.o_spring + m.link_qpos[k], -g)
            add_at(w.tangent, w.t, d, g)


@wp.func(inline=True)
def damping_slope(m: wp.ref[Tables], w: wp.ref[World], v: f64, i: int) -> f64:
    """B = b + 2 p0 |v| + 3 p1 v²: what the implicit integrators take of the damper."""
    n = wp.abs(v)
    ip = m.o_dampingpoly + 2 * i
    return w.th[m.o_damping + i] + n * (TWO * w.th[ip] + THREE * n * w.th[ip + 1])


@wp.func(inline=True)
def actuator_length(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """Length of an actuator: gear · q of a hinge or slide; of a free joint it is none, of a ball it is not needed."""
    y = ZERO
    if m.act_ndof[i] == 1:
        y = w.th[m.o_gear + 6 * i] * w.qpos[r, m.act_qpos[i]]
    elif m.act_tendon[i] >= 0:
        y = w.th[m.o_gear + 6 * i] * w.ten_length[w.t, m.act_tendon[i]]
    return y


@wp.func(inline=True)
def actuator_rate(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """Velocity of an actuator, gear · q̇, over all dofs of its joint."""
    y = ZERO
    for k in range(m.act_ndof[i]):
        y += w.th[m.o_gear + 6 * i + k] * w.qvel[r, m.act_dof[i] + k]
    if m.act_tendon[i] >= 0:
        y = w.th[m.o_gear + 6 * i] * w.ten_rate[w.t, m.act_tendon[i]]
    return y


@wp.func(inline=True)
def actuator_force(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """gain(l, l̇) u + bias(l, l̇) with length l, velocity l̇ and drive u, before the force range."""
    og = m.o_gain + 3 * i
    ob = m.o_bias + 3 * i
    gain = w.th[og]
    if m.act_affine_gain[i] != 0:
        gain += w.th[og + 1] * actuator_length(m, w, r, i) + w.th[og + 2] * actuator_rate(m, w, r, i)
    force = gain * drive(m, w, r, i)
    if m.act_affine_bias[i] != 0:
        force += w.th[ob] + w.th[ob + 1] * actuator_length(m, w, r, i) + w.th[ob + 2] * actuator_rate(m, w, r, i)
    return force


@wp.func(inline=True)
def ranged_force(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """:func:`actuator_force` within the force range; times the gear, it acts on the joint."""
    f = actuator_force(m, w, r, i)
    if m.act_frclimited[i] != 0:
        f = clamp(w, m.o_forcerange + 2 * i, f)
    return f


@wp.func(inline=True)
def sum_forces(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """What all actuators exert on each dof, before the joints' own ranges, into ``w.work``."""
    for i in range(m.nv):
        w.work[w.t, i] = ZERO
    for i in range(m.nu):
        f = ranged_force(m, w, r, i)
        for k in range(m.act_ndof[i]):
            w.work[w.t, m.act_dof[i] + k] += w.th[m.o_gear + 6 * i + k] * f
        if m.act_tendon[i] >= 0:
            w.ten_force[w.t, m.act_tendon[i]] += w.th[m.o_gear + 6 * i] * f
            w.ten_sum[w.t, m.act_tendon[i]] += f
    for k in range(num_tendons(m)):
        f = tendon_actuation(m, w, k)
        if f != ZERO:
            tendon_add(m, w, k, f, w.work, w.t)


@wp.func(inline=True)
def tendon_actuation(m: wp.ref[Tables], w: wp.ref[World], k: int) -> f64:
    """Force of all actuators of tendon ``k``, scaled so that the sum without gears is within the tendon's range."""
    f = w.ten_force[w.t, k]
    total = w.ten_sum[w.t, k]
    if m.ten_frclimited[k] != 0 and total != ZERO:
        f *= clamp(w, m.o_ten_actfrcrange + 2 * k, total) / total
    return f


@wp.func(inline=False)
def tendon_actuation_adjoint(m: wp.ref[Tables], w: wp.ref[World], k: int, bar: f64):
    """Adjoint of :func:`tendon_actuation`: of the sums with and without gears, in their place."""
    scale = ONE
    sum_bar = ZERO
    total = w.ten_sum[w.t, k]
    if m.ten_frclimited[k] != 0 and total != ZERO:
        o = m.o_ten_actfrcrange + 2 * k
        ranged = clamp(w, o, total)
        scale = ranged / total
        scale_bar = bar * w.ten_force[w.t, k]
        sum_bar = clamp_adjoint(w, o, total, scale_bar / total) - scale_bar * scale / total
    w.ten_force[w.t, k] = bar * scale
    w.ten_sum[w.t, k] = sum_bar


@wp.func(inline=True)
def add_actuators(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Load from actuators, clamped per joint where the joint says so."""
    if m.has_frclimit + num_tendons(m) == 0:
        for i in range(m.nu):
            f = ranged_force(m, w, r, i)
            for k in range(m.act_ndof[i]):
                w.load[w.t, m.act_dof[i] + k] -= w.th[m.o_gear + 6 * i + k] * f
    else:
        sum_forces(m, w, r)
        for j in range(m.nlink):
            d = m.link_dof[j]
            if m.link_frclimited[j] != 0:
                w.work[w.t, d] = clamp(w, m.o_actfrcrange + 2 * m.link_jnt[j], w.work[w.t, d])
        for i in range(m.nv):
            w.load[w.t, i] -= w.work[w.t, i]


@wp.func(inline=True)
def add_thrust(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Subtract from the bodies' forces those of actuators at sites."""
    for i in range(m.nu):
        if is_thrust(m, i):
            b = m.act_body[i]
            w.force[w.t, b] = w.force[w.t, b] - thrust(m, w, i) * ranged_force(m, w, r, i)


@wp.func(inline=True)
def actuators_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Adjoint of :func:`add_actuators`; ``w.work`` comes to hold ∂(−λτ)/∂τ before the joints' ranges."""
    if m.has_frclimit != 0:
        sum_forces(m, w, r)
        for j in range(m.nlink):
            d = m.link_dof[j]
            if m.link_frclimited[j] != 0:
                w.work[w.t, d] = clamp_adjoint(w, m.o_actfrcrange + 2 * m.link_jnt[j], w.work[w.t, d], -w.lam[w.t, d])
            else:
                for k in range(m.link_ndof[j]):
                    w.work[w.t, d + k] = -w.lam[w.t, d + k]
    else:
        if num_tendons(m) != 0:
            sum_forces(m, w, r)
        for i in range(m.nv):
            w.work[w.t, i] = -w.lam[w.t, i]
    for k in range(num_tendons(m)):
        if w.ten_force[w.t, k] != ZERO:
            tendon_bar(m, w, k, tendon_actuation(m, w, k), w.work, w.t)
        tendon_actuation_adjoint(m, w, k, tendon_dot(m, w, k, w.work, w.t))
    for i in range(m.nu):
        d = m.act_dof[i]
        og = m.o_gain + 3 * i
        ob = m.o_bias + 3 * i
        oe = m.o_gear + 6 * i
        length = actuator_length(m, w, r, i)
        rate = actuator_rate(m, w, r, i)
        u = drive(m, w, r, i)
        f = actuator_force(m, w, r, i)
        fbar = ZERO  # ∂/∂force
        for k in range(m.act_ndof[i]):
            fbar += w.th[oe + k] * w.work[w.t, d + k]
        if m.act_tendon[i] >= 0:
            fbar = w.th[oe] * w.ten_force[w.t, m.act_tendon[i]] + w.ten_sum[w.t, m.act_tendon[i]]
        if is_thrust(m, i):
            fbar = -wp.dot(w.dual[w.t, m.act_body[i]], thrust(m, w, i))
        if m.act_frclimited[i] != 0:
            fbar = clamp_adjoint(w, m.o_forcerange + 2 * i, f, fbar)
            f = clamp(w, m.o_forcerange + 2 * i, f)
        gain = w.th[og]
        slope_l = ZERO
        slope_v = ZERO
        w.grad[w.t, og] += fbar * u
        if m.act_affine_gain[i] != 0:
            gain += w.th[og + 1] * length + w.th[og + 2] * rate
            slope_l += w.th[og + 1] * u
            slope_v += w.th[og + 2] * u
            w.grad[w.t, og + 1] += fbar * u * length
            w.grad[w.t, og + 2] += fbar * u * rate
        if m.act_affine_bias[i] != 0:
            slope_l += w.th[ob + 1]
            slope_v += w.th[ob + 2]
            w.grad[w.t, ob] += fbar
            w.grad[w.t, ob + 1] += fbar * length
            w.grad[w.t, ob + 2] += fbar * rate
        if m.act_ndof[i] == 1:
            w.tangent[w.t, d] += fbar * slope_l * w.th[oe]
            w.grad[w.t, oe] += fbar * slope_l * w.qpos[r, m.act_qpos[i]]
        for k in range(m.act_ndof[i]):
            w.vel_bar[w.t, d + k] += fbar * slope_v * w.th[oe + k]
            w.grad[w.t, oe + k] += f * w.work[w.t, d + k] + fbar * slope_v * w.qvel[r, d + k]
        if m.act_tendon[i] >= 0:
            k = m.act_tendon[i]
            w.ten_length_bar[w.t, k] += fbar * slope_l * w.th[oe]
            rate_bar(m, w, k, fbar * slope_v * w.th[oe], w.vel_bar, r)
            lever = slope_l * w.ten_length[w.t, k] + slope_v * w.ten_rate[w.t, k]
            w.grad[w.t, oe] += f * w.ten_force[w.t, k] + fbar * lever
        if is_thrust(m, i):
            thrust_adjoint(m, w, i, f)
        drive_adjoint(m, w, r, i, fbar * gain)


@wp.func(inline=True)
def actuator_slope(m: wp.ref[Tables], w: wp.ref[World], r: int, a: int) -> f64:
    """gear² (bias_v + gain_v u): ∂τ/∂q̇ of an actuator on a hinge or slide, or zero where the force is clamped."""
    gear = w.th[m.o_gear + 6 * a]
    y = ZERO
    if m.act_affine_bias[a] != 0:
        y += w.th[m.o_bias + 3 * a + 2]
    if m.act_affine_gain[a] != 0:
        y += w.th[m.o_gain + 3 * a + 2] * drive(m, w, r, a)
    if m.act_frclimited[a] != 0:
        f = actuator_force(m, w, r, a)
        o = m.o_forcerange + 2 * a
        if f <= w.th[o] or f >= w.th[o + 1]:
            y = ZERO
    return gear * gear * y


@wp.func(inline=True)
def actuator_slope_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, a: int, bar: f64):
    """Adjoint of :func:`actuator_slope` (which does not see the position)."""
    slope = actuator_slope(m, w, r, a)
    if slope != ZERO:
        gear = w.th[m.o_gear + 6 * a]
        w.grad[w.t, m.o_gear + 6 * a] += bar * TWO * slope / gear
        if m.act_affine_bias[a] != 0:
            w.grad[w.t, m.o_bias + 3 * a + 2] += bar * gear * gear
        if m.act_affine_gain[a] != 0:
            o = m.o_gain + 3 * a + 2
            w.grad[w.t, o] += bar * gear * gear * drive(m, w, r, a)
            drive_adjoint(m, w, r, a, bar * gear * gear * w.th[o])


@wp.func(inline=True)
def add_forces(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Load from dampers, F = −v (b + p0 |v| + p1 v²), springs, actuators and what is applied besides."""
    for i in range(m.nv * w.applied):
        w.load[w.t, i] -= w.ctrl[w.rc, w.ctrl.shape[1] - m.nv + i]
    for i in range(m.nv * m.has_damper):
        v = w.qvel[r, i]
        n = wp.abs(v)
        ip = m.o_dampingpoly + 2 * i
        w.load[w.t, i] += v * (w.th[m.o_damping + i] + n * (w.th[ip] + n * w.th[ip + 1]))
    if m.has_spring != 0:
        add_springs(m, w, r)
    if num_tendons(m) != 0:
        add_tendon_forces(m, w)
    add_actuators(m, w, r)


@wp.func(inline=True)
def forces_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Adjoint of :func:`add_forces`."""
    for i in range(m.nv * w.applied):
        w.ctrl_bar[w.rb, w.ctrl.shape[1] - m.nv + i] -= w.lam[w.t, i]
    for i in range(m.nv * m.has_damper):
        v = w.qvel[r, i]
        n = wp.abs(v)
        jl = w.lam[w.t, i]
        ip = m.o_dampingpoly + 2 * i
        w.vel_bar[w.t, i] += jl * damping_slope(m, w, v, i)
        w.grad[w.t, m.o_damping + i] += jl * v
        w.grad[w.t, ip] += jl * v * n
        w.grad[w.t, ip + 1] += jl * v * n * n
    if m.has_spring != 0:
        springs_adjoint(m, w, r)
    if num_tendons(m) != 0:
        tendon_forces_adjoint(m, w, r)
    actuators_adjoint(m, w, r)
