"""`python -m studies.acceptance` in miniature: what it keeps, what it makes of it, and the noise of energies."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import openmm
import pandas as pd
import pytest

from openmm_sier import SIERIntegrator
from openmm_sier.measure import forcefields
from studies import acceptance, acceptance_trials, boxes, records
from studies.acceptance_trials import AcceptanceSettings
from tests.support.commands import SYSTEMS, write_lattice
from tests.support.reports import Told
from tests.support.waters import platform


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return AcceptanceSettings(
        out=out,
        box=write_lattice(out / "box.pdb"),
        sizes=(27,),
        schemes=("verlet", "sier4g"),
        trials=(3,),
        time=0.012,
        equilibrate=0.03,
        platform="CPU",
    )


@pytest.fixture(scope="module")
def finished(settings):
    told = Told()
    return acceptance.study(settings, told).tables["rows"], told


@pytest.mark.slow
def test_rows_and_files(finished, settings):
    rows, told = finished
    assert rows[["molecules", "method", "step", "length", "trials"]].values.tolist() == [
        [27, "Verlet, RATTLE", 2.0, 12.0, 3],
        [27, "SIER4G", 6.0, 12.0, 3],
    ]
    verlet, sier4g = rows.to_dict("records")
    assert 0 < sier4g["spread"] < verlet["spread"]
    assert 0 < verlet["acceptance"] <= 1
    # Forces of single precision on 27 molecules: 1e-7 of energies of 1000 kJ/mol.
    assert 0 < verlet["noise"] < 1e-3
    pd.testing.assert_frame_equal(records.read(settings.out / "acceptance.json").tables["rows"], rows)
    assert (settings.out / "acceptance.png").read_bytes().startswith(b"\x89PNG")
    assert [len(table.rows) for table in told.tables] == [2, 0]


@pytest.mark.slow
def test_nothing_is_measured_twice(finished, settings, monkeypatch):
    """What a directory has is taken from there, and what it lacks is added."""
    rows, _ = finished
    made = []

    def measured(begun, method, dt, trials, *others):
        made.append((method.name, dt))
        return trials_of(27, (0.1, None), method.name, dt)

    monkeypatch.setattr(acceptance_trials, "measure", measured)
    monkeypatch.setattr(acceptance_trials, "prepare", lambda *_, **__: pytest.fail("the box was equilibrated"))
    pd.testing.assert_frame_equal(acceptance.measure(settings), rows)
    assert not made
    more = acceptance.measure(dataclasses.replace(settings, schemes=("sier2",), dt=(3.0,)))
    assert made == [("SIER2", 3.0)]
    pd.testing.assert_frame_equal(more[:2], rows)
    # One of two trajectories could not be followed, and is rejected.
    assert more["acceptance"][2] == pytest.approx(0.5 * math.exp(-0.1))
    assert math.isnan(more["spread"][2])
    # More trials than there are.
    acceptance.measure(dataclasses.replace(settings, schemes=("sier4g",), trials=(4,)))
    assert made[1:] == [("SIER4G", 2.0)]
    with pytest.raises(ValueError, match=r"has results with time 0.012, got 0.03: take another directory"):
        acceptance.measure(dataclasses.replace(settings, time=0.03))


def trials_of(molecules, errors, method="SIER2", dt=2.0, broken=""):
    """What `acceptance_trials.measure` gives."""
    place = {"molecules": molecules, "method": method, "fs_per_force": dt, "step": dt, "length": 60.0}
    return place | {"errors": list(errors), "reversal": 1e-8, "noise": 1e-3, "broken": broken}


def normal(molecules, spread, trials=200):
    errors = 0.5 * spread**2 + spread * np.random.default_rng(4).normal(size=trials)
    return trials_of(molecules, errors)


def test_limits():
    """Spreads of boxes of 512 molecules and more are pooled; what was measured is told from what was not."""
    members = [normal(64, 5.0), *(normal(n, 0.02 * n**0.5) for n in (512, 4096, 32768))]
    refused = trials_of(512, (), "SIER4", broken="too long")
    rows = pd.DataFrame([acceptance.row_of(member) for member in (*members, refused)])
    (limit,) = acceptance.limits(rows).to_dict("records")
    assert limit["method"] == "SIER2"
    assert limit["spread"] == pytest.approx(0.02, abs=4 * limit["spread_error"])
    # (1.349/0.02)^2 = 4549.
    assert limit["measured"] == 4096
    assert limit["largest"] == pytest.approx(4549, abs=4 * limit["largest_error"])
    assert acceptance.expected_acceptance(limit["spread"] * limit["largest"] ** 0.5) == pytest.approx(0.5)
    # A spread that is larger by its error makes the box smaller by about as much as is said.
    smaller = limit["largest"] / (1 + limit["spread_error"] / limit["spread"]) ** 2
    assert limit["largest"] - smaller == pytest.approx(limit["largest_error"], rel=0.1)


def test_spreads_of_boxes_of_several_sizes_are_pooled(rng):
    sizes, trials, of_one = (100, 400, 1600), (4000, 1000, 250), 0.03
    spreads = [rng.normal(0, of_one * n**0.5, k).std(ddof=1) for n, k in zip(sizes, trials, strict=True)]
    rows = pd.DataFrame({"molecules": sizes, "trials": trials, "spread": spreads})
    value, error = acceptance.pooled_spread(rows)
    assert error == pytest.approx(of_one / (2 * 5250) ** 0.5, rel=0.05)
    assert abs(value - of_one) < 4 * error


@pytest.mark.parametrize(("name", "noisy"), [("Reference", False), ("CPU", True)])
def test_noise_of_the_energy(settings, name, noisy):
    box = forcefields.read_box(settings.box)
    context = openmm.Context(box.system, SIERIntegrator(0.001), platform(name))
    context.setPositions(box.positions)
    before = context.getState(positions=True).getPositions(asNumpy=True)
    # In double precision the second order in displacements of 1e-6 nm is left: of overlapping molecules 1e-5 kJ/mol.
    assert (acceptance_trials.energy_noise(context) > 2e-5) is noisy
    assert np.array_equal(context.getState(positions=True).getPositions(asNumpy=True), before)


def test_part_of_a_box():
    found = forcefields.read_box(SYSTEMS / "tip3p-512.pdb")
    part = boxes.of_size(found, SYSTEMS, 64)
    assert part.molecules == 64
    assert part.positions.shape == (192, 3)
    edges = [
        np.array([vector[i]._value for i, vector in enumerate(system.getDefaultPeriodicBoxVectors())])
        for system in (part.system, found.system)
    ]
    # An eighth of the molecules in an eighth of the volume.
    assert edges[0] == pytest.approx(edges[1] / 2)
    waters = part.positions.reshape(64, 3, 3)
    assert np.linalg.norm(waters[:, 1] - waters[:, 0], axis=1) == pytest.approx(0.09572, abs=1e-4)
    assert (waters.mean(axis=1) < edges[0] * (1 + 1e-9)).all()
    # No two molecules of the liquid come closer than they were, but for faces and the change of size.
    apart = np.linalg.norm(waters[:, None, 0] - waters[None, :, 0], axis=2)[np.triu_indices(64, 1)]
    assert apart.min() > 0.22
    assert boxes.of_size(found, SYSTEMS, 1024).molecules == 1024
    with pytest.raises(ValueError, match="a part of a box of 512 molecules has 1 to 511, got 0"):
        boxes.of_size(found, SYSTEMS, 0)
