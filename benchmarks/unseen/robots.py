"""All robots by name."""

from __future__ import annotations

from fnmatch import fnmatchcase

from benchmarks.unseen import arms, bodies, legs, machines, wheels
from benchmarks.unseen.robot import Robot

ROBOTS: dict[str, Robot] = {r.name: r for kind in (arms, wheels, legs, bodies, machines) for r in kind.ROBOTS}


def select(pattern: str) -> list[str]:
    """Return the names that match a pattern such as ``ro*``."""
    return [name for name in ROBOTS if fnmatchcase(name, pattern)]
