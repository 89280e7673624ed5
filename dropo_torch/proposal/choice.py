"""The largest set of candidates that a log tells apart, and what the others are confused with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dropo_torch.proposal.candidates import Candidate, Kind

State = Literal["chosen", "stands for", "confounded", "unseen"]

#: Standard error, in a candidate's size, up to which it counts as told apart.
TOLD = 0.25
#: One up to which nothing is left out.
CERTAIN = 0.1
#: How readily a candidate is left out: what models have right more often goes first.
READINESS: dict[Kind, float] = {
    "mass": 1.0, "damping": 0.8, "friction": 0.7, "armature": 1.1, "stiffness": 1.0, "gain": 1.2, "contact": 0.8,
    "softness": 2.0, "center": 3.0, "gear": 6.0,
}  # fmt: skip
#: Share of a candidate's effect that the chosen ones make up for, from which on they are confused with it.
EXPLAINED = 0.9
#: Weight of a chosen candidate in that, in its size, from which on it is named; and how many are named.
WEIGHT, NAMED = 0.1, 4
#: How far off, in its size, a confounded candidate is thought to be at most.
OFF = 0.3
#: Standard error, in sizes, beyond which one is as bad as another: readiness alone then says what goes.
LOST = 1.0
#: Share of what parameters do by themselves, squared, that a combination of them must do to count: differences are
#: no more exact, nor are models. A scale common to all masses and gains does nothing, and would seem to do a little.
ACCURACY, NOTHING = 1e-5, 1e-18


@dataclass(frozen=True)
class Told:
    """What a log tells of one candidate.

    Attributes:
        candidate: the candidate.
        state: ``chosen``: told apart from all others; ``stands for``: chosen, but with what it is confused with;
            ``confounded``: left out, as chosen ones make up for it; ``unseen``: left out, as it hardly moves anything.
        error: standard error to expect beside the chosen ones, in the candidate's unit.
        with_: the candidates that it is confused with, and by how many of their units for one of its own.
    """

    candidate: Candidate
    state: State
    error: float
    with_: tuple[tuple[str, float], ...] = ()

    @property
    def percent(self) -> float:
        """The error relative to the model's value, or where that is 0 to the size that matters, as a share."""
        own = abs(self.candidate.nominal)
        return self.error / (own if own > 0 and self.candidate.kind != "center" else self.candidate.size)

    @property
    def is_in(self) -> bool:
        """Whether it is in the config."""
        return self.state in ("chosen", "stands for")


@dataclass(frozen=True)
class Group:
    """Candidates that are told only in some combinations.

    Attributes:
        names: the candidates.
        directions: the combinations: name → weight, each in sizes of the candidates, with their standard errors.
    """

    names: tuple[str, ...]
    directions: tuple[tuple[tuple[tuple[str, float], ...], float], ...]


@dataclass(frozen=True)
class Choice:
    """What of all candidates is fitted, and why the others are not.

    Attributes:
        told: each candidate.
        groups: those that are told only together.
        gram: Fisher information in the candidates' sizes, ``(d, d)``.
    """

    told: tuple[Told, ...]
    groups: tuple[Group, ...]
    gram: np.ndarray

    @property
    def chosen(self) -> tuple[Told, ...]:
        """The candidates of the config."""
        return tuple(t for t in self.told if t.is_in)

    @property
    def summary(self) -> str:
        """How many candidates are told, in a sentence."""
        single = sum(t.state == "chosen" for t in self.told)
        unseen = sum(t.state == "unseen" for t in self.told)
        parts = [f"{single} {'is' if single == 1 else 'are'} identifiable one by one"]
        together, count = sum(len(g.names) for g in self.groups), sum(len(g.directions) for g in self.groups)
        parts += [f"{together} only as {count} combination{'' if count == 1 else 's'}"] if together else []
        loose = len(self.told) - single - unseen - together
        parts += [f"{loose} weakly, beside the others"] if loose > 0 else []
        parts += [f"{unseen} not at all"] if unseen else []
        return "; ".join(parts)


def choose(candidates: Sequence[Candidate], gram: np.ndarray, forced: Sequence[str] | None = None) -> Choice:
    """Return the largest set that is told apart.

    Candidates that tell nothing by themselves are left out; of the others, the one of the largest error, weighed by how
    readily it is left out, goes until all that are left have small ones; then each that fits beside them comes back.

    Args:
        candidates: the candidates.
        gram: Fisher information in their sizes, ``(d, d)``.
        forced: names to choose instead.
    """
    ready = np.array([READINESS[c.kind] for c in candidates])
    alone = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    if forced is None:
        kept = _eliminated(gram, ready, [i for i in range(len(candidates)) if alone[i] <= TOLD])
        kept = _returned(gram, ready, kept, [i for i in range(len(candidates)) if alone[i] <= TOLD])
    else:
        kept = [i for i, c in enumerate(candidates) if c.name in forced]
    own = _errors(gram, kept)
    confused = _confused(gram, kept, [i for i in range(len(candidates)) if i not in kept and alone[i] <= TOLD])
    partners: dict[int, dict[int, float]] = {}
    for i, weights in confused.items():
        for k, weight in weights.items():
            if abs(weight) * OFF > 2 * own[kept.index(k)]:
                partners.setdefault(k, {})[i] = weight
    told = []
    for i, c in enumerate(candidates):
        if i in kept:
            state: State = "stands for" if i in partners else "chosen"
            error, others = own[kept.index(i)], partners.get(i, {})
        else:
            state = "unseen" if alone[i] > TOLD else "confounded"
            error, others = _errors(gram, [*kept, i])[-1], confused.get(i, {})
        most = sorted(others.items(), key=lambda item: -abs(item[1]))[:NAMED]
        named = tuple((candidates[k].name, float(w * candidates[k].size / c.size)) for k, w in most)
        told.append(Told(c, state, float(error * c.size), named))
    return Choice(tuple(told), _groups(candidates, gram, kept, confused, partners), gram)


