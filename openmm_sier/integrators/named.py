"""Integrators with a fixed scheme."""

from typing import ClassVar

from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER2, SIER4, SIER4G, SIER4P, Scheme
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.system.arguments import Bodies, ForceGroups, Quantity


class IntegratorWithScheme(SIERIntegrator):
    """Integrate by a scheme that the class fixes.

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
            stepSize: the step, a time quantity or a number in ps.
            bodies: the rigid bodies, as in `SIERIntegrator`; None finds them in the System's constraints.
            engine: you can skip this; see `SIERIntegrator`.
            substeps: you can skip this; see `SIERIntegrator`.
            fastForceGroups: you can skip this; see `SIERIntegrator`.

        Raises:
            ValueError: `SIERIntegrator` refuses a value.
            TypeError: the step is not a time, or `bodies` or `fastForceGroups` have the wrong type.
        """
        super().__init__(stepSize, self.SCHEME, bodies, exact, engine, substeps, fastForceGroups)


class SIER2Integrator(IntegratorWithScheme):
    """Integrate with second order by one force evaluation a step, as Verlet does.

    Usual steps in water: 2 fs at constant energy, 4 fs in a heat bath (9 fs with heavy hydrogens). Steps up to 2/w are
    stable for a mode of angular frequency w. For a heat bath take `SIERLangevinIntegrator`, which uses this scheme.

    >>> integrator = SIER2Integrator(2*femtoseconds)

    Source: van Zon and Schofield (2007), Eq. Verlet.
    """

    SCHEME = SIER2


class SIER4Integrator(IntegratorWithScheme):
    """Integrate with fourth order by four force evaluations a step, the paper's scheme.

    Usual steps in water: 4 fs at constant energy, 5 fs in hybrid Monte Carlo. Steps up to 3.0/w are stable for a mode
    of angular frequency w.

    >>> integrator = SIER4Integrator(4*femtoseconds)

    Source: van Zon and Schofield (2007), Eq. EFRL.
    """

    SCHEME = SIER4


class SIER4GIntegrator(IntegratorWithScheme):
    """Integrate with fourth order by three force evaluations a step: the choice at constant energy.

    Usual steps in water: 4 fs at constant energy, 6 fs in hybrid Monte Carlo (9 fs with heavy hydrogens). Steps up to
    3.46/w are stable for a mode of angular frequency w. It uses a force gradient, one force at displaced positions.

    >>> print(prepare_system(system))
    The sums of PME are balanced.
    ...
    >>> integrator = SIER4GIntegrator(4*femtoseconds)
    >>> simulation = Simulation(topology, system, integrator)
    >>> simulation.context.setPositions(positions)
    >>> simulation.context.setVelocitiesToTemperature(300*kelvin)
    >>> simulation.step(2)
    >>> temperatures = integrator.computeTemperatures()

    Source: Chin, Phys. Lett. A 226, 344 (1997), algorithm A.
    """

    SCHEME = SIER4G


class SIER4PIntegrator(IntegratorWithScheme):
    """Integrate with fourth order by four force evaluations a step: the most accurate scheme below 2 fs per force.

    Usual steps in water: 5 fs at constant energy, 6 fs in hybrid Monte Carlo. Steps up to 3.1/w are stable for a mode
    of angular frequency w. It uses a force gradient, one force at displaced positions.

    >>> integrator = SIER4PIntegrator(5*femtoseconds)

    Source: Omelyan, Mryglod and Folk, Comput. Phys. Commun. 151, 272 (2003), Eq. 44.
    """

    SCHEME = SIER4P
