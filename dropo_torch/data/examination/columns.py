"""Columns by themselves: stuck, repeated, quantised, out of range, in another unit."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from dropo_torch.data.examination.commands import is_servo
from dropo_torch.data.examination.finding import Finding, confidence, first_rows
from dropo_torch.data.examination.prediction import skills
from dropo_torch.data.examination.record import Coordinate, Pair, Record
from dropo_torch.data.examination.rules import Rules
from dropo_torch.data.resolution import resolution

DEGREE = float(np.pi / 180)
#: Steps of a column from which on one of them is unlike the others, those beside a row that count, and rows that a
#: sentence names.
LEAST_STEPS, BESIDE, MOST_NAMED = 50, 6, 3


def stuck(record: Record, rules: Rules) -> list[Finding]:
    """Return columns that stand still while their position or velocity says that they move, or all where none moves."""
    still = not np.ptp(np.concatenate([record.before, record.after]), axis=0).any()
    if record.pairs and still and len(record.before) >= rules.frozen:
        return [_motionless(record)]
    found = []
    step = record.step or 1.0
    usual = float(np.median([np.ptp(record.before[:, c.position]) for c in record.pairs])) if record.pairs else 0.0
    for c in record.pairs:
        position, speed = record.before[:, c.position], record.before[:, c.velocity]
        moved, told = float(np.ptp(position)), float(np.abs(np.cumsum(speed)).max() * step)
        if np.ptp(speed) == 0 and moved > 0 and np.median(np.abs(record.steps[:, c.position])) > 0:
            found.append(_constant(record, c, c.velocity, moved))
        elif moved == 0 and np.ptp(speed) > 0 and told > max(rules.frozen_travel * usual, 0.0):
            found.append(_constant(record, c, c.position, told))
        else:
            found += _frozen(record, c, step, rules)
    return found + _repeated(record, step, rules)


def spikes(record: Record, rules: Rules) -> list[Finding]:
    """Return positions that leave for a single row and come back, faster by far than they move anywhere else."""
    found = {column: rows for c, column in record.positions if (rows := _spikes(record, c, column, rules)).size}
    if not found:
        return []
    places = [
        f"{record.named([column])} at row {', '.join(str(record.file_row(int(r))) for r in rows[:MOST_NAMED])}"
        + (f" and {len(rows) - MOST_NAMED} more" if len(rows) > MOST_NAMED else "")
        + f" ({record.before[rows[0], column]:.4g} between {record.before[rows[0] - 1, column]:.4g} and "
        f"{record.after[rows[0], column]:.4g})"
        for column, rows in found.items()
    ]
    return [Finding(
        "spike", tuple(record.label(column) for column in found),
        f"a position jumps away for a single row: {'; '.join(places)}", "doubtful",
        rows=first_rows(np.unique(np.concatenate(list(found.values())))),
        evidence={record.label(column): float(len(rows)) for column, rows in found.items()},
        advice="leave the row out, or set the value to NaN and let preprocess: {max_gap: SECONDS} bridge it",
    )]  # fmt: skip


def _spikes(record: Record, c: Coordinate, column: int, rules: Rules) -> np.ndarray:
    """Rows whose value departs from those of both rows beside it by far more than the column's other steps."""
    steps, runs = record.steps[:, column], record.runs
    size = np.abs(steps)
    if len(steps) < LEAST_STEPS or not size.any():
        return np.empty(0, dtype=int)
    rows = np.arange(1, len(steps))
    whole = (runs[1:] == runs[:-1]) & ~record.cut[1:] & ~record.cut[:-1]
    away, back = steps[:-1], steps[1:]
    least = np.minimum(size[:-1], size[1:])
    usual = max(float(np.quantile(size, 0.99)), float(np.median(size[size > 0])))
    padded = np.pad(size, BESIDE)
    beside = np.max([padded[BESIDE + rows + s] for s in range(-BESIDE, BESIDE) if s not in (-1, 0)], axis=0)
    whole &= (away * back < 0) & (np.abs(away + back) < 0.5 * least)  # it comes back to where it was
    whole &= least > rules.spike * np.maximum(usual, beside)
    if c.velocity is not None:
        speed = 0.5 * (record.before[:, c.velocity] + record.after[:, c.velocity]) * (record.step or 1.0)
        whole &= (np.abs(away - speed[:-1]) > 0.5 * size[:-1]) & (np.abs(back - speed[1:]) > 0.5 * size[1:])
    return rows[whole]


