"""The table of segments to be flown again."""

from __future__ import annotations

import csv
import io

from daemon.planning.model import PlannedLine, Point
from daemon.planning.reflight_files import TABLE_COLUMNS, table
from daemon.planning.reflight_planning import Segment

START, END = Point(47.0731, 15.43), Point(47.0758, 15.43)
LINE = PlannedLine("=1+1", Point(47.07, 15.43), Point(47.08, 15.43))


def test_a_table_has_units_in_its_header_and_no_formula() -> None:
    segment = Segment(LINE, 340.0, 640.5, START, END, ("exposures 6, 7: lost",))
    text = table([segment], simulated=True)
    (row,) = csv.DictReader(io.StringIO(text))
    assert tuple(row) == TABLE_COLUMNS
    assert (row["line"], row["from_m"], row["length_m"]) == ("'=1+1", "340.0", "300.5")
    assert 47.07 < float(row["start_latitude_deg"]) < float(row["end_latitude_deg"]) < 47.08
    assert (row["simulated"], row["reasons"]) == ("1", "exposures 6, 7: lost")
    assert text.count("\r\n") == 2
