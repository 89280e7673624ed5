"""Effects of contacts: friction, softness and reach of a geom."""

from __future__ import annotations

import copy
import itertools

import mujoco
import numpy as np

from dropo_torch.effects.base import Effect, Placed, Quantity, Setting, object_number

#: Sliding friction of slippery things, from which a search begins where the model has less, or none.
LEAST = 0.1


class ContactEffect(Effect):
    """An effect of every contact of one geom that touches something in the log."""

    kind = "geom"

    def targets(self, setting: Setting) -> list[str | None]:
        return list(itertools.compress(setting.names("geom"), setting.signals.contacts))

    @staticmethod
    def partners(model: mujoco.MjModel, geom: int) -> list[int]:
        """Return the geoms that may touch this one."""
        kind, affinity, body = model.geom_contype, model.geom_conaffinity, model.geom_bodyid
        fits = (kind & affinity[geom]) | (kind[geom] & affinity)
        return [int(g) for g in np.flatnonzero((body != body[geom]) & (fits != 0))]


def take_over(model: mujoco.MjModel, geom: int, partners: list[int]) -> None:
    """Let one geom alone decide its contacts' properties, which stay as they were mixed."""
    same = [g for g in [geom, *partners] if model.geom_priority[g] == model.geom_priority[geom]]
    if higher := [g for g in partners if model.geom_priority[g] > model.geom_priority[geom]]:
        for field in ("geom_friction", "geom_solref", "geom_solimp", "geom_condim"):
            getattr(model, field)[geom] = getattr(model, field)[higher[0]]
    elif len(same) > 1:
        other = same[1]
        model.geom_friction[geom] = model.geom_friction[same].max(0)
        weights = model.geom_solmix[[geom, other]]
        share = float(weights[0] / weights.sum()) if weights.sum() > 1e-15 else 0.5
        for field in ("geom_solref", "geom_solimp"):
            values = getattr(model, field)
            if field == "geom_solref" and (values[[geom, other], 0] <= 0).any():
                values[geom] = np.minimum(values[geom], values[other])
            else:
                values[geom] = share * values[geom] + (1 - share) * values[other]
        model.geom_condim[geom] = model.geom_condim[same].max()
    model.geom_priority[geom] = model.geom_priority[[geom, *partners]].max() + 1


class ContactFriction(ContactEffect):
    """Sliding friction of a geom's contacts."""

    name = "contact_friction"
    sentence = "the sliding friction of {target} is not the model's"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        own = self.own(setting.model, target)
        return (Quantity("friction", "-", own, 0.01 * own, max(5.0, 5 * own), 0.3 * max(own, LEAST)),)

    def own(self, model: mujoco.MjModel, target: str | None) -> float:
        """Return the friction that the model's contacts of this geom have."""
        geom = object_number(model, "geom", target)
        same = [geom, *self.partners(model, geom)]
        top = model.geom_priority[same].max()
        return float(max(model.geom_friction[g, 0] for g in same if model.geom_priority[g] == top))

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        size = max(self.own(setting.model, target), LEAST)
        return [np.array([share * size]) for share in (0.9, 0.6, 1.4)]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        geom = object_number(model, "geom", target)
        take_over(model, geom, self.partners(model, geom))
        model.geom_friction[geom, 0] = values[0]


class ContactStiffness(ContactEffect):
    """Softness and damping of a geom's contacts."""

    name = "contact_stiffness"
    sentence = "contacts of {target} are softer or stiffer than the model's"

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        return [t for t in super().targets(setting) if self.own(m, t)[0] > 0]

    def own(self, model: mujoco.MjModel, target: str | None) -> np.ndarray:
        """Return the time constant and damping ratio that the model's contacts of this geom have."""
        geom = object_number(model, "geom", target)
        alone = copy.copy(model)
        take_over(alone, geom, self.partners(model, geom))
        return alone.geom_solref[geom].copy()

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        time, ratio = (float(x) for x in self.own(setting.model, target))
        least = 2 * float(setting.model.opt.timestep)
        return (
            Quantity("time_constant", "s", time, min(least, time), 30 * max(time, least), 0.5 * time),
            Quantity("damping_ratio", "-", ratio, 0.05 * ratio, 20 * ratio, 0.5 * ratio),
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        time, ratio = (float(x) for x in self.own(setting.model, target))
        return [np.array([1.15 * time, ratio]), np.array([2 * time, ratio])]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        geom = object_number(model, "geom", target)
        take_over(model, geom, self.partners(model, geom))
        model.geom_solref[geom] = values


class ContactMargin(ContactEffect):
    """A geom whose contacts act from a distance on, as if it were larger: a sole or a coating that the model lacks."""

    name = "contact_margin"
    sentence = "contacts of {target} act from a distance on, as if it were larger than in the model"
    shares = (0.3, 1.5)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        m, geom = setting.model, object_number(setting.model, "geom", target)
        size, own = float(m.geom_rbound[geom]) or 0.1, float(m.geom_margin[geom])
        return (Quantity("margin", "m", 0.0, -own, 0.5 * size, 0.02 * size),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.geom_margin[object_number(model, "geom", target)] += values[0]


_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
#: Geoms that grow by their radius.
_ROUND = (int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE))


class ContactSole(ContactMargin):
    """A geom that is larger than in the model, by a sole or a coating: contacts act where the surface of that is.

    MuJoCo's margin has them act halfway between two geoms. Spheres and capsules grow, and a plane rises. Under any
    other geom, which may touch planes only, these sink by as much, and its margin is twice as large.
    """

    name = "contact_sole"
    known_as = ContactMargin.name
    alone = False
    contains = (ContactMargin.name,)
    sentence = "{target} is larger than in the model, as by a sole or a coating"

    def targets(self, setting: Setting) -> list[str | None]:
        model, touches = setting.model, setting.signals.contacts
        planes = model.geom_type == _PLANE
        fits = planes | np.isin(model.geom_type, _ROUND)
        alone = bool((touches & ~planes).sum() == 1)  # all that it touches are planes, which nothing else touches
        names = setting.names("geom")
        return [t for t in super().targets(setting) if fits[names.index(str(t))] or alone]

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        margin = simpler.effect.name == ContactMargin.name and simpler.target in self.targets(setting)
        return [np.array(simpler.values)] if margin else []

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        geom, by = object_number(model, "geom", target), values[0]
        if model.geom_type[geom] == _PLANE:
            _raise(model, geom, by)
        elif model.geom_type[geom] in _ROUND:
            _grow(model, geom, by)
        else:
            model.geom_margin[geom] += 2 * by
            for plane in self.partners(model, geom):
                if model.geom_type[plane] == _PLANE:
                    _raise(model, plane, -by)


def _raise(model: mujoco.MjModel, plane: int, by: float) -> None:
    """Move a plane along its normal."""
    normal = np.zeros(3)
    mujoco.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), model.geom_quat[plane])
    model.geom_pos[plane] += by * normal
    model.geom_sameframe[plane] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)


def _grow(model: mujoco.MjModel, geom: int, by: float) -> None:
    """Let a sphere or a capsule have a larger radius, and all that bounds it."""
    model.geom_size[geom, 0] += by
    model.geom_rbound[geom] += by
    model.geom_aabb[geom, 3:] += by
    body = model.geom_bodyid[geom]
    first = model.body_bvhadr[body]
    model.bvh_aabb[first : first + model.body_bvhnum[body], 3:] += by
