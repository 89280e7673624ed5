"""Activations of actuators (integrators, filters, muscles): their rates, their steps, and the adjoints.

An activation is a state that follows the control; a force goes by it where a plain actuator's goes by the control.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.parts import is_activated, num_activations
from dropo_torch.simulators.warp.spatial import add_at, late, theta_vec3
from dropo_torch.simulators.warp.types import (
    FILTEREXACT,
    HALF,
    INTEGRATOR,
    MINVAL,
    MUSCLE,
    ONE,
    RK4,
    TWO,
    ZERO,
    Tables,
    World,
    f64,
    vec3,
)


@wp.func(inline=True)
def clamp(w: wp.ref[World], o: int, x: f64) -> f64:
    """x within the range that stands at ``o`` in θ."""
    return wp.min(wp.max(x, w.th[o]), w.th[o + 1])


@wp.func(inline=True)
def clamp_adjoint(w: wp.ref[World], o: int, x: f64, bar: f64) -> f64:
    """Adjoint of x before :func:`clamp`: where it is clamped its end of the range has it."""
    out = bar
    if x < w.th[o]:
        w.grad[w.t, o] += bar
        out = ZERO
    elif x > w.th[o + 1]:
        w.grad[w.t, o + 1] += bar
        out = ZERO
    return out


@wp.func(inline=True)
def control(m: wp.ref[Tables], w: wp.ref[World], i: int) -> f64:
    """Control of an actuator, clamped to its range."""
    u = w.ctrl[w.rc, i]
    if m.act_ctrllimited[i] != 0:
        u = clamp(w, m.o_ctrlrange + 2 * i, u)
    return u


@wp.func(inline=True)
def control_adjoint(m: wp.ref[Tables], w: wp.ref[World], i: int, bar: f64):
    """Adjoint of :func:`control`."""
    ubar = bar
    if m.act_ctrllimited[i] != 0:
        ubar = clamp_adjoint(w, m.o_ctrlrange + 2 * i, w.ctrl[w.rc, i], bar)
    w.ctrl_bar[w.rb, i] += ubar


@wp.func(inline=False)
def _muscle_rate(u: f64, act: f64, prm: vec3) -> f64:
    """Rate of a muscle's activation; ``prm`` are the time constants on and off, and the width of what joins them."""
    x = wp.clamp(act, ZERO, ONE)
    away = wp.clamp(u, ZERO, ONE) - act
    on = prm[0] * (HALF + f64(1.5) * x)
    off = prm[1] / (HALF + f64(1.5) * x)
    share = wp.where(away > ZERO, ONE, ZERO)
    if prm[2] >= MINVAL:
        y = wp.clamp(away / prm[2] + HALF, ZERO, ONE)
        share = y * y * y * (y * (f64(6.0) * y - f64(15.0)) + f64(10.0))
    return away / wp.max(off + (on - off) * share, MINVAL)


@wp.func(inline=False)
def activation_power(dynamics: int, u: f64, act: f64, prm: vec3, bar: f64) -> f64:
    """Leaf: the rate of an activation under a control, times its adjoint."""
    rate = u
    if dynamics == MUSCLE:
        rate = _muscle_rate(u, act, prm)
    elif dynamics != INTEGRATOR:
        rate = (u - act) / wp.max(prm[0], MINVAL)
    return rate * bar


