"""An end to the search: after some time, the best answer so far, and what was not tried."""

from __future__ import annotations

import time

from dropo_torch.support.report import Report

#: Share of the time left that a search may take while others wait.
SHARE = 0.6


class OutOfTime(Exception):
    """The time of a search is over; its message is the stage that it was in."""


def until(report: Report, end: float) -> Report:
    """Return a report that ends a search after a time; what is reported as done is not lost by that.

    Args:
        report: what is called before then.
        end: by ``time.monotonic``.

    Raises:
        OutOfTime: later (when the report is called).
    """

    def watched(stage: str, share: float) -> None:
        if time.monotonic() > end and share < 1:
            raise OutOfTime(stage)
        report(stage, share)

    return watched


def share_of(end: float, waiting: int) -> float:
    """Return when a search must end that begins now, before some others that wait, by ``time.monotonic``."""
    now = time.monotonic()
    return now + (SHARE if waiting else 1.0) * (end - now)
