"""The integrators Euler (implicit in damping), implicitfast and RK4, and their adjoints."""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.forces import actuator_force, control, damping_slope
from dropo_torch.simulators.warp.kinematics import packed, sweep_out
from dropo_torch.simulators.warp.solver import factor, mass_mul, solve
from dropo_torch.simulators.warp.spatial import (
    chart_rate,
    chart_rate_dual,
    nothing,
    quat_integrate,
    quat_mul,
    right_jacobian_t,
    turn,
)
from dropo_torch.simulators.warp.stage import accelerate, accelerate_adjoint
from dropo_torch.simulators.warp.types import (
    BALL,
    HALF,
    ONE,
    RK4,
    THREE,
    TRANSLATION,
    TWO,
    ZERO,
    Ints,
    Reals,
    Reals2,
    Scratch,
    Tables,
    f64,
    vec3,
    vec4,
)

LARGE = wp.constant(wp.float64(1.0e10))  # mjMAXVAL


@wp.func(inline=True)
def move(m: Tables, qpos: Reals2, r: int, vel: Reals2, rv: int, h: f64, out: Reals2, ro: int):
    """out[ro] = qpos[r] ⊕ h vel[rv]."""
    for k in range(m.nlink):
        iq = m.link_qpos[k]
        d = m.link_dof[k]
        kind = m.link_kind[k]
        if kind == BALL:
            q = vec4(qpos[r, iq], qpos[r, iq + 1], qpos[r, iq + 2], qpos[r, iq + 3])
            q = quat_integrate(q, vec3(vel[rv, d], vel[rv, d + 1], vel[rv, d + 2]) * h)
            for i in range(4):
                out[ro, iq + i] = q[i]
        else:
            n = int(1)
            if kind == TRANSLATION:
                n = 3
            for i in range(n):
                out[ro, iq + i] = qpos[r, iq + i] + h * vel[rv, d + i]


@wp.func(inline=True)
def move_adjoint(
    m: Tables, vel: Reals2, rv: int, h: f64, bar: Reals2, rb: int, pos_bar: Reals2, vel_bar: Reals2, o: int
):
    """Adjoint of :func:`move`: adds to ``pos_bar[rb]`` and ``vel_bar[rb, o:]`` from ``bar[rb]``."""
    if m.has_ball == 0:
        for i in range(m.nv):
            g = bar[rb, i]
            pos_bar[rb, i] += g
            vel_bar[rb, o + i] += h * g
    else:
        _move_adjoint(m, vel, rv, h, bar, rb, pos_bar, vel_bar, o)


@wp.func(inline=True)
def _move_adjoint(
    m: Tables, vel: Reals2, rv: int, h: f64, bar: Reals2, rb: int, pos_bar: Reals2, vel_bar: Reals2, o: int
):
    """:func:`move_adjoint` where there are quaternions."""
    for k in range(m.nlink):
        d = m.link_dof[k]
        kind = m.link_kind[k]
        if kind == BALL:
            # q' = q exp(r): δ' = exp(−[r]) δ + J_r(r) δr
            r = vec3(vel[rv, d], vel[rv, d + 1], vel[rv, d + 2]) * h
            g = vec3(bar[rb, d], bar[rb, d + 1], bar[rb, d + 2])
            back = turn(r, g)
            w = right_jacobian_t(r, g) * h
            for i in range(3):
                pos_bar[rb, d + i] += back[i]
                vel_bar[rb, o + d + i] += w[i]
        else:
            n = int(1)
            if kind == TRANSLATION:
                n = 3
            for i in range(n):
                pos_bar[rb, d + i] += bar[rb, d + i]
                vel_bar[rb, o + d + i] += h * bar[rb, d + i]


@wp.func(inline=True)
def chart_rates(m: Tables, rate: Reals2, r: int, c: f64, qvel: Reals2):
    """rate[r] of a stage that is ``c`` rate[r − 1] away from the start of its step."""
    for k in range(m.nlink * m.has_ball):
        d = m.link_dof[k]
        kind = m.link_kind[k]
        if kind == BALL:
            turned = vec3(rate[r - 1, d], rate[r - 1, d + 1], rate[r - 1, d + 2]) * c
            w = chart_rate(turned, vec3(qvel[r, d], qvel[r, d + 1], qvel[r, d + 2]))
            for i in range(3):
                rate[r, d + i] = w[i]
        else:
            n = int(1)
            if kind == TRANSLATION:
                n = 3
            for i in range(n):
                rate[r, d + i] = qvel[r, d + i]


