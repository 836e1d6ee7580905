"""A crowd of rigid proteins: how it slows their diffusion, and what such steps cost.

    python -m studies.crowding [--fractions 0.05 0.15 0.25 0.35] [--time 5000]

Copies of DHFR, one bead for each residue, are rigid bodies in a bath. Beads of different copies repel each other; there
is neither water nor hydrodynamics. The first row has no interactions, and there the diffusion is known. A second table
has the cost of DHFR in water as one body. Writes crowding.json and crowding.png. The structure is that of openmmtools
(`pip install openmmtools`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import openmm
import pandas as pd
from openmm import unit
from scipy.spatial.transform import Rotation

from openmm_sier import SIER2, RigidBodies, SIER4GIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.inputs.starts import make_context
from studies import boxes, style, text
from studies.command import Settings, command
from studies.records import Record
from studies.report import SILENT, Report
from studies.speed_boxes import INTERACTIONS
from studies.units import md

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Of beads: diameter in nm, beyond which they do not act on each other, and spring of an overlap in kJ/mol/nm^2.
DIAMETER, STIFFNESS = 0.6, 1000.0

#: ps between frames, and over which displacements and turns are taken.
EVERY, LAG = 10.0, 200.0

#: nm^3 of a protein for each dalton.
SPECIFIC_VOLUME = 1.21e-3

COLUMNS = text.columns("fraction", "beads") | {
    "edge, nm": "{edge:.1f}",
    "translation, D/D0": "{translation:.2f} ± {translation_error:.2f}",
    "rotation, D/D0": "{rotation:.2f} ± {rotation_error:.2f}",
    "ms a step": "{milliseconds:.2f}",
}


WATER_COLUMNS = text.columns("protein", "atoms") | {
    "atoms of water": "{beside}",
    "ms a step": "{milliseconds:.0f}",
}


@dataclass(frozen=True)
class CrowdSettings(Settings):
    """Settings of the crowd.

    Attributes:
        fractions: of the volume that proteins take.
        copies: of the protein, a cube of a whole number.
        time: of each run, ps.
        settle: before it, ps.
        step: fs.
        friction: of the bath, 1/ps.
        water_steps: that tell the cost of DHFR in water.
        temperature: K.
        platform: of OpenMM; None takes the fastest.
    """

    fractions: tuple[float, ...] = (0.05, 0.15, 0.25, 0.35)
    copies: int = 27
    time: float = 5000.0
    settle: float = 300.0
    step: float = 200.0
    friction: float = 0.1
    water_steps: int = 10
    temperature: float = 297.0
    platform: str | None = None


class Protein(NamedTuple):
    """Beads of a protein about its centre of mass, (n, 3) in nm, and their masses, (n,) in dalton."""

    beads: np.ndarray
    masses: np.ndarray


def dhfr() -> Protein:
    """Alpha carbons with the masses of their residues.

    Raises:
        ImportError: openmmtools is not installed.
    """
    made = boxes.dhfr(0.9, 0.75, 5e-4, 1.008)
    carbons = [atom for atom in made.topology.atoms() if atom.name == "CA"]
    masses = np.array([sum(md(atom.element.mass) for atom in carbon.residue.atoms()) for carbon in carbons])
    beads = md(made.positions)[[carbon.index for carbon in carbons]]
    return Protein(beads - masses @ beads / masses.sum(), masses)


def crowd(protein: Protein, copies: int, edge: float, interact: bool) -> tuple[openmm.System, list[list[int]]]:
    """System of copies in a cubic box with this edge in nm, and the atoms of each."""
    system, beads = openmm.System(), len(protein.masses)
    force = openmm.CustomNonbondedForce(f"select(body1-body2, {STIFFNESS / 2}*(r-{DIAMETER})^2, 0)")
    force.addPerParticleParameter("body")
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(DIAMETER)
    for body in range(copies):
        for mass in protein.masses:
            system.addParticle(mass)
            force.addParticle([body if interact else 0])
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    return system, [list(range(first, first + beads)) for first in range(0, copies * beads, beads)]


def edge_of(protein: Protein, copies: int, fraction: float) -> float:
    """Edge in nm of the box in which copies take this fraction of the volume."""
    return float((copies * SPECIFIC_VOLUME * protein.masses.sum() / fraction) ** (1 / 3))


class Followed(NamedTuple):
    """Where bodies were, and what a step took.

    Attributes:
        centres: nm, (frames, 3, n).
        attitudes: (frames, 3, 3, n).
        milliseconds: of processor time for a step.
    """

    centres: np.ndarray
    attitudes: np.ndarray
    milliseconds: float


def followed(protein: Protein, edge: float, settings: CrowdSettings, interact: bool) -> Followed:
    """Run copies from a lattice with attitudes at random, and keep a frame every `EVERY` ps."""
    system, rigid = crowd(protein, settings.copies, edge, interact)
    side = round(settings.copies ** (1 / 3))
    centres = (np.argwhere(np.ones((side,) * 3)) + 0.5) * edge / side
    turns = Rotation.random(settings.copies, random_state=settings.seed)
    positions = np.concatenate([turn.apply(protein.beads) + c for turn, c in zip(turns, centres, strict=True)])
    step = settings.step * 1e-3
    # All copies have the geometry of the first.
    bodies = RigidBodies.from_system(system, rigid=rigid, positions=positions)
    integrator = SIERLangevinIntegrator(settings.temperature, settings.friction, step, SIER2, bodies=bodies)
    integrator.setRandomNumberSeed(settings.seed)
    context = make_context(system, integrator, settings.platform)
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 500)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    integrator.step(round(settings.settle / step))
    start = time.process_time()
    frames, steps = [], round(EVERY / step)
    for _ in range(round(settings.time / EVERY)):
        integrator.step(steps)
        state = integrator.getBodyState()
        frames.append((state.q.copy(), state.A.copy()))
    spent = 1e3 * (time.process_time() - start) / (steps * len(frames))
    centres, attitudes = (np.array(values) for values in zip(*frames, strict=True))
    return Followed(centres, attitudes, spent)


def cost_in_water(settings: CrowdSettings) -> list[dict[str, Any]]:
    """Milliseconds of a step of SIER4G for DHFR in water with all its atoms, as one body and with its constraints."""
    box = boxes.solute(boxes.DHFR, INTERACTIONS)
    system, positions = box.system, md(box.positions)
    protein = max(openmm.Context(system, openmm.VerletIntegrator(0.001)).getMolecules(), key=len)
    rows = []
    for name, rigid in (("one body", [list(protein)]), ("flexible", None)):
        mine = openmm.XmlSerializer.clone(system)
        bodies = RigidBodies.from_system(mine, rigid=rigid, positions=positions)
        prepare_system(mine, bodies)
        integrator = SIER4GIntegrator(4.5e-3, bodies=bodies)
        context = make_context(mine, integrator, settings.platform)
        context.setPositions(positions)
        context.setVelocitiesToTemperature(settings.temperature, settings.seed)
        integrator.step(2)
        start = time.process_time()
        integrator.step(settings.water_steps)
        spent = 1e3 * (time.process_time() - start) / settings.water_steps
        beside = len(positions) - len(protein)
        rows.append({"protein": name, "atoms": len(protein), "beside": beside, "milliseconds": spent})
    return rows


def diffusion(path: Followed) -> dict[str, float]:
    """Coefficients by displacements and turns within `LAG`, in nm^2/ps and 1/ps, with errors from the bodies."""
    lag = round(LAG / EVERY)
    moved = ((path.centres[lag:] - path.centres[:-lag]) ** 2).sum(axis=1).mean(axis=0) / (6 * LAG)
    overlap = (path.attitudes[lag:] * path.attitudes[:-lag]).sum(axis=(1, 2)).mean(axis=0) / 3
    turned = -np.log(np.maximum(overlap, 1e-3)) / (2 * LAG)
    root = np.sqrt(len(moved))
    found = {"translation": moved.mean(), "translation_error": moved.std(ddof=1) / root}
    return found | {"rotation": turned.mean(), "rotation_error": turned.std(ddof=1) / root}


def study(settings: CrowdSettings, report: Report = SILENT) -> Record:
    """Run the crowds, and write crowding.json and crowding.png.

    Raises:
        ValueError: `copies` is not the cube of a whole number, or `time` is too short.
        ImportError: openmmtools is not installed.
    """
    if round(settings.copies ** (1 / 3)) ** 3 != settings.copies:
        raise ValueError(f"copies must be the cube of a whole number, got {settings.copies}")
    if settings.time < 2 * LAG:
        raise ValueError(f"time must be at least {2 * LAG:g} ps, got {settings.time:g}")
    protein, rows = dhfr(), []
    free: dict[str, float] = {}
    for fraction in (0.0, *settings.fractions):
        edge = edge_of(protein, settings.copies, fraction or min(settings.fractions))
        path = followed(protein, edge, settings, fraction > 0)
        found = diffusion(path)
        free = free or found
        row: dict[str, Any] = {"fraction": fraction, "edge": edge, "beads": settings.copies * len(protein.masses)}
        for kind in ("translation", "rotation"):
            row |= {name: found[name] / free[kind] for name in (kind, f"{kind}_error")}
        rows.append(row | {"milliseconds": path.milliseconds})
        report.note(f"{fraction:g} of the volume: {row['translation']:.3f}, {row['rotation']:.3f}")
    tables = {"crowds": pd.DataFrame(rows), "water": pd.DataFrame(cost_in_water(settings))}
    title = "Diffusion in a crowd of DHFR, over that without interactions"
    report.table(title, text.table(tables["crowds"], COLUMNS))
    report.table("DHFR in water, SIER4G at 4.5 fs", text.table(tables["water"], WATER_COLUMNS))
    # nm^2/ps, of a free body: kT/(m friction), less what the motion before the first collision takes.
    kT = unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin) * settings.temperature
    known = kT / protein.masses.sum() / settings.friction
    short = (1 - np.exp(-settings.friction * LAG)) / settings.friction / LAG
    last = {"centres": path.centres[-1].round(3), "attitudes": path.attitudes[-1].round(4), "edge": edge}
    notes = {"free": free, "known": known * (1 - short), "beads": protein.beads.round(3), "last": last}
    record = Record(settings.recorded(), tables, notes)
    record.write(settings.out / "crowding.json")
    figure(record, settings.out / "crowding.png")
    return record


def figure(record: Record, path: Path) -> None:
    """The densest crowd, and diffusion against the volume that proteins take."""
    crowds, last = record.tables["crowds"], record.notes["last"]
    with style.figure(path, 2) as (_, (picture, slowed)):
        _draw(picture, np.array(record.notes["beads"]), *(np.array(last[name]) for name in ("centres", "attitudes")))
        picture.set_title(
            f"{record.settings['copies']} rigid proteins, {100 * crowds['fraction'].max():.0f} % of the volume"
        )
        for kind, colour, marker in (("translation", "#0072b2", "o"), ("rotation", "#d55e00", "s")):
            slowed.errorbar(
                crowds["fraction"], crowds[kind], crowds[f"{kind}_error"], color=colour, marker=marker, label=kind
            )
        slowed.set(xlabel="fraction of the volume", ylabel="diffusion over that of a free protein", ylim=(0, 1.1))
        densest = crowds.loc[crowds["fraction"].idxmax()]
        slowed.set_title(f"There they diffuse {densest['translation']:.1f} times as fast as alone")
        slowed.legend()


def _draw(axes: Axes, beads: np.ndarray, centres: np.ndarray, attitudes: np.ndarray) -> None:
    """Beads as discs, a colour for each protein, the nearest on top and the farthest pale."""
    import matplotlib as mpl

    # Lab coordinates (n, beads, 3) of whole proteins.
    placed = np.einsum("ijn,bj->nbi", attitudes, beads) + centres.T[:, None]
    colours = mpl.colormaps["tab20"](np.arange(len(placed)) % 20)[:, :3]
    depth = placed[..., 2]
    pale = ((depth - depth.min()) / np.ptp(depth))[..., None] * 0.7 + 0.3
    shades = pale * colours[:, None] + (1 - pale)
    order = np.argsort(depth, axis=None)
    flat = placed.reshape(-1, 3)[order]
    axes.scatter(flat[:, 0], flat[:, 1], s=26, c=shades.reshape(-1, 3)[order], edgecolors="0.25", linewidths=0.15)
    axes.set_aspect("equal")
    axes.set_axis_off()


main = command(CrowdSettings, study, __doc__, __name__)
