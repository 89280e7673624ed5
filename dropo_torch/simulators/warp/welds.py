"""Connect and weld equalities: constraints that hold two bodies, or two sites, together.

Such a constraint has six rows, the distance between its two anchors and its torque scale times the vector part of the
quaternion from the second frame to the first; a connect has the scale zero. They always act and their cost is
quadratic: it is added to M and to the load before the solver sees them. The position that their impedance
depends on is the norm of all rows.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.impedance import regularization
from dropo_torch.simulators.warp.kinematics import packed
from dropo_torch.simulators.warp.parts import num_welds
from dropo_torch.simulators.warp.rotations import quat_matrix, quat_mul
from dropo_torch.simulators.warp.soft import Soft, soft_adjoint, softness
from dropo_torch.simulators.warp.spatial import (
    add_at,
    ang,
    at,
    cross_force,
    join,
    late,
    lin,
    pull,
    theta_vec3,
    theta_vec4,
)
from dropo_torch.simulators.warp.types import (
    EQ_WIDTH,
    HALF,
    ONE,
    TWO,
    ZERO,
    Tables,
    World,
    f64,
    mat33,
    vec3,
    vec4,
    vec6,
)

#: Where a weld's quaternion and torque scale stand among an equality's numbers.
QUAT = wp.constant(6)
SCALE = wp.constant(10)


@wp.struct
class Weld:
    """Where a weld's two frames are."""

    b1: wp.int32
    b2: wp.int32
    p1: vec3  # anchors
    p2: vec3
    r1: mat33  # rotation of the first frame, turned by the reference rotation
    r2: mat33
    s: wp.float64  # quaternion of r2ᵀ r1, as long as the reference one: scalar and vector part
    v: vec3
    scale: wp.float64


@wp.func(inline=True)
def weld_anchor(m: wp.ref[Tables], w: wp.ref[World], e: int, side: int) -> vec3:
    """Place in θ of an anchor in its body's frame; a weld's data has that of the second body first."""
    x = m.weld_pos[2 * e + side]
    if m.weld_sites[e] == 0:
        first = wp.where(m.weld_turns[e] != 0, 1 - side, side)
        x = theta_vec3(w.th, m.o_eq_data + EQ_WIDTH * m.weld_id[e] + 3 * first)
    return x


@wp.func(inline=True)
def weld_pose(m: wp.ref[Tables], w: wp.ref[World], e: int) -> Weld:
    """The two frames of weld ``e``."""
    x = Weld()
    x.b1 = m.weld_body[2 * e]
    x.b2 = m.weld_body[2 * e + 1]
    x.p1 = w.xpos[w.t, x.b1] + w.xmat[w.t, x.b1] * weld_anchor(m, w, e, 0)
    x.p2 = w.xpos[w.t, x.b2] + w.xmat[w.t, x.b2] * weld_anchor(m, w, e, 1)
    x.scale = ZERO
    x.s = ONE
    if m.weld_turns[e] != 0:
        data = m.o_eq_data + EQ_WIDTH * m.weld_id[e]
        x.scale = w.th[data + SCALE]
        x.r1 = w.xmat[w.t, x.b1] * m.weld_mat[2 * e]
        x.r2 = w.xmat[w.t, x.b2] * m.weld_mat[2 * e + 1]
        size = ONE
        if m.weld_sites[e] == 0:
            reference = theta_vec4(w.th, data + QUAT)
            size = wp.length(reference)
            x.r1 = x.r1 * quat_matrix(reference)
        q = wp.quat_from_matrix(wp.transpose(x.r2) * x.r1)
        x.s = q[3] * size
        x.v = vec3(q[0], q[1], q[2]) * size
    return x


@wp.func(inline=False)
def weld_error(x: Weld) -> vec6:
    """Position of the six rows."""
    return join(x.p1 - x.p2, x.v * x.scale)


@wp.func(inline=False)
def weld_motion(x: Weld, x1: vec6, x2: vec6) -> vec6:
    """How fast the rows change while the bodies move with ``x1`` and ``x2``: v' = ½ (s ω + ω × v)."""
    turning = wp.transpose(x.r2) * (ang(x1) - ang(x2))
    rate = turning * x.s + wp.cross(turning, x.v)
    return join(at(x1, x.p1) - at(x2, x.p2), rate * (HALF * x.scale))