@wp.func(inline=True)
def chart_rates_adjoint(m: Tables, s: Scratch, t: int, rate: Reals2, r: int, c: f64, qvel: Reals2, o: int):
    """Adjoint of :func:`chart_rates`: ``s.stage_rate_bar[o:]`` to ``s.vel_bar`` and the stage before."""
    _late = wp.grad(nothing)(ONE)
    if m.has_ball == 0:
        for i in range(m.nv):
            s.vel_bar[t, i] += s.stage_rate_bar[t, o + i]
    else:
        _chart_rates_adjoint(m, s, t, rate, r, c, qvel, o)


@wp.func(inline=True)
def _chart_rates_adjoint(m: Tables, s: Scratch, t: int, rate: Reals2, r: int, c: f64, qvel: Reals2, o: int):
    """:func:`chart_rates_adjoint` where there are quaternions."""
    _late = wp.grad(nothing)(ONE)
    for k in range(m.nlink):
        d = m.link_dof[k]
        kind = m.link_kind[k]
        if kind == BALL:
            turned = vec3(rate[r - 1, d], rate[r - 1, d + 1], rate[r - 1, d + 2]) * c
            w = vec3(qvel[r, d], qvel[r, d + 1], qvel[r, d + 2])
            bar = vec3(s.stage_rate_bar[t, o + d], s.stage_rate_bar[t, o + d + 1], s.stage_rate_bar[t, o + d + 2])
            turnedbar, wbar, _bar = wp.grad(chart_rate_dual)(turned, w, bar)
            for i in range(3):
                s.vel_bar[t, d + i] += wbar[i]
                s.stage_rate_bar[t, o - m.nv + d + i] += c * turnedbar[i]
        else:
            n = int(1)
            if kind == TRANSLATION:
                n = 3
            for i in range(n):
                s.vel_bar[t, d + i] += s.stage_rate_bar[t, o + d + i]


@wp.func(inline=True)
def good(m: Tables, qpos: Reals2, qvel: Reals2, r: int) -> int:
    """1 while every number of a state is finite and below MuJoCo's limit."""
    ok = int(1)
    for i in range(m.nq):
        if not (wp.abs(qpos[r, i]) < LARGE):
            ok = 0
    for i in range(m.nv):
        if not (wp.abs(qvel[r, i]) < LARGE):
            ok = 0
    return ok


@wp.func(inline=True)
def implicit_slope(m: Tables, th: Reals, qpos: Reals2, qvel: Reals2, r: int, ctrl: Reals2, rc: int, i: int) -> f64:
    """B of dof ``i``: −∂τ/∂q̇ that the integrator takes implicitly."""
    b = ZERO
    if m.has_damper != 0:
        b = damping_slope(m, th, qvel[r, i], i)
    if m.implicit_actuators != 0:
        for a in range(m.nu):
            if m.act_dof[a] == i:
                b -= actuator_slope(m, th, qpos, qvel, r, ctrl, rc, a)
    return b


@wp.func(inline=True)
def actuator_slope(m: Tables, th: Reals, qpos: Reals2, qvel: Reals2, r: int, ctrl: Reals2, rc: int, a: int) -> f64:
    """gear² (bias_v + gain_v u), or zero where the force is clamped."""
    gear = th[m.o_gear + a]
    u = control(m, th, ctrl, rc, a)
    y = ZERO
    if m.act_affine_bias[a] != 0:
        y += th[m.o_bias + 3 * a + 2]
    if m.act_affine_gain[a] != 0:
        y += th[m.o_gain + 3 * a + 2] * u
    if m.act_frclimited[a] != 0:
        f = actuator_force(m, th, a, u, gear * qpos[r, m.act_qpos[a]], gear * qvel[r, m.act_dof[a]])
        o = m.o_forcerange + 2 * a
        if f <= th[o] or f >= th[o + 1]:
            y = ZERO
    return gear * gear * y


