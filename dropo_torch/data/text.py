"""Logs of text in columns: where the rows begin, what names their columns, and in which units.

Loggers and scopes write more than a header above the rows: comments, what was recorded and when, several lines of
names, their units. The rows tell themselves apart by their numbers; the names are in the last line above them whose
cells all differ, or in that and the lines above it.
"""

from __future__ import annotations

import bz2
import csv
import gzip
import lzma
import re
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np

from dropo_torch.data.tables import Table, frame_table
from dropo_torch.errors import InputError
from dropo_torch.support.extras import extra
from dropo_torch.support.given import MOST_TEXT, reading

if TYPE_CHECKING:
    import pandas as pd

#: How text files end, and how they are packed.
_KINDS = (".csv", ".tsv", ".txt", ".dat", ".log", ".asc")
_PACKED: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
#: How text files end, packed or not.
TEXT = tuple(f"{kind}{packed}" for kind in _KINDS for packed in ("", *_PACKED))
#: What separates columns, the likeliest first; a blank stands for any number of them.
SEPARATORS = (",", ";", "\t", " ")
#: Lines that are looked at, and the share of the last half of these that a separator must part alike.
LOOKED_AT, ALIKE = 400, 0.8
#: Rows that must follow on each other for the first of them to be one.
FOLLOW = 3
#: Share of a row's numbers that must be some for it to be the first: a name may be a number, too.
SURE = 0.9
#: How lines begin that are comments.
_COMMENTS = ("#", "%", "//")
#: Numbers with a comma before their decimals, and whole ones with one before every thousand, which look alike.
_DECIMAL_COMMA = r"[-+]?\d*(,\d*)?([eE][-+]?\d+)?"
_THOUSANDS = r"[-+]?(0|[1-9]\d{0,2}(,\d{3})*)"
#: Dates and times of day.
_DATE = re.compile(r"[-+:./TZ \d]*\d[:-]\d[-+:.,/TZ \d]*")
#: Units, and what a line of them is called.
_UNIT = re.compile(
    r"[\[(]?((m|c|k|µ|μ|u|n)?(s|sec|m|rad|N|Nm|N·m|N\*m|N m|g|V|A)|deg|degrees?|°|º|rev|rpm|Hz|%|-|1|°C|C|bar|Pa|"
    r"counts?|ticks)([/·*]?(s|sec|min|s\^?2|s²))?[\])]?"
)
_UNITS = ("unit", "units", "einheit", "einheiten")
#: Where what was recorded says in which unit lengths are, as exports of motion capture do; the words for these.
_LENGTHS = re.compile(r"\b(?:length|position|distance|translation)\s*units?\b[\s,;:=\"]*([A-Za-z]+)", re.IGNORECASE)
_LENGTH_WORDS = {
    "mm": "mm", "millimeter": "mm", "millimetre": "mm", "cm": "cm", "centimeter": "cm", "centimetre": "cm", "m": "m",
    "meter": "m", "metre": "m", "inch": "inch", "inches": "inch",
}  # fmt: skip
#: Names of lengths along an axis.
_LENGTH = re.compile(r"(?:.*[\W_])?(?:pos|position|translation|location)[\W_]*(?:.*[\W_])?[XYZ]", re.IGNORECASE)


@dataclass(frozen=True)
class Head:
    """What stands above the rows.

    Attributes:
        lines: how many lines there are above the first row.
        names: of the columns; empty where nothing names them.
        width: how many columns the rows have.
    """

    lines: int
    names: tuple[str, ...]
    width: int


