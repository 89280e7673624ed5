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
from dropo_torch.simulators.warp.spatial import add_vec3, inverse_right_jacobian_t, nothing, quat_log, vec3_at, vec4_at
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
    Tables,
    World,
    f64,
    vec2,
    vec3,
    vec3i,
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
def equality_position(m: Tables, w: World, r: int, e: int) -> vec3:
    """(q1 − p(q2), p'(q2), p''(q2)) of a joint equality, both measured from their references."""
    c = m.o_eq_data + 5 * m.eq_id[e]
    x = w.qpos[r, m.eq_qpos[2 * e]] - m.eq_ref[2 * e] - w.th[c]
    slope = ZERO
    curve = ZERO
    if m.eq_dof[2 * e + 1] >= 0:
        y = w.qpos[r, m.eq_qpos[2 * e + 1]] - m.eq_ref[2 * e + 1]
        x -= y * (w.th[c + 1] + y * (w.th[c + 2] + y * (w.th[c + 3] + y * w.th[c + 4])))
        slope = w.th[c + 1] + y * (TWO * w.th[c + 2] + y * (THREE * w.th[c + 3] + y * FOUR * w.th[c + 4]))
        curve = TWO * w.th[c + 2] + y * (f64(6.0) * w.th[c + 3] + y * f64(12.0) * w.th[c + 4])
    return vec3(x, slope, curve)


@wp.func(inline=True)
def row_dot(w: World, n: int, x: Reals2, r: int) -> f64:
    """J x of row ``n``."""
    c = w.row_coef[w.t, n]
    y = c[0] * x[r, w.row_dof[w.t, n][0]]
    d = w.row_dof[w.t, n][1]
    if d >= 0:
        y += c[1] * x[r, d]
        d = w.row_dof[w.t, n][2]
        if d >= 0:
            y += c[2] * x[r, d]
    return y


@wp.func(inline=True)
def _row_softness(m: Tables, w: World, n: int):
    """Places of solref and solimp of row ``n`` in θ, and its approximate inverse inertia."""
    kind = w.row_kind[w.t, n]
    index = w.row_index[w.t, n]
    d = w.row_dof[w.t, n][0]
    o_ref = m.o_dof_solref + 2 * d
    o_imp = m.o_dof_solimp + 5 * d
    weight = w.th[m.o_dof_invweight + d]
    if kind == ROW_LIMIT:
        j = m.link_jnt[m.limit_link[index]]
        o_ref = m.o_jnt_solref + 2 * j
        o_imp = m.o_jnt_solimp + 5 * j
    elif kind == ROW_EQUALITY:
        o_ref = m.o_eq_solref + 2 * m.eq_id[index]
        o_imp = m.o_eq_solimp + 5 * m.eq_id[index]
        d2 = w.row_dof[w.t, n][1]
        if d2 >= 0:
            weight += w.th[m.o_dof_invweight + d2]
    return o_ref, o_imp, weight


@wp.func(inline=True)
def _weigh_row(m: Tables, w: World, r: int, n: int):
    """Reference acceleration and D of row ``n``."""
    o_ref, o_imp, weight = _row_softness(m, w, n)
    solref = theta_vec2(w.th, o_ref)
    solimp = theta_vec5(w.th, o_imp)
    x = w.row_x[w.t, n]
    imp = impedance_slope(x, solimp)[0]
    aref = -damping(solref, solimp, m.h, m.refsafe) * row_dot(w, n, w.qvel, r)
    if w.row_kind[w.t, n] != ROW_FRICTION:
        aref -= stiffness(solref, solimp, m.h, m.refsafe) * imp * x
    w.row_aref[w.t, n] = aref
    w.row_d[w.t, n] = ONE / regularisation(imp, weight)


