"""Pictures of the gallery: a frame of a simulation beside its energy."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import EllipseCollection
from openmm import unit
from openmm.app import Simulation

from openmm_sier.analysis.observables import energy_error

#: Between two energies.
EVERY = 5

#: Colour and radius in nm by element; None are virtual sites.
LOOK = {"H": ("#f4f4f4", 0.08), "O": ("#d1495b", 0.12), "C": ("#4d4d4d", 0.14), "N": ("#30638e", 0.13)}
OTHERS = ("#8e6c8a", 0.16)

#: Part of its size and opacity that water has beside something else.
SMALLER, FAINTER = 0.6, 0.25


def panel(simulation: Simulation, title: str, steps: int = 500) -> None:
    """Run, and draw the last frame beside the energy of the run, whose error stands in the title."""
    times, potentials, totals = [], [], []
    for _ in range(steps // EVERY):
        simulation.step(EVERY)
        state = simulation.context.getState(energy=True)
        times.append(state.getTime().value_in_unit(unit.picosecond))
        potentials.append(state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole))
        totals.append(potentials[-1] + state.getKineticEnergy().value_in_unit(unit.kilojoule_per_mole))
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), dpi=90, layout="constrained")
    draw(simulation, left)
    V, H = np.array(potentials), np.array(totals)
    right.plot(times, V - V.mean(), lw=1, color="#9aa5b1", label="potential energy")
    right.plot(times, H - H.mean(), lw=1.5, color="#0b5394", label="conserved energy")
    right.set(xlabel="time (ps)", ylabel="energy less its mean (kJ/mol)")
    right.legend(frameon=False, loc="upper right")
    figure.suptitle(f"{title}: the energy is kept within {100 * energy_error(H, V):.2g} % of the fluctuation of V")


def draw(simulation: Simulation, axes: plt.Axes) -> None:
    """The molecules, whole, seen along y; what is nearer hides what is farther."""
    state = simulation.context.getState(positions=True, enforcePeriodicBox=True)
    positions = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    atoms = [atom for atom in simulation.topology.atoms() if atom.element is not None]
    atoms.sort(key=lambda atom: -positions[atom.index, 1])
    alone = all(atom.residue.name == "HOH" for atom in atoms)
    looks = [LOOK.get(atom.element.symbol, OTHERS) for atom in atoms]
    faint = [not alone and atom.residue.name == "HOH" for atom in atoms]
    sizes = np.array([2 * radius * (SMALLER if less else 1) for (_, radius), less in zip(looks, faint, strict=True)])
    places = positions[[atom.index for atom in atoms]][:, [0, 2]]
    discs = EllipseCollection(
        sizes,
        sizes,
        np.zeros(len(sizes)),
        units="x",
        offsets=places,
        offset_transform=axes.transData,
        facecolors=[colour for colour, _ in looks],
        edgecolors="#333333",
        linewidths=0.3,
        alpha=[FAINTER if less else 1.0 for less in faint],
    )
    axes.add_collection(discs)
    (left, bottom), (right, top) = places.min(axis=0) - 0.2, places.max(axis=0) + 0.2
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.axis("off")
