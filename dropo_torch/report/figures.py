"""Figures as inline SVG: plain arrays in, a string out, the same string for the same arrays.

Everything is drawn for a white page in the colours of Okabe and Ito, which colour-blind readers tell
apart. Figures are small panels that a page arranges; names and units are the page's business, so that
they wrap and can be searched. Dense data are thinned to what the eye can separate.
"""

from __future__ import annotations

import html
import io
import re
import warnings
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

INK, GREY, FAINT = "#1f2933", "#7b8794", "#d5dbe1"
BLUE, SKY, ORANGE = "#0072b2", "#cfe6f5", "#d55e00"
#: Colours of lines that must be told apart.
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
#: Points of a curve, and of a log's overview, are thinned to about this many.
MAX_POINTS = 120
#: Labels inside figures are shortened to this many characters.
MAX_LABEL = 28


@dataclass(frozen=True)
class Axis:
    """An axis of a parameter: its ends, and whether it is logarithmic."""

    low: float
    high: float
    is_log: bool = False


def distribution_row(axis: Axis, values: np.ndarray, density: np.ndarray, center: float, nominal: float) -> str:
    """Draw one parameter's density over its search box.

    Args:
        axis: the search box, in the parameter's units.
        values, density: the curve, ``(n,)`` each.
        center: the mean.
        nominal: the model's own value; NaN where there is none.
    """
    figure = new_figure(320, 64)
    axes = new_axes(figure, (12, 20, 12, 4))
    for side in ("left", "top", "right"):
        axes.spines[side].set_visible(False)
    if axis.is_log:
        axes.set_xscale("log")
        axes.minorticks_off()
    axes.set_xlim(axis.low, axis.high)
    _few_ticks(axes.xaxis, 6, axis.is_log)
    _tick_the_ends(axes, axis)
    axes.set_yticks([])
    top = float(np.max(density, initial=0.0, where=np.isfinite(density)))
    if top > 0 and np.isfinite(values).all():
        axes.fill_between(values, density / top, color=SKY, linewidth=0)
        axes.plot(values, density / top, color=BLUE, linewidth=1.2)
    if np.isfinite(center):
        axes.plot([center, center], [0, 1], color=BLUE, linewidth=1.6)
    if np.isfinite(nominal):
        axes.plot([nominal], [0.1], marker="D", markersize=4.5, color="white", markeredgecolor=ORANGE, clip_on=False)
    axes.set_ylim(0, 1.12)
    return to_svg(figure, "density over the search box")


def pair_panel(x_axis: Axis, y_axis: Axis, x: np.ndarray, y: np.ndarray) -> str:
    """Draw draws of two parameters over their search boxes.

    Args:
        x_axis, y_axis: the search boxes, in the parameters' units.
        x, y: the draws, ``(n,)`` each.
    """
    figure = new_figure(300, 240)
    axes = new_axes(figure, (46, 26, 12, 8))
    for scale, is_log in ((axes.set_xscale, x_axis.is_log), (axes.set_yscale, y_axis.is_log)):
        scale("log" if is_log else "linear")
    axes.minorticks_off()
    _dots(axes, x, y, BLUE)
    axes.set_xlim(x_axis.low, x_axis.high)
    axes.set_ylim(y_axis.low, y_axis.high)
    _few_ticks(axes.xaxis, 5, x_axis.is_log)
    _few_ticks(axes.yaxis, 5, y_axis.is_log)
    return to_svg(figure, "draws of two parameters")


