"""Velocities against the changes of positions: units, signs, order, delays, and the time between rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dropo_torch.data.examination.finding import Finding, confidence
from dropo_torch.data.examination.lag import lagging
from dropo_torch.data.examination.prediction import Reading, better_reading
from dropo_torch.data.examination.record import Pair, Record, entry, resampled, windows
from dropo_torch.data.examination.rules import Rules

#: Rows over which changes are summed: noise drowns the change of one row, never that of many.
LENGTHS = (1, 4, 16, 64)
DEGREE = float(np.pi / 180)
#: Factors from a unit to the model's, by whether the coordinate is an angle.
UNITS = {True: {DEGREE: "degrees"}, False: {1e-3: "millimeters", 1e-2: "centimeters"}}


@dataclass(frozen=True)
class Likeness:
    """How a velocity column explains a position column's changes.

    Attributes:
        share: r², the share of the changes that it explains.
        slope: seconds of a row by which it does.
        length: rows over which the changes were summed.
    """

    share: float
    slope: float
    length: int


def velocities(record: Record, rules: Rules) -> list[Finding]:
    """Return what the velocities contradict in the positions."""
    pairs = [c for c in record.pairs if _moves(record, c)]
    if not pairs or record.step is None:
        return []
    own = {c: likeness(record, c.position, c.velocity) for c in pairs}
    found, exchanged = _order(record, pairs, own, rules)
    clear = [c for c in pairs if own[c].share > rules.fits and c not in exchanged]
    found += _slopes(record, clear, own, rules)
    odd = [c for c in pairs if own[c].share <= 0.3 and c not in exchanged and _smooth(record, c)]
    if odd and not found:
        columns = [i for c in odd for i in (c.position, c.velocity)]
        what = (
            f"the velocities of {', '.join(c.name for c in odd)} do not follow from the positions: {_worst(odd, own)}"
        )
        found.append(Finding(
            "velocity", tuple(record.label(i) for i in columns), what, "doubtful",
            evidence={c.name: own[c].share for c in odd},
            advice="derive them: data: {observations: [the positions], preprocess: {dt: SECONDS, cutoff: HZ}}",
        ))  # fmt: skip
    delays = _delays(record, clear, rules)
    if found or any(finding.sure for finding in delays):
        return found + delays
    return lagging(record, clear, rules) or delays


def likeness(record: Record, position: int, velocity: int) -> Likeness:
    """Return how well a column is another one's derivative, over the number of rows where it is best."""
    change = record.steps[:, position]
    mean = 0.5 * (record.before[:, velocity] + record.after[:, velocity])
    best = Likeness(0.0, 0.0, 1)
    for length in LENGTHS:
        sums, _ = windows(record, np.stack([change, mean], axis=1), length)
        if len(sums) < 20:
            break
        found = _fit(sums[:, 0], sums[:, 1])
        if found[0] > best.share + 0.01:
            best = Likeness(found[0], found[1], length)
    return best


def _fit(change: np.ndarray, mean: np.ndarray) -> tuple[float, float]:
    """r² and slope of a line through the origin, without the twentieth of the rows that are off furthest."""
    size = float(mean @ mean)
    if size == 0:
        return 0.0, 0.0
    off = np.abs(change - mean * (mean @ change) / size)
    kept = off <= np.quantile(off, 0.95)
    x, y = mean[kept], change[kept]
    whole, part = float(y @ y), float(x @ x)
    if whole == 0 or part == 0:
        return 0.0, 0.0
    return float((x @ y) ** 2 / (whole * part)), float((x @ y) / part)


def _moves(record: Record, c: Pair) -> bool:
    return bool(np.ptp(record.before[:, c.position]) > 0 and np.ptp(record.before[:, c.velocity]) > 0)