@wp.func(inline=True)
def soften(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    acc: Reals2,
    soft: Reals2,
    hess: Reals2,
    r: int,
    ctrl: Reals2,
    rc: int,
):
    """soft[r] = (M + h B)⁻¹ M acc[r], with the factor left in ``hess[r]``."""
    mass_mul(m, s, t, acc, r, soft, r)
    for i in range(m.nh):
        hess[r, i] = s.mass[t, i]
    for i in range(m.nv):
        hess[r, packed(i, i)] += m.h * implicit_slope(m, th, qpos, qvel, r, ctrl, rc, i)
    factor(m, 0, hess, r)
    solve(m, 0, hess, r, soft, r)


@wp.func(inline=True)
def slope_adjoint(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    soft: Reals2,
    r: int,
    ctrl: Reals2,
    rc: int,
    ctrl_bar: Reals2,
    rb: int,
):
    """The part of B in the adjoint of :func:`soften`: the gradient of −h λᵀ B a', into ``s.stage_vel_bar`` and θ."""
    if m.has_damper != 0:
        for i in range(m.nv):
            y = -m.h * s.lam[t, i] * soft[r, i]  # ∂/∂B
            v = qvel[r, i]
            n = wp.abs(v)
            ip = m.o_dampingpoly + 2 * i
            s.grad[t, m.o_damping + i] += y
            s.grad[t, ip] += TWO * n * y
            s.grad[t, ip + 1] += THREE * n * n * y
            s.stage_vel_bar[t, i] += y * (TWO * th[ip] * wp.sign(v) + f64(6.0) * th[ip + 1] * v)
    if m.implicit_actuators != 0:
        for a in range(m.nu):
            _actuator_slope_adjoint(m, s, t, th, qpos, qvel, soft, r, ctrl, rc, ctrl_bar, rb, a)


@wp.func(inline=True)
def _actuator_slope_adjoint(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    soft: Reals2,
    r: int,
    ctrl: Reals2,
    rc: int,
    ctrl_bar: Reals2,
    rb: int,
    a: int,
):
    """Adjoint of the actuators' part of B (which does not see the position)."""
    slope = actuator_slope(m, th, qpos, qvel, r, ctrl, rc, a)
    if slope != ZERO:
        i = m.act_dof[a]
        y = m.h * s.lam[t, i] * soft[r, i]
        gear = th[m.o_gear + a]
        s.grad[t, m.o_gear + a] += y * TWO * slope / gear
        if m.act_affine_bias[a] != 0:
            s.grad[t, m.o_bias + 3 * a + 2] += y * gear * gear
        if m.act_affine_gain[a] != 0:
            s.grad[t, m.o_gain + 3 * a + 2] += y * gear * gear * control(m, th, ctrl, rc, a)
            o = m.o_ctrlrange + 2 * a
            g = y * gear * gear * th[m.o_gain + 3 * a + 2]
            if m.clampctrl == 0 or m.act_ctrllimited[a] == 0:
                ctrl_bar[rb, a] += g
            elif ctrl[rc, a] < th[o]:
                s.grad[t, o] += g
            elif ctrl[rc, a] > th[o + 1]:
                s.grad[t, o + 1] += g
            else:
                ctrl_bar[rb, a] += g


