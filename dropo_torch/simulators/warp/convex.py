"""Distance of two convex shapes: support points, and Gilbert, Johnson and Keerthi's algorithm in MuJoCo's variant.

A shape is known by its support points alone. The steps are those of MuJoCo 4.0, in its order, so that rounding and
the end of the iteration are the same too; where they stop early, so do these. Nothing here is differentiated.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

from typing import Any

import warp as wp

from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, ZERO, Tables, f64, mat33, vec2, vec3, vec4

mat43: Any = wp.types.matrix((4, 3), wp.float64)

#: Kinds of shape, as MuJoCo numbers them.
SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
ELLIPSOID = wp.constant(4)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
MESH = wp.constant(7)

#: Of an infinite distance, and the square of mjMINVAL.
FAR = wp.constant(wp.float64(1.7976931348623157e308))
MINVAL2 = wp.constant(wp.float64(1.0e-30))


@wp.struct
class Shape:
    """A convex geom: its kind, pose and size, how far it is inflated, and where its hull's vertices are."""

    kind: wp.int32
    hull: wp.int32
    count: wp.int32
    climbs: wp.int32  # whether support points of the mesh are found along the hull's edges
    place: wp.int32  # where the last search among them ended
    inflation: wp.float64
    size: vec3
    pos: vec3
    rot: mat33


@wp.struct
class Simplex:
    """Up to four points of the Minkowski difference, those of the two shapes, and the shapes' vertices they are."""

    n: wp.int32
    point: mat43
    one: mat43
    two: mat43
    vertex1: wp.vec4i
    vertex2: wp.vec4i


@wp.struct
class Distance:
    """Outcome of GJK: whether a plane separates the shapes, how far they are, and the nearest points."""

    apart: wp.int32
    dist: wp.float64
    x1: vec3
    x2: vec3
    place1: wp.int32
    place2: wp.int32
    simplex: Simplex


@wp.func(inline=False)
def positive(x: f64) -> f64:
    """Sign of a number, that of zero being positive."""
    return wp.where(x >= ZERO, ONE, -ONE)


@wp.func(inline=False)
def hull_vertex(m: wp.ref[Tables], s: Shape, d: vec3) -> int:
    """Vertex of a hull that is furthest along ``d``, in the hull's frame."""
    best = s.place
    if s.climbs != 0:
        if best < 0:
            best = int(0)
        far = wp.dot(m.hull_vert[s.hull + best], d)
        last = int(-1)
        while best != last:
            last = best
            i = m.hull_edgeadr[s.hull + last]
            j = m.hull_edge[i]
            while j >= 0:
                x = wp.dot(m.hull_vert[s.hull + j], d)
                if x > far:
                    far = x
                    best = j
                i += 1
                j = m.hull_edge[i]
    else:
        far = -FAR
        kept = int(0)
        if best >= 0:
            far = wp.dot(m.hull_vert[s.hull + best], d)
            kept = 1
        for j in range(s.count):
            x = wp.dot(m.hull_vert[s.hull + j], d)
            first = best < 0 or m.hull_id[s.hull + j] < m.hull_id[s.hull + wp.max(best, 0)]
            if x > far or (x == far and kept == 0 and first):
                far = x
                best = j
                kept = 0
    return wp.max(best, 0)


