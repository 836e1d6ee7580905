"""Copies of Systems with frames: atoms, constraints, molecules, refusals, topologies, and the way back."""

import io
import re

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import RigidBodies, RigidityError, prepare_system, select_bodies, with_frames
from tests.support.framed import (
    SHAPES,
    atom_velocities,
    energy_and_forces,
    frame_velocities,
    moved,
    polar,
    system_of,
    topology_of,
)
from tests.support.systems import assembled
from tests.support.waters import array, cluster_system, plain_context, platform


def atoms_of(framed, positions):
    """Where OpenMM puts the atoms for positions of frames alone."""
    frames_only = np.where(np.arange(len(positions))[:, None] < framed.numAtoms, 0.0, positions)
    points = [i for i in range(framed.numAtoms) if not framed.system.isVirtualSite(i)]
    frames_only[points] = positions[points]
    return framed.getAtomPositions(energy_and_forces(framed.system, frames_only)[1])


@pytest.mark.parametrize("name", SHAPES)
def test_sites_are_where_the_atoms_were(name):
    """Positions of some nm in double precision."""
    system, positions, bodies = system_of("N2", name)
    framed = with_frames(system, positions, bodies)
    assert np.abs(atoms_of(framed, framed.positions) - positions).max() < 1e-13
    turned = moved(positions, bodies)
    assert np.abs(atoms_of(framed, framed.addFramePositions(turned)) - turned).max() < 1e-13


def test_mass_and_degrees_of_freedom_are_those_of_the_bodies():
    system, positions, bodies = system_of("36 beads", "benzene", "carbon dioxide")
    framed = with_frames(system, positions, bodies)
    masses = [framed.system.getParticleMass(i)._value for i in range(framed.system.getNumParticles())]
    assert not any(masses[: framed.numAtoms])
    assert sum(masses) == pytest.approx(
        sum(SHAPES[name][0].sum() for name in ("36 beads", "benzene", "carbon dioxide"))
    )
    assert (len(masses) - framed.numAtoms, framed.system.getNumConstraints()) == (4 + 3 + 2, 6 + 3 + 1)
    original = [system.getParticleMass(i)._value for i in range(system.getNumParticles())]
    assert all(original)
    assert system.getNumParticles() == framed.numAtoms


def test_every_body_is_one_molecule():
    """Barostats move molecules, of which 60 unbonded atoms would be 60."""
    system, positions, bodies = system_of("C60", "benzene")
    framed = with_frames(system, positions, bodies)
    context = openmm.Context(framed.system, openmm.VerletIntegrator(0.001), platform())
    assert sorted(len(molecule) for molecule in context.getMolecules()) == [15, 64]


def test_frames_have_the_kinetic_energy_of_the_bodies():
    system, positions, bodies = system_of("36 beads", "benzene", "carbon dioxide")
    system.addParticle(5.0)
    positions = np.vstack([positions, [0, 3, 0]])
    framed = with_frames(system, positions, bodies)
    rng = np.random.default_rng(4)
    rigid = np.array(rng.normal(size=(len(positions), 3)))
    for atoms in bodies:
        spin, speed = rng.normal(size=(2, 3))
        rigid[atoms] = speed + np.cross(spin, positions[atoms])
    context = openmm.Context(framed.system, openmm.VerletIntegrator(0.001), platform())
    context.setPositions(framed.positions)
    context.setVelocities(frame_velocities(framed, positions, rigid))
    state = context.getState(positions=True, velocities=True, energy=True)
    assert np.abs(atom_velocities(framed, state) - rigid).max() < 1e-12
    masses = np.array([system.getParticleMass(i)._value for i in range(len(positions))])
    kinetic = 0.5 * (masses[:, None] * rigid**2).sum()
    # OpenMM takes the kinetic energy of a leapfrog step, which without forces is that of the velocities.
    assert state.getKineticEnergy()._value == pytest.approx(kinetic, rel=1e-12)


