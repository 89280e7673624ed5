"""Drag of the inertia box (``opt.density``, ``opt.viscosity``, ``opt.wind``): one body, and its adjoint leaf."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.spatial import ang, at, pull, theta_mat33, theta_vec3
from dropo_torch.simulators.warp.types import HALF, MINVAL, THREE, ZERO, Tables, World, f64, mat33, vec3, vec6

PI = wp.constant(wp.float64(wp.pi))


@wp.func(inline=False)
def _edge(a: f64, b: f64, c: f64, mass: f64) -> f64:
    """Edge of the box with the body's inertia, along the axis of moment ``c``."""
    return wp.sqrt(wp.max(MINVAL, a + b - c) / mass * f64(6.0))


@wp.func(inline=False)
def _edges(x: vec3, mass: f64):
    """Edges of the box with moments ``x``."""
    return _edge(x[1], x[2], x[0], mass), _edge(x[0], x[2], x[1], mass), _edge(x[0], x[1], x[2], mass)


@wp.func(inline=False)
def box_force(v: vec3, x: vec3, mass: f64, density: f64, viscosity: f64) -> vec3:
    """Force in the inertial frame of a box with moments ``x`` that moves at ``v`` through the medium."""
    b0, b1, b2 = _edges(x, mass)
    k = THREE * PI * (b0 + b1 + b2) / THREE * viscosity
    q = HALF * density
    return vec3(
        -k * v[0] - q * b1 * b2 * wp.abs(v[0]) * v[0],
        -k * v[1] - q * b0 * b2 * wp.abs(v[1]) * v[1],
        -k * v[2] - q * b0 * b1 * wp.abs(v[2]) * v[2],
    )


@wp.func(inline=False)
def box_torque(w: vec3, x: vec3, mass: f64, density: f64, viscosity: f64) -> vec3:
    """Torque in the inertial frame of a box with moments ``x`` that turns at ``w``."""
    b0, b1, b2 = _edges(x, mass)
    d = (b0 + b1 + b2) / THREE
    k = PI * d * d * d * viscosity
    p0 = b0 * b0 * b0 * b0
    p1 = b1 * b1 * b1 * b1
    p2 = b2 * b2 * b2 * b2
    q = density / f64(64.0)
    return vec3(
        -k * w[0] - q * b0 * (p1 + p2) * wp.abs(w[0]) * w[0],
        -k * w[1] - q * b1 * (p0 + p2) * wp.abs(w[1]) * w[1],
        -k * w[2] - q * b2 * (p0 + p1) * wp.abs(w[2]) * w[2],
    )


@wp.func(inline=False)
def box_power(w: vec3, v: vec3, lw: vec3, lv: vec3, x: vec3, mass: f64, density: f64, viscosity: f64) -> f64:
    """−(force · lv + torque · lw): what drag adds to λᵀR, all in the inertial frame."""
    return (
        ZERO
        - wp.dot(box_force(v, x, mass, density, viscosity), lv)
        - wp.dot(box_torque(w, x, mass, density, viscosity), lw)
    )


@wp.func(inline=True)
def inertial_frame(m: wp.ref[Tables], w: wp.ref[World], b: int) -> mat33:
    """Rotation of the inertial frame of a body."""
    return w.xmat[w.t, b] * theta_mat33(w.th, m.o_imat + 9 * b)


@wp.func(inline=True)
def center_of_mass(m: wp.ref[Tables], w: wp.ref[World], b: int) -> vec3:
    """Center of mass of a body, from the origin of the sweep."""
    return w.xpos[w.t, b] + w.xmat[w.t, b] * theta_vec3(w.th, m.o_ipos + 3 * b)


@wp.func(inline=True)
def fluid_wrench(m: wp.ref[Tables], w: wp.ref[World], b: int) -> vec6:
    """The drag on a body as a spatial force."""
    rot = inertial_frame(m, w, b)
    c = center_of_mass(m, w, b)
    wind = theta_vec3(w.th, m.o_wind)
    vel = w.velocity[w.t, b]
    back = wp.transpose(rot)
    x = theta_vec3(w.th, m.o_inertia + 3 * b)
    mass = w.th[m.o_mass + b]
    f = rot * box_force(back * (at(vel, c) - wind), x, mass, w.th[m.o_density], w.th[m.o_viscosity])
    n = rot * box_torque(back * ang(vel), x, mass, w.th[m.o_density], w.th[m.o_viscosity])
    return pull(f, c, n)


@wp.func(inline=False)
def box_slopes(w: vec3, v: vec3, x: vec3, mass: f64, density: f64, viscosity: f64):
    """Minus the slopes of :func:`box_torque` and :func:`box_force`, each component in its own velocity."""
    b0, b1, b2 = _edges(x, mass)
    d = (b0 + b1 + b2) / THREE
    kw = PI * d * d * d * viscosity
    kv = THREE * PI * d * viscosity
    p0 = b0 * b0 * b0 * b0
    p1 = b1 * b1 * b1 * b1
    p2 = b2 * b2 * b2 * b2
    q = density / f64(32.0)
    turn = vec3(
        kw + q * b0 * (p1 + p2) * wp.abs(w[0]),
        kw + q * b1 * (p0 + p2) * wp.abs(w[1]),
        kw + q * b2 * (p0 + p1) * wp.abs(w[2]),
    )
    move = vec3(
        kv + density * b1 * b2 * wp.abs(v[0]),
        kv + density * b0 * b2 * wp.abs(v[1]),
        kv + density * b0 * b1 * wp.abs(v[2]),
    )
    return turn, move


@wp.func(inline=False)
def box_slope_power(
    w: vec3, v: vec3, lw: vec3, lv: vec3, uw: vec3, uv: vec3, x: vec3, mass: f64, density: f64, viscosity: f64
) -> f64:
    """−λᵀ (slope of drag along u), all in the inertial frame."""
    turn, move = box_slopes(w, v, x, mass, density, viscosity)
    return wp.dot(wp.cw_mul(turn, uw), lw) + wp.dot(wp.cw_mul(move, uv), lv)