@wp.func(inline=False)
def support(m: wp.ref[Tables], s: Shape, d: vec3):
    """Point of a shape that is furthest along ``d``, which vertex it is (−1: none), and where the search ended."""
    local = wp.transpose(s.rot) * d
    x = vec3()
    vertex = int(-1)
    place = int(-1)
    if s.kind == CAPSULE or s.kind == SPHERE:
        x = local * s.size[0]
        x[2] = x[2] + positive(local[2]) * s.size[1]
    elif s.kind == ELLIPSOID:
        y = wp.cw_mul(local, s.size)
        length = wp.length(y)
        x = vec3(s.size[0], ZERO, ZERO)
        if length >= MINVAL:
            x = wp.cw_mul(y * (ONE / length), s.size)
    elif s.kind == CYLINDER:
        radial = local[0] * local[0] + local[1] * local[1]
        if radial > MINVAL2:
            scale = s.size[0] / wp.sqrt(radial)
            x = vec3(local[0] * scale, local[1] * scale, ZERO)
        x[2] = positive(local[2]) * s.size[1]
        vertex = wp.where(local[2] >= ZERO, 0, 1)
    elif s.kind == BOX:
        x = vec3(
            positive(local[0]) * s.size[0],
            positive(local[1]) * s.size[1],
            positive(local[2]) * s.size[2],
        )
        vertex = wp.where(local[0] >= ZERO, 1, 0) + wp.where(local[1] >= ZERO, 2, 0) + wp.where(local[2] >= ZERO, 4, 0)
    elif s.kind == MESH:
        place = hull_vertex(m, s, local)
        vertex = place
        x = m.hull_vert[s.hull + place]
    return s.rot * x + s.pos + d * s.inflation, vertex, place


@wp.func(inline=False)
def is_discrete(a: Shape, b: Shape) -> bool:
    """Whether both shapes are polytopes."""
    return a.kind >= BOX and b.kind >= BOX and a.inflation == ZERO and b.inflation == ZERO


@wp.func(inline=False)
def project_on_plane(a: vec3, b: vec3, c: vec3):
    """The origin projected on the plane through three points, and whether there is one."""
    ba = b - a
    ca = c - a
    cb = c - b
    n = wp.cross(cb, ba)
    nv = wp.dot(n, b)
    nn = wp.dot(n, n)
    ok = nn != ZERO
    if ok and (nv == ZERO or nn <= MINVAL):
        n = wp.cross(ba, ca)
        nv = wp.dot(n, a)
        nn = wp.dot(n, n)
        ok = nn != ZERO
        if ok and (nv == ZERO or nn <= MINVAL):
            n = wp.cross(ca, cb)
            nv = wp.dot(n, c)
            nn = wp.dot(n, n)
            ok = nn != ZERO
    x = vec3()
    if ok:
        x = n * (nv / nn)
    return x, ok


@wp.func(inline=False)
def agree(a: f64, b: f64) -> bool:
    """Whether two numbers have the same sign, none being zero."""
    return (a > ZERO and b > ZERO) or (a < ZERO and b < ZERO)


@wp.func(inline=False)
def weights_on_line(a: vec3, b: vec3) -> vec2:
    """Weights of two points in the point of their segment that is closest to the origin."""
    d = b - a
    dd = wp.dot(d, d)
    w = vec2(ZERO, ONE)
    if dd >= MINVAL2:
        p = b + d * (-wp.dot(b, d) / dd)
        mu = a - b
        i = wp.where(wp.abs(mu[1]) >= wp.abs(mu[0]), 1, 0)
        if wp.abs(mu[2]) >= wp.abs(mu[i]):
            i = 2
        one = p[i] - b[i]
        two = a[i] - p[i]
        if agree(mu[i], one):
            w = vec2(ONE, ZERO)
            if agree(mu[i], two):
                w = vec2(one / mu[i], two / mu[i])
    return w


@wp.func(inline=False)
def areas(a: vec3, b: vec3, c: vec3, p: vec3) -> vec3:
    """Twice the areas of the three triangles of a, b, c with p, and the sign of all in the fourth: see the callers."""
    n = wp.cross(b - a, c - a)
    i = int(0)
    j = int(1)
    if wp.abs(n[0]) >= wp.abs(n[1]) and wp.abs(n[0]) >= wp.abs(n[2]):
        i = 1
        j = 2
    elif wp.abs(n[1]) >= wp.abs(n[2]):
        j = 2
    a -= p
    b -= p
    c -= p
    return vec3(b[i] * c[j] - c[i] * b[j], c[i] * a[j] - a[i] * c[j], a[i] * b[j] - b[i] * a[j])


