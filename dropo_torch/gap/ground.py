"""What every step of a search stands on and hands on, and the refits of what a step proposes."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from dropo_torch.effects.base import Effect, Placed, Setting
from dropo_torch.gap.evidence import Cost, Evidence
from dropo_torch.gap.log import parts_of, since_known, spread
from dropo_torch.gap.refit import Hypothesis, Refit, Resolved, refit, resolved
from dropo_torch.gap.result import Ranked
from dropo_torch.gap.rules import Alike, Rules, as_good, chance_of, clears
from dropo_torch.gap.screen import Candidate, Focus, all_candidates, left_by, screen
from dropo_torch.gap.starts import begun
from dropo_torch.gap.twin import Windows
from dropo_torch.support.report import Report

#: Windows that refits use, and that the screening uses; all if there are fewer.
FEW, FEWER = 40, 10
#: Residuals of a window from which on fewer windows do, which tell as much; the share of them that there are at least.
RICH, SCARCE = 400, 0.5
#: Evaluations of forces in a window from which on these cost much.
COSTLY = 200


@dataclass(frozen=True)
class Screening:
    """What every candidate promises beside the declared parameters alone.

    Attributes:
        ranked: the candidates, the most promising first.
        residual: weighted residuals of the screened windows without them, ``(W·N,)``.
        slope: their derivatives by the declared parameters, ``(d, W·N)``.
        degrees: degrees of freedom of these windows.
    """

    ranked: tuple[Candidate, ...]
    residual: np.ndarray
    slope: np.ndarray
    degrees: float

    @property
    def chi2(self) -> float:
        """χ² of the screened windows without them."""
        return float(self.residual @ self.residual)

    @property
    def silent(self) -> tuple[Placed, ...]:
        """Candidates that change nothing on this log, which it therefore cannot judge."""
        return tuple(c.placed for c in self.ranked if c.dead)

    def rivals(self, placed: Sequence[Placed], index: int, rules: Alike) -> set[tuple[str, str | None]] | None:
        """Return which candidates may explain what one effect does beside others, by first order; ``None`` for any.

        This screening says so only where it predicts, for the effects themselves, what they turned out to explain. Of a
        finer step it never does, since that is found among a few by simulation; nor is it a name that others may stand
        for.

        Args:
            placed: effects that were found since.
            index: of the one.
            rules: thresholds.
        """
        alive = {c.key: c for c in self.ranked if not c.dead}
        if any(p.key not in alive for p in placed):
            return None
        others = [alive[p.key] for i, p in enumerate(placed) if i != index]
        before = max(left_by(self, others) - self.degrees, 1e-12)
        share = {key: (left_by(self, [*others, c]) - self.degrees) / before for key, c in alive.items()}
        own = placed[index]
        if not own.effect.steps and share[own.key] > rules.straight:
            return None
        return {key for key, left in share.items() if left < rules.likely}


@dataclass(frozen=True)
class State:
    """Where a search stands; a checkpoint holds nothing else.

    Attributes:
        noise: standard deviation of each feature, ``(m,)``, as it is beside the hypothesis so far.
        since: logged step of each episode from which on the commands that act under it are known, ``(E,)``.
        caps: factors of the windows' residuals in all fits, ``(W,)``, or 1.
        base: the declared parameters alone.
        first: the screening beside them.
        current: the hypothesis so far.
        number: rounds done.
        done: whether no round is to follow.
        attempts: what was refitted, in order.
        refused: why what explained the most has no name, if it has none.
        family: whether the hypothesis is the base family, at all joints where it is needed.
        few: windows that refits use, at most.
        rivals: hypotheses that left no more than noise, either, as it was when this one was chosen.
        starts: of windows that do not begin as measured: episode, step and columns, ``(k, 2 + n)``.
    """

    noise: np.ndarray
    since: np.ndarray
    caps: np.ndarray | float
    base: Refit
    first: Screening
    current: Refit
    number: int = 0
    done: bool = False
    attempts: tuple[Ranked, ...] = ()
    refused: str = ""
    family: bool = False
    few: int = FEW
    rivals: tuple[Hypothesis, ...] = ()
    starts: np.ndarray | None = None


def scarcity(evidence: Evidence) -> float:
    """Return which share of the usual windows tells enough, as each has many residuals.

    Where nothing touches and windows cost little, all do: a base family has many numbers.
    """
    if not evidence.twin.setting.signals.contacts.any() and evaluations(evidence) < COSTLY:
        return 1.0
    return float(np.clip(RICH / max(evidence.num_rows, 1), SCARCE, 1.0))


def work(evidence: Evidence) -> int:
    """Return how often forces are evaluated where the windows that refits use are simulated once."""
    return count_refitted(evidence) * evaluations(evidence)


def count_refitted(evidence: Evidence) -> int:
    """Return how many windows refits use."""
    return min(len(evidence.windows), round(FEW * scarcity(evidence)))


def evaluations(evidence: Evidence) -> int:
    """Return how often forces are evaluated in a simulation of a window."""
    setting = evidence.twin.setting
    stages = 4 if setting.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 1
    return int(evidence.windows.length * setting.frame_skip * stages)


@dataclass(frozen=True)
class Ground:
    """What a search stands on, the same for all of its steps.

    Attributes:
        evidence: all windows of the training part.
        effects: the vocabulary.
        report: called with a stage and its share done.
        caps: factors of the refitted windows' residuals, ``(W,)``, or 1.
        short: short windows from which the noise is estimated; ``None`` where it is given.
        few: windows that refits use, at most; by default as many as tell enough.
    """

    evidence: Evidence
    effects: tuple[Effect, ...]
    report: Report = lambda stage, share: None
    caps: np.ndarray | float = 1.0
    short: Windows | None = None
    few: int | None = None

    def at(self, state: State) -> Ground:
        """Return the ground with the noise, the windows with their starts, and the caps that a state has found."""
        return replace(self, few=state.few).on(state.noise, state.since, state.caps).begun(state.starts)

    def reporting(self, report: Report) -> Ground:
        """Return the ground that reports elsewhere, and knows what was fitted on it."""
        other = replace(self, report=report)
        vars(other).update({name: known for name, known in vars(self).items() if name not in vars(other)})
        return other

    def begun(self, starts: np.ndarray | None) -> Ground:
        """Return the ground with windows that begin where a state has found; see :attr:`State.starts`."""
        windows = self.evidence.windows
        return replace(self, evidence=replace(self.evidence, windows=replace(windows, starts=begun(windows, starts))))

    def on(self, noise: np.ndarray, since: np.ndarray, caps: np.ndarray | float = 1.0) -> Ground:
        """Return the ground with another noise, and without windows that start before some steps, ``(E,)``."""
        evidence = replace(self.evidence, windows=since_known(self.evidence.windows, since), noise=noise)
        return replace(self, evidence=evidence, caps=caps)

    @property
    def rules(self) -> Rules:
        """Thresholds."""
        return self.evidence.rules

    @property
    def setting(self) -> Setting:
        """The model and its columns."""
        return self.evidence.twin.setting

    @property
    def most(self) -> int:
        """Windows that refits use, at most."""
        return round(FEW * scarcity(self.evidence)) if self.few is None else self.few

    @cached_property
    def part(self) -> Evidence:
        """The evidence on the windows that refits use."""
        return replace(self.evidence.on(spread(self.evidence.windows, self.most)), caps=self.caps)

    @cached_property
    def candidates(self) -> list[Placed]:
        """Every effect at every target, at each of its starts."""
        return list(all_candidates(self.setting, self.effects))

    def refit(self, hypothesis: Hypothesis, iterations: int = 12) -> Refit:
        """Return a hypothesis fitted on the windows that refits use; the same one is fitted once."""
        key = (hypothesis.vector.tobytes(), tuple(p.key for p in hypothesis.placed), iterations)
        if key not in self._known:
            self._known[key] = refit(self.part, hypothesis, iterations=iterations)
        return self._known[key]

    def resolved(self, fitted: Refit) -> Resolved:
        """Return a fit of these windows as it would be under an endlessly fine step; see :func:`resolved`."""
        key = (fitted.hypothesis.vector.tobytes(), tuple(p.key for p in fitted.hypothesis.placed))
        if key not in self._resolved:
            self._resolved[key] = resolved(self.part, fitted, anew=True)
        return self._resolved[key]

    @cached_property
    def _resolved(self) -> dict[tuple, Resolved]:
        return {}

    @cached_property
    def _known(self) -> dict[tuple, Refit]:
        return {}

    def clears(self, base: Refit, current: Refit) -> bool:
        """Return whether effects are right although something else remains in some windows; only if these may part."""
        return self.evidence.robust and clears(base, current, self.rules)

    def focus(self, fitted: Refit, times: int = 1) -> Focus:
        """Return a fitted hypothesis on the windows that it fits worst and on a spread of the others.

        Args:
            fitted: the hypothesis.
            times: of the windows that the screening uses.
        """
        count = round(times * FEWER * scarcity(self.evidence))
        order = np.argsort(-fitted.cost.windows)
        half = count // 2
        others = np.linspace(0, len(order) - 1, count - half).astype(int)
        rows = np.unique(np.concatenate([order[:half], order[others]]))
        here = replace(
            fitted, residual=fitted.residual[rows], slope=fitted.slope[:, rows], linear=fitted.linear.select(rows),
            factor=fitted.factor[rows],
        )  # fmt: skip
        return Focus(self.part.select(rows), here)

    def screened(self, fitted: Refit, keys: Container[tuple[str, str | None]] | None = None) -> list[Candidate]:
        """Return what candidates promise beside a fitted hypothesis: those of some effects and targets, or all."""
        candidates = [c for c in self.candidates if keys is None or c.key in keys]
        stage = f"screening {len(candidates)} candidates"
        self.report(stage, 0.0)
        return screen(self.focus(fitted), candidates, self.rules.tried, lambda share: self.report(stage, share))

    @property
    def comparisons(self) -> int:
        """Candidates among which each name is chosen."""
        return len({placed.key for placed in self.candidates})

    @cached_property
    def blocks(self) -> np.ndarray:
        """Blocks of the refitted windows that count as independent, ``(W,)``."""
        return parts_of(self.part.windows.episodes, self.rules.chance.blocks)

    def chance(self, better: Refit, worse: Refit) -> float:
        """Return how likely one hypothesis is as much nearer to the log than another by chance."""
        return chance_of(better, worse, self.blocks)

    def as_good(self, rival: Refit, own: Refit) -> bool:
        """Return whether one hypothesis explains the log as well as another."""
        return as_good(rival.cost, own.cost, self.blocks, self.rules)

    def refits(
        self, state: State, beside: Refit, groups: Sequence[Sequence[Placed]], stage: str,
        origin: Hypothesis | None = None, most: int = 3, iterations: tuple[int, int] = (2, 5),
        known: Hypothesis | None = None, hopeless: float = math.inf,
    ) -> tuple[list[Refit], State]:  # fmt: skip
        """Refit a hypothesis with each group of effects more; the best first, and the state with these attempts.

        All are fitted a little, on few windows; those that come near the best of them are then fitted in full. Of the
        same effects from several starts, the best goes on.

        Args:
            state: where the search stands.
            beside: the fitted hypothesis.
            groups: the effects to add.
            stage: what to report.
            origin: the hypothesis from which the fits begin; by default the fitted one.
            most: how many are fitted in full.
            iterations: of the fits on few windows: of all, and of the best ones.
            known: a fitted hypothesis that they must come near, too.
            hopeless: share of the excess that none but the best may leave roughly.
        """
        if not groups:
            return [], state
        focus = self.focus(beside, 2)
        before, first = focus.cost, len(beside.hypothesis.placed)

        def rough(hypothesis: Hypothesis, most: int, target: float = math.inf) -> Refit:
            linear = focus.fitted.linear
            return refit(focus.evidence, hypothesis, linear=linear, iterations=most, slopes=False, target=target)

        def spare(best: Cost) -> float:
            above = (tried.worse - 1) * max(best.misfit, 0.0) + self.rules.least * before.above(best)
            return above + tried.sigmas * best.sigma

        found, tried = [], self.rules.tried
        reached = [] if known is None else [rough(known, iterations[0])]
        target = min((r.loss + spare(r.cost) for r in reached if not focus.evidence.robust), default=math.inf)
        for number, group in enumerate(groups):
            self.report(stage, number / (len(groups) + 2))
            found.append(rough((origin or beside.hypothesis).with_effects(group), iterations[0], target))
        found.sort(key=lambda r: r.cost.excess)
        found[: most + 1] = [rough(r.hypothesis, iterations[1], target) for r in found[: most + 1]]
        found.sort(key=lambda r: r.cost.excess)
        attempts = [a for r in found for a in self._ranked(r.hypothesis.placed[first:], r.cost.left_of(before), state)]
        best = min((r.cost for r in (found[0], *reached)), key=lambda cost: cost.excess)
        near = best.excess + spare(best)
        full = []
        chosen = [r for r in _best_starts(found[: most + 1])[:most] if r.cost.excess <= near]
        chosen[1:] = [r for r in chosen[1:] if r.cost.left_of(before) <= hopeless]
        for number, fitted in enumerate(chosen):
            self.report(stage, (len(groups) + number / (most + 1)) / (len(groups) + 2))
            full.append(self.refit(fitted.hypothesis))
        full.sort(key=lambda r: r.cost.excess)
        return full, replace(state, attempts=(*state.attempts, *attempts))

    def _ranked(self, placed: Sequence[Placed], left: float, state: State) -> Iterator[Ranked]:
        """Each of the effects that were tried together, with what they left together."""
        for p in placed:
            together = tuple(other.key for other in placed if other is not p)
            yield Ranked(*p.key, p.summary(self.setting), left, state.number, together)


def _best_starts(found: Sequence[Refit]) -> list[Refit]:
    """Of fits with the same effects at the same places, the first."""
    first: dict[tuple, Refit] = {}
    for fitted in found:
        first.setdefault(tuple(p.key for p in fitted.hypothesis.placed), fitted)
    return list(first.values())
