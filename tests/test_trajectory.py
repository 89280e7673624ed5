from __future__ import annotations

import numpy as np
import pytest
from conftest import SLIDE_XML, compiled
from hypothesis import given
from hypothesis import strategies as st

from dropo_torch.data.observation import generic_observation, parse_observation
from dropo_torch.data.trajectory import Trajectories, concatenate, make_transitions
from dropo_torch.errors import InputError

lengths = st.lists(st.integers(1, 9), min_size=1, max_size=6)


def numbered_log(episode_lengths: list[int], **options: object) -> Trajectories:
    """A log whose entries say where they stand: observation t is (t, episode), its next (t + 0.5, episode)."""
    episode = np.repeat(np.arange(len(episode_lengths)), episode_lengths)
    t = np.arange(len(episode), dtype=float)
    terminals = np.append(np.diff(episode) != 0, True)
    return Trajectories(
        np.stack([t, episode], 1), np.stack([t + 0.5, episode], 1), t[:, None] * 10, terminals, **options
    )


@given(lengths, st.integers(1, 9))
def test_no_window_crosses_the_end_of_an_episode(episode_lengths, lag):
    if max(episode_lengths) < lag:
        with pytest.raises(InputError, match=f"longest episode has {max(episode_lengths)} transitions"):
            make_transitions(numbered_log(episode_lengths), generic_observation(2), lag=lag)
        return
    log = numbered_log(episode_lengths)
    found = make_transitions(log, generic_observation(2), lag=lag)
    assert found.lag == lag
    np.testing.assert_array_equal(found.states[:, 1], found.measured[:, 1])
    np.testing.assert_array_equal(found.episodes, found.states[:, 1])
    np.testing.assert_array_equal(found.measured[:, 0], found.rows + lag - 0.5)
    np.testing.assert_array_equal(found.states[:, 0], found.rows)
    steps = found.rows[:, None] + np.arange(lag)
    np.testing.assert_array_equal(found.controls[:, :, 0], 10.0 * steps)
    assert (log.episodes[steps] == found.episodes[:, None]).all()
    assert not log.terminals[steps[:, :-1]].any()


@given(lengths, st.integers(1, 9))
def test_windows_are_consecutive_and_use_every_transition_that_fits(episode_lengths, lag):
    if max(episode_lengths) < lag:
        return
    found = make_transitions(numbered_log(episode_lengths), generic_observation(2), lag=lag)
    used = (found.rows[:, None] + np.arange(lag)).ravel()
    assert len(set(used)) == len(used)
    assert len(found) == sum(n // lag for n in episode_lengths)
    starts = np.cumsum([0, *episode_lengths[:-1]])
    np.testing.assert_array_equal((found.rows - starts[found.episodes]) % lag, 0)


def test_lag_below_one_is_refused():
    with pytest.raises(InputError, match="lag: 0"):
        make_transitions(numbered_log([3]), generic_observation(2), lag=0)


@given(lengths, st.data())
def test_leaving_rows_out_ends_the_episode_there(episode_lengths, data):
    log = numbered_log(episode_lengths)
    keep = np.array(data.draw(st.lists(st.booleans(), min_size=len(log), max_size=len(log))))
    if not keep.any():
        return
    part = log.select(keep)
    rows = np.flatnonzero(keep)
    np.testing.assert_array_equal(part.observations[:, 0], rows)
    for i in range(len(part) - 1):
        follows = rows[i + 1] == rows[i] + 1 and not log.terminals[rows[i]]
        assert part.terminals[i] == (not follows)
    assert part.terminals[-1]
    if (np.diff(np.flatnonzero(np.append(True, part.terminals))) >= 2).any():
        pairs = make_transitions(part, generic_observation(2), lag=2)
        np.testing.assert_array_equal(pairs.measured[:, 0], pairs.states[:, 0] + 1.5)


def test_selected_episodes_keep_their_rows_and_ends():
    part = numbered_log([2, 3, 1, 2]).select_episodes([1, 3])
    np.testing.assert_array_equal(part.observations[:, 0], [2, 3, 4, 6, 7])
    np.testing.assert_array_equal(part.terminals, [False, False, True, False, True])
    assert part.num_episodes == 2
    np.testing.assert_array_equal(part.episodes, [0, 0, 0, 1, 1])


@pytest.mark.parametrize("which", [[4], [-1], []])
def test_an_episode_that_is_not_there_is_refused(which):
    with pytest.raises(InputError, match="the log has 2 episodes"):
        numbered_log([2, 2]).select_episodes(which)


@given(lengths, lengths, st.integers(1, 4))
def test_no_window_crosses_from_one_log_into_the_next(first, second, lag):
    if max(first + second) < lag:
        return
    joined = concatenate([numbered_log(first), numbered_log(second)])
    assert joined.num_episodes == len(first) + len(second)
    found = make_transitions(joined, generic_observation(2), lag=lag)
    assert (found.rows < sum(first)).sum() == sum(n // lag for n in first)
    before = found.rows < sum(first)
    assert (found.rows[before] + lag <= sum(first)).all()


def test_logs_of_other_columns_or_sampling_times_are_not_joined():
    wide = Trajectories(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 1)), [0, 1], source="wide.npz")
    with pytest.raises(InputError, match=r"wide\.npz: 3 columns of observations"):
        concatenate([numbered_log([2]), wide])
    with pytest.raises(InputError, match=r"sampled every 0\.02 s"):
        concatenate([numbered_log([2], dt=0.01), numbered_log([2], dt=0.02)])
    with pytest.raises(InputError, match=r"c: sampled every 0\.02 s, but b every 0\.01 s"):
        concatenate([numbered_log([2], dt=dt, source=name) for name, dt in (("a", None), ("b", 0.01), ("c", 0.02))])
    assert concatenate([numbered_log([2]), numbered_log([2], dt=0.02)]).dt == 0.02


