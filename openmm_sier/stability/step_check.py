"""Check whether a step is short enough for what vibrates and spins in a System."""

from collections.abc import Callable, Sequence

import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.species import Species
from openmm_sier.stability.spins import ROOM_TEMPERATURE, Spins
from openmm_sier.stability.vibrations import Vibrations


class StepCheck:
    """Refuse steps that are too long for bonds, librations and spins; warn of those at which the energy walks."""

    def __init__(
        self,
        system: openmm.System,
        bodies: BodySet,
        inner_step: Callable[[Flow, float], float] | None = None,
        rigid: Sequence[Species] | None = None,
    ):
        """
        Args:
            system: openmm.System.
            bodies: what moves in it.
            inner_step: gives the longest step of a flow within drifts, ps. Its second argument is the longest step that
                the bonds bear, for flows that leave the number of substeps open. None: the number of the flow, or one.
            rigid: the kinds of rigid body; None: those of `bodies`.
        """
        self._spins = Spins(system, bodies.species if rigid is None else rigid, bodies.describe_atoms)
        self._vibrations = Vibrations(system, bodies)
        self._inner_step = inner_step or _as_asked
        self._checked: tuple = ()
        #: The flow and the groups for which an inner step was found, and that step.
        self._found: tuple[Flow | None, int, float] = (None, 0, 0.0)

    def inner_step(self, flow: Flow, groups: int) -> float:
        """Return the longest step of a flow within drifts, ps; `groups` are the integration force groups, a bit mask.

        It is found anew only for another flow, and after stiffer expressions were measured.
        """
        known, with_groups, found = self._found
        if known is not flow or with_groups != groups:
            borne = self._vibrations.longest_inner_step(flow.scheme.within_drifts, groups & flow.fast_groups)
            found = self._inner_step(flow, borne)
            self._found = flow, groups, found
        return found

    def __call__(self, flow: Flow, groups: int, context: openmm.Context | None = None) -> None:
        """Check a flow, once, by forces of integration force groups, a bit mask.

        Engines call it before the first step and not earlier: a Context may also be made for energies alone.

        Args:
            flow: what will be followed.
            groups: the integration force groups.
            context: whose positions tell how stiff expressions are; None before there are any.

        Raises:
            openmm.OpenMMException: the step is too long.
        """
        if context is not None and self._vibrations.measure(context):
            self._checked, self._found = (), (None, 0, 0.0)
        temperature = ROOM_TEMPERATURE if flow.bath is None else flow.bath.temperature
        checked = flow.scheme, flow.step, flow.substeps, flow.fast_groups, groups, temperature
        if checked == self._checked:
            return
        slow, fast = groups & ~flow.fast_groups, groups & flow.fast_groups
        self._vibrations.check(flow.scheme, flow.step, slow)
        self._spins.check(flow.scheme, flow.step, slow, temperature)
        inner_step = self.inner_step(flow, groups)
        self._vibrations.check_nested(flow.scheme, flow.scheme.within_drifts, inner_step, flow.step, fast)
        if flow.constant_energy:
            self._vibrations.tell_of_walk(flow.scheme, flow.step, slow)
        self._checked = checked


def _as_asked(flow: Flow, _: float) -> float:
    """Return the longest step of a flow within drifts, ps, with the number of substeps that it names, or one."""
    return flow.step * flow.scheme.inner_fraction(flow.substeps or 1)
