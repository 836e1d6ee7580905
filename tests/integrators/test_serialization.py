"""XML, copies and caches keyed by XML: all settings are in what OpenMM serializes, and come back from it."""

import copy
import importlib
import itertools
import json
import math
import pickle
import sys
from dataclasses import replace

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import (
    SIER2,
    SIER4,
    SIER4G,
    RigidBodies,
    Scheme,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    SIERThermostatIntegrator,
    hooks,
    select_bodies,
)
from openmm_sier.dynamics import rotation
from openmm_sier.engines.native import installation
from openmm_sier.ensembles import VelocityRescaling
from openmm_sier.integrators import settings
from tests.support.restarts import full_state
from tests.support.seeded import seeded
from tests.support.systems import assembled
from tests.support.waters import array, cluster_system, context_at, platform

serialize, deserialize = openmm.XmlSerializer.serialize, openmm.XmlSerializer.deserialize


def langevin(temperature=300.0, friction=1.0, **settings):
    return SIERLangevinIntegrator(temperature, friction, 0.002, **settings)


def nudged(scheme: Scheme) -> Scheme:
    """Another scheme of the same name, which differs in the last bit of two fractions."""
    first = np.nextafter(scheme.stages[0].fraction, 1)
    stages = [list(stage) for stage in scheme.stages]
    stages[0][1] = stages[-1][1] = float(first)
    return Scheme(scheme.name, tuple(map(tuple, stages)), scheme.source)


def stretched_molecules():
    """Bodies of the masses of water with other shapes."""
    topology, positions, system = cluster_system()
    while system.getNumConstraints():
        system.removeConstraint(0)
    return RigidBodies.from_system(system, topology, select_bodies(topology, "HOH"), 1.001 * positions)


#: No two of them are alike.
DISTINCT = {
    "SIER2": lambda: SIERIntegrator(0.002, "SIER2"),
    "SIER4": lambda: SIERIntegrator(0.002, "SIER4"),
    "SIER4G": lambda: SIERIntegrator(0.002, SIER4G),
    "a last bit": lambda: SIERIntegrator(0.002, nudged(SIER4G)),
    "other rotation": lambda: SIERIntegrator(0.002, SIER2, rotation=rotation.mrdl),
    "bodies": lambda: SIERIntegrator(0.002, SIER2, bodies=RigidBodies.from_system(cluster_system()[2])),
    "other bodies": lambda: SIERIntegrator(0.002, SIER2, bodies=stretched_molecules()),
    "Langevin": langevin,
    "temperature": lambda: langevin(310),
    "friction": lambda: langevin(friction=2),
    "rotational friction": lambda: langevin(rotationalFriction=2),
    "the same rotational friction": lambda: langevin(rotationalFriction=1),
    "scheme of the bath": lambda: langevin(scheme=SIER4G),
    "pressure": lambda: langevin(pressure=1 * unit.bar),
    "higher pressure": lambda: langevin(pressure=2 * unit.bar),
    "engine": lambda: SIERIntegrator(0.002, SIER2, engine="native"),
    "substeps": lambda: SIERIntegrator(0.002, SIER2, engine="native", substeps=5),
    "interval": lambda: langevin(pressure=1 * unit.bar, barostatInterval=5),
    "hybrid Monte Carlo": lambda: SIERHMCIntegrator(300, 0.002),
    "length of trials": lambda: SIERHMCIntegrator(300, 0.002, stepsPerTrial=5),
    "momenta kept in part": lambda: SIERHMCIntegrator(300, 0.002, frictionCoeff=2),
    "velocity rescaling": lambda: SIERThermostatIntegrator(VelocityRescaling(300, 1), 0.002),
    "another rate": lambda: SIERThermostatIntegrator(VelocityRescaling(300, 2), 0.002),
    "trials at constant pressure": lambda: SIERHMCIntegrator(300, 0.002, pressure=1 * unit.bar, barostatInterval=5),
}


def test_what_differs_serializes_differently():
    results = {name: serialize(make()) for name, make in DISTINCT.items()}
    alike = [pair for pair in itertools.combinations(results, 2) if results[pair[0]] == results[pair[1]]]
    assert not alike