def trace_panel(
    position: np.ndarray, measured: np.ndarray, simulated: np.ndarray, expected: np.ndarray, breaks: np.ndarray
) -> str:
    """Draw measured dots on the simulated line, and below them the residual in its ±2 deviation band.

    Args:
        position: place in the log, ``(n,)``.
        measured, simulated, expected: next states and expected deviation, ``(n,)`` each.
        breaks: whether a point does not follow on the one before, ``(n,)`` bool.
    """
    figure = new_figure(320, 200)
    upper, lower = new_axes(figure, (46, 92, 14, 6)), new_axes(figure, (46, 20, 14, 120))
    lower.sharex(upper)
    upper.tick_params(labelbottom=False)
    joined = _insert_breaks(breaks, position, simulated, expected)
    upper.plot(joined[0], joined[1], color=BLUE, linewidth=1.1)
    _dots(upper, position, measured, INK)
    for start, stop in _runs(joined):
        x, simulation, band = joined[:, start:stop]
        if stop - start == 1:  # no neighbour to draw a line to
            _strokes(upper, x, simulation, simulation, BLUE, 6)
            x, band = x[0] + np.array([-0.4, 0.4]), np.repeat(band, 2)
        lower.fill_between(x, -2 * band, 2 * band, color=SKY, linewidth=0)
    lower.axhline(0, color=BLUE, linewidth=1.0)
    _dots(lower, position, measured - simulated, INK)
    for axes in (upper, lower):
        _few_ticks(axes.yaxis, 4 if axes is upper else 3)
        axes.margins(y=0.12)
    if len(position):
        pad = 0.02 * max(float(np.ptp(position)), 1.0) + (len(position) == 1)
        upper.set_xlim(position.min() - pad, position.max() + pad)
    _few_ticks(lower.xaxis, 5, whole=True)
    return to_svg(figure, "measured and simulated next states, and their difference")


def residual_panel(position: np.ndarray, standardised: np.ndarray) -> str:
    """Draw standardised residuals along the log, and their histogram against the standard normal, sideways.

    Args:
        position: place in the log, ``(T,)``.
        standardised: residual over expected deviation, ``(T,)``; what is not finite is left out.
    """
    figure = new_figure(320, 130)
    along, across = new_axes(figure, (34, 20, 92, 6)), new_axes(figure, (236, 20, 8, 6))
    finite = np.isfinite(standardised)
    x, z = position[finite], standardised[finite]
    reach = _reach(z)
    for axes in (along, across):
        axes.axhspan(-2, 2, color=SKY, linewidth=0)
        axes.axhline(0, color=BLUE, linewidth=0.8)
        axes.set_ylim(-reach, reach)
    _dots_or_envelope(along, x, np.clip(z, -reach, reach))
    edges = np.linspace(-reach, reach, 42)
    share = np.histogram(np.clip(z, -reach, reach), edges)[0] / max(len(z), 1) / (edges[1] - edges[0])
    across.stairs(share, edges, orientation="horizontal", fill=True, color=GREY)
    grid = np.linspace(-4, 4, 61)
    across.plot(np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi), grid, color=ORANGE, linewidth=1.3)
    across.set_xlim(0, 1.08 * max(0.4, float(share.max())))
    across.set_xticks([])
    across.tick_params(labelleft=False)
    _few_ticks(along.yaxis, 5, whole=True)
    _few_ticks(along.xaxis, 4, whole=True)
    return to_svg(figure, "standardised residuals along the log and their histogram")


def progress_panel(
    cost: np.ndarray,
    seconds: np.ndarray,
    lines: np.ndarray,
    colours: Sequence[str],
    changes: Sequence[float],
    *,
    label: str,
    log: bool = False,
    upside_down: bool = False,
    marks: Sequence[float] = (),
    limits: tuple[float, float] | None = None,
) -> str:
    """Draw lines against simulated transitions (below) and time (above), stage changes marked.

    Args:
        cost, seconds: ``(n,)`` each, ascending.
        lines: ``(n, lines)``; not drawn where not finite.
        colours: one a line.
        changes: ``cost`` at which stages begin; they are lettered A, B, ...
        label: of the vertical axis.
        log, upside_down: of the vertical axis.
        marks: horizontal guides.
        limits: of the vertical axis.
    """
    figure = new_figure(340, 225)
    axes = new_axes(figure, (58, 36, 12, 34))
    keep = _thinned(len(cost), MAX_POINTS)
    lines = np.where(np.isfinite(lines) & ((lines > 0) | (not log)), lines, np.nan)
    for column, colour in sorted(enumerate(colours), key=lambda pair: pair[1] != FAINT):
        few = colour != FAINT and len(keep) <= 40
        axes.plot(cost[keep], lines[keep, column], color=colour, linewidth=1.4, marker="." if few else "", markersize=4)
    if not np.isfinite(lines).any():
        axes.text(0.5, 0.5, "no finite value", transform=axes.transAxes, ha="center", color=GREY, fontsize=9.5)
    if log and np.isfinite(lines).any():
        axes.set_yscale("log")
        axes.minorticks_off()
        _few_ticks(axes.yaxis, 6, is_log=True)
    else:
        _few_ticks(axes.yaxis, 5)
    if limits is not None:
        axes.set_ylim(*limits)
    if upside_down:
        axes.invert_yaxis()
    for mark in marks:
        axes.axhline(mark, color=GREY, linewidth=0.8, linestyle=(0, (3, 3)))
    end = float(cost[-1]) if len(cost) and cost[-1] > 0 else 1.0
    axes.set_xlim(0, 1.02 * end)
    for number, change in enumerate(changes):
        axes.axvline(change, color=GREY, linewidth=0.8)
        offset = (3, -10 - 11 * (number % 2))  # neighbours may begin close together
        axes.annotate(
            chr(ord("A") + number % 26),
            (change, 1),
            xycoords=("data", "axes fraction"),
            xytext=offset,
            textcoords="offset points",
            color=GREY,
            fontsize=8.5,
            fontweight="bold",
        )
    axes.set_ylabel(label)
    axes.yaxis.set_label_coords(-48 / 270, 0.5)
    axes.set_xlabel("simulated transitions")
    _few_ticks(axes.xaxis, 6, whole=True)
    if len(cost):
        _clock(axes, cost, seconds)
    return to_svg(figure, label)


