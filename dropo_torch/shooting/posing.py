"""States in the place of sensors, row by row: where markers and encoders tell every position of every row.

Positions are the least squares of each row's columns, from those of the row before (inverse kinematics). Velocities are
what gyroscopes and encoders say of them; those that none shows follow from the positions of some rows about each, which
is no measurement: they are masked. So is the place of a floating base that no column shows: it follows from its feet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from dropo_torch.data.features import Features, masked_columns
from dropo_torch.data.observation import Observation, parse_observation
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.errors import InputError
from dropo_torch.objective import LIMITS
from dropo_torch.problem import Problem, make_problem
from dropo_torch.shooting.begin import scatter
from dropo_torch.shooting.odometry import Base, base_motion, find_base, scale_of, sinking
from dropo_torch.support.rows import evenly

_SENSOR = mujoco.mjtSensor
#: Sensors of where things are that are smooth in it.
_PLACES = frozenset(
    int(kind)
    for kind in (
        _SENSOR.mjSENS_FRAMEPOS, _SENSOR.mjSENS_FRAMEQUAT, _SENSOR.mjSENS_FRAMEXAXIS, _SENSOR.mjSENS_FRAMEYAXIS,
        _SENSOR.mjSENS_FRAMEZAXIS, _SENSOR.mjSENS_SUBTREECOM, _SENSOR.mjSENS_JOINTPOS, _SENSOR.mjSENS_BALLQUAT,
        _SENSOR.mjSENS_TENDONPOS, _SENSOR.mjSENS_ACTUATORPOS,
    )
)  # fmt: skip
#: Poses from which an episode's first row is tried, their seed, and iterations of each and of a later row.
TRIED, SEED, FIRST, LATER = 24, 7, 30, 8
#: Step of differences, and the size of a step at which a pose is at rest, in rad and m.
DIFFERENCE, REST = 1e-6, 1e-9
#: Error of a position, in rad or lengths of the model, from which on a row's columns do not tell it; and the share of
#: rows that may be such.
UNTOLD, SOME = 0.3, 0.02
#: Sizes of its noise, and share of its spread, by which a column's poses may miss it typically.
ASTRAY, MISSED = 6.0, 0.05
#: ε relative to the noise, which it must not add to.
BESIDE = 0.1
#: The smallest noise of a column relative to the others' of its kind.
LEAST = 1e-2
#: Rows from which a velocity is derived, the most first; and by how much their residuals may exceed the noise.
SPANS, ROUGH, ORDER = (31, 25, 21, 17, 13, 11, 9, 7, 5), 1.1, 3


def posed(problem: Problem) -> Problem:
    """Return a problem whose log has states in place of sensors; the same where it has them.

    Args:
        problem: with a MuJoCo model.

    Raises:
        InputError: columns that do not tell every position in nearly every row, or that no pose of the model has.
    """
    if not problem.observation.is_sensed:
        return problem
    assert problem.space.model is not None
    step = problem.trajectories.dt or problem.simulator.timestep or 1.0
    log, told = posed_log(problem.space.model, problem.observation, problem.trajectories, step)
    own = {
        "observation": None,
        "mask": [*told.blind, *_masked(problem, told)],
        "noise": None,
        "trajectories": None,
        "leave_out": [],
    }
    own |= _state_noise(problem, told)
    config = problem.config.model_copy(update=own)
    return replace(make_problem(config, log=log, general=True), sensed=problem.config, derived=told.blind)


def _masked(problem: Problem, told: Told) -> list[str]:
    """The numbers of a state that the log shows and the config masks, such as velocities that are derived already."""
    model, observation = problem.space.model, problem.observation
    assert model is not None
    masked = masked_columns(observation, problem.config.mask)
    if (seat := _seat_of(model, observation)) is not None:
        observation = seat.observation
    of_state = set(parse_observation(model, None).labels) - told.blind.keys()
    return [observation.labels[c] for c in sorted(masked) if observation.labels[c] in of_state]


def is_placeable(problem: Problem) -> bool:
    """Return whether the log of a problem lacks no more of a state than where a floating base is, and its speed."""
    model, observation = problem.space.model, problem.observation
    if not observation.is_sensed or model is None:
        return False
    seat = _seat_of(model, observation)
    return _Reading(model, observation if seat is None else seat.observation).lacks_base_only


def _state_noise(problem: Problem, told: Told) -> dict[str, Any]:
    """The noise of a log of states, where its columns are that of the sensors or derived, and ε below it; or nothing.

    Of a sensor that shows no number of the state itself, the noise of the states does not follow.
    """
    model, observation, given = problem.space.model, problem.observation, problem.config.noise
    if given is None or model is None:
        return {}
    labels = parse_observation(model, None).labels
    listed = np.broadcast_to(np.asarray(given, dtype=float), observation.size)
    if (seat := _seat_of(model, observation)) is not None:
        observation, listed = seat.observation, seat.noise(listed)
    known = dict(zip(observation.labels, listed.tolist(), strict=True)) | told.blind
    noise = [known.get(label, 0.0) for label in labels]
    if min(noise) <= 0:  # one that is 0 is to be estimated
        return {}
    return {"noise": noise, "epsilon": max((BESIDE * min(noise)) ** 2, LIMITS["epsilon"][0])}


@dataclass(frozen=True)
class Told:
    """What the columns of a log of sensors tell of its states.

    Attributes:
        blind: the numbers of a state that no column shows, by their labels, with their errors as derived: velocities,
            and where a floating base is.
        missed: root mean square of what the poses leave of each position feature, by its label.
    """

    blind: dict[str, float]
    missed: dict[str, float]


def posed_log(
    model: mujoco.MjModel, observation: Observation, log: Trajectories, dt: float
) -> tuple[Trajectories, Told]:
    """Return a log of states ``[qpos, qvel]`` for one of sensors, and what it is worth.

    Args:
        model: the model.
        observation: what the columns are.
        log: the log.
        dt: seconds between rows.

    Raises:
        InputError: see :func:`posed`.
    """
    seat = _seat_of(model, observation)
    if seat is not None:
        observation, log = seat.observation, seat.seen(log)
    reading = _Reading(model, observation)
    ends = np.flatnonzero(log.terminals) + 1
    bounds = zip(np.append(0, ends[:-1]), ends, strict=True)
    paths = [np.concatenate([log.observations[a : a + 1], log.next_observations[a:b]]) for a, b in bounds]
    paths = [observation.observed(path) for path in paths]
    noise = reading.noise(paths)
    found = [reading.positions(path, noise, start) for start, path in enumerate(paths)]
    missed = reading.check(paths, found, noise)
    states = []
    known, errors = np.ones(model.nq + model.nv, dtype=bool), []
    for path, positions in zip(paths, found, strict=True):
        rates, error = derived(model, positions, dt)
        velocities, told = reading.velocities(path, positions, rates)
        known[model.nq :] &= told
        errors.append(np.concatenate([np.zeros(model.nq), error]))
        states.append(np.concatenate([positions, velocities], axis=1))
    if reading.base is not None:
        known[reading.base.columns] = False
        states, errors = _based(reading, paths, states, errors, log.actions, dt)
    labels = parse_observation(model, None).labels
    error = np.sqrt(np.mean(np.square(errors), axis=0))
    blind = {labels[i]: float(error[i]) for i in np.flatnonzero(~known)}
    before, after = (np.concatenate(parts) for parts in ([s[:-1] for s in states], [s[1:] for s in states]))
    whole = Trajectories(before, after, log.actions, log.terminals, log.dt, log.source)
    return whole, Told(blind, missed)


@dataclass(frozen=True)
class _Seat:
    """An IMU on a floating base: its orientation and its gyroscope as those of the base.

    Attributes:
        observation: of the base's columns in place of the sensors'.
        turn: of the IMU in the base.
        orientation, gyroscope: observed columns of w, x, y, z and of x, y, z; empty for none.
    """

    observation: Observation
    turn: Rotation
    orientation: tuple[int, ...]
    gyroscope: tuple[int, ...]

    def seen(self, log: Trajectories) -> Trajectories:
        """Return the log with the base's columns."""
        before, after = (self._turned(x) for x in (log.observations, log.next_observations))
        return replace(log, observations=before, next_observations=after)

    def _turned(self, rows: np.ndarray) -> np.ndarray:
        found, place = rows.copy(), list(self.observation.log_columns)
        if self.orientation:
            own = [place[c] for c in self.orientation]
            found[:, own] = (Rotation.from_quat(rows[:, own], scalar_first=True) * self.turn.inv()).as_quat(
                scalar_first=True
            )
        if self.gyroscope:
            own = [place[c] for c in self.gyroscope]
            found[:, own] = self.turn.apply(rows[:, own])
        return found

    def noise(self, columns: np.ndarray) -> np.ndarray:
        """Return the noise of the base's columns from that of the sensors', ``(n,)`` each."""
        found = columns.copy()
        if self.gyroscope:
            own = list(self.gyroscope)
            found[own] = np.sqrt(self.turn.as_matrix() ** 2 @ columns[own] ** 2)
        return found


