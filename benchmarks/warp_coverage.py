"""Which models of public packages the Warp backend takes, why not the others, and whether it simulates them truly.

Every MJCF in a package's folder that compiles and has 1 to 120 degrees of freedom is tried, with its masses, frictions
and dampings as parameters. With ``--conformance`` each one that is taken is simulated for two steps from random states
and compared with C MuJoCo: the states, and the gradients by those parameters with central differences, both with a
search for contacts of curved shapes that goes on until it is done (``ccd_tolerance`` of 1e-12). The packages are found
without being imported (extra ``coverage-models``), or in ``--from FOLDER``, a folder for each package.

    python benchmarks/warp_coverage.py [--conformance] [--only dm_control] [--models '*humanoid*'] [--out coverage.json]

With ``--out`` results are kept model by model, and a second run goes on where the first was stopped; a model during
which a run died is not tried again.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import fnmatch
import importlib.util
import json
import math
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from dropo_torch.errors import InputError
from dropo_torch.models.load import quiet_mujoco
from dropo_torch.parameters import ParameterSpace, object_names
from dropo_torch.simulators.hidden import filters_of
from dropo_torch.simulators.mujoco import MujocoSimulator
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.simulators.warp.pairs import candidate_pairs
from dropo_torch.simulators.warp.support import Missing, missing, summary
from dropo_torch.testing import converged

#: Name of a distribution → the folder of its modules.
PACKAGES = {
    "gymnasium": "gymnasium", "brax": "brax", "dm_control": "dm_control", "gymnasium_robotics": "gymnasium_robotics",
    "metaworld": "metaworld", "playground": "mujoco_playground", "robosuite": "robosuite",
}  # fmt: skip
LARGEST = 120
STATES, STEPS = 20, 2
#: Seconds of motion before a state is taken.
SETTLING = (0.0, 0.1, 0.3, 1.0)
#: Median errors that pass, of states and of derivatives; and of states at a tie, where contacts come and go by a hair's
#: breadth: these count as right where they are so with margins by that much smaller or larger.
STATE_ERROR, GRADIENT_ERROR, TIE_ERROR = 1e-8, 1e-5, 1e-6
#: Fields that vary, and whose gradients are compared.
VARIED = {"mass": "body_mass", "friction": "geom_friction", "pair friction": "pair_friction", "damping": "dof_damping"}
_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
#: What stands in a model's place while it is simulated, and stays there if that ends the whole run.
DIED = "the run died"
#: A hair's breadth: displacement of a state, or of the margins, that must not change which geoms touch.
NUDGE = 1e-9
#: Nudged states of each, how often as many more are tried where no answer is near; and how far a contact must not be
#: shifted by a nudge, in meters.
NUDGES, ROUNDS, SHIFT = 32, 32, 1e-4
#: Tolerance in meters and iterations of a search for contacts that is done.
FINISHED = 1e-12, 400
#: Steps of central differences, relative to a parameter's size.
MOVES = (1e-5, 1e-4, 1e-3)


@dataclass
class Model:
    """What became of one model.

    Attributes:
        path: its file, from the package's folder.
        nv: degrees of freedom.
        reasons: what the backend lacks, each once; none where the model is taken.
        line: the same in one line, as a user reads it.
        conformance: what :func:`conformance` found.
        fault: what went wrong in the trial itself.
    """

    path: str
    nv: int = 0
    reasons: list[str] = field(default_factory=list)
    line: str = ""
    conformance: dict[str, Any] | None = None
    fault: str = ""

    @property
    def taken(self) -> bool:
        """Whether the backend simulates it."""
        return bool(self.nv) and not self.reasons

    @property
    def failed(self) -> bool:
        """Whether it is simulated wrongly, or not to the end."""
        return bool(self.fault) or (self.conformance is not None and not self.conformance["passed"])


def package_folder(name: str, root: Path | None) -> Path | None:
    """Return the folder of an installed package, or the one of that name in ``root``; ``None`` where there is none."""
    if root is not None:
        return next((root / n for n in (name, PACKAGES.get(name, name)) if (root / n).is_dir()), None)
    spec = importlib.util.find_spec(PACKAGES.get(name, name))  # a module without a dot is found without being imported
    places = list(spec.submodule_search_locations or ()) if spec else []
    return Path(places[0]) if places else None


def compiled_models(folder: Path, pattern: str) -> Iterator[tuple[str, mujoco.MjModel]]:
    """MJCFs in a folder that compile and have 1 to :data:`LARGEST` degrees of freedom, with their paths in it."""
    for file in sorted(folder.rglob("*.xml")):
        path = str(file.relative_to(folder))
        if not fnmatch.fnmatch(path, pattern):
            continue
        try:
            with quiet_mujoco(), warnings.catch_warnings(action="ignore"):
                model = mujoco.MjModel.from_xml_path(str(file))
        except (ValueError, mujoco.FatalError):
            continue  # a part of another file, another kind of XML, or one whose meshes are fetched elsewhere
        if 0 < model.nv <= LARGEST:
            yield path, model


def varied(model: mujoco.MjModel) -> ParameterSpace:
    """All masses of bodies that move, frictions of what may touch, and dampings of a model."""
    pairs = candidate_pairs(model)
    touching = {g for g1, g2, pair in pairs if pair < 0 for g in (g1, g2)}
    chosen = {
        "mass": [b for b in range(model.nbody) if model.body_weldid[b] and model.body_mass[b] > 0],
        "friction": sorted(touching),
        "pair friction": sorted({pair for _, _, pair in pairs if pair >= 0}),
        "damping": range(model.njnt),
    }
    specs = {}
    for kind, numbers in chosen.items():
        names = object_names(model, "jnt" if kind == "damping" else VARIED[kind].split("_")[0])
        for i in numbers:
            specs[f"{kind} {names[i]}"] = {"field": VARIED[kind], "name": names[i], "bounds": [1e-9, 1e9]}
    return ParameterSpace(model, specs)


def examine(path: str, model: mujoco.MjModel) -> Model:
    """Whether the backend takes a model, and what it lacks."""
    found = missing(model, varied(model), candidate_pairs(model))
    try:
        filters_of(model)
    except InputError:
        found.append(Missing("activations that no log holds"))
    return Model(path, int(model.nv), list(dict.fromkeys(m.what for m in found)), summary(found))


def random_states(model: mujoco.MjModel, count: int, seed: int) -> np.ndarray:
    """States ``(count, nq + nv)`` around the start and anywhere in the joints' ranges, some time after, in motion.

    What floats falls and what is posed into something is pushed out, so that the states have contacts where they can.
    """
    rng = np.random.default_rng(seed)
    data, states = mujoco.MjData(model), []
    for attempt in range(20 * count):
        if len(states) == count:
            break
        mujoco.mj_resetData(model, data)
        if model.nkey and attempt % 2:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        _disturb(model, data, rng, 1.0 if attempt % 3 == 0 else 0.1)
        for _ in range(min(500, int(rng.choice(SETTLING) / model.opt.timestep))):
            data.ctrl[:] = 0.3 * random_controls(model, rng)
            mujoco.mj_step(model, data)
        sound = not any(w.number for w in data.warning) and np.abs(data.qvel).max() < 100
        if sound or attempt >= 10 * count:  # one that never comes to rest is taken as it is
            states.append(np.r_[data.qpos, data.qvel])
    return np.array(states)


def _disturb(model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator, share: float) -> None:
    """Move joints by a share of their ranges, what floats by a little, and give all a velocity."""
    move = share * 0.3 * rng.uniform(-1, 1, model.nv)
    for j in range(model.njnt):
        address = model.jnt_dofadr[j]
        if model.jnt_type[j] >= _SLIDE and model.jnt_limited[j]:
            low, high = model.jnt_range[j]
            place = data.qpos[model.jnt_qposadr[j]]
            move[address] = np.clip(place + share * (high - low) * rng.uniform(-1, 1), low, high) - place
        elif model.jnt_type[j] == _FREE:
            move[address : address + 3] *= 0.1
    mujoco.mj_integratePos(model, data.qpos, move, 1.0)
    # what is damped away within a step, such as a base that is only posed, does not move
    slowed = 1 + model.opt.timestep * model.dof_damping / np.maximum(model.dof_M0, 1e-9)
    data.qvel[:] = rng.uniform(-1, 1, model.nv) / slowed
    for mocap, held, _ in _holds(model, data):
        number = model.body_mocapid[mocap]
        data.mocap_pos[number], data.mocap_quat[number] = data.xpos[held], data.xquat[held]


def take_hold(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Put mocap bodies where the bodies are that are welded to them, as environments do before they begin."""
    for mocap, held, e in _holds(model, data):
        model.body_pos[mocap], model.body_quat[mocap] = data.xpos[held], data.xquat[held]
        model.eq_data[e, 3:10] = [0, 0, 0, 1, 0, 0, 0]


