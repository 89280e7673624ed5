"""Figures of the page on a fit: densities, traces, residuals, convergence and identifiability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dropo_torch.report.figures import drawing
from dropo_torch.report.figures.drawing import BLUE, CLOUD, FAINT, GRAY, INK, MAX_POINTS, ORANGE, SKY, Axis
from dropo_torch.support.rows import evenly


def distribution_row(axis: Axis, values: np.ndarray, density: np.ndarray, center: float, nominal: float) -> Any:
    """Draw one parameter's density over its search box.

    Args:
        axis: the search box, in the parameter's units.
        values, density: the curve, ``(n,)`` each.
        center: the mean.
        nominal: the model's own value; NaN where there is none.
    """
    figure, axes = drawing.new_panel(320, 64, "density over the search box", (12, 20, 12, 4))
    axes.spines["left"].set_visible(False)
    drawing.show_axis(axes, "x", axis, 6)
    _tick_the_ends(axes, axis)
    top = float(np.max(density, initial=0.0, where=np.isfinite(density)))
    if top > 0 and np.isfinite(values).all():
        axes.fill_between(values, density / top, color=SKY, linewidth=0)
        axes.plot(values, density / top, color=BLUE, linewidth=1.2)
    if np.isfinite(center):
        axes.plot([center, center], [0, 1], color=BLUE, linewidth=1.6)
    if np.isfinite(nominal):
        axes.plot([nominal], [0.1], marker="D", markersize=4.5, color="white", markeredgecolor=ORANGE, clip_on=False)
    axes.set(yticks=[], ylim=(0, 1.12))
    return figure


def pair_panel(x_axis: Axis, y_axis: Axis, x: np.ndarray, y: np.ndarray) -> Any:
    """Draw draws of two parameters over their search boxes.

    Args:
        x_axis, y_axis: the search boxes, in the parameters' units.
        x, y: the draws, ``(n,)`` each.
    """
    figure, axes = drawing.new_panel(300, 240, "draws of two parameters", (46, 26, 12, 8))
    drawing.dots(axes, x, y, BLUE)
    drawing.show_axis(axes, "x", x_axis, 5)
    drawing.show_axis(axes, "y", y_axis, 5)
    return figure


def trace_panel(
    position: np.ndarray, measured: np.ndarray, simulated: np.ndarray, expected: np.ndarray, breaks: np.ndarray
) -> Any:
    """Draw measured dots on the simulated line, and below them the residual in its ±2σ band.

    Args:
        position: place in the log, ``(n,)``.
        measured, simulated, expected: next states and their expected standard deviation, ``(n,)`` each.
        breaks: whether a point does not follow on the one before, ``(n,)`` bool.
    """
    figure = drawing.new_figure(320, 200, "measured and simulated next states, and their difference")
    upper, lower = drawing.new_axes(figure, (46, 92, 14, 6)), drawing.new_axes(figure, (46, 20, 14, 120))
    lower.sharex(upper)
    upper.tick_params(labelbottom=False)
    joined = _insert_breaks(breaks, position, simulated, expected)
    upper.plot(joined[0], joined[1], color=BLUE, linewidth=1.1)
    drawing.dots(upper, position, measured, INK)
    for start, stop in _runs(joined):
        x, simulation, band = joined[:, start:stop]
        if stop - start == 1:  # no neighbor to draw a line to
            drawing.strokes(upper, x, simulation, simulation, BLUE, 6)
            x, band = x[0] + np.array([-0.4, 0.4]), np.repeat(band, 2)
        lower.fill_between(x, -2 * band, 2 * band, color=SKY, linewidth=0)
    lower.axhline(0, color=BLUE, linewidth=1.0)
    drawing.dots(lower, position, measured - simulated, INK)
    for axes, ticks in ((upper, 4), (lower, 3)):
        drawing.few_ticks(axes, y=ticks)
        axes.margins(y=0.12)
    if len(position):
        pad = 0.02 * max(float(np.ptp(position)), 1.0) + (len(position) == 1)
        upper.set_xlim(position.min() - pad, position.max() + pad)
    drawing.few_ticks(lower, x=5, whole=True)
    return figure


def residual_panel(position: np.ndarray, standardized: np.ndarray) -> Any:
    """Draw standardized residuals along the log, and their histogram against the standard normal, sideways.

    Args:
        position: place in the log, ``(T,)``.
        standardized: residual over its expected standard deviation, ``(T,)``; what is not finite is left out.
    """
    figure = drawing.new_figure(320, 130, "standardized residuals along the log and their histogram")
    along, across = drawing.new_axes(figure, (34, 20, 92, 6)), drawing.new_axes(figure, (236, 20, 8, 6))
    finite = np.isfinite(standardized)
    x, z = position[finite], standardized[finite]
    reach = _reach(z)
    z = np.clip(z, -reach, reach)
    for axes in (along, across):
        axes.axhspan(-2, 2, color=SKY, linewidth=0)
        axes.axhline(0, color=BLUE, linewidth=0.8)
        axes.set_ylim(-reach, reach)
    _dots_or_envelope(along, x, z)
    edges = np.linspace(-reach, reach, 42)
    share = np.histogram(z, edges)[0] / max(len(z), 1) / (edges[1] - edges[0])
    across.stairs(share, edges, orientation="horizontal", fill=True, color=GRAY)
    grid = np.linspace(-4, 4, 61)
    across.plot(np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi), grid, color=ORANGE, linewidth=1.3)
    across.set(xlim=(0, 1.08 * max(0.4, float(share.max()))), xticks=[])
    across.tick_params(labelleft=False)
    drawing.few_ticks(along, 4, 5, whole=True)
    return figure


def progress_panel(
    cost: np.ndarray,
    seconds: np.ndarray,
    changes: Sequence[float],
    lines: np.ndarray,
    colors: Sequence[str],
    *,
    label: str,
    log: bool = False,
    upside_down: bool = False,
    limits: tuple[float, float] | None = None,
    marks: Sequence[float] = (),
) -> Any:
    """Draw lines against simulated transitions (below) and time (above), stage changes marked.

    Args:
        cost, seconds: ``(n,)`` each, ascending.
        changes: ``cost`` at which stages begin; they are lettered A, B, ...
        lines: ``(n, lines)``; not drawn where not finite.
        colors: one a line.
        label: of the vertical axis.
        log, upside_down: of the vertical axis.
        limits: of the vertical axis.
        marks: horizontal guides.
    """
    figure, axes = drawing.new_panel(340, 225, label, (58, 36, 12, 34))
    keep = evenly(len(cost), min(len(cost), MAX_POINTS))
    lines = np.where(np.isfinite(lines) & ((lines > 0) | (not log)), lines, np.nan)
    for column, color in sorted(enumerate(colors), key=lambda pair: pair[1] != FAINT):
        few = color != FAINT and len(keep) <= 40
        axes.plot(cost[keep], lines[keep, column], color=color, linewidth=1.4, marker="." if few else "", markersize=4)
    if not np.isfinite(lines).any():
        drawing.say_empty(axes)
    elif log:
        drawing.log_scale(axes, "y")
    drawing.few_ticks(axes, y=6 if axes.get_yscale() == "log" else 5)
    if limits is not None:
        axes.set_ylim(*limits)
    if upside_down:
        axes.invert_yaxis()
    for mark in marks:
        axes.axhline(mark, color=GRAY, linewidth=0.8, linestyle=(0, (3, 3)))
    axes.set_xlim(0, 1.02 * (float(cost[-1]) if len(cost) and cost[-1] > 0 else 1.0))
    for number, change in enumerate(changes):
        axes.axvline(change, color=GRAY, linewidth=0.8)
        letter = chr(ord("A") + number % 26)
        offset = (3, -10 - 11 * (number % 2))  # neighbors may begin close together
        at, style = ("data", "axes fraction"), {"color": GRAY, "fontsize": 8.5, "fontweight": "bold"}
        axes.annotate(letter, (change, 1), offset, at, "offset points", **style)
    axes.set(xlabel="simulated transitions", ylabel=label)
    axes.yaxis.set_label_coords(-48 / 270, 0.5)
    drawing.few_ticks(axes, x=6, whole=True)
    if len(cost):
        drawing.clock(axes, cost, seconds)
    return figure


def heat_map(
    matrix: np.ndarray, rows: Sequence[str], columns: Sequence[str], *, diverging: bool = False, lower: bool = False
) -> Any:
    """Draw a matrix as colored cells, with numbers in them where it is small.

    Args:
        matrix: ``(rows, columns)``; what is not finite is left white.
        rows, columns: labels.
        diverging: colors from -1 to 1; otherwise four decades up to :func:`heat_top`.
        lower: leave out what is above the diagonal.
    """
    count, width = matrix.shape
    roomy = count <= 14 and width <= 14
    small = 15 if max(count, width) <= 42 else 12
    cell, right = ((40, 24), 70) if roomy else ((small, small), 8)
    rows, columns = [drawing.shorten(r) for r in rows], [drawing.shorten(c) for c in columns]
    left, top = (12 + 5.6 * max(map(len, names), default=1) for names in (rows, columns))
    figure, axes = drawing.new_panel(
        left + cell[0] * width + right, top + cell[1] * count + 6, "heat map", (left, 6, right, top)
    )
    shown = np.where(np.tri(count, width, dtype=bool) | (not lower), matrix, np.nan)
    colors = heat_colors(shown, diverging)
    axes.imshow(colors, aspect="auto", interpolation="none")
    axes.set_xticks(range(width), columns, rotation=60 if roomy else 90, ha="left" if roomy else "center")
    axes.set_yticks(range(count), rows)
    axes.xaxis.tick_top()
    axes.set_xticks(np.arange(width - 1) + 0.5, minor=True)
    axes.set_yticks(np.arange(count - 1) + 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set_visible(False)
    for text in (*axes.get_xticklabels(), *axes.get_yticklabels()):
        text.set_parse_math(False)
    if roomy:
        for i, j in np.argwhere(np.isfinite(shown)):
            dark = colors[i, j, :3] @ (0.2126, 0.7152, 0.0722) < 0.5
            text, ink = _brief(shown[i, j], diverging), "white" if dark else INK
            axes.text(j, i, text, ha="center", va="center", fontsize=7.5, color=ink)
    return figure


def heat_top(matrix: np.ndarray) -> float:
    """Return the power of ten at or above a matrix's largest finite entry, the top of its colors."""
    top = float(np.max(np.abs(matrix), initial=0.0, where=np.isfinite(matrix)))
    return float(10.0 ** np.ceil(np.log10(top) - 1e-9)) if top > 0 else 1.0


