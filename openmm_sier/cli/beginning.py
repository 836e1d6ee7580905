"""The beginning of a simulation: the System of its input, its integrator, and a Context with a start."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import openmm

from openmm_sier.cli import run_checks
from openmm_sier.cli.console import REPORT, note
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.info import rigid_bodies
from openmm_sier.cli.methods import METHODS
from openmm_sier.cli.options import RECOMMENDED
from openmm_sier.cli.plan import Options, Plan, RunError, noted_plan
from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.inputs.forcefields import describe
from openmm_sier.inputs.inputs import fingerprints, read_input
from openmm_sier.inputs.pdb_files import first_line
from openmm_sier.inputs.starts import make_context, prepare, stop_centre_of_mass
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator
from openmm_sier.observe import stock
from openmm_sier.prepare.preparation import prepare_system


def read_start(checkpoint: Path | None) -> tuple[openmm.State | None, Plan | None]:
    """The state from which a new run starts, and the plan of the run that reached it; None without a checkpoint.

    Raises:
        RecordError, RunError, OSError: as their messages say.
    """
    if checkpoint is None:
        return None, None
    state, notes = checkpoints.read_checkpoint(checkpoint)
    return state, noted_plan(checkpoint, notes["plan"])


class Simulated:
    """What is simulated, with the System prepared for long steps.

    Attributes:
        options: of the command.
        plan: of the run.
        box: with the System.
        bodies: its rigid bodies.
        fast: force groups that are fast.
        inputs: fingerprints of the files that were read.
        unsettled: how a doubtful equilibration ended, in words; None without one.
    """

    def __init__(self, options: Options, plan: Plan):
        """Read the files of the input, and prepare their System.

        Raises:
            RunError: the plan needs a periodic box, which there is none.
            ForceFieldError, RigidityError, OSError: as their messages say.
        """
        box = read_input(options.box, plan.topology, plan.forcefield, plan.constraints, plan.interactions, plan.edges)
        note(f"{options.box}: force field {' '.join(box.files)} ({box.reason}); {describe(box)}")
        self.options, self.plan, self.box = options, plan, box
        self.bodies = rigid_bodies(box, plan.rigid)
        prepared = prepare_system(box.system, self.bodies)
        self.fast = prepared.fastForceGroups
        if plan.rigid:
            for done in prepared.done:
                note(done)
        if plan.pressure_tensor and not box.system.usesPeriodicBoundaryConditions():
            raise RunError("--pressure-tensor needs a periodic box, which there is none")
        self.inputs = fingerprints(box.sources)
        self.unsettled: str | None = None

    def context(self, step: int = 0) -> openmm.Context:
        """The Context of the run when it begins or goes on at a step, without positions.

        Raises:
            RunError: checkpoints are too frequent for OpenMM's barostat.
        """
        plan = self.plan
        if plan.method.scheme is not None:
            return make_context(self.box.system, self.integrator(plan), self.options.platform)
        if plan.moves_volume and plan.interval(plan.checkpoint_every) < stock.BAROSTAT_INTERVAL:
            raise RunError(
                f"--checkpoint-every {plan.checkpoint_every:g} is too short: OpenMM's barostat counts its "
                f"{stock.BAROSTAT_INTERVAL} steps anew after each checkpoint"
            )
        bath = plan.temperature if plan.ensemble != "nve" else None
        piston = plan.pressure if plan.moves_volume else None
        system, integrator = stock.make_stock(self.box.system, plan.scheme, plan.dt / 1000, bath, plan.friction, piston)
        stock.seed_noise(system, integrator, plan.seed, step)
        context = make_context(system, integrator, self.options.platform)
        integrator.bind(context, self.bodies)
        return context

    def begin(self, state: openmm.State | None = None, origin: Plan | None = None) -> openmm.Context:
        """The Context of a new run, with positions and velocities.

        All methods begin alike: OpenMM's own integrators go on from a start that one of this package has made.

        Args:
            state, origin: of the checkpoint that the run starts from, and the plan of its run.

        Raises:
            RunError: the checkpoint that it starts from belongs to another system.
            Runaway: the equilibration broke down.
        """
        plan, options = self.plan, self.options
        scheme = RECOMMENDED[plan.ensemble]
        usual = METHODS[scheme].usual_step(plan.ensemble, plan.hydrogen_mass)
        stand_in = plan if plan.method.scheme else replace(plan, scheme=scheme, dt=usual)
        begun = make_context(self.box.system, self.integrator(stand_in), options.platform)
        begun.getIntegrator().binding.check_step()
        positions, minimize = self.box.positions, options.minimize
        if state is not None:
            self._start_from(begun, state, origin)
            positions, minimize = state.getPositions(), bool(minimize)
        if options.equilibrates:
            self._equilibrate(begun, positions, minimize)
        elif plan.ensemble == "nve":
            stop_centre_of_mass(begun)
        if plan.method.scheme:
            return begun
        context = self.context()
        context.setState(begun.getState(positions=True, velocities=True))
        if plan.method.leapfrog:
            stock.shift_velocities(context, -plan.dt / 2000)
        return context

    def integrator(self, plan: Plan) -> SIERIntegrator:
        """An integrator of this package for a plan, with SIER4G where the plan has a method of OpenMM."""
        step, scheme = plan.dt / 1000, plan.method.scheme or SIER4G
        # The exact engine, which runs on GPUs too, has what the native one lacks: bodies that no constraints hold.
        engine = "exact" if plan.rigid else "auto"
        shared: dict[str, Any] = {"bodies": self.bodies, "engine": engine, "fastForceGroups": self.fast}
        if plan.ensemble == "nve":
            return SIERIntegrator(step, scheme, **shared)
        shared["pressure"] = plan.pressure if plan.moves_volume else None
        made: SIERHMCIntegrator | SIERLangevinIntegrator
        if plan.ensemble == "hmc":
            friction = plan.friction or None
            made = SIERHMCIntegrator(plan.temperature, step, scheme, plan.steps_per_trial, friction, **shared)
        else:
            # The log has the conserved energy, on every platform.
            made = SIERLangevinIntegrator(plan.temperature, plan.friction, step, scheme, countsHeat=True, **shared)
        made.setRandomNumberSeed(plan.seed)
        return made

    def _start_from(self, context: openmm.Context, state: openmm.State, origin: Plan | None) -> None:
        """Take positions, velocities and box of a checkpoint."""
        start = self.options.start
        redraws = origin is not None and origin.hydrogen_mass != self.plan.hydrogen_mass
        try:
            context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
            context.setPositions(state.getPositions())
            if redraws:
                context.setVelocitiesToTemperature(self.plan.temperature, self.plan.seed)
            else:
                context.setVelocities(state.getVelocities())
            context.getIntegrator().getBodyState()
        except (RigidityError, openmm.OpenMMException) as error:
            raise RunError(f"{start} does not fit {self.options.box}: {first_line(error)}") from error
        if redraws:
            note(f"starts from the positions and box of {start}; hydrogens had another mass: velocities are drawn anew")
            return
        if origin is not None and origin.method.leapfrog:
            stock.shift_velocities(context, origin.dt / 2000)
        note(f"starts from the positions, velocities and box of {start}")

    def _equilibrate(self, context: openmm.Context, positions: Any, minimize: bool | None) -> None:
        plan, time = self.plan, self.options.equilibrate
        try:
            found = prepare(context, positions, plan.temperature, plan.seed, time, minimize, REPORT)
        except openmm.OpenMMException as error:
            if not run_checks.is_runaway(error):
                raise
            raise run_checks.Runaway(f"the equilibration broke down, do atoms overlap? {first_line(error)}") from error
        if found.doubtful:
            self.unsettled = found.described
