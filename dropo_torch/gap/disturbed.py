"""Unknown pushes: spans of the log in which a force acts that the same motion at other times does not show.

Somebody leans on the arm, a cable snags, a crate is bumped into. No number of a model stands for that, and what such
rows say about the robot is wrong. A push is told by what it is not: most of the log looks like noise beside the model,
some spans do not, a force leaves nothing in them, and the joints were at the same places, as fast and under the same
commands at times when no force was missing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from dropo_torch.effects.actuator import driven_joint
from dropo_torch.effects.base import Setting
from dropo_torch.gap.evidence import Evidence
from dropo_torch.gap.locate import dof_names, force_unit, instants, middles
from dropo_torch.gap.log import cut_windows, episode_bounds, spread
from dropo_torch.gap.noise import LENGTH, FreeForces, free_forces
from dropo_torch.gap.refit import Hypothesis
from dropo_torch.gap.result import Disturbance
from dropo_torch.gap.scene import Scene, odds, without_rows
from dropo_torch.gap.twin import Windows
from dropo_torch.support.rows import evenly

#: Seconds of a window, about, and its logged steps at most; windows of a first look; and of one at the whole log.
SECONDS, LONGEST, FEW, ALL = 0.08, 30, 24, 600
#: Seconds that a push lasts at least, and windows without one between two that belong together.
LEAST, APART = 0.05, 2
#: Quantiles of a joint's motion elsewhere within which it was in a span; share of its largest force at which one has
#: come; and of the surest joint's standard errors those of another that was pushed.
USUAL, COMES, MAIN = (0.01, 0.99), 0.5, 0.2
#: Share of the forces' mean squares that one on a body explains, at least, for the body to be named; and by how much
#: more another may leave that explains it alike.
EXPLAINED, ALIKE = 0.8, 1.05


@dataclass(frozen=True)
class Span:
    """Rows of the log in which something pushed.

    Attributes:
        first, last: rows, the last one not among them.
        told: what it was.
    """

    first: int
    last: int
    told: Disturbance


def undisturbed(scene: Scene, hypothesis: Hypothesis, noise: np.ndarray) -> tuple[Scene, tuple[Disturbance, ...]]:
    """Return a scene without the spans in which something pushed, and what was told of these.

    Args:
        scene: of the log.
        hypothesis: beside which they are looked for.
        noise: standard deviation of each feature, ``(m,)``.
    """
    spans = find_spans(scene, hypothesis, noise)
    if not spans:
        return scene, ()
    kept = np.ones(len(scene.train) + len(scene.held), dtype=bool)
    for span in spans:
        kept[span.first : span.last] = False
    parts = np.split(kept, [len(scene.train)])
    if not all(part.any() for part in parts):
        return scene, ()
    return without_rows(scene, *parts), tuple(span.told for span in spans)


def find_spans(scene: Scene, hypothesis: Hypothesis, noise: np.ndarray) -> tuple[Span, ...]:
    """Return the spans in which something pushed; none where joints touch something, or are free.

    Args:
        scene: of the log.
        hypothesis: beside which they are looked for.
        noise: standard deviation of each feature, ``(m,)``.
    """
    setting, rules = scene.setting, scene.rules.disturbed
    kinds = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
    if setting.signals.contacts.any() or not np.isin(setting.model.jnt_type, kinds).all():
        return ()
    evidence = replace(scene.evidence, noise=noise, model_error=1.0, caps=1.0)
    windows = _all_windows(scene, hypothesis)
    if not len(windows):
        return ()
    typical = float(np.median(odds(evidence, spread(windows, FEW), hypothesis.variant)[1]))
    if typical > rules.typical:
        return ()
    evidence = replace(evidence, noise=noise * max(typical, 1.0) ** 0.5)
    rows = evenly(len(windows), ALL)
    (chance, reduced), least = np.zeros((2, len(windows))), np.log(evidence.rules.chance.error / len(windows))
    chance[rows], reduced[rows] = odds(evidence, windows.select(rows), hypothesis.variant)
    far = chance < least
    if not far.any():
        return ()
    if len(rows) < len(windows):  # between those that were looked at
        more = _between(far, rows)
        chance[more], reduced[more] = odds(evidence, windows.select(more), hypothesis.variant)
        far = chance < least
    main = far & (reduced > rules.minor * reduced.max())
    runs, calm = _runs(np.flatnonzero(main), windows), np.setdiff1d(rows, _beside(np.flatnonzero(far)))
    if len(runs) > rules.spans or main.sum() > rules.share * len(windows) or not calm.size:
        return ()
    there = windows.select(calm)
    spans = {run: _span(scene, evidence, hypothesis, windows, run, reduced, there) for run in runs}
    told = sum(float(reduced[a:b].sum()) for (a, b), span in spans.items() if span is not None)
    most = told > scene.rules.most * float(reduced[far].sum())
    return tuple(span for span in spans.values() if span is not None) if most else ()


def _beside(rows: np.ndarray) -> np.ndarray:
    """Some windows, and those before and after them."""
    return np.unique(rows[:, None] + np.arange(-1, 2))


def _all_windows(scene: Scene, hypothesis: Hypothesis) -> Windows:
    """Short windows of the whole log, one after the other; their episodes are those of its two parts in turn."""
    setting, parts, found = scene.setting, (scene.train, scene.held), list[Windows]()
    length = int(np.clip(round(SECONDS / setting.signals.timestep), LENGTH, LONGEST))
    for part in parts:
        since = scene.twin.settled(hypothesis.variant, part.commands)
        found.append(cut_windows(part, setting.observation, length, since=since))
    return _joined(*found)


def _joined(first: Windows, second: Windows) -> Windows:
    """The windows of two logs of the same columns, the episodes of the second after those of the first."""
    both = (first, second)
    names = [n for n in ("measured", "rates", "steps", "unseen", "gains") if getattr(first, n) is not None]
    arrays: dict[str, Any] = {n: np.concatenate([getattr(w, n) for w in both]) for n in names}
    for name in ("commands", "observed"):  # of whole episodes, the last row repeated
        own = [x for w in both if (x := getattr(w, name)) is not None]
        wide = max((x.shape[1] for x in own), default=0)
        padded = [np.pad(x, ((0, 0), (0, wide - x.shape[1]), (0, 0)), "edge") for x in own]
        arrays[name] = np.concatenate(padded) if len(own) == len(both) else None
    episodes = np.concatenate([first.episodes, second.episodes + len(first.commands)])
    return replace(first, **arrays, episodes=episodes)


def _between(far: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The windows between those of a first look ``rows`` that stand out and their neighbors that do not."""
    ends = [(rows[max(k - 1, 0)], rows[min(k + 1, len(rows) - 1)]) for k in np.flatnonzero(far[rows]).tolist()]
    return np.setdiff1d(np.concatenate([np.arange(a, b + 1) for a, b in ends]), rows)


