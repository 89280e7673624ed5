"""The time that a search still takes, as it is told while it goes on."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from rich.console import Console

from dropo_torch.commands.progress import StageProgress
from dropo_torch.gap.time_left import PLAN, QUIET_PLAN, SCREENING, TimeLeft

Reports = tuple[tuple[str, float, float], ...]
#: Stages of a search for one effect on a cart-pole, their shares, and when they were reported, in seconds.
ONE: Reports = (
    ("preparing", 0.0, 0.0),
    ("fitting the declared parameters", 0.0, 0.51),
    ("screening 120 candidates", 0.2, 1.46),
    ("screening 120 candidates", 0.6, 2.14),
    ("screening 120 candidates", 1.0, 2.63),
    ("refitting", 0.0, 2.63),
    ("refitting", 0.33, 2.82),
    ("refitting", 0.67, 3.09),
    ("all but noise is explained", 1.0, 3.92),
    ("checking 1 effect", 0.0, 4.61),
    ("looking for ties", 0.0, 4.85),
    ("screening 120 candidates", 0.2, 5.17),
    ("screening 120 candidates", 0.6, 5.86),
    ("screening 120 candidates", 1.0, 6.33),
    ("looking for ties", 0.0, 6.77),
    ("looking for ties", 0.31, 7.49),
    ("looking for ties", 0.62, 8.25),
    ("fitting on all windows", 0.0, 9.39),
    ("verifying", 0.0, 9.97),
    ("verifying", 0.5, 10.86),
    ("verifying", 0.8, 11.59),
    ("proposing a motion", 0.0, 11.87),
)
#: When it ended.
END = 12.86


def after(reports: Reports, limit: float = math.inf) -> TimeLeft:
    known = TimeLeft(limit)
    for stage, share, seconds in reports:
        known = known.told(stage, share, seconds)
    return known


def at(now: float, reports: Reports = ONE, limit: float = math.inf) -> float:
    return after(tuple(r for r in reports if r[2] <= now), limit).left(now)


def beginning(*stages: str) -> Reports:
    """Stages that follow each other after a second each."""
    return tuple((stage, 0.0, float(i)) for i, stage in enumerate(stages))


def test_remaining_time_of_a_recorded_search_is_right_within_a_factor_of_two() -> None:
    instants = np.linspace(0.25, 0.95, 100) * END
    ratios = np.array([at(t) / (END - t) for t in instants])
    assert np.all((ratios > 0.5) & (ratios < 2.0))


def test_it_is_never_negative_and_falls_until_the_next_report() -> None:
    for number in range(1, len(ONE) + 1):
        known, told = after(ONE[:number]), ONE[number - 1][2]
        left = np.array([known.left(told + wait) for wait in np.linspace(0, 100, 50)])
        if np.isnan(left).any():
            assert np.isnan(left).all()
            continue
        assert left.min() >= 0
        assert np.all(np.diff(left) <= 0)
        assert np.all(np.diff(left) >= -100 / 49 - 1e-9)  # not faster than time goes by


def test_nothing_is_told_before_a_stage_has_shown_how_fast_the_search_is() -> None:
    for reports in ((), ONE[:1], ONE[:2]):
        assert math.isnan(after(reports).left(5.0))
        assert after(reports).share(5.0) == 0
    assert after(beginning("preparing", "fitting the declared parameters", "screening 9 candidates")).left(2.0) > 0


def test_nothing_is_left_at_the_end() -> None:
    known = after((*ONE, ("comparing forces", 0.0, END), ("comparing forces", 1.0, END + 1)))
    assert known.left(END + 1) == 0
    assert known.share(END + 1) == 1


@pytest.mark.parametrize("factor", [0.1, 7.0])
def test_it_is_learned_from_this_run(factor: float) -> None:
    """A machine so many times as slow takes so many times as long."""
    slow = tuple((stage, share, factor * seconds) for stage, share, seconds in ONE)
    for now in np.linspace(0.3, 0.9, 7) * END:
        assert at(factor * now, slow) == pytest.approx(factor * at(now))


def test_share_of_the_whole_is_the_time_over() -> None:
    known = after(ONE)
    assert known.share(END) == pytest.approx(END / (END + known.left(END)))


BEGUN = ("preparing", "fitting the declared parameters")


def test_less_is_left_where_nothing_seems_to_be_missing() -> None:
    missing = after(beginning(*BEGUN, "screening 9 candidates")).left(2.0)
    known = after(
        (*beginning(*BEGUN), ("what is left looks like noise", 0.0, 2.0), ("screening 9 candidates", 0.0, 2.0))
    )
    assert known.plan == QUIET_PLAN
    assert known.left(2.0) < missing
    assert known.told("refitting", 0.0, 3.0).plan == PLAN


def test_less_is_left_once_all_is_explained_and_more_for_more_effects() -> None:
    round_one = beginning(*BEGUN, "screening 9 candidates", "refitting")
    part, whole = (after(round_one).told(f"{s} explained", 1.0, 4.0) for s in ("part of it is", "all but noise is"))
    assert 0 < whole.left(4.0) < part.left(4.0)
    one, two = (whole.told(words, 0.0, 5.0).left(5.0) for words in ("checking 1 effect", "checking 2 effects"))
    assert one < two


def test_another_search_begins_anew() -> None:
    known = after(beginning(*BEGUN, "screening 9 candidates", "refitting", "checking 1 effect"))
    again = known.told("searching over shorter windows", 0.0, 5.0)
    assert again.left(5.0) > known.left(5.0)


def test_speed_of_another_search_is_learned_anew() -> None:
    first = beginning(*BEGUN, "screening 9 candidates", "refitting", "checking 1 effect")
    second = ("searching over shorter windows", BEGUN[1], "screening 9 candidates", "refitting")
    slow, fast = (after((*first, *((s, 0.0, 5 + i * pace) for i, s in enumerate(second)))) for pace in (1.0, 0.1))
    assert fast.left(5.3) < 0.5 * slow.left(8.0)


def test_time_limit_ends_the_rounds_but_not_what_follows() -> None:
    reports = beginning(*BEGUN, "screening 9 candidates", "refitting")
    free, over = after(reports), after(reports, limit=0.0)
    assert 0 < over.left(3.0) < free.left(3.0)
    for limit in (2.0, 3.0, 4.0):  # of which two seconds are over
        assert after(reports, limit).left(3.0) == pytest.approx(over.left(3.0) + limit - 2.0)
    assert after(reports, 1e6).left(3.0) == free.left(3.0)


def test_screening_is_a_part_of_what_screens_for_itself() -> None:
    known = after(beginning(*BEGUN, "screening 9 candidates", "refitting", "checking 1 effect", "looking for ties"))
    assert known.told("screening 9 candidates", 0.5, 5.5) == known


def test_unknown_stages_change_nothing() -> None:
    known = after(ONE)
    assert known.told("something else", 0.0, END) == known


def shown(*reports: tuple[str, float], remaining: TimeLeft | None) -> list[str]:
    """Lines of a run that is seen elsewhere than on a terminal."""
    console = Console(file=io.StringIO(), width=200)
    with StageProgress(console, "gap", remaining) as progress:
        for stage, share in reports:
            progress.show(stage, share)
    return console.file.getvalue().splitlines()


def test_a_line_of_each_stage_tells_what_is_left_once_it_is_known() -> None:
    reports = ((BEGUN[0], 0.0), (BEGUN[1], 0.0), (SCREENING.words, 0.0), (SCREENING.words, 0.5))
    assert shown(*reports, remaining=None) == ["gap: preparing", f"gap: {BEGUN[1]}", "gap: screening"]
    first, second, third = shown(*reports, remaining=TimeLeft())
    assert (first, second) == ("gap: preparing", f"gap: {BEGUN[1]}")
    assert third.startswith("gap: screening, about ")
    assert third.endswith(" s left")