def _smooth(record: Record, c: Pair) -> bool:
    """Whether a position moves by more than it scatters, and long enough to say so."""
    sums, start = windows(record, record.steps[:, [c.position]], 8)
    if len(start) < 20:
        return False
    single = record.steps[~record.cut, c.position]
    return bool(sums.std() > 4 * single.std())  # eight independent steps would make 2.8 of one


def _worst(pairs: Sequence[Pair], own: dict[Pair, Likeness]) -> str:
    return ", ".join(f"r² = {own[c].share:.2f}" for c in pairs)


def _order(
    record: Record, pairs: Sequence[Pair], own: dict[Pair, Likeness], rules: Rules
) -> tuple[list[Finding], set[Pair]]:
    """Columns that stand in each other's place: others are their derivatives, and these are not."""
    wrong = [c for c in pairs if own[c].share < rules.unlike or own[c].slope < 0]
    weak = [c for c in pairs if c not in wrong and own[c].share < 0.99]
    for group in (wrong, [*wrong, *weak]):
        if not group:
            continue
        columns = _matched(record, group, own, rules)
        if columns is not None:
            return _exchanged(record, columns, rules)
    return [], set()


def _matched(
    record: Record, group: Sequence[Pair], own: dict[Pair, Likeness], rules: Rules
) -> list[tuple[Pair, int, int]] | None:
    """The position and velocity columns, among all of a group's, that fit each coordinate far better."""
    pool = [i for c in group for i in (c.position, c.velocity)]
    table = np.zeros((len(pool), len(pool)))
    slopes = np.zeros_like(table)
    for a, b in zip(*np.nonzero(_alike(record, pool) > 0.5), strict=True):
        found = likeness(record, pool[a], pool[b])
        slopes[a, b], table[a, b] = found.slope, found.share if found.slope > 0 else 0.0
    if not any(_far_better(table, pool, c, own[c], rules) for c in group):
        return None
    chosen = _pairing(table, pool, group)
    if chosen is None:
        return None
    step = record.step or 1.0
    moved = [
        (c, a, b) for c, (a, b) in zip(group, chosen, strict=True) if (pool[a], pool[b]) != (c.position, c.velocity)
    ]
    if not moved:
        return None
    for c, a, b in moved:
        if table[a, b] < rules.like or not (1 / rules.sure_slope < slopes[a, b] / step < rules.sure_slope):
            return None
        if not _beats(table[a, b], own[c], rules):
            return None
    return [(c, pool[a], pool[b]) for c, a, b in moved]


def _far_better(table: np.ndarray, pool: Sequence[int], c: Pair, own: Likeness, rules: Rules) -> bool:
    """Whether other columns are like a coordinate's position or velocity, and its own are not."""
    place = pool.index(c.position), pool.index(c.velocity)
    others = [float(table[a, b]) for a, b in np.ndindex(*table.shape) if (a, b) != place and {a, b} & set(place)]
    best = max(others, default=0.0)
    return bool(best > rules.like and _beats(best, own, rules))


def _beats(share: float, own: Likeness, rules: Rules) -> bool:
    """Whether an r² leaves far less than the columns as they stand."""
    return (1 - (own.share if own.slope > 0 else 0.0)) >= rules.better * (1 - share)


def _alike(record: Record, pool: Sequence[int]) -> np.ndarray:
    """The largest r² of each column's changes on each other column's means, outliers among them, ``(p, p)``."""
    columns = list(pool)
    changes, means = record.steps[:, columns], 0.5 * (record.before[:, columns] + record.after[:, columns])
    best = np.zeros((len(columns), len(columns)))
    for length in LENGTHS:
        sums, _ = windows(record, np.concatenate([changes, means], axis=1), length)
        if len(sums) < 20:
            break
        change, mean = sums[:, : len(columns)], sums[:, len(columns) :]
        sizes = np.outer((change**2).sum(axis=0), (mean**2).sum(axis=0))
        best = np.maximum(best, np.divide((change.T @ mean) ** 2, sizes, out=np.zeros_like(best), where=sizes > 0))
    np.fill_diagonal(best, 0.0)
    return best


