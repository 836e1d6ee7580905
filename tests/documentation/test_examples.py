"""The examples in the docstrings of what users call run, each with a System, a topology and a Simulation of its own."""

import copy
import doctest
import importlib

import numpy as np
import openmm
import pytest
from openmm import app, unit

import openmm_sier
from openmm_sier.integrators import tuning
from openmm_sier.observe import conservation, gsd_reporter, reporters
from tests.support.matrices import representatives
from tests.support.waters import periodic_system, platform, relaxed

#: Classes whose objects users get and never make.
RESULTS = {
    "BodyState",
    "ForceCheck",
    "ForceDoubt",
    "ForceFault",
    "FramedSystem",
    "Preparation",
    "RigidityError",
    "SelectedBodies",
    "Tuning",
}

#: Schemes, which are data, and the number of the version.
DATA = {"SIER2", "SIER2P3", "SIER2V2", "SIER4", "SIER4G", "SIER4P", "SIER4V", "__version__"}

#: What users import from modules.
ELSEWHERE = (
    "ensembles.rescaling.VelocityRescaling",
    "observe.reporters.ConservationReporter",
    "observe.reporters.BodyStateReporter",
    "observe.reporters.PressureReporter",
    "observe.gsd_reporter.GSDReporter",
    "observe.pressure.MolecularPressure",
    "analysis.read_log",
    "analysis.statistics.mean_and_error",
    "analysis.statistics.of_independent",
    "analysis.statistics.pooled",
    "analysis.statistics.jackknife",
    "analysis.statistics.settled_from",
    "analysis.statistics.slope_and_error",
    "analysis.transport.shear_viscosity",
    "analysis.transport.self_diffusion",
    "analysis.transport.unwrapped",
    "analysis.transport.without_finite_size",
)


def named(place):
    """What a path within the package names."""
    module, _, name = place.rpartition(".")
    return getattr(importlib.import_module(f"openmm_sier.{module}".rstrip(".")), name)


CALLED = [*(name for name in openmm_sier.__all__ if name not in RESULTS | DATA), *ELSEWHERE]


#: Those whose examples take more than half a second.
DEAR = {"check_forces", "tune", "equilibrate"}


@pytest.fixture(scope="module")
def water():
    """Topology, positions and System of a box of 59 molecules, in a chain A that begins at the centre of the box.

    The first molecules are bodies of examples, which the periodic boundary must not cut.
    """
    topology, positions, system = periodic_system()
    topology = copy.deepcopy(topology)
    next(topology.chains()).id = "A"
    positions, _ = relaxed("box-59", topology, positions, copy.deepcopy(system))
    molecules = positions.reshape(topology.getNumResidues(), 3, 3)
    centre = np.diag(topology.getPeriodicBoxVectors().value_in_unit(unit.nanometer)) / 2
    order = np.argsort(np.linalg.norm(molecules[:, 0] - centre, axis=1))
    return topology, molecules[order].reshape(-1, 3), system


@pytest.fixture
def names(water, tmp_path, monkeypatch):
    """What examples find: the names of OpenMM and of the package, and the box of water."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENMM_CPU_THREADS", "1")
    monkeypatch.setattr(tuning, "ATTEMPTS", 1)
    topology, positions, system = water
    system = copy.deepcopy(system)
    integrator = openmm_sier.SIERIntegrator(0.004)
    simulation = app.Simulation(topology, copy.deepcopy(system), integrator, platform("Reference"))
    simulation.context.setPositions(positions)
    (tmp_path / "run.csv").write_text(conservation.csv_line(conservation.COLUMNS[:6]) + "0,0,-1,1,0,0\n")
    results = {"np": np, "openmm": openmm, "Simulation": app.Simulation}
    results |= {name: getattr(unit, name) for name in ("bar", "dalton", "femtoseconds", "kelvin", "picosecond")}
    results |= {name: getattr(openmm_sier, name) for name in openmm_sier.__all__}
    results |= {name: getattr(reporters, name) for name in dir(reporters) if name.endswith("Reporter")}
    results["GSDReporter"] = gsd_reporter.GSDReporter
    return results | {"topology": topology, "positions": positions, "system": system, "simulation": simulation}


@pytest.mark.filterwarnings("ignore:Call prepare_system", "ignore:A step of")
@pytest.mark.parametrize("place", representatives(CALLED, *(name for name in CALLED if name not in DEAR)))
def test_there_is_an_example_and_it_runs(place, names):
    """It is in the docstring of the class or function itself; those of methods run too."""
    thing = named(place)
    tests = doctest.DocTestFinder().find(
        thing, thing.__name__, globs=names | vars(importlib.import_module(thing.__module__))
    )
    assert any(test.name == thing.__name__ and test.examples for test in tests), f"{place} has no example"
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS, verbose=False)
    report = []
    for test in tests:
        runner.run(test, out=report.append)
    assert runner.failures == 0, "".join(report)