def _motionless(record: Record) -> Finding:
    what = f"no column changes in {len(record.before)} rows: the robot stood still, or its state was not recorded"
    labels = tuple(record.label(column) for column in range(record.before.shape[1]))
    return Finding("frozen", labels, what, "sure", advice="record a motion; this log tells nothing")


def _constant(record: Record, c: Pair, column: int, moved: float) -> Finding:
    other = c.position if column == c.velocity else c.velocity
    what = f"{record.named([column])} is constant while {record.named([other])} changes: it was not measured"
    advice = "" if column == c.position else (
        "leave the velocities out and let them be derived: data: {observations: [the positions], preprocess: {dt: "
        f"{record.step or 'SECONDS'}}}}}"
    )  # fmt: skip
    return Finding("frozen", (record.label(column),), what, "sure", evidence={"moved": moved}, advice=advice)


def _frozen(record: Record, c: Pair, step: float, rules: Rules) -> list[Finding]:
    """A stretch in which a position stands still although its velocity is not zero."""
    still = (record.steps[:, c.position] == 0) & ~record.cut
    travel = 0.5 * step * (record.before[:, c.velocity] + record.after[:, c.velocity])
    spread = float(np.ptp(record.before[:, c.position]))
    size = np.abs(record.steps[:, c.position])
    quantum = float(size[size > 0].min()) if size.any() else 0.0
    best, rows = max(rules.frozen_travel * spread, 5 * quantum), np.empty(0, dtype=int)
    for a, b in _stretches(still & ~record.parted):
        moved = abs(float(travel[a:b].sum()))
        if b - a >= rules.frozen and moved > best:
            best, rows = moved, np.arange(a, b)
    if rows.size == 0:
        return []
    what = (
        f"{record.named([c.position])} stands still for {len(rows)} rows from row {rows[0]} on, in which "
        f"{record.named([c.velocity])} says that it moves by {best:.3g}"
    )
    advice = f"leave rows {rows[0]} to {rows[-1]} out (preprocess: start, stop, or two files)"
    return [Finding(
        "frozen", (record.label(c.position),), what, "sure", rows=first_rows(rows),
        evidence={"rows": float(len(rows)), "travel": best}, advice=advice,
    )]  # fmt: skip


def _stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    """First and last-plus-one row of each stretch of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _repeated(record: Record, step: float, rules: Rules) -> list[Finding]:
    """Rows in which positions stand still between rows in which they move."""
    found = []
    held: list[np.ndarray] = []
    for c in record.pairs:
        size = np.abs(record.steps[:, c.position])
        moving = size > 0
        if moving.sum() < 20:
            continue
        told = 0.5 * step * np.abs(record.before[:, c.velocity] + record.after[:, c.velocity])
        counts = told > max(3 * float(np.min(size[moving])), 0.3 * float(np.median(size[moving])))
        counts &= ~record.cut
        if counts.sum() >= 20:
            held.append(np.where(counts, ~moving, np.nan))
    if not held:
        return []
    share = float(np.nanmean(np.concatenate(held)))
    if share > rules.hold:
        rows = np.flatnonzero(np.nanmax(np.nan_to_num(held), axis=0) > 0)
        what = (
            f"{share:.0%} of the rows repeat the positions of the row before while the velocities say that they move: "
            "the sensor is slower than the log, or rows are copies"
        )
        advice = "keep one row a measurement and resample: data: {preprocess: {dt: SECONDS}}"
        found.append(Finding(
            "repeated", (), what, confidence(share > rules.sure_hold), rows=first_rows(rows),
            evidence={"share": share}, advice=advice,
        ))  # fmt: skip
    return found


def clipped(record: Record, rules: Rules) -> list[Finding]:
    """Return positions that stop dead at one end of their values: there the sensor's range ends."""
    found = {
        column: np.flatnonzero(rows)
        for c, column in record.positions
        if (rows := _clipped(record, c, column, rules)).any()
    }
    if not found:
        return []
    said = [f"{record.named([c])} at {record.before[rows[0], c]:.4g} in {len(rows)} rows" for c, rows in found.items()]
    return [Finding(
        "clipped", tuple(record.label(column) for column in found),
        f"a position stops dead at the end of what its sensor shows: {', '.join(said)}", "doubtful",
        rows=first_rows(np.unique(np.concatenate(list(found.values())))),
        evidence={record.label(column): float(len(rows)) for column, rows in found.items()},
        advice="leave these rows out, or set the values to NaN and let data: {pause: SECONDS} end an episode there",
    )]  # fmt: skip


