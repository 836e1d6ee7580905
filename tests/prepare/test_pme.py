"""The split of PME between its two sums."""

import copy
import functools
import itertools
import math
import warnings
from pathlib import Path

import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier import SIERIntegrator, balance_pme, prepare_system
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.forcefields import Interactions
from tests.support.waters import cluster_system, force_of, periodic_system, plain_context

SYSTEMS = Path(__file__).parents[2] / "systems"


@pytest.fixture
def water():
    return periodic_system("tip3p", 64)


@pytest.mark.parametrize(("constant_energy", "finer"), [(True, 1.1), (False, 1.0)], ids=["constant energy", "bath"])
def test_the_mesh_is_that_of_openmm_or_a_tenth_finer(water, constant_energy, finer):
    _, positions, system = water
    a, b, c = (np.array(vector._value) for vector in system.getDefaultPeriodicBoxVectors())
    system.setDefaultPeriodicBoxVectors(a, 1.1 * b, 1.3 * c)
    pme = force_of(system)
    for tolerance in (1e-6, 1e-5, 1e-4):
        pme.setEwaldErrorTolerance(tolerance)
        pme.setPMEParameters(0, 0, 0, 0)
        usual = pme.getPMEParametersInContext(plain_context(system, positions))
        balance_pme(system, constant_energy)
        balanced = pme.getPMEParametersInContext(plain_context(system, positions))
        # Both are rounded up.
        for points, theirs in zip(balanced[1:], usual[1:], strict=True):
            assert finer * (theirs - 1) <= points < finer * theirs + 1
        assert balanced[0] > usual[0]


BOXES = {
    "cube": np.eye(3),
    "orthorhombic": np.diag([1.0, 2.0, 3.0]),
    "dodecahedron": np.array([[1, 0, 0], [0, 1, 0], [0.5, 0.5, math.sqrt(0.5)]]),
    "octahedron": np.array([[3, 0, 0], [1, math.sqrt(8), 0], [-1, math.sqrt(2), math.sqrt(6)]]) / 3,
}


#: Shapes that are left out by default; numbers are seeds of random shapes.
THOROUGH = "orthorhombic", "octahedron", 1, 2


def reduced_box(rng) -> np.ndarray:
    """A random triclinic box in the reduced form that OpenMM requires."""
    a, b, c = rng.uniform(1, 2, 3)
    by_a, by_b = rng.uniform(-0.5, 0.5, (2, 2)), rng.uniform(-0.5, 0.5)
    return np.array([[a, 0, 0], [by_a[0, 0] * a, b, 0], [by_a[1, 0] * a, by_b * b, c]])


def charged_water(box):
    """Water as in the liquid but for a narrow gap at the faces of the box, with no forces but those of charges."""
    liquid = app.PDBFile(str(SYSTEMS / "tip3p-512.pdb"))
    edges = liquid.topology.getPeriodicBoxVectors()
    molecules = np.array(liquid.getPositions(asNumpy=True)._value).reshape(-1, 3, 3)
    shifts = np.array(list(itertools.product(range(-3, 5), repeat=3))) @ np.array([edge._value for edge in edges])
    copies = (molecules + shifts[:, None, None]).reshape(-1, 3, 3)
    fractions = copies[:, 0] @ np.linalg.inv(box)
    positions = copies[((fractions > 0.03) & (fractions < 0.97)).all(axis=1)].reshape(-1, 3)
    system, force = openmm.System(), openmm.NonbondedForce()
    system.setDefaultPeriodicBoxVectors(*box)
    force.setNonbondedMethod(openmm.NonbondedForce.PME)
    force.setCutoffDistance(0.8)
    for first in range(0, len(positions), 3):
        for mass, charge in ((15.999, -0.834), (1.008, 0.417), (1.008, 0.417)):
            system.addParticle(mass)
            force.addParticle(charge, 1, 0)
        for i, j, length in ((0, 1, 0.09572), (0, 2, 0.09572), (1, 2, 0.15139)):
            system.addConstraint(first + i, first + j, length)
            force.addException(first + i, first + j, 0, 1, 0)
    system.addForce(force)
    return system, positions


@pytest.mark.parametrize(
    "shape", ["cube", "dodecahedron", 0, *(pytest.param(s, marks=pytest.mark.thorough) for s in THOROUGH)], ids=str
)
def test_forces_are_more_accurate_than_with_openmms_split(shape):
    """On atoms and on molecules, in boxes of all shapes, for constant energy and for a bath with heavy hydrogens."""
    rng = np.random.default_rng(shape if isinstance(shape, int) else None)
    box = BOXES[shape] if isinstance(shape, str) else reduced_box(rng)
    # OpenMM requires that no diagonal element is below two cut-offs.
    system, positions = charged_water(box * 1.65 / box.diagonal().min())

    def errors(tolerance, prepare=None, exact=0.0):
        copied = copy.deepcopy(system)
        force_of(copied).setEwaldErrorTolerance(tolerance)
        if prepare is not None:
            prepare(copied)
        # Not on Reference, whose neighbour lists miss pairs in small triclinic boxes.
        forces = plain_context(copied, positions, "CPU").getState(forces=True).getForces(asNumpy=True)._value
        return (forces - exact).reshape(-1, 3, 3)

    exact = errors(1e-6).reshape(-1, 3)
    for tolerance in (1e-3, 5e-4, 1e-5):
        usual = errors(tolerance, exact=exact)
        for prepare in (prepare_system, functools.partial(prepare_system, hydrogenMass=4)):
            prepared = errors(tolerance, prepare, exact)
            # 0.2 to 0.6 of OpenMM's in eighteen boxes.
            assert np.linalg.norm(prepared) < np.linalg.norm(usual)
            assert np.linalg.norm(prepared.sum(axis=1)) < np.linalg.norm(usual.sum(axis=1))


