"""The chains of `studies.domains.chain` in LAMMPS, with `fix rigid/small`, if `lmp` is on the PATH.

The input has the same positions, masses, bonds and interactions. Ashbaugh-Hatch is the sum of two Lennard-Jones pairs,
of which one ends at its minimum. LAMMPS does not shift coul/debye to zero at its cut-off, where a pair of charges has
0.003 kJ/mol; forces are the same. Heat baths are LAMMPS' own, of the same friction: `langevin` of fix rigid/small for
bodies, fix langevin for linkers.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import openmm

from openmm_sier.analysis.statistics import mean_and_error
from studies.domains import chain
from studies.domains.models import Model
from studies.units import md

#: nm and kJ/mol in LAMMPS' units "real".
ANGSTROM, KCAL = 0.1, 4.184

#: A of the skin of its lists of neighbours; chosen for speed.
SKIN = 8.0

PROGRAM = "lmp"

#: As the command names it, and as tables do.
SHORT, NAME = "lammps", "LAMMPS, fix rigid/small"


class Run(NamedTuple):
    """What LAMMPS printed.

    Attributes:
        samples: by heading, (n,) each.
        seconds: of processor time for the steps.
    """

    samples: dict[str, np.ndarray]
    seconds: float


def installed() -> bool:
    """Whether LAMMPS is there."""
    return shutil.which(PROGRAM) is not None


def data(model: Model, positions: np.ndarray) -> str:
    """The data file: a molecule for each domain and one for all linkers, a type of atom for each residue."""
    residues = sorted(set(chain.SEQUENCE))
    owner = {atom: number + 2 for number, body in enumerate(model.bodies) for atom in body}
    edge = chain.EDGE / ANGSTROM
    atoms: list[str] = []
    bonds: list[str] = []
    for i, place in enumerate(positions / ANGSTROM):
        residue = chain.SEQUENCE[i % len(chain.SEQUENCE)]
        at = " ".join(f"{x:.8f}" for x in place)
        atoms.append(f"{i + 1} {owner.get(i, 1)} {residues.index(residue) + 1} {chain.RESIDUES[residue][1]} {at}")
    for molecule in model.chains:
        for i in molecule[:-1]:
            if i not in owner or owner[i] != owner.get(i + 1):
                bonds.append(f"{len(bonds) + 1} 1 {i + 1} {i + 2}")
    masses = [f"{number + 1} {chain.RESIDUES[residue][0]}" for number, residue in enumerate(residues)]
    sections = [
        "chains of rigid domains",
        f"{len(atoms)} atoms\n{len(bonds)} bonds\n{len(residues)} atom types\n1 bond types",
        "\n".join(f"0 {edge} {axis}lo {axis}hi" for axis in "xyz"),
        "Masses\n\n" + "\n".join(masses),
        "Atoms # full\n\n" + "\n".join(atoms),
        "Bonds\n\n" + "\n".join(bonds),
    ]
    return "\n\n".join(sections) + "\n"


def script(model: Model, step: float, steps: int, every: int, friction: float, seed: int) -> str:
    """The input of a run."""
    residues = sorted(set(chain.SEQUENCE))
    pairs = []
    for a, first in enumerate(residues):
        for b, second in enumerate(residues[a:], a):
            one, other = chain.RESIDUES[first], chain.RESIDUES[second]
            sigma, strength = (one[2] + other[2]) / 2 / ANGSTROM, (one[3] + other[3]) / 2
            epsilon, kinds = chain.EPSILON / KCAL, f"{a + 1} {b + 1}"
            pairs.append(f"pair_coeff {kinds} lj/cut 1 {epsilon * strength:.12g} {sigma:.8g} {chain.NEAR / ANGSTROM}")
            ends = 2 ** (1 / 6) * sigma
            pairs.append(f"pair_coeff {kinds} lj/cut 2 {epsilon * (1 - strength):.12g} {sigma:.8g} {ends:.12g}")
    # LAMMPS' own constant of Coulomb's law, 332.06371 kcal/mol A, over this gives that of the model.
    dielectric = 332.06371 * KCAL * ANGSTROM / chain.COULOMB
    gyrations = "\n".join(
        f"group chain{number} id {molecule[0] + 1}:{molecule[-1] + 1}\ncompute g{number} chain{number} gyration"
        for number, molecule in enumerate(model.chains)
    )
    headings = " ".join(f"c_g{number}" for number in range(len(model.chains)))
    bath = f"{model.temperature} {model.temperature} {1e3 / friction}"
    return f"""units real
