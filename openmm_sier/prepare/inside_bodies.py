"""Interactions within rigid bodies, which do no work and cost time: found, excluded, and their energy told.

Two atoms of a body keep their distance, so that the energy of their interaction is a constant, and its forces on the
body cancel. With a cut-off a force of one dense body of 1500 atoms took 1.6 ms with them and 0.6 ms without, and one
of eight chains, with domains of a dozen beads, 0.45 and 0.40 ms (CPU platform, one thread).

Nothing is excluded beside an Ewald sum. Its reciprocal part has all pairs, and OpenMM takes that of excluded ones away
again pair by pair, for which the CPU platform takes five times as long as for the interactions themselves: with PME 64
bodies of 36 atoms would take 23 ms a force in place of 5, and one of 1500 atoms 71 in place of 12.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.etree import ElementTree

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.dynamics.species import Species
from openmm_sier.prepare.joined_bodies import NAME as OWN
from openmm_sier.system.bonded_terms import bonded_kind, bonded_terms
from openmm_sier.system.boxes import widths

#: Atoms of the smallest bodies that are looked at. Force fields exclude what is in smaller ones, such as water.
FEWEST_ATOMS = 5

#: Share of the narrowest width of the box up to which atoms of a body may be apart. Beyond half of it an atom interacts
#: with an image of the other one, which is another interaction; the box of a run may become narrower.
WITHIN_BOX = 0.45

#: Pairs of one body above which they are left alone: a System with more takes long to make, and much memory.
MOST_PAIRS = 2_000_000

#: Forces between pairs. Exclusions of the first two must be the same on some platforms.
PAIRWISE = (openmm.NonbondedForce, openmm.CustomNonbondedForce, openmm.GayBerneForce)

#: Forces that also have exclusions, and whose energy is no sum of pairs.
MANY_BODY = (
    *(openmm.CustomGBForce, openmm.ConstantPotentialForce, openmm.AmoebaMultipoleForce, openmm.AmoebaVdwForce),
    *(openmm.HippoNonbondedForce, openmm.AmoebaGeneralizedKirkwoodForce),
)

#: Attributes of a particle in the XML of a GayBerneForce: others that tell how its ellipsoid is turned.
_AXES = ("xparticle", "yparticle")

#: Methods of a NonbondedForce without a sum in reciprocal space.
DIRECT = (
    *(openmm.NonbondedForce.NoCutoff, openmm.NonbondedForce.CutoffNonPeriodic),
    openmm.NonbondedForce.CutoffPeriodic,
)


@dataclass
class Excluded:
    """Hold what `exclude_inside_bodies` did.

    Attributes:
        pairs: how many pairs of atoms were excluded.
        bodies: in how many bodies they are.
        energy: of their interactions, with global parameters at their defaults, kJ/mol; not finite where atoms of a
            body are on one point.
        forces: names of the Forces that had them.
        refusal: why nothing is excluded, if anything is there.
    """

    pairs: int = 0
    bodies: int = 0
    energy: float = 0.0
    forces: list[str] = field(default_factory=list)
    refusal: str = ""


def exclude_inside_bodies(system: openmm.System, bodies: RigidBodies) -> Excluded:
    """Exclude interactions between atoms of one body in NonbondedForces, CustomNonbondedForces and GayBerneForces.

    Of Forces with a cut-off these are pairs within the longest one. All these Forces get the same exclusions, which
    some platforms demand. Exceptions that are there lose their interaction. Forces within other Forces are left alone,
    since these may depend on the energy.

    Args:
        system: openmm.System; its Forces are changed.
        bodies: its rigid bodies, whose shape tells which atoms are near.

    Returns:
        How many pairs were excluded, and their energy.
    """
    forces = [force for force in system.getForces() if isinstance(force, PAIRWISE)]
    found = Excluded()
    wanted = dict(_pairs_by_species(system, bodies, forces)) if forces else {}
    if not wanted:
        return found
    if refusal := _refusal(system, bodies, wanted):
        found.refusal = refusal
        return found
    changed = np.zeros((0, 2), dtype=np.int64)
    for force in forces:
        known = _Interactions(force)
        new = {species: known.acting(species, pairs) for species, pairs in wanted.items()}
        if not any(len(rows) for each in new.values() for rows in each):
            continue
        found.energy += sum(known.energy(system, species, rows) for species, rows in new.items())
        pairs = np.concatenate([rows for each in new.values() for rows in each])
        _exclude(force, pairs)
        found.forces.append(force.getName())
        changed = np.concatenate([changed, pairs])
    changed = np.unique(np.sort(changed, axis=1), axis=0)
    found.pairs, found.bodies = len(changed), len(np.unique(bodies.owners[changed]))
    return found


def useless_terms(system: openmm.System, owner: np.ndarray) -> dict[str, tuple[int, int]]:
    """Return how many of the terms of bonded Forces act within one body, and of how many, by the names of the Forces.

    Args:
        system: openmm.System.
        owner: for each particle the number of its rigid body, (N,), -1 where it has none.
    """
    found = {}
    for force in system.getForces():
        if bonded_kind(force) is None or force.getName() == OWN:
            continue
        owners = owner[bonded_terms(force)]
        inside = (owners == owners[:, :1]).all(axis=1) & (owners[:, 0] >= 0) if len(owners) else owners
        if count := int(np.count_nonzero(inside)):
            found[force.getName()] = count, len(owners)
    return found


# --- which pairs ------------------------------------------------------------------------------------------------------


def _pairs_by_species(
    system: openmm.System, bodies: RigidBodies, forces: list[openmm.Force]
) -> Iterator[tuple[Species, np.ndarray]]:
    """Give pairs of atoms that are near in a species, by their numbers in it, (p, 2)."""
    reach = max(_reach(force) for force in forces)
    if any(force.usesPeriodicBoundaryConditions() for force in forces):
        vectors = system.getDefaultPeriodicBoxVectors()
        reach = min(reach, WITHIN_BOX * widths(np.array([v.value_in_unit(unit.nanometer) for v in vectors])).min())
    for species in bodies.species:
        if len(species.masses) < FEWEST_ATOMS:
            continue
        pairs = _near(species.sites.T, reach)
        if 0 < len(pairs) <= MOST_PAIRS:
            yield species, pairs


def _reach(force: openmm.Force) -> float:
    """Return the distance in nm up to which a Force acts."""
    cut_off = force.getNonbondedMethod() != type(force).NoCutoff
    return force.getCutoffDistance().value_in_unit(unit.nanometer) if cut_off else np.inf


def _near(sites: np.ndarray, reach: float) -> np.ndarray:
    """Return pairs of sites (k, 3) within a distance, both in nm."""
    from scipy.spatial import cKDTree

    if not np.isfinite(reach):
        return np.column_stack(np.triu_indices(len(sites), 1))
    return cKDTree(sites).query_pairs(reach, output_type="ndarray").astype(np.int64).reshape(-1, 2)


def _refusal(system: openmm.System, bodies: RigidBodies, wanted: dict[Species, np.ndarray]) -> str:
    """Return why pairs of a System are not excluded; nothing where they are."""
    inside = {int(atom) for species in wanted for atom in species.atoms.ravel()}
    for force in system.getForces():
        name = force.getName()
        if isinstance(force, MANY_BODY):
            return f"exclusions would change {name} too, whose energy is not a sum over pairs"
        if isinstance(force, openmm.NonbondedForce):
            if force.getNonbondedMethod() not in DIRECT:
                return f"with the reciprocal sum of {name} an excluded pair takes longer than one that is not"
            offsets = [force.getParticleParameterOffset(i)[1] for i in range(force.getNumParticleParameterOffsets())]
            for i in range(force.getNumExceptionParameterOffsets()):
                offsets += force.getExceptionParameters(force.getExceptionParameterOffset(i)[1])[:2]
            if inside.intersection(offsets):
                return f"the energy of {name} within bodies depends on a global parameter"
        if isinstance(force, openmm.CustomNonbondedForce) and force.getNumEnergyParameterDerivatives():
            return f"{name} gives derivatives of its energy by a global parameter"
    return ""


# --- interactions of a Force ------------------------------------------------------------------------------------------


class _Interactions:
    """The pairs that a Force lets interact, and the energy of those in one body."""

    def __init__(self, force: openmm.Force):
        self._force = force
        root = ElementTree.fromstring(openmm.XmlSerializer.serialize(force))
        self._particles = _emptied(root, "Particles")
        self._left_out = _emptied(
            root, "Exclusions" if isinstance(force, openmm.CustomNonbondedForce) else "Exceptions"
        )
        self._groups = _emptied(root, "InteractionGroups")
        for name in ("ParticleOffsets", "ExceptionOffsets"):
            _emptied(root, name)
        # Long-range corrections do not know exclusions.
        for name in ("dispersionCorrection", "useLongRangeCorrection"):
            if name in root.attrib:
                root.set(name, "0")
        self._root = root
        self._of_atom: dict[int, list[ElementTree.Element]] = defaultdict(list)
        self._silent: set[tuple[int, int]] = set()
        for entry in self._left_out:
            a, b = int(entry.attrib["p1"]), int(entry.attrib["p2"])
            self._of_atom[a].append(entry)
            if not float(entry.get("q", "0")) and not float(entry.get("eps", "0")):
                self._silent.add((min(a, b), max(a, b)))

    def acting(self, species: Species, pairs: np.ndarray) -> list[np.ndarray]:
        """Return for each body those of some pairs, by their numbers in a species, that are not excluded, as atoms."""
        found = []
        for atoms in species.atoms:
            turning = self._turned_from_outside(atoms)
            rows = np.sort(atoms[pairs], axis=1)
            acts = [tuple(row) not in self._silent and turning.isdisjoint(row) for row in rows.tolist()]
            found.append(rows[acts])
        return found

    def _turned_from_outside(self, atoms: np.ndarray) -> set[int]:
        """Return those of a body's atoms whose ellipsoids in a GayBerneForce have an axis to an atom outside."""
        inside = {-1, *atoms.tolist()}
        axes = ((atom, int(self._particles[atom].get(axis, "-1"))) for atom in atoms.tolist() for axis in _AXES)
        return {atom for atom, end in axes if end not in inside}

    def energy(self, system: openmm.System, species: Species, rows: list[np.ndarray]) -> float:
        """Return the energy of pairs, given for each body of a species, kJ/mol.

        Bodies with the same parameters and pairs are evaluated once.
        """
        known: dict[tuple, float] = {}
        total = 0.0
        for atoms, pairs in zip(species.atoms, rows, strict=True):
            if not len(pairs):
                continue
            alone = self._alone(atoms)
            key = openmm.XmlSerializer.serialize(alone), (np.searchsorted(np.sort(atoms), pairs)).tobytes()
            if key not in known:
                number = {int(atom): i for i, atom in enumerate(atoms)}
                own = np.array([[number[a], number[b]] for a, b in pairs.tolist()])
                known[key] = _difference(system, species, alone, own)
            total += known[key]
        return total

    def _alone(self, atoms: np.ndarray) -> openmm.Force:
        """Return the Force for some atoms alone, which get numbers from 0."""
        number = {int(atom): str(i) for i, atom in enumerate(atoms)}
        root = ElementTree.Element(self._root.tag, self._root.attrib)
        for child in self._root:
            part = ElementTree.SubElement(root, child.tag, child.attrib)
            if child.tag == "Particles":
                part.extend(_renumbered_axes(self._particles[int(atom)], i, number) for i, atom in enumerate(atoms))
            elif child.tag in ("Exceptions", "Exclusions"):
                for entry in (entry for atom in atoms for entry in self._of_atom[int(atom)]):
                    ends = {end: number.get(int(entry.attrib[end]), "") for end in ("p1", "p2")}
                    if all(ends.values()):
                        ElementTree.SubElement(part, entry.tag, entry.attrib | ends)
            elif child.tag == "InteractionGroups":
                part.extend(_renumbered(group, number) for group in self._groups)
            else:
                part.extend(child)
        return openmm.XmlSerializer.deserialize(ElementTree.tostring(root, encoding="unicode"))


