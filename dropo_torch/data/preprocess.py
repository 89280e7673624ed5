"""From a raw recording to transitions: synchronize, filter, resample, differentiate, infer commands.

The sensors of a real robot report at times of their own, and seldom its velocities or what the
simulator takes as action. Following Tiboni et al. (2023), every measured signal is put on one uniform
time grid, ``dt`` being the simulator's step times ``frame_skip``, by an Akima spline, whose derivative is
the velocity; commands are held between their stamps. In this order:

1. known delays are taken off the time stamps, unknown ones, of signals or clocks, estimated by cross-correlation first;
2. a zero-phase Butterworth low-pass filter takes the encoder noise off, which differentiation amplifies;
3. the splines are evaluated on the grid, between ``start`` and ``stop``;
4. the commands in force are looked up, averaged over the step, or inferred from the motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from dropo_torch.data.recording import Recording, resolve_names
from dropo_torch.data.ticks import Ticks, find_ticks
from dropo_torch.data.trajectory import Origin, Trajectories, check_values, concatenate
from dropo_torch.errors import InputError, choices
from dropo_torch.support.given import check_keys, number

if TYPE_CHECKING:
    from scipy.interpolate import Akima1DInterpolator

Actions = Literal["hold", "mean", "position", "velocity"]

_EDGE = 1e-3  # fraction of a step by which a stamp may lie behind the grid and still count for it
_MISSING = 1.7  # usual sampling intervals between two samples from among which one is missing
_BENT, _TELLING = 8, 1000  # samples of which a spline's noise is known, at least, and those that tell it, at most
_DRAWS, _SEED = 8, 3  # of noise
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
            default ``1 / cutoff``, and 0 without filter; with ``derive``, in whole steps. 0 is right for a robot
            at rest there.
        positions: signals of the first columns of the result; by default every observation that is not in
            ``velocities``.
        velocities: signals that measure velocities, taken as the last columns; by default the velocities
            are derivatives of the positions. ``()`` for none.
        derive: positions whose velocities are derived although others are measured: ``[positions..., derived...,
            velocities...]``. Derivatives alone are then filtered.
        quaternions: groups of four of the positions that are a unit quaternion (w, x, y, z); by default those that
            the log itself says, as bags do. Its derived
            velocity is the angular velocity in the body's frame, as in MuJoCo.
        actions: ``hold``: the command in force at the step's start; ``mean``: the mean of the commands in
            force during it; ``position`` or ``velocity``: what was measured at its end, which is what a
            robot that tracks its command closely was told.
        command_clock: whether commands change by a clock of the controller that is not that of the rows; each change is
            then put back from the row that tells it to the tick at which it was.
        controlled: the positions whose ``position`` or ``velocity`` is the action; all by default.
        delays: signal → seconds by which it is stamped later than what it measures.
        align: signals whose delay against ``reference`` is estimated.
        reference: the signal that those are compared with.
        same_clock: signals stamped by the clock of those in ``align``: all of these then have one delay, the mean.
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
    derive: Sequence[str] = ()
    quaternions: Sequence[Sequence[str]] = ()
    actions: Actions = "hold"
    command_clock: bool = False
    controlled: Sequence[str] = ()
    delays: Mapping[str, float] = field(default_factory=dict)
    align: Sequence[str] = ()
    reference: str | None = None
    same_clock: Sequence[str] = ()
    max_delay: float = 0.1
    max_gap: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.delays, Mapping):
            raise InputError(f"preprocess: delays is {self.delays!r}; expected signal: seconds")
        checked: dict[str, Any] = {
            "delays": {str(name): number(delay, f"preprocess: delays: {name}") for name, delay in self.delays.items()},
            "quaternions": tuple(_names(group, "quaternions") for group in self.quaternions),
        }
        for name in ("dt", "max_delay", "cutoff", "max_gap", "start", "stop", "trim"):
            value, bound = getattr(self, name), "least" if name in ("start", "stop", "trim") else "above"
            if value is not None or name in ("dt", "max_delay"):
                checked[name] = number(value, f"preprocess: {name}", **{bound: 0})
        for name in ("positions", "velocities", "derive", "controlled", "align", "same_clock"):
            checked[name] = _names(getattr(self, name), name)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if isinstance(self.order, bool) or not isinstance(self.order, int) or not 1 <= self.order <= 10:
            raise InputError(f"preprocess: order is {self.order!r}; expected a whole number from 1 to 10")
        if self.actions not in get_args(Actions):
            raise InputError(
                f"preprocess: actions: unknown kind {self.actions!r}{choices(self.actions, get_args(Actions))}"
            )
        if not isinstance(self.command_clock, bool):
            raise InputError(f"preprocess: command_clock is {self.command_clock!r}; expected true or false")
        if self.command_clock and self.infers_actions:
            raise InputError(f"preprocess: command_clock has no meaning with actions: {self.actions}; leave it out")
        if self.derive and self.velocities is None:
            raise InputError("preprocess: derive has no meaning without velocities, as all are derived; leave it out")
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise InputError(f"preprocess: stop is {self.stop:g} s and start {self.start:g} s; stop must be later")
        if bool(self.align) != (self.reference is not None):
            raise InputError(
                "preprocess: align and reference go together: signals to align, and the signal to align with"
            )
        if self.same_clock and not self.align:
            raise InputError("preprocess: same_clock needs align: signals by which that clock is compared with another")
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
        check_keys(mapping, [field.name for field in fields(cls)], "preprocess")
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
    filtered: bool = False

    @property
    def spline(self) -> Akima1DInterpolator:
        from scipy.interpolate import Akima1DInterpolator  # heavy, and most logs need none

        return Akima1DInterpolator(self.time, self.values)

    def gain(self, times: np.ndarray) -> np.ndarray:
        """Return the noise of the spline at some times relative to that of a sample, ``(N,)``; 1 where filtered.

        Midway between two samples it is least. How low, depends on whether the signal or its noise bends the spline
        more, which draws of noise show.
        """
        if self.filtered or len(self.time) < _BENT:
            return np.ones(len(times))
        after = np.clip(np.searchsorted(self.time, times, side="right"), 1, len(self.time) - 1)
        begin, end = self.time[after - 1], self.time[after]
        share = np.clip((times - begin) / (end - begin), 0.0, 1.0)
        return np.sqrt(1 - (1 - self._middle_gain**2) * (4 * share * (1 - share)) ** 2)

    @cached_property
    def _middle_gain(self) -> float:
        """The noise of the spline midway between samples, relative to that of these."""
        few = _Samples(self.time[:_TELLING], self.values[:_TELLING])
        noise = few._noise
        if not noise > 0:
            return 1.0
        middle = 0.5 * (few.time[1:] + few.time[:-1])[1:-1]
        draws = noise * np.random.default_rng(_SEED).standard_normal((_DRAWS, len(few.time)))
        moved = [_Samples(few.time, few.values + draw).spline(middle) for draw in draws]
        return min(float(np.std(np.array(moved) - few.spline(middle)) / noise), 1.0)

    @property
    def _noise(self) -> float:
        """The noise of the samples, by how far each lies from the cubic through the four about it."""
        around = np.delete(np.lib.stride_tricks.sliding_window_view(np.arange(len(self.time)), 5), 2, axis=1)
        times = self.time[around] - self.time[2:-2, None]
        weights = np.stack(
            [np.prod([times[:, k] / (times[:, k] - times[:, j]) for k in range(4) if k != j], 0) for j in range(4)],
            axis=1,
        )
        away = self.values[2:-2] - (weights * self.values[around]).sum(1)
        return float(np.sqrt(np.mean(away**2 / (1 + (weights**2).sum(1)))))

    @property
    def filled(self) -> _Samples:
        """These samples, and between two of them from among which some are missing others, interpolated."""
        steps = np.diff(self.time)
        usual = float(np.median(steps))
        holes = np.flatnonzero(steps > _MISSING * usual)
        if not holes.size:
            return self
        lost = [np.linspace(self.time[i], self.time[i + 1], round(steps[i] / usual) + 1)[1:-1] for i in holes]
        time = np.sort(np.concatenate([self.time, *lost]))
        return _Samples(time, self.spline(time))


class _TooShort(InputError):
    """An episode that holds no transition."""


def preprocess(recording: Recording, options: Preprocess) -> Trajectories:
    """Return a recording as transitions ``dt`` apart, with observations ``[positions..., velocities...]``.

    Args:
        recording: samples in time, each episode of which is handled on its own.
        options: what to do.

    What pauses leave of an episode may be too short for a transition: it is left out.

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
    if options.max_gap is None and not recording.sparse:
        where = f"{recording.source}: preprocess without max_gap"
        check_values(recording.observations, recording.observation_names, where)
        check_values(recording.actions, recording.action_names, where)
    delays = signal_delays(recording, options)
    logs, scraps = [], []
    for i, part in enumerate(recording.split()):
        try:
            logs.append(
                _Episode(replace(part, source=f"{recording.source}: episode {i}"), options, delays).transitions()
            )
        except _TooShort as error:
            scraps.append(error)
    if scraps and not (recording.cut and logs):
        raise scraps[0]
    return replace(concatenate(logs), source=recording.source)


