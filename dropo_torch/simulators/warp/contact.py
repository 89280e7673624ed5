"""Contacts: finding them, their Jacobians, the friction cone's force, and the adjoint of all three."""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.collide import (
    CAPSULE_BOX,
    PLANE_BOX,
    PLANE_CAPSULE,
    PLANE_CYLINDER,
    PLANE_ELLIPSOID,
    PLANE_SPHERE,
    ROUND,
    SPHERE_BOX,
    are_parallel,
    box_closest,
    capsule_box_codes,
    capsule_box_contact,
    column,
    corner,
    cylinder_point,
    ellipsoid_point,
    overlap_end,
    plane_point,
    round_contact,
    vec7,
)
from dropo_torch.simulators.warp.cone import normal_d
from dropo_torch.simulators.warp.impedance import damping, impedance_slope, regularisation, stiffness
from dropo_torch.simulators.warp.rows import theta_vec2, theta_vec5
from dropo_torch.simulators.warp.spatial import ang, at
from dropo_torch.simulators.warp.types import (
    HALF,
    MINVAL,
    ONE,
    ZERO,
    Tables,
    World,
    f64,
    mat33,
    vec3,
    vec6,
)


@wp.func(inline=True)
def geom_centre(m: Tables, w: World, g: int) -> vec3:
    """Centre of a geom, from the origin of the sweep."""
    b = m.geom_body[g]
    return w.xpos[w.t, b] + w.xmat[w.t, b] * m.geom_pos[g]


@wp.func(inline=True)
def geom_rotation(m: Tables, w: World, g: int) -> mat33:
    """Rotation of a geom."""
    return w.xmat[w.t, m.geom_body[g]] * m.geom_mat[g]


@wp.func(inline=True)
def geom_axis(m: Tables, w: World, g: int) -> vec3:
    """Third axis of a geom: a plane's normal, the axis of a capsule."""
    return w.xmat[w.t, m.geom_body[g]] * column(m.geom_mat[g], 2)


@wp.func(inline=True)
def _add(w: World, n: int, k: int, which: int, x: vec7, hint: vec3):
    """Write contact ``n`` with its frame; the first tangent is along the hint, or along y or z without one."""
    w.con_pair[w.t, n] = k
    w.con_which[w.t, n] = which
    w.con_dist[w.t, n] = x[0]
    w.con_point[w.t, n] = vec3(x[1], x[2], x[3])
    normal = vec3(x[4], x[5], x[6])
    y = hint
    if wp.dot(hint, hint) < f64(0.25):
        y = vec3(ZERO, ONE, ZERO)
        if normal[1] >= HALF or normal[1] <= -HALF:
            y = vec3(ZERO, ZERO, ONE)
    w.con_hint[w.t, n] = y
    y = y - normal * wp.dot(normal, y)
    length = wp.length(y)
    t1 = vec3(ONE, ZERO, ZERO)
    if length > MINVAL:
        t1 = y / length
    t2 = wp.cross(normal, t1)
    w.con_frame[w.t, n] = mat33(normal[0], normal[1], normal[2], t1[0], t1[1], t1[2], t2[0], t2[1], t2[2])


@wp.func(inline=True)
def pair_count(m: Tables, k: int, parallel: bool) -> int:
    """How many points of a pair may touch."""
    kind = m.pair_kind[k]
    n = int(wp.where(kind == CAPSULE_BOX, 2, 1))
    if kind == PLANE_CAPSULE or (kind == ROUND and parallel):
        n = 2
    elif kind == PLANE_BOX:
        n = 8
    elif kind == PLANE_CYLINDER:
        n = 4
    return n


