"""How far trajectories of hybrid Monte Carlo miss their start when they are followed back, in a liquid."""

import openmm
import pytest

from openmm_sier import SIER4G, SIERHMCIntegrator, prepare_system
from openmm_sier.ensembles import metropolis
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Interactions
from tests.support.commands import SYSTEMS


def first_trial(steps):
    """Return the integrator after a trial of so many steps of 6 fs, in 512 molecules of TIP3P."""
    box = forcefields.read_box(SYSTEMS / "tip3p-512.pdb", interactions=Interactions(0.9, 0.75, 5e-4))
    prepare_system(box.system)
    integrator = SIERHMCIntegrator(297, 0.006, SIER4G, steps)
    integrator.setRandomNumberSeed(1)
    # Forces are in single precision.
    context = openmm.Context(box.system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(box.positions)
    integrator.step(1)
    return integrator


@pytest.mark.thorough
def test_trajectories_come_back():
    """The rounding of forces leaves some 1e-6 nm after 60 fs, a hundredth of the tolerance."""
    assert 0 < first_trial(10).reversalError < metropolis.REVERSIBLE


@pytest.mark.thorough
def test_trajectories_in_which_chaos_has_its_time_are_refused():
    """They miss by 4e-3 nm, forty times the tolerance."""
    with pytest.raises(openmm.OpenMMException, match="missed its start"):
        first_trial(100)
