"""All physical numbers of a model that a log may tell, with bounds from physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from dropo_torch.data.observation import joint_name
from dropo_torch.effects.base import Setting
from dropo_torch.parameters import object_names
from dropo_torch.proposal.places import command_kind
from dropo_torch.support.rows import evenly

Kind = Literal["mass", "damping", "friction", "armature", "stiffness", "gain", "contact", "softness", "center", "gear"]

#: A joint's friction, damping and rotor inertia that count, as a share of its typical force, force by speed, inertia.
TYPICAL = 0.1
#: The largest of them, in the same units, and as multiples of the model's own. Through a gear of n, a rotor's inertia
#: counts n² times, and may be many times that of what it moves.
MOST, ROTOR, MULTIPLE = 1.0, 10.0, 3.0
#: How far a center of mass may lie from the model's, in radii of gyration.
AWAY = 0.5
#: Share of the largest joint speed of its kind below which a joint stands still.
STILL = 1e-3
#: Rows at which contacts are looked for.
SAMPLES = 300


@dataclass(frozen=True)
class Candidate:
    """A parameter that may be fitted.

    Attributes:
        name: what it is called.
        kind: what it is.
        spec: its entry of a config's ``parameters``.
        nominal: its value in the model, in the entry's unit.
        size: a change of it that matters, in the entry's unit: errors are judged by it.
        why: where its bounds come from.
    """

    name: str
    kind: Kind
    spec: dict[str, Any]
    nominal: float
    size: float
    why: str

    @property
    def unit(self) -> str:
        """Its unit."""
        return str(self.spec.get("unit", ""))


def all_candidates(setting: Setting, states: np.ndarray) -> tuple[Candidate, ...]:
    """Return the candidates of a model, as the forces, speeds and contacts of a log size them.

    Args:
        setting: the model, and the sizes of the log.
        states: of the log, ``(T, nq + nv)``.
    """
    model = setting.model
    found = [*_masses(model), *_joints(setting), *_actuators(model), *_tendons(model)]
    found += _contacts(model, states)
    return tuple(_unique([*found, *_centers(model)]))


def _unique(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates whose names stand once each."""
    seen: set[str] = set()
    found = []
    for c in candidates:
        if c.name not in seen:
            found.append(c)
        seen.add(c.name)
    return found


def rounded(value: float, digits: int = 3) -> float:
    """Return a number as it is written into a config."""
    return float(f"{value:.{digits}g}")


def _word(name: str) -> str:
    """A name as part of a parameter's: dots and blanks would be read as something else."""
    return "".join(c if c.isalnum() or c == "_" else "_" for c in name)


def _rigid(model: mujoco.MjModel) -> dict[int, list[int]]:
    """Bodies with joints, each with those that are fixed to it, itself first."""
    found: dict[int, list[int]] = {}
    for b in range(1, model.nbody):
        root = int(model.body_weldid[b])
        if root != 0 and model.body_mass[b] > 0:
            found.setdefault(root, []).append(b)
    return found


def _masses(model: mujoco.MjModel) -> list[Candidate]:
    names, found = object_names(model, "body"), []
    for root, members in _rigid(model).items():
        mass = float(model.body_mass[members].sum())
        name = f"{_word(names[root])}_mass"
        if len(members) == 1:
            own = rounded(mass)
            spec: dict[str, Any] = {
                "field": "body_mass", "name": names[members[0]], "bounds": [rounded(0.5 * own), rounded(2 * own)],
                "unit": "kg", "scale_inertia": True,
            }  # fmt: skip
            found.append(Candidate(name, "mass", spec, mass, mass, "half to double the model's mass, inertia with it"))
        else:
            spec = {
                "field": "body_mass", "name": [names[b] for b in members], "bounds": [0.5, 2.0], "relative": True,
                "scale_inertia": True,
            }  # fmt: skip
            found.append(Candidate(
                name, "mass", spec, 1.0, 1.0, "half to double the model's, of all bodies that are fixed to each other"
            ))  # fmt: skip
    return found


