"""Integrators from XML in a process of OpenMM without this package."""

import json

import numpy as np
import openmm

from openmm_sier.engines.native.installation import PARTS
from openmm_sier.integrators.storage import written
from tests.support.subprocesses import run_python
from tests.support.waters import plain_context

#: Program that makes steps, and prints the energies after each, or the error.
PROGRAM = """
import json, sys, openmm
system, integrator, state = (openmm.XmlSerializer.deserialize(open(name).read()) for name in sys.argv[1:4])
assert not any(name.startswith("openmm_sier") for name in sys.modules)
assert type(integrator) is openmm.CustomIntegrator
context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
context.setPositions(state.getPositions())
context.setVelocities(state.getVelocities())
integrator.setConstraintTolerance(1e-9)
energies, error = [], ""
try:
    for _ in range(4):
        integrator.step(int(sys.argv[4]))
        found = context.getState(energy=True)
        energies.append([found.getPotentialEnergy()._value, found.getKineticEnergy()._value])
except openmm.OpenMMException as raised:
    error = str(raised)
print(json.dumps([energies, context.getTime()._value, error]))
"""


#: Program that writes positions and velocities after each of many steps to a file of NumPy.
SAMPLES = """
import sys, numpy, openmm
system, integrator, state = (openmm.XmlSerializer.deserialize(open(name).read()) for name in sys.argv[1:4])
assert not any(name.startswith("openmm_sier") for name in sys.modules)
assert type(integrator) is openmm.CustomIntegrator
integrator.setRandomNumberSeed(5)
context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
context.setPositions(state.getPositions())
integrator.step(20)
rows = []
for _ in range(int(sys.argv[4])):
    integrator.step(1)
    found = context.getState(positions=True, velocities=True)
    rows.append([found.getPositions(asNumpy=True)._value, found.getVelocities(asNumpy=True)._value])
counts = [integrator.getGlobalVariableByName(name) for name in ("sier_trials", "sier_accepted")]
numpy.savez(sys.argv[5], rows=rows, counts=counts, time=context.getTime()._value)
"""


def samples_of_openmm_alone(directory, system, integrator, state, steps):
    """Positions and velocities (n, 2, N, 3) after steps, numbers of trials and of accepted ones, and the final time in
    ps, which includes 20 earlier steps."""
    path = directory / "samples.npz"
    run_python(SAMPLES, *_written(directory, system, integrator, state), steps, path)
    result = np.load(path)
    return result["rows"], result["counts"], float(result["time"])


def _written(directory, system, integrator, state):
    files = []
    for name, thing in (("system", system), ("integrator", integrator), ("state", state)):
        files.append(directory / f"{name}.xml")
        files[-1].write_text(openmm.XmlSerializer.serialize(thing))
    return files


def run_by_openmm_alone(directory, system, integrator, state):
    """Energies (4, 2) after each of four steps of the scheme, the time in ps, and the error that ended them."""
    native_steps = int(written(integrator).getGlobalVariableByName(PARTS)) or 1
    return json.loads(run_python(PROGRAM, *_written(directory, system, integrator, state), native_steps))


def fails_in_openmm_alone(directory, integrator):
    """Whether the program of a free particle fails with a message that names the package to import."""
    system = openmm.System()
    system.addParticle(1.0)
    state = plain_context(system, [[0, 0, 0]]).getState(positions=True, velocities=True)
    return "import_openmm_sier" in run_by_openmm_alone(directory, system, integrator, state)[2]
