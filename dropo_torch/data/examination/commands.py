"""Commands: of another row, of another actuator, with another sign or in another unit.

The model need not be right for that: what commands do to the velocities within a row is simulated, and regressed on
what the velocities did, each degree of freedom with terms of its own for whatever depends on where it is and how fast.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np

from dropo_torch.data.examination.finding import Finding, confidence
from dropo_torch.data.examination.prediction import Reading as Whole
from dropo_torch.data.examination.prediction import better_reading, chosen_rows, response_steps, simulate
from dropo_torch.data.examination.record import Pair, Record
from dropo_torch.data.examination.rules import Rules

#: Rows by which commands are shifted.
REACH = 2
#: Positions and velocities that may explain accelerations besides commands, at most so many each.
TERMS = 8
#: Rows below which commands are not examined: they would be as few as what may explain them.
LEAST_ROWS = 100
#: Rows that a command stays the same from which on a row says little of when it acts: velocities that were smoothed
#: change before it does.
HELD = 3.0
#: Share of its effect in its own row that a command has in the right one, at least: what is a row off looks weaker, and
#: what explains less and less of it the later it is stands for something else, such as damping that the model lacks.
WEAKENED = 0.7
#: Blocks over which readings are compared.
BLOCKS = 20
DEGREE = float(np.pi / 180)


@dataclass(frozen=True)
class Reading:
    """Which command acts at each actuator, and how many rows further on in the log it stands."""

    order: tuple[int, ...]
    shift: int = 0


@dataclass(frozen=True)
class Explained:
    """How a reading explains the accelerations.

    Attributes:
        gains: factor of each actuator's effect, ``(nu,)``; 1 where model and log agree.
        errors: standard errors of these.
        misfit: robust misfit of each block of rows, ``(B,)``.
        share: share of what terms without commands leave that commands explain.
        shares: share that each command explains beside the others, ``(nu,)``.
    """

    gains: np.ndarray
    errors: np.ndarray
    misfit: np.ndarray
    share: float
    shares: np.ndarray


def commands(record: Record, rules: Rules) -> list[Finding]:
    """Return what is wrong with the commands, as far as the accelerations tell."""
    effects = None if record.observation.is_sensed else _Effects.of(record)  # it simulates from what is logged
    if effects is None:
        return []
    own = tuple(range(effects.controls))
    plain = effects.explained(Reading(own))
    if plain is None:
        return []
    late = [] if _inferred(record) else _late(record, effects, plain, rules)
    return (
        late or _exchanged(record, effects, plain, rules) or _negated(record, plain, rules)
        or ([] if _inferred(record) else _units(record, plain, rules))
    )  # fmt: skip


def _inferred(record: Record) -> bool:
    """Whether the commands were taken from what was measured after the row, as preprocessing does it."""
    return all(
        (record.after == action[:, None]).all(axis=0).any() for action in record.log.actions.T
    )  # fmt: skip


@dataclass(frozen=True)
class _Effects:
    """What rows and commands do to velocities.

    Attributes:
        change: changes of velocity that no command made, if the model is right, ``(T, v)``.
        response: changes per unit of each command, ``(T, v, nu)``.
        logged: logged commands so many rows further on, by shift, each ``(T, nu)``.
        terms: an orthonormal basis of what may explain changes besides, ``(T, p)``.
        scale: standard deviation of each column of what is left, ``(v,)``.
        made: what commands make where they act, without what other terms explain, by shift, actuator and command:
            computed when first asked for.
    """

    change: np.ndarray
    response: np.ndarray
    logged: dict[int, np.ndarray]
    terms: np.ndarray
    scale: np.ndarray
    made: dict[tuple[int, int, int], np.ndarray] = field(default_factory=dict)

    @property
    def controls(self) -> int:
        """Number of commands."""
        return int(self.response.shape[2])

    @classmethod
    def of(cls, record: Record) -> _Effects | None:
        """Simulate some rows of a record; ``None`` where commands or velocities are missing or do not vary."""
        model, log = record.model, record.log
        columns = np.asarray(record.observation.columns)
        if model is None or model.nu == 0 or model.na or log.actions.shape[1] != model.nu:
            return None
        seen = np.flatnonzero(columns >= model.nq)
        if seen.size == 0 or not (log.actions.std(axis=0) > 0).any():
            return None
        rows = chosen_rows(record, record.frame_skip + model.nu * response_steps(record), reach=REACH)
        if len(rows) < LEAST_ROWS:
            return None
        predicted, response = _responses(record, rows, seen)
        predicted = predicted - np.einsum("tvu,tu->tv", response, log.actions[rows])
        change = (record.after - record.before)[rows][:, seen] - predicted
        good = np.isfinite(change).all(axis=1) & np.isfinite(response).all(axis=(1, 2))
        rows, change, response = rows[good], change[good], response[good]
        moved = np.abs(response).max(axis=(0, 2), initial=0.0) > 0
        if len(rows) < LEAST_ROWS or not moved.any():
            return None
        logged = {s: log.actions[rows + s] for s in range(-REACH, REACH + 1)}
        terms = _terms(record, rows, predicted[good])
        change, response = change[:, moved], response[:, moved]
        found = cls(change, response, logged, terms, np.ones(change.shape[1]))
        rest = found._rest(change)
        scale = 1.4826 * np.median(np.abs(rest - np.median(rest, axis=0)), axis=0)
        return replace(found, scale=np.maximum(scale, 1e-9)).rescaled()

    def rescaled(self) -> _Effects:
        """Return these with the scale of what the best simple reading leaves."""
        own = tuple(range(self.controls))
        best, least = self.scale, np.inf
        for shift in self.logged:
            fitted = self._fit(Reading(own, shift))
            if fitted is not None:
                scale = np.maximum(1.4826 * np.median(np.abs(fitted[1]), axis=0), 1e-9 * self.scale)
                size = float(np.log(scale).sum())
                if size < least:
                    best, least = scale, size
        return replace(self, scale=np.maximum(best, 1e-6 * self.scale))

    def _columns(self, reading: Reading) -> np.ndarray:
        """Changes that each command makes under a reading, without what other terms explain, ``(T, v, nu)``."""
        parts = []
        for actuator, command in enumerate(reading.order):
            key = reading.shift, actuator, command
            if key not in self.made:
                acting = self.logged[reading.shift][:, command, None]
                self.made[key] = self._rest(self.response[:, :, actuator] * acting)
            parts.append(self.made[key])
        return np.stack(parts, axis=2)

    def _rest(self, changes: np.ndarray) -> np.ndarray:
        """What the other terms leave of changes ``(T, v)``; sums this small take longest where they are shared out."""
        return np.asarray(changes - np.einsum("tp,pv->tv", self.terms, np.einsum("tp,tv->pv", self.terms, changes)))

    def _fit(self, reading: Reading) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Gains, residuals ``(T, v)``, whitened columns and the inverse of their normal matrix."""
        made = self._columns(reading)
        target = self._rest(self.change)
        count, width, controls = made.shape
        weight = np.ones(count)
        matrix = (made / self.scale[:, None]).reshape(count * width, controls)
        wanted = (target / self.scale).reshape(-1)
        gains, normal = np.zeros(controls), np.eye(controls)
        for _ in range(3):  # rows that fit far worse than the others, as at impacts, count less
            rows = np.repeat(np.sqrt(weight), width)
            weighted = matrix * rows[:, None]
            normal = weighted.T @ weighted
            if not np.isfinite(normal).all() or np.trace(normal) == 0:
                return None
            inverse = np.linalg.pinv(normal, rcond=1e-8)
            gains = inverse @ (weighted.T @ (wanted * rows))
            off = ((wanted - matrix @ gains).reshape(count, width) ** 2).mean(axis=1)
            typical = max(float(np.median(off)), 1e-12)
            weight = np.minimum(1.0, 9 * typical / np.maximum(off, 1e-300))
        rest = (wanted - matrix @ gains).reshape(count, width)
        return gains, rest * self.scale, matrix * np.repeat(np.sqrt(weight), width)[:, None], inverse

    def explained(self, reading: Reading) -> Explained | None:
        """Return how a reading explains the changes; ``None`` where its commands make none."""
        fitted = self._fit(reading)
        if fitted is None:
            return None
        gains, rest, matrix, inverse = fitted
        count, width = rest.shape
        whitened = rest / self.scale
        losses = np.minimum(whitened**2, 25.0).mean(axis=1)
        blocks = np.array_split(np.arange(count), BLOCKS)
        scores = (matrix * whitened.reshape(-1, 1)).reshape(count, width, -1).sum(axis=1)
        sums = np.stack([scores[b].sum(axis=0) for b in blocks])
        errors = np.sqrt(np.maximum(np.diag(inverse @ (sums.T @ sums) @ inverse), 1e-300))
        target = self._rest(self.change) / self.scale
        kept = np.sqrt((whitened**2).mean(axis=1))
        kept = kept <= np.quantile(kept, 0.95)
        whole = float((target[kept] ** 2).sum())
        left = float((whitened[kept] ** 2).sum())
        size = (matrix.reshape(count, width, -1)[kept] ** 2).sum(axis=(0, 1)) * gains**2
        return Explained(
            gains, errors, np.array([losses[b].sum() for b in blocks]), 1 - left / max(whole, 1e-300),
            size / (size + max(left, 1e-300)),
        )  # fmt: skip


