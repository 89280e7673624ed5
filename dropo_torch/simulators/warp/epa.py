"""Depth of two convex shapes that overlap: MuJoCo's variant of the expanding polytope algorithm, step by step.

A polytope inside the Minkowski difference grows around the origin until the face that is closest to it is one of the
difference's own. Its vertices and faces are in the world's memory (``epa_...``); the numbers of them and where the
searches for support points ended are in ``epa_state``. Nothing here is differentiated.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

from typing import Any

import warp as wp

from dropo_torch.simulators.warp.convex import (
    FAR,
    MINVAL2,
    Shape,
    Simplex,
    areas,
    is_discrete,
    project_on_plane,
    support,
)
from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, ZERO, Tables, World, f64, mat33, vec3, vec3i

vec5i: Any = wp.types.vector(5, wp.int32)

#: What ``epa_state`` holds: vertices, faces, faces that may be expanded, edges of the horizon, places of the searches.
VERTICES = wp.constant(0)
FACES = wp.constant(1)
LISTED = wp.constant(2)
EDGES = wp.constant(3)
PLACE1 = wp.constant(4)
PLACE2 = wp.constant(5)
#: Where a face is in the list of those that may be expanded: nowhere, or nowhere because it is gone.
UNLISTED = wp.constant(-1)
GONE = wp.constant(-2)
#: Outcomes of building a polytope around a simplex.
BUILT = wp.constant(0)
SMALLER = wp.constant(1)  # the origin is on a part of the simplex: build around that
FAILED = wp.constant(2)


@wp.struct
class Depth:
    """Outcome of EPA: whether there is one, the negative depth, the deepest points, and the face's vertices."""

    found: wp.int32
    dist: wp.float64
    x1: vec3
    x2: vec3
    simplex: Simplex


@wp.func(inline=False)
def _start(w: wp.ref[World]):
    for i in range(4):
        w.epa_state[w.t, i] = 0


@wp.func(inline=False)
def _add_vertex(w: wp.ref[World], s: Simplex, i: int) -> int:
    k = w.epa_state[w.t, VERTICES]
    w.epa_state[w.t, VERTICES] = k + 1
    w.epa_point[w.t, k] = s.one[i] - s.two[i]
    w.epa_one[w.t, k] = s.one[i]
    w.epa_two[w.t, k] = s.two[i]
    w.epa_vertex1[w.t, k] = s.vertex1[i]
    w.epa_vertex2[w.t, k] = s.vertex2[i]
    return k


@wp.func(inline=False)
def _add_support(m: wp.ref[Tables], w: wp.ref[World], a: Shape, b: Shape, d: vec3, length: f64) -> int:
    """Append the support point along ``d``, of the given length, and return its number."""
    u = vec3(ONE, ZERO, ZERO)
    if length > MINVAL:
        u = d / length
    k = w.epa_state[w.t, VERTICES]
    w.epa_state[w.t, VERTICES] = k + 1
    a.place = w.epa_state[w.t, PLACE1]
    b.place = w.epa_state[w.t, PLACE2]
    p1, v1, place1 = support(m, a, u)
    p2, v2, place2 = support(m, b, -u)
    w.epa_state[w.t, PLACE1] = place1
    w.epa_state[w.t, PLACE2] = place2
    w.epa_one[w.t, k] = p1
    w.epa_two[w.t, k] = p2
    w.epa_point[w.t, k] = p1 - p2
    w.epa_vertex1[w.t, k] = v1
    w.epa_vertex2[w.t, k] = v2
    return k


@wp.func(inline=False)
def _attach(w: wp.ref[World], v1: int, v2: int, v3: int, n1: int, n2: int, n3: int) -> f64:
    """Append a face with its neighbors and return its squared distance from the origin, zero without a plane."""
    k = w.epa_state[w.t, FACES]
    w.epa_state[w.t, FACES] = k + 1
    w.epa_corners[w.t, k] = vec3i(v1, v2, v3)
    w.epa_beside[w.t, k] = vec3i(n1, n2, n3)
    w.epa_place[w.t, k] = UNLISTED
    p = w.epa_point[w.t, v1]
    x, ok = project_on_plane(w.epa_point[w.t, v3], w.epa_point[w.t, v2], p)
    if ok and wp.dot(x, p - w.epa_center[w.t, 0]) < ZERO:
        x = -x
    w.epa_near[w.t, k] = x
    w.epa_dist[w.t, k] = wp.dot(x, x)
    return wp.where(ok, wp.dot(x, x), ZERO)