@wp.func(inline=True)
def activation_rate(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """Rate of the activation of actuator ``i`` in row ``r``."""
    act = w.act[r, m.act_state[i]]
    return activation_power(m.act_dyn[i], control(m, w, i), act, theta_vec3(w.th, m.o_dynprm + 3 * i), ONE)


@wp.func(inline=True)
def reach(m: wp.ref[Tables], w: wp.ref[World], i: int) -> f64:
    """What the rate of an activation is multiplied by over a step."""
    y = m.h
    if m.act_dyn[i] == FILTEREXACT:
        tau = wp.max(w.th[m.o_dynprm + 3 * i], MINVAL)
        y = tau * (ONE - wp.exp(-m.h / tau))
    return y


@wp.func(inline=True)
def stepped(m: wp.ref[Tables], w: wp.ref[World], i: int, act: f64, rate: f64) -> f64:
    """An activation a step later, at a rate."""
    y = act + reach(m, w, i) * rate
    if m.act_statelimited[i] != 0:
        y = clamp(w, m.o_actrange + 2 * i, y)
    return y


@wp.func(inline=True)
def stepped_adjoint(m: wp.ref[Tables], w: wp.ref[World], i: int, act: f64, rate: f64, bar: f64) -> f64:
    """Adjoint of the activation in :func:`stepped`; times :func:`reach` it is the rate's."""
    y = bar
    if m.act_statelimited[i] != 0:
        y = clamp_adjoint(w, m.o_actrange + 2 * i, act + reach(m, w, i) * rate, bar)
    if m.act_dyn[i] == FILTEREXACT:
        tau = w.th[m.o_dynprm + 3 * i]
        if tau > MINVAL:
            x = m.h / tau
            w.grad[w.t, m.o_dynprm + 3 * i] += y * rate * (ONE - wp.exp(-x) * (ONE + x))
    return y


@wp.func(inline=True)
def _activation(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """Activation that acts in row ``r``."""
    y = w.act[r, m.act_state[i]]
    if m.act_early[i] != 0:
        y = stepped(m, w, i, y, activation_rate(m, w, r, i))
    return y


@wp.func(inline=True)
def drive(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """What the force of an actuator goes by: its control, its activation, or that at the end of the step."""
    y = control(m, w, i)
    if is_activated(m, i):
        y = _activation(m, w, r, i)
    return y


@wp.func(inline=True)
def _activation_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int, bar: f64):
    """Adjoint of :func:`_activation`."""
    k = m.act_state[i]
    if m.act_early[i] == 0:
        w.act_bar[w.t, k] += bar
    else:
        y = stepped_adjoint(m, w, i, w.act[r, k], activation_rate(m, w, r, i), bar)
        w.act_bar[w.t, k] += y
        w.act_rate_bar[w.t, k] += y * reach(m, w, i)


@wp.func(inline=True)
def drive_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int, bar: f64):
    """Adjoint of :func:`drive`."""
    if is_activated(m, i):
        _activation_adjoint(m, w, r, i, bar)
    else:
        control_adjoint(m, w, i, bar)


@wp.func(inline=True)
def move_activations(m: wp.ref[Tables], w: wp.ref[World], r: int, k: int, c: f64):
    """Activations of stage ``k`` of RK4, ``c`` after those of the start at the rates of the stage before."""
    for j in range(m.na):
        w.act[r + k, j] = w.act[r, j] + c * activation_rate(m, w, r + k - 1, m.state_act[j])


@wp.func(inline=True)
def mean_rate(m: wp.ref[Tables], w: wp.ref[World], r: int, i: int) -> f64:
    """Rate of an activation over the step whose stages begin in row ``r``."""
    y = activation_rate(m, w, r, i)
    if m.integrator == RK4:
        y += TWO * (activation_rate(m, w, r + 1, i) + activation_rate(m, w, r + 2, i))
        y = (y + activation_rate(m, w, r + 3, i)) / f64(6.0)
    return y


@wp.func(inline=True)
def step_activations(m: wp.ref[Tables], w: wp.ref[World], r: int, nxt: int):
    """Activations at the end of a step, in row ``nxt``."""
    for j in range(m.na):
        i = m.state_act[j]
        w.act[nxt, j] = stepped(m, w, i, w.act[r, j], mean_rate(m, w, r, i))


@wp.func(inline=True)
def step_activations_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Adjoint of :func:`step_activations`: from ``w.act_end_bar`` to the start and the rates of all stages."""
    for j in range(m.na):
        i = m.state_act[j]
        y = stepped_adjoint(m, w, i, w.act[r, j], mean_rate(m, w, r, i), w.act_end_bar[w.t, j])
        w.act_bar0[w.t, j] = y
        y = y * reach(m, w, i)
        for k in range(m.nstage):
            weight = ONE
            if m.integrator == RK4:
                weight = wp.where(k == 0 or k == 3, ONE, TWO) / f64(6.0)
            w.stage_act_rate_bar[w.t, k * m.na + j] = weight * y


@wp.func(inline=True)
def begin_activations_adjoint(m: wp.ref[Tables], w: wp.ref[World], k: int):
    """Adjoints of the activations of stage ``k`` and of their rates, before that of what depends on them."""
    for j in range(num_activations(m)):
        w.act_bar[w.t, j] = ZERO
        w.act_rate_bar[w.t, j] = w.stage_act_rate_bar[w.t, k * m.na + j]


@wp.func(inline=True)
def end_activations_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, k: int, c: f64):
    """Adjoint of the rates of stage ``k``, row ``r``, and of :func:`move_activations`; of stage 0 ``c`` is zero."""
    _late = wp.grad(late)(ONE)
    for j in range(m.na):
        i = m.state_act[j]
        o = m.o_dynprm + 3 * i
        _d, ubar, actbar, prmbar, _bar = wp.grad(activation_power)(
            m.act_dyn[i], control(m, w, i), w.act[r, j], theta_vec3(w.th, o), w.act_rate_bar[w.t, j]
        )
        control_adjoint(m, w, i, ubar)
        add_at(w.grad, w.t, o, prmbar)
        y = w.act_bar[w.t, j] + actbar
        w.act_bar0[w.t, j] += y
        w.act_end_bar[w.t, j] = w.act_bar0[w.t, j]
        if k > 0:
            w.stage_act_rate_bar[w.t, (k - 1) * m.na + j] += c * y