def _centers(model: mujoco.MjModel) -> list[Candidate]:
    names, found = object_names(model, "body"), []
    for members in _rigid(model).values():
        if len(members) > 1:
            continue
        b = members[0]
        radius = float(np.sqrt(0.5 * model.body_inertia[b].sum() / model.body_mass[b]))
        if radius <= 0:
            continue
        for i, axis in enumerate("xyz"):
            own = float(model.body_ipos[b, i])
            spec = {
                "field": "body_ipos", "index": i, "name": names[b],
                "bounds": [rounded(own - AWAY * radius), rounded(own + AWAY * radius)], "unit": "m",
            }  # fmt: skip
            found.append(Candidate(
                f"{_word(names[b])}_centre_{axis}", "center", spec, own, AWAY * radius,
                "half a radius of gyration to either side of the model's",
            ))  # fmt: skip
    return found


def _joints(setting: Setting) -> list[Candidate]:
    model, signals, found = setting.model, setting.signals, []
    for j in range(model.njnt):
        kind, name = int(model.jnt_type[j]), joint_name(model, j)
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            continue
        dofs = np.flatnonzero(model.dof_jntid == j)
        speed, inertia = float(signals.speed[dofs].max()), float(signals.inertia[dofs].mean())
        force = float(signals.force[dofs].max())
        turns = kind != mujoco.mjtJoint.mjJNT_SLIDE
        if speed <= STILL * float(signals.speed.max(initial=0.0)):
            continue
        word = _word(name)
        rate = "N·m·s/rad" if turns else "N·s/m"
        for what, field, own, typical, unit, why in (
            ("damping", "dof_damping", model.dof_damping[dofs[0]], force / speed, rate, "efforts by speeds"),
            ("friction", "dof_frictionloss", model.dof_frictionloss[dofs[0]], force, ("N", "N·m")[turns], "efforts"),
            ("armature", "dof_armature", model.dof_armature[dofs[0]], inertia, ("kg", "kg·m²")[turns], "inertias"),
        ):  # fmt: skip
            if what == "armature" and kind == mujoco.mjtJoint.mjJNT_BALL:
                continue
            largest = ROTOR if what == "armature" else MOST
            most = rounded(max(largest * typical, MULTIPLE * float(own)), 2)
            spec = {"field": field, "name": name, "bounds": [0.0, most], "unit": unit}
            found.append(Candidate(
                f"{word}_{what}", what, spec, float(own), max(float(own), TYPICAL * typical),  # type: ignore[arg-type]
                f"0 up to {'ten times ' if what == 'armature' else ''}the size of the log's {why}",
            ))  # fmt: skip
        if model.jnt_stiffness[j] > 0:
            own = float(model.jnt_stiffness[j])
            spec = {
                "field": "jnt_stiffness", "name": name, "bounds": [rounded(0.5 * own), rounded(2 * own)],
                "unit": "N·m/rad" if turns else "N/m",
            }  # fmt: skip
            found.append(Candidate(f"{word}_stiffness", "stiffness", spec, own, own, "half to double the model's"))
    return found


def _actuators(model: mujoco.MjModel) -> list[Candidate]:
    found = []
    for a, name in enumerate(object_names(model, "actuator")):
        word, takes = _word(name), command_kind(model, a)
        gains = []
        if takes == "position":
            gains += [("kp", "actuator_kp", float(-model.actuator_biasprm[a, 1]))]
        if takes in ("position", "velocity") and model.actuator_biasprm[a, 2] != 0:
            gains += [("kv", "actuator_kv", float(-model.actuator_biasprm[a, 2]))]
        for what, field, own in gains:
            if own > 0:
                spec: dict[str, Any] = {"field": field, "name": name, "bounds": [rounded(0.5 * own), rounded(2 * own)]}
                found.append(Candidate(f"{word}_{what}", "gain", spec, own, own, "half to double the model's"))
        if takes == "effort" and abs(model.actuator_gear[a, 0]) not in (0.0, 1.0):  # 1: commands are forces
            spec = {"field": "actuator_gear", "name": name, "bounds": [0.7, 1.4], "relative": True}
            found.append(Candidate(
                f"{word}_gear", "gear", spec, 1.0, 1.0, "0.7 to 1.4 times the model's: forces are what is commanded"
            ))  # fmt: skip
    return found


