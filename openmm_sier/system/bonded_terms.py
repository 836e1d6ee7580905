"""Bonded Forces of a System, and the atoms that their terms act on."""

from xml.etree import ElementTree

import numpy as np
import openmm

#: Forces whose terms name two to eight atoms, each with the element and the attributes that do so in its XML.
_FOUR = ("p1", "p2", "p3", "p4")
TERMS = {
    openmm.HarmonicBondForce: ("Bond", _FOUR[:2]),
    openmm.HarmonicAngleForce: ("Angle", _FOUR[:3]),
    openmm.PeriodicTorsionForce: ("Torsion", _FOUR),
    openmm.RBTorsionForce: ("Torsion", _FOUR),
    openmm.CMAPTorsionForce: ("Torsion", ("a1", "a2", "a3", "a4", "b1", "b2", "b3", "b4")),
    openmm.CustomBondForce: ("Bond", _FOUR[:2]),
    openmm.CustomAngleForce: ("Angle", _FOUR[:3]),
    openmm.CustomTorsionForce: ("Torsion", _FOUR),
}

#: Those whose terms have a strength, so that a term can be moved to another Force. Others are expressions or maps.
DIVISIBLE = (openmm.HarmonicBondForce, openmm.HarmonicAngleForce, openmm.PeriodicTorsionForce, openmm.RBTorsionForce)

#: These change the box and positions together, and neither read nor change velocities.
BAROSTATS = (
    openmm.MonteCarloBarostat,
    openmm.MonteCarloAnisotropicBarostat,
    openmm.MonteCarloMembraneBarostat,
    openmm.MonteCarloFlexibleBarostat,
)

#: Forces of OpenMM that set a temperature or a pressure.
OF_ENSEMBLES = (openmm.AndersenThermostat, *BAROSTATS)

#: These exert no forces, whatever their group.
WITHOUT_FORCES = (openmm.CMMotionRemover, *OF_ENSEMBLES)


def bonded_kind(force: openmm.Force) -> type | None:
    """Return the class among `TERMS` that a Force is of; None if it is not a bonded one."""
    return next((kind for kind in TERMS if isinstance(force, kind)), None)


def bonded_terms(force: openmm.Force) -> np.ndarray:
    """Return particles of each term of a Force that has a `bonded_kind`, (t, k)."""
    _, attributes = TERMS[bonded_kind(force)]
    found = [[int(term.attrib[name]) for name in attributes] for term in _elements(force)]
    return np.array(found, dtype=np.int64).reshape(-1, len(attributes))


def working_terms(force: openmm.Force, owner: np.ndarray) -> np.ndarray:
    """Return the terms of a Force that do not lie in one body, (t, k); none if it is not a bonded one.

    Args:
        force: openmm.Force.
        owner: for each particle the number of its body, (N,), -1 where it has none.
    """
    if bonded_kind(force) is None:
        return np.empty((0, 0), dtype=np.int64)
    terms = bonded_terms(force)
    return terms[do_work(terms, owner)]


def with_working_terms(force: openmm.Force, owner: np.ndarray) -> openmm.Force:
    """Return a copy of a bonded Force with its `working_terms` alone."""
    root = ElementTree.fromstring(openmm.XmlSerializer.serialize(force))
    works = iter(do_work(bonded_terms(force), owner).tolist())
    for parent in _parents(force, root):
        parent[:] = [term for term in parent if next(works)]
    return openmm.XmlSerializer.deserialize(ElementTree.tostring(root, encoding="unicode"))


def do_work(terms: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Tell which terms, (t, k), do not lie in one body, (t,); `owner` is that of `working_terms`."""
    found = owner[terms]
    return (found != found[:, :1]).any(axis=1) | (found[:, 0] < 0)


def harmonic_bonds(force: openmm.HarmonicBondForce) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return particles of each bond, (b, 2), lengths, (b,), nm, and force constants, (b,), kJ/mol/nm^2."""
    parameters = [(float(term.attrib["d"]), float(term.attrib["k"])) for term in _elements(force)]
    lengths, strengths = np.array(parameters, dtype=float).reshape(-1, 2).T
    return bonded_terms(force), lengths, strengths


def harmonic_angles(force: openmm.HarmonicAngleForce) -> tuple[np.ndarray, np.ndarray]:
    """Return particles of each angle, (a, 3), and force constants, (a,), kJ/mol/rad^2."""
    return bonded_terms(force), np.array([float(term.attrib["k"]) for term in _elements(force)], dtype=float)


def _elements(force: openmm.Force) -> list[ElementTree.Element]:
    root = ElementTree.fromstring(openmm.XmlSerializer.serialize(force))
    return [term for parent in _parents(force, root) for term in parent]


def _parents(force: openmm.Force, root: ElementTree.Element) -> list[ElementTree.Element]:
    """Return the elements of a Force's XML that contain its terms."""
    tag, _ = TERMS[bonded_kind(force)]
    return list(root.iter(f"{tag}s"))
