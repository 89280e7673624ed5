"""Scalar constraint rows: friction loss, limits and equalities of joints and of tendons.

A row has at most three dofs, or its J combines those of one or two tendons. Its force f minimizes MuJoCo's cost at
J a − aref: quadratic (equality), one-sided (limit) or Huber's (friction loss).
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.impedance import regularization
from dropo_torch.simulators.warp.parts import num_tendons
from dropo_torch.simulators.warp.rotations import chart_rate, quat_log
from dropo_torch.simulators.warp.soft import Soft, soft_adjoint, softness
from dropo_torch.simulators.warp.spatial import add_at, late, vec3_at, vec4_at
from dropo_torch.simulators.warp.tendons import tendon_add, tendon_bar, tendon_dot
from dropo_torch.simulators.warp.types import (
    BALL,
    EQ_WIDTH,
    MINVAL,
    ONE,
    TWO,
    ZERO,
    Reals2,
    Tables,
    World,
    f64,
    vec3,
    vec3i,
)

FOUR = wp.constant(wp.float64(4.0))
#: Kinds of row.
ROW_EQUALITY = wp.constant(0)
ROW_FRICTION = wp.constant(1)
ROW_LIMIT = wp.constant(2)


@wp.func(inline=True)
def row_force(w: wp.ref[World], n: int, jar: f64) -> f64:
    """Constraint force of row ``n`` at J a − aref = ``jar``."""
    f = -w.row_d[w.t, n] * jar
    if w.row_kind[w.t, n] == ROW_LIMIT:
        f = wp.max(ZERO, f)
    elif w.row_kind[w.t, n] == ROW_FRICTION:
        f = wp.clamp(f, -w.row_loss[w.t, n], w.row_loss[w.t, n])
    return f


@wp.func(inline=True)
def row_state(w: wp.ref[World], n: int, jar: f64) -> int:
    """Which piece of the cost of row ``n`` ``jar`` is on; 1 is the quadratic one."""
    state = int(1)
    if w.row_kind[w.t, n] == ROW_LIMIT:
        if jar >= ZERO:
            state = int(0)
    elif w.row_kind[w.t, n] == ROW_FRICTION:
        y = w.row_d[w.t, n] * jar
        if wp.abs(y) >= w.row_loss[w.t, n]:
            state = wp.where(y < ZERO, 2, 3)
    return state


@wp.func(inline=True)
def equality_position(m: wp.ref[Tables], w: wp.ref[World], r: int, e: int) -> vec3:
    """(q1 − p(q2), p'(q2), p''(q2)) of a joint equality, both measured from their references."""
    c = m.o_eq_data + EQ_WIDTH * m.eq_id[e]
    x = w.qpos[r, m.eq_qpos[2 * e]] - m.eq_ref[2 * e] - w.th[c]
    slope = ZERO
    curve = ZERO
    if m.eq_dof[2 * e + 1] >= 0:
        y = w.qpos[r, m.eq_qpos[2 * e + 1]] - m.eq_ref[2 * e + 1]
        p = polynomial(w, c, y)
        x -= p[0]
        slope = p[1]
        curve = p[2]
    return vec3(x, slope, curve)


@wp.func(inline=True)
def row_dot(m: wp.ref[Tables], w: wp.ref[World], n: int, x: Reals2, r: int) -> f64:
    """J x of row ``n``."""
    c = w.row_coef[w.t, n]
    d = w.row_dof[w.t, n]
    if num_tendons(m) != 0 and w.row_tendon[w.t, n] != 0:
        z = c[0] * tendon_dot(m, w, d[0], x, r)
        if d[1] >= 0:
            z += c[1] * tendon_dot(m, w, d[1], x, r)
        return z
    y = c[0] * x[r, d[0]]
    if d[1] >= 0:
        y += c[1] * x[r, d[1]]
        if d[2] >= 0:
            y += c[2] * x[r, d[2]]
    return y


@wp.func(inline=True)
def row_add(m: wp.ref[Tables], w: wp.ref[World], n: int, y: f64, x: Reals2, r: int):
    """x += Jᵀ y of row ``n``."""
    c = w.row_coef[w.t, n]
    d = w.row_dof[w.t, n]
    if num_tendons(m) != 0 and w.row_tendon[w.t, n] != 0:
        tendon_add(m, w, d[0], c[0] * y, x, r)
        if d[1] >= 0:
            tendon_add(m, w, d[1], c[1] * y, x, r)
    else:
        x[r, d[0]] += c[0] * y
        if d[1] >= 0:
            x[r, d[1]] += c[1] * y
            if d[2] >= 0:
                x[r, d[2]] += c[2] * y


@wp.func(inline=True)
def row_softness(m: wp.ref[Tables], w: wp.ref[World], n: int) -> Soft:
    """The softness of row ``n``; a friction loss has no stiffness."""
    kind = w.row_kind[w.t, n]
    index = w.row_index[w.t, n]
    d = w.row_dof[w.t, n]
    o_ref = m.o_dof_solref + 2 * d[0]
    o_imp = m.o_dof_solimp + 5 * d[0]
    o_weight = m.o_dof_invweight
    if w.row_tendon[w.t, n] != 0:
        o_weight = m.o_ten_invweight
        o_ref = wp.where(kind == ROW_LIMIT, m.o_ten_solref_lim, m.o_ten_solref_fri) + 2 * index
        o_imp = wp.where(kind == ROW_LIMIT, m.o_ten_solimp_lim, m.o_ten_solimp_fri) + 5 * index
        if kind == ROW_EQUALITY:
            o_ref = m.o_eq_solref + 2 * m.teneq_id[index]
            o_imp = m.o_eq_solimp + 5 * m.teneq_id[index]
    weight = w.th[o_weight + d[0]]
    if w.row_tendon[w.t, n] != 0:
        if kind == ROW_EQUALITY and d[1] >= 0:
            weight += w.th[o_weight + d[1]]
    elif kind == ROW_LIMIT:
        j = m.link_jnt[m.limit_link[index]]
        o_ref = m.o_jnt_solref + 2 * j
        o_imp = m.o_jnt_solimp + 5 * j
    elif kind == ROW_EQUALITY:
        o_ref = m.o_eq_solref + 2 * m.eq_id[index]
        o_imp = m.o_eq_solimp + 5 * m.eq_id[index]
        if d[1] >= 0:
            weight += w.th[o_weight + d[1]]
    soft = softness(m, w, o_ref, o_imp, weight, w.row_x[w.t, n])
    if kind == ROW_FRICTION:
        soft.k = ZERO
    return soft


@wp.func(inline=True)
def make_rows(m: wp.ref[Tables], w: wp.ref[World], r: int, weighed: int) -> int:
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
            else:
                coef = vec3(f64(1 - 2 * side), ZERO, ZERO)
                x = coef[0] * (w.qpos[r, iq] - w.th[o + side]) - w.th[m.o_jnt_margin + j]
        if kind == ROW_EQUALITY or (kind == ROW_FRICTION and loss > ZERO) or (kind == ROW_LIMIT and x < ZERO):
            dof3 = wp.where(dof2 >= 0 and kind == ROW_LIMIT, dof + 2, -1)
            w.row_loss[w.t, n] = loss
            w.row_tendon[w.t, n] = 0
            _add_row(m, w, r, n, kind, index, vec3i(dof, dof2, dof3), coef, x, weighed)
            n += 1
    if num_tendons(m) != 0:
        n = make_tendon_rows(m, w, r, n, weighed)
    return n


@wp.func(inline=True)
def _add_row(
    m: wp.ref[Tables], w: wp.ref[World], r: int, n: int, kind: int, index: int, dofs: vec3i, coef: vec3, x: f64,
    weighed: int,
):  # fmt: skip
    """Write row ``n``."""
    w.row_kind[w.t, n] = kind
    w.row_index[w.t, n] = index
    w.row_dof[w.t, n] = dofs
    w.row_coef[w.t, n] = coef
    w.row_x[w.t, n] = x
    if weighed != 0:
        soft = row_softness(m, w, n)
        w.row_aref[w.t, n] = -soft.b * row_dot(m, w, n, w.qvel, r) - soft.k * soft.imp * x
        w.row_d[w.t, n] = ONE / regularization(soft.imp, soft.weight)


@wp.func(inline=False)
def make_tendon_rows(m: wp.ref[Tables], w: wp.ref[World], r: int, start: int, weighed: int) -> int:
    """List the rows of tendons after the ``start`` that there are, and return the number of all."""
    n = int(start)
    for candidate in range(m.nteneq + 3 * num_tendons(m)):
        k = candidate - m.nteneq
        kind = int(ROW_EQUALITY)
        index = int(candidate)
        x = f64(0.0)
        loss = f64(0.0)
        coef = vec3(ONE, ZERO, ZERO)
        other = int(-1)
        acts = int(1)
        if k < 0:
            p = tendon_equality_position(m, w, index)
            x = p[0]
            coef = vec3(ONE, -p[1], ZERO)
            k = m.teneq_tendon[2 * index]
            other = m.teneq_tendon[2 * index + 1]
        else:
            side = k % 3
            k = k // 3
            index = k
            if side == 2:
                kind = ROW_FRICTION
                loss = w.th[m.o_ten_frictionloss + k]
                acts = wp.where(m.ten_frictional[k] != 0 and loss > ZERO, 1, 0)
            else:
                kind = ROW_LIMIT
                coef = vec3(f64(1 - 2 * side), ZERO, ZERO)
                x = coef[0] * (w.ten_length[w.t, k] - w.th[m.o_ten_range + 2 * k + side]) - w.th[m.o_ten_margin + k]
                acts = wp.where(m.ten_limited[k] != 0 and x < ZERO, 1, 0)
        if acts != 0:
            w.row_loss[w.t, n] = loss
            w.row_tendon[w.t, n] = 1
            _add_row(m, w, r, n, kind, index, vec3i(k, other, -1), coef, x, weighed)
            n += 1
    return n


@wp.func(inline=False)
def tendon_equality_position(m: wp.ref[Tables], w: wp.ref[World], e: int) -> vec3:
    """:func:`equality_position` of the lengths of two tendons, measured from those at the reference position."""
    k1 = m.teneq_tendon[2 * e]
    k2 = m.teneq_tendon[2 * e + 1]
    c = m.o_eq_data + EQ_WIDTH * m.teneq_id[e]
    p = vec3()
    if k2 >= 0:
        p = polynomial(w, c, w.ten_length[w.t, k2] - m.ten_ref[k2])
    return vec3(w.ten_length[w.t, k1] - m.ten_ref[k1] - w.th[c] - p[0], p[1], p[2])


@wp.func(inline=True)
def polynomial(w: wp.ref[World], c: int, y: f64) -> vec3:
    """The polynomial of an equality whose numbers stand at ``c`` in θ, without its constant, and two derivatives."""
    value = y * (w.th[c + 1] + y * (w.th[c + 2] + y * (w.th[c + 3] + y * w.th[c + 4])))
    slope = w.th[c + 1] + y * (TWO * w.th[c + 2] + y * (f64(3.0) * w.th[c + 3] + y * FOUR * w.th[c + 4]))
    return vec3(value, slope, TWO * w.th[c + 2] + y * (f64(6.0) * w.th[c + 3] + y * f64(12.0) * w.th[c + 4]))


@wp.func(inline=True)
def rows_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, nrow: int):
    """Adjoint of the rows: the gradient of Σ −f Jλ, with J where it moves."""
    _late = wp.grad(late)(ONE)
    for n in range(nrow):
        kind = w.row_kind[w.t, n]
        soft = row_softness(m, w, n)
        v = row_dot(m, w, n, w.qvel, r)
        jar = row_dot(m, w, n, w.acc, r) + soft.b * v + soft.k * soft.imp * soft.x
        d = ONE / regularization(soft.imp, soft.weight)
        w.row_d[w.t, n] = d
        state = row_state(w, n, jar)
        if state != 0:
            jl = row_dot(m, w, n, w.lam, w.t)
            dof = w.row_dof[w.t, n][0]
            if state == 1:
                ubar = d * jl
                sbar = wp.where(kind == ROW_FRICTION, ZERO, ubar)
                xbar, weightbar, _mubar = soft_adjoint(m, w, soft, 1, ONE, d, jar * jl, v * ubar, sbar)
                row_add(m, w, n, soft.b * ubar, w.vel_bar, w.t)
                lbar = d * jar
                tendon = w.row_tendon[w.t, n]
                w.grad[w.t, wp.where(tendon != 0, m.o_ten_invweight, m.o_dof_invweight) + dof] += weightbar
                if tendon != 0:
                    _tendon_row_adjoint(m, w, r, n, xbar, ubar, soft.b * ubar, lbar, weightbar)
                elif kind == ROW_LIMIT:
                    _limit_adjoint(m, w, r, n, xbar, ubar, soft.b * ubar, lbar)
                elif kind == ROW_EQUALITY:
                    if w.row_dof[w.t, n][1] >= 0:
                        w.grad[w.t, m.o_dof_invweight + w.row_dof[w.t, n][1]] += weightbar
                    _equality_adjoint(m, w, r, n, xbar, ubar, soft.b * ubar, lbar)
            else:
                o = wp.where(w.row_tendon[w.t, n] != 0, m.o_ten_frictionloss, m.o_frictionloss)
                w.grad[w.t, o + dof] += wp.where(state == 2, -jl, jl)
                if w.row_tendon[w.t, n] != 0:
                    tendon_bar(m, w, dof, wp.where(state == 2, -ONE, ONE) * w.row_loss[w.t, n], w.lam, w.t)


