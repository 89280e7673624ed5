"""Where two geoms touch: distance, point and normal as smooth functions of their poses.

A contact is found by ``find_contacts`` (contact.py) and named by its pair and a number ``which`` within the pair;
its geometry is then one of two shapes. Against a plane it is decided by a point x fixed in the other geom, or by
the support point of a cylinder or an ellipsoid; between round geoms by the closest points of two segments.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

from typing import Any

import warp as wp

from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, ZERO, f64, mat33, vec2, vec3

#: distance, point, normal
vec7: Any = wp.types.vector(7, wp.float64)

PLANE_SPHERE = wp.constant(0)
PLANE_CAPSULE = wp.constant(1)
PLANE_BOX = wp.constant(2)
PLANE_CYLINDER = wp.constant(3)
PLANE_ELLIPSOID = wp.constant(4)
ROUND = wp.constant(5)  # spheres and capsules among themselves
SPHERE_BOX = wp.constant(6)
SPHERE_CYLINDER = wp.constant(7)


@wp.func
def column(r: mat33, i: int) -> vec3:
    """Column ``i`` of a rotation."""
    return vec3(r[0, i], r[1, i], r[2, i])


@wp.func
def corner(which: int, size: vec3) -> vec3:
    """Corner ``which`` of a box: its bits are the signs."""
    x = size[0]
    y = size[1]
    z = size[2]
    if which % 2 == 0:
        x = -x
    if (which // 2) % 2 == 0:
        y = -y
    if (which // 4) % 2 == 0:
        z = -z
    return vec3(x, y, z)


@wp.func
def plane_point(n: vec3, origin: vec3, x: vec3, radius: f64) -> vec7:
    """Contact of a plane with a ball of ``radius`` about ``x``."""
    d = wp.dot(n, x - origin) - radius
    p = x - n * (radius + HALF * d)
    return vec7(d, p[0], p[1], p[2], n[0], n[1], n[2])


@wp.func
def cylinder_point(n: vec3, c: vec3, rot: mat33, size: vec3, which: int) -> vec3:
    """Point ``which`` of a cylinder that a plane with normal ``n`` touches: near rim, far rim, two on the near disk."""
    axis = column(rot, 2)
    prj = wp.dot(n, axis)
    sign = ONE
    if prj > ZERO:
        sign = -ONE
    a = axis * sign
    v = a * (prj * sign) - n
    length = wp.length(v)
    radial = column(rot, 0) * size[0]
    if length >= MINVAL:
        radial = v * (size[0] / length)
    x = c + radial + a * size[1]
    if which == 1:
        x = c + radial - a * size[1]
    elif which >= 2:
        side = wp.normalize(wp.cross(radial, a)) * (size[0] * wp.sqrt(f64(3.0)) * HALF)
        if which == 3:
            side = -side
        x = c + side + a * size[1] - radial * HALF
    return x


@wp.func
def ellipsoid_point(n: vec3, c: vec3, rot: mat33, size: vec3) -> vec3:
    """The point of an ellipsoid farthest along −n."""
    y = wp.cw_mul(wp.transpose(rot) * n, size)
    return c - rot * (wp.cw_mul(y, size) / wp.length(y))


@wp.func
def _clip(x: f64) -> f64:
    return wp.min(ONE, wp.max(-ONE, x))


@wp.func
def closest(c1: vec3, a1: vec3, c2: vec3, a2: vec3, which: int) -> vec2:
    """Places in [−1, 1] along two half-axes a1, a2 where two capsules touch; a sphere has a zero half-axis.

    Parallel capsules have up to two contacts: ``which`` 1 to 4 fixes one end of one of them.
    """
    ma = wp.dot(a1, a1)
    mc = wp.dot(a2, a2)
    mb = -wp.dot(a1, a2)
    dif = c1 - c2
    u = -wp.dot(a1, dif)
    v = wp.dot(a2, dif)
    x1 = ZERO
    x2 = ZERO
    if ma > ZERO and mc > ZERO:
        if which == 0:
            det = ma * mc - mb * mb
            p = (mc * u - mb * v) / det
            x1 = p
            x2 = (ma * v - mb * u) / det
            if p > ONE:
                x1 = ONE
                x2 = (v - mb) / mc
            elif p < -ONE:
                x1 = -ONE
                x2 = (v + mb) / mc
            if x2 > ONE:
                x2 = ONE
                x1 = _clip((u - mb) / ma)
            elif x2 < -ONE:
                x2 = -ONE
                x1 = _clip((u + mb) / ma)
        elif which == 1:
            x1 = ONE
            x2 = _clip((v - mb) / mc)
        elif which == 2:
            x1 = -ONE
            x2 = _clip((v + mb) / mc)
        elif which == 3:
            x2 = ONE
            x1 = _clip((u - mb) / ma)
        else:
            x2 = -ONE
            x1 = _clip((u + mb) / ma)
    elif mc > ZERO:
        x2 = _clip(v / mc)
    elif ma > ZERO:
        x1 = _clip(u / ma)
    return vec2(x1, x2)


@wp.func
def balls(x1: vec3, x2: vec3, r1: f64, r2: f64) -> vec7:
    """Contact of two balls about x1 and x2."""
    v = x2 - x1
    length = wp.length(v)
    n = vec3(ONE, ZERO, ZERO)
    if length > MINVAL:
        n = v / length
    d = length - r1 - r2
    p = x1 + n * (r1 + HALF * d)
    return vec7(d, p[0], p[1], p[2], n[0], n[1], n[2])


@wp.func
def round_contact(c1: vec3, a1: vec3, r1: f64, c2: vec3, a2: vec3, r2: f64, which: int) -> vec7:
    """Contact of two spheres or capsules with half-axes a1, a2 (zero for a sphere)."""
    x = closest(c1, a1, c2, a2, which)
    return balls(c1 + a1 * x[0], c2 + a2 * x[1], r1, r2)


@wp.func
def pair7(x: vec7, dbar: f64, pbar: vec3, nbar: vec3) -> f64:
    """⟨x, x̄⟩ of a contact's geometry and its adjoint."""
    return (
        x[0] * dbar
        + (x[1] * pbar[0] + x[2] * pbar[1] + x[3] * pbar[2])
        + (x[4] * nbar[0] + x[5] * nbar[1] + x[6] * nbar[2])
    )


