"""Bodies without bonds: OpenMM keeps their atoms together, in trajectories and with its barostats."""

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies, SIERLangevinIntegrator, prepare_system, select_bodies
from openmm_sier.prepare.joined_bodies import NAME
from tests.support.domains import descriptions, domain_system, folded, topology_of
from tests.support.waters import platform


def unbonded(box=12.0):
    """Two chains with two domains each, in which there are no bonds: System, bodies and positions."""
    topology, positions, system = topology_of(2), folded(2), domain_system(2, box=box, elastic=False)
    domains = select_bodies(topology, descriptions("AB"))
    return system, RigidBodies.from_system(system, topology, domains, positions), positions


def molecules(system):
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform())
    return sorted(len(molecule) for molecule in context.getMolecules())


@pytest.mark.parametrize("as_lists", [False, True])
def test_a_chain_is_one_molecule(as_lists):
    system, bodies, _ = unbonded()
    lists = select_bodies(topology_of(2), descriptions("AB"))
    assert len(molecules(system)) > 40
    told = str(prepare_system(system, lists if as_lists else bodies))
    assert "The atoms of 4 rigid bodies are joined" in told
    assert molecules(system) == [40, 40]
    before = openmm.XmlSerializer.serialize(system)
    prepare_system(system, bodies)
    if not as_lists:
        assert openmm.XmlSerializer.serialize(system) == before


def test_nothing_is_joined_where_bonds_do_or_where_there_is_no_box():
    for system in (domain_system(2, box=12.0), unbonded(None)[0]):
        prepare_system(system, unbonded()[1])
        assert NAME not in [force.getName() for force in system.getForces()]


def test_atoms_stay_together_in_frames_and_with_a_barostat_of_openmm():
    """Frames move molecules into the box; a body is as large as it was, to the rounding of shifts by 24 nm."""
    system, bodies, positions = unbonded()
    system.addForce(openmm.MonteCarloBarostat(1.0, 300.0, 5))
    prepare_system(system, bodies)
    context = openmm.Context(system, SIERLangevinIntegrator(300, 1, 0.01, bodies=bodies), platform("CPU"))
    context.setPositions(positions + np.array([11.5, -12.2, 24.1]))
    context.getIntegrator().step(20)
    frame = context.getState(positions=True, enforcePeriodicBox=True).getPositions(asNumpy=True)._value
    for domain in select_bodies(topology_of(2), descriptions("AB")):
        x, y = positions[list(domain)], frame[list(domain)]
        before, after = (np.linalg.norm(z[:, None] - z[None], axis=2) for z in (x, y))
        # Shapes are those of the bodies, which two domains alike share, and positions on CPU are in single precision.
        assert np.abs(after - before).max() < 0.05
