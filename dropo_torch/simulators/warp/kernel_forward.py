"""The kernel that simulates: one thread a world, all its physics steps."""

# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# kernel code: Warp reads these functions with types of its own, and a variable of a loop wants int(0)

from __future__ import annotations

from functools import cache

import warp as wp

from dropo_torch.simulators.warp.integrate import good, step
from dropo_torch.simulators.warp.parts import make_kernel, num_activations
from dropo_torch.simulators.warp.types import ZERO, Chunk, Ints, OneTables, Reals2, Tables, World, f64


@wp.func(inline=True)
def _simulate_world(
    m: wp.ref[Tables], w: wp.ref[World], chunk: Chunk, theta: Reals2, states: Reals2, controls: Reals2, alive: Ints,
    out: Reals2, tid: int,
):  # fmt: skip
    """Simulate world number ``tid`` of a launch; see :func:`simulate`."""
    world = chunk.first + tid
    i = chunk.local + tid
    tr = world // chunk.each
    w.th = theta[world % chunk.nparam]
    w.ctrl = controls
    w.applied = chunk.applied
    w.wrenched = chunk.wrenched
    w.t = chunk.slot + tid * chunk.slot_stride
    w.full[w.t] = 0
    base = wp.where(chunk.keep != 0, i, w.t) * chunk.period * m.nstage
    for j in range(m.nq):
        w.qpos[base, j] = states[world // chunk.start_each, j]
    for j in range(m.nv):
        w.qvel[base, j] = states[world // chunk.start_each, m.nq + j]
        w.acc[base, j] = ZERO
    for j in range(num_activations(m)):
        w.act[base, j] = states[world // chunk.start_each, m.nq + m.nv + j]
    ok = int(1)
    n = int(0)
    for logged in range(chunk.lag):
        w.rc = tr * chunk.lag + logged
        for _k in range(chunk.skip):
            if ok != 0:
                ok = step(m, w, base + (n % chunk.period) * m.nstage, base + ((n + 1) % chunk.period) * m.nstage)
                ok *= 1 - w.full[w.t]
            n += 1
        r = base + (n % chunk.period) * m.nstage
        if ok != 0:
            ok = good(m, w, r)
        for j in range(m.nq + m.nv):
            y = f64(wp.nan)
            if ok != 0:
                y = w.qpos[r, j] if j < m.nq else w.qvel[r, j - m.nq]
            out[i * chunk.lag + logged, j] = y
        for j in range(num_activations(m)):
            out[i * chunk.lag + logged, m.nq + m.nv + j] = w.act[r, j]
    alive[i] = ok - w.full[w.t]


def simulate(
    tables: OneTables, w: World, chunk: Chunk, theta: Reals2, states: Reals2, controls: Reals2, alive: Ints, out: Reals2
):
    """Simulate the worlds of a chunk; ``out`` has a row per logged step.

    ``alive`` says whether a world stayed finite; −1 is a world that had more contacts than there is memory for.
    """
    _simulate_world(tables[0], w, chunk, theta, states, controls, alive, out, wp.tid())


@cache
def simulate_kernel(parts: int) -> wp.Kernel:
    """Return the kernel of :func:`simulate` that has some parts, made once."""
    return make_kernel(simulate, parts)
