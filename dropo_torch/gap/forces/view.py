"""What the model lacks by the forces at its joints, for logs on which open-loop predictions have no skill.

An arm that is driven by torques drifts: whatever its model lacks, an error of the force grows with the square of time,
and a heavier arm predicts better only because it moves as it did. In the space of forces nothing drifts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects.base import Effect, Placed, Setting, find_effect
from dropo_torch.gap.forces.motion import FORCES, KEPT, has_forces, highest_frequency, stretches
from dropo_torch.gap.forces.payload import PAYLOAD, in_one_place, with_payload
from dropo_torch.gap.forces.presliding import Giving, displacements, giving, halves
from dropo_torch.gap.forces.regression import (
    GAIN,
    Regression,
    chances,
    fit,
    neutral_chances,
    refined,
    refusal,
    score,
    select,
    share_left,
    unseen,
    widest,
)
from dropo_torch.gap.forces.terms import CENTER, FRICTION, PRESLIDING, Terms, linear_effects, needed, terms
from dropo_torch.gap.rules import Forces

#: Rows in half an oscillation at the highest frequency of the motion, which count as one observation.
CORRELATED = 0.5 * KEPT * FORCES


@dataclass(frozen=True)
class ForceView:
    """Effects by which the forces at the joints suit their motion.

    Attributes:
        velocity: of the joints on held-out data, ``(N, nv)``.
        missing: logged force minus what that motion needs in the model as it is, ``(N, nv)``.
        left: the same with the effects, ``(N, nv)``.
        rival: the same with the effects that predictions named; ``None`` where forces cannot tell these.
        placed: the effects, with values; none where forces give no names.
        halves: half-widths of the 90 % intervals of each effect's numbers.
        shares: share of the unseen forces' mean squares that comes back without each.
        ties: for each effect those that may stand in its place: others that explain the log as well, and centers of
            mass of other bodies, which are only known together.
        left_out: what none of the forces needs, with half-widths of the 90 % intervals of its numbers.
    """

    velocity: np.ndarray
    missing: np.ndarray
    left: np.ndarray
    rival: np.ndarray | None = None
    placed: tuple[Placed, ...] = ()
    halves: tuple[np.ndarray, ...] = ()
    shares: tuple[float, ...] = ()
    ties: tuple[tuple[Placed, ...], ...] = ()
    left_out: tuple[tuple[Placed, np.ndarray], ...] = ()

    @property
    def before(self) -> np.ndarray:
        """Root mean square of the missing force of each joint ``(nv,)``."""
        return _rms(self.missing)

    @property
    def after(self) -> np.ndarray:
        """The same with the effects, ``(nv,)``."""
        return _rms(self.left)

    def share(self, left: np.ndarray) -> float:
        """Return the share of the forces' mean squares that is left ``(N, nv)``, averaged over joints that lack any."""
        return share_left(_rms(left) ** 2, self.before**2)

    def beats_rival(self, rules: Forces) -> bool:
        """Return whether the effects leave clearly less than those that predictions named."""
        return self.rival is not None and self.share(self.left) < rules.clearer * self.share(self.rival)


