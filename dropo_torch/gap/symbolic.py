"""A sparse formula for a missing force that has no name: offered, not claimed."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np

from dropo_torch.effects.base import Setting
from dropo_torch.gap.locate import dof_names, setting_states
from dropo_torch.gap.noise import FreeForces

#: Terms are kept whose share of the force's deviation is at least this.
THRESHOLD = 0.15
#: Share of the variance below which no formula is worth offering, and the most terms that one may have.
WORTH, TERMS = 0.5, 5


def describe(setting: Setting, free: FreeForces, dof: int) -> str:
    """Return a formula for the missing force at a degree of freedom, or nothing if none describes it.

    Sequentially thresholded least squares (SINDy; Brunton, Proctor, Kutz 2016) over positions, velocities, their signs
    and squares, and commands, at the middle of short windows.
    """
    library = _library(setting, free, dof)
    force = free.forces[:, dof]
    table = np.stack(list(library.values()), axis=1)
    usable = np.isfinite(force) & np.isfinite(table).all(1)
    if usable.sum() < 5 * len(library):
        return ""
    table, force = table[usable], force[usable]
    sizes = np.sqrt((table**2).mean(0))
    size = float(np.sqrt((force**2).mean()))
    keep = sizes > 1e-12
    names = [n for n, k in zip(library, keep, strict=True) if k]
    table, sizes = table[:, keep] / sizes[keep], sizes[keep]
    if size <= 0:
        return ""
    weights = _sparse(table, force / size)
    explained = 1 - float(((force / size - table @ weights) ** 2).sum() / ((force / size) ** 2).sum())
    chosen = np.flatnonzero(weights)
    if explained < WORTH or not 0 < len(chosen) <= TERMS:
        return ""
    order = chosen[np.argsort(-np.abs(weights[chosen]))]
    signs = ["+" if weights[i] > 0 else "−" for i in order]
    numbers = [f"{abs(weights[i]) * size / sizes[i]:.3g}·{names[i]}" for i in order]
    terms = " ".join(f"{s} {n}" for s, n in zip(signs, numbers, strict=True)).removeprefix("+ ")
    place = dof_names(setting.model)[dof]
    return f"force at {place} ≈ {terms} ({100 * explained:.0f} % of its variance)"


def _sparse(table: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Coefficients ``(p,)``, most of them zero."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pysindy.optimizers import STLSQ

        found = STLSQ(threshold=THRESHOLD, alpha=1e-6, max_iter=50).fit(table, force[:, None])
    return np.asarray(found.coef_).reshape(-1)


def _library(setting: Setting, free: FreeForces, dof: int) -> dict[str, np.ndarray]:
    """Terms of the formula by name, ``(W,)`` each."""
    model, windows = setting.model, free.windows
    middle = setting_states(setting, windows.measured[:, windows.length // 2])
    position, velocity = middle[:, : model.nq], middle[:, model.nq :]
    names = dof_names(model)
    found = {"1": np.ones(len(middle))}
    for d in range(model.nv):
        v, speed = velocity[:, d], f"v({names[d]})"
        found[speed] = v
        if d == dof:
            found[f"sign {speed}"] = np.sign(v)
            found[f"{speed}·|{speed}|"] = v * np.abs(v)
        joint = int(model.dof_jntid[d])
        if int(model.jnt_type[joint]) >= int(mujoco.mjtJoint.mjJNT_SLIDE):
            q, place = position[:, model.jnt_qposadr[joint]], f"q({names[d]})"
            found[place] = q
            if d == dof and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
                found[f"sin {place}"], found[f"cos {place}"] = np.sin(q), np.cos(q)
    at = windows.steps + windows.length // 2
    for i in range(windows.commands.shape[2]):
        found[f"u({setting.names('actuator')[i] if i < model.nactuator else i})"] = windows.commands[
            windows.episodes, at, i
        ]
    return found
