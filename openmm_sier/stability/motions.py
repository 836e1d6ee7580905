"""The fastest motions of a System: unconstrained vibrations, librations of molecules among others, spins of bodies.

The frequencies of librations are estimated without positions. An atom with an inverse effective mass u, its body's
rotation included, in surroundings of the stiffness k swings with the angular frequency sqrt(k u). For the hydrogens of
rigid water u is 1/m, since out of the plane of the molecule they move like free atoms. Heavier hydrogens, and those of
larger bodies, are slower.
"""

import math
from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from typing import Literal, NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.index_ranges import distinct
from openmm_sier.dynamics.species import Species
from openmm_sier.stability import advice
from openmm_sier.stability.advice import Remedies
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import COARSE, constrained_bends, harmonic_frequencies, mobilities
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import SystemForce, all_forces
from openmm_sier.system.links import links_of
from openmm_sier.system.measurement import HiddenError, fastest_motion

#: Stiffness of a charged atom's surroundings, kJ/mol/nm^2. Librations of water have 400 to 900 cm^-1, with a tail. This
#: value, 1060 cm^-1 for its hydrogens, gives SIER2 a stability limit of 10.0 fs, SIER2V2 12.8, SIER2P3 23.4, SIER4G
#: 17.4, SIER4 15.1, SIER4V and SIER4P 15.8. In 64 molecules of liquid the energy grew within 1.2 ps by this share of
#: the kinetic energy:
#:     TIP3P     SIER2   9 fs 0.03, 10 fs 0.14, 11 fs 0.8     SIER4G  13 fs 0.04, 16 fs 0.11, 18 fs 0.6, 20 fs 1.7
#:     SPC/E     SIER2   8 fs 0.03, 10 fs 0.28, 11 fs 3.6     SIER4G  14 fs 0.06, 16 fs 0.37, 18 fs 1.0, 20 fs 2.9
#:     TIP4P-Ew  SIER2   8 fs 0.06, 10 fs 0.97, 11 fs 1e20    SIER4G  13 fs 0.02, 16 fs 0.54, 18 fs 1.1, 20 fs 3.3
#:     TIP3P     SIER4  13 fs 0.06, 16 fs 0.31, 18 fs 3.0     SIER4P  18 fs 0.04, 20 fs 0.07     SIER4V  20 fs 0.05
#:     TIP3P     SIER2V2  10 fs 0, 12 fs 0.04, 14 fs 0.35       SIER2P3  20 fs 0, 23 fs 0.10, 26 fs 0.77
#: At the accuracy limits of the schemes of fourth order, 11 to 15 fs, rms(H) is 0.02 to 0.06 rms(V), and at SIER2's,
#: 3.0 fs, it is 0.02.
HYDROGEN_BOND = 4.0e4

#: Charge in e, of either sign, of an atom with hydrogen bonds. Hydrogens of water have 0.19 in HIPPO, 0.24 in TIP5P and
#: 0.26 to 0.30 in AMOEBA, those of amides 0.27, and those on carbon up to 0.15.
CHARGED = 0.18

#: Stiffness of a Lennard-Jones atom's surroundings in units of epsilon/sigma^2: the second derivative at the minimum,
#: 72/2^(1/3), for twelve neighbours, a third of which counts in each direction. For liquid argon it gives 6.7/ps; its
#: Einstein frequency is 7.5/ps.
LENNARD_JONES = 4 * 72 / 2 ** (1 / 3)


class Motion(NamedTuple):
    """A vibration or libration as a harmonic oscillator.

    Attributes:
        period: ps.
        atoms: particle indices of the ends of a bond, the atoms of an angle or another vibration, or the one atom that
            swings.
        group: the force group that moves them.
        share: stiffness of the surroundings over that of the vibration.
        force: name of the Force, where the motion was measured.
        kind: what vibrates: a bond, an angle between constrained bonds, or other atoms.
        can_be_fast: whether inner steps could follow it, once the System is prepared.
    """

    period: float
    atoms: tuple[int, ...]
    group: int
    share: float = 0.0
    force: str = ""
    kind: Literal["bond", "angle", "other"] = "bond"
    can_be_fast: bool = False


class Spin(NamedTuple):
    """The rotation of a rigid body about its smallest moment of inertia.

    Attributes:
        moment: dalton nm^2.
        name: of the body, in words.
        groups: bit mask of the force groups that may turn it.
    """

    moment: float
    name: str
    groups: int

    def rate(self, temperature: float) -> float:
        """Return its thermal angular velocity sqrt(kT/I), 1/ps, at a temperature in K."""
        return math.sqrt(GAS_CONSTANT * temperature / self.moment)


