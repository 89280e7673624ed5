"""Where two boxes touch, as MuJoCo 4 finds it: the axis of largest separation, then a cut face or two edges.

If the axis is a face's normal, that box is the reference: the face of the other box that is turned most against it
is cut by the four sides of the reference face, and every corner of what remains is a contact. Otherwise the contact
is where two edges pass each other closest. A code names what a contact is made of (the corner of a face, the place
where an edge passes a side, a corner of the reference face over the other face, two edges), so that its geometry is a
smooth function of the two poses.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

from typing import Any

import warp as wp

from dropo_torch.simulators.warp.collide import pair7, vec7
from dropo_torch.simulators.warp.spatial import join
from dropo_torch.simulators.warp.types import HALF, MINVAL, ONE, ZERO, f64, mat33, vec3, vec4, vec6

#: Corners of a face that was cut: in the plane of the reference face, and above it.
Corners: Any = wp.types.matrix((8, 3), wp.float64)
#: What each of them is made of, or which line leaves it.
Labels: Any = wp.types.vector(8, wp.int32)
#: Distance and point of each contact.
Spots: Any = wp.types.matrix((8, 4), wp.float64)
MOST = wp.constant(8)

#: Rounding error of a separation, relative to the boxes' sizes.
SEPARATION = wp.constant(wp.float64(1.0e-13))
#: Squared sine of the angle below which edges are parallel.
PARALLEL_EDGES = wp.constant(wp.float64(1.0e-16))
#: Component of the axis below which either of two edges supports it.
AMBIGUOUS = wp.constant(wp.float64(1.0e-9))
#: Squared distance, relative to the reference face, below which two corners are one.
SAME_CORNER = wp.constant(wp.float64(1.0e-14))
#: By how much edges must be better than a face: in general, and where the axis almost is the face's normal.
EDGE_BIAS = wp.constant(wp.float64(1.0e-6))
NEAR_FACE = wp.constant(wp.float64(0.05))
NEAR_NORMAL = wp.constant(wp.float64(0.99))

#: Axes: 0 to 2 the first box's faces, 3 to 5 the second's, from here on edge i of the first with edge j of the second.
EDGES = wp.constant(6)
#: Labels of a corner: 0 to 3 of the incident face, then its edge e with side s (4 + 4 e + s), then corners of the
#: reference face.
CROSSING = wp.constant(4)
REFERENCE_CORNER = wp.constant(20)
#: In the code of a contact the label of its corner stands above the two faces; codes of edges start from there.
FACE_LABEL = wp.constant(128)
EDGE_CODE = wp.constant(4096)


@wp.func(inline=False)
def unit(i: int) -> vec3:
    """Unit vector along axis ``i``."""
    e = vec3()
    e[i] = ONE
    return e


@wp.func(inline=False)
def signed(code: int, bit: int) -> f64:
    """+1 where a bit of a code is set, −1 where it is not."""
    return f64(2 * ((code >> bit) & 1) - 1)


@wp.func(inline=False)
def _edge_axis(rot: mat33, i: int, j: int) -> vec3:
    """Cross product of axis ``i`` of the first box with axis ``j`` of the second, in the first one's frame."""
    return wp.cross(unit(i), rot * unit(j))


@wp.func(inline=False)
def _reach(rot: mat33, size: vec3) -> vec3:
    """How far a box reaches along the axes of a frame; ``rot`` has its own axes there."""
    return wp.abs(rot[:, 0]) * size[0] + wp.abs(rot[:, 1]) * size[1] + wp.abs(rot[:, 2]) * size[2]


