"""Limbs that move apart from each other: what changes in one shows nowhere else, so that one simulation serves all.

A robot's legs on a stand, or two arms, have no joint in common. Where nothing touches and nothing couples them, changes
of a number at each are found together (Curtis, Powell and Reid 1974).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from dropo_torch.data.features import Features
from dropo_torch.effects.actuator import driven_joint
from dropo_torch.effects.base import Effect, Placed, Setting, object_number
from dropo_torch.effects.engine import Variant

#: Simulates hypotheses from changed initial states, and returns their residuals ``(K, W, N)``.
Simulate = Callable[[Sequence[Variant], np.ndarray | None], np.ndarray]


@dataclass(frozen=True)
class Limbs:
    """Kinematic trees that nothing couples, two or more.

    Attributes:
        setting: the model.
        features: the limb of each feature, ``(m,)``.
    """

    setting: Setting
    features: np.ndarray

    @classmethod
    def of(cls, setting: Setting, chart: Features, placed: Sequence[Placed]) -> Limbs | None:
        """Return those of a model with effects; ``None`` where there is one alone, or where they may be coupled."""
        model, observation = setting.model, setting.observation
        coupled = model.neq or model.ntendon or model.nflex or setting.signals.contacts.any()
        if coupled or model.ntree < 2 or any(driven_joint(model, i) is None for i in range(model.nu)):
            return None
        if not all(_is_known(p.effect) and p.effect.kind in ("world", "sensor", *_AT_A_LIMB) for p in placed):
            return None
        columns = [*chart.plain, *(q[0] for q in chart.quaternions for _ in range(3))]
        places = np.asarray(observation.index)[columns]
        if (places < 0).any():
            return None
        joints = np.searchsorted(model.jnt_qposadr, np.minimum(places, model.nq - 1), side="right") - 1
        dofs = np.where(places < model.nq, model.jnt_dofadr[joints], places - model.nq)
        return cls(setting, np.asarray(model.dof_treeid[dofs]))

    def at(self, placed: Placed) -> int | None:
        """Return the limb at which an effect acts; ``None`` for one that acts on all, or on what does not move."""
        model, target = self.setting.model, placed.target
        if target is None or not _is_known(placed.effect) or placed.effect.kind not in _AT_A_LIMB:
            return None
        if placed.effect.kind == "body":
            found = int(model.body_treeid[object_number(model, "body", target)])
            return found if found >= 0 else None
        if placed.effect.kind == "joint":
            return int(model.dof_treeid[self.setting.dof(target)])
        joint = driven_joint(model, object_number(model, "actuator", target))
        return None if joint is None else int(model.dof_treeid[model.jnt_dofadr[joint]])

    def where(self, own: Variant, other: Variant, moved: np.ndarray | None) -> int | None:
        """Return the only limb in which a hypothesis, or its initial states, differ from another; ``None`` for none."""
        kept = len(own.placed)
        pairs = list(zip(own.placed, other.placed[:kept], strict=False))
        if other.declared != own.declared or len(pairs) < kept or any(a.key != b.key for a, b in pairs):
            return None
        found = {self.at(b) for a, b in pairs if a.values != b.values} | {self.at(p) for p in other.placed[kept:]}
        found |= set() if moved is None else {int(limb) for limb in self.features[np.any(moved != 0, axis=0)]}
        return next(iter(found)) if len(found) == 1 else None

    def residuals(
        self, own: Variant, at: np.ndarray, others: Sequence[Variant], moved: np.ndarray | None, simulate: Simulate
    ) -> np.ndarray:
        """Return residuals of hypotheses ``(K, W, N)``, as few of which are simulated as can be.

        Args:
            own: a hypothesis from which each differs, at best in one limb.
            at: its residuals, ``(W, N)``.
            others: the hypotheses, K of them.
            moved: changes of their initial states, ``(K, W, m)`` or ``(K, 1, m)``; ``None`` for none.
            simulate: what finds residuals.
        """
        limbs = [self.where(own, v, None if moved is None else moved[k]) for k, v in enumerate(others)]
        groups = _groups(limbs)
        found = simulate(
            [_joined(own, [others[k] for k in group]) for group in groups],
            None if moved is None else np.stack([moved[group].sum(0) for group in groups]),
        )
        out, alone = np.empty((len(others), *at.shape)), list[int]()
        for group, values in zip(groups, found, strict=True):
            if len(group) > 1 and not np.isfinite(values).all():
                alone += group  # nothing is known of the others where one of them diverges
                continue
            for k in group:
                out[k] = values if len(group) == 1 else self._in(limbs[k], values, at)
        if alone:
            out[alone] = simulate([others[k] for k in alone], None if moved is None else moved[alone])
        return out

    def _in(self, limb: int | None, values: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Residuals ``(W, N)`` of one limb beside those of the others as they were."""
        own = np.tile(self.features == limb, values.shape[-1] // len(self.features))
        return np.where(own, values, at)


#: Kinds of effects that act at a limb.
_AT_A_LIMB = ("joint", "actuator", "body")


@cache
def _is_known(effect: Effect) -> bool:
    """Whether an effect is one of the vocabulary: a user's own may couple what it likes."""
    return type(effect).__module__.split(".")[0] == __name__.split(".")[0]


def _groups(limbs: Sequence[int | None]) -> list[list[int]]:
    """Numbers of what differs in limbs, such that each limb is in a group once; what differs elsewhere is alone."""
    groups, used = list[list[int]](), list[set[int]]()
    for k, limb in enumerate(limbs):
        free = next((i for i, taken in enumerate(used) if limb is not None and taken and limb not in taken), len(used))
        if free == len(used):
            groups.append([])
            used.append(set())
        groups[free].append(k)
        used[free] |= set() if limb is None else {limb}
    return groups


def _joined(own: Variant, others: Sequence[Variant]) -> Variant:
    """A hypothesis that differs from one in all in which others do."""
    kept, placed = len(own.placed), list(own.placed)
    for other in others:
        for i, after in enumerate(other.placed[:kept]):
            placed[i] = after if after.values != own.placed[i].values else placed[i]
        placed += other.placed[kept:]
    return others[0] if len(others) == 1 else replace(own, placed=tuple(placed))
