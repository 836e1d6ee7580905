"""Logs of runs, read back."""

import numpy as np
import pytest

from openmm_sier.analysis import read_log


@pytest.mark.parametrize("rows", [[[0.5, -1.25]], [[0.5, -1.25], [1.0, float("nan")]]], ids=["one row", "two rows"])
def test_columns_have_their_names(tmp_path, rows):
    path = tmp_path / "run.csv"
    path.write_text("Time (ps),Energy (kJ/mol)\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    log = read_log(str(path))
    assert list(log) == ["Time (ps)", "Energy (kJ/mol)"]
    np.testing.assert_array_equal(np.array(list(log.values())).T, rows)


@pytest.mark.parametrize("row", ["1.0", "1.0,2.0,3.0", "1.0,words"])
def test_a_damaged_row_is_an_error_that_names_the_file(tmp_path, row):
    path = tmp_path / "run.csv"
    path.write_text(f"Time (ps),Energy (kJ/mol)\n{row}\n")
    with pytest.raises(ValueError, match=r"run\.csv"):
        read_log(path)
