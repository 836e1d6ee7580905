"""Deprecated names of `SIERIntegrator` with a scheme, which the next release removes."""

from typing import ClassVar

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER2, SIER4, SIER4G, SIER4P, Scheme
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.system.arguments import ForceGroups, Quantity, warn_of_former_name


class IntegratorWithScheme(SIERIntegrator):
    """Integrator with the scheme of its class. The constructor warns that the name is deprecated."""

    SCHEME: ClassVar[Scheme]

    def __init__(
        self,
        stepSize: Quantity,
        bodies: BodySet | None = None,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: ForceGroups | None = None,
    ):
        """
        Args:
            stepSize: see `SIERIntegrator`.
            bodies: see `SIERIntegrator`.
            engine: see `SIERIntegrator`.
            substeps: see `SIERIntegrator`.
            fastForceGroups: see `SIERIntegrator`.

        Raises:
            ValueError: `SIERIntegrator` refuses a value.
            TypeError: `SIERIntegrator` refuses a type.
        """
        warn_of_former_name(type(self).__name__, f'SIERIntegrator(stepSize, "{self.SCHEME.name}")')
        super().__init__(stepSize, self.SCHEME, bodies, exact, engine, substeps, fastForceGroups)


class SIER2Integrator(IntegratorWithScheme):
    """Integrate by SIER2."""

    SCHEME = SIER2


class SIER4Integrator(IntegratorWithScheme):
    """Integrate by SIER4."""

    SCHEME = SIER4


class SIER4GIntegrator(IntegratorWithScheme):
    """Integrate by SIER4G, the default of `SIERIntegrator`."""

    SCHEME = SIER4G


class SIER4PIntegrator(IntegratorWithScheme):
    """Integrate by SIER4P."""

    SCHEME = SIER4P