def _emptied(root: ElementTree.Element, name: str) -> list[ElementTree.Element]:
    """Return what an element of a Force's XML contains, and take it out."""
    part = root.find(name)
    if part is None:
        return []
    found = list(part)
    part[:] = []
    return found


def _renumbered_axes(particle: ElementTree.Element, own: int, number: dict[int, str]) -> ElementTree.Element:
    """Return a particle of a Force, with the axes of its ellipsoid, if it has one, by new numbers.

    Axes to atoms that have none become others: pairs of such a particle stay, and what they have cancels.
    """
    found = ElementTree.Element(particle.tag, particle.attrib)
    for place, axis in enumerate(_AXES, 1):
        if int(particle.get(axis, "-1")) >= 0:
            found.set(axis, number.get(int(particle.attrib[axis]), str((own + place) % len(number))))
    return found


def _renumbered(group: ElementTree.Element, number: dict[int, str]) -> ElementTree.Element:
    """Return an interaction group with those particles that have a number, by it."""
    found = ElementTree.Element(group.tag, group.attrib)
    for part in group:
        kept = ElementTree.SubElement(found, part.tag, part.attrib)
        for particle in part:
            index = number.get(int(particle.attrib["index"]))
            if index is not None:
                ElementTree.SubElement(kept, particle.tag, {"index": index})
    return found


