"""What a model lacks, on one picture: the answer, and unseen data as measured and as predicted."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.gap.result import Course, Gap
from dropo_torch.report import gap_words as words
from dropo_torch.report.figures.drawing import BLUE, CLOUD, GRAY, INK, ORANGE, new_axes, new_figure
from dropo_torch.report.figures.gap import draw_course
from dropo_torch.support.files import write_atomically

#: Size in points; dots per inch of 72 points.
WIDTH, HEIGHT, DPI = 1152, 648, 120
#: Lines of the answer's items, and courses, that have room.
MOST_LINES, MOST_COURSES = 6, 2


def write_gap_picture(path: str | Path, gap: Gap) -> bool:
    """Write the answer as a picture in PNG, whole or not at all; return whether there is something to draw.

    Args:
        path: the file.
        gap: the result. One whose answer is by forces at the joints has no predictions to draw.
    """
    if not gap.courses:
        return False
    figure = new_figure(WIDTH, HEIGHT)
    figure.patch.set(visible=True, facecolor="white")
    bottom = _say(figure, gap)
    _draw(figure, gap, bottom)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
    write_atomically(Path(path), stream.getvalue())
    return True


def _say(figure: Any, gap: Gap) -> float:
    """Write the answer, and return the height in points that is left below it."""
    headline, items = words.answer(replace(gap, remaining=None, own_step=None))
    said = [words.change(gap)]
    said += [] if gap.remaining is None else [f"They do not explain everything: {words.left(gap.remaining)}."]
    lines = [(line, 23, "bold", INK) for line in textwrap.wrap(headline, 74)]
    lines += [(line, 15, "normal", INK) for line in _listed(items)]
    lines += [(line, 13, "normal", GRAY) for text in said for line in textwrap.wrap(text, 146)]
    height = HEIGHT - 30.0
    for text, size, weight, color in lines:
        height -= 1.5 * size
        figure.text(48 / WIDTH, height / HEIGHT, text, size=size, weight=weight, color=color, va="bottom")
    return height - 24


def _listed(items: Sequence[str]) -> list[str]:
    """The lines of as many items as have room."""
    lines: list[str] = []
    for shown, item in enumerate(items):
        own = textwrap.wrap(f"–  {item}", 126, subsequent_indent="    ")
        if len(lines) + len(own) > MOST_LINES:
            return [*lines, f"–  and {len(items) - shown} more"]
        lines += own
    return lines


def _draw(figure: Any, gap: Gap, height: float) -> None:
    """Draw the courses side by side below, with a legend."""
    named = any(words.is_named(e) for e in gap.effects)
    shown = sorted(gap.courses, key=_gained, reverse=True)[:MOST_COURSES]
    wide = WIDTH / len(shown)
    for i, course in enumerate(shown):
        axes = new_axes(figure, (wide * i + 84, 62, WIDTH - wide * (i + 1) + 24, HEIGHT - height + 26))
        draw_course(axes, course, named=named, width=1.5)
        axes.tick_params(labelsize=13)
        axes.set_xlabel("time in unseen data (s)", size=14)
        axes.set_ylabel(f"{course.label}{f' ({course.unit})' if course.unit else ''}", size=14)
    legend = [("measured", CLOUD), ("model as given" if named else "your model", ORANGE)]
    legend += [("with what was missing", BLUE)] if named else []
    place = 84.0
    for text, color in legend:
        figure.text(place / WIDTH, (height - 12) / HEIGHT, text, size=15, weight="bold", color=color, va="center")
        place += 9.2 * len(text) + 30


def _gained(course: Course) -> float:
    """By how much effects improve the prediction of a position, in units of its motion; without any, the error."""
    before, after = (
        float(np.sqrt(np.nanmean((line - course.measured) ** 2))) if np.isfinite(line).any() else 0.0
        for line in (course.before, course.after)
    )
    gained = before if np.array_equal(course.before, course.after, equal_nan=True) else before - after
    return gained / (float(np.ptp(course.measured)) or 1.0)