@wp.func(inline=True)
def make_rows(m: Tables, w: World, r: int, weighed: int) -> int:
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
            p = equality_position(m, w, r, index)
            x = p[0]
            dof = m.eq_dof[2 * index]
            dof2 = m.eq_dof[2 * index + 1]
            coef = vec3(ONE, -p[1], ZERO)
        elif candidate < m.neq + m.nfriction:
            kind = ROW_FRICTION
            dof = m.friction_dof[index]
            x = f64(0.0)
            loss = w.th[m.o_frictionloss + dof]
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
                    q = vec4_at(w.qpos, r, iq)
                    rot = quat_log(q / wp.length(q))
                    angle = wp.length(rot)
                    x = wp.max(w.th[o], w.th[o + 1]) - angle - w.th[m.o_jnt_margin + j]
                    coef = -rot / wp.max(angle, MINVAL)
                    dof2 = dof + 1
            elif side == 0:
                x = w.qpos[r, iq] - w.th[o] - w.th[m.o_jnt_margin + j]
                coef = vec3(ONE, ZERO, ZERO)
            else:
                x = w.th[o + 1] - w.qpos[r, iq] - w.th[m.o_jnt_margin + j]
                coef = vec3(-ONE, ZERO, ZERO)
        if kind == ROW_EQUALITY or (kind == ROW_FRICTION and loss > ZERO) or (kind == ROW_LIMIT and x < ZERO):
            dof3 = int(-1)
            if dof2 >= 0 and kind == ROW_LIMIT:
                dof3 = dof + 2
            w.row_kind[w.t, n] = kind
            w.row_index[w.t, n] = index
            w.row_dof[w.t, n] = vec3i(dof, dof2, dof3)
            w.row_coef[w.t, n] = coef
            w.row_x[w.t, n] = x
            w.row_loss[w.t, n] = loss
            if weighed != 0:
                _weigh_row(m, w, r, n)
            n += 1
    return n


@wp.func(inline=True)
def row_add(w: World, n: int, y: f64, x: Reals2, r: int):
    """x += Jᵀ y of row ``n``."""
    c = w.row_coef[w.t, n]
    x[r, w.row_dof[w.t, n][0]] += c[0] * y
    d = w.row_dof[w.t, n][1]
    if d >= 0:
        x[r, d] += c[1] * y
        d = w.row_dof[w.t, n][2]
        if d >= 0:
            x[r, d] += c[2] * y


@wp.func(inline=True)
def soft_adjoint(
    m: Tables,
    w: World,
    o_ref: int,
    o_imp: int,
    dim: int,
    x: f64,
    mu: f64,
    solref: vec2,
    solimp: vec5,
    weight: f64,
    imp: f64,
    slope: f64,
    stiff: f64,
    d: f64,
    dbar: f64,
    bbar: f64,
    sbar: f64,
):
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
            w.grad[w.t, o_ref + i] += refbar[i]
        for i in range(5):
            w.grad[w.t, o_imp + i] += impbar[i]
    return xbar, weightbar, mubar


