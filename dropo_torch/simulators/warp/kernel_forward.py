"""The kernel that simulates: one thread a world, all its physics steps."""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

import warp as wp

from dropo_torch.simulators.warp.integrate import good, step
from dropo_torch.simulators.warp.types import ZERO, Ints, Reals2, Rows, Scratch, Tables, f64

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def simulate_kernel(
    m: Tables,
    s: Scratch,
    rows: Rows,
    theta: Reals2,
    states: Reals2,
    controls: Reals2,
    out: Reals2,
    alive: Ints,
    first: int,
    local: int,
    nparam: int,
    each: int,
    lag: int,
    skip: int,
    period: int,
    slot: int,
    slot_stride: int,
    keep: int,
):
    """Simulate world ``first + tid``: transition ``world // each`` under parameter vector ``world % nparam``.

    ``out`` has a row per logged step; ``rows`` keeps every stage (``keep`` 1) or the last two steps.
    """
    tid = wp.tid()
    world = first + tid
    i = local + tid
    tr = world // each
    th = theta[world % nparam]
    t = slot + tid * slot_stride
    base = t * period * m.nstage
    if keep != 0:
        base = i * period * m.nstage
    for j in range(m.nq):
        rows.qpos[base, j] = states[tr, j]
    for j in range(m.nv):
        rows.qvel[base, j] = states[tr, m.nq + j]
        rows.acc[base, j] = ZERO
    ok = int(1)
    n = int(0)
    for step_of in range(lag):
        for _k in range(skip):
            r = base + (n % period) * m.nstage
            nxt = base + ((n + 1) % period) * m.nstage
            if ok != 0:
                ok = step(
                    m, s, t, th, rows.qpos, rows.qvel, rows.rate, rows.acc, rows.soft, rows.hess,
                    rows.soft_hess, rows.held, r, nxt,
                    controls, tr * lag + step_of,
                )  # fmt: skip
            n += 1
        r = base + (n % period) * m.nstage
        if ok != 0:
            ok = good(m, rows.qpos, rows.qvel, r)
        for j in range(m.nq + m.nv):
            y = f64(wp.nan)
            if ok != 0:
                y = rows.qpos[r, j] if j < m.nq else rows.qvel[r, j - m.nq]
            out[i * lag + step_of, j] = y
    alive[i] = ok