@wp.func(inline=False)
def _sum3(w: vec3, a: vec3, b: vec3, c: vec3) -> vec3:
    return a * w[0] + b * w[1] + c * w[2]


@wp.func(inline=False)
def weights_on_triangle(a: vec3, b: vec3, c: vec3) -> vec3:
    """Weights of three points in the point of their triangle that is closest to the origin."""
    p, ok = project_on_plane(a, b, c)
    area = vec3()
    total = ZERO
    if ok:
        area = areas(a, b, c, p)
        n = wp.cross(b - a, c - a)
        total = n[2]
        if wp.abs(n[0]) >= wp.abs(n[1]) and wp.abs(n[0]) >= wp.abs(n[2]):
            total = n[0]
        elif wp.abs(n[1]) >= wp.abs(n[2]):
            total = -n[1]
    in1 = agree(total, area[0])
    in2 = agree(total, area[1])
    in3 = agree(total, area[2])
    w = vec3()
    if in1 and in2 and in3:
        w = area / (area[0] + area[1] + area[2])
    else:
        best = FAR
        if not in1:
            u = weights_on_line(b, c)
            w = vec3(ZERO, u[0], u[1])
            x = _sum3(w, a, b, c)
            best = wp.dot(x, x)
        if not in2:
            u = weights_on_line(a, c)
            v = vec3(u[0], ZERO, u[1])
            x = _sum3(v, a, b, c)
            if wp.dot(x, x) < best:
                best = wp.dot(x, x)
                w = v
        if not in3:
            u = weights_on_line(a, b)
            v = vec3(u[0], u[1], ZERO)
            x = _sum3(v, a, b, c)
            if wp.dot(x, x) < best:
                w = v
    return w


@wp.func(inline=False)
def _volume(a: vec3, b: vec3, c: vec3) -> f64:
    return wp.dot(a, wp.cross(b, c))


@wp.func(inline=False)
def weights_in_tetrahedron(s: mat43) -> vec4:
    """Weights of four points in the point of their tetrahedron that is closest to the origin."""
    v1 = -_volume(s[1], s[2], s[3])
    v2 = _volume(s[0], s[2], s[3])
    v3 = -_volume(s[0], s[1], s[3])
    v4 = _volume(s[0], s[1], s[2])
    total = v1 + v2 + v3 + v4
    w = vec4()
    if agree(total, v1) and agree(total, v2) and agree(total, v3) and agree(total, v4):
        w = vec4(v1, v2, v3, v4) / total
    else:
        best = FAR
        v = vec4(v1, v2, v3, v4)
        faces = int(4)  # a variable: the loop is not unrolled
        for k in range(faces):
            if not agree(total, v[k]):
                i = wp.where(k == 0, 1, 0)
                j = wp.where(k <= 1, 2, 1)
                h = wp.where(k == 3, 2, 3)
                u = weights_on_triangle(s[i], s[j], s[h])
                x = _sum3(u, s[i], s[j], s[h])
                if wp.dot(x, x) < best:
                    best = wp.dot(x, x)
                    w = vec4()
                    w[i] = u[0]
                    w[j] = u[1]
                    w[h] = u[2]
    return w


@wp.func(inline=False)
def simplex_weights(n: int, s: mat43) -> vec4:
    """Weights of the ``n`` points of a simplex in its point that is closest to the origin."""
    w = vec4(ONE, ZERO, ZERO, ZERO)
    if n == 2:
        u = weights_on_line(s[0], s[1])
        w = vec4(u[0], u[1], ZERO, ZERO)
    elif n == 3:
        v = weights_on_triangle(s[0], s[1], s[2])
        w = vec4(v[0], v[1], v[2], ZERO)
    elif n == 4:
        w = weights_in_tetrahedron(s)
    return w


