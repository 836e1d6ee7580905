"""Bodies by residues, chains, selections and lists of atoms."""

import sys

import openmm
import pytest
from openmm import app

from openmm_sier import RigidBodies, SIERIntegrator, prepare_system, select_bodies


def chains(names="AB", residues=10, first=1):
    """Chains of beads with one larger residue at the end of each."""
    topology = app.Topology()
    for name in names:
        chain = topology.addChain(name)
        for number in range(first, first + residues):
            residue = topology.addResidue("GLY", chain, str(number))
            topology.addAtom("CA", None, residue)
        cap = topology.addResidue("CO2", chain, str(first + residues))
        for atom in ("C", "O1", "O2"):
            topology.addAtom(atom, None, cap)
    return topology


#: Each chain has ten beads and a residue of three atoms.
SIZE = 13


@pytest.mark.parametrize(
    ("description", "expected"),
    [
        ("A:1-3", [[0, 1, 2]]),
        ("A:1-3,5", [[0, 1, 2, 4]]),
        (":1-2", [[0, 1], [SIZE, SIZE + 1]]),
        ("B:", [range(SIZE, 2 * SIZE)]),
        ("CO2", [[10, 11, 12], [23, 24, 25]]),
        ("resSeq 2 to 3", [[1, 2], [SIZE + 1, SIZE + 2]]),
        ("name O1 or name O2", [[11, 12], [24, 25]]),
        ("name =~ 'O[12]'", [[11, 12], [24, 25]]),
        ([4, 5, 6], [[4, 5, 6]]),
        ([[4, 5, 6], [8, 7]], [[4, 5, 6], [7, 8]]),
        (["A:1-3", [4, 5]], [[0, 1, 2], [4, 5]]),
    ],
)
def test_descriptions(description, expected):
    assert list(select_bodies(chains(), description)) == [tuple(body) for body in expected]


def test_names():
    bodies = select_bodies(chains(), {"head": "A:1-3", "both": ":5-6"})
    assert bodies.names == ("head", "both 1", "both 2")
    assert str(bodies).splitlines()[0] == "head (atoms 0-2)"
    assert str(select_bodies(chains(), "resSeq 2 to 3")) == "resSeq 2 to 3 1 (atoms 1-2)\nresSeq 2 to 3 2 (atoms 14-15)"
    assert str(select_bodies(chains(), [11, 12])) == "atoms 11-12"


def test_chains_of_one_name_and_without_a_name():
    """PDB files have one letter for the name of a chain, and models of many chains use it again."""
    assert len(select_bodies(chains("AA"), "A:1-3")) == 2
    assert list(select_bodies(chains(" "), ":1-3")) == [(0, 1, 2)]


def test_numbers_below_zero_and_insertion_codes():
    topology = chains("A", first=-3)
    assert list(select_bodies(topology, "A:-3--1")) == [(0, 1, 2)]
    residues = list(topology.residues())
    residues[1].id, residues[1].insertionCode = "-3", "A"
    assert list(select_bodies(topology, "A:-3A--1")) == [(1, 2)]


@pytest.mark.parametrize(
    ("description", "named"),
    [
        ("A:1-30", "no chain A has residues 1-30, each once; there are A:1-11, B:1-11"),
        ("A:3-1", "no chain A has residues 3-1"),
        ("C:1-2", "no chain C has residues 1-2"),
        (":40-50", "no chain  has residues 40-50"),
        ("A:1 B:1", "'A:1 B:1' describes no body"),
        ("1-36", "'1-36' describes no body"),
        ("", "'' describes no body"),
        ("name ZZ", "selects no atom"),
    ],
)
def test_wrong_descriptions_are_named(description, named):
    with pytest.raises(ValueError, match=named):
        select_bodies(chains(), description)


@pytest.mark.parametrize("description", [5, None, {"head": 4.0}])
def test_other_types_are_refused(description):
    with pytest.raises(TypeError):
        select_bodies(chains(), description)
    with pytest.raises(TypeError, match=r"openmm\.app\.Topology"):
        select_bodies(openmm.System(), "A:1")


def test_without_mdtraj(monkeypatch):
    monkeypatch.setitem(sys.modules, "mdtraj", None)
    assert len(select_bodies(chains(), "A:1-3")) == 1
    with pytest.raises(ValueError, match="pip install mdtraj"):
        select_bodies(chains(), "name O1")


def test_they_are_taken_as_bodies():
    topology = chains("A")
    system = openmm.System()
    positions = [[0.38 * i, 0.1 * (i % 2), 0.2 * (i % 3 == 0)] for i in range(topology.getNumAtoms())]
    for _ in positions:
        system.addParticle(100.0)
    domains = select_bodies(topology, {"head": "A:1-4"})
    bodies = RigidBodies.from_system(system, topology, domains, positions)
    assert bodies.atoms_of(int(bodies.owners[0])).tolist() == [0, 1, 2, 3]
    prepare_system(system, domains)
    context = openmm.Context(system, SIERIntegrator(0.01, bodies=bodies))
    context.setPositions(positions)
    context.getIntegrator().step(1)


def test_messages_name_large_bodies_by_ranges():
    topology = chains("A")
    labels = [f"{atom.residue.name} {atom.residue.id}" for atom in topology.atoms()]
    bodies = RigidBodies([], len(labels), labels)
    assert bodies.describe_atoms(range(10)) == "residues GLY 1 to GLY 10 (atoms 0-9)"
    assert bodies.describe_atoms([10, 11, 12]) == "residue CO2 11 (atoms 10, 11, 12)"
    assert RigidBodies([], 20).describe_atoms([*range(9), 12]) == "the body of atoms 0-8,12"