class Motions:
    """The fastest motions of a System.

    Motions within bodies and along constraints do not count. The periods of HarmonicBondForces are read from the
    System, and again after `updateParametersInContext`. Each of these bonds is treated separately, which gives its
    period to 1 % for hydrogens; bonds between heavy atoms that share an atom (CO2) vibrate up to a quarter faster. Of
    the angles of HarmonicAngleForces only those between constrained bonds count: others are slower than their bonds by
    a factor of two. Of forces between molecules only those with charges count, and the Lennard-Jones terms of
    NonbondedForces. Forces of expressions or collective variables are measured by `measure`, at positions.

    Attributes:
        bodies: all that move in the System.
        measured: the fastest motion by each Force that was measured.
        librations: the fastest swing by each Force with charges.
        spin: of the slimmest rigid body; None if no body turns.
        unknown: force group and name of each Force of unknown stiffness, including those that overlaps hide.
        remedies: for these motions.
    """

    def __init__(self, system: openmm.System, bodies: BodySet, rigid: Sequence[Species]):
        """
        Args:
            system: openmm.System.
            bodies: all that move in it.
            rigid: the kinds of rigid body.
        """
        self.bodies = bodies
        self._mobility = mobilities(bodies)
        links = links_of(system)
        self.remedies = Remedies(system, bodies, links)
        forces = [entry for entry in all_forces(system) if not entry.is_variable]
        with_charges = [entry for entry in forces if kind_of(entry.force).charges]
        stiffnesses = [_stiffness_around(entry.force) for entry in with_charges]
        #: Stiffness of the surroundings of each atom, (N,), kJ/mol/nm^2.
        self._held = np.max([np.zeros(bodies.n_particles), *stiffnesses], axis=0)
        self._linked = links.link(bodies)
        # Molecules swing among others, or among frozen atoms.
        is_alone = len(distinct(self._linked.molecules)) < 2 and not tables.frozen_without(system, bodies.owners).size
        self.librations = [] if is_alone else list(self._swings(with_charges, stiffnesses))
        owners = _owners(system, self._linked, rigid)
        self._find_vibrations = partial(harmonic_vibrations, forces, self._mobility, owners, links.constraints)
        self.measured: list[Motion] = []
        self.unknown = _described([entry for entry in forces if _is_unknown(entry)])
        self.spin = _slimmest(system, bodies, rigid, is_alone)
        self._to_measure = [entry for entry in forces if _is_measured(entry)]

    @cached_property
    def harmonic(self) -> list[Motion]:
        """The fastest bond of each HarmonicBondForce, and such an angle of each HarmonicAngleForce."""
        return [self._motion(*vibration) for vibration in self._find_vibrations()]

    def forget_vibrations(self) -> None:
        """Read `harmonic` from the System again when it is asked for: parameters were changed."""
        vars(self).pop("harmonic", None)

    @property
    def vibrations(self) -> list[Motion]:
        """Motions caused by bonded Forces, fields and collective variables."""
        return self.harmonic + self.measured

    def measure(self, context: openmm.Context) -> bool:
        """Measure, once, the motions that are not read from parameters; return whether anything was measured.

        Args:
            context: of the System, with positions.
        """
        if not self._to_measure:
            return False
        measured, hidden = [], []
        for entry in self._to_measure:
            try:
                vibration = fastest_motion(entry.force, context, self._linked)
            except HiddenError:
                hidden.append(entry)
                continue
            if vibration is not None:
                is_bond = kind_of(entry.force).acts_on == "terms" and len(vibration.atoms) == 2
                kind: Literal["bond", "other"] = "bond" if is_bond else "other"
                motion = self._motion(entry, vibration.atoms, vibration.square, kind=kind)
                measured.append(motion._replace(force=entry.name))
        self.unknown += _described(hidden)
        self.measured = measured
        self._to_measure = []
        return True

    def moves_like_hydrogen(self, motion: Motion) -> bool:
        """Return whether one of the atoms moves like a hydrogen, which may have been made heavy."""
        return bool(self._mobility[list(motion.atoms)].max() * tables.HEAVIEST_HYDROGEN >= 1)

    def fastest_hydrogen(self, kind: str, groups: int) -> Motion | None:
        """Return the fastest bond to hydrogen, or angle of hydrogens, in force groups, a bit mask."""
        motions = [motion for motion in self.vibrations if motion.kind == kind and self.moves_like_hydrogen(motion)]
        return fastest(motions, groups)

    def body_of(self, libration: Motion) -> int:
        """Return the index of the body that swings."""
        return int(self.bodies.owners[libration.atoms[0]])

    def ways_to_hold(self, vibration: Motion) -> list[str]:
        """Return remedies that make a vibration slower."""
        if vibration.kind == "other":
            return [advice.soften(vibration.force)]
        return self.remedies.hold(vibration.atoms)

    def describe(self, vibration: Motion) -> str:
        """Return a vibration in words."""
        labels, atoms = self.bodies.labels, vibration.atoms
        residues = "" if labels is None else f" ({' and '.join(dict.fromkeys(labels[i] for i in atoms))})"
        if vibration.kind == "angle":
            return f"the angle of atoms {', '.join(map(str, atoms))}{residues}"
        if vibration.kind == "bond":
            by = f" by {vibration.force}" if vibration.force else ""
            return f"the bond between atoms {atoms[0]} and {atoms[1]}{residues}{by}"
        plural = "s" if len(atoms) > 1 else ""
        return f"the motion of atom{plural} {', '.join(map(str, atoms))}{residues} by {vibration.force}"

    def _motion(
        self,
        entry: SystemForce,
        atoms: tuple[int, ...],
        square: float,
        gradients: np.ndarray | None = None,
        kind: Literal["bond", "angle", "other"] = "bond",
    ) -> Motion:
        """Return a motion; see `Vibration`."""
        period = 2 * math.pi / math.sqrt(square)
        mobility = self._mobility[list(atoms)]
        gradients = np.ones(len(atoms)) if gradients is None else gradients
        # Stiffness of the surroundings of the atoms, over that of the vibration. Sites have no mobility of their own.
        moved = float(gradients @ mobility)
        share = float(self._held[list(atoms)] @ (gradients * mobility**2)) / (square * moved) if moved else 0.0
        can_be_fast = period < COARSE and not entry.containers and self.remedies.can_be_fast(entry.force, atoms)
        return Motion(period, atoms, entry.group, share, kind=kind, can_be_fast=can_be_fast)

    def _swings(self, with_charges: Sequence[SystemForce], stiffnesses: Sequence[np.ndarray]) -> Iterator[Motion]:
        """Yield the fastest libration by each Force with charges, from the stiffness of each atom's surroundings."""
        for entry, stiffness in zip(with_charges, stiffnesses, strict=True):
            squares = stiffness * self._mobility
            if squares.max(initial=0) > 0:
                atom = int(squares.argmax())
                yield Motion(2 * math.pi / math.sqrt(squares[atom]), (atom,), entry.group)


