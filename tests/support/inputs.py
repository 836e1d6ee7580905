"""One small system in files of AMBER, GROMACS, CHARMM and OpenMM with the same parameters.

26 molecules of TIP3P water and one of hydrogen peroxide, which has bonds, angles, a torsion and a pair three bonds
apart, on a lattice in a cubic box. Coordinates are rounded to what every file holds, gro files least. The prmtop file
has a wider box than the coordinates, as before an equilibration, and a bond in place of the angle of water, as tleap
writes it; `vacuum` is the same without a box. The top file of GROMACS includes one with the molecules.
"""

from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from tests.support.waters import plain_context

#: The files of AMBER, GROMACS and CHARMM.
FILES = Path(__file__).parents[1] / "data" / "inputs"

#: Cubic box, nm.
EDGE = 0.96


def positions() -> np.ndarray:
    """Of all atoms, (82, 3), nm."""
    return app.GromacsGroFile(str(FILES / "gromacs.gro")).getPositions(asNumpy=True).value_in_unit(unit.nanometer)


def write_openmm(directory: Path, system: openmm.System, name: str = "openmm") -> tuple[Path, Path]:
    """A State and a System in XML, whose box is then wider, as before an equilibration; the System is changed."""
    coordinates, topology = directory / f"{name}-state.xml", directory / f"{name}-system.xml"
    context = plain_context(system, positions())
    coordinates.write_text(openmm.XmlSerializer.serialize(context.getState(positions=True)))
    system.setDefaultPeriodicBoxVectors(*(1.1 * EDGE * np.eye(3)))
    topology.write_text(openmm.XmlSerializer.serialize(system))
    return coordinates, topology


def write_pdb(path: Path, topology: app.Topology, places: np.ndarray) -> Path:
    """A PDB file or, by its ending, a PDBx/mmCIF file."""
    writer = app.PDBxFile if path.suffix == ".cif" else app.PDBFile
    with path.open("w") as file:
        writer.writeFile(topology, places * unit.nanometer, file)
    return path
