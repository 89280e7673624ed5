"""From a raw recording to transitions: synchronise, filter, resample, differentiate, infer commands.

The sensors of a real robot report at times of their own, and seldom its velocities or what the
simulator takes as action. Following Tiboni et al. (2023), every measured signal is put on one uniform
time grid, ``dt`` being the simulator's step times ``frame_skip``, by an Akima spline, whose derivative is
the velocity; commands are held between their stamps. In this order:

1. known delays are taken off the time stamps, unknown ones estimated by cross-correlation first;
2. a zero-phase Butterworth low-pass filter takes the encoder noise off, which differentiation amplifies;
3. the splines are evaluated on the grid, between ``start`` and ``stop``;
4. the commands in force are looked up, averaged over the step, or inferred from the motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

import numpy as np
from scipy.interpolate import Akima1DInterpolator
from scipy.signal import butter, sosfiltfilt

from dropo_torch.data.recording import Recording, check_values, resolve_names
from dropo_torch.data.trajectory import Trajectories, concatenate
from dropo_torch.errors import InputError, choices

Actions = Literal["hold", "mean", "position", "velocity"]

_LEAST: dict[str, float | None] = {  # None: positive
    "dt": None,
    "cutoff": None,
    "max_delay": None,
    "max_gap": None,
    "start": 0.0,
    "stop": 0.0,
    "trim": 0.0,
}
_EDGE = 1e-3  # fraction of a step by which a stamp may lie behind the grid and still count for it
_GAP = 2.5  # steps, or sampling intervals, over which a signal is interpolated unless max_gap says otherwise
_LEAST_CORRELATION = 0.5


@dataclass(frozen=True, kw_only=True)
class Preprocess:
    """Options of :func:`preprocess`. A signal is named as in the column map; ``q`` means ``q[0]``, ``q[1]``, ... too.

    Attributes:
        dt: time step of the result in seconds: the simulator's step times ``frame_skip``.
        start: where the part that is used begins, in seconds since the episode's first sample.
        stop: where it ends; the end of the episode by default.
        cutoff: frequency in Hz above which the low-pass filter attenuates; no filter by default. It
            halves the amplitude there, so it should lie well above what the robot does (its control
            bandwidth) and below ``1 / (2 dt)``.
        order: order of the Butterworth filter, which runs forwards and backwards.
        trim: seconds left out at both ends of each episode, where the filter sees one side only; by
            default ``1 / cutoff``, and 0 without filter. 0 is right for a robot at rest there.
        positions: signals of the first columns of the result; by default every observation that is not in
            ``velocities``.
        velocities: signals that measure velocities, taken as the last columns; by default the velocities
            are derivatives of the positions. ``()`` for none.
        quaternions: groups of four of the positions that are a unit quaternion (w, x, y, z). Its derived
            velocity is the angular velocity in the body's frame, as in MuJoCo.
        actions: ``hold``: the command in force at the step's start; ``mean``: the mean of the commands in
            force during it; ``position`` or ``velocity``: what was measured at its end, which is what a
            robot that tracks its command closely was told.
        controlled: the positions whose ``position`` or ``velocity`` is the action; all by default.
        delays: signal → seconds by which it is stamped later than what it measures.
        align: signals whose delay against ``reference`` is estimated.
        reference: the signal that those are compared with.
        max_delay: largest delay, either way, that is considered, in seconds.
        max_gap: longest time without a sample in seconds that is interpolated; with it, NaN counts as no
            sample. By default a value must be finite and the longest gap is 2.5 steps or sampling intervals,
            whichever is longer.

    Raises:
        InputError: a value that makes no sense.
    """

    dt: float
    start: float | None = None
    stop: float | None = None
    cutoff: float | None = None
    order: int = 4
    trim: float | None = None
    positions: Sequence[str] | None = None
    velocities: Sequence[str] | None = None
    quaternions: Sequence[Sequence[str]] = ()
    actions: Actions = "hold"
    controlled: Sequence[str] = ()
    delays: Mapping[str, float] = field(default_factory=dict)
    align: Sequence[str] = ()
    reference: str | None = None
    max_delay: float = 0.1
    max_gap: float | None = None

    def __post_init__(self) -> None:
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value is not None or name in ("dt", "max_delay"):
                object.__setattr__(self, name, _number(value, name, least))
        if not isinstance(self.delays, Mapping):
            raise InputError(f"preprocess: delays is {self.delays!r}; expected signal: seconds")
        object.__setattr__(
            self, "delays", {str(k): _number(v, f"delays: {k}", -np.inf) for k, v in self.delays.items()}
        )
        for name in ("positions", "velocities", "controlled", "align"):
            object.__setattr__(self, name, _names(getattr(self, name), name))
        object.__setattr__(self, "quaternions", tuple(_names(q, "quaternions") for q in self.quaternions))
        if isinstance(self.order, bool) or not isinstance(self.order, int) or not 1 <= self.order <= 10:
            raise InputError(f"preprocess: order is {self.order!r}; expected a whole number from 1 to 10")
        if self.actions not in get_args(Actions):
            raise InputError(
                f"preprocess: actions: unknown kind {self.actions!r}{choices(self.actions, get_args(Actions))}"
            )
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise InputError(f"preprocess: stop is {self.stop:g} s and start {self.start:g} s; stop must be later")
        if bool(self.align) != (self.reference is not None):
            raise InputError(
                "preprocess: align and reference go together: signals to align, and the signal to align with"
            )
        if self.controlled and not self.infers_actions:
            raise InputError(f"preprocess: controlled has no meaning with actions: {self.actions}; leave it out")

    @property
    def infers_actions(self) -> bool:
        """Whether the actions come from the motion rather than from logged commands."""
        return self.actions in ("position", "velocity")

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Preprocess:
        """Read the ``preprocess`` entry of a config.

        Raises:
            InputError: an unknown key, a value that makes no sense, no ``dt``.
        """
        known = {f.name: f for f in fields(cls)}
        for key in mapping:
            if key not in known:
                raise InputError(f"preprocess: unknown key {key!r}{choices(key, known)}")
        if "dt" not in mapping:
            raise InputError(
                "preprocess: dt is missing; expected the simulator's time step times frame_skip, in seconds"
            )
        return cls(**mapping)


@dataclass(frozen=True)
class _Samples:
    """One signal's own samples, evenly spaced if it was filtered."""

    time: np.ndarray
    values: np.ndarray

    @property
    def spline(self) -> Akima1DInterpolator:
        return Akima1DInterpolator(self.time, self.values)


