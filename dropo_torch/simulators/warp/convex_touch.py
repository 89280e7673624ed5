"""Contacts of two convex geoms for which there is no formula, and what their adjoints mean for the two bodies.

A contact hangs on the features that touch, held fixed. At a pair of nearest or deepest points with normal n at
distance d, x2 − x1 = d n, and each point is the one of its body that is furthest along ±n. A change δn, seen from the
body, moves it by R δn with R the radii of curvature there: none at a vertex, infinite along an edge. With three
equations for each body this is a linear system for the two displacements, and the adjoint solves its transpose.
A corner of a clipped polygon is where three planes meet, each fixed in one of the bodies.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.clip import (
    ALONG_NORMAL,
    CLIPPED,
    FACE_ON_2,
    NORMAL_ON_2,
    ROLLS_1,
    ROLLS_2,
    feature_of,
    multicontact,
)
from dropo_torch.simulators.warp.convex import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    FAR,
    MESH,
    SPHERE,
    Shape,
    Simplex,
    gjk,
)
from dropo_torch.simulators.warp.epa import epa
from dropo_torch.simulators.warp.frames import geom_position, geom_size, geom_turn
from dropo_torch.simulators.warp.spatial import pull
from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, ZERO, Tables, World, f64, mat33, vec2, vec3, vec6

#: A radius of curvature that is infinite.
FLAT = wp.constant(wp.float64(-1.0))


@wp.func(inline=False)
def shape_of(m: wp.ref[Tables], w: wp.ref[World], g: int, inflation: f64) -> Shape:
    """A geom as a convex shape."""
    b = m.geom_body[g]
    s = Shape()
    s.kind = m.geom_kind[g]
    s.hull = m.geom_hull[g]
    s.count = m.geom_nhull[g]
    s.climbs = m.geom_climbs[g]
    s.place = -1
    s.inflation = inflation
    s.size = geom_size(m, w, g)
    s.pos = w.xpos[w.t, b] + w.xmat[w.t, b] * geom_position(m, w, g)
    s.rot = w.xmat[w.t, b] * geom_turn(m, w, g)
    return s


@wp.func(inline=False)
def _is_round(s: Shape) -> bool:
    return s.kind == SPHERE or s.kind == CAPSULE


@wp.func(inline=False)
def _core(s0: Shape) -> Shape:
    """A shape without what it is inflated by, a sphere or a capsule without its radius."""
    s = s0
    s.inflation = ZERO
    if _is_round(s):
        s.size = vec3(ZERO, s.size[1], s.size[2])
    return s


@wp.func(inline=False)
def _inflated(s: Shape) -> f64:
    """How far a shape reaches beyond its core."""
    return s.inflation + wp.where(_is_round(s), s.size[0], ZERO)


@wp.func(inline=False)
def _perpendicular(n: vec3) -> vec3:
    t = wp.where(wp.abs(n[0]) < HALF, vec3(ONE, ZERO, ZERO), vec3(ZERO, ONE, ZERO))
    return wp.normalize(t - n * wp.dot(n, t))


@wp.func(inline=False)
def _curve(t0: vec3, n: vec3, along: f64, across: f64) -> vec6:
    """A direction tangent to a surface with normal ``n``, and the radii along and across it."""
    t = t0 - n * wp.dot(n, t0)
    length = wp.length(t)
    t = t / length if length > MINVAL else _perpendicular(n)
    return vec6(t[0], t[1], t[2], along, across, ZERO)


@wp.func(inline=False)
def _ellipsoid_curve(s: Shape, n: vec3) -> vec6:
    """Principal directions and radii of an ellipsoid where its normal is ``n``."""
    local = wp.transpose(s.rot) * n
    squares = wp.cw_mul(s.size, s.size)
    q = wp.length(wp.cw_mul(s.size, local))
    x = wp.cw_mul(squares, local) / q
    e1 = _perpendicular(local)
    e2 = wp.cross(local, e1)
    a = (wp.dot(e1, wp.cw_mul(squares, e1)) - wp.dot(x, e1) * wp.dot(x, e1)) / q
    b = (wp.dot(e1, wp.cw_mul(squares, e2)) - wp.dot(x, e1) * wp.dot(x, e2)) / q
    c = (wp.dot(e2, wp.cw_mul(squares, e2)) - wp.dot(x, e2) * wp.dot(x, e2)) / q
    angle = HALF * wp.atan2(b + b, a - c)
    co = wp.cos(angle)
    si = wp.sin(angle)
    one = a * co * co + (b + b) * co * si + c * si * si
    return _curve(s.rot * (e1 * co + e2 * si), n, one, a + c - one)


@wp.func(inline=False)
def curve_at(m: wp.ref[Tables], s: Shape, vertices: wp.vec4i, n: int, x: vec3, normal: vec3) -> vec6:
    """How a shape is curved at a point ``x`` that touches, with outward normal: direction, radii along and across it.

    The ``n`` vertices are those that the point lies between; an infinite radius is FLAT.
    """
    axis = s.rot[:, 2]
    out = _curve(axis, normal, ZERO, ZERO)
    f = feature_of(vertices, mat33(), n)
    if s.kind == SPHERE:
        out = _curve(axis, normal, s.size[0], s.size[0])
    elif s.kind == ELLIPSOID:
        out = _ellipsoid_curve(s, normal)
    elif s.kind == CAPSULE:
        place = wp.dot(axis, x - normal * (s.size[0] + s.inflation) - s.pos)
        inside = wp.abs(place) < s.size[1] * (ONE - f64(1.0e-9))
        out = _curve(axis, normal, wp.where(inside, FLAT, s.size[0]), s.size[0])
    elif s.kind == CYLINDER:
        up = wp.dot(axis, normal)
        radial = wp.sqrt(wp.max(ONE - up * up, ZERO))
        if f.dim == 2:  # both disks: the side
            out = _curve(axis, normal, FLAT, s.size[0])
        elif radial < f64(1.0e-7):
            out = _curve(axis, normal, FLAT, FLAT)
        else:
            out = _curve(wp.cross(axis, normal), normal, s.size[0] / radial, ZERO)
    elif f.dim == 3:
        out = _curve(axis, normal, FLAT, FLAT)
    elif f.dim == 2:
        one = vec3()
        two = vec3()
        if s.kind == BOX:
            for k in range(3):
                one[k] = wp.where(((f.v1 >> k) & 1) != 0, s.size[k], -s.size[k])
                two[k] = wp.where(((f.v2 >> k) & 1) != 0, s.size[k], -s.size[k])
        elif s.kind == MESH:
            one = m.hull_vert[s.hull + f.v1]
            two = m.hull_vert[s.hull + f.v2]
        out = _curve(s.rot * (two - one), normal, FLAT, ZERO)
    return out


@wp.func(inline=False)
def _keep_single(
    m: wp.ref[Tables], w: wp.ref[World], a: Shape, b: Shape, s: Simplex, x1: vec3, x2: vec3, normal: vec3, dist: f64
):
    """Write the one contact of two witnesses, and how the shapes are curved there."""
    w.clip_dist[w.t, 0] = dist
    w.clip_mid[w.t, 0] = (x1 + x2) * HALF
    w.clip_normal[w.t, 0] = normal
    w.clip_how[w.t, 0] = 0
    w.clip_single[w.t, 0] = normal
    w.clip_single[w.t, 1] = (x1 + x2) * HALF
    w.clip_single[w.t, 2] = vec3(dist + a.inflation + b.inflation, ZERO, ZERO)
    w.clip_curve[w.t, 0] = curve_at(m, a, s.vertex1, s.n, x1, normal)
    w.clip_curve[w.t, 1] = curve_at(m, b, s.vertex2, s.n, x2, -normal)


@wp.func(inline=False)
def convex_contacts(m: wp.ref[Tables], w: wp.ref[World], k: int, reach: f64) -> int:
    """Find the contacts of a pair nearer than ``reach``; how many: in ``clip_...``, distances less it."""
    a = shape_of(m, w, m.pair_geom1[k], HALF * reach)
    b = shape_of(m, w, m.pair_geom2[k], HALF * reach)
    tolerance = m.ccd_tolerance
    x1 = vec3()
    x2 = vec3()
    normal = vec3()
    dist = f64(0.0)
    s = Simplex()
    found = int(0)
    deep = bool(True)
    if _is_round(a) or _is_round(b) or reach > ZERO:
        one = _inflated(a)
        two = _inflated(b)
        r = gjk(m, _core(a), _core(b), tolerance, m.ccd_iterations, one + two)
        a.place = r.place1
        b.place = r.place2
        if r.dist > tolerance:
            deep = bool(False)
            if r.dist < FAR and r.dist < one + two:
                normal = wp.normalize(r.x2 - r.x1)
                x1 = r.x1 + normal * one
                x2 = r.x2 - normal * two
                dist = r.dist - (one + two)
                s = r.simplex
                found = 1
    if deep:
        r = gjk(m, a, b, tolerance, m.ccd_iterations, ZERO)
        if r.dist <= tolerance and r.simplex.n > 1 and r.apart == 0:
            d = epa(m, w, a, b, r.simplex, r.place1, r.place2, tolerance, m.ccd_iterations)
            if d.found != 0 and d.dist < ZERO:
                x1 = d.x1
                x2 = d.x2
                normal = wp.normalize(x1 - x2)
                dist = d.dist
                s = d.simplex
                found = 1
    if found != 0:
        _keep_single(m, w, a, b, s, x1, x2, normal, dist)
        if m.pair_most[k] > 1:
            found = wp.max(multicontact(m, w, a, b, s, x1, x2), 1)
    return found


@wp.func(inline=False)
def keep_contact(w: wp.ref[World], n: int, i: int):
    """Keep what the adjoint of contact ``n``, the ``i``-th found of its pair, needs."""
    w.con_how[w.t, n] = w.clip_how[w.t, i]
    w.con_planes[w.t, n] = w.clip_planes[w.t, i]
    w.con_corner[w.t, n] = w.clip_corner[w.t, i]
    w.con_facing[w.t, n] = w.clip_normal[w.t, 1]
    w.con_height[w.t, n] = w.clip_height[w.t, i]
    for j in range(3):
        w.con_single[w.t, 3 * n + j] = w.clip_single[w.t, j]
    for j in range(2):
        w.con_curve[w.t, 2 * n + j] = w.clip_curve[w.t, j]


@wp.func(inline=False)
def _radii(c: vec6) -> vec2:
    return vec2(c[3], c[4])


@wp.func(inline=False)
def _tangent(c: vec6) -> vec3:
    return vec3(c[0], c[1], c[2])


@wp.func(inline=False)
def _slack(r: f64) -> f64:
    """Change of the normal with a unit step: one, or none where it is flat."""
    return wp.where(r < ZERO, ZERO, ONE)


@wp.func(inline=False)
def _stride(r: f64) -> f64:
    """Displacement with a unit step: the radius, or one where it is flat."""
    return wp.where(r < ZERO, ONE, r)


@wp.func(inline=False)
def _flats(c: vec6) -> int:
    """In how many directions a surface is flat."""
    r = _radii(c)
    return wp.where(r[0] < ZERO, 1, 0) + wp.where(r[1] < ZERO, 1, 0)


@wp.func(inline=False)
def _held(c: vec6) -> vec6:
    """A surface whose point is held where it is in the directions in which it is flat."""
    return vec6(c[0], c[1], c[2], wp.max(c[3], ZERO), wp.max(c[4], ZERO), ZERO)


@wp.func(inline=False)
def _settled(c1: vec6, c2: vec6):
    """The two curves, the less flat one held where both leave a direction free: any point of it may be the one."""
    free1 = _flats(c1)
    free2 = _flats(c2)
    parallel = free1 == 1 and free2 == 1 and wp.length(wp.cross(_tangent(c1), _tangent(c2))) < f64(1.0e-9)
    one = c1
    two = c2
    if free1 + free2 > 2 or parallel:
        if free1 < free2:
            one = _held(c1)
        else:
            two = _held(c2)
    return one, two


@wp.func(inline=False)
def single_adjoint(n: vec3, d: f64, mid: vec3, c1a: vec6, c2a: vec6, dbar: f64, pbar: vec3, nbar0: vec3):
    """From adjoints of distance, midpoint and normal of two witnesses to spatial forces on the two bodies."""
    nbar = nbar0 + pbar * (HALF * d)
    nbar = nbar - n * wp.dot(n, nbar)
    slope = dbar + HALF * wp.dot(n, pbar)
    c1, c2 = _settled(c1a, c2a)
    t1 = _tangent(c1)
    u1 = wp.cross(n, t1)
    t2 = _tangent(c2)
    u2 = wp.cross(n, t2)
    r1 = _radii(c1)
    r2 = _radii(c2)
    # columns: steps of the first witness along t1 and u1, of the second along t2 and u2; rows along t1 and u1:
    # both normals change alike, and the witnesses stay on one normal
    a1 = _slack(r1[0])
    b1 = -_stride(r1[0]) - d * a1
    a2 = _slack(r1[1])
    b2 = -_stride(r1[1]) - d * a2
    a3 = _slack(r2[0])
    b3 = _stride(r2[0])
    a4 = _slack(r2[1])
    b4 = _stride(r2[1])
    tt = wp.dot(t1, t2)
    tu = wp.dot(t1, u2)
    ut = wp.dot(u1, t2)
    uu = wp.dot(u1, u2)
    system = wp.matrix_from_rows(
        wp.vec4d(a1, ZERO, a3 * tt, a4 * tu),
        wp.vec4d(ZERO, a2, a3 * ut, a4 * uu),
        wp.vec4d(b1, ZERO, b3 * tt, b4 * tu),
        wp.vec4d(ZERO, b2, b3 * ut, b4 * uu),
    )
    ybar = wp.vec4d(
        a1 * wp.dot(t1, nbar) + _stride(r1[0]) * wp.dot(t1, pbar),
        a2 * wp.dot(u1, nbar) + _stride(r1[1]) * wp.dot(u1, pbar),
        ZERO,
        ZERO,
    )
    dual = wp.vec4d()
    if wp.abs(wp.determinant(system)) > ZERO:
        dual = wp.transpose(wp.inverse(system)) * ybar
    a = t1 * dual[0] + u1 * dual[1]
    b = t1 * dual[2] + u1 * dual[3]
    x1 = mid - n * (HALF * d)
    x2 = mid + n * (HALF * d)
    y1 = pull(pbar - n * slope + b, x1, wp.cross(n, nbar - a + b * d))
    y2 = pull(n * slope - b, x2, wp.cross(n, a))
    return y1, y2


@wp.func(inline=False)
def _rolled(s: Shape, axis: vec3, n: vec3, f: vec3) -> vec3:
    """Adjoint of an outward normal in the place of a capsule's or a cylinder's line, from the force on the line."""
    across = f - axis * wp.dot(axis, f)
    out = across * (s.size[0] + s.inflation)
    if s.kind == CYLINDER:
        v = n - axis * wp.dot(axis, n)
        length = wp.length(v)
        if length > MINVAL:
            v = v / length
            out = (across - v * wp.dot(v, across)) * (s.size[0] / length)
        else:
            out = vec3()
    return out


@wp.func(inline=False)
def clipped_adjoint(m: wp.ref[Tables], w: wp.ref[World], c: int, dbar: f64, pbar: vec3, nbar0: vec3):
    """From adjoints of distance, point and normal of a clipped corner to spatial forces on the two bodies."""
    k = w.con_pair[w.t, c]
    how = w.con_how[w.t, c]
    normal = w.con_frame[w.t, c][0]
    nc = w.con_facing[w.t, c]
    x = w.con_corner[w.t, c]
    height = w.con_height[w.t, c]  # of the corner above the clipping face; the distance is along ``way``
    along = wp.where((how & ALONG_NORMAL) != 0, ONE, -ONE)
    way = normal * along
    facing = wp.dot(nc, way)
    slope = dbar - HALF * wp.dot(way, pbar)
    hbar = -slope * facing - wp.dot(nc, pbar)
    ncbar = way * (-height * slope) - pbar * height
    waybar = nc * (-height * slope) + pbar * (HALF * height * facing)
    reach = w.th[m.o_pair_margin + k] + m.pair_gap[k]
    a = shape_of(m, w, m.pair_geom1[k], HALF * reach)
    b = shape_of(m, w, m.pair_geom2[k], HALF * reach)
    shift = wp.where(a.kind == CAPSULE, -HALF * b.inflation, wp.where(b.kind == CAPSULE, HALF * a.inflation, ZERO))
    nbar = nbar0 + waybar * along + pbar * shift
    xbar = pbar + nc * hbar
    planes = w.con_planes[w.t, c]
    steps = wp.inverse(wp.transpose(planes)) * xbar
    f1 = vec3()
    f2 = vec3()
    for i in range(3):
        if ((how >> i) & 1) != 0:
            f2 += planes[i] * steps[i]
        else:
            f1 += planes[i] * steps[i]
    y1 = pull(f1, x, vec3())
    y2 = pull(f2, x, vec3())
    face = pull(nc * -hbar, x - nc * height, wp.cross(nc, ncbar))
    turn = pull(vec3(), x, wp.cross(normal, nbar))
    if (how & FACE_ON_2) != 0:
        y2 += face
    else:
        y1 += face
    if (how & NORMAL_ON_2) != 0:
        y2 += turn
    else:
        y1 += turn
    if (how & (ROLLS_1 + ROLLS_2)) != 0:
        # the line on the capsule or cylinder turns with the normal of the nearest points
        first = (how & ROLLS_1) != 0
        sign = wp.where(first, ONE, -ONE)
        n = w.con_single[w.t, 3 * c]
        out = _rolled(a, a.rot[:, 2], n, f1) if first else _rolled(b, b.rot[:, 2], -n, f2)
        z1, z2 = single_adjoint(
            n, w.con_single[w.t, 3 * c + 2][0], w.con_single[w.t, 3 * c + 1], w.con_curve[w.t, 2 * c],
            w.con_curve[w.t, 2 * c + 1], ZERO, vec3(), out * sign,
        )  # fmt: skip
        y1 += z1
        y2 += z2
        held = pull(vec3(), x, wp.cross(n, out) * -sign)
        if first:
            y1 += held
        else:
            y2 += held
    return y1, y2


@wp.func(inline=False)
def convex_adjoint(m: wp.ref[Tables], w: wp.ref[World], c: int, dbar: f64, pbar: vec3, nbar: vec3):
    """From adjoints of distance, point and normal of a contact to spatial forces on the two bodies."""
    y1 = vec6()
    y2 = vec6()
    if (w.con_how[w.t, c] & CLIPPED) != 0:
        y1, y2 = clipped_adjoint(m, w, c, dbar, pbar, nbar)
    else:
        y1, y2 = single_adjoint(
            w.con_single[w.t, 3 * c], w.con_single[w.t, 3 * c + 2][0], w.con_single[w.t, 3 * c + 1],
            w.con_curve[w.t, 2 * c], w.con_curve[w.t, 2 * c + 1], dbar, pbar, nbar,
        )  # fmt: skip
    return y1, y2