def heat_colors(matrix: np.ndarray, diverging: bool) -> np.ndarray:
    """Return RGBA in [0, 1] of a matrix's cells; see :func:`heat_map`."""
    if diverging:
        share = 0.5 + 0.5 * matrix
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            share = 1 + np.log10(np.abs(matrix) / heat_top(matrix)) / 4
    colors = _colormap(diverging)(np.clip(np.nan_to_num(share, nan=0.0, posinf=1.0, neginf=0.0), 0, 1))
    colors[~np.isfinite(matrix)] = 0.0  # transparent
    return colors


def ramp(diverging: bool) -> str:
    """Return the colors of :func:`heat_map` as a CSS gradient, for a legend."""
    colors = 255 * _colormap(diverging)(np.linspace(0, 1, 9))[:, :3]
    stops = ",".join("#{:02x}{:02x}{:02x}".format(*(round(c) for c in color)) for color in colors)
    return f"linear-gradient(to right,{stops})"


def _tick_the_ends(axes: Any, axis: Axis) -> None:
    """Add ticks at both ends of the horizontal axis, in place of those too near to them."""
    place = np.log if axis.is_log else np.asarray
    low, high = float(place(axis.low)), float(place(axis.high))
    inner = [float(t) for t in axes.get_xticks() if 0.16 < (float(place(max(t, axis.low))) - low) / (high - low) < 0.84]
    axes.set_xticks([axis.low, *inner, axis.high])
    labels = axes.get_xticklabels()
    labels[0].set_horizontalalignment("left")
    labels[-1].set_horizontalalignment("right")


