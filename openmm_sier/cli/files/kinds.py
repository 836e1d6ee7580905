"""The kinds of output that grow during a run: their options, files and records."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import openmm
from openmm import app

from openmm_sier.cli.files.records import GrowingFile, Log, Noted
from openmm_sier.cli.files.trajectories import Trajectory
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.observe import conservation, pressure

#: An open file, and a function that appends a record of the last completed step, given the values of the log by column.
#: There are no values if neither log nor checkpoint is due.
Opened = tuple[GrowingFile, Callable[[Mapping[str, float]], None]]


class OutputKind(NamedTuple):
    """A kind of output.

    Attributes:
        option, every: the options that name the file and set its interval.
        open: function that opens the file at a path for a simulated system and its Context, new or cut to the length in
            a checkpoint.
        format: class of the file.
    """

    option: str
    every: str
    open: Callable[[Path, SimulatedSystem, openmm.Context, Noted | None], Opened]
    format: type[GrowingFile]


def open_trajectory(path: Path, simulated: SimulatedSystem, context: openmm.Context, noted: Noted | None) -> Opened:
    """Open a trajectory of the atoms that are listed in the file of the coordinates."""
    settings, box = simulated.settings, simulated.box
    is_wrapped = box.system.usesPeriodicBoundaryConditions() and not settings.unwrapped
    topology, interval = _subset(box.topology, box.listed), settings.interval(settings.every)
    file = Trajectory(path, topology, settings.step_time, interval, noted)

    def write(values: Mapping[str, float]) -> None:
        state = context.getState(positions=True, enforcePeriodicBox=is_wrapped)
        file.write(state.getPositions(asNumpy=True)[box.listed], state.getPeriodicBoxVectors())

    return file, write


def open_log(path: Path, simulated: SimulatedSystem, context: openmm.Context, noted: Noted | None) -> Opened:
    """Open a log of energies, temperatures and counts of the integrator."""
    file = Log(path, conservation.columns(context.getIntegrator()), noted)

    def write(values: Mapping[str, float]) -> None:
        file.write([values[column] for column in file.columns])

    return file, write


def open_tensors(path: Path, simulated: SimulatedSystem, context: openmm.Context, noted: Noted | None) -> Opened:
    """Open a table of molecular pressure tensors, which are computed in a second Context."""
    pressures = pressure.MolecularPressure(context)
    file = Log(path, pressure.COLUMNS, noted)

    def write(values: Mapping[str, float]) -> None:
        file.write(pressures.row(context.getState(positions=True, velocities=True)))

    return file, write


#: All kinds by their names in checkpoints, in the order in which they are checked and written.
KINDS = {
    "trajectory": OutputKind("out", "every", open_trajectory, Trajectory),
    "log": OutputKind("report", "report_every", open_log, Log),
    "tensors": OutputKind("pressure_tensor", "pressure_tensor_every", open_tensors, Log),
}


def _subset(topology: app.Topology, listed: np.ndarray) -> app.Topology:
    """Return the Topology of some atoms with their names, and with the box, which a trajectory needs."""
    if len(listed) == topology.getNumAtoms():
        return topology
    subset, indices = app.Topology(), set(listed.tolist())
    subset.setPeriodicBoxVectors(topology.getPeriodicBoxVectors())
    for chain in topology.chains():
        own_chain = subset.addChain(chain.id)
        for residue in chain.residues():
            own_residue = subset.addResidue(residue.name, own_chain, residue.id, residue.insertionCode)
            for atom in residue.atoms():
                if atom.index in indices:
                    subset.addAtom(atom.name, atom.element, own_residue, atom.id)
    return subset
