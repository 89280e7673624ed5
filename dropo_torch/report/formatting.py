"""Numbers and lists as people read them; the filters of the templates."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

#: Lists in sentences name at most this many.
MOST_NAMED = 6


def plain(value: float) -> str:
    """Return a short number with a true minus, 20k for 20000."""
    if not np.isfinite(value):
        return "n/a" if np.isnan(value) else "∞" if value > 0 else "−∞"
    value = 0.0 if abs(value) < 1e-300 else value
    if 1e4 <= abs(value) < 1e9:
        scaled, suffix = (value / 1e6, "M") if abs(value) >= 1e6 else (value / 1e3, "k")
        return f"{scaled:.4g}{suffix}".replace("-", "−")
    text = f"{value:.4g}" if abs(value) >= 1e-3 or value == 0 else f"{value:.3g}"
    return re.sub(r"e([+-])0*", lambda m: "e" + m[1].replace("+", ""), text).replace("-", "−")


def number(value: float, uncertainty: float = float("nan")) -> str:
    """Return a number to two digits of its uncertainty, or to four digits where that is not known."""
    if value == 0 or not np.isfinite(value):
        return plain(value)
    digits = 4
    if np.isfinite(uncertainty) and uncertainty > 0:
        digits = int(np.clip(np.floor(np.log10(abs(value))) - np.floor(np.log10(uncertainty)) + 2, 2, 6))
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e" in text or not 1e-4 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", "−")


def thousands(value: float, decimals: int = 0) -> str:
    """Return a number with commas between its thousands."""
    return f"{value:,.{decimals}f}".replace("-", "−")


def nats(value: float) -> str:
    """Return a log-likelihood."""
    return thousands(value, 1) if abs(value) < 1e9 else number(value)


def score(value: float) -> str:
    """Return a score: three digits, or whole numbers where it is large."""
    if 1000 <= abs(value) < 1e9:
        return thousands(value)
    if not 1e-4 <= abs(value) < 1e6:
        return short(value)
    return f"{value:#.3g}".rstrip(".").replace("-", "−")


def short(value: float) -> str:
    """Return a number with three digits at most, or whole where it is large."""
    value = float(f"{value:.3g}")
    return thousands(value) if 1000 <= abs(value) < 1e9 else plain(value)


def rms(value: float) -> str:
    """Return a standardized root mean square, to what matters of it."""
    if not np.isfinite(value):
        return "n/a"
    return f"{value:.2f}" if 0.095 <= value < 10 else f"{value:.2g}" if value < 10 else number(round(value, 0), 1.0)


def signed(value: float, digits: int = 2) -> str:
    """Return a number with its sign, zero without one."""
    if not np.isfinite(value):
        return plain(value)
    text = f"{value:+.{digits}f}"
    return text[1:] if not text.strip("+-0.") else text.replace("-", "−")


def percent(share: float) -> str:
    """Return a share in percent."""
    if not np.isfinite(share):
        return "not known"
    size = abs(100 * share)
    if size == 0:
        return "0\u00a0%"
    if size < 0.001:
        return "below 0.001\u00a0%"
    if 0 < 100 - size < 1:
        text = "100" if size > 99.995 else f"{size:.2f}" if 100 - size < 0.1 else f"{size:.1f}"
    else:
        text = f"{size:.0f}" if size >= 10 else f"{size:.2g}"
    return f"{'−' if share < 0 else ''}{text}\u00a0%"


def css(share: float) -> str:
    """Return a share, cut to [0, 1], as a length in a style; zero where it is not known."""
    return f"{100 * float(np.clip(np.nan_to_num(share), 0, 1)):.1f}%"


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    if not np.isfinite(seconds):
        return "n/a"
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.3g} min" if seconds < 6000 else f"{seconds / 3600:.3g} h"


def plural(thing: str, count: int) -> str:
    """Return a noun as its count wants it."""
    return thing if count == 1 else f"{thing}s"


def whole(count: int, thing: str) -> str:
    """Return a count with its noun."""
    return f"{count:,} {plural(thing, count)}"


def joined(items: Sequence[str], most: int = MOST_NAMED, *, last: str = "and", rest: str = "{} more") -> str:
    """Return a list in words, with ``last`` before its last item; after ``most`` items, the ``rest`` is counted."""
    if len(items) > most:
        items = [*items[:most], rest.format(len(items) - most)]
    return f" {last} ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def with_unit(text: str, unit: str) -> str:
    """Return a number with its unit, if it has one."""
    return f"{text} {unit}" if unit else text


FILTERS = (plain, number, thousands, nats, score, short, rms, signed, percent, css, duration, plural, joined)