@wp.func
def round_dual(
    c1: vec3, a1: vec3, r1: f64, c2: vec3, a2: vec3, r2: f64, which: int, dbar: f64, pbar: vec3, nbar: vec3
) -> f64:
    """Leaf: the adjoint of :func:`round_contact` is its gradient."""
    return pair7(round_contact(c1, a1, r1, c2, a2, r2, which), dbar, pbar, nbar)


@wp.func
def cylinder_dual(n: vec3, c: vec3, rot: mat33, size: vec3, which: int, xbar: vec3) -> f64:
    """Leaf: the adjoint of :func:`cylinder_point` is its gradient."""
    return wp.dot(cylinder_point(n, c, rot, size, which), xbar)


@wp.func
def ellipsoid_dual(n: vec3, c: vec3, rot: mat33, size: vec3, xbar: vec3) -> f64:
    """Leaf: the adjoint of :func:`ellipsoid_point` is its gradient."""
    return wp.dot(ellipsoid_point(n, c, rot, size), xbar)


@wp.func
def box_closest(c: vec3, rot: mat33, size: vec3, x: vec3, radius: f64) -> vec7:
    """Contact of a ball about ``x`` (first geom) with a box (second): MuJoCo's sphere-box."""
    local = wp.transpose(rot) * (x - c)
    q = vec3(
        wp.min(size[0], wp.max(-size[0], local[0])),
        wp.min(size[1], wp.max(-size[1], local[1])),
        wp.min(size[2], wp.max(-size[2], local[2])),
    )
    away = q - local
    dist = wp.length(away)
    n = vec3(ONE, ZERO, ZERO)
    depth = dist
    point = q
    if dist > MINVAL:
        n = away / dist
        point = (q + local + n * radius) * HALF
    else:
        # centre inside: leave through the nearest face
        k = int(0)
        best = size[0] - wp.abs(local[0])
        g1 = size[1] - wp.abs(local[1])
        g2 = size[2] - wp.abs(local[2])
        if g1 < best:
            best = g1
            k = 1
        if g2 < best:
            best = g2
            k = 2
        n0 = ZERO
        n1 = ZERO
        n2 = ZERO
        if k == 0:
            n0 = wp.where(local[0] > ZERO, -ONE, ONE)
        elif k == 1:
            n1 = wp.where(local[1] > ZERO, -ONE, ONE)
        else:
            n2 = wp.where(local[2] > ZERO, -ONE, ONE)
        n = vec3(n0, n1, n2)
        depth = -best
        point = local + n * (HALF * (radius - best))
    d = depth - radius
    p = c + rot * point
    nw = rot * n
    return vec7(d, p[0], p[1], p[2], nw[0], nw[1], nw[2])


@wp.func
def box_dual(c: vec3, rot: mat33, size: vec3, x: vec3, radius: f64, dbar: f64, pbar: vec3, nbar: vec3) -> f64:
    """Leaf: the adjoint of :func:`box_closest` is its gradient."""
    return pair7(box_closest(c, rot, size, x, radius), dbar, pbar, nbar)
