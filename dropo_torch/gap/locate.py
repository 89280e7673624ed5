"""Where the simulation and the log disagree: by joint and regime from free forces, by place from the screening."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy import stats

from dropo_torch.data.observation import joint_name
from dropo_torch.effects.actuator import driven_joint
from dropo_torch.effects.base import Setting, object_number
from dropo_torch.gap.ground import Screening
from dropo_torch.gap.log import blocks_of
from dropo_torch.gap.noise import FreeForces
from dropo_torch.gap.result import Place, Residuals
from dropo_torch.gap.rules import Shown
from dropo_torch.gap.twin import Windows

#: Windows on each side of a change, at least.
LEAST = 10
#: Thresholds of what is told of where and when.
SHOWN = Shown()


@dataclass(frozen=True)
class Regressor:
    """What the force on a degree of freedom may depend on, in short windows.

    Attributes:
        words: the dependence, in words.
        values: what the force is proportional to, ``(W,)``.
        label, unit: of the variable against which the force is shown.
        shown: that variable, ``(W,)``.
    """

    words: str
    values: np.ndarray
    label: str
    unit: str
    shown: np.ndarray


def _joint_of(model: mujoco.MjModel, dof: int) -> tuple[int, int]:
    """The joint of a degree of freedom, and which of its directions that is."""
    joint = int(model.dof_jntid[dof])
    return joint, dof - int(model.jnt_dofadr[joint])


def dof_names(model: mujoco.MjModel) -> list[str]:
    """Return the joint of every degree of freedom, with its direction where it has several."""
    directions = np.bincount(model.dof_jntid, minlength=model.njnt)
    joints = (_joint_of(model, dof) for dof in range(model.nv))
    return [joint_name(model, j) + (f"[{offset}]" if directions[j] > 1 else "") for j, offset in joints]


def force_unit(model: mujoco.MjModel, dof: int) -> str:
    """Return the unit of the generalized force on a degree of freedom."""
    (joint, offset), kinds = _joint_of(model, dof), mujoco.mjtJoint
    kind = int(model.jnt_type[joint])
    return "N" if kind == int(kinds.mjJNT_SLIDE) or (kind == int(kinds.mjJNT_FREE) and offset < 3) else "N·m"


def middles(setting: Setting, windows: Windows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions ``(W, nq)``, velocities ``(W, nv)`` and commands ``(W, nu)`` in the middle of windows."""
    return instants(setting, windows, windows.length // 2)


def instants(setting: Setting, windows: Windows, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions ``(W, nq)``, velocities ``(W, nv)`` and commands ``(W, nu)`` at a row of windows."""
    states = setting.observation.full(windows.measured[:, row], windows.unseen)
    commands = windows.commands[windows.episodes, windows.steps + row]
    return states[:, : setting.model.nq], states[:, setting.model.nq :], commands


def regressors(setting: Setting, windows: Windows, dof: int) -> list[Regressor]:
    """Return what the force on a degree of freedom may depend on; its velocity is the second."""
    model = setting.model
    position, velocity, command = middles(setting, windows)
    joint = int(model.dof_jntid[dof])
    name, v = dof_names(model)[dof], velocity[:, dof]
    angular = force_unit(model, dof) == "N·m"
    speed = (f"velocity of {name}", "rad/s" if angular else "m/s")
    found = [
        Regressor(f"with the direction in which {name} moves", np.sign(v), *speed, v),
        Regressor(f"in proportion to the velocity of {name}", v, *speed, v),
        Regressor(f"with the square of the velocity of {name}", v * np.abs(v), *speed, v),
    ]

    def plainly(words: str, values: np.ndarray, label: str, unit: str) -> None:
        found.append(Regressor(words, values, label, unit, values))

    if model.jnt_type[joint] >= int(mujoco.mjtJoint.mjJNT_SLIDE):
        at = position[:, model.jnt_qposadr[joint]]
        plainly(f"with the position of {name}", at, f"position of {name}", "rad" if angular else "m")
    begin, end = (setting.observation.full(windows.measured[:, i], windows.unseen)[:, model.nq + dof] for i in (0, -1))
    plainly(f"with the acceleration of {name}", end - begin, f"change of {speed[0]}", speed[1])
    earlier = windows.commands[windows.episodes, np.maximum(windows.steps + windows.length // 2 - 3, 0)]
    for i in range(model.nu):
        label = f"command of {setting.names('actuator')[i] if i < model.nactuator else f'command {i}'}"
        plainly(f"with the {label}", command[:, i], label, "command")
        plainly(f"when the {label} changes", command[:, i] - earlier[:, i], f"change of the {label}", "command")
    return found


def regime(setting: Setting, free: FreeForces, dof: int, rules: Shown = SHOWN) -> Regressor:
    """Return what the missing force of a degree of freedom goes with; the velocity without words if with nothing.

    Each explanation is a regression over the windows of one trajectory; a t-test over trajectories says whether its
    slope has a sign at all, so that neighboring samples do not count as independent.
    """
    found = regressors(setting, free.windows, dof)
    best, most = replace(found[1], words=""), 0.0
    more, factor = rules.better
    known = np.isfinite(free.forces[:, dof])
    force, episodes = free.forces[known, dof], free.windows.episodes[known]
    total = float(np.var(force)) if known.any() else 0.0
    if total <= 0:
        return best
    mean, error = float(force.mean()), float(np.sqrt(total / known.sum()))
    if mean**2 / (mean**2 + total) > rules.constant and abs(mean) > rules.sure * error:
        return replace(best, words="always, and always the same way")
    for regressor in found:
        values = regressor.values[known]
        if not np.isfinite(values).all() or np.std(values) < 1e-12:
            continue
        share = stats.spearmanr(values, force).statistic ** 2
        if share > most * factor + more and _p_value(values, force, episodes) < rules.regime:
            best, most = regressor, float(share)
    return best if most > rules.correlation else replace(found[1], words="")


def told_when(setting: Setting, free: FreeForces, dof: int, rules: Shown = SHOWN) -> str:
    """Return when the force on a degree of freedom is missing, in words: in a part of the log, or in a regime."""
    return part_of_log(setting, free, dof, rules) or regime(setting, free, dof, rules).words


def part_of_log(setting: Setting, free: FreeForces, dof: int, rules: Shown = SHOWN) -> str:
    """Return in which part of the log a force is missing, if it is in one alone: before or after something changed.

    The windows are in the order of the log. Where they are best parted in two, the typical square of the force, by its
    error, is many times larger on one side. Forces that come and go with the motion do not differ by as much.
    """
    windows = free.windows
    size = (free.forces[:, dof] / free.errors[:, dof]) ** 2
    order = np.lexsort((windows.steps, windows.episodes))
    order = order[np.isfinite(size[order])]
    size, least = size[order], max(LEAST, len(order) // 10)
    ends = np.arange(least, len(order) - least)
    if not ends.size:
        return ""
    before = np.cumsum(size)[ends - 1]
    after = size.sum() - before
    spread = ends * np.log(before / ends + 1) + (len(order) - ends) * np.log(after / (len(order) - ends) + 1)
    end = int(ends[spread.argmin()])  # the likeliest, if each part has a variance of its own
    first, second = (float(np.median(part)) + 1 for part in np.split(size, [end]))
    if max(first, second) < rules.changes * min(first, second):
        return ""
    from_there = second > first
    row = order[end if from_there else end - 1]
    if windows.episodes.max() > 0:
        episode = windows.episodes[row] + 1
        return f"from episode {episode} on" if from_there else f"up to episode {episode}"
    time = f"{windows.steps[row] * setting.signals.timestep:.3g} s"
    return f"from {time} on" if from_there else f"until {time}"


def _p_value(values: np.ndarray, force: np.ndarray, episodes: np.ndarray) -> float:
    """p-value that the slope has no sign, over trajectories (or tenths of a single one)."""
    found = slopes(values, force, blocks_of(episodes, 4))
    return float(stats.ttest_1samp(found, 0.0).pvalue) if len(found) > 2 else 1.0


def slopes(values: np.ndarray, force: np.ndarray, blocks: np.ndarray) -> list[float]:
    """Return the slope of a force over values in each block that has one, all ``(W,)``."""
    found = []
    for block in np.unique(blocks):
        x, y = values[blocks == block], force[blocks == block]
        if len(x) > 2 and np.std(x) > 0:
            found.append(float(np.cov(x, y)[0, 1] / np.var(x, ddof=1)))
    return found


def places(setting: Setting, free: FreeForces, screening: Screening, rules: Shown = SHOWN) -> tuple[Place, ...]:
    """Return where a change could explain the gap, the largest share first.

    Args:
        setting: the model and its columns.
        free: forces that were missing.
        screening: what the candidates promise.
        rules: thresholds.
    """
    shares: dict[tuple[str, str | None], float] = {}
    before = max(screening.chi2 - screening.degrees, 1e-12)
    for candidate in screening.ranked:
        if not candidate.dead:
            key = (candidate.placed.effect.kind, candidate.placed.target)
            share = 1 - max(candidate.chi2 - screening.degrees, 0.0) / before
            shares[key] = max(shares.get(key, 0.0), min(max(share, 0.0), 1.0))
    found = []
    for (kind, name), share in sorted(shares.items(), key=lambda item: -item[1])[: rules.places]:
        if share >= rules.place:
            dof = _dof_of(setting, kind, name)
            when = "" if dof is None else told_when(setting, free, dof, rules)
            found.append(Place("contact" if kind == "geom" else kind, name, share, when))
    return tuple(found)


def _dof_of(setting: Setting, kind: str, name: str | None) -> int | None:
    """The degree of freedom in whose force a place shows first."""
    model = setting.model
    if kind == "joint":
        return setting.dof(name)
    if kind == "actuator":
        joint = driven_joint(model, object_number(model, "actuator", name))
        return None if joint is None else int(model.jnt_dofadr[joint])
    if kind == "body":
        moving = int(model.body_weldid[object_number(model, "body", name)])
        return int(model.body_dofadr[moving]) if moving > 0 else None
    if kind == "sensor":
        stem, names = str(name).rsplit(".", 1)[0], [joint_name(model, j) for j in range(model.njnt)]
        return int(model.jnt_dofadr[names.index(stem)]) if stem in names else None
    return None


def standing_out(free: FreeForces) -> np.ndarray:
    """Return by how much each degree of freedom's missing force stands out against its noise, ``(nv,)``."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.nanmedian(np.abs(free.forces) / free.errors, axis=0)


def guilty(free: FreeForces) -> int:
    """Return the degree of freedom whose missing force stands out most against its noise."""
    return int(np.nanargmax(standing_out(free)))


def residual_pictures(setting: Setting, before: FreeForces, after: FreeForces, count: int) -> tuple[Residuals, ...]:
    """Return missing forces against what they go with, for the degrees of freedom where they stand out most."""
    names, found = dof_names(setting.model), []
    for dof in np.argsort(-np.nan_to_num(standing_out(before)))[:count].tolist():
        goes_with = regime(setting, before, dof)
        found.append(
            Residuals(
                f"Missing force at {names[dof]}", f"{goes_with.label} ({goes_with.unit})",
                force_unit(setting.model, dof), goes_with.shown, before.forces[:, dof], after.forces[:, dof],
            )
        )  # fmt: skip
    return tuple(found)
