"""The integrators Euler (implicit in damping), implicitfast and RK4, and their adjoints."""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.activations import (
    begin_activations_adjoint,
    end_activations_adjoint,
    move_activations,
    step_activations,
    step_activations_adjoint,
)
from dropo_torch.simulators.warp.forces import actuator_slope, actuator_slope_adjoint, damping_slope
from dropo_torch.simulators.warp.kinematics import packed, sweep_out
from dropo_torch.simulators.warp.parts import has_full_slope, num_activations, num_tendons
from dropo_torch.simulators.warp.rotations import (
    chart_rate,
    chart_rate_dual,
    quat_integrate,
    quat_mul,
    right_jacobian_t,
    turn,
)
from dropo_torch.simulators.warp.slopes import factor_full, fill_slopes, solve_full
from dropo_torch.simulators.warp.spatial import add_at, late, vec3_at, vec4_at
from dropo_torch.simulators.warp.stage import accelerate, accelerate_adjoint
from dropo_torch.simulators.warp.tendons import (
    add_outer,
    outer_dot,
    outer_mul,
    rate_bar,
    tendon_damping_slope,
    tendons_adjoint,
)
from dropo_torch.simulators.warp.triangle import factor, multiply, solve
from dropo_torch.simulators.warp.types import BALL, HALF, ONE, RK4, THREE, TWO, ZERO, Reals2, Tables, World, f64, vec4

LARGE = wp.constant(wp.float64(1.0e10))  # mjMAXVAL


@wp.func(inline=True)
def move(m: wp.ref[Tables], w: wp.ref[World], r: int, vel: Reals2, rv: int, h: f64, ro: int):
    """qpos[ro] = qpos[r] ⊕ h vel[rv]."""
    for k in range(m.nlink):
        iq = m.link_qpos[k]
        d = m.link_dof[k]
        if m.link_kind[k] == BALL:
            q = quat_integrate(vec4_at(w.qpos, r, iq), vec3_at(vel, rv, d) * h)
            for i in range(4):
                w.qpos[ro, iq + i] = q[i]
        else:
            for i in range(m.link_ndof[k]):
                w.qpos[ro, iq + i] = w.qpos[r, iq + i] + h * vel[rv, d + i]


@wp.func(inline=True)
def move_adjoint(
    m: wp.ref[Tables], w: wp.ref[World], vel: Reals2, rv: int, h: f64, bar: Reals2, vel_bar: Reals2, o: int
):
    """Adjoint of :func:`move`: adds to ``w.pos_bar0`` and ``vel_bar[w.t, o:]`` from ``bar[w.t]``."""
    for k in range(m.nlink):
        d = m.link_dof[k]
        if m.link_kind[k] == BALL:
            # q' = q exp(r): δ' = exp(−[r]) δ + J_r(r) δr
            r = vec3_at(vel, rv, d) * h
            g = vec3_at(bar, w.t, d)
            add_at(w.pos_bar0, w.t, d, turn(r, g))
            add_at(vel_bar, w.t, o + d, right_jacobian_t(r, g) * h)
        else:
            for i in range(d, d + m.link_ndof[k]):
                w.pos_bar0[w.t, i] += bar[w.t, i]
                vel_bar[w.t, o + i] += h * bar[w.t, i]


@wp.func(inline=True)
def chart_rates(m: wp.ref[Tables], w: wp.ref[World], r: int, c: f64):
    """rate[r] of a stage that is ``c`` rate[r − 1] away from the start of its step."""
    for k in range(m.nlink * m.has_ball):
        d = m.link_dof[k]
        if m.link_kind[k] == BALL:
            rate = chart_rate(vec3_at(w.rate, r - 1, d) * c, vec3_at(w.qvel, r, d))
            for i in range(3):
                w.rate[r, d + i] = rate[i]
        else:
            for i in range(d, d + m.link_ndof[k]):
                w.rate[r, i] = w.qvel[r, i]