def test_systems_without_a_mesh_are_refused():
    _, _, system = cluster_system(2)
    with pytest.raises(ValueError, match="PME or LJPME"):
        balance_pme(system)


@pytest.mark.parametrize(
    ("name", "value"),
    [("EwaldErrorTolerance", 0.5), ("EwaldErrorTolerance", math.nan), ("CutoffDistance", -1)],
)
def test_values_out_of_range_are_refused_before_anything_is_changed(water, name, value):
    _, _, system = water
    other = openmm.NonbondedForce()
    other.setNonbondedMethod(openmm.NonbondedForce.PME)
    getattr(other, f"set{name}")(value)
    system.addForce(other)
    force_of(system).setPMEParameters(0, 0, 0, 0)
    with pytest.raises(
        ValueError,
        match=f"(ewaldErrorTolerance must be from 1e-10 to 0.001|cut-off distance must be positive), got {value:g}",
    ):
        balance_pme(system)
    assert force_of(system).getPMEParameters()[1:] == [0, 0, 0]


def two_charges(distance: float, edge: float, tolerance: float):
    """System and positions of unit charges of opposite sign."""
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.PME)
    force.setCutoffDistance(0.9)
    force.setEwaldErrorTolerance(tolerance)
    for charge in (-1, 1):
        system.addParticle(1)
        force.addParticle(charge, 1, 0)
    system.addForce(force)
    return system, np.array([[0.1, 0.2, 0.3], [0.1, 0.2, 0.3 + distance]])


def balanced_parameters(edge: float, tolerance: float, constant_energy: bool):
    """The parameters of PME for as many charges as liquids have."""
    system, _ = two_charges(0.5, edge, tolerance)
    for k in range(500):
        force_of(system).addParticle((-1) ** k, 1, 0)
    assert balance_pme(system, constant_energy)
    return force_of(system).getPMEParameters()


def energy(system, positions) -> float:
    return plain_context(system, positions).getState(energy=True).getPotentialEnergy()._value


@pytest.mark.parametrize("tolerance", [5e-4, 1e-5])
@pytest.mark.parametrize(("constant_energy", "share"), [(True, 200), (False, 20)], ids=["constant energy", "bath"])
def test_the_step_at_the_cutoff_is_smaller(constant_energy, share, tolerance):
    # Within 2e-10 nm the energy of forces of 200 kJ/mol/nm changes by 4e-8 kJ/mol besides; the least jump is 2e-6.
    step = np.zeros(2)
    for balanced in (0, 1):
        for side in (-1, 1):
            system, positions = two_charges(0.9 + side * 1e-10, 2.4, tolerance)
            if balanced:
                force_of(system).setPMEParameters(*balanced_parameters(2.4, tolerance, constant_energy))
            step[balanced] += side * energy(system, positions)
    # erfc(x) is about exp(-x^2) / (x sqrt(pi)): the share by the definition, and 12 to 30 % by x.
    assert 1.1 * share < step[0] / step[1] < 1.32 * share


def test_boxes_that_are_nearly_empty_are_left_as_they_are():
    """With two charges OpenMM's sums are more accurate, and no warning asks for more."""
    system, positions = two_charges(0.5, 2.4, 5e-4)
    before = openmm.XmlSerializer.serialize(force_of(system))
    assert not balance_pme(system)
    assert "The sums of PME stay as they are" in str(prepare_system(system))
    assert openmm.XmlSerializer.serialize(force_of(system)) == before
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        context = openmm.Context(system, SIERIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
        context.setPositions(positions)


@pytest.mark.thorough
def test_the_net_force_on_the_box_grows():
    """It should be zero. Threefold and more over 20 states; one state scatters by a third about that mean."""
    box = forcefields.read_box(SYSTEMS / "spce-512.pdb", interactions=Interactions(0.9, 0.75, 5e-4))
    sizes = []
    for split in (balance_pme, lambda system: force_of(system).setPMEParameters(0, 0, 0, 0)):
        split(box.system)
        context = openmm.Context(box.system, openmm.VerletIntegrator(0.002), openmm.Platform.getPlatformByName("CPU"))
        context.setPositions(box.positions)
        forces = context.getState(forces=True).getForces(asNumpy=True)._value
        sizes.append(np.linalg.norm(forces.sum(axis=0)))
    balanced, usual = sizes
    assert balanced > 1.5 * usual > 0