@wp.func(inline=True)
def find_contacts(m: Tables, w: World) -> int:
    """List the contacts of a configuration and return their number."""
    n = int(0)
    for k in range(m.npair):
        kind = m.pair_kind[k]
        g1 = m.pair_geom1[k]
        g2 = m.pair_geom2[k]
        margin = w.th[m.o_pair_margin + k]
        c1 = geom_centre(m, w, g1)
        c2 = geom_centre(m, w, g2)
        reach = margin + m.pair_bound[k]
        normal = vec3()
        near = bool(False)
        if kind <= PLANE_ELLIPSOID:
            normal = geom_axis(m, w, g1)
            near = wp.dot(normal, c2 - c1) < reach
        else:
            near = wp.length_sq(c2 - c1) < reach * reach
        if near:
            size1 = m.geom_size[g1]
            size2 = m.geom_size[g2]
            axis = geom_axis(m, w, g2)
            a1 = vec3()
            a2 = axis * size2[1]
            parallel = bool(False)
            rot = mat33()
            if kind == ROUND:
                a1 = geom_axis(m, w, g1) * size1[1]
                parallel = are_parallel(a1, a2)
            elif kind > PLANE_CAPSULE:
                rot = geom_rotation(m, w, g2)
            first = int(-1)
            second = int(-1)
            if kind == CAPSULE_BOX:
                a1 = geom_axis(m, w, g1) * size1[1]
                back = wp.transpose(rot)
                limit = margin + f64(2.0) * (size1[0] + size1[1] + size2[0] + size2[1] + size2[2])
                first, second = capsule_box_codes(back * (c1 - c2), back * a1, size2, limit)
            start = n
            for i in range(pair_count(m, k, parallel)):
                possible = bool(True)
                which = i
                hint = vec3()
                x = vec7()
                if kind == PLANE_SPHERE:
                    x = plane_point(normal, c1, c2, size2[0])
                elif kind == PLANE_CAPSULE:
                    hint = axis
                    x = plane_point(normal, c1, c2 + a2 * (ONE - f64(2.0) * f64(float(i))), size2[0])
                elif kind == PLANE_BOX:
                    # the first four corners on the plane's side of the centre
                    y = rot * corner(i, size2)
                    possible = wp.dot(normal, y) <= ZERO and n - start < 4
                    x = plane_point(normal, c1, c2 + y, ZERO)
                elif kind == PLANE_CYLINDER:
                    # the near rim, then the far rim and two points of the near disk
                    possible = i == 0 or n > start
                    x = plane_point(normal, c1, cylinder_point(normal, c2, rot, size2, i), ZERO)
                elif kind == PLANE_ELLIPSOID:
                    x = plane_point(normal, c1, ellipsoid_point(normal, c2, rot, size2), ZERO)
                elif kind == SPHERE_BOX:
                    x = box_closest(c2, rot, size2, c1, size1[0])
                elif kind == CAPSULE_BOX:
                    which = wp.where(i == 0, first, second)
                    possible = which >= 0
                    if possible:
                        x = capsule_box_contact(c1, a1, size1[0], c2, rot, size2, which)
                else:
                    which = int(0)
                    if parallel:
                        which = overlap_end(c1, a1, c2, a2, i)
                    x = round_contact(c1, a1, size1[0], c2, a2, size2[0], which)
                if possible and x[0] < margin:
                    _add(w, n, k, which, x, hint)
                    n += 1
    return n


@wp.func(inline=True)
def half_axis(m: Tables, w: World, g: int) -> vec3:
    """Half-axis of a capsule, zero for a sphere (whose second size is zero)."""
    return geom_axis(m, w, g) * m.geom_size[g][1]


@wp.func
def in_frame(frame: mat33, x: vec6, p: vec3) -> vec6:
    """The motion ``x`` at ``p`` along the contact's axes, then its rotation about them."""
    v = frame * at(x, p)
    w = frame * ang(x)
    return vec6(v[0], v[1], v[2], w[0], w[1], w[2])


@wp.func(inline=True)
def fills_in(m: Tables, w: World, ncon: int) -> int:
    """1 if H has entries beyond the tree's, because a contact joins two branches."""
    dense = m.always_dense
    for c in range(ncon):
        if m.pair_dense[w.con_pair[w.t, c]] != 0:
            dense = 1
    return dense


@wp.func(inline=True)
def make_contacts(m: Tables, w: World, ncon: int):
    """Jacobian, reference acceleration and D of each contact."""
    for c in range(ncon):
        k = w.con_pair[w.t, c]
        b1 = m.pair_body1[k]
        b2 = m.pair_body2[k]
        for i in range(m.nv):
            w.con_jac[w.t, c * m.nv + i] = vec6()
        p = w.con_point[w.t, c]
        frame = w.con_frame[w.t, c]
        for side in range(2):
            sign = -ONE
            i = m.body_lastdof[b1]
            if side == 1:
                sign = ONE
                i = m.body_lastdof[b2]
            while i >= 0:
                column_i = in_frame(frame, w.motion[w.t, i], p) * sign
                w.con_jac[w.t, c * m.nv + i] = w.con_jac[w.t, c * m.nv + i] + column_i
                i = m.dof_parent[0, i]
        v = in_frame(frame, w.velocity[w.t, b2] - w.velocity[w.t, b1], p)
        solref = theta_vec2(w.th, m.o_pair_solref + 2 * k)
        friction_ref = theta_vec2(w.th, m.o_pair_solreffriction + 2 * k)
        solimp = theta_vec5(w.th, m.o_pair_solimp + 5 * k)
        x = w.con_dist[w.t, c] - w.th[m.o_pair_margin + k]
        imp = impedance_slope(x, solimp)[0]
        b = damping(solref, solimp, m.h, m.refsafe)
        bf = b
        if m.elliptic != 0 and (friction_ref[0] != ZERO or friction_ref[1] != ZERO):
            bf = damping(friction_ref, solimp, m.h, m.refsafe)
        aref = v * -bf
        aref[0] = -b * v[0] - stiffness(solref, solimp, m.h, m.refsafe) * imp * x
        w.con_aref[w.t, c] = aref
        mu = w.th[m.o_pair_friction + 5 * k]
        w.con_d[w.t, c] = normal_d(
            m.pair_dim[k], m.elliptic, regularisation(imp, ONE), w.th[m.o_pair_invweight + k], mu, m.impratio
        )
