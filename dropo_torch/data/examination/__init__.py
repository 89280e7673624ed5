"""The examination of a log before anything is fitted: what is wrong with it, where, how surely, and what cures it.

A check is a function of a :class:`~dropo_torch.data.examination.record.Record` and the
:class:`~dropo_torch.data.examination.rules.Rules`; it returns findings. Those of :data:`CHECKS` need nothing but the
columns; those of :data:`LATER_CHECKS`, some of which simulate, run in turn while nothing sure is found: they would see
the same fault again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from dropo_torch.data.examination.columns import (
    clipped,
    commanded_range,
    quantised,
    ranges,
    silent,
    spikes,
    stuck,
    units,
)
from dropo_torch.data.examination.commands import commands
from dropo_torch.data.examination.continuity import continuous
from dropo_torch.data.examination.finding import Finding
from dropo_torch.data.examination.kinematics import velocities
from dropo_torch.data.examination.quaternions import quaternions
from dropo_torch.data.examination.record import Record
from dropo_torch.data.examination.rules import Rules
from dropo_torch.data.examination.stamps import stamps
from dropo_torch.data.observation import Observation
from dropo_torch.data.trajectory import Trajectories

__all__ = ["CHECKS", "LATER_CHECKS", "Finding", "Rules", "examine"]

Check = Callable[[Record, Rules], list[Finding]]

CHECKS: tuple[Check, ...] = (
    stamps,
    quaternions,
    stuck,
    silent,
    spikes,
    clipped,
    velocities,
    quantised,
    commanded_range,
)
LATER_CHECKS: tuple[Check, ...] = (units, ranges, commands)
#: Findings by which a log is wrong although nobody knows in which of two ways: what is simulated from it tells nothing.
UNDECIDED = ("order",)


def examine(
    log: Trajectories,
    observation: Observation,
    model: mujoco.MjModel | None,
    frame_skip: int,
    *,
    tolerance: float = np.inf,
    rules: Rules | None = None,
) -> tuple[Finding, ...]:
    """Return what is wrong with a log, the sure findings first.

    Args:
        log: the log.
        observation: what its columns are.
        model: the model, or ``None`` where there is none: only what needs none is examined.
        frame_skip: physics steps of one logged transition.
        tolerance: relative deviation of time stamps above which they are refused by the reader.
        rules: the thresholds.
    """
    with np.errstate(all="ignore"):  # whatever a wrong log holds
        return _examined(Record.of(log, observation, model, frame_skip, tolerance), rules or Rules())


def _examined(record: Record, rules: Rules) -> tuple[Finding, ...]:
    record, found = continuous(record, rules)
    for check in () if any(finding.name == "next_observations" for finding in found) else CHECKS:
        found += check(record, rules)
    for check in LATER_CHECKS:
        if not any(finding.sure or finding.name in UNDECIDED for finding in found):
            found += check(record, rules)
    return tuple(sorted(_causes(found), key=lambda finding: not finding.sure))


def _causes(found: Sequence[Finding]) -> list[Finding]:
    """Return the findings without those that another one explains: the same again, or doubts about the same columns."""
    sure = {column for finding in found if finding.sure for column in finding.where}
    kept: list[Finding] = []
    for finding in found:
        again = not finding.where and any(finding.name == other.name for other in kept)
        if not again and (finding.sure or not sure.intersection(finding.where)):
            kept.append(finding)
    return kept
