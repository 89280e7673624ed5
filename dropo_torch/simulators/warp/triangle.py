"""Linear algebra of symmetric matrices whose lower triangles are packed by rows, as sparse as the tree or dense.

``parents`` has two rows: the parent of each dof in the tree, and the dof before it. A matrix without entries beyond
those of the tree has none in its factor either, if the last dof is eliminated first; ``dense`` 1 says that it has some.
These are the innermost loops of all: they are written in C++, on bare memory, where the compiler vectorizes them.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.types import Ints, Ints2, Reals2, Vec6s2, mat33, vec6

_ROWS = """
    const int* parent = &wp::index(parents, dense, 0);
    double* h = &wp::index(matrix, r, 0);
"""


@wp.func_native(
    _ROWS
    + """
    for (int k = n - 1; k >= 0; --k) {
        double* __restrict row = h + k * (k + 1) / 2;
        const double inverse = 1.0 / row[k];
        for (int i = parent[k]; i >= 0; i = parent[i]) {
            double* __restrict to = h + i * (i + 1) / 2;
            const double a = row[i] * inverse;
            if (dense)
                for (int j = 0; j <= i; ++j) to[j] -= a * row[j];
            else
                for (int j = i; j >= 0; j = parent[j]) to[j] -= a * row[j];
            row[i] = a;
        }
    }
"""
)
def factor(parents: Ints2, n: int, dense: int, matrix: Reals2, r: int):
    """A = Lᵀ D L in place, of the matrix in row ``r``."""


@wp.func_native(
    _ROWS
    + """
    double* y = &wp::index(x, rx, 0);
    for (int i = n - 1; i >= 0; --i) {
        const double* row = h + i * (i + 1) / 2;
        const double yi = y[i];
        if (dense)
            for (int j = 0; j < i; ++j) y[j] -= row[j] * yi;
        else
            for (int j = parent[i]; j >= 0; j = parent[j]) y[j] -= row[j] * yi;
    }
    for (int i = 0; i < n; ++i) {
        const double* row = h + i * (i + 1) / 2;
        double yi = y[i] / row[i];
        for (int j = parent[i]; j >= 0; j = parent[j]) yi -= row[j] * y[j];
        y[i] = yi;
    }
"""
)
def solve(parents: Ints2, n: int, dense: int, matrix: Reals2, r: int, x: Reals2, rx: int):
    """x ← A⁻¹ x with the factor of :func:`factor`."""


@wp.func_native(
    _ROWS
    + """
    const double* from = &wp::index(x, rx, 0);
    double* to = &wp::index(y, ry, 0);
    for (int i = 0; i < n; ++i) to[i] = 0.0;
    for (int i = 0; i < n; ++i) {
        const double* row = h + i * (i + 1) / 2;
        const double xi = from[i];
        double sum = row[i] * xi;
        for (int j = parent[i]; j >= 0; j = parent[j]) {
            sum += row[j] * from[j];
            to[j] += row[j] * xi;
        }
        to[i] += sum;
    }
"""
)
def multiply(parents: Ints2, n: int, dense: int, matrix: Reals2, r: int, x: Reals2, rx: int, y: Reals2, ry: int):
    """y ← A x."""


@wp.func_native(
    """
    const int* dof = &wp::index(dofs, first);
    const wp::vec_t<6, double>* column = &wp::index(jacobian, t, start);
    double* h = &wp::index(matrix, r, 0);
    for (int a = 0; a < count; ++a) {
        const double* x = column[a].c;
        double y[6] = {};
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) y[i] += ll.data[i][j] * x[j];
        double* row = h + dof[a] * (dof[a] + 1) / 2;
        if (!turns) {
            for (int b = 0; b <= a; ++b) {
                const double* z = column[b].c;
                row[dof[b]] += y[0] * z[0] + y[1] * z[1] + y[2] * z[2];
            }
            continue;
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                y[i] += la.data[i][j] * x[3 + j];
                y[3 + i] += la.data[j][i] * x[j] + aa.data[i][j] * x[3 + j];
            }
        for (int b = 0; b <= a; ++b) {
            const double* z = column[b].c;
            row[dof[b]] += y[0] * z[0] + y[1] * z[1] + y[2] * z[2] + y[3] * z[3] + y[4] * z[4] + y[5] * z[5];
        }
    }
"""
)
def add_congruence(
    dofs: Ints, first: int, count: int, jacobian: Vec6s2, t: int, start: int, ll: mat33, la: mat33, aa: mat33,
    turns: int, matrix: Reals2, r: int,
):  # fmt: skip
    """A += Jᵀ C J of a contact, whose J has ``count`` columns, of the dofs from place ``first`` on, in rising order.

    C has the blocks (directions, directions), (directions, turns) and (turns, turns); without ``turns`` the first only.
    """


@wp.func_native(
    """
    const int* dof = &wp::index(dofs, first);
    const wp::vec_t<6, double>* column = &wp::index(jacobian, t, start);
    const double* from = &wp::index(x, r, 0);
    wp::vec_t<6, double> y;
    for (int a = 0; a < count; ++a)
        for (int i = 0; i < 6; ++i) y.c[i] += column[a].c[i] * from[dof[a]];
    return y;
"""
)
def jacobian_mul(dofs: Ints, first: int, count: int, jacobian: Vec6s2, t: int, start: int, x: Reals2, r: int) -> vec6:
    """J x of a contact, with J as in :func:`add_congruence`."""


@wp.func_native(
    """
    const int* dof = &wp::index(dofs, first);
    const wp::vec_t<6, double>* column = &wp::index(jacobian, t, start);
    double* to = &wp::index(y, r, 0);
    for (int a = 0; a < count; ++a)
        for (int i = 0; i < 6; ++i) to[dof[a]] += column[a].c[i] * f.c[i];
"""
)
def add_jacobian_force(
    dofs: Ints, first: int, count: int, jacobian: Vec6s2, t: int, start: int, f: vec6, y: Reals2, r: int
):
    """y += Jᵀ f of a contact, with J as in :func:`add_congruence`."""
