"""What may stand between a command and what acts: each is begun with the step (s) and the first command."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

#: What a command becomes, one call a step.
Filter = Callable[[float], float]
Drive = Callable[[float, float], Filter]


def delay(seconds: float) -> Drive:
    """Commands act some time after they are sent."""

    def begin(step: float, first: float) -> Filter:
        waiting = deque([first] * round(seconds / step))

        def act(command: float) -> float:
            waiting.append(command)
            return waiting.popleft()

        return act

    return begin


def lag(seconds: float) -> Drive:
    """Commands act through a first-order filter of a time constant."""

    def begin(step: float, first: float) -> Filter:
        share, now = 1 - math.exp(-step / seconds), first

        def act(command: float) -> float:
            nonlocal now
            now += share * (command - now)
            return now

        return act

    return begin


def gain(factor: float) -> Drive:
    """Commands act by a part."""
    return lambda step, first: lambda command: factor * command


def deadband(width: float) -> Drive:
    """Commands below ``width`` do nothing, and larger ones lack it."""
    return lambda step, first: lambda command: math.copysign(max(abs(command) - width, 0.0), command)


def backlash(width: float) -> Drive:
    """A command that turns around crosses ``width`` before it acts."""

    def begin(step: float, first: float) -> Filter:
        now = first

        def act(command: float) -> float:
            nonlocal now
            now = min(max(now, command - width / 2), command + width / 2)
            return now

        return act

    return begin
