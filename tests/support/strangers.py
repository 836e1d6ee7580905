"""Integrators in XML as a process without this package meets them."""

import json

import openmm

from openmm_sier.engines.native.installation import PARTS
from openmm_sier.integrators.storage import written
from tests.support.subprocesses import run_python
from tests.support.waters import plain_context

#: Steps of the integrator, and the energies after each, or why it cannot make a step.
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


def run_as_stranger(directory, system, integrator, state):
    """Energies (4, 2) after each of four steps of the scheme, the time in ps, and the error that ended them."""
    native_steps = int(written(integrator).getGlobalVariableByName(PARTS)) or 1
    files = []
    for name, thing in (("system", system), ("integrator", integrator), ("state", state)):
        files.append(directory / f"{name}.xml")
        files[-1].write_text(openmm.XmlSerializer.serialize(thing))
    return json.loads(run_python(PROGRAM, *files, native_steps))


def fails_as_stranger(directory, integrator):
    """Whether a program of a free particle fails with the word of what would have to be imported."""
    system = openmm.System()
    system.addParticle(1.0)
    state = plain_context(system, [[0, 0, 0]]).getState(positions=True, velocities=True)
    return "import_openmm_sier" in run_as_stranger(directory, system, integrator, state)[2]