def _pairing(table: np.ndarray, pool: Sequence[int], group: Sequence[Pair]) -> list[tuple[int, int]] | None:
    """Which columns of a pool are positions and which their velocities, in the order of the positions."""
    from scipy.optimize import linear_sum_assignment  # heavy, and most logs need none

    index = {column: i for i, column in enumerate(pool)}
    positions = [index[c.position] for c in group]
    others = [index[c.velocity] for c in group]
    rows, columns = linear_sum_assignment(-table[np.ix_(positions, others)])
    best = [(positions[r], others[c]) for r, c in zip(rows, columns, strict=True)]
    if all(table[a, b] > 0.9 for a, b in best):
        return best
    free, found = set(range(len(pool))), []  # positions may stand among velocities: the best pairs first
    order = np.dstack(np.unravel_index(np.argsort(-table, axis=None), table.shape))[0]
    for a, b in order:
        if a in free and b in free:
            free -= {int(a), int(b)}
            found.append((int(a), int(b)))
    return sorted(found, key=lambda pair: pool[pair[0]]) if len(found) == len(group) else None


def _exchanged(
    record: Record, columns: Sequence[tuple[Pair, int, int]], rules: Rules
) -> tuple[list[Finding], set[Pair]]:
    """The finding of columns that stand in each other's place.

    Where positions changed places among themselves, or velocities did, the likeness of the ones to the others is the
    same: the model decides by what it predicts, if it does.
    """
    own, nq = record.observation.columns, 0 if record.model is None else record.model.nq
    readings = [_places(own, [(p, c.qpos) for c, p, _ in columns] + [(v, nq + c.dof) for c, _, v in columns])]
    pairs = {c.position: c for c, _, _ in columns}
    if set(pairs) == {p for _, p, _ in columns} and nq:  # the velocities among themselves, or the positions
        speeds = {c.velocity: c for c, _, _ in columns}
        readings = [
            _places(own, [(v, nq + pairs[p].dof) for _, p, v in columns]),
            _places(own, [(p, speeds[v].qpos) for _, p, v in columns]),
        ]
    chosen = 0 if len(readings) == 1 else better_reading(record, [Reading.of(record, r) for r in readings], rules)
    touched = sorted({i for reading in readings for i, place in enumerate(reading) if place != own[i]})
    names = [f"{record.signal(v)} is the velocity of {record.signal(p)}" for _, p, v in columns]
    what = f"columns stand in each other's place: {'; '.join(names)}"
    advice = "where the velocities are right and the positions are exchanged, exchange those instead"
    if chosen is None:
        what += f"; either {' and '.join(record.signal(v) for _, _, v in columns)} are exchanged or "
        what += f"{' and '.join(record.signal(p) for _, p, _ in columns)} are, and the model tells these not apart"
        lines = [f"[{', '.join(_listed(record, reading))}]" for reading in readings]
        advice = f"observation: {lines[0]} for the velocities, observation: {lines[1]} for the positions"
    elif len(readings) == 2:
        advice = f"the {('velocities', 'positions')[chosen]} are, as the model predicts the log so"
    finding = Finding(
        "order", tuple(record.label(i) for i in touched), what, confidence(chosen is not None),
        evidence={f"{record.label(v)} of {record.label(p)}": likeness(record, p, v).share for _, p, v in columns},
        cure={} if chosen is None else {"observation": _listed(record, readings[chosen])}, advice=advice,
    )  # fmt: skip
    return [finding], {c for c, _, _ in columns}


def _places(own: Sequence[int], moved: Sequence[tuple[int, int]]) -> tuple[int, ...]:
    """The places of observed columns, some of which are moved."""
    places = dict(moved)
    return tuple(places.get(i, place) for i, place in enumerate(own))


def _listed(record: Record, places: Sequence[int]) -> list[str]:
    """The entries of ``observation`` that put observed columns so."""
    listed = ["skip"] * record.observation.log_width
    for i, place in enumerate(places):
        listed[record.observation.log_columns[i]] = entry(record, place)
    return listed


