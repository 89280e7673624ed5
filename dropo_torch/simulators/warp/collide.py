"""Where two geoms touch: distance, point and normal as smooth functions of their poses.

A contact is found by ``find_contacts`` (touch.py) and named by its pair and a number ``which`` within the pair;
its geometry is then one of a few shapes. Against a plane it is decided by a point x fixed in the other geom, or by
the support point of a cylinder or an ellipsoid; between round geoms by the closest points of two segments; against a
box by a ball, at a capsule's center line wherever ``which`` says (:func:`capsule_place`); between a sphere and a
cylinder by a side, a cap or a rim. Two boxes have a module of their own.
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
PLANE_MESH = wp.constant(3)
PLANE_CYLINDER = wp.constant(4)
PLANE_ELLIPSOID = wp.constant(5)
ROUND = wp.constant(6)  # spheres and capsules among themselves
CAPSULE_BOX = wp.constant(7)  # a sphere too
SPHERE_CYLINDER = wp.constant(8)
BOX_BOX = wp.constant(9)  # see boxes.py
CONVEX = wp.constant(10)  # all that MuJoCo leaves to its general convex collision, see convex_touch.py
#: Where a sphere touches a cylinder: its side, a cap, the rim of a cap; odd the upper, then the lower.
SIDE = wp.constant(0)
CAP = wp.constant(1)
RIM = wp.constant(3)

#: Squared sine of the angle below which MuJoCo 4 takes two capsules for parallel.
PARALLEL = wp.constant(wp.float64(1.0e-8))
#: Where on its axis a capsule touches a box: one of its ends, where it passes a corner, where it passes an edge.
END = wp.constant(0)  # the end at −1; 1 is that at +1
AT_CORNER = wp.constant(2)
AT_EDGE = wp.constant(3)
#: How a second point follows from the first: across the box, along its edge, or where the axis meets a side's plane.
ACROSS = wp.constant(1)
ALONG = wp.constant(2)
PLANE = wp.constant(3)


@wp.func(inline=False)
def corner(which: int, size: vec3) -> vec3:
    """Corner ``which`` of a box: its bits are the signs."""
    x = size
    for i in range(3):
        if (which >> i) % 2 == 0:
            x[i] = -size[i]
    return x


@wp.func(inline=False)
def plane_point(n: vec3, origin: vec3, x: vec3, radius: f64) -> vec7:
    """Contact of a plane with a ball of ``radius`` about ``x``."""
    d = wp.dot(n, x - origin) - radius
    p = x - n * (radius + HALF * d)
    return vec7(d, p[0], p[1], p[2], n[0], n[1], n[2])


@wp.func(inline=False)
def cylinder_point(n: vec3, c: vec3, rot: mat33, size: vec3, which: int) -> vec3:
    """Point ``which`` of a cylinder that a plane with normal ``n`` touches: near rim, far rim, two on the near disk."""
    axis = rot[:, 2]
    prj = wp.dot(n, axis)
    sign = wp.where(prj > ZERO, -ONE, ONE)
    a = axis * sign
    v = a * (prj * sign) - n
    length = wp.length(v)
    radial = rot[:, 0] * size[0]
    if length >= MINVAL:
        radial = v * (size[0] / length)
    x = c + radial + a * size[1]
    if which == 1:
        x = c + radial - a * size[1]
    elif which >= 2:
        side = wp.normalize(wp.cross(radial, a)) * (size[0] * wp.sqrt(f64(3.0)) * HALF)
        x = c + wp.where(which == 3, -side, side) + a * size[1] - radial * HALF
    return x


@wp.func(inline=False)
def support_point(kind: int, n: vec3, c: vec3, rot: mat33, size: vec3, which: int) -> vec3:
    """The point of a cylinder or an ellipsoid that a plane with normal ``n`` touches."""
    if kind == PLANE_CYLINDER:
        return cylinder_point(n, c, rot, size, which)
    y = wp.cw_mul(wp.transpose(rot) * n, size)
    return c - rot * (wp.cw_mul(y, size) / wp.length(y))


@wp.func(inline=False)
def closest(c1: vec3, a1: vec3, c2: vec3, a2: vec3, which: int) -> vec2:
    """Places in [−1, 1] along two half-axes a1, a2 where two capsules touch; a sphere has a zero half-axis.

    Parallel capsules have two contacts: ``which`` 1 to 4 fixes one end of one of them (:func:`overlap_end`).
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
            x1 = (mc * u - mb * v) / det
            x2 = (ma * v - mb * u) / det
            if wp.abs(x1) > ONE:
                x1 = wp.sign(x1)
                x2 = (v - x1 * mb) / mc
            if wp.abs(x2) > ONE:
                x2 = wp.sign(x2)
                x1 = wp.clamp((u - x2 * mb) / ma, -ONE, ONE)
        elif which <= 2:
            x1 = f64(3 - 2 * which)
            x2 = wp.clamp((v - x1 * mb) / mc, -ONE, ONE)
        else:
            x2 = f64(7 - 2 * which)
            x1 = wp.clamp((u - x2 * mb) / ma, -ONE, ONE)
    elif mc > ZERO:
        x2 = wp.clamp(v / mc, -ONE, ONE)
    elif ma > ZERO:
        x1 = wp.clamp(u / ma, -ONE, ONE)
    return vec2(x1, x2)


