"""Checks of a System: Forces that change positions, velocities or the box, and barostats that deform bodies."""

import math
from collections.abc import Sequence

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, RigidityError, molecule_of_atoms
from openmm_sier.system import tables
from openmm_sier.system.forces import kind_of
from openmm_sier.system.geometries import RESOLUTION
from openmm_sier.system.inner_forces import all_forces
from openmm_sier.system.solver_trial import LINE_REMEDY
from openmm_sier.system.user_warnings import warn


def acting_forces(system: openmm.System) -> list[openmm.Force]:
    """Return the Forces of a System that are not passive, or contain one that is not; unknown ones are not passive."""
    acting = {part.number for part in all_forces(system) if not kind_of(part.force).is_passive}
    return [system.getForce(number) for number in sorted(acting)]


def barostats(system: openmm.System) -> list[openmm.Force]:
    """Return the barostats of OpenMM that a System has."""
    return [force for force in system.getForces() if kind_of(force).sets == "pressure"]


def gives_uncounted_heat(context: openmm.Context) -> bool:
    """Tell whether a thermostat or barostat of OpenMM acts in a Context: nobody counts the energy that it gives."""
    for force in context.getSystem().getForces():
        if kind_of(force).sets == "pressure" and force.getFrequency() > 0:
            return True
        if isinstance(force, openmm.AndersenThermostat) and context.getParameter(force.CollisionFrequency()) > 0:
            return True
    return False


def refuse_drude_particles(system: openmm.System) -> None:
    """Refuse a DrudeForce, whose particles need a cold heat bath of their own.

    Raises:
        openmm.OpenMMException: there is one.
    """
    for part in all_forces(system):
        if isinstance(part.force, openmm.DrudeForce):
            raise openmm.OpenMMException(
                f"{part.name} is a DrudeForce. These integrators have no cold bath for Drude particles: the particles "
                "would heat up from 1 K to hundreds of kelvins, and the polarization would be wrong. Take "
                "openmm.DrudeLangevinIntegrator, DrudeNoseHooverIntegrator or DrudeSCFIntegrator"
            )


def refuse_impossible_numbers(system: openmm.System) -> None:
    """Refuse masses and constraints that no motion can have; OpenMM takes them as they are.

    Raises:
        openmm.OpenMMException: a mass is negative or not finite; a constraint has a length that is not positive or not
            finite, or does not join two particles of the System.
    """
    masses = tables.masses(system)
    if (wrong := ~(np.isfinite(masses) & (masses >= 0))).any():
        atom = int(wrong.argmax())
        raise openmm.OpenMMException(
            f"The mass of particle {atom} is {masses[atom]:g} dalton: it must be positive, or 0 for a frozen atom. Did "
            "hydrogens get more mass than their neighbour had? prepare_system(system, hydrogenMass=…) avoids that"
        )
    rows = tables.constraint_rows(system)
    ends = rows[:, :2]
    is_particle = (ends >= 0) & (ends < len(masses))
    if (wrong := ~is_particle.all(axis=1) | (ends[:, 0] == ends[:, 1])).any():
        i, j = ends[wrong.argmax()].tolist()
        raise openmm.OpenMMException(
            f"A constraint joins the particles {i:.0f} and {j:.0f}: expected two different ones, of {len(masses)}"
        )
    if (wrong := ~((rows[:, 2] > 0) & (rows[:, 2] < math.inf))).any():
        i, j, length = rows[wrong.argmax()].tolist()
        raise openmm.OpenMMException(
            f"The constraint of particles {i:.0f} and {j:.0f} has the length {length:g} nm: it must be positive"
        )


def refuse_constant_pressure(system: openmm.System, bodies: BodySet) -> None:
    """Refuse a System whose volume an integrator cannot change.

    Raises:
        openmm.OpenMMException: it is not periodic, has a barostat of its own, or a particle that belongs to no body.
    """
    if not system.usesPeriodicBoundaryConditions():
        raise openmm.OpenMMException("A constant pressure needs a periodic System (nonbondedMethod=PME)")
    for force in barostats(system):
        raise openmm.OpenMMException(
            f"Two barostats: pressure= of the integrator and a {type(force).__name__} in the System. Remove one"
        )
    for i in np.flatnonzero(bodies.owners < 0).tolist():
        if not system.isVirtualSite(i):
            raise openmm.OpenMMException(
                f"At constant pressure all particles move with the box, but particle {i} belongs to no body: it has no "
                "mass, or was left out of `bodies`. Leave out `pressure`, or give the particle a mass and restrain it "
                "by a force"
            )


