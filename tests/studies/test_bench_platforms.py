"""The benchmark of a platform: what it counts, and boxes of many sizes; how fast anything is, no test says."""

from __future__ import annotations

import math

import numpy as np
import openmm
import pandas as pd
import pytest

from openmm_sier.measure import forcefields
from openmm_sier.measure.report import SILENT
from studies import bench, boxes
from studies.bench import accuracy, platforms
from studies.bench.timing import BenchSettings
from tests.support.commands import SYSTEMS, write_lattice
from tests.support.reports import Told
from tests.support.waters import platform


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return write_lattice(tmp_path_factory.mktemp("box") / "box.pdb")


@pytest.mark.slow
def test_platform_in_miniature(box, tmp_path, monkeypatch):
    monkeypatch.setattr(accuracy, "METHODS", {"verlet": (0.5, 2.0), "sier4g": (1.0,)})
    monkeypatch.setattr(platforms, "TURN", 1e-6)

    settings = BenchSettings(
        out=tmp_path, box=box, molecules=(27, 54), rounds=1, time=0.02, equilibrate=0.01, platform="CPU"
    )
    told = Told()
    found = bench.study(settings, told).tables
    assert set(found) == {"platform_points", "speeds"}
    rows = found["speeds"]
    assert list(rows["molecules"]) == 5 * [27] + 5 * [54]
    assert list(rows["method"][:5]) == ["OpenMM Verlet", "OpenMM LangevinMiddle", "SIER2", "SIER4G", "SIER4P"]
    assert set(rows["platform"]) == {"CPU"}
    assert list(rows["engine"][:5]) == ["", "", "exact", "exact", "exact"]
    assert list(rows["forces_per_second"] / rows["steps_per_second"]) == pytest.approx(2 * [1, 1, 1, 3, 4])
    assert (rows["over_forces"] > 0).all()
    # The errors of a method are found by its name.
    assert set(found["platform_points"]["method"]) == {"OpenMM Verlet", "SIER4G"}
    assert [table.title[:14] for table in told.tables] == ["Energy error a", "On the CPU pla", "Simulated fs p"]


def test_speed_at_an_error_is_that_of_the_step_that_has_it(monkeypatch):
    """Second order: the errors of 0.01 and 0.16 % at 0.5 and 2 fs enclose 0.05 % at 1.118 fs."""
    points = pd.DataFrame(
        [("OpenMM Verlet", dt, 0.04 * dt**2) for dt in (0.5, 2.0)], columns=["method", "fs_per_force", "percent"]
    )
    seconds = {name: np.array([0.6, 0.6]) for name in platforms.METHODS}
    seconds |= {platforms.READING: np.array([0.1, 0.1]), platforms.FORCES: np.array([0.5, 0.5])}
    monkeypatch.setattr(platforms, "interleaved", lambda actions, rounds: {name: seconds[name] for name in actions})
    monkeypatch.setattr(platforms, "_evaluations_in_a_turn", lambda context: 24)
    found = forcefields.read_box(SYSTEMS / "tip4p-1.pdb")
    replica = boxes.repeated(found, SYSTEMS, (1, 1, 1))
    settings = BenchSettings(box=SYSTEMS / "tip4p-1.pdb", platform="Reference")
    verlet, langevin, *_ = platforms._speeds(replica, points, settings, SILENT)
    assert verlet["forces_per_second"] == pytest.approx(48)
    assert verlet["over_forces"] == pytest.approx(1.25)
    assert verlet["fs_per_second_at_0_05"] == pytest.approx(48 * math.sqrt(1.25))
    assert math.isnan(langevin["fs_per_second_at_0_05"])


@pytest.mark.parametrize(("times", "copies"), [(1, (1, 1, 1)), (2, (1, 1, 2)), (64, (4, 4, 4)), (192, (4, 6, 8))])
def test_boxes_are_as_cubic_as_they_can_be(times, copies):
    assert boxes.copies_for(512 * times, 512) == copies


@pytest.mark.parametrize("molecules", [100, 513])
def test_sizes_that_are_no_multiple_are_refused(molecules):
    with pytest.raises(ValueError, match=f"multiples of the 512 molecules of the box, got {molecules}"):
        boxes.copies_for(molecules, 512)


@pytest.mark.parametrize("name", ["tip3p-512.pdb", "tip4p2005-512.pdb"])
def test_repeated_box_has_the_energy_of_its_copies(name):
    found = forcefields.read_box(SYSTEMS / name)
    energies = []
    for copies in ((1, 1, 1), (1, 2, 1)):
        replica = boxes.repeated(found, SYSTEMS, copies)
        assert replica.molecules == 512 * math.prod(copies)
        context = openmm.Context(replica.system, openmm.VerletIntegrator(0.001), platform("CPU"))
        context.setPositions(replica.positions)
        energies.append(context.getState(energy=True).getPotentialEnergy()._value)
    # PME on meshes of two shapes, at a tolerance of 1e-5.
    assert energies[1] == pytest.approx(2 * energies[0], rel=1e-4)
