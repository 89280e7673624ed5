"""A sparse formula for a missing force that has no name: offered, not claimed."""

from __future__ import annotations

import mujoco
import numpy as np

from dropo_torch.effects.base import Setting
from dropo_torch.gap.locate import dof_names, middles
from dropo_torch.gap.noise import FreeForces
from dropo_torch.gap.rules import Shown

#: Ridge of the fits that drop terms.
RIDGE = 1e-6
#: Name of the term that is 1.
CONSTANT = ""


def describe(setting: Setting, free: FreeForces, dof: int, shown: Shown) -> str:
    """Return a formula for the missing force at a degree of freedom, or nothing if none describes it.

    Sparse regression over positions, velocities, their signs
    and squares, and commands, at the middle of short windows.

    Args:
        setting: the model and its columns.
        free: the missing forces.
        dof: the degree of freedom.
        shown: thresholds.
    """
    library, force = _library(setting, free, dof), free.forces[:, dof]
    table = np.stack(list(library.values()), axis=1)
    usable = np.isfinite(force) & np.isfinite(table).all(1)
    table, force = table[usable], force[usable]
    if len(force) < 5 * len(library) or not force.any():
        return ""
    sizes, size = np.sqrt((table**2).mean(0)), float(np.sqrt((force**2).mean()))
    moving, weights = sizes > 1e-12, np.zeros(len(sizes))
    weights[moving] = sparse_regression(table[:, moving] / sizes[moving], force / size, shown.term)
    coefficients = weights * size / np.where(moving, sizes, 1.0)
    explained = 1 - float(((force - table @ coefficients) ** 2).sum() / (force**2).sum())
    chosen = np.flatnonzero(weights)
    if explained < shown.formula or not 0 < len(chosen) <= shown.terms:
        return ""
    names, order = list(library), chosen[np.argsort(-np.abs(weights[chosen]))]
    terms = [f"{'+' if weights[i] > 0 else '−'} {_term(abs(coefficients[i]), names[i])}" for i in order]
    formula = " ".join(terms).removeprefix("+ ")
    return f"force at {dof_names(setting.model)[dof]} ≈ {formula} ({100 * explained:.0f} % of its mean square)"


def _term(coefficient: float, name: str) -> str:
    return f"{coefficient:.3g}" if name == CONSTANT else f"{coefficient:.3g}·{name}"


def sparse_regression(table: np.ndarray, force: np.ndarray, threshold: float) -> np.ndarray:
    """Return coefficients ``(p,)``, most of them zero: sequentially thresholded least squares.

    Terms whose coefficient is below the threshold are dropped and the others fitted anew, until none is dropped
    (Brunton, Proctor, Kutz 2016, doi:10.1073/pnas.1517384113); a ridge keeps terms that are alike from growing against
    each other meanwhile.

    Args:
        table: the terms, of root mean square 1, ``(W, p)``.
        force: of root mean square 1, ``(W,)``.
        threshold: least coefficient of a term.
    """
    kept = np.arange(table.shape[1])
    while True:
        part = table[:, kept]
        large = np.abs(np.linalg.solve(part.T @ part + RIDGE * np.eye(len(kept)), part.T @ force)) >= threshold
        if large.all():
            break
        kept = kept[large]
    weights = np.zeros(table.shape[1])
    weights[kept] = np.linalg.lstsq(part, force, rcond=None)[0]
    return weights


def _library(setting: Setting, free: FreeForces, dof: int) -> dict[str, np.ndarray]:
    """Terms of the formula by name, ``(W,)`` each."""
    model, names = setting.model, dof_names(setting.model)
    position, velocity, command = middles(setting, free.windows)
    found = {CONSTANT: np.ones(len(velocity))}
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
    for i in range(command.shape[1]):
        found[f"u({setting.names('actuator')[i] if i < model.nactuator else i})"] = command[:, i]
    return found
