"""Symplectic integrators of second and fourth order for rigid molecules in OpenMM."""

from openmm_sier.context import hooks
from openmm_sier.context.find_bodies import RigidBodies
from openmm_sier.context.hmc import SIERHMCIntegrator
from openmm_sier.context.integrator import SIERIntegrator
from openmm_sier.context.langevin import SIERLangevinIntegrator
from openmm_sier.context.named_integrators import SIER2Integrator, SIER4GIntegrator, SIER4Integrator, SIER4PIntegrator
from openmm_sier.context.pme import balance_pme
from openmm_sier.context.preparation import Preparation, prepare_system
from openmm_sier.context.tuning import Tuning, tune
from openmm_sier.dynamics.bodies import BodyState, RigidityError
from openmm_sier.dynamics.schemes import SIER2, SIER4, SIER4G, SIER4P, SIER4V, Scheme
from openmm_sier.version import __version__

hooks.install()

__all__ = [
    "SIER2",
    "SIER4",
    "SIER4G",
    "SIER4P",
    "SIER4V",
    "BodyState",
    "Preparation",
    "RigidBodies",
    "RigidityError",
    "SIER2Integrator",
    "SIER4GIntegrator",
    "SIER4Integrator",
    "SIER4PIntegrator",
    "SIERHMCIntegrator",
    "SIERIntegrator",
    "SIERLangevinIntegrator",
    "Scheme",
    "Tuning",
    "__version__",
    "balance_pme",
    "prepare_system",
    "tune",
]