def _slopes(record: Record, pairs: Sequence[Pair], own: dict[Pair, Likeness], rules: Rules) -> list[Finding]:
    """Signs, units and the time step, from the seconds by which velocities explain the changes of positions."""
    if not pairs:
        return []
    step = record.step or 1.0
    ratio = {c: own[c].slope / step for c in pairs}
    found = [_sign(record, [c for c in pairs if ratio[c] < 0], ratio)] if any(r < 0 for r in ratio.values()) else []
    size = {c: abs(ratio[c]) for c in pairs}
    off = [c for c in pairs if abs(np.log(size[c])) > np.log(1 + rules.slope)]
    if not off:
        return found
    united = [c for c in off if _unit(c, size[c], rules) is not None]
    if united:
        found.append(_units(record, united, size, rules))
        off = [c for c in off if c not in united]
    if not off:
        return found
    values = np.array([size[c] for c in pairs if c not in united])
    typical = float(np.median(values))
    near = np.abs(np.log(values / typical)) < np.log(1 + rules.common)
    if near.mean() >= 0.75 and abs(np.log(typical)) > np.log(1 + rules.common):
        return found + _time_step(record, off, typical)
    return found + _scales(record, off, size, rules)


def _sign(record: Record, pairs: Sequence[Pair], ratio: dict[Pair, float]) -> Finding:
    columns = [c.velocity for c in pairs]
    what = f"{record.named(columns)} has the opposite sign of the position's changes"
    return Finding(
        "sign", tuple(record.label(i) for i in columns), what, "sure", evidence={c.name: ratio[c] for c in pairs},
        cure={"data": {"scale": {record.signal(i): -1.0 for i in columns}}},
        advice="or the positions', where they grow against the joint's axis",
    )  # fmt: skip


def _unit(c: Pair, ratio: float, rules: Rules) -> tuple[bool, float, str] | None:
    """Whether the position is the one in another unit, the factor to the model's, and the unit."""
    for factor, name in UNITS[c.angle].items():
        for of_position, expected in ((True, 1 / factor), (False, factor)):
            if abs(np.log(ratio / expected)) < rules.unit:
                return of_position, factor, name
    return None


def _units(record: Record, pairs: Sequence[Pair], size: dict[Pair, float], rules: Rules) -> Finding:
    scale, words, columns = {}, [], []
    for c in pairs:
        unit = _unit(c, size[c], rules)
        assert unit is not None
        column = c.position if unit[0] else c.velocity
        scale[record.signal(column)] = unit[1]
        columns.append(column)
        words.append(f"{record.named([column])} is in {unit[2]}{'' if unit[0] else ' per second'}")
    evidence = {c.name: size[c] for c in pairs}
    return Finding(
        "units", tuple(record.label(i) for i in columns), "; ".join(words) + ", and its derivative or integral is not",
        "sure", evidence=evidence, cure={"data": {"scale": scale}},
    )  # fmt: skip


def _time_step(record: Record, pairs: Sequence[Pair], ratio: float) -> list[Finding]:
    """All columns agree on another time between rows than the simulated one."""
    steps = ratio * record.frame_skip
    stamped = record.log.dt is not None and record.step is not None and abs(record.log.dt / record.step - 1) < 0.02
    whole = round(steps) >= 1 and abs(steps - round(steps)) < 0.1 * steps and round(steps) != record.frame_skip
    sure = (len(pairs) > 1 or not 0.6 < ratio < 1.6) and whole and not stamped
    seconds = ratio * (record.step or 1.0)
    what = (
        f"positions change by {ratio:.3g} times what the velocities say in the {record.step or 0:g} s of a row: rows "
        f"are {seconds:.4g} s apart"
    )
    if stamped:
        what += ", or, since the time stamps say otherwise, all velocities are in another unit"
    return [Finding(
        "frame_skip", (), what, confidence(sure), evidence={"ratio": ratio, "columns": float(len(pairs))},
        cure={} if stamped or not whole else {"frame_skip": round(steps)},
        advice="" if whole else f"resample: data: {{dt: {seconds:.4g}, preprocess: {{dt: {record.step or 0:g}}}}}",
    )]  # fmt: skip


