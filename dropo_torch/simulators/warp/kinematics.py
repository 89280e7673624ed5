"""Sweeps over the tree: poses and velocities going out, inertial forces and the mass matrix coming in.

All spatial vectors are in world axes about one origin that travels with the first root, so that a robot far
from the world's origin loses no digits; no result depends on where that origin is.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.ellipsoid import ellipsoids_wrench
from dropo_torch.simulators.warp.fluid import fluid_wrench, inertial_frame
from dropo_torch.simulators.warp.frames import body_position, body_rotation, link_axis, link_position
from dropo_torch.simulators.warp.parts import has_medium
from dropo_torch.simulators.warp.rotations import quat_matrix, rotation
from dropo_torch.simulators.warp.spatial import (
    cross_force,
    cross_motion,
    inertia_about_origin,
    inertia_mul,
    join,
    theta_vec3,
    vec3_at,
    vec4_at,
)
from dropo_torch.simulators.warp.types import HINGE, MINVAL, SLIDE, TRANSLATION, ZERO, Tables, World, vec3, vec6, vec10
from dropo_torch.simulators.warp.wrenches import outer_wrench


@wp.func(inline=False)
def packed(i: int, j: int) -> int:
    """Place of (i, j), j ≤ i, in a packed lower triangle."""
    return (i * (i + 1)) // 2 + j


@wp.func(inline=True)
def sweep_out(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Poses, motion axes s, velocities V, bias accelerations A (q̈ = 0, gravity in the root) and inertias I."""
    o = m.origin_base
    for i in range(m.norigin):
        o += m.origin_axis[i] * w.qpos[r, m.origin_qpos[i]]
    w.xpos[w.t, 0] = -o
    w.xmat[w.t, 0] = wp.identity(n=3, dtype=wp.float64)
    w.velocity[w.t, 0] = vec6()
    w.bias[w.t, 0] = join(vec3(), -theta_vec3(w.th, m.o_gravity))
    for b in range(1, m.nb):
        p = m.body_parent[b]
        rp = w.xmat[w.t, p]
        pos = w.xpos[w.t, p] + rp * body_position(m, w, b)
        rot = rp * body_rotation(m, w, b)
        i = m.body_pose[b]
        if i >= 0:
            pos = vec3_at(w.ctrl, w.rc, i) - o
            rot = quat_matrix(vec4_at(w.ctrl, w.rc, i + 3))
        v = w.velocity[w.t, p]
        a = w.bias[w.t, p]
        first = m.body_link[b]
        for k in range(first, first + m.body_nlink[b]):
            kind = m.link_kind[k]
            d = m.link_dof[k]
            iq = m.link_qpos[k]
            sv = vec6()
            if kind == HINGE:
                local = link_axis(m, w, k)
                place = link_position(m, w, k)
                axis = rot * local
                anchor = pos + rot * place
                rot = rot * rotation(local, w.qpos[r, iq] - m.link_ref[k])
                pos = anchor - rot * place
                sd = join(axis, wp.cross(anchor, axis))
                w.motion[w.t, d] = sd
                sv = sd * w.qvel[r, d]
            elif kind == SLIDE:
                axis = rot * link_axis(m, w, k)
                pos += axis * (w.qpos[r, iq] - m.link_ref[k])
                sd = join(vec3(), axis)
                w.motion[w.t, d] = sd
                sv = sd * w.qvel[r, d]
            elif kind == TRANSLATION:
                pos = vec3_at(w.qpos, r, iq) - o
                for i in range(3):
                    w.motion[w.t, d + i] = join(vec3(), w.xmat[w.t, 0][i])
                sv = join(vec3(), vec3_at(w.qvel, r, d))
            else:
                place = link_position(m, w, k)
                anchor = pos + rot * place
                rot = rot * quat_matrix(vec4_at(w.qpos, r, iq))
                pos = anchor - rot * place
                for i in range(3):
                    axis = vec3(rot[0, i], rot[1, i], rot[2, i])
                    sd = join(axis, wp.cross(anchor, axis))
                    w.motion[w.t, d + i] = sd
                    sv += sd * w.qvel[r, d + i]
            a += cross_motion(v, sv)
            v += sv
        w.xpos[w.t, b] = pos
        w.xmat[w.t, b] = rot
        w.velocity[w.t, b] = v
        w.bias[w.t, b] = a
        if m.body_massive[b] != 0:
            c = pos + rot * theta_vec3(w.th, m.o_ipos + 3 * b)
            moments = theta_vec3(w.th, m.o_inertia + 3 * b)
            w.inertia[w.t, b] = inertia_about_origin(w.th[m.o_mass + b], c, inertial_frame(m, w, b), moments)
        else:
            w.inertia[w.t, b] = vec10()


@wp.func(inline=True)
def inertial_forces(m: wp.ref[Tables], w: wp.ref[World]):
    """F = I A + V ×* I V of each body, less gravity compensation, drag and the wrenches from outside."""
    for b in range(1, m.nb):
        i = w.inertia[w.t, b]
        w.composite[w.t, b] = i
        if m.body_massive[b] != 0:
            v = w.velocity[w.t, b]
            a = w.bias[w.t, b]
            if m.has_gravcomp != 0:
                a += join(vec3(), theta_vec3(w.th, m.o_gravity) * w.th[m.o_gravcomp + b])
            f = inertia_mul(i, a) + cross_force(v, inertia_mul(i, v))
            if has_medium(m) and w.th[m.o_mass + b] >= MINVAL:
                if m.body_nfluid[b] != 0:
                    f -= ellipsoids_wrench(m, w, b)
                else:
                    f -= fluid_wrench(m, w, b)
            if w.wrenched != 0:
                f -= outer_wrench(m, w, b)
            w.force[w.t, b] = f
        else:
            w.force[w.t, b] = vec6()


@wp.func(inline=True)
def sweep_in(m: wp.ref[Tables], w: wp.ref[World]):
    """Mass matrix M with armature, and the bias force c, from subtree sums of I and F."""
    for i in range(m.nh):
        w.mass[w.t, i] = ZERO
    for back in range(1, m.nb):
        b = m.nb - back
        p = m.body_parent[b]
        f = w.force[w.t, b]
        ic = w.composite[w.t, b]
        if p > 0:
            w.force[w.t, p] = w.force[w.t, p] + f
            w.composite[w.t, p] = w.composite[w.t, p] + ic
        first = m.body_dof[b]
        for i in range(first, first + m.body_ndof[b]):
            sd = w.motion[w.t, i]
            w.load[w.t, i] = wp.dot(sd, f)
            g = inertia_mul(ic, sd)
            row = packed(i, 0)
            w.mass[w.t, row + i] = wp.dot(sd, g) + w.th[m.o_armature + i]
            j = m.dof_parent[0, i]
            while j >= 0:
                w.mass[w.t, row + j] = wp.dot(w.motion[w.t, j], g)
                j = m.dof_parent[0, j]
