"""Bodies of frames beside those of the script `rigid.py`: their moments of inertia, and energy at constant energy.

    OPENMM_CPU_THREADS=1 python -m studies.frames

The script, to which users of OpenMM are sent, holds four atoms of a body by constraints and makes the others virtual
sites. The four are those nearest to the root mean square distance from the centre of mass that can have masses above 0
with which mass and centre are right; moments of inertia follow from that. A published copy is openabc/forcefields/
rigid.py of github.com/ZhangGroup-MITChemistry/OpenABC. Here only its rule is used. It stops with a singular matrix
where four atoms that it tries lie in a plane. The table has the largest relative error of a principal moment.

Then eight molecules of C60 with frames, Lennard-Jones without cut-off, follow Verlet and SIER4G (native engine) at
constant energy, from one start; rms(H)/rms(V) within the time, in per cent. Writes frames.json.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import openmm
import pandas as pd
from openmm import unit

from openmm_sier import SIER4GIntegrator, with_frames
from openmm_sier.dynamics.species import Species
from openmm_sier.prepare.frame_shapes import FrameShape
from studies import text
from studies.command import Settings, command
from studies.records import Record
from studies.report import SILENT, Report

GOLDEN = (1 + 5**0.5) / 2

#: nm and dalton. Bonds of C60 and of benzene, and carbon and hydrogen.
BOND, RING, RING_OF_HYDROGENS = 0.144, 0.1395, 0.2480
CARBON, HYDROGEN = 12.011, 1.008

#: Beads of domains: masses of residues, and a globule's density of residues in nm^-3.
LIGHTEST, HEAVIEST, RESIDUES = 57.0, 186.0, 7.4

#: Lennard-Jones of carbon in C60, nm and kJ/mol (Girifalco, J. Phys. Chem. 96, 858 (1992)), and nm between molecules.
SIGMA, EPSILON, NEIGHBOUR = 0.3469, 0.2763, 1.004

#: Condition of the equations of four atoms in a plane, but for rounding.
SINGULAR = 1e12

MOMENTS = text.columns("body", "atoms", "script", "frame")
ENERGIES = text.columns("integrator", "step", "percent")


@dataclass(frozen=True)
class FrameSettings(Settings):
    """What moves.

    Attributes:
        verlet: steps of Verlet, fs.
        sier4g: steps of SIER4G, fs.
        time: at constant energy, ps.
        temperature: of the start, K.
    """

    verlet: tuple[float, ...] = (5.0, 10.0, 20.0)
    sier4g: tuple[float, ...] = (15.0, 30.0, 60.0)
    time: float = 6.0
    temperature: float = 300.0


def buckminsterfullerene() -> np.ndarray:
    """Positions (60, 3) in nm about the origin."""
    corners = set()
    for corner in ((0, 1, 3 * GOLDEN), (1, 2 + GOLDEN, 2 * GOLDEN), (GOLDEN, 2, 2 * GOLDEN + 1)):
        for signs in itertools.product((1, -1), repeat=3):
            for shift in range(3):
                corners.add(tuple(np.round(np.roll(np.array(corner) * signs, shift), 12) + 0.0))
    return BOND / 2 * np.array(sorted(corners))


def shapes(seed: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Masses (k,) in dalton and positions (k, 3) in nm of bodies, by their names."""
    angles = np.pi / 3 * np.arange(6)
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    found = {
        "benzene": (np.repeat([CARBON, HYDROGEN], 6), np.concatenate([RING * ring, RING_OF_HYDROGENS * ring])),
        "C60": (np.full(60, CARBON), buckminsterfullerene()),
    }
    random = np.random.default_rng(seed)
    for beads in (36, 200):
        radius = (3 * beads / (4 * np.pi * RESIDUES)) ** (1 / 3)
        directions = random.normal(size=(beads, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        places = directions * radius * random.uniform(size=(beads, 1)) ** (1 / 3)
        found[f"domain of {beads} beads"] = random.uniform(LIGHTEST, HEAVIEST, beads), places
    return found


def four_atoms(masses: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masses (4,) and positions (4, 3) from the centre of mass, by the script's rule.

    Raises:
        ValueError: four atoms that are tried lie in a plane, where the script stops, or no four can have them.
    """
    arms = places - masses @ places / masses.sum()
    distances = np.linalg.norm(arms, axis=1)
    order = np.argsort(np.abs(distances - np.sqrt((distances**2).mean())), kind="stable")
    for chosen in itertools.combinations(order.tolist(), 4):
        corners = arms[list(chosen)]
        equations = np.vstack([corners.T, np.ones(4)])
        if np.linalg.cond(equations) > SINGULAR:
            raise ValueError("the four atoms lie in a plane")
        found = np.linalg.solve(equations, [0, 0, 0, masses.sum()])
        if (found > 0).all():
            return found, corners
    raise ValueError("no four atoms have the mass and the centre of the body")


def moments_of(masses: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Principal moments, (3,), ascending."""
    return Species.from_coordinates([range(len(masses))], masses, places).moments


def errors_of_moments(masses: np.ndarray, places: np.ndarray) -> tuple[float, float]:
    """The largest relative error of a moment, of the script's four atoms (NaN if there are none) and of a frame."""
    body = Species.from_coordinates([range(len(masses))], masses, places)
    frame = FrameShape.of(body, body.sites.T)
    of_frame = moments_of(frame.masses, frame.corners.T)
    try:
        of_script = moments_of(*four_atoms(masses, places))
    except ValueError:
        of_script = np.full(3, np.nan)
    found = [np.abs(each / body.moments - 1) for each in (of_script, of_frame)]
    return float(np.max(found[0])), float(np.max(found[1]))


def crystallite() -> tuple[openmm.System, np.ndarray, list[list[int]]]:
    """Eight molecules of C60 at the corners of a rhombohedron of the crystal."""
    system, force, places, bodies = openmm.System(), openmm.NonbondedForce(), [], []
    vectors = NEIGHBOUR / 2**0.5 * np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]])
    for corner in itertools.product((0, 1), repeat=3):
        places.append(buckminsterfullerene() + np.array(corner) @ vectors)
        bodies.append([system.addParticle(CARBON) for _ in places[-1]])
        for _ in bodies[-1]:
            force.addParticle(0, SIGMA, EPSILON)
        for i, j in itertools.combinations(bodies[-1], 2):
            force.addException(i, j, 0, 1, 0)
    system.addForce(force)
    return system, np.concatenate(places), bodies