@wp.func(inline=False)
def _list(w: wp.ref[World], face: int):
    k = w.epa_state[w.t, LISTED]
    w.epa_state[w.t, LISTED] = k + 1
    w.epa_list[w.t, k] = face
    w.epa_place[w.t, face] = k


@wp.func(inline=False)
def _delete(w: wp.ref[World], face: int):
    """Take a face off the polytope; the last of the list takes its place there."""
    place = w.epa_place[w.t, face]
    if place >= 0:
        k = w.epa_state[w.t, LISTED] - 1
        w.epa_state[w.t, LISTED] = k
        last = w.epa_list[w.t, k]
        w.epa_list[w.t, place] = last
        w.epa_place[w.t, last] = place
    w.epa_place[w.t, face] = GONE


@wp.func(inline=False)
def _same_side(p0: vec3, p1: vec3, p2: vec3, p3: vec3) -> bool:
    """Whether the origin and p3 are on the same side of the plane through the others."""
    n = wp.cross(p1 - p0, p2 - p0)
    one = wp.dot(n, p3 - p0)
    two = wp.dot(n, -p0)
    return (one > ZERO and two > ZERO) or (one < ZERO and two < ZERO)


@wp.func(inline=False)
def _volumes(v1: vec3, v2: vec3, v3: vec3, v4: vec3, v5: vec3) -> vec3:
    """Volumes beside the segment v1 v2 towards the edges of a triangle: of one sign where it goes through."""
    d = v2 - v1
    return vec3(
        wp.dot(v3 - v1, wp.cross(v4 - v1, d)),
        wp.dot(v4 - v1, wp.cross(v5 - v1, d)),
        wp.dot(v5 - v1, wp.cross(v3 - v1, d)),
    )


@wp.func(inline=False)
def _pierces(v: vec3) -> bool:
    return (v[0] >= ZERO and v[1] >= ZERO and v[2] >= ZERO) or (v[0] <= ZERO and v[1] <= ZERO and v[2] <= ZERO)


@wp.func(inline=False)
def _picked(w: wp.ref[World], n: int, v1: int, v2: int, v3: int) -> Simplex:
    """The simplex of two or three of the polytope's vertices."""
    s = Simplex()
    s.n = n
    v = vec3i(v1, v2, v3)
    for i in range(n):
        k = v[i]
        s.point[i] = w.epa_point[w.t, k]
        s.one[i] = w.epa_one[w.t, k]
        s.two[i] = w.epa_two[w.t, k]
        s.vertex1[i] = w.epa_vertex1[w.t, k]
        s.vertex2[i] = w.epa_vertex2[w.t, k]
    return s


@wp.func(inline=False)
def _list_all(w: wp.ref[World]):
    for i in range(w.epa_state[w.t, FACES]):
        _list(w, i)


