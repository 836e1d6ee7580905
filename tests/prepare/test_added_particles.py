"""Forces of a copy with frames have the energies and the forces that they had."""

import copy

import numpy as np
import openmm
import pytest
from openmm import app, unit

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


def variables(system, bodies):
    force = openmm.CustomCVForce("0.1*a^2 + 2*b")
    force.addCollectiveVariable("a", centroids(system, bodies))
    force.addCollectiveVariable("b", by_expression(system, bodies))
    return force


def external(system, bodies):
    return soft(system, bodies)[1]


FORCES = (pme, by_expression, between_groups, centroids, compounds, hydrogen_bonds, variables, external)


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
    values, others, theirs = energy_and_forces(framed.system, framed.addFramePositions(x), name)
    assert abs(energy) > 1e-3
    assert values == pytest.approx(energy, rel=rel)
    size = np.abs(forces).max()
    assert size > 1e-3
    points = [i for i in range(len(x)) if not framed.system.isVirtualSite(i)]
    assert theirs[points] == pytest.approx(forces[points], abs=rel * size)
    for atoms, frame in zip(bodies, framed.frames, strict=True):
        expected = net(places[atoms], forces[atoms])
        assert net(others[frame.particles], theirs[frame.particles]) == pytest.approx(expected, abs=100 * rel * size)


@pytest.mark.parametrize("build", FORCES)
def test_energy_and_forces_are_those_of_the_original(build):
    """To rounding: sums come in the same order."""
    system, positions, bodies = pair_of_bodies(build)
    framed = with_frames(system, positions, bodies)
    for x in (positions, moved(positions, bodies)):
        checked(system, framed, x, bodies)


@pytest.mark.parametrize("build", [pme, by_expression])
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
    results = []
    for each, x in ((system, positions), (framed.system, framed.positions)):
        with_correction = energy_and_forces(each, x)[0]
        without = copy.deepcopy(each)
        without.getForce(0).setUseDispersionCorrection(False)
        n = each.getNumParticles()
        results.append((with_correction - energy_and_forces(without, x)[0]) * (n + 1) / n)
    assert results[1] == pytest.approx(results[0], rel=1e-9)


def test_derivatives_by_parameters_are_carried():
    system, positions, bodies = pair_of_bodies(by_expression)
    framed = with_frames(system, positions, bodies)
    results = []
    for each, x in ((system, positions), (framed.system, framed.positions)):
        context = openmm.Context(each, openmm.VerletIntegrator(0.001), platform())
        context.setPositions(x)
        results.append(context.getState(parameterDerivatives=True).getEnergyParameterDerivatives()["depth"])
    assert results[1] == pytest.approx(results[0], rel=1e-9)


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
