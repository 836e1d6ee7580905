"""Forces of a copy with frames have the energies and the forces that they had."""

import copy

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm.app.internal.customgbforces import GBSAOBC2Force

from openmm_sier import with_frames
from tests.support.framed import energy_and_forces, moved, net, polar, soft, system_of
from tests.support.waters import array, platform

EDGE = 9.0


def lone_points(system, positions, points=6):
    """Add atoms that belong to no body."""
    rng = np.random.default_rng(8)
    for _ in range(points):
        system.addParticle(20.0)
    return np.vstack([positions, positions.mean(axis=0) + [0, 2.0, 0] + 0.6 * rng.normal(size=(points, 3))])


def periodic(force, method, cutoff=1.2):
    force.setNonbondedMethod(method)
    force.setCutoffDistance(cutoff)
    return force


def pme(system, bodies):
    force = periodic(polar(system, bodies), openmm.NonbondedForce.PME)
    force.setUseDispersionCorrection(False)
    force.setPMEParameters(2.6, 40, 40, 40)
    force.addGlobalParameter("scale", 0.3)
    force.addParticleParameterOffset("scale", 2, 0.2, 0.0, 0.1)
    return force


def by_expression(system, bodies):
    force = openmm.CustomNonbondedForce("depth*(s/r)^6 - q1*q2/r; s = s1 + s2; depth = 0.01;")
    for name in ("q", "s"):
        force.addPerParticleParameter(name)
    force.addGlobalParameter("depth", 1.0)
    force.addEnergyParameterDerivative("depth")
    for i in range(system.getNumParticles()):
        force.addParticle([0.1 * (-1) ** i, 0.1 + 0.01 * (i % 4)])
    for atoms in bodies:
        for number, i in enumerate(atoms):
            for j in atoms[:number]:
                force.addExclusion(i, j)
    return periodic(force, force.CutoffPeriodic)


def between_groups(system, bodies):
    force = by_expression(system, bodies)
    force.addInteractionGroup(bodies[0], bodies[1])
    return force


def implicit(system, bodies):
    force = openmm.GBSAOBCForce()
    force.setSurfaceAreaEnergy(0)
    for i in range(system.getNumParticles()):
        force.addParticle(0.2 * (-1) ** i, 0.15 + 0.02 * (i % 3), 0.8)
    return force


def implicit_by_expression(system, bodies):
    force = GBSAOBC2Force(SA="ACE")
    parameters = [(0.2 * (-1) ** i, 0.15 + 0.02 * (i % 3), 0.8) for i in range(system.getNumParticles())]
    force.addParticles([list(row) for row in parameters])
    force.finalize()
    return openmm.XmlSerializer.clone(force)


def ellipsoids(system, bodies):
    force = openmm.GayBerneForce()
    for number in range(system.getNumParticles()):
        body = next((atoms for atoms in bodies if number in atoms), None)
        axes = (-1, -1) if body is None else (body[0], body[1])
        if number in axes:
            axes = (-1, -1)
        shape = (0.3, 0.3, 0.3, 1, 1, 1) if axes == (-1, -1) else (0.3, 0.35, 0.4, 1, 1.2, 1.3)
        force.addParticle(0.3, 0.5, *axes, *shape)
    for atoms in bodies:
        for number, i in enumerate(atoms):
            for j in atoms[:number]:
                force.addException(i, j, 0.3, 0)
    return force


def triples(system, bodies):
    energy = "C*(1 + 3*cos(theta1)*cos(theta2)*cos(theta3))*c1*c2*c3/(r12*r13*r23)^3; C = 1e-3;"
    energy += "theta1 = angle(p1,p2,p3); theta2 = angle(p2,p3,p1); theta3 = angle(p3,p1,p2);"
    energy += "r12 = distance(p1,p2); r13 = distance(p1,p3); r23 = distance(p2,p3)"
    force = openmm.CustomManyParticleForce(3, energy)
    force.addPerParticleParameter("c")
    for i in range(system.getNumParticles()):
        force.addParticle([1.0 + 0.1 * (i % 2)], i % 2)
    return periodic(force, force.CutoffNonPeriodic, 0.8)