@wp.func(inline=False)
def _around_segment(m: wp.ref[Tables], w: wp.ref[World], a: Shape, b: Shape, s: Simplex):
    """Build a polytope around two points: with three support points beside them."""
    _start(w)
    d = s.point[1] - s.point[0]
    i = int(0)
    if wp.abs(d[1]) < wp.abs(d[0]):
        i = 1
    if wp.abs(d[2]) < wp.abs(d[i]):
        i = 2
    e = vec3()
    e[i] = ONE
    d1 = wp.cross(e, d)
    u = d / wp.length(d)
    sine = f64(0.86602540378)
    turn = wp.outer(u, u) * f64(1.5) + mat33(
        -HALF, -u[2] * sine, u[1] * sine, u[2] * sine, -HALF, -u[0] * sine, -u[1] * sine, u[0] * sine, -HALF
    )
    d2 = turn * d1
    d3 = turn * d2
    _add_vertex(w, s, 0)
    _add_vertex(w, s, 1)
    _add_support(m, w, a, b, d1, wp.length(d1))
    _add_support(m, w, a, b, d2, wp.length(d2))
    _add_support(m, w, a, b, d3, wp.length(d3))
    total = vec3()
    for k in range(5):
        total += w.epa_point[w.t, k]
    w.epa_center[w.t, 0] = total * f64(0.2)
    out = s
    status = int(BUILT)
    faces = int(6)  # a variable: the loop is not unrolled
    for k in range(faces):
        f = vec3i(0, 2, 3)
        g = vec3i(1, 3, 2)
        if k == 1:
            f = vec3i(0, 4, 2)
            g = vec3i(2, 4, 0)
        elif k == 2:
            f = vec3i(0, 3, 4)
            g = vec3i(0, 5, 1)
        elif k == 3:
            f = vec3i(1, 3, 2)
            g = vec3i(5, 0, 4)
        elif k == 4:
            f = vec3i(1, 2, 4)
            g = vec3i(3, 1, 5)
        elif k == 5:
            f = vec3i(1, 4, 3)
            g = vec3i(4, 2, 3)
        if status == BUILT and _attach(w, f[0], f[1], f[2], g[0], g[1], g[2]) < MINVAL2:
            status = SMALLER
            out = _picked(w, 3, f[0], f[1], f[2])
    if status == BUILT:
        v = _volumes(
            w.epa_point[w.t, 0], w.epa_point[w.t, 1], w.epa_point[w.t, 2], w.epa_point[w.t, 3], w.epa_point[w.t, 4]
        )
        if not _pierces(v):
            status = FAILED
        else:
            _list_all(w)
    return status, out


@wp.func(inline=False)
def _on_face(a: vec3, b: vec3, c: vec3, p: vec3) -> bool:
    """Whether a point is in a triangle, to rounding."""
    area = areas(a, b, c, p)
    u = area / (area[0] + area[1] + area[2])
    near = wp.length(a * u[0] + b * u[1] + c * u[2] - p) < MINVAL
    return u[0] >= ZERO and u[1] >= ZERO and u[2] >= ZERO and near


@wp.func(inline=False)
def _hexahedron(v: vec3, k: vec5i):
    """The five vertices in an order in which they span a hexahedron; or 0 if four of them contain the fifth."""
    low = -MINVAL
    out = k
    whole = int(1)
    if v[0] > ZERO and v[1] < low and v[2] < low:
        out = vec5i(k[2], k[4], k[3], k[0], k[1])
    elif v[1] > ZERO and v[0] < low and v[2] < low:
        out = vec5i(k[0], k[4], k[3], k[1], k[2])
    elif v[2] > ZERO and v[0] < low and v[1] < low:
        out = vec5i(k[1], k[4], k[3], k[2], k[0])
    else:
        whole = 0
        if not (v[1] >= v[0] and v[2] >= v[0]):
            if v[0] >= v[1] and v[2] >= v[1]:
                out = vec5i(k[1], k[2], k[2], k[3], k[4])
            else:
                out = vec5i(k[2], k[0], k[2], k[3], k[4])
    return whole, out


@wp.func(inline=False)
def _origin_on(a: vec3, b: vec3) -> bool:
    """Whether the origin is on a segment, to rounding."""
    on = bool(False)
    if wp.dot(a, b) < ZERO:
        d = b - a
        dd = wp.dot(d, d)
        if dd >= MINVAL2:
            x = b + d * (-wp.dot(b, d) / dd)
            on = wp.dot(x, x) < MINVAL2
    return on


@wp.func(inline=False)
def _contains_origin(w: wp.ref[World], face: int, v: int, least: f64) -> bool:
    """Whether the origin is on the side of a face where vertex ``v`` is, or as good as on it."""
    c = w.epa_corners[w.t, face]
    inside = _same_side(w.epa_point[w.t, c[0]], w.epa_point[w.t, c[1]], w.epa_point[w.t, c[2]], w.epa_point[w.t, v])
    return inside or w.epa_dist[w.t, face] < least


