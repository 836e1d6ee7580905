"""Make the operators that move the bodies of one Context, with constraints, and fast forces in the drifts."""

from functools import partial

import numpy as np
import openmm

from openmm_sier.dynamics import constrained, operators
from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.ledger import Ledger
from openmm_sier.dynamics.operators import CachedForces, Operator, Rotation
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.stages import BATH, DRIFT
from openmm_sier.engines.exact.solute import SoluteForces, solute_system
from openmm_sier.system import tables
from openmm_sier.system.arguments import groups_of

#: The longest inner step where the number of substeps is left open, ps: of SIER4G, and of SIER2 around a bath, which
#: has the averages of harmonic motion right at any step below its stability limit.
LONGEST_INNER_STEP = 0.003
LONGEST_WITH_BATH = 0.0035

#: Number of atoms below which the threads of the CPU platform cost more than they save. With one thread Reference is
#: faster than CPU for bonded forces at any size (78 and 176 us for 90 atoms of a peptide, 0.73 and 1.01 ms for 816).
SMALL_SOLUTE = 200


class Motion:
    """Operators of one Context's bodies.

    Attributes:
        fast: the fast forces, a function of the positions of flexible points; None where there are none.
        solute: what computes them.
        after_bath: what the last bath made; None before the first.
    """

    def __init__(
        self,
        context: openmm.Context,
        bodies: RigidBodies,
        forces: CachedForces,
        rotation: Rotation,
        fast_groups: int,
        ledger: Ledger,
    ):
        """
        Args:
            context: openmm.Context.
            bodies: its bodies.
            forces: forces on them in the kicks.
            rotation: free-rotation map.
            fast_groups: bit mask of the force groups that act within drifts.
            ledger: counts what a bath does.

        Raises:
            SoluteError: a fast force is not a bonded force, or one of its terms acts on something other than a flexible
                point.
        """
        self._bodies, self._ledger = bodies, ledger
        self._groups = _flexible_points(bodies)
        self._members = np.flatnonzero(self._groups >= 0)
        self.solute = _solute(context, bodies, self._members, fast_groups)
        self.fast = None if self.solute is None else CachedForces(self.solute)
        self._drift = operators.drift(bodies, rotation)
        if len(self._members):
            self._outer = constrained.constrained_operators(bodies, forces, bodies.constraints, rotation, self._groups)
        else:
            self._outer = operators.body_operators(bodies, forces, rotation)
        #: The flow and the longest inner step for which a stepper was made, and the stepper.
        self._made: tuple[Flow, float, operators.Stepper] | None = None
        self.after_bath: BodyState | None = None

    def stepper(self, flow: Flow, longest: float) -> operators.Stepper:
        """Return what makes a step of a flow, with inner steps of up to `longest`, ps."""
        if self._made is None or self._made[0] is not flow or self._made[1] != longest:
            made = operators.stepper(flow.scheme, self._operators(flow, longest), flow.step)
            self._made = flow, longest, made
        return self._made[2]

    def _operators(self, flow: Flow, longest: float) -> dict[str, Operator]:
        """Return the operators that execute a flow, by name."""
        found = dict(self._outer)
        if flow.bath is not None:
            bath = constrained.bath_operator(flow.bath, self._bodies, self._ledger)
            found[BATH] = partial(self._remembered, bath)
        if self.fast is not None and longest:
            found |= self._nested_drifts(self.fast, flow.scheme, longest)
        return found

    def _remembered(self, bath: Operator, state: BodyState, h: float) -> BodyState:
        """Let a bath act, and leave what it made as `after_bath`."""
        self.after_bath = bath(state, h)
        return self.after_bath

    def follow(self, context: openmm.Context) -> None:
        """Take over parameters and box of the Context for the fast forces."""
        if self.fast is not None and self.solute is not None:
            self.solute.follow(context)
            self.fast.invalidate()

    def _nested_drifts(self, forces: CachedForces, scheme: Scheme, longest: float) -> dict[str, Operator]:
        members, constraints = self._members, self._bodies.constraints.restricted(self._members)
        groups = self._groups[members]
        if scheme.bath_divides_drift:
            # One RATTLE step in each drift: SIER2's own errors are larger.
            within = constrained.point_operators(constraints, forces, (1.0,), groups)
            moves = constrained.steps_around_bath(within, longest)
        else:
            within = constrained.point_operators(constraints, forces, groups=groups)
            moves = {DRIFT: constrained.equal_steps(scheme.within_drifts, within, longest)}
        return {name: constrained.nested_drift(self._drift, members, move) for name, move in moves.items()}


def _platform_of_solute(context: openmm.Context, atoms: int) -> tuple[openmm.Platform, dict[str, str]]:
    """Return the platform for the bonded forces of some atoms: that of the Context, or Reference if that is faster."""
    platform = context.getPlatform()
    kept = set(platform.getPropertyNames()) & {"Threads", "DeterministicForces", "Precision", "DeviceIndex"}
    properties = {name: platform.getPropertyValue(context, name) for name in kept}
    if platform.getName() == "CPU" and (properties["Threads"] == "1" or atoms < SMALL_SOLUTE):
        return openmm.Platform.getPlatformByName("Reference"), {}
    return platform, properties


def _solute(context: openmm.Context, bodies: RigidBodies, members: np.ndarray, groups: int) -> SoluteForces | None:
    """Return an object that computes the forces of some groups, a bit mask; None where there are none."""
    if not groups:
        return None
    system = context.getSystem()
    atoms = [int(bodies.atoms_of(body)[0]) for body in members.tolist()]
    rigid = np.where(bodies.point_particles, -1, bodies.owners)
    rigid[tables.frozen_atoms(system)] = bodies.n
    # Forces that cannot be fast are refused even where there is nothing to compute.
    reduced = solute_system(system, atoms, groups_of(groups), rigid)
    if not atoms or reduced.getNumForces() == 0:
        return None
    solute = SoluteForces(reduced, atoms, *_platform_of_solute(context, len(atoms)))
    solute.follow(context)
    return solute


def _flexible_points(bodies: RigidBodies) -> np.ndarray:
    """Return the number of the molecule of each point body in a molecule that is not rigid, (n,); -1 for others."""
    points = bodies.flexible & ~bodies.moments.any(axis=0)
    groups = np.full(bodies.n, -1)
    groups[points] = np.unique(bodies.molecules[points], return_inverse=True)[1]
    return groups


def inner_step(flow: Flow, borne: float) -> float:
    """Return the length of the inner steps in the longest drift of a flow, ps.

    Without `Flow.substeps` there are as many as `LONGEST_INNER_STEP` and `LONGEST_WITH_BATH` ask for, or more where the
    bonds bear only shorter steps, up to `borne`.
    """
    scheme, h = flow.scheme, flow.step
    if flow.substeps is not None:
        return h * scheme.inner_fraction(flow.substeps)
    if scheme.bath_divides_drift:
        return h / constrained.steps_with_bath(h, min(LONGEST_WITH_BATH, borne))
    longest = h * scheme.longest_drift
    return longest / constrained.inner_steps(longest, min(LONGEST_INNER_STEP, borne))
