"""A System remembers its bodies: OpenMM keeps their atoms together, and an integrator without them is refused."""

import numpy as np
import openmm
import pytest

from openmm_sier import (
    RigidBodies,
    RigidityError,
    SIERLangevinIntegrator,
    prepare_system,
    select_bodies,
    with_frames,
)
from openmm_sier.prepare.joined_bodies import NAME
from tests.support.domains import descriptions, domain_system, folded, topology_of
from tests.support.waters import periodic_system, platform


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
    message = str(prepare_system(system, lists if as_lists else bodies))
    assert "The atoms of 4 rigid bodies are joined" in message
    assert molecules(system) == [40, 40]
    before = openmm.XmlSerializer.serialize(system)
    prepare_system(system, bodies)
    if not as_lists:
        assert openmm.XmlSerializer.serialize(system) == before


def test_nothing_is_joined_where_constraints_hold_the_bodies():
    _, _, system = periodic_system()
    prepare_system(system, RigidBodies.from_system(system))
    assert NAME not in [force.getName() for force in system.getForces()]


PREPARED = {
    "apart": unbonded,
    "bonded": lambda: (domain_system(2, box=12.0), *unbonded()[1:]),
    "without a box": lambda: unbonded(None),
}


@pytest.mark.parametrize("engine", ["auto", "exact"])
@pytest.mark.parametrize("kind", PREPARED)
def test_an_integrator_without_the_bodies_of_the_preparation_is_refused(kind, engine):
    """The atoms of the domains may not interact any more, and would fly apart; copies by XML remember it too."""
    system, bodies, positions = PREPARED[kind]()
    prepare_system(system, bodies)
    lists = [species.atoms[i].tolist() for species in bodies.species for i in range(len(species.atoms))]
    lists = [atoms for atoms in lists if len(atoms) > 1]
    copied = openmm.XmlSerializer.clone(system)
    for rigid in (None, lists[1:], [lists[0][1:], *lists[1:]]):
        others = RigidBodies.from_system(copied, rigid=rigid, positions=positions)
        with pytest.raises(RigidityError, match=r"atoms \d+ and \d+, but"):
            openmm.Context(copied, SIERLangevinIntegrator(300, 1, 0.01, bodies=others, engine=engine), platform())
    context = openmm.Context(copied, SIERLangevinIntegrator(300, 1, 0.01, bodies=bodies), platform())
    context.setPositions(positions)
    context.getIntegrator().step(1)


def test_a_system_with_frames_needs_no_bodies():
    system, bodies, positions = unbonded()
    prepare_system(system, bodies)
    framed = with_frames(system, positions, bodies)
    for integrator in (openmm.VerletIntegrator(0.01), SIERLangevinIntegrator(300, 1, 0.01)):
        context = openmm.Context(framed.system, integrator, platform())
        context.setPositions(framed.positions)
        integrator.step(1)


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