@wp.func(inline=False)
def weld_acceleration(x: Weld, v1: vec6, v2: vec6, a1: vec6, a2: vec6) -> vec6:
    """Second derivative of the rows: the accelerations of the anchors, and ½ (s α + α × v) − ¼ |ω|² v."""
    turning = ang(v1) - ang(v2)
    twist = wp.transpose(x.r2) * _relative_twist(v1, v2, a1, a2)
    rate = (twist * x.s + wp.cross(twist, x.v)) * HALF - x.v * (f64(0.25) * wp.dot(turning, turning))
    move1 = at(a1, x.p1) + wp.cross(ang(v1), at(v1, x.p1))
    move2 = at(a2, x.p2) + wp.cross(ang(v2), at(v2, x.p2))
    return join(move1 - move2, rate * x.scale)


@wp.func(inline=False)
def _relative_twist(v1: vec6, v2: vec6, a1: vec6, a2: vec6) -> vec3:
    """Angular acceleration of the first body seen from the second."""
    return ang(a1) - ang(a2) - wp.cross(ang(v2), ang(v1))


@wp.func(inline=False)
def _turning_force(x: Weld, y: vec6) -> vec3:
    """Transpose of :func:`weld_motion` in the difference of the angular velocities."""
    y_rot = lin(y)
    return x.r2 * ((y_rot * x.s + wp.cross(x.v, y_rot)) * (HALF * x.scale))


@wp.func(inline=True)
def weld_softness(m: wp.ref[Tables], w: wp.ref[World], e: int, error: vec6, part: int) -> Soft:
    """The softness of the rows that displace (``part`` 0) or turn (1)."""
    o_ref = m.o_eq_solref + 2 * m.weld_id[e]
    o_imp = m.o_eq_solimp + 5 * m.weld_id[e]
    return softness(m, w, o_ref, o_imp, w.th[m.o_weld_invweight + 2 * e + part], wp.length(error))


@wp.func(inline=False)
def stiffen(soft: Soft) -> f64:
    """D of rows of this softness."""
    return ONE / regularization(soft.imp, soft.weight)


