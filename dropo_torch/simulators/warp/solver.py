"""Newton's method for the constrained acceleration, with a factor that keeps the tree's sparsity.

Minimises ½ aᵀMa + aᵀ(c − τ) + Σ s(J a − aref). With pyramidal cones the cost is piecewise quadratic: a full
step that stays on one piece is exact, so the iteration ends after finitely many.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.cone import CURVED, cone_force, cone_hessian, cone_piece
from dropo_torch.simulators.warp.kinematics import packed
from dropo_torch.simulators.warp.rows import row_add, row_dot, row_force, row_state
from dropo_torch.simulators.warp.types import ONE, ZERO, Reals, Reals2, Scratch, Tables, f64, mat33, vec3, vec6

ITERATIONS = wp.constant(60)
LINE_STEPS = wp.constant(50)


@wp.func(inline=True)
def factor(m: Tables, dense: int, hess: Reals2, r: int):
    """H = Lᵀ D L in place, from the last dof to the first: no fill-in along the tree (dense = 0)."""
    for back in range(m.nv):
        k = m.nv - 1 - back
        rk = packed(k, 0)
        inv = ONE / hess[r, rk + k]
        i = m.dof_parent[dense, k]
        while i >= 0:
            ri = packed(i, 0)
            a = hess[r, rk + i] * inv
            j = i
            while j >= 0:
                hess[r, ri + j] -= a * hess[r, rk + j]
                j = m.dof_parent[dense, j]
            hess[r, rk + i] = a
            i = m.dof_parent[dense, i]


@wp.func(inline=True)
def solve(m: Tables, dense: int, hess: Reals2, r: int, x: Reals2, rx: int):
    """x ← H⁻¹ x with the factor of :func:`factor`."""
    for back in range(m.nv):
        i = m.nv - 1 - back
        xi = x[rx, i]
        ri = packed(i, 0)
        j = m.dof_parent[dense, i]
        while j >= 0:
            x[rx, j] -= hess[r, ri + j] * xi
            j = m.dof_parent[dense, j]
    for i in range(m.nv):
        ri = packed(i, 0)
        xi = x[rx, i] / hess[r, ri + i]
        j = m.dof_parent[dense, i]
        while j >= 0:
            xi -= hess[r, ri + j] * x[rx, j]
            j = m.dof_parent[dense, j]
        x[rx, i] = xi


@wp.func(inline=True)
def mass_mul(m: Tables, s: Scratch, t: int, x: Reals2, rx: int, y: Reals2, ry: int):
    """y ← M x."""
    for i in range(m.nv):
        y[ry, i] = ZERO
    for i in range(m.nv):
        ri = packed(i, 0)
        xi = x[rx, i]
        yi = s.mass[t, ri + i] * xi
        j = m.dof_parent[0, i]
        while j >= 0:
            mij = s.mass[t, ri + j]
            yi += mij * x[rx, j]
            y[ry, j] += mij * xi
            j = m.dof_parent[0, j]
        y[ry, i] += yi


@wp.func(inline=True)
def contact_dot(m: Tables, s: Scratch, t: int, c: int, x: Reals2, r: int) -> vec6:
    """J x of contact ``c``."""
    y = vec6()
    base = c * m.nv
    for i in range(m.nv):
        y += s.con_jac[t, base + i] * x[r, i]
    return y


@wp.func(inline=True)
def _add_contact_hessian(m: Tables, s: Scratch, t: int, dense: int, c: int, ll: mat33, la: mat33, aa: mat33,
                         dim: int, hess: Reals2, r: int):  # fmt: skip
    """H += Jᵀ C J of one contact."""
    base = c * m.nv
    k = s.con_pair[t, c]
    one_sided = int(0)
    i = m.nv - 1
    if m.pair_dense[k] == 0 and dense == 0:
        one_sided = 1
        i = m.body_lastdof[m.pair_body2[k]]
        if i < m.body_lastdof[m.pair_body1[k]]:
            i = m.body_lastdof[m.pair_body1[k]]
    which = 1 - one_sided
    while i >= 0:
        ri = packed(i, 0)
        ji = s.con_jac[t, base + i]
        jl = vec3(ji[0], ji[1], ji[2])
        cl = ll * jl
        if dim > 3:
            ja = vec3(ji[3], ji[4], ji[5])
            cl += la * ja
            ca = wp.transpose(la) * jl + aa * ja
            j = i
            while j >= 0:
                x = s.con_jac[t, base + j]
                hess[r, ri + j] += wp.dot(cl, vec3(x[0], x[1], x[2])) + wp.dot(ca, vec3(x[3], x[4], x[5]))
                j = m.dof_parent[which, j]
        else:
            j = i
            while j >= 0:
                x = s.con_jac[t, base + j]
                hess[r, ri + j] += cl[0] * x[0] + cl[1] * x[1] + cl[2] * x[2]
                j = m.dof_parent[which, j]
        i = m.dof_parent[which, i]


@wp.func(inline=True)
def _add_row_hessian(m: Tables, s: Scratch, t: int, n: int, hess: Reals2, r: int):
    """H += Jᵀ D J of one scalar row."""
    d = s.row_d[t, n]
    c = s.row_coef[t, n]
    for a in range(3):
        i = s.row_dof[t, 3 * n + a]
        if i >= 0:
            for b in range(3):
                j = s.row_dof[t, 3 * n + b]
                if j >= 0 and j <= i:
                    hess[r, packed(i, 0) + j] += d * c[a] * c[b]


@wp.func(inline=True)
def assemble(m: Tables, s: Scratch, t: int, th: Reals, nrow: int, ncon: int, dense: int, hess: Reals2, r: int):
    """H = M + Jᵀ C J and the gradient M a + c − τ − Jᵀ f at the current J a − aref, into ``s.step``."""
    for i in range(m.nh):
        hess[r, i] = s.mass[t, i]
    for i in range(m.nv):
        s.step[t, i] = -s.product[t, i]
    for n in range(nrow):
        kind = s.row_kind[t, n]
        jar = s.row_jar[t, n]
        row_add(s, t, n, row_force(kind, jar, s.row_d[t, n], s.row_loss[t, n]), s.step, t)
        if row_state(kind, jar, s.row_d[t, n], s.row_loss[t, n]) == 1:
            _add_row_hessian(m, s, t, n, hess, r)
    for c in range(ncon):
        k = s.con_pair[t, c]
        dim = m.pair_dim[k]
        w = s.con_jar[t, c]
        o_mu = m.o_pair_friction + 5 * k
        if cone_piece(dim, m.elliptic, th, o_mu, m.impratio, w) != 0:
            f = cone_force(dim, m.elliptic, s.con_d[t, c], th, o_mu, m.impratio, w)
            base = c * m.nv
            for i in range(m.nv):
                s.step[t, i] += wp.dot(s.con_jac[t, base + i], f)
            ll, la, aa = cone_hessian(dim, m.elliptic, s.con_d[t, c], th, o_mu, m.impratio, w)
            _add_contact_hessian(m, s, t, dense, c, ll, la, aa, dim, hess, r)


@wp.func
def _slopes(m: Tables, s: Scratch, t: int, th: Reals, nrow: int, ncon: int, alpha: f64, linear: f64, quad: f64):
    """φ'(α) and φ''(α) of the cost along the step."""
    d1 = linear + alpha * quad
    d2 = quad
    for n in range(nrow):
        kind = s.row_kind[t, n]
        y = s.row_dir[t, n]
        jar = s.row_jar[t, n] + alpha * y
        d = s.row_d[t, n]
        d1 -= row_force(kind, jar, d, s.row_loss[t, n]) * y
        if row_state(kind, jar, d, s.row_loss[t, n]) == 1:
            d2 += d * y * y
    for c in range(ncon):
        k = s.con_pair[t, c]
        dim = m.pair_dim[k]
        dw = s.con_dir[t, c]
        w = s.con_jar[t, c] + dw * alpha
        o_mu = m.o_pair_friction + 5 * k
        if cone_piece(dim, m.elliptic, th, o_mu, m.impratio, w) != 0:
            d1 -= wp.dot(cone_force(dim, m.elliptic, s.con_d[t, c], th, o_mu, m.impratio, w), dw)
            ll, la, aa = cone_hessian(dim, m.elliptic, s.con_d[t, c], th, o_mu, m.impratio, w)
            yl = vec3(dw[0], dw[1], dw[2])
            ya = vec3(dw[3], dw[4], dw[5])
            d2 += wp.dot(yl, ll * yl) + f64(2.0) * wp.dot(yl, la * ya) + wp.dot(ya, aa * ya)
    return d1, d2