@wp.func(inline=True)
def step(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    rate: Reals2,
    acc: Reals2,
    soft: Reals2,
    hess: Reals2,
    soft_hess: Reals2,
    held: Ints,
    r: int,
    nxt: int,
    ctrl: Reals2,
    rc: int,
) -> int:
    """One physics step from row ``r`` (stages in the rows after it) to row ``nxt``; 1 while it is good."""
    h = m.h
    ok = good(m, qpos, qvel, r)
    for k in range(m.nstage):
        if ok != 0:
            if k > 0:
                c = h * HALF
                if k == 3:
                    c = h
                # Munthe-Kaas: stages of a quaternion combine in the chart at the start of the step
                move(m, qpos, r, rate, r + k - 1, c, qpos, r + k)
                for i in range(m.nv):
                    qvel[r + k, i] = qvel[r, i] + c * acc[r + k - 1, i]
                    acc[r + k, i] = acc[r + k - 1, i]  # the guess of a stage
                chart_rates(m, rate, r + k, c, qvel)
            else:
                for i in range(m.nv):
                    rate[r, i] = qvel[r, i]
            accelerate(m, s, t, th, qpos, qvel, acc, hess, held, r + k, ctrl, rc)
            if k == 0:
                for i in range(m.nv):
                    if not (wp.abs(acc[r, i]) < LARGE):
                        ok = 0
    if ok != 0:
        if m.integrator == RK4:
            for i in range(m.nv):
                s.work[t, i] = (rate[r, i] + TWO * rate[r + 1, i] + TWO * rate[r + 2, i] + rate[r + 3, i]) / f64(6.0)
                qvel[nxt, i] = qvel[r, i] + h / f64(6.0) * (
                    acc[r, i] + TWO * acc[r + 1, i] + TWO * acc[r + 2, i] + acc[r + 3, i]
                )
        else:
            if m.implicit != 0:
                soften(m, s, t, th, qpos, qvel, acc, soft, soft_hess, r, ctrl, rc)
            for i in range(m.nv):
                a = acc[r, i]
                if m.implicit != 0:
                    a = soft[r, i]
                v = qvel[r, i] + h * a
                qvel[nxt, i] = v
                s.work[t, i] = v
        move(m, qpos, r, s.work, t, h, qpos, nxt)
        for i in range(m.nv):
            acc[nxt, i] = acc[r + m.nstage - 1, i]
    return ok


@wp.func(inline=True)
def step_adjoint(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    rate: Reals2,
    acc: Reals2,
    soft: Reals2,
    hess: Reals2,
    soft_hess: Reals2,
    held: Ints,
    r: int,
    nxt: int,
    ctrl: Reals2,
    rc: int,
    ctrl_bar: Reals2,
    rb: int,
):
    """Adjoint of :func:`step`: ``s.pos_bar`` (tangent) and ``s.rate_bar`` of the end become those of the start."""
    _late = wp.grad(nothing)(ONE)
    h = m.h
    nv = m.nv
    _end_adjoint(m, s, t, qvel, rate, r, nxt)
    for back in range(m.nstage + m.implicit):
        softening = int(0)
        k = int(0)
        if m.nstage > 1:
            k = m.nstage - 1 - back
            for i in range(nv):
                s.acc_bar[t, i] = s.stage_acc_bar[t, k * nv + i]
        elif m.implicit != 0 and back == 0:
            softening = 1
        for i in range(nv):
            s.tangent[t, i] = ZERO
            s.vel_bar[t, i] = ZERO
        sweep_out(m, s, t, th, qpos, qvel, r + k)
        if softening != 0:
            # λ = (M + h B)⁻¹ ā', then the gradient of λᵀ (M (a − a') − h B a')
            for i in range(nv):
                s.lam[t, i] = s.acc_bar[t, i]
                s.qacc[t, i] = acc[r, i] - soft[r, i]
                s.qd[t, i] = ZERO
        else:
            for i in range(nv):
                s.lam[t, i] = -s.acc_bar[t, i]
                s.qacc[t, i] = acc[r + k, i]
                s.qd[t, i] = qvel[r + k, i]
        accelerate_adjoint(
            m, s, t, th, qpos, qvel, acc, hess, soft_hess, held, r + k, ctrl, rc, ctrl_bar, rb, softening
        )
        if softening != 0:
            slope_adjoint(m, s, t, th, qpos, qvel, soft, r, ctrl, rc, ctrl_bar, rb)
            for i in range(nv):
                s.pos_bar0[t, i] += s.tangent[t, i]
                # ā = M λ, with M λ = Σ_subtree s · I Λ + armature
                inertial = wp.dot(s.motion[t, i], s.f_accel[t, m.dof_body[i]])
                s.acc_bar[t, i] = inertial + th[m.o_armature + i] * s.lam[t, i]
        elif k > 0:
            c = h * HALF
            if k == 3:
                c = h
            chart_rates_adjoint(m, s, t, rate, r + k, c, qvel, k * nv)
            for i in range(nv):
                s.stage_vel_bar[t, i] += s.vel_bar[t, i]
                s.stage_acc_bar[t, (k - 1) * nv + i] += c * s.vel_bar[t, i]
            move_adjoint(m, rate, r + k - 1, c, s.tangent, t, s.pos_bar0, s.stage_rate_bar, (k - 1) * nv)
    for i in range(nv):
        s.pos_bar[t, i] = s.pos_bar0[t, i] + s.tangent[t, i]
        s.rate_bar[t, i] = s.stage_vel_bar[t, i] + s.stage_rate_bar[t, i] + s.vel_bar[t, i]