@wp.func(inline=True)
def rows_adjoint(m: Tables, w: World, r: int, nrow: int):
    """Adjoint of the rows: the gradient of Σ −f Jλ, with J where it moves."""
    _late = wp.grad(nothing)(ONE)
    for n in range(nrow):
        kind = w.row_kind[w.t, n]
        o_ref, o_imp, weight = _row_softness(m, w, n)
        solref = theta_vec2(w.th, o_ref)
        solimp = theta_vec5(w.th, o_imp)
        x = w.row_x[w.t, n]
        loss = w.row_loss[w.t, n]
        imp = impedance_slope(x, solimp)
        b = damping(solref, solimp, m.h, m.refsafe)
        stiff = ZERO
        if kind != ROW_FRICTION:
            stiff = stiffness(solref, solimp, m.h, m.refsafe)
        v = row_dot(w, n, w.qvel, r)
        jar = row_dot(w, n, w.acc, r) + b * v + stiff * imp[0] * x
        d = ONE / regularisation(imp[0], weight)
        state = row_state(kind, jar, d, loss)
        if state != 0:
            jl = row_dot(w, n, w.lam, w.t)
            dof = w.row_dof[w.t, n][0]
            if state == 1:
                ubar = d * jl
                xbar, weightbar, _mubar = soft_adjoint(
                    m, w, o_ref, o_imp, 1, x, ONE, solref, solimp, weight, imp[0], imp[1], stiff, d, jar * jl,
                    v * ubar, wp.where(kind == ROW_FRICTION, ZERO, ubar),
                )  # fmt: skip
                row_add(w, n, b * ubar, w.vel_bar, w.t)
                w.grad[w.t, m.o_dof_invweight + dof] += weightbar
                lbar = d * jar
                if kind == ROW_LIMIT:
                    _limit_adjoint(m, w, r, n, xbar, ubar, b * ubar, lbar)
                elif kind == ROW_EQUALITY:
                    if w.row_dof[w.t, n][1] >= 0:
                        w.grad[w.t, m.o_dof_invweight + w.row_dof[w.t, n][1]] += weightbar
                    _equality_adjoint(m, w, r, n, xbar, ubar, b * ubar, lbar)
            elif state == 2:
                w.grad[w.t, m.o_frictionloss + dof] -= jl
            else:
                w.grad[w.t, m.o_frictionloss + dof] += jl


@wp.func(inline=True)
def _limit_adjoint(m: Tables, w: World, r: int, n: int, xbar: f64, ubar: f64, vbar: f64, lbar: f64):
    """Where a limit's position and axis come from."""
    k = m.limit_link[w.row_index[w.t, n]]
    j = m.link_jnt[k]
    d = m.link_dof[k]
    o = m.o_range + 2 * j
    c = w.row_coef[w.t, n]
    w.grad[w.t, m.o_jnt_margin + j] -= xbar
    if m.link_kind[k] == BALL:
        iq = m.link_qpos[k]
        q = vec4_at(w.qpos, r, iq)
        rot = quat_log(q / wp.length(q))
        angle = wp.length(rot)
        if w.th[o] >= w.th[o + 1]:
            w.grad[w.t, o] += xbar
        else:
            w.grad[w.t, o + 1] += xbar
        cbar = vec3_at(w.acc, r, d) * ubar + vec3_at(w.qvel, r, d) * vbar + vec3_at(w.lam, w.t, d) * lbar
        # c = −φ/|φ|, x = ... − |φ|
        g = c * xbar - (cbar - c * wp.dot(c, cbar)) / angle
        g = inverse_right_jacobian_t(rot, g)
        add_vec3(w.tangent, w.t, d, g)
    else:
        w.tangent[w.t, d] += c[0] * xbar
        if c[0] > ZERO:
            w.grad[w.t, o] -= xbar
        else:
            w.grad[w.t, o + 1] += xbar


@wp.func(inline=True)
def _equality_adjoint(m: Tables, w: World, r: int, n: int, xbar: f64, ubar: f64, vbar: f64, lbar: f64):
    """Where an equality's position and slope come from."""
    e = w.row_index[w.t, n]
    d1 = m.eq_dof[2 * e]
    d2 = m.eq_dof[2 * e + 1]
    o = m.o_eq_data + 5 * m.eq_id[e]
    w.tangent[w.t, d1] += xbar
    w.grad[w.t, o] -= xbar
    if d2 >= 0:
        p = equality_position(m, w, r, e)
        y = w.qpos[r, m.eq_qpos[2 * e + 1]] - m.eq_ref[2 * e + 1]
        slopebar = -(w.acc[r, d2] * ubar + w.qvel[r, d2] * vbar + w.lam[w.t, d2] * lbar)
        w.tangent[w.t, d2] += slopebar * p[2] - xbar * p[1]
        power = ONE
        for i in range(1, 5):
            w.grad[w.t, o + i] += slopebar * f64(float(i)) * power - xbar * power * y
            power = power * y
