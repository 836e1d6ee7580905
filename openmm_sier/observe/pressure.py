"""Molecular pressure tensor of a periodic box, from momenta of molecules and the energy change under strain.

V P = sum over molecules of p p^T/M - dU/d(strain), where centres follow the box and molecules keep their shape. With
periodic boundaries the sum of centres times forces is not this virial, since it lacks the change of the box. Therefore
the total U is differentiated, including sums over periodic images and the long-range dispersion correction.
"""

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import BAR
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.engines import neighbour_list
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.system import tables
from openmm_sier.system.boxes import wrapped
from openmm_sier.system.inner_forces import all_forces
from openmm_sier.system.second_context import follow_parameters, second_context

#: Components of a symmetric tensor in the order of `MolecularPressure.components`.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

#: Strain of the central differences. In water, where pressure components fluctuate by some hundred bar, the third
#: derivative causes an error of 0.5 bar at this strain, and the rounding of energies in single precision one of 5 bar.
STRAIN = 1e-3

#: Columns of PressureReporter.
COLUMNS = ("Step", "Time (ps)", *(f"Pressure {'xyz'[i]}{'xyz'[j]} (bar)" for i, j in COMPONENTS), "Box Volume (nm^3)")


class MolecularPressure:
    """Molecular pressure tensor of the simulation in a Context.

    >>> pressure = MolecularPressure(simulation.context)
    >>> components = pressure.components(simulation.context.getState(positions=True, velocities=True))

    Energies are computed in a second Context of the same System on the same Platform, so that the first is not changed.
    Momenta are counted as they are: where the total momentum is zero, as with a CMMotionRemover, the diagonal
    components are lower by kT/V, on average, than with `pressure=` or a barostat of OpenMM.

    A tensor costs 12 energy evaluations. Changes of global parameters and of the integrator's force groups are
    followed, but not later calls of `updateParametersInContext`.
    """

    def __init__(self, context: openmm.Context) -> None:
        """
        Args:
            context: a Context of a periodic System.

        Raises:
            ValueError: the System is not periodic, has massless molecules, or a Force that ties particles to fixed
                points or is not defined in strained boxes.
        """
        system = context.getSystem()
        _check(system)
        self._source = context
        self._system = system
        self._masses = tables.masses(system)
        owners, molecule_masses = _molecules(context, self._masses)
        self._owners = owners
        self._molecule_masses = molecule_masses
        self._context = second_context(context, system)
        self._forgets = neighbour_list.is_remembered(self._context)
        self._strains = [(_strain(axes, STRAIN), _strain(axes, -STRAIN)) for axes in COMPONENTS]

    def components(self, state: openmm.State) -> np.ndarray:
        """Return the components xx, yy, zz, xy, xz and yz of the pressure in bar, the last three symmetrized, (6,).

        Args:
            state: a State of the Context with positions and velocities at the same time. Velocities of OpenMM's
                leapfrog integrators are half a step earlier.
        """
        box = state.getPeriodicBoxVectors(asNumpy=True).value_in_unit(unit.nanometer)
        velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        momenta = self._sums(self._masses[:, None] * velocities)
        kinetic = momenta.T @ (momenta / self._molecule_masses[:, None])
        slopes = self._slopes(state.getPositions(asNumpy=True).value_in_unit(unit.nanometer), box)
        volume = np.diag(box).prod()
        return np.array([kinetic[axes] for axes in COMPONENTS] - slopes) / volume / BAR

    def row(self, state: openmm.State) -> tuple[float, ...]:
        """Return values of `COLUMNS`; the arguments are those of `components`."""
        time = state.getTime().value_in_unit(unit.picosecond)
        volume = state.getPeriodicBoxVolume().value_in_unit(unit.nanometer**3)
        return (state.getStepCount(), time, *self.components(state).tolist(), volume)

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """Return sums (M, 3) over the atoms of each molecule of values (N, 3)."""
        return np.stack([np.bincount(self._owners, column) for column in values.T], axis=1)

    def _slopes(self, positions: np.ndarray, box: np.ndarray) -> np.ndarray:
        """Return derivatives of the potential energy by the strains, (6,), kJ/mol."""
        centres = self._sums(self._masses[:, None] * positions) / self._molecule_masses[:, None]
        arms = positions - centres[self._owners]
        centres = wrapped(centres, box)
        self._follow(box, centres[self._owners] + arms)
        groups = self._source.getIntegrator().getIntegrationForceGroups()
        slopes = []
        for pair in self._strains:
            energies = []
            for stretch, turn in pair:
                self._context.setPeriodicBoxVectors(*_reduced(box @ stretch.T))
                self._context.setPositions((centres @ stretch.T)[self._owners] + arms @ turn.T)
                strained = self._context.getState(energy=True, groups=groups)
                energies.append(strained.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole))
            slopes.append((energies[0] - energies[1]) / (2 * STRAIN))
        return np.array(slopes)

    def _follow(self, box: np.ndarray, positions: np.ndarray) -> None:
        """Copy the state of the first Context to the second, without memory of earlier states."""
        follow_parameters(self._source, self._context)
        if self._forgets:
            self._context.setPeriodicBoxVectors(*box)
            self._context.setPositions(positions)
            neighbour_list.forget(self._context)


