"""How much longer a search takes, by what its stages have cost so far and by what typically follows."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from itertools import pairwise


@dataclass(frozen=True)
class Stage:
    """A stage of a search, as it typically is.

    Attributes:
        words: how its reports begin.
        cost: what a visit takes, relative to those of other stages.
        visits: how often it is visited when a search comes by it.
        rounds: whether it is part of a round, which may follow again, and which ends when the time is over.
        like: the stages to whose time this one's is proportional.
    """

    words: str
    cost: float
    visits: float = 1.0
    rounds: bool = False
    like: str = "search"


#: Share of rounds that leave more than noise where nothing tells, and further rounds that typically follow these.
PARTLY, AGAIN = 0.2, 0.8
#: How much the costs of all stages count beside those of the like.
FAINT = 0.1
#: Cost of a search over shorter windows, relative to the one before, by which it is judged up to so many visits.
SHORTER, KNOWN = 0.4, 3

PREPARING = Stage("preparing", 0.45, like="log")
SHORT = Stage("searching over shorter windows", 0.2, visits=0.0)
FITTING = Stage("fitting the declared parameters", 1.1)
QUIET = Stage("what is left looks like noise", 0.0)
SCREENING = Stage("screening", 1.0, rounds=True)
SWAPPING = Stage("swapping", 1.8, visits=0.4, rounds=True)
PAIRS = Stage("refitting pairs", 2.5, visits=0.3, rounds=True)
PART = Stage("part of it is explained", 0.5, rounds=True)
EXPLAINED = Stage("all but noise is explained", 0.9, like="log")
CHECKING = Stage("checking", 0.4)
SUBTLE = Stage("looking for what is faint", 1.5, visits=0.8)
TIES = Stage("looking for ties", 3.2)
VERIFYING = Stage("verifying", 1.8, like="log")
#: What follows what where something is missing; after a round, the next one may begin.
PLAN = (
    PREPARING,
    SHORT,
    FITTING,
    SCREENING,
    Stage("refitting", 1.3, rounds=True),
    PAIRS,
    Stage("refitting families", 1.0, visits=0.2, rounds=True),
    PART,
    Stage("fitting friction", 3.0, visits=0.5, rounds=True),
    Stage("refining", 2.4, visits=0.8, rounds=True),
    SWAPPING,
    EXPLAINED,
    CHECKING,
    Stage("judging on all windows", 1.0, visits=0.0),
    Stage("trying the names", 1.0, visits=0.0),
    SUBTLE,
    TIES,
    Stage("fitting on all windows", 1.3),
    VERIFYING,
    Stage("proposing a motion", 1.0, visits=0.5),
    Stage("comparing forces", 2.0, visits=0.0),
)
#: And where nothing seems to be: all is done again on all windows.
QUIET_PLAN = (QUIET, SCREENING, FITTING, QUIET, SCREENING, SUBTLE, VERIFYING)
#: Stages that tell that one effect does not explain all.
HARD = (SHORT, PAIRS, PART)
#: Stages that screen for themselves.
SCREENING_TOO = (SWAPPING, SUBTLE, TIES)


@dataclass(frozen=True)
class Visit:
    """One visit of a stage.

    Attributes:
        stage: the stage.
        began, told: when it began, and when it was reported last.
        share: its share that was done then.
    """

    stage: Stage
    began: float
    told: float
    share: float


@dataclass(frozen=True)
class TimeLeft:
    """What a search has reported so far, and the time that it still takes by that.

    Attributes:
        limit: seconds after which the time for rounds is over.
        visits: of stages so far.
        plan: what follows what.
        row: of the present stage in it.
        effects: for how many ties are looked for.
    """

    limit: float = math.inf
    visits: tuple[Visit, ...] = ()
    plan: tuple[Stage, ...] = PLAN
    row: int = 0
    effects: int = 1

    def told(self, words: str, share: float, now: float) -> TimeLeft:
        """Return what is known once a stage and its share done are reported.

        Args:
            words: the stage; one without a plan changes nothing.
            share: of it that is done; where it begins with 1, what follows it is counted as a part of it.
            now: by a clock of seconds.
        """
        found = [s for s in (*PLAN, QUIET) if words.startswith(s.words)]
        if not found:
            return self
        stage = max(found, key=lambda s: len(s.words))
        if self.visits:
            last = self.visits[-1]
            if stage == SCREENING and last.stage in SCREENING_TOO:
                return self
            if stage == last.stage and share >= last.share:
                return replace(self, visits=(*self.visits[:-1], replace(last, told=now, share=share)))
        number = re.search(r"\d+", words) if stage == CHECKING else None
        plan, row = self._place(stage)
        return replace(
            self, visits=(*self.visits, Visit(stage, now, now, share if share < 1 else 0.0)), plan=plan, row=row,
            effects=int(number[0]) if number else self.effects,
        )  # fmt: skip

    def left(self, now: float) -> float:
        """Return the seconds that remain; NaN as long as nothing tells how fast this search is.

        Args:
            now: not before the last report.
        """
        if not any(v.stage not in (PREPARING, SHORT) for v in self.visits[:-1]):
            return math.nan
        started = next(v.began for v in self.visits if v.stage != PREPARING)
        last, ahead = self.visits[-1], self._ahead()
        rest = (1 - last.share) * ((1 - last.share) * self._cost(last.stage) + last.told - last.began)
        rest = max(rest - (now - last.told), 0.0)
        rounds = sum(visits * self._cost(s) for s, visits in ahead if s.rounds) + rest * last.stage.rounds
        others = sum(visits * self._cost(s) for s, visits in ahead if not s.rounds) + rest * (not last.stage.rounds)
        return min(rounds, max(started + self.limit - now, 0.0)) + others

    def share(self, now: float) -> float:
        """Return the share of the whole time that is over; 0 as long as that is unknown."""
        left = self.left(now)
        if math.isnan(left):
            return 0.0
        over = now - self.visits[0].began
        return over / max(over + left, 1e-9)

    def _place(self, stage: Stage) -> tuple[tuple[Stage, ...], int]:
        """The plan in which a stage comes next, and its row there."""
        plan = QUIET_PLAN if stage == QUIET else self.plan if stage in self.plan else PLAN
        later = [row for row, s in enumerate(plan) if s == stage and row > self.row and plan == self.plan]
        return plan, later[0] if later else plan.index(stage)

    def _ahead(self) -> list[tuple[Stage, float]]:
        """The stages, with the number of visits that are expected after the present one."""
        if self.plan == QUIET_PLAN:
            return [(s, s.visits) for s in QUIET_PLAN[self.row + 1 :]]
        first, last = PLAN.index(PART), PLAN.index(EXPLAINED)
        hard = any(v.stage in HARD for v in self.visits)
        partly = 0.0 if self.row >= last else 1.0 if hard else PARTLY
        effects = self.effects + (hard and self.row < last)  # another one, where one does not explain all
        ahead = []
        for row, stage in enumerate(PLAN):
            visits = stage.visits * ((row > self.row) * (partly if first <= row < last else 1.0))
            if stage == TIES and row >= self.row:
                visits = max(effects - sum(v.stage == TIES for v in self.visits), 0)
            ahead.append((stage, visits + AGAIN * partly * stage.visits * stage.rounds))
        return ahead

    def _cost(self, stage: Stage) -> float:
        """Seconds of a visit, by those of the same stage, of those like it, and of all stages in this search so far."""
        begins = max((i for i, v in enumerate(self.visits) if v.stage == SHORT), default=0)
        new = len(self.visits) - begins < KNOWN and begins > 0
        times = [(v.stage, after.began - v.began) for v, after in pairwise(self.visits[0 if new else begins :])]
        own = [t for s, t in times if s == stage]
        alike = [(s, t) for s, t in times if s.like == stage.like]
        unit = sum(t for _, t in times) / max(sum(s.cost for s, _ in times), 1e-9)
        unit = (sum(t for _, t in alike) + FAINT * unit) / (sum(s.cost for s, _ in alike) + FAINT)
        return (SHORTER if new else 1.0) * (sum(own) + unit * stage.cost) / (len(own) + 1)
