"""Two effects that a log does not tell apart, and by how many σ a motion would."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.config import make_config
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.effects import VOCABULARY, find_effect
from dropo_torch.effects.base import Placed, Setting
from dropo_torch.errors import InputError
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.log import cut_windows, spread
from dropo_torch.gap.refit import Hypothesis, Refit, refit
from dropo_torch.gap.result import FAMILY
from dropo_torch.gap.scene import prepare
from dropo_torch.gap.screen import all_candidates
from dropo_torch.gap.suggest import ADAPTED, LOGGED, WINDOWS, separation
from dropo_torch.problem import make_problem
from dropo_torch.support.given import read_text

#: Ties of a gap that a motion is to break at once, at most.
MOST = 4


@dataclass(frozen=True, eq=False)
class Tie:
    """An effect that was named, and one that explains the log as well.

    Attributes:
        one, other: what they are called.
        true: the model with the one.
        rival: the model with the other, fitted to the log.
    """

    one: str
    other: str
    true: Hypothesis
    rival: Refit


@dataclass(frozen=True, eq=False)
class Ties:
    """What a motion is to tell apart.

    Attributes:
        ties: the pairs.
        evidence: windows of the log, and how they are weighed.
        share: windows of the log, by those that rivals were fitted to.
    """

    ties: tuple[Tie, ...]
    evidence: Evidence
    share: float

    def apart(self, motion: Trajectories) -> list[float]:
        """Return by how many σ a motion tells each pair apart, at least; 0 where a model diverges."""
        observation = self.evidence.twin.setting.observation
        longest = int(np.bincount(motion.episodes).max())
        length = min(self.evidence.windows.length, longest)
        windows = spread(cut_windows(motion, observation, length), WINDOWS)
        found = [separation(self.evidence.on(windows), t.true, t.rival, self.share) for t in self.ties]
        return [0.0 if x is None else x for x in found]


def read_ties(folder: Path) -> Ties:
    """Return the ties that a run of ``dropo gap`` found.

    Raises:
        InputError: no run, or one in which nothing is tied.
    """
    path = folder / "gap.json"
    if not path.is_file() or not (folder / "config.yaml").is_file():
        raise InputError(f"--gap: {folder} has no gap.json and config.yaml; expected a dropo gap that named effects")
    try:
        document = json.loads(read_text(path, "--gap"))
    except ValueError as error:
        raise InputError(f"--gap: {path} is no JSON ({error}); run dropo gap again") from None
    if not any(e.get("indistinguishable_from") for e in document.get("effects") or ()):
        raise InputError(f"--gap: no effects are tied in {path}; plan without --gap, to tell the parameters")
    config = make_config(document["config"], base=folder, source=str(path))
    scene = prepare(make_problem(config.model_copy(update={"backend": "mujoco"}), general=True))
    declared = tuple(float(entry["with_effects"]) for entry in (document.get("declared") or {}).values())
    placed, tied = _placed(document, scene.setting)
    true = Hypothesis(declared, placed)
    log = scene.evidence.on(spread(scene.evidence.windows, LOGGED))
    ties = []
    for index, effect, target in tied[:MOST]:
        starts = _starts(scene.setting, effect, target)
        if effect == placed[index].effect.name:  # at another place it may be the same thing
            starts.append(replace(placed[index], target=target))
        fits = [refit(log, true.instead(index, start), iterations=ADAPTED) for start in starts]
        if fits:
            rival = min(fits, key=lambda f: f.loss)
            ties.append(
                Tie(_called(placed[index].effect.name, placed[index].target), _called(effect, target), true, rival)
            )
    if not ties:
        raise InputError(f"--gap: {path} ties effects that this vocabulary does not have; run dropo gap again")
    return Ties(tuple(ties), scene.evidence, len(scene.evidence.windows) / max(len(log.windows), 1))


def _placed(
    document: Mapping[str, Any], setting: Setting
) -> tuple[tuple[Placed, ...], list[tuple[int, str, str | None]]]:
    """The named effects with their numbers, and each one's number with the effect and target that tie with it."""
    placed: list[Placed] = []
    tied: list[tuple[int, str, str | None]] = []
    for entry in document["effects"]:
        effect, first = find_effect(entry.get("variant") or entry["effect"]), len(placed)
        numbers = {name: float(s["value"]) for name, s in entry["parameters"].items()}
        if entry["target"] == FAMILY:
            placed += [Placed(effect, target, (value,)) for target, value in numbers.items()]
        else:
            names = [q.name for q in effect.quantities(setting, entry["target"])]
            placed.append(Placed(effect, entry["target"], tuple(numbers[name] for name in names)))
        own = {p.target: first + i for i, p in enumerate(placed[first:])}
        for other in entry["indistinguishable_from"]:
            tied.append((own.get(other["target"], first), other["effect"], other["target"]))
    return tuple(placed), tied


def _starts(setting: Setting, name: str, target: str | None) -> list[Placed]:
    """Where the fit of a rival begins."""
    kinds = [e for e in VOCABULARY.values() if name in (e.name, e.known_as)]
    return [p for p in all_candidates(setting, kinds) if p.target == target]


def _called(name: str, target: str | None) -> str:
    return name.replace("_", " ") + ("" if target is None else f" of {target}")
