"""The kernels engine: compiled kernels move rigid bodies and points on a platform for GPUs, in one launch for each force."""

from __future__ import annotations

import math

import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.tally import Tally
from openmm_sier.engines.compiled.installation import InstalledStep
from openmm_sier.engines.compiled.plugin import address_of
from openmm_sier.engines.compiled.refusals import refusal, refuse_method
from openmm_sier.engines.native.engine import NativeEngine
from openmm_sier.engines.program import Program
from openmm_sier.engines.records import Changes
from openmm_sier.system import checks

#: The sum of the heat of baths, and of what OpenMM's own updates do to kinetic energies.
HEAT = "heat"


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
        self._step, self._library = installed
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
            raise refusal(f"is not on the {platform} platform, which OpenMM took: name the platform of the Context")

    def _refuse_system(self, system: openmm.System, bodies: BodySet | None) -> None:
        if system.getNumConstraints():
            checks.refuse_scaled_atoms(system)
        checks.refuse_hits_on_atoms(system, self._step.bodies)
        checks.refuse_deforming_barostats(system, self._context.getMolecules(), self._step.bodies)

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
