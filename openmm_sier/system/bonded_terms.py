"""Terms of bonded Forces: atoms, lengths, force constants and frequencies."""

from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.system import tables
from openmm_sier.system.forces import Terms, kind_of
from openmm_sier.system.tables import Constraints

#: Period in ps above which bonds and angles belong to coarse-grained beads and need no inner steps. Periods between
#: atoms are 0.01 to 0.1 ps, with one bead per residue 0.3 to 0.5 ps. For two chains of 40 beads SIER4G's energy at
#: 30 fs was off by 0.005 kJ/mol whether bonds acted in the kicks or in inner steps, which took longer.
COARSE = 0.2

#: nm. Length of the arms of an angle. Those of atoms are shorter, by which their angles are faster still.
ARM = 0.2


@tables.once
def bonded_terms(force: openmm.Force) -> np.ndarray:
    """Return particles of each term of a bonded Force, (t, k)."""
    if isinstance(force, openmm.HarmonicBondForce | openmm.HarmonicAngleForce):
        return _harmonic_terms(force)[0]
    written = _written(force)
    first, size = written.first, len(written.atoms)
    terms = tables.rows(force, f"get{written.element}Parameters", _count(force))
    return np.fromiter((term[first : first + size] for term in terms), np.dtype((np.int64, size)), _count(force))


def working_terms(force: openmm.Force, owner: np.ndarray) -> np.ndarray:
    """Return the terms of a Force that do not lie within one body, (t, k); none if the Force is not bonded.

    Args:
        force: openmm.Force.
        owner: body index of each particle, (N,); -1 without a body.
    """
    if kind_of(force).terms is None:
        return np.empty((0, 0), dtype=np.int64)
    terms = bonded_terms(force)
    return terms[do_work(terms, owner)]


def with_working_terms(force: openmm.Force, owner: np.ndarray) -> openmm.Force:
    """Return a copy of a bonded Force with only its `working_terms`."""
    works = do_work(bonded_terms(force), owner)
    if works.all():
        return openmm.XmlSerializer.clone(force)
    root, remaining = ElementTree.fromstring(openmm.XmlSerializer.serialize(force)), iter(works.tolist())
    for parent in root.iter(f"{_written(force).element}s"):
        parent[:] = [term for term in parent if next(remaining)]
    return openmm.XmlSerializer.deserialize(ElementTree.tostring(root, encoding="unicode"))


