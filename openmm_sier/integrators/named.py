"""Integrators with a fixed scheme."""

from typing import ClassVar

from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER2, SIER4, SIER4G, SIER4P, Scheme
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.system.arguments import Bodies, ForceGroups, Quantity


class IntegratorWithScheme(SIERIntegrator):
    """A `SIERIntegrator` whose class fixes its scheme.

    The usual steps in water are `SCHEME.constant_energy_step` and, for hybrid Monte Carlo, `SCHEME.trial_step`, in ps.
    """

    SCHEME: ClassVar[Scheme]

    def __init__(
        self,
        stepSize: Quantity,
        bodies: Bodies = None,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: ForceGroups | None = None,
    ):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            bodies, engine, substeps, fastForceGroups: see `SIERIntegrator`.
        """
        super().__init__(stepSize, self.SCHEME, bodies, exact, engine, substeps, fastForceGroups)


class SIER2Integrator(IntegratorWithScheme):
    """Second order, one force evaluation a step: the counterpart of Verlet for rigid molecules.

    Usual step in water: 2 fs at constant energy, 4 fs in a heat bath (9 fs with heavy hydrogens).
    It is stable for steps up to 2/w for a mode of angular frequency w.

    Source: van Zon and Schofield (2007), Eq. Verlet.
    """

    SCHEME = SIER2


class SIER4Integrator(IntegratorWithScheme):
    """Fourth order, four force evaluations a step: the paper's scheme.

    Usual step in water: 4 fs at constant energy, 5 fs in hybrid Monte Carlo.
    It is stable for steps up to 3.0/w for a mode of angular frequency w.

    Source: van Zon and Schofield (2007), Eq. EFRL.
    """

    SCHEME = SIER4


class SIER4GIntegrator(IntegratorWithScheme):
    """Fourth order with a force gradient, three force evaluations a step: the choice for most work.

    Usual step in water: 4 fs at constant energy, 6 fs in hybrid Monte Carlo (9 fs with heavy hydrogens).
    It is stable for steps up to 3.46/w for a mode of angular frequency w, the longest per force evaluation of the
    fourth-order schemes.

    Source: Chin, Phys. Lett. A 226, 344 (1997), algorithm A.
    """

    SCHEME = SIER4G


class SIER4PIntegrator(IntegratorWithScheme):
    """Fourth order with a force gradient, four force evaluations a step: the most accurate below 2 fs per force.

    Usual step in water: 5 fs at constant energy, 6 fs in hybrid Monte Carlo.
    It is stable for steps up to 3.1/w for a mode of angular frequency w.

    Source: Omelyan, Mryglod and Folk, Comput. Phys. Commun. 151, 272 (2003), Eq. 44.
    """

    SCHEME = SIER4P
