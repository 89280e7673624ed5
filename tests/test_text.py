"""What stands above the rows of a text is told from them, and names their columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dropo_torch.data.readers import read_recording
from dropo_torch.data.text import find_head, find_separator
from dropo_torch.errors import InputError

ROWS = "0.00{0}1.5{0}-2\n0.01{0}1.6{0}-3\n0.02{0}1.7{0}-4\n0.03{0}1.8{0}-5\n"
HEADS = {
    "a line of names": (",", "t,q,u\n", ["t", "q", "u"]),
    "names that are numbers": (",", "time,1,2\n", ["time", "1", "2"]),
    "what was recorded": (";", "Trace: A1\nRobot: arm; No 7\n\nZeit [ms];q [°];u\n", ["Zeit [ms]", "q [°]", "u"]),
    "units below names": ("\t", "t\tq\tu\nms\tdeg\tN·m\n", ["t (ms)", "q (deg)", "u (N·m)"]),
    "units that are called so": (
        "\t", "File\tC:\\run\nName\tAxis.q\tAxis.u\nData-Type\tREAL64\tREAL64\nSampleTime[ms]\t4\t4\nUnit\tmm\tN\n",
        ["Name", "Axis.q (mm)", "Axis.u (N)"],
    ),
    "names in several lines": (
        ",", "Rate,120.0\n\n,Body,Body\n,Rotation,Position\nTime,X,X\n", ["Time", "Rotation X", "Position X"],
    ),
    "the unit of lengths": (
        ",", "Length Units,Millimeters,Rotation Type,XYZ\n\n,Box,Box\n,Rotation,Position\nt,X,X\n",
        ["t", "Rotation X", "Position X (mm)"],
    ),
    "a comment": (" ", "# of May 3\n# t q u\n", ["t", "q", "u"]),
    "a comment above names": (",", "% exported\nt,q,u\n", ["t", "q", "u"]),
    "an empty line": (",", "\nt,q,u\n", ["t", "q", "u"]),
}  # fmt: skip


@pytest.mark.parametrize(("separator", "above", "names"), HEADS.values(), ids=HEADS)
def test_the_lines_above_rows_name_their_columns(separator: str, above: str, names: list[str]) -> None:
    lines = (above + ROWS.format(separator)).splitlines()
    assert find_separator(lines) == separator
    head = find_head(lines, separator)
    assert list(head.names) == names
    assert head.lines == len(above.splitlines())


def test_a_separator_at_the_end_of_rows_is_no_column_without_a_name() -> None:
    lines = ("t,q,u\n" + ROWS.format(",").replace("\n", ",\n")).splitlines()
    assert find_head(lines, ",").names == ("t", "q", "u", "")


def test_decimal_commas_separate_nothing() -> None:
    lines = ["t;q;u", *(f"0,{i:02d};1,5;-{i},25" for i in range(20))]
    assert find_separator(lines) == ";"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1,2,3\n2,3,4\n3,4,5\n", "nothing above its rows names their columns"),
        ("t,q\n0,1,2\n1,2,3\n2,3,4\n", "2 names stand above rows of 3 columns"),
        ("\n\n", "it holds other things"),
    ],
)
def test_a_text_whose_columns_have_no_names_is_refused(text: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(InputError, match=rf"log\.csv: cannot be read as a table of text: {why}"):
        read_recording(tmp_path / "log.csv", observations="q", actions=[], dt=0.1)


def test_times_of_day_go_on_after_midnight(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("clock,q\n23:59:59.900,1\n23:59:59.950,2\n00:00:00.000,3\n00:00:00.050,4\n")
    log = read_recording(tmp_path / "log.csv", observations="q", actions=[], time="clock")
    np.testing.assert_allclose(log.time, [0.0, 0.05, 0.1, 0.15], atol=1e-9)