def _check(system: openmm.System) -> None:
    needs = "a pressure tensor requires"
    if not system.usesPeriodicBoundaryConditions():
        raise ValueError(f"{needs} a System with periodic boundary conditions, but this one has none")
    for force in (entry.force for entry in all_forces(system)):
        if isinstance(force, openmm.CustomExternalForce):
            raise ValueError(f"{needs} forces between particles, but the System has a CustomExternalForce: remove it")
        # OpenMM supports Ewald sums only in rectangular boxes, and checks this only when a Context is created.
        if isinstance(force, openmm.NonbondedForce) and force.getNonbondedMethod() == force.Ewald:
            raise ValueError(f"{needs} nonbondedMethod=PME: OpenMM supports Ewald sums only in rectangular boxes")


def _molecules(context: openmm.Context, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the molecule (N,) of each particle, and the masses (M,) of molecules.

    Atoms of one rigid body are in one molecule, even if nothing in the System joins them.
    """
    groups = [np.array(atoms) for atoms in context.getMolecules()]
    if isinstance(integrator := context.getIntegrator(), SIERIntegrator):
        groups += [atoms for species in integrator.bodies.species for atoms in species.atoms]
    edges = np.concatenate([np.stack([np.full_like(atoms, atoms[0]), atoms], axis=1) for atoms in groups])
    owners = np.unique(joined(len(masses), edges), return_inverse=True)[1]
    totals = np.bincount(owners, masses)
    if (totals == 0).any():
        atom = int(np.flatnonzero(totals[owners] == 0)[0])
        raise ValueError(f"a pressure tensor requires moving molecules, but the molecule of atom {atom} has no mass")
    return owners, totals


def _strain(axes: tuple[int, int], size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the stretch of box and centres, and the rotation of molecules, for a symmetric strain of one component.

    OpenMM's boxes allow only upper triangular deformations, so the strained box is rotated into that form. Rotating
    everything, molecules included, does not change the energy.
    """
    strained = np.eye(3)
    i, j = axes
    strained[i, j] += size / 2
    strained[j, i] += size / 2
    stretch = np.linalg.cholesky(strained.T @ strained).T
    return stretch, stretch @ np.linalg.inv(strained)


def _reduced(box: np.ndarray) -> np.ndarray:
    """Return the same lattice in OpenMM's reduced form; box vectors are rows, lower triangular, nm."""
    a, b, c = box
    c = c - b * np.round(c[1] / b[1])
    c = c - a * np.round(c[0] / a[0])
    return np.array([a, b - a * np.round(b[0] / a[0]), c])
