"""Frames of bodies, joints and geoms, fixed or as parameters, and the adjoints of those that vary.

A change of a frame displaces everything beyond it, like a joint there would: what the sweep inwards knows of such a
displacement is its gradient. Rotations are unit quaternions and axes unit vectors.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.parts import has_frames, has_geoms
from dropo_torch.simulators.warp.rotations import quat_matrix, quat_mul, rotation
from dropo_torch.simulators.warp.spatial import add_at, ang, lin, theta_vec3, vec4_at
from dropo_torch.simulators.warp.types import (
    BALL,
    HINGE,
    ONE,
    SLIDE,
    TRANSLATION,
    TWO,
    ZERO,
    Reals,
    Tables,
    World,
    mat33,
    vec3,
    vec4,
    vec6,
)

#: Numbers of a body's frame (position, quaternion), of a joint's (axis, position) and of a geom's (the same as a
#: body's, and the size).
BODY = wp.constant(7)
JOINT = wp.constant(6)
GEOM = wp.constant(10)


@wp.func(inline=False)
def theta_vec4(th: Reals, i: int) -> vec4:
    """Four consecutive numbers of θ."""
    return vec4(th[i], th[i + 1], th[i + 2], th[i + 3])


@wp.func(inline=True)
def body_position(m: wp.ref[Tables], w: wp.ref[World], b: int) -> vec3:
    """Position of a body in its parent."""
    y = m.body_pos[b]
    if has_frames(m) and m.body_frame[b] >= 0:
        y = theta_vec3(w.th, m.o_body_frame + BODY * m.body_frame[b])
    return y


@wp.func(inline=True)
def body_rotation(m: wp.ref[Tables], w: wp.ref[World], b: int) -> mat33:
    """Rotation of a body in its parent."""
    y = m.body_mat[b]
    if has_frames(m) and m.body_frame[b] >= 0:
        y = quat_matrix(theta_vec4(w.th, m.o_body_frame + BODY * m.body_frame[b] + 3))
    return y


@wp.func(inline=True)
def link_axis(m: wp.ref[Tables], w: wp.ref[World], k: int) -> vec3:
    """Axis of a joint in its body."""
    y = m.link_axis[k]
    if has_frames(m) and m.link_frame[k] >= 0:
        y = theta_vec3(w.th, m.o_link_frame + JOINT * m.link_frame[k])
    return y


@wp.func(inline=True)
def link_position(m: wp.ref[Tables], w: wp.ref[World], k: int) -> vec3:
    """Position of a joint in its body."""
    y = m.link_pos[k]
    if has_frames(m) and m.link_frame[k] >= 0:
        y = theta_vec3(w.th, m.o_link_frame + JOINT * m.link_frame[k] + 3)
    return y


@wp.func(inline=True)
def geom_position(m: wp.ref[Tables], w: wp.ref[World], g: int) -> vec3:
    """Position of a geom in its body."""
    y = m.geom_pos[g]
    if has_geoms(m) and m.geom_frame[g] >= 0:
        y = theta_vec3(w.th, m.o_geom_frame + GEOM * m.geom_frame[g])
    return y


@wp.func(inline=True)
def geom_turn(m: wp.ref[Tables], w: wp.ref[World], g: int) -> mat33:
    """Rotation of a geom in its body."""
    y = m.geom_mat[g]
    if has_geoms(m) and m.geom_frame[g] >= 0:
        y = quat_matrix(theta_vec4(w.th, m.o_geom_frame + GEOM * m.geom_frame[g] + 3))
    return y


@wp.func(inline=True)
def geom_size(m: wp.ref[Tables], w: wp.ref[World], g: int) -> vec3:
    """Size of a geom."""
    y = m.geom_size[g]
    if has_geoms(m) and m.geom_frame[g] >= 0:
        y = theta_vec3(w.th, m.o_geom_frame + GEOM * m.geom_frame[g] + 7)
    return y


@wp.func(inline=False)
def beyond(v: vec6, a: vec6, u: vec6, dual: vec6, fv: vec6, fa: vec6, fu: vec6, fl: vec6, fy: vec6) -> vec6:
    """What everything beyond a place is displaced along, as a force: Y − Σ X ×* F_X with the place's own X."""
    y = fy - wp.spatial_cross_dual(v, fv) - wp.spatial_cross_dual(a, fa)
    return y - wp.spatial_cross_dual(dual, fl) - wp.spatial_cross_dual(u, fu)