@wp.func(inline=True)
def _end_adjoint(m: Tables, s: Scratch, t: int, qvel: Reals2, rate: Reals2, r: int, nxt: int):
    """Adjoint of the last line of a step: what its end gives to start, stages and accelerations."""
    h = m.h
    nv = m.nv
    for i in range(nv):
        s.pos_bar0[t, i] = ZERO
        s.tangent[t, i] = ZERO
        s.stage_vel_bar[t, i] = s.rate_bar[t, i]
        s.stage_rate_bar[t, i] = ZERO
    if m.has_ball != 0:
        for i in range(nv):
            if m.integrator == RK4:
                s.work[t, i] = (rate[r, i] + TWO * rate[r + 1, i] + TWO * rate[r + 2, i] + rate[r + 3, i]) / f64(6.0)
            else:
                s.work[t, i] = qvel[nxt, i]
    move_adjoint(m, s.work, t, h, s.pos_bar, t, s.pos_bar0, s.tangent, 0)
    for i in range(nv):
        g = s.tangent[t, i]
        if m.integrator == RK4:
            abar = s.rate_bar[t, i] * h / f64(6.0)
            for k in range(4):
                weight = TWO
                if k == 0 or k == 3:
                    weight = ONE
                s.stage_rate_bar[t, k * nv + i] = weight * g / f64(6.0)
                s.stage_acc_bar[t, k * nv + i] = weight * abar
        else:
            # q' = q ⊕ h v', v' = v + h a'
            s.stage_vel_bar[t, i] += g
            s.acc_bar[t, i] = h * (s.rate_bar[t, i] + g)


@wp.func(inline=True)
def to_tangent(m: Tables, qpos: Reals2, r: int, bar: Reals2, rb: int, out: Reals2, t: int):
    """Add the adjoint of a raw position to its tangent: ½ (q* ⊗ q̄) of a unit quaternion."""
    for k in range(m.nlink):
        iq = m.link_qpos[k]
        d = m.link_dof[k]
        kind = m.link_kind[k]
        if kind == BALL:
            q = vec4(qpos[r, iq], -qpos[r, iq + 1], -qpos[r, iq + 2], -qpos[r, iq + 3])
            g = quat_mul(q, vec4(bar[rb, iq], bar[rb, iq + 1], bar[rb, iq + 2], bar[rb, iq + 3]))
            for i in range(3):
                out[t, d + i] += HALF * g[i + 1]
        else:
            n = int(1)
            if kind == TRANSLATION:
                n = 3
            for i in range(n):
                out[t, d + i] += bar[rb, iq + i]


@wp.func(inline=True)
def from_tangent(m: Tables, qpos: Reals2, r: int, bar: Reals2, t: int, out: Reals2, ro: int):
    """Write the adjoint of a raw position from its tangent: 2/|q| q̂ ⊗ (0, g)."""
    for k in range(m.nlink):
        iq = m.link_qpos[k]
        d = m.link_dof[k]
        kind = m.link_kind[k]
        if kind == BALL:
            q = vec4(qpos[r, iq], qpos[r, iq + 1], qpos[r, iq + 2], qpos[r, iq + 3])
            g = quat_mul(q, vec4(ZERO, bar[t, d], bar[t, d + 1], bar[t, d + 2])) * (TWO / wp.dot(q, q))
            for i in range(4):
                out[ro, iq + i] = g[i]
        else:
            n = int(1)
            if kind == TRANSLATION:
                n = 3
            for i in range(n):
                out[ro, iq + i] = bar[t, d + i]
