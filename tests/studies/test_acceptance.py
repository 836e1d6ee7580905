"""`openmm-sier acceptance` in miniature: what it keeps, what it makes of it, and the noise of energies."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import openmm
import pytest

from openmm_sier import SIERIntegrator
from openmm_sier.measure import forcefields
from studies import acceptance, acceptance_trials, style
from studies.acceptance import Row
from studies.acceptance_trials import AcceptanceSettings, Member
from studies.bench import replicas
from tests.support.commands import SYSTEMS, complaint, run, write_lattice
from tests.support.reports import Told
from tests.support.waters import platform


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    box = write_lattice(tmp_path_factory.mktemp("box") / "box.pdb")
    return AcceptanceSettings(
        box=box, sizes=(27,), schemes=("verlet", "sier4g"), trials=(3,), time=0.012, equilibrate=0.03, platform="CPU"
    )


@pytest.fixture(scope="module")
def finished(settings):
    out, told = settings.box.parent / "new" / "out", Told()
    return out, acceptance.run(settings, out, told), told


@pytest.mark.slow
def test_rows_and_files(finished):
    out, rows, told = finished
    assert [(row.molecules, row.method, row.step, row.length, row.trials) for row in rows] == [
        (27, "Verlet, RATTLE", 2.0, 12.0, 3),
        (27, "SIER4G", 6.0, 12.0, 3),
    ]
    verlet, sier4g = rows
    assert 0 < sier4g.spread[0] < verlet.spread[0]
    assert 0 < verlet.acceptance[0] <= 1
    # Forces of single precision on 27 molecules: 1e-7 of energies of 1000 kJ/mol.
    assert 0 < verlet.noise < 1e-3
    assert acceptance.load(out / "acceptance.json") == rows
    assert json.loads((out / "acceptance.json").read_text())["settings"]["box"] == "box.pdb"
    assert (out / "acceptance.png").read_bytes().startswith(b"\x89PNG")
    assert [len(table.rows) for table in told.tables] == [2, 0]


@pytest.mark.slow
def test_nothing_is_measured_twice(finished, settings, monkeypatch):
    """What a directory has is taken from there, and what it lacks is added."""
    out, rows, _ = finished
    made = []

    def measured(begun, method, dt, trials, *others):
        made.append((method.name, dt))
        return Member(27, method.name, dt, dt, 1, (0.1, None), 1e-9, 1e-4)

    monkeypatch.setattr(acceptance_trials, "measure", measured)
    monkeypatch.setattr(style, "can_draw", lambda report: False)
    monkeypatch.setattr(acceptance_trials, "prepare", lambda *_, **__: pytest.fail("the box was equilibrated"))
    assert acceptance.run(settings, out) == rows
    assert not made
    more = acceptance.run(dataclasses.replace(settings, schemes=("sier2",), dt=(3.0,)), out)
    assert made == [("SIER2", 3.0)]
    assert more[:2] == rows
    # One of two trajectories could not be followed, and is rejected.
    assert more[2].acceptance[0] == pytest.approx(0.5 * math.exp(-0.1))
    assert math.isnan(more[2].spread[0])
    # More trials than there are.
    acceptance.run(dataclasses.replace(settings, schemes=("sier4g",), trials=(4,)), out)
    assert made[1:] == [("SIER4G", 2.0)]


@pytest.mark.slow
def test_other_settings_need_another_directory(finished, settings):
    with pytest.raises(ValueError, match=r"has trials with time 0.012, got 0.03: take another directory"):
        acceptance.run(dataclasses.replace(settings, time=0.03), finished[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schemes": ("sier5",)}, "unknown scheme 'sier5'; known are verlet, sier2"),
        ({"trials": (1,)}, "trials must be at least 2, got 1"),
        ({"trials": (2, 3)}, "one number or one for each of 1 sizes"),
        ({"sizes": (40,)}, "multiples of the 27 molecules of the box, got 40"),
    ],
)
def test_settings_that_make_no_sense(settings, tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        acceptance.run(dataclasses.replace(settings, **changes), tmp_path)


@pytest.mark.slow
def test_the_command(settings, tmp_path, capsys):
    options = ("--sizes", "27", "--schemes", "sier2", "--trials", "2", "--time", "0.004", "--equilibrate", "0.006")
    run("acceptance", settings.box, *options, "--platform", "CPU", "--out", tmp_path)
    assert "acceptance" in capsys.readouterr().out
    wrong = ("--schemes", "sier2", "--trials", "1", "--out", str(tmp_path))
    assert "trials must be at least 2" in complaint(capsys, "acceptance", str(settings.box), *wrong)


def member(molecules, spread, method="SIER2", trials=200, **changes):
    errors = 0.5 * spread**2 + spread * np.random.default_rng(4).normal(size=trials)
    return Member(molecules, method, 2.0, 2.0, 30, tuple(errors), 1e-8, 1e-3, **changes)


def test_limits():
    """Spreads of boxes of 512 molecules and more are pooled; what was measured is told from what was not."""
    members = [member(n, 0.02 * n**0.5) for n in (512, 4096, 32768)]
    small = member(64, 5.0)
    refused = Member(512, "SIER4", 2.0, 2.0, 30, broken="too long")
    (limit,) = acceptance.limits(list(map(Row.of, [small, *members, refused])))
    assert limit.method == "SIER2"
    assert limit.spread[0] == pytest.approx(0.02, abs=4 * limit.spread[1])
    # (1.349/0.02)^2 = 4549.
    assert limit.measured == 4096
    assert limit.extrapolated[0] == pytest.approx(4549, abs=4 * limit.extrapolated[1])
    table = acceptance.table([Row.of(refused)])
    assert "refused" in table.rows[0]
    assert not any("nan" in cell for cell in table.rows[0])


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
    part = replicas.of_size(found, SYSTEMS, 64)
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
    assert replicas.of_size(found, SYSTEMS, 1024).molecules == 1024
    with pytest.raises(ValueError, match="a part of a box of 512 molecules has 1 to 511, got 0"):
        replicas.of_size(found, SYSTEMS, 0)
