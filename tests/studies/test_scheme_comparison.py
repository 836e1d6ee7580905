"""The comparison of schemes: published candidates, what it reports, and its files."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
from openmm import app, unit

from openmm_sier.dynamics.schemes import DRIFT, KICK, SIER4P, SIER4V, alternating
from studies import schemes
from studies.schemes import OTHERS, Row, SchemesSettings
from tests.support.convergence import slope
from tests.support.molecules import WATER, SoftCluster
from tests.support.reports import Told
from tests.support.waters import water_box

CANDIDATES = {**OTHERS, "sier4v": SIER4V, "sier4p": SIER4P}
FORCES = {"s6": 6, "srkn6b": 6, "pefrl": 4, "sier4v": 5, "sier4p": 4, "omf3gg": 5}


@pytest.mark.parametrize("name", CANDIDATES)
def test_candidates_are_symmetric_and_of_fourth_order(name):
    scheme = CANDIDATES[name]
    assert scheme.order == 4
    assert scheme.is_palindrome
    assert scheme.force_evaluations == FORCES[name]


@pytest.mark.parametrize("name", CANDIDATES)
def test_candidates_are_of_fourth_order_in_the_dynamics(rng, name):
    cluster = SoftCluster([WATER] * 3)
    # SRKN6b has so small a h^4 that h^6 shows unless the steps are short.
    assert slope(cluster, CANDIDATES[name], cluster.start(rng), steps=(24, 48, 96)) == pytest.approx(4.0, abs=0.3)


def test_a_nystroem_scheme_of_sixth_order_needs_kicks_and_drifts():
    """Blanes and Moan's SRKN11b rests on [B, [B, [B, A]]] = 0: of operators without that rule it is of fourth order."""
    b = (0.0414649985182624, 0.198128671918067, -0.0400061921041533, 0.0752539843015807, -0.0115113874206879)
    a = (0.123229775946271, 0.290553797799558, -0.127049212625417, -0.246331761062075, 0.357208872795928)
    fractions = [x for pair in zip(b, a, strict=True) for x in pair]
    fractions.append(0.5 - math.fsum(b))
    assert alternating("SRKN11b", KICK, DRIFT, tuple(fractions)).order == 6
    assert alternating("free", "B", "A", tuple(fractions)).order == 4
    # The rule does not hold with the operators exchanged.
    assert alternating("exchanged", DRIFT, KICK, tuple(fractions)).order == 4


def row(scheme, dt, error):
    return Row(scheme, 4, 3, 3 * dt, dt, 1.0, error, (0.0, 0.1))


def test_best_at_every_number_of_forces():
    rows = [row("A", 1, 0.02), row("B", 1, 0.01), row("A", 2, 0.03), row("B", 2, math.nan), row("A", 4, math.nan)]
    assert {dt: found.scheme for dt, found in schemes.best(rows).items()} == {1: "B", 2: "A"}


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    topology, positions, _ = water_box("tip3p", 64)
    path = tmp_path_factory.mktemp("survey") / "box.pdb"
    app.PDBFile.writeFile(topology, positions * unit.nanometer, str(path))
    return SchemesSettings(
        box=path,
        forcefield=["tip3p.xml"],
        dt=(2.0, 12.0),
        schemes=("verlet", "sier2", "sier4g"),
        time=0.3,
        equilibrate=0.2,
        platform="CPU",
    )


@pytest.fixture(scope="module")
def finished(settings):
    out = settings.box.parent / "new" / "out"
    told = Told()
    return out, schemes.run(settings, out, told), told


def test_rows(finished):
    _, rows, _ = finished
    assert [(r.scheme, r.fs_per_force, r.force_evaluations) for r in rows] == [
        (name, dt, forces) for dt in (2.0, 12.0) for name, forces in (("OpenMM Verlet", 1), ("SIER2", 1), ("SIER4G", 3))
    ]
    assert [r.step for r in rows] == [2.0, 2.0, 6.0, 12.0, 12.0, 36.0]
    assert [r.forces_per_ps for r in rows[:3]] == [500.0] * 3
    verlet, sier2, sier4g = rows[:3]
    # Second order is second order, and the fourth is several times better, cut-off and all.
    assert 0.3 < sier2.error / verlet.error < 3
    assert sier4g.error < 0.5 * sier2.error
    # A step of a whole period of libration breaks the run, and says so.
    assert rows[-1].broken
    assert math.isnan(rows[-1].error)


def test_files(finished, settings):
    out, rows, _ = finished
    loaded = schemes.load(out / "schemes.json")
    for one, other in zip(loaded, rows, strict=True):
        assert str(one) == str(other)
    record = json.loads((out / "schemes.json").read_text())
    assert record["settings"]["box"] == "box.pdb"
    assert (out / "schemes.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "schemes.png").stat().st_size > 20000


def test_what_is_reported(finished):
    _, rows, told = finished
    (table,) = told.tables
    cells = [cell for row in table.rows for cell in row]
    assert len(table.rows) == len(rows)
    assert "broke down" in cells
    assert not any("nan" in cell for cell in cells)
    assert any(note.startswith("least energy error at 2 fs per force: SIER4G") for note in told.notes)
    # The equilibration and every run show how far they are.
    assert [what for what, _ in told.runs][1:3] == ["OpenMM Verlet, 2 fs per force", "SIER2, 2 fs per force"]
    for _, amounts in told.runs[:3]:
        assert amounts == sorted(amounts)
        assert 0.9 < amounts[-1] <= 1


def test_an_unknown_scheme_is_refused_before_anything_is_read(settings, tmp_path):
    wrong = dataclasses.replace(settings, box=tmp_path / "none.pdb", schemes=("sier4g", "sier5"))
    with pytest.raises(ValueError, match=r"unknown scheme 'sier5'; known are verlet, sier2, .*srkn6b"):
        schemes.compare(wrong)
