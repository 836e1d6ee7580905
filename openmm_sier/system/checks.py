"""Checks of a System for Forces, masses, constraints and barostats that integrators cannot handle."""

import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import openmm

from openmm_sier.dynamics.barostat import molecule_of_atoms
from openmm_sier.dynamics.bodies import BodySet, RigidityError
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.system import tables
from openmm_sier.system.forces import kind_of
from openmm_sier.system.geometries import RESOLUTION
from openmm_sier.system.inner_forces import all_forces
from openmm_sier.system.links import Links, held_bodies
from openmm_sier.system.user_warnings import warn

#: nm. Sites of water are up to this from its oxygen, the lone pairs of TIP5P; covalent bonds are longer.
LONGEST_TO_SITE = 0.072

#: Number of atoms that constraints join in the smallest molecule with sites of its own.
SMALLEST_WITH_SITES = 3


def acting_forces(system: openmm.System) -> list[openmm.Force]:
    """Return the Forces of a System that are not passive or contain such a Force; unknown Forces are not passive."""
    acting = {entry.number for entry in all_forces(system) if not kind_of(entry.force).is_passive}
    return [system.getForce(number) for number in sorted(acting)]


def barostats(system: openmm.System) -> list[openmm.Force]:
    """Return the OpenMM barostats of a System."""
    return [force for force in system.getForces() if kind_of(force).sets == "pressure"]


def gives_uncounted_heat(context: openmm.Context) -> bool:
    """Return whether a thermostat or barostat of OpenMM acts in a Context, whose heat is not counted."""
    for force in context.getSystem().getForces():
        if kind_of(force).sets == "pressure" and force.getFrequency() > 0:
            return True
        if isinstance(force, openmm.AndersenThermostat) and context.getParameter(force.CollisionFrequency()) > 0:
            return True
    return False


def refuse_drude_particles(system: openmm.System) -> None:
    """Refuse a DrudeForce, whose particles require a separate cold heat bath.

    Raises:
        openmm.OpenMMException: the System has a DrudeForce.
    """
    for entry in all_forces(system):
        if isinstance(entry.force, openmm.DrudeForce):
            raise openmm.OpenMMException(
                f"{entry.name} is a DrudeForce. These integrators have no cold bath for Drude particles: the particles "
                "would heat up from 1 K to hundreds of kelvins, and the polarization would be wrong. Take "
                "openmm.DrudeLangevinIntegrator, DrudeNoseHooverIntegrator or DrudeSCFIntegrator"
            )


def refuse_impossible_masses(system: openmm.System) -> None:
    """Refuse impossible masses, which OpenMM accepts.

    Raises:
        openmm.OpenMMException: a mass is negative or not finite.
    """
    masses = tables.masses(system)
    if (wrong := ~(np.isfinite(masses) & (masses >= 0))).any():
        atom = int(wrong.argmax())
        raise openmm.OpenMMException(
            f"The mass of particle {atom} is {masses[atom]:g} dalton: it must be positive, or 0 for a frozen atom. Was "
            "more mass moved to hydrogens than their neighbour had? prepare_system(system, hydrogenMass=…) avoids that"
        )


@tables.read_once()
def refuse_sites_without_place(system: openmm.System) -> None:
    """Refuse massless particles that belong to a molecule with constraints but are no virtual sites of it.

    OpenMM would leave them where they are, while the molecule moves on. They are excluded from interacting with every
    atom of that molecule. So may be a frozen atom next to a methyl group, but it has a bond as long as those of atoms.

    Raises:
        ValueError: there is such a particle with a charge or Lennard-Jones forces.
    """
    frozen = set(tables.frozen_atoms(system).tolist())
    if frozen:
        frozen -= _bonded_as_atoms(system)
    pairs = tables.constraints(system).pairs
    if not frozen or not len(pairs):
        return
    molecule = joined(system.getNumParticles(), pairs)
    members, sizes = np.unique(molecule, return_counts=True)
    size = dict(zip(members.tolist(), sizes.tolist(), strict=True))
    for force in system.getForces():
        if not isinstance(force, openmm.NonbondedForce):
            continue
        parameters = tables.atom_parameters(force)
        acting = {i for i in frozen if parameters[i, 0] or parameters[i, 2]}
        for i, molecules in _excluded(force, acting, molecule).items():
            whole = [number for number, count in molecules.items() if count == size[number] >= SMALLEST_WITH_SITES]
            if whole:
                first = int(np.flatnonzero(molecule == whole[0])[0])
                raise ValueError(
                    f"particle {i} has a charge of {parameters[i, 0]:g} e but no mass, and is no virtual site: OpenMM "
                    f"would leave it in its place while the molecule of atom {first}, to which it belongs, moves on. "
                    "OpenMM's reader of AMBER files knows the sites of water by the names EP and LP, in residues WAT, "
                    f"HOH, TP4 and TP5: rename them, or call system.setVirtualSite({i}, …)"
                )


def _bonded_as_atoms(system: openmm.System) -> set[int]:
    """Return the particles with a bond that is as long as those of atoms, or of unknown length."""
    links = Links(system)
    return set(np.concatenate([links.bonds[links.lengths > LONGEST_TO_SITE], links.custom]).ravel().tolist())


def _excluded(force: openmm.NonbondedForce, chosen: set[int], molecule: np.ndarray) -> dict[int, Counter[int]]:
    """Return the number of atoms of each molecule that are excluded from interacting with the chosen particles."""
    excluded: dict[int, Counter[int]] = {i: Counter() for i in chosen}
    if not chosen:
        return excluded
    for k in range(force.getNumExceptions()):
        i, j, product, _, epsilon = force.getExceptionParameters(k)
        if product._value or epsilon._value:
            continue
        for one, other in ((i, j), (j, i)):
            if one in chosen:
                excluded[one][int(molecule[other])] += 1
    return excluded