def _clipped(record: Record, c: Coordinate, column: int, rules: Rules) -> np.ndarray:
    """Rows in which a column stands at its largest or smallest value, if it comes and goes at speed, ``(T,)`` bool.

    Not where the joint has a stop.
    """
    values, size = record.before[:, column], np.abs(record.steps[:, column])
    found = np.zeros(len(values), dtype=bool)
    if len(size) < LEAST_STEPS or not size.any():
        return found
    usual = float(np.median(size[size > 0]))
    for end in (values.max(), values.min()):
        rows = np.flatnonzero(values == end)
        stays = [s for s in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(s) >= rules.clipped]
        others = np.delete(size, np.concatenate([s[:-1] for s in stays])) if stays else size
        edges = [size[i] for s in stays for i in (s[0] - 1, s[-1]) if 0 <= i < len(size)]
        moves = (others == 0).mean() < rules.hold  # elsewhere; a sensor that counts stands still in between
        stops = c.limits is not None and np.abs(end - np.array(c.limits)).min() < rules.stop * _width(c)
        if len(edges) > 1 and moves and not stops and np.median(edges) > rules.dead * usual:
            found[np.concatenate(stays)] = True
    return found


def quantised(record: Record, rules: Rules) -> list[Finding]:
    """Return positions whose resolution is as coarse as their motion."""
    columns, quanta = [], []
    for _, column in record.positions:
        values = np.unique(record.before[:, column])
        size = np.abs(record.steps[:, column])
        if len(values) < 3 or len(values) > len(size) / 4:
            continue
        quantum = resolution(values)
        typical = float(np.median(size[size > 0])) if (size > 0).any() else 0.0
        if quantum >= rules.quantum * typical > 0:
            columns.append(column)
            quanta.append(quantum)
    if not columns:
        return []
    what = f"{record.named(columns)}: a row's motion is as small as the resolution, " + ", ".join(
        f"{q:.3g}" for q in quanta
    )
    return [Finding(
        "quantised", tuple(record.label(c) for c in columns), what, "doubtful",
        evidence=dict(zip((record.label(c) for c in columns), quanta, strict=True)),
        advice="noise of the quantum / √12 at least in these columns, or velocities by preprocess with a cutoff, or "
        "a longer lag",
    )]  # fmt: skip


def silent(record: Record, rules: Rules) -> list[Finding]:
    """Return columns of sensors that never change."""
    nq, nv = (0, 0) if record.model is None else (record.model.nq, record.model.nv)
    columns = [
        i for i, place in enumerate(record.observation.columns)
        if record.observation.is_sensed and place >= nq + nv and np.ptp(record.before[:, i]) == 0
    ]  # fmt: skip
    if not columns:
        return []
    verb = "changes" if len(columns) == 1 else "change"
    what = f"{record.named(columns)} never {verb}: a fit learns nothing from that"
    advice = "where the sensor was not connected, list it as skip in observation"
    return [Finding("silent", tuple(record.label(i) for i in columns), what, "doubtful", advice=advice)]


