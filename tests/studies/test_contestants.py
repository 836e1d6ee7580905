"""Integrators that speeds and averages compare."""

import openmm
import pytest

from studies import boxes, heat_bath, speed
from studies.command import SYSTEMS
from studies.gpu import methods as on_gpus
from studies.methods import Bath
from tests.support.waters import periodic_system

NAMES = {
    "gpu": [method.name for method in on_gpus(False)],
    "speed": [method.name.removeprefix("OpenMM ") for method in speed.contestants(False)],
    "heat bath": list(heat_bath.METHODS),
}


@pytest.mark.parametrize("study", NAMES)
def test_rigid_water_has_its_strongest_rival(study):
    """LangevinMiddle at the step of SIER2, on the prepared System with heavy hydrogens."""
    assert any(name.startswith("LangevinMiddle, 9 fs") for name in NAMES[study])
    assert len(set(NAMES[study])) == len(NAMES[study])


def test_solutes_do_not():
    methods = [*on_gpus(True), *speed.contestants(True)]
    assert not any(method.only_rigid for method in methods)
    assert {"MTSLangevin, 8 fs", "OpenMM MTSLangevin, 8 fs"} <= {method.name for method in methods}
    asked = {task.method for task in heat_bath.tasks(heat_bath.BathSettings())}
    assert asked == {name for name, method in heat_bath.METHODS.items() if not method.only_rigid}
    assert boxes.is_water(SYSTEMS / "tip3p-512.pdb")


def test_some_speeds_can_be_measured_alone():
    names = speed.compared(False, ["OpenMM LangevinMiddle, 10 fs"])
    assert list(names) == ["OpenMM Verlet, 2 fs", "OpenMM LangevinMiddle, 4 fs", "OpenMM LangevinMiddle, 10 fs"]
    assert len(speed.compared(True, ())) == len(speed.contestants(True))


@pytest.mark.parametrize("name", heat_bath.METHODS)
def test_every_one_can_be_made(name):
    method = heat_bath.METHODS[name]
    _, positions, system = periodic_system("tip3p", 64)
    method.fit(system)
    integrator = method.integrator(Bath(300.0, 5.0))
    assert integrator.getStepSize()._value == pytest.approx(1e-3 * method.duration)
    openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference")).setPositions(positions)
