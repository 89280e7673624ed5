"""Bundled simulations, found by name.

A package offers one by an entry point of the group ``dropo_torch.sims`` that is a :class:`BundledSim`.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, cast

from dropo_torch.errors import InputError, choices
from dropo_torch.support.parallel import Workers
from dropo_torch.support.report import Report

GROUP = "dropo_torch.sims"


@dataclass(frozen=True)
class BundledSim:
    """A model with what a config would say about it.

    Attributes:
        name: what it is called in a config's ``sim``.
        model: path of the MJCF.
        frame_skip: physics steps of one logged transition.
        observation: what the log's columns are.
        parameters: what may vary, as in a config.
        log: path of a small log, for the demo.
        truth: the values that the log was recorded with.
        task: the class of its task as ``module:Class``, or ``None``.
        study: what ``dropo reproduce`` runs, as ``module:function``, or ``None``.
    """

    name: str
    model: Path
    frame_skip: int
    observation: tuple[str, ...]
    parameters: Mapping[str, Mapping[str, Any]]
    log: Path
    truth: Mapping[str, float] = field(default_factory=dict)
    task: str | None = None
    study: str | None = None


class Study(Protocol):
    """A published study, redone: results into a folder, finished parts kept where it resumes."""

    def __call__(self, out: Path, *, reduced: bool, resume: bool, report: Report, workers: Workers) -> Sequence[str]:
        """Run it by so many processes, or by a cluster; return what it found, in sentences."""


def bundled_sim(name: str, *, key: str = "sim") -> BundledSim:
    """Return a bundled simulation; ``key`` is the config's key, or the command, that names it.

    Raises:
        InputError: an unknown name.
    """
    found = entry_points(group=GROUP)
    if name not in found.names:
        raise InputError(f"{key}: no bundled simulation {name!r}" + choices(name, sorted(found.names)))
    sim = found[name].load()
    if not isinstance(sim, BundledSim):
        raise InputError(f"{key}: {found[name].value} is no BundledSim")
    return sim


def bundled_study(name: str) -> Study:
    """Return the study of a bundled simulation.

    Raises:
        InputError: an unknown name, or a simulation without a study.
    """
    study = bundled_sim(name, key="reproduce").study
    if study is None:
        raise InputError(f"reproduce: {name} has no study")
    return cast(Study, pkgutil.resolve_name(study))
