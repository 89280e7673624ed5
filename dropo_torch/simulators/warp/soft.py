"""The softness of a constraint at its position, and the adjoint of what follows from it."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.cone import contact_scalars
from dropo_torch.simulators.warp.impedance import damping, impedance_slope, stiffness
from dropo_torch.simulators.warp.spatial import add_at, theta_vec2, theta_vec5
from dropo_torch.simulators.warp.types import MINVAL, ONE, TWO, ZERO, Tables, World, f64


@wp.struct
class Soft:
    """Impedance and reference acceleration −B v − K d(x) x of a constraint."""

    o_ref: wp.int32  # places of solref and solimp in θ
    o_imp: wp.int32
    weight: wp.float64  # approximate inverse inertia
    x: wp.float64  # position less margin
    imp: wp.float64  # d(x)
    slope: wp.float64  # d'(x)
    b: wp.float64
    k: wp.float64


@wp.func(inline=True)
def softness(m: wp.ref[Tables], w: wp.ref[World], o_ref: int, o_imp: int, weight: f64, x: f64) -> Soft:
    """The softness that stands at two places in θ, at the position ``x``."""
    solref = theta_vec2(w.th, o_ref)
    solimp = theta_vec5(w.th, o_imp)
    imp = impedance_slope(x, solimp)
    b = damping(solref, solimp, m.h, m.refsafe)
    return Soft(o_ref, o_imp, weight, x, imp[0], imp[1], b, stiffness(solref, solimp, m.h, m.refsafe))


@wp.func(inline=True)
def soft_adjoint(
    m: wp.ref[Tables], w: wp.ref[World], soft: Soft, dim: int, mu: f64, d: f64, dbar: f64, bbar: f64, sbar: f64
):
    """Adjoints of a constraint's position, inverse inertia and first friction; adds those of solref and solimp.

    ⟨D, D̄⟩ + ⟨B, B̄⟩ + ⟨K d(x) x, s̄⟩ is the number.
    """
    # D is inverse to R = (1 − d)/d · A, of a pyramid to 2 μ² (1 + μ²) R
    xbar = sbar * soft.k * (soft.imp + soft.slope * soft.x)
    weightbar = ZERO
    mubar = ZERO
    if dim > 1:
        mubar = -TWO * dbar * d / mu
    if (ONE - soft.imp) * soft.weight > MINVAL * soft.imp:
        xbar += dbar * d * soft.slope / (soft.imp * (ONE - soft.imp))
        weightbar = -dbar * d / soft.weight
        if dim > 1:
            mubar -= TWO * dbar * d * mu / (ONE + mu * mu)
    if m.want_soft != 0:
        _d, _x, _margin, _mu, refbar, impbar, _w, _r, _h, _s, _1, _2, _3 = wp.grad(contact_scalars)(
            dim, soft.x, ZERO, mu, theta_vec2(w.th, soft.o_ref), theta_vec5(w.th, soft.o_imp), soft.weight, m.impratio,
            m.h, m.refsafe, dbar, bbar, sbar,
        )  # fmt: skip
        add_at(w.grad, w.t, soft.o_ref, refbar)
        add_at(w.grad, w.t, soft.o_imp, impbar)
    return xbar, weightbar, mubar
