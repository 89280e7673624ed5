"""What a search for a gap gives: where, what, how strong, what is left, and what would tell more."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from dropo_torch.effects.base import Placed
from dropo_torch.support.files import plain_numbers

SCHEMA = "dropo-torch/gap/1"
#: Target of an effect that sits at all places of its kind.
FAMILY = "*"


@dataclass(frozen=True)
class Place:
    """Where simulation and measurement disagree.

    Attributes:
        kind: joint, body, actuator, sensor, contact or world.
        name: which one; ``None`` for the world.
        share: share of the gap that a change there could explain, in [0, 1].
        when: the regime in which it shows, in words.
    """

    kind: str
    name: str | None
    share: float
    when: str


@dataclass(frozen=True)
class Strength:
    """One number of a named effect, with its 90 % interval."""

    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class NamedEffect:
    """A missing effect.

    Attributes:
        effect: its name in the vocabulary, or ``unnamed``.
        target: where it sits; ``*`` for a family over all joints or actuators, ``None`` for the world.
        parameters: its numbers.
        share_of_gap: share of the excess misfit that goes when it is added, in [0, 1].
        indistinguishable_from: effect and target of those that explain this log as well.
        sentence: what it is, to a person.
        variant: name in the vocabulary of the kind of the effect that it is, where that has another.
    """

    effect: str
    target: str | None
    parameters: Mapping[str, Strength]
    share_of_gap: float
    indistinguishable_from: tuple[tuple[str, str | None], ...] = ()
    sentence: str = ""
    variant: str = ""

    @classmethod
    def of(
        cls, placed: Placed, parameters: Mapping[str, Strength], share: float, tied: Iterable[Placed]
    ) -> NamedEffect:
        """Return a named effect as it was found, with its numbers, its share of the gap, and what ties with it."""
        kind, sentence = placed.effect, placed.effect.sentence.format(target=placed.target)
        keys = tuple(dict.fromkeys(p.called for p in tied if p.called != placed.called))
        name, variant = (kind.known_as, kind.name) if kind.known_as else (kind.name, "")
        return cls(name, placed.target, parameters, share, keys, sentence, variant)


@dataclass(frozen=True)
class LeftOut:
    """An effect that has no name because nothing needs it, and how large it may be all the same.

    Attributes:
        effect: its name in the vocabulary.
        target: where it would sit.
        parameters: its numbers, with the 90 % intervals that they have beside all others of its kind.
    """

    effect: str
    target: str | None
    parameters: Mapping[str, Strength]


@dataclass(frozen=True)
class Score:
    """How far a model is from held-out data.

    Attributes:
        mse: mean squared error of one-step predictions, over features; it averages rad², m² and squares of velocities.
        log_likelihood: of the one-step predictions, with the noise of start and end, in nats.
        rollout_rmse: root mean square error of open-loop positions over :attr:`Gap.rollout_seconds`; angles in rad and
            lengths in m, averaged as they are.
        rollout: root mean square error of each feature in open loop, ``(m,)``, in the feature's unit.
    """

    mse: float
    log_likelihood: float
    rollout_rmse: float
    rollout: tuple[float, ...] = ()


@dataclass(frozen=True)
class Ranked:
    """A candidate that was tried, for the report.

    Attributes:
        effect, target: the candidate.
        values: its numbers.
        left: share of the excess that was left with it, and with what it was tried together, of what there was without.
        round: of the search; each begins from what the ones before have found.
        together: effects and targets that were added along with it.
    """

    effect: str
    target: str | None
    values: Mapping[str, float]
    left: float
    round: int = 0
    together: tuple[tuple[str, str | None], ...] = ()


@dataclass(frozen=True)
class Residuals:
    """Residuals before and after against the variable that tells most, for one named effect or place.

    Attributes:
        title: what is shown.
        label: the variable and its unit.
        unit: unit of the force.
        variable: its values, ``(N,)``.
        before, after: missing generalized force without and with the effects, ``(N,)``.
    """

    title: str
    label: str
    unit: str
    variable: np.ndarray
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class Course:
    """A position over successive stretches of unseen data, each predicted in open loop from where the log is then.

    Attributes:
        label, unit: of the position.
        time: seconds since the episode began, ``(S, L + 1)``.
        measured: as logged, ``(S, L + 1)``.
        before, after: as predicted without and with the effects, ``(S, L + 1)``; NaN where a simulation diverged.
    """

    label: str
    unit: str
    time: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class Remaining:
    """What named effects leave, where it is more than noise.

    Attributes:
        chi2_per_degree: χ² per degree of freedom; noise alone makes 1.
        share: share of the gap's misfit that is left, in [0, 1].
        windows: share of the log's stretches in which it shows.
        where: joint whose missing force stands out most.
        when: the regime in which that shows, in words, or empty.
        open_loop: open-loop error on held-out data, in units of what noise alone makes.
    """

    chi2_per_degree: float
    share: float
    windows: float
    where: str
    when: str
    open_loop: float


@dataclass(frozen=True)
class JointForce:
    """Force of a joint that a model does not explain on held-out data.

    Attributes:
        joint: its name.
        unit: of the force.
        before, after: root mean square of the logged force minus what the motion needs, without and with the effects,
            as far as the joints move: both are free of what is much faster.
    """

    joint: str
    unit: str
    before: float
    after: float


@dataclass(frozen=True)
class Disturbance:
    """A push that is no part of the robot, for a span of the log.

    Attributes:
        episode: of the log, counted from 0.
        begin, end: seconds since the episode began.
        body: on which one constant force explains it; ``None`` where none does.
        force: that force at the body's center, in the world's directions, in N, ``(3,)``; ``None`` where there is none.
        joint: the joint at which it stands out most.
        moment: the largest force that this joint would need besides.
        unit: of that.
    """

    episode: int
    begin: float
    end: float
    body: str | None
    force: tuple[float, float, float] | None
    joint: str
    moment: float
    unit: str


@dataclass(frozen=True)
class Gap:
    """The result of ``dropo gap``.

    Attributes:
        where: places, the largest share first.
        effects: named effects, the strongest first; empty if the log shows no gap.
        before, after, noise_floor: scores on held-out data.
        next_experiment: what motion would tell more, or ``None``.
        found: whether anything is missing at all.
        declared: values of the declared parameters: as given, fitted alone, fitted with the effects.
        fitted: the last of these with their intervals; empty where predictions did not decide.
        noise: estimated (or given) standard deviation of each feature.
        labels, units: the features.
        reduced: χ² per degree of freedom before and after.
        ranking: candidates that were tried, best first.
        residuals: pictures of what is missing.
        courses: positions on held-out data, as measured and as predicted; empty where predictions did not decide.
        left_out: of what real joints have, where several were named together: what was not needed.
        cannot_judge: candidates that change nothing on this log.
        rollout_seconds: length of an open-loop prediction.
        window: logged steps of the windows on which hypotheses were compared.
        simulated_transitions, seconds, backend, seed: what it took.
        notes: remarks for a person.
        symbolic: a sparse formula for a force that has no name, or empty.
        remaining: what the named effects leave, if that is more than noise.
        refused: why what would account for the misfit has no name, or empty.
        unfinished: where the search was when its time was over, or empty.
        own_step: χ² per degree of freedom with the model's own step and with a finer one, if only that remains.
        lasting: whether noise leaves more than that of single rows would: no effect explains any of it, and it does not
            add up in longer predictions.
        joints: the joint at which each effect of the base family sits: of joints and actuators by name, in the model's
            order; empty where what was named is no such family.
        skill: whether the model as it is predicts held-out data better in open loop than constant velocity does.
        forces: unexplained forces of the joints, where these decided and not predictions: the log has the force of
            every joint, and the model as it is has no skill.
        disturbances: pushes that are no part of the robot; the spans of the log that have them were left out.
    """

    where: tuple[Place, ...]
    effects: tuple[NamedEffect, ...]
    before: Score
    after: Score
    noise_floor: Score
    next_experiment: str | None
    found: bool
    declared: Mapping[str, tuple[float, float, float]]
    noise: tuple[float, ...]
    labels: tuple[str, ...]
    units: tuple[str, ...]
    reduced: tuple[float, float]
    ranking: tuple[Ranked, ...] = ()
    residuals: tuple[Residuals, ...] = ()
    courses: tuple[Course, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    cannot_judge: tuple[tuple[str, str | None], ...] = ()
    fitted: Mapping[str, Strength] = field(default_factory=dict)
    rollout_seconds: float = 0.0
    window: int = 0
    simulated_transitions: int = 0
    seconds: float = 0.0
    backend: str = "mujoco"
    seed: int = 0
    notes: tuple[str, ...] = ()
    symbolic: str = ""
    remaining: Remaining | None = None
    refused: str = ""
    unfinished: str = ""
    own_step: tuple[float, float] | None = None
    lasting: bool = False
    joints: Mapping[str, str] = field(default_factory=dict)
    skill: bool = True
    forces: tuple[JointForce, ...] = ()
    disturbances: tuple[Disturbance, ...] = ()

    @property
    def verdict(self) -> str:
        """What was found: ``no gap``, ``explained``, ``partly explained`` or ``unnamed``."""
        if not self.found:
            return "no gap"
        if all(e.effect == "unnamed" for e in self.effects):
            return "unnamed"
        return "explained" if self.remaining is None and not self.forces else "partly explained"

    @property
    def closed(self) -> float:
        """Share of the open-loop error above the noise floor that is gone; NaN where that says nothing."""
        before, after, floor = (s.rollout_rmse for s in (self.before, self.after, self.noise_floor))
        sound = all(map(math.isfinite, (before, after, floor))) and before > floor
        return min((before - after) / (before - floor), 1.0) if sound else math.nan

    def document(self) -> dict[str, Any]:
        """Return the content of ``gap.json``."""
        return plain_numbers({
            "schema": SCHEMA,
            "verdict": self.verdict,
            "verdict_reason": reason(self),
            "unfinished": self.unfinished or None,
            "own_step": self.own_step,
            "remaining": None if self.remaining is None else asdict(self.remaining),
            "where": [asdict(place) for place in self.where],
            "effects": [_effect(e) for e in self.effects],
            "forces": [asdict(f) for f in self.forces] or None,
            "disturbances": [asdict(d) for d in self.disturbances],
            "gap": {
                name: {key: getattr(getattr(self, name), key) for key in ("mse", "log_likelihood", "rollout_rmse")}
                for name in ("before", "after", "noise_floor")
            },
            "next_experiment": self.next_experiment,
            "declared": {
                n: dict(zip(("given", "alone", "with_effects"), values, strict=True))
                | ({"low": self.fitted[n].low, "high": self.fitted[n].high} if n in self.fitted else {})
                for n, values in self.declared.items()
            },
            "noise": dict(zip(self.labels, self.noise, strict=True)),
            "chi2_per_degree": dict(zip(("before", "after"), self.reduced, strict=True)),
            "ranking": [asdict(r) | {"together": [_pair(p) for p in r.together]} for r in self.ranking],
            "left_out": [
                {**_pair((e.effect, e.target)), "parameters": {n: asdict(s) for n, s in e.parameters.items()}}
                for e in self.left_out
            ],
            "cannot_judge": [_pair(p) for p in self.cannot_judge],
            "symbolic": self.symbolic or None,
            "notes": self.notes,
            "backend": self.backend,
            "simulated_transitions": self.simulated_transitions,
            "seconds": self.seconds,
            "seed": self.seed,
        })  # fmt: skip


def reason(gap: Gap) -> str:
    """Return in words what a verdict stands on."""
    if gap.lasting:
        return (
            f"χ² per degree of freedom is {gap.reduced[1]:.3g}, but no effect explains any of it, and it does not add "
            "up in longer predictions of unseen data: it is noise that lasts over rows, or stamps that jitter"
        )
    if not gap.found:
        return "what remains is no more than noise"
    if gap.verdict == "unnamed":
        if gap.unfinished and not gap.refused:
            return f"the time for the search was over ({gap.unfinished})"
        return gap.refused or "no known effect, and no few of them together, account for the misfit"
    if gap.forces:
        return f"no open-loop prediction has skill on this log, and by the forces at the joints, {fallen(gap.forces)}"
    if gap.own_step is not None:
        own, finer = gap.own_step
        return (
            f"the named effects leave no more than noise under a finer step: χ² per degree of freedom is {finer:.3g}, "
            f"and {own:.3g} with the model's own step; their numbers are those of an endlessly fine one"
        )
    if gap.remaining is None:
        return "the named effects leave no more than noise"
    left = gap.remaining
    when = f", {left.when}" if left.when else ""
    return (
        f"what the named effects leave is more than noise: χ² per degree of freedom is {left.chi2_per_degree:.3g} "
        f"(1 is noise alone), in {100 * left.windows:.0f} % of the log's stretches, mostly at {left.where}{when}; "
        f"open-loop errors are {left.open_loop:.3g} times what noise alone makes"
    )


def fallen(forces: Sequence[JointForce]) -> str:
    """Return in words how much less of the joints' forces is unexplained with the effects."""
    shares = [f.after / f.before for f in forces if f.before > 0]
    least, most = (f"{100 * share:.0f}" for share in (min(shares), max(shares)))
    rest = f"{least} %" if least == most else f"{least} to {most} %"
    return f"the force that is unexplained on held-out data falls to {rest} at each"


def _pair(placed: tuple[str, str | None]) -> dict[str, str | None]:
    return {"effect": placed[0], "target": placed[1]}


def _effect(e: NamedEffect) -> dict[str, Any]:
    return {
        **_pair((e.effect, e.target)),
        **({"variant": e.variant} if e.variant else {}),
        "parameters": {n: asdict(s) for n, s in e.parameters.items()},
        "share_of_gap": e.share_of_gap,
        "indistinguishable_from": [_pair(p) for p in e.indistinguishable_from],
    }
