"""`python -m studies.hmc.exactness` in miniature."""

from __future__ import annotations

import pytest

from studies.hmc import exactness


@pytest.mark.slow
def test_averages_are_known(tmp_path):
    rows = exactness.study(exactness.ExactnessSettings(trials=200, processes=1, out=tmp_path)).tables["rows"]
    assert rows.groupby("model", sort=False).size().tolist() == [4, 4, 4, 4]
    # Errors of so few trials, which are not independent, are too small. A wrong ensemble is off by the mean itself.
    exact = rows[rows["name"].isin(["cosine", "volume of the gas", "p^2 / m kT"])]
    assert (exact["mean"] / exact["exact"]).between(0.7, 1.4).all()
    assert (tmp_path / "exactness.json").exists()
