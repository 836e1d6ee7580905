"""The kernels engine: compiled kernels move bodies and points on platforms for GPUs, in one launch for each force."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines.compiled.installation import InstalledStep
from openmm_sier.engines.compiled.kernel_text import BATHED, END_SUMS, SUM_SIZE, SUM_SLOTS
from openmm_sier.engines.compiled.plugin import address_of
from openmm_sier.engines.compiled.refusals import refusal, refuse_method
from openmm_sier.engines.compiled.trial_blocks import SUMMED
from openmm_sier.engines.exact.actions import BodyActions
from openmm_sier.engines.exact.forces import BodyForces
from openmm_sier.engines.native.constrained_start import OFF
from openmm_sier.engines.native.engine import NativeEngine
from openmm_sier.engines.program import Program
from openmm_sier.engines.records import Changes, RollbackState
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import checks

#: The sum of the heat of baths, and of what OpenMM's own updates do to kinetic energies.
HEAT = "heat"

#: Atoms of bodies that are further off their places, nm, or have velocities that differ by more from those of their
#: bodies, nm/ps, were set by a user: see `OFF`. Positions in single precision are no better.
SINGLE_OFF = 1e-6


class Motion(NamedTuple):
    """Kinetic energy, kJ/mol, and momentum, (3,), of all atoms; infinite energy where that of a body is too large."""

    kinetic: float
    momentum: np.ndarray


class KernelsEngine(NativeEngine):
    """An engine whose steps a compiled library executes. Its phase point is that of the atoms of the Context.

    In all but its steps it does what the native engine does.
    """

    name = "kernels"

    def __init__(
        self,
        context: openmm.Context,
        method: IntegrationMethod,
        tally: Tally,
        bodies: BodySet | None,
        program: Program,
        installed: InstalledStep,
    ) -> None:
        """
        Args:
            context: openmm.Context, which has the integrator.
            method: the scheme that will be executed.
            tally: of the integrator.
            bodies: the rigid bodies; None: those that the constraints form.
            program: of the native engine.
            installed: what the library executes.

        Raises:
            openmm.OpenMMException: the Context does not execute the step: it is on another platform.
        """
        self._has_warned_of_misfit = False
        self._step = installed.step
        self._library = installed.library
        self._address = address_of(context.getIntegrator())
        step = self._step
        # What the native engine has to know of its program.
        described = program._replace(
            parts=((),),
            refusal="",
            inner_fraction=step.inner_fraction,
            counts_heat=step.counts_heat,
            ends_constrained=True,
            trials=None,
        )
        super().__init__(context, method, tally, bodies, described)
        if not self._library.is_executed(self._address):
            platform = context.getPlatform().getName()
            raise refusal(f"is not on the {platform} platform, which OpenMM took")
        system = context.getSystem()
        self.moving = step.bodies
        self.step_check = StepCheck(system, self.moving, None, step.inner_fraction)

        self._forces_on_bodies = BodyForces(context, self.moving)
        self._actions = BodyActions(self._context, self, self._forces_on_bodies)

    @property
    def actions(self) -> BodyActions:
        """Return the actions of the exact engine, at the present positions of the Context."""
        self._forces_on_bodies.select(self._groups, self.method.fast_groups)
        self._forces_on_bodies.take_positions(Snapshot.of(self._context))
        return self._actions

    def _refuse_system(self, system: openmm.System, bodies: BodySet | None) -> None:
        if system.getNumConstraints():
            checks.refuse_scaled_atoms(system)
        checks.refuse_hits_on_atoms(system, self._step.bodies)
        checks.refuse_deforming_barostats(system, self._context.getMolecules, self._step.bodies)

    def accept(self, method: IntegrationMethod, groups: int | None = None) -> None:
        refuse_method(method)
        if method.fast_groups & self._groups != self._step.fast_groups or (
            groups is not None and method.fast_groups & groups != self._step.fast_groups
        ):
            raise refusal("was made for other fast force groups, and cannot change them in a Context")

    def synchronize(self) -> None:
        if Changes.VARIABLES in self.changes:
            # They bring the heat of another run.
            self._take_heat()
        super().synchronize()

    def _set_bath(self) -> None:
        super()._set_bath()
        method = self.method
        self._library.set_scalars(self._address, method.step, self._step.scalars.values(method))
        self._step_of_clock = method.step

    def _check_start(self) -> None:
        super()._check_start()
        now = Snapshot.of(self._context)
        q, A, misfit = self.moving.fit_with_misfit(now.positions)
        if not self._has_warned_of_misfit:
            self._has_warned_of_misfit = checks.warn_about_misfit(self.moving, misfit)
        if misfit.max(initial=0.0) > (SINGLE_OFF if self.precision == "single" else OFF):
            openmm.Context.setPositions(self._context, self.moving.place(q, A, now.positions))
            if self._has_sites:
                self._context.computeVirtualSites()
        p, L = self.moving.momenta(now.velocities, A)
        rigid = self.moving.move(BodyState(q, p, A, L), now.velocities.copy())
        if np.abs(rigid - now.velocities).max(initial=0.0) > SINGLE_OFF:
            openmm.Context.setVelocities(self._context, rigid)
        self._atoms.forget()

    def run(self, block: int, times: int = 1, are_forces_known: bool = True) -> float:
        """Execute a block of commands, and return the energy that it asks for, see `Library.run`."""
        return float(self._library.run(self._address, block, times, are_forces_known))

    def sum_on_device(self) -> float:
        self._library.clear_totals(self._address, END_SUMS)
        self.run(SUMMED)
        return self._motion(END_SUMS).kinetic

    def _motion(self, name: str) -> Motion:
        totals = self._library.read_totals(self._address, name, SUM_SLOTS * SUM_SIZE)
        kinetic, *momentum, excluded = totals.reshape(SUM_SLOTS, SUM_SIZE).sum(axis=0)
        energy = math.inf if excluded else float(kinetic) / self._step.sum_units
        return Motion(energy, np.array(momentum) / self._step.sum_units)

    def select_groups(self) -> None:
        """Let the next step compute forces: the program names only the fast groups."""
        self.changes |= Changes.FORCES

    # --- moves of ensembles ---

    def _constrain_velocities(self) -> None:
        """Keep the rigid part of the motion of bodies, without what points have along constraints."""
        positions, velocities = self._atoms.positions, self._atoms.velocities
        q, A = self.moving.fit(positions)
        p, L = self.moving.momenta(velocities, A)
        rigid = BodyState(q, self.moving.constraints.project(q, p), A, L)
        self._atoms.write_velocities(self.moving.move(rigid, velocities.copy()))

    def _centres(self, positions: np.ndarray) -> np.ndarray:
        return self.moving.fit(positions)[0]

    def _bathed_velocities(self) -> np.ndarray:
        return np.asarray(self._library.read_vectors(self._address, BATHED, self.moving.n_particles))

    # --- heat ---

    def save(self) -> RollbackState:
        if self._step.counts_heat:
            # The heat of steps that are not undone.
            self.heat()
        return super().save()

    def restore(self, saved: RollbackState, reverse: bool = False) -> None:
        if self._step.counts_heat:
            self._take_heat()
        super().restore(saved, reverse)

    def _take_heat(self) -> float:
        """Return the heat that the library has counted since the last time, kJ/mol."""
        return float(self._library.take_total(self._address, HEAT))

    def heat(self) -> float:
        if not self._step.counts_heat:
            return math.nan
        if Changes.VARIABLES not in self.changes:
            self.tally.heat += self._take_heat()
        return self.tally.heat

    def store(self) -> None:
        """Write the heat, the only thing that the Context does not have."""
        if self._step.counts_heat:
            self.heat()
