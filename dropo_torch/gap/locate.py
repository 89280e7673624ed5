"""Where the simulation and the log disagree: by joint and regime from free forces, by place from the screening."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from scipy import stats

from dropo_torch.data.observation import joint_name
from dropo_torch.effects.base import Setting
from dropo_torch.effects.twin import Windows
from dropo_torch.gap.noise import FreeForces
from dropo_torch.gap.result import Place, Residuals
from dropo_torch.gap.screen import Candidate

#: Places that explain less of the gap than this are not listed; at most this many are.
LEAST_SHARE, MOST_PLACES = 0.05, 8
#: p-value, over trajectories, from which on a regime is told.
P_VALUE = 0.01


def dof_names(model: mujoco.MjModel) -> list[str]:
    """Return the joint of every degree of freedom, with its direction where it has several."""
    names = []
    for dof in range(model.nv):
        joint = int(model.dof_jntid[dof])
        offset = dof - int(model.jnt_dofadr[joint])
        width = {0: 6, 1: 3}.get(int(model.jnt_type[joint]), 1)
        names.append(joint_name(model, joint) + (f"[{offset}]" if width > 1 else ""))
    return names


def regressors(setting: Setting, free: FreeForces, dof: int) -> dict[str, tuple[np.ndarray, str, str]]:
    """Return what the force on a degree of freedom may depend on: in words → values ``(W,)``, label, unit."""
    model, windows = setting.model, free.windows
    middle = setting_states(setting, windows.measured[:, windows.length // 2])
    position, velocity = middle[:, : model.nq], middle[:, model.nq :]
    joint = int(model.dof_jntid[dof])
    name = dof_names(model)[dof]
    angular = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    found: dict[str, tuple[np.ndarray, str, str]] = {}
    v = velocity[:, dof]
    speed = "rad/s" if angular else "m/s"
    found[f"with the direction in which {name} moves"] = (np.sign(v), f"velocity of {name}", speed)
    found[f"in proportion to the velocity of {name}"] = (v, f"velocity of {name}", speed)
    found[f"with the square of the velocity of {name}"] = (v * np.abs(v), f"velocity of {name}", speed)
    if int(model.jnt_type[joint]) in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
        q = position[:, model.jnt_qposadr[joint]]
        found[f"with the position of {name}"] = (q, f"position of {name}", "rad" if angular else "m")
    acceleration = (windows_velocity(setting, windows, -1) - windows_velocity(setting, windows, 0))[:, dof]
    found[f"with the acceleration of {name}"] = (acceleration, f"change of velocity of {name}", speed)
    for i in range(model.nu):
        label = setting.names("actuator")[i] if i < model.nactuator else f"command {i}"
        at = windows.steps + windows.length // 2
        u = windows.commands[windows.episodes, at, i]
        before = windows.commands[windows.episodes, np.maximum(at - 3, 0), i]
        found[f"with the command of {label}"] = (u, f"command of {label}", "command")
        found[f"when the command of {label} changes"] = (u - before, f"change of the command of {label}", "command")
    return found


def setting_states(setting: Setting, columns: np.ndarray) -> np.ndarray:
    """Return states ``(W, nq + nv)`` of observed columns; what is not observed has its default."""
    states = np.tile(np.array(setting.observation.default_state), (len(columns), 1))
    states[:, setting.observation.index] = columns
    return states


def windows_velocity(setting: Setting, windows: Windows, at: int) -> np.ndarray:
    """Return velocities ``(W, nv)`` at one instant of every window."""
    return setting_states(setting, windows.measured[:, at])[:, setting.model.nq :]


def regime(setting: Setting, free: FreeForces, dof: int) -> tuple[str, np.ndarray, str, str]:
    """Return what the missing force of a degree of freedom goes with: in words, the variable, its label and unit.

    Each explanation is a regression over the windows of one trajectory; a t-test over trajectories says whether its
    slope has a sign at all, so that neighbouring samples do not count as independent.
    """
    force = free.forces[:, dof]
    known = np.isfinite(force)
    best = ("", np.zeros(len(force)), "", "")
    most = 0.0
    total = float(np.var(force[known])) if known.any() else 0.0
    if total <= 0:
        return best
    mean, error = float(force[known].mean()), float(np.sqrt(total / known.sum()))
    constant = mean**2 / (mean**2 + total)
    if constant > 0.5 and abs(mean) > 5 * error:
        return ("always, and always the same way", *_first(setting, free, dof))
    for words, (values, label, unit) in regressors(setting, free, dof).items():
        if not np.isfinite(values[known]).all() or np.std(values[known]) < 1e-12:
            continue
        share = stats.spearmanr(values[known], force[known]).statistic ** 2
        if share > most * 1.05 + 0.02 and _p_value(values[known], force[known], free.windows.episodes[known]) < P_VALUE:
            best, most = (words, values, label, unit), float(share)
    return best if most > 0.05 else ("", *_first(setting, free, dof))


def _first(setting: Setting, free: FreeForces, dof: int) -> tuple[np.ndarray, str, str]:
    words = list(regressors(setting, free, dof).values())
    return words[1]


def _p_value(values: np.ndarray, force: np.ndarray, episodes: np.ndarray) -> float:
    """p-value that the slope has no sign, over trajectories (or tenths of a single one)."""
    groups = episodes if len(np.unique(episodes)) >= 4 else (np.arange(len(values)) * 10) // len(values)
    slopes = []
    for g in np.unique(groups):
        x, y = values[groups == g], force[groups == g]
        if len(x) > 2 and np.std(x) > 0:
            slopes.append(float(np.cov(x, y)[0, 1] / np.var(x)))
    if len(slopes) < 3:
        return 1.0
    return float(stats.ttest_1samp(slopes, 0.0).pvalue)


def place_of(kind: str, target: str | None) -> tuple[str, str | None]:
    """Return how a place is called in a result."""
    return ("contact" if kind == "geom" else kind), target


def places(
    setting: Setting, free: FreeForces, ranked: Sequence[Candidate], before: float, degrees: float
) -> tuple[Place, ...]:
    """Return where a change could explain the gap, the largest share first.

    Args:
        setting: the model and its columns.
        free: forces that were missing.
        ranked: the screening's candidates.
        before: χ² of the screened windows without them.
        degrees: its degrees of freedom.
    """
    shares: dict[tuple[str, str | None], float] = {}
    for candidate in ranked:
        if candidate.dead:
            continue
        key = place_of(candidate.placed.effect.kind, candidate.placed.target)
        share = 1 - max(candidate.chi2 - degrees, 0.0) / max(before - degrees, 1e-12)
        shares[key] = max(shares.get(key, 0.0), min(max(share, 0.0), 1.0))
    order = sorted(shares.items(), key=lambda item: -item[1])
    words: dict[int, str] = {}
    found = []
    for (kind, name), share in order[:MOST_PLACES]:
        if share < LEAST_SHARE:
            break
        dof = _dof_of(setting, kind, name)
        if dof is not None and dof not in words:
            words[dof] = regime(setting, free, dof)[0]
        found.append(Place(kind, name, share, words.get(dof, "") if dof is not None else ""))
    return tuple(found)


def _dof_of(setting: Setting, kind: str, name: str | None) -> int | None:
    """The degree of freedom in whose force a place shows first."""
    model = setting.model
    if kind == "joint":
        return setting.dof(str(name))
    if kind == "actuator":
        i = setting.names("actuator").index(str(name))
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT:
            return int(model.jnt_dofadr[model.actuator_trnid[i, 0]])
    if kind == "body":
        b = setting.names("body").index(str(name))
        while b > 0 and model.body_dofnum[b] == 0:
            b = int(model.body_parentid[b])
        return int(model.body_dofadr[b]) if b > 0 else None
    if kind == "sensor":
        joint = str(name).rsplit(".", 1)[0]
        names = [joint_name(model, j) for j in range(model.njnt)]
        return int(model.jnt_dofadr[names.index(joint)]) if joint in names else None
    return None


def guilty(free: FreeForces) -> int:
    """Return the degree of freedom whose missing force stands out most against its noise."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return int(np.nanargmax(np.nanmedian(np.abs(free.forces) / free.errors, axis=0)))


def residual_pictures(
    setting: Setting, before: FreeForces, after: FreeForces, dofs: Sequence[int]
) -> tuple[Residuals, ...]:
    """Return missing forces against what they go with, for some degrees of freedom."""
    names, found = dof_names(setting.model), []
    for dof in dofs:
        _, values, label, unit = regime(setting, before, dof)
        joint = int(setting.model.dof_jntid[dof])
        moves = dof - int(setting.model.jnt_dofadr[joint])
        kind = int(setting.model.jnt_type[joint])
        force = "N" if kind == int(mujoco.mjtJoint.mjJNT_SLIDE) or (kind == 0 and moves < 3) else "N·m"
        variable = values
        if "velocity of" in label and "change" not in label:
            variable = windows_velocity(setting, before.windows, before.windows.length // 2)[:, dof]
        found.append(
            Residuals(f"Missing force at {names[dof]}", f"{label} ({unit})", force, variable,
                      before.forces[:, dof], after.forces[:, dof])
        )  # fmt: skip
    return tuple(found)