@pytest.mark.parametrize("make", DISTINCT.values(), ids=DISTINCT)
def test_xml_gives_back_the_integrator(make):
    """Of the same class and settings, of the same XML, and to the bit."""
    original = make()
    original.setIntegrationForceGroups({0, 3})
    original.setConstraintTolerance(1e-7)
    original.setRandomNumberSeed(12)
    for way in (lambda it: deserialize(serialize(it)), openmm.XmlSerializer.clone):
        back = way(original)
        assert type(back) is type(original)
        # Bodies that are given as such are compared below.
        settings = (it.impl.settings for it in (back, original))
        assert len({replace(each, bodies=None) for each in settings}) == 1
        for name in ("IntegrationForceGroups", "ConstraintTolerance", "RandomNumberSeed"):
            assert getattr(back, f"get{name}")() == getattr(original, f"get{name}")()
        assert serialize(back) == serialize(original)


def test_settings_that_are_changed_are_in_xml():
    integrator = langevin(pressure=1 * unit.bar)
    seen = {serialize(integrator)}
    for name in ("Temperature", "Friction", "RotationalFriction", "Pressure", "StepSize"):
        getattr(integrator, f"set{name}")(5)
        seen.add(serialize(integrator))
        back = deserialize(serialize(integrator))
        assert getattr(back, f"get{name}")() == getattr(integrator, f"get{name}")()
    assert len(seen) == 6


@pytest.mark.parametrize("name", [name for name in DISTINCT if "pressure" not in name and name != "interval"])
def test_copies_of_a_bound_integrator_serialize_like_it(cluster, name):
    """Molecules without a box, which have no pressure."""
    integrator = DISTINCT[name]()
    _context = context_at(cluster[1], integrator, cluster[2], steps=1)
    for way in (copy.copy, copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))):
        assert serialize(way(integrator)) == serialize(integrator)


def test_a_copy_has_no_program_before_it_has_a_system(cluster, monkeypatch):
    """A program is written for a System; one for any System would be taken out again."""
    integrator = SIERIntegrator(0.001, "SIER2")
    _context = context_at(cluster[1], integrator, cluster[2], steps=1)
    assert integrator.getNumComputations()

    def refused(*_):
        raise AssertionError("a program was installed")

    monkeypatch.setattr(installation, "install", refused)
    for way in (copy.copy, copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))):
        assert way(integrator).getNumComputations() == 0


def test_settled_bodies_come_back_to_the_bit(cluster):
    bodies = RigidBodies.from_system(cluster[1], cluster[0])
    back = deserialize(serialize(SIERIntegrator(0.001, "SIER2", bodies=bodies))).impl.settings.bodies
    assert back.n_particles == bodies.n_particles
    for one, two in zip(back.species, bodies.species, strict=True):
        for name in ("atoms", "masses", "sites", "moments"):
            assert np.array_equal(getattr(one, name), getattr(two, name))
    # Copies in one process also know the names of residues, for messages.
    assert copy.deepcopy(SIERIntegrator(0.001, "SIER2", bodies=bodies)).impl.settings.bodies is bodies


def test_a_run_from_xml_files_is_the_run(tmp_path, cluster):
    """OpenMM's Simulation takes file names of System, integrator and State; nothing else is needed to continue."""
    topology, system, point = cluster
    integrator = SIERIntegrator(0.004, SIER4G)
    context = context_at(system, integrator, point, steps=3)
    files = [str(tmp_path / f"{name}.xml") for name in ("system", "integrator", "state")]
    for file, item in zip(files, (system, integrator, full_state(context)), strict=True):
        with open(file, "w") as out:
            out.write(serialize(item))
    simulation = app.Simulation(topology, files[0], files[1], platform(), state=files[2])
    assert isinstance(simulation.integrator, SIERIntegrator)
    integrator.step(5)
    simulation.step(5)
    ends = [array(it.getState(positions=True).getPositions(asNumpy=True)) for it in (context, simulation.context)]
    assert np.array_equal(*ends)


def test_a_state_does_not_bring_back_settings(cluster):
    """A checkpoint of a colder run leaves the integrator at the temperature that it was made with, as in OpenMM."""
    _, system, point = cluster
    cold = langevin(100)
    first = context_at(system, cold, point, steps=1)
    warm = langevin(300)
    second = context_at(system, warm, point)
    second.loadCheckpoint(first.createCheckpoint())
    assert warm.getTemperature() == 300 * unit.kelvin
    assert deserialize(serialize(warm)).getTemperature() == 300 * unit.kelvin


@pytest.mark.parametrize("n", [1, 5])
def test_copy_of_a_bound_integrator_in_another_system(cluster, n):
    """OpenMM does not check that per-atom variables fit the System, and would read beyond their end."""
    integrator = SIERIntegrator(0.001, "SIER2")
    _context = context_at(cluster[1], integrator, cluster[2], steps=1)
    other, positions = copy.deepcopy(integrator), np.arange(3.0 * n).reshape(n, 3)
    context = context_at(assembled(n * [1.0]), other, (positions, np.ones((n, 3))), steps=2)
    assert len(other.getPerDofVariableByName("sier_state0")) == n
    results = array(context.getState(positions=True).getPositions(asNumpy=True))
    # Two steps at constant velocity, to rounding.
    assert results == pytest.approx(positions + 0.002, abs=1e-14)


