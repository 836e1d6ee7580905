"""Check whether a step is short enough for the fastest motions of a System."""

import math
import re
from collections.abc import Sequence

import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.stability.advice import StepError, StepWarning
from openmm_sier.stability.motions import Motions, fastest
from openmm_sier.stability.step_rules import ROOM_TEMPERATURE, RULES, Conditions, Verdict, longest_inner_step
from openmm_sier.system.forces import kind_of
from openmm_sier.system.user_warnings import warn


class StepCheck:
    """Limits of steps by the rules of `step_rules`.

    A call refuses a step that is too long, or warns of one at which energies are wrong. `inner_step` and `longest_step`
    give steps that are short enough.
    """

    def __init__(
        self,
        system: openmm.System,
        bodies: BodySet,
        rigid: Sequence[Species] | None = None,
        inner_fraction: float | None = None,
    ):
        """
        Args:
            system: openmm.System.
            bodies: all that move in it.
            rigid: the kinds of rigid body; None: those of `bodies`.
            inner_fraction: the inner step of a program that is written already, as a fraction of the step; None: steps
                have as many inner steps as they need.
        """
        self._motions = Motions(system, bodies, bodies.species if rigid is None else rigid)
        self._is_isolated = not any(kind_of(force).sets for force in system.getForces())
        self._inner_fraction = inner_fraction
        self._checked: tuple = ()
        #: The last method and groups, and the inner step for them.
        self._known: tuple[IntegrationMethod | None, int, float] = (None, 0, 0.0)
        self._warnings: set[str] = set()

    def forget_vibrations(self) -> None:
        """Read harmonic vibrations from the System again when they are asked for: their parameters were changed."""
        self._motions.forget_vibrations()
        self._checked = ()
        self._known = None, 0, 0.0

    def inner_step(self, method: IntegrationMethod, groups: int) -> float:
        """Return the inner step of a method, ps; `groups` are the integration force groups, a bit mask.

        Of bonds only the harmonic ones count: measured motions depend on positions, and a restart must find the same.
        """
        known_method, known_groups, step = self._known
        if known_method is not method or known_groups != groups:
            bond = fastest(self._motions.harmonic, groups & method.fast_groups)
            if self._inner_fraction is not None:
                step = method.step * self._inner_fraction
            else:
                step = method.inner_step(longest_inner_step(method.scheme, None if bond is None else bond.period))
            self._known = method, groups, step
        return step

    def longest_step(
        self,
        scheme: Scheme,
        groups: int,
        fast: int,
        temperature: float = ROOM_TEMPERATURE,
        context: openmm.Context | None = None,
    ) -> float:
        """Return the longest step without a warning, ps, with inner steps that are short enough for the fast groups.

        Infinite where nothing moves fast.

        Args:
            scheme: of the step.
            groups: force groups in the kicks, a bit mask.
            fast: force groups within drifts, a bit mask.
            temperature: K.
            context: with positions, where motions are measured; None to leave those out.
        """
        if context is not None:
            self._motions.measure(context)
        conditions = Conditions(scheme, groups, fast, temperature)
        rules = [rule for rule in RULES if not (rule.judges_inner_step or rule.is_estimate)]
        limits = [rule.limit(self._motions, conditions) for rule in rules]
        return min((limit.longest_step for limit in limits if limit is not None), default=math.inf)

    def __call__(self, method: IntegrationMethod, groups: int, context: openmm.Context | None = None) -> None:
        """Check a method, once, by forces of integration force groups, a bit mask.

        Engines call it before the first step and not earlier: a Context may also be made for energies alone.

        Args:
            method: the method of the steps.
            groups: the integration force groups.
            context: where motions are measured; None before there are positions.

        Raises:
            StepError: the step is too long.
        """
        if context is not None and self._motions.measure(context):
            self._checked = ()
        scheme = method.scheme
        temperature = ROOM_TEMPERATURE if method.bath is None else method.bath.temperature
        checked = scheme, method.step, method.substeps, method.fast_groups, groups, temperature
        if checked == self._checked:
            return
        slow, fast = groups & ~method.fast_groups, groups & method.fast_groups
        conserves_energy = method.constant_energy and self._is_isolated
        step = Conditions(scheme, slow, fast, temperature, conserves_energy), method.step
        inner_step = Conditions(scheme.within_drifts, fast, is_inner=True), self.inner_step(method, groups)
        for rule in RULES:
            conditions, h = inner_step if rule.judges_inner_step else step
            limit = rule.limit(self._motions, conditions)
            if limit is not None and h > limit.longest_step:
                self._report(limit.verdict(h))
        self._checked = checked

    def _report(self, verdict: Verdict) -> None:
        """Refuse a step, or warn of it."""
        if verdict.is_refused:
            raise StepError(verdict.message)
        # The same words with other numbers are not repeated: tuning tries many steps.
        words = re.sub(r"[\d.]+", "", verdict.message)
        if words not in self._warnings:
            self._warnings.add(words)
            warn(StepWarning(verdict.message))
