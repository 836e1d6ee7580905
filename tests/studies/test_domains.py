"""The models of the study of rigid domains, and its criteria."""

import math
import re
import shlex

import mdtraj
import numpy as np
import openmm
import pandas as pd
import pytest
from scipy.spatial.distance import pdist

from openmm_sier import SIERIntegrator
from openmm_sier.cli import main
from openmm_sier.inputs.equilibration import make_context
from studies.domains import chain, fullerenes, methods, models, patchy, study, zeolite
from studies.units import md
from tests.support.commands import SYSTEMS


def energy(system, positions, groups=-1):
    """kJ/mol."""
    context = make_context(openmm.XmlSerializer.clone(system), openmm.VerletIntegrator(0.001), "Reference")
    context.setPositions(positions)
    return md(context.getState(energy=True, groups=groups).getPotentialEnergy())


def test_neighbours_of_a_chain_are_a_bond_apart():
    lengths = np.linalg.norm(np.diff(chain.domain(), axis=0), axis=1)
    # A turn of a helix by 100 degrees at 0.23 nm with a rise of 0.15 nm is 0.383 nm long.
    assert np.allclose(lengths, chain.LENGTH, atol=0.004)
    assert pdist(chain.domain()).min() > 0.99 * chain.LENGTH
    assert len(chain.domain()) == len(chain.DOMAIN) == 36
    assert len(chain.SEQUENCE) == 120


def test_interactions_of_a_chain_are_those_of_the_paper():
    """Ashbaugh-Hatch and Debye-Hückel of two residues, by their formulas."""
    contacts, charges = chain.contact_force(), chain.charge_force()
    system = openmm.System()
    for residue in "KE":
        mass, charge, sigma, strength = chain.RESIDUES[residue]
        system.addParticle(mass)
        contacts.addParticle([sigma, strength])
        charges.addParticle([charge])
    system.addForce(contacts)
    system.addForce(charges)
    system.setDefaultPeriodicBoxVectors([9, 0, 0], [0, 9, 0], [0, 0, 9])
    sigma, strength = (0.636 + 0.592) / 2, (0.1790211738990582 + 0.0006935460962935) / 2

    def lennard_jones(r):
        return 4 * chain.EPSILON * ((sigma / r) ** 12 - (sigma / r) ** 6)

    for r in (0.5, 0.65, 0.8, 1.9):
        within = r < 2 ** (1 / 6) * sigma
        expected = lennard_jones(r) + chain.EPSILON * (1 - strength) if within else strength * lennard_jones(r)
        expected -= strength * lennard_jones(chain.NEAR)
        screened = [math.exp(-x / chain.DEBYE) / x for x in (r, chain.FAR)]
        expected -= chain.COULOMB * (screened[0] - screened[1])
        # OpenMM's tables of functions are not used on Reference: rounding.
        assert energy(system, [[0, 0, 0], [r, 0, 0]]) == pytest.approx(expected, rel=1e-9)


def test_springs_hold_what_is_rigid_and_change_nothing_else():
    model = patchy.model(2)
    assert energy(model.network, model.positions) == pytest.approx(energy(model.rigid, model.positions), abs=1e-6)
    assert energy(model.network, model.positions, {models.SPRINGS}) == pytest.approx(0, abs=1e-9)
    # Twice as large, springs of 0.1 nm and more have at least this energy each.
    assert energy(model.network, 2 * model.positions, {models.SPRINGS}) > 0.5 * patchy.STIFFNESS * 1e-2


def test_networks_of_chains_have_bonds_and_springs():
    model = chain.model(1)
    (force,) = (each for each in model.network.getForces() if each.getForceGroup() == models.SPRINGS)
    strengths = [md(force.getBondParameters(i)[-1]) for i in range(force.getNumBonds())]
    assert strengths.count(chain.STIFFNESS) == 2 * 35
    assert strengths.count(chain.NETWORK) == len(strengths) - 70 > 100
    assert energy(model.network, model.positions, {models.SPRINGS}) == pytest.approx(0, abs=1e-9)
    # All pairs of a domain have a spring, or interact.
    for name in ("contacts", "charges"):
        rigid, elastic = (named(system, name).getNumExclusions() for system in (model.rigid, model.network))
        assert rigid == 119 - 70 + 2 * 36 * 35 // 2
        assert elastic == 119 - 70 + force.getNumBonds()


def named(system, name):
    return next(each for each in system.getForces() if each.getName() == name)