def test_copies_of_a_bound_integrator_have_their_own_noise(cluster):
    """A copy does not repeat the random numbers of its original, unless both are given one seed."""
    _, system, point = cluster
    original = langevin()
    context = context_at(system, original, point)
    other = copy.deepcopy(original)
    second = context_at(system, other, point)
    original.step(1)
    other.step(1)
    ends = [array(it.getState(velocities=True).getVelocities(asNumpy=True)) for it in (context, second)]
    assert not np.array_equal(*ends)


def test_variables_that_others_write_over_ours_do_not_repeat_noise(cluster):
    """openmmtools' ContextCache copies the variables of an integrator without a Context, all zero, over ours."""
    _, system, point = cluster
    integrator = seeded(langevin(friction=50.0))
    context = context_at(system, integrator, point)
    ends = []
    for _ in range(3):
        for i in range(integrator.getNumGlobalVariables()):
            integrator.setGlobalVariable(i, 0.0)
        context.setPositions(point[0])
        context.setVelocities(point[1])
        integrator.step(1)
        ends.append(array(context.getState(velocities=True).getVelocities(asNumpy=True)))
    assert not np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[1], ends[2])


@pytest.mark.parametrize("name", ["a 'b' \"c\" {d} <e> & f", "100 % é", "", " x "])
def test_names_that_xml_readers_damage(name):
    scheme = Scheme(name, SIER2.stages, name)
    back = deserialize(serialize(SIERIntegrator(0.001, scheme)))
    assert back.scheme == scheme


def test_a_rotation_of_users():
    """XML cannot contain it and refuses; copies within the process can."""
    integrator = SIERIntegrator(0.001, SIER2, rotation=lambda A, L, moments, h: rotation.mrdl(A, L, moments, h))
    assert copy.deepcopy(integrator).rotation is integrator.rotation
    with pytest.raises(openmm.OpenMMException, match="free-rotation map"):
        deserialize(serialize(integrator))
    other = SIERIntegrator(0.001, SIER2, rotation=lambda A, L, moments, h: (A, L))
    assert serialize(other) != serialize(integrator)


class Special(SIERIntegrator):
    """A user's own class, with an attribute of its own."""

    colour = "red"


def test_classes_of_users():
    integrator = Special(0.001, SIER4)
    integrator.colour = "blue"
    assert type(deserialize(serialize(integrator))) is Special
    assert copy.deepcopy(integrator).colour == "blue"
    assert pickle.loads(pickle.dumps(integrator)).colour == "blue"


def test_xml_of_another_version(monkeypatch):
    monkeypatch.setattr(settings, "LAYOUT", 7)
    xml = serialize(SIERIntegrator(0.001, "SIER2"))
    monkeypatch.undo()
    with pytest.raises(openmm.OpenMMException, match="layout 7, and this version reads layout 2"):
        deserialize(xml)


PRESSURE = {"pressure": None, "interval": 1}
LANGEVIN = PRESSURE | {"name": "Langevin", "temperature": 1.0, "friction": 1.0, "rotational_friction": None}
LANGEVIN |= {"counts_heat": None}
SCHEME = settings.as_json(SIERIntegrator(0.001, "SIER2").impl.settings)["scheme"]
BODY = {
    "atoms": [[0, 1]],
    "masses": [1.0, 1.0],
    "sites": [[-1.0, 1.0], [0.0, 0.0], [0.0, 0.0]],
    "moments": [0.0, 2.0, 2.0],
}


def bodies_of(species, particles=2):
    return {"particles": particles, "species": species}


