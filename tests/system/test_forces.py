"""The table of Forces has a row for each class of OpenMM, and its rows are what OpenMM does."""

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies
from openmm_sier.system.bonded_terms import bonded_terms
from openmm_sier.system.forces import FORCES, UNKNOWN, ForceKind, kind_of
from tests.support import force_examples
from tests.support.force_examples import EXAMPLES, POSITIONS, of_each_particle, system_of
from tests.support.systems import assembled, field
from tests.support.waters import array, plain_context, platform

every_class = pytest.mark.parametrize("kind", FORCES, ids=lambda kind: kind.__name__)


def test_every_force_of_openmm_has_its_row():
    classes = {member for member in vars(openmm).values() if isinstance(member, type)}
    assert set(FORCES) == {member for member in classes if issubclass(member, openmm.Force)} - {openmm.Force}


def test_a_subclass_has_the_row_of_its_class():
    class Springs(openmm.HarmonicBondForce):
        pass

    class Plugin(openmm.Force):
        def __init__(self):
            pass

    assert kind_of(Springs()) == FORCES[openmm.HarmonicBondForce]
    assert kind_of(Plugin()) == UNKNOWN


def test_what_executes_code_or_has_no_xml_is_no_data():
    """A class that is new in OpenMM is data unless it executes code or opens files, as PythonForce does."""
    others = {force for force, kind in FORCES.items() if not kind.is_data}
    assert others == {openmm.PythonForce, openmm.RPMDMonteCarloBarostat}


#: Functions that make a Force of an expression, for each class of particles whose energy is one.
EXPRESSIONS = {
    openmm.CustomBondForce: openmm.CustomBondForce,
    openmm.CustomAngleForce: openmm.CustomAngleForce,
    openmm.CustomTorsionForce: openmm.CustomTorsionForce,
    openmm.CustomCompoundBondForce: lambda energy: openmm.CustomCompoundBondForce(1, energy),
    openmm.CustomCentroidBondForce: force_examples.centroids,
    openmm.CustomHbondForce: force_examples.donors,
    openmm.CustomNonbondedForce: lambda energy: of_each_particle(openmm.CustomNonbondedForce(energy), []),
    openmm.CustomManyParticleForce: force_examples.of_three,
    # Its coordinates are x, y and z.
    openmm.CustomExternalForce: lambda energy: field(energy, [0]),
}


def test_every_class_with_an_expression_is_in_the_table():
    custom = {force for force in FORCES if hasattr(force, "getEnergyFunction")}
    of_no_particles = {openmm.ATMForce, openmm.CustomCVForce, openmm.CustomVolumeForce}
    assert custom == EXPRESSIONS.keys() | of_no_particles


@pytest.mark.parametrize("kind", EXPRESSIONS, ids=lambda kind: kind.__name__)
def test_classes_with_absolute_coordinates_are_those_that_accept_them(kind):
    """OpenMM refuses unknown names when it makes a Context."""

    def context(energy):
        return plain_context(assembled(force_examples.MASSES, EXPRESSIONS[kind](energy)), POSITIONS)

    context("0")
    if FORCES[kind].has_coordinates:
        context("x1")
    else:
        with pytest.raises(openmm.OpenMMException, match="x1"):
            context("x1")


def test_only_classes_with_an_expression_have_absolute_coordinates():
    assert {kind for kind, row in FORCES.items() if row.has_coordinates} <= EXPRESSIONS.keys()


# --- the other columns, by OpenMM's methods and by what the examples do ---

#: Classes that OpenMM accepts with integrators of its own or of this package.
USUAL = [kind for kind in FORCES if kind is not openmm.RPMDMonteCarloBarostat]

#: Classes of terms that have another form in XML than a list of atoms, and no motion that must be measured.
WITHOUT_LISTED_TERMS = {
    openmm.AmoebaTorsionTorsionForce,
    openmm.CustomCompoundBondForce,
    openmm.CustomHbondForce,
}

#: Classes of force fields that hold molecules together beside bonds. Other terms may be restraints.
JOINING = {openmm.HarmonicAngleForce, openmm.PeriodicTorsionForce, openmm.RBTorsionForce}

every_usual_class = pytest.mark.parametrize("kind", USUAL, ids=lambda kind: kind.__name__)
every_class_of_terms = pytest.mark.parametrize(
    "kind", [kind for kind, row in FORCES.items() if row.terms], ids=lambda kind: kind.__name__
)


def energy_and_forces(context):
    state = context.getState(energy=True, forces=True)
    return state.getPotentialEnergy()._value, array(state.getForces())


def has_an_entry_for_each_particle(kind):
    """Whether OpenMM refuses a System with another particle."""
    try:
        plain_context(system_of(kind, more_particles=1), np.zeros((len(POSITIONS) + 1, 3)))
    except openmm.OpenMMException as error:
        return f"{kind.__name__} must have exactly as many particles" in str(error)
    return False