def test_virtual_sites_follow_the_atoms_of_bodies():
    system, positions, bodies = system_of("36 beads", "benzene")
    inner, of_inner, between = (system.addParticle(0.0) for _ in range(3))
    system.setVirtualSite(inner, openmm.OutOfPlaneSite(0, 1, 2, 0.3, 0.4, 2.0))
    system.setVirtualSite(of_inner, openmm.TwoParticleAverageSite(inner, 5, 0.3, 0.7))
    system.setVirtualSite(between, openmm.TwoParticleAverageSite(of_inner, bodies[1][0], 0.5, 0.5))
    positions = np.vstack([positions, np.zeros((3, 3))])
    expected = energy_and_forces(system, positions)[1]
    framed = with_frames(system, positions, bodies)
    assert np.abs(atoms_of(framed, framed.positions) - expected).max() < 1e-13
    assert isinstance(framed.system.getVirtualSite(between), openmm.TwoParticleAverageSite)
    turned = moved(positions, bodies)
    expected = energy_and_forces(system, turned)[1]
    assert np.abs(atoms_of(framed, framed.addFramePositions(turned)) - expected).max() < 1e-13


def test_a_cluster_of_tip4p_is_one_body_with_its_sites():
    topology, positions, system = cluster_system(8, "tip4pew")
    context = plain_context(system, positions)
    # Positions of a file are rounded.
    context.applyConstraints(1e-12)
    context.computeVirtualSites()
    positions = array(context.getState(positions=True).getPositions(asNumpy=True))
    first = [atom.index for residue in list(topology.residues())[:3] for atom in residue.atoms()]
    framed = with_frames(system, positions, [first], topology)
    assert framed.system.getNumConstraints() == 5 * 3 + 6
    # SETTLE leaves errors of 5e-9 nm, which bodies of constraints do not have.
    assert np.abs(atoms_of(framed, framed.positions) - positions).max() < 2e-8
    before, _, forces = energy_and_forces(system, positions)
    after, _, _ = energy_and_forces(framed.system, framed.positions)
    assert after == pytest.approx(before, abs=2e-8 * np.abs(forces).sum())


def test_bodies_that_openmm_can_hold_stay_as_they_are():
    _, positions, system = cluster_system(2)
    with pytest.raises(ValueError, match="no body needs a frame"):
        with_frames(system, positions)
    # Ten constraints, of which one is redundant, are too many for OpenMM's solver.
    masses, places = SHAPES["methane"]
    pairs = [(i, j) for i in range(5) for j in range(i)]
    held = assembled(masses, constraints=[(i, j, float(np.linalg.norm(places[i] - places[j]))) for i, j in pairs])
    framed = with_frames(held, places)
    assert framed.system.getNumConstraints() == 6
    assert all(framed.system.isVirtualSite(i) for i in range(5))


def test_the_topology_gets_a_chain_of_frames_and_can_be_written():
    system, positions, bodies = system_of("36 beads", "benzene")
    box = [[4, 0, 0], [0, 4, 0], [0, 0, 4]] * unit.nanometer
    topology = topology_of(bodies, box)
    atoms = list(topology.atoms())
    topology.addBond(atoms[0], atoms[1])
    framed = with_frames(system, positions, bodies, topology)
    assert topology.getNumAtoms() == 48
    assert framed.topology.getNumAtoms() == 48 + 7 == framed.system.getNumParticles()
    last = list(framed.topology.chains())[-1]
    assert [len(list(residue.atoms())) for residue in last.residues()] == [4, 3]
    assert {residue.name for residue in last.residues()} == {"FRM"}
    assert framed.topology.getNumBonds() == 1
    assert [atom.name for atom in framed.topology.atoms()][:48] == [atom.name for atom in atoms]
    written = io.StringIO()
    app.PDBFile.writeFile(framed.topology, framed.positions * unit.nanometer, written)
    assert app.PDBFile(io.StringIO(written.getvalue())).topology.getNumAtoms() == 55


def test_the_original_is_left_alone_and_the_copy_can_be_prepared_and_stored():
    system, positions, bodies = system_of("36 beads", "benzene")
    system.addForce(polar(system, bodies))
    before = openmm.XmlSerializer.serialize(system)
    framed = with_frames(system, positions, bodies)
    assert openmm.XmlSerializer.serialize(system) == before
    prepare_system(framed.system)
    again = openmm.XmlSerializer.clone(framed.system)
    energy, _, forces = energy_and_forces(again, framed.positions)
    expected, _, same = energy_and_forces(framed.system, framed.positions)
    assert energy == expected
    assert (forces == same).all()


