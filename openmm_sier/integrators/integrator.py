"""The integrators that OpenMM users call."""

from __future__ import annotations

from typing import Any

import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER4G, Scheme
from openmm_sier.engines.native.program import Program
from openmm_sier.ensembles.ensemble import ConstantEnergy, Ensemble
from openmm_sier.integrators.binding import Binding
from openmm_sier.integrators.settings import Settings, place_of
from openmm_sier.integrators.storage import unpickled
from openmm_sier.system import arguments
from openmm_sier.system.arguments import Bodies, ForceGroups, Quantity
from openmm_sier.system.temperature import Temperatures


class SIERIntegrator(openmm.CustomIntegrator):
    """Integrator for rigid bodies by splitting schemes, with the exact solution of free rotation.

    A drop-in replacement for OpenMM's integrators: pass it to a `Simulation` or a `Context`; nothing else has to be
    called. Rigid molecules are found in the System's constraints when the Context is created. The atoms of other
    molecules are points, joined by their constraints. Velocities in the Context are those at the end of the step.

    Two engines can execute the scheme. The exact engine is a Python layer over the Context and rotates bodies exactly.
    The native engine is the integrator's own program, which OpenMM executes on any platform. It rotates bodies by
    RATTLE steps and moves molecules with constraints of any kind. XML carries the program, so that it also runs where
    this package is not imported: see docs/guide/engines.md.

    Source: van Zon and Schofield (2007).
    """

    def __init__(
        self,
        stepSize: Quantity,
        scheme: Scheme | str = SIER4G,
        bodies: Bodies = None,
        rotation: Rotation = exact,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: ForceGroups | None = None,
        ensemble: Ensemble | None = None,
    ):
        """
        Args:
            stepSize: step, a time quantity or a number in ps.
            scheme: splitting scheme, see `openmm_sier.dynamics.schemes`, or its name, such as "SIER4G".
            bodies: the rigid bodies; None finds them in the System's constraints. Lists of particle indices define
                further rigid bodies, with the geometry that they have at the first step.
            rotation: free-rotation map, such as `rotation.exact`.
            engine: "exact", "native", or "auto": exact on the CPU and Reference platforms and native on others.
            substeps: number of steps into which a drift is divided. Without fast forces these are RATTLE steps of the
                native engine: 3 and 5 make the drift fourth order, and None means 3, or 5 with SIER4, SIER4V and other
                schemes with long drifts, or 1 in each half with SIER2 and a bath. The exact engine's drifts are then
                not divided. With fast forces they are
                inner steps of SIER4G. None then means, with the exact engine, the least number for which they are no
                longer than 3 fs; with the native engine, 1, or 2 for schemes with long drifts. With SIER2 and a bath
                they are leapfrog steps, of which one has the bath in its middle and counts on both sides: n substeps
                are 2n - 1 in a step. None then means at most 3.5 fs, or 2 with the native engine. The exact
                engine takes more where an unconstrained harmonic bond is too fast for these.
            fastForceGroups: force groups that act within the drifts, as a set or a bit mask: bonds, angles and torsions
                of molecules that are not rigid. None: those of a System that `prepare_system` prepared, which are found
                when the Context is created, and none in other Systems. The exact engine computes them in a separate
                Context of those molecules alone.
            ensemble: what happens between steps of the scheme, see `openmm_sier.ensembles`; None: constant energy.

        Raises:
            ValueError: the step is negative or not finite, scheme or engine are unknown, `substeps` is below 1, or a
                force group is not from 0 to 31. A step of 0 is allowed, for Contexts that only evaluate forces: steps
                are counted and nothing moves.
            TypeError: the step is not a time, `scheme` is neither a Scheme nor a name, or `bodies` or `fastForceGroups`
                have the wrong type.
        """
        given = Settings(
            kind=place_of(type(self)),
            scheme=arguments.checked_scheme(scheme),
            step=stepSize,
            engine=engine,
            substeps=substeps,
            fast_groups=None if fastForceGroups is None else arguments.group_mask("fastForceGroups", fastForceGroups),
            bodies=bodies,
            rotation=rotation,
            ensemble=ConstantEnergy() if ensemble is None else ensemble,
        )
        super().__init__(given.step)
        self.binding = Binding(self, given)
        self.binding.declare()

    # --- what users ask ---

    @property
    def engine(self) -> str:
        """The engine in use; before a Context is created, the one that was requested."""
        return self.binding.engine_name

    @property
    def substeps(self) -> int | None:
        """Number of steps into which a drift is divided, as requested; None leaves it to the engine."""
        return self.binding.settings.substeps

    @property
    def fastForceGroups(self) -> set[int]:
        """The force groups that act within drifts."""
        return set(arguments.groups_of(self.binding.flow().fast_groups))

    @property
    def program(self) -> Program:
        """The program that the native engine executes; it can be printed.

        Raises:
            ValueError: the scheme has an operator that cannot be written out.
        """
        if self.binding.program.refusal:
            raise ValueError(self.binding.program.refusal)
        return self.binding.program

    @property
    def scheme(self) -> Scheme:
        """The splitting scheme."""
        return self.binding.settings.scheme

    @property
    def rotation(self) -> Rotation:
        """The free-rotation map."""
        return self.binding.settings.rotation

    @property
    def bodies(self) -> RigidBodies:
        """The rigid bodies of the Context that this integrator is bound to."""
        return self.binding.engine.bodies

    @property
    def forceEvaluations(self) -> int:
        """Number of force evaluations done by this integrator since its Context was created."""
        return self.binding.engine.evaluations

    @property
    def conservesMomentum(self) -> bool:
        """Whether the total momentum is conserved, so that three degrees of freedom hold no heat.

        See `openmm_sier.system.temperature.MomentumConservation`.
        """
        return self.binding.engine.conserves_momentum(self.binding.ensemble.has_friction)

    @property
    def countedHeat(self) -> float:
        """Energy that baths, moves and a CMMotionRemover have given to the bodies, kJ/mol; NaN if it is not counted.

        The native engine counts the heat of a bath where `SIERLangevinIntegrator` says.
        """
        return self.binding.engine.heat()

    def getStepSize(self) -> unit.Quantity:
        """Time by which `step(1)` advances the Context, a quantity in ps. OpenMM's own step may be a fraction of it."""
        return self.binding.settings.step * self.binding.ensemble.steps * unit.picosecond

    def setStepSize(self, size: Quantity) -> None:
        """Set the time by which `step(1)` advances the Context, a time quantity or a number in ps."""
        self.binding.change(step=arguments.step_size(size) / self.binding.ensemble.steps)

    def getBodyState(self) -> BodyState:
        """The state of the rigid bodies, brought up to date with the Context.

        Raises:
            RigidityError: the Context's positions do not form the bodies.
        """
        return self.binding.engine.state()

    def getWholeStepState(self) -> BodyState:
        """The state at which the energy less the heat is conserved, within the error of the scheme.

        It is that of `getBodyState`, but for SIER2 with a heat bath: its velocities at the end of a step, those after
        the bath, lag half a kick behind, as those of OpenMM's LangevinMiddleIntegrator do. To advance them costs a
        force evaluation.
        """
        engine = self.binding.engine
        return engine.at_whole_step(engine.state())

    def step(self, steps: int) -> None:
        """Advance by a number of steps.

        An interrupt leaves the Context at the last completed step. With the exact engine an error does the same. With
        the native engine an error leaves the Context where it happened, as with OpenMM's integrators.

        Raises:
            ValueError: `steps` is negative or not a whole number.
            RigidityError: positions set from outside do not form the bodies.
            openmm.OpenMMException: there is no Context, its System was changed, a force is not finite, or the step is
                too long for a bond.
        """
        self.binding.step(arguments.whole_number("steps", steps))

    def computeSystemTemperature(self) -> unit.Quantity:
        """Temperature from the kinetic energy and the degrees of freedom of the bodies, a quantity in K.

        OpenMM's StateDataReporter calls it. Where the total momentum is conserved, with or without a CMMotionRemover,
        three degrees of freedom and the kinetic energy of the centre of mass are left out. NaN if there are no degrees
        of freedom.
        """
        return self.computeTemperatures().total

    def computeTemperatures(self) -> Temperatures:
        """Temperatures of all motion, of translation, of rotation and of flexible molecules, quantities in K.

        A named tuple (total, translation, rotation, flexible), by the rule of `computeSystemTemperature`; NaN where
        there are no degrees of freedom. `in_kelvin` gives numbers. Translation and rotation are those of all rigid
        bodies, also of domains that linkers join; flexible is the temperature of the points of other molecules. With a
        bath in the middle of the step, as that of SIER2 is, they are those just after the bath, which have no error of
        the step.
        """
        return self.binding.engine.temperatures(self.conservesMomentum).as_quantities()

    def reported(self) -> dict[str, float]:
        """Additional columns for `ConservationReporter`, by name."""
        return {}

    def forcesChanged(self) -> None:
        """Tell the integrator that the potential was changed by other means than a method of the Context or its Forces.

        Changes of positions, velocities, box and Context parameters, and changes by `updateParametersInContext`, are
        noticed automatically.
        """
        self.binding.engine.forces_changed()

    def setIntegrationForceGroups(self, groups: ForceGroups) -> None:
        """Set the force groups that move the bodies, as a set or a bit mask; they take effect with the next step."""
        super().setIntegrationForceGroups(groups)
        self.binding.groups_changed()

    # --- copies ---

    def __copy__(self) -> SIERIntegrator:
        """An integrator with the same settings and variables, bound to no Context."""
        make, arguments = self.__reduce__()
        return make(*arguments)

    def __deepcopy__(self, memo: dict[int, Any]) -> SIERIntegrator:
        return self.__copy__()

    def __reduce__(self) -> tuple[Any, ...]:
        attributes = {name: value for name, value in vars(self).items() if name not in ("this", "binding")}
        return unpickled, (openmm.XmlSerializer.serialize(self), type(self), self.binding.settings, attributes)