@wp.func(inline=False)
def are_parallel(a1: vec3, a2: vec3) -> bool:
    """Whether two capsules are parallel to MuJoCo's tolerance, an angle; a sphere is parallel to nothing."""
    ma = wp.dot(a1, a1)
    mc = wp.dot(a2, a2)
    mb = wp.dot(a1, a2)
    return ma > ZERO and mc > ZERO and ma * mc - mb * mb < PARALLEL * (ma * mc)


@wp.func(inline=False)
def overlap_end(c1: vec3, a1: vec3, c2: vec3, a2: vec3, upper: int) -> int:
    """Which end of parallel capsules bounds their overlap, as :func:`closest` numbers it.

    Along a1, the lower (``upper`` 0) or the upper end; beyond the second capsule both are the end that is nearest.
    """
    sign = f64(2 * upper - 1)
    mb = -wp.dot(a1, a2)
    far = wp.where(mb > ZERO, -sign, sign)
    x1 = (-wp.dot(a1, c1 - c2) - far * mb) / wp.dot(a1, a1)
    which = int(wp.where(far > ZERO, 3, 4))
    if x1 > ONE:
        which = 1
    elif x1 < -ONE:
        which = 2
    return which


@wp.func(inline=False)
def balls(x1: vec3, x2: vec3, r1: f64, r2: f64, across: vec3) -> vec7:
    """Contact of two balls about x1 and x2; where these coincide, its normal is along ``across``."""
    v = x2 - x1
    length = wp.length(v)
    n = vec3(ONE, ZERO, ZERO)
    if length > MINVAL:
        n = v / length
    elif wp.length(across) > MINVAL:
        n = wp.normalize(across)
    d = length - r1 - r2
    p = x1 + n * (r1 + HALF * d)
    return vec7(d, p[0], p[1], p[2], n[0], n[1], n[2])


@wp.func(inline=False)
def round_contact(c1: vec3, a1: vec3, r1: f64, c2: vec3, a2: vec3, r2: f64, which: int) -> vec7:
    """Contact of two spheres or capsules with half-axes a1, a2 (zero for a sphere)."""
    x = closest(c1, a1, c2, a2, which)
    return balls(c1 + a1 * x[0], c2 + a2 * x[1], r1, r2, wp.cross(a1, a2))  # axes cross where a robot is planar


@wp.func(inline=False)
def pair7(x: vec7, dbar: f64, pbar: vec3, nbar: vec3) -> f64:
    """⟨x, x̄⟩ of a contact's geometry and its adjoint."""
    return x[0] * dbar + wp.dot(x[1:4], pbar) + wp.dot(x[4:7], nbar)


@wp.func(inline=False)
def round_dual(
    c1: vec3, a1: vec3, r1: f64, c2: vec3, a2: vec3, r2: f64, which: int, dbar: f64, pbar: vec3, nbar: vec3
) -> f64:
    """Leaf: the adjoint of :func:`round_contact` is its gradient."""
    return pair7(round_contact(c1, a1, r1, c2, a2, r2, which), dbar, pbar, nbar)