def _seat_of(model: mujoco.MjModel, observation: Observation) -> _Seat | None:
    """The IMU of which columns show the orientation, or the turning, of a floating base; ``None`` without one."""
    base = find_base(model)
    if base is None or not observation.is_sensed:
        return None
    columns, labels, units = list(observation.columns), list(observation.labels), list(observation.units)
    state = parse_observation(model, None)
    found: dict[str, tuple[int, ...]] = {"orientation": (), "gyroscope": ()}
    turns = []
    shown = [(i, "orientation", base.turn.start, 4) for i in base.sensors(_SENSOR.mjSENS_FRAMEQUAT)]
    shown += [(i, "gyroscope", model.nq + base.rate.start, 3) for i in base.sensors(_SENSOR.mjSENS_GYRO)]
    for i, name, into, size in shown:
        first, seat = model.nq + model.nv + int(model.sensor_adr[i]), base.seat(i)
        own = tuple(columns.index(first + k) for k in range(size) if first + k in columns)
        if seat is None or len(own) != size or found[name]:
            continue
        found[name] = own
        turns.append(seat)
        for k, c in enumerate(own):
            columns[c], labels[c], units[c] = into + k, state.labels[into + k], state.units[into + k]
    same = all((turn * turns[0].inv()).magnitude() < 1e-9 for turn in turns)
    if not turns or not same or len(set(columns)) != len(columns):
        return None
    changed = replace(observation, columns=tuple(columns), labels=tuple(labels), units=tuple(units))
    return _Seat(changed, turns[0], found["orientation"], found["gyroscope"])