@wp.func(inline=True)
def make_welds(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Add the cost of all welds: JᵀD J to the matrix ``w.quad``, −JᵀD aref to the load."""
    if num_welds(m) > 0:
        for i in range(m.nh):
            w.quad[w.t, i] = w.mass[w.t, i]
    for e in range(num_welds(m)):
        _make_weld(m, w, e)


@wp.func(inline=True)
def _make_weld(m: wp.ref[Tables], w: wp.ref[World], e: int):
    """Add the cost of one weld, aref with the acceleration that the rows have without any of the joints."""
    x = weld_pose(m, w, e)
    error = weld_error(x)
    soft = weld_softness(m, w, e, error, 0)
    d1 = stiffen(soft)
    d2 = stiffen(weld_softness(m, w, e, error, 1))
    v1 = w.velocity[w.t, x.b1]
    v2 = w.velocity[w.t, x.b2]
    aref = weld_motion(x, v1, v2) * -soft.b - error * (soft.k * soft.imp)
    aref -= weld_acceleration(x, v1, v2, w.bias[w.t, x.b1], w.bias[w.t, x.b2])
    for i in range(m.nv):
        w.weld_jac[w.t, i] = vec6()
    for side in range(2):
        i = m.body_lastdof[wp.where(side == 0, x.b1, x.b2)]
        while i >= 0:
            axis = w.motion[w.t, i]
            column = weld_motion(x, axis, vec6()) if side == 0 else weld_motion(x, vec6(), axis)
            w.weld_jac[w.t, i] = w.weld_jac[w.t, i] + column
            i = m.dof_parent[0, i]
    which = m.weld_dense[e]
    i = wp.max(m.body_lastdof[x.b1], m.body_lastdof[x.b2])
    while i >= 0:
        ji = w.weld_jac[w.t, i]
        dj = join(ang(ji) * d1, lin(ji) * d2)
        w.load[w.t, i] -= wp.dot(dj, aref)
        j = i
        while j >= 0:
            w.quad[w.t, packed(i, j)] += wp.dot(dj, w.weld_jac[w.t, j])
            j = m.dof_parent[which, j]
        i = m.dof_parent[which, i]


@wp.func(inline=True)
def welds_adjoint(m: wp.ref[Tables], w: wp.ref[World]):
    """Add the gradient of Σ −f Jλ over the welds to the bodies' F and Y and to θ."""
    _late = wp.grad(late)(ONE)
    for e in range(num_welds(m)):
        _weld_adjoint(m, w, e)


@wp.func(inline=True)
def _weld_adjoint(m: wp.ref[Tables], w: wp.ref[World], e: int):
    """The gradient of one weld's Σ D (ẍ + B ẋ + K d(|x|) x) Jλ."""
    _late = wp.grad(late)(ONE)
    x = weld_pose(m, w, e)
    error = weld_error(x)
    soft = weld_softness(m, w, e, error, 0)
    soft2 = weld_softness(m, w, e, error, 1)
    d1 = stiffen(soft)
    d2 = stiffen(soft2)
    v1 = w.velocity[w.t, x.b1]
    v2 = w.velocity[w.t, x.b2]
    jv = weld_motion(x, v1, v2)
    jl = weld_motion(x, w.dual[w.t, x.b1], w.dual[w.t, x.b2])
    jar = weld_acceleration(x, v1, v2, w.bias[w.t, x.b1], w.bias[w.t, x.b2])
    jar += jv * soft.b + error * (soft.k * soft.imp)
    ab = join(ang(jl) * d1, lin(jl) * d2)
    lb = join(ang(jar) * d1, lin(jar) * d2)
    along = vec6()
    if soft.x > ZERO:
        along = error / soft.x
    sbar = wp.dot(ab, along)
    power1 = wp.dot(ang(jar), ang(jl))
    power2 = wp.dot(lin(jar), lin(jl))
    xbar, weightbar, _mu = soft_adjoint(m, w, soft, 1, ONE, d1, power1, wp.dot(jv, ab), sbar)
    xbar2, weightbar2, _mu2 = soft_adjoint(m, w, soft2, 1, ONE, d2, power2, ZERO, ZERO)
    w.grad[w.t, m.o_weld_invweight + 2 * e] += weightbar
    w.grad[w.t, m.o_weld_invweight + 2 * e + 1] += weightbar2
    errorbar = along * (xbar + xbar2) + (ab - along * sbar) * (soft.k * soft.imp)
    _hang_weld(m, w, e, x, errorbar, ab, ab * soft.b, lb)


@wp.func(inline=True)
def _hang_weld(m: wp.ref[Tables], w: wp.ref[World], e: int, x: Weld, errorbar: vec6, ab: vec6, vb: vec6, lb: vec6):
    """Hang the adjoints of position, acceleration, velocity and Jλ of the rows on bodies and on the equality's data."""
    v1 = w.velocity[w.t, x.b1]
    v2 = w.velocity[w.t, x.b2]
    twist = _relative_twist(v1, v2, w.bias[w.t, x.b1], w.bias[w.t, x.b2])
    turning = ang(v1) - ang(v2)
    dual = ang(w.dual[w.t, x.b1]) - ang(w.dual[w.t, x.b2])
    back = wp.transpose(x.r2)
    fa = _turning_force(x, ab)
    fv = _turning_force(x, vb)
    fl = _turning_force(x, lb)
    # the quaternion (s, v): in the rates ½ (s ω + ω × v) of three motions, in −¼ |ω|² v, and as the position
    speed = f64(0.25) * wp.dot(turning, turning)
    half = HALF * x.scale
    sbar = half * (wp.dot(lin(ab), back * twist) + wp.dot(lin(vb), back * turning) + wp.dot(lin(lb), back * dual))
    vbar = (
        wp.cross(lin(ab), back * twist) + wp.cross(lin(vb), back * turning) + wp.cross(lin(lb), back * dual)
    ) * half + (lin(errorbar) - lin(ab) * speed) * x.scale
    # it turns by ½ (−ω·v, s ω + ω × v)
    torque = x.r2 * ((x.s * vbar - sbar * x.v + wp.cross(x.v, vbar)) * HALF)
    frame = wp.cross(twist, fa) + wp.cross(turning, fv) + wp.cross(dual, fl)
    slow = turning * (-half * wp.dot(lin(ab), x.v))
    turn1 = fv + slow - wp.cross(fa, ang(v2))
    turn2 = -fv - slow - wp.cross(ang(v1), fa)
    p1bar = _hang_anchor(w, x.b1, x.p1, ang(errorbar), ang(ab), ang(vb), ang(lb), fa, turn1, fl, torque)
    p2bar = _hang_anchor(w, x.b2, x.p2, -ang(errorbar), -ang(ab), -ang(vb), -ang(lb), -fa, turn2, -fl, -torque - frame)
    data = m.o_eq_data + EQ_WIDTH * m.weld_id[e]
    if m.weld_sites[e] == 0:
        first = wp.where(m.weld_turns[e] != 0, 3, 0)
        add_at(w.grad, w.t, data + first, wp.transpose(w.xmat[w.t, x.b1]) * p1bar)
        add_at(w.grad, w.t, data + 3 - first, wp.transpose(w.xmat[w.t, x.b2]) * p2bar)
    if m.weld_turns[e] != 0:
        rates = wp.dot(lin(ab), _rate(x, back * twist) - x.v * speed) + wp.dot(lin(vb), _rate(x, back * turning))
        w.grad[w.t, data + SCALE] += wp.dot(lin(errorbar), x.v) + rates + wp.dot(lin(lb), _rate(x, back * dual))
        if m.weld_sites[e] == 0:
            q = theta_vec4(w.th, data + QUAT)
            turn = wp.transpose(x.r1) * torque * TWO
            _turn_adjoint(w, data + QUAT, q, x.s * sbar + wp.dot(x.v, vbar), turn)


@wp.func(inline=False)
def _hang_anchor(
    w: wp.ref[World], b: int, p: vec3, pbar: vec3, ab: vec3, vb: vec3, lb: vec3, turn_a: vec3, turn_v: vec3,
    turn_l: vec3, torque: vec3,
) -> vec3:  # fmt: skip
    """Hang the adjoints of an anchor's position, acceleration, velocity and Λ, and torques, on its body.

    Also on the world, whose acceleration is gravity's. Returns the whole adjoint of the anchor.
    """
    a = w.bias[w.t, b]
    v = w.velocity[w.t, b]
    dual = w.dual[w.t, b]
    # the acceleration is a + α × p + ω × (v + ω × p)
    swing = wp.cross(ab, ang(v))
    fa = pull(ab, p, turn_a)
    fv = pull(vb + swing, p, turn_v + wp.cross(at(v, p), ab))
    fl = pull(lb, p, turn_l)
    y = pbar + wp.cross(ab, ang(a)) + wp.cross(vb + swing, ang(v)) + wp.cross(lb, ang(dual))
    w.f_accel[w.t, b] = w.f_accel[w.t, b] + fa
    w.f_velocity[w.t, b] = w.f_velocity[w.t, b] + fv
    w.f_dual[w.t, b] = w.f_dual[w.t, b] + fl
    pose = pull(y, p, torque) + cross_force(a, fa) + cross_force(v, fv) + cross_force(dual, fl)
    w.f_pose[w.t, b] = w.f_pose[w.t, b] + pose
    return y


@wp.func(inline=False)
def _rate(x: Weld, turning: vec3) -> vec3:
    """Rate of the quaternion's vector part."""
    return (turning * x.s + wp.cross(turning, x.v)) * HALF


@wp.func(inline=False)
def _turn_adjoint(w: wp.ref[World], o: int, q: vec4, grow: f64, turn: vec3):
    """Adjoint of the reference quaternion at ``o`` in θ: q ⊗ (grow, turn) / |q|²."""
    bar = quat_mul(q, vec4(grow, turn[0], turn[1], turn[2])) / wp.dot(q, q)
    add_at(w.grad, w.t, o, bar)
