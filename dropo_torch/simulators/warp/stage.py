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

from dropo_torch.simulators.warp.contact import fills_in, find_contacts, make_contacts
from dropo_torch.simulators.warp.contact_adjoint import contacts_adjoint
from dropo_torch.simulators.warp.fluid import box_power, centre_of_mass, inertial_frame
from dropo_torch.simulators.warp.forces import (
    actuators_adjoint,
    add_actuators,
    add_dampers,
    add_springs,
    dampers_adjoint,
    springs_adjoint,
)
from dropo_torch.simulators.warp.kinematics import inertial_forces, sweep_in, sweep_out, theta_vec3
from dropo_torch.simulators.warp.rows import make_rows, rows_adjoint
from dropo_torch.simulators.warp.solver import factor, newton, solve
from dropo_torch.simulators.warp.spatial import (
    ang,
    at,
    cross_force,
    cross_motion,
    inertia_mul,
    join,
    nothing,
    wrench,
)
from dropo_torch.simulators.warp.types import (
    BALL,
    MINVAL,
    ONE,
    TRANSLATION,
    Ints,
    Reals,
    Reals2,
    Scratch,
    Tables,
    vec3,
    vec6,
)


@wp.func(inline=True)
def accelerate(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    acc: Reals2,
    hess: Reals2,
    held: Ints,
    r: int,
    ctrl: Reals2,
    rc: int,
):
    """Acceleration of the state in row ``r``, from the guess in ``acc[r]``; leaves the factor of H in ``hess[r]``."""
    sweep_out(m, s, t, th, qpos, qvel, r)
    inertial_forces(m, s, t, th)
    sweep_in(m, s, t, th)
    if m.has_damper != 0:
        add_dampers(m, s, t, th, qvel, r)
    if m.has_spring != 0:
        add_springs(m, s, t, th, qpos, r)
    add_actuators(m, s, t, th, qpos, qvel, r, ctrl, rc)
    nrow = make_rows(m, s, t, th, qpos, qvel, r, 1)
    ncon = find_contacts(m, s, t, th)
    held[r] = wp.min(nrow, 1) + 2 * wp.min(ncon, 1)
    if nrow + ncon == 0:
        for i in range(m.nh):
            hess[r, i] = s.mass[t, i]
        factor(m, 0, hess, r)
        for i in range(m.nv):
            acc[r, i] = -s.load[t, i]
        solve(m, 0, hess, r, acc, r)
    else:
        make_contacts(m, s, t, th, ncon)
        newton(m, s, t, th, nrow, ncon, fills_in(m, s, t, ncon), acc, hess, r)


@wp.func(inline=True)
def accelerate_adjoint(
    m: Tables,
    s: Scratch,
    t: int,
    th: Reals,
    qpos: Reals2,
    qvel: Reals2,
    acc: Reals2,
    hess: Reals2,
    soft_hess: Reals2,
    held: Ints,
    r: int,
    ctrl: Reals2,
    rc: int,
    ctrl_bar: Reals2,
    rb: int,
    softening: int,
):
    """Adjoint of :func:`accelerate`: adds to ``s.tangent``, ``s.vel_bar``, controls and θ.

    Poses of row ``r`` are in the scratch memory, minus the adjoint of the acceleration in ``s.lam``, its acceleration
    and velocity in ``s.qacc`` and ``s.qd``. With ``softening`` it is instead the part of M in the adjoint of an
    implicit integrator: λᵀ M a alone, of bodies at rest without gravity, with λ solved with ``soft_hess``.
    """
    _late = wp.grad(nothing)(ONE)
    nrow = int(0)
    ncon = int(0)
    if softening != 0:
        for b in range(m.nb):
            s.velocity[t, b] = vec6()
            s.bias[t, b] = vec6()
        solve(m, 0, soft_hess, r, s.lam, t)
    else:
        kept = held[r]
        if kept % 2 != 0:
            nrow = make_rows(m, s, t, th, qpos, qvel, r, 0)
        if kept > 1:
            ncon = find_contacts(m, s, t, th)
        solve(m, fills_in(m, s, t, ncon), hess, r, s.lam, t)
    carry_out(m, s, t)
    posed = ncon + m.has_gravcomp + m.has_fluid
    bodies_adjoint(m, s, t, th, 1 - softening, posed)
    for i in range(m.nv):
        s.grad[t, m.o_armature + i] += s.lam[t, i] * s.qacc[t, i]
    if softening == 0:
        if m.has_damper != 0:
            dampers_adjoint(m, s, t, th, qvel, r)
        if m.has_spring != 0:
            springs_adjoint(m, s, t, th, qpos, r)
        actuators_adjoint(m, s, t, th, qpos, qvel, r, ctrl, rc, ctrl_bar, rb)
        rows_adjoint(m, s, t, th, qpos, qvel, acc, r, nrow)
        contacts_adjoint(m, s, t, th, ncon)
    carry_in(m, s, t, posed)
    if softening == 0:
        for i in range(3):
            s.grad[t, m.o_gravity + i] -= s.f_accel[t, 0][3 + i]


