"""Contacts: finding them, their Jacobians, the friction cone's force, and the adjoint of all three."""

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.collide import (
    PLANE_BOX,
    PLANE_CAPSULE,
    PLANE_CYLINDER,
    PLANE_ELLIPSOID,
    PLANE_SPHERE,
    ROUND,
    SPHERE_BOX,
    box_closest,
    closest,
    column,
    corner,
    cylinder_point,
    ellipsoid_point,
    plane_point,
    round_contact,
    vec7,
)
from dropo_torch.simulators.warp.cone import normal_d
from dropo_torch.simulators.warp.impedance import damping, impedance, regularisation, stiffness
from dropo_torch.simulators.warp.rows import theta_vec2, theta_vec5
from dropo_torch.simulators.warp.spatial import ang, at, join
from dropo_torch.simulators.warp.types import (
    HALF,
    MINVAL,
    ONE,
    ZERO,
    Reals,
    Reals2,
    Scratch,
    Tables,
    f64,
    mat33,
    vec3,
    vec6,
)


@wp.func
def geom_centre(m: Tables, s: Scratch, t: int, g: int) -> vec3:
    """Centre of a geom, from the origin of the sweep."""
    b = m.geom_body[g]
    return s.xpos[t, b] + s.xmat[t, b] * m.geom_pos[g]


@wp.func
def geom_rotation(m: Tables, s: Scratch, t: int, g: int) -> mat33:
    """Rotation of a geom."""
    return s.xmat[t, m.geom_body[g]] * m.geom_mat[g]


@wp.func
def geom_axis(m: Tables, s: Scratch, t: int, g: int) -> vec3:
    """Third axis of a geom: a plane's normal, the axis of a capsule."""
    return s.xmat[t, m.geom_body[g]] * column(m.geom_mat[g], 2)


@wp.func
def _add(s: Scratch, t: int, n: int, k: int, which: int, x: vec7, margin: f64, hint: vec3) -> int:
    """Append a contact if it is closer than its margin; the number of contacts."""
    if x[0] >= margin:
        return n
    s.con_pair[t, n] = k
    s.con_which[t, n] = which
    s.con_dist[t, n] = x[0]
    s.con_point[t, n] = vec3(x[1], x[2], x[3])
    normal = vec3(x[4], x[5], x[6])
    y = hint
    if wp.dot(hint, hint) < f64(0.25):
        y = vec3(ZERO, ONE, ZERO)
        if normal[1] >= HALF or normal[1] <= -HALF:
            y = vec3(ZERO, ZERO, ONE)
    s.con_hint[t, n] = y
    y = y - normal * wp.dot(normal, y)
    length = wp.length(y)
    t1 = vec3(ONE, ZERO, ZERO)
    if length > MINVAL:
        t1 = y / length
    t2 = wp.cross(normal, t1)
    s.con_frame[t, n] = mat33(
        normal[0], normal[1], normal[2], t1[0], t1[1], t1[2], t2[0], t2[1], t2[2]
    )
    return n + 1


@wp.func
def find_contacts(m: Tables, s: Scratch, t: int, th: Reals) -> int:
    """List the contacts of a configuration and return their number."""
    n = int(0)
    none = vec3()
    for k in range(m.npair):
        kind = m.pair_kind[k]
        g1 = m.pair_geom1[k]
        g2 = m.pair_geom2[k]
        margin = th[m.o_pair_margin + k]
        c1 = geom_centre(m, s, t, g1)
        c2 = geom_centre(m, s, t, g2)
        size = m.geom_size[g2]
        if kind <= PLANE_ELLIPSOID:
            normal = geom_axis(m, s, t, g1)
            if wp.dot(normal, c2 - c1) < margin + m.pair_bound[k]:
                if kind == PLANE_SPHERE:
                    n = _add(s, t, n, k, 0, plane_point(normal, c1, c2, size[0]), margin, none)
                elif kind == PLANE_CAPSULE:
                    axis = geom_axis(m, s, t, g2)
                    x = plane_point(normal, c1, c2 + axis * size[1], size[0])
                    n = _add(s, t, n, k, 0, x, margin, axis)
                    x = plane_point(normal, c1, c2 - axis * size[1], size[0])
                    n = _add(s, t, n, k, 1, x, margin, axis)
                elif kind == PLANE_BOX:
                    n = _plane_box(m, s, t, n, k, normal, c1, c2, margin)
                elif kind == PLANE_CYLINDER:
                    n = _plane_cylinder(m, s, t, n, k, normal, c1, c2, margin)
                else:
                    x3 = ellipsoid_point(normal, c2, geom_rotation(m, s, t, g2), size)
                    n = _add(s, t, n, k, 0, plane_point(normal, c1, x3, ZERO), margin, none)
        elif wp.length_sq(c2 - c1) < (margin + m.pair_bound[k]) * (margin + m.pair_bound[k]):
            if kind == SPHERE_BOX:
                x = box_closest(c2, geom_rotation(m, s, t, g2), size, c1, m.geom_size[g1][0])
                n = _add(s, t, n, k, 0, x, margin, none)
            else:
                n = _round(m, s, t, n, k, c1, c2, margin)
    return n


