"""Virtual sites that belong to rigid bodies, and massless particles that should."""

from pathlib import Path

import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier import RigidBodies, SIERLangevinIntegrator, prepare_system, with_frames
from openmm_sier.inputs.inputs import read_input
from openmm_sier.inputs.pdb_files import ForceFieldError
from openmm_sier.system import checks, tables
from openmm_sier.system.links import Links
from tests.support.silence import silence
from tests.support.systems import assembled
from tests.support.waters import cluster_system, context_at, relaxed

FOUR_SITES = "tip4pew"
INPUTS = Path(__file__).parents[1] / "data" / "inputs"


def sites_of(system):
    return [i for i in range(system.getNumParticles()) if system.isVirtualSite(i)]


def with_bonds_to_sites(system):
    """A copy with a bond from each site to its oxygen, as AMBER's files have it, and an angle with a hydrogen."""
    system = openmm.XmlSerializer.clone(system)
    bonds, angles = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce()
    for site in sites_of(system):
        oxygen, hydrogen = (system.getVirtualSite(site).getParticle(k) for k in (0, 1))
        bonds.addBond(site, oxygen, 0.0125, 5e5)
        angles.addAngle(site, oxygen, hydrogen, 0.9, 400)
    system.addForce(bonds)
    system.addForce(angles)
    return system


def test_a_bond_of_a_body_to_its_own_site_is_no_bond():
    _, _, system = cluster_system(3, FOUR_SITES)
    bonded = with_bonds_to_sites(system)
    bodies = RigidBodies.from_system(bonded)
    assert repr(bodies) == repr(RigidBodies.from_system(system)) == "<RigidBodies: 3 rigid of 3 atoms>"
    assert "All molecules with bonded forces are rigid" in str(prepare_system(bonded))
    # A bond to the site of another molecule is one.
    bonded.getForce(bonded.getNumForces() - 2).addBond(3, 4, 0.3, 100.0)
    clusters = np.repeat([0, -1, 1, -1, 2, -1], [3, 1, 3, 1, 3, bonded.getNumParticles() - 11])
    assert Links(bonded).leave(clusters, 3).tolist() == [True, True, False]


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_a_bond_of_a_body_to_its_own_site_limits_no_step(engine):
    """Its period would be 28 fs."""
    topology, positions, system = cluster_system(3, FOUR_SITES)
    point = relaxed("cluster-3-tip4pew", topology, positions, system)
    bonded = with_bonds_to_sites(system)
    prepare_system(bonded, hydrogenMass=4)
    integrator = SIERLangevinIntegrator(300, 5, 0.009, engine=engine)
    with silence():
        context = context_at(bonded, integrator, point, steps=2)
    assert np.isfinite(integrator.computeTemperatures().rotation._value)
    del context


def test_sites_of_sites_belong_to_the_body():
    """Before and after the sites that place them; a site between two bodies, or one that follows the box, does not."""
    system = assembled(np.zeros(10))
    for i in range(2, 7):
        system.setParticleMass(i, 12.0)
    average = openmm.TwoParticleAverageSite
    placed = {0: average(1, 2, 0.5, 0.5), 1: average(2, 3, 0.5, 0.5), 7: average(1, 0, 0.5, 0.5)}
    placed[8] = average(3, 4, 0.5, 0.5)
    for site, how in placed.items():
        system.setVirtualSite(site, how)
    owner = np.array([-1, -1, 0, 0, 1, 1, 2, -1, -1, -1])
    assert tables.with_sites(system, owner).tolist() == [0, 0, 0, 0, 1, 1, 2, 0, -1, -1]


# --- sites that a reader did not recognize ----------------------------------------------------------------------------


def without_sites(system):
    """A copy in which virtual sites are massless particles, as OpenMM reads unknown names from AMBER's files."""
    copied = openmm.System()
    for i in range(system.getNumParticles()):
        copied.addParticle(system.getParticleMass(i))
    for i in range(system.getNumConstraints()):
        copied.addConstraint(*system.getConstraintParameters(i))
    for force in system.getForces():
        copied.addForce(openmm.XmlSerializer.clone(force))
    return copied


@pytest.mark.parametrize("third", [True, False], ids=["rigid", "without the third constraint"])
def test_charges_that_would_stay_behind_are_refused(third):
    _, positions, system = cluster_system(2, FOUR_SITES)
    frozen = without_sites(system)
    if not third:
        pairs = [frozen.getConstraintParameters(i)[:2] for i in range(frozen.getNumConstraints())]
        for i in reversed([i for i, (a, _) in enumerate(pairs) if a % 4]):
            frozen.removeConstraint(i)
    message = "particle [37] has a charge of -1.0484.* no virtual site.*rename them, or call system.setVirtualSite"
    before = openmm.XmlSerializer.serialize(frozen)
    for use in (
        prepare_system,
        lambda system: openmm.Context(system, SIERLangevinIntegrator(300, 1, 0.001)),
        lambda system: with_frames(system, positions, [[0, 1, 2]]),
    ):
        with pytest.raises((ValueError, openmm.OpenMMException), match=message):
            use(frozen)
    assert openmm.XmlSerializer.serialize(frozen) == before
    checks.refuse_sites_without_place(system)


def test_frozen_ions_and_anchors_are_accepted():
    """An anchor at the end of a constrained chain is excluded from its neighbours alone."""
    system = assembled([0.0, *(6 * [12.0]), 0.0], constraints=[(i, i + 1, 0.15) for i in range(1, 6)])
    force = openmm.NonbondedForce()
    for _ in range(8):
        force.addParticle(0.5, 0.3, 0.1)
    force.createExceptionsFromBonds([(i, i + 1) for i in range(6)], 0.5, 0.5)
    system.addForce(force)
    checks.refuse_sites_without_place(system)


def test_water_of_four_sites_without_a_third_bond_has_a_hint(monkeypatch):
    """OpenMM's reader multiplies a number by None there."""
    monkeypatch.setattr(app.AmberPrmtopFile, "createSystem", lambda *_, **__: 1.5 * None)
    with pytest.raises(ForceFieldError, match=r"amber\.prmtop: .*bond between its hydrogens"):
        read_input(INPUTS / "amber.inpcrd", INPUTS / "amber.prmtop")