@pytest.mark.thorough
def test_bodies_have_no_energy_of_their_own():
    model = fullerenes.model(2)
    apart = model.positions.copy()
    apart[model.bodies[0]] = model.positions[model.bodies[0]].mean(axis=0) + 1.5 * (
        apart[model.bodies[0]] - model.positions[model.bodies[0]].mean(axis=0)
    )
    # Alone in the box a body of any size has none.
    for i in range(60, model.rigid.getNumParticles()):
        force = model.rigid.getForce(0)
        force.setParticleParameters(i, 0, 1, 0)
    force.setUseDispersionCorrection(False)
    assert energy(model.rigid, apart) == pytest.approx(0, abs=1e-9)


def test_silicon_has_four_oxygens():
    cell = np.concatenate([zeolite.orbit(zeolite.SILICON), *map(zeolite.orbit, zeolite.OXYGENS)])
    assert [len(zeolite.orbit(each)) for each in (zeolite.SILICON, *zeolite.OXYGENS)] == [24, 12, 12, 24]
    apart = cell[:, None] - cell
    distances = zeolite.EDGE * np.linalg.norm(apart - np.round(apart), axis=2)
    near = np.sort(distances[:24, 24:], axis=1)
    # Bonds of silica are 0.16 nm long; the next oxygens are those of other tetrahedra, 0.37 nm away.
    assert np.allclose(near[:, :4], 0.16, atol=0.004)
    assert (near[:, 4] > 0.3).all()


def test_gas_moves_in_a_framework_that_does_not():
    model = zeolite.model(1, per_cage=1)
    result = methods.METHODS["sier2"].make(model, 0.005, 1.0, 1)
    context = make_context(result.system, result.integrator, "Reference")
    context.setPositions(result.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 50)
    context.setVelocitiesToTemperature(300, 1)
    result.integrator.step(5)
    moved = md(context.getState(positions=True).getPositions(asNumpy=True)) - model.positions
    assert not moved[: zeolite.orbit(zeolite.SILICON).size // 3 * 3].any()
    assert np.linalg.norm(moved[-3:], axis=1).min() > 0


def test_methods_match_their_descriptions():
    model = patchy.model(2)
    for name, method in methods.METHODS.items():
        result = method.make(model, 0.01, 1.0, 1)
        own = isinstance(result.integrator, SIERIntegrator)
        assert own == (name not in ("langevinmiddle", "frames"))
        assert (result.system.getNumForces() > model.rigid.getNumForces()) == method.springs


def table(**columns):
    known = {"key": "chain", "seed": 1, "method": "A", "name": "sier2"}
    return pd.DataFrame([known | dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)])


def test_the_longest_right_step_has_only_right_ones_below_it():
    rows = table(step=[20.0, 60.0, 40.0, 80.0], off=[1.0, 3.5, 2.0, 1.0])
    assert study.longest_right(rows, "chain", "A") == 40
    assert math.isnan(study.longest_right(rows.assign(off=5.0), "chain", "A"))


def test_a_step_of_the_same_error_is_between_those_that_were_run():
    verlet = pd.DataFrame({"step": [1.0, 2.0, 4.0], "rms": [0.01, 0.04, 0.16]})
    # An error that goes with the square of the step, also beyond the shortest step.
    assert study.same_error(verlet, 0.09) == pytest.approx(3)
    assert study.same_error(verlet, 0.0025) == pytest.approx(0.5)


@pytest.mark.thorough
def test_the_command_of_the_how_to_goes_from_coordinates_to_a_trajectory(tmp_path, monkeypatch):
    """With less time, and every fifth step."""
    page = (SYSTEMS.parent / "docs" / "guide" / "howto" / "rigid-domains.md").read_text()
    (listed,) = re.findall(r"^    openmm-sier (run (?:.*\\\n)*.*)$", page, re.M)
    line = listed.replace("\\\n", " ")
    monkeypatch.chdir(tmp_path)
    chain.write(tmp_path)
    shorter = re.sub(r"--time \S+", "--time 0.4", re.sub(r"--equilibrate \S+", "--equilibrate 0.06", line))
    assert main.main([*shlex.split(shorter), "--every", "0.2", "--platform", "CPU"]) == 0
    frames = mdtraj.load("chain.dcd", top="chain.pdb")
    assert frames.n_frames == 2
    domain = frames.xyz[:, 12:48].astype(float)
    apart = [pdist(each) for each in domain]
    # A trajectory has single precision: 24 nm to 2e-6 nm.
    assert np.abs(apart[1] - apart[0]).max() < 1e-5
    assert np.abs(np.diff(domain, axis=0)).max() > 1e-4