def centroids(system, bodies):
    """By masses, which atoms of bodies lose, and by weights."""
    force = openmm.CustomCentroidBondForce(3, "10*(distance(g1, g2) - 1)^2 + distance(g1, g3)")
    force.addGroup(bodies[0][:9])
    force.addGroup([bodies[1][0], system.getNumParticles() - 1])
    force.addGroup(bodies[0][3:6], [1.0, 2.0, 3.0])
    force.addBond([0, 1, 2])
    return force


def compounds(system, bodies):
    force = openmm.CustomCompoundBondForce(3, "5*distance(p1, p2)*angle(p1, p2, p3)")
    force.addBond([bodies[0][2], bodies[1][1], system.getNumParticles() - 1])
    return force


def hydrogen_bonds(system, bodies):
    force = openmm.CustomHbondForce("3*(distance(a1, d1) - 0.5)^2*(1 + cos(angle(d2, d1, a1)))")
    force.addDonor(bodies[0][0], bodies[0][1], -1)
    force.addAcceptor(bodies[1][0], -1, -1)
    force.addAcceptor(system.getNumParticles() - 1, -1, -1)
    return force


def reference(system):
    return np.random.default_rng(3).normal(size=(system.getNumParticles(), 3))


def deviation(system, bodies):
    return openmm.RMSDForce(reference(system))


def orientation(system, bodies):
    return openmm.OrientationRestraintForce(40.0, reference(system), bodies[0])


def gyration(system, bodies):
    return openmm.RGForce()


def surfaces(system, bodies):
    force = openmm.LCPOForce()
    for i in range(system.getNumParticles()):
        force.addParticle(0.3 + 0.01 * (i % 3), 0.7, -0.2, -0.0003, 0.0008)
    return force


def variables(system, bodies):
    force = openmm.CustomCVForce("0.1*a^2 + 2*b + 0.1*c*b; ")
    force.addCollectiveVariable("a", centroids(system, bodies))
    force.addCollectiveVariable("b", gyration(system, bodies))
    force.addCollectiveVariable("c", deviation(system, bodies))
    return force


def alchemical(system, bodies):
    force = openmm.ATMForce(0.3, 0.6, 0.1, 0, 0, 100.0, 50.0, 0.1, 1.0)
    for i in range(system.getNumParticles()):
        force.addParticle(openmm.Vec3(0.3, 0.1, 0) if i in bodies[1] else openmm.Vec3(0, 0, 0))
    force.addForce(pme(system, bodies))
    return force


def constant_potential(system, bodies):
    force = openmm.ConstantPotentialForce()
    for i in range(system.getNumParticles()):
        force.addParticle(0.1 * (-1) ** i)
    force.addElectrode(set(bodies[1]), 5.0, 0.1, 0.0)
    force.setCutoffDistance(1.2)
    force.setPMEParameters(2.6, 40, 40, 40)
    return force


def in_python(state):
    positions = state.getPositions(asNumpy=True)._value
    return 0.5 * (positions**2).sum(), -positions


def python(system, bodies):
    return openmm.PythonForce(in_python)


def external(system, bodies):
    return soft(system, bodies)[1]


FORCES = (
    *(pme, by_expression, between_groups, implicit, implicit_by_expression, ellipsoids, triples, centroids, compounds),
    *(hydrogen_bonds, deviation, orientation, gyration, surfaces, variables, alchemical, constant_potential, python),
    *(external,),
)


def pair_of_bodies(build):
    """A System with a Force, positions at which no body is where it was named, and the bodies."""
    system, positions, bodies = system_of("36 beads", "N2", apart=1.6)
    positions = lone_points(system, positions)
    system.setDefaultPeriodicBoxVectors([EDGE, 0, 0], [0, EDGE, 0], [0, 0, EDGE])
    if build is not None:
        system.addForce(build(system, bodies))
    return system, positions, bodies


def checked(system, framed, x, bodies, name="Reference", rel=1e-9):
    """Compare energies, forces on points, and net forces and torques of bodies."""
    energy, places, forces = energy_and_forces(system, x, name)
    found, others, theirs = energy_and_forces(framed.system, framed.addFramePositions(x), name)
    assert abs(energy) > 1e-3
    assert found == pytest.approx(energy, rel=rel)
    size = np.abs(forces).max()
    assert size > 1e-3
    points = [i for i in range(len(x)) if not framed.system.isVirtualSite(i)]
    assert theirs[points] == pytest.approx(forces[points], abs=rel * size)
    for atoms, frame in zip(bodies, framed.frames, strict=True):
        expected = net(places[atoms], forces[atoms])
        assert net(others[frame.particles], theirs[frame.particles]) == pytest.approx(expected, abs=100 * rel * size)


