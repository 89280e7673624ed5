"""Effects of contacts: friction, softness and reach of a geom."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import mujoco
import numpy as np

from dropo_torch.effects.base import Effect, Placed, Quantity, Setting, object_number
from dropo_torch.models.contacts import condim, mixing, never_touch

#: Sliding friction of slippery things, from which a search begins where the model has less, or none.
LEAST = 0.1
#: Dimensions of contacts from which on they resist turning about their normal, and rolling.
_TURNS, _ROLLS = 4, 6
#: Geoms that roll.
_ROLLING = tuple(
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER")
)


class ContactEffect(Effect):
    """An effect of every contact of one geom that touches something in the log."""

    kind = "geom"

    def targets(self, setting: Setting) -> list[str | None]:
        return list(itertools.compress(setting.names("geom"), setting.signals.contacts))

    @staticmethod
    def partners(model: mujoco.MjModel, geom: int) -> list[int]:
        """Return the geoms that may touch this one, as MuJoCo filters them."""
        kind, affinity, body = model.geom_contype, model.geom_conaffinity, model.geom_bodyid
        fits = (kind & affinity[geom]) | (kind[geom] & affinity)
        own = int(body[geom])
        return [int(g) for g in np.flatnonzero(fits) if not never_touch(model, own, int(body[g]))]


@dataclass(frozen=True)
class Mixed:
    """The properties of the contacts of two geoms.

    Attributes:
        friction, solref, solimp: as in MJCF, ``(3,)``, ``(2,)`` and ``(5,)``.
        condim: the dimension of the contacts.
    """

    friction: np.ndarray
    solref: np.ndarray
    solimp: np.ndarray
    condim: int

    @classmethod
    def of(cls, model: mujoco.MjModel, one: int, other: int) -> Mixed:
        """Return them as MuJoCo mixes them: of the geom of higher priority, or of both."""
        first, second = model.geom_priority[[one, other]]
        if first != second:
            one = other = one if first > second else other
        pair = [one, other]
        share, references = float(mixing(model, np.array([pair]))[0]), model.geom_solref[pair]
        blended = (references[:, 0] > 0).all() or one == other
        solref = share * references[0] + (1 - share) * references[1] if blended else references.min(0)
        solimp = share * model.geom_solimp[one] + (1 - share) * model.geom_solimp[other]
        return cls(model.geom_friction[pair].max(0), solref, solimp, condim(model, one, other))

    def is_close(self, other: Mixed) -> bool:
        """Return whether contacts of both kinds are the same."""
        fields = ("friction", "solref", "solimp", "condim")
        return all(np.allclose(getattr(self, f), getattr(other, f), rtol=1e-9, atol=0) for f in fields)


@dataclass(frozen=True)
class Deciding:
    """How a geom's contacts are changed, so that none changes with what the model has.

    Contacts with geoms of higher priority are theirs. Where all others are alike, the geom decides them alone;
    otherwise numbers of the geom and of those that it mixes with change alike. Of a robot's contacts with itself none
    counts, unless it has no others: they are rare, and would tie its geoms to each other.

    Attributes:
        geom: the geom.
        equals: geoms of its priority that it may touch.
        kinds: its contacts with these, and with those of lower priority; alone if there are none.
    """

    geom: int
    equals: list[int]
    kinds: list[Mixed]

    @classmethod
    def of(cls, model: mujoco.MjModel, geom: int) -> Deciding:
        """Return how those of a geom are."""
        own, root = model.geom_priority[geom], model.body_rootid[model.geom_bodyid]
        partners = ContactEffect.partners(model, geom)
        partners = [g for g in partners if root[g] != root[geom]] or partners
        kinds = [Mixed.of(model, geom, g) for g in partners if model.geom_priority[g] <= own]
        equals = [g for g in partners if model.geom_priority[g] == own]
        return cls(geom, equals, kinds or [Mixed.of(model, geom, geom)])

    @property
    def friction(self) -> float:
        """Their sliding friction; the largest where they differ."""
        return float(max(kind.friction[0] for kind in self.kinds))

    @property
    def solref(self) -> np.ndarray:
        """Their time constant and damping ratio, ``(2,)``; those of the first where they differ."""
        return self.kinds[0].solref

    def take_over(self, model: mujoco.MjModel) -> bool:
        """Let the geom alone decide its contacts, which stay as they are, where this is possible."""
        kind = self.kinds[0]
        if not all(kind.is_close(other) for other in self.kinds[1:]):
            return False
        for field in ("friction", "solref", "solimp", "condim"):
            getattr(model, f"geom_{field}")[self.geom] = getattr(kind, field)
        model.geom_priority[:] *= 2  # above its equals, and below what is above them
        model.geom_priority[self.geom] += 1
        return True

    def scale(self, field: np.ndarray, ratio: np.ndarray | float) -> None:
        """Multiply numbers of the geom and of its equals, ``field`` of all geoms."""
        field[[self.geom, *self.equals]] *= ratio


class ContactFriction(ContactEffect):
    """Sliding friction of a geom's contacts."""

    name = "contact_friction"
    sentence = "the sliding friction of {target} is not the model's"

    def targets(self, setting: Setting) -> list[str | None]:
        """Return them, those of larger friction first: MuJoCo takes the larger one of a pair."""
        model = setting.model
        return sorted(super().targets(setting), key=lambda t: -model.geom_friction[object_number(model, "geom", t), 0])

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        own = self.own(setting.model, target)
        return (Quantity("friction", "-", own, 0.01 * own, max(5.0, 5 * own), 0.3 * max(own, LEAST)),)

    def own(self, model: mujoco.MjModel, target: str | None) -> float:
        """Return the friction that the model's contacts of this geom have."""
        return Deciding.of(model, object_number(model, "geom", target)).friction

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        size = max(self.own(setting.model, target), LEAST)
        return [np.array([share * size]) for share in (0.9, 0.6, 1.4)]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        deciding = Deciding.of(model, object_number(model, "geom", target))
        if deciding.take_over(model):
            model.geom_friction[deciding.geom, 0] = values[0]
        else:
            deciding.scale(model.geom_friction[:, 0], values[0] / deciding.friction)


