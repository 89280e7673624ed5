"""Which geoms touch and where, and what adjoints of distance, point and frame mean for the two geoms.

A kind of pair takes a constant in ``collide``, a line in ``tables``, a branch in :func:`find_contacts` and one in
:func:`geometry_adjoint`.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp import boxes, collide, hull
from dropo_torch.simulators.warp.convex_touch import convex_adjoint, convex_contacts, keep_contact
from dropo_torch.simulators.warp.frames import (
    geom_frame_adjoint,
    geom_position,
    geom_size,
    geom_size_adjoint,
    geom_turn,
)
from dropo_torch.simulators.warp.parts import has_geoms, with_convex
from dropo_torch.simulators.warp.spatial import pull, wrench
from dropo_torch.simulators.warp.types import (
    HALF,
    MINVAL,
    ONE,
    TWO,
    ZERO,
    Ints,
    Ints2,
    Reals,
    Tables,
    Vec3s2,
    World,
    f64,
    mat33,
    vec3,
    vec6,
)


@wp.func(inline=True)
def geom_center(m: wp.ref[Tables], w: wp.ref[World], g: int) -> vec3:
    """Center of a geom, from the origin of the sweep."""
    b = m.geom_body[g]
    return w.xpos[w.t, b] + w.xmat[w.t, b] * geom_position(m, w, g)


@wp.func(inline=True)
def geom_rotation(m: wp.ref[Tables], w: wp.ref[World], g: int) -> mat33:
    """Rotation of a geom."""
    return w.xmat[w.t, m.geom_body[g]] * geom_turn(m, w, g)


@wp.func(inline=True)
def geom_axis(m: wp.ref[Tables], w: wp.ref[World], g: int) -> vec3:
    """Third axis of a geom: a plane's normal, the axis of a capsule."""
    return w.xmat[w.t, m.geom_body[g]] * geom_turn(m, w, g)[:, 2]


@wp.func(inline=True)
def half_axis(m: wp.ref[Tables], w: wp.ref[World], g: int) -> vec3:
    """Half-axis of a capsule, zero for a sphere (whose second size is zero)."""
    return geom_axis(m, w, g) * geom_size(m, w, g)[1]


@wp.func(inline=True)
def _add(w: wp.ref[World], n: int, k: int, which: int, x: collide.vec7, hint: vec3):
    """Write contact ``n`` with its frame; the first tangent is along the hint, or along y or z without one."""
    w.con_pair[w.t, n] = k
    w.con_which[w.t, n] = which
    w.con_dist[w.t, n] = x[0]
    w.con_point[w.t, n] = x[1:4]
    normal = x[4:7]
    y = hint
    if wp.dot(hint, hint) < f64(0.25):
        y = wp.where(wp.abs(normal[1]) >= HALF, vec3(ZERO, ZERO, ONE), vec3(ZERO, ONE, ZERO))
    w.con_hint[w.t, n] = y
    y = y - normal * wp.dot(normal, y)
    length = wp.length(y)
    t1 = vec3(ONE, ZERO, ZERO)
    if length > MINVAL:
        t1 = y / length
    w.con_frame[w.t, n] = wp.matrix_from_rows(normal, t1, wp.cross(normal, t1))


@wp.func(inline=True)
def _towards_plane(kind: int, n: vec3, c: vec3, axis: vec3, rot: mat33, size: vec3, which: int) -> vec3:
    """The point of a geom that may touch a plane with normal ``n``; ``which`` numbers them."""
    x = c
    if kind == collide.PLANE_CAPSULE:
        x = c + axis * (size[1] * (ONE - TWO * f64(which)))
    elif kind == collide.PLANE_BOX:
        x = c + rot * collide.corner(which, size)
    elif kind >= collide.PLANE_CYLINDER:
        x = collide.support_point(kind, n, c, rot, size, which)
    return x