@pytest.mark.parametrize("build", FORCES)
def test_energy_and_forces_are_those_of_the_original(build):
    """To rounding, but for the charges of electrodes and PME, whose sums come in another order."""
    system, positions, bodies = pair_of_bodies(build)
    framed = with_frames(system, positions, bodies)
    rel = {constant_potential: 1e-5, alchemical: 1e-7}.get(build, 1e-9)
    for x in (positions, moved(positions, bodies)):
        checked(system, framed, x, bodies, rel=rel)


@pytest.mark.parametrize("build", [pme, by_expression, implicit, implicit_by_expression, triples])
def test_the_same_on_the_cpu_platform(build):
    """In single precision; net torques are sums of 36 forces."""
    system, positions, bodies = pair_of_bodies(build)
    checked(system, with_frames(system, positions, bodies), moved(positions, bodies), bodies, "CPU", rel=3e-5)


@pytest.mark.parametrize("build", [by_expression, pme])
def test_a_particle_of_a_frame_may_be_where_an_atom_of_another_body_is(build):
    """Its interactions are 0 however near it comes, where energies of atoms would overflow single precision."""
    system, positions, bodies = pair_of_bodies(build)
    framed = with_frames(system, positions, bodies)
    x = framed.positions.copy()
    atom = system.getNumParticles() - 1
    x[atom] = x[framed.frames[0].particles[0]]
    x[atom, 0] += 1e-4
    for name in ("Reference", "CPU"):
        energy, _, forces = energy_and_forces(framed.system, x, name)
        expected, _, alone = energy_and_forces(system, x[: framed.numAtoms], name)
        assert np.isfinite(forces).all()
        assert energy == pytest.approx(expected, rel=1e-4)
        assert forces[atom] == pytest.approx(alone[atom], rel=1e-4)


def test_long_range_corrections_differ_by_the_number_of_particles_alone():
    system, positions, bodies = pair_of_bodies(None)
    force = periodic(polar(system, bodies, charge=0.0), openmm.NonbondedForce.CutoffPeriodic)
    system.addForce(force)
    framed = with_frames(system, positions, bodies)
    found = []
    for each, x in ((system, positions), (framed.system, framed.positions)):
        with_correction = energy_and_forces(each, x)[0]
        without = copy.deepcopy(each)
        without.getForce(0).setUseDispersionCorrection(False)
        n = each.getNumParticles()
        found.append((with_correction - energy_and_forces(without, x)[0]) * (n + 1) / n)
    assert found[1] == pytest.approx(found[0], rel=1e-9)


def test_derivatives_by_parameters_are_carried():
    system, positions, bodies = pair_of_bodies(by_expression)
    framed = with_frames(system, positions, bodies)
    found = []
    for each, x in ((system, positions), (framed.system, framed.positions)):
        context = openmm.Context(each, openmm.VerletIntegrator(0.001), platform())
        context.setPositions(x)
        found.append(context.getState(parameterDerivatives=True).getEnergyParameterDerivatives()["depth"])
    assert found[1] == pytest.approx(found[0], rel=1e-9)


def test_a_force_field_with_bodies_in_water():
    """PME of createSystem with exceptions, bonds, angles and torsions, and water that constraints hold."""
    pdb = app.PDBFile("systems/peptide.pdb")
    field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    system = field.createSystem(pdb.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9 * unit.nanometer)
    positions = array(pdb.getPositions(asNumpy=True))
    protein = [atom.index for atom in pdb.topology.atoms() if atom.residue.name != "HOH"]
    for force in system.getForces():
        if isinstance(force, openmm.NonbondedForce):
            force.setUseDispersionCorrection(False)
    framed = with_frames(system, positions, [protein], pdb.topology)
    waters = (system.getNumParticles() - len(protein)) // 3
    assert framed.system.getNumConstraints() == 3 * waters + 6
    energy, _, _ = energy_and_forces(system, framed.getAtomPositions(framed.positions))
    # The mesh of PME and its sums are of the same size; rounding of charges and splines is 1e-9 of the energy.
    assert energy_and_forces(framed.system, framed.positions)[0] == pytest.approx(energy, rel=1e-8)