def _based(
    reading: _Reading, paths: list[np.ndarray], states: list[np.ndarray], errors: list[np.ndarray],
    commands: np.ndarray, dt: float,
) -> tuple[list[np.ndarray], list[np.ndarray]]:  # fmt: skip
    """States ``(T, nq + nv)`` of episodes and their errors ``(nq + nv,)``, with how the base moves in them."""
    base, nq = reading.base, reading.size
    assert base is not None
    found, whole = [], []
    begins = np.cumsum([0, *(len(own) - 1 for own in states)])
    for path, own, error in zip(paths, states, errors, strict=True):
        shown, site = reading.accelerations(path)
        motion = base_motion(base, own[:, :nq], own[:, nq:], dt, accelerations=shown, site=site)
        state, off = own.copy(), error.copy()
        state[:, base.columns] = np.concatenate([motion.places, motion.velocities], axis=1)
        off[base.columns] = np.append(np.full(3, motion.height_error), motion.speed_error)
        found.append(state)
        whole.append(off)
    sunk = np.median([
        sinking(base, state[:, :nq], state[:, nq:], commands[a : a + len(state) - 1], dt)
        for a, state in zip(begins[:-1], found, strict=True)
    ])  # fmt: skip
    for state in found:
        state[:, base.place] -= sunk * base.axes[:, 2]
    return found, whole


def column_noise(observation: Observation, log: Trajectories) -> np.ndarray:
    """Return the noise of each observed column of a log, ``(n,)``, by fourth differences."""
    path = observation.observed(log.observations)
    features = Features.of(observation)
    away = features.difference(path, np.broadcast_to(path[:1], path.shape))
    inside = np.flatnonzero(log.episodes[4:] == log.episodes[:-4]) if len(log) > 4 else np.array([], dtype=int)
    fourth = np.diff(away, 4, axis=0)[inside] if inside.size else away
    return features.column_noise(scale_of(fourth))


