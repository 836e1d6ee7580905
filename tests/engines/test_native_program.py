"""The program that a scheme becomes: as data, and executed on particles without constraints."""

import re

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER4G, Scheme, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.dynamics.stages import DRIFT, KICK
from openmm_sier.engines.native import program as native_program
from openmm_sier.engines.program import CONSTRAIN_V, CONSTRAIN_X
from tests.support.systems import assembled, field
from tests.support.waters import context_at, phase_point


@pytest.mark.parametrize("substeps", [1, 2, 3, 4, 5, 7])
def test_substeps_make_up_the_drift(substeps):
    program = native_program.write(SIER4G, substeps)
    drifts = [line for group in program.parts for line in group if line.title == "drift"]
    assert len(drifts) == 2
    for line in drifts:
        assert len(line.lengths) == substeps
        # Rounding of a few numbers.
        assert sum(line.lengths) == pytest.approx(0.5, abs=1e-15)
        assert line.lengths == line.lengths[::-1]
        cubes = sum(d**3 for d in line.lengths)
        assert abs(cubes) < 1e-15 if substeps in native_program.COMPOSITIONS else cubes > 1e-3


@pytest.mark.parametrize("groups", [set(), {1}], ids=["free drifts", "fast forces"])
def test_drifts_of_trials_are_single_steps_of_rattle(groups):
    program = SIERHMCIntegrator(300, 0.006, SIER4G, fastForceGroups=groups).program
    lines = [line for part in program.parts for line in part]
    drifts = [line for line in [*lines, *(inner for line in lines for inner in line.inner)] if line.title == "drift"]
    # Two in the step or, with fast forces, in the inner step of each of its two drifts.
    assert [len(line.lengths) for line in drifts] == [1] * (4 if groups else 2)


@pytest.mark.parametrize("groups", [set(), {1}], ids=["free drifts", "fast forces"])
def test_positions_change_only_where_they_are_constrained_next(groups):
    """A bath in the middle of a drift would otherwise take a kernel of its own."""
    program = SIERLangevinIntegrator(300, 5, 0.009, fastForceGroups=groups).program
    targets = [statement.target for statement in program.statements]
    assert targets.count("x") == targets.count(CONSTRAIN_X) > 0


def test_program_prints_as_the_algorithm():
    text = str(SIERIntegrator(0.006, SIER4G).program)
    lines = text.splitlines()
    assert len(lines) <= 12
    assert lines[0] == "SIER4G: one step h = 4 native steps dt"
    assert "kick: v = v + 0.16666666666666666*h*f/m" in text
    assert lines[-1].split(": ")[1] == CONSTRAIN_V
    assert "sier_" not in text


def test_scheme_that_cannot_be_written_out_is_left_to_the_exact_engine():
    other = Scheme("other", ((KICK, 0.5), (DRIFT, 1.0), (KICK, 0.5), ("spin", 1.0)))
    integrator = SIERIntegrator(0.002, other)
    with pytest.raises(ValueError, match="'spin'"):
        _ = integrator.program
    system = assembled([1.0])
    with pytest.raises(openmm.OpenMMException, match="take another scheme"):
        openmm.Context(system, SIERIntegrator(0.002, other, engine="native"))
    many = Scheme("many", ((KICK, 0.5), *[(DRIFT, 0.05), (KICK, 0.0)] * 20, (KICK, 0.5)))
    with pytest.raises(ValueError, match="more than 12"):
        native_program.write(many, 1)


@pytest.fixture(scope="module")
def particles():
    """Anharmonic oscillators that are coupled, and a point of their phase space.

    The coupling is no bond: of a molecule the exact engine conserves the angular momentum in gradient kicks.
    """
    rng = np.random.default_rng(5)
    pairs = openmm.CustomNonbondedForce("20*(r-0.3)^2 + 50*(r-0.3)^3")
    for _ in range(5):
        pairs.addParticle([])
    system = assembled([1.0, 2.0, 3.0, 4.0, 5.0], pairs, field("30*(x^2+y^2+z^4)", range(5)))
    return system, (rng.normal(size=(5, 3)) * 0.2, rng.normal(size=(5, 3)))


@pytest.mark.parametrize("scheme", CATALOGUE.values(), ids=CATALOGUE)
def test_without_constraints_both_engines_make_the_same_trajectory(scheme, particles):
    """RATTLE without constraints is the exact drift, so that every coefficient of the program is compared."""
    system, point = particles
    ends = {}
    for engine in ("exact", "native"):
        integrator = SIERIntegrator(0.02, scheme, engine=engine, substeps=3)
        context = context_at(system, integrator, point, steps=20)
        assert integrator.engine == engine
        ends[engine] = phase_point(context)
        assert context.getStepCount() == 20
        assert integrator.forceEvaluations == pytest.approx(20 * scheme.force_evaluations, abs=1)
    assert np.abs(ends["exact"][0] - point[0]).max() > 0.1
    for exact, native in zip(ends["exact"], ends["native"], strict=True):
        # 20 steps of some 10 roundings, which the motion amplifies less than a hundredfold. A wrong last digit of a
        # coefficient of 1e-9 shows.
        assert np.abs(exact - native).max() < 1e-12


@pytest.mark.parametrize(("name", "number"), [("sier2", 3), ("sier4g", 3), ("sier4p", 3), ("sier4", 5), ("sier4v", 5)])
def test_schemes_with_long_drifts_have_more_steps_of_rattle(name, number):
    """With three, rms(H)/rms(V) of water by SIER4V at 2 fs per force is six times that of the exact engine."""
    scheme = CATALOGUE[name]
    assert native_program.write(scheme) == native_program.write(scheme, number)
    assert SIERIntegrator(0.002, scheme).program == native_program.write(scheme, number)
    assert SIERIntegrator(0.002, scheme, substeps=2).program == native_program.write(scheme, 2)


@pytest.mark.parametrize("scheme", CATALOGUE.values(), ids=CATALOGUE)
def test_program_knows_its_longest_inner_step(scheme):
    nested = native_program.write(scheme, fast_groups={1}, inner_step=0.2)
    lengths = [d for group in nested.parts for line in group for d in line.lengths]
    assert nested.inner_fraction == pytest.approx(max(map(abs, lengths)), rel=1e-14)
    assert nested.inner_fraction <= 0.2


def programs():
    """All that the native engine executes with fast forces, for Systems that may have virtual sites."""
    for scheme in CATALOGUE.values():
        for slow_group in (None, 0):
            yield native_program.write(scheme, fast_groups={1, 3}, slow_group=slow_group)
    for scheme in (SIER2, SIER4G):
        method = SIERLangevinIntegrator(300, 1, 0.002, scheme=scheme).impl.method()
        for counts_heat in (True, False):
            yield native_program.write(
                method.scheme, fast_groups={1}, bath=method.bath, slow_group=0, counts_heat=counts_heat
            )


def test_no_native_step_uses_slow_forces_after_it_moved_atoms():
    """Virtual sites are placed at its end. Which forces a statement uses is read from its expression here."""
    count = 0
    for program in programs():
        for part in program.parts:
            has_moved = False
            for statement in (statement for line in part for statement, _ in line.executed()):
                forces = set(re.findall(r"\bf\d*(?=/m)", statement.expression))
                assert forces == ({statement.force.name} if statement.force is not None else set())
                uses_slow = bool(forces & {"f", "f0"})
                assert not (uses_slow and has_moved)
                has_moved = has_moved or statement.moves
                count += uses_slow
    assert count > 50
