"""Spatial algebra on ``vec6`` (angular first) and rigid rotations, as pure Warp functions."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

from typing import Any

import warp as wp

from dropo_torch.simulators.warp.types import (
    HALF,
    MINVAL,
    ONE,
    TWO,
    ZERO,
    Reals,
    Reals2,
    f64,
    mat33,
    vec2,
    vec3,
    vec4,
    vec5,
    vec6,
    vec10,
)

#: Of a spatial vector the angular and the linear part; a × b of two motions; a ×* f of a motion and a force, its dual:
#: ⟨f, a × b⟩ = −⟨a ×* f, b⟩.
ang, lin, cross_motion, cross_force = wp.spatial_top, wp.spatial_bottom, wp.spatial_cross, wp.spatial_cross_dual


@wp.func
def theta_vec2(th: Reals, i: int) -> vec2:
    """Two consecutive numbers of θ."""
    return vec2(th[i], th[i + 1])


@wp.func
def theta_vec3(th: Reals, i: int) -> vec3:
    """Three consecutive numbers of θ."""
    return vec3(th[i], th[i + 1], th[i + 2])


@wp.func
def theta_vec5(th: Reals, i: int) -> vec5:
    """Five consecutive numbers of θ."""
    return vec5(th[i], th[i + 1], th[i + 2], th[i + 3], th[i + 4])


@wp.func(inline=True)
def vec3_at(x: Reals2, r: int, i: int) -> vec3:
    """Three consecutive numbers of a row."""
    return vec3(x[r, i], x[r, i + 1], x[r, i + 2])


@wp.func(inline=True)
def vec4_at(x: Reals2, r: int, i: int) -> vec4:
    """Four consecutive numbers of a row."""
    return vec4(x[r, i], x[r, i + 1], x[r, i + 2], x[r, i + 3])


@wp.func(inline=True)
def add_at(x: Reals2, r: int, i: int, y: Any):
    """Add a vector to consecutive numbers of a row."""
    for k in range(len(y)):
        x[r, i + k] += y[k]


@wp.func
def join(w: vec3, v: vec3) -> vec6:
    """The spatial vector of an angular and a linear part."""
    return vec6(w[0], w[1], w[2], v[0], v[1], v[2])


@wp.func
def at(x: vec6, p: vec3) -> vec3:
    """Linear part of the motion ``x`` at the point ``p``: v + ω × p."""
    return lin(x) + wp.cross(ang(x), p)


@wp.func
def wrench(f: vec3, p: vec3) -> vec6:
    """The spatial force of ``f`` acting at ``p``."""
    return join(wp.cross(p, f), f)


@wp.func
def inertia_about_origin(mass: f64, c: vec3, rot: mat33, moments: vec3) -> vec10:
    """Spatial inertia of a body with principal ``moments`` along the columns of ``rot``, centred at ``c``."""
    r0 = rot[:, 0]
    r1 = rot[:, 1]
    r2 = rot[:, 2]
    a = r0 * moments[0]
    b = r1 * moments[1]
    d = r2 * moments[2]
    h = c * mass
    return vec10(
        mass,
        h[0],
        h[1],
        h[2],
        a[0] * r0[0] + b[0] * r1[0] + d[0] * r2[0] + h[1] * c[1] + h[2] * c[2],
        a[1] * r0[1] + b[1] * r1[1] + d[1] * r2[1] + h[0] * c[0] + h[2] * c[2],
        a[2] * r0[2] + b[2] * r1[2] + d[2] * r2[2] + h[0] * c[0] + h[1] * c[1],
        a[0] * r0[1] + b[0] * r1[1] + d[0] * r2[1] - h[0] * c[1],
        a[0] * r0[2] + b[0] * r1[2] + d[0] * r2[2] - h[0] * c[2],
        a[1] * r0[2] + b[1] * r1[2] + d[1] * r2[2] - h[1] * c[2],
    )


@wp.func
def inertia_mul(i: vec10, x: vec6) -> vec6:
    """I x: the momentum of a body moving with ``x``."""
    h = vec3(i[1], i[2], i[3])
    w = ang(x)
    v = lin(x)
    return vec6(
        i[4] * w[0] + i[7] * w[1] + i[8] * w[2] + h[1] * v[2] - h[2] * v[1],
        i[7] * w[0] + i[5] * w[1] + i[9] * w[2] + h[2] * v[0] - h[0] * v[2],
        i[8] * w[0] + i[9] * w[1] + i[6] * w[2] + h[0] * v[1] - h[1] * v[0],
        i[0] * v[0] + w[1] * h[2] - w[2] * h[1],
        i[0] * v[1] + w[2] * h[0] - w[0] * h[2],
        i[0] * v[2] + w[0] * h[1] - w[1] * h[0],
    )


@wp.func
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


@wp.func
def quat_matrix(q: vec4) -> mat33:
    """Rotation of the quaternion (w, x, y, z), which need not be normalised; the zero quaternion is identity."""
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


@wp.func
def quat_mul(a: vec4, b: vec4) -> vec4:
    """Product of two quaternions."""
    return vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def quat_integrate(q: vec4, r: vec3) -> vec4:
    """q turned by the local rotation vector ``r``, normalised."""
    angle = wp.length(r)
    s = HALF
    if angle > f64(1.0e-8):
        s = wp.sin(HALF * angle) / angle
    out = quat_mul(q, vec4(wp.cos(HALF * angle), s * r[0], s * r[1], s * r[2]))
    return out / wp.length(out)


@wp.func
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


@wp.func
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


@wp.func
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


@wp.func
def _curl(a2: f64) -> f64:
    """1/a² − (1 + cos a) / (2 a sin a), the coefficient of [r]² in J_r(r)⁻¹."""
    k = ONE / f64(12.0) + a2 / f64(720.0) + a2 * a2 / f64(30240.0)
    if a2 > f64(1.0e-4):
        a = wp.sqrt(a2)
        k = ONE / a2 - (ONE + wp.cos(a)) / (TWO * a * wp.sin(a))
    return k


@wp.func
def chart_rate(r: vec3, w: vec3) -> vec3:
    """J_r(r)⁻¹ w: how fast the rotation vector r of q₀⁻¹q changes while q turns at the local rate w.

    J_r(r)⁻ᵀ = J_r(−r)⁻¹: what a change of log(q) sees of a local turn of q.
    """
    u = wp.cross(r, w)
    return w + HALF * u + _curl(wp.dot(r, r)) * wp.cross(r, u)


@wp.func
def chart_rate_dual(r: vec3, w: vec3, bar: vec3) -> f64:
    """Leaf: the adjoint of :func:`chart_rate` is its gradient."""
    return wp.dot(chart_rate(r, w), bar)


@wp.func
def nothing(x: f64) -> f64:
    """The identity. Warp emits a function that takes a gradient after those that take none, so whatever calls such a
    function takes the gradient of this one, to be emitted after it."""
    return x