def signal_delays(recording: Recording, options: Preprocess) -> dict[str, float]:
    """Return the delay of each signal in seconds, as given or, the median over episodes, as estimated.

    Raises:
        InputError: a name that is not there, a signal that does not correlate with the reference.
    """
    names, where = recording.names, f"{recording.source}: preprocess"
    delays: dict[str, float] = {}
    for name, delay in options.delays.items():
        delays |= dict.fromkeys(resolve_names([name], names, f"{where}: delays"), delay)
    if options.reference is None:
        return delays
    known = delays.get(options.reference, 0.0)
    align = resolve_names(options.align, names, f"{where}: align")
    alike = resolve_names(options.same_clock, names, f"{where}: same_clock")
    found: dict[str, float] = {}
    for name in (*align, *alike):
        if name in delays or name == options.reference:
            keys = "align" if name in align else "same_clock", "delays" if name in delays else "reference"
            raise InputError(f"{where}: {name} stands in both {' and '.join(keys)}; leave one out")
    for name in align:
        lags = [_lag(part, options.reference, name, options.max_delay) for part in recording.split()]
        found[name] = known + float(np.median(lags))
    if alike:
        found = dict.fromkeys([*align, *alike], float(np.mean(list(found.values()))))
    return delays | found


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
    centered = reference[most : most + middle] - reference[most : most + middle].mean()
    scale = windows.std(axis=1) * np.linalg.norm(centered) * np.sqrt(middle)
    correlation = np.divide(windows @ centered, scale, out=np.zeros(len(windows)), where=scale > 0)
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


