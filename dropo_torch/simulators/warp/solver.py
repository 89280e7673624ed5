"""Newton's method for the constrained acceleration, with a factor that keeps the tree's sparsity.

Minimizes ½ aᵀMa + aᵀ(c − τ) + Σ s(J a − aref). With pyramidal cones the cost is piecewise quadratic: a full
step that stays on one piece is exact, so the iteration ends after finitely many.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.cone import CURVED, cone_force, cone_hessian, cone_of, cone_piece, cone_slopes
from dropo_torch.simulators.warp.kinematics import packed
from dropo_torch.simulators.warp.parts import num_tendons
from dropo_torch.simulators.warp.rows import row_add, row_dot, row_force, row_state
from dropo_torch.simulators.warp.triangle import (
    add_congruence,
    add_jacobian_force,
    factor,
    jacobian_mul,
    multiply,
    solve,
)
from dropo_torch.simulators.warp.types import ONE, ZERO, Reals2, Tables, World, f64, vec6

ITERATIONS = wp.constant(60)
LINE_STEPS = wp.constant(50)


@wp.func(inline=True)
def contact_dot(m: wp.ref[Tables], w: wp.ref[World], c: int, x: Reals2, r: int) -> vec6:
    """J x of contact ``c``."""
    k = w.con_pair[w.t, c]
    first = m.pair_dofadr[k]
    return jacobian_mul(m.pair_dof, first, m.pair_dofadr[k + 1] - first, w.con_jac, w.t, c * m.nv, x, r)


@wp.func(inline=True)
def _add_row_hessian(m: wp.ref[Tables], w: wp.ref[World], n: int, r: int):
    """H += Jᵀ D J of one scalar row."""
    if num_tendons(m) != 0 and w.row_tendon[w.t, n] != 0:
        _add_tendon_hessian(m, w, n, r)
    else:
        _add_dofs_hessian(m, w, n, r)


@wp.func(inline=False)
def _add_tendon_hessian(m: wp.ref[Tables], w: wp.ref[World], n: int, r: int):
    d = w.row_d[w.t, n]
    for a in range(2):
        for b in range(2):
            ka = w.row_dof[w.t, n][a]
            kb = w.row_dof[w.t, n][b]
            if ka >= 0 and kb >= 0:
                y = d * w.row_coef[w.t, n][a] * w.row_coef[w.t, n][b]
                for ci in range(m.ten_start[ka], m.ten_start[ka + 1]):
                    i = m.ten_dof[ci]
                    yi = y * w.ten_jac[w.t, ci]
                    for cj in range(m.ten_start[kb], m.ten_start[kb + 1]):
                        j = m.ten_dof[cj]
                        if j <= i:
                            w.hess[r, packed(i, 0) + j] += yi * w.ten_jac[w.t, cj]


@wp.func(inline=True)
def _add_dofs_hessian(m: wp.ref[Tables], w: wp.ref[World], n: int, r: int):
    d = w.row_d[w.t, n]
    c = w.row_coef[w.t, n]
    for a in range(3):
        i = w.row_dof[w.t, n][a]
        if i >= 0:
            for b in range(3):
                j = w.row_dof[w.t, n][b]
                if j >= 0 and j <= i:
                    w.hess[r, packed(i, 0) + j] += d * c[a] * c[b]


@wp.func(inline=True)
def assemble(m: wp.ref[Tables], w: wp.ref[World], nrow: int, ncon: int, r: int):
    """H = M + Jᵀ C J and the gradient M a + c − τ − Jᵀ f at the current J a − aref, into ``w.step``."""
    for i in range(m.nh):
        w.hess[r, i] = w.quad[w.t, i]
    for i in range(m.nv):
        w.step[w.t, i] = -w.product[w.t, i]
    for n in range(nrow):
        jar = w.row_jar[w.t, n]
        row_add(m, w, n, row_force(w, n, jar), w.step, w.t)
        if row_state(w, n, jar) == 1:
            _add_row_hessian(m, w, n, r)
    for c in range(ncon):
        k = w.con_pair[w.t, c]
        cone = cone_of(m, w, k, w.con_d[w.t, c])
        jar6 = w.con_jar[w.t, c]
        if cone_piece(cone, jar6) != 0:
            f = cone_force(cone, jar6)
            first = m.pair_dofadr[k]
            count = m.pair_dofadr[k + 1] - first
            add_jacobian_force(m.pair_dof, first, count, w.con_jac, w.t, c * m.nv, f, w.step, w.t)
            ll, la, aa = cone_hessian(cone, jar6)
            add_congruence(
                m.pair_dof, first, count, w.con_jac, w.t, c * m.nv, ll, la, aa, int(m.pair_dim[k] > 3), w.hess, r
            )


@wp.func(inline=True)
def _slopes(m: wp.ref[Tables], w: wp.ref[World], nrow: int, ncon: int, alpha: f64, linear: f64, quad: f64):
    """φ'(α) and φ''(α) of the cost along the step."""
    d1 = linear + alpha * quad
    d2 = quad
    for n in range(nrow):
        y = w.row_dir[w.t, n]
        jar = w.row_jar[w.t, n] + alpha * y
        d1 -= row_force(w, n, jar) * y
        if row_state(w, n, jar) == 1:
            d2 += w.row_d[w.t, n] * y * y
    for c in range(ncon):
        cone = cone_of(m, w, w.con_pair[w.t, c], w.con_d[w.t, c])
        y6 = w.con_dir[w.t, c]
        c1, c2 = cone_slopes(cone, w.con_jar[w.t, c] + y6 * alpha, y6)
        d1 += c1
        d2 += c2
    return d1, d2