def open_text(path: Path, separator: str | None) -> list[Table]:
    """Text in columns, one row a sample below what names them."""
    with extra("formats", str(path)):
        import pandas as pd
    separator = separator or ("\t" if ".tsv" in path.suffixes else ",")
    with reading(path, "a table of text"):
        lines = first_lines(path)
        head = find_head(lines, separator)
    refuse = f"{path}: cannot be read as a table of text"
    if not any(map(str.strip, lines)) or any("\0" in line for line in lines):
        raise InputError(f"{refuse}: it {'holds other things' if lines else 'is empty'}")
    if not head.names:
        raise InputError(f"{refuse}: nothing above its rows names their columns; write a line of names there")
    if head.width != len(head.names):
        raise InputError(f"{refuse}: {len(head.names)} names stand above rows of {head.width} columns")
    with (
        reading(path, "a table of text"),
        warnings.catch_warnings(action="error", category=pd.errors.ParserWarning),  # rows longer than the header
    ):
        read: Callable[..., Any] = partial(
            pd.read_csv, path, sep=r"\s+" if separator == " " else separator, skipinitialspace=True, index_col=False,
            low_memory=False, header=None, names=range(len(head.names)), skiprows=head.lines,
            encoding_errors="replace",
        )  # fmt: skip
        frame = read()
        if separator != "," and _has_decimal_commas(frame):
            frame = read(decimal=",")
        frame.columns = pd.Index([name or f"Unnamed: {i}" for i, name in enumerate(head.names)])
    _check(frame, path, separator)
    return [frame_table(str(path), frame)]


def _check(frame: pd.DataFrame, path: Path, separator: str) -> None:
    """Refuse what was read in another way than it was written."""
    twice = frame.columns[frame.columns.duplicated()]
    if len(twice):
        raise InputError(f"{path}: two columns are named {str(twice[0])!r}; give each a name of its own")
    for name in frame.columns[[kind.kind not in "biuf" for kind in frame.dtypes]]:
        rows = np.flatnonzero(frame[name].astype(str).str.contains("[\n\r]"))
        if rows.size:
            raise InputError(
                f"{path}: {name} has a line break at row {rows[0]} (counted from 0); is a quotation mark left open?"
            )
    only = str(frame.columns[0])
    other = next((mark for mark in ";\t, " if mark != separator and mark in only), None)
    if len(frame.columns) == 1 and other is not None:
        raise InputError(f"{path}: its one column is {only!r}; separator: {other!r} may be what is meant")


def first_lines(path: Path) -> list[str]:
    """Return the first lines of a text file, packed or not."""
    with cast(IO[bytes], _PACKED.get(path.suffix.lower(), open)(path, "rb")) as file:
        lines = [file.readline(MOST_TEXT) for _ in range(LOOKED_AT)]
    text = [line.decode("utf-8-sig", errors="replace").rstrip("\r\n") for line in lines if line]
    return text


def find_separator(lines: Sequence[str]) -> str | None:
    """Return what separates the columns of lines of text: what makes the most numbers of them; ``None`` for nothing."""
    found = {mark: _numbers_of(_rows(lines, mark)) for mark in SEPARATORS}
    best = max(SEPARATORS, key=lambda mark: found[mark])
    return best if found[best] else None


def find_head(lines: Sequence[str], separator: str) -> Head:
    """Return what stands above the rows of a text.

    Args:
        lines: its first lines.
        separator: of its columns.
    """
    rows = _rows(lines, separator)
    width, numeric = _shape(rows)
    first = next((i for i in range(len(rows)) if _begins(rows[i:], width, numeric)), None)
    if first is None:  # no numbers: the first line is all that can name what there is
        first = next((i + 1 for i, line in enumerate(lines) if line.strip()), 0)
    told = [i for i in range(first) if not lines[i].lstrip().startswith(_COMMENTS)]
    closed = width > 2 and not any(row[-1] for row in rows[first:] if len(row) == width)  # by a separator
    above = _last_block([rows[i] for i in told], (width - 1, width) if closed else (width,))
    if not above:
        bare = [_cells(line.strip().lstrip("".join(_COMMENTS)).strip(), separator) for line in lines[:first]]
        above = [row for row in bare if len(row) == width][-1:]
    if not above and told:
        above = [rows[told[-1]]]  # of another number of columns than the rows, as reading them will tell
    return Head(first, tuple(_in_lengths(_named(above), lines[:first])), width)


def _last_block(rows: Sequence[Sequence[str]], widths: Sequence[int]) -> list[list[str]]:
    """The last lines of so many cells, without one between them that is none."""
    begin = len(rows)
    while begin and any(rows[begin - 1]) and len(rows[begin - 1]) in widths:
        begin -= 1
    return [[*row, *[""] * (max(widths) - len(row))] for row in rows[begin:]]


def _rows(lines: Sequence[str], separator: str) -> list[list[str]]:
    return [_cells(line, separator) for line in lines]


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split() or [""]
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [""])] or [""]