def units(record: Record, rules: Rules) -> list[Finding]:
    """Return joints whose positions and velocities together are in another unit than the model's."""
    angles = [c for c, _ in record.positions if c.angle]
    places = [column for c, column in record.positions if c.angle]
    if not angles:
        return []
    outside = [c for c in angles if c.limits is not None and _outside(record, c) > rules.out_of_range]
    reach = float(np.abs(record.before[:, places]).max()) / (2 * np.pi)
    if not outside and reach < rules.turns:
        return []
    fits = [c for c in outside if _outside(record, c, DEGREE) < 0.05]
    columns = [i for c in angles for i in (c.position, c.velocity) if i is not None]
    as_is, degrees = skills(record, dict.fromkeys(columns, DEGREE))
    if (found := _of_motors(record, rules, angles, degrees)) is not None:
        return [found]
    targets = _targets(record, angles)
    _, both = skills(record, dict.fromkeys(columns, DEGREE), dict.fromkeys(targets, DEGREE)) if targets else (0.0, 0.0)
    if both - degrees > rules.skill:
        degrees = both
    else:
        targets = []
    evidence = {"turns": reach, "outside": float(len(outside)), "skill": as_is, "skill_in_degrees": degrees}
    decided = degrees - as_is > rules.skill
    scale = {record.signal(i): DEGREE for i in columns} | {record.command(j): DEGREE for j in targets}
    within = len(fits) > 0 and len(fits) == len(outside)
    if decided or ((within or reach > rules.many_turns) and as_is < 2 * rules.skill):
        named = [c.position for c in (outside or angles) if c.position is not None]
        sure = decided or (within and as_is < rules.skill)
        what = f"{record.named(named)} reach {reach:.3g} turns if they are radians: the angles are in degrees"
        what += f", and so are the targets {', '.join(record.command(j) for j in targets)}" if targets else ""
        if outside:
            what += f"; they leave the ranges of {', '.join(c.name for c in outside)}, and in degrees lie within"
        return [Finding(
            "degrees", tuple(record.label(i) for i in columns), what, confidence(sure), evidence=evidence,
            cure={"data": {"scale": scale}},
        )]  # fmt: skip
    return []


def _of_motors(record: Record, rules: Rules, angles: Sequence[Coordinate], degrees: float) -> Finding | None:
    """Angles that are those of motors before gears, if the model explains more so than as they are, or in degrees.

    A gear of 50 or 60 is as many as a radian has degrees: which of both is nearer decides.
    """
    ratios = [(c, _ratio(record, c)) for c in angles]
    factors = {i: 1 / g for c, g in ratios if g > 1 for i in (c.position, c.velocity) if i is not None}
    if not factors:
        return None
    as_is, divided = skills(record, factors)
    if divided - as_is <= rules.skill or divided <= degrees:
        return None
    gears = ", ".join(f"{g:g} at {c.name}" for c, g in ratios if g > 1)
    what = f"{record.named(list(factors))} are of the motors, before the gears ({gears})"
    return Finding(
        "motor_side", tuple(record.label(i) for i in factors), what, "sure",
        evidence={"skill": as_is, "skill_divided": divided},
        cure={"data": {"scale": {record.signal(i): factor for i, factor in factors.items()}}},
    )  # fmt: skip


def _ratio(record: Record, c: Coordinate) -> float:
    """The gear ratio of the only actuator of a joint; 1 where there is none, or several."""
    model = record.model
    if model is None:
        return 1.0
    joint, through = int(model.dof_jntid[c.dof]), mujoco.mjtTrn.mjTRN_JOINT
    own = [i for i in range(model.nu) if model.actuator_trntype[i] == through and model.actuator_trnid[i, 0] == joint]
    return abs(float(model.actuator_gear[own[0], 0])) if len(own) == 1 else 1.0