class Vibration(NamedTuple):
    """A vibration that the parameters of a Force give.

    Attributes:
        entry: the Force.
        atoms: particle indices, k of them.
        square: of the angular frequency, 1/ps^2.
        gradients: squared derivatives of what vibrates by the position of each atom, (k,); None: all alike, as of a
            bond.
        kind: see `Motion`.
    """

    entry: SystemForce
    atoms: tuple[int, ...]
    square: float
    gradients: np.ndarray | None
    kind: Literal["bond", "angle"]


def harmonic_vibrations(
    forces: Sequence[SystemForce], mobility: np.ndarray, owners: np.ndarray, constraints: tables.Constraints
) -> Iterator[Vibration]:
    """Yield the fastest bond of each HarmonicBondForce, and the fastest angle of each HarmonicAngleForce.

    Bonds are unconstrained, and angles are between constrained bonds. Both join different bodies.

    Args:
        forces: of the System.
        mobility: inverse effective mass of each particle, (N,), 1/dalton.
        owners: number of the body of each particle, (N,).
        constraints: of the System.
    """
    for entry in forces:
        force = entry.force
        if isinstance(force, openmm.HarmonicBondForce):
            atoms, squares = harmonic_frequencies(force, mobility, owners, constraints)
            if squares.max(initial=0) > 0:
                k = int(squares.argmax())
                yield Vibration(entry, tuple(atoms[k].tolist()), float(squares[k]), None, "bond")
        elif isinstance(force, openmm.HarmonicAngleForce) and len(constraints.pairs):
            bends = constrained_bends(force, mobility, owners, constraints)
            if bends.squares.max(initial=0) > 0:
                k = int(bends.squares.argmax())
                bent = tuple(bends.atoms[k].tolist())
                yield Vibration(entry, bent, float(bends.squares[k]), bends.gradients[k], "angle")


def shortest_period(system: openmm.System, bodies: BodySet, rigid: Sequence[Species], groups: int) -> float | None:
    """Return the period of the fastest of `harmonic_vibrations` in force groups, ps; None without any.

    Args:
        system: openmm.System.
        bodies: all that move in it.
        rigid: the kinds of rigid body.
        groups: bit mask of force groups.
    """
    forces = [entry for entry in all_forces(system) if not entry.is_variable and groups >> entry.group & 1]
    owners = _owners(system, bodies, rigid)
    found = harmonic_vibrations(forces, mobilities(bodies), owners, tables.constraints(system))
    square = max((vibration.square for vibration in found), default=0.0)
    return 2 * math.pi / math.sqrt(square) if square else None