def preprocess(recording: Recording, options: Preprocess) -> Trajectories:
    """Return a recording as transitions ``dt`` apart, with observations ``[positions..., velocities...]``.

    Args:
        recording: samples in time, each episode of which is handled on its own.
        options: what to do.

    Raises:
        InputError: no time stamps, a missing value or too long a gap, a filter or delay that does not fit,
            a name that is not there, a part that holds no transition.
    """
    if recording.time is None:
        raise InputError(f"{recording.source}: preprocess needs time stamps; name their column with time, or give dt")
    if options.infers_actions and recording.action_names:
        raise InputError(
            f"{recording.source}: preprocess: actions: {options.actions} infers the actions from the motion, but the "
            f"log's actions are {', '.join(recording.action_names)}; leave one of both out"
        )
    if options.max_gap is None:
        for values, names in (
            (recording.observations, recording.observation_names),
            (recording.actions, recording.action_names),
        ):
            check_values(values, names, f"{recording.source}: preprocess without max_gap")
    delays = signal_delays(recording, options)
    logs = [
        _episode(replace(part, source=f"{recording.source}: episode {i}"), options, delays)
        for i, part in enumerate(recording.split())
    ]
    return replace(concatenate(logs), source=recording.source)


def signal_delays(recording: Recording, options: Preprocess) -> dict[str, float]:
    """Return the delay of each signal in seconds, as given or, the median over episodes, as estimated.

    Raises:
        InputError: a name that is not there, a signal that does not correlate with the reference.
    """
    names = recording.observation_names + recording.action_names
    delays: dict[str, float] = {}
    for name, delay in options.delays.items():
        delays |= dict.fromkeys(resolve_names([name], names, recording.source, "preprocess: delays"), delay)
    if options.reference is None:
        return delays
    known = delays.get(options.reference, 0.0)
    for name in resolve_names(options.align, names, recording.source, "preprocess: align"):
        if name in delays:
            raise InputError(f"{recording.source}: preprocess: {name} stands in both align and delays; leave one out")
        found = [
            estimate_delay(
                *_common_grid(part, options.reference, name),
                max_delay=options.max_delay,
                source=f"{recording.source}: {name} and {options.reference}",
            )
            for part in recording.split()
        ]
        delays[name] = known + float(np.median(found))
    return delays