def _targets(record: Record, angles: Sequence[Coordinate]) -> list[int]:
    """Commands that are targets of angles."""
    model = record.model
    if model is None:
        return []
    dofs = {c.dof for c in angles}
    return [
        j
        for j in range(min(model.nu, record.log.actions.shape[1]))
        if is_servo(record, j) and int(model.jnt_dofadr[model.actuator_trnid[j, 0]]) in dofs
    ]


def ranges(record: Record, rules: Rules) -> list[Finding]:
    """Return joints whose positions lie far outside their ranges."""
    found = []
    for c, column in record.positions:
        if c.limits is None:
            continue
        share = _outside(record, c)
        if share > rules.out_of_range:
            low, high = (float(f(record.before[:, column])) for f in (np.min, np.max))
            what = (
                f"{record.named([column])} goes from {low:.3g} to {high:.3g}, and the joint's range is "
                f"{c.limits[0]:.3g} to {c.limits[1]:.3g}: another unit, zero, sign or joint"
            )
            far = low > c.limits[1] + _width(c) or high < c.limits[0] - _width(c)
            found.append(Finding(
                "range", (record.label(column),), what, confidence(far), evidence={"share": share},
                advice=f"data: {{scale: {{{record.signal(column)}: FACTOR}}}}, an offset, or observation",
            ))  # fmt: skip
    return found


def _width(c: Coordinate) -> float:
    assert c.limits is not None
    return c.limits[1] - c.limits[0]


def _outside(record: Record, c: Coordinate, factor: float = 1.0) -> float:
    """Share of a joint's positions that lie beyond its range by a fifth of it."""
    assert c.limits is not None
    values, margin = factor * record.before[:, c.position], 0.2 * _width(c)
    return float(((values < c.limits[0] - margin) | (values > c.limits[1] + margin)).mean())


def commanded_range(record: Record, rules: Rules) -> list[Finding]:
    """Return commands beyond the actuators' range, which the simulation cuts off."""
    model, actions = record.model, record.log.actions
    if model is None or model.nu != actions.shape[1]:
        return []
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return []
    limited = np.flatnonzero(model.actuator_ctrllimited)
    low, high = model.actuator_ctrlrange[limited].T
    margin = 0.01 * (high - low)
    share = ((actions[:, limited] < low - margin) | (actions[:, limited] > high + margin)).mean(axis=0)
    reach = np.abs(actions[:, limited]).max(axis=0) / np.maximum(np.abs(low), np.abs(high))
    found = []
    far = (share > 0.5) & (reach > rules.far_beyond)
    for wanted, sure in ((far, True), ((share > rules.beyond) & ~far, False)):
        if wanted.any():
            found.append(_beyond(record, limited[wanted], share[wanted], reach[wanted], sure))
    return found


def _beyond(record: Record, columns: np.ndarray, share: np.ndarray, reach: np.ndarray, sure: bool) -> Finding:
    """The finding of commands beyond their ranges."""
    names = [record.command(int(j)) for j in columns]
    shares = ", ".join(f"{n} in {s:.0%} of the rows" for n, s in zip(names, share, strict=True))
    what = (
        "commands lie beyond their actuators' ctrlrange, where the simulation cuts them off: "
        f"{shares}, up to {reach.max():.3g} times as far"
    )
    typical = 1 / float(reach.max())
    unit = min((DEGREE, 1e-3, 1e-2), key=lambda f: abs(np.log(f / typical)))
    factor = unit if abs(np.log(unit / typical)) < 1.2 else float(f"{typical:.3g}")
    guess = "the factor is a guess by the range; or a wider ctrlrange in the model"
    usual = "nothing where the robot cuts them off, too; otherwise a wider ctrlrange in the model"
    return Finding(
        "ctrlrange", tuple(names), what, confidence(sure),
        evidence={"share": float(share.max()), "reach": float(reach.max())},
        cure={"data": {"scale": dict.fromkeys(names, factor)}} if sure else {}, advice=guess if sure else usual,
    )  # fmt: skip