def _tendons(model: mujoco.MjModel) -> list[Candidate]:
    found = []
    for t, name in enumerate(object_names(model, "tendon")):
        for what, field in (("stiffness", "tendon_stiffness"), ("damping", "tendon_damping")):
            own = float(getattr(model, field).reshape(model.ntendon, -1)[t, 0])
            if own > 0:
                spec: dict[str, Any] = {"field": field, "name": name, "bounds": [0.5, 2.0], "relative": True}
                if getattr(model, field).ndim > 1:
                    spec["index"] = 0
                kind: Kind = "stiffness" if what == "stiffness" else "damping"
                found.append(Candidate(f"{_word(name)}_{what}", kind, spec, 1.0, 1.0, "half to double the model's"))
    return found


# --- contacts ---


def _contacts(model: mujoco.MjModel, states: np.ndarray) -> list[Candidate]:
    """Friction and softness where the log's geoms touch, tied for those that decide a contact together."""
    names = object_names(model, "geom")
    found = []
    groups = touching_groups(model, states)
    for number, group in enumerate(groups):
        moving = [g for g in group if model.body_weldid[model.geom_bodyid[g]] != 0] or group
        word = _word(names[moving[0]]) if len(groups) > 1 or len(moving) == 1 else "contact"
        word = word if not word.startswith("geom") else f"contact{number or ''}"
        own = float(model.geom_friction[group[0], 0])
        objects = [names[g] for g in group]
        if own > 0:
            spec: dict[str, Any] = {
                "field": "geom_friction", "name": objects, "bounds": [rounded(0.3 * own), rounded(2.5 * own)]
            }  # fmt: skip
            found.append(Candidate(
                f"{word}_friction", "contact", spec, own, own, "0.3 to 2.5 times the model's, where geoms touch"
            ))  # fmt: skip
        soft = float(model.geom_solref[group[0], 0])
        if soft > 0 and len({float(model.geom_solref[g, 0]) for g in group}) == 1:
            least = max(2 * float(model.opt.timestep), 0.3 * soft)
            spec = {
                "field": "geom_solref", "index": 0, "name": objects, "bounds": [rounded(least), rounded(3 * soft)],
                "unit": "s",
            }  # fmt: skip
            if least < soft:
                found.append(Candidate(
                    f"{word}_softness", "softness", spec, soft, soft, "time constant of the contact, a third to triple"
                ))  # fmt: skip
    return found


def touching_groups(model: mujoco.MjModel, states: np.ndarray) -> list[list[int]]:
    """Return the geoms whose friction decides contacts in the log, together where they decide one together."""
    owner = {g: g for g in range(model.ngeom)}

    def root(g: int) -> int:
        while owner[g] != g:
            g = owner[g]
        return g

    deciding: set[int] = set()
    data = mujoco.MjData(model)
    for row in evenly(len(states), SAMPLES):
        data.qpos[:], data.qvel[:] = states[row, : model.nq], states[row, model.nq :]
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact[: data.ncon]:
            pair = [int(g) for g in contact.geom if g >= 0]
            if len(pair) < 2 or contact.exclude or contact.dim < 3:
                continue
            own = decides(model, pair[0], pair[1])
            deciding |= set(own)
            if len(own) == 2:
                owner[root(own[1])] = root(own[0])
    groups: dict[int, list[int]] = {}
    for g in sorted(deciding):
        groups.setdefault(root(g), []).append(g)
    return [g for g in groups.values() if np.ptp(model.geom_friction[g, 0]) == 0]


def decides(model: mujoco.MjModel, first: int, second: int) -> list[int]:
    """Return which of two geoms decide the friction between them: the one of higher priority, or of more friction."""
    a, b = model.geom_priority[first], model.geom_priority[second]
    if a != b:
        return [first if a > b else second]
    a, b = model.geom_friction[first, 0], model.geom_friction[second, 0]
    return [first, second] if a == b else [first if a > b else second]
