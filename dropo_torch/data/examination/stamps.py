"""Time stamps: gaps, jitter, and whether frame_skip is the time between rows."""

from __future__ import annotations

import numpy as np

from dropo_torch.data.examination.finding import Finding, confidence, first_rows
from dropo_torch.data.examination.record import Record, resampled
from dropo_torch.data.examination.rules import Rules

#: Units of time stamps, by how many of them make a second.
UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


def stamps(record: Record, rules: Rules) -> list[Finding]:
    """Return what the time stamps say: samples left out, uneven spacing, another step than the simulation's."""
    origin = record.log.origin
    durations = None if origin is None else origin.durations
    if durations is None or not np.isfinite(durations).any():
        return _step(record, record.log.dt)
    rows = np.flatnonzero(np.isfinite(durations))
    lengths = durations[rows]
    median = float(np.median(lengths))
    off = np.abs(lengths / median - 1)
    found = []
    wide = rows[lengths > rules.gap * median]
    uneven = rows[off > rules.jitter]
    refused = bool((off > record.tolerance).any())
    longest = float(lengths.max())
    bridged = {"max_gap": float(f"{1.01 * longest:.4g}")} if longest > 2.4 * median else {}
    cure = resampled(record, **bridged)
    if wide.size:
        what = (
            f"the time stamps leave samples out at {len(wide)} rows: up to {lengths.max():.4g} s lie between rows that "
            f"are {median:.4g} s apart as a rule"
        )
        found.append(Finding(
            "dropouts", (), what, confidence(refused), rows=first_rows(wide),
            evidence={"longest": float(lengths.max()), "median": median, "rows": float(len(wide))}, cure=cure,
            advice="data: breaks makes two episodes of a gap too long to be interpolated" if bridged else "",
        ))  # fmt: skip
    if uneven.size > len(wide) + 0.01 * len(rows):
        what = (
            f"the time stamps jitter: {len(uneven) / len(rows):.0%} of the rows are off by more than "
            f"{rules.jitter:.0%} of {median:.4g} s, their standard deviation is {lengths.std():.3g} s"
        )
        found.append(Finding(
            "jitter", (), what, confidence(refused), rows=first_rows(uneven),
            evidence={"share": len(uneven) / len(rows), "median": median, "deviation": float(lengths.std())}, cure=cure,
        ))  # fmt: skip
    typical = float(lengths[lengths <= rules.gap * median].mean())
    return found + _step(record, typical if found else record.log.dt, 0.03 if found else 1e-3)


def _step(record: Record, seconds: float | None, tolerance: float = 1e-3) -> list[Finding]:
    """Whether the time between rows is that of the simulated transition."""
    if record.model is None or seconds is None or record.step is None:
        return []
    ratio = seconds / record.step
    if abs(ratio - 1) <= tolerance:
        return []
    steps = seconds / float(record.model.opt.timestep)
    evidence = {"stamps": seconds, "simulated": record.step, "ratio": ratio}
    for factor, unit in UNITS.items():
        if abs(ratio / factor - 1) < 0.05:
            what = f"rows are {seconds:g} s apart by their stamps and {record.step:g} s in simulation: they are {unit}"
            cure = {"data": {"time": {"signal": "NAME", "scale": 1 / factor}}}
            return [Finding("time_unit", (), what, "sure", evidence=evidence, cure=cure, advice="NAME is the column")]
    what = f"rows are {seconds:.6g} s apart by their stamps, and frame_skip {record.frame_skip} makes {record.step:g} s"
    if round(steps) >= 1 and abs(steps - round(steps)) < 0.02 * steps:
        return [Finding("frame_skip", (), what, "sure", evidence=evidence, cure={"frame_skip": round(steps)})]
    return [Finding("frame_skip", (), what, "sure", evidence=evidence, cure=resampled(record))]