@wp.func(inline=True)
def chart_rates_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, c: f64, o: int):
    """Adjoint of :func:`chart_rates`: ``w.stage_rate_bar[o:]`` to ``w.vel_bar`` and the stage before."""
    for k in range(m.nlink):
        d = m.link_dof[k]
        if m.link_kind[k] == BALL:
            turnedbar, velbar, _bar = wp.grad(chart_rate_dual)(
                vec3_at(w.rate, r - 1, d) * c, vec3_at(w.qvel, r, d), vec3_at(w.stage_rate_bar, w.t, o + d)
            )
            add_at(w.vel_bar, w.t, d, velbar)
            add_at(w.stage_rate_bar, w.t, o - m.nv + d, turnedbar * c)
        else:
            for i in range(d, d + m.link_ndof[k]):
                w.vel_bar[w.t, i] += w.stage_rate_bar[w.t, o + i]


@wp.func(inline=True)
def finite(x: Reals2, r: int, n: int) -> int:
    """1 while all ``n`` numbers of a row are below MuJoCo's limit."""
    ok = int(1)
    for i in range(n):
        if not (wp.abs(x[r, i]) < LARGE):
            ok = 0
    return ok


@wp.func(inline=True)
def good(m: wp.ref[Tables], w: wp.ref[World], r: int) -> int:
    """1 while every number of a state is finite and below MuJoCo's limit."""
    return finite(w.qpos, r, m.nq) * finite(w.qvel, r, m.nv)