@wp.func(inline=True)
def carry_out(m: Tables, s: Scratch, t: int):
    """U = Σ s a and Λ = Σ s λ of each body, and A completed to the acceleration with joint accelerations."""
    s.total[t, 0] = vec6()
    s.dual[t, 0] = vec6()
    for b in range(1, m.nb):
        p = m.body_parent[b]
        u = s.total[t, p]
        dual = s.dual[t, p]
        first = m.body_dof[b]
        for i in range(first, first + m.body_ndof[b]):
            sd = s.motion[t, i]
            u += sd * s.qacc[t, i]
            dual += sd * s.lam[t, i]
        s.total[t, b] = u
        s.dual[t, b] = dual
        s.bias[t, b] = s.bias[t, b] + u


@wp.func(inline=True)
def bodies_adjoint(m: Tables, s: Scratch, t: int, th: Reals, moving: int, posed: int):
    """Each body's ⟨Λ, I A + V ×* I V⟩: its gradient in Λ, A, V and in mass, moments and centre of mass.

    ``moving`` 0 leaves out V, gravity compensation and drag: the adjoint of λᵀ M a alone.
    """
    _late = wp.grad(nothing)(ONE)
    zero = vec6()
    s.f_velocity[t, 0] = zero
    s.f_accel[t, 0] = zero
    s.f_dual[t, 0] = zero
    if posed != 0:
        for b in range(m.nb):
            s.f_total[t, b] = zero
            s.f_pose[t, b] = zero
    for b in range(1, m.nb):
        if m.body_massive[b] == 0:
            s.f_velocity[t, b] = zero
            s.f_accel[t, b] = zero
            s.f_dual[t, b] = zero
        if m.body_massive[b] != 0:
            i = s.inertia[t, b]
            dual = s.dual[t, b]
            v = s.velocity[t, b]
            a = s.bias[t, b]
            fa = inertia_mul(i, dual)
            lv = cross_motion(dual, v)
            if moving != 0:
                if m.has_gravcomp != 0:
                    gc = th[m.o_gravcomp + b]
                    g = join(vec3(), theta_vec3(th, m.o_gravity))
                    a += g * gc
                    s.grad[t, m.o_gravcomp + b] += wp.dot(fa, g)
                    s.f_pose[t, b] = cross_force(g, fa) * -gc
                    for k in range(3):
                        s.grad[t, m.o_gravity + k] += gc * fa[3 + k]
                iv = inertia_mul(i, v)
                s.f_velocity[t, b] = inertia_mul(i, lv) - cross_force(dual, iv)
                s.f_dual[t, b] = inertia_mul(i, a) + cross_force(v, iv)
            else:
                s.f_velocity[t, b] = zero
                s.f_dual[t, b] = inertia_mul(i, a)
            s.f_accel[t, b] = fa
            if m.want_inertial != 0:
                _inertia_adjoint(m, s, t, th, b, dual, a, lv, v)
            if moving != 0 and m.has_fluid != 0 and th[m.o_mass + b] >= MINVAL:
                _fluid_adjoint(m, s, t, th, b, dual, v)


@wp.func(inline=True)
def _inertia_adjoint(m: Tables, s: Scratch, t: int, th: Reals, b: int, x: vec6, y: vec6, z: vec6, v: vec6):
    """Gradient of ⟨x, I y⟩ + ⟨z, I v⟩ in mass, moments and centre of mass."""
    rot = s.xmat[t, b]
    c = centre_of_mass(m, s, t, th, b)
    xc = at(x, c)
    yc = at(y, c)
    zc = at(z, c)
    vc = at(v, c)
    s.grad[t, m.o_mass + b] += wp.dot(xc, yc) + wp.dot(zc, vc)
    if m.want_ipos != 0:
        cbar = wp.cross(yc, ang(x)) + wp.cross(xc, ang(y)) + wp.cross(vc, ang(z)) + wp.cross(zc, ang(v))
        pbar = wp.transpose(rot) * (cbar * th[m.o_mass + b])
        for k in range(3):
            s.grad[t, m.o_ipos + 3 * b + k] += pbar[k]
    if m.want_inertia != 0:
        frame = wp.transpose(rot * m.body_imat[b])
        xw = frame * ang(x)
        yw = frame * ang(y)
        zw = frame * ang(z)
        vw = frame * ang(v)
        for k in range(3):
            s.grad[t, m.o_inertia + 3 * b + k] += xw[k] * yw[k] + zw[k] * vw[k]


