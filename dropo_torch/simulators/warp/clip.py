"""Several contacts of two convex shapes from the faces or edges that touch: MuJoCo's "multiccd", step by step.

Of the two features that meet where the shapes are closest or deepest, one is a face and the other a face or an edge
that is nearly parallel to it. The second is clipped at the sides of the first; each corner of what remains is a
contact. A corner is where three planes meet, each fixed in one of the two bodies: this is how it is differentiated.

Working memory is ``clip_...``. Sides of the clipped feature are numbered from 0, those it is clipped at from SIDE.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

from typing import Any

import warp as wp

from dropo_torch.simulators.warp.convex import BOX, CAPSULE, CYLINDER, MESH, MINVAL2, Shape, Simplex
from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, TWO, ZERO, Tables, World, f64, mat33, vec3

vec4i: Any = wp.vec4i

#: Cosine and sine that tell whether normals of faces, or a normal and an edge, are aligned.
FACE_COSINE = wp.constant(wp.float64(0.996))
EDGE_SINE = wp.constant(wp.float64(0.0888))
#: Number of the first side of the clipping face.
SIDE = wp.constant(1 << 20)
#: Corners of the polygon that stands for a cylinder's disk.
DISK = wp.constant(16)

#: What ``con_how`` says of a contact: its corner's planes that are fixed in the second body (three bits), whether the
#: clipping face is the second body's, the normal is, the direction of projection is along the normal, and whether the
#: clipped edge is one that rolls on the first or the second body; of all, that the contact is a clipped corner.
FACE_ON_2 = wp.constant(8)
NORMAL_ON_2 = wp.constant(16)
ALONG_NORMAL = wp.constant(32)
ROLLS_1 = wp.constant(64)
ROLLS_2 = wp.constant(128)
CLIPPED = wp.constant(256)


@wp.struct
class Feature:
    """What of a shape touches: how many distinct vertices, which, and a point of it."""

    dim: wp.int32
    v1: wp.int32
    v2: wp.int32
    v3: wp.int32
    point: vec3


@wp.func(inline=False)
def feature_of(v: vec4i, points: mat33, n: int) -> Feature:
    """The feature that the vertices of a simplex with ``n`` points span."""
    out = Feature()
    out.v1 = v[0]
    out.v2 = v[wp.where(n > 1, 1, 0)]
    out.v3 = v[wp.where(n > 2, 2, 0)]
    out.point = points[0]
    out.dim = 2
    if out.v1 != out.v2:
        if out.v3 != out.v1 and out.v3 != out.v2:
            out.dim = 3
    else:
        out.v2 = out.v3
        if out.v1 == out.v3:
            out.dim = 1
    return out


@wp.func(inline=False)
def _bit(i: int, k: int) -> int:
    return (i >> k) & 1


@wp.func(inline=False)
def box_corner(s: Shape, i: int) -> vec3:
    """Corner of a box, its bits the signs."""
    x = vec3()
    for k in range(3):
        x[k] = wp.where(_bit(i, k) != 0, s.size[k], -s.size[k])
    return s.rot * x + s.pos


@wp.func(inline=False)
def _corner(m: wp.ref[Tables], s: Shape, i: int) -> vec3:
    """Vertex of a box or a mesh."""
    return box_corner(s, i) if s.kind == BOX else s.rot * m.hull_vert[s.hull + i] + s.pos


@wp.func(inline=False)
def _set_normal(w: wp.ref[World], side: int, k: int, n: vec3, face: int):
    """Write normal ``k`` of the first or the second shape, and the face that has it."""
    if side == 0:
        w.clip_normal1[w.t, k] = n
        w.clip_index1[w.t, k] = face
    else:
        w.clip_normal2[w.t, k] = n
        w.clip_index2[w.t, k] = face


@wp.func(inline=False)
def _box_normals(w: wp.ref[World], side: int, s: Shape, f: Feature, outward: vec3) -> int:
    """Normals of the faces of a box that a feature is on."""
    n = int(0)
    axes = int(3)  # a variable: the loops are not unrolled
    for k in range(axes):
        one = _bit(f.v1, k)
        same = f.dim == 1 or _bit(f.v2, k) == one
        if f.dim == 3:
            same = same and _bit(f.v3, k) == one
        if same:
            axis = s.rot[:, k]
            _set_normal(w, side, n, wp.where(one != 0, axis, -axis), 2 * k + 1 - one)
            n += 1
    if (f.dim == 3 and n != 1) or (f.dim == 2 and n == 0):
        # the vertices are on no common face: the one along the normal, if there is one
        n = int(0)
        local = wp.normalize(wp.transpose(s.rot) * outward)
        for k in range(axes):
            for sign in range(axes - 1):
                x = local[k] * f64(1 - 2 * sign)
                if n == 0 and x > FACE_COSINE:
                    axis = s.rot[:, k]
                    _set_normal(w, side, 0, wp.where(sign == 0, axis, -axis), 2 * k + sign)
                    n = 1
    return n


@wp.func(inline=False)
def _has_polygon(m: wp.ref[Tables], s: Shape, v: int, polygon: int) -> bool:
    """Whether a vertex of a hull is on a polygon."""
    i = m.hull_polyadr[s.hull + v]
    found = bool(False)
    while m.hull_poly[i] >= 0:
        if m.hull_poly[i] == polygon:
            found = True
        i += 1
    return found


@wp.func(inline=False)
def _mesh_normals(m: wp.ref[Tables], w: wp.ref[World], side: int, s: Shape, f: Feature) -> int:
    """Normals of the polygons of a hull that a feature is on."""
    n = int(0)
    most = wp.where(f.dim == 1, m.nclip_normal, wp.where(f.dim == 2, 2, 1))
    i = m.hull_polyadr[s.hull + f.v1]
    while m.hull_poly[i] >= 0 and n < most:
        k = m.hull_poly[i]
        on = f.dim < 2 or _has_polygon(m, s, f.v2, k)
        if f.dim == 3:
            on = on and _has_polygon(m, s, f.v3, k)
        if on:
            _set_normal(w, side, n, s.rot * m.poly_normal[k], k)
            n += 1
        i += 1
    return n


@wp.func(inline=False)
def _normals(m: wp.ref[Tables], w: wp.ref[World], side: int, s: Shape, f: Feature, outward: vec3) -> int:
    """Normals of the faces that a feature is on; how many."""
    n = int(0)
    if s.kind == BOX:
        n = _box_normals(w, side, s, f, outward)
    elif s.kind == MESH:
        n = _mesh_normals(m, w, side, s, f)
    elif s.kind == CYLINDER and f.dim == 1:
        axis = s.rot[:, 2]
        _set_normal(w, side, 0, wp.where(f.v1 != 0, -axis, axis), f.v1)
        n = 1
    return n


@wp.func(inline=False)
def _set_edge(w: wp.ref[World], side: int, k: int, start: vec3, end: vec3):
    d = end - start
    _set_normal(w, side, k, wp.normalize(d), 0)
    w.clip_end[w.t, k] = end


@wp.func(inline=False)
def _mesh_edges(m: wp.ref[Tables], w: wp.ref[World], side: int, s: Shape, v: int, start: vec3) -> int:
    """Edges of a hull at a vertex: for each of its polygons to the vertex before."""
    n = int(0)
    i = m.hull_polyadr[s.hull + v]
    while m.hull_poly[i] >= 0 and n < m.nclip_normal:
        k = m.hull_poly[i]
        first = m.poly_adr[k]
        count = m.poly_num[k]
        for j in range(count):
            if m.poly_vert[first + j] == v:
                before = m.poly_vert[first + (j + count - 1) % count]
                _set_edge(w, side, n, start, _corner(m, s, before))
        n += 1
        i += 1
    return n


@wp.func(inline=False)
def _edges(m: wp.ref[Tables], w: wp.ref[World], side: int, s: Shape, f: Feature, witness: vec3):
    """Edges that a feature may be part of: how many, and where they start; their ends and directions are written."""
    n = int(0)
    start = f.point
    axis = s.rot[:, 2]
    if s.kind == CAPSULE:
        along = wp.dot(witness - s.pos, axis)
        start = witness - axis * (along + s.size[1])
        _set_edge(w, side, 0, start, witness + axis * (s.size[1] - along))
        n = 1
    elif s.kind == CYLINDER:
        up = axis * wp.where(f.v1 != 0, ONE, -ONE)
        if s.inflation > ZERO:
            local = wp.transpose(s.rot) * (f.point - s.pos)
            radial = local[0] * local[0] + local[1] * local[1]
            scale = ZERO
            if radial >= MINVAL2:
                scale = s.size[0] / wp.sqrt(radial)
            start = s.pos + s.rot[:, 0] * (local[0] * scale) + s.rot[:, 1] * (local[1] * scale) - up * s.size[1]
        _set_normal(w, side, 0, up, 0)
        w.clip_end[w.t, 0] = start + up * (TWO * s.size[1])
        n = 1
    elif s.kind == BOX or s.kind == MESH:
        start = _corner(m, s, f.v1)
        if f.dim == 2:
            _set_edge(w, side, 0, start, _corner(m, s, f.v2))
            n = 1
        elif s.kind == BOX:
            n = 3
            for k in range(n):
                _set_edge(w, side, k, start, box_corner(s, f.v1 ^ (1 << k)))
        else:
            n = _mesh_edges(m, w, side, s, f.v1, start)
    return n, start


@wp.func(inline=False)
def _set_corner(w: wp.ref[World], side: int, k: int, x: vec3):
    if side == 0:
        w.clip_face1[w.t, k] = x
    else:
        w.clip_face2[w.t, k] = x


@wp.func(inline=False)
def _face(m: wp.ref[Tables], w: wp.ref[World], side: int, s: Shape, face: int) -> int:
    """Write the corners of a face, clockwise from outside; how many."""
    n = int(0)
    if s.kind == BOX:
        corners = wp.where(face == 0, 2655, wp.where(face == 1, 306, wp.where(face == 2, 3546, 108)))
        if face >= 4:
            corners = wp.where(face == 4, 2430, 531)  # an octal digit each
        n = 4
        for c in range(n):
            _set_corner(w, side, c, box_corner(s, (corners >> (3 * c)) & 7))
    elif s.kind == MESH:
        first = m.poly_adr[face]
        n = m.poly_num[face]
        for c in range(n):
            _set_corner(w, side, c, _corner(m, s, m.poly_vert[first + n - 1 - c]))
    elif s.kind == CYLINDER:
        sign = wp.where(face != 0, -ONE, ONE)
        center = s.rot[:, 2] * (sign * s.size[1]) + s.pos
        u = s.rot[:, 0] * s.size[0]
        v = s.rot[:, 1] * (s.size[0] * sign)
        n = DISK
        for c in range(n):
            angle = f64(wp.pi) * f64(c) / f64(8.0)
            _set_corner(w, side, c, u * wp.cos(angle) - v * wp.sin(angle) + center)
    return n


@wp.func(inline=False)
def _corner_of(w: wp.ref[World], side: int, k: int) -> vec3:
    return wp.where(side == 0, w.clip_face1[w.t, k], w.clip_face2[w.t, k])


@wp.func(inline=False)
def capacity(w: wp.ref[World]) -> int:
    """Corners of which there is room in a polygon."""
    return w.clip_point.shape[1] // 2


@wp.func(inline=False)
def _add_point(w: wp.ref[World], page: int, k: int, x: vec3, line: int):
    """Append a corner to a polygon in one of two pages, with the side that leaves it."""
    if k < capacity(w):
        w.clip_point[w.t, page * capacity(w) + k] = x
        w.clip_line[w.t, page * capacity(w) + k] = line


@wp.func(inline=False)
def _clip(w: wp.ref[World], clipping: int, nclipping: int, clipped: int, nclipped: int, n: vec3):
    """Clip a polygon at the sides of a face with normal ``n``; the page where the result is, and its corners."""
    half = capacity(w)
    page = int(0)
    count = nclipped
    for i in range(nclipped):
        _add_point(w, 0, i, _corner_of(w, clipped, i), i)
    for e in range(nclipping):
        a = _corner_of(w, clipping, e)
        side = wp.cross(_corner_of(w, clipping, (e + 1) % nclipping) - a, n)
        level = wp.dot(side, a)
        k = int(0)
        for i in range(count):
            j = (i + 1) % count
            p = w.clip_point[w.t, page * half + i]
            q = w.clip_point[w.t, page * half + j]
            line = w.clip_line[w.t, page * half + i]
            p_in = wp.dot(p - a, side) > -MINVAL
            q_in = wp.dot(q - a, side) > -MINVAL
            if p_in != q_in:
                slope = wp.dot(side, q - p)
                if wp.abs(slope) > MINVAL2:
                    t = (level - wp.dot(side, p)) / slope
                    if t > -MINVAL and t < ONE + MINVAL:
                        t = wp.clamp(t, ZERO, ONE)
                        _add_point(w, 1 - page, k, p + (q - p) * t, wp.where(p_in, SIDE + e, line))
                        k += 1
            if q_in:
                _add_point(w, 1 - page, k, q, w.clip_line[w.t, page * half + j])
                k += 1
        page = 1 - page
        count = wp.min(k, half)
    return page, count


@wp.func(inline=False)
def _at(w: wp.ref[World], page: int, i: int) -> vec3:
    return w.clip_point[w.t, page * capacity(w) + i]


@wp.func(inline=False)
def _area(w: wp.ref[World], page: int, a: int, b: int, c: int, d: int) -> f64:
    return HALF * wp.length(wp.cross(_at(w, page, a) - _at(w, page, c), _at(w, page, b) - _at(w, page, d)))


@wp.func(inline=False)
def _largest_quad(w: wp.ref[World], page: int, n: int) -> vec4i:
    """Corners of a quadrilateral of largest area in a polygon, as MuJoCo finds it."""
    b = int(1)
    c = int(2)
    d = int(3)
    best = vec4i(0, 1, 2, 3)
    area = _area(w, page, 0, b, c, d)
    for a in range(n):
        going = bool(True)
        while going:
            x = _area(w, page, a, b, c, (d + 1) % n)
            going = x > area
            if going:
                area = x
                d = (d + 1) % n
                best = vec4i(a, b, c, d)
                inner = bool(True)
                while inner:
                    x = _area(w, page, a, b, (c + 1) % n, d)
                    inner = x > area
                    if inner:
                        area = x
                        c = (c + 1) % n
                        best = vec4i(a, b, c, d)
                inner = bool(True)
                while inner:
                    x = _area(w, page, a, (b + 1) % n, c, d)
                    inner = x > area
                    if inner:
                        area = x
                        b = (b + 1) % n
                        best = vec4i(a, b, c, d)
        if b == a:
            b = (b + 1) % n
            if c == b:
                c = (c + 1) % n
                if d == c:
                    d = (d + 1) % n
    return best


@wp.func(inline=False)
def _furthest_two(w: wp.ref[World], page: int, n: int) -> vec4i:
    best = vec4i(0, 1, 0, 0)
    far = f64(0.0)
    for i in range(n):
        for j in range(i + 1, n):
            d = _at(w, page, j) - _at(w, page, i)
            if wp.dot(d, d) > far:
                far = wp.dot(d, d)
                best = vec4i(i, j, 0, 0)
    return best


@wp.func(inline=False)
def _plane_of(
    w: wp.ref[World], line: int, clipping: int, nclipping: int, nc: vec3, clipped: int, nclipped: int, nd: vec3
):
    """Normal of the plane of a side, and whether it is one of the clipping face."""
    side = clipped
    i = line
    count = nclipped
    n = nd
    if line >= SIDE:
        side = clipping
        i = line - SIDE
        count = nclipping
        n = nc
    d = _corner_of(w, side, (i + 1) % count) - _corner_of(w, side, i)
    return wp.normalize(wp.cross(d, n)), line >= SIDE


@wp.func(inline=False)
def _planes_at(
    w: wp.ref[World], page: int, k: int, clipping: int, nclipping: int, nc: vec3, clipped: int, nclipped: int, nd: vec3
):
    """Three planes in whose common point a corner is, and which of them are fixed in the clipped body (bits)."""
    out_line = w.clip_line[w.t, page * capacity(w) + k]
    in_line = w.clip_before[w.t, k]
    rows = mat33(ONE, ZERO, ZERO, ZERO, ONE, ZERO, ZERO, ZERO, ONE)
    own = int(7)
    if nclipped == 2:
        # an edge: cut by a side, or one of its ends
        if out_line >= SIDE or in_line >= SIDE:
            line = wp.where(out_line >= SIDE, out_line, in_line)
            side, _foreign = _plane_of(w, line, clipping, nclipping, nc, clipped, nclipped, nd)
            d = wp.normalize(_corner_of(w, clipped, 1) - _corner_of(w, clipped, 0))
            if wp.abs(wp.dot(d, side)) > f64(1.0e-9):
                u = wp.normalize(
                    wp.cross(d, wp.where(wp.abs(d[0]) < HALF, vec3(ONE, ZERO, ZERO), vec3(ZERO, ONE, ZERO)))
                )
                rows = wp.matrix_from_rows(side, u, wp.cross(d, u))
                own = 6
    else:
        p, p_foreign = _plane_of(w, in_line, clipping, nclipping, nc, clipped, nclipped, nd)
        q, q_foreign = _plane_of(w, out_line, clipping, nclipping, nc, clipped, nclipped, nd)
        if (p_foreign or q_foreign) and wp.abs(wp.dot(nd, wp.cross(p, q))) > f64(1.0e-9):
            rows = wp.matrix_from_rows(nd, p, q)
            own = 1 + wp.where(p_foreign, 0, 2) + wp.where(q_foreign, 0, 4)
    return rows, own


@wp.func(inline=False)
def _best_faces(w: wp.ref[World], n1: int, n2: int, direction: vec3):
    """The two faces that face each other most, if they do; ``direction`` is against the normal of the contact."""
    limit = EDGE_SINE * wp.length(direction)
    best = -FACE_COSINE
    one = int(-1)
    two = int(-1)
    for i in range(n1):
        if wp.dot(w.clip_normal1[w.t, i], direction) < -limit:
            for j in range(n2):
                if wp.dot(w.clip_normal2[w.t, j], direction) > limit:
                    d = wp.dot(w.clip_normal1[w.t, i], w.clip_normal2[w.t, j])
                    if d < best:
                        best = d
                        one = i
                        two = j
    return one, two


@wp.func(inline=False)
def _edge_and_face(w: wp.ref[World], edges: int, nedge: int, nface: int, direction: vec3):
    """The first edge that lies in a face's plane, of the shape ``edges``, and the face."""
    edge = int(-1)
    face = int(-1)
    for i in range(nface):
        n = wp.where(edges == 0, w.clip_normal2[w.t, i], w.clip_normal1[w.t, i])
        if face < 0 and wp.dot(n, direction) > MINVAL:
            for j in range(nedge):
                d = wp.where(edges == 0, w.clip_normal1[w.t, j], w.clip_normal2[w.t, j])
                if face < 0 and wp.abs(wp.dot(d, n)) < EDGE_SINE:
                    edge = j
                    face = i
    return edge, face


