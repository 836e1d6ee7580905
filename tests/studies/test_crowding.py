"""The crowd of proteins in miniature, with a small protein in the place of DHFR."""

import numpy as np
import pytest

from studies import crowding, records
from studies.crowding import CrowdSettings, Followed, Protein
from tests.support.cages import cage
from tests.support.reports import Told


def test_diffusion_of_bodies_that_turn_and_move_evenly():
    """Frames a step of motion apart: 1 nm along x, and a turn about z by an angle, within `LAG`."""
    lag = round(crowding.LAG / crowding.EVERY)
    times, angle = np.arange(2 * lag) / lag, 0.3
    c, s = np.cos(times * angle), np.sin(times * angle)
    attitudes = np.array([[c, -s, 0 * c], [s, c, 0 * c], [0 * c, 0 * c, 1 + 0 * c]])
    centres = np.array([times, 0 * times, 0 * times]).T[:, :, None]
    two = [np.repeat(values, 2, axis=-1) for values in (centres, np.moveaxis(attitudes, 2, 0)[..., None])]
    found = crowding.diffusion(Followed(*two, 0.0))
    assert found["translation"] == pytest.approx(1 / (6 * crowding.LAG))
    assert found["rotation"] == pytest.approx(-np.log((1 + 2 * np.cos(angle)) / 3) / (2 * crowding.LAG))
    assert found["translation_error"] == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
def test_crowding_in_miniature(tmp_path, monkeypatch):
    """Free bodies diffuse as they should: 27 of them over 20 independent lags have an error of 4 %; four of these.

    Nothing acts on them but noise, so that it is that of the seed on every machine. Of the crowd no number is known.
    """
    monkeypatch.setattr(crowding, "dhfr", lambda: Protein(cage()[::5], np.full(12, 1500.0)))
    monkeypatch.setattr(crowding, "cost_in_water", lambda settings: [{"protein": "one body"}])
    monkeypatch.setattr(crowding, "WATER_COLUMNS", {"protein": "{protein}"})
    settings = CrowdSettings(out=tmp_path, fractions=(0.3,), time=4000, settle=20, step=400, platform="CPU")
    told = Told()
    record = crowding.study(settings, told)
    free, notes = record.tables["crowds"].iloc[0], record.notes
    assert free["translation"] == free["rotation"] == 1
    assert notes["free"]["translation"] == pytest.approx(notes["known"], rel=0.15)
    assert 0 < record.tables["crowds"].iloc[1]["translation"] != 1
    assert (tmp_path / "crowding.png").stat().st_size > 10_000
    assert len(records.read(tmp_path / "crowding.json").tables["crowds"]) == 2
    with pytest.raises(ValueError, match="cube of a whole number"):
        crowding.study(CrowdSettings(out=tmp_path, copies=9))
    with pytest.raises(ValueError, match="time must be at least 400 ps"):
        crowding.study(CrowdSettings(out=tmp_path, time=100))
