"""Naming what is missing: screen, refit, accept by the excess that is removed, swap, prune, and tell what ties."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dropo_torch.effects.base import Effect, Placed
from dropo_torch.errors import InputError
from dropo_torch.gap.evidence import Evidence, caps_of, cost_of
from dropo_torch.gap.refit import Hypothesis, Refit, refit
from dropo_torch.gap.rules import Rules, allowance, clears, paired, significant, simplest
from dropo_torch.gap.screen import Candidate, all_candidates, promising_families, promising_pairs, screen
from dropo_torch.support.files import write_atomically


@dataclass(frozen=True)
class Trial:
    """A candidate that was refitted, for the report: what it left of the excess."""

    placed: Placed
    excess: float
    before: float
    round: int = 0


@dataclass(frozen=True)
class Naming:
    """What was found.

    Attributes:
        base: the declared parameters alone.
        final: with the named effects, or the base again.
        gap: whether anything is missing at all.
        named: whether the named effects account for it.
        ties: for each named effect, the candidates that do as well in its place.
        trials: what was refitted, in order.
        silent: candidates that change nothing on this log, which it therefore cannot judge.
        shares: excess that comes back when each named effect alone is left out.
        partial: whether they leave nothing in most of the log, but something else remains in the rest.
    """

    base: Refit
    final: Refit
    gap: bool
    named: bool
    ties: tuple[tuple[Placed, ...], ...] = ()
    trials: tuple[Trial, ...] = ()
    silent: tuple[tuple[str, str | None], ...] = ()
    shares: tuple[float, ...] = ()
    partial: bool = False


#: ``report(stage, share)`` as the work goes on.
Report = Callable[[str, float], None]


@dataclass(frozen=True)
class Stage:
    """Where a search stands: the declared parameters alone, the hypothesis so far, and rounds done."""

    base: Refit
    current: Refit
    number: int
    done: bool


#: What else a checkpoint holds.
_KEPT = ("trials", "silent", "first", "first_chi2", "first_degrees", "_round", "_caps")


class Search:
    """The search for missing effects on one log.

    Args:
        evidence: all windows of the training part.
        effects: the vocabulary.
        rules: thresholds.
        checkpoint: file of the state between rounds; none by default.
        resume: go on from the checkpoint.
        fingerprint: identifies config, model and log.
        few: windows that refits use; all if there are fewer.
        fewer: windows that the screening uses.
    """

    def __init__(
        self, evidence: Evidence, effects: Sequence[Effect], *, rules: Rules, checkpoint: Path | None = None,
        resume: bool = False, fingerprint: str = "", few: int = 40, fewer: int = 10,
        report: Report = lambda stage, share: None,
    ) -> None:  # fmt: skip
        self.evidence, self.effects, self.rules, self._report = evidence, effects, rules, report
        self._few, self._fewer = few, fewer
        self._checkpoint, self._resume, self._fingerprint = checkpoint, resume, fingerprint
        self._caps = np.ones(0)
        self.trials: list[Trial] = []
        self.silent: list[tuple[str, str | None]] = []
        self.first: list[Candidate] = []
        self.first_chi2, self.first_degrees = 0.0, 0.0
        self._round = 0
        setting = evidence.twin.setting
        self.candidates = list(all_candidates(setting, effects))

    def run(self, begin: Hypothesis) -> Naming:
        """Return what is missing, beginning from the declared parameters' values."""
        rules = self.rules
        stage = self._restored() or self._based(begin)
        if not significant(stage.base.cost, rules):
            silent = tuple(c.key for c in self._screened(stage.base) if c.dead)
            return Naming(stage.base, stage.base, gap=False, named=False, silent=silent)
        while not stage.done:
            stage = self._round_of(stage)
            self._save(stage)
        base, current = stage.base, self._prune(stage.current, stage.base)
        left = max(current.cost.excess, 0.0) / base.cost.excess
        partial = self.evidence.robust and clears(base, current)
        if not current.hypothesis.placed or not (partial or left <= allowance(current.hypothesis, rules)):
            return Naming(base, base, True, False, trials=tuple(self.trials), silent=tuple(self.silent))
        ties, shares = [], []
        for index in range(len(current.hypothesis.placed)):
            tied, share = self._ties(current, index, base)
            ties.append(tied)
            shares.append(share)
        current, ties = self._canonical(current, ties)
        return Naming(
            base, current, True, True, tuple(ties), tuple(self.trials), tuple(self.silent), shares=tuple(shares),
            partial=partial,
        )  # fmt: skip

    def start(self, begin: Hypothesis) -> Refit:
        """Fit the declared parameters alone, with the influence of single windows capped."""
        self._report("fitting the declared parameters", 0.0)
        base = self._renoise(refit(self._part(self._few), begin))
        robust = self.evidence.robust
        self._caps = np.ones(len(base.factor)) if robust else caps_of(base.cost.windows, base.cost.degrees)
        return refit(self._part(self._few), base.hypothesis, caps=self._caps, iterations=4)

    def look(self, base: Refit) -> list[Candidate]:
        """Screen every candidate beside the declared parameters alone, and keep what that says."""
        ranked = self._screened(base)
        self.silent = [c.key for c in ranked if c.dead]
        fewer, here, caps = self._fewer_of(base, self._fewer)
        self.first, self.first_degrees = ranked, fewer.degrees(here.starts)
        self.first_chi2 = float(((here.residual * (caps * here.factor)[:, None]) ** 2).sum())
        return ranked

    def _based(self, begin: Hypothesis) -> Stage:
        """The first stage: the declared parameters alone."""
        base = self.start(begin)
        stage = Stage(base, base, 0, False)
        self._save(stage)
        return stage

    def _round_of(self, stage: Stage) -> Stage:
        """Accept one or two more effects, and swap those accepted before for better ones."""
        base = stage.base
        found = self._next(stage.current, base, stage.number)
        if found is None:
            return replace(stage, done=True)
        if self.evidence.robust and not self._is_done(found, base):
            found = self._everywhere(found)
        elif significant(found.cost, self.rules):
            found = self._extended(found, base)
        if not self._is_done(found, base) and len(found.hypothesis.placed) > 1:
            found = self._swap(found, base)
        number = stage.number + 1
        return Stage(base, found, number, self._is_done(found, base) or number >= self.rules.effects)

    def _save(self, stage: Stage) -> None:
        """Write the state between two rounds, whole or not at all."""
        if self._checkpoint is not None:
            kept = {name: getattr(self, name) for name in _KEPT}
            document = {"fingerprint": self._fingerprint, "stage": stage, "noise": self.evidence.noise, **kept}
            write_atomically(self._checkpoint, pickle.dumps(document))

    def _restored(self) -> Stage | None:
        """Take up the state of an interrupted search, if there is one.

        Raises:
            InputError: it is of another config, model or log.
        """
        if self._checkpoint is None or not self._resume or not self._checkpoint.exists():
            return None
        try:
            document = pickle.loads(self._checkpoint.read_bytes())
            known = document.get("fingerprint")
        except Exception:  # whatever bytes that are no checkpoint make of a pickle
            raise InputError(f"--resume: {self._checkpoint} is no checkpoint; run without --resume") from None
        if known != self._fingerprint:
            raise InputError(
                f"--resume: {self._checkpoint} is of another config, model or log; run without --resume, "
                "or name another folder"
            )
        self.evidence = self.evidence.with_noise(document["noise"])
        for name in _KEPT:
            setattr(self, name, document[name])
        return document["stage"]

    def _renoise(self, fitted: Refit) -> Refit:
        """Lower the noise where even this hypothesis leaves less of it in a feature, and fit again."""
        m = self.evidence.chart.size
        squares = (fitted.residual**2).reshape(len(fitted.residual), -1, m)
        rows = (fitted.starts.weights > 0).reshape(squares.shape).sum((0, 1))
        free = rows * fitted.cost.degrees / max(float((fitted.starts.weights > 0).sum()), 1.0)
        ratio = np.sqrt(squares.sum((0, 1)) / np.maximum(free, 1.0))
        if fitted.cost.reduced > self.rules.least_reduced or (ratio > 0.97).all():
            return fitted
        self.evidence = self.evidence.with_noise(self.evidence.noise * np.minimum(ratio, 1.0))
        return refit(self._part(self._few), fitted.hypothesis, iterations=4)

    def _part(self, count: int) -> Evidence:
        """The evidence on a spread of windows."""
        windows = self.evidence.windows
        if len(windows) <= count:
            return self.evidence
        rows = np.unique(np.linspace(0, len(windows) - 1, count).astype(int))
        return self.evidence.on(windows.select(rows))

    def _fewer_of(self, current: Refit, count: int) -> tuple[Evidence, Refit, np.ndarray]:
        """The windows that fit worst and a spread of the others, with the fitted hypothesis there."""
        part = self._part(self._few)
        order = np.argsort(-current.cost.windows)
        half = count // 2
        spread = np.linspace(0, len(order) - 1, count - half).astype(int)
        rows = np.unique(np.concatenate([order[:half], order[spread]]))
        starts = replace(
            current.starts, basis=current.starts.basis[rows], weights=current.starts.weights[rows],
            shift=current.starts.shift[rows],
        )  # fmt: skip
        here = replace(
            current, residual=current.residual[rows], slope=current.slope[:, rows], starts=starts,
            factor=current.factor[rows],
        )  # fmt: skip
        return part.on(part.windows.select(rows)), here, self._caps[rows]

    def _beats(self, better: Refit, worse: Refit) -> bool:
        """Whether a hypothesis removes most of another's excess, or less of it all over the log."""
        return (
            better.cost.excess < (1 - self.rules.most) * worse.cost.excess
            or paired(worse.cost, better.cost, self.blocks) >= self.rules.significance
        )

    def _is_done(self, current: Refit, base: Refit) -> bool:
        """Whether what is left is noise, or too small a part of the gap to tell anything."""
        if self.evidence.robust and clears(base, current):
            return True
        return not significant(current.cost, self.rules) or (current.cost.excess < self.rules.least * base.cost.excess)

    @property
    def blocks(self) -> np.ndarray:
        """The block of each refitted window, for paired tests: its episode, or a tenth of a single one."""
        windows = self._part(self._few).windows
        if len(np.unique(windows.episodes)) >= 5:
            return windows.episodes
        return (np.arange(len(windows)) * 10) // len(windows)

    def _screened(self, current: Refit) -> list[Candidate]:
        """Screen on the windows that fit worst and on a spread of the others."""
        fewer, here, caps = self._fewer_of(current, self._fewer)
        total = len(self.candidates)
        return screen(
            fewer, here, self.candidates, caps=caps * here.factor,
            on_progress=lambda done: self._report(f"screening {total} candidates", done / total),
        )  # fmt: skip

    def _next(self, current: Refit, base: Refit, number: int) -> Refit | None:
        """The hypothesis with one or two more effects that removes the most, or ``None``."""
        rules = self.rules
        ranked = self.look(current) if number == 0 else self._screened(current)
        self._round = number
        alive = [c for c in ranked if not c.dead]
        singles = self._refits(current, [(c.placed,) for c in alive[: rules.refits]], "refitting")
        if not singles:
            return None
        best = simplest(singles)
        left = best.cost.excess / current.cost.excess
        if left > 1 - rules.most:
            pairs = promising_pairs(*self._aligned(current, alive[:16]), 5)
            tried = self._refits(current, pairs, "refitting pairs")
            if tried and tried[0].cost.excess < 0.5 * best.cost.excess:
                best = tried[0]
            _, here, caps = self._fewer_of(current, self._fewer)
            families = promising_families(here, caps * here.factor, alive)
            tried = self._refits(current, families, "refitting families")
            if tried and tried[0].cost.excess < 0.5 * best.cost.excess:
                best = tried[0]
        if best.cost.excess > rules.hopeless * current.cost.excess:
            return None
        gained = current.cost.excess - best.cost.excess
        if gained < rules.least * base.cost.excess or not self._beats(best, current):
            return None
        return best

    def _aligned(self, current: Refit, candidates: Sequence[Candidate]) -> tuple[Refit, list[Candidate], np.ndarray]:
        """Promising candidates screened again from where they promise the most, on more windows."""
        fewer, here, caps = self._fewer_of(current, 2 * self._fewer)
        caps = caps * here.factor
        return here, screen(fewer, here, [c.placed for c in candidates], caps=caps), caps

    def _refits(
        self, current: Refit, groups: Sequence[Sequence[Placed]], stage: str, origin: Hypothesis | None = None
    ) -> list[Refit]:
        """Refit the current hypothesis with each group of effects more; the best first.

        All are fitted a little, on few windows; those that come near the best of them are then fitted in full. They
        begin from ``origin``, by default the current hypothesis.
        """
        fewer, here, caps = self._fewer_of(current, 2 * self._fewer)
        before = cost_of(here.residual, here.starts, fewer.degrees(here.starts), caps, fewer.tail(here.starts)).excess
        rough: list[Refit] = []
        for number, group in enumerate(groups):
            self._report(stage, number / (len(groups) + 2))
            hypothesis = current.hypothesis if origin is None else origin
            for placed in group:
                hypothesis = hypothesis.with_effect(placed)
            rough.append(refit(fewer, hypothesis, starts=here.starts, caps=caps, iterations=2))
        rough.sort(key=lambda r: r.cost.excess)
        kept = [refit(fewer, r.hypothesis, starts=here.starts, caps=caps, iterations=5) for r in rough[:4]]
        rough = sorted([*kept, *rough[4:]], key=lambda r: r.cost.excess)
        for fitted in rough:
            for placed in fitted.hypothesis.placed[len(current.hypothesis.placed) :]:
                self.trials.append(Trial(placed, fitted.cost.excess, before, self._round))
        if not rough:
            return []
        near = 3 * max(rough[0].cost.excess, 0.0) + self.rules.least * before + 10 * np.sqrt(2 * rough[0].cost.degrees)
        full = []
        for number, fitted in enumerate(r for r in rough[:3] if r.cost.excess <= near):
            self._report(stage, (len(groups) + number / 4) / (len(groups) + 2))
            full.append(refit(self._part(self._few), fitted.hypothesis, caps=self._caps))
        return sorted(full, key=lambda r: r.cost.excess)

    def _swap(self, current: Refit, base: Refit) -> Refit:
        """Try to put another effect in the place of each accepted one."""
        for _ in range(2):
            before = current
            for index in range(len(current.hypothesis.placed)):
                without = refit(self._part(self._few), current.hypothesis.without(index), caps=self._caps)
                alive = self._better(without, current)
                for found in self._refits(without, [(c.placed,) for c in alive], "swapping")[:1]:
                    if found.cost.excess < current.cost.excess and self._beats(found, current):
                        current = found
                        break
            if current is before:
                break
        return current

    def _extended(self, current: Refit, base: Refit) -> Refit:
        """Put effects that contain an accepted one in its place, where that explains more."""
        setting = self.evidence.twin.setting
        for index, own in enumerate(current.hypothesis.placed):
            groups = [
                (Placed(effect, own.target, tuple(float(v) for v in start)),)
                for effect in self.effects
                for start in effect.extends(setting, own)
            ]
            if not groups:
                continue
            without = refit(self._part(self._few), current.hypothesis.without(index), caps=self._caps)
            origin = current.hypothesis.without(index)
            for found in self._refits(without, groups, "refining", origin)[:1]:
                gained = current.cost.excess - found.cost.excess
                much = gained >= self.rules.least * base.cost.excess or gained >= self.rules.most * current.cost.excess
                if much and self._beats(found, current):
                    current = found
                    break
        return current

    def _everywhere(self, current: Refit) -> Refit:
        """Put the last accepted effect at all its other targets, too, where that explains more."""
        own = current.hypothesis.placed[-1]
        if len(own.values) != 1:
            return current
        setting, taken = self.evidence.twin.setting, {p.key for p in current.hypothesis.placed}
        idle = {*taken, *self.silent}
        hypothesis = current.hypothesis
        for target in own.effect.targets(setting):
            if (own.effect.name, target) not in idle:
                neutral = own.effect.quantities(setting, target)[0].neutral
                hypothesis = hypothesis.with_effect(Placed(own.effect, target, (neutral,)))
        self._report("refitting families", 0.5)
        whole = refit(self._part(self._few), hypothesis, caps=self._caps)
        return whole if self._beats(whole, current) else current

    def _better(self, without: Refit, current: Refit) -> list[Candidate]:
        """Candidates that promise to explain more than the effect that was left out does, the best first."""
        ranked = [c for c in self._screened(without) if not c.dead]
        fewer, _, caps = self._fewer_of(without, self._fewer)
        here = refit(fewer, current.hypothesis, caps=caps, iterations=0)
        return [c for c in ranked[:3] if c.chi2 < 0.8 * here.cost.chi2]

    def _prune(self, current: Refit, base: Refit) -> Refit:
        """Drop effects that are not needed, the least needed first."""
        while len(current.hypothesis.placed) > 1:
            without = [
                refit(self._part(self._few), current.hypothesis.without(i), caps=self._caps)
                for i in range(len(current.hypothesis.placed))
            ]
            least = min(without, key=lambda r: r.cost.excess)
            needed = least.cost.excess - current.cost.excess
            if needed >= self.rules.least * base.cost.excess and self._beats(current, least):
                break
            current = least
        return current

    def _ties(self, current: Refit, index: int, base: Refit) -> tuple[tuple[Placed, ...], float]:
        """Candidates that explain the log as well in the place of one named effect, and the excess it accounts for."""
        placed = current.hypothesis.placed
        own = placed[index]
        alone = len(placed) == 1
        without = base if alone else refit(self._part(self._few), current.hypothesis.without(index), caps=self._caps)
        ranked = self.first if alone else self._screened(without)
        twins = self._twins(own, ranked)
        known = {own.key, *(t.key for t in twins)}
        fits = [c for c in ranked if not c.dead and len(c.placed.values) <= len(own.values)]
        order = [c.placed for c in fits if c.key not in known][: max(5 - len(twins), 2)]
        self._round, found = -1, []
        origin = current.hypothesis.without(index)
        alike = [refit(self._part(self._few), origin.with_effect(p), caps=self._caps, iterations=3) for p in twins]
        others = self._refits(without, [(p,) for p in order], "looking for ties", origin)
        for fitted in (*alike, *others):
            other = fitted.hypothesis.placed[-1]
            close = fitted.cost.excess - current.cost.excess < max(
                0.3 * max(current.cost.excess, 0.0), 4 * np.sqrt(2 * current.cost.degrees)
            )
            as_clear = not self.evidence.robust or clears(base, fitted) or not clears(base, current)
            if close and as_clear and paired(fitted.cost, current.cost, self.blocks) < self.rules.tie:
                found.append(other)
        return tuple(found), without.cost.excess - current.cost.excess

    def _twins(self, own: Placed, ranked: Sequence[Candidate]) -> list[Placed]:
        """Candidates of as many numbers whose derivatives point the same way, with the values that do the same."""
        mine = next((c for c in ranked if c.key == own.key), None)
        if mine is None or len(mine.slope) != 1 or len(own.values) != 1:
            return []
        setting = self.evidence.twin.setting
        quantity = own.effect.quantities(setting, own.target)[0]
        found = []
        for other in ranked:
            if other.key == own.key or other.dead or len(other.slope) != 1 or len(other.placed.values) != 1:
                continue
            a, b = mine.slope[0], other.slope[0]
            cosine = float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300))
            if abs(cosine) < 0.9999:
                continue
            theirs = other.placed.effect.quantities(setting, other.placed.target)[0]
            ratio = float(a @ b / (b @ b)) / quantity.scale * theirs.scale
            value = theirs.neutral + ratio * (own.values[0] - quantity.neutral)
            found.append(other.placed.at([float(np.clip(value, theirs.low, theirs.high))]))
        return found

    def _canonical(self, current: Refit, ties: list[tuple[Placed, ...]]) -> tuple[Refit, list[tuple[Placed, ...]]]:
        """Among exact ties name the one with the fewest numbers that the vocabulary lists first."""
        order = {effect.name: i for i, effect in enumerate(self.effects)}
        for index, tied in enumerate(ties):
            own = current.hypothesis.placed[index]
            first = min((own, *tied), key=lambda p: (len(p.values), order.get(p.effect.name, 99)))
            if first is own:
                continue
            placed = list(current.hypothesis.placed)
            placed[index] = first
            current = refit(
                self._part(self._few), Hypothesis(current.hypothesis.declared, tuple(placed)), caps=self._caps
            )
            ties[index] = tuple(own if p is first else p for p in tied)
        return current, ties
