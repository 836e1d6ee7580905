"""What ensembles and users ask of the native engine at a completed step, by the atoms of the Context."""

import math
from abc import abstractmethod
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, BodyState
from openmm_sier.engines.native.atom_cache import AtomCache
from openmm_sier.engines.native.reported_bodies import ReportedBodies
from openmm_sier.engines.program import V0, WORK, Program
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.records import Changes, RollbackState
from openmm_sier.engines.snapshot import Environment, Snapshot, potential_of
from openmm_sier.engines.variables import per_atom_values
from openmm_sier.system.tables import Constraints
from openmm_sier.system.temperature import Temperatures


class Potential(NamedTuple):
    """A potential energy, kJ/mol, and the box and the parameters of the Context at which it was computed."""

    energy: float
    environment: Environment


class AtomVerbs(Engine):
    """The verbs of an engine whose phase point is that of the atoms of the Context."""

    _program: Program
    _atoms: AtomCache
    _reported: ReportedBodies
    _constraints: Constraints
    _potential: Potential | None
    #: Whether OpenMM still has the forces of the end of the last step.
    _has_force: bool
    #: Whether velocities are those that the last step left.
    _follows_bath: bool

    @abstractmethod
    def _check_start(self) -> None:
        """Check atoms that were moved, and satisfy constraints."""

    # --- the phase point: the atoms as OpenMM has them ---

    def save(self) -> RollbackState:
        atoms, tally = self._atoms, self.tally
        point = atoms.positions, atoms.velocities
        return RollbackState(point, self.clock, atoms.box, tally.mark(), dict(tally.counts), self._potential)

    def restore(self, saved: RollbackState, reverse: bool = False) -> None:
        positions, velocities = saved.point
        if saved.box != self._atoms.box:
            self._atoms.write_box(saved.box)
        self._atoms.write_positions(positions)
        self._write_velocities(-velocities if reverse else velocities)
        self._follows_bath = False
        self.clock = saved.clock
        self._potential = saved.more
        self.tally.restore(saved.mark)

    def _write_velocities(self, velocities: np.ndarray) -> None:
        self._atoms.write_velocities(velocities)
        self._velocities_changed()

    def _velocities_changed(self) -> None:
        # OpenMM considers no force valid after that.
        self._has_force = False

    # --- moves of ensembles ---

    def positions(self) -> np.ndarray:
        return self._atoms.positions

    def potential_energy(self) -> float:
        if self.changes:
            self.synchronize()
        if self._potential is None:
            state = openmm.Context.getState(self._context, energy=True, parameters=True, groups=self._groups)
            self._potential = Potential(potential_of(state), Environment.of(state))
        return self._potential.energy

    def kinetic_energy(self) -> float:
        return self._atoms.kinetic_energy()

    def centre_velocity(self) -> np.ndarray:
        return self._atoms.centre_velocity()

    def transform_velocities(self, factor: float, shift: np.ndarray) -> None:
        self._atoms.scale(factor, shift)
        self._velocities_changed()

    def draw_momenta(self, kT: float, kept: float) -> None:
        """See `Verbs.draw_momenta`; constraints leave the new velocities canonical."""
        before = self.kinetic_energy()
        self._atoms.refresh_velocities(kept, kT, self.tally.noise())
        self._constrain_velocities()
        self._velocities_changed()
        self.tally.heat += self.kinetic_energy() - before
        self.tally.draws += 1

    def _constrain_velocities(self) -> None:
        """Take away what drawn velocities have along the constraints."""
        if len(self._constraints.pairs):
            self._atoms.constrain_velocities(self._integrator.getConstraintTolerance())

    def scale(self, factor: float) -> None:
        atoms, owners = self._atoms, self.moving.owners
        atoms.write_box([factor * edge for edge in atoms.box])
        positions = atoms.positions.copy()
        massive = owners >= 0
        shifts = (factor - 1) * self.molecule_centres(self._centres(positions))
        positions[massive] += shifts[:, owners[massive]].T
        atoms.write_positions(positions)
        self._check_start()
        self.forget_list()

    def _centres(self, positions: np.ndarray) -> np.ndarray:
        """Return the centres of all that moves, (3, n), nm, at positions of particles, (N, 3), nm."""
        owners = self.moving.owners
        massive = owners >= 0
        points = np.empty((3, self.moving.n))
        points[:, owners[massive]] = positions[massive].T
        return points

    # --- questions of users ---

    @property
    def bodies(self) -> BodySet:
        """Return the rigid and point bodies of the System.

        Raises:
            RigidityError: the System has constraints that do not form rigid bodies.
        """
        return self._reported.bodies

    @property
    def momentum_lag(self) -> float:
        # The program has its bath also where there is no friction.
        return self._program.momentum_lag

    def state(self) -> BodyState:
        return self._reported.state(Snapshot.of(self._context))

    def temperatures(self, conserved: bool) -> Temperatures:
        """See `Engine.temperatures`; only those of flexible molecules are those just after the bath."""
        return self._reported.temperatures(Snapshot.of(self._context), self._velocities_after_bath(), conserved)

    def _velocities_after_bath(self) -> np.ndarray | None:
        """Return velocities of all particles just after a bath in the middle of the last step, nm/ps, if it had one."""
        has_followed = self._follows_bath and Changes.ATOMS not in self.changes
        if has_followed and self.method.scheme.bath_divides_drift and self.method.fast_groups & self._groups:
            return self._bathed_velocities()
        return None

    def _bathed_velocities(self) -> np.ndarray:
        """Return the velocities that the last step kept just after its bath, (N, 3), nm/ps."""
        (velocities,) = per_atom_values(self._context, V0)
        return velocities

    def degrees_of_freedom(self, conserved: bool) -> float:
        return self._reported.degrees_of_freedom(conserved)

    def heat(self) -> float:
        """Return the energy from baths and moves, kJ/mol; NaN where the program does not count it."""
        if not self._program.counts_heat:
            return math.nan
        heat = self.tally.heat
        if WORK in self._program.vectors:
            heat += float(np.sum(per_atom_values(self._context, WORK)))
        return heat