def _owners(system: openmm.System, bodies: BodySet, rigid: Sequence[Species]) -> np.ndarray:
    """Return the body of each particle, (N,), where atoms of a rigid body and its virtual sites have one; -1 without.

    Args:
        system: openmm.System.
        bodies: all that move in it.
        rigid: the kinds of rigid body, which may be single atoms in `bodies`.
    """
    owners, number = bodies.owners.copy(), bodies.n
    for species in rigid:
        count, size = species.atoms.shape
        if size > 1:
            owners[species.atoms] = np.arange(number, number + count)[:, None]
            number += count
    return tables.with_sites(system, owners)


def fastest(motions: Sequence[Motion], groups: int) -> Motion | None:
    """Return the motion of shortest period in force groups, a bit mask; None if there is none."""
    return min((motion for motion in motions if groups >> motion.group & 1), default=None)


def _described(forces: Sequence[SystemForce]) -> list[tuple[int, str]]:
    """Return force group and name of each Force."""
    return [(entry.group, f"{entry.name} ({type(entry.force).__name__})") for entry in forces]


def _is_measured(entry: SystemForce) -> bool:
    """Return whether the fastest motion by a Force is measured: it acts on few atoms, or is cheap for all of them."""
    # The close pairs of `prepare_system` are nonbonded interactions.
    return _is_cheap(entry.force) and not entry.force.getName().startswith("openmm_sier: ")


def _is_cheap(force: openmm.Force) -> bool:
    if isinstance(force, openmm.CustomCVForce):
        variables = [force.getCollectiveVariable(i) for i in range(force.getNumCollectiveVariables())]
        return all(kind_of(variable).terms or _is_cheap(variable) for variable in variables)
    return kind_of(force).stiffness == "measured"


def _is_unknown(entry: SystemForce) -> bool:
    """Return whether no stiffness of a Force is known, as of a collective variable of all pairs.

    An ATMForce is a sum of Forces, which are judged one by one.
    """
    is_known = kind_of(entry.force).stiffness != "unknown" or isinstance(entry.force, openmm.ATMForce)
    return not (is_known or _is_cheap(entry.force))


def _stiffness_around(force: openmm.Force) -> np.ndarray:
    """Return the estimated stiffness of each atom's surroundings by a Force with charges, (N,), kJ/mol/nm^2."""
    if not isinstance(force, openmm.NonbondedForce):
        return np.where(np.abs(_charges(force)) >= CHARGED, HYDROGEN_BOND, 0.0)
    charges, sigma, epsilon = tables.atom_parameters(force).T
    bonding = np.where(np.abs(charges) >= CHARGED, HYDROGEN_BOND, 0.0)
    dispersion = np.divide(LENNARD_JONES * epsilon, sigma**2, out=np.zeros_like(sigma), where=sigma > 0)
    return np.maximum(bonding, dispersion)


def _charges(force: openmm.Force) -> np.ndarray:
    """Return the charges of the particles of a Force without Lennard-Jones terms, (N,), e."""
    if isinstance(force, openmm.AmoebaMultipoleForce):
        charges = [force.getMultipoleParameters(i)[0] for i in range(force.getNumMultipoles())]
    elif isinstance(force, openmm.HippoNonbondedForce):
        charges = [force.getParticleParameters(i)[0] for i in range(force.getNumParticles())]
    else:
        charges = [force.getParticleParameters(i) for i in range(force.getNumParticles())]
    in_e = [charge.value_in_unit(unit.elementary_charge) if unit.is_quantity(charge) else charge for charge in charges]
    return np.array(in_e, dtype=float)


def _slimmest(system: openmm.System, bodies: BodySet, rigid: Sequence[Species], is_alone: bool) -> Spin | None:
    """Return the spin about the smallest moment of inertia; only fields turn a single molecule."""
    moments = [float(species.moments[species.turns].min(initial=math.inf)) for species in rigid]
    smallest = min(moments, default=math.inf)
    if smallest == math.inf:
        return None
    groups = 0
    for force in system.getForces():
        kind = kind_of(force)
        if kind.exerts_forces and (not is_alone or kind.acts_on == "particles"):
            groups |= 1 << force.getForceGroup()
    return Spin(smallest, bodies.describe_atoms(rigid[moments.index(smallest)].atoms[0]), groups)
