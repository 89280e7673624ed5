"""The workflow: locate, name, verify; step by step, or as one call."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from dropo_torch.effects import VOCABULARY, Effect
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.naming import Naming, Report, Search
from dropo_torch.gap.noise import free_forces
from dropo_torch.gap.outcome import found_places, make_result
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.result import Gap, Place, Score
from dropo_torch.gap.rules import Rules, significant
from dropo_torch.gap.scene import Scene, contact_windows, prepare, short_windows, shorter_windows
from dropo_torch.gap.verify import cut_held, floor_score, score
from dropo_torch.problem import Problem


def locate(scene: Scene, *, effects: Sequence[Effect] | None = None, rules: Rules | None = None) -> tuple[Place, ...]:
    """Return where simulation and log disagree, the largest share first; nothing if what remains is noise.

    The declared parameters are fitted first; a place's share is the most that a change there could explain.

    Args:
        scene: of :func:`prepare`.
        effects: the vocabulary; all of the package's by default.
        rules: thresholds.
    """
    rules = rules or Rules()
    search = Search(scene.evidence, list(effects or VOCABULARY.values()), rules=rules)
    base = search.start(scene.begin)
    if not significant(base.cost, rules):
        return ()
    search.look(base)
    free = free_forces(scene.twin, short_windows(scene.problem, scene.train), base.hypothesis.variant, scene.noise)
    return found_places(scene, search, free)


def name(scene: Scene, *, effects: Sequence[Effect] | None = None, rules: Rules | None = None) -> Naming:
    """Return the effects that the log needs, with values, ties and the candidates that were tried.

    Args:
        scene: of :func:`prepare`.
        effects: the vocabulary; all of the package's by default.
        rules: thresholds.
    """
    return _name(scene, list(effects or VOCABULARY.values()), rules or Rules(), None, False, _quiet)[1]


def verify(scene: Scene, hypothesis: Hypothesis) -> tuple[Score, Score]:
    """Return how far a hypothesis is from held-out data, and how far noise alone would leave a perfect one.

    Args:
        scene: of :func:`prepare`.
        hypothesis: such as ``name(scene).base.hypothesis`` and ``.final.hypothesis``.
    """
    step = scene.setting.signals.timestep
    held = cut_held(scene.twin, scene.held, scene.problem.observation, hypothesis, scene.noise, step)
    return score(scene.evidence, held, hypothesis), floor_score(scene.evidence, held, hypothesis)


def find_gap(
    problem: Problem,
    *,
    effects: Sequence[Effect] | None = None,
    rules: Rules | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    report: Report | None = None,
    scene: Scene | None = None,
) -> Gap:
    """Find where simulation and log disagree, name the missing effects, and verify them on held-out data.

    Args:
        problem: the model, its declared parameters, and the log.
        effects: the vocabulary; all of the package's by default.
        rules: thresholds.
        checkpoint: file in which the state between rounds is kept.
        resume: go on from it.
        report: called with a stage and its share done.
        scene: what :func:`prepare` made of the problem; made here by default.

    Raises:
        InputError: a log or simulator in which nothing can be looked for.
    """
    started = time.perf_counter()
    report = report or _quiet
    report("preparing", 0.0)
    scene = scene or prepare(problem)
    vocabulary = list(effects or VOCABULARY.values())
    search, naming = _name(scene, vocabulary, rules or Rules(), checkpoint, resume, report)
    report("verifying", 0.0)
    return make_result(scene, search, naming, started)


def _name(
    scene: Scene, vocabulary: list[Effect], rules: Rules, checkpoint: Path | None, resume: bool, report: Report
) -> tuple[Search, Naming]:
    """Search; where nothing has a name, once more over shorter windows, and where there are contacts robustly."""
    known = f"{scene.problem.fingerprint} {rules} {[e.name for e in vocabulary]}"

    def look(evidence: Evidence, suffix: str) -> tuple[Search, Naming]:
        store = None if checkpoint is None else checkpoint.with_stem(f"{checkpoint.stem}{suffix}")
        search = Search(
            evidence, vocabulary, rules=rules, report=report, checkpoint=store, resume=resume, fingerprint=known
        )
        return search, search.run(scene.begin)

    first = look(scene.evidence, "")
    for suffix, make in (("-shorter", shorter_windows), ("-contact", contact_windows)):
        if first[1].named or not first[1].gap:
            break
        evidence = make(scene)
        again = None if evidence is None else look(evidence, suffix)
        if again is not None and again[1].named:
            return again
    return first


def _quiet(stage: str, share: float) -> None:
    """Report nothing."""