def acts_on(kind):
    """The first column, by energies of the example and by the methods of the class."""
    context = plain_context(system_of(kind), POSITIONS)
    energy, forces = energy_and_forces(context)
    if not energy and not forces.any():
        return "nothing"
    context.setPositions(POSITIONS + 0.1)
    # The mesh of PME, which is at rest, changes energies by 1e-5 of them.
    if energy_and_forces(context)[0] != pytest.approx(energy, rel=1e-3):
        return "particles"
    terms = ("Bonds", "Angles", "Torsions", "TorsionTorsions", "Donors")
    if any(hasattr(kind, f"getNum{name}") for name in terms) and not hasattr(kind, "getNumGroups"):
        return "terms"
    # Sets of three particles or more are no pairs.
    is_of_pairs = has_an_entry_for_each_particle(kind) and not hasattr(kind, "getNumParticlesPerSet")
    return "pairs" if is_of_pairs else "whole"


@every_usual_class
def test_what_a_class_acts_on(kind):
    assert FORCES[kind].acts_on == acts_on(kind)


def test_a_barostat_for_ring_polymers_is_in_no_context():
    assert FORCES[openmm.RPMDMonteCarloBarostat] == ForceKind("nothing", "soft", is_passive=False, is_data=False)
    with pytest.raises(openmm.OpenMMException, match="RPMDIntegrator"):
        plain_context(system_of(openmm.RPMDMonteCarloBarostat), POSITIONS)


@every_class
def test_terms_are_the_atoms_that_openmm_lists(kind):
    """A correction map is listed before its atoms."""
    row, force = FORCES[kind], EXAMPLES[kind]()
    assert (row.acts_on == "terms") == bool(row.terms or kind in WITHOUT_LISTED_TERMS)
    if row.terms:
        first = 1 if kind is openmm.CMAPTorsionForce else 0
        parameters = getattr(force, f"get{row.terms.element}Parameters")(0)
        assert bonded_terms(force).tolist() == [parameters[first : first + len(row.terms.atoms)]]
        _, forces = energy_and_forces(plain_context(system_of(kind), POSITIONS))
        assert set(np.flatnonzero(forces.any(axis=1))) == set(np.ravel(bonded_terms(force)))


@every_class_of_terms
def test_strengths_are_the_parameters_without_which_a_term_has_no_energy(kind):
    element, atoms, strengths, _ = FORCES[kind].terms
    assert all(position >= len(atoms) for position in strengths)
    energies = []
    for zeros in [(), strengths, *(tuple(set(strengths) - {one}) for one in strengths)]:
        force = EXAMPLES[kind]()
        parameters = getattr(force, f"get{element}Parameters")(0)
        for zero in zeros:
            parameters[zero] *= 0
        getattr(force, f"set{element}Parameters")(0, *parameters)
        energies.append(energy_and_forces(plain_context(assembled(force_examples.MASSES, force), POSITIONS))[0])
    before, without, *others = energies
    assert before
    if strengths:
        assert without == 0
        # Each is needed: alone it leaves an energy.
        assert all(others)
    else:
        # Neither a map nor an expression has a parameter that removes a term.
        assert kind is openmm.CMAPTorsionForce or hasattr(kind, "getEnergyFunction")


@every_class_of_terms
def test_terms_that_join_molecules(kind):
    bodies = RigidBodies.from_system(system_of(kind))
    are_joined = len(set(bodies.molecules)) < bodies.n
    in_any_case = (openmm.HarmonicBondForce, openmm.CustomBondForce)
    assert are_joined == (kind in JOINING or kind in in_any_case)


def test_other_classes_join_nothing():
    assert {kind for kind, row in FORCES.items() if row.joins} == JOINING


@every_class
def test_charges_and_meshes_are_those_of_openmm(kind):
    """Every class with PME has charges, and induced dipoles if it has multipoles."""
    charges = meshes = None
    if hasattr(kind, "getPMEParameters"):
        charges = "multipoles" if hasattr(kind, "getInducedDipoles") else "points"
        meshes = ()
    if charges and hasattr(kind, "getNonbondedMethod"):
        meshes = tuple(getattr(kind, name) for name in ("PME", "LJPME") if hasattr(kind, name))
    assert (FORCES[kind].charges, FORCES[kind].meshes) == (charges, meshes)


@every_usual_class
def test_variables_that_are_set_have_parameters_of_the_context(kind):
    names = plain_context(system_of(kind), POSITIONS).getParameters()
    is_barostat = any("Pressure" in name for name in names)
    is_thermostat = any("Temperature" in name for name in names) and not is_barostat
    assert FORCES[kind].sets == ("pressure" if is_barostat else "temperature" if is_thermostat else None)


def contents(context):
    """Positions, velocities, forces and box."""
    state = context.getState(positions=True, velocities=True, forces=True)
    arrays = (state.getPositions(), state.getVelocities(), state.getForces(), state.getPeriodicBoxVectors())
    return np.concatenate([array(each) for each in arrays])


@every_usual_class
def test_passive_classes_change_nothing_and_ignore_the_time(kind):
    """A barostat at 10^5 bar accepts every smaller box, which half of its moves propose: 60 leave the box by 1e-18."""
    integrator = openmm.CustomIntegrator(0.001)
    integrator.addUpdateContextState()
    context = openmm.Context(system_of(kind), integrator, platform())
    context.setPositions(POSITIONS)
    context.setVelocities(np.ones_like(POSITIONS))
    before = contents(context)
    integrator.step(60)
    is_passive = np.array_equal(contents(context), before)
    # The exact engine stops the centre of mass in its place.
    assert FORCES[kind].is_passive == (is_passive or kind is openmm.CMMotionRemover)