def estimate_delay(
    reference: np.ndarray, signal: np.ndarray, dt: float, *, max_delay: float, source: str = "signal"
) -> float:
    """Return by how many seconds ``signal (N,)`` lags behind ``reference (N,)``, both sampled every ``dt``.

    The lag is where the correlation of the middle of the reference with the shifted signal peaks, and the
    vertex of the parabola through the three values around that peak gives the fraction of a sample.

    Raises:
        InputError: signals too short, no peak within ``max_delay``, or none worth the name.
    """
    most = int(np.ceil(max_delay / dt))
    middle = len(reference) - 2 * most
    if middle < max(2 * most, 8):
        raise InputError(
            f"{source}: {len(reference) * dt:.3g} s are too short to look for delays up to max_delay {max_delay:g} s; "
            "expected at least four times as long"
        )
    windows = np.lib.stride_tricks.sliding_window_view(signal, middle)
    centred = reference[most : most + middle] - reference[most : most + middle].mean()
    scale = windows.std(axis=1) * np.linalg.norm(centred) * np.sqrt(middle)
    correlation = np.divide(windows @ centred, scale, out=np.zeros(len(windows)), where=scale > 0)
    peak = int(correlation.argmax())
    if correlation[peak] < _LEAST_CORRELATION:
        raise InputError(
            f"{source}: no delay can be estimated: their correlation is {correlation[peak]:.2f} at best, at least "
            f"{_LEAST_CORRELATION} is needed; give the delay by delays"
        )
    if peak in (0, len(correlation) - 1):
        raise InputError(
            f"{source}: no delay within {max_delay:g} s: the correlation still rises there; raise max_delay"
        )
    left, top, right = correlation[peak - 1 : peak + 2]
    return float((peak - most + 0.5 * (left - right) / (left - 2 * top + right)) * dt)


