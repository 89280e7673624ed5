"""Which vertices of a convex hull touch a plane, as MuJoCo 4 picks them; the tables are those of meshes.py."""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.types import Tables, f64, vec3, vec3i


@wp.func(inline=True)
def deepest(m: wp.ref[Tables], g: int, way: vec3) -> int:
    """The vertex of a mesh that is farthest along ``way``; which of several depends on how MuJoCo looks for it."""
    start = m.geom_hull[g]
    best = int(0)
    if m.geom_climbs[g] == 0:
        for v in range(1, m.geom_nhull[g]):
            more = wp.dot(way, m.hull_vert[start + v]) - wp.dot(way, m.hull_vert[start + best])
            if more > f64(0.0) or (more == f64(0.0) and m.hull_id[start + v] < m.hull_id[start + best]):
                best = v
    climbs = int(m.geom_climbs[g])
    while climbs != 0:
        climbs = int(0)
        e = int(m.hull_edgeadr[start + best])
        while m.hull_edge[e] >= 0:
            v = m.hull_edge[e]
            if wp.dot(way, m.hull_vert[start + v]) > wp.dot(way, m.hull_vert[start + best]):
                best = v
                climbs = int(1)
            e += 1
    return best


@wp.func(inline=True)
def lowest_face(m: wp.ref[Tables], v: int, normal: vec3) -> int:
    """The flat face at a vertex whose normal is most against ``normal``, −1 without one."""
    face = int(-1)
    least = f64(1.0)
    p = int(m.hull_polyadr[v])
    while m.hull_poly[p] >= 0:
        x = wp.dot(m.poly_normal[m.hull_poly[p]], normal)
        if x < least:
            least = x
            face = m.hull_poly[p]
        p += 1
    return face


@wp.func(inline=True)
def face_corners(m: wp.ref[Tables], start: int, face: int, vertex: int):
    """Where a vertex stands in a face, and by how much three others are after it that span much of its area.

    The corners turn about the face as calipers do, as long as that makes the quadrilateral larger.
    """
    first = m.poly_adr[face]
    count = m.poly_num[face]
    own = int(0)
    for i in range(count):
        if m.poly_vert[first + i] == vertex:
            own = i
    b = int(1)
    c = int(2)
    d = int(3)
    area = _area(m, start, face, own, b, c, d)
    turns = int(count)
    while turns > 4:
        turns -= 1
        most = f64(_area(m, start, face, own, b, c, d + 1))
        if area >= most:
            turns = int(0)
        else:
            d += 1
            grows = int(1)
            while grows != 0:
                x = _area(m, start, face, own, b, c + 1, d)
                grows = int(wp.where(x > most, 1, 0))
                if x > most:
                    most = x
                    c += 1
            grows = int(1)
            while grows != 0:
                x = _area(m, start, face, own, b + 1, c, d)
                grows = int(wp.where(x > most, 1, 0))
                if x > most:
                    most = x
                    b += 1
            area = most
    return own, vec3i(b, c, d)


@wp.func(inline=True)
def _area(m: wp.ref[Tables], start: int, face: int, own: int, b: int, c: int, d: int) -> f64:
    """Twice the area of a quadrilateral of corners of a face: its own, and others by how far they are after that."""
    first = m.poly_adr[face]
    n = m.poly_num[face]
    across = m.hull_vert[start + m.poly_vert[first + (own + c) % n]] - m.hull_vert[start + m.poly_vert[first + own]]
    beside = (
        m.hull_vert[start + m.poly_vert[first + (own + d) % n]]
        - m.hull_vert[start + m.poly_vert[first + (own + b) % n]]
    )
    return wp.length(wp.cross(across, beside))
