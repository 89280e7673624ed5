"""MuJoCo's soft constraint: impedance, reference acceleration, regularization. Pure functions, safe for ``wp.grad``."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, TWO, ZERO, f64, vec2, vec5

MINIMP = wp.constant(wp.float64(0.0001))
MAXIMP = wp.constant(wp.float64(0.9999))


@wp.func(inline=False)
def _limit(x: f64) -> f64:
    return wp.min(MAXIMP, wp.max(MINIMP, x))


@wp.func(inline=False)
def _power(x: f64, p: f64) -> f64:
    """x to the power p, x > 0; at p = 2 and 1 without ``pow``, and with the slope in p, which is x^p log x."""
    if p == TWO:
        return x * x * (ONE + (p - TWO) * wp.log(x))
    if p == ONE:
        return x * (ONE + (p - ONE) * wp.log(x))
    return wp.pow(x, p)


@wp.func(inline=False)
def impedance(x: f64, solimp: vec5) -> f64:
    """d(x) of a constraint whose position less margin is ``x``; solimp = (d0, dwidth, width, midpoint, power)."""
    d0 = _limit(solimp[0])
    d1 = _limit(solimp[1])
    width = wp.max(ZERO, solimp[2])
    mid = _limit(solimp[3])
    p = wp.max(ONE, solimp[4])
    d = HALF * (d0 + d1)
    if width > MINVAL:  # also where d0 = d1: the value is the same, the slopes in d0 and d1 are not
        a = wp.abs(x) / width
        if a >= ONE:
            d = d1
        elif a <= ZERO:
            d = d0
        else:
            y = a
            if p != ONE:
                if a <= mid:
                    y = _power(a, p) / _power(mid, p - ONE)
                else:
                    y = ONE - _power(ONE - a, p) / _power(ONE - mid, p - ONE)
            d = d0 + y * (d1 - d0)
    return d


@wp.func(inline=False)
def _plain_power(x: f64, p: f64) -> f64:
    """x to the power p without the logarithm that a derivative in p would want."""
    if p == ONE:
        return x
    return wp.pow(x, p)


@wp.func(inline=False)
def impedance_slope(x: f64, solimp: vec5) -> vec2:
    """d(x) of :func:`impedance` and d'(x)."""
    d0 = _limit(solimp[0])
    d1 = _limit(solimp[1])
    width = wp.max(ZERO, solimp[2])
    d = HALF * (d0 + d1)
    slope = ZERO
    if width > MINVAL:
        a = wp.abs(x) / width
        if a >= ONE:
            d = d1
        elif a <= ZERO:
            d = d0
        else:
            mid = _limit(solimp[3])
            p = wp.max(ONE, solimp[4])
            z = a
            ratio = ONE
            if a > mid:
                z = ONE - a
                mid = ONE - mid
            if p != ONE:
                ratio = _plain_power(z, p - ONE) / _plain_power(mid, p - ONE)
            y = z * ratio
            if z != a:
                y = ONE - y
            d = d0 + y * (d1 - d0)
            slope = (d1 - d0) * p * ratio * wp.sign(x) / width
    return vec2(d, slope)


@wp.func(inline=False)
def _solref(solref: vec2, h: f64, refsafe: int) -> vec2:
    """solref made safe: no mixed signs, and a time constant of at least two steps."""
    a = solref[0]
    b = solref[1]
    if (a > ZERO and b <= ZERO) or (a <= ZERO and b > ZERO):
        a = f64(0.02)
        b = ONE
    if refsafe != 0 and a > ZERO:
        a = wp.max(a, TWO * h)
    return vec2(a, b)


@wp.func(inline=False)
def stiffness(solref: vec2, solimp: vec5, h: f64, refsafe: int) -> f64:
    """K of aref = −B v − K d(x) x."""
    ref = _solref(solref, h, refsafe)
    d1 = _limit(solimp[1])
    k = -ref[0] / (d1 * d1)
    if ref[0] > ZERO:
        k = ONE / wp.max(MINVAL, d1 * d1 * ref[0] * ref[0] * ref[1] * ref[1])
    return k


@wp.func(inline=False)
def damping(solref: vec2, solimp: vec5, h: f64, refsafe: int) -> f64:
    """B of aref = −B v − K d(x) x."""
    ref = _solref(solref, h, refsafe)
    d1 = _limit(solimp[1])
    b = -ref[1] / d1
    if ref[1] > ZERO:
        b = TWO / wp.max(MINVAL, d1 * ref[0])
    return b


@wp.func(inline=False)
def regularization(d: f64, invweight: f64) -> f64:
    """R = (1 − d) / d · A, with A the approximate inverse inertia."""
    return wp.max(MINVAL, (ONE - d) * invweight / d)