def _common_grid(part: Recording, reference: str, name: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Two signals on one even grid at the faster one's sampling interval, and that interval."""
    splines, stamps = [], []
    for label in (reference, name):
        samples = _samples(part, label)
        stamps.append(samples.time)
        splines.append(samples.spline)
    dt = float(min(np.median(np.diff(time)) for time in stamps))
    low, high = max(time[0] for time in stamps), min(time[-1] for time in stamps)
    grid = low + dt * np.arange(int((high - low) / dt + _EDGE) + 1)
    grid = grid[grid <= high]
    return splines[0](grid), splines[1](grid), dt


def _episode(part: Recording, options: Preprocess, delays: Mapping[str, float]) -> Trajectories:
    positions, velocities = _measured(part, options)
    quaternions = _quaternions(options, positions, part.source)
    signals = {name: _samples(part, name, delays.get(name, 0.0)) for name in positions + velocities}
    for quaternion in quaternions:
        signals |= _continuous({name: signals[name] for name in quaternion}, part.source)
    for name, samples in signals.items():
        _check_gaps(samples, f"{part.source}: {name}", options)
    if options.cutoff is not None:
        signals = {name: _filtered(s, options, f"{part.source}: {name}") for name, s in signals.items()}
    grid = _grid(part, options, [s.time for s in signals.values()], delays)
    position, velocity, velocity_names = _motion(signals, positions, velocities, quaternions, grid, options)
    if options.actions == "position":
        actions = _controlled(position, positions, options, part.source)[1:]
    elif options.actions == "velocity":
        actions = _controlled(velocity, velocity_names, options, part.source)[1:]
    else:
        actions = _commands(part, grid[:-1], options, delays)
    observations = np.concatenate([position, velocity], axis=1)
    return Trajectories(
        observations=observations[:-1],
        next_observations=observations[1:],
        actions=actions,
        terminals=np.arange(2, len(grid) + 1) == len(grid),
        dt=options.dt,
        source=part.source,
    )


def _measured(part: Recording, options: Preprocess) -> tuple[list[str], list[str]]:
    """The signals that are positions, and those that are velocities."""
    names = part.observation_names
    velocities = resolve_names(options.velocities or (), names, part.source, "preprocess: velocities")
    wanted = options.positions
    if wanted is None:
        wanted = [name for name in names if name not in velocities]
    return resolve_names(wanted, names, part.source, "preprocess: positions"), velocities


def _samples(part: Recording, name: str, delay: float = 0.0) -> _Samples:
    """A signal's samples at the times of what they measure; NaN counts as none."""
    assert part.time is not None
    values = part.signal(name)
    present = ~np.isnan(values)
    if present.sum() < 2:
        raise InputError(f"{part.source}: {name} has {present.sum()} samples; at least two are needed")
    return _Samples(time=part.time[present] - part.time[0] - delay, values=values[present])


def _check_gaps(samples: _Samples, where: str, options: Preprocess) -> None:
    steps = np.diff(samples.time)
    most = _GAP * max(options.dt, float(np.median(steps))) if options.max_gap is None else options.max_gap
    longest = int(steps.argmax())
    if steps[longest] > most:
        raise InputError(
            f"{where} has no sample for {steps[longest]:.4g} s from {samples.time[longest]:.6g} s on, and at most "
            f"{most:.4g} s are interpolated; raise max_gap, or make two episodes of it"
        )


def _filtered(samples: _Samples, options: Preprocess, where: str) -> _Samples:
    """The samples, put on an even grid at their own rate, through the zero-phase low-pass filter."""
    first, last = samples.time[0], samples.time[-1]
    count = round((last - first) / float(np.median(np.diff(samples.time)))) + 1
    rate = (count - 1) / (last - first)
    assert options.cutoff is not None
    if options.cutoff >= rate / 2:
        raise InputError(
            f"{where}: cutoff is {options.cutoff:g} Hz, but the signal is sampled at {rate:.4g} Hz; "
            f"cutoff must lie below half of that, {rate / 2:.4g} Hz"
        )
    pad = int(np.ceil(2 * options.order * rate / options.cutoff))
    time = np.linspace(first, last, count)
    sections = butter(options.order, options.cutoff, fs=rate, output="sos")
    values = sosfiltfilt(sections, samples.spline(time), padlen=min(pad, count - 1))
    return _Samples(time=time, values=values)


def _grid(
    part: Recording, options: Preprocess, stamps: Sequence[np.ndarray], delays: Mapping[str, float]
) -> np.ndarray:
    """The result's times: where every signal has samples, within start and stop."""
    assert part.time is not None
    length = float(part.time[-1] - part.time[0])
    trim = 1 / options.cutoff if options.cutoff is not None and options.trim is None else options.trim or 0.0
    early = [delays.get(name, 0.0) for name in part.action_names]
    low = max([time[0] + trim for time in stamps] + [-delay for delay in early] + [options.start or 0.0])
    high = min([time[-1] - trim for time in stamps] + [length - delay for delay in early])
    if options.stop is not None:
        high = min(high, options.stop)
    steps = int(np.floor((high - low) / options.dt + _EDGE)) if high > low else 0
    if steps < 1:
        raise InputError(
            f"{part.source}: preprocess leaves no transition of {options.dt:g} s: the recording lasts {length:.4g} s "
            f"and {low:.4g} s to {high:.4g} s of it are used; see start, stop, trim and delays"
        )
    return low + options.dt * np.arange(steps + 1)


def _quaternions(options: Preprocess, positions: Sequence[str], source: str) -> list[list[str]]:
    groups = []
    for quaternion in options.quaternions:
        group = resolve_names(quaternion, positions, source, "preprocess: quaternions")
        if len(set(group)) != 4:
            raise InputError(f"{source}: preprocess: quaternions: {', '.join(group)}: expected four different signals")
        groups.append(group)
    return groups


def _continuous(quaternion: Mapping[str, _Samples], source: str) -> dict[str, _Samples]:
    """The four components with signs by which no sample lies opposite to the one before it."""
    names, parts = list(quaternion), list(quaternion.values())
    if any(not np.array_equal(part.time, parts[0].time) for part in parts):
        raise InputError(
            f"{source}: preprocess: quaternions: {', '.join(names)} need samples at the same times and one delay"
        )
    values = np.stack([part.values for part in parts], axis=1)
    norm = np.linalg.norm(values, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > 0.1)
    if bad.size:
        raise InputError(
            f"{source}: preprocess: quaternions: {', '.join(names)} has length {norm[bad[0]]:.3g} at sample {bad[0]}; "
            "a unit quaternion (w, x, y, z) is expected"
        )
    flips = np.where((values[1:] * values[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    values = values * np.cumprod(np.append(1.0, flips))[:, None]
    return {name: replace(part, values=values[:, i]) for i, (name, part) in enumerate(quaternion.items())}


def _motion(
    signals: Mapping[str, _Samples],
    positions: Sequence[str],
    velocities: Sequence[str],
    quaternions: Sequence[Sequence[str]],
    grid: np.ndarray,
    options: Preprocess,
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Positions ``(N, p)`` and velocities ``(N, v)`` on the grid, and the velocities' names."""
    position = {name: signals[name].spline(grid, extrapolate=True) for name in positions}
    slope = {name: signals[name].spline(grid, nu=1, extrapolate=True) for name in positions}
    derived = {name: slope[name] for name in positions}
    for group in quaternions:
        components = np.stack([position[name] for name in group], axis=1)
        angular = _angular_velocity(components, np.stack([slope[name] for name in group], axis=1))
        components = components / np.linalg.norm(components, axis=1, keepdims=True)
        position |= dict(zip(group, components.T, strict=True))
        columns = {f"{group[0]}.angular[{axis}]": angular[:, axis] for axis in range(3)}
        derived = _replaced(derived, group, columns)
    if options.velocities is not None:
        derived = {name: signals[name].spline(grid, extrapolate=True) for name in velocities}
    return _columns(position, len(grid)), _columns(derived, len(grid)), list(derived)


def _angular_velocity(quaternion: np.ndarray, derivative: np.ndarray) -> np.ndarray:
    """Angular velocity in the body's frame ``(N, 3)``: twice the vector part of ``q⁻¹ q̇``."""
    w, v = quaternion[:, :1], quaternion[:, 1:]
    dw, dv = derivative[:, :1], derivative[:, 1:]
    return np.asarray(2 * (w * dv - dw * v - np.cross(v, dv)) / (quaternion**2).sum(axis=1, keepdims=True))


def _replaced(
    columns: Mapping[str, np.ndarray], group: Sequence[str], new: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """``columns`` with ``new`` where the first of ``group`` stood, and without the rest of it."""
    first = next(name for name in columns if name in group)
    result: dict[str, np.ndarray] = {}
    for name, values in columns.items():
        if name == first:
            result |= new
        elif name not in group:
            result[name] = values
    return result


def _columns(columns: Mapping[str, np.ndarray], rows: int) -> np.ndarray:
    return np.stack(list(columns.values()), axis=1) if columns else np.empty((rows, 0))


def _controlled(values: np.ndarray, names: Sequence[str], options: Preprocess, source: str) -> np.ndarray:
    if not options.controlled:
        return values
    wanted = resolve_names(options.controlled, names, source, "preprocess: controlled")
    return values[:, [list(names).index(name) for name in wanted]]


def _commands(part: Recording, begin: np.ndarray, options: Preprocess, delays: Mapping[str, float]) -> np.ndarray:
    """The commands of the steps that begin at the given times, ``(T, m)``."""
    columns = {}
    for name in part.action_names:
        samples = _samples(part, name, delays.get(name, 0.0))
        if samples.time[0] > begin[0] + _EDGE * options.dt:
            raise InputError(
                f"{part.source}: {name} has no sample before {samples.time[0]:.6g} s; use start from there on"
            )
        columns[name] = (
            _mean(samples, begin, options.dt) if options.actions == "mean" else _hold(samples, begin, options.dt)
        )
    return _columns(columns, len(begin))


def _hold(samples: _Samples, begin: np.ndarray, dt: float) -> np.ndarray:
    return samples.values[np.searchsorted(samples.time, begin + _EDGE * dt, side="right") - 1]


def _mean(samples: _Samples, begin: np.ndarray, dt: float) -> np.ndarray:
    """Mean over each step of the commands, each in force until the next one."""
    time = np.append(samples.time, max(begin[-1] + dt, samples.time[-1]) + dt)
    integral = np.append(0.0, np.cumsum(samples.values * np.diff(time)))
    return (np.interp(begin + dt, time, integral) - np.interp(begin, time, integral)) / dt


def _number(value: object, name: str, least: float | None) -> float:
    """A number that is at least ``least``, or positive (also where YAML reads ``1e-3`` as text)."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = float("nan")
    fits = number > 0 if least is None else number >= least
    if isinstance(value, bool) or not np.isfinite(number) or not fits:
        wanted = "a positive number" if least is None else "a finite number" if least < 0 else "0 or a positive number"
        raise InputError(f"preprocess: {name} is {value!r}; expected {wanted}")
    return number


def _names(value: object, what: str) -> tuple[str, ...] | None:
    if value is None:
        return None
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise InputError(f"preprocess: {what} is {value!r}; expected a list of signals")
    return tuple(str(name) for name in value)
