"""`python -m studies.native.program`, against what OpenMM does."""

import numpy as np
import openmm
import pytest

from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.engines.native.installation import install
from openmm_sier.engines.native.program import Program, Statement, write
from studies.native import program as counts


def evaluations(program: Program, groups: tuple[int, ...]) -> list[int]:
    """How often OpenMM asks for the forces of each group in the second step of a program."""
    system, seen = openmm.System(), dict.fromkeys(groups, 0)
    system.addParticle(1.0)

    def counting(group: int) -> openmm.PythonForce:
        def compute(_state):
            seen[group] += 1
            return 0.0, np.zeros((1, 3))

        force = openmm.PythonForce(compute)
        force.setForceGroup(group)
        return force

    for group in groups:
        system.addForce(counting(group))
    integrator = openmm.CustomIntegrator(0.001)
    install(program, integrator)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[0, 0, 0]])
    integrator.step(len(program.parts))
    first = dict(seen)
    integrator.step(len(program.parts))
    return [seen[group] - first[group] for group in groups]


@pytest.mark.parametrize("name", ["sier2", "sier2p3", "sier4g", "sier4p"])
def test_forces_are_counted_as_openmm_computes_them(name):
    scheme = CATALOGUE[name]
    row = counts.count(write(scheme))
    assert [row["forces"]] == evaluations(write(scheme), (0,)) == [scheme.force_evaluations]
    assert row["fast_alone"] == 0
    nested = write(scheme, fast_groups={counts.FAST})
    row = counts.count(nested)
    # The sum of all groups asks for each of them.
    assert evaluations(nested, (0, counts.FAST)) == [row["forces"], row["forces"] + row["fast_alone"]]


def test_statements_are_one_kernel_until_atoms_move_or_the_group_changes():
    v, u = Statement("v", "v + f/m"), Statement("u", "v")
    x, fast = Statement("x", "x + v"), Statement("v", "v + f1/m")
    constrain = Statement("constrain x")
    assert counts.kernels([[u, v, x]]) == 1
    assert counts.kernels([[x, v]]) == 2
    assert counts.kernels([[v, constrain, u]]) == 2
    # The first u counts to the force that follows it.
    assert counts.kernels([[v, u, fast]]) == 2
    assert counts.kernels([[v], [v]]) == 2
