"""Boxes and integrators whose commands are counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import openmm
from openmm import app

from openmm_sier import (
    SIER2P3,
    SIER4G,
    SIER4GIntegrator,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    prepare_system,
)
from openmm_sier.inputs import forcefields
from studies.command import SYSTEMS

#: Boxes of `SYSTEMS`: water, water with virtual sites, and a peptide in water.
BOXES = ("tip3p-512", "tip4p-512", "peptide")

#: nm.
CUTOFF = 0.9

#: Dalton. Hydrogens of prepared Systems, with which SIER2 takes 9 fs.
HYDROGEN = 4

#: K, and 1/ps.
TEMPERATURE, FRICTION = 300.0, 5.0


class Method(NamedTuple):
    """An integrator at its usual step.

    Attributes:
        name: with the step.
        make: its function.
        kind: OpenMM's class that it is of.
        is_prepared: whether its System is.
        calls: of one step that are counted.
        steps: in a call of many, as `Simulation` has ten.
    """

    name: str
    make: Callable[[], openmm.Integrator]
    kind: str = "CustomIntegrator"
    is_prepared: bool = True
    calls: int = 6
    steps: int = 10


def _middle() -> openmm.Integrator:
    return openmm.LangevinMiddleIntegrator(TEMPERATURE, 1.0, 0.004)


def _several() -> openmm.Integrator:
    return openmm.MTSLangevinIntegrator(TEMPERATURE, 1.0, 0.008, [(0, 1), (1, 4)])


def _sier2(**options: Any) -> openmm.Integrator:
    return SIERLangevinIntegrator(TEMPERATURE, FRICTION, 0.009, engine="native", **options)


#: By the names that the command takes.
METHODS = {
    "verlet": Method("Verlet, 4 fs", lambda: openmm.VerletIntegrator(0.004), "VerletIntegrator", False),
    "langevinmiddle": Method("LangevinMiddle, 4 fs", _middle, "LangevinMiddleIntegrator", False),
    "mtslangevin": Method("MTSLangevin, 8 fs", _several),
    "sier2": Method("SIER2, 9 fs", _sier2),
    "sier2-heat": Method("SIER2, 9 fs, heat counted", lambda: _sier2(countsHeat=True)),
    "sier2p3": Method("SIER2P3, 9 fs", lambda: SIERIntegrator(0.009, SIER2P3, engine="native")),
    "sier4g": Method("SIER4G, 4 fs", lambda: SIER4GIntegrator(0.004, engine="native")),
    "hmc": Method(
        "hybrid Monte Carlo, a trial of 10 steps of 9 fs",
        lambda: SIERHMCIntegrator(TEMPERATURE, 0.009, SIER4G, 10, engine="native", extraChances=0),
        calls=3,
        steps=2,
    ),
}


def context(box: str, method: Method, precision: str, seed: int) -> openmm.Context:
    """Return a Context on the OpenCL platform, with velocities.

    Args:
        box: a name of `BOXES`.
        method: the integrator.
        precision: mixed, single or double.
        seed: of velocities and of the integrator.
    """
    path = SYSTEMS / f"{box}.pdb"
    pdb = app.PDBFile(str(path))
    field = forcefields.load(forcefields.pick(path)[0], SYSTEMS)
    topology, positions = forcefields.add_virtual_sites(pdb.topology, pdb.positions, field)
    system = field.createSystem(topology, nonbondedMethod=app.PME, nonbondedCutoff=CUTOFF, constraints=app.HBonds)
    if method.is_prepared:
        prepare_system(system, hydrogenMass=HYDROGEN)
    integrator = method.make()
    if hasattr(integrator, "setRandomNumberSeed"):
        integrator.setRandomNumberSeed(seed)
    platform = openmm.Platform.getPlatformByName("OpenCL")
    made = openmm.Context(system, integrator, platform, {"Precision": precision})
    made.setPositions(positions)
    made.applyConstraints(1e-6)
    made.setVelocitiesToTemperature(TEMPERATURE, seed)
    return made