@wp.func(inline=False)
def _around_triangle(
    m: wp.ref[Tables], w: wp.ref[World], a: Shape, b: Shape, s: Simplex, tolerance: f64, may_shrink: int
):
    """Build a polytope around three points: with the support points on both sides."""
    _start(w)
    n = wp.cross(s.point[1] - s.point[0], s.point[2] - s.point[0])
    length = wp.length(n)
    status = int(FAILED)
    out = s
    if length >= MINVAL:
        for i in range(s.n):
            _add_vertex(w, s, i)
        below = _add_support(m, w, a, b, -n, length)
        above = _add_support(m, w, a, b, n, length)
        v1 = w.epa_point[w.t, 0]
        v2 = w.epa_point[w.t, 1]
        v3 = w.epa_point[w.t, 2]
        v4 = w.epa_point[w.t, above]
        v5 = w.epa_point[w.t, below]
        thick = wp.dot(n, v4 - v1) >= MINVAL * length and wp.dot(-n, v5 - v1) >= MINVAL * length
        if thick and not _on_face(v1, v2, v3, v4) and not _on_face(v1, v2, v3, v5):
            k = vec5i(0, 1, 2, above, below)
            whole = int(1)
            v = _volumes(v4, v5, v1, v2, v3)
            if not _pierces(v):
                whole, k = _hexahedron(v, k)
            status = int(BUILT)
            total = w.epa_point[w.t, k[0]] + w.epa_point[w.t, k[1]] + w.epa_point[w.t, k[3]] + w.epa_point[w.t, k[4]]
            least = f64(FAR)
            if whole != 0:
                w.epa_center[w.t, 0] = (total + w.epa_point[w.t, k[2]]) * f64(0.2)
                least = wp.min(least, _attach(w, k[3], k[0], k[1], 1, 3, 2))
                least = wp.min(least, _attach(w, k[3], k[2], k[0], 2, 4, 0))
                least = wp.min(least, _attach(w, k[3], k[1], k[2], 0, 5, 1))
                least = wp.min(least, _attach(w, k[4], k[1], k[0], 5, 0, 4))
                least = wp.min(least, _attach(w, k[4], k[0], k[2], 3, 1, 5))
                least = wp.min(least, _attach(w, k[4], k[2], k[1], 4, 2, 3))
            else:
                w.epa_center[w.t, 0] = total * f64(0.25)
                least = wp.min(least, _attach(w, k[0], k[1], k[3], 1, 3, 2))
                least = wp.min(least, _attach(w, k[0], k[4], k[1], 2, 3, 0))
                least = wp.min(least, _attach(w, k[0], k[3], k[4], 0, 3, 1))
                least = wp.min(least, _attach(w, k[4], k[3], k[1], 2, 0, 1))
            if least < MINVAL2:
                status = FAILED
                if may_shrink != 0:
                    for i in range(s.n):
                        j = (i + 1) % 3
                        if status == FAILED and _origin_on(w.epa_point[w.t, i], w.epa_point[w.t, j]):
                            status = SMALLER
                            out = _picked(w, 2, i, j, j)
            else:
                t2 = tolerance * tolerance
                ok = bool(True)
                if whole != 0:
                    ok = (
                        _contains_origin(w, 0, k[2], t2)
                        and _contains_origin(w, 1, k[1], t2)
                        and _contains_origin(w, 2, k[0], t2)
                        and _contains_origin(w, 3, k[2], t2)
                        and _contains_origin(w, 4, k[1], t2)
                        and _contains_origin(w, 5, k[0], t2)
                    )
                else:
                    ok = (
                        _contains_origin(w, 0, k[4], t2)
                        and _contains_origin(w, 1, k[3], t2)
                        and _contains_origin(w, 2, k[1], t2)
                        and _contains_origin(w, 3, k[0], t2)
                    )
                if ok:
                    _list_all(w)
                else:
                    status = FAILED
    return status, out