@wp.func(inline=False)
def support_dual(kind: int, n: vec3, c: vec3, rot: mat33, size: vec3, which: int, xbar: vec3) -> f64:
    """Leaf: the adjoint of :func:`support_point` is its gradient."""
    return wp.dot(support_point(kind, n, c, rot, size, which), xbar)


@wp.func(inline=False)
def cylinder_place(v: vec3, axis: vec3, size: vec3) -> int:
    """Where a cylinder is touched by a sphere whose center is ``v`` from its own."""
    x = wp.dot(axis, v)
    r = wp.length(v - axis * x)
    beside = wp.abs(x) < size[1]
    above = r < size[0]
    if beside and above:
        beside = size[1] - wp.abs(x) >= size[0] - r
        above = not beside
    lower = wp.where(x > ZERO, 0, 1)
    place = int(RIM + lower)
    if beside:
        place = SIDE
    elif above:
        place = CAP + lower
    return place


@wp.func(inline=False)
def sphere_cylinder(c1: vec3, radius: f64, c2: vec3, axis: vec3, size: vec3, place: int) -> vec7:
    """Contact of a sphere (first geom) and a cylinder (second) at a place of the cylinder."""
    v = c1 - c2
    x = wp.dot(axis, v)
    if place == SIDE:
        return balls(c1, c2 + axis * x, radius, size[0], vec3())
    up = axis * wp.where(place % 2 == 1, ONE, -ONE)
    if place < RIM:
        y = plane_point(up, c2 + up * size[1], c1, radius)
        return vec7(y[0], y[1], y[2], y[3], -up[0], -up[1], -up[2])
    out = v - axis * x
    return balls(c1, c2 + up * size[1] + out * (size[0] / wp.length(out)), radius, ZERO, vec3())


@wp.func(inline=False)
def sphere_cylinder_dual(
    c1: vec3, radius: f64, c2: vec3, axis: vec3, size: vec3, place: int, dbar: f64, pbar: vec3, nbar: vec3
) -> f64:
    """Leaf: the adjoint of :func:`sphere_cylinder` is its gradient."""
    return pair7(sphere_cylinder(c1, radius, c2, axis, size, place), dbar, pbar, nbar)


@wp.func(inline=False)
def box_closest(c: vec3, rot: mat33, size: vec3, x: vec3, radius: f64) -> vec7:
    """Contact of a ball about ``x`` (first geom) with a box (second): MuJoCo's sphere-box."""
    local = wp.transpose(rot) * (x - c)
    q = wp.min(size, wp.max(-size, local))
    away = q - local
    dist = wp.length(away)
    n = vec3(ONE, ZERO, ZERO)
    depth = dist
    point = q
    if dist > MINVAL:
        n = away / dist
        point = (q + local + n * radius) * HALF
    else:
        # center inside: leave through the nearest face
        gap = size - wp.abs(local)
        k = int(wp.argmin(gap))
        n = vec3()
        n[k] = wp.where(local[k] > ZERO, -ONE, ONE)
        depth = -gap[k]
        point = local + n * (HALF * (radius - gap[k]))
    d = depth - radius
    p = c + rot * point
    nw = rot * n
    return vec7(d, p[0], p[1], p[2], nw[0], nw[1], nw[2])


@wp.func(inline=False)
def _place_code(base: int, near: int, edge: int, step: int, axis: int, back: int, less: int) -> int:
    """One number for a place on a capsule's axis; ``near`` is a corner, ``back`` and ``less`` are signs."""
    return base + 4 * near + 32 * edge + 128 * step + 512 * axis + 2048 * back + 4096 * less