def _reach(standardized: np.ndarray) -> float:
    """How far an axis of standardized residuals goes: to the largest, or to where but a few lie beyond."""
    size = np.abs(standardized)
    if not len(size) or size.max() <= 4:
        return 4.0
    return float(1.05 * size.max()) if size.max() <= 12 else max(4.0, 1.1 * float(np.quantile(size, 0.995)))


def _dots_or_envelope(axes: Any, x: np.ndarray, y: np.ndarray) -> None:
    """Draw few values as dots, many as each stretch's whole span, and its middle two thirds darker."""
    if len(x) <= 2 * MAX_POINTS:
        drawing.dots(axes, x, y, INK)
        return
    groups = np.array_split(np.arange(len(x)), MAX_POINTS)
    middle = np.array([x[g].mean() for g in groups])
    least, low, high, greatest = np.array([np.quantile(y[g], (0, 0.16, 0.84, 1)) for g in groups]).T
    drawing.strokes(axes, middle, least, greatest, CLOUD, 1.3)
    drawing.strokes(axes, middle, low, high, INK, 1.3)


def _insert_breaks(breaks: np.ndarray, *lines: np.ndarray) -> np.ndarray:
    """Lines ``(lines, n + breaks)`` with NaN before every break but the first point's."""
    places = np.flatnonzero(breaks)
    return np.stack([np.insert(np.asarray(line, dtype=float), places[places > 0], np.nan) for line in lines])


def _runs(lines: np.ndarray) -> list[tuple[int, int]]:
    """Stretches over which all lines are finite."""
    finite = np.concatenate([[False], np.isfinite(lines).all(0), [False]])
    edges = np.flatnonzero(finite[1:] != finite[:-1])
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _colormap(diverging: bool) -> Any:
    import matplotlib

    return matplotlib.colormaps["RdBu_r" if diverging else "Blues"]


def _brief(value: float, diverging: bool) -> str:
    if diverging:
        return f"{value:.2f}".replace("-", "−").replace("−0.00", "0.00")
    if value == 0:
        return "0"
    return f"{value:#.2g}".rstrip(".") if value >= 0.01 else f"{value:.0e}".replace("e-0", "e−").replace("e-", "e−")