def _errors(gram: np.ndarray, kept: Sequence[int]) -> np.ndarray:
    """Standard errors of some candidates, fitted together, in their sizes; infinite along what does nothing."""
    scale, values, vectors = _normalized(gram[np.ix_(kept, kept)])
    variance = (vectors**2) @ (1 / np.where(values > ACCURACY, values, NOTHING))
    return np.asarray(np.sqrt(variance) / scale)


def _normalized(part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scales with which an information matrix has a diagonal of 1, and its eigenvalues and vectors then."""
    scale = np.sqrt(np.maximum(np.diag(part), 1e-300))
    return (scale, *np.linalg.eigh(part / np.outer(scale, scale)))


def _inverse(part: np.ndarray) -> np.ndarray:
    """The inverse of an information matrix, without what does nothing."""
    scale, values, vectors = _normalized(part)
    known = values > ACCURACY
    return np.asarray((vectors[:, known] / values[known]) @ vectors[:, known].T / np.outer(scale, scale))


def _eliminated(gram: np.ndarray, ready: np.ndarray, kept: list[int]) -> list[int]:
    while kept:
        errors = _errors(gram, kept)
        if (errors <= TOLD).all():
            break
        worst = int(np.argmax(np.where(errors > TOLD, np.minimum(errors, LOST) * ready[kept], -1.0)))
        kept = kept[:worst] + kept[worst + 1 :]
    return kept


def _returned(gram: np.ndarray, ready: np.ndarray, kept: list[int], seen: Sequence[int]) -> list[int]:
    """Candidates with those that fit beside them after all, the most wanted first.

    One that is certain takes the place of those that are not, if these are then told no longer.
    """
    for i in sorted((i for i in seen if i not in kept), key=lambda i: ready[i]):
        before, larger = dict(zip(kept, _errors(gram, kept), strict=True)), sorted([*kept, i])
        while True:
            errors = dict(zip(larger, _errors(gram, larger), strict=True))
            lost = [k for k in larger if errors[k] > TOLD]
            if not lost or errors[i] > CERTAIN or any(before[k] <= CERTAIN for k in lost):
                break
            larger.remove(max(lost, key=lambda k: errors[k]))
        if not lost:
            kept = larger
    return kept


def _confused(gram: np.ndarray, kept: Sequence[int], left: Sequence[int]) -> dict[int, dict[int, float]]:
    """By how much of the chosen ones each left out one is made up for, in sizes."""
    found: dict[int, dict[int, float]] = {}
    if not kept:
        return found
    part = gram[np.ix_(kept, kept)]
    inverse = _inverse(part)
    for i in left:
        weights = inverse @ gram[kept, i]
        explained = float(weights @ part @ weights) / float(gram[i, i])
        if explained > EXPLAINED:
            found[i] = {k: float(w) for k, w in zip(kept, weights, strict=True) if abs(w) > WEIGHT}
    return found


def _groups(
    candidates: Sequence[Candidate], gram: np.ndarray, kept: Sequence[int], confused: dict[int, dict[int, float]],
    partners: dict[int, dict[int, float]],
) -> tuple[Group, ...]:  # fmt: skip
    """Candidates that are linked by being confused, with the combinations that are told."""
    owner = {i: i for i in range(len(candidates))}

    def root(i: int) -> int:
        while owner[i] != i:
            i = owner[i]
        return i

    for k, others in partners.items():
        for i in others:
            owner[root(i)] = root(k)
    members: dict[int, list[int]] = {}
    for i in {*partners, *(i for others in partners.values() for i in others)}:
        members.setdefault(root(i), []).append(i)
    return tuple(_group(candidates, gram, sorted(m), [k for k in kept if k not in m]) for m in members.values())


def _group(candidates: Sequence[Candidate], gram: np.ndarray, members: list[int], rest: list[int]) -> Group:
    block = gram[np.ix_(members, members)]
    if rest:
        across = gram[np.ix_(members, rest)]
        block = block - across @ _inverse(gram[np.ix_(rest, rest)]) @ across.T
    values, vectors = np.linalg.eigh(block)
    found = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        error = 1 / np.sqrt(max(float(value), 1e-300))
        if error <= TOLD:
            vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
            order = [j for j in np.argsort(-np.abs(vector)) if abs(vector[j]) > WEIGHT]
            found.append((tuple((candidates[members[j]].name, float(vector[j])) for j in order), error))
    return Group(tuple(candidates[i].name for i in members), tuple(found))
