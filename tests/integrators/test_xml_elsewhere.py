"""XML of an integrator in a process that does not import this package."""

import openmm

from openmm_sier import SIERIntegrator
from tests.support.subprocesses import run_python

PROGRAM = """
import sys, openmm
integrator = openmm.XmlSerializer.deserialize(open(sys.argv[1]).read())
assert type(integrator) is openmm.CustomIntegrator
assert not any(name.startswith("openmm_sier") for name in sys.modules)
system = openmm.System()
system.addParticle(1.0)
try:
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(sys.argv[2]))
    context.setPositions([[0, 0, 0]])
    integrator.step(1)
except openmm.OpenMMException as error:
    print(error)
"""


def test_it_fails_and_names_the_package(tmp_path):
    """It must not run as an integrator that does nothing."""
    path = tmp_path / "integrator.xml"
    path.write_text(openmm.XmlSerializer.serialize(SIERIntegrator(0.002)))
    for platform in ("Reference", "CPU"):
        assert "import_openmm_sier" in run_python(PROGRAM, path, platform)
