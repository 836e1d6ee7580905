"""The integrators that OpenMM users call."""

from typing import Any

import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet, BodyState, Pair
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER4G, Scheme
from openmm_sier.engines.program import Program
from openmm_sier.engines.records import Changes
from openmm_sier.ensembles.ensemble import ConstantEnergy, Ensemble
from openmm_sier.integrators.impl import IntegratorImpl
from openmm_sier.integrators.settings import Settings, place_of
from openmm_sier.integrators.storage import pickled, unpickled
from openmm_sier.system import arguments
from openmm_sier.system.arguments import ForceGroups, Quantity
from openmm_sier.system.temperature import Temperatures


class SIERIntegrator(openmm.CustomIntegrator):
    """Integrate rigid bodies at constant energy.

    Use it like any integrator of OpenMM: give it to a `Simulation` or a `Context`. In a heat bath take its subclass
    `SIERLangevinIntegrator`, and for exact averages `SIERHMCIntegrator`. The default scheme, SIER4G, has small energy
    errors for its cost; its usual step in water is 4 fs. SIER2 and SIER4 are the schemes of the paper, with usual steps
    of 2 and 4 fs.

    The integrator finds rigid molecules in the System's constraints when the Context is created. The atoms of other
    molecules are points, with their constraints. Velocities in the Context are those at the end of the step.

    >>> print(prepare_system(system))
    The sums of PME are balanced.
    ...
    >>> integrator = SIERIntegrator(4*femtoseconds)
    >>> simulation = Simulation(topology, system, integrator)
    >>> simulation.context.setPositions(positions)
    >>> simulation.context.setVelocitiesToTemperature(300*kelvin)
    >>> simulation.step(2)
    >>> temperatures = integrator.computeTemperatures()

    Sources: van Zon and Schofield (2007) for SIER2 (Eq. Verlet) and SIER4 (Eq. EFRL); Chin, Phys. Lett. A 226, 344
    (1997), algorithm A, for SIER4G.
    """

    def __init__(
        self,
        stepSize: Quantity,
        scheme: Scheme | str = SIER4G,
        bodies: BodySet | None = None,
        rotation: Rotation = exact,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: ForceGroups | None = None,
        ensemble: Ensemble | None = None,
    ):
        """
        Args:
            stepSize: the step, a time quantity or a number in ps. With 0 nothing moves, for Contexts that only evaluate
                forces.
            scheme: the splitting scheme or its name, such as "SIER4G".
            bodies: the rigid bodies, as `RigidBodies`, with those that constraints do not form. None finds them in the
                System's constraints.
            rotation: the free-rotation map; others serve comparisons.
            engine: "auto" takes the exact engine on the CPU and Reference platforms and on GPUs the kernels engine,
                where it is installed and can move the System, or else the native one; "exact", "native" and "kernels"
                ask for one of them (docs/guide/engines.md).
            substeps: number of inner steps into which each drift is divided, at least 1; None chooses it
                (docs/guide/engines.md).
            fastForceGroups: force groups of fast bonded forces, as a set or a bit mask, or an empty set for none. None
                takes those of a System of `prepare_system`.
            ensemble: one of `openmm_sier.ensembles`; None keeps the energy constant.

        Raises:
            ValueError: the step is negative or not finite, the scheme or the engine is unknown, `substeps` is below 1,
                or a force group is not from 0 to 31.
            TypeError: the step is not a time, `scheme` is neither a Scheme nor a name, or `bodies` or `fastForceGroups`
                have the wrong type.
        """
        given = Settings(
            kind=place_of(type(self)),
            step=arguments.step_size(stepSize),
            scheme=arguments.checked_scheme(scheme),
            engine=engine,
            substeps=substeps,
            fast_groups=None if fastForceGroups is None else arguments.group_mask("fastForceGroups", fastForceGroups),
            bodies=bodies,
            rotation=rotation,
            ensemble=ConstantEnergy() if ensemble is None else ensemble,
        )
        super().__init__(given.step)
        self.impl = IntegratorImpl(self, given)
        self.impl.declare()

    # --- what users ask ---

    def __repr__(self) -> str:
        """Return the scheme, its step and the engine: `print(integrator)`."""
        step = 1000 * self.impl.settings.step
        return f"<{type(self).__name__}: {self.scheme.name} in steps of {step:g} fs, engine {self.engine}>"

    @property
    def engine(self) -> str:
        """Return the name of the engine in use; before a Context is created, the one that was requested."""
        return self.impl.engine_name

    @property
    def substeps(self) -> int | None:
        """Return the requested number of steps in a drift; None leaves it to the engine."""
        return self.impl.settings.substeps

    @property
    def fastForceGroups(self) -> set[int]:
        """Return the force groups of the fast forces, which act within drifts."""
        return set(arguments.groups_of(self.impl.method().fast_groups))

    @property
    def program(self) -> Program:
        """Return the program that the native engine executes; print it to read it.

        Raises:
            ValueError: OpenMM cannot execute an operator of the scheme in a CustomIntegrator.
        """
        if self.impl.program.refusal:
            raise ValueError(self.impl.program.refusal)
        return self.impl.program

    @property
    def scheme(self) -> Scheme:
        """Return the splitting scheme."""
        return self.impl.settings.scheme

    @property
    def rotation(self) -> Rotation:
        """Return the free-rotation map."""
        return self.impl.settings.rotation

    @property
    def bodies(self) -> BodySet:
        """Return the rigid bodies of the integrator's Context."""
        return self.impl.engine.bodies

    @property
    def forceEvaluations(self) -> int:
        """Return the number of force evaluations since the Context was created."""
        return self.impl.engine.evaluations

    @property
    def conservesMomentum(self) -> bool:
        """Return whether the total momentum is conserved, so that three degrees of freedom hold no heat.

        See `openmm_sier.system.temperature.MomentumConservation`.
        """
        return self.impl.engine.conserves_momentum(self.impl.ensemble.has_friction)

    @property
    def countedHeat(self) -> float:
        """Return the energy that baths, volume moves and a CMMotionRemover gave to the bodies, kJ/mol.

        NaN where the engine does not count it; see `countsHeat` of `SIERLangevinIntegrator`.
        """
        return self.impl.engine.heat()

    def getStepSize(self) -> unit.Quantity:
        """Return the time by which `step(1)` advances the Context, a quantity in ps.

        OpenMM's own step may be a fraction of it.
        """
        return self.impl.settings.step * self.impl.ensemble.steps * unit.picosecond

    def setStepSize(self, size: Quantity) -> None:
        """Set the time by which `step(1)` advances the Context, a time quantity or a number in ps."""
        self.impl.change(step=arguments.step_size(size) / self.impl.ensemble.steps)

    def getBodyState(self) -> BodyState:
        """Return positions, attitudes and momenta of the bodies, up to date with the Context.

        Raises:
            RigidityError: the Context's positions do not form the bodies.
        """
        return self.impl.engine.state()

    def getWholeStepState(self) -> BodyState:
        """Return the state at a whole step, at which energy minus heat is conserved within the error of the scheme.

        It is what `getBodyState` returns, except for SIER2 in a heat bath. There velocities lag half a kick behind, as
        with OpenMM's LangevinMiddleIntegrator, and this method advances them by a further force evaluation.
        """
        engine = self.impl.engine
        return engine.at_whole_step(engine.state())

    def computeBodyForces(self) -> Pair:
        """Return the forces on the bodies, and the torques about their centres of mass.

        They are those of the integration force groups, without forces of constraints, and cost a force evaluation.

        Returns:
            Two arrays (3, n), in the lab frame, kJ/mol/nm and kJ/mol, for the bodies in the order of `bodies`.

        Raises:
            RigidityError: the Context's positions do not form the bodies.
        """
        return self.impl.engine.body_forces()

    def step(self, steps: int) -> None:
        """Advance by a number of steps.

        An interrupt leaves the Context at the last completed step. With the exact engine an error does the same. With
        the others an error leaves the Context where it happened, as with OpenMM's integrators, except in trials and in
        a step that follows a move of the volume or of velocities, which are undone.

        Raises:
            ValueError: `steps` is negative or not a whole number.
            RigidityError: positions set from outside do not form the bodies.
            openmm.OpenMMException: there is no Context, a force is not finite, or the step is too long for a bond.
        """
        if type(steps) is not int or steps < 0:
            steps = arguments.whole_number("steps", steps)
        self.impl.session.step(steps)

    def computeSystemTemperature(self) -> unit.Quantity:
        """Return the temperature of all motion, a quantity in K.

        OpenMM's StateDataReporter calls it. Where the total momentum is conserved, with or without a CMMotionRemover,
        it leaves out three degrees of freedom and the kinetic energy of the centre of mass. It is NaN if there are no
        degrees of freedom.
        """
        return self.computeTemperatures().total

    def computeTemperatures(self) -> Temperatures:
        """Return the temperatures of all motion, of translation, of rotation and of flexible molecules.

        They are a named tuple (total, translation, rotation, flexible) of quantities in K, NaN where there are no
        degrees of freedom; `in_kelvin` gives numbers. Degrees of freedom are counted as in `computeSystemTemperature`.
        Translation and rotation are those of all rigid bodies, also of domains that linkers join. `flexible` is the
        temperature of the points of other molecules. With SIER2 in a bath velocities are those just after the bath,
        whose temperatures have no error of the step.
        """
        return self.impl.engine.temperatures(self.conservesMomentum).as_quantities()

    def reported(self) -> dict[str, float]:
        """Return additional columns for `ConservationReporter`, by name."""
        return {}

    def forcesChanged(self) -> None:
        """Tell the integrator that something other than a method of the Context or its Forces changed the potential.

        The integrator notices changes of positions, velocities, box and Context parameters, and those by
        `updateParametersInContext`, by itself.
        """
        self.impl.session.changed(Changes.FORCES | Changes.FAST | Changes.BONDS)

    def setConstraintTolerance(self, tol: float) -> None:
        """Set the relative error of constrained distances at which OpenMM's solvers stop.

        Args:
            tol: the error, above 0 and below 1.

        Raises:
            ValueError: it is not.
        """
        if not 0 < arguments.quantity_to_float("tol", tol, unit.dimensionless, "") < 1:
            raise ValueError(f"tol, the relative error of constraints, must be above 0 and below 1, got {tol}")
        super().setConstraintTolerance(tol)

    def setIntegrationForceGroups(self, groups: ForceGroups) -> None:
        """Set the force groups that move the bodies; they take effect with the next step.

        Args:
            groups: a set of groups from 0 to 31, or a bit mask, as `getIntegrationForceGroups` returns.

        Raises:
            ValueError: a group is not from 0 to 31.
            TypeError: `groups` is neither a set of numbers nor a mask.
            openmm.OpenMMException: the engine cannot follow them, since a fast force group is not among them. Nothing
                has been changed then.
        """
        self.impl.set_groups(groups)

    # --- copies ---

    def __copy__(self) -> "SIERIntegrator":
        """Return an integrator with the same settings and variables, bound to no Context."""
        make, arguments = self.__reduce__()
        return make(*arguments)

    def __deepcopy__(self, memo: dict[int, Any]) -> "SIERIntegrator":
        return self.__copy__()

    def __reduce__(self) -> tuple[Any, ...]:
        attributes = {name: value for name, value in vars(self).items() if name not in ("this", "impl")}
        return unpickled, (pickled(self), type(self), self.impl.settings, attributes)