def _holds(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[tuple[int, int, int]]:
    """Mocap bodies, the bodies that are welded to them, and the welds, with the poses of ``data.qpos``."""
    mujoco.mj_kinematics(model, data)
    for e in np.flatnonzero(model.eq_type == int(mujoco.mjtEq.mjEQ_WELD)):
        pair = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        for mocap, held in (pair, pair[::-1]):
            if model.body_mocapid[mocap] >= 0:
                yield mocap, held, int(e)


def random_controls(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Controls ``(nu,)`` within their ranges, or within ±1."""
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = (np.where(limited, end, s) for end, s in zip(model.actuator_ctrlrange.T, (-1.0, 1.0), strict=True))
    return rng.uniform(low, high)


@contextlib.contextmanager
def poisoned() -> Iterator[None]:
    """Fill the memory that the backend asks for with NaN, so that no number is right by being left from before."""

    def filled(make: Callable[..., Any], fill: Callable[[Any], object]) -> Callable[..., Any]:
        def made(*arguments: Any, **keywords: Any) -> Any:
            out = make(*arguments, **keywords)
            fill(out)
            return out

        return made

    def real(array: Any) -> object:
        scalar = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
        return array.fill_(math.nan) if scalar is wp.float64 else None

    kept = wp.empty, torch.empty
    wp.empty = filled(wp.empty, real)
    torch.empty = filled(torch.empty, lambda x: x.is_floating_point() and x.fill_(math.nan))
    try:
        yield
    finally:
        wp.empty, torch.empty = kept


def conformance(model: mujoco.MjModel, seed: int = 0) -> dict[str, Any]:
    """Simulate a model from random states with both backends, and compare states and gradients.

    Returns:
        Largest, median and count of errors, and whether all ``passed``.
    """
    space, rng = varied(model), np.random.default_rng(seed)
    values = torch.from_numpy(_values(space) * rng.uniform(0.9, 1.1, len(space)))[None]
    take_hold(model, mujoco.MjData(model))
    with quiet_mujoco():
        states = torch.from_numpy(random_states(model, STATES, seed))
    with poisoned():
        simulator = _simulator(space)
        controls = np.zeros((STATES, 1, simulator.num_controls))
        controls[:, 0] = [_inputs(model, state, simulator.num_controls, rng) for state in states.numpy()]
        inputs = torch.from_numpy(controls)
        found = simulator.simulate(states, inputs, values)[:, 0]
        weights = torch.from_numpy(rng.normal(size=tuple(states.shape)))
        finished = _finished(space)
        slopes = _slopes(_simulator(finished), states, inputs, values, weights)
    reference = _reference(space)
    errors = _errors(found, reference.simulate(states, inputs, values)[:, 0])
    ties = np.array([_is_tied(model, s, rng) for s in states.numpy()])
    for other in _answers_nearby(space, states[ties], inputs[ties], values, rng) if ties.any() else ():
        errors[ties] = torch.minimum(errors[ties], _errors(found[ties], other))
        if (errors[ties] <= TIE_ERROR).all():
            break
    assert finished.model is not None
    smooth = ~ties & ~np.array([_is_tied(finished.model, s, rng) for s in states.numpy()])
    sound, reference = torch.from_numpy(smooth), _reference(finished)
    trues = [_differences(reference, states[sound], inputs[sound], values, weights[sound], step) for step in MOVES]
    gradient = _gradient_errors({name: slope[smooth] for name, slope in slopes.items()}, trues, space)
    return judged(errors.numpy(), ties, gradient) | {"contacts": _contacts(model, states.numpy())}


def _answers_nearby(
    space: ParameterSpace, states: torch.Tensor, inputs: torch.Tensor, values: torch.Tensor, rng: np.random.Generator
) -> Iterator[torch.Tensor]:
    """The reference's next states of margins and of poses that are a hair's breadth off."""
    model = space.model
    assert model is not None
    for margin in (NUDGE, -NUDGE):
        yield _reference(space.on(_with_margins(model, margin))).simulate(states, inputs, values)[:, 0]
    reference = _reference(space)
    for _ in range(ROUNDS):
        for moved in zip(*(_nudged(model, state, rng) for state in states.numpy()), strict=True):
            yield reference.simulate(torch.from_numpy(np.array(moved)), inputs, values)[:, 0]


def _finished(space: ParameterSpace) -> ParameterSpace:
    """The same of a model whose search for contacts of curved shapes ends when it is done.

    By default it ends within a micrometer, with a normal that is off by as much over the size of the shapes, and
    differences are those of where it ends.
    """
    model = copy.copy(space.model)
    assert model is not None
    model.opt.ccd_tolerance = min(FINISHED[0], model.opt.ccd_tolerance)
    model.opt.ccd_iterations = max(FINISHED[1], model.opt.ccd_iterations)
    return space.on(model)


def _simulator(space: ParameterSpace) -> WarpSimulator:
    assert space.model is not None
    return WarpSimulator(space.model, parameters=space, frame_skip=STEPS, num_threads=1)


def _values(space: ParameterSpace) -> np.ndarray:
    """The model's own values ``(d,)``; light damping where there is none, whose derivative would be one-sided."""
    model = space.model
    assert model is not None
    light = [0.1 * model.dof_M0[p.targets[0].index] if p.field == "dof_damping" else 0.0 for p in space.parameters]
    return np.where(space.nominal == 0, light, space.nominal)


def _reference(space: ParameterSpace) -> MujocoSimulator:
    """C MuJoCo, with its solver run to convergence."""
    own = converged(space)
    assert own.model is not None
    return MujocoSimulator(own.model, parameters=own, frame_skip=STEPS, num_threads=1, chunk_size=1000)


def _with_margins(model: mujoco.MjModel, change: float) -> mujoco.MjModel:
    """A copy whose contacts are made a little earlier or later."""
    model = copy.copy(model)
    model.geom_margin += change
    model.pair_margin += change
    return model


def _inputs(model: mujoco.MjModel, state: np.ndarray, width: int, rng: np.random.Generator) -> np.ndarray:
    """Controls, and then poses of mocap bodies near those of what they hold, or near their own, ``(width,)``."""
    data = mujoco.MjData(model)
    data.qpos[:] = state[: model.nq]
    held = {mocap: (data.xpos[body], data.xquat[body]) for mocap, body, _ in _holds(model, data)}
    poses = []
    for body in np.flatnonzero(model.body_mocapid >= 0)[: (width - model.nu) // 7]:
        pos, quat = held.get(int(body), (model.body_pos[body], model.body_quat[body]))
        quat = quat + rng.normal(0, 0.02, 4)
        poses.append(np.r_[pos + rng.normal(0, 0.01, 3), quat / np.linalg.norm(quat)])
    return np.concatenate([_endured(model, state, random_controls(model, rng)), *poses])


def _endured(model: mujoco.MjModel, state: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """Controls that are small enough for a step to end at speeds below 100."""
    data = mujoco.MjData(model)
    for _ in range(30):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[: model.nq], state[model.nq :], controls
        mujoco.mj_step(model, data)
        if not any(w.number for w in data.warning) and np.abs(data.qvel).max() < 100:
            break
        controls = controls / 2
    return controls


def _errors(found: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Largest error of each state, relative to 1 + its size, ``(T,)``; none where both diverge."""
    both = found.isnan() & true.isnan()
    return ((found - true).abs() / (1 + true.abs())).masked_fill(both, 0.0).nan_to_num(nan=math.inf).amax(1)


def _slopes(
    simulator: WarpSimulator, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor, weights: torch.Tensor
) -> dict[str, np.ndarray]:
    """Gradients of each transition's weighted final state by the parameters, states and controls, ``(T, p)``."""
    rows: dict[str, list[np.ndarray]] = {"values": [], "states": [], "controls": []}
    for t in range(len(states)):
        leaves = [x.clone().requires_grad_() for x in (states[t : t + 1], controls[t : t + 1], values)]
        (simulator.simulate(*leaves)[0, 0] * weights[t]).sum().backward()
        for name, leaf in zip(("states", "controls", "values"), leaves, strict=True):
            rows[name].append(np.zeros(leaf.numel()) if leaf.grad is None else leaf.grad.numpy().ravel())
    return {name: np.array(row) for name, row in rows.items()}


def _differences(
    reference: MujocoSimulator,
    states: torch.Tensor,
    controls: torch.Tensor,
    values: torch.Tensor,
    weights: torch.Tensor,
    step: float,
) -> dict[str, np.ndarray]:
    """Central differences of the reference by the same."""
    sizes = step * torch.where(values[0] != 0, values[0].abs(), 0.1)
    moves = torch.diag(sizes)
    ends = [reference.simulate(states, controls, values + sign * moves) for sign in (1, -1)]
    out = {"values": (((ends[0] - ends[1]) * weights[:, None]).sum(-1) / (2 * sizes)).numpy()}
    for name, given in (("states", states), ("controls", controls)):
        flat = given.flatten(1)
        count, width = flat.shape
        both = []
        for sign in (1, -1):
            moved = flat[:, None] + sign * step * torch.eye(width, dtype=torch.float64)
            moved = moved.reshape(count * width, *given.shape[1:])
            others = [x.repeat_interleave(width, 0) for x in (states, controls)]
            others[name == "controls"] = moved
            both.append(
                reference.simulate(*others, values)[:, 0].reshape(count, width, states.shape[1]) if width else None
            )
        slope = ((both[0] - both[1]) * weights[:, None]).sum(-1) / (2 * step) if width else flat
        out[name] = slope.numpy()
    return out


def _gradient_errors(
    found: dict[str, np.ndarray], trues: Sequence[dict[str, Any]], space: ParameterSpace
) -> dict[str, Any]:
    """For each kind of parameter, states and controls: the errors of all derivatives that are not zero."""
    kinds: dict[str, tuple[str, Any]] = {
        kind: ("values", np.array([p.field == field for p in space.parameters], dtype=bool))
        for kind, field in VARIED.items()
    }
    kinds |= {name: (name, slice(None)) for name in ("states", "controls")}
    return {
        kind: relative_errors(found[name][:, own], *(true[name][:, own] for true in trues))
        for kind, (name, own) in kinds.items()
        if found[name][:, own].shape[1]
    }


def relative_errors(found: np.ndarray, *trues: np.ndarray, floor: float = 1e-6) -> np.ndarray:
    """Errors of derivatives, relative to their size, of those that either side has as different from zero.

    Differences by a small step are blurred by rounding, those by a large one by curvature: the nearest of ``trues``
    counts. Smaller derivatives than ``floor`` of the largest count as that large; where all are NaN there is no error.
    """
    errors, acts = np.full(found.shape, math.inf), np.zeros(found.shape, dtype=bool)
    for true in trues:
        both = np.isnan(found) & np.isnan(true)
        largest = floor * (1 + np.nan_to_num(np.abs(true)).max(initial=0.0))
        acts |= ~both & (~(np.abs(found) <= largest) | ~(np.abs(true) <= largest))
        error = np.abs(found - true) / (np.abs(true) + largest)
        errors = np.fmin(errors, np.where(both, 0.0, error))
    return errors[acts]


def _is_tied(model: mujoco.MjModel, state: np.ndarray, rng: np.random.Generator) -> bool:
    """Whether a hair's breadth, of the pose or of the margins, changes which geoms touch, or at which points.

    Or a joint is so near to a limit that differences reach across it.
    """
    data = mujoco.MjData(model)
    own = state[: model.nq]
    limited = model.jnt_limited.astype(bool) & (model.jnt_type >= _SLIDE)
    if (np.abs(own[model.jnt_qposadr[limited], None] - model.jnt_range[limited]) < MOVES[0]).any():
        return True
    expected = _touching(model, data, own)
    others = [_touching(_with_margins(model, change), data, own) for change in (NUDGE, -NUDGE)]
    others += [_touching(model, data, moved[: model.nq]) for moved in _nudged(model, state, rng)]
    return any(
        pairs != expected[0] or np.abs(points - expected[1]).max(initial=0.0) > SHIFT for pairs, points in others
    )


def _touching(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Pairs of geoms that touch, and the points where they do."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    found = [c for c in data.contact if not c.exclude]
    found.sort(key=lambda c: (int(c.geom[0]), int(c.geom[1])))
    points = np.array([c.pos for c in found]).reshape(-1, 3)
    return [(int(c.geom[0]), int(c.geom[1])) for c in found], points


def _nudged(model: mujoco.MjModel, state: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """States a hair's breadth from one."""
    for _ in range(NUDGES):
        moved = state.copy()
        mujoco.mj_integratePos(model, moved[: model.nq], rng.normal(size=model.nv), NUDGE)
        yield moved


def _contacts(model: mujoco.MjModel, states: np.ndarray) -> int:
    """How many of the states have a contact."""
    data, number = mujoco.MjData(model), 0
    for state in states:
        data.qpos[:] = state[: model.nq]
        mujoco.mj_fwdPosition(model, data)
        number += bool(data.ncon)
    return number


def judged(errors: np.ndarray, ties: np.ndarray, gradient: dict[str, np.ndarray]) -> dict[str, Any]:
    """The verdict on errors of states ``(T,)``, which of them are at a tie, and errors of derivatives by kind."""
    sound = errors[~ties]
    median = float(np.median(sound)) if len(sound) else 0.0
    slopes = {kind: float(np.median(e)) if len(e) else None for kind, e in gradient.items()}
    wrong = [kind for kind, e in slopes.items() if e is not None and e > GRADIENT_ERROR]
    tied = float(np.median(errors[ties])) if ties.any() else 0.0
    passed = median <= STATE_ERROR and tied <= TIE_ERROR and not wrong
    off = int((errors > np.where(ties, TIE_ERROR, STATE_ERROR)).sum())
    return {
        "passed": bool(passed), "state_median": median, "state_worst": float(errors.max()),
        "off": off, "ties": int(ties.sum()), "gradients": slopes, "wrong": wrong,
    }  # fmt: skip


def reason_table(models: Iterable[Model]) -> list[tuple[str, int, int]]:
    """Reasons for refusals: what is missing, models that need it, and those that need nothing else; the most first."""
    refused = [set(m.reasons) for m in models if m.reasons]
    counts = Counter(reason for reasons in refused for reason in reasons)
    alone = Counter(next(iter(reasons)) for reasons in refused if len(reasons) == 1)
    return [(reason, number, alone[reason]) for reason, number in sorted(counts.items(), key=lambda c: (-c[1], c[0]))]


def resumed(out: Path | None) -> dict[str, dict[str, Model]]:
    """What an earlier run found, package → path → model."""
    if out is None or not out.exists():
        return {}
    document = json.loads(out.read_text())
    return {package: {path: Model(**found) for path, found in models.items()} for package, models in document.items()}


def kept(out: Path | None, results: dict[str, dict[str, Model]]) -> None:
    """Write results, so that a run can go on from them."""
    if out is not None:
        document = {package: {p: asdict(m) for p, m in models.items()} for package, models in results.items()}
        partial = out.with_suffix(".partial")
        partial.write_text(json.dumps(document, indent=1))
        partial.replace(out)


def run(package: str, folder: Path, results: dict[str, dict[str, Model]], arguments: argparse.Namespace) -> None:
    """Examine the models of one package."""
    models = results.setdefault(package, {})
    for path, model in compiled_models(folder, arguments.models):
        found = models.get(path)
        if found and (found.fault == DIED or found.conformance):
            continue
        start = time.perf_counter()
        models[path] = result = examine(path, model)
        if result.taken and arguments.conformance:
            result.fault = DIED
            kept(arguments.out, results)
            try:
                result.conformance, result.fault = conformance(model), ""
            except Exception as error:
                result.fault = f"{type(error).__name__}: {error}"[:300]
        kept(arguments.out, results)
        print(f"{package}/{path} (nv {result.nv}, {time.perf_counter() - start:.1f} s): {verdict(result)}", flush=True)


def verdict(model: Model) -> str:
    """One line on a model."""
    if not model.taken:
        return "refused: " + model.line
    if model.fault:
        return "FAILED: " + model.fault
    if model.conformance is None:
        return "taken"
    c = model.conformance
    slopes = ", ".join(f"{kind} {'-' if e is None else f'{e:.0e}'}" for kind, e in c["gradients"].items())
    return (
        f"{'passed' if c['passed'] else 'FAILED'}: states {c['state_median']:.0e} (worst {c['state_worst']:.0e}, "
        f"{c['off']} off, {c['ties']} ties, {c['contacts']} of {STATES} in contact); gradients {slopes}"
    )


def report(results: dict[str, dict[str, Model]]) -> str:
    """The tables: models by package, reasons, and failures."""
    lines = [f"{'package':20} tried  taken  conform", ""]
    every = [m for models in results.values() for m in models.values()]
    for package, models in [*((p, list(m.values())) for p, m in results.items()), ("all", every)]:
        checked = [m for m in models if m.conformance or m.fault]
        conform = f"{len(checked) - sum(m.failed for m in checked)} of {len(checked)}" if checked else "-"
        lines.append(f"{package:20} {len(models):5}  {sum(m.taken for m in models):5}  {conform}")
    lines += ["", "models  alone  what is missing (alone: nothing else is)", ""]
    lines += [f"{number:6}  {alone:5}  {reason}" for reason, number, alone in reason_table(every)]
    failed = [(p, m) for p, models in results.items() for m in models.values() if m.failed]
    if failed:
        share = len(failed) / max(1, sum(m.taken for m in every))
        lines += ["", f"{len(failed)} fail, {share:.1%} of those taken:"]
        lines += [f"  {package}/{m.path}: {verdict(m)}" for package, m in failed]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conformance", action="store_true", help="compare every model that is taken with C MuJoCo")
    parser.add_argument("--only", choices=sorted(PACKAGES), action="append", help="this package; may be repeated")
    parser.add_argument("--models", default="*", metavar="GLOB", help="only files whose path in the package matches")
    parser.add_argument("--from", dest="root", type=Path, metavar="FOLDER", help="packages' folders, not installed")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="where results are kept")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = resumed(arguments.out)
    for package in arguments.only or PACKAGES:
        folder = package_folder(package, arguments.root)
        if folder is None:
            print(f"{package}: not installed (pip install -e '.[coverage-models]')")
        else:
            run(package, folder, results, arguments)
    print("\n" + report(results))


if __name__ == "__main__":
    main()