@wp.func(inline=False)
def _around_tetrahedron(w: wp.ref[World], s: Simplex):
    """Take four points as a polytope, unless the origin is on one of its faces."""
    _start(w)
    for i in range(s.n):
        _add_vertex(w, s, i)
    w.epa_center[w.t, 0] = (s.point[0] + s.point[1] + s.point[2] + s.point[3]) * f64(0.25)
    status = int(BUILT)
    out = s
    faces = int(4)
    for k in range(faces):
        f = vec3i(0, 1, 2)
        g = vec3i(1, 3, 2)
        if k == 1:
            f = vec3i(0, 3, 1)
            g = vec3i(2, 3, 0)
        elif k == 2:
            f = vec3i(0, 2, 3)
            g = vec3i(0, 3, 1)
        elif k == 3:
            f = vec3i(3, 2, 1)
            g = vec3i(2, 0, 1)
        if status == BUILT:
            dist = _attach(w, f[0], f[1], f[2], g[0], g[1], g[2])
            if dist < MINVAL2:
                status = SMALLER
                out = _picked(w, 3, f[0], f[1], f[2])
    if status == BUILT:
        inside = (
            _same_side(s.point[0], s.point[1], s.point[2], s.point[3])
            and _same_side(s.point[1], s.point[2], s.point[3], s.point[0])
            and _same_side(s.point[2], s.point[3], s.point[0], s.point[1])
            and _same_side(s.point[3], s.point[0], s.point[1], s.point[2])
        )
        if inside:
            _list_all(w)
        else:
            status = FAILED
    return status, out


@wp.func(inline=False)
def _sees(w: wp.ref[World], face: int, p: vec3) -> bool:
    """Whether a point is beyond a face."""
    d2 = w.epa_dist[w.t, face]
    return wp.dot(w.epa_near[w.t, face], p) - d2 > wp.max(wp.sqrt(d2) * MINVAL, MINVAL)


@wp.func(inline=False)
def _horizon(w: wp.ref[World], face: int, p: vec3, capacity: int) -> bool:
    """Delete the faces that a point sees, from one on, and list the edges around them; False if they are too many."""
    _delete(w, face)
    w.epa_walk[w.t, 0] = vec3i(face, 2, 1)
    top = int(0)
    n = int(0)
    while top >= 0:
        frame = w.epa_walk[w.t, top]
        f = frame[0]
        step = frame[2]
        if step > wp.where(top == 0, 3, 2):
            top -= 1
        else:
            w.epa_walk[w.t, top] = vec3i(f, frame[1], step + 1)
            i = (frame[1] + step) % 3
            g = w.epa_beside[w.t, f][i]
            if w.epa_place[w.t, g] > GONE:
                corner = w.epa_corners[w.t, f][(i + 1) % 3]
                c = w.epa_corners[w.t, g]
                e = wp.where(c[0] == corner, 0, wp.where(c[1] == corner, 1, 2))
                if _sees(w, g, p):
                    _delete(w, g)
                    top += 1
                    w.epa_walk[w.t, top] = vec3i(g, e, 1)
                else:
                    if n >= capacity:
                        return False
                    w.epa_edge[w.t, n] = vec3i(g, e, 0)
                    n += 1
    w.epa_state[w.t, EDGES] = n
    return True


@wp.func(inline=False)
def _closest_face(w: wp.ref[World], previous: int):
    face = previous
    least = f64(FAR)
    for i in range(w.epa_state[w.t, LISTED]):
        f = w.epa_list[w.t, i]
        if w.epa_dist[w.t, f] < least:
            face = f
            least = w.epa_dist[w.t, f]
    return face, least


@wp.func(inline=False)
def _is_old(w: wp.ref[World], k: int) -> bool:
    """Whether a vertex of the polytope is one of those before it."""
    found = bool(False)
    for i in range(k):
        if w.epa_vertex1[w.t, i] == w.epa_vertex1[w.t, k] and w.epa_vertex2[w.t, i] == w.epa_vertex2[w.t, k]:
            found = True
    return found


