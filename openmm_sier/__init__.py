"""Integrators of second and fourth order for rigid molecules in OpenMM."""

from openmm_sier import hooks
from openmm_sier.dynamics.bodies import BodyState, RigidityError
from openmm_sier.dynamics.motion import Motion
from openmm_sier.dynamics.schemes import SIER2, SIER2P3, SIER2V2, SIER4, SIER4G, SIER4P, SIER4V, Scheme
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator
from openmm_sier.integrators.tuning import Tuning, tune
from openmm_sier.observe.force_check import ForceCheck, ForceDoubt, ForceFault, check_forces
from openmm_sier.prepare.frames import FramedSystem, with_frames
from openmm_sier.prepare.inertia import set_inertia
from openmm_sier.prepare.pme import balance_pme
from openmm_sier.prepare.preparation import Preparation, prepare_system
from openmm_sier.system.body_selection import SelectedBodies, select_bodies
from openmm_sier.system.body_types import BodyType, add_bodies
from openmm_sier.system.diffusion import rotational_friction, translational_friction
from openmm_sier.system.find_bodies import RigidBodies
from openmm_sier.system.molecules import make_whole
from openmm_sier.version import __version__

hooks.install()

__all__ = ["SIER2", "SIER2P3", "SIER2V2", "SIER4", "SIER4G", "SIER4P", "SIER4V", "Scheme"]
__all__ += ["SIERHMCIntegrator", "SIERIntegrator", "SIERLangevinIntegrator", "SIERThermostatIntegrator"]
__all__ += ["Tuning", "tune"]
__all__ += ["BodyState", "BodyType", "RigidBodies", "RigidityError", "SelectedBodies", "make_whole", "select_bodies"]
__all__ += ["ForceCheck", "ForceDoubt", "ForceFault", "check_forces"]
__all__ += ["FramedSystem", "Preparation", "__version__", "add_bodies", "balance_pme", "prepare_system"]
__all__ += ["Motion", "rotational_friction", "set_inertia", "translational_friction", "with_frames"]
