"""Sweeps over the tree: poses and velocities going out, inertial forces and the mass matrix coming in.

All spatial vectors are in world axes about one origin that travels with the first root, so that a robot far
from the world's origin loses no digits; no result depends on where that origin is.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.fluid import fluid_wrench
from dropo_torch.simulators.warp.spatial import (
    cross_force,
    cross_motion,
    inertia_about_origin,
    inertia_mul,
    join,
    quat_matrix,
    rotation,
)
from dropo_torch.simulators.warp.types import (
    HINGE,
    MINVAL,
    SLIDE,
    TRANSLATION,
    ZERO,
    Reals,
    Reals2,
    Scratch,
    Tables,
    vec3,
    vec4,
    vec6,
    vec10,
)


@wp.func
def theta_vec3(th: Reals, i: int) -> vec3:
    """Three consecutive numbers of θ."""
    return vec3(th[i], th[i + 1], th[i + 2])


@wp.func
def packed(i: int, j: int) -> int:
    """Place of (i, j), j ≤ i, in a packed lower triangle."""
    return (i * (i + 1)) // 2 + j


@wp.func(inline=True)
def sweep_out(m: Tables, s: Scratch, t: int, th: Reals, qpos: Reals2, qvel: Reals2, r: int):
    """Poses, motion axes s, velocities V, bias accelerations A (q̈ = 0, gravity in the root) and inertias I."""
    o = m.origin_base
    for i in range(m.norigin):
        o += m.origin_axis[i] * qpos[r, m.origin_qpos[i]]
    s.xpos[t, 0] = -o
    s.xmat[t, 0] = wp.identity(n=3, dtype=wp.float64)
    s.velocity[t, 0] = vec6()
    s.bias[t, 0] = join(vec3(), -theta_vec3(th, m.o_gravity))
    for b in range(1, m.nb):
        p = m.body_parent[b]
        rp = s.xmat[t, p]
        pos = s.xpos[t, p] + rp * m.body_pos[b]
        rot = rp * m.body_mat[b]
        v = s.velocity[t, p]
        a = s.bias[t, p]
        first = m.body_link[b]
        for k in range(first, first + m.body_nlink[b]):
            kind = m.link_kind[k]
            d = m.link_dof[k]
            iq = m.link_qpos[k]
            if kind == HINGE:
                axis = rot * m.link_axis[k]
                anchor = pos + rot * m.link_pos[k]
                rot = rot * rotation(m.link_axis[k], qpos[r, iq] - m.link_ref[k])
                pos = anchor - rot * m.link_pos[k]
                sd = join(axis, wp.cross(anchor, axis))
                s.motion[t, d] = sd
                sv = sd * qvel[r, d]
                a += cross_motion(v, sv)
                v += sv
            elif kind == SLIDE:
                axis = rot * m.link_axis[k]
                pos += axis * (qpos[r, iq] - m.link_ref[k])
                sd = join(vec3(), axis)
                s.motion[t, d] = sd
                sv = sd * qvel[r, d]
                a += cross_motion(v, sv)
                v += sv
            elif kind == TRANSLATION:
                pos = vec3(qpos[r, iq], qpos[r, iq + 1], qpos[r, iq + 2]) - o
                for i in range(3):
                    e = vec3()
                    e[i] = wp.float64(1.0)
                    s.motion[t, d + i] = join(vec3(), e)
                v += join(vec3(), vec3(qvel[r, d], qvel[r, d + 1], qvel[r, d + 2]))
            else:
                anchor = pos + rot * m.link_pos[k]
                rot = rot * quat_matrix(vec4(qpos[r, iq], qpos[r, iq + 1], qpos[r, iq + 2], qpos[r, iq + 3]))
                pos = anchor - rot * m.link_pos[k]
                sv = vec6()
                for i in range(3):
                    axis = vec3(rot[0, i], rot[1, i], rot[2, i])
                    sd = join(axis, wp.cross(anchor, axis))
                    s.motion[t, d + i] = sd
                    sv += sd * qvel[r, d + i]
                a += cross_motion(v, sv)
                v += sv
        s.xpos[t, b] = pos
        s.xmat[t, b] = rot
        s.velocity[t, b] = v
        s.bias[t, b] = a
        if m.body_massive[b] != 0:
            c = pos + rot * theta_vec3(th, m.o_ipos + 3 * b)
            moments = theta_vec3(th, m.o_inertia + 3 * b)
            s.inertia[t, b] = inertia_about_origin(th[m.o_mass + b], c, rot * m.body_imat[b], moments)
        else:
            s.inertia[t, b] = vec10()


@wp.func(inline=True)
def inertial_forces(m: Tables, s: Scratch, t: int, th: Reals):
    """F = I A + V ×* I V of each body, less gravity compensation and drag."""
    for b in range(1, m.nb):
        i = s.inertia[t, b]
        s.composite[t, b] = i
        if m.body_massive[b] != 0:
            v = s.velocity[t, b]
            a = s.bias[t, b]
            if m.has_gravcomp != 0:
                a += join(vec3(), theta_vec3(th, m.o_gravity) * th[m.o_gravcomp + b])
            f = inertia_mul(i, a) + cross_force(v, inertia_mul(i, v))
            if m.has_fluid != 0 and th[m.o_mass + b] >= MINVAL:
                f -= fluid_wrench(m, s, t, th, b)
            s.force[t, b] = f
        else:
            s.force[t, b] = vec6()


@wp.func(inline=True)
def sweep_in(m: Tables, s: Scratch, t: int, th: Reals):
    """Mass matrix M with armature, and the bias force c, from subtree sums of I and F."""
    for i in range(m.nh):
        s.mass[t, i] = ZERO
    for back in range(1, m.nb):
        b = m.nb - back
        p = m.body_parent[b]
        f = s.force[t, b]
        ic = s.composite[t, b]
        if p > 0:
            s.force[t, p] = s.force[t, p] + f
            s.composite[t, p] = s.composite[t, p] + ic
        first = m.body_dof[b]
        for i in range(first, first + m.body_ndof[b]):
            sd = s.motion[t, i]
            s.load[t, i] = wp.dot(sd, f)
            g = inertia_mul(ic, sd)
            row = packed(i, 0)
            s.mass[t, row + i] = wp.dot(sd, g) + th[m.o_armature + i]
            j = m.dof_parent[0, i]
            while j >= 0:
                s.mass[t, row + j] = wp.dot(s.motion[t, j], g)
                j = m.dof_parent[0, j]