#: Each a field of the settings, and values that it must not have.
WRONG = {
    "layout": [None, 1, "2"],
    "kind": [None, 3, "os:path", "venv.__main__:EnvBuilder", "openmm:VerletIntegrator", "nowhere", ":", "a:b.c.d"],
    "scheme": [
        None,
        [],
        {},
        {"name": "x", "source": "", "stages": []},
        SCHEME | {"name": 1},
        SCHEME | {"stages": 5},
        SCHEME | {"stages": []},
        SCHEME | {"stages": [["kick", "1"]]},
        SCHEME | {"stages": [[3, 1.0]]},
        SCHEME | {"stages": [["kick", 1.0, 0.0, 0.0]]},
        SCHEME | {"stages": [["kick", math.nan]]},
        SCHEME | {"stages": [["gradient kick", 1.0, math.inf]]},
    ],
    "step": [None, "1", -1.0, math.nan, math.inf, True, 10**400],
    "engine": [None, "cuda", 1, ["auto"]],
    "substeps": [0, -1, 1.5, "3", True],
    "fast_groups": [-1, 2**32, 1.0],
    "bodies": [
        3,
        "x",
        [3],
        [[0.5]],
        {},
        bodies_of([{}]),
        bodies_of(3),
        bodies_of([3]),
        bodies_of([BODY], particles="2"),
        bodies_of([BODY], particles=1),
        bodies_of([BODY | {"atoms": [[0.5, 1.0]]}]),
        bodies_of([BODY | {"atoms": []}]),
        bodies_of([BODY | {"masses": [1.0]}]),
        bodies_of([BODY | {"masses": ["a", "b"]}]),
        bodies_of([BODY | {"sites": [[0.0], [0.0, 1.0]]}]),
        bodies_of([BODY | {"moments": [0.0, math.nan, 2.0]}]),
    ],
    "rotation": [None, 3, "os:_exit", "exact()", "venv.__main__:main"],
    "ensemble": [
        None,
        {},
        {"name": "Warm"},
        {"name": "ConstantEnergy", "pressure": 1.0},
        LANGEVIN | {"temperature": "hot"},
        LANGEVIN | {"friction": -1.0},
        LANGEVIN | {"friction": None},
        LANGEVIN | {"volume_move": None},
        LANGEVIN | {"counts_heat": "x"},
        LANGEVIN | {"interval": True},
        LANGEVIN | {"pressure": "high"},
        LANGEVIN | {"interval": 0},
        PRESSURE | {"name": "Metropolis", "temperature": 300.0, "friction": None, "steps_per_trial": 0},
    ],
}


@pytest.mark.parametrize("field", WRONG)
def test_wrong_values_in_xml_are_refused_and_import_nothing(field):
    for value in WRONG[field]:
        plain = openmm.CustomIntegrator(0.001)
        values = settings.as_json(SIERIntegrator(0.001, "SIER2").impl.settings) | {field: value}
        settings.store_text(plain, json.dumps(values))
        imported = set(sys.modules)
        with pytest.raises(openmm.OpenMMException) as refused:
            deserialize(serialize(plain))
        text = str(refused.value)
        assert "\n" not in text
        assert set(sys.modules) == imported


def test_damaged_settings_are_refused():
    plain = openmm.CustomIntegrator(0.001)
    for text in ("", "{", "[]", "null", '{"layout": 2}', "\u00e9" * 20):
        settings.store_text(plain, text)
        with pytest.raises(openmm.OpenMMException, match=r"stored (in this )?SIER integrator|another"):
            deserialize(serialize(plain))
    for values in ([-1.0, 0.0], [1e300, 1.0], [math.nan, 2.0], [0.5, 0.5]):
        plain.getTabulatedFunction(0).setFunctionParameters(values)
        with pytest.raises(openmm.OpenMMException):
            deserialize(serialize(plain))


def test_other_integrators_are_left_alone():
    plain = openmm.CustomIntegrator(0.001)
    plain.addTabulatedFunction("sierra nevada", openmm.Discrete1DFunction([1.0]))
    assert type(deserialize(serialize(plain))) is openmm.CustomIntegrator
    assert type(copy.deepcopy(openmm.VerletIntegrator(0.001))) is openmm.VerletIntegrator


def test_hooks_are_put_in_place_once(cluster):
    """Also where the package is imported again: OpenMM's own methods are one layer below."""

    def depth():
        method, layers = openmm.Context.__init__, 0
        while hasattr(method, "__wrapped__"):
            method, layers = method.__wrapped__, layers + 1
        return layers

    before = depth()
    hooks.install()
    importlib.reload(hooks).install()
    assert depth() == before == 1
    context = context_at(cluster[1], SIERIntegrator(0.001, "SIER2"), cluster[2], steps=1)
    assert context.getStepCount() == 1


def test_xml_without_the_variables_of_a_trial_is_refused():
    """That of earlier versions, which made trials step by step."""
    xml = openmm.XmlSerializer.serialize(SIERHMCIntegrator(300.0, 0.004))
    line = next(line for line in xml.splitlines() if 'name="sier_steps"' in line)
    with pytest.raises(settings.SettingsError, match="sier_steps"):
        openmm.XmlSerializer.deserialize(xml.replace(line, "", 1))