atom_style full
bond_style harmonic
special_bonds lj/coul 0 1 1
dielectric {dielectric:.12g}
pair_style hybrid/overlay lj/cut 20 lj/cut 20 coul/debye {ANGSTROM / chain.DEBYE:.12g} {chain.FAR / ANGSTROM}
read_data data
{chr(10).join(pairs)}
pair_coeff * * coul/debye
pair_modify pair lj/cut 1 shift yes
pair_modify pair lj/cut 2 shift yes
bond_coeff 1 {chain.STIFFNESS / 2 / KCAL * ANGSTROM**2:.12g} {chain.LENGTH / ANGSTROM}
group linkers molecule 1
group domains subtract all linkers
neigh_modify exclude molecule/intra domains
neighbor {SKIN} bin
velocity all create {model.temperature} {seed} dist gaussian
fix turning domains rigid/small molecule langevin {bath} {seed}
fix moving linkers nve
fix bath linkers langevin {bath} {seed + 1}
timestep {step}
compute hot linkers temp
{gyrations}
compute moved all ke/rigid turning
compute turned all erotate/rigid turning
thermo_style custom step pe ebond c_hot c_moved c_turned {headings}
thermo {every}
run {steps}
"""


def run(
    model: Model, positions: np.ndarray, step: float, steps: int, every: int, friction: float, seed: int, place: Path
) -> Run:
    """Run LAMMPS on one thread in a directory.

    Args:
        model: chains.
        positions: (N, 3), nm.
        step: fs.
        steps, every: of the run, and between two samples.
        friction: 1/ps.
        seed: of baths and velocities.
        place: directory for its files.

    Raises:
        RuntimeError: LAMMPS stopped.
    """
    place.mkdir(parents=True, exist_ok=True)
    (place / "data").write_text(data(model, positions))
    (place / "in.lmp").write_text(script(model, step, steps, every, friction, seed))
    command = [PROGRAM, "-in", "in.lmp", "-log", "log", "-screen", "none"]
    process = subprocess.run(command, cwd=place, capture_output=True, text=True)
    log = (place / "log").read_text()
    table = re.search(r"^ *(Step .*)\n((?: *\d.*\n)+)Loop time of ([\d.eE+-]+)", log, re.M)
    use = re.search(r"([\d.]+)% CPU use", log)
    if process.returncode or table is None or use is None:
        error = re.search(r"ERROR.*", log + process.stdout + process.stderr)
        raise RuntimeError(f"LAMMPS stopped: {error[0] if error else process.stderr[-200:]}")
    rows = np.array([line.split() for line in table[2].splitlines()], dtype=float)
    samples = dict(zip(table[1].split(), rows.T, strict=True))
    return Run(samples, float(table[3]) * float(use[1]) / 100)


def averages(run: Run, model: Model) -> dict[str, Any]:
    """Means of what `studies.domains.bath` observes of a run, without its first tenth."""
    row: dict[str, Any] = {}
    gas = md(openmm.unit.MOLAR_GAS_CONSTANT_R) / KCAL
    bodies = len(model.bodies)
    squares = [run.samples[f"c_g{number}"] ** 2 for number in range(len(model.chains))]
    series = {
        "translation": 2 * run.samples["c_moved"] / (3 * bodies * gas),
        "rotation": 2 * run.samples["c_turned"] / (3 * bodies * gas),
        "linkers": run.samples["c_hot"],
        "potential": KCAL * run.samples["PotEng"],
        "bonds": KCAL * run.samples["E_bond"],
        "gyration": ANGSTROM * np.sqrt(np.mean(squares, axis=0)),
    }
    for key, values in series.items():
        row[key], row[f"{key}_error"], _ = mean_and_error(values[len(values) // 10 :])
    return row
