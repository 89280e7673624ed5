"""Rotations: matrices, quaternions (w, x, y, z) and rotation vectors with their Jacobians, as pure Warp functions."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, TWO, ZERO, f64, mat33, vec3, vec4


@wp.func(inline=False)
def rotation(axis: vec3, angle: f64) -> mat33:
    """Rodrigues' rotation by ``angle`` about the unit ``axis``."""
    s = wp.sin(angle)
    c = wp.cos(angle)
    t = ONE - c
    x = axis[0]
    y = axis[1]
    z = axis[2]
    return mat33(
        t * x * x + c, t * x * y - s * z, t * x * z + s * y,
        t * x * y + s * z, t * y * y + c, t * y * z - s * x,
        t * x * z - s * y, t * y * z + s * x, t * z * z + c,
    )  # fmt: skip


@wp.func(inline=False)
def quat_matrix(q: vec4) -> mat33:
    """Rotation of the quaternion (w, x, y, z), which need not be normalized; the zero quaternion is identity."""
    n = wp.length(q)
    unit = vec4(ONE, ZERO, ZERO, ZERO)
    if n > MINVAL:
        unit = q / n
    w = unit[0]
    x = unit[1]
    y = unit[2]
    z = unit[3]
    return mat33(
        w * w + x * x - y * y - z * z, TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), w * w - x * x + y * y - z * z, TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), w * w - x * x - y * y + z * z,
    )  # fmt: skip


@wp.func(inline=False)
def quat_mul(a: vec4, b: vec4) -> vec4:
    """Product of two quaternions."""
    return vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func(inline=False)
def quat_integrate(q: vec4, r: vec3) -> vec4:
    """q turned by the local rotation vector ``r``, normalized."""
    angle = wp.length(r)
    s = HALF
    if angle > f64(1.0e-8):
        s = wp.sin(HALF * angle) / angle
    out = quat_mul(q, vec4(wp.cos(HALF * angle), s * r[0], s * r[1], s * r[2]))
    return out / wp.length(out)


@wp.func(inline=False)
def quat_log(q: vec4) -> vec3:
    """Rotation vector of q, the short way round (mju_quat2Vel over one second)."""
    v = vec3(q[1], q[2], q[3])
    s = wp.length(v)
    k = TWO
    if s > MINVAL:
        angle = TWO * wp.atan2(s, q[0])
        if angle > f64(wp.pi):
            angle -= f64(2.0 * wp.pi)
        k = angle / s
    return v * k


@wp.func(inline=False)
def turn(r: vec3, x: vec3) -> vec3:
    """exp([r]) x: the vector ``x`` rotated by the rotation vector ``r``."""
    a2 = wp.dot(r, r)
    s = ONE
    c = HALF
    if a2 > f64(1.0e-16):
        a = wp.sqrt(a2)
        s = wp.sin(a) / a
        c = TWO * wp.sin(HALF * a) * wp.sin(HALF * a) / a2
    u = wp.cross(r, x)
    return x + s * u + c * wp.cross(r, u)


@wp.func(inline=False)
def right_jacobian_t(r: vec3, x: vec3) -> vec3:
    """J_r(r)ᵀ x, with exp([r + d]) ≈ exp([r]) exp([J_r(r) d]); J_rᵀ = I + (1−cos a)/a² [r] + (a−sin a)/a³ [r]²."""
    a2 = wp.dot(r, r)
    c = HALF - a2 / f64(24.0)
    e = ONE / f64(6.0) - a2 / f64(120.0)
    if a2 > f64(1.0e-6):
        a = wp.sqrt(a2)
        c = TWO * wp.sin(HALF * a) * wp.sin(HALF * a) / a2
        e = (a - wp.sin(a)) / (a2 * a)
    u = wp.cross(r, x)
    return x + c * u + e * wp.cross(r, u)


@wp.func(inline=False)
def _curl(a2: f64) -> f64:
    """1/a² − (1 + cos a) / (2 a sin a), the coefficient of [r]² in J_r(r)⁻¹."""
    k = ONE / f64(12.0) + a2 / f64(720.0) + a2 * a2 / f64(30240.0)
    if a2 > f64(1.0e-4):
        a = wp.sqrt(a2)
        k = ONE / a2 - (ONE + wp.cos(a)) / (TWO * a * wp.sin(a))
    return k


@wp.func(inline=False)
def chart_rate(r: vec3, w: vec3) -> vec3:
    """J_r(r)⁻¹ w: how fast the rotation vector r of q₀⁻¹q changes while q turns at the local rate w.

    J_r(r)⁻ᵀ = J_r(−r)⁻¹: what a change of log(q) sees of a local turn of q.
    """
    u = wp.cross(r, w)
    return w + HALF * u + _curl(wp.dot(r, r)) * wp.cross(r, u)


@wp.func(inline=False)
def chart_rate_dual(r: vec3, w: vec3, bar: vec3) -> f64:
    """Leaf: the adjoint of :func:`chart_rate` is its gradient."""
    return wp.dot(chart_rate(r, w), bar)