@wp.func
def _line_search(m: Tables, s: Scratch, t: int, th: Reals, nrow: int, ncon: int, acc: Reals2, r: int) -> f64:
    """The root of φ' along the step: Newton's iteration kept in a bracket."""
    mass_mul(m, s, t, s.step, t, s.work, t)
    linear = ZERO
    quad = ZERO
    for i in range(m.nv):
        linear += s.product[t, i] * s.step[t, i]
        quad += s.work[t, i] * s.step[t, i]
    start, _curve = _slopes(m, s, t, th, nrow, ncon, ZERO, linear, quad)
    low = ZERO
    high = f64(-1.0)
    alpha = ONE
    for _k in range(LINE_STEPS):
        d1, d2 = _slopes(m, s, t, th, nrow, ncon, alpha, linear, quad)
        if wp.abs(d1) <= f64(1.0e-15) * wp.abs(start):
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
def newton(
    m: Tables, s: Scratch, t: int, th: Reals, nrow: int, ncon: int, dense: int, acc: Reals2, hess: Reals2, r: int
):
    """Solve for ``acc[r]`` from the guess it holds; leave the factor of H at the solution in ``hess[r]``."""
    for n in range(nrow):
        s.row_jar[t, n] = row_dot(s, t, n, acc, r) - s.row_aref[t, n]
    for c in range(ncon):
        s.con_jar[t, c] = contact_dot(m, s, t, c, acc, r) - s.con_aref[t, c]
    mass_mul(m, s, t, acc, r, s.product, t)
    for i in range(m.nv):
        s.product[t, i] += s.load[t, i]
    done = int(0)
    for _k in range(ITERATIONS):
        assemble(m, s, t, th, nrow, ncon, dense, hess, r)
        factor(m, dense, hess, r)
        if done != 0:
            break
        solve(m, dense, hess, r, s.step, t)
        same = int(1)
        curved = int(0)
        for n in range(nrow):
            y = row_dot(s, t, n, s.step, t)
            s.row_dir[t, n] = y
            kind = s.row_kind[t, n]
            jar = s.row_jar[t, n]
            d = s.row_d[t, n]
            loss = s.row_loss[t, n]
            if row_state(kind, jar, d, loss) != row_state(kind, jar + y, d, loss):
                same = 0
        for c in range(ncon):
            y6 = contact_dot(m, s, t, c, s.step, t)
            s.con_dir[t, c] = y6
            k = s.con_pair[t, c]
            dim = m.pair_dim[k]
            o_mu = m.o_pair_friction + 5 * k
            w = s.con_jar[t, c]
            before = cone_piece(dim, m.elliptic, th, o_mu, m.impratio, w)
            after = cone_piece(dim, m.elliptic, th, o_mu, m.impratio, w + y6)
            if before != after:
                same = 0
            elif m.elliptic != 0 and dim > 1 and after == CURVED:
                curved = 1
        if same != 0 and curved == 0:
            for i in range(m.nv):
                acc[r, i] += s.step[t, i]
            break
        alpha = ONE
        small = int(1)
        for i in range(m.nv):
            if wp.abs(s.step[t, i]) > f64(1.0e-11) * (ONE + wp.abs(acc[r, i])):
                small = 0
        if small == 0:
            alpha = _line_search(m, s, t, th, nrow, ncon, acc, r)
        else:
            done = 1  # one more factor at the solution, for the adjoint
        _advance(m, s, t, nrow, ncon, alpha, acc, r)


@wp.func(inline=True)
def _advance(m: Tables, s: Scratch, t: int, nrow: int, ncon: int, alpha: f64, acc: Reals2, r: int):
    """Move ``alpha`` steps."""
    for i in range(m.nv):
        acc[r, i] += alpha * s.step[t, i]
    mass_mul(m, s, t, acc, r, s.product, t)
    for i in range(m.nv):
        s.product[t, i] += s.load[t, i]
    for n in range(nrow):
        s.row_jar[t, n] += alpha * s.row_dir[t, n]
    for c in range(ncon):
        s.con_jar[t, c] = s.con_jar[t, c] + s.con_dir[t, c] * alpha