def _responses(record: Record, rows: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Simulated changes of the observed velocities ``(T, v)``, and their derivatives by the commands ``(T, v, nu)``."""
    model, log = record.model, record.log
    assert model is not None
    columns = np.asarray(record.observation.columns)[seen]
    states = record.observation.states(log.observations[rows])
    actions = log.actions[rows]
    low, high = np.where(
        model.actuator_ctrllimited.astype(bool)[:, None], model.actuator_ctrlrange, [[-np.inf, np.inf]]
    ).T
    base = np.clip(actions, low, high)
    ends = simulate(model, states, base, record.frame_skip)[:, columns]
    steps = response_steps(record)
    short = ends if steps == record.frame_skip else simulate(model, states, base, steps)[:, columns]
    response = np.empty((len(rows), len(columns), model.nu))
    for j in range(model.nu):  # over so large a change that stops and contacts do not hide what a command does
        size = 0.5 * max(float(actions[:, j].std()), 1e-6)
        moved = base.copy()
        moved[:, j] = np.clip(np.where(np.abs(base[:, j]) > size, -1, 0) * base[:, j], low[j], high[j])
        moved[:, j] += np.where(moved[:, j] != base[:, j], 0.0, np.where(base[:, j] + size > high[j], -size, size))
        change = simulate(model, states, moved, steps)[:, columns] - short
        response[:, :, j] = change / (moved[:, j] - base[:, j])[:, None] * (record.frame_skip / steps)
    return ends - states[:, columns], response


def _terms(record: Record, rows: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what may explain changes besides commands in some rows, ``(T, p)``.

    That is a constant, positions, velocities and their signs, as springs and friction need them, sines and cosines of
    angles, as weights do, and the changes that the model predicts without commands, as wrong masses do.
    """
    model = record.model
    assert model is not None
    columns = np.asarray(record.observation.columns)
    positions = np.flatnonzero(columns < model.nq)[:TERMS]
    speeds = np.flatnonzero(columns >= model.nq)[:TERMS]
    values = record.before[rows]
    angles = [c.position for c in record.coordinates if c.angle and c.position is not None][:TERMS]
    fast = np.maximum(0.1 * values[:, speeds].std(axis=0), 1e-12)
    parts = [
        np.ones((len(rows), 1)), values[:, positions], values[:, speeds], np.tanh(values[:, speeds] / fast),
        np.sin(values[:, angles]), np.cos(values[:, angles]), predicted[:, :TERMS],
    ]  # fmt: skip
    table = np.concatenate(parts, axis=1)
    table = table / np.maximum(np.abs(table).max(axis=0), 1e-12)
    size, vectors = np.linalg.eigh(np.einsum("tp,tq->pq", table, table))
    kept = size > 1e-10 * size[-1]
    return np.asarray(np.einsum("tp,pq->tq", table, vectors[:, kept] / np.sqrt(size[kept])))


def beats(first: Explained, second: Explained) -> float:
    """Return by how many paired standard errors over blocks the first reading leaves less than the second."""
    change = second.misfit - first.misfit
    error = float(change.std(ddof=1)) * np.sqrt(len(change))
    return float(change.sum()) / max(error, 1e-12)


def _exchanged(record: Record, effects: _Effects, plain: Explained, rules: Rules) -> list[Finding]:
    """Commands that act at each other's actuators."""
    count = effects.controls
    if count < 2 or count > 12:
        return []
    best: tuple[float, Reading, Explained] | None = None
    for i, j in itertools.combinations(range(count), 2):
        order = list(range(count))
        order[i], order[j] = j, i
        found = effects.explained(Reading(tuple(order)))
        if found is not None and (best is None or found.misfit.sum() < best[0]):
            best = float(found.misfit.sum()), Reading(tuple(order)), found
    if best is None:
        return []
    _, reading, found = best
    better = beats(found, plain)
    pair = [i for i, j in enumerate(reading.order) if i != j]
    right = found.gains[pair]
    if better < rules.significance or not (np.abs(np.log(np.maximum(right, 1e-9))) < np.log(rules.gain)).all():
        return []
    if (right < 5 * found.errors[pair]).any() or found.share < plain.share:
        return []
    remains = (1 - found.share) / max(1 - plain.share, 1e-12)
    sure = better > rules.sure_significance and remains < 1 - rules.command_share
    names = [record.command(j) for j in reading.order]
    first, second = (record.command(i) for i in pair)
    what = (
        f"the accelerations follow if {first} and {second} are exchanged: {found.share:.0%} of what commands can "
        f"explain, {plain.share:.0%} as they stand"
    )
    return [Finding(
        "action_order", (first, second), what, confidence(sure),
        evidence={"standard_errors": better, "share": found.share, "share_as_logged": plain.share},
        cure={"data": {"actions": names}},
    )]  # fmt: skip


def _negated(record: Record, plain: Explained, rules: Rules) -> list[Finding]:
    """Commands that act with the opposite sign."""
    told = plain.gains + rules.significance * plain.errors < 0
    told &= np.abs(np.log(np.maximum(-plain.gains, 1e-9))) < np.log(rules.gain)
    told &= plain.shares > 0.02
    if not told.any():
        return []
    columns = np.flatnonzero(told)
    sure = bool(
        (plain.gains[columns] + rules.sure_significance * plain.errors[columns] < 0).all()
        and (plain.shares[columns] > rules.command_share).all()
    )
    return _signs(record, plain, columns.tolist(), sure, rules)


def _signs(record: Record, plain: Explained, columns: Sequence[int], sure: bool, rules: Rules) -> list[Finding]:
    """The finding of commands that act with the opposite sign, or of joints that are logged so: as the model says."""
    joints = {j: pair for j in columns if (pair := _driven(record, j)) is not None}
    flipped = [c for pair in dict.fromkeys(joints.values()) for c in (pair.position, pair.velocity)]
    others = [j for j in columns if j not in joints]
    names = tuple(record.command(j) for j in columns)
    factors = f"factor {', '.join(f'{plain.gains[j]:.2f}' for j in columns)}"
    evidence = {n: float(plain.gains[j]) for n, j in zip(names, columns, strict=True)}
    signs: dict[str, Any] = {"data": {"scale": dict.fromkeys(names, -1.0)}}
    what = f"{', '.join(names)} act against the sign that the model gives them ({factors})"
    if not joints:
        advice = "or the model's gear has the wrong sign"
        return [Finding("action_sign", names, what, confidence(sure), evidence=evidence, cure=signs, advice=advice)]
    readings = [Whole.of(record, commands=columns), Whole.of(record, columns=flipped, commands=others)]
    chosen = better_reading(record, readings, rules)
    signals = [record.signal(c) for c in flipped]
    negated = dict.fromkeys([*signals, *(record.command(j) for j in others)], -1.0)
    if chosen is None:
        what += f"; either they are negated or {', '.join(signals)} are, and the model tells these not apart"
        advice = f"data: {{scale: {_flow(signs['data']['scale'])}}}, or data: {{scale: {_flow(negated)}}}"
        return [Finding("action_sign", names, what, "doubtful", evidence=evidence, advice=advice)]
    if chosen == 0:
        advice = "or the model's gear has the wrong sign; with the joint negated the model predicts the log less well"
        return [Finding("action_sign", names, what, confidence(sure), evidence=evidence, cure=signs, advice=advice)]
    what = f"{record.named(flipped)} grow against the joint's axis: {', '.join(names)} would act backwards ({factors})"
    return [Finding(
        "joint_sign", tuple(record.label(c) for c in flipped), what, confidence(sure), evidence=evidence,
        cure={"data": {"scale": negated}}, advice="or the model's axis points the wrong way",
    )]  # fmt: skip


def _driven(record: Record, actuator: int) -> Pair | None:
    """The coordinate that an actuator drives at its joint, where both its columns are seen."""
    model = record.model
    assert model is not None
    kinds = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    joint = int(model.actuator_trnid[actuator, 0])
    scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    if int(model.actuator_trntype[actuator]) not in kinds or int(model.jnt_type[joint]) not in scalar:
        return None
    return next((c for c in record.pairs if c.dof == int(model.jnt_dofadr[joint])), None)


def _flow(scale: Mapping[str, float]) -> str:
    """Factors as they stand in YAML."""
    return f"{{{', '.join(f'{name}: {factor:g}' for name, factor in scale.items())}}}"


def _units(record: Record, plain: Explained, rules: Rules) -> list[Finding]:
    """Commands whose effect is another one by far than the model's."""
    found = []
    for j, (gain, error, share) in enumerate(zip(plain.gains, plain.errors, plain.shares, strict=True)):
        clear = gain > rules.sure_significance * error and share > rules.command_share
        if not clear or abs(np.log(gain)) < np.log(rules.gain):
            continue
        degrees = abs(np.log(gain / DEGREE)) < 0.3 and is_servo(record, j)
        unit = "in degrees" if degrees else "in another unit"
        factor = DEGREE if degrees else float(f"{gain:.3g}")
        what = f"{record.command(j)} acts {gain:.3g} times as strongly as the model says: it is {unit}"
        found.append(Finding(
            "action_unit", (record.command(j),), what, confidence(degrees),
            evidence={"gain": float(gain), "error": float(error), "share": float(share)},
            cure={"data": {"scale": {record.command(j): factor}}},
        ))  # fmt: skip
    return found


def is_servo(record: Record, actuator: int) -> bool:
    """Return whether an actuator's command is the target of a joint."""
    model = record.model
    assert model is not None
    joint = model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
    return bool(joint and model.actuator_biasprm[actuator, 1] != 0)


def _held(record: Record) -> float:
    """For how many rows a command stays the same, on average."""
    actions = record.log.actions
    changes = (np.abs(np.diff(actions, axis=0)) > 1e-9 * actions.std(axis=0)).any(axis=1).mean()
    return float(1 / max(changes, 1e-9))


def _late(record: Record, effects: _Effects, plain: Explained, rules: Rules) -> list[Finding]:
    """Commands that act in other rows than theirs."""
    own = tuple(range(effects.controls))
    others = {s: effects.explained(Reading(own, s)) for s in effects.logged if s != 0}
    known = {s: found for s, found in others.items() if found is not None}
    if not known:
        return []
    shift = min(known, key=lambda s: known[s].misfit.sum())
    best = known[shift]
    better = beats(best, plain)
    left = (1 - best.share) / max(1 - plain.share, 1e-12)
    acting = best.shares > 0.02
    in_range = np.abs(np.log(np.maximum(best.gains[acting], 1e-9))) < np.log(rules.gain)
    grows = bool((best.gains > WEAKENED * plain.gains)[acting].all())
    if better < rules.significance or left > 0.9 or not acting.any() or not (grows and in_range.all()):
        return []
    rows = f"{abs(shift)} {'row' if abs(shift) == 1 else 'rows'}"
    evidence = {"rows": float(shift), "standard_errors": better, "left": left, "share": best.share}
    names = tuple(record.command(j) for j in own)
    cure = {"data": {"shift": shift}}
    if shift > 0:
        what = (
            f"the accelerations of a row follow from the commands logged {rows} later: rows carry earlier commands "
            "than those that act, or the observations come late"
        )
        sure = better > rules.sure_significance and left < rules.earlier and _held(record) <= HELD
        return [Finding("action_shift", names, what, confidence(sure), evidence=evidence, cure=cure)]
    what = (
        f"the accelerations of a row follow from the commands logged {rows} before: rows carry later commands than "
        "those that act, or the actuators answer with a delay"
    )
    advice = "leave a true delay to the model: dropo gap names it (actuator_delay, actuator_lag)"
    return [Finding("action_shift", names, what, "doubtful", evidence=evidence, cure=cure, advice=advice)]