@wp.func(inline=False)
def capsule_place(pos: vec3, half: vec3, size: vec3, code: int) -> f64:
    """Place in [−1, 1] on a capsule's half-axis that a code names, all in the box's frame; differentiable."""
    base = code % 4
    edge = (code // 32) % 4
    step = (code // 128) % 4
    axis = (code // 512) % 4
    sign = wp.where((code // 2048) % 2 != 0, -ONE, ONE)
    t = wp.where(base == 1, ONE, -ONE)
    if base >= AT_CORNER:
        e = corner((code // 4) % 8, size) - pos
        mc = wp.dot(half, half)
        if base == AT_CORNER:
            t = wp.dot(half, e) / mc
        else:
            # closest to a line along the edge: neither half nor e counts along it
            hj = half[edge]
            ej = e[edge]
            t = (wp.dot(half, e) - hj * ej) / (mc - hj * hj)
    if step == ACROSS:
        t = t + sign * (size[axis] + size[axis]) / wp.abs(half[axis])
    elif step == ALONG:
        # the edge's own place, where the axis is at t
        x = (pos[edge] + t * half[edge]) / size[edge]
        if (code // 4096) % 2 != 0:
            x = -x
        t = t + sign * size[axis] * (ONE + x) / wp.abs(half[axis])
    elif step == PLANE:
        t = (sign * size[axis] - pos[axis]) / half[axis]
    return t


@wp.func(inline=False)
def _end(sign: f64) -> int:
    return wp.where(sign > ZERO, 1, 0)


@wp.func(inline=False)
def capsule_box_first(pos: vec3, half: vec3, size: vec3, limit: f64):
    """Where a capsule is closest to a box: face or −1, edge or −1, corner, whether it is a corner, places on both.

    The last number is the code of the place, −1 without one. As in MuJoCo ``limit`` bounds the squared distance.
    """
    best = f64(limit)
    code = int(-1)
    face = int(-1)
    edge = int(-1)
    near = int(0)
    at_corner = int(0)
    t = f64(0.0)
    x = f64(0.0)
    ends = int(2)
    for i in range(ends):
        sign = f64(float(2 * i - 1))
        p = pos + half * sign
        outside = int(0)
        side = int(-1)
        q = ZERO
        for j in range(3):
            beyond = wp.abs(p[j]) - size[j]
            if beyond > ZERO:
                outside += 1
                side = j
                q += beyond * beyond
        if outside <= 1 and q < best:
            best = q
            code = i
            face = side
            t = sign
    mc = wp.dot(half, half)
    edges = int(24)
    for k in range(edges):
        j = k // 8
        i = k % 8
        if ((i >> j) & 1) == 0:
            sj = size[j]
            e = corner(i, size) - pos
            e[j] = -pos[j]
            ma = sj * sj
            mb = -sj * half[j]
            u = -sj * e[j]
            v = wp.dot(half, e)
            det = ma * mc - mb * mb
            if wp.abs(det) >= MINVAL:
                x1 = (mc * u - mb * v) / det
                x2 = (ma * v - mb * u) / det
                s1 = int(1)
                s2 = int(1)
                if wp.abs(x1) > ONE:
                    x1 = wp.sign(x1)
                    s1 = wp.where(x1 > ZERO, 2, 0)
                    x2 = (v - x1 * mb) / mc
                if wp.abs(x2) > ONE:
                    x2 = wp.sign(x2)
                    s2 = wp.where(x2 > ZERO, 2, 0)
                    x1 = (u - x2 * mb) / ma
                    if wp.abs(x1) > ONE:
                        x1 = wp.sign(x1)
                        s1 = wp.where(x1 > ZERO, 2, 0)
                e = e - half * x2
                e[j] = e[j] + sj * x1
                q = wp.dot(e, e)
                if q < best - MINVAL:
                    best = q
                    edge = j
                    near = i + wp.where(s1 == 2, 1 << j, 0)
                    at_corner = wp.where(s1 == 1, 0, 1)
                    t = x2
                    x = x1
                    code = s2 // 2
                    if s2 == 1:
                        code = _place_code(wp.where(s1 == 1, AT_EDGE, AT_CORNER), near, j, 0, 0, 0, 0)
    return face, edge, near, at_corner, t, x, code


@wp.func(inline=False)
def _second_by_face(pos: vec3, half: vec3, size: vec3, face: int, t: f64) -> int:
    """Code of the second point where one end is closest to a face: how far the axis stays above it."""
    code = _end(-t)
    best = f64(2.0)
    start = pos + half * t
    for i in range(3):
        if i != face:
            for back in range(2):
                side = size[i] * (ONE - f64(2.0 * float(back)))
                reach = -t * (side - start[i]) / half[i]
                if reach > ZERO and reach < best:
                    best = reach
                    code = _place_code(END, 0, 0, PLANE, i, back, 0)
    return code


@wp.func(inline=False)
def _second_by_corner(half: vec3, size: vec3, near: int, t: f64, first: int) -> int:
    """Code of the second point where a corner is closest: along an edge or over a face, if the axis goes there."""
    code = int(-1)
    rel = near
    for j in range(3):
        if half[j] > ZERO:
            rel = rel ^ (1 << j)
    if rel != 0 and rel != 7:
        way = f64(1.0)
        if rel == 3 or rel == 5 or rel == 6:
            way = f64(-1.0)
            rel = 7 - rel
        ax = rel // 2
        along = half[ax] * half[ax] > HALF * wp.dot(half, half)
        if not along:
            way = -way
        code = _end(way)
        best = ONE - way * t
        for turn in range(3):
            i = (ax + turn) % 3
            reach = (size[i] + size[i]) / wp.abs(half[i])
            if (turn == 0) == along and reach < best:
                best = reach
                code = first + _place_code(END, 0, 0, ACROSS, i, 1 - _end(way), 0)
    return code


@wp.func(inline=False)
def _second_by_edge(half: vec3, size: vec3, near: int, edge: int, t: f64, x: f64, first: int) -> int:
    """Code of the second point where the inside of an edge is closest: over the face that the axis is flatter on."""
    code = int(-1)
    axisdir = int(0)
    for j in range(3):
        if half[j] > ZERO:
            axisdir += 1 << j
    rel = (near ^ axisdir) & (7 - (1 << edge))
    if rel == 1 or rel == 2 or rel == 4:
        ax1 = (edge + 1) % 3
        ax2 = (edge + 2) % 3
        if wp.abs(half[ax1]) > wp.abs(half[ax2]):
            ax2 = ax1
        ahead = (rel >> ax2) & 1
        way = f64(2.0 * float(ahead) - 1.0)
        code = _end(way)
        best = ONE - way * t
        reach = (size[ax2] + size[ax2]) / wp.abs(half[ax2])
        if reach < best:
            best = reach
            code = first + _place_code(END, 0, 0, ACROSS, ax2, 1 - ahead, 0)
        less = wp.where(((axisdir >> edge) & 1) == ahead, 1, 0)
        rest = wp.where(less != 0, ONE - x, ONE + x)
        if size[edge] * rest / wp.abs(half[edge]) < best:
            # the first code has the edge unless it is one of the ends
            code = first % 32 + _place_code(END, 0, edge, ALONG, edge, 1 - ahead, less)
    return code


@wp.func(inline=False)
def capsule_box_codes(pos: vec3, half: vec3, size: vec3, limit: f64):
    """Codes of the one or two places of a capsule that touch a box, −1 for none: MuJoCo's capsule-box."""
    face, edge, near, at_corner, t, x, first = capsule_box_first(pos, half, size, limit)
    second = int(-1)
    if first >= 0:
        if edge >= 0:
            if at_corner != 0:
                second = _second_by_corner(half, size, near, t, first)
            else:
                second = _second_by_edge(half, size, near, edge, t, x, first)
        elif face >= 0:
            second = _second_by_face(pos, half, size, face, t)
    return first, second


@wp.func(inline=False)
def capsule_box_contact(c1: vec3, a1: vec3, radius: f64, c2: vec3, rot: mat33, size: vec3, code: int) -> vec7:
    """Contact of a capsule with half-axis a1 (first geom) and a box (second) at the place that a code names."""
    back = wp.transpose(rot)
    t = capsule_place(back * (c1 - c2), back * a1, size, code)
    return box_closest(c2, rot, size, c1 + a1 * t, radius)


@wp.func(inline=False)
def capsule_box_dual(
    c1: vec3, a1: vec3, radius: f64, c2: vec3, rot: mat33, size: vec3, code: int, dbar: f64, pbar: vec3, nbar: vec3
) -> f64:
    """Leaf: the adjoint of :func:`capsule_box_contact` is its gradient."""
    return pair7(capsule_box_contact(c1, a1, radius, c2, rot, size, code), dbar, pbar, nbar)
