"""What the figures share: canvas and axes in one style, few round ticks, dots and strokes that take few bytes.

Everything is drawn for a white page in the colors of Okabe and Ito, which color-blind readers tell
apart. Figures are small panels that a page arranges; names and units are the page's business, so that
they wrap and can be searched. Dense data are thinned to what the eye can separate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from dropo_torch.report.formatting import duration, plain

INK, GRAY, FAINT, CLOUD, GRID = "#1f2933", "#7b8794", "#d5dbe1", "#a3afbb", "#edf0f3"
BLUE, SKY, ORANGE = "#0072b2", "#cfe6f5", "#d55e00"
#: Colors of lines that must be told apart.
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c6d31")
#: Points of a curve, and of a log's overview, are thinned to about this many.
MAX_POINTS = 120
#: Labels inside figures are shortened to this many characters.
MAX_LABEL = 28
#: Margins of axes: left, bottom, right and top, in pixels.
Margins = tuple[float, float, float, float]
Which = Literal["x", "y"]


@dataclass(frozen=True)
class Axis:
    """An axis of a parameter: its ends, and whether it is logarithmic."""

    low: float
    high: float
    is_log: bool = False


def new_figure(width: float, height: float, label: str = "") -> Any:
    """Return an empty figure of a size in CSS pixels, with a label for screen readers."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 72, height / 72), dpi=72)  # the SVG's points are scaled to pixels
    FigureCanvasAgg(figure)
    figure.patch.set_visible(False)
    figure.set_label(label)
    return figure


