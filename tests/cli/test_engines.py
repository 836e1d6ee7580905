"""Which engine a run takes, whatever the platform."""

from __future__ import annotations

from pathlib import Path

import pytest

from openmm_sier import RigidBodies
from openmm_sier.cli.beginning import Simulated
from openmm_sier.cli.plan import Options, new_plan
from tests.support.waters import cluster_system


@pytest.mark.parametrize(
    ("options", "engine"),
    [({}, "auto"), ({"ensemble": "nvt"}, "auto"), ({"ensemble": "npt"}, "auto"), ({"rigid": ["BNZ"]}, "exact")],
)
def test_engine_of_a_run(options, engine):
    """The native engine has no bodies that no constraints hold."""
    bodies = RigidBodies.from_system(cluster_system(1)[2])
    given = Options(Path("box.pdb"), **options)
    plan = new_plan(given)
    assert Simulated(given, plan, None, bodies, frozenset()).integrator(plan).engine == engine