@wp.func(inline=False)
def _three(x: wp.types.matrix((4, 3), wp.float64)) -> mat33:
    return wp.matrix_from_rows(x[0], x[1], x[2])


@wp.func(inline=False)
def multicontact(m: wp.ref[Tables], w: wp.ref[World], a: Shape, b: Shape, s: Simplex, x1: vec3, x2: vec3) -> int:
    """Contacts of two shapes whose witnesses and their simplex are known; how many, 0 if only the witnesses touch.

    They are written to ``clip_dist`` (of the inflated shapes), ``clip_mid``, ``clip_corner``, ``clip_height``,
    ``clip_planes``, ``clip_normal`` (the contacts' and the clipping face's) and ``clip_how``.
    """
    direction = x2 - x1
    f1 = feature_of(s.vertex1, _three(s.one), s.n)
    f2 = feature_of(s.vertex2, _three(s.two), s.n)
    n1 = _normals(m, w, 0, a, f1, -direction)
    n2 = _normals(m, w, 1, b, f2, direction)
    one, two = _best_faces(w, n1, n2, direction)
    edge = int(-1)  # of the first shape 0, of the second 1
    start = vec3()
    end = vec3()
    if one < 0:
        if f1.dim < 3 and n2 > 0 and (f1.dim <= f2.dim or n1 == 0):
            k, start = _edges(m, w, 0, a, f1, x1)
            one, two = _edge_and_face(w, 0, k, n2, direction)
            edge = 0
        if (one < 0 or two < 0) and f2.dim < 3 and n1 > 0:
            n1 = _normals(m, w, 0, a, f1, -direction)  # edges have been written over them
            k, start = _edges(m, w, 1, b, f2, x2)
            two, one = _edge_and_face(w, 1, k, n1, -direction)
            edge = 1
        if one < 0 or two < 0 or edge < 0:
            return 0
    count1 = int(2)
    count2 = int(2)
    if edge >= 0:
        end = w.clip_end[w.t, wp.where(edge == 0, one, two)]
        _set_corner(w, edge, 0, start)
        _set_corner(w, edge, 1, end)
    if edge != 0:
        count1 = _face(m, w, 0, a, w.clip_index1[w.t, one])
    if edge != 1:
        count2 = _face(m, w, 1, b, w.clip_index2[w.t, two])
    face1 = w.clip_normal1[w.t, one]
    face2 = w.clip_normal2[w.t, two]
    margin1 = wp.where(a.kind == CAPSULE, ZERO, a.inflation)
    margin2 = wp.where(b.kind == CAPSULE, ZERO, b.inflation)
    margin = margin1 + margin2
    # the clipping face's side, its normal, and what is clipped
    clipping = wp.where(edge == 0, 1, 0)
    nc = wp.where(edge == 0, face2, face1)
    nd = wp.where(edge < 0, face2, vec3())
    way = face2  # of projection
    normal = -face2
    how = CLIPPED + NORMAL_ON_2
    if edge == 0:
        way = -face2
        how = CLIPPED + NORMAL_ON_2 + FACE_ON_2 + ALONG_NORMAL
        if a.kind == CAPSULE or a.kind == CYLINDER:
            how += ROLLS_1
    elif edge == 1:
        way = -face1
        normal = face1
        how = int(CLIPPED)
        if b.kind == CAPSULE or b.kind == CYLINDER:
            how += ROLLS_2
    nclipping = wp.where(clipping == 0, count1, count2)
    nclipped = wp.where(clipping == 0, count2, count1)
    if nclipping < 3:
        return 0
    page, n = _clip(w, clipping, nclipping, 1 - clipping, nclipped, nc)
    base = _corner_of(w, clipping, 0)
    kept = int(0)
    half = capacity(w)
    for i in range(n):  # the side that enters a corner is that which leaves the one before
        w.clip_before[w.t, i] = w.clip_line[w.t, page * half + (i + n - 1) % n]
    for i in range(n):
        if wp.dot(_at(w, page, i) - base, nc) <= margin:
            w.clip_point[w.t, page * half + kept] = _at(w, page, i)
            w.clip_line[w.t, page * half + kept] = w.clip_line[w.t, page * half + i]
            w.clip_before[w.t, kept] = w.clip_before[w.t, i]
            kept += 1
    if kept < 1:
        return 0
    found = wp.min(kept, 4)
    which = vec4i(0, 1, 2, 3)
    if nclipped == 2 and kept > 2:
        which = _furthest_two(w, page, kept)
        found = 2
    elif kept > 4:
        which = _largest_quad(w, page, kept)
    for i in range(found):
        k = which[i]
        x = _at(w, page, k)
        depth = wp.dot(x - base, nc)
        foot = x - nc * depth
        dist = wp.dot(foot - x, way)
        rows, own = _planes_at(w, page, k, clipping, nclipping, nc, 1 - clipping, nclipped, nd)
        bits = wp.where(clipping == 0, own, 7 - own)
        w.clip_dist[w.t, i] = dist - margin
        w.clip_mid[w.t, i] = foot - way * (HALF * dist) + normal * (HALF * (margin1 - margin2))
        w.clip_corner[w.t, i] = x
        w.clip_height[w.t, i] = depth
        w.clip_planes[w.t, i] = rows
        w.clip_how[w.t, i] = how + bits
    w.clip_normal[w.t, 0] = normal
    w.clip_normal[w.t, 1] = nc
    return found