def heat_map(
    matrix: np.ndarray, rows: Sequence[str], columns: Sequence[str], *, diverging: bool = False, lower: bool = False
) -> str:
    """Draw a matrix as coloured cells, with numbers in them where it is small.

    Args:
        matrix: ``(rows, columns)``; what is not finite is left white.
        rows, columns: labels.
        diverging: colours from -1 to 1; otherwise four decades up to :func:`heat_top`.
        lower: leave out what is above the diagonal.
    """
    count, width = matrix.shape
    roomy = count <= 14 and width <= 14
    small = 15 if max(count, width) <= 42 else 12
    cell, right = ((40, 24), 70) if roomy else ((small, small), 8)
    rows, columns = [shorten(r) for r in rows], [shorten(c) for c in columns]
    left, top = (12 + 5.6 * max(map(len, names), default=1) for names in (rows, columns))
    figure = new_figure(left + cell[0] * width + right, top + cell[1] * count + 6)
    axes = new_axes(figure, (left, 6, right, top))
    shown = np.where(np.tri(count, width, dtype=bool) | (not lower), matrix, np.nan)
    colours = heat_colours(shown, diverging)
    axes.imshow(colours, aspect="auto", interpolation="none")
    axes.set_xticks(range(width), columns, rotation=90 if not roomy else 60, ha="center" if not roomy else "left")
    if roomy:
        for text in axes.get_xticklabels():
            text.set_rotation_mode("anchor")
    axes.set_yticks(range(count), rows)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.set_xticks(np.arange(width - 1) + 0.5, minor=True)
    axes.set_yticks(np.arange(count - 1) + 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1)
    axes.tick_params(which="minor", length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    for text in (*axes.get_xticklabels(), *axes.get_yticklabels()):
        text.set_parse_math(False)
    if roomy:
        for i, j in np.argwhere(np.isfinite(shown)):
            dark = colours[i, j, :3] @ (0.2126, 0.7152, 0.0722) < 0.5
            axes.text(j, i, _brief(shown[i, j], diverging), ha="center", va="center", fontsize=7.5,
                      color="white" if dark else INK)  # fmt: skip
    return to_svg(figure, "heat map", grow=False)


def heat_top(matrix: np.ndarray) -> float:
    """Return the power of ten at or above a matrix's largest finite entry, the top of its colours."""
    top = float(np.max(np.abs(matrix), initial=0.0, where=np.isfinite(matrix)))
    return float(10.0 ** np.ceil(np.log10(top) - 1e-9)) if top > 0 else 1.0


def heat_colours(matrix: np.ndarray, diverging: bool) -> np.ndarray:
    """Return RGBA in [0, 1] of a matrix's cells; see :func:`heat_map`."""
    if diverging:
        share = 0.5 + 0.5 * matrix
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            share = 1 + np.log10(np.abs(matrix) / heat_top(matrix)) / 4
    colours = _colormap(diverging)(np.clip(np.nan_to_num(share, nan=0.0, posinf=1.0, neginf=0.0), 0, 1))
    colours[~np.isfinite(matrix)] = 0.0  # transparent
    return colours


def ramp(diverging: bool) -> str:
    """Return the colours of :func:`heat_map` as a CSS gradient, for a legend."""
    colours = 255 * _colormap(diverging)(np.linspace(0, 1, 9))[:, :3]
    stops = ",".join("#{:02x}{:02x}{:02x}".format(*(round(c) for c in colour)) for colour in colours)
    return f"linear-gradient(to right,{stops})"


def log_log(x: np.ndarray, y: np.ndarray, *, chosen: float, x_label: str, y_label: str, y_log: bool = True) -> str:
    """Draw one curve over a logarithmic axis, with one place on it marked.

    Args:
        x, y: ``(n,)`` each.
        chosen: the marked x; NaN for none.
        x_label, y_label: of the axes.
        y_log: whether the vertical axis is logarithmic, too.
    """
    figure = new_figure(460, 300)
    axes = new_axes(figure, (62, 42, 14, 12))
    usable = np.isfinite(x) & (x > 0) & np.isfinite(y) & ((y > 0) | (not y_log))
    if usable.any():
        axes.set_xscale("log")
        axes.set_yscale("log" if y_log else "linear")
        axes.minorticks_off()
    axes.grid(color="#edf0f3", linewidth=0.8)
    axes.plot(x[usable], y[usable], color=BLUE, linewidth=1.5, marker="o", markersize=4.5)
    if np.isfinite(chosen) and chosen > 0:
        axes.axvline(chosen, color=ORANGE, linewidth=1.0, linestyle=(0, (4, 3)))
        at = usable & np.isclose(x, chosen, rtol=1e-9, atol=0)
        axes.plot(x[at], y[at], color=ORANGE, marker="o", markersize=9, markerfacecolor="none", markeredgewidth=2)
    if usable.any():
        axes.set_xlim(x[usable].min() / 1.5, x[usable].max() * 1.5)
        _few_ticks(axes.xaxis, 12, is_log=True)
        _few_ticks(axes.yaxis, 6, is_log=y_log)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    return to_svg(figure, f"{y_label} against {x_label}")


def to_svg(figure: Any, label: str, *, grow: bool = True) -> str:
    """Return a figure as an ``<svg>`` element without ids, dates or addresses of its own.

    Args:
        figure: a matplotlib ``Figure``.
        label: what it shows, for screen readers.
        grow: scale with the page, up to a quarter beyond its natural size.
    """
    import matplotlib

    stream = io.StringIO()
    settings = {"svg.hashsalt": "dropo_torch", "svg.fonttype": "none", "path.simplify": False}
    with matplotlib.rc_context(settings), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # the reader's fonts draw the text
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return _inline(stream.getvalue(), label, grow)


def shorten(label: str, length: int = MAX_LABEL) -> str:
    """Return a label of at most ``length`` characters, its middle left out."""
    if len(label) <= length:
        return label
    head = (length - 1) // 2
    return f"{label[:head]}…{label[len(label) - (length - 1 - head) :]}"


def _reach(standardised: np.ndarray) -> float:
    """How far an axis of standardised residuals goes: to the largest, or to where but a few lie beyond."""
    size = np.abs(standardised)
    if not len(size) or size.max() <= 4:
        return 4.0
    return float(1.05 * size.max()) if size.max() <= 12 else max(4.0, 1.1 * float(np.quantile(size, 0.995)))


def new_figure(width: float, height: float) -> Any:
    """An empty figure of a size in CSS pixels; the SVG's points are scaled to that."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 72, height / 72), dpi=72)
    FigureCanvasAgg(figure)
    figure.patch.set_visible(False)
    return figure


def new_axes(figure: Any, margins: tuple[float, float, float, float]) -> Any:
    """Axes with margins left, bottom, right and top, in pixels, in the style of all figures."""
    width, height = figure.get_size_inches() * 72
    left, bottom, right, top = margins
    axes = figure.add_axes(
        (left / width, bottom / height, (width - left - right) / width, (height - bottom - top) / height)
    )
    axes.patch.set_visible(False)
    axes.tick_params(length=3, width=0.7, color=GREY, labelcolor=INK, labelsize=9.5, pad=2)
    for side, spine in axes.spines.items():
        spine.set_color(GREY)
        spine.set_linewidth(0.7)
        spine.set_visible(side in ("left", "bottom"))
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set_color(INK)
        label.set_fontsize(9.5)
    return axes


def _few_ticks(axis: Any, count: int, is_log: bool = False, *, whole: bool = False) -> None:
    """Put few ticks on an axis, with plain numbers."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator

    if is_log:
        low, high = sorted(axis.get_view_interval())
        axis.set_major_locator(FixedLocator(_log_ticks(low, high, count)))
    else:
        axis.set_major_locator(
            MaxNLocator(count - 1, integer=whole, steps=[1, 2, 5, 10] if whole else [1, 2, 2.5, 5, 10], min_n_ticks=2)
        )
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain(value)))