def refuse_constant_pressure(system: openmm.System, bodies: BodySet) -> None:
    """Refuse a System whose volume an integrator cannot change.

    Raises:
        openmm.OpenMMException: the System is not periodic, has a barostat, or has a particle that belongs to no body.
    """
    if not system.usesPeriodicBoundaryConditions():
        raise openmm.OpenMMException("Constant pressure requires a periodic System (nonbondedMethod=PME)")
    for force in barostats(system):
        raise openmm.OpenMMException(
            f"The integrator has pressure=… and the System a {type(force).__name__}: remove one of the two barostats"
        )
    for i in np.flatnonzero(bodies.owners < 0).tolist():
        if not system.isVirtualSite(i):
            raise openmm.OpenMMException(
                f"At constant pressure all particles move with the box, but particle {i} belongs to no body: it has no "
                "mass, or was left out of `bodies`. Leave out `pressure`, or give the particle a mass and restrain it "
                "by a force"
            )
    refuse_places(bodies, "pressure=…")


def refuse_places(bodies: BodySet, barostat: str) -> None:
    """Refuse bodies that do not move along all axes, where a barostat, of this name, moves all centres.

    Raises:
        openmm.OpenMMException: there is such a body.
    """
    held = np.flatnonzero(~bodies.translates.all(axis=0))
    if held.size:
        raise openmm.OpenMMException(
            f"At constant pressure all bodies move with the box, but {bodies.describe(held[0])} does not move along "
            f"all axes: leave out the {barostat}, or give its type another motion and restrain it by a force"
        )


def refuse_scaled_atoms(system: openmm.System) -> None:
    """Refuse a barostat that scales atoms one by one, which deforms rigid bodies.

    Raises:
        RigidityError: the System has such a barostat.
    """
    for barostat in barostats(system):
        if hasattr(barostat, "getScaleMoleculesAsRigid") and not barostat.getScaleMoleculesAsRigid():
            raise RigidityError(
                f"{type(barostat).__name__} scales each atom separately, which deforms rigid bodies and breaks "
                "constraints: create it with scaleMoleculesAsRigid=True"
            )


def refuse_deforming_barostats(
    system: openmm.System, molecules: Callable[[], Sequence[Sequence[int]]], bodies: BodySet
) -> None:
    """Refuse a barostat that deforms bodies; `molecules` is the method `Context.getMolecules`.

    Raises:
        RigidityError: a barostat scales atoms one by one, or moves molecules of one body apart.
        openmm.OpenMMException: there is a barostat, and a body that does not move along all axes.
    """
    extended = [species for species in bodies.species if species.atoms.shape[1] > 1]
    for barostat in barostats(system):
        refuse_places(bodies, type(barostat).__name__)
    if not extended or not barostats(system):
        return
    refuse_scaled_atoms(system)
    molecule = molecule_of_atoms(molecules(), bodies.n_particles)
    for species in extended:
        split = np.ptp(molecule[species.atoms], axis=1) > 0
        if split.any():
            raise RigidityError(
                f"{bodies.describe_atoms(species.atoms[np.argmax(split)])} consists of several molecules, and "
                f"{type(barostats(system)[0]).__name__} moves each of them separately. Join them by "
                "prepare_system(system, bodies) before the Context is made; or remove the barostat, and give the "
                "integrator pressure=…"
            )


def refuse_hits_on_atoms(system: openmm.System, bodies: BodySet) -> None:
    """Refuse an AndersenThermostat beside bodies that constraints do not hold.

    Raises:
        openmm.OpenMMException: the System has one, and there is such a body.
    """
    if not any(isinstance(force, openmm.AndersenThermostat) for force in system.getForces()):
        return
    for species, is_held in zip(bodies.species, held_bodies(system, bodies.species), strict=True):
        if not is_held.all():
            raise openmm.OpenMMException(
                "AndersenThermostat draws velocities of single atoms, of which a body keeps only the rigid part, and "
                f"constraints do not join all atoms of {bodies.describe_atoms(species.atoms[np.argmin(is_held)])}. "
                "Remove the AndersenThermostat and use SIERLangevinIntegrator"
            )


def warn_about_other_temperatures(context: openmm.Context, temperature: float) -> bool:
    """Warn if the temperature of a barostat or thermostat of OpenMM differs from that of a heat bath, in K.

    Returns:
        Whether a temperature differs.
    """
    others = False
    for force in [force for force in context.getSystem().getForces() if kind_of(force).sets]:
        setting = context.getParameter(force.Temperature())
        if not math.isclose(setting, temperature, rel_tol=1e-6):
            others = True
            warn(
                f"The {type(force).__name__} has {setting:g} K, but the heat bath of the integrator has "
                f"{temperature:g} K: averages belong to neither temperature. Set both to the same temperature; for the "
                f"{type(force).__name__} call context.setParameter({type(force).__name__}.Temperature(), "
                f"{temperature:g})"
            )
    return others


def warn_about_misfit(bodies: BodySet, misfit: np.ndarray) -> bool:
    """Warn if fitting bodies moves atoms by more than the rounding of a PDB file.

    Args:
        bodies: the bodies.
        misfit: largest distance between an atom of each body and its site, (n,), nm.

    Returns:
        Whether a warning was issued.
    """
    off = int(np.count_nonzero(misfit > RESOLUTION))
    if not off:
        return False
    worst = int(misfit.argmax())
    warn(
        f"{off} of {bodies.n} bodies do not quite have the shape of their constraints, or their given geometry, and "
        f"are corrected: an atom moves by up to {misfit[worst]:.4f} nm, in {bodies.describe(worst)}. Were the "
        "positions made with another force field?"
    )
    return True