def test_the_last_transition_always_ends_an_episode():
    log = Trajectories(np.zeros((3, 1)), np.zeros((3, 1)), np.zeros((3, 1)), [0, 0, 0])
    np.testing.assert_array_equal(log.terminals, [False, False, True])


def test_a_log_does_not_change_when_its_source_arrays_do():
    states, ends = np.zeros((3, 2)), np.array([False, False, True])
    log = Trajectories(states, states, states, ends)
    states[:] = 7
    ends[:] = True
    assert (log.observations == 0).all()
    assert log.num_episodes == 1
    with pytest.raises(ValueError, match="read-only"):
        log.observations[0, 0] = 1


@pytest.mark.parametrize("name", ["observations", "next_observations", "actions"])
def test_a_value_that_is_not_finite_is_named_by_row_and_column(name):
    arrays = {k: np.zeros((5, 3)) for k in ("observations", "next_observations", "actions")}
    arrays[name][3, 2] = np.nan
    arrays[name][4, 0] = np.inf
    with pytest.raises(InputError, match=rf"robot\.npz: {name}\[2\] is nan at row 3 \(counted from 0\) and 1 more"):
        Trajectories(**arrays, terminals=[0, 0, 0, 0, 1], source="robot.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actions": np.zeros((4, 1))}, "actions has 4 rows and observations has 5"),
        ({"terminals": [0, 1]}, "terminals has 2 rows"),
        ({"terminals": [0, 0, 2, 0, 1]}, "terminals must be true/false"),
        ({"terminals": ["a"] * 5}, "terminals must be true/false"),
        ({"next_observations": np.zeros((5, 2))}, "next_observations has 2 columns and observations has 3"),
        ({"observations": np.zeros((5, 3, 1))}, r"observations has shape \(5, 3, 1\)"),
        ({"observations": [["x"]] * 5}, "observations is not a table of numbers"),
        ({"dt": 0.0}, "time between samples is 0"),
        ({"dt": np.nan}, "time between samples is nan"),
    ],
)
def test_shapes_and_kinds_that_do_not_fit_are_named(change, message):
    arrays = {k: np.zeros((5, 3)) for k in ("observations", "next_observations", "actions")}
    with pytest.raises(InputError, match=message):
        Trajectories(**{**arrays, "terminals": [0, 0, 0, 0, 1], **change})


def test_an_empty_log_is_refused():
    with pytest.raises(InputError, match="no transition"):
        Trajectories(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 1)), [])


def test_transitions_carry_full_states_where_the_log_is_partial():
    model = compiled(SLIDE_XML)
    observation = parse_observation(model, ["skip", "rail.velocity"], log_width=2)
    log = Trajectories([[9.0, 2.0]], [[9.0, 3.0]], [[1.0]], [1])
    found = make_transitions(log, observation)
    np.testing.assert_array_equal(found.states, [[0.0, 2.0]])
    np.testing.assert_array_equal(found.measured, [[3.0]])


BALL_XML = """
<mujoco><worldbody><body name="ball"><freejoint name="root"/><geom size=".1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("what", ["observations", "next_observations"])
@pytest.mark.parametrize("lag", [1, 2])
def test_a_zero_quaternion_at_either_end_is_refused_with_its_row(what: str, lag: int) -> None:
    """It is no orientation, and would count as a perfect match; with windows of two steps, between them, too."""
    model = compiled(BALL_XML)
    states = np.tile(np.concatenate([model.qpos0, np.zeros(6)]), (6, 1))
    arrays = {"observations": states, "next_observations": states.copy()}
    arrays[what] = states.copy()
    arrays[what][3, 3:7] = 0
    log = Trajectories(**arrays, actions=np.zeros((6, 0)), terminals=np.zeros(6, dtype=bool))
    with pytest.raises(InputError, match=rf"row 3 of {what} has a zero quaternion in root\.position\[qw\]"):
        make_transitions(log, parse_observation(model, None), lag=lag)


def test_a_log_is_shown_in_one_line():
    shown = repr(numbered_log([3, 2], dt=0.02, source="log.npz"))
    assert shown == (
        "<Trajectories of log.npz: 5 transitions, 2 episodes, 2 observed columns, 1 action column, every 0.02 s>"
    )
    assert "1 transition, 1 episode" in repr(numbered_log([1]))
    assert "no time stamps" in repr(numbered_log([1]))