def force_view(
    setting: Setting, train: Trajectories, held: Trajectories, known: Sequence[Effect], rules: Forces,
    rival: Sequence[Placed] = (), noise: Mapping[int, float] | None = None,
) -> ForceView | None:  # fmt: skip
    """Return what the forces at the joints say; ``None`` where the log has not all of them, or is too short.

    Args:
        setting: the model as it is.
        train: the log.
        held: data for the last word.
        known: the vocabulary.
        rules: thresholds.
        rival: effects that predictions named, with values.
        noise: standard deviations of the joints' measured positions, by their numbers, where they are known.
    """
    if not has_forces(setting):
        return None
    placed, highest = linear_effects(setting, known), highest_frequency(train, setting)
    parts, others = (stretches(log, setting, highest) for log in (train, held))
    if not placed or not parts or not others or coarse(setting, train, highest, rules):
        return None
    seen, last = terms(setting, parts, placed), terms(setting, others, placed)
    blocks = _blocks(seen.episodes, rules)
    if blocks is None:
        return None
    regression, theirs = _regression(seen, blocks), _coefficients(placed, last.owner, rival)
    left_by_rival = None if theirs is None else _regression(last, last.episodes).left(theirs)
    chosen = select(regression, seen.owner, _families(seen))
    bent = Giving()
    if find_effect(PRESLIDING) in known:
        bent = displacements(setting, parts, seen, regression, chosen, rules, noise or {})
    if bent.displacements or bent.sharpness:
        seen, last = (giving(setting, p, t, bent) for p, t in ((parts, seen), (others, last)))
        regression = _regression(seen, blocks)
        chosen = select(regression, seen.owner, _families(seen))
    chosen, missing = _settled(seen, regression, chosen, rules), last.missing
    if find_effect(PAYLOAD) in known and (heavy := in_one_place(setting, parts, seen, regression, chosen)) is not None:
        chosen = np.append(_without(seen, chosen, CENTER), np.ones(len(heavy.values), dtype=bool))
        seen, last = (with_payload(setting, p, t, heavy) for p, t in ((parts, seen), (others, last)))
        regression = _regression(seen, blocks)
        chosen = _settled(seen, regression, chosen, rules)
    found = fit(regression, chosen)
    named = ForceView(
        np.concatenate([part.compared(part.velocity) for part in others]), missing,
        _regression(last, last.episodes).left(found), left_by_rival,
    )  # fmt: skip
    if not chosen.any() or named.share(named.left) > rules.left:
        return replace(named, left=missing)
    return replace(
        named,
        placed=tuple(_moved(seen.placed[i], found[seen.owner == i]) for i in np.unique(seen.owner[chosen])),
        halves=tuple(halves(setting, parts, seen, regression, chosen, found)),
        shares=_shares(regression, chosen, seen.owner),
        ties=_ties(seen, regression, chosen, bent.rivals),
        left_out=_left_out(seen, regression, chosen),
    )


def _without(found: Terms, chosen: np.ndarray, name: str) -> np.ndarray:
    """The chosen columns ``(P,)`` bool that are not those of some effect."""
    return chosen & ~np.array([p.effect.name == name for p in found.placed])[found.owner]


def _moved(placed: Placed, numbers: np.ndarray) -> Placed:
    """An effect whose first numbers, those in which forces are linear, are away from their neutral values."""
    values = np.array(placed.values)
    values[: len(numbers)] += numbers
    return placed.at(values)


def _coefficients(placed: Sequence[Placed], owner: np.ndarray, rival: Sequence[Placed]) -> np.ndarray | None:
    """The coefficients ``(P,)`` that effects stand for; ``None`` where some are not among the linear ones."""
    numbers, found = {p.key: n for n, p in enumerate(placed)}, np.zeros(len(owner))
    for p in rival:
        if p.key not in numbers:
            return None
        neutral = placed[numbers[p.key]].values
        found[owner == numbers[p.key]] = np.array(p.values) - np.array(neutral)
    return found


def coarse(setting: Setting, log: Trajectories, highest: float, rules: Forces) -> bool:
    """Return whether the forces that are missing come from the log's sampling: whether half of it makes others.

    Differences of sampled positions err with the square of the step.
    """
    sizes = []
    for rows in (1, 2):
        parts = stretches(log, setting, highest, rows)
        found = [part.compared(part.force - needed(setting.model, part)) for part in parts]
        if not found:
            return True
        sizes.append(_rms(np.concatenate(found)))
    return bool(np.abs(np.log(np.maximum(sizes[1], 1e-300) / np.maximum(sizes[0], 1e-300))).max() > rules.sampled)


def _blocks(episodes: np.ndarray, rules: Forces) -> np.ndarray | None:
    """Blocks of rows ``(N,)``: episodes, or runs of one; none is shorter than what counts as one observation."""
    least, most = rules.blocks
    if len(np.unique(episodes)) >= least:
        return episodes
    count = min(int(len(episodes) / CORRELATED), most)
    return np.arange(len(episodes)) * count // len(episodes) if count >= least else None


def _regression(found: Terms, blocks: np.ndarray) -> Regression:
    """The regression of missing forces; half an oscillation of the motion counts as one observation."""
    return Regression(found.missing, found.columns, found.low, found.high, found.prior, blocks, CORRELATED)


def _families(found: Terms) -> np.ndarray:
    """The kind of effect of each column, ``(P,)``; friction is of one kind, whether or not it gives."""
    names = [FRICTION if p.effect.name == PRESLIDING else p.effect.name for p in found.placed]
    kinds = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return np.array([kinds[n] for n in names])[found.owner]


