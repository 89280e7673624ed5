"""The kernels of the adjoint: one thread a world, its physics steps from last to first, then the sums over worlds."""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

from functools import cache

import warp as wp

from dropo_torch.simulators.warp.activations import activation_power
from dropo_torch.simulators.warp.boxes import box_dual
from dropo_torch.simulators.warp.collide import capsule_box_dual, round_dual, sphere_cylinder_dual, support_dual
from dropo_torch.simulators.warp.cone import contact_scalars, elliptic_power
from dropo_torch.simulators.warp.ellipsoid import ellipsoid_power, ellipsoid_slope_power
from dropo_torch.simulators.warp.fluid import box_power, box_slope_power
from dropo_torch.simulators.warp.integrate import from_tangent, step_adjoint, to_tangent
from dropo_torch.simulators.warp.parts import make_kernel, num_activations
from dropo_torch.simulators.warp.rotations import chart_rate_dual
from dropo_torch.simulators.warp.spatial import late, theta_vec2, theta_vec3, theta_vec5
from dropo_torch.simulators.warp.types import (
    ONE,
    ZERO,
    Chunk,
    Ints,
    OneTables,
    Reals,
    Reals2,
    Tables,
    World,
    mat33,
    vec6,
)

wp.set_module_options({"enable_backward": False})


@wp.func(inline=True)
def _world_adjoint(
    m: wp.ref[Tables], w: wp.ref[World], chunk: Chunk, theta: Reals2, controls: Reals2, alive: Ints, columns: Ints,
    out_bar: Reals2, theta_bar: Reals2, state_bar: Reals2, control_bar: Reals2, tid: int,
):  # fmt: skip
    """Adjoints of world number ``tid`` of a launch; see :func:`adjoint`."""
    _late = wp.grad(late)(ONE)
    world = chunk.first + tid
    i = chunk.local + tid
    tr = world // chunk.nparam
    w.th = theta[world % chunk.nparam]
    w.ctrl = controls
    w.applied = chunk.applied
    w.wrenched = chunk.wrenched
    w.ctrl_bar = control_bar
    w.t = chunk.slot + tid * chunk.slot_stride
    base = i * chunk.period * m.nstage
    seen = ZERO
    for row in range(i * chunk.lag, (i + 1) * chunk.lag):
        for k in range(m.nq + m.nv + num_activations(m)):
            seen += wp.abs(out_bar[row, k])
    # a gradient that arrives at a simulation that diverged
    blank = wp.where(alive[i] <= 0 and seen != ZERO, wp.float64(wp.nan), ZERO)
    for j in range(columns.shape[0]):  # whatever else is added up is never read
        w.grad[w.t, columns[j]] = blank
    for j in range(m.nv):
        w.pos_bar[w.t, j] = blank
        w.rate_bar[w.t, j] = blank
    for j in range(num_activations(m)):
        w.act_end_bar[w.t, j] = blank
    for row in range(i * chunk.lag, (i + 1) * chunk.lag):
        for k in range(control_bar.shape[1]):
            control_bar[row, k] = blank
    if alive[i] > 0 and seen != ZERO:
        for back in range(chunk.lag):
            logged = chunk.lag - 1 - back
            w.rc = tr * chunk.lag + logged
            w.rb = i * chunk.lag + logged
            end = base + (logged + 1) * chunk.skip * m.nstage
            to_tangent(m, w, end, out_bar, w.rb)
            for j in range(m.nv):
                w.rate_bar[w.t, j] += out_bar[w.rb, m.nq + j]
            for j in range(num_activations(m)):
                w.act_end_bar[w.t, j] += out_bar[w.rb, m.nq + m.nv + j]
            for k in range(chunk.skip):
                r = end - (k + 1) * m.nstage
                step_adjoint(m, w, r, r + m.nstage)
    from_tangent(m, w, base, state_bar, i)
    for j in range(m.nv):
        state_bar[i, m.nq + j] = w.rate_bar[w.t, j]
    for j in range(num_activations(m)):
        state_bar[i, m.nq + m.nv + j] = w.act_end_bar[w.t, j]
    for j in range(columns.shape[0]):
        theta_bar[i, j] = w.grad[w.t, columns[j]]


def adjoint(
    tables: OneTables, w: World, chunk: Chunk, theta: Reals2, controls: Reals2, alive: Ints, columns: Ints,
    out_bar: Reals2, theta_bar: Reals2, state_bar: Reals2, control_bar: Reals2,
):  # fmt: skip
    """Adjoints of initial state, controls and the θ ``columns`` of each world, from that of its output."""
    _world_adjoint(
        tables[0], w, chunk, theta, controls, alive, columns, out_bar, theta_bar, state_bar, control_bar, wp.tid()
    )


def leaves(x: wp.array(dtype=vec6), r: wp.array(dtype=mat33), y: Reals):
    """Never launched: makes Warp emit the adjoints of the leaves and of all that they call.

    A function that ``wp.grad`` meets after the forward code has used what it calls gets no adjoint of those, and its
    gradient is silently zero. A kernel with a backward marks them whatever the order.
    """
    a = x[0]
    v = theta_vec3(y, 0)
    v2 = theta_vec2(y, 0)
    v5 = theta_vec5(y, 0)
    s = y[0]
    y[1] = elliptic_power(3, a, a, a, s, s, v5, v2, v2, v5, s, s, s, 1)
    y[8] = contact_scalars(3, s, s, s, v2, v5, s, s, s, 1, s, s, s)
    y[2] = box_power(v, v, v, v, v, s, s, s)
    y[9] = ellipsoid_power(v, v, v, v, v, v, v, v, v, s, s)
    y[10] = box_slope_power(v, v, v, v, v, v, v, s, s, s)
    y[11] = ellipsoid_slope_power(v, v, v, v, v, v, v, v, v, v, v, s, s, 1)
    y[3] = round_dual(v, v, s, v, v, s, 0, s, v, v)
    y[4] = support_dual(3, v, v, r[0], v, 0, v)
    y[0] = capsule_box_dual(v, v, s, v, r[0], v, 0, s, v, v)
    y[5] = sphere_cylinder_dual(v, s, v, v, v, 0, s, v, v)
    y[6] = box_dual(v, r[0], v, v, r[0], v, 0, s, v, v)
    y[7] = chart_rate_dual(v, v, v)
    y[12] = activation_power(4, s, s, v, s)


@cache
def adjoint_kernel(parts: int) -> wp.Kernel:
    """Return the kernel of :func:`adjoint` that has some parts, made once."""
    make_kernel(leaves, parts, differentiated=True)
    return make_kernel(adjoint, parts)


@wp.kernel(enable_backward=False)
def sum_over_transitions(theta_bar: Reals2, total: Reals2, first: int, count: int, nparam: int):
    """Add the worlds ``first ...`` to their parameter vectors, in the order of transitions whatever the chunks."""
    k, j = wp.tid()
    i = (nparam + k - first % nparam) % nparam
    y = total[k, j]
    while i < count:
        y += theta_bar[i, j]
        i += nparam
    total[k, j] = y


@wp.kernel(enable_backward=False)
def sum_over_parameters(bar: Reals2, total: Reals2, first: int, count: int, nparam: int, width: int):
    """Add rows ``world · width + ...`` to their transitions, in the order of parameter vectors."""
    tr, row, j = wp.tid()
    tr += first // nparam
    start = wp.max(tr * nparam, first) - first
    stop = wp.min((tr + 1) * nparam, first + count) - first
    y = total[tr * width + row, j]
    for i in range(start, stop):
        y += bar[i * width + row, j]
    total[tr * width + row, j] = y