def refuse_scaled_atoms(system: openmm.System) -> None:
    """Refuse a barostat that scales atoms one by one, which deforms whatever is rigid.

    Raises:
        RigidityError: there is one.
    """
    for barostat in barostats(system):
        if hasattr(barostat, "getScaleMoleculesAsRigid") and not barostat.getScaleMoleculesAsRigid():
            raise RigidityError(
                f"{type(barostat).__name__} scales each atom separately, which deforms rigid bodies and breaks "
                "constraints: create it with scaleMoleculesAsRigid=True"
            )


def refuse_deforming_barostats(system: openmm.System, molecules: Sequence[Sequence[int]], bodies: BodySet) -> None:
    """Refuse a barostat that moves atoms of one body apart; molecules are those of `Context.getMolecules()`.

    Raises:
        RigidityError: a barostat scales atoms one by one, or moves apart molecules that share a body.
    """
    extended = [species for species in bodies.species if species.atoms.shape[1] > 1]
    if not extended or not barostats(system):
        return
    refuse_scaled_atoms(system)
    molecule = molecule_of_atoms(molecules, bodies.n_particles)
    for species in extended:
        split = np.ptp(molecule[species.atoms], axis=1) > 0
        if split.any():
            raise RigidityError(
                f"{bodies.describe_atoms(species.atoms[np.argmax(split)])} consists of several molecules, and "
                f"{type(barostats(system)[0]).__name__} moves each of them separately: join them by "
                "prepare_system(system, bodies) before the Context is made; or leave out the barostat, and give the "
                "integrator pressure=…"
            )


def warn_about_moving_frozen_atoms(system: openmm.System) -> None:
    """Warn of a barostat of OpenMM in a System with frozen atoms, which it moves too."""
    if barostats(system) and (frozen := tables.frozen_atoms(system)).size:
        warn(
            f"{type(barostats(system)[0]).__name__} moves all molecules with the box, those of frozen atoms too (of "
            f"the mass 0, such as atom {frozen[0]}), and counts frozen molecules among those that share the heat. To "
            "hold atoms in place at constant pressure, restrain them by forces"
        )


def warn_about_other_temperatures(context: openmm.Context, temperature: float) -> bool:
    """Warn of a barostat or an AndersenThermostat of OpenMM that has another temperature in K than a heat bath now.

    Returns:
        Whether there is one.
    """
    others = False
    for force in [force for force in context.getSystem().getForces() if kind_of(force).sets]:
        theirs = context.getParameter(force.Temperature())
        if not math.isclose(theirs, temperature, rel_tol=1e-6):
            others = True
            warn(
                f"The {type(force).__name__} has {theirs:g} K, but the heat bath of the integrator has "
                f"{temperature:g} K: averages belong to neither temperature. Set both to the same; for the "
                f"{type(force).__name__} call context.setParameter({type(force).__name__}.Temperature(), "
                f"{temperature:g})"
            )
    return others


def is_line(masses: np.ndarray, places: np.ndarray) -> bool:
    """Tell whether atoms at places (k, 3) are within `RESOLUTION` of the axis of the smallest moment of inertia."""
    arms = places - masses @ places / masses.sum()
    _, axes = np.linalg.eigh(np.einsum("k,kx,ky->xy", masses, arms, arms))
    return bool(np.linalg.norm(arms @ axes[:, :2], axis=1).max() <= RESOLUTION)


def refuse_constrained_lines(system: openmm.System, bodies: BodySet) -> None:
    """Refuse rigid bodies of three or more atoms on a line, within `RESOLUTION`, that constraints hold.

    OpenMM's own constraint solvers divide by zero there: minimization, `applyConstraints` and
    `setVelocitiesToTemperature` give NaN. Bodies that are not quite lines spin about their axes by several radians in
    any usual step, and their constraints differ from those of a line by less than force fields give.

    Raises:
        RigidityError: there is one; the message names the first.
    """
    for species in bodies.species:
        if species.atoms.shape[1] < 3 or not is_line(species.masses, species.sites.T):
            continue
        for row in species.atoms[tables.constraints(system).hold(species.atoms)]:
            raise RigidityError(
                f"{bodies.describe_atoms(row)}: these atoms lie on a line (within {RESOLUTION:g} nm), and every two of "
                "them are constrained. OpenMM cannot solve such constraints and sets their positions to NaN. "
                f"{LINE_REMEDY}"
            )


def warn_about_misfit(bodies: BodySet, misfit: np.ndarray) -> bool:
    """Warn of atoms that move by more than the rounding of a PDB file when bodies are fitted to them.

    Returns whether there were any. The misfit of a body is the largest distance of an atom from its place, (n,), nm.
    """
    off = int(np.count_nonzero(misfit > RESOLUTION))
    if not off:
        return False
    worst = int(misfit.argmax())
    warn(
        f"{off} of {bodies.n} bodies do not quite have the shape of their constraints, or the geometry that they were "
        f"given, and are corrected: an atom moves by up to {misfit[worst]:.4f} nm, in {bodies.describe(worst)}. Were "
        "the positions made with another force field?"
    )
    return True