def _shape(rows: Sequence[Sequence[str]]) -> tuple[int, list[int]]:
    """How many columns most of the last rows have, and which of these hold numbers there."""
    last = rows[len(rows) // 2 :]
    width = Counter(len(row) for row in last).most_common(1)[0][0] if last else 0
    alike = [row for row in last if len(row) == width]
    return width, [c for c in range(width) if sum(_is_value(row[c]) for row in alike) >= 0.5 * len(alike)]


def _numbers_of(rows: Sequence[Sequence[str]]) -> int:
    """How many columns of numbers rows have, if they have as many columns each; 0 elsewhere."""
    width, numeric = _shape(rows)
    last = rows[len(rows) // 2 :]
    alike = sum(len(row) == width for row in last) >= ALIKE * len(last)
    return len(numeric) if alike and width > 1 else 0


def _begins(rows: Sequence[Sequence[str]], width: int, numeric: Sequence[int]) -> bool:
    """Whether rows of numbers begin here."""
    if not numeric or any(len(row) != width for row in rows[:FOLLOW]):
        return False
    told = [[row[c] for c in numeric if row[c]] for row in rows[:FOLLOW]]
    shares = [sum(map(_is_value, cells)) / max(len(cells), 1) for cells in told]
    return shares[0] >= SURE and min(shares) >= 0.5


def _is_value(cell: str) -> bool:
    """Whether a cell holds a number, a date, or a time of day."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return bool(_DATE.fullmatch(cell))
    return True


def _named(above: Sequence[Sequence[str]]) -> list[str]:
    """The names that some lines give, with their units."""
    units = next((row for row in reversed(above[1:]) if _are_units(row)), None)
    rest = [row for row in above if row is not units]
    if not rest:
        return []
    own = next((row for row in reversed(rest) if all(row[:-1]) and _are_apart(row)), None)
    names = list(own or _joined(rest))
    if units is not None:
        told = [unit.strip("[]()") if _UNIT.fullmatch(unit) else "" for unit in units]
        names = [f"{n} ({u})" if u and n and f"({u})" not in n else n for n, u in zip(names, told, strict=True)]
    return names


def _in_lengths(names: Sequence[str], lines: Sequence[str]) -> list[str]:
    """Names with the unit of lengths that lines above them tell, at those of positions along an axis."""
    told = [found[1].lower() for line in lines for found in [_LENGTHS.search(line)] if found]
    units = {_LENGTH_WORDS.get(word) or _LENGTH_WORDS.get(word.removesuffix("s")) for word in told} - {None}
    if len(units) != 1:
        return list(names)
    (unit,) = units
    return [f"{name} ({unit})" if _LENGTH.fullmatch(name) else name for name in names]


def _are_apart(row: Sequence[str]) -> bool:
    """Whether the cells of a line all differ, and none is a number."""
    return len(set(row)) == len(row) and not any(map(_is_value, row))


def _joined(rows: Sequence[Sequence[str]]) -> list[str]:
    """The last of some lines, with as much before it of those above as tells its cells apart."""
    names = list(rows[-1])
    for row in reversed(rows[:-1]):
        if len({n for n in names if n}) == sum(bool(n) for n in names):
            break
        names = [f"{more} {name}".strip() for more, name in zip(row, names, strict=True)]
    return names


def _are_units(row: Sequence[str]) -> bool:
    """Whether a line says units: the first cell may say that it does."""
    cells = row[1:] if row[0].lower() in _UNITS else row
    told = [cell for cell in cells if cell]
    return len(told) >= 0.5 * len(cells) > 0 and all(_UNIT.fullmatch(cell) for cell in told)


def _has_decimal_commas(frame: pd.DataFrame) -> bool:
    """Whether columns of text are numbers with a comma before their decimals, and not one before every thousand."""
    kinds = [kind.kind not in "biuf" for kind in frame.dtypes]
    texts = [frame[name].dropna().astype(str).str.strip() for name in frame.columns[kinds]]
    numbers = [t for t in texts if len(t) and t.str.fullmatch(_DECIMAL_COMMA).all()]
    return any(not t.str.fullmatch(_THOUSANDS).all() for t in numbers)