@wp.func(inline=True)
def implicit_slope(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """B of dof ``i``: −∂τ/∂q̇ that the integrator takes implicitly."""
    b = ZERO
    if m.has_damper != 0:
        b = damping_slope(m, w, w.qvel[r, i], i)
    if m.implicit_actuators != 0:
        for a in range(m.nu):
            if m.act_dof[a] == i and m.act_tendon[a] < 0:
                b -= actuator_slope(m, w, r, a)
    return b


@wp.func(inline=True)
def tendon_slope(m: wp.ref[Tables], w: wp.ref[World], r: int, k: int) -> f64:
    """−∂F/∂v of the force F and the velocity v of tendon ``k``."""
    y = ZERO
    if m.ten_damped[k] != 0:
        y = tendon_damping_slope(m, w, k)
    for a in range(m.nu):
        if m.act_tendon[a] == k:
            y -= actuator_slope(m, w, r, a)
    return y


@wp.func(inline=True)
def soften(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """soft[r] = (M + h B)⁻¹ M acc[r], with the factor left in ``w.soft_hess[r]``."""
    multiply(m.dof_parent, m.nv, 0, w.mass, w.t, w.acc, r, w.soft, r)
    if has_full_slope(m):
        fill_slopes(m, w, r)
        for i in range(m.nv):
            w.soft_hess[r, i * m.nv + i] += m.h * implicit_slope(m, w, r, i)
        factor_full(m, w.soft_hess, r)
        solve_full(m, w.soft_hess, r, w.soft, r)
    else:
        for i in range(m.nh):
            w.soft_hess[r, i] = w.mass[w.t, i]
        for i in range(m.nv):
            w.soft_hess[r, packed(i, i)] += m.h * implicit_slope(m, w, r, i)
        for k in range(num_tendons(m) * m.implicit_actuators):
            y = m.h * tendon_slope(m, w, r, k)
            if y != ZERO:
                add_outer(m, w, k, y, w.soft_hess, r)
        factor(m.dof_parent, m.nv, 0, w.soft_hess, r)
        solve(m.dof_parent, m.nv, 0, w.soft_hess, r, w.soft, r)


@wp.func(inline=True)
def slope_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """The part of B in the adjoint of :func:`soften`: the gradient of −h λᵀ B a', into ``w.stage_vel_bar`` and θ."""
    if m.has_damper != 0:
        for i in range(m.nv):
            y = -m.h * w.lam[w.t, i] * w.soft[r, i]  # ∂/∂B
            v = w.qvel[r, i]
            n = wp.abs(v)
            ip = m.o_dampingpoly + 2 * i
            w.grad[w.t, m.o_damping + i] += y
            w.grad[w.t, ip] += TWO * n * y
            w.grad[w.t, ip + 1] += THREE * n * n * y
            w.stage_vel_bar[w.t, i] += y * (TWO * w.th[ip] * wp.sign(v) + f64(6.0) * w.th[ip + 1] * v)
    if m.implicit_actuators != 0:
        for a in range(m.nu):
            if m.act_tendon[a] < 0:
                i = m.act_dof[a]
                actuator_slope_adjoint(m, w, r, a, m.h * w.lam[w.t, i] * w.soft[r, i])
        for k in range(num_tendons(m)):
            _tendon_slope_adjoint(m, w, r, k)
        tendons_adjoint(m, w)


@wp.func(inline=False)
def _tendon_slope_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, k: int):
    """The part of tendon ``k`` in :func:`slope_adjoint`."""
    power = outer_dot(m, w, k, w.lam, w.t, w.soft, r, -m.h * tendon_slope(m, w, r, k))
    if m.ten_damped[k] != 0:
        y = -m.h * power  # ∂/∂B
        v = w.ten_rate[w.t, k]
        n = wp.abs(v)
        ip = m.o_ten_dampingpoly + 2 * k
        w.grad[w.t, m.o_ten_damping + k] += y
        w.grad[w.t, ip] += TWO * n * y
        w.grad[w.t, ip + 1] += THREE * n * n * y
        curve = TWO * w.th[ip] * wp.sign(v) + f64(6.0) * w.th[ip + 1] * v
        rate_bar(m, w, k, y * curve, w.stage_vel_bar, r)
    for a in range(m.nu):
        if m.act_tendon[a] == k:
            actuator_slope_adjoint(m, w, r, a, m.h * power)


@wp.func(inline=True)
def rk4_sum(x: Reals2, r: int, i: int) -> f64:
    """Six times the mean of the four stages from row ``r``."""
    return x[r, i] + TWO * x[r + 1, i] + TWO * x[r + 2, i] + x[r + 3, i]


@wp.func(inline=True)
def stage_time(h: f64, k: int) -> f64:
    """How far stage ``k`` > 0 of RK4 is from the one before."""
    return wp.where(k == 3, h, h * HALF)


@wp.func(inline=True)
def step(m: wp.ref[Tables], w: wp.ref[World], r: int, nxt: int) -> int:
    """One physics step from row ``r`` (stages in the rows after it) to row ``nxt``; 1 while it is good."""
    h = m.h
    ok = good(m, w, r)
    for k in range(m.nstage):
        if ok != 0:
            if k > 0:
                c = stage_time(h, k)
                # Munthe-Kaas: stages of a quaternion combine in the chart at the start of the step
                move(m, w, r, w.rate, r + k - 1, c, r + k)
                for i in range(m.nv):
                    w.qvel[r + k, i] = w.qvel[r, i] + c * w.acc[r + k - 1, i]
                    w.acc[r + k, i] = w.acc[r + k - 1, i]  # the guess of a stage
                chart_rates(m, w, r + k, c)
                if num_activations(m) != 0:
                    move_activations(m, w, r, k, c)
            else:
                for i in range(m.nv):
                    w.rate[r, i] = w.qvel[r, i]
            accelerate(m, w, r + k)
            if k == 0:
                ok = finite(w.acc, r, m.nv)
    if ok != 0:
        if m.integrator == RK4:
            for i in range(m.nv):
                w.work[w.t, i] = rk4_sum(w.rate, r, i) / f64(6.0)
                w.qvel[nxt, i] = w.qvel[r, i] + h / f64(6.0) * rk4_sum(w.acc, r, i)
        else:
            if m.implicit != 0:
                soften(m, w, r)
            for i in range(m.nv):
                a = w.soft[r, i] if m.implicit != 0 else w.acc[r, i]
                v = w.qvel[r, i] + h * a
                w.qvel[nxt, i] = v
                w.work[w.t, i] = v
        move(m, w, r, w.work, w.t, h, nxt)
        if num_activations(m) != 0:
            step_activations(m, w, r, nxt)
        for i in range(m.nv):
            w.acc[nxt, i] = w.acc[r + m.nstage - 1, i]
    return ok


@wp.func(inline=True)
def step_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, nxt: int):
    """Adjoint of :func:`step`: ``w.pos_bar`` (tangent) and ``w.rate_bar`` of the end become those of the start."""
    _late = wp.grad(late)(ONE)
    h = m.h
    nv = m.nv
    _end_adjoint(m, w, r, nxt)
    if num_activations(m) != 0:
        step_activations_adjoint(m, w, r)
    passes = m.nstage + m.implicit * (1 + m.implicit_fluid + 2 * m.has_turning)
    for back in range(passes):
        left = passes - 1 - back
        softening = int(0)
        k = int(0)
        if m.nstage > 1:
            k = m.nstage - 1 - back
            for i in range(nv):
                w.acc_bar[w.t, i] = w.stage_acc_bar[w.t, k * nv + i]
        elif left != 0:
            softening = 3
            if back == 0:
                softening = 1
            elif back == 1 and m.implicit_fluid != 0:
                softening = 2
        for i in range(nv):
            w.tangent[w.t, i] = ZERO
            w.vel_bar[w.t, i] = ZERO
        if back == 0 or m.nstage > 1:
            begin_activations_adjoint(m, w, k)
        if softening == 3:
            # ∂c/∂v a' = (c(v + h a') − c(v − h a')) / 2 h, for c is quadratic in v
            for i in range(nv):
                y = wp.where(left == 2, h, -h) * w.soft[r, i]
                w.kept[w.t, i] = w.qvel[r, i]
                w.qvel[r, i] = w.qvel[r, i] + y
                w.lam[w.t, i] = w.lam[w.t, i] * wp.where(left == 2, -HALF, -ONE)
                w.qacc[w.t, i] = ZERO
                w.qd[w.t, i] = w.qvel[r, i]
        sweep_out(m, w, r + k)
        if softening == 1:
            # λ = (M + h B)⁻ᵀ ā', then the gradient of λᵀ (M (a − a') − h B a')
            for i in range(nv):
                w.lam[w.t, i] = w.acc_bar[w.t, i]
                w.qacc[w.t, i] = w.acc[r, i] - w.soft[r, i]
                w.qd[w.t, i] = ZERO
        elif softening == 2:
            for i in range(nv):
                w.qacc[w.t, i] = -h * w.soft[r, i]
                w.qd[w.t, i] = w.qvel[r, i]
        elif softening == 0:
            for i in range(nv):
                w.lam[w.t, i] = -w.acc_bar[w.t, i]
                w.qacc[w.t, i] = w.acc[r + k, i]
                w.qd[w.t, i] = w.qvel[r + k, i]
        accelerate_adjoint(m, w, r + k, softening)
        if softening > 1:
            for i in range(nv):
                w.pos_bar0[w.t, i] += w.tangent[w.t, i]
                w.stage_vel_bar[w.t, i] += w.vel_bar[w.t, i]
                if softening == 3:
                    w.qvel[r, i] = w.kept[w.t, i]
        elif softening == 1:
            slope_adjoint(m, w, r)
            for i in range(nv):
                w.pos_bar0[w.t, i] += w.tangent[w.t, i]
                # ā = M λ, with M λ = Σ_subtree s · I Λ + armature
                inertial = wp.dot(w.motion[w.t, i], w.f_accel[w.t, m.dof_body[i]])
                w.acc_bar[w.t, i] = inertial + w.th[m.o_armature + i] * w.lam[w.t, i]
            for n in range(num_tendons(m)):
                outer_mul(m, w, n, w.th[m.o_ten_armature + n], w.lam, w.t, w.acc_bar, w.t)
        elif k > 0:
            c = stage_time(h, k)
            if num_activations(m) != 0:
                end_activations_adjoint(m, w, r + k, k, c)
            chart_rates_adjoint(m, w, r + k, c, k * nv)
            for i in range(nv):
                w.stage_vel_bar[w.t, i] += w.vel_bar[w.t, i]
                w.stage_acc_bar[w.t, (k - 1) * nv + i] += c * w.vel_bar[w.t, i]
            move_adjoint(m, w, w.rate, r + k - 1, c, w.tangent, w.stage_rate_bar, (k - 1) * nv)
        elif num_activations(m) != 0:
            end_activations_adjoint(m, w, r, 0, ZERO)
    for i in range(nv):
        w.pos_bar[w.t, i] = w.pos_bar0[w.t, i] + w.tangent[w.t, i]
        w.rate_bar[w.t, i] = w.stage_vel_bar[w.t, i] + w.stage_rate_bar[w.t, i] + w.vel_bar[w.t, i]