class ContactRolling(ContactEffect):
    """Resistance of a geom's contacts to rolling, and to turning on the spot."""

    name = "contact_rolling"
    sentence = "{target} resists rolling otherwise than in the model"

    def targets(self, setting: Setting) -> list[str | None]:
        """Return geoms that touch something, where any of these is round."""
        touching = setting.model.geom_type[setting.signals.contacts]
        return super().targets(setting) if np.isin(touching, _ROLLING).any() else []

    def own(self, model: mujoco.MjModel, target: str | None) -> np.ndarray:
        """Return the rolling and torsional friction that the model's contacts of this geom have, ``(2,)``."""
        kind = Deciding.of(model, object_number(model, "geom", target)).kinds[0]
        return np.where([kind.condim >= _ROLLS, kind.condim >= _TURNS], kind.friction[[2, 1]], 0.0)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        geom = object_number(setting.model, "geom", target)
        size = float(setting.model.geom_rbound[geom]) or 0.1
        names, owns = ("rolling", "torsional"), self.own(setting.model, target)
        return tuple(
            Quantity(name, "m", float(own), 0.0, float(max(size, 5 * own)), 0.02 * size)
            for name, own in zip(names, owns, strict=True)
        )

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        """Begin where rolling costs something: contacts of more dimensions are stiffer along their normal, too."""
        size = np.array([q.scale for q in self.quantities(setting, target)])
        own = self.own(setting.model, target)
        return [own + share * size for share in (0.5, 2.0)]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        if np.array_equal(values, self.own(model, target)):
            return
        deciding = Deciding.of(model, object_number(model, "geom", target))
        if not deciding.take_over(model):  # the larger friction of two geoms counts
            plain = [g for g in deciding.equals if model.geom_condim[g] < _TURNS]
            model.geom_friction[plain, 1:] = 0.0
        model.geom_condim[deciding.geom] = _ROLLS
        model.geom_friction[deciding.geom, 1:] = values[1], values[0]


class ContactStiffness(ContactEffect):
    """Softness and damping of a geom's contacts."""

    name = "contact_stiffness"
    sentence = "contacts of {target} are softer or stiffer than the model's"

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        return [t for t in super().targets(setting) if self.own(m, t)[0] > 0]

    def own(self, model: mujoco.MjModel, target: str | None) -> np.ndarray:
        """Return the time constant and damping ratio that the model's contacts of this geom have."""
        return Deciding.of(model, object_number(model, "geom", target)).solref

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
        deciding = Deciding.of(model, object_number(model, "geom", target))
        if deciding.take_over(model):
            model.geom_solref[deciding.geom] = values
        else:
            deciding.scale(model.geom_solref, np.asarray(values) / deciding.solref)


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
