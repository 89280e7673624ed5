"""One evaluation of the dynamics: the acceleration of a state, and its adjoint.

At the solution R = M a + c − τ − Jᵀ f(J a − aref) = 0, so the adjoint of a stage is H λ = −ā with
H = ∂R/∂a, then the gradient of λᵀR, in which λ and a stand fixed. That number is a sum over bodies and
constraints of quantities carried outwards, so its gradient needs one sweep inwards and no solver.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.contact import contacts_adjoint, fills_in, make_contacts
from dropo_torch.simulators.warp.ellipsoid import ellipsoid_power, fluid_center, fluid_frame
from dropo_torch.simulators.warp.fluid import box_power, center_of_mass, inertial_frame
from dropo_torch.simulators.warp.forces import add_forces, add_thrust, forces_adjoint
from dropo_torch.simulators.warp.frames import before_link, beyond, body_frame_adjoint, link_frame_adjoint
from dropo_torch.simulators.warp.kinematics import inertial_forces, sweep_in, sweep_out
from dropo_torch.simulators.warp.parts import (
    has_frames,
    has_full_slope,
    has_medium,
    has_thrust,
    num_tendons,
    num_welds,
    with_medium,
)
from dropo_torch.simulators.warp.rotations import quat_mul
from dropo_torch.simulators.warp.rows import make_rows, rows_adjoint
from dropo_torch.simulators.warp.slopes import fluid_slopes_adjoint, solve_full_transposed
from dropo_torch.simulators.warp.solver import newton
from dropo_torch.simulators.warp.spatial import (
    add_at,
    ang,
    at,
    cross_force,
    cross_motion,
    inertia_mul,
    join,
    late,
    lin,
    theta_vec3,
    vec4_at,
    wrench,
)
from dropo_torch.simulators.warp.tendons import (
    add_tendon_armature,
    clear_tendon_bars,
    make_tendons,
    tendon_armature_adjoint,
    tendons_adjoint,
)
from dropo_torch.simulators.warp.touch import find_contacts
from dropo_torch.simulators.warp.triangle import factor, solve
from dropo_torch.simulators.warp.types import MINVAL, ONE, TWO, ZERO, Tables, World, mat33, vec3, vec4, vec6
from dropo_torch.simulators.warp.welds import make_welds, welds_adjoint
from dropo_torch.simulators.warp.wrenches import outer_wrench_adjoint


@wp.func(inline=True)
def accelerate(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """Acceleration of the state in row ``r``, from the guess in ``acc[r]``; leaves the factor of H in ``hess[r]``."""
    sweep_out(m, w, r)
    inertial_forces(m, w)
    if has_thrust(m):
        add_thrust(m, w, r)
    sweep_in(m, w)
    if num_tendons(m) != 0:
        make_tendons(m, w, r)
        add_tendon_armature(m, w)
    add_forces(m, w, r)
    make_welds(m, w, r)
    nrow = make_rows(m, w, r, 1)
    ncon = find_contacts(m, w)
    w.held[r] = wp.min(nrow, 1) + 2 * wp.min(ncon, 1)
    if nrow + ncon == 0:
        for i in range(m.nh):
            w.hess[r, i] = w.quad[w.t, i]
        factor(m.dof_parent, m.nv, m.quad_dense, w.hess, r)
        for i in range(m.nv):
            w.acc[r, i] = -w.load[w.t, i]
        solve(m.dof_parent, m.nv, m.quad_dense, w.hess, r, w.acc, r)
    else:
        make_contacts(m, w, ncon)
        newton(m, w, nrow, ncon, fills_in(m, w, ncon), r)


@wp.func(inline=True)
def accelerate_adjoint(m: wp.ref[Tables], w: wp.ref[World], r: int, softening: int):
    """Adjoint of :func:`accelerate`: adds to ``w.tangent``, ``w.vel_bar``, controls and θ.

    Poses of row ``r`` are in the scratch memory, minus the adjoint of the acceleration in ``w.lam``, its acceleration
    and velocity in ``w.qacc`` and ``w.qd``. With ``softening`` it is instead a part of the adjoint of an implicit
    integrator: 1, that of M, λᵀ M a of bodies at rest without gravity, with λ solved with ``soft_hess``; 2, with that
    same λ, of the medium's slope, λᵀ B a; 3, of velocity products, λᵀ c.
    """
    _late = wp.grad(late)(ONE)
    nrow = int(0)
    ncon = int(0)
    if num_tendons(m) != 0:
        make_tendons(m, w, r)
        clear_tendon_bars(m, w)
    if softening == 1:
        for b in range(m.nb):
            w.velocity[w.t, b] = vec6()
            w.bias[w.t, b] = vec6()
        if has_full_slope(m):
            solve_full_transposed(m, w.soft_hess, r, w.lam, w.t)
        else:
            solve(m.dof_parent, m.nv, 0, w.soft_hess, r, w.lam, w.t)
    elif softening == 3:
        gravity = w.bias[w.t, 0]
        for b in range(m.nb):
            w.bias[w.t, b] = w.bias[w.t, b] - gravity
    elif softening == 0:
        kept = w.held[r]
        if kept % 2 != 0:
            nrow = make_rows(m, w, r, 0)
        if kept > 1:
            ncon = find_contacts(m, w)
        solve(m.dof_parent, m.nv, fills_in(m, w, ncon), w.hess, r, w.lam, w.t)
    if num_tendons(m) != 0:
        tendon_armature_adjoint(m, w)
    carry_out(m, w)
    posed = ncon + num_welds(m) + m.has_gravcomp + m.has_fluid + w.wrenched
    if with_medium() and softening == 2:
        fluid_slopes_adjoint(m, w)
    else:
        bodies_adjoint(m, w, softening, posed)
        for i in range(m.nv):
            w.grad[w.t, m.o_armature + i] += w.lam[w.t, i] * w.qacc[w.t, i]
    if softening == 0:
        forces_adjoint(m, w, r)
        rows_adjoint(m, w, r, nrow)
        contacts_adjoint(m, w, ncon)
        welds_adjoint(m, w)
        if num_tendons(m) != 0:
            tendons_adjoint(m, w)
    carry_in(m, w, r, posed)
    if softening == 0:
        add_at(w.grad, w.t, m.o_gravity, -lin(w.f_accel[w.t, 0]))


@wp.func(inline=True)
def carry_out(m: wp.ref[Tables], w: wp.ref[World]):
    """U = Σ s a and Λ = Σ s λ of each body, and A completed to the acceleration with joint accelerations."""
    w.total[w.t, 0] = vec6()
    w.dual[w.t, 0] = vec6()
    for b in range(1, m.nb):
        p = m.body_parent[b]
        u = w.total[w.t, p]
        dual = w.dual[w.t, p]
        first = m.body_dof[b]
        for i in range(first, first + m.body_ndof[b]):
            sd = w.motion[w.t, i]
            u += sd * w.qacc[w.t, i]
            dual += sd * w.lam[w.t, i]
        w.total[w.t, b] = u
        w.dual[w.t, b] = dual
        w.bias[w.t, b] = w.bias[w.t, b] + u


@wp.func(inline=True)
def bodies_adjoint(m: wp.ref[Tables], w: wp.ref[World], softening: int, posed: int):
    """Each body's ⟨Λ, I A + V ×* I V⟩: its gradient in Λ, A, V and in mass, moments and center of mass.

    ``softening`` 1 leaves out V, and 3 all bodies whose velocity products are not taken implicitly; both leave out
    gravity compensation, drag and wrenches.
    """
    _late = wp.grad(late)(ONE)
    zero = vec6()
    for b in range(m.nb):
        w.f_velocity[w.t, b] = zero
        w.f_accel[w.t, b] = zero
        w.f_dual[w.t, b] = zero
        if posed != 0:
            w.f_total[w.t, b] = zero
            w.f_pose[w.t, b] = zero
        if m.body_massive[b] != 0 and (softening != 3 or m.body_turning[b] != 0):
            i = w.inertia[w.t, b]
            dual = w.dual[w.t, b]
            v = w.velocity[w.t, b]
            a = w.bias[w.t, b]
            fa = inertia_mul(i, dual)
            lv = cross_motion(dual, v)
            if softening != 1:
                if softening == 0 and m.has_gravcomp != 0:
                    gc = w.th[m.o_gravcomp + b]
                    g = join(vec3(), theta_vec3(w.th, m.o_gravity))
                    a += g * gc
                    w.grad[w.t, m.o_gravcomp + b] += wp.dot(fa, g)
                    w.f_pose[w.t, b] = cross_force(g, fa) * -gc
                    add_at(w.grad, w.t, m.o_gravity, lin(fa) * gc)
                iv = inertia_mul(i, v)
                w.f_velocity[w.t, b] = inertia_mul(i, lv) - cross_force(dual, iv)
                w.f_dual[w.t, b] = cross_force(v, iv)
            w.f_dual[w.t, b] = w.f_dual[w.t, b] + inertia_mul(i, a)
            w.f_accel[w.t, b] = fa
            if m.want_inertial != 0:
                _inertia_adjoint(m, w, b, dual, a, lv, v)
            if softening == 0 and has_medium(m) and w.th[m.o_mass + b] >= MINVAL:
                if m.body_nfluid[b] != 0:
                    _ellipsoids_adjoint(m, w, b, dual, v)
                else:
                    _fluid_adjoint(m, w, b, dual, v)
            if softening == 0 and w.wrenched != 0:
                outer_wrench_adjoint(m, w, b, dual)


@wp.func(inline=True)
def _inertia_adjoint(m: wp.ref[Tables], w: wp.ref[World], b: int, x: vec6, y: vec6, z: vec6, v: vec6):
    """Gradient of ⟨x, I y⟩ + ⟨z, I v⟩ in mass, moments and center of mass."""
    rot = w.xmat[w.t, b]
    c = center_of_mass(m, w, b)
    xc = at(x, c)
    yc = at(y, c)
    zc = at(z, c)
    vc = at(v, c)
    w.grad[w.t, m.o_mass + b] += wp.dot(xc, yc) + wp.dot(zc, vc)
    if m.want_ipos != 0:
        cbar = wp.cross(yc, ang(x)) + wp.cross(xc, ang(y)) + wp.cross(vc, ang(z)) + wp.cross(zc, ang(v))
        add_at(w.grad, w.t, m.o_ipos + 3 * b, wp.transpose(rot) * (cbar * w.th[m.o_mass + b]))
    if m.want_inertia != 0:
        frame = wp.transpose(inertial_frame(m, w, b))
        moments = wp.cw_mul(frame * ang(x), frame * ang(y)) + wp.cw_mul(frame * ang(z), frame * ang(v))
        add_at(w.grad, w.t, m.o_inertia + 3 * b, moments)


@wp.func(inline=True)
def _fluid_adjoint(m: wp.ref[Tables], w: wp.ref[World], b: int, dual: vec6, v: vec6):
    """Gradient of −λ · (drag on the body)."""
    rot = inertial_frame(m, w, b)
    back = wp.transpose(rot)
    c = center_of_mass(m, w, b)
    wind = theta_vec3(w.th, m.o_wind)
    x = theta_vec3(w.th, m.o_inertia + 3 * b)
    wbar, vbar, lwbar, lvbar, xbar, massbar, denbar, visbar = wp.grad(box_power)(
        back * ang(v), back * (at(v, c) - wind), back * ang(dual), back * at(dual, c), x, w.th[m.o_mass + b],
        w.th[m.o_density], w.th[m.o_viscosity],
    )  # fmt: skip
    fv = rot * vbar
    fl = rot * lvbar
    w.f_velocity[w.t, b] = w.f_velocity[w.t, b] + wrench(fv, c) + join(rot * wbar, vec3())
    w.f_dual[w.t, b] = w.f_dual[w.t, b] + wrench(fl, c) + join(rot * lwbar, vec3())
    w.f_pose[w.t, b] = w.f_pose[w.t, b] - join(wp.cross(fv, wind), vec3())
    cbar = wp.transpose(w.xmat[w.t, b]) * (wp.cross(fv, ang(v)) + wp.cross(fl, ang(dual)))
    w.grad[w.t, m.o_mass + b] += massbar
    w.grad[w.t, m.o_density] += denbar
    w.grad[w.t, m.o_viscosity] += visbar
    add_at(w.grad, w.t, m.o_wind, -fv)
    add_at(w.grad, w.t, m.o_inertia + 3 * b, xbar)
    add_at(w.grad, w.t, m.o_ipos + 3 * b, cbar)


@wp.func(inline=True)
def _ellipsoids_adjoint(m: wp.ref[Tables], w: wp.ref[World], b: int, dual: vec6, v: vec6):
    """Gradient of −λ · (forces of the medium on the body's ellipsoids)."""
    wind = theta_vec3(w.th, m.o_wind)
    first = m.body_fluid[b]
    for i in range(first, first + m.body_nfluid[b]):
        g = m.fluid_geom[i]
        rot = fluid_frame(m, w, b, g)
        back = wp.transpose(rot)
        c = fluid_center(m, w, b, g)
        wbar, vbar, lwbar, lvbar, _s, _d, _l, _m, _i, denbar, visbar = wp.grad(ellipsoid_power)(
            back * ang(v), back * (at(v, c) - wind), back * ang(dual), back * at(dual, c), m.fluid_size[i],
            m.fluid_drag[i], m.fluid_lift[i], m.fluid_mass[i], m.fluid_inertia[i], w.th[m.o_density],
            w.th[m.o_viscosity],
        )  # fmt: skip
        fv = rot * vbar
        w.f_velocity[w.t, b] = w.f_velocity[w.t, b] + wrench(fv, c) + join(rot * wbar, vec3())
        w.f_dual[w.t, b] = w.f_dual[w.t, b] + wrench(rot * lvbar, c) + join(rot * lwbar, vec3())
        w.f_pose[w.t, b] = w.f_pose[w.t, b] - join(wp.cross(fv, wind), vec3())
        w.grad[w.t, m.o_density] += denbar
        w.grad[w.t, m.o_viscosity] += visbar
        add_at(w.grad, w.t, m.o_wind, -fv)


@wp.func(inline=True)
def pose_adjoint(m: wp.ref[Tables], w: wp.ref[World], b: int, y: vec6):
    """Adjoint of a prescribed pose among the inputs: ``y`` is that of displacing the body, which stands still."""
    i = m.body_pose[b]
    q = vec4_at(w.ctrl, w.rc, i + 3)
    n = wp.length(q)
    add_at(w.ctrl_bar, w.rb, i, lin(y))
    if n > MINVAL:
        torque = ang(y) - wp.cross(w.xpos[w.t, b], lin(y))
        turned = quat_mul(vec4(ZERO, torque[0], torque[1], torque[2]), q)
        add_at(w.ctrl_bar, w.rb, i + 3, turned * (TWO / (n * n)))


@wp.func(inline=True)
def carry_in(m: wp.ref[Tables], w: wp.ref[World], r: int, posed: int):
    """Adjoints of positions and velocities, from the leaves to the root.

    In a frame that is displaced along s with everything beyond the joint, only what comes from before the joint
    moves: each of V, A, U, Λ there by X × s. So L_q = Σ_X F_X · (X × s) + Y · s and L_v = F_V · s + F_A · (V × s),
    X before the joint, with F_V += v s ×* F_A between the two. ``posed`` 0 says that there is no F_U and no Y.
    Frames that vary get their adjoints on the way.
    """
    for reverse in range(1, m.nb):
        b = m.nb - reverse
        p = m.body_parent[b]
        fv = w.f_velocity[w.t, b]
        fa = w.f_accel[w.t, b]
        fl = w.f_dual[w.t, b]
        fu = vec6()
        fy = vec6()
        if posed != 0:
            fu = w.f_total[w.t, b]
            fy = w.f_pose[w.t, b]
        v = w.velocity[w.t, b]
        a = w.bias[w.t, b]
        u = w.total[w.t, b]
        dual = w.dual[w.t, b]
        first = m.body_link[b]
        count = m.body_nlink[b]
        after = vec6()
        pos = vec3()
        rot = mat33()
        if has_frames(m):
            after = beyond(v, a, u, dual, fv, fa, fu, fl, fy)
            pos = w.xpos[w.t, b]
            rot = w.xmat[w.t, b]
        for step in range(count):
            k = first + count - 1 - step
            d = m.link_dof[k]
            sv = vec6()
            sa = vec6()
            sl = vec6()
            for i in range(d, d + m.link_ndof[k]):
                sd = w.motion[w.t, i]
                sv += sd * w.qd[w.t, i]
                sa += sd * w.qacc[w.t, i]
                sl += sd * w.lam[w.t, i]
            v = v - sv
            u = u - sa
            dual = dual - sl
            a = a - sa - cross_motion(v, sv)
            # F_A · (V × s) = −s · V ×* F_A
            g = fv - cross_force(v, fa)
            fv = fv + cross_force(sv, fa)
            # Σ F_X · (X × s) = −s · Σ X ×* F_X
            y = fy - cross_force(v, fv) - cross_force(a, fa) - cross_force(dual, fl)
            if posed != 0:
                y = y - cross_force(u, fu)
            for i in range(d, d + m.link_ndof[k]):
                w.vel_bar[w.t, i] += wp.dot(w.motion[w.t, i], g)
                w.tangent[w.t, i] += wp.dot(w.motion[w.t, i], y)
            if has_frames(m):
                place, inner = before_link(m, w, r, k, pos, rot)
                pull = g * w.qd[w.t, d] + (fu + fa) * w.qacc[w.t, d] + fl * w.lam[w.t, d]
                link_frame_adjoint(m, w, r, k, place, inner, rot, after, y, pull)
                after = y
                pos = place
                rot = inner
        if m.body_pose[b] >= 0:
            pose_adjoint(m, w, b, fy - cross_force(a, fa))
        if has_frames(m):
            body_frame_adjoint(m, w, b, after)
        w.f_velocity[w.t, p] = w.f_velocity[w.t, p] + fv
        w.f_accel[w.t, p] = w.f_accel[w.t, p] + fa
        if posed != 0:
            w.f_total[w.t, p] = w.f_total[w.t, p] + fu
            w.f_pose[w.t, p] = w.f_pose[w.t, p] + fy
        w.f_dual[w.t, p] = w.f_dual[w.t, p] + fl