@wp.func(inline=False)
def combine(n: int, w: vec4, s: mat43) -> vec3:
    """Weighted sum of the first ``n`` points."""
    x = s[0] * w[0]
    for i in range(1, 4):
        if i < n:
            x += s[i] * w[i]
    return x


@wp.func(inline=False)
def _next_point(n: int, w: vec4, s: mat43) -> vec3:
    """The point of a simplex that is closest to the origin, projected anew where it can be."""
    x = combine(n, w, s)
    if n == 3:
        y, ok = project_on_plane(s[0], s[1], s[2])
        if ok:
            x = y
    elif n == 2:
        d = s[1] - s[0]
        dd = wp.dot(d, d)
        if dd >= MINVAL2:
            x = s[1] + d * (-wp.dot(s[1], d) / dd)
    return x


@wp.func(inline=False)
def _kept(n: int, w: vec4, s: Simplex):
    """The points of a simplex with weights, their number, and their weights."""
    out = Simplex()
    v = vec4()
    k = int(0)
    for i in range(n):
        if w[i] != ZERO:
            out.point[k] = s.point[i]
            out.one[k] = s.one[i]
            out.two[k] = s.two[i]
            out.vertex1[k] = s.vertex1[i]
            out.vertex2[k] = s.vertex2[i]
            v[k] = w[i]
            k += 1
    out.n = k
    return out, v


@wp.func(inline=False)
def gjk(m: wp.ref[Tables], a0: Shape, b0: Shape, tolerance: f64, iterations: int, cutoff: f64) -> Distance:
    """Distance of two shapes up to a cutoff; with the cutoff zero only whether they overlap."""
    a = a0
    b = b0
    out = Distance()
    s = Simplex()
    w = vec4(ONE, ZERO, ZERO, ZERO)
    discrete = is_discrete(a, b)
    gap = HALF * tolerance * tolerance
    least = tolerance
    if discrete:
        gap = ZERO
    if discrete or cutoff > ZERO:
        least = MINVAL
    x = a.pos - b.pos
    norm = wp.length(x)
    if norm < MINVAL:
        x = vec3(ONE, ZERO, ZERO)
        norm = ONE
    k = int(0)
    going = bool(True)
    while going and k < iterations:
        d = x * (ONE / norm)
        p1, v1, place1 = support(m, a, -d)
        p2, v2, place2 = support(m, b, d)
        a.place = place1
        b.place = place2
        p = p1 - p2
        n = s.n
        s.point[n] = p
        s.one[n] = p1
        s.two[n] = p2
        s.vertex1[n] = v1
        s.vertex2[n] = v2
        along = wp.dot(x, p)
        if along > ZERO:
            out.apart = 1
            if cutoff == ZERO or along >= cutoff * norm:
                s.n = 0
                out.dist = FAR
                out.simplex = s
                return out
        if k > 0 and wp.dot(x, x - p) < gap:
            going = bool(False)
        else:
            w = simplex_weights(n + 1, s.point)
            s, w = _kept(n + 1, w, s)
            if s.n == 4:
                norm = wp.where(out.apart != 0, norm, ZERO)
                going = bool(False)
            elif s.n == 0:
                out.dist = FAR
                out.apart = 1
                out.simplex = s
                return out
            else:
                x = _next_point(s.n, w, s.point)
                last = norm
                norm = wp.length(x)
                if norm < wp.where(s.n == 1, MINVAL, least) or (k > 0 and wp.abs(norm - last) < MINVAL):
                    going = bool(False)
            if going:
                k += 1
    out.x1 = combine(s.n, w, s.one)
    out.x2 = combine(s.n, w, s.two)
    if s.n <= 3 and out.apart == 0 and norm >= MINVAL:
        d = x * (ONE / norm)
        p1, v1, place1 = support(m, a, -d)
        p2, v2, place2 = support(m, b, d)
        if wp.dot(x, p1 - p2) > ZERO:
            out.apart = 1
    out.dist = norm
    out.place1 = a.place
    out.place2 = b.place
    out.simplex = s
    return out