def test_rigid_bodies_and_names_are_taken_too():
    system, positions, bodies = system_of("36 beads", "benzene")
    topology = topology_of(bodies)
    known = RigidBodies.from_system(system, rigid=bodies, positions=positions)
    made = [
        with_frames(system, positions, known),
        with_frames(system, positions * unit.nanometer, select_bodies(topology, "DOM"), topology),
        with_frames(system, (10 * positions) * unit.angstrom, bodies),
    ]
    for framed in made:
        assert framed.system.getNumParticles() == 48 + 4 + 3
        assert np.abs(framed.getAtomPositions(framed.positions) - positions).max() < 1e-12


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", [openmm.GBSAOBCForce, openmm.AmoebaMultipoleForce, openmm.RMSDForce, openmm.PythonForce]
)
def test_forces_of_rare_classes_are_refused_by_name(kind):
    system, positions, bodies = system_of("36 beads")
    # OpenMM cannot copy the PythonForce, since its function cannot be pickled.
    arguments = {openmm.RMSDForce: (positions,), openmm.PythonForce: (lambda state: (0.0, np.zeros((36, 3))),)}
    force = kind(*arguments.get(kind, ()))
    force.setName("the rare one")
    system.addForce(force)
    message = rf"the rare one \({kind.__name__}\) cannot be copied to a System with frames.*bodies="
    with pytest.raises(ValueError, match=message):
        with_frames(system, positions, bodies)


def test_forces_within_forces_are_refused_by_name():
    system, positions, bodies = system_of("36 beads")
    outer = openmm.CustomCVForce("inner")
    outer.setName("bias")
    inner = openmm.RMSDForce(positions)
    inner.setName("distance")
    outer.addCollectiveVariable("inner", inner)
    system.addForce(outer)
    with pytest.raises(ValueError, match=re.escape("distance in bias (RMSDForce)")):
        with_frames(system, positions, bodies)


def test_bad_input_is_refused():
    system, positions, bodies = system_of("36 beads", "benzene")
    with pytest.raises(ValueError, match=r"shape \(48, 3\)"):
        with_frames(system, positions[:-1], bodies)
    with pytest.raises(TypeError, match=r"openmm\.System"):
        with_frames(topology_of(bodies), positions, bodies)
    with pytest.raises(ValueError, match="no body needs a frame"):
        with_frames(system, positions)
    with pytest.raises(ValueError, match="particle 99"):
        with_frames(system, positions, [[0, 99]])
    with pytest.raises(ValueError, match="36 atoms"):
        with_frames(system, positions, bodies, topology_of(bodies[:1]))
    framed = with_frames(system, positions, bodies)
    with pytest.raises(ValueError, match=rf"shape \({len(framed.positions)}, 3\)"):
        framed.getAtomPositions(positions)
    with pytest.raises(RigidityError):
        framed.addFramePositions(positions + np.where(np.arange(48)[:, None] == 3, 0.5, 0.0))
    system.addConstraint(0, 40, 0.3)
    with pytest.raises(RigidityError, match="atoms 0 and 40"):
        with_frames(system, positions, bodies)


def test_bodies_that_the_box_cuts_and_barostats_that_deform_them_are_refused():
    system, positions, bodies = system_of("36 beads")
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(4, 5, float(np.linalg.norm(positions[4] - positions[5])), 1000.0)
    system.addForce(bonds)
    system.setDefaultPeriodicBoxVectors([8, 0, 0], [0, 8, 0], [0, 0, 8])
    cut = positions.copy()
    cut[5] += [8, 0, 0]
    with pytest.raises(RigidityError, match="atoms 4 and 5 "):
        with_frames(system, cut, bodies)
    barostat = openmm.MonteCarloAnisotropicBarostat([1, 1, 1], 300, True, True, True, 5, False)
    system.addForce(barostat)
    with pytest.raises(RigidityError, match="scaleMoleculesAsRigid=True"):
        with_frames(system, positions, bodies)
