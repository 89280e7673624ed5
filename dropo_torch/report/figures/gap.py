"""Figures of the page on a gap: scores before and after, and the missing force against what drives it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dropo_torch.gap.result import Course
from dropo_torch.report.figures import drawing
from dropo_torch.report.figures.drawing import BLUE, CLOUD, FAINT, GRAY, INK, ORANGE
from dropo_torch.report.formatting import number, score
from dropo_torch.support.rows import evenly

#: Points of a cloud are thinned to about this many.
MAX_DOTS = 700
#: Points that a running median is taken over, at least.
LEAST_POINTS = 8
#: An axis of log-likelihoods is no narrower: smaller differences are chance.
LEAST_NATS = 20.0
#: Axes of a course reach this share of the measured range beyond it; what is predicted farther off is cut.
BEYOND = 0.75
_COLORS = {"your model": ORANGE, "before": ORANGE, "after": BLUE, "noise floor": GRAY}


def score_panel(scores: Mapping[str, float], label: str, *, log: bool) -> Any:
    """Draw one score of each model as a dot on a line, with its number.

    Args:
        scores: the scores of ``your model``, ``before``, ``after`` or ``noise floor``; what is not finite is
            written, not drawn.
        label: what the score is, with its unit.
        log: whether the axis is logarithmic, for errors; it is not if one is not positive. Otherwise it is at least
            :data:`LEAST_NATS` wide.
    """
    figure, axes = drawing.new_panel(300, 56 + 26 * len(scores), label, (80, 40, 62, 8), grid="x")
    drawn = np.array([v for v in scores.values() if np.isfinite(v)])
    least = 0.0 if log else LEAST_NATS
    log = log and len(drawn) > 0 and bool((drawn > 0).all())
    if log:
        drawing.log_scale(axes, "x")
    axes.set_xlim(*_limits(drawn, log, least))
    for row, (name, value) in enumerate(scores.items()):
        axes.axhline(row, color=FAINT, linewidth=0.7, zorder=0.5)
        if np.isfinite(value):
            axes.plot([value], [row], marker="o", markersize=8, color=_COLORS[name], clip_on=False)
        text = score(value) if np.isfinite(value) else "not known" if np.isnan(value) else number(value)
        axes.text(1.05, row, text, transform=axes.get_yaxis_transform(), va="center", fontsize=11, color=INK)
    drawing.name_rows(axes, list(scores))
    axes.tick_params(axis="x", labelsize=10)
    if len(drawn):
        drawing.few_ticks(axes, x=4, least=2)
    else:
        axes.set_xticks([])
    axes.set_xlabel(label, fontsize=10.5)
    return figure


def force_panel(
    variable: np.ndarray, force: np.ndarray, frame: tuple[float, float, float, float], x_label: str, y_label: str,
    color: str,
) -> Any:  # fmt: skip
    """Draw a force against a variable as a cloud, with its running median.

    Args:
        variable, force: ``(N,)`` each; what is not finite is left out.
        frame: left, right, lower and upper end of the axes; what lies beyond is drawn at the edge.
        x_label, y_label: of the axes.
        color: of the median.
    """
    figure, axes = drawing.new_panel(420, 250, f"{y_label} against {x_label}", (62, 42, 14, 10))
    left, right, low, high = frame
    axes.set(xlabel=drawing.shorten(x_label, 56), ylabel=drawing.shorten(y_label, 36))
    axes.yaxis.set_label_coords(-48 / 344, 0.5)
    finite = np.isfinite(variable) & np.isfinite(force)
    x, y = variable[finite], force[finite]
    if len(x):
        axes.axhline(0, color=GRAY, linewidth=0.8)
        few = len(x) <= MAX_DOTS  # of more, some at random, but always the same
        keep = np.arange(len(x)) if few else np.sort(np.random.default_rng(0).choice(len(x), MAX_DOTS, replace=False))
        cloud = np.clip(y[keep], low, high)
        drawing.strokes(axes, np.clip(x[keep], left, right), cloud, cloud, CLOUD, 2.6)
        middle, median = running_median(x, y)
        inside = (middle >= left) & (middle <= right)
        axes.plot(middle[inside], np.clip(median[inside], low, high), color=color, linewidth=2.0)
    else:
        drawing.say_empty(axes)
    axes.set(xlim=(left, right), ylim=(low, high))
    drawing.few_ticks(axes, 6, 6)
    return figure


def force_frame(variable: np.ndarray, *forces: np.ndarray) -> tuple[float, float, float, float]:
    """Return left, right, lower and upper end of axes that suit all forces, a few outliers apart."""
    x_low, x_high = _range(variable, 0.0025)
    y_low, y_high = _range(np.concatenate(forces) if forces else np.zeros(0), 0.005)
    return x_low, x_high, min(y_low, 0.0), max(y_high, 0.0)


def course_panel(course: Course, *, named: bool) -> Any:
    """Draw a position on unseen data: as measured, and as predicted by the model as given and with the effects."""
    figure, axes = drawing.new_panel(420, 190, f"{course.label} as measured and as predicted", (56, 38, 12, 8))
    draw_course(axes, course, named=named)
    axes.set(xlabel="time (s)", ylabel=f"{drawing.shorten(course.label)}{f' ({course.unit})' if course.unit else ''}")
    axes.yaxis.set_label_coords(-44 / 352, 0.5)
    return figure


def draw_course(axes: Any, course: Course, *, named: bool, width: float = 1.0) -> None:
    """Draw a course's lines on axes, whose limits suit what was measured and the prediction with the effects.

    Args:
        axes: where.
        course: the position.
        named: whether there are effects.
        width: factor of the lines' widths.
    """
    keep = evenly(course.time.shape[1], drawing.MAX_POINTS)
    low, high = float(course.measured.min()), float(course.measured.max())
    pad = BEYOND * (high - low) or 0.5
    frame, lines = (low - pad, high + pad), [(course.before, ORANGE, 1.5)]
    lines += [(course.after, BLUE, 1.8)] if named else []
    shown = np.concatenate([course.measured, *(line for line, *_ in lines)])
    shown = shown[np.isfinite(shown)].clip(*frame)
    size = float(np.ptp(shown))  # of what rests but for rounding, nothing
    margin = 0.06 * size if size > 1e-9 * float(np.abs(shown).max()) else 0.5
    for time in course.time[1:, 0]:
        axes.axvline(time, color=FAINT, linewidth=0.7 * width, zorder=0.5)
    for time, measured in zip(course.time, course.measured, strict=True):
        axes.plot(time[keep], measured[keep], color=CLOUD, linewidth=4.5 * width, solid_capstyle="round")
    for line, color, size in lines:
        for time, predicted in zip(course.time, line, strict=True):
            axes.plot(time[keep], predicted[keep], color=color, linewidth=size * width)
    axes.set(xlim=(course.time.min(), course.time.max()), ylim=(shown.min() - margin, shown.max() + margin))
    drawing.few_ticks(axes, 6, 5)


def running_median(x: np.ndarray, y: np.ndarray, most: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Return medians of x and y over neighbors in x, as many in each; the whole where there are few."""
    order = np.argsort(x, kind="stable")
    count = int(np.clip(len(x) // LEAST_POINTS, 1, most))
    groups = [g for g in np.array_split(order, count) if len(g)]
    return np.array([np.median(x[g]) for g in groups]), np.array([np.median(y[g]) for g in groups])


def _range(values: np.ndarray, share: float) -> tuple[float, float]:
    """The range of values without a share at either end, a little wider."""
    values = values[np.isfinite(values)]
    if not len(values):
        return -1.0, 1.0
    low, high = (float(v) for v in np.quantile(values, (share, 1 - share)))
    pad = 0.06 * (high - low) or 0.5 * abs(high) or 1.0
    return low - pad, high + pad


def _limits(values: np.ndarray, log: bool, least: float) -> tuple[float, float]:
    """Ends of an axis around a few values."""
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    if log:
        factor = max((high / low) ** 0.12, 2.2)
        return low / factor, high * factor
    pad = max(0.12 * (high - low), 0.5 * (least - (high - low))) or 0.1 * abs(high) or 1.0
    return low - pad, high + pad