@wp.func(inline=True)
def _add_boxes(
    m: wp.ref[Tables], w: wp.ref[World], n: int, k: int, c1: vec3, r1: mat33, c2: vec3, r2: mat33, margin: f64
) -> int:
    """Write the contacts of a pair of boxes from number ``n`` on and return the number of the next one."""
    size1 = m.geom_size[m.pair_geom1[k]]
    size2 = m.geom_size[m.pair_geom2[k]]
    spots, codes, normal, found = boxes.box_spots(c1, r1, size1, c2, r2, size2, margin + m.pair_gap[k])
    number = n
    for i in range(found):
        if spots[i, 0] < margin:
            x = collide.vec7(spots[i, 0], spots[i, 1], spots[i, 2], spots[i, 3], normal[0], normal[1], normal[2])
            _add(w, number, k, codes[i], x, vec3())
            number += 1
    return number


@wp.func(inline=True)
def _add_corners(
    m: wp.ref[Tables], w: wp.ref[World], n: int, k: int, normal: vec3, c1: vec3, c2: vec3, rot: mat33, margin: f64
) -> int:
    """Write the contacts of a plane and a mesh from number ``n`` on and return the number of the next one.

    They are the deepest vertex of the hull and up to three more of the face there that is turned most to the plane.
    """
    g = m.pair_geom2[k]
    start = m.geom_hull[g]
    local = wp.transpose(rot) * normal
    deepest = hull.deepest(m, g, -local)
    x = collide.plane_point(normal, c1, c2 + rot * m.hull_vert[start + deepest], ZERO)
    number = n
    if x[0] < margin:
        _add(w, number, k, start + deepest, x, vec3())
        number += 1
    face = hull.lowest_face(m, start + deepest, local)
    if x[0] <= margin + m.pair_gap[k] and face >= 0:
        own, others = hull.face_corners(m, start, face, deepest)
        for i in range(wp.min(m.poly_num[face], 4) - 1):
            v = start + m.poly_vert[m.poly_adr[face] + (own + others[i]) % m.poly_num[face]]
            way = rot * m.hull_vert[v]
            x = collide.plane_point(normal, c1, c2 + way, ZERO)
            if x[0] < margin and wp.dot(normal, way) <= ZERO:
                _add(w, number, k, v, x, vec3())
                number += 1
    return number


@wp.func(inline=True)
def _add_convex(m: wp.ref[Tables], w: wp.ref[World], n: int, k: int, margin: f64) -> int:
    """Write the contacts of a pair of convex geoms from number ``n`` on and return the number of the next one."""
    reach = margin + m.pair_gap[k]
    number = n
    for i in range(convex_contacts(m, w, k, reach)):
        dist = w.clip_dist[w.t, i] + reach
        if dist < margin:
            p = w.clip_mid[w.t, i]
            normal = w.clip_normal[w.t, 0]
            x = collide.vec7(dist, p[0], p[1], p[2], normal[0], normal[1], normal[2])
            _add(w, number, k, 0, x, vec3())
            keep_contact(w, number, i)
            number += 1
    return number


@wp.func(inline=True)
def _extent(m: wp.ref[Tables], w: wp.ref[World], g: int, direction: vec3) -> f64:
    """How far the bounding box of a geom reaches in a direction from the geom's center."""
    local = wp.transpose(m.geom_mat[g]) * (wp.transpose(w.xmat[w.t, m.geom_body[g]]) * direction)
    half = m.geom_half[g]
    spread = half[0] * wp.abs(local[0]) + half[1] * wp.abs(local[1]) + half[2] * wp.abs(local[2])
    return spread + wp.dot(m.geom_mid[g], local)


@wp.func(inline=True)
def _may_touch(m: wp.ref[Tables], w: wp.ref[World], g1: int, g2: int, apart: vec3, margin: f64) -> bool:
    """Whether the bounding boxes of two geoms overlap, or nearly so, as seen along the line of their centers."""
    length = wp.length(apart)
    near = bool(True)
    if length > MINVAL and not has_geoms(m):  # the boxes are those of the sizes in the model
        d = apart / length
        near = length - _extent(m, w, g1, d) - _extent(m, w, g2, -d) < margin
    return near


