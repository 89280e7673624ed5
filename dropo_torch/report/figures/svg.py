"""Figures as inline SVG: the same string for the same figure, without ids, dates or addresses of its own."""

from __future__ import annotations

import html
import io
import re
import warnings
import zlib
from typing import Any

from markupsafe import Markup


def to_svg(figure: Any, label: str = "", *, grow: bool = True) -> Markup:
    """Return a figure as an ``<svg>`` element.

    Args:
        figure: a matplotlib ``Figure``.
        label: what it shows, for screen readers; the figure's own label where empty.
        grow: scale with the page, up to a quarter beyond its natural size.
    """
    import matplotlib

    stream = io.StringIO()
    settings = {"svg.hashsalt": "dropo_torch", "svg.fonttype": "none", "path.simplify": False}
    with matplotlib.rc_context(settings), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # the reader's fonts draw the text
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return Markup(_inline(stream.getvalue(), label or figure.get_label(), grow))


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
