"""Figures of the page on a gap: scores before and after, and the missing force against what drives it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dropo_torch.report import figures, words

#: Points of a cloud are thinned to about this many.
MAX_DOTS = 700
#: Points that a running median is taken over, at least.
LEAST_POINTS = 8
#: An axis of log-likelihoods is no narrower: smaller differences are chance.
LEAST_NATS = 20.0
_CLOUD = "#a3afbb"
_COLOURS = {"your model": figures.ORANGE, "before": figures.ORANGE, "after": figures.BLUE, "noise floor": figures.GREY}


def score_panel(names: Sequence[str], values: Sequence[float], label: str, *, log: bool) -> str:
    """Draw one score of each model as a dot on a line, with its number.

    Args:
        names: what is compared, from ``your model``, ``before``, ``after`` and ``noise floor``.
        values: the scores; what is not finite is written, not drawn.
        label: what the score is, with its unit.
        log: whether the axis is logarithmic, for errors; it is not if one is not positive. Otherwise it is at least
            :data:`LEAST_NATS` wide.
    """
    figure = figures.new_figure(300, 56 + 26 * len(names))
    axes = figures.new_axes(figure, (80, 40, 62, 8))
    numbers = np.asarray(values, dtype=float)
    drawn = np.isfinite(numbers)
    least = 0.0 if log else LEAST_NATS
    log = log and bool(drawn.any()) and bool((numbers[drawn] > 0).all())
    if log:
        axes.set_xscale("log")
        axes.minorticks_off()
    axes.set_xlim(*_limits(numbers[drawn], log, least))
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(axis="x", color="#edf0f3", linewidth=0.8)
    axes.set_axisbelow(True)
    for row, (name, value) in enumerate(zip(names, numbers, strict=True)):
        axes.axhline(row, color=figures.FAINT, linewidth=0.7, zorder=0.5)
        if np.isfinite(value):
            axes.plot([value], [row], marker="o", markersize=8, color=_COLOURS[name], clip_on=False)
        text = score(value) if np.isfinite(value) else "not known" if np.isnan(value) else words.number(value)
        axes.text(1.05, row, text, transform=axes.get_yaxis_transform(), va="center", fontsize=11, color=figures.INK)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0, pad=8, labelsize=11)
    axes.tick_params(axis="x", labelsize=10)
    axes.spines["left"].set_visible(False)
    if drawn.any():
        figures._few_ticks(axes.xaxis, 4, is_log=log)
        if log:
            axes.set_xticks(_log_ticks(*axes.get_xlim()))
    else:
        axes.set_xticks([])
    axes.set_xlabel(label, fontsize=10.5)
    return figures.to_svg(figure, label)


def score(value: float) -> str:
    """Return a score for people: three digits, or whole numbers where it is large."""
    if np.isfinite(value) and 1000 <= abs(value) < 1e9:
        return f"{value:,.0f}".replace("-", "−")
    if not np.isfinite(value) or value == 0 or not 1e-4 <= abs(value) < 1e6:
        return figures.plain(float(f"{value:.3g}"))
    return f"{value:#.3g}".rstrip(".").replace("-", "−")


def force_panel(
    variable: np.ndarray, force: np.ndarray, frame: tuple[float, float, float, float], x_label: str, y_label: str,
    colour: str,
) -> str:  # fmt: skip
    """Draw a force against a variable as a cloud, with its running median.

    Args:
        variable, force: ``(N,)`` each; what is not finite is left out.
        frame: left, right, lower and upper end of the axes; what lies beyond is drawn at the edge.
        x_label, y_label: of the axes.
        colour: of the median.
    """
    figure = figures.new_figure(420, 250)
    axes = figures.new_axes(figure, (62, 42, 14, 10))
    left, right, low, high = frame
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
    figures._few_ticks(axes.xaxis, 6)
    figures._few_ticks(axes.yaxis, 6)
    axes.set_xlabel(figures.shorten(x_label, 56))
    axes.set_ylabel(figures.shorten(y_label, 36))
    for text in (axes.xaxis.label, axes.yaxis.label):
        text.set_parse_math(False)
    axes.yaxis.set_label_coords(-48 / 344, 0.5)
    finite = np.isfinite(variable) & np.isfinite(force)
    x, y = variable[finite], force[finite]
    if not len(x):
        axes.text(0.5, 0.5, "no finite value", transform=axes.transAxes, ha="center", color=figures.GREY, fontsize=9.5)
        return figures.to_svg(figure, f"{y_label} against {x_label}")
    axes.axhline(0, color=figures.GREY, linewidth=0.8)
    keep = _spread(x, MAX_DOTS)
    _strokes(axes, np.clip(x[keep], left, right), np.clip(y[keep], low, high), _CLOUD, 2.6)
    middle, median = running_median(x, y)
    inside = (middle >= left) & (middle <= right)
    axes.plot(middle[inside], np.clip(median[inside], low, high), color=colour, linewidth=2.0)
    return figures.to_svg(figure, f"{y_label} against {x_label}")


def force_frame(variable: np.ndarray, *forces: np.ndarray) -> tuple[float, float, float, float]:
    """Return left, right, lower and upper end of axes that suit all forces, a few outliers apart."""
    x_low, x_high = _range(variable, 0.0025)
    y_low, y_high = _range(np.concatenate(forces) if forces else np.zeros(0), 0.005)
    return x_low, x_high, min(y_low, 0.0), max(y_high, 0.0)


def running_median(x: np.ndarray, y: np.ndarray, most: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Return medians of x and y over neighbours in x, as many in each; the whole where there are few."""
    order = np.argsort(x, kind="stable")
    count = int(np.clip(len(x) // LEAST_POINTS, 1, most))
    groups = [g for g in np.array_split(order, count) if len(g)]
    return np.array([np.median(x[g]) for g in groups]), np.array([np.median(y[g]) for g in groups])


def _spread(x: np.ndarray, most: int) -> np.ndarray:
    """Which points to draw: all, or as many as may be, at random but always the same."""
    if len(x) <= most:
        return np.arange(len(x))
    return np.sort(np.random.default_rng(0).choice(len(x), most, replace=False))


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


def _log_ticks(low: float, high: float) -> list[float]:
    """Two to four round values within a positive interval that spans at least a factor of four."""
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    inside: list[float] = []
    for digits in ((1,), (1, 3), (1, 2, 5)):
        values = [float(f"{d}e{e}") for e in range(first, last + 1) for d in digits]
        inside = [v for v in values if low <= v <= high]
        if len(inside) >= 2:
            break
    return inside[:: -(-len(inside) // 4)]


def _strokes(axes: Any, x: np.ndarray, y: np.ndarray, colour: str, width: float) -> None:
    limits = axes.get_xlim(), axes.get_ylim()
    figures._strokes(axes, x, y, y, colour, width)
    axes.set_xlim(*limits[0])
    axes.set_ylim(*limits[1])