@wp.func(inline=True)
def _add_formula(
    m: wp.ref[Tables], w: wp.ref[World], n: int, k: int, normal: vec3, c1: vec3, c2: vec3, margin: f64
) -> int:
    """Write the contacts of a pair that has a formula from number ``n`` on and return the number of the next one."""
    kind = m.pair_kind[k]
    g1 = m.pair_geom1[k]
    g2 = m.pair_geom2[k]
    size1 = geom_size(m, w, g1)
    size2 = geom_size(m, w, g2)
    axis = geom_axis(m, w, g2)
    a1 = vec3()
    a2 = axis * size2[1]
    rot = mat33()
    parallel = bool(False)
    first = int(0)
    second = int(0)
    if kind == collide.ROUND:
        a1 = half_axis(m, w, g1)
        parallel = collide.are_parallel(a1, a2)
    elif kind > collide.PLANE_CAPSULE and kind != collide.SPHERE_CYLINDER:
        rot = geom_rotation(m, w, g2)
    if kind == collide.CAPSULE_BOX and size1[1] > ZERO:  # a sphere has only the place 0
        a1 = half_axis(m, w, g1)
        back = wp.transpose(rot)
        limit = margin + TWO * (size1[0] + size1[1] + size2[0] + size2[1] + size2[2])
        first, second = collide.capsule_box_codes(back * (c1 - c2), back * a1, size2, limit)
    number = n
    for i in range(m.pair_points[k]):
        possible = bool(True)
        which = i
        hint = vec3()
        x = collide.vec7()
        if kind <= collide.PLANE_ELLIPSOID:
            radius = wp.where(kind <= collide.PLANE_CAPSULE, size2[0], ZERO)
            if kind == collide.PLANE_CAPSULE:
                hint = axis
            elif kind == collide.PLANE_BOX:  # the first four corners on the plane's side of the center
                possible = wp.dot(normal, rot * collide.corner(i, size2)) <= ZERO and number - n < 4
            elif kind == collide.PLANE_CYLINDER:  # the near rim, then the far one and two points near
                possible = i == 0 or number > n
            x = collide.plane_point(normal, c1, _towards_plane(kind, normal, c2, axis, rot, size2, i), radius)
        elif kind == collide.ROUND:
            which = int(0)
            possible = i == 0 or parallel
            if parallel:
                which = collide.overlap_end(c1, a1, c2, a2, i)
            x = collide.round_contact(c1, a1, size1[0], c2, a2, size2[0], which)
        elif kind == collide.SPHERE_CYLINDER:
            which = collide.cylinder_place(c1 - c2, axis, size2)
            x = collide.sphere_cylinder(c1, size1[0], c2, axis, size2, which)
        else:
            which = wp.where(i == 0, first, second)
            possible = which >= 0
            if possible:
                x = collide.capsule_box_contact(c1, a1, size1[0], c2, rot, size2, which)
        if possible and x[0] < margin:
            _add(w, number, k, which, x, hint)
            number += 1
    return number


@wp.func_native("""
    const int* kinds = &wp::index(kind, 0);
    const double* margins = &wp::index(theta, o_margin);
    const double* bounds = &wp::index(bound, 0);
    const int* one = &wp::index(geom1, 0);
    const int* two = &wp::index(geom2, 0);
    const wp::vec_t<3, double>* c = &wp::index(center, t, 0);
    int* list = &wp::index(near, t, 0);
    int n = 0;
    for (int k = 0; k < count; ++k) {
        const double* p = c[one[k]].c;
        const double* q = c[two[k]].c;
        const double x = q[0] - p[0], y = q[1] - p[1], z = q[2] - p[2];
        const double reach = margins[k] + bounds[k];
        list[n] = k;
        n += (kinds[k] <= last_plane) | (x * x + y * y + z * z < reach * reach);
    }
    return n;
""")
def _near_pairs(
    kind: Ints, geom1: Ints, geom2: Ints, bound: Reals, theta: Reals, o_margin: int, count: int, last_plane: int,
    center: Vec3s2, near: Ints2, t: int,
) -> int:  # fmt: skip
    """List the pairs whose bounding spheres are within the margin, and all of planes; return their number."""