def new_axes(figure: Any, margins: Margins, *, grid: Literal["x", "y", "both"] | None = None) -> Any:
    """Add axes in the style of all figures."""
    width, height = figure.get_size_inches() * 72
    left, bottom, right, top = margins
    axes = figure.add_axes(
        (left / width, bottom / height, (width - left - right) / width, (height - bottom - top) / height)
    )
    axes.patch.set_visible(False)
    axes.tick_params(length=3, width=0.7, color=GRAY, labelcolor=INK, labelsize=9.5, pad=2)
    for side, spine in axes.spines.items():
        spine.set(color=GRAY, linewidth=0.7, visible=side in ("left", "bottom"))
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=INK, fontsize=9.5, parse_math=False)
    if grid is not None:
        axes.grid(axis=grid, color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
    return axes


def new_panel(
    width: float, height: float, label: str, margins: Margins, grid: Literal["x", "y", "both"] | None = None
) -> tuple[Any, Any]:
    """Return a figure of one pair of axes, and these."""
    figure = new_figure(width, height, label)
    return figure, new_axes(figure, margins, grid=grid)


def log_scale(axes: Any, which: Which) -> None:
    """Make an axis logarithmic; around values that are one but for rounding, it has an octave each way."""
    from matplotlib.scale import LogScale
    from matplotlib.ticker import LogLocator

    class Decades(LogLocator):
        def nonsingular(self, vmin: float, vmax: float) -> tuple[float, float]:
            rests = 0 < vmin <= vmax <= vmin * (1 + 1e-9)
            return super().nonsingular(*((vmin / 2, vmax * 2) if rests else (vmin, vmax)))

    class Scale(LogScale):
        def set_default_locators_and_formatters(self, axis: Any) -> None:
            super().set_default_locators_and_formatters(axis)
            axis.set_major_locator(Decades())

    axes.set(**{f"{which}scale": Scale(axes.xaxis if which == "x" else axes.yaxis)})
    axes.minorticks_off()


def show_axis(axes: Any, which: Which, axis: Axis, ticks: int) -> None:
    """Give an axis the ends and the scale of a parameter's, and few ticks."""
    if axis.is_log:
        log_scale(axes, which)
    axes.set(**{f"{which}lim": (axis.low, axis.high)})
    few_ticks(axes, *((ticks, 0) if which == "x" else (0, ticks)))


def few_ticks(axes: Any, x: int = 0, y: int = 0, *, whole: bool = False, least: int = 3) -> None:
    """Put few ticks with plain numbers on the axes, whose limits must be set if they are logarithmic.

    Args:
        axes: the axes.
        x, y: the most ticks of each axis; 0 leaves it alone.
        whole: whole numbers only.
        least: so many round values a logarithmic axis has at least, if it can.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator

    for axis, count in ((axes.xaxis, x), (axes.yaxis, y)):
        if not count:
            continue
        if axis.get_scale() == "log":
            axis.set_major_locator(FixedLocator(_log_ticks(axis, count, least)))
        else:
            steps = [1, 2, 5, 10] if whole else [1, 2, 2.5, 5, 10]
            axis.set_major_locator(MaxNLocator(count - 1, integer=whole, steps=steps, min_n_ticks=2))
        axis.set_major_formatter(FuncFormatter(lambda value, _: plain(value)))


def name_rows(axes: Any, names: list[str]) -> None:
    """Turn the vertical axis into rows, the first on top, each with its name."""
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0, pad=8, labelsize=11)
    axes.spines["left"].set_visible(False)


def say_empty(axes: Any) -> None:
    """Write that there is nothing to draw."""
    axes.text(0.5, 0.5, "no finite value", transform=axes.transAxes, ha="center", color=GRAY, fontsize=9.5)


def clock(axes: Any, cost: np.ndarray, seconds: np.ndarray) -> None:
    """Write the time above a horizontal axis of cost."""
    twin = axes.twiny()
    twin.patch.set_visible(False)
    twin.set_xlim(axes.get_xlim())
    ticks = [t for t in axes.get_xticks() if axes.get_xlim()[0] <= t <= axes.get_xlim()[1]]
    passed = np.interp(ticks, np.concatenate([[0], cost]), np.concatenate([[0], np.nan_to_num(seconds)]))
    twin.set_xticks(ticks, [duration(float(s)) for s in passed])
    twin.tick_params(length=3, width=0.7, color=GRAY, labelcolor=GRAY, labelsize=9.5, pad=2)
    for spine in twin.spines.values():
        spine.set_visible(False)


def dots(axes: Any, x: np.ndarray, y: np.ndarray, color: str) -> None:
    """Draw dots as strokes of no length with round caps: a tenth of the bytes of markers."""
    finite = np.isfinite(x) & np.isfinite(y)
    strokes(axes, x[finite], y[finite], y[finite], color, 2.6)


def strokes(axes: Any, x: np.ndarray, low: np.ndarray, high: np.ndarray, color: str, width: float) -> None:
    """Draw upright strokes, all as one path; the limits of the axes follow."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    if not len(x):
        return
    ends = np.stack([np.stack([x, low], -1), np.stack([x, high], -1)], 1).reshape(-1, 2)
    path = Path(ends, np.tile([Path.MOVETO, Path.LINETO], len(x)))
    path.should_simplify = False  # or strokes of no length are left out
    axes.add_patch(PathPatch(path, facecolor="none", edgecolor=color, linewidth=width, capstyle="round"))
    axes.autoscale_view()


def shorten(label: str, length: int = MAX_LABEL) -> str:
    """Return a label of at most ``length`` characters, its middle left out."""
    if len(label) <= length:
        return label
    head = (length - 1) // 2
    return f"{label[:head]}…{label[len(label) - (length - 1 - head) :]}"


def _log_ticks(axis: Any, count: int, least: int) -> list[float]:
    """Round values between the ends of an axis, even in the logarithm."""
    low, high = sorted(axis.get_view_interval())
    if not (0 < low < high < np.inf):
        return []
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    inside: list[float] = []
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)):
        values = [d * 10.0**e for e in range(first, last + 1) for d in digits]
        inside = [v for v in values if low * (1 - 1e-9) <= v <= high * (1 + 1e-9)]
        if len(inside) >= min(least, count):
            break
    if len(inside) < 2:
        return [float(v) for v in np.geomspace(low, high, 3)]
    return inside[:: max(1, -(-len(inside) // count))]