def _difference(system: openmm.System, species: Species, force: openmm.Force, pairs: np.ndarray) -> float:
    """Return by how much exclusions lower the energy of a body that is alone, kJ/mol."""
    excluding = openmm.XmlSerializer.clone(force)
    _exclude(excluding, pairs)
    alone = openmm.System()
    alone.setDefaultPeriodicBoxVectors(*system.getDefaultPeriodicBoxVectors())
    for mass in species.masses.tolist():
        alone.addParticle(mass)
    for group, each in enumerate((force, excluding)):
        each.setForceGroup(group)
        alone.addForce(each)
    reference = openmm.Platform.getPlatformByName("Reference")
    context = openmm.Context(alone, openmm.VerletIntegrator(0.001), reference)
    context.setPositions(species.sites.T)
    before, after = (context.getState(energy=True, groups={group}).getPotentialEnergy() for group in (0, 1))
    return float((before - after).value_in_unit(unit.kilojoule_per_mole))


def _exclude(force: openmm.Force, pairs: np.ndarray) -> None:
    """Let pairs of atoms (p, 2) interact no more, which are in no exclusion of a Force; exceptions are changed."""
    if isinstance(force, openmm.CustomNonbondedForce):
        for a, b in pairs.tolist():
            force.addExclusion(a, b)
        return
    exceptions: dict[tuple[int, int], int] = {}
    for number in range(force.getNumExceptions()):
        a, b, *_ = force.getExceptionParameters(number)
        exceptions[min(a, b), max(a, b)] = number
    silent = (1.0, 0.0) if isinstance(force, openmm.GayBerneForce) else (0.0, 1.0, 0.0)
    for a, b in pairs.tolist():
        there = exceptions.get((min(a, b), max(a, b)))
        if there is None:
            force.addException(a, b, *silent)
        else:
            force.setExceptionParameters(there, a, b, *silent)