def _settled(found: Terms, regression: Regression, chosen: np.ndarray, rules: Forces) -> np.ndarray:
    """Of the columns those that may have a name ``(P,)`` bool, each needed beside just these."""
    families, refused = _families(found), np.zeros_like(chosen)
    while True:
        sure = _sure(found, regression, chosen, rules)
        refused |= chosen & ~sure
        allowed = np.isin(families, families[sure]) & ~refused
        chosen = refined(regression, sure, found.owner, allowed)
        if not (chosen & ~sure).any():
            return chosen


def _sure(found: Terms, regression: Regression, chosen: np.ndarray, rules: Forces) -> np.ndarray:
    """Of the chosen columns those that may have a name ``(P,)`` bool: of kinds of effects that chance does not explain.

    What ends at a bound of physics has none. Of the rest, an effect of one number must differ from its neutral value,
    by more than chance explains in any of its kind that were tried (Holm's procedure).
    """
    families, single = _families(found), np.bincount(found.owner)[found.owner] == 1
    kinds = np.unique(families)
    tried = [int((single & (families == k)).sum()) for k in kinds]
    while chosen.any():
        values = fit(regression, chosen)
        bound = chosen & ((values <= found.low) | (values >= found.high))
        present = [k for k in kinds if (chosen & (families == k)).any()]
        likely = chances(regression, chosen, [chosen & (families == k) for k in present])
        worst = int(np.argmax(likely))
        neutral = neutral_chances(regression, chosen, values)
        unsure = [
            (float(refusal(neutral[own], count) / rules.error), own)
            for k, count in zip(kinds, tried, strict=True)
            if (own := np.flatnonzero(chosen & single & (families == k))).size
        ]
        if bound.any():
            chosen = chosen & ~np.isin(found.owner, found.owner[bound])
        elif likely[worst] > rules.error / len(kinds):
            chosen = chosen & (families != present[worst])
        elif unsure and max(unsure, key=lambda item: item[0])[0] > 1:
            own = max(unsure, key=lambda item: item[0])[1]
            chosen = chosen & (np.arange(len(chosen)) != own[np.argmax(neutral[own])])
        else:
            break
    return chosen


def _shares(regression: Regression, chosen: np.ndarray, owner: np.ndarray) -> tuple[float, ...]:
    """The share of the first mean squares that comes back without each effect, of unseen blocks."""
    first = unseen(regression, np.zeros_like(chosen)).mean(0)

    def share(columns: np.ndarray) -> float:
        return share_left(unseen(regression, columns).mean(0), first)

    whole = share(chosen)
    gone = [share(chosen & (owner != member)) - whole for member in np.unique(owner[chosen])]
    return tuple(float(np.clip(g / max(1 - whole, 1e-12), 0, 1)) for g in gone)


def _ties(
    found: Terms, regression: Regression, chosen: np.ndarray, told: Mapping[int, Placed]
) -> tuple[tuple[Placed, ...], ...]:
    """For each chosen effect those that may stand in its place, with those that are told already, by its number."""
    members = np.unique(found.owner[chosen]).tolist()
    most, names, ties = score(unseen(regression, chosen)) + GAIN, [p.effect.name for p in found.placed], []
    for member in members:
        without = chosen & (found.owner != member)
        grouped = [m for m in members if m != member and names[m] == names[member] == CENTER]
        others = [n for n in range(len(names)) if n not in members]
        rivals = [n for n in others if score(unseen(regression, without | (found.owner == n))) <= most]
        ties.append((*(found.placed[n] for n in (*grouped, *rivals)), *(told[n] for n in {member} & {*told})))
    return tuple(ties)


def _left_out(found: Terms, regression: Regression, chosen: np.ndarray) -> tuple[tuple[Placed, np.ndarray], ...]:
    """The effects that are not chosen, as large as they are beside all others, and how sure that is.

    The displacement of friction that gives is none of the numbers that are fitted, so it has no interval.
    """
    every = np.ones_like(chosen)
    coefficients = fit(regression, every)
    widths, members = widest(regression, every, coefficients), set(found.owner[chosen].tolist())
    return tuple(
        (moved, np.append(widths[own], np.full(len(moved.values) - own.sum(), np.nan)))
        for n in range(len(found.placed))
        if n not in members
        for own in [found.owner == n]
        for moved in [_moved(found.placed[n], coefficients[own])]
    )


def _rms(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt((values**2).mean(0)))