class _Reading:
    """The columns of a log as functions of positions and velocities."""

    def __init__(self, model: mujoco.MjModel, observation: Observation) -> None:
        self._model, self._data, self._observation = model, mujoco.MjData(model), observation
        self._features = Features.of(observation)
        self._stage = stage = self._stages()
        first = [*self._features.plain, *(q[0] for q in self._features.quaternions for _ in range(3))]
        self._of_positions = np.flatnonzero([stage[c] == 0 for c in first])
        self._of_velocities = np.flatnonzero([stage[c] == 1 for c in first])

    def _stages(self) -> list[int]:
        """Of each observed column: 0 where it shows positions, 1 for velocities, 2 for what is not used."""
        model, found = self._model, []
        ends = model.sensor_adr + model.sensor_dim
        for c in self._observation.index.tolist():
            if c < model.nq + model.nv:
                found.append(int(c >= model.nq))
                continue
            sensor = int(np.searchsorted(ends, c - model.nq - model.nv, side="right"))
            stage = int(model.sensor_needstage[sensor])
            usable = stage == mujoco.mjtStage.mjSTAGE_VEL or int(model.sensor_type[sensor]) in _PLACES
            found.append(2 if not usable else int(stage == mujoco.mjtStage.mjSTAGE_VEL))
        return found

    @property
    def size(self) -> int:
        """Number of positions nq."""
        return int(self._model.nq)

    @property
    def lacks_base_only(self) -> bool:
        """Whether columns are all positions and velocities of a state but those of a base, and no more of sensors."""
        return self.base is not None and all(self._as_they_are(stage) is not None for stage in (0, 1))

    @cached_property
    def base(self) -> Base | None:
        """The floating base whose place no column shows, if there is ground on which it may stand."""
        base = find_base(self._model)
        if base is None:
            return None
        there = self._model.qpos0.copy()
        there[base.place] += 1.0
        moved = self._features.difference(self._at(there), self._at(self._model.qpos0))
        return None if np.abs(moved[self._of_positions]).max() > 1e-9 else base

    def accelerations(self, path: np.ndarray) -> tuple[np.ndarray | None, int]:
        """Return what an accelerometer on the base shows, ``(T, 3)``, and its site; ``None`` without one."""
        model, base = self._model, self.base
        assert base is not None
        for i in base.sensors(_SENSOR.mjSENS_ACCELEROMETER):
            site, first = int(model.sensor_objid[i]), model.nq + model.nv + int(model.sensor_adr[i])
            shown = [np.flatnonzero(self._observation.index == first + k) for k in range(3)]
            if all(c.size for c in shown):
                return path[:, [int(c[0]) for c in shown]], site
        return None, -1

    @property
    def _labels(self) -> list[str]:
        return [self._features.labels[i] for i in self._of_positions]

    def noise(self, paths: list[np.ndarray]) -> np.ndarray:
        """Return the noise of each feature that shows positions, by fourth differences, ``(p,)``."""
        own = [self._features.difference(p, np.broadcast_to(p[:1], p.shape))[:, self._of_positions] for p in paths]
        fourth = np.concatenate([np.diff(p, 4, axis=0) for p in own])
        size = np.concatenate(own).std(0)
        found = scale_of(fourth) if len(fourth) else 1e-3 * size
        usual = float(np.median(found[found > 0])) if (found > 0).any() else 1e-6
        return np.maximum(found, max(LEAST * usual, 1e-9))

    def _at(self, position: np.ndarray) -> np.ndarray:
        """The columns of a pose at rest, ``(n,)``, right in those that show positions."""
        model, data = self._model, self._data
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mj_transmission(model, data)
        mujoco.mj_sensorPos(model, data)
        return np.concatenate([position, np.zeros(model.nv), data.sensordata])[self._observation.index]

    def _residual(self, row: np.ndarray, position: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return self._features.difference(row, self._at(position))[self._of_positions] / noise

    def _moved(self, position: np.ndarray, move: np.ndarray) -> np.ndarray:
        moved = position.copy()
        mujoco.mj_integratePos(self._model, moved, move, 1.0)
        return moved

    def _slope(self, row: np.ndarray, position: np.ndarray, off: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals by moves of the pose, ``(p, nv)``."""
        steps = DIFFERENCE * np.eye(self._model.nv)
        beside = [self._residual(row, self._moved(position, step), noise) for step in steps]
        return (np.stack(beside, axis=1) - off[:, None]) / DIFFERENCE

    def _settled(
        self, row: np.ndarray, position: np.ndarray, noise: np.ndarray, iterations: int
    ) -> tuple[np.ndarray, float]:
        """Levenberg-Marquardt on the pose of a row; it, and its χ²."""
        off = self._residual(row, position, noise)
        cost, damping = float(off @ off), 1e-6
        for _ in range(iterations):
            slope = self._slope(row, position, off, noise)
            normal = slope.T @ slope
            normal[np.diag_indices_from(normal)] *= 1 + damping
            normal[np.diag_indices_from(normal)] += 1e-9 * max(float(np.trace(normal)), 1e-300)
            move = np.linalg.solve(normal, -slope.T @ off)
            tried = self._moved(position, move)
            there = self._residual(row, tried, noise)
            if float(there @ there) < cost:
                position, off, cost, damping = tried, there, float(there @ there), damping / 10
            else:
                damping = max(10 * damping, 1e-4)
            if np.abs(move).max() < REST:
                break
        return position, cost

    def positions(self, path: np.ndarray, noise: np.ndarray, seed: int) -> np.ndarray:
        """Return the poses of an episode's rows ``(T, n)``, ``(T, nq)``."""
        found = np.tile(self._model.qpos0, (len(path), 1))
        if (own := self._as_they_are(0)) is not None:
            found[:, self._observation.index[own]] = path[:, own]
            for position in found:
                mujoco.mj_normalizeQuat(self._model, position)
            return found
        tried = np.repeat(self._model.qpos0[None, None], TRIED, axis=1)
        scatter(self._model, tried, np.random.default_rng((SEED, seed)))
        position, _ = min((self._settled(path[0], p, noise, FIRST) for p in tried[0]), key=lambda x: x[1])
        position = self._unwound(position)
        for t, row in enumerate(path):
            position, _ = self._settled(row, position, noise, LATER)
            found[t] = position
        return found

    def _as_they_are(self, stage: int) -> np.ndarray | None:
        """The observed columns that are all positions of a state (stage 0), or all velocities (1), and nothing else is.

        All but those of a base that no column places; ``None`` where there are others.
        """
        nq, nv = self._model.nq, self._model.nv
        every = range(nq, nq + nv) if stage else range(nq)
        own = np.flatnonzero(np.array(self._stage) == stage)
        wanted = set(every) - set(() if self.base is None else self.base.columns)
        return own if set(self._observation.index[own].tolist()) == wanted else None

    def _unwound(self, position: np.ndarray) -> np.ndarray:
        """The same pose with joints that turn freely within half a turn of the model's own."""
        model, found = self._model, position.copy()
        free = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)) & (model.jnt_limited == 0)
        at = model.jnt_qposadr[free]
        found[at] -= 2 * np.pi * np.round((position[at] - model.qpos0[at]) / (2 * np.pi))
        return found

    def check(self, paths: list[np.ndarray], found: list[np.ndarray], noise: np.ndarray) -> dict[str, float]:
        """Return by how much poses miss each feature, by its label; refuse poses that rows do not tell, or that miss.

        Raises:
            InputError: the joint, or the sensor.
        """
        rows = [(row, p) for path, own in zip(paths, found, strict=True) for row, p in zip(path, own, strict=True)]
        some = [rows[i] for i in evenly(len(rows), 100)]
        untold = np.zeros(self._model.nv)
        for row, position in some:
            slope = self._slope(row, position, self._residual(row, position, noise), noise) * self._lengths
            _, sizes, directions = np.linalg.svd(slope, full_matrices=True)
            error = np.full(self._model.nv, 1e12)
            error[: len(sizes)] = 1 / np.maximum(sizes, 1e-12)
            untold += (directions**2 * error[:, None] ** 2).sum(0) > UNTOLD**2
        if self.base is not None:
            untold[self.base.speed] = 0
        if (bad := np.flatnonzero(untold > SOME * len(some))).size:
            label = parse_observation(self._model, None).labels[self._model.nq + int(bad[0])]
            raise InputError(
                f"observation: its sensors do not tell {label.rpartition('.')[0]}.position row by row, which needs "
                "markers or encoders of every joint; dropo fit and dropo check take such a log"
            )
        missed = np.sqrt(np.mean([(self._residual(r, p, noise) * noise) ** 2 for r, p in rows], axis=0))
        about = np.concatenate([self._features.difference(p, np.broadcast_to(p[:1], p.shape)) for p in paths])
        spread = about[:, self._of_positions].std(0).max()
        worst = int(np.argmax(missed / noise))
        if missed[worst] > ASTRAY * noise[worst] and missed[worst] > MISSED * spread:
            unit = self._features.units[self._of_positions[worst]]
            raise InputError(
                f"observation: no pose of the model has {self._labels[worst]} as logged: it is {missed[worst]:.3g} "
                f"{unit} off, and its noise is {noise[worst]:.2g} {unit}; is it along the world's axes from its "
                f"origin, in {unit}, and is the marker where the model has it?"
            )
        return dict(zip(self._labels, missed.tolist(), strict=True))

    @cached_property
    def _lengths(self) -> np.ndarray:
        """What counts as large of each degree of freedom, ``(nv,)``: a rad, or the size of a body."""
        linear = np.zeros(self._model.nv, dtype=bool)
        for kind, dof in zip(self._model.jnt_type, self._model.jnt_dofadr, strict=True):
            linear[dof : dof + {int(mujoco.mjtJoint.mjJNT_FREE): 3}.get(int(kind), 1)] = kind in (
                int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE),
            )  # fmt: skip
        return np.where(linear, self._model.stat.meansize, 1.0)

    def velocities(self, path: np.ndarray, positions: np.ndarray, derived: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return velocities ``(T, nv)``, as columns show them or else as derived, and which are shown, ``(nv,)``."""
        rows, nv = self._of_velocities, self._model.nv
        if not rows.size:
            return derived, np.zeros(nv, dtype=bool)
        found, told = derived.copy(), np.ones(nv, dtype=bool)
        if (own := self._as_they_are(1)) is not None:
            shown = self._observation.index[own] - self._model.nq
            found[:, shown] = path[:, own]
            return found, np.isin(np.arange(nv), shown)
        for t, (row, position) in enumerate(zip(path, positions, strict=True)):
            zero = self._moving(position, np.zeros(nv))
            beside = [self._features.difference(self._moving(position, unit), zero) for unit in np.eye(nv)]
            slope = np.stack(beside, axis=1)[rows]
            shown = self._features.difference(row, zero)[rows]
            inverse = np.linalg.pinv(slope, rcond=1e-6)
            found[t] += inverse @ (shown - slope @ found[t])
            told &= np.diag(inverse @ slope) > 1 - 1e-6
        return found, told

    def _moving(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """The columns of a moving pose, ``(n,)``, right in those that show positions or velocities."""
        self._at(position)
        self._data.qvel[:] = velocity
        mujoco.mj_comVel(self._model, self._data)
        mujoco.mj_sensorVel(self._model, self._data)
        return np.concatenate([position, velocity, self._data.sensordata])[self._observation.index]


def derived(model: mujoco.MjModel, positions: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return velocities ``(T, nv)`` by which poses ``(T, nq)`` move, and their errors, ``(nv,)``.

    They are those of cubics through the rows about each, as many as leave no more than noise.

    Args:
        model: the model.
        positions: of one episode.
        dt: seconds between rows.
    """
    away = _apart(model, positions, np.zeros(len(positions), dtype=int), np.arange(len(positions)))
    fourth = np.diff(away, 4, axis=0)
    noise = scale_of(fourth) if len(fourth) else np.zeros(model.nv)
    found, error = np.zeros((len(positions), model.nv)), np.zeros(model.nv)
    settled = np.zeros(model.nv, dtype=bool)
    for span in [s for s in SPANS if s <= len(positions)] or [len(positions)]:
        velocities, left = _by_cubics(model, positions, span)
        found[:, ~settled] = velocities[:, ~settled] / dt
        error[~settled] = (np.linalg.norm(_cubic(span, span // 2)[1]) * np.maximum(noise, left) / dt)[~settled]
        settled |= left <= ROUGH * noise
        if settled.all():
            break
    return found, error


def _cubic(span: int, place: int) -> np.ndarray:
    """What a cubic through so many rows makes of them at one: its value and its change a row, ``(·, span)``."""
    return np.linalg.pinv(np.vander(np.arange(span) - place, min(ORDER + 1, span), increasing=True))


def _by_cubics(model: mujoco.MjModel, positions: np.ndarray, span: int) -> tuple[np.ndarray, np.ndarray]:
    """Moves a row by cubics through so many rows about each, ``(T, nv)``, and the noise that these leave, ``(nv,)``."""
    rows = np.arange(len(positions))
    first = np.clip(rows - span // 2, 0, len(positions) - span)
    moves, left = np.empty((len(positions), model.nv)), []
    for place in range(span):  # of a row within its window
        own = rows[rows - first == place]
        if own.size:
            inverse = _cubic(span, place)
            about = np.stack([_apart(model, positions, own, first[own] + k) for k in range(span)])  # (span, R, nv)
            level, moves[own] = (np.tensordot(inverse[i], about, 1) for i in (0, 1))
            left.append(level / np.sqrt(max(1 - inverse[0, place], 1e-9)))
    return moves, np.sqrt(np.mean(np.concatenate(left) ** 2, axis=0))


def _apart(model: mujoco.MjModel, positions: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The moves that lead from some rows of poses ``(T, nq)`` to others, ``(R, nv)``."""
    if model.nq == model.nv:
        return np.asarray(positions[end] - positions[start])
    found = np.empty((len(start), model.nv))
    for out, a, b in zip(found, start, end, strict=True):
        mujoco.mj_differentiatePos(model, out, 1.0, positions[a], positions[b])
    return found