def _runs(far: np.ndarray, windows: Windows) -> list[tuple[int, int]]:
    """Windows that stand out one after the other, the first and the one after the last."""
    new = (np.diff(far) > APART + 1) | (np.diff(windows.episodes[far]) != 0)
    ends = zip(far[np.append(True, new)], far[np.append(new, True)], strict=True)
    return [(int(first), int(last) + 1) for first, last in ends]


def _span(
    scene: Scene, evidence: Evidence, hypothesis: Hypothesis, windows: Windows, run: tuple[int, int],
    reduced: np.ndarray, calm: Windows,
) -> Span | None:  # fmt: skip
    """What a run of windows shows, if it is a push."""
    setting, rules = scene.setting, scene.rules.disturbed
    own = windows.select(np.arange(*run))
    if (own.steps[-1] - own.steps[0] + own.length) * setting.signals.timestep < LEAST:
        return None
    free = free_forces(scene.twin, own, hypothesis.variant, evidence.noise)
    known = np.isfinite(free.forces).all(1)
    most = np.maximum(rules.left, rules.rest * reduced[run[0] : run[1]])
    if not known.any() or np.median((free.left / most)[known]) > 1:
        return None
    sure = np.abs(free.forces / free.errors)
    mean = np.sqrt(np.nanmean(sure**2, axis=0))
    pushed = np.flatnonzero((mean > rules.sure) & (mean > MAIN * mean.max()))
    if not pushed.size or not all(_was_usual(setting, own, sure, calm, int(dof), rules.near) for dof in pushed):
        return None
    return _told(scene, own, free, int(mean.argmax()))


