"""Where dry friction gives before it slides, and over which motion it builds up: what unseen blocks say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dropo_torch.effects.base import Placed, Setting, find_effect
from dropo_torch.effects.presliding import PAST, bristle_after
from dropo_torch.gap.chance import least_surplus
from dropo_torch.gap.forces.motion import Stretch
from dropo_torch.gap.forces.regression import Regression, chance_of, half_widths, unseen
from dropo_torch.gap.forces.terms import AT_REST, FRICTION, PRESLIDING, Terms, sharp
from dropo_torch.gap.rules import Forces

#: Displacements that are tried, by the measured range of the joint.
SHARES = tuple(1e-4 * 2.0**n for n in range(10))
#: The one of friction that does not give; and in units of a position's noise, which hides those up to the last one.
AT_ONCE, HIDDEN = 3e-6, (1.0, 2.0, 4.0)
#: Factors that are tried next to the best of them, in turn.
FINER = ((2.0**-0.5, 2.0**0.5), (2.0**-0.25, 2.0**0.25), (2.0**-0.125, 2.0**0.125))
#: Speeds below which friction that depends on the velocity alone may fall, by the joint's root mean square.
SPEEDS = (0.25 * AT_REST, 0.5 * AT_REST, AT_REST, 0.05, 0.1, 0.2)
#: Relative step of the derivative by a displacement.
STEP = 0.1


@dataclass(frozen=True)
class Giving:
    """Where friction gives before it slides, by the number of the friction's effect.

    Attributes:
        displacements: of those that do.
        sharpness: of those that do not: the speed, by the joint's root mean square, below which they fall; or, with a
            minus, the motion in which they turn, which is no more than the noise of positions hides.
        rivals: the other of the two kinds of friction, where unseen blocks leave open which one it is.
    """

    displacements: Mapping[int, float] = field(default_factory=dict)
    sharpness: Mapping[int, float] = field(default_factory=dict)
    rivals: Mapping[int, Placed] = field(default_factory=dict)


def bristles(position: np.ndarray, displacement: float, speed: float) -> np.ndarray:
    """Return the share of a joint's friction that is built up, -1 to 1, ``(N,)``.

    Args:
        position: of the joint, row by row, ``(N,)``.
        displacement: see :func:`~dropo_torch.effects.presliding.bristle_after`.
        speed: velocity at the first row.
    """
    moved = np.diff(position, prepend=position[0] - PAST * speed)
    found, now = np.empty(len(position)), np.zeros(1)
    for row in range(len(position)):
        now = bristle_after(now, moved[row : row + 1], displacement)
        found[row] = now[0]
    return found


def built_up(setting: Setting, parts: Sequence[Stretch], joint: str | None, displacement: float) -> np.ndarray:
    """Return the forces ``(N, nv)`` that a unit of friction needs which builds up over a displacement."""
    dof, found = setting.dof(joint), []
    for part in parts:
        column = np.zeros(part.velocity.shape)
        column[:, dof] = bristles(part.position[:, dof], displacement, float(part.velocity[0, dof]))
        found.append(part.compared(column))
    return np.concatenate(found)


def displacements(
    setting: Setting, parts: Sequence[Stretch], found: Terms, regression: Regression, chosen: np.ndarray, rules: Forces,
    noise: Mapping[int, float],
) -> Giving:  # fmt: skip
    """Return where friction gives before it slides, over which displacements, and where that is left open.

    At all joints with friction together it must leave less of unseen blocks than friction that depends on the velocity
    alone, by more than chance explains. Then it gives where it leaves clearly less; what one joint does not show by
    itself is left open, and so is what is not surely less than that. Displacements are the best on the same blocks.

    Args:
        setting: the model.
        parts: the motion.
        found: the terms, with friction that does not give.
        regression: of these.
        chosen: the columns that explain unseen blocks, ``(P,)`` bool.
        rules: thresholds.
        noise: standard deviations of the joints' measured positions, by their numbers.
    """
    tried = {
        number: _displacement(setting, parts, found, regression, chosen, number, noise)
        for number in np.unique(found.owner[chosen]).tolist()
        if found.placed[number].effect.name == FRICTION
    }
    clear = {n for n, (_, less, _) in tried.items() if less.mean() > 1 - rules.gives}
    if clear and chance_of(np.sum([less for _, less, _ in tried.values()], axis=0)) > rules.error:
        clear = set()
    rivals = {}
    for n, (displacement, less, _) in tried.items():
        if n in clear and chance_of(less) > rules.error:
            rivals[n] = found.placed[n]
        elif n not in clear and -least_surplus(-less, rules.error) > (1 - rules.gives) * len(less):
            rivals[n] = Placed(find_effect(PRESLIDING), found.placed[n].target, (0.0, displacement))
    return Giving(
        {n: tried[n][0] for n in sorted(clear)}, {n: tried[n][2] for n in tried if n not in clear}, rivals
    )  # fmt: skip


def _displacement(
    setting: Setting, parts: Sequence[Stretch], found: Terms, regression: Regression, chosen: np.ndarray, number: int,
    noise: Mapping[int, float],
) -> tuple[float, np.ndarray, float]:  # fmt: skip
    """The best displacement of a friction, how much less of its joint it leaves in each unseen block ``(B,)``, and the
    sharpness of the best friction that depends on the velocity, or its sign, alone.

    What is left is relative to the mean square that this one leaves.
    """
    joint, column = found.placed[number].target, int(np.flatnonzero(found.owner == number)[0])
    dof, width = setting.dof(joint), float(np.ptp(setting.signals.position[setting.coordinate(joint)]))

    def left(values: np.ndarray) -> np.ndarray:
        return np.asarray(unseen(regression.with_column(column, values), chosen)[:, dof])

    hidden = [noise.get(setting.joint(joint), 0.0) * times for times in HIDDEN]
    shapes = {-AT_ONCE * width, *(-d for d in hidden if d > AT_ONCE * width), *SPEEDS}
    plain = {shape: left(_plain(setting, parts, joint, shape)) for shape in sorted(shapes)}
    sharpest = min(plain, key=lambda speed: float(plain[speed].mean()))
    tried: dict[float, np.ndarray] = {}
    best, near = width, SHARES
    for nearer in (*FINER, ()):
        shown = [best * share for share in near if best * share > hidden[-1]]
        tried |= {d: left(built_up(setting, parts, joint, d)) for d in shown}
        if not tried:
            return best, np.zeros_like(plain[sharpest]), sharpest
        best, near = min(tried, key=lambda d: float(tried[d].mean())), nearer
    less = (plain[sharpest] - tried[best]) / max(float(plain[sharpest].mean()), 1e-300)
    return best, less, sharpest


def _plain(setting: Setting, parts: Sequence[Stretch], joint: str | None, sharpness: float) -> np.ndarray:
    """Forces ``(N, nv)`` that a unit of friction needs which does not give; see :attr:`Giving.sharpness`."""
    shape = sharp if sharpness > 0 else built_up
    return shape(setting, parts, joint, abs(sharpness))


def giving(setting: Setting, parts: Sequence[Stretch], found: Terms, bent: Giving) -> Terms:
    """Return terms in which frictions build up over displacements, or turn as sharply as is found."""
    placed, columns, low = list(found.placed), found.columns.copy(), found.low.copy()
    for number, displacement in bent.displacements.items():
        joint, at = placed[number].target, found.owner == number
        placed[number] = Placed(find_effect(PRESLIDING), joint, (0.0, displacement))
        columns[at], low[at] = built_up(setting, parts, joint, displacement), 0.0
    for number, sharpness in bent.sharpness.items():
        columns[found.owner == number] = _plain(setting, parts, placed[number].target, sharpness)
    return replace(found, placed=tuple(placed), columns=columns, low=low)


def halves(
    setting: Setting, parts: Sequence[Stretch], found: Terms, regression: Regression, chosen: np.ndarray,
    coefficients: np.ndarray,
) -> list[np.ndarray]:  # fmt: skip
    """Return half-widths of the 90 % intervals of each chosen effect's numbers, displacements among them.

    A displacement's are those of a coefficient of the derivative by it.
    """
    members = np.unique(found.owner[chosen]).tolist()
    bent = [n for n in members if found.placed[n].effect.name == PRESLIDING]
    slopes = []
    for number in bent:
        joint, size = found.placed[number].target, coefficients[found.owner == number][0]
        ends = [built_up(setting, parts, joint, found.placed[number].values[1] * (1 + s)) for s in (-STEP, STEP)]
        slopes.append(size * (ends[1] - ends[0]) / (2 * STEP * found.placed[number].values[1]))
    extra = np.full(len(bent), np.inf)
    wider = replace(
        regression, columns=np.concatenate([regression.columns, *(s[None] for s in slopes)]),
        low=np.append(regression.low, -extra), high=np.append(regression.high, extra),
        prior=np.append(regression.prior, extra),
    )  # fmt: skip
    picked, owner = np.append(chosen, extra > 0), np.append(found.owner, np.array(bent, dtype=int))
    widths = half_widths(wider, picked)
    return [widths[owner == n] for n in members]