def do_work(terms: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Return which terms (t, k) do not lie within one body, (t,); for `owner` see `working_terms`."""
    owners = owner[terms]
    return (owners != owners[:, :1]).any(axis=1) | (owners[:, 0] < 0)


def harmonic_bonds(force: openmm.HarmonicBondForce) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return particles of each bond, (b, 2), lengths, (b,), nm, and force constants, (b,), kJ/mol/nm^2."""
    atoms, parameters = _harmonic_terms(force)
    return atoms, parameters[:, 0], parameters[:, 1]


def harmonic_angles(force: openmm.HarmonicAngleForce) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return particles of each angle, (a, 3), angles, (a,), radians, and force constants, (a,), kJ/mol/rad^2."""
    atoms, parameters = _harmonic_terms(force)
    return atoms, parameters[:, 0], parameters[:, 1]


@tables.once
def _harmonic_terms(force: openmm.Force) -> tuple[np.ndarray, np.ndarray]:
    """Return particles of each harmonic bond or angle, (t, k), and its equilibrium and force constant, (t, 2)."""
    written = _written(force)
    size = len(written.atoms)
    table = tables.numeric_rows(force, f"get{written.element}Parameters", _count(force), size + 2)
    return table[:, :size].astype(np.int64), table[:, size:]


def _count(force: openmm.Force) -> int:
    """Return the number of terms of a bonded Force."""
    return int(getattr(force, f"getNum{_written(force).element}s")())


def mobilities(bodies: BodySet) -> np.ndarray:
    """Return the largest inverse effective mass of each particle over all directions, 1/dalton; 0 without a body.

    A force f at the site r of a body accelerates that site by f / M + I^-1 (r x f) x r.
    """
    mobility = np.zeros(bodies.n_particles)
    turning = [species for species in bodies.species if species.sites.any()]
    for species in bodies.species:
        mobility[species.atoms] = any(species.motion.translations) / species.mass
    if not turning:
        return mobility
    # All kinds at once: there may be thousands.
    sizes = [species.masses.size for species in turning]
    moments = np.array([species.moments for species in turning])
    turns = np.array([species.turns for species in turning])
    inverse = np.repeat(np.divide(1.0, moments, out=np.zeros(moments.shape), where=turns), sizes, axis=0)
    cross = np.cross(np.eye(3), np.concatenate([species.sites.T for species in turning])[:, None])
    rotational = np.linalg.eigvalsh(np.einsum("kax,ka,kay->kxy", cross, inverse, cross))[:, -1]
    for species, values in zip(turning, np.split(rotational, np.cumsum(sizes)[:-1]), strict=True):
        mobility[species.atoms] += values
    return mobility


def harmonic_frequencies(
    force: openmm.Force, mobility: np.ndarray, owner: np.ndarray, constraints: Constraints
) -> tuple[np.ndarray, np.ndarray]:
    """Return particles of harmonic bonds or angles, (t, k), and squares of their angular frequencies, (t,), 1/ps^2.

    A square is 0 where a body or a constraint holds the term. Forces of other classes have none.

    Args:
        force: openmm.Force.
        mobility: inverse effective masses of the particles, (N,), 1/dalton.
        owner: that of `working_terms`.
        constraints: of the System.
    """
    if isinstance(force, openmm.HarmonicBondForce):
        atoms, _, strengths = harmonic_bonds(force)
        squares = ~constraints.hold([atoms])[0] * strengths * mobility[atoms].sum(axis=1)
    elif isinstance(force, openmm.HarmonicAngleForce):
        atoms, _, strengths = harmonic_angles(force)
        # The middle atom moves against both others, by twice their way.
        squares = strengths * (mobility[atoms] @ [1, 4, 1]) / ARM**2
    else:
        return np.empty((0, 1), dtype=np.int64), np.empty(0)
    return atoms, np.where(do_work(atoms, owner), squares, 0.0)


class Bends(NamedTuple):
    """Vibrations of angles between constrained bonds.

    Attributes:
        atoms: particles of each, (b, 3).
        squares: of their angular frequencies, (b,), 1/ps^2.
        gradients: squared derivatives of the angle by the position of each atom, (b, 3), 1/nm^2.
    """

    atoms: np.ndarray
    squares: np.ndarray
    gradients: np.ndarray


def constrained_bends(
    force: openmm.HarmonicAngleForce, mobility: np.ndarray, owner: np.ndarray, constraints: Constraints
) -> Bends:
    """Return the angles of a Force between two constrained bonds, without those that a body or a constraint holds.

    Of other angles a bond vibrates faster. The frequency is that of three atoms, by the elements of Wilson's G matrix
    for the equilibrium angle and both bonds (Wilson, Decius and Cross, Molecular Vibrations (1955), appendix VI), of
    which the bonds are eliminated, since they keep their lengths.

    Args:
        force: openmm.HarmonicAngleForce.
        mobility: inverse effective masses of the particles, (N,), 1/dalton.
        owner: that of `working_terms`.
        constraints: of the System.
    """
    atoms, angles, strengths = harmonic_angles(force)
    first, second = constraints.lengths_of(atoms[:, :2]), constraints.lengths_of(atoms[:, 1:])
    is_free = np.isnan(constraints.lengths_of(atoms[:, ::2])) & do_work(atoms, owner)
    chosen = is_free & ~np.isnan(first + second)
    atoms, strengths, first, second = atoms[chosen], strengths[chosen], 1 / first[chosen], 1 / second[chosen]
    cosine, sine = np.cos(angles[chosen]), np.sin(angles[chosen])
    gradients = np.stack([first**2, first**2 + second**2 - 2 * cosine * first * second, second**2], axis=1)
    ends, middle = mobility[atoms[:, ::2]].T, mobility[atoms[:, 1]]
    bonds = ends + middle
    to_bonds = middle * sine * second, middle * sine * first
    coupling = middle * cosine
    eliminated = (
        to_bonds[0] ** 2 * bonds[1] + to_bonds[1] ** 2 * bonds[0] - 2 * to_bonds[0] * to_bonds[1] * coupling
    ) / (bonds[0] * bonds[1] - coupling**2)
    inverse_mass = (gradients * mobility[atoms]).sum(axis=1) - eliminated
    return Bends(atoms, strengths * inverse_mass, gradients)


def _written(force: openmm.Force) -> Terms:
    """Return the XML form of the terms of a bonded Force."""
    terms = kind_of(force).terms
    if terms is None:
        raise TypeError(f"{force.getName()} ({type(force).__name__}) is not a bonded Force")
    return terms