@wp.func(inline=True)
def _fluid_adjoint(m: Tables, s: Scratch, t: int, th: Reals, b: int, dual: vec6, v: vec6):
    """Gradient of −λ · (drag on the body)."""
    rot = inertial_frame(m, s, t, b)
    back = wp.transpose(rot)
    c = centre_of_mass(m, s, t, th, b)
    wind = theta_vec3(th, m.o_wind)
    x = theta_vec3(th, m.o_inertia + 3 * b)
    wbar, vbar, lwbar, lvbar, xbar, massbar, denbar, visbar = wp.grad(box_power)(
        back * ang(v), back * (at(v, c) - wind), back * ang(dual), back * at(dual, c), x, th[m.o_mass + b],
        th[m.o_density], th[m.o_viscosity],
    )  # fmt: skip
    fv = rot * vbar
    fl = rot * lvbar
    s.f_velocity[t, b] = s.f_velocity[t, b] + wrench(fv, c) + join(rot * wbar, vec3())
    s.f_dual[t, b] = s.f_dual[t, b] + wrench(fl, c) + join(rot * lwbar, vec3())
    s.f_pose[t, b] = s.f_pose[t, b] - join(wp.cross(fv, wind), vec3())
    cbar = wp.transpose(s.xmat[t, b]) * (wp.cross(fv, ang(v)) + wp.cross(fl, ang(dual)))
    s.grad[t, m.o_mass + b] += massbar
    s.grad[t, m.o_density] += denbar
    s.grad[t, m.o_viscosity] += visbar
    for k in range(3):
        s.grad[t, m.o_wind + k] -= fv[k]
        s.grad[t, m.o_inertia + 3 * b + k] += xbar[k]
        s.grad[t, m.o_ipos + 3 * b + k] += cbar[k]


@wp.func(inline=True)
def carry_in(m: Tables, s: Scratch, t: int, posed: int):
    """Adjoints of positions and velocities, from the leaves to the root.

    In a frame that is displaced along s with everything beyond the joint, only what comes from before the joint
    moves: each of V, A, U, Λ there by X × s. So L_q = Σ_X F_X · (X × s) + Y · s and L_v = F_V · s + F_A · (V × s),
    X before the joint, with F_V += v s ×* F_A between the two. ``posed`` 0 says that there is no F_U and no Y.
    """
    for reverse in range(1, m.nb):
        b = m.nb - reverse
        p = m.body_parent[b]
        fv = s.f_velocity[t, b]
        fa = s.f_accel[t, b]
        fl = s.f_dual[t, b]
        fu = vec6()
        fy = vec6()
        if posed != 0:
            fu = s.f_total[t, b]
            fy = s.f_pose[t, b]
        v = s.velocity[t, b]
        a = s.bias[t, b]
        u = s.total[t, b]
        dual = s.dual[t, b]
        first = m.body_link[b]
        count = m.body_nlink[b]
        for step in range(count):
            k = first + count - 1 - step
            d = m.link_dof[k]
            n = int(1)
            if m.link_kind[k] == BALL or m.link_kind[k] == TRANSLATION:
                n = 3
            sv = vec6()
            sa = vec6()
            sl = vec6()
            for i in range(d, d + n):
                sd = s.motion[t, i]
                sv += sd * s.qd[t, i]
                sa += sd * s.qacc[t, i]
                sl += sd * s.lam[t, i]
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
            for i in range(d, d + n):
                s.vel_bar[t, i] += wp.dot(s.motion[t, i], g)
                s.tangent[t, i] += wp.dot(s.motion[t, i], y)
        s.f_velocity[t, p] = s.f_velocity[t, p] + fv
        s.f_accel[t, p] = s.f_accel[t, p] + fa
        if posed != 0:
            s.f_total[t, p] = s.f_total[t, p] + fu
            s.f_pose[t, p] = s.f_pose[t, p] + fy
        s.f_dual[t, p] = s.f_dual[t, p] + fl