@wp.func(inline=True)
def _line_search(m: wp.ref[Tables], w: wp.ref[World], nrow: int, ncon: int, r: int) -> f64:
    """The root of φ' along the step: Newton's iteration kept in a bracket, roughly where cones are curved."""
    multiply(m.dof_parent, m.nv, m.quad_dense, w.quad, w.t, w.step, w.t, w.work, w.t)
    linear = ZERO
    quad = ZERO
    for i in range(m.nv):
        linear += w.product[w.t, i] * w.step[w.t, i]
        quad += w.work[w.t, i] * w.step[w.t, i]
    enough = f64(1.0e-15)
    if m.elliptic != 0:
        enough = f64(1.0e-3)
    start = f64(0.0)
    low = ZERO
    high = f64(-1.0)
    alpha = f64(0.0)
    for k in range(LINE_STEPS + 1):
        d1, d2 = _slopes(m, w, nrow, ncon, alpha, linear, quad)
        nxt = ONE
        if k == 0:
            start = d1
        else:
            if wp.abs(d1) <= enough * wp.abs(start):
                break
            if d1 < ZERO:
                low = alpha
            else:
                high = alpha
            nxt = alpha - d1 / d2
            if nxt <= low or (high > ZERO and nxt >= high):
                nxt = f64(0.5) * (low + high) if high > ZERO else f64(2.0) * alpha
        if nxt == alpha:
            break
        alpha = nxt
    return alpha


@wp.func(inline=True)
def _unconstrained_gradient(m: wp.ref[Tables], w: wp.ref[World], r: int):
    """quad · a + load, into ``w.product``."""
    multiply(m.dof_parent, m.nv, m.quad_dense, w.quad, w.t, w.acc, r, w.product, w.t)
    for i in range(m.nv):
        w.product[w.t, i] += w.load[w.t, i]


@wp.func(inline=True)
def newton(m: wp.ref[Tables], w: wp.ref[World], nrow: int, ncon: int, dense: int, r: int):
    """Solve for ``w.acc[r]`` from the guess it holds; leave the factor of H at the solution in ``w.hess[r]``."""
    for n in range(nrow):
        w.row_jar[w.t, n] = row_dot(m, w, n, w.acc, r) - w.row_aref[w.t, n]
    for c in range(ncon):
        w.con_jar[w.t, c] = contact_dot(m, w, c, w.acc, r) - w.con_aref[w.t, c]
    _unconstrained_gradient(m, w, r)
    done = int(0)
    for _k in range(ITERATIONS):
        assemble(m, w, nrow, ncon, r)
        factor(m.dof_parent, m.nv, dense, w.hess, r)
        if done != 0:
            break
        solve(m.dof_parent, m.nv, dense, w.hess, r, w.step, w.t)
        same = int(1)
        curved = int(0)
        for n in range(nrow):
            y = row_dot(m, w, n, w.step, w.t)
            w.row_dir[w.t, n] = y
            jar = w.row_jar[w.t, n]
            if row_state(w, n, jar) != row_state(w, n, jar + y):
                same = 0
        for c in range(ncon):
            y6 = contact_dot(m, w, c, w.step, w.t)
            w.con_dir[w.t, c] = y6
            cone = cone_of(m, w, w.con_pair[w.t, c], w.con_d[w.t, c])
            jar6 = w.con_jar[w.t, c]
            after = cone_piece(cone, jar6 + y6)
            if cone_piece(cone, jar6) != after:
                same = 0
            elif cone.elliptic != 0 and cone.dim > 1 and after == CURVED:
                curved = 1
        if same != 0 and curved == 0:
            for i in range(m.nv):
                w.acc[r, i] += w.step[w.t, i]
            break
        alpha = ONE
        small = int(1)
        enough = f64(1.0e-11)
        if same != 0:
            enough = f64(1.0e-8)  # on one smooth piece convergence is quadratic
        for i in range(m.nv):
            if wp.abs(w.step[w.t, i]) > enough * (ONE + wp.abs(w.acc[r, i])):
                small = 0
        if small == 0:
            alpha = _line_search(m, w, nrow, ncon, r)
        else:
            done = 1  # one more factor at the solution, for the adjoint
        _advance(m, w, nrow, ncon, alpha, r)


@wp.func(inline=True)
def _advance(m: wp.ref[Tables], w: wp.ref[World], nrow: int, ncon: int, alpha: f64, r: int):
    """Move ``alpha`` steps."""
    for i in range(m.nv):
        w.acc[r, i] += alpha * w.step[w.t, i]
    _unconstrained_gradient(m, w, r)
    for n in range(nrow):
        w.row_jar[w.t, n] += alpha * w.row_dir[w.t, n]
    for c in range(ncon):
        w.con_jar[w.t, c] = w.con_jar[w.t, c] + w.con_dir[w.t, c] * alpha