@wp.func(inline=True)
def _end_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, nxt: int):
    """Adjoint of the last line of a step: what its end gives to start, stages and accelerations."""
    h = m.h
    nv = m.nv
    for i in range(nv):
        w.pos_bar0[w.t, i] = ZERO
        w.tangent[w.t, i] = ZERO
        w.stage_vel_bar[w.t, i] = w.rate_bar[w.t, i]
        w.stage_rate_bar[w.t, i] = ZERO
    if m.has_ball != 0:
        for i in range(nv):
            if m.integrator == RK4:
                w.work[w.t, i] = rk4_sum(w.rate, r, i) / f64(6.0)
            else:
                w.work[w.t, i] = w.qvel[nxt, i]
    move_adjoint(m, w, w.work, w.t, h, w.pos_bar, w.tangent, 0)
    for i in range(nv):
        g = w.tangent[w.t, i]
        if m.integrator == RK4:
            abar = w.rate_bar[w.t, i] * h / f64(6.0)
            for k in range(4):
                weight = wp.where(k == 0 or k == 3, ONE, TWO)
                w.stage_rate_bar[w.t, k * nv + i] = weight * g / f64(6.0)
                w.stage_acc_bar[w.t, k * nv + i] = weight * abar
        else:
            # q' = q ⊕ h v', v' = v + h a'
            w.stage_vel_bar[w.t, i] += g
            w.acc_bar[w.t, i] = h * (w.rate_bar[w.t, i] + g)


