"""Steps in which bodies with a small moment of inertia turn too far: warnings, and refusals at two kicks a turn."""

from functools import partial

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, RigidBodies, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.step_limits import FAST_SPIN
from openmm_sier.inputs.equilibration import equilibrate
from openmm_sier.stability.step_check import StepCheck
from tests.support.constrained_molecules import gas, triangle
from tests.support.reports import RecordingReport
from tests.support.silence import silence
from tests.support.systems import field, with_forces
from tests.support.waters import cluster_system, energies, platform

ENGINES = ("exact", "native")
MASSES, ARM = [12.0, 16.0, 16.0], 0.116


def trimers(degrees, edge=2):
    return gas(triangle(MASSES, np.radians(degrees), ARM), edge)


def moment(degrees):
    """About the axis: atom 0 against the two others."""
    height = ARM * np.cos(np.radians(degrees) / 2)
    return 12 * 32 / 44 * height**2


def made(system, integrator, silently=True):
    """A Context, whose step is judged as before the first step."""
    context = openmm.Context(system, integrator, platform())
    if silently:
        with silence():
            integrator.impl.refuse_long_step()
    else:
        integrator.impl.refuse_long_step()
    return context


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("make", [partial(SIERIntegrator, scheme="SIER2"), SIERIntegrator])
def test_a_step_is_long_where_fast_bodies_turn_too_far(make, engine):
    system, _ = trimers(177)
    scheme = make(0.001).scheme
    limit = scheme.accuracy_limit / (FAST_SPIN * np.sqrt(GAS_CONSTANT * 300 / moment(177)))
    made(system, make(0.99 * limit, engine=engine))
    message = r"fs is long: the body of atoms 0, 1, 2 and similar bodies have a moment of inertia of only 8e-05"
    with pytest.warns(UserWarning, match=message):
        context = made(system, make(1.01 * limit, engine=engine), silently=False)
    with silence():
        context.getIntegrator().setStepSize(1.02 * limit)
    aliased = np.pi / np.sqrt(GAS_CONSTANT * 300 / moment(177))
    with pytest.raises(openmm.OpenMMException, match=r"too long: .*3\.2 radians"):
        made(system, make(1.01 * aliased, engine=engine))


def test_the_temperature_of_a_bath_counts():
    system, _ = trimers(177)
    with pytest.warns(UserWarning, match="300 K"):
        made(system, SIERLangevinIntegrator(300, 1, 0.008), silently=False)
    made(system, SIERLangevinIntegrator(60, 1, 0.008))
    made(system, SIERLangevinIntegrator(0, 1, 0.008))


def test_where_nothing_turns_them():
    """A body alone, or among others without forces; a field turns it."""
    alone, _ = trimers(178, edge=1)
    made(alone, SIERIntegrator(0.006, "SIER2"))
    without, _ = trimers(178)
    without.removeForce(0)
    made(without, SIERIntegrator(0.006, "SIER2"))
    with pytest.warns(UserWarning, match="is long: .*atoms 0, 1, 2"):
        made(with_forces(alone, field("100*y^2", range(3))), SIERIntegrator(0.006, "SIER2"), silently=False)


@pytest.mark.parametrize("model", ["tip3p", "tip4pew"])
def test_spins_do_not_limit_molecules_that_are_no_lines(model):
    """Librations do: without a Force with charges any step below that of spins is silent."""
    _, _, system = cluster_system(3, model)
    system.removeForce([type(force) for force in system.getForces()].index(openmm.NonbondedForce))
    system.addForce(field("100*y^2", [0]))
    check = StepCheck(system, RigidBodies.from_system(system))
    # SIER2's stability limit for librations of water is 10 fs.
    assert check.longest_step(SIER2, 1, 0) > 0.01


def named(degrees):
    """The same without constraints: System, positions, and bodies of the shape that they had."""
    system, positions = trimers(degrees)
    while system.getNumConstraints():
        system.removeConstraint(0)
    rigid = np.arange(24).reshape(8, 3).tolist()
    return system, positions, RigidBodies.from_system(system, rigid=rigid, positions=positions)


def test_the_spins_of_named_bodies_count():
    system, _, bodies = named(177)
    with pytest.raises(openmm.OpenMMException, match=r"20 fs is too long: .*atoms 0, 1, 2"):
        made(system, SIERIntegrator(0.02, bodies=bodies), silently=False)
    # Those within the rounding of a PDB file of a line are put onto it.
    system, positions, bodies = named(179.9)
    context = made(system, SIERIntegrator(0.006, bodies=bodies))
    context.setPositions(positions)
    context.setVelocitiesToTemperature(300, 1)
    with silence():
        # The first step leaves rigid motion of the velocities that OpenMM drew for atoms.
        context.getIntegrator().step(1)
        start = sum(energies(context))
        context.getIntegrator().step(20)
    # Second order: of some 25 kJ/mol of kinetic energy, a hundredth.
    assert abs(sum(energies(context)) - start) < 0.3


def test_an_equilibration_takes_short_enough_steps():
    system, positions = trimers(177)
    context = made(system, SIERLangevinIntegrator(300, 1, 0.002))
    context.setPositions(positions)
    report = RecordingReport()
    with silence():
        equilibrate(context, 300, time=0.02, report=report)
    # Three quarters of 6.5 fs of SIER4G.
    assert "equilibrates in steps of 4.9 fs, since bonds or rotations are too fast" in report.notes[0]
