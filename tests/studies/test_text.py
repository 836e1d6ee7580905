"""Tables of results as text."""

import math

import pandas as pd
import pytest

from studies import text

ROWS = pd.DataFrame(
    [
        ("SIER2", 2.0, 0.83, 0.02, math.nan),
        ("SIER4G", 2.0, 0.08, math.nan, math.nan),
        ("SIER2", 1.0, 0.19, 0.01, math.nan),
    ],
    columns=["method", "h", "percent", "percent_error", "unknown"],
)


def test_a_column_for_each_heading():
    """Columns in which nothing is known are left out."""
    columns = {"scheme": "{method}", "fs": "{h:g}", "%": "{percent_text}", "what": "{unknown}"}
    result = text.table(ROWS, columns)
    assert list(result.columns) == ["scheme", "fs", "%"]
    assert result.to_numpy().tolist() == [
        ["SIER2", "2", "0.830 ± 0.020"],
        ["SIER4G", "2", "0.08 ± ?"],
        ["SIER2", "1", "0.190 ± 0.010"],
    ]


def test_a_column_for_each_value_in_a_heading():
    result = text.table(ROWS[::-1], {"fs": "{h:g}", "{method}, %": "{percent:.2f}"})
    assert list(result.columns) == ["fs", "SIER2, %", "SIER4G, %"]
    assert result.to_numpy().tolist() == [["1", "0.19", "-"], ["2", "0.83", "0.08"]]


def test_missing_names_are_reported():
    with pytest.raises(ValueError, match="'per_cent'; there are method, h, percent"):
        text.table(ROWS, {"%": "{per_cent:.2f}"})
    with pytest.raises(ValueError, match="'liquid'"):
        text.table(ROWS, {"fs": "{h:g}", "{liquid}": "{percent:.2f}"})


def test_no_rows():
    assert text.table(ROWS[:0], {"fs": "{h:g}", "{method}": "{percent:.2f}"}).empty


def test_cells_of_known_and_unknown_numbers():
    assert text.cell("{x:.1f} ± {e:.1f}", {"x": 1.0, "e": math.nan}) == "1.0"
    assert text.cell("{x:.1f} ± {e:.1f}", {"x": math.nan, "e": 1.0}) == "-"
    assert text.cell("a nanosecond, {x}", {"x": 2}) == "a nanosecond, 2"


def test_markdown():
    result = text.table(ROWS[:1], {"scheme": "{method}", "%": "{percent:.2f}"})
    assert text.markdown(result).splitlines() == ["| scheme | % |", "| --- | --- |", "| SIER2 | 0.83 |"]