def _scales(record: Record, pairs: Sequence[Pair], size: dict[Pair, float], rules: Rules) -> list[Finding]:
    """Columns by themselves in a unit of no name, or with a gain: the sure ones, and the doubtful ones."""
    found = []
    far = [c for c in pairs if not 1 / rules.sure_slope < size[c] < rules.sure_slope]
    for group, sure in ((far, True), ([c for c in pairs if c not in far], False)):
        if not group:
            continue
        ratios = ", ".join(f"{record.named([c.position])} by {size[c]:.4g} times" for c in group)
        what = f"positions change more or less than their velocities say: {ratios}; a unit or a gain"
        found.append(Finding(
            "units", tuple(record.label(i) for c in group for i in (c.position, c.velocity)), what, confidence(sure),
            evidence={c.name: size[c] for c in group},
            cure={"data": {"scale": {record.signal(c.velocity): float(f"{size[c]:.4g}") for c in group}}},
            advice="or the inverse of the positions', where those are wrong",
        ))  # fmt: skip
    return found


def _delays(record: Record, pairs: Sequence[Pair], rules: Rules) -> list[Finding]:
    """Velocities that fit the changes of positions of other rows."""
    late: dict[Pair, tuple[int, float]] = {}
    for c in pairs:
        misfit = _shifted_misfits(record, c)
        if misfit is None:
            return []
        best = min(misfit, key=lambda s: misfit[s])
        if best != 0:
            late[c] = (best, misfit[best] / misfit[0])
    if not late:
        return []
    clear = {c: (s, share) for c, (s, share) in late.items() if share < rules.late}
    if not clear:
        return []
    sure = all(share < rules.sure_late for _, share in clear.values()) and len(clear) >= 0.5 * len(pairs)
    rows = round(float(np.median([s for s, _ in clear.values()])))
    columns = [c.velocity for c in clear]
    direction = "late" if rows > 0 else "early"
    what = (
        f"{record.named(columns)}: the velocity stands {abs(rows)} {'row' if abs(rows) == 1 else 'rows'} {direction} "
        f"against the changes of the position ({_shares(clear)} of the misfit remain without the delay)"
    )
    seconds = round(rows * (record.step or 1.0), 9)
    return [Finding(
        "delay", tuple(record.label(i) for i in columns), what, confidence(sure),
        evidence={c.name: share for c, (_, share) in clear.items()},
        cure=resampled(record, delays={record.signal(i): seconds for i in columns}),
        advice="" if sure else "a filter of the velocity looks like this, too",
    )]  # fmt: skip


def _shares(late: dict[Pair, tuple[int, float]]) -> str:
    return ", ".join(f"{share:.0%}" for _, share in late.values())


def _shifted_misfits(record: Record, c: Pair) -> dict[int, float] | None:
    """What velocities so many rows later leave unexplained of the changes of a position."""
    runs, count, reach = record.runs, len(record.log), 2
    if count < 40:
        return None
    rows = np.arange(reach, count - reach)
    rows = rows[(runs[rows - reach] == runs[rows + reach]) & ~record.cut[rows]]
    if len(rows) < 40:
        return None
    change = record.steps[rows, c.position]
    mean = 0.5 * (record.before[:, c.velocity] + record.after[:, c.velocity])
    off = {s: change - mean[rows + s] * _fit(change, mean[rows + s])[1] for s in range(-reach, reach + 1)}
    kept = np.abs(off[0]) <= np.quantile(np.abs(off[0]), 0.98)
    return {s: max(float((o[kept] ** 2).sum()), 1e-300) for s, o in off.items()}