@wp.func
def _plane_box(
    m: Tables, s: Scratch, t: int, n: int, k: int, normal: vec3, c1: vec3, c2: vec3, margin: f64
) -> int:
    """The first four corners on the plane's side of the centre."""
    g2 = m.pair_geom2[k]
    rot = geom_rotation(m, s, t, g2)
    start = n
    for i in range(8):
        x = rot * corner(i, m.geom_size[g2])
        if wp.dot(normal, x) <= ZERO and n - start < 4:
            n = _add(s, t, n, k, i, plane_point(normal, c1, c2 + x, ZERO), margin, vec3())
    return n


@wp.func
def _plane_cylinder(
    m: Tables, s: Scratch, t: int, n: int, k: int, normal: vec3, c1: vec3, c2: vec3, margin: f64
) -> int:
    """The near rim, then the far rim and two points of the near disk."""
    g2 = m.pair_geom2[k]
    rot = geom_rotation(m, s, t, g2)
    start = n
    for i in range(4):
        if i == 0 or n > start:
            x = cylinder_point(normal, c2, rot, m.geom_size[g2], i)
            n = _add(s, t, n, k, i, plane_point(normal, c1, x, ZERO), margin, vec3())
    return n


@wp.func
def half_axis(m: Tables, s: Scratch, t: int, g: int) -> vec3:
    """Half-axis of a capsule, zero for a sphere (whose second size is zero)."""
    return geom_axis(m, s, t, g) * m.geom_size[g][1]


@wp.func
def _round(m: Tables, s: Scratch, t: int, n: int, k: int, c1: vec3, c2: vec3, margin: f64) -> int:
    """Spheres and capsules: one contact, or up to two when capsules are parallel."""
    g1 = m.pair_geom1[k]
    g2 = m.pair_geom2[k]
    a1 = half_axis(m, s, t, g1)
    a2 = half_axis(m, s, t, g2)
    r1 = m.geom_size[g1][0]
    r2 = m.geom_size[g2][0]
    ma = wp.dot(a1, a1)
    mc = wp.dot(a2, a2)
    mb = wp.dot(a1, a2)
    start = n
    if ma > ZERO and mc > ZERO and wp.abs(ma * mc - mb * mb) < MINVAL:
        for i in range(1, 5):
            if n - start < 2:
                n = _add(s, t, n, k, i, round_contact(c1, a1, r1, c2, a2, r2, i), margin, vec3())
    else:
        n = _add(s, t, n, k, 0, round_contact(c1, a1, r1, c2, a2, r2, 0), margin, vec3())
    return n


@wp.func
def in_frame(frame: mat33, x: vec6, p: vec3) -> vec6:
    """The motion ``x`` at ``p`` along the contact's axes, then its rotation about them."""
    v = frame * at(x, p)
    w = frame * ang(x)
    return vec6(v[0], v[1], v[2], w[0], w[1], w[2])


@wp.func
def _chain(m: Tables, s: Scratch, t: int, c: int, b: int, sign: f64):
    """Add the columns of a body's dofs to the Jacobian of contact ``c``."""
    frame = s.con_frame[t, c]
    p = s.con_point[t, c]
    i = m.body_lastdof[b]
    while i >= 0:
        s.con_jac[t, c * m.nv + i] = s.con_jac[t, c * m.nv + i] + in_frame(frame, s.motion[t, i], p) * sign
        i = m.dof_parent[0, i]


@wp.func
def fills_in(m: Tables, s: Scratch, t: int, ncon: int) -> int:
    """1 if H has entries beyond the tree's, because a contact joins two branches."""
    dense = m.always_dense
    for c in range(ncon):
        if m.pair_dense[s.con_pair[t, c]] != 0:
            dense = 1
    return dense


@wp.func
def make_contacts(m: Tables, s: Scratch, t: int, th: Reals, ncon: int):
    """Jacobian, reference acceleration and D of each contact."""
    for c in range(ncon):
        k = s.con_pair[t, c]
        b1 = m.pair_body1[k]
        b2 = m.pair_body2[k]
        for i in range(m.nv):
            s.con_jac[t, c * m.nv + i] = vec6()
        _chain(m, s, t, c, b1, -ONE)
        _chain(m, s, t, c, b2, ONE)
        p = s.con_point[t, c]
        v = in_frame(s.con_frame[t, c], s.velocity[t, b2] - s.velocity[t, b1], p)
        solref = theta_vec2(th, m.o_pair_solref + 2 * k)
        friction_ref = theta_vec2(th, m.o_pair_solreffriction + 2 * k)
        solimp = theta_vec5(th, m.o_pair_solimp + 5 * k)
        x = s.con_dist[t, c] - th[m.o_pair_margin + k]
        imp = impedance(x, solimp)
        b = damping(solref, solimp, m.h, m.refsafe)
        bf = b
        if m.elliptic != 0 and (friction_ref[0] != ZERO or friction_ref[1] != ZERO):
            bf = damping(friction_ref, solimp, m.h, m.refsafe)
        aref = v * -bf
        aref[0] = -b * v[0] - stiffness(solref, solimp, m.h, m.refsafe) * imp * x
        s.con_aref[t, c] = aref
        mu = th[m.o_pair_friction + 5 * k]
        s.con_d[t, c] = normal_d(
            m.pair_dim[k], m.elliptic, regularisation(imp, ONE), th[m.o_pair_invweight + k], mu, m.impratio
        )