@wp.func(inline=True)
def _limit_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, n: int, xbar: f64, ubar: f64, vbar: f64, lbar: f64):
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
        w.grad[w.t, wp.where(w.th[o] >= w.th[o + 1], o, o + 1)] += xbar
        cbar = vec3_at(w.acc, r, d) * ubar + vec3_at(w.qvel, r, d) * vbar + vec3_at(w.lam, w.t, d) * lbar
        # c = −φ/|φ|, x = ... − |φ|
        g = c * xbar - (cbar - c * wp.dot(c, cbar)) / angle
        add_at(w.tangent, w.t, d, chart_rate(-rot, g))
    else:
        w.tangent[w.t, d] += c[0] * xbar
        w.grad[w.t, wp.where(c[0] > ZERO, o, o + 1)] -= c[0] * xbar


@wp.func(inline=True)
def _equality_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, n: int, xbar: f64, ubar: f64, vbar: f64, lbar: f64):
    """Where an equality's position and slope come from."""
    e = w.row_index[w.t, n]
    d1 = m.eq_dof[2 * e]
    d2 = m.eq_dof[2 * e + 1]
    o = m.o_eq_data + EQ_WIDTH * m.eq_id[e]
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


@wp.func(inline=False)
def _tendon_row_adjoint(
    m: wp.ref[Tables], w: wp.ref[World], r: int, n: int, xbar: f64, ubar: f64, vbar: f64, lbar: f64, weightbar: f64
):  # fmt: skip
    """Where the position and J of a row of tendons come from."""
    kind = w.row_kind[w.t, n]
    coef = w.row_coef[w.t, n]
    k = w.row_dof[w.t, n][0]
    other = w.row_dof[w.t, n][1]
    _arms_bar(m, w, r, k, coef[0], ubar, vbar, lbar)
    if kind == ROW_LIMIT:
        w.ten_length_bar[w.t, k] += coef[0] * xbar
        w.grad[w.t, m.o_ten_range + 2 * k + wp.where(coef[0] > ZERO, 0, 1)] -= coef[0] * xbar
        w.grad[w.t, m.o_ten_margin + k] -= xbar
    elif kind == ROW_EQUALITY:
        e = w.row_index[w.t, n]
        o = m.o_eq_data + EQ_WIDTH * m.teneq_id[e]
        w.ten_length_bar[w.t, k] += xbar
        w.grad[w.t, o] -= xbar
        if other >= 0:
            w.grad[w.t, m.o_ten_invweight + other] += weightbar
            _arms_bar(m, w, r, other, coef[1], ubar, vbar, lbar)
            slopebar = -(tendon_dot(m, w, other, w.acc, r) * ubar + tendon_dot(m, w, other, w.qvel, r) * vbar)
            slopebar -= tendon_dot(m, w, other, w.lam, w.t) * lbar
            y = w.ten_length[w.t, other] - m.ten_ref[other]
            p = polynomial(w, o, y)
            w.ten_length_bar[w.t, other] += slopebar * p[2] - xbar * p[1]
            power = ONE
            for i in range(1, 5):
                w.grad[w.t, o + i] += slopebar * f64(float(i)) * power - xbar * power * y
                power = power * y


@wp.func(inline=False)
def _arms_bar(m: wp.ref[Tables], w: wp.ref[World], r: int, k: int, coef: f64, ubar: f64, vbar: f64, lbar: f64):
    """Adjoint of J of tendon ``k`` through J a, J q̇ and Jλ."""
    tendon_bar(m, w, k, coef * ubar, w.acc, r)
    tendon_bar(m, w, k, coef * vbar, w.qvel, r)
    tendon_bar(m, w, k, coef * lbar, w.lam, w.t)