@wp.func(inline=False)
def best_axis(rot: mat33, x21: vec3, x12: vec3, size1: vec3, size2: vec3, margin: f64) -> int:
    """The axis of largest separation, −1 where the boxes are apart by more than the margin.

    ``rot`` has the second box's axes in the frame of the first as columns, x21 and x12 are the centers in the other's
    frame. Edges have to be better than faces, which give more contacts.
    """
    most = margin + SEPARATION * (wp.dot(size1, vec3(ONE, ONE, ONE)) + wp.dot(size2, vec3(ONE, ONE, ONE)))
    back = wp.transpose(rot)
    sep1 = wp.abs(x21) - size1 - _reach(rot, size2)
    sep2 = wp.abs(x12) - size2 - _reach(back, size1)
    if wp.max(wp.max(sep1), wp.max(sep2)) > most:
        return -1
    face = int(0)
    best_face = sep1[0]
    for i in range(1, 6):
        sep = wp.where(i < 3, sep1[i % 3], sep2[i % 3])
        if sep > best_face:
            best_face = sep
            face = i
    code = face
    best = best_face
    for k in range(9):
        i = k // 3
        axis = _edge_axis(rot, i, k % 3)
        norm2 = wp.length_sq(axis)
        if norm2 >= PARALLEL_EDGES:
            axis = axis * (ONE / wp.sqrt(norm2))
            radius = wp.dot(size1, wp.abs(axis)) + wp.dot(size2, wp.abs(back * axis))
            sep = wp.abs(wp.dot(axis, x21)) - radius
            if sep > most:
                return -1
            if sep - EDGE_BIAS * wp.abs(sep) > best and sep > best_face:
                best = sep
                code = EDGES + k
    if code >= EDGES:
        axis = wp.normalize(_edge_axis(rot, (code - EDGES) // 3, (code - EDGES) % 3))
        along = wp.where(face < 3, axis, back * axis)
        if wp.abs(along[face % 3]) > NEAR_NORMAL and best < best_face + NEAR_FACE * wp.abs(best_face) + MINVAL:
            code = face
    return code


@wp.func(inline=False)
def _cut_label(line: int, side: int) -> int:
    """Label of the corner where ``side`` cuts a line: an edge of the incident face (0 to 3) or a side (4 + side)."""
    label = CROSSING + 4 * line + side
    if line >= 4:
        x = wp.where(side < 2, side, line - 4)
        y = wp.where(side < 2, line - 4, side)
        label = REFERENCE_CORNER + 2 * (x & 1) + (y & 1)
    return label


@wp.func(inline=False)
def cut(corners: Corners, labels: Labels, lines: Labels, count: int, side: int, limit: f64):
    """Cut a polygon by a side of the reference face: 0, 1 the upper and lower along x, 2, 3 along y.

    ``lines`` says which line leaves each corner: an edge of the incident face or, plus four, a side.
    """
    new = Corners()
    new_labels = Labels()
    new_lines = Labels()
    n = int(0)
    c = side // 2
    sign = f64(1 - 2 * (side % 2))
    for k in range(count):
        q = int(wp.where(k + 1 == count, 0, k + 1))
        dp = sign * corners[k, c] - limit
        dq = sign * corners[q, c] - limit
        if dp <= ZERO and n < MOST:
            new[n] = corners[k]
            new_labels[n] = labels[k]
            new_lines[n] = wp.where(dp == ZERO and dq > ZERO, 4 + side, lines[k])
            n += 1
        if dp * dq < ZERO and n < MOST:
            new[n] = corners[k] + (corners[q] - corners[k]) * (dp / (dp - dq))
            new_labels[n] = _cut_label(lines[k], side)
            new_lines[n] = wp.where(dq > ZERO, 4 + side, lines[k])
            n += 1
    return new, new_labels, new_lines, n


@wp.func(inline=False)
def face_base(axis: int, rot: mat33, x: vec3) -> int:
    """Code of a face contact without its corner: the reference face and the incident one, each an axis and a sign.

    ``rot`` has the axes of the incident box in the reference box's frame, ``x`` its center.
    """
    a = axis % 3
    up = wp.where(x[a] >= ZERO, 1, 0)
    b = int(0)
    for k in range(1, 3):
        if wp.abs(rot[a, k]) > wp.abs(rot[a, b]):
            b = k
    against = wp.where(rot[a, b] * f64(2 * up - 1) > ZERO, 0, 1)
    return a + 4 * up + 8 * b + 32 * against + 64 * (axis // 3)


@wp.func(inline=False)
def is_second(code: int) -> int:
    """1 if the reference face is the second box's."""
    return wp.where(code < EDGE_CODE, (code >> 6) & 1, 0)


@wp.func(inline=False)
def _face_corner(rot: mat33, x: vec3, size: vec3, code: int, k: int) -> vec3:
    """Corner ``k`` of the incident face, in the reference frame."""
    b = (code >> 3) & 3
    u = (b + 1) % 3
    v = (b + 2) % 3
    local = vec3()
    local[b] = signed(code, 5) * size[b]
    local[u] = wp.where(k == 0 or k == 3, size[u], -size[u])
    local[v] = wp.where(k < 2, size[v], -size[v])
    return x + rot * local


@wp.func(inline=False)
def cut_face(rot: mat33, x: vec3, size: vec3, inc_size: vec3, base: int, margin: f64):
    """What of the incident face is over the reference face: its distinct corners, their labels, and how many."""
    a = base & 3
    up = signed(base, 2)
    ax = (a + 1) % 3
    ay = (a + 2) % 3
    corners = Corners()
    labels = Labels()
    lines = Labels()
    for k in range(4):
        p = _face_corner(rot, x, inc_size, base, k)
        corners[k] = vec3(p[ax], p[ay], up * p[a] - size[a])
        labels[k] = k
        lines[k] = k
    n = int(4)
    for side in range(4):
        corners, labels, lines, n = cut(corners, labels, lines, n, side, wp.where(side < 2, size[ax], size[ay]))
    near = SAME_CORNER * (size[ax] * size[ax] + size[ay] * size[ay])
    kept = int(0)
    for k in range(n):
        same = int(wp.where(corners[k, 2] > margin, 1, 0))
        for q in range(kept):
            dx = corners[q, 0] - corners[k, 0]
            dy = corners[q, 1] - corners[k, 1]
            if dx * dx + dy * dy < near:
                same = 1
        if same == 0:
            corners[kept] = corners[k]
            labels[kept] = labels[k]
            kept += 1
    return corners, labels, kept


@wp.func(inline=False)
def face_contact(c1: vec3, r1: mat33, size1: vec3, c2: vec3, r2: mat33, size2: vec3, code: int) -> vec7:
    """A contact of a reference face (of the first box here) and an incident one; the normal leaves the reference."""
    a = code & 3
    ea = unit(a)
    ex = unit((a + 1) % 3)
    ey = unit((a + 2) % 3)
    up = signed(code, 2)
    back = wp.transpose(r1)
    rot = back * r2
    x = back * (c2 - c1)
    label = code // FACE_LABEL
    p = vec3()
    if label < CROSSING:
        p = _face_corner(rot, x, size2, code, label)
    elif label < REFERENCE_CORNER:
        e = (label - CROSSING) // 4
        side = (label - CROSSING) % 4
        start = _face_corner(rot, x, size2, code, e)
        way = _face_corner(rot, x, size2, code, (e + 1) % 4) - start
        along = wp.where(side < 2, ex, ey)
        limit = wp.dot(along, size1) * f64(1 - 2 * (side % 2))
        p = start + way * ((limit - wp.dot(along, start)) / wp.dot(along, way))
    else:
        # over a corner of the reference face, on the plane of the incident one
        eb = unit((code >> 3) & 3)
        m = rot * eb
        from_face = x + m * (signed(code, 5) * wp.dot(eb, size2))
        flat = -ex * (signed(label - REFERENCE_CORNER, 1) * wp.dot(ex, size1))
        flat = flat - ey * (signed(label - REFERENCE_CORNER, 0) * wp.dot(ey, size1))
        p = flat + ea * (wp.dot(m, from_face - flat) / wp.dot(m, ea))
    d = up * wp.dot(ea, p) - wp.dot(ea, size1)
    q = c1 + r1 * (p - ea * (up * HALF * d))
    n = r1 * ea * up
    return vec7(d, q[0], q[1], q[2], n[0], n[1], n[2])


@wp.func(inline=False)
def _edge_middle(size: vec3, i: int, code: int) -> vec3:
    """Middle of an edge along ``i``; the two bits of the code are its signs along the next two axes."""
    u = (i + 1) % 3
    v = (i + 2) % 3
    p = vec3()
    p[u] = signed(code, 0) * size[u]
    p[v] = signed(code, 1) * size[v]
    return p


@wp.func(inline=False)
def edge_witnesses(c1: vec3, r1: mat33, size1: vec3, c2: vec3, r2: mat33, size2: vec3, code: int) -> vec6:
    """Closest points of an edge of each box, one after the other."""
    i = (code >> 5) & 3
    j = (code >> 7) & 3
    d1 = r1 * unit(i)
    d2 = r2 * unit(j)
    x1 = c1 + r1 * _edge_middle(size1, i, code)
    x2 = c2 + r2 * _edge_middle(size2, j, code >> 2)
    e = x2 - x1
    b = wp.dot(d1, d2)
    e1 = wp.dot(d1, e)
    e2 = wp.dot(d2, e)
    h1 = wp.dot(unit(i), size1)
    h2 = wp.dot(unit(j), size2)
    s = ZERO
    if ONE - b * b >= MINVAL:
        s = wp.clamp((e1 - b * e2) / (ONE - b * b), -h1, h1)
    t = wp.clamp(b * s - e2, -h2, h2)
    s = wp.clamp(e1 + b * t, -h1, h1)
    return join(x1 + d1 * s, x2 + d2 * t)


@wp.func(inline=False)
def edge_contact(c1: vec3, r1: mat33, size1: vec3, c2: vec3, r2: mat33, size2: vec3, code: int) -> vec7:
    """Where two edges pass each other closest, half-way between them."""
    n = wp.normalize(wp.cross(r1 * unit((code >> 5) & 3), r2 * unit((code >> 7) & 3))) * signed(code, 4)
    both = edge_witnesses(c1, r1, size1, c2, r2, size2, code)
    w1 = wp.spatial_top(both)
    w2 = wp.spatial_bottom(both)
    q = (w1 + w2) * HALF
    return vec7(wp.dot(n, w2 - w1), q[0], q[1], q[2], n[0], n[1], n[2])


@wp.func(inline=False)
def edge_code(c1: vec3, r1: mat33, size1: vec3, c2: vec3, r2: mat33, size2: vec3, axis: int) -> int:
    """Code of the edges that the boxes touch with, given the axis."""
    i = (axis - EDGES) // 3
    j = (axis - EDGES) % 3
    n = wp.normalize(wp.cross(r1 * unit(i), r2 * unit(j)))
    up = wp.where(wp.dot(n, c2 - c1) < ZERO, 0, 1)
    n = n * f64(2 * up - 1)
    n1 = wp.transpose(r1) * n
    n2 = wp.transpose(r2) * n
    base = EDGE_CODE + 16 * up + 32 * i + 128 * j
    flips = int(0)  # bits of the code where either sign may be right
    for k in range(2):
        u = (i + 1 + k) % 3
        v = (j + 1 + k) % 3
        base += wp.where(n1[u] >= ZERO, 1 << k, 0) + wp.where(n2[v] >= ZERO, 0, 4 << k)
        if wp.abs(n1[u]) < AMBIGUOUS and flips % 4 == 0:
            flips += 1 << k
        if wp.abs(n2[v]) < AMBIGUOUS and flips < 4:
            flips += 4 << k
    code = base
    best = f64(wp.inf)
    for flip in range(16):
        if (flip & flips) == flip:
            both = edge_witnesses(c1, r1, size1, c2, r2, size2, base ^ flip)
            gap = wp.length_sq(wp.spatial_top(both) - wp.spatial_bottom(both))
            if gap < best:
                best = gap
                code = base ^ flip
    return code


@wp.func(inline=False)
def box_contact(c1: vec3, r1: mat33, size1: vec3, c2: vec3, r2: mat33, size2: vec3, code: int) -> vec7:
    """The contact that a code names; the reference box, where there is one, stands first."""
    if code < EDGE_CODE:
        return face_contact(c1, r1, size1, c2, r2, size2, code)
    return edge_contact(c1, r1, size1, c2, r2, size2, code)


@wp.func(inline=False)
def box_spots(c1: vec3, r1: mat33, size1: vec3, c2: vec3, r2: mat33, size2: vec3, margin: f64):
    """Contacts of two boxes: (distance, point) of each, their codes, their normal, and how many."""
    back = wp.transpose(r1)
    rot = back * r2
    x = back * (c2 - c1)
    axis = best_axis(rot, x, wp.transpose(r2) * (c1 - c2), size1, size2, margin)
    spots = Spots()
    codes = Labels()
    normal = vec3()
    n = int(0)
    if axis >= EDGES:
        code = edge_code(c1, r1, size1, c2, r2, size2, axis)
        y = edge_contact(c1, r1, size1, c2, r2, size2, code)
        spots[0] = vec4(y[0], y[1], y[2], y[3])
        codes[0] = code
        normal = y[4:7]
        n = 1
    elif axis >= 0:
        a = axis % 3
        c = c1
        r = r1
        size = size1
        other = size2
        if axis >= 3:
            c = c2
            r = r2
            size = size2
            other = size1
            rot = wp.transpose(rot)
            x = -(rot * x)
        base = face_base(axis, rot, x)
        up = signed(base, 2)
        corners, labels, n = cut_face(rot, x, size, other, base, margin)
        for k in range(n):
            p = vec3()
            p[a] = up * (size[a] + HALF * corners[k, 2])
            p[(a + 1) % 3] = corners[k, 0]
            p[(a + 2) % 3] = corners[k, 1]
            p = c + r * p
            spots[k] = vec4(corners[k, 2], p[0], p[1], p[2])
            codes[k] = base + FACE_LABEL * labels[k]
        normal = r * unit(a) * wp.where(axis >= 3, -up, up)
    return spots, codes, normal, n


@wp.func(inline=False)
def box_dual(
    c1: vec3, r1: mat33, size1: vec3, c2: vec3, r2: mat33, size2: vec3, code: int, dbar: f64, pbar: vec3, nbar: vec3
) -> f64:
    """Leaf: the adjoint of :func:`box_contact` is its gradient."""
    return pair7(box_contact(c1, r1, size1, c2, r2, size2, code), dbar, pbar, nbar)