def _tick_the_ends(axes: Any, axis: Axis) -> None:
    """Add ticks at both ends of the horizontal axis, in place of those too near to them."""
    place = np.log if axis.is_log else np.asarray
    low, high = float(place(axis.low)), float(place(axis.high))
    inner = [float(t) for t in axes.get_xticks() if 0.16 < (float(place(max(t, axis.low))) - low) / (high - low) < 0.84]
    axes.set_xticks([axis.low, *inner, axis.high])
    labels = axes.get_xticklabels()
    labels[0].set_horizontalalignment("left")
    labels[-1].set_horizontalalignment("right")


def _log_ticks(low: float, high: float, count: int) -> list[float]:
    """Round values within a positive interval, even in the logarithm."""
    if not (0 < low < high < np.inf):
        return []
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    inside: list[float] = []
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)):
        values = [d * 10.0**e for e in range(first, last + 1) for d in digits]
        inside = [v for v in values if low * (1 - 1e-9) <= v <= high * (1 + 1e-9)]
        if len(inside) >= min(3, count):
            break
    if len(inside) < 2:
        return [float(v) for v in np.geomspace(low, high, 3)]
    return inside[:: max(1, -(-len(inside) // count))]


def plain(value: float) -> str:
    """Return a tick's number: short, a true minus, 20k for 20000."""
    if not np.isfinite(value):
        return "n/a" if np.isnan(value) else "∞" if value > 0 else "−∞"
    value = 0.0 if abs(value) < 1e-300 else value
    if value != 0 and abs(value) >= 1e4 and abs(value) < 1e9:
        scaled, suffix = (value / 1e6, "M") if abs(value) >= 1e6 else (value / 1e3, "k")
        return f"{scaled:.4g}{suffix}".replace("-", "−")
    text = f"{value:.4g}" if abs(value) >= 1e-3 or value == 0 else f"{value:.3g}"
    return re.sub(r"e([+-])0*", lambda m: "e" + m[1].replace("+", ""), text).replace("-", "−")


def _clock(axes: Any, cost: np.ndarray, seconds: np.ndarray) -> None:
    """Write the time above an axis of simulated transitions."""
    twin = axes.twiny()
    twin.patch.set_visible(False)
    twin.set_xlim(axes.get_xlim())
    ticks = [t for t in axes.get_xticks() if axes.get_xlim()[0] <= t <= axes.get_xlim()[1]]
    passed = np.interp(ticks, np.concatenate([[0], cost]), np.concatenate([[0], np.nan_to_num(seconds)]))
    twin.set_xticks(ticks, [duration(float(s)) for s in passed])
    twin.tick_params(length=3, width=0.7, color=GREY, labelcolor=GREY, labelsize=9.5, pad=2)
    for spine in twin.spines.values():
        spine.set_visible(False)


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    if not np.isfinite(seconds):
        return "n/a"
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.3g} min" if seconds < 6000 else f"{seconds / 3600:.3g} h"


def _dots(axes: Any, x: np.ndarray, y: np.ndarray, colour: str) -> None:
    """Draw dots as strokes of no length with round caps: a tenth of the bytes of markers."""
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = x[finite], y[finite]
    _strokes(axes, x, y, y, colour, 2.6)


def _strokes(axes: Any, x: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str, width: float) -> None:
    """Draw upright strokes, all as one path."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    if not len(x):
        return
    ends = np.stack([np.stack([x, low], -1), np.stack([x, high], -1)], 1).reshape(-1, 2)
    path = Path(ends, np.tile([Path.MOVETO, Path.LINETO], len(x)))
    path.should_simplify = False  # or strokes of no length are left out
    axes.add_patch(PathPatch(path, facecolor="none", edgecolor=colour, linewidth=width, capstyle="round"))
    axes.autoscale_view()


def _dots_or_envelope(axes: Any, x: np.ndarray, y: np.ndarray) -> None:
    """Draw few values as dots, many as each stretch's whole span, and its middle two thirds darker."""
    if len(x) <= 2 * MAX_POINTS:
        _dots(axes, x, y, INK)
        return
    groups = np.array_split(np.arange(len(x)), MAX_POINTS)
    middle = np.array([x[g].mean() for g in groups])
    least, low, high, greatest = np.array([np.quantile(y[g], (0, 0.16, 0.84, 1)) for g in groups]).T
    _strokes(axes, middle, least, greatest, "#a3afbb", 1.3)
    _strokes(axes, middle, low, high, INK, 1.3)


def _insert_breaks(breaks: np.ndarray, *lines: np.ndarray) -> np.ndarray:
    """Lines ``(lines, n + breaks)`` with NaN before every break but the first point's."""
    places = np.flatnonzero(breaks)
    return np.stack([np.insert(np.asarray(line, dtype=float), places[places > 0], np.nan) for line in lines])


def _runs(lines: np.ndarray) -> list[tuple[int, int]]:
    """Stretches over which all lines are finite."""
    finite = np.concatenate([[False], np.isfinite(lines).all(0), [False]])
    edges = np.flatnonzero(finite[1:] != finite[:-1])
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _thinned(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).astype(int))


def _colormap(diverging: bool) -> Callable[[np.ndarray], np.ndarray]:
    import matplotlib

    colormap: Callable[[np.ndarray], np.ndarray] = matplotlib.colormaps["RdBu_r" if diverging else "Blues"]
    return colormap


def _brief(value: float, diverging: bool) -> str:
    if diverging:
        return f"{value:.2f}".replace("-", "−").replace("−0.00", "0.00")
    if value == 0:
        return "0"
    return f"{value:#.2g}".rstrip(".") if value >= 0.01 else f"{value:.0e}".replace("e-0", "e−").replace("e-", "e−")


def _inline(document: str, label: str, grow: bool) -> str:
    """Reduce matplotlib's SVG document to a small element that shares a page with others."""
    size = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', document)
    width, height = (float(x) for x in size.groups()) if size else (300.0, 200.0)
    body = document[document.index(">", document.index("<svg")) + 1 :]
    body = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<defs>\s*<style.*?</defs>", "", body, flags=re.DOTALL)
    body = re.sub(r'<g id="[^"]*"', "<g", body).replace("xlink:href", "href")
    body = re.sub(r"font: (\d+ )?([\d.]+)px [^;\"]*", _font, body)
    body = re.sub(r"font-family: [^;\"]*(; )?|font-style: normal; ", "", body)
    body = re.sub(r' transform="rotate\(-?0 [^"]*"', "", body)
    body = re.sub(r"<[^>]*>", lambda tag: re.sub(r"\d+\.\d{2,}", _rounded, tag[0]), body)
    body = re.sub(r"(?<=base64,)[^\"]*", lambda m: re.sub(r"\s", "", m[0]), body)
    body = re.sub(r' d="([^"]*)"', lambda m: f' d="{_shorter(m[1])}"', body)
    tag = f"s{zlib.crc32(body.encode()):x}"
    for count, name in enumerate(dict.fromkeys(re.findall(r' id="(\w+)"', body))):
        body = re.sub(rf'(?<=["#]){name}(?=["\)])', f"{tag}{count}", body)
    body = re.sub(r">\s+<", "><", re.sub(r"\s*\n\s*", " ", body)).strip()
    extent = f"max-width:{1.25 * width:.0f}px" if grow else f"width:{1.15 * width:.0f}px"
    return (
        f'<svg class="plot" role="img" aria-label="{html.escape(label)}" viewBox="0 0 {width:g} {height:g}" '
        f'style="{extent}">{body}'
    )


def _rounded(match: re.Match[str]) -> str:
    return f"{float(match[0]):.1f}".removesuffix(".0")


def _font(match: re.Match[str]) -> str:
    weight = f"font-weight: {match[1].strip()}; " if match[1].strip().isdigit() else ""
    return f"{weight}font-size: {match[2]}px"


def _shorter(path: str) -> str:
    """A path without spaces that say nothing; a stroke of no length stays one."""
    path = re.sub(r"\s+", " ", path).strip()
    path = re.sub(r"M ([-\d.]+ [-\d.]+) L \1(?= M|$)", r"M\1h0", path)
    path = re.sub(r"M ([-\d.]+) ([-\d.]+) L \1 ([-\d.]+)(?= M|$)", r"M\1 \2V\3", path)
    return re.sub(r" ?([MLCQzZ]) ?", r"\1", path)