@wp.func(inline=True)
def find_contacts(m: wp.ref[Tables], w: wp.ref[World]) -> int:
    """List the contacts of a configuration and return their number."""
    for i in range(m.ntouching):
        g = m.touching[i]
        w.center[w.t, g] = geom_center(m, w, g)
    close = int(0)
    if m.npair > 0:
        close = _near_pairs(
            m.pair_kind, m.pair_geom1, m.pair_geom2, m.pair_bound, w.th, m.o_pair_margin, m.npair,
            collide.PLANE_ELLIPSOID, w.center, w.near, w.t,
        )  # fmt: skip
    n = int(0)
    for i in range(close):
        k = w.near[w.t, i]
        kind = m.pair_kind[k]
        margin = w.th[m.o_pair_margin + k]
        g1 = m.pair_geom1[k]
        g2 = m.pair_geom2[k]
        c1 = w.center[w.t, g1]
        c2 = w.center[w.t, g2]
        normal = vec3()
        near = bool(True)
        if kind <= collide.PLANE_ELLIPSOID:
            normal = geom_axis(m, w, g1)
            near = wp.dot(normal, c2 - c1) < margin + m.pair_bound[k]
        else:
            near = _may_touch(m, w, g1, g2, c2 - c1, margin)
        if near and n + m.pair_most[k] > m.maxcon:
            w.full[w.t] = 1
        elif near and kind == collide.BOX_BOX:
            n = _add_boxes(m, w, n, k, c1, geom_rotation(m, w, g1), c2, geom_rotation(m, w, g2), margin)
        elif near and kind == collide.PLANE_MESH:
            n = _add_corners(m, w, n, k, normal, c1, c2, geom_rotation(m, w, g2), margin)
        elif near and with_convex() and kind == collide.CONVEX:
            n = _add_convex(m, w, n, k, margin)
        elif near:
            n = _add_formula(m, w, n, k, normal, c1, c2, margin)
    return n


@wp.func(inline=False)
def _turned(r: mat33, rbar: mat33) -> vec3:
    """Torque that a rotation's adjoint is: Σ columns r × r̄."""
    return wp.cross(r[:, 0], rbar[:, 0]) + wp.cross(r[:, 1], rbar[:, 1]) + wp.cross(r[:, 2], rbar[:, 2])


@wp.func(inline=True)
def _boxes_adjoint(
    c1: vec3, r1: mat33, size1: vec3, c2: vec3, r2: mat33, size2: vec3, code: int, dbar: f64, pbar: vec3, nbar: vec3
):
    """Spatial forces on the bodies of two boxes; :func:`box_contact` takes the reference box first."""
    swap = boxes.is_second(code) != 0
    sign = wp.where(swap, -ONE, ONE)
    ca = wp.where(swap, c2, c1)
    cb = wp.where(swap, c1, c2)
    ra = r1
    rb = r2
    if swap:
        ra = r2
        rb = r1
    cab, rab, _sa, cbb, rbb, _sb, _w, _d, _p, _n = wp.grad(boxes.box_dual)(
        ca, ra, wp.where(swap, size2, size1), cb, rb, wp.where(swap, size1, size2), code, dbar, pbar, nbar * sign
    )
    ya = pull(cab, ca, _turned(ra, rab))
    yb = pull(cbb, cb, _turned(rb, rbb))
    return wp.where(swap, yb, ya), wp.where(swap, ya, yb)


