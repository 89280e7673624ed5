"""The windows' first states: found one after another, each from where the one before has ended."""

from __future__ import annotations

import mujoco
import numpy as np

from dropo_torch.optimizers.gauss_newton import DIFFERENCE_STEP
from dropo_torch.shooting.equations import FIRST, huber, huber_weight
from dropo_torch.shooting.windows import Windows

#: States from which an episode's first window is tried, and how many of them are followed.
CANDIDATES, FOLLOWED = 24, 4
#: Iterations of an episode's first state, and of a later one.
ITERATIONS = (12, 5)
#: Standard deviation of a later state about the end of the window before it, in sizes of moves.
LATER = 0.1
#: Noise of a column, at least, as a share of its spread: parameters may still be wrong.
LEAST = 0.03


def rough_noise(windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise of each feature by second differences, and its spread over the log, ``(m,)`` each."""
    path = windows.measured
    about = windows.features.difference(path, np.broadcast_to(path[:, :1], path.shape))
    flat = windows.features.difference(path.reshape(-1, path.shape[-1]), path[0, 0])
    spread = flat.std(0)
    spread = np.where(spread > 0, spread, 1.0)
    if windows.length < 3:
        return LEAST * spread, spread
    second = np.abs(np.diff(about, 2, axis=1)).reshape(-1, about.shape[-1])
    return np.clip(1.4826 * np.median(second, 0) / np.sqrt(6), LEAST * spread, spread), spread


def first_states(windows: Windows, mean: np.ndarray, noise: np.ndarray, seed: int) -> np.ndarray:
    """Return initial states ``(W, nq + nv)`` with which the model follows the log at given parameters.

    Args:
        windows: the log.
        mean: parameters in coordinates, ``(d,)``.
        noise: of each feature, ``(m,)``.
        seed: of the states from which episodes are tried.
    """
    states, values = windows.starts.copy(), windows.box.values(mean)[None]
    begins = np.flatnonzero(~windows.follows)
    states[begins], ends = _tried(windows, begins, values, noise, seed)
    while len(begins):
        rows = begins + 1
        goes_on = (rows < len(windows)) & windows.follows[np.minimum(rows, len(windows) - 1)]
        begins, about = rows[goes_on], ends[goes_on]
        if len(begins):
            states[begins], ends, _ = _settled(windows, begins, about, about, values, noise, LATER, ITERATIONS[1])
    return states


def _tried(
    windows: Windows, rows: np.ndarray, values: np.ndarray, noise: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """The best states of episodes' first windows ``(R,)`` from several, and where they end."""
    tried, own = _candidates(windows, rows, seed), np.arange(len(rows))
    paths = windows.paths(rows, tried, values)[:, :, 0]
    found = windows.residuals(rows, paths) / noise
    order = np.argsort(np.nan_to_num((found**2).sum((-1, -2)), nan=np.inf), axis=1, kind="stable")[:, :FOLLOWED]
    about = np.repeat(tried[:, 0], order.shape[1], axis=0)
    chosen = tried[own[:, None], order].reshape(-1, tried.shape[-1])
    many = np.repeat(rows, order.shape[1])
    states, ends, cost = _settled(windows, many, chosen, about, values, noise, FIRST, ITERATIONS[0])
    best = np.argmin(cost.reshape(order.shape), axis=1) + own * order.shape[1]
    return states[best], ends[best]


def _candidates(windows: Windows, rows: np.ndarray, seed: int) -> np.ndarray:
    """States of windows ``(R, C, nq + nv)``: as the log and the model have it, then joints anywhere in their ranges."""
    found = np.repeat(windows.starts[rows][:, None], CANDIDATES, axis=1)
    scatter(windows.model, found, np.random.default_rng(seed))
    seen = windows.observation.index[windows.observation.index < windows.starts.shape[1]]
    found[..., seen] = windows.starts[rows][:, None, seen]
    return found


def scatter(model: mujoco.MjModel, states: np.ndarray, rng: np.random.Generator) -> None:
    """Turn joints anywhere in their ranges, in place, in all but the first states of each row, ``(R, C, nq + ...)``."""
    shape = states.shape[0], states.shape[1] - 1
    for j in range(model.njnt):
        first, kind = int(model.jnt_qposadr[j]), int(model.jnt_type[j])
        if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            low, high = model.jnt_range[j] if model.jnt_limited[j] else model.qpos0[first] + np.array([-np.pi, np.pi])
            if kind == mujoco.mjtJoint.mjJNT_HINGE or model.jnt_limited[j]:
                states[:, 1:, first] = rng.uniform(low, high, shape)
        else:
            first += 3 * (kind == mujoco.mjtJoint.mjJNT_FREE)
            turned = rng.standard_normal((*shape, 4))
            states[:, 1:, first : first + 4] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def _settled(
    windows: Windows, rows: np.ndarray, states: np.ndarray, about: np.ndarray, values: np.ndarray, noise: np.ndarray,
    scale: float, iterations: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Levenberg-Marquardt on the states ``(R, nq + nv)`` of windows, each by itself; states, ends and costs.

    Where a window diverges from its state, it is where the search ends.
    """
    s, width = len(windows.sizes), states.shape[1]
    weight = np.tile(1 / noise, windows.length)
    damping, tried = np.full(len(rows), 1e-2), states
    states, cost = states.copy(), np.full(len(rows), np.inf)
    ends, off, going = states.copy(), np.zeros((len(rows), len(weight))), np.ones(len(rows), dtype=bool)
    for _ in range(iterations):
        path = windows.paths(rows, tried[:, None], values)[:, 0, 0]
        found = windows.residuals(rows, path).reshape(len(rows), -1) * weight
        link = windows.between(tried, about) / scale
        now = np.nan_to_num(huber(found).sum(1) + huber(link).sum(1), nan=np.inf)
        better = now < cost
        going &= ~better | (now < (1 - 1e-3) * cost)
        states[better], ends[better], off[better] = tried[better], path[better, -1, :width], found[better]
        cost[better] = now[better]
        damping = np.where(better, np.maximum(damping / 8, 1e-9), np.maximum(6 * damping, 1e-3))
        going &= np.isfinite(cost) & (damping < 1e6)
        if not going.any():
            break
        moved = windows.moved(np.repeat(states[:, None], s, axis=1), DIFFERENCE_STEP * np.eye(s))
        beside = windows.residuals(rows, windows.paths(rows, moved, values)[:, :, 0]).reshape(len(rows), s, -1) * weight
        factor = huber_weight(off)[:, None]
        slope = np.nan_to_num((beside - off[:, None]) / DIFFERENCE_STEP) * factor
        normal = slope @ slope.swapaxes(1, 2)
        normal[:, range(s), range(s)] *= 1 + damping[:, None]
        link = windows.between(states, about) / scale
        own = (huber_weight(link) / scale) ** 2
        normal[:, range(s), range(s)] += own
        force = np.einsum("rsn,rn->rs", slope, off * factor[:, 0]) + own * link * scale
        step = np.clip(np.linalg.solve(normal, -force[..., None])[..., 0], -1.0, 1.0)
        tried = np.where(going[:, None], windows.moved(states, step), states)
    return states, ends, cost
