"""Scalar constraint rows: friction loss, joint limits and joint equalities.

A row has at most three dofs. Its force f minimises MuJoCo's cost at J a − aref: quadratic (equality), one-sided
(limit) or Huber's (friction loss).
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.cone import contact_scalars
from dropo_torch.simulators.warp.impedance import damping, impedance_slope, regularisation, stiffness
from dropo_torch.simulators.warp.spatial import inverse_right_jacobian_t, nothing, quat_log
from dropo_torch.simulators.warp.types import (
    BALL,
    MINVAL,
    ONE,
    ROW_EQUALITY,
    ROW_FRICTION,
    ROW_LIMIT,
    THREE,
    TWO,
    ZERO,
    Reals,
    Reals2,
    Scratch,
    Tables,
    f64,
    vec2,
    vec3,
    vec4,
    vec5,
)

FOUR = wp.constant(wp.float64(4.0))


@wp.func
def theta_vec2(th: Reals, i: int) -> vec2:
    """Two consecutive numbers of θ."""
    return vec2(th[i], th[i + 1])


@wp.func
def theta_vec5(th: Reals, i: int) -> vec5:
    """Five consecutive numbers of θ."""
    return vec5(th[i], th[i + 1], th[i + 2], th[i + 3], th[i + 4])


@wp.func
def row_force(kind: int, jar: f64, d: f64, loss: f64) -> f64:
    """Constraint force at J a − aref = ``jar``."""
    f = -d * jar
    if kind == ROW_LIMIT:
        f = wp.max(ZERO, f)
    elif kind == ROW_FRICTION:
        f = wp.min(loss, wp.max(-loss, f))
    return f


@wp.func
def row_state(kind: int, jar: f64, d: f64, loss: f64) -> int:
    """Which piece of the cost ``jar`` is on; 1 is the quadratic one."""
    state = int(1)
    if kind == ROW_LIMIT:
        if jar >= ZERO:
            state = int(0)
    elif kind == ROW_FRICTION:
        if d * jar <= -loss:
            state = int(2)
        elif d * jar >= loss:
            state = int(3)
    return state


@wp.func(inline=True)
def equality_position(m: Tables, th: Reals, qpos: Reals2, r: int, e: int) -> vec3:
    """(q1 − p(q2), p'(q2), p''(q2)) of a joint equality, both measured from their references."""
    c = m.o_eq_data + 5 * m.eq_id[e]
    x = qpos[r, m.eq_qpos[2 * e]] - m.eq_ref[2 * e] - th[c]
    slope = ZERO
    curve = ZERO
    if m.eq_dof[2 * e + 1] >= 0:
        y = qpos[r, m.eq_qpos[2 * e + 1]] - m.eq_ref[2 * e + 1]
        x -= y * (th[c + 1] + y * (th[c + 2] + y * (th[c + 3] + y * th[c + 4])))
        slope = th[c + 1] + y * (TWO * th[c + 2] + y * (THREE * th[c + 3] + y * FOUR * th[c + 4]))
        curve = TWO * th[c + 2] + y * (f64(6.0) * th[c + 3] + y * f64(12.0) * th[c + 4])
    return vec3(x, slope, curve)


@wp.func(inline=True)
def row_dot(s: Scratch, t: int, n: int, x: Reals2, r: int) -> f64:
    """J x of row ``n``."""
    c = s.row_coef[t, n]
    y = c[0] * x[r, s.row_dof[t, 3 * n]]
    d = s.row_dof[t, 3 * n + 1]
    if d >= 0:
        y += c[1] * x[r, d]
        d = s.row_dof[t, 3 * n + 2]
        if d >= 0:
            y += c[2] * x[r, d]
    return y


@wp.func(inline=True)
def _row_softness(m: Tables, s: Scratch, t: int, th: Reals, n: int):
    """Places of solref and solimp of row ``n`` in θ, and its approximate inverse inertia."""
    kind = s.row_kind[t, n]
    index = s.row_index[t, n]
    d = s.row_dof[t, 3 * n]
    o_ref = m.o_dof_solref + 2 * d
    o_imp = m.o_dof_solimp + 5 * d
    w = th[m.o_dof_invweight + d]
    if kind == ROW_LIMIT:
        j = m.link_jnt[m.limit_link[index]]
        o_ref = m.o_jnt_solref + 2 * j
        o_imp = m.o_jnt_solimp + 5 * j
    elif kind == ROW_EQUALITY:
        o_ref = m.o_eq_solref + 2 * m.eq_id[index]
        o_imp = m.o_eq_solimp + 5 * m.eq_id[index]
        d2 = s.row_dof[t, 3 * n + 1]
        if d2 >= 0:
            w += th[m.o_dof_invweight + d2]
    return o_ref, o_imp, w


@wp.func(inline=True)
def _weigh_row(m: Tables, s: Scratch, t: int, th: Reals, qvel: Reals2, r: int, n: int):
    """Reference acceleration and D of row ``n``."""
    o_ref, o_imp, w = _row_softness(m, s, t, th, n)
    solref = theta_vec2(th, o_ref)
    solimp = theta_vec5(th, o_imp)
    x = s.row_x[t, n]
    imp = impedance_slope(x, solimp)[0]
    aref = -damping(solref, solimp, m.h, m.refsafe) * row_dot(s, t, n, qvel, r)
    if s.row_kind[t, n] != ROW_FRICTION:
        aref -= stiffness(solref, solimp, m.h, m.refsafe) * imp * x
    s.row_aref[t, n] = aref
    s.row_d[t, n] = ONE / regularisation(imp, w)


@wp.func(inline=True)
def make_rows(m: Tables, s: Scratch, t: int, th: Reals, qpos: Reals2, qvel: Reals2, r: int, weighed: int) -> int:
    """List the scalar rows of a state and return their number; ``weighed`` 0 leaves out what resists in them."""
    n = int(0)
    for candidate in range(m.neq + m.nfriction + 2 * m.nlimit):
        kind = int(ROW_LIMIT)
        index = int(candidate - m.neq)
        x = f64(1.0)
        loss = f64(0.0)
        coef = vec3()
        dof = int(0)
        dof2 = int(-1)
        if candidate < m.neq:
            kind = ROW_EQUALITY
            index = candidate
            p = equality_position(m, th, qpos, r, index)
            x = p[0]
            dof = m.eq_dof[2 * index]
            dof2 = m.eq_dof[2 * index + 1]
            coef = vec3(ONE, -p[1], ZERO)
        elif candidate < m.neq + m.nfriction:
            kind = ROW_FRICTION
            dof = m.friction_dof[index]
            x = f64(0.0)
            loss = th[m.o_frictionloss + dof]
            coef = vec3(ONE, ZERO, ZERO)
        else:
            side = (index - m.nfriction) % 2
            index = (index - m.nfriction) // 2
            k = m.limit_link[index]
            j = m.link_jnt[k]
            iq = m.link_qpos[k]
            dof = m.link_dof[k]
            o = m.o_range + 2 * j
            if m.link_kind[k] == BALL:
                if side == 0:
                    q = vec4(qpos[r, iq], qpos[r, iq + 1], qpos[r, iq + 2], qpos[r, iq + 3])
                    rot = quat_log(q / wp.length(q))
                    angle = wp.length(rot)
                    x = wp.max(th[o], th[o + 1]) - angle - th[m.o_jnt_margin + j]
                    coef = -rot / wp.max(angle, MINVAL)
                    dof2 = dof + 1
            elif side == 0:
                x = qpos[r, iq] - th[o] - th[m.o_jnt_margin + j]
                coef = vec3(ONE, ZERO, ZERO)
            else:
                x = th[o + 1] - qpos[r, iq] - th[m.o_jnt_margin + j]
                coef = vec3(-ONE, ZERO, ZERO)
        if kind == ROW_EQUALITY or (kind == ROW_FRICTION and loss > ZERO) or (kind == ROW_LIMIT and x < ZERO):
            dof3 = int(-1)
            if dof2 >= 0 and kind == ROW_LIMIT:
                dof3 = dof + 2
            s.row_kind[t, n] = kind
            s.row_index[t, n] = index
            s.row_dof[t, 3 * n] = dof
            s.row_dof[t, 3 * n + 1] = dof2
            s.row_dof[t, 3 * n + 2] = dof3
            s.row_coef[t, n] = coef
            s.row_x[t, n] = x
            s.row_loss[t, n] = loss
            if weighed != 0:
                _weigh_row(m, s, t, th, qvel, r, n)
            n += 1
    return n


@wp.func(inline=True)
def row_add(s: Scratch, t: int, n: int, y: f64, x: Reals2, r: int):
    """x += Jᵀ y of row ``n``."""
    c = s.row_coef[t, n]
    x[r, s.row_dof[t, 3 * n]] += c[0] * y
    d = s.row_dof[t, 3 * n + 1]
    if d >= 0:
        x[r, d] += c[1] * y
        d = s.row_dof[t, 3 * n + 2]
        if d >= 0:
            x[r, d] += c[2] * y


@wp.func(inline=True)
def soft_adjoint(
    m: Tables, s: Scratch, t: int, o_ref: int, o_imp: int, dim: int, x: f64, mu: f64, solref: vec2, solimp: vec5,
    weight: f64, imp: f64, slope: f64, stiff: f64, d: f64, dbar: f64, bbar: f64, sbar: f64,
):  # fmt: skip
    """Adjoints of a constraint's position, inverse inertia and first friction; adds those of solref and solimp.

    ⟨D, D̄⟩ + ⟨B, B̄⟩ + ⟨K d(x) x, s̄⟩ is the number; ``imp`` and ``slope`` are d(x) and d'(x), ``stiff`` is K.
    """
    _late = wp.grad(nothing)(ONE)
    # D is inverse to R = (1 − d)/d · A, of a pyramid to 2 μ² (1 + μ²) R
    xbar = sbar * stiff * (imp + slope * x)
    weightbar = ZERO
    mubar = ZERO
    if dim > 1:
        mubar = -TWO * dbar * d / mu
    if (ONE - imp) * weight > MINVAL * imp:
        xbar += dbar * d * slope / (imp * (ONE - imp))
        weightbar = -dbar * d / weight
        if dim > 1:
            mubar -= TWO * dbar * d * mu / (ONE + mu * mu)
    if m.want_soft != 0:
        _d, _x, _margin, _mu, refbar, impbar, _w, _r, _h, _s, _1, _2, _3 = wp.grad(contact_scalars)(
            dim, x, ZERO, mu, solref, solimp, weight, m.impratio, m.h, m.refsafe, dbar, bbar, sbar
        )
        for i in range(2):
            s.grad[t, o_ref + i] += refbar[i]
        for i in range(5):
            s.grad[t, o_imp + i] += impbar[i]
    return xbar, weightbar, mubar


@wp.func(inline=True)
def rows_adjoint(m: Tables, s: Scratch, t: int, th: Reals, qpos: Reals2, qvel: Reals2, acc: Reals2, r: int, nrow: int):
    """Adjoint of the rows: the gradient of Σ −f Jλ, with J where it moves."""
    _late = wp.grad(nothing)(ONE)
    for n in range(nrow):
        kind = s.row_kind[t, n]
        o_ref, o_imp, weight = _row_softness(m, s, t, th, n)
        solref = theta_vec2(th, o_ref)
        solimp = theta_vec5(th, o_imp)
        x = s.row_x[t, n]
        loss = s.row_loss[t, n]
        imp = impedance_slope(x, solimp)
        b = damping(solref, solimp, m.h, m.refsafe)
        stiff = ZERO
        if kind != ROW_FRICTION:
            stiff = stiffness(solref, solimp, m.h, m.refsafe)
        v = row_dot(s, t, n, qvel, r)
        jar = row_dot(s, t, n, acc, r) + b * v + stiff * imp[0] * x
        d = ONE / regularisation(imp[0], weight)
        state = row_state(kind, jar, d, loss)
        if state != 0:
            jl = row_dot(s, t, n, s.lam, t)
            dof = s.row_dof[t, 3 * n]
            if state == 1:
                ubar = d * jl
                xbar, weightbar, _mubar = soft_adjoint(
                    m, s, t, o_ref, o_imp, 1, x, ONE, solref, solimp, weight, imp[0], imp[1], stiff, d, jar * jl,
                    v * ubar, wp.where(kind == ROW_FRICTION, ZERO, ubar),
                )  # fmt: skip
                row_add(s, t, n, b * ubar, s.vel_bar, t)
                s.grad[t, m.o_dof_invweight + dof] += weightbar
                lbar = d * jar
                if kind == ROW_LIMIT:
                    _limit_adjoint(m, s, t, th, qpos, qvel, acc, r, n, xbar, ubar, b * ubar, lbar)
                elif kind == ROW_EQUALITY:
                    if s.row_dof[t, 3 * n + 1] >= 0:
                        s.grad[t, m.o_dof_invweight + s.row_dof[t, 3 * n + 1]] += weightbar
                    _equality_adjoint(m, s, t, th, qpos, qvel, acc, r, n, xbar, ubar, b * ubar, lbar)
            elif state == 2:
                s.grad[t, m.o_frictionloss + dof] -= jl
            else:
                s.grad[t, m.o_frictionloss + dof] += jl


@wp.func(inline=True)
def _limit_adjoint(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    acc: Reals2,
    r: int,
    n: int,
    xbar: f64,
    ubar: f64,
    vbar: f64,
    lbar: f64,
):
    """Where a limit's position and axis come from."""
    k = m.limit_link[s.row_index[t, n]]
    j = m.link_jnt[k]
    d = m.link_dof[k]
    o = m.o_range + 2 * j
    c = s.row_coef[t, n]
    s.grad[t, m.o_jnt_margin + j] -= xbar
    if m.link_kind[k] == BALL:
        iq = m.link_qpos[k]
        q = vec4(qpos[r, iq], qpos[r, iq + 1], qpos[r, iq + 2], qpos[r, iq + 3])
        rot = quat_log(q / wp.length(q))
        angle = wp.length(rot)
        if th[o] >= th[o + 1]:
            s.grad[t, o] += xbar
        else:
            s.grad[t, o + 1] += xbar
        cbar = (
            vec3(acc[r, d], acc[r, d + 1], acc[r, d + 2]) * ubar
            + vec3(qvel[r, d], qvel[r, d + 1], qvel[r, d + 2]) * vbar
            + vec3(s.lam[t, d], s.lam[t, d + 1], s.lam[t, d + 2]) * lbar
        )
        # c = −φ/|φ|, x = ... − |φ|
        g = c * xbar - (cbar - c * wp.dot(c, cbar)) / angle
        g = inverse_right_jacobian_t(rot, g)
        for i in range(3):
            s.tangent[t, d + i] += g[i]
    else:
        s.tangent[t, d] += c[0] * xbar
        if c[0] > ZERO:
            s.grad[t, o] -= xbar
        else:
            s.grad[t, o + 1] += xbar


@wp.func(inline=True)
def _equality_adjoint(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    acc: Reals2,
    r: int,
    n: int,
    xbar: f64,
    ubar: f64,
    vbar: f64,
    lbar: f64,
):
    """Where an equality's position and slope come from."""
    e = s.row_index[t, n]
    d1 = m.eq_dof[2 * e]
    d2 = m.eq_dof[2 * e + 1]
    o = m.o_eq_data + 5 * m.eq_id[e]
    s.tangent[t, d1] += xbar
    s.grad[t, o] -= xbar
    if d2 >= 0:
        p = equality_position(m, th, qpos, r, e)
        y = qpos[r, m.eq_qpos[2 * e + 1]] - m.eq_ref[2 * e + 1]
        slopebar = -(acc[r, d2] * ubar + qvel[r, d2] * vbar + s.lam[t, d2] * lbar)
        s.tangent[t, d2] += slopebar * p[2] - xbar * p[1]
        power = ONE
        for i in range(1, 5):
            s.grad[t, o + i] += slopebar * f64(float(i)) * power - xbar * power * y
            power = power * y
