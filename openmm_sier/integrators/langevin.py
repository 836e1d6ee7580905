"""Langevin dynamics of rigid bodies, for OpenMM users."""

from collections.abc import Mapping

from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.friction import Friction
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER2, Scheme
from openmm_sier.ensembles.langevin import Langevin
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.system.arguments import ForceGroups, Frictions, Quantity


class SIERLangevinIntegrator(SIERThermostatIntegrator):
    """Sample averages in a heat bath, at constant volume or pressure, by Langevin dynamics of rigid bodies.

    Usual steps: 9 fs with heavy hydrogens and a friction of 5/ps, or 4 fs with unchanged masses and 1/ps.

    >>> print(prepare_system(system, hydrogenMass=4*dalton))
    The sums of PME are balanced for a heat bath.
    ...
    >>> integrator = SIERLangevinIntegrator(300*kelvin, 5/picosecond, 9*femtoseconds, pressure=1*bar)
    >>> integrator.setRandomNumberSeed(1)

    The heat bath is an exact Ornstein-Uhlenbeck process, and is placed so that averages keep the scheme's order
    (`Scheme.with_bath`). With SIER2 it acts in the middle of the step (kick, half drift, bath, half drift), as in
    OpenMM's LangevinMiddleIntegrator. With other schemes half of it acts at either end.

    A checkpoint continues the same trajectory. With the exact engine a State does too if you set the same seed. With
    the others it does not, since OpenMM's noise is only in checkpoints.

    With `pressure`, Monte Carlo moves change the volume of the box, and a restarted run repeats them exactly. OpenMM's
    barostats work with this integrator too, but a State does not contain their memory of earlier moves.
    """

    def __init__(
        self,
        temperature: Quantity,
        frictionCoeff: Frictions,
        stepSize: Quantity,
        scheme: Scheme | str = SIER2,
        bodies: BodySet | None = None,
        rotation: Rotation = exact,
        rotationalFriction: Frictions | None = None,
        pressure: Quantity | None = None,
        barostatInterval: int = 25,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: ForceGroups | None = None,
        countsHeat: bool | None = None,
    ):
        """
        Args:
            temperature: of the bath, a quantity or a number in K, not negative.
            frictionCoeff: coupling to the bath, a quantity or a number in 1/ps, not negative. A longer step needs a
                stronger bath: with 9 fs rotations of water are 4 K warmer than translations at 1/ps, and 2 K at 5/ps.
                For bodies of types, frictions by names of types: {"rod": (1, 2, 2), "default": 1}. Each is a number or
                three, along the principal axes, by ascending moments; "default" is for all bodies that are not named.
                See `translational_friction`.
            stepSize: the step, a time quantity or a number in ps.
            scheme: the splitting scheme or its name. SIER2 is best here.
            bodies: the rigid bodies, as in `SIERIntegrator`; None finds them in the System's constraints.
            rotation: see `SIERIntegrator`.
            rotationalFriction: friction of the rotation, a quantity or a number in 1/ps, or by names of types, about
                the principal axes; None takes `frictionCoeff`. See `rotational_friction`.
            pressure: for constant pressure, a quantity or a number in bar; None keeps the volume. A move scales all
                edges of the box by the same factor.
            barostatInterval: number of steps between attempts to change the volume, at least 1.
            engine: see `SIERIntegrator`.
            substeps: see `SIERIntegrator`.
            fastForceGroups: see `SIERIntegrator`.
            countsHeat: whether the native and the kernels engine count the heat of the bath, for `getHeat` and the
                conserved energy of reports, which takes up to a fifth of a step of the native engine on a GPU. None
                counts it except on GPUs. The exact engine always counts it.

        Raises:
            ValueError: a value is not finite or has the wrong sign, or `SIERIntegrator` refuses one.
            TypeError: a quantity has the wrong dimension.
        """
        bath = Langevin(
            temperature,
            frictionCoeff,
            rotationalFriction,
            pressure=pressure,
            interval=barostatInterval,
            counts_heat=countsHeat,
        )
        super().__init__(bath, stepSize, scheme, bodies, rotation, engine, substeps, fastForceGroups)

    def getFriction(self) -> Frictions:
        """Return the friction of the translation, a quantity in 1/ps, or by names of types one of three numbers."""
        return _as_quantities(self.impl.ensemble.friction)

    def setFriction(self, coeff: Frictions) -> None:
        """Set the friction, as in the constructor, also for the rotation unless that has its own."""
        self._change_ensemble(friction=coeff)

    def getRotationalFriction(self) -> Frictions:
        """Return the friction of the rotation, a quantity in 1/ps, or by names of types one of three numbers."""
        return _as_quantities(self.impl.ensemble.turning)

    def setRotationalFriction(self, coeff: Frictions) -> None:
        """Set the friction of the rotation, as in the constructor; `setFriction` no longer changes it."""
        self._change_ensemble(rotational_friction=coeff)


def _as_quantities(friction: Friction) -> Frictions:
    """Return a friction in 1/ps as a quantity, or one for each type."""
    if isinstance(friction, Mapping):
        return {name: unit.Quantity(rates, unit.picosecond**-1) for name, rates in friction.items()}
    return friction / unit.picosecond
