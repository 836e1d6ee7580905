"""Langevin dynamics of rigid bodies, for OpenMM users."""

from openmm import unit

from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER2, Scheme
from openmm_sier.ensembles.langevin import Langevin
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.system.arguments import Bodies, ForceGroups, Quantity


class SIERLangevinIntegrator(SIERThermostatIntegrator):
    """Averages at constant temperature, or pressure, by rigid-body Langevin dynamics.

    Usual step: 9 fs with heavy hydrogens and a friction of 5/ps, 4 fs with light ones and 1/ps.

    The heat bath is exact, and placed so that averages keep the scheme's order (`Scheme.with_bath`). In SIER2 it acts
    in the middle of the step (kick, half drift, bath, half drift), as in OpenMM's LangevinMiddleIntegrator; in other
    schemes half of it acts at either end, so that velocities at the end of a step have the bath's temperature. With
    zero friction the trajectory of the exact engine is, bit for bit, that of the scheme without a bath.

    With the exact engine the noise is a function of the seed and of the number of bath operations done so far. Both
    travel in checkpoints, so that a restarted run continues the same trajectory. A State holds the count alone. A run
    restarted from it is the same if you set the same seed; noise that was used is never used again. With the native
    engine the noise is OpenMM's, which checkpoints hold and States do not.

    With `pressure`, Monte Carlo moves change the volume of the box, and a restarted run repeats them exactly. OpenMM's
    barostats work with this integrator too, but no State holds their memory of earlier moves.
    """

    def __init__(
        self,
        temperature: Quantity,
        frictionCoeff: Quantity,
        stepSize: Quantity,
        scheme: Scheme | str = SIER2,
        bodies: Bodies = None,
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
            temperature: of the bath, a quantity or a number in K.
            frictionCoeff: coupling to the bath, a quantity or a number in 1/ps. The weaker it is and the longer the
                step, the warmer are rotations than translations: with 9 fs in water by 4 K at 1/ps, 2 at 5/ps.
            stepSize: step, a time quantity or a number in ps. With SIER2 4 fs are usual for rigid water, and 9 fs on a
                System with heavy hydrogens, `prepare_system(system, hydrogenMass=4)`.
            scheme: splitting scheme or its name; one without a bath gets one by `Scheme.with_bath`. SIER2 takes one
                force a step, and has the longest step for each: see `stepSize`.
            bodies: see `SIERIntegrator`.
            rotation: free-rotation map, such as `rotation.exact`.
            rotationalFriction: friction of the rotation, if it differs from `frictionCoeff`.
            pressure: for constant pressure, a quantity or a number in bar. One move scales all edges of the box by the
                same factor, and changes ln V by up to 0.5/sqrt(number of molecules).
            barostatInterval: number of steps between attempts to change the volume.
            engine, substeps, fastForceGroups: see `SIERIntegrator`. The native engine uses OpenMM's noise.
            countsHeat: whether the native engine counts the heat of the bath, for `getHeat` and the conserved energy of
                reports. It projects velocities for this, which takes up to a fifth of a step on a GPU. None: it counts
                except on GPU platforms. The exact engine always counts.

        Raises:
            ValueError: a value is not finite or has the wrong sign.
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
        """Friction of the translation, a quantity in 1/ps."""
        return self.binding.ensemble.friction / unit.picosecond

    def setFriction(self, coeff: Quantity) -> None:
        """Set the friction, a quantity or a number in 1/ps, also for the rotation unless that has its own."""
        self._change_ensemble(friction=coeff)

    def getRotationalFriction(self) -> unit.Quantity:
        """Friction of the rotation, a quantity in 1/ps."""
        return self.binding.ensemble.turning / unit.picosecond

    def setRotationalFriction(self, coeff: Quantity) -> None:
        """Set the friction of the rotation, a quantity or a number in 1/ps; `setFriction` no longer changes it."""
        self._change_ensemble(rotational_friction=coeff)
