"""Langevin dynamics of rigid bodies, for OpenMM users."""

from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER2, Scheme
from openmm_sier.ensembles.langevin import Langevin
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.system.arguments import ForceGroups, Quantity


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
    the native engine it does not, since OpenMM's noise is only in checkpoints.

    With `pressure`, Monte Carlo moves change the volume of the box, and a restarted run repeats them exactly. OpenMM's
    barostats work with this integrator too, but a State does not contain their memory of earlier moves.
    """

    def __init__(
        self,
        temperature: Quantity,
        frictionCoeff: Quantity,
        stepSize: Quantity,
        scheme: Scheme | str = SIER2,
        bodies: BodySet | None = None,
        rotation: Rotation = exact,
        rotationalFriction: Quantity | None = None,
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
            stepSize: the step, a time quantity or a number in ps.
            scheme: the splitting scheme or its name. SIER2 is best here.
            bodies: the rigid bodies, as in `SIERIntegrator`; None finds them in the System's constraints.
            rotation: see `SIERIntegrator`.
            rotationalFriction: friction of the rotation, a quantity or a number in 1/ps; None takes `frictionCoeff`.
            pressure: for constant pressure, a quantity or a number in bar; None keeps the volume. A move scales all
                edges of the box by the same factor.
            barostatInterval: number of steps between attempts to change the volume, at least 1.
            engine: see `SIERIntegrator`.
            substeps: see `SIERIntegrator`.
            fastForceGroups: see `SIERIntegrator`.
            countsHeat: whether the native engine counts the heat of the bath, for `getHeat` and the conserved energy of
                reports, which takes up to a fifth of a step on a GPU. None counts it except on GPUs. The exact engine
                always counts it.

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

    def getFriction(self) -> unit.Quantity:
        """Return the friction of the translation, a quantity in 1/ps."""
        return self.impl.ensemble.friction / unit.picosecond

    def setFriction(self, coeff: Quantity) -> None:
        """Set the friction, a quantity or a number in 1/ps, also for the rotation unless that has its own."""
        self._change_ensemble(friction=coeff)

    def getRotationalFriction(self) -> unit.Quantity:
        """Return the friction of the rotation, a quantity in 1/ps."""
        return self.impl.ensemble.turning / unit.picosecond

    def setRotationalFriction(self, coeff: Quantity) -> None:
        """Set the friction of the rotation, a quantity or a number in 1/ps; `setFriction` no longer changes it."""
        self._change_ensemble(rotational_friction=coeff)
