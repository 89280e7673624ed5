"""The friction cone: force, Hessian and piece of MuJoCo's contact cost, and the leaf its adjoint is the gradient of.

``w = J a − aref`` has the normal first, then two tangents, then the rotations about the three; ``dim`` of them act.
"""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.impedance import damping, impedance, regularization, stiffness
from dropo_torch.simulators.warp.spatial import theta_vec5
from dropo_torch.simulators.warp.types import (
    MINVAL,
    ONE,
    TWO,
    ZERO,
    Tables,
    World,
    f64,
    mat33,
    mat66,
    vec2,
    vec3,
    vec5,
    vec6,
)

#: Piece number of the curved part of an elliptic cone, where the cost is not quadratic.
CURVED = wp.constant(2)


@wp.func(inline=False)
def normal_d(dim: int, elliptic: int, r: f64, invweight: f64, mu: f64, impratio: f64) -> f64:
    """D of the normal (frictionless, elliptic) or of every edge of the pyramid, with r = (1 − d)/d."""
    d = ONE / wp.max(MINVAL, r * invweight)
    if dim > 1 and elliptic == 0:
        # Rpy = 2 μ²/impratio · R, with A multiplied by 1 + μ²
        d = impratio / (TWO * mu * mu * wp.max(MINVAL, r * invweight * (ONE + mu * mu)))
    return d


@wp.struct
class Cone:
    """A friction cone: its dimension, kind, D, and the friction along each tangent and about each axis."""

    dim: wp.int32
    elliptic: wp.int32
    impratio: wp.float64
    d: wp.float64
    mu: vec5


@wp.func(inline=True)
def cone_of(m: wp.ref[Tables], w: wp.ref[World], k: int, d: f64) -> Cone:
    """The cone of pair ``k``."""
    return Cone(m.pair_dim[k], m.elliptic, m.impratio, d, theta_vec5(w.th, m.o_pair_friction + 5 * k))


@wp.func(inline=False)
def _tangential(cone: Cone, w: vec6) -> f64:
    """T: length of all but the normal, each scaled with its friction."""
    tt = ZERO
    for k in range(1, cone.dim):
        y = cone.mu[k - 1] * w[k]
        tt += y * y
    return wp.sqrt(tt)


@wp.func(inline=False)
def cone_piece(cone: Cone, w: vec6) -> int:
    """Which piece of the cost ``w`` is on; equal numbers mean one quadratic, save :data:`CURVED`."""
    piece = int(0)
    if cone.dim == 1:
        if w[0] < ZERO:
            piece = int(1)
    elif cone.elliptic == 0:
        bit = int(1)
        for k in range(1, cone.dim):
            y = cone.mu[k - 1] * w[k]
            if w[0] + y < ZERO:
                piece += bit
            if w[0] - y < ZERO:
                piece += 2 * bit
            bit = 4 * bit
    else:
        mu = cone.mu[0] / wp.sqrt(cone.impratio)
        tan = _tangential(cone, w)
        n = w[0] * mu
        if not (n >= mu * tan or (tan <= ZERO and n >= ZERO)):
            piece = CURVED
            if mu * n + tan <= ZERO or tan <= ZERO:
                piece = int(1)
    return piece


@wp.func(inline=False)
def cone_force(cone: Cone, w: vec6) -> vec6:
    """Contact force −∂s/∂w."""
    f = vec6()
    d = cone.d
    if cone.dim == 1:
        f[0] = wp.max(ZERO, -d * w[0])
    elif cone.elliptic == 0:
        for k in range(1, cone.dim):
            mu = cone.mu[k - 1]
            plus = d * wp.max(ZERO, -(w[0] + mu * w[k]))
            minus = d * wp.max(ZERO, -(w[0] - mu * w[k]))
            f[0] += plus + minus
            f[k] = mu * (plus - minus)
    else:
        piece = cone_piece(cone, w)
        mu1 = cone.mu[0]
        if piece == 1:
            f[0] = -d * w[0]
            for k in range(1, cone.dim):
                mu = cone.mu[k - 1]
                f[k] = -d * cone.impratio * mu * mu / (mu1 * mu1) * w[k]
        elif piece == CURVED:
            reg = mu1 / wp.sqrt(cone.impratio)
            tan = _tangential(cone, w)
            dm = d / (reg * reg * (ONE + reg * reg))
            e = w[0] * reg - reg * tan
            f[0] = -dm * e * reg
            for k in range(1, cone.dim):
                mu = cone.mu[k - 1]
                f[k] = -f[0] / tan * mu * mu * w[k]
    return f