@wp.func(inline=True)
def _frame_adjoint(w: wp.ref[World], o: int, outer: mat33, rot: mat33, p: vec3, y: vec6):
    """Adds of a frame at ``p`` the adjoint of its position in ``outer`` and of its quaternion, to θ from ``o``."""
    add_at(w.grad, w.t, o, wp.transpose(outer) * lin(y))
    g = wp.transpose(rot) * (ang(y) - wp.cross(p, lin(y)))
    q = theta_vec4(w.th, o + 3)
    add_at(w.grad, w.t, o + 3, quat_mul(q, vec4(ZERO, g[0], g[1], g[2])) * TWO)


@wp.func(inline=True)
def body_frame_adjoint(m: wp.ref[Tables], w: wp.ref[World], b: int, y: vec6):
    """Adjoint of a body's frame, where ``y`` is :func:`beyond` its place before its joints."""
    if m.body_frame[b] >= 0:
        outer = w.xmat[w.t, m.body_parent[b]]
        p = w.xpos[w.t, m.body_parent[b]] + outer * body_position(m, w, b)
        o = m.o_body_frame + BODY * m.body_frame[b]
        _frame_adjoint(w, o, outer, outer * body_rotation(m, w, b), p, y)


@wp.func(inline=True)
def geom_frame_adjoint(m: wp.ref[Tables], w: wp.ref[World], g: int, y: vec6):
    """Adjoint of a geom's frame, where ``y`` is the force on it."""
    if m.geom_frame[g] >= 0:
        outer = w.xmat[w.t, m.geom_body[g]]
        p = w.xpos[w.t, m.geom_body[g]] + outer * geom_position(m, w, g)
        o = m.o_geom_frame + GEOM * m.geom_frame[g]
        _frame_adjoint(w, o, outer, outer * geom_turn(m, w, g), p, y)


@wp.func(inline=True)
def geom_size_adjoint(m: wp.ref[Tables], w: wp.ref[World], g: int, bar: vec3):
    """Adds the adjoint of a geom's size."""
    if m.geom_frame[g] >= 0:
        add_at(w.grad, w.t, m.o_geom_frame + GEOM * m.geom_frame[g] + 7, bar)


@wp.func(inline=True)
def before_link(m: wp.ref[Tables], w: wp.ref[World], r: int, k: int, pos: vec3, rot: mat33):
    """Position and rotation of a link's body before the link turned and moved it."""
    p = pos
    inner = rot
    kind = m.link_kind[k]
    iq = m.link_qpos[k]
    if kind == SLIDE:
        p = pos - rot * link_axis(m, w, k) * (w.qpos[r, iq] - m.link_ref[k])
    elif kind == HINGE:
        inner = rot * wp.transpose(rotation(link_axis(m, w, k), w.qpos[r, iq] - m.link_ref[k]))
    elif kind == BALL:
        inner = rot * wp.transpose(quat_matrix(vec4_at(w.qpos, r, iq)))
    if kind != SLIDE and kind != TRANSLATION:
        p = pos + rot * link_position(m, w, k) - inner * link_position(m, w, k)
    return p, inner


@wp.func(inline=True)
def link_frame_adjoint(
    m: wp.ref[Tables], w: wp.ref[World], r: int, k: int, p: vec3, inner: mat33, rot: mat33, after: vec6, y: vec6,
    pull: vec6,
):  # fmt: skip
    """Adjoint of a joint's axis and position.

    The body is at ``p`` and turned by ``inner`` before the joint, by ``rot`` after it; ``after`` and ``y`` are
    :func:`beyond` the joint and before it, ``pull`` is the adjoint of its motion axis.
    """
    if m.link_frame[k] >= 0 and m.link_kind[k] != TRANSLATION:
        o = m.o_link_frame + JOINT * m.link_frame[k]
        back = wp.transpose(inner)
        if m.link_kind[k] == SLIDE:
            x = w.qpos[r, m.link_qpos[k]] - m.link_ref[k]
            add_at(w.grad, w.t, o, back * (lin(pull) + lin(after) * x))
        else:
            # the joint and all beyond move with the position, and what is beyond moves back by it
            add_at(w.grad, w.t, o + 3, back * lin(y) - wp.transpose(rot) * lin(after))
        if m.link_kind[k] == HINGE:
            anchor = p + inner * link_position(m, w, k)
            e = link_axis(m, w, k)
            angle = w.qpos[r, m.link_qpos[k]] - m.link_ref[k]
            torque = back * (ang(after) - wp.cross(anchor, lin(after)))
            # the body turns by sin φ δe + (1 − cos φ) e × δe
            ebar = torque * wp.sin(angle) + wp.cross(torque, e) * (ONE - wp.cos(angle))
            add_at(w.grad, w.t, o, ebar + back * (ang(pull) - wp.cross(anchor, lin(pull))))
