"""Boxes and integrators of the study."""

from __future__ import annotations

import importlib.util
from typing import Any, NamedTuple

import openmm
from openmm import app

from openmm_sier.dynamics.acceptance import TRIAL_FRICTION
from openmm_sier.dynamics.schemes import SIER2P3, SIER2V2, SIER4G
from openmm_sier.inputs import forcefields
from studies import boxes
from studies.command import SYSTEMS
from studies.domains import rings
from studies.methods import HEAVY, MIDDLE, VERLET, Bath, Contestant, in_bath, of_scheme, several_steps, trials

#: Boxes of `SYSTEMS`: water, water with virtual sites, and a peptide in water.
BOXES = ("tip3p-512", "tip4p-512", "peptide")

#: A box of named bodies, rings of six atoms, and how many there are along an edge.
BODIES, EDGE = "hexagons-1000", 10

#: nm.
CUTOFF = 0.9

#: K and 1/ps.
BATH = Bath(300.0, 5.0)


class Case(NamedTuple):
    """An integrator whose commands are counted.

    Attributes:
        integrator: at its usual step.
        kind: OpenMM's class that it is of.
        calls: of one step that are counted.
        steps: in a call of many, as `Simulation` has ten.
        names_bodies: whether it moves those of the box `BODIES`, and no other box.
    """

    integrator: Contestant
    kind: str = "CustomIntegrator"
    calls: int = 6
    steps: int = 10
    names_bodies: bool = False


def _trials(engine: str, detail: str = "") -> Contestant:
    """Return hybrid Monte Carlo with the usual step and friction, whose trials all have as many steps."""
    method = trials(SIER2V2, 8, frictionCoeff=TRIAL_FRICTION, engine=engine, extraChances=0)
    return method.at(9, **HEAVY, detail=f" x 8{detail}", steps=8)


#: By the names that the command takes.
CASES = {
    "verlet": Case(VERLET.at(4), "VerletIntegrator"),
    "langevinmiddle": Case(MIDDLE.at(4, friction=1.0), "LangevinMiddleIntegrator"),
    "mtslangevin": Case(several_steps(8, friction=1.0)),
    "sier2": Case(in_bath(engine="native").at(9, **HEAVY)),
    "sier2-heat": Case(in_bath(engine="native", countsHeat=True).at(9, **HEAVY, detail=", heat counted")),
    "sier2p3": Case(of_scheme(SIER2P3, engine="native").at(9, **HEAVY)),
    "sier4g": Case(of_scheme(SIER4G, engine="native").at(4, **HEAVY)),
    "hmc": Case(_trials("native"), calls=4, steps=4),
    "sier2-kernels": Case(in_bath(engine="kernels").at(9, **HEAVY, detail=", kernels")),
    "hmc-kernels": Case(_trials("kernels", ", kernels"), calls=4, steps=4),
    "sier4g-kernels": Case(of_scheme(SIER4G, engine="kernels").at(4, **HEAVY, detail=", kernels")),
    "bodies-kernels": Case(in_bath(engine="kernels").at(9, detail=", kernels"), names_bodies=True),
}

#: Those that need the package openmm-sier-kernels.
WITH_KERNELS = ("sier2-kernels", "sier4g-kernels", "hmc-kernels", "bodies-kernels")


def usual() -> tuple[str, ...]:
    """Return the names of the cases that can be counted here."""
    has_kernels = importlib.util.find_spec("openmm_sier_kernels") is not None
    return tuple(name for name in CASES if has_kernels or name not in WITH_KERNELS)


def context(box: str, method: Contestant, precision: str, seed: int) -> openmm.Context:
    """Return a Context on the OpenCL platform, with velocities.

    Args:
        box: a name of `BOXES`, `BODIES`, or tip3p-N, N molecules of TIP3P.
        method: the integrator.
        precision: mixed, single or double.
        seed: of velocities and of the integrator.
    """
    system, positions, integrator = _named(method) if box == BODIES else _of_file(box, method)
    if hasattr(integrator, "setRandomNumberSeed"):
        integrator.setRandomNumberSeed(seed)
    platform = openmm.Platform.getPlatformByName("OpenCL")
    result = openmm.Context(system, integrator, platform, {"Precision": precision})
    result.setPositions(positions)
    if system.getNumConstraints():
        result.applyConstraints(1e-6)
    result.setVelocitiesToTemperature(BATH.temperature, seed)
    return result


def _of_file(box: str, method: Contestant) -> tuple[openmm.System, Any, openmm.Integrator]:
    path = SYSTEMS / f"{box}.pdb"
    if not path.exists():
        return _of_size(box, method)
    pdb = app.PDBFile(str(path))
    field = forcefields.load(forcefields.pick(path)[0], SYSTEMS)
    topology, positions = forcefields.add_virtual_sites(pdb.topology, pdb.positions, field)
    system = field.createSystem(topology, nonbondedMethod=app.PME, nonbondedCutoff=CUTOFF, constraints=app.HBonds)
    method.fit(system)
    return system, positions, method.integrator(BATH)


def _of_size(box: str, method: Contestant) -> tuple[openmm.System, Any, openmm.Integrator]:
    """Return water on a lattice, whose name ends in its number of molecules."""
    topology, positions = boxes.on_lattice(int(box.rpartition("-")[2]))
    system = forcefields.pme_system(topology, forcefields.load(["tip3p.xml"]))
    method.fit(system)
    return system, positions, method.integrator(BATH)


def _named(method: Contestant) -> tuple[openmm.System, Any, openmm.Integrator]:
    model = rings.model(EDGE)
    integrator = in_bath(engine="kernels", bodies=model.rigid_bodies).at(method.step).integrator(BATH)
    return model.rigid, model.positions, integrator