@wp.func(inline=True)
def to_tangent(m: wp.ref[Tables], w: wp.ref[World], r: int, bar: Reals2, rb: int):
    """Add the adjoint of a raw position to its tangent: ½ (q* ⊗ q̄) of a unit quaternion."""
    for k in range(m.nlink):
        iq = m.link_qpos[k]
        d = m.link_dof[k]
        if m.link_kind[k] == BALL:
            q = vec4_at(w.qpos, r, iq)
            g = quat_mul(vec4(q[0], -q[1], -q[2], -q[3]), vec4_at(bar, rb, iq))
            add_at(w.pos_bar, w.t, d, HALF * g[1:4])
        else:
            for i in range(m.link_ndof[k]):
                w.pos_bar[w.t, d + i] += bar[rb, iq + i]


@wp.func(inline=True)
def from_tangent(m: wp.ref[Tables], w: wp.ref[World], r: int, out: Reals2, ro: int):
    """Write the adjoint of a raw position from its tangent: 2/|q| q̂ ⊗ (0, g)."""
    for k in range(m.nlink):
        iq = m.link_qpos[k]
        d = m.link_dof[k]
        if m.link_kind[k] == BALL:
            q = vec4_at(w.qpos, r, iq)
            bar = vec3_at(w.pos_bar, w.t, d)
            g = quat_mul(q, vec4(ZERO, bar[0], bar[1], bar[2])) * (TWO / wp.dot(q, q))
            for i in range(4):
                out[ro, iq + i] = g[i]
        else:
            for i in range(m.link_ndof[k]):
                out[ro, iq + i] = w.pos_bar[w.t, d + i]
