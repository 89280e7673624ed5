"""Spatial algebra on ``vec6`` (angular first), and numbers of a row as vectors, as pure Warp functions."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

from typing import Any

import warp as wp

from dropo_torch.simulators.warp.types import Reals, Reals2, f64, mat33, vec2, vec3, vec4, vec5, vec6, vec10

#: Of a spatial vector the angular and the linear part; a × b of two motions; a ×* f of a motion and a force, its dual:
#: ⟨f, a × b⟩ = −⟨a ×* f, b⟩.
ang, lin, cross_motion, cross_force = wp.spatial_top, wp.spatial_bottom, wp.spatial_cross, wp.spatial_cross_dual


@wp.func(inline=False)
def theta_vec2(th: Reals, i: int) -> vec2:
    """Two consecutive numbers of θ."""
    return vec2(th[i], th[i + 1])


@wp.func(inline=False)
def theta_vec3(th: Reals, i: int) -> vec3:
    """Three consecutive numbers of θ."""
    return vec3(th[i], th[i + 1], th[i + 2])


@wp.func(inline=False)
def theta_mat33(th: Reals, i: int) -> mat33:
    """Nine consecutive numbers of θ, row by row."""
    return mat33(th[i], th[i + 1], th[i + 2], th[i + 3], th[i + 4], th[i + 5], th[i + 6], th[i + 7], th[i + 8])


@wp.func(inline=False)
def theta_vec4(th: Reals, i: int) -> vec4:
    """Four consecutive numbers of θ."""
    return vec4(th[i], th[i + 1], th[i + 2], th[i + 3])


@wp.func(inline=False)
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


@wp.func(inline=False)
def join(w: vec3, v: vec3) -> vec6:
    """The spatial vector of an angular and a linear part."""
    return vec6(w[0], w[1], w[2], v[0], v[1], v[2])


@wp.func(inline=False)
def at(x: vec6, p: vec3) -> vec3:
    """Linear part of the motion ``x`` at the point ``p``: v + ω × p."""
    return lin(x) + wp.cross(ang(x), p)


@wp.func(inline=False)
def wrench(f: vec3, p: vec3) -> vec6:
    """The spatial force of ``f`` acting at ``p``."""
    return join(wp.cross(p, f), f)


@wp.func(inline=False)
def pull(f: vec3, p: vec3, torque: vec3) -> vec6:
    """The spatial force of ``f`` at ``p`` and a torque."""
    return wrench(f, p) + join(torque, vec3())


@wp.func(inline=False)
def inertia_about_origin(mass: f64, c: vec3, rot: mat33, moments: vec3) -> vec10:
    """Spatial inertia of a body with principal ``moments`` along the columns of ``rot``, centered at ``c``."""
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


@wp.func(inline=False)
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


@wp.func(inline=False)
def late(x: f64) -> f64:
    """The identity. Warp emits a function that takes a gradient after those that take none, so whatever calls such a
    function takes the gradient of this one, to be emitted after it."""
    return x