def percent(integrator: openmm.Integrator, system: openmm.System, state: openmm.State, steps: int) -> float:
    """rms(H)/rms(V) of a run from a State, in per cent."""
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(state.getPositions())
    context.setVelocities(state.getVelocities())
    total, potential = [], []
    for _ in range(steps):
        integrator.step(1)
        found = context.getState(energy=True)
        both = found.getPotentialEnergy(), found.getKineticEnergy()
        V, T = (each.value_in_unit(unit.kilojoule_per_mole) for each in both)
        total.append(V + T)
        potential.append(V)
    return float(100 * np.std(total) / np.std(potential))


def energies(settings: FrameSettings) -> pd.DataFrame:
    """Errors of the energy by integrator and step."""
    system, positions, bodies = crystallite()
    framed = with_frames(system, positions, bodies)
    start = openmm.LangevinMiddleIntegrator(settings.temperature, 5.0, 0.005)
    start.setRandomNumberSeed(settings.seed)
    context = openmm.Context(framed.system, start, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(framed.positions)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    start.step(round(settings.time / 2 / 0.005))
    state = context.getState(positions=True, velocities=True)
    rows = []
    runs: Sequence[tuple[str, float, openmm.Integrator]] = (
        *(("Verlet of OpenMM", dt, openmm.VerletIntegrator(1e-3 * dt)) for dt in settings.verlet),
        *(("SIER4G", dt, SIER4GIntegrator(1e-3 * dt, engine="native")) for dt in settings.sier4g),
    )
    for name, dt, integrator in runs:
        integrator.setConstraintTolerance(1e-9)
        found = percent(integrator, framed.system, state, round(1e3 * settings.time / dt))
        rows.append({"integrator": name, "step": dt, "percent": found})
    return pd.DataFrame(rows)


def study(settings: FrameSettings, report: Report = SILENT) -> Record:
    """Compare moments, follow energies, and write frames.json."""
    rows = []
    for name, (masses, places) in shapes(settings.seed).items():
        script, frame = errors_of_moments(masses, places)
        rows.append({"body": name, "atoms": len(masses), "script": 100 * script, "frame": 100 * frame})
    moments = pd.DataFrame(rows)
    report.table("Errors of moments of inertia, %", text.table(moments, MOMENTS))
    found = energies(settings)
    report.table("rms(H)/rms(V), eight molecules of C60", text.table(found, ENERGIES))
    tables = {"moments": moments, "energies": found}
    return Record(settings.recorded(), tables, {}).write(settings.out / "frames.json")


main = command(FrameSettings, study, __doc__, __name__)