@wp.func(inline=True)
def geometry_adjoint(
    m: wp.ref[Tables], w: wp.ref[World], c: int, distbar: f64, pbar: vec3, nbar0: vec3, t1bar0: vec3, t2bar: vec3
):
    """From the adjoints of distance, point and frame to spatial forces on the two geoms' bodies."""
    k = w.con_pair[w.t, c]
    which = w.con_which[w.t, c]
    kind = m.pair_kind[k]
    g1 = m.pair_geom1[k]
    g2 = m.pair_geom2[k]
    n = w.con_frame[w.t, c][0]
    t1 = w.con_frame[w.t, c][1]
    hint = w.con_hint[w.t, c]
    # t2 = n × t1, t1 = (hint − n n·hint) / |...|
    nbar = nbar0 + wp.cross(t1, t2bar)
    t1bar = t1bar0 + wp.cross(t2bar, n)
    along = wp.dot(n, hint)
    length = wp.length(hint - n * along)
    ybar = vec3()
    if length > MINVAL:
        ybar = (t1bar - t1 * wp.dot(t1, t1bar)) / length
    nbar = nbar - ybar * along - hint * wp.dot(n, ybar)
    c1 = geom_center(m, w, g1)
    c2 = geom_center(m, w, g2)
    size1 = geom_size(m, w, g1)
    size = geom_size(m, w, g2)
    size1bar = vec3()
    sizebar = vec3()
    rot = mat33()
    if kind != collide.ROUND and kind != collide.PLANE_SPHERE and kind != collide.SPHERE_CYLINDER:
        rot = geom_rotation(m, w, g2)
    y1 = vec6()
    y2 = vec6()
    if with_convex() and kind == collide.CONVEX:
        y1, y2 = convex_adjoint(m, w, c, distbar, pbar, nbar)
    elif kind <= collide.PLANE_ELLIPSOID:
        # dist = n·(x − c1) − r, p = x − n (r + dist/2), x a point of the second geom
        radius = wp.where(kind <= collide.PLANE_CAPSULE, size[0], ZERO)
        x = c2
        if kind == collide.PLANE_MESH:
            x = c2 + rot * m.hull_vert[which]
        else:
            x = _towards_plane(kind, n, c2, hint, rot, size, which)
        slope = distbar - HALF * wp.dot(pbar, n)
        xbar = pbar + n * slope
        nbar = nbar + (x - c1) * slope - pbar * (radius + HALF * w.con_dist[w.t, c])
        if kind >= collide.PLANE_CYLINDER:
            _k, nb, cb, rb, sizebar, _w, _x = wp.grad(collide.support_dual)(kind, n, c2, rot, size, which, xbar)
            nbar = nbar + nb
            y2 = pull(cb, c2, _turned(rot, rb))
        elif kind == collide.PLANE_CAPSULE:  # its axis is the hint
            y2 = pull(xbar, x, wp.cross(hint, ybar - n * wp.dot(n, ybar)))
            sizebar[1] = wp.dot(hint, xbar) * (ONE - TWO * f64(which))
        else:
            y2 = wrench(xbar, x)
            if kind == collide.PLANE_BOX:
                sizebar = wp.cw_mul(collide.corner(which, vec3(ONE, ONE, ONE)), wp.transpose(rot) * xbar)
        if kind <= collide.PLANE_CAPSULE:
            sizebar[0] = -distbar - HALF * wp.dot(pbar, n)
        y1 = pull(n * -slope, c1, wp.cross(n, nbar))
    elif kind == collide.ROUND:
        a1 = half_axis(m, w, g1)
        a2 = half_axis(m, w, g2)
        c1b, a1b, r1b, c2b, a2b, r2b, _w, _d, _p, _n = wp.grad(collide.round_dual)(
            c1, a1, size1[0], c2, a2, size[0], which, distbar, pbar, nbar
        )
        y1 = pull(c1b, c1, wp.cross(a1, a1b))
        y2 = pull(c2b, c2, wp.cross(a2, a2b))
        size1bar = vec3(r1b, wp.dot(geom_axis(m, w, g1), a1b), ZERO)
        sizebar = vec3(r2b, wp.dot(geom_axis(m, w, g2), a2b), ZERO)
    elif kind == collide.SPHERE_CYLINDER:
        axis = geom_axis(m, w, g2)
        c1b, r1b, c2b, axisb, sizebar, _w, _d, _p, _n = wp.grad(collide.sphere_cylinder_dual)(
            c1, size1[0], c2, axis, size, which, distbar, pbar, nbar
        )
        size1bar = vec3(r1b, ZERO, ZERO)
        y1 = wrench(c1b, c1)
        y2 = pull(c2b, c2, wp.cross(axis, axisb))
    elif kind == collide.BOX_BOX:
        y1, y2 = _boxes_adjoint(c1, geom_rotation(m, w, g1), size1, c2, rot, size, which, distbar, pbar, nbar)
    else:
        a1 = half_axis(m, w, g1)
        c1b, a1b, r1b, cb, rb, sizebar, _w, _d, _p, _n = wp.grad(collide.capsule_box_dual)(
            c1, a1, size1[0], c2, rot, size, which, distbar, pbar, nbar
        )
        y1 = pull(c1b, c1, wp.cross(a1, a1b))
        y2 = pull(cb, c2, _turned(rot, rb))
        size1bar = vec3(r1b, wp.dot(geom_axis(m, w, g1), a1b), ZERO)
    if has_geoms(m):
        geom_frame_adjoint(m, w, g1, y1)
        geom_frame_adjoint(m, w, g2, y2)
        geom_size_adjoint(m, w, g1, size1bar)
        geom_size_adjoint(m, w, g2, sizebar)
    return y1, y2
