"""Laws of the preprocessing: what must come back from signals whose derivative, delay or command is known."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dropo_torch.data.preprocess import Preprocess, estimate_delay, preprocess, signal_delays
from dropo_torch.data.readers import read_trajectories
from dropo_torch.data.recording import Recording
from dropo_torch.errors import InputError


def recording(time, observations, actions=None, episodes=None):
    """A recording of named signals."""
    time = np.asarray(time, dtype=float)
    actions = {} if actions is None else actions
    table = lambda columns: np.stack(list(columns.values()), axis=1) if columns else np.empty((len(time), 0))  # noqa: E731
    return Recording(
        observations=table(observations),
        actions=table(actions),
        time=time,
        episodes=np.zeros(len(time), dtype=int) if episodes is None else episodes,
        observation_names=tuple(observations),
        action_names=tuple(actions),
        source="test",
    )


TIME = np.arange(0, 2.0005, 0.001)
SINE = np.sin(2 * np.pi * TIME)


def sine_recording(**observations):
    return recording(TIME, {"q": SINE, **observations}, {"u": np.floor(TIME * 100 + 1e-6)})


# -- resampling and differentiation ---------------------------------------------------------------


@given(
    slope=st.floats(-5, 5),
    intercept=st.floats(-5, 5),
    dt=st.floats(0.01, 0.2),
    jitter=st.floats(0, 0.9),
    epoch=st.sampled_from([0.0, -3.5, 1.7e9]),
)
def test_a_straight_line_is_resampled_and_differentiated_exactly(slope, intercept, dt, jitter, epoch):
    steps = 0.01 * (1 + jitter * np.random.default_rng(0).uniform(-1, 1, 200))
    time = np.cumsum(steps)
    out = preprocess(recording(epoch + time, {"q": intercept + slope * (time - time[0])}), Preprocess(dt=dt))
    at = dt * np.arange(len(out) + 1)
    np.testing.assert_allclose(out.observations[:, 0], intercept + slope * at[:-1], atol=1e-4 if epoch > 1 else 1e-9)
    np.testing.assert_allclose(
        out.next_observations[:, 0], intercept + slope * at[1:], atol=1e-4 if epoch > 1 else 1e-9
    )
    np.testing.assert_allclose(out.observations[:, 1], slope, atol=5e-3 if epoch > 1 else 1e-9)
    assert out.dt == dt
    assert at[-1] <= time[-1] - time[0] + 1e-3 * dt < at[-1] + dt


def test_samples_on_the_grid_come_back_exactly():
    values = np.random.default_rng(0).normal(size=len(TIME))
    out = preprocess(recording(TIME, {"q": values}), Preprocess(dt=0.004))
    np.testing.assert_allclose(out.observations[:, 0], values[:-1:4], atol=1e-9)


@pytest.mark.parametrize("noise", [0.3, 1e-3, 1e-5])
@pytest.mark.parametrize("drift", [0.0, 1e-3, 0.4])
def test_what_lies_between_samples_has_the_noise_that_is_told(noise, drift):
    time = 0.01 * (1 + drift / 4) * np.arange(4000)
    time = time + drift * 0.004 * np.random.default_rng(1).uniform(-1, 1, 4000)
    motion = np.sin(2 * np.pi * time)
    known = preprocess(recording(time, {"q": motion, "dq": motion}), Preprocess(dt=0.01, velocities=["dq"]))
    draws = noise * np.random.default_rng(2).standard_normal((2, 4000))
    log = preprocess(
        recording(time, {"q": motion + draws[0], "dq": motion + draws[1]}), Preprocess(dt=0.01, velocities=["dq"])
    )
    if drift == 0:
        assert log.gains is None
        return
    error = (log.observations - known.observations) / noise
    gains = log.gains[:, 0]
    np.testing.assert_array_equal(log.gains[1:, 0], log.gains[:-1, 1])
    for part in np.array_split(np.argsort(gains[:, 0]), 4):
        np.testing.assert_allclose(error[part].std(), gains[part].mean(), rtol=0.07)
    assert gains.min() < 0.95


def test_a_filtered_or_derived_column_has_the_noise_of_its_own():
    time = np.cumsum(0.01 + 0.002 * np.random.default_rng(0).uniform(-1, 1, 500))
    noisy = np.sin(time) + 1e-3 * np.random.default_rng(1).standard_normal(500)
    log = preprocess(recording(time, {"q": noisy}), Preprocess(dt=0.01, velocities=[], derive=["q"], cutoff=8.0))
    assert log.gains[:, :, 0].min() < 0.9
    np.testing.assert_array_equal(log.gains[:, :, 1], 1.0)
    assert preprocess(recording(time, {"q": noisy}), Preprocess(dt=0.01, cutoff=8.0)).gains is None
    assert log.select(np.arange(10, 20)).gains.shape == (10, 2, 2)


@pytest.mark.parametrize("cutoff", [None, 40.0])
def test_derivative_of_a_sine(cutoff):
    out = preprocess(sine_recording(), Preprocess(dt=0.01, cutoff=cutoff))
    at = (0 if cutoff is None else 1 / cutoff) + 0.01 * np.arange(len(out))
    scale = 2 * np.pi
    np.testing.assert_allclose(out.observations[:, 0], np.sin(scale * at), atol=1e-4)
    np.testing.assert_allclose(out.observations[:, 1] / scale, np.cos(scale * at), atol=1e-4)


def test_filter_makes_the_velocity_of_a_noisy_encoder_smooth_and_adds_no_lag():
    position = 0.1 * np.sin(2 * np.pi * TIME) ** 3
    noisy = position + np.random.default_rng(1).normal(0, 5e-6, len(TIME))
    truth = 0.1 * 3 * np.sin(2 * np.pi * TIME) ** 2 * np.cos(2 * np.pi * TIME) * 2 * np.pi

    def velocity(cutoff):
        out = preprocess(recording(TIME, {"q": noisy}), Preprocess(dt=0.005, cutoff=cutoff, trim=0.05))
        return out.observations[:, 1], truth[50 : 50 + 5 * len(out) : 5]

    raw, expected = velocity(None)
    smooth, _ = velocity(40.0)
    assert np.std(raw - expected) > 2e-3
    assert np.std(smooth - expected) < 3e-4
    lag = estimate_delay(expected, smooth, 0.005, max_delay=0.05)
    assert abs(lag) < 2e-5


def test_filtered_log_may_be_sampled_irregularly():
    time = np.cumsum(np.random.default_rng(2).uniform(0.0005, 0.0015, 2000))
    time -= time[0]
    out = preprocess(recording(time, {"q": np.sin(2 * np.pi * time)}), Preprocess(dt=0.01, cutoff=40))
    at = 1 / 40 + 0.01 * np.arange(len(out))
    np.testing.assert_allclose(out.observations[:, 1] / (2 * np.pi), np.cos(2 * np.pi * at), atol=2e-4)


def test_measured_velocities_are_kept_and_may_be_left_out():
    rec = sine_recording(dq=np.full(len(TIME), 7.0))
    kept = preprocess(rec, Preprocess(dt=0.01, velocities=["dq"]))
    assert kept.observations.shape[1] == 2
    np.testing.assert_allclose(kept.observations[:, 1], 7.0)
    assert preprocess(rec, Preprocess(dt=0.01, positions=["q"], velocities=[])).observations.shape[1] == 1


def test_some_velocities_are_derived_beside_those_that_are_measured():
    """Derivatives alone are filtered, and stand before what was measured."""
    noisy = SINE + 1e-3 * np.random.default_rng(0).standard_normal(len(TIME))
    rec = recording(TIME, {"q": noisy, "z": 5 * TIME, "dz": np.full(len(TIME), 7.0)})
    options = {"dt": 0.01, "velocities": ["dz"], "derive": ["q"]}
    raw = preprocess(rec, Preprocess(**options)).observations
    smooth = preprocess(rec, Preprocess(**options, cutoff=10, trim=0)).observations
    np.testing.assert_allclose(raw[:, 3], 7.0)
    np.testing.assert_array_equal(raw[:, :2], smooth[:, :2])
    exact = np.gradient(preprocess(sine_recording(), Preprocess(dt=0.01)).observations[:, 0], 0.01)
    inside = slice(20, len(raw) - 20)
    assert np.std((smooth[:, 2] - exact)[inside]) < 0.2 * np.std((raw[:, 2] - exact)[inside])
    trimmed = preprocess(rec, Preprocess(**options, cutoff=13)).observations
    np.testing.assert_allclose(trimmed[:, :2], raw[8 : 8 + len(trimmed), :2], atol=1e-12)  # as measured
    with pytest.raises(InputError, match="derive has no meaning without velocities"):
        Preprocess(dt=0.01, derive=["q"])


def test_columns_are_positions_then_velocities_in_the_order_given():
    rec = recording(TIME, {"q[0]": SINE, "q[1]": 3 * TIME, "z": 5 * TIME})
    out = preprocess(rec, Preprocess(dt=0.01, positions=["z", "q"]))
    at = 0.01 * np.arange(len(out))
    np.testing.assert_allclose(out.observations[:, 0], 5 * at, atol=1e-9)
    np.testing.assert_allclose(out.observations[:, [3, 5]], np.tile([5, 3], (len(out), 1)), atol=1e-9)
    np.testing.assert_allclose(out.observations[:, 1], np.sin(2 * np.pi * at), atol=1e-9)


# -- parts, episodes, gaps ------------------------------------------------------------------------


def test_start_and_stop_split_a_recording_without_overlap():
    first = preprocess(sine_recording(), Preprocess(dt=0.01, stop=1.5))
    rest = preprocess(sine_recording(), Preprocess(dt=0.01, start=1.5))
    assert (len(first), len(rest)) == (150, 50)
    np.testing.assert_allclose(first.next_observations[-1], rest.observations[0], atol=1e-9)
    np.testing.assert_allclose(first.actions[-1] + 1, rest.actions[0])


def test_no_step_crosses_from_one_episode_into_the_next():
    episodes = np.repeat([0, 1], [1000, 1001])
    time = np.where(episodes == 0, TIME, TIME - 1.0)
    out = preprocess(recording(time, {"q": episodes * 9.0}, episodes=episodes), Preprocess(dt=0.01))
    assert out.num_episodes == 2
    assert set(out.observations[:, 0]) == {0.0, 9.0}
    np.testing.assert_allclose(out.observations[:, 1], 0, atol=1e-12)
    assert out.source == "test"


def test_missing_samples_are_interpolated_only_with_max_gap():
    values = 2 * TIME
    values[500:550] = np.nan
    rec = recording(TIME, {"q": values})
    with pytest.raises(InputError, match=r"q is nan at row 500 .*and 49 more"):
        preprocess(rec, Preprocess(dt=0.01))
    with pytest.raises(InputError, match=r"q has no sample for 0\.051 s from 0\.499 s on.*0\.02 s"):
        preprocess(rec, Preprocess(dt=0.01, max_gap=0.02))
    out = preprocess(rec, Preprocess(dt=0.01, max_gap=0.06))
    np.testing.assert_allclose(out.observations[:, 1], 2, atol=1e-9)


def test_gap_in_the_time_stamps_is_refused():
    keep = (TIME < 0.5) | (TIME > 0.6)
    with pytest.raises(InputError, match=r"episode 0: q has no sample for 0\.102 s .*max_gap"):
        preprocess(recording(TIME[keep], {"q": SINE[keep]}), Preprocess(dt=0.01))


def test_what_pauses_leave_that_is_too_short_is_left_out():
    time = 0.01 * np.arange(300)
    rec = recording(time, {"q": np.sin(time)}, episodes=np.r_[np.zeros(100, int), 1, np.full(199, 2)])
    with pytest.raises(InputError, match="episode 1: q has 1 samples"):
        preprocess(rec, Preprocess(dt=0.01))
    out = preprocess(replace(rec, cut=True), Preprocess(dt=0.01))
    assert np.bincount(out.episodes).tolist() == [99, 198]
    with pytest.raises(InputError, match="episode 0: q has 1 samples"):
        preprocess(replace(rec, cut=True, episodes=np.arange(300)), Preprocess(dt=0.01))


# -- commands -------------------------------------------------------------------------------------


def test_commands_of_rows_that_are_missing_lie_between_those_that_are_not():
    """Held from the row before, a command that rises would be late there."""
    time = np.delete(0.01 * np.arange(200), [50, 90, 91, 140])
    out = preprocess(recording(time, {"q": np.sin(time)}, {"u": 3 * time}), Preprocess(dt=0.01, max_gap=0.04))
    np.testing.assert_allclose(out.actions[:, 0], 3 * 0.01 * np.arange(len(out)), atol=1e-9)


def test_command_is_held_from_its_stamp_on():
    step = (TIME >= 0.5 - 1e-9).astype(float)
    out = preprocess(recording(TIME, {"q": SINE}, {"u": step}), Preprocess(dt=0.02))
    np.testing.assert_array_equal(out.actions[:, 0], np.arange(100) >= 25)


def test_stamp_that_jitters_behind_the_step_still_counts_for_it():
    time = TIME + np.where(TIME > 0, 2e-8, 0)
    out = preprocess(recording(time, {"q": SINE}, {"u": np.arange(len(TIME))}), Preprocess(dt=0.01))
    np.testing.assert_array_equal(out.actions[:, 0], 10 * np.arange(len(out)))


@given(change=st.floats(0.1, 1.9))
def test_held_command_changes_at_the_first_step_after_it(change):
    stamps = np.array([0.0, change, 2.0])
    u = np.interp(TIME, TIME, np.searchsorted(stamps, TIME, side="right") - 1.0)
    seen = TIME[np.flatnonzero(u >= 1)[0]]
    out = preprocess(recording(TIME, {"q": SINE}, {"u": u}), Preprocess(dt=0.01))
    first = 0.01 * np.flatnonzero(out.actions[:, 0] >= 1)[0]
    assert -2e-5 <= first - seen < 0.01


def test_mean_of_commands_is_exact_for_what_is_held():
    out = preprocess(sine_recording(), Preprocess(dt=0.02, actions="mean"))
    np.testing.assert_allclose(out.actions[:, 0], 2 * np.arange(100) + 0.5, atol=1e-6)
    shifted = preprocess(sine_recording(), Preprocess(dt=0.02, actions="mean", start=0.0025))
    np.testing.assert_allclose(shifted.actions[:, 0], 2 * np.arange(99) + 0.75, atol=1e-6)


def test_commanded_position_is_what_is_measured_at_the_next_step():
    out = preprocess(recording(TIME, {"q": SINE, "p": TIME}), Preprocess(dt=0.01, actions="position"))
    np.testing.assert_array_equal(out.actions, out.next_observations[:, :2])
    only = preprocess(
        recording(TIME, {"q": SINE, "p": TIME}), Preprocess(dt=0.01, actions="velocity", controlled=["p"])
    )
    np.testing.assert_array_equal(only.actions, only.next_observations[:, 3:])


# -- delays ---------------------------------------------------------------------------------------


@given(delay=st.floats(-0.03, 0.03), seed=st.integers(0, 5))
def test_delay_is_found_to_a_fraction_of_a_sample(delay, seed):
    dt, time = 0.004, np.arange(0, 4, 0.004)
    frequencies, phases = np.random.default_rng(seed).uniform(0.3, 6, (2, 6))
    wave = lambda t: np.sin(2 * np.pi * np.outer(t, frequencies) + phases).sum(axis=1)  # noqa: E731
    found = estimate_delay(wave(time), 0.5 * wave(time - delay) + 3, dt, max_delay=0.05)
    assert abs(found - delay) < 0.03 * dt


def test_aligned_signal_comes_back_in_time():
    late = np.sin(2 * np.pi * (TIME - 0.0123)) + np.sin(7 * (TIME - 0.0123))
    rec = recording(TIME, {"q": late, "motor": 3 * (np.sin(2 * np.pi * TIME) + np.sin(7 * TIME))})
    options = Preprocess(dt=0.01, positions=["q"], velocities=[], align=["q"], reference="motor", max_delay=0.05)
    assert signal_delays(rec, options)["q"] == pytest.approx(0.0123, abs=2e-5)
    out = preprocess(rec, options)
    at = 0.01 * np.arange(len(out))
    np.testing.assert_allclose(out.observations[:, 0], np.sin(2 * np.pi * at) + np.sin(7 * at), atol=2e-4)
    given = preprocess(rec, replace(options, align=(), reference=None, delays={"q": 0.0123}))
    np.testing.assert_allclose(given.observations, out.observations, atol=5e-4)


def test_delay_of_the_reference_counts_for_what_is_aligned_with_it():
    rec = sine_recording(late=np.sin(2 * np.pi * (TIME - 0.02)))
    options = Preprocess(dt=0.01, align=["late"], reference="q", delays={"q": 0.005})
    assert signal_delays(rec, options) == {"q": 0.005, "late": pytest.approx(0.025, abs=2e-5)}


def test_all_signals_of_a_clock_have_the_delay_of_those_that_are_aligned():
    wave = lambda t: np.sin(2 * np.pi * t) + np.sin(7 * t)  # noqa: E731
    late = lambda values: {"marker": wave(TIME - 0.0123), "object": values}  # noqa: E731
    for values in (np.full(len(TIME), 0.3), np.cos(5 * (TIME - 0.0123))):  # one that rests has no delay of its own
        rec = recording(TIME, {"tip": 3 * wave(TIME), **late(values)})
        options = Preprocess(dt=0.01, align=["marker"], reference="tip", same_clock=["object"], delays={"tip": 0.002})
        found = signal_delays(rec, options)
        assert found["object"] == found["marker"] == pytest.approx(0.0143, abs=2e-5)
        assert found["tip"] == 0.002
    out = preprocess(rec, options)
    at = 0.01 * np.arange(len(out))
    np.testing.assert_allclose(out.observations[:, 2], np.cos(5 * (at + 0.002)), atol=2e-4)


def test_several_signals_of_a_clock_have_one_delay_between_theirs():
    wave = lambda t: np.sin(2 * np.pi * t) + np.sin(7 * t)  # noqa: E731
    rec = recording(TIME, {"tip": wave(TIME), "x": wave(TIME - 0.010), "y": wave(TIME - 0.014), "z": 0 * TIME})
    options = Preprocess(dt=0.01, align=["x", "y"], reference="tip")
    apart, together = signal_delays(rec, options), signal_delays(rec, replace(options, same_clock=["z"]))
    assert apart == {"x": pytest.approx(0.010, abs=2e-5), "y": pytest.approx(0.014, abs=2e-5)}
    assert together == dict.fromkeys("xyz", pytest.approx(0.012, abs=2e-5))


def test_delayed_command_is_taken_earlier():
    step = (TIME >= 0.5 - 1e-9).astype(float)
    out = preprocess(recording(TIME, {"q": SINE}, {"u": step}), Preprocess(dt=0.02, delays={"u": 0.1}))
    np.testing.assert_array_equal(out.actions[:, 0], np.arange(len(out)) >= 20)


@pytest.mark.parametrize(
    ("signal", "max_delay", "message"),
    [
        (
            np.random.default_rng(0).normal(size=len(TIME)),
            0.05,
            r"no delay can be estimated: their correlation is 0\.\d",
        ),
        (np.roll(SINE, 80), 0.05, r"no delay within 0\.05 s.*raise max_delay"),
        (SINE, 0.9, r"too short to look for delays up to max_delay 0\.9 s"),
    ],
)
def test_delay_that_cannot_be_found_is_an_error(signal, max_delay, message):
    rec = sine_recording(other=signal)
    with pytest.raises(InputError, match=message):
        preprocess(rec, Preprocess(dt=0.01, align=["other"], reference="q", max_delay=max_delay))


# -- orientations ---------------------------------------------------------------------------------


def test_turning_body_has_its_angular_velocity_in_its_own_frame():
    rate = np.array([0.3, -1.2, 2.0])
    start = Rotation.from_euler("xyz", [0.4, 0.2, -1.0])
    wxyz = np.roll((start * Rotation.from_rotvec(np.outer(TIME, rate))).as_quat(), 1, axis=1)
    wxyz *= np.where(np.arange(len(TIME)) % 3 == 0, -1, 1)[:, None]  # a logger that flips the sign
    names = ("qw", "qx", "qy", "qz")
    rec = recording(TIME, {"x": TIME, **dict(zip(names, wxyz.T, strict=True)), "z": 2 * TIME})
    out = preprocess(rec, Preprocess(dt=0.01, quaternions=[names]))
    assert out.observations.shape[1] == 6 + 5
    np.testing.assert_allclose(np.linalg.norm(out.observations[:, 1:5], axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(out.observations[:, 6:], np.tile([1, *rate, 2], (len(out), 1)), atol=1e-4)
    at = start * Rotation.from_rotvec(np.outer(0.01 * np.arange(len(out)), rate))
    turned = at.inv() * Rotation.from_quat(np.roll(out.observations[:, 1:5], -1, axis=1))
    assert turned.magnitude().max() < 1e-5


def test_quaternion_between_samples_has_unit_length():
    turns = Rotation.from_rotvec(np.outer(TIME[::100], [0, 0, 5]))
    names = ("qw", "qx", "qy", "qz")
    rec = recording(TIME[::100], dict(zip(names, np.roll(turns.as_quat(), 1, axis=1).T, strict=True)))
    out = preprocess(rec, Preprocess(dt=0.013, quaternions=[names]))
    np.testing.assert_allclose(np.linalg.norm(out.observations[:, :4], axis=1), 1, atol=1e-12)


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"dt": 0.01, "cutof": 20}, r"unknown key 'cutof'; did you mean 'cutoff'"),
        ({"cutoff": 20}, r"dt is missing; expected the simulator's time step times frame_skip"),
        ({"dt": -1}, r"dt is -1; expected a positive number"),
        ({"dt": None}, r"dt is None; expected a positive number"),
        ({"dt": 0.01, "cutoff": "fast"}, r"cutoff is 'fast'; expected a positive number"),
        ({"dt": 0.01, "order": 0}, r"order is 0; expected a whole number from 1 to 10"),
        ({"dt": 0.01, "start": 2, "stop": 1}, r"stop is 1 s and start 2 s"),
        ({"dt": 0.01, "actions": "holdd"}, r"unknown kind 'holdd'; did you mean 'hold'"),
        ({"dt": 0.01, "align": ["q"]}, r"align and reference go together"),
        ({"dt": 0.01, "same_clock": ["q"]}, r"same_clock needs align"),
        ({"dt": 0.01, "same_clock": "q"}, r"same_clock is 'q'; expected a list of signals"),
        ({"dt": 0.01, "controlled": ["q"]}, r"controlled has no meaning with actions: hold"),
        ({"dt": 0.01, "positions": "q"}, r"positions is 'q'; expected a list of signals"),
        ({"dt": 0.01, "delays": {"q": [1]}}, r"delays: q is \[1\]; expected a finite number"),
        ({"dt": 0.01, "delays": 0.1}, r"delays is 0\.1; expected signal: seconds"),
        ({"dt": 0.01, "quaternions": "q"}, r"quaternions is 'q'; expected a list"),
    ],
)
def test_option_that_makes_no_sense(mapping, message):
    with pytest.raises(InputError, match=message):
        Preprocess.from_mapping(mapping)


def test_yaml_writes_1e_3_as_text():
    assert Preprocess.from_mapping({"dt": "1e-3"}).dt == 1e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cutoff": 500}, r"q: cutoff is 500 Hz, but the signal is sampled at 1000 Hz"),
        ({"start": 5}, r"leaves no transition of 0\.01 s: the recording lasts 2 s"),
        ({"trim": 1.0}, r"leaves no transition"),
        ({"positions": ["p"]}, r"positions: there is no signal 'p' \(there are: q\)"),
        ({"velocities": ["dq"]}, r"velocities: there is no signal 'dq'"),
        ({"delays": {"v": 0.1}}, r"delays: there is no signal 'v'"),
        ({"align": ["x"], "reference": "q"}, r"align: there is no signal 'x'"),
        ({"align": ["u"], "reference": "x"}, r"there is no signal 'x'"),
        ({"align": ["u"], "reference": "q", "delays": {"u": 1}}, r"u stands in both align and delays"),
        ({"align": ["u"], "reference": "q", "same_clock": ["x"]}, r"same_clock: there is no signal 'x'"),
        ({"align": ["u"], "reference": "q", "same_clock": ["q"]}, r"q stands in both same_clock and reference"),
        ({"actions": "position"}, r"infers the actions from the motion, but the log's actions are u"),
        ({"quaternions": [["q", "q", "q", "q"]]}, r"expected four different signals"),
    ],
)
def test_option_that_does_not_fit_the_recording(options, message):
    with pytest.raises(InputError, match=message):
        preprocess(sine_recording(), Preprocess(dt=0.01, **options))


def test_quaternion_must_have_unit_length():
    rec = recording(TIME, dict.fromkeys("wxyz", SINE))
    with pytest.raises(InputError, match=r"w, x, y, z has length 0 at sample 0; a unit quaternion"):
        preprocess(rec, Preprocess(dt=0.01, quaternions=[list("wxyz")]))


def test_recording_without_time_is_refused():
    with pytest.raises(InputError, match=r"preprocess needs time stamps; name their column with time, or give dt"):
        preprocess(replace(sine_recording(), time=None), Preprocess(dt=0.01))


# -- a measured drive -----------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_measured_drive_obeys_its_published_dynamics(dt):
    """Force = mass·acceleration + viscous + Coulomb friction + offset, by least squares on what comes out."""
    path = Path(os.environ.get("DROPO_DATA", "")) / "emps" / "DATA_EMPS.mat"
    if not path.is_file():
        pytest.skip("DROPO_DATA has no emps/DATA_EMPS.mat")
    log = read_trajectories(
        path,
        time="t",
        observations="qm",
        actions={"force": {"signal": "vir", "scale": "gtau"}},
        preprocess=Preprocess(dt=dt, cutoff=80, actions="mean"),
    )
    velocity = (log.observations[:, 1] + log.next_observations[:, 1]) / 2
    acceleration = (log.next_observations[:, 1] - log.observations[:, 1]) / dt
    regressors = np.stack([acceleration, velocity, np.sign(velocity), np.ones(len(log))], axis=1)
    found, *_ = np.linalg.lstsq(regressors, log.actions[:, 0], rcond=None)
    np.testing.assert_allclose(found, [95.1, 203.5, 20.4, -3.2], rtol=0.05)
    residual = log.actions[:, 0] - regressors @ found
    assert residual.std() < 0.05 * log.actions[:, 0].std()
