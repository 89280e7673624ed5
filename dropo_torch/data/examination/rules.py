"""The thresholds of the examination, in one place, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Rules:
    """What is called wrong, and from where on that is sure.

    A sure finding stops a run, so that what a right log of an imperfect model, or of a real sensor, can show is never
    more than doubtful.

    Attributes:
        turn_tolerance: by how much of a turn a jump of an angle may differ from it: a joint turns less in one row.
        jump: a row's step against those beside it and the median one, from which on it is a jump: an impact turns a
            velocity around, never a position.
        sure_jump: the same in a single column; two columns that jump together need no more than ``jump``.
        spike: a single row's departure from both rows beside it, in the largest steps near by and of 99 in 100 rows,
            from which on it is told: positions do not come back from so far.
        linked: a difference of ``next_observations`` and the next row, in standard deviations of the others': noise
            stays far below.
        out_of_range: share of a limited joint's values beyond its range from which on it is no overshoot.
        turns: turns of an unlimited joint from which on degrees are thought of.
        many_turns: turns from which on they are told even where the model cannot decide: an order of magnitude.
        skill: share of the accelerations that the model must explain more in other units than in those of the log.
        beyond: share of commands beyond their range that is told: clipping a policy's tails is usual.
        far_beyond: multiple of the range that is certainly another unit, where most commands lie beyond.
        fits: r² of Δq on dq from which on a velocity is its position's: noise leaves the slope, not the likeness.
        like: r² that a column must reach to be called another one's derivative.
        unlike: r² that the column in its place must then stay below.
        better: factor by which the unexplained part must fall for columns to be called exchanged.
        reading: share of another reading's misfit over a row that the best one may leave to be taken.
        slope: relative error of the slope that is told: large steps make a fifth.
        sure_slope: factor of the slope that no faulty sensor has, so that the unit is wrong.
        unit: relative distance from a unit's factor within which the unit is named.
        common: relative spread of the slopes of most columns that count as one: then it is the time step.
        late: what the best shift of a velocity leaves of the misfit without one, doubtful; filters do this.
        sure_late: the same, sure: a shift by a whole row and little else.
        lag: share of a row by which a velocity comes after that of its position, from which on it is told.
        hold: share of rows in which a moving column stands still that is told; polled buses repeat some.
        sure_hold: the same, sure: the sensor is slower than the log.
        frozen: rows that a column stands still while it is said to move.
        frozen_travel: share of the column's range that it should have moved meanwhile.
        quantum: smallest difference of a column's values in its median steps, from which on it is told.
        clipped: rows that a column stands at the end of its values, while it moves elsewhere.
        dead: its last step before and its first one after that, in its median steps: what comes to rest is slower.
        stop: distance from a joint's limit, in its range, within which it may stand at the stop.
        jitter: relative deviation of stamps that is told.
        gap: stamps further apart than so many times the median leave samples out.
        norm: relative deviation of a quaternion's length that is told; rounding and noise stay below.
        sure_norm: the same for the median row: these are other columns.
        turned: share of the rotation that the best reading of a quaternion may leave unexplained.
        turned_worse: how many times more the reading of the log must leave.
        significance: paired standard errors over blocks by which one reading of the commands beats another.
        sure_significance: the same, for what stops a run.
        command_share: share of the accelerations that commands must explain for their order or sign to be sure.
        earlier: what commands one row on must leave of the misfit to be sure: no actuator answers before it is told.
        gain: factor of the commands' effect that is told: a wrong gain is for the search to find.
    """

    turn_tolerance: float = 0.15
    jump: float = 8.0
    sure_jump: float = 25.0
    spike: float = 8.0
    linked: float = 12.0
    out_of_range: float = 0.2
    turns: float = 1.5
    many_turns: float = 10.0
    skill: float = 0.25
    beyond: float = 0.02
    far_beyond: float = 5.0
    fits: float = 0.8
    like: float = 0.9
    unlike: float = 0.8
    better: float = 5.0
    reading: float = 0.7
    slope: float = 0.3
    sure_slope: float = 3.0
    unit: float = 0.25
    common: float = 0.25
    late: float = 0.7
    sure_late: float = 0.25
    lag: float = 0.15
    hold: float = 0.03
    sure_hold: float = 0.3
    frozen: int = 10
    frozen_travel: float = 0.05
    quantum: float = 0.5
    clipped: int = 5
    dead: float = 0.3
    stop: float = 0.03
    jitter: float = 0.05
    gap: float = 1.75
    norm: float = 0.02
    sure_norm: float = 0.2
    turned: float = 0.3
    turned_worse: float = 4.0
    significance: float = 4.0
    sure_significance: float = 6.0
    command_share: float = 0.3
    earlier: float = 0.6
    gain: float = 8.0