@wp.func(inline=False)
def _grow(w: wp.ref[World], v: int, lower2: f64, upper2: f64) -> bool:
    """Attach a vertex to the horizon; False if one of its faces has no plane."""
    first = w.epa_state[w.t, FACES]
    n = w.epa_state[w.t, EDGES]
    for i in range(n):
        edge = w.epa_edge[w.t, i]
        g = edge[0]
        e = edge[1]
        c = w.epa_corners[w.t, g]
        beside = w.epa_beside[w.t, g]
        beside[e] = first + i
        w.epa_beside[w.t, g] = beside
        before = first + (i + n - 1) % n
        d2 = _attach(w, v, c[(e + 1) % 3], c[e], before, g, first + (i + 1) % n)
        if d2 == ZERO:
            return False
        if d2 >= lower2 and d2 <= upper2:
            _list(w, first + i)
    return True


@wp.func(inline=False)
def _expand(
    m: wp.ref[Tables], w: wp.ref[World], a: Shape, b: Shape, tolerance0: f64, iterations: int, faces: int
) -> int:
    """Expand the polytope and return the face that tells the depth, or −1."""
    discrete = is_discrete(a, b)
    tolerance = tolerance0
    if discrete:
        tolerance = MINVAL
    upper = f64(FAR)
    upper2 = f64(FAR)
    face = int(-1)
    k = int(0)
    going = bool(True)
    while going and k < wp.min(iterations, 1000):
        candidate, lower2 = _closest_face(w, face)
        if lower2 > upper2 or candidate < 0:
            return face
        face = candidate
        if lower2 <= ZERO:
            return face
        lower = wp.sqrt(lower2)
        near = w.epa_near[w.t, face]
        v = _add_support(m, w, a, b, near, lower)
        reach = wp.dot(near, w.epa_point[w.t, v]) / lower
        if reach < upper:
            upper = reach
            upper2 = reach * reach
        if reach - lower < tolerance:
            if k == 0 and lower - tolerance > upper:
                return -1
            return face
        if discrete and _is_old(w, v):
            return face
        if not _horizon(w, face, w.epa_point[w.t, v], wp.max(iterations, 35) - 11):
            return -1
        n = w.epa_state[w.t, EDGES]
        if n < 3:
            return -1
        if n > faces - w.epa_state[w.t, FACES]:
            return face
        if not _grow(w, v, lower2, upper2):
            return face
        if w.epa_state[w.t, LISTED] == 0:
            return face
        k += 1
    return face


@wp.func(inline=False)
def epa(
    m: wp.ref[Tables],
    w: wp.ref[World],
    a: Shape,
    b: Shape,
    s0: Simplex,
    place1: int,
    place2: int,
    tolerance: f64,
    iterations: int,
) -> Depth:
    """Depth of two shapes that overlap, from the simplex that GJK ended with."""
    out = Depth()
    w.epa_state[w.t, PLACE1] = place1
    w.epa_state[w.t, PLACE2] = place2
    s = s0
    status = int(SMALLER)
    may_shrink = int(1)
    tries = int(0)
    while status == SMALLER and tries < 4:
        tries += 1
        if s.n == 2:
            may_shrink = 0
            status, s = _around_segment(m, w, a, b, s)
        elif s.n == 3:
            status, s = _around_triangle(m, w, a, b, s, tolerance, may_shrink)
        else:
            status, s = _around_tetrahedron(w, s)
    if status == BUILT:
        face = _expand(m, w, a, b, tolerance, iterations, 6 * iterations)
        if face >= 0:
            c = w.epa_corners[w.t, face]
            f = _picked(w, 3, c[0], c[1], c[2])
            area = areas(f.point[0], f.point[1], f.point[2], w.epa_near[w.t, face])
            u = area / (area[0] + area[1] + area[2])
            out.found = 1
            out.dist = -wp.sqrt(w.epa_dist[w.t, face])
            out.x1 = f.one[0] * u[0] + f.one[1] * u[1] + f.one[2] * u[2]
            out.x2 = f.two[0] * u[0] + f.two[1] * u[1] + f.two[2] * u[2]
            out.simplex = f
    return out