@wp.func(inline=False)
def cone_hessian(cone: Cone, w: vec6):
    """Hessian of the cost: blocks (directions, directions), (directions, rotations), (rotations, rotations)."""
    piece = cone_piece(cone, w)
    ll = mat33()
    la = mat33()
    aa = mat33()
    if cone.dim == 1:
        if piece == 1:
            ll[0, 0] = cone.d
    elif cone.elliptic == 0:
        ll, la, aa = _pyramid_hessian(cone, piece)
    elif piece == 1:
        scale = cone.d * cone.impratio / (cone.mu[0] * cone.mu[0])
        tangents, turns = _squared(cone)
        ll = wp.diag(tangents * scale)
        ll[0, 0] = cone.d
        aa = wp.diag(turns * scale)
    elif piece == CURVED:
        ll, la, aa = _curved_hessian(cone, w)
    return ll, la, aa


@wp.func(inline=False)
def _pyramid_hessian(cone: Cone, piece: int):
    """Blocks of the Hessian of a pyramid, from the edges that act."""
    hess = mat66()
    for k in range(1, cone.dim):
        mu = cone.mu[k - 1]
        plus = cone.d * f64(piece % 2)
        minus = cone.d * f64((piece // 2) % 2)
        piece = piece // 4
        hess[0, 0] += plus + minus
        hess[0, k] = mu * (plus - minus)
        hess[k, 0] = hess[0, k]
        hess[k, k] = mu * mu * (plus + minus)
    return hess[0:3, 0:3], hess[0:3, 3:6], hess[3:6, 3:6]


@wp.func(inline=False)
def _squared(cone: Cone):
    """Squared frictions along the directions, none along the normal, and about them, as far as they act."""
    mu = cone.mu
    third = wp.where(cone.dim > 3, mu[2] * mu[2], ZERO)
    others = wp.where(cone.dim > 4, ONE, ZERO)
    return vec3(ZERO, mu[0] * mu[0], mu[1] * mu[1]), vec3(third, mu[3] * mu[3] * others, mu[4] * mu[4] * others)


@wp.func(inline=False)
def _curved_hessian(cone: Cone, w: vec6):
    """Blocks of the Hessian on the curved part of an elliptic cone.

    In cone coordinates U = (μ₁ w₁, ...), T = |U|, N = μ w₀ the first row is (1, −μ/T U), and the rest
    μN/T³ U Uᵀ + (μ² − μN/T) I.
    """
    tangents, turns = _squared(cone)
    p = wp.cw_mul(tangents, wp.spatial_top(w))
    q = wp.cw_mul(turns, wp.spatial_bottom(w))
    reg = cone.mu[0] / wp.sqrt(cone.impratio)
    tan = _tangential(cone, w)
    dm = cone.d / (reg * reg * (ONE + reg * reg))
    bend = dm * reg * reg * w[0] / tan
    edge = dm * reg * reg / tan
    own = dm * reg * reg - bend
    normal = vec3(ONE, ZERO, ZERO)
    ll = wp.outer(p, p) * (bend / (tan * tan)) - (wp.outer(normal, p) + wp.outer(p, normal)) * edge
    ll = ll + wp.diag(tangents * own + normal * (dm * reg * reg))
    la = wp.outer(p * (bend / (tan * tan)) - normal * edge, q)
    aa = wp.outer(q, q) * (bend / (tan * tan)) + wp.diag(turns * own)
    return ll, la, aa


@wp.func(inline=False)
def cone_slopes(cone: Cone, w: vec6, y: vec6):
    """First and second derivative of the cost at ``w`` along ``y``."""
    d = cone.d
    first = ZERO
    second = ZERO
    if cone.dim == 1:
        if w[0] < ZERO:
            first = d * w[0] * y[0]
            second = d * y[0] * y[0]
    elif cone.elliptic == 0:
        for k in range(1, cone.dim):
            mu = cone.mu[k - 1]
            plus = w[0] + mu * w[k]
            minus = w[0] - mu * w[k]
            if plus < ZERO:
                along = y[0] + mu * y[k]
                first += d * plus * along
                second += d * along * along
            if minus < ZERO:
                along = y[0] - mu * y[k]
                first += d * minus * along
                second += d * along * along
    else:
        piece = cone_piece(cone, w)
        inner = ZERO  # Σ μ² w y
        square = ZERO  # Σ μ² y²
        for k in range(1, cone.dim):
            mu = cone.mu[k - 1]
            inner += mu * mu * w[k] * y[k]
            square += mu * mu * y[k] * y[k]
        if piece == 1:
            scale = cone.impratio / (cone.mu[0] * cone.mu[0])
            first = d * (w[0] * y[0] + scale * inner)
            second = d * (y[0] * y[0] + scale * square)
        elif piece == CURVED:
            reg = cone.mu[0] / wp.sqrt(cone.impratio)
            tan = _tangential(cone, w)
            dm = d / (ONE + reg * reg)  # of N/μ − T, with μ² taken in
            e = w[0] - tan
            along = inner / tan
            first = dm * e * (y[0] - along)
            second = dm * ((y[0] - along) * (y[0] - along) - e * (square - along * along) / tan)
    return first, second


@wp.func(inline=False)
def _elliptic(dim: int, w: vec6, jl: vec6, mu: vec5, d: f64, impratio: f64) -> f64:
    """f · Jλ of an elliptic cone."""
    reg = mu[0] / wp.sqrt(impratio)
    y1 = mu[0] * w[1]
    y2 = mu[1] * w[2]
    y3 = wp.where(dim > 3, mu[2] * w[3], ZERO)
    y4 = wp.where(dim > 4, mu[3] * w[4], ZERO)
    y5 = wp.where(dim > 4, mu[4] * w[5], ZERO)
    tt = y1 * y1 + y2 * y2 + y3 * y3 + y4 * y4 + y5 * y5
    n = w[0] * reg
    out = ZERO
    if tt > ZERO:
        tan = wp.sqrt(tt)
        along = y1 * mu[0] * jl[1] + y2 * mu[1] * jl[2] + y3 * mu[2] * jl[3] + y4 * mu[3] * jl[4] + y5 * mu[4] * jl[5]
        if n >= reg * tan:
            out = ZERO
        elif reg * n + tan <= ZERO:
            out = -d * w[0] * jl[0] - d * impratio / (mu[0] * mu[0]) * along
        else:
            fn = -d / (reg * (ONE + reg * reg)) * (n - reg * tan)
            out = fn * jl[0] - fn / tan * along
    elif n < ZERO:
        out = -d * w[0] * jl[0]
        out -= d * impratio * (w[1] * jl[1] + mu[1] * mu[1] / (mu[0] * mu[0]) * w[2] * jl[2])
    return out


@wp.func(inline=False)
def elliptic_power(
    dim: int, u: vec6, v: vec6, jl: vec6, dist: f64, margin: f64, mu: vec5, solref: vec2, friction_ref: vec2,
    solimp: vec5, invweight: f64, impratio: f64, h: f64, refsafe: int,
) -> f64:  # fmt: skip
    """−f (Jλ) of an elliptic contact with J a = u, J q̇ = v, J λ = jl: the leaf whose gradient the adjoint takes."""
    x = dist - margin
    imp = impedance(x, solimp)
    b = damping(solref, solimp, h, refsafe)
    bf = b
    if friction_ref[0] != ZERO or friction_ref[1] != ZERO:
        bf = damping(friction_ref, solimp, h, refsafe)
    w0 = u[0] + b * v[0] + stiffness(solref, solimp, h, refsafe) * imp * x
    d = normal_d(dim, 1, regularization(imp, ONE), invweight, mu[0], impratio)
    w = vec6(w0, u[1] + bf * v[1], u[2] + bf * v[2], u[3] + bf * v[3], u[4] + bf * v[4], u[5] + bf * v[5])
    return -_elliptic(dim, w, jl, mu, d, impratio)


@wp.func(inline=False)
def contact_scalars(
    dim: int, dist: f64, margin: f64, mu: f64, solref: vec2, solimp: vec5, invweight: f64, impratio: f64, h: f64,
    refsafe: int, dbar: f64, bbar: f64, sbar: f64,
) -> f64:  # fmt: skip
    """Leaf: ⟨D, D̄⟩ + ⟨B, B̄⟩ + ⟨K d(x) x, s̄⟩ of a pyramidal or frictionless contact."""
    x = dist - margin
    imp = impedance(x, solimp)
    return (
        dbar * normal_d(dim, 0, regularization(imp, ONE), invweight, mu, impratio)
        + bbar * damping(solref, solimp, h, refsafe)
        + sbar * stiffness(solref, solimp, h, refsafe) * imp * x
    )