def _was_usual(setting: Setting, own: Windows, sure: np.ndarray, calm: Windows, dof: int, near: float) -> bool:
    """Whether a joint was where, as fast and under the commands as at other times, mostly or before the force came.

    A hard push takes a joint where it is at no other time, but it begins where the joint was by itself.
    """
    model, joint = setting.model, int(setting.model.dof_jntid[dof])
    driven = [i for i in range(model.nu) if i < model.nactuator and driven_joint(model, i) == joint]

    def signals(windows: Windows, row: int) -> np.ndarray:
        position, velocity, commands = instants(setting, windows, row)
        ctrl = [commands[:, model.actuator_ctrladr[i]] for i in driven]
        return np.stack([position[:, model.jnt_qposadr[joint]], velocity[:, dof], *ctrl], 1)

    there = signals(calm, calm.length // 2)
    low, high = np.quantile(there, USUAL, axis=0)
    size = np.maximum(there.std(0), 1e-12)

    def usual(here: np.ndarray) -> np.ndarray:
        distance, _ = cKDTree(there / size).query(here / size)
        return np.asarray(((here >= low) & (here <= high)).all(1) & (distance < near))

    came = np.flatnonzero(sure[:, dof] > COMES * np.nanmax(sure[:, dof]))[0]
    return bool(usual(signals(own, own.length // 2)).mean() > 0.5 or usual(signals(own, 0))[came])


def _told(scene: Scene, own: Windows, free: FreeForces, dof: int) -> Span:
    """A push, with its time and what was pushed."""
    setting, dt, length = scene.setting, scene.setting.signals.timestep, own.length
    unseen = len(scene.train)
    bounds = episode_bounds(scene.train) + [(a + unseen, b + unseen) for a, b in episode_bounds(scene.held)]
    first, end = bounds[own.episodes[0]]
    begin, last = int(first + own.steps[0]), int(first + own.steps[-1] + length)
    episodes = scene.problem.trajectories.episodes
    episode = int(episodes[begin])
    since = int(np.flatnonzero(episodes == episode)[0])
    body, force = _on_body(setting, own, free)
    told = Disturbance(
        episode, (begin - since) * dt, (last - since) * dt, body, force,
        dof_names(setting.model)[dof], float(np.nanmax(np.abs(free.forces[:, dof]))), force_unit(setting.model, dof),
    )  # fmt: skip
    return Span(max(begin - length, first), min(last + length, end), told)


def _on_body(setting: Setting, own: Windows, free: FreeForces) -> tuple[str | None, tuple[float, float, float] | None]:
    """The body on which one force at its center explains what the joints needed best, and that force in newtons.

    Of bodies that explain it nearly alike, the one nearest to the base; none where no force on a single body does.
    """
    model, found = setting.model, list[tuple[float, int, np.ndarray]]()
    position, _, _ = middles(setting, own)
    known = np.isfinite(free.forces).all(1)
    if known[1:-1].any():  # at its ends, a push fills windows in part
        known[[0, -1]] = False
    target = (free.forces / free.errors)[known].ravel()
    for body in range(1, model.nbody):
        slope = np.stack([_jacobian(setting, q, body) for q in position[known]]) / free.errors[known][:, None]
        matrix = slope.swapaxes(1, 2).reshape(len(target), 3)
        force, *_ = np.linalg.lstsq(matrix, target, rcond=1e-3)
        found.append((float(((target - matrix @ force) ** 2).sum()), body, force))
    least = min(left for left, _, _ in found)
    left, body, force = next(f for f in found if f[0] <= ALIKE * least + 1e-12)
    if left > (1 - EXPLAINED) * float((target**2).sum()):
        return None, None
    return setting.names("body")[body], (float(force[0]), float(force[1]), float(force[2]))


def _jacobian(setting: Setting, position: np.ndarray, body: int) -> np.ndarray:
    """How a body's center moves with the joints, ``(3, nv)``."""
    model, jacobian = setting.model, np.zeros((3, setting.model.nv))
    data = mujoco.MjData(model)
    data.qpos[:] = position
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
    return jacobian