def _lag(part: Recording, reference: str, name: str, max_delay: float) -> float:
    """Seconds by which a signal lags behind another, both on one even grid at the faster one's sampling interval."""
    first, second = (_samples(part, label) for label in (reference, name))
    dt = float(min(np.median(np.diff(s.time)) for s in (first, second)))
    low, high = max(first.time[0], second.time[0]), min(first.time[-1], second.time[-1])
    grid = low + dt * np.arange(int((high - low) / dt + _EDGE) + 1)
    grid = grid[grid <= high]
    source = f"{part.source}: {name} and {reference}"
    return estimate_delay(first.spline(grid), second.spline(grid), dt, max_delay=max_delay, source=source)


def _samples(part: Recording, name: str, delay: float = 0.0, least: int = 2) -> _Samples:
    """A signal's samples at the times of what they measure; NaN counts as none."""
    assert part.time is not None
    values = part.signal(name)
    present = ~np.isnan(values)
    if present.sum() < least:
        raise _TooShort(f"{part.source}: {name} has {present.sum()} samples; at least {least} are needed")
    return _Samples(time=part.time[present] - part.time[0] - delay, values=values[present])


@dataclass(frozen=True)
class _Episode:
    """An episode on its way from samples to transitions."""

    part: Recording
    options: Preprocess
    delays: Mapping[str, float]

    def transitions(self) -> Trajectories:
        names, given = self.part.observation_names, self.options.positions
        velocities = self._resolve("velocities", self.options.velocities or (), names)
        positions = self._resolve(
            "positions", [n for n in names if n not in velocities] if given is None else given, names
        )
        groups = self.options.quaternions or [g for g in self.part.quaternions if set(g) <= set(positions)]
        quaternions = [self._resolve("quaternions", group, positions) for group in groups]
        signals = {name: _samples(self.part, name, self.delays.get(name, 0.0)) for name in positions + velocities}
        for group in quaternions:
            signals |= self._continuous(group, signals)
        for name, samples in signals.items():
            self._check_gaps(name, samples)
        derive, smooth = self._resolve("derive", self.options.derive, positions), signals
        if self.options.cutoff is not None:
            noisy = derive or list(signals)
            smooth = signals | {name: self._filtered(name, signals[name], self.options.cutoff) for name in noisy}
            signals = signals if derive else smooth
        grid = self._grid(list(signals.values()))
        position = {name: signals[name].spline(grid, extrapolate=True) for name in positions}
        if self.options.velocities is not None:
            slope = {name: smooth[name].spline(grid, nu=1, extrapolate=True) for name in derive}
            velocity = _velocities(position, slope, quaternions)
            velocity |= {name: signals[name].spline(grid, extrapolate=True) for name in velocities}
        else:
            slope = {name: signals[name].spline(grid, nu=1, extrapolate=True) for name in positions}
            velocity = _velocities(position, slope, quaternions)
        for group in quaternions:
            norm = np.linalg.norm([position[name] for name in group], axis=0)
            position |= {name: position[name] / norm for name in group}
        if self.options.infers_actions:  # what was measured at each step's end
            motion = position if self.options.actions == "position" else velocity
            controlled = self._resolve("controlled", self.options.controlled or list(motion), list(motion))
            actions = {name: motion[name][1:] for name in controlled}
        else:
            actions = {name: self._commands(name, grid[:-1]) for name in self.part.action_names}
        observations = np.stack([*position.values(), *velocity.values()], axis=1)
        commands = np.stack(list(actions.values()), axis=1) if actions else np.empty((len(grid) - 1, 0))
        log = Trajectories.of_samples(observations, commands, dt=self.options.dt, source=self.part.source)
        sampled = [signals[name] for name in position] + [signals[n] if n in velocities else None for n in velocity]
        origin = Origin((*position, *velocity), tuple(actions))
        slopes = tuple(len(position) + i for i, name in enumerate(velocity) if name not in velocities)
        return replace(log, origin=origin, gains=self._gains(sampled, grid), slopes=slopes)

    def _gains(self, interpolated: Sequence[_Samples | None], grid: np.ndarray) -> np.ndarray | None:
        """Noise of columns before and after each transition, relative to a sample's ``(T, 2, n)``, if it is another."""
        ones = np.ones(len(grid))
        gain = np.stack([ones if samples is None else samples.gain(grid) for samples in interpolated], axis=1)
        return None if np.allclose(gain, 1.0, atol=_EDGE) else np.stack([gain[:-1], gain[1:]], axis=1)

    def _resolve(self, key: str, wanted: Sequence[str], names: Sequence[str]) -> list[str]:
        return resolve_names(wanted, names, f"{self.part.source}: preprocess: {key}")

    def _continuous(self, group: Sequence[str], signals: Mapping[str, _Samples]) -> dict[str, _Samples]:
        """The four components with signs by which no sample lies opposite to the one before it."""
        where = f"{self.part.source}: preprocess: quaternions: {', '.join(group)}"
        if len(set(group)) != 4:
            raise InputError(f"{where}: expected four different signals")
        parts = [signals[name] for name in group]
        if any(not np.array_equal(part.time, parts[0].time) for part in parts):
            raise InputError(f"{where} need samples at the same times and one delay")
        values = np.stack([part.values for part in parts], axis=1)
        norm = np.linalg.norm(values, axis=1)
        bad = np.flatnonzero(np.abs(norm - 1) > 0.1)
        if bad.size:
            raise InputError(
                f"{where} has length {norm[bad[0]]:.3g} at sample {bad[0]}; a unit quaternion (w, x, y, z) is expected"
            )
        flips = np.where((values[1:] * values[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        values = values * np.cumprod(np.append(1.0, flips))[:, None]
        return {name: _Samples(parts[0].time, values[:, i]) for i, name in enumerate(group)}

    def _check_gaps(self, name: str, samples: _Samples) -> None:
        steps, most = np.diff(samples.time), self.options.max_gap
        if most is None:
            most = _GAP * max(self.options.dt, float(np.median(steps)))
        longest = int(steps.argmax())
        if steps[longest] > most:
            raise InputError(
                f"{self.part.source}: {name} has no sample for {steps[longest]:.4g} s from {samples.time[longest]:.6g} "
                f"s on, and at most {most:.4g} s are interpolated; raise max_gap, or begin an episode there "
                "with data: pause"
            )

    def _filtered(self, name: str, samples: _Samples, cutoff: float) -> _Samples:
        """The samples, put on an even grid at their own rate, through the zero-phase low-pass filter."""
        from scipy.signal import butter, sosfiltfilt

        first, last = samples.time[0], samples.time[-1]
        count = round((last - first) / float(np.median(np.diff(samples.time)))) + 1
        rate = (count - 1) / (last - first)
        if cutoff >= rate / 2:
            raise InputError(
                f"{self.part.source}: {name}: cutoff is {cutoff:g} Hz, but the signal is sampled at {rate:.4g} Hz; "
                f"cutoff must lie below half of that, {rate / 2:.4g} Hz"
            )
        pad = int(np.ceil(2 * self.options.order * rate / cutoff))
        time = np.linspace(first, last, count)
        sections = butter(self.options.order, cutoff, fs=rate, output="sos")
        values = sosfiltfilt(sections, samples.spline(time), padlen=min(pad, count - 1))
        return _Samples(time, values, filtered=True)

    def _grid(self, signals: Sequence[_Samples]) -> np.ndarray:
        """The result's times: where every signal has samples, within start and stop."""
        assert self.part.time is not None
        options, length = self.options, float(self.part.time[-1] - self.part.time[0])
        trim = 1 / options.cutoff if options.cutoff is not None and options.trim is None else options.trim or 0.0
        if options.derive:  # positions are not filtered: samples that are dt apart stay as they are
            trim = float(np.ceil(trim / options.dt - _EDGE)) * options.dt
        early = [self.delays.get(name, 0.0) for name in self.part.action_names]
        low = max([s.time[0] + trim for s in signals] + [-delay for delay in early] + [options.start or 0.0])
        if self.part.sparse:  # as every signal, commands begin with their first sample
            low = max([low, *(self._command(name).time[0] for name in self.part.action_names)])
        stop = np.inf if options.stop is None else options.stop
        high = min([s.time[-1] - trim for s in signals] + [length - delay for delay in early] + [stop])
        steps = int(np.floor((high - low) / options.dt + _EDGE)) if high > low else 0
        if steps < 1:
            raise _TooShort(
                f"{self.part.source}: preprocess leaves no transition of {options.dt:g} s: the recording lasts "
                f"{length:.4g} s and {low:.4g} s to {high:.4g} s of it are used; see start, stop, trim and delays"
            )
        return low + options.dt * np.arange(steps + 1)

    def _command(self, name: str) -> _Samples:
        """The samples of a command; of a stream, a single one holds from then on."""
        delay = self.delays.get(name, 0.0)
        samples = _samples(self.part, name, delay, least=1 if self.part.sparse else 2)
        if not self.options.command_clock:
            return samples if self.part.sparse else samples.filled
        return replace(samples, time=self._ticks.put_back(samples.time + delay) - delay)

    @cached_property
    def _ticks(self) -> Ticks:
        """The clock by which commands change."""
        part, where = self.part, f"{self.part.source}: preprocess: command_clock"
        assert part.time is not None
        if part.sparse:
            raise InputError(f"{where}: commands have time stamps of their own here; leave it out")
        commands = np.stack([part.signal(name) for name in part.action_names], axis=1)
        if np.isnan(commands).any():
            raise InputError(f"{where}: a command has no value in some rows; give them all one, or leave it out")
        if (ticks := find_ticks(part.time - part.time[0], commands)) is None:
            raise InputError(f"{where}: commands do not change by a clock that is not that of the rows; leave it out")
        return ticks

    def _commands(self, name: str, begin: np.ndarray) -> np.ndarray:
        """A command in the steps that begin at the given times, ``(T,)``: in force then, or the mean of each step."""
        samples, dt = self._command(name), self.options.dt
        if samples.time[0] > begin[0] + _EDGE * dt:
            raise InputError(
                f"{self.part.source}: {name} has no sample before {samples.time[0]:.6g} s; use start from there on"
            )
        if self.options.actions == "hold":
            return samples.values[np.searchsorted(samples.time, begin + _EDGE * dt, side="right") - 1]
        time = np.append(samples.time, max(begin[-1] + dt, samples.time[-1]) + dt)
        integral = np.append(0.0, np.cumsum(samples.values * np.diff(time)))
        return (np.interp(begin + dt, time, integral) - np.interp(begin, time, integral)) / dt


def _velocities(
    position: Mapping[str, np.ndarray], slope: Mapping[str, np.ndarray], quaternions: Sequence[Sequence[str]]
) -> dict[str, np.ndarray]:
    """The derivatives of positions; in place of a quaternion's, its angular velocity."""
    velocity: dict[str, np.ndarray] = {}
    for name, values in slope.items():
        group = next((group for group in quaternions if name in group), None)
        if group is None:
            velocity[name] = values
        elif f"{group[0]}.angular[0]" not in velocity:  # in the body's frame: twice the vector part of q⁻¹ q̇
            quaternion, derivative = (np.stack([of[n] for n in group], axis=1) for of in (position, slope))
            w, v, dw, dv = quaternion[:, :1], quaternion[:, 1:], derivative[:, :1], derivative[:, 1:]
            angular = 2 * (w * dv - dw * v - np.cross(v, dv)) / (quaternion**2).sum(axis=1, keepdims=True)
            velocity |= {f"{group[0]}.angular[{axis}]": angular[:, axis] for axis in range(3)}
    return velocity


def _names(value: object, what: str) -> tuple[str, ...] | None:
    if value is None:
        return None
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise InputError(f"preprocess: {what} is {value!r}; expected a list of signals")
    return tuple(str(name) for name in value)
