"""Force fields for water boxes: picking the water model of a PDB file, and building the System."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.context.pme import balance_pme, meshed_forces

#: Where the project's own force fields and boxes are: in an installed package, and in a checkout.
PACKAGE = Path(__file__).parent.parent
SHIPPED = (PACKAGE / "systems", PACKAGE.parent / "systems")

#: The box where none is given, one of the project's own.
DEFAULT_BOX = "tip3p-512.pdb"

#: A PDB file names its force field in records that begin like this; one file name follows.
REMARK = "REMARK  99 FORCEFIELD"

#: Settings of the System, nm: direct-space cut-off, and where Lennard-Jones starts to be switched off.
CUTOFF = 0.9
SWITCH = 0.75

#: From it follow the mesh and, with more to spare, the Ewald parameter.
EWALD_TOLERANCE = 1e-5

#: The cut-off as a fraction of the narrowest box width where the box is too small for `CUTOFF`. OpenMM refuses 0.5, and
#: a barostat may shrink the box.
LARGEST_CUTOFF = 0.45


class ForceFieldError(ValueError):
    """No force field can be picked, found or applied."""


@dataclass(frozen=True)
class WaterModel:
    """What tells a water model by its geometry.

    Attributes:
        name: as in the literature.
        sites: of one molecule, virtual sites included.
        distances: O-H and O-M (0 without such a site), nm.
        file: force field with water alone.
        file_with_ions: force field with ions too, if there is one.
    """

    name: str
    sites: int
    distances: tuple[float, float]
    file: str
    file_with_ions: str | None = None


#: Geometries from the force-field files themselves.
WATER_MODELS = (
    WaterModel("TIP3P", 3, (0.09572, 0.0), "tip3p.xml", "amber14/tip3p.xml"),
    WaterModel("SPC/E", 3, (0.1, 0.0), "spce.xml", "amber14/spce.xml"),
    WaterModel("OPC3", 3, (0.097888, 0.0), "opc3.xml", "amber14/opc3.xml"),
    WaterModel("TIP3P-FB", 3, (0.101181, 0.0), "tip3pfb.xml", "amber14/tip3pfb.xml"),
    WaterModel("TIP4P", 4, (0.09572, 0.015), "tip4p.xml"),
    WaterModel("TIP4P-Ew", 4, (0.09572, 0.0125), "tip4pew.xml", "amber14/tip4pew.xml"),
    WaterModel("TIP4P/2005", 4, (0.09572, 0.01546), "tip4p2005.xml"),
    WaterModel("TIP4P-FB", 4, (0.09572, 0.010527), "tip4pfb.xml", "amber14/tip4pfb.xml"),
    WaterModel("OPC", 4, (0.087243, 0.015940), "opc.xml", "amber14/opc.xml"),
    WaterModel("TIP5P", 5, (0.09572, 0.07), "tip5p.xml"),
)


@dataclass(frozen=True)
class Choice:
    """Force-field files, and in words why they were picked."""

    files: tuple[str, ...]
    reason: str


def pick(path: str | Path, topology, positions) -> Choice:
    """The force field of a PDB file for which the user named none.

    Records "REMARK  99 FORCEFIELD file.xml" in the file decide; the project's own boxes have them. Without them it
    is the water model with as many sites whose O-H and O-M distances are nearest to those in the file.

    Args:
        path: the PDB file.
        topology: openmm.app.Topology of it.
        positions: (N, 3), nm.

    Raises:
        ForceFieldError: there is no water, or something besides water and ions.
    """
    named = tuple(
        line[len(REMARK) :].strip()
        for line in Path(path).read_text(errors="replace").splitlines()
        if line.startswith(REMARK)
    )
    if named:
        return Choice(named, "named in the PDB file")
    waters, others = _residues(topology)
    if not waters:
        raise ForceFieldError(f"{path} has no water, so that no force field can be picked. Name one with --forcefield")
    model, measured = _nearest(waters, positions)
    reason = f"{model.name}, the nearest of the {model.sites}-site models to O-H {measured[0]:.4f} nm"
    reason += f" and O-M {measured[1]:.4f} nm" if model.sites > 3 else ""
    if not others:
        return Choice((model.file,), reason)
    if model.file_with_ions is None or any(len(list(residue.atoms())) > 1 for residue in others):
        names = ", ".join(sorted({residue.name for residue in others}))
        raise ForceFieldError(
            f"{path} has residues {names} besides {model.name} water. Name force fields for them with --forcefield"
        )
    return Choice((model.file_with_ions,), reason + ", with ions")


def _residues(topology):
    """Residues that are water, and the others."""
    residues = list(topology.residues())
    waters = [r for r in residues if r.name == "HOH"]
    return waters, [r for r in residues if r.name != "HOH"]


def _nearest(waters, positions):
    """The model whose distances are nearest to the medians over the molecules, and these medians."""
    counts = [len(list(residue.atoms())) for residue in waters]
    sites = max(counts)
    if min(counts) != sites:
        odd = waters[counts.index(min(counts))]
        raise ForceFieldError(
            f"residue {odd.name} {odd.id} has {min(counts)} atoms, other water has {sites}; expected equal molecules"
        )
    candidates = [model for model in WATER_MODELS if model.sites == sites]
    if not candidates:
        raise ForceFieldError(
            f"residue {waters[0].name} {waters[0].id} has {sites} atoms, expected water with 3, 4 or 5 sites. "
            "Are hydrogens missing? Otherwise name a force field with --forcefield"
        )
    measured = np.median([_distances(residue, positions) for residue in waters], axis=0)
    return min(candidates, key=lambda model: float(np.abs(measured - model.distances).sum())), measured


def _distances(residue, positions) -> tuple[float, float]:
    """O-H and O-M, the latter 0 without such a site."""
    kinds: dict[str, list] = {"O": [], "H": [], "M": []}
    for atom in residue.atoms():
        symbol = "M" if atom.element is None else atom.element.symbol
        if symbol not in kinds:
            raise ForceFieldError(f"residue {residue.name} {residue.id} has an atom {atom.name}, which water has not")
        kinds[symbol].append(positions[atom.index])
    if len(kinds["O"]) != 1 or len(kinds["H"]) != 2:
        raise ForceFieldError(
            f"residue {residue.name} {residue.id} has {len(kinds['O'])} oxygens and {len(kinds['H'])} hydrogens, "
            "expected 1 and 2"
        )
    oxygen = kinds["O"][0]
    return tuple(  # type: ignore[return-value]
        float(np.mean([np.linalg.norm(x - oxygen) for x in kinds[kind]])) if kinds[kind] else 0.0 for kind in "HM"
    )


def load(files: Sequence[str], beside: str | Path = ".") -> app.ForceField:
    """A ForceField from files, looked for as given, in the directory `beside`, among the project's own, and in OpenMM.

    Raises:
        ForceFieldError: a file is not found or no force field.
    """
    try:
        return app.ForceField(*[locate(name, Path(beside)) for name in files])
    except ForceFieldError:
        raise
    except Exception as error:
        raise ForceFieldError(f"cannot read the force field {' '.join(files)}: {first_line(error)}") from error


def locate(name: str, beside: Path) -> str:
    """The path of a force-field file, or its name where it is one of OpenMM's own; looked for as `load` does.

    Raises:
        ForceFieldError: there is none.
    """
    for directory in (Path(), beside, *SHIPPED):
        if (directory / name).is_file():
            return str(directory / name)
    if not (Path(app.__file__).parent / "data" / name).is_file():
        raise ForceFieldError(f"there is no force field {name}, neither here, beside the PDB file, nor in OpenMM")
    return name


def add_virtual_sites(topology, positions, forcefield):
    """Topology and positions (a Quantity) with the virtual sites that the force field has and the file lacks.

    Raises:
        ForceFieldError: the force field has no template for a residue.
    """
    modeller = app.Modeller(topology, positions)
    try:
        modeller.addExtraParticles(forcefield)
    except Exception as error:
        raise ForceFieldError(first_line(error)) from error
    return modeller.topology, modeller.positions


def pme_system(topology, forcefield):
    """The System: rigid water, PME where there is a box, everything with everything where there is none.

    The cut-off is 0.9 nm, less in a box too small for it, with the sums of PME balanced (`openmm_sier.balance_pme`);
    Lennard-Jones is switched off over the last sixth of it, with the usual correction for its tail. Nothing removes the
    motion of the centre of mass.

    Raises:
        ForceFieldError: the force field has no template for a residue.
    """
    box = topology.getPeriodicBoxVectors()
    settings = {"nonbondedMethod": app.NoCutoff}
    if box is not None:
        cutoff = min(CUTOFF, LARGEST_CUTOFF * _narrowest_width(box))
        settings = {
            "nonbondedMethod": app.PME,
            "nonbondedCutoff": cutoff * unit.nanometer,
            "switchDistance": cutoff * SWITCH / CUTOFF * unit.nanometer,
            "ewaldErrorTolerance": EWALD_TOLERANCE,
        }
    try:
        system = forcefield.createSystem(topology, rigidWater=True, constraints=None, removeCMMotion=False, **settings)
    except Exception as error:
        raise ForceFieldError(first_line(error)) from error
    if meshed_forces(system):
        balance_pme(system)
    return system


@dataclass(frozen=True)
class Box:
    """A PDB file with its force field, molecules whole.

    Attributes:
        topology: openmm.app.Topology, virtual sites included.
        positions: Quantity, of all sites.
        system: openmm.System.
        choice: the force field and why.
        listed: indices of the particles that the PDB file lists, virtual sites only if it has them.
    """

    topology: app.Topology
    positions: unit.Quantity
    system: openmm.System
    choice: Choice
    listed: np.ndarray


def read_box(path: str | Path, files: Sequence[str] | None = None) -> Box:
    """Read a PDB file and build its System.

    Args:
        path: the PDB file.
        files: force-field files; None picks one, see `pick`.

    Raises:
        ForceFieldError: the file is no PDB file, or no force field fits it.
        OSError: the file cannot be read.
    """
    if not any(line.startswith(("ATOM", "HETATM")) for line in Path(path).read_text(errors="replace").splitlines()):
        raise ForceFieldError(f"{path} is no PDB file with atoms")
    try:
        pdb = app.PDBFile(str(path))
    except Exception as error:
        raise ForceFieldError(f"cannot read {path} as a PDB file: {first_line(error)}") from error
    lengths = pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    choice = Choice(tuple(files), "named by the user") if files else pick(path, pdb.topology, lengths)
    forcefield = load(choice.files, Path(path).parent)
    positions = make_whole(lengths, pdb.topology) * unit.nanometer
    topology, positions = add_virtual_sites(pdb.topology, positions, forcefield)
    listed = np.array([atom.index for atom in topology.atoms() if atom.element is not None])
    if len(listed) != pdb.topology.getNumAtoms():
        listed = np.arange(topology.getNumAtoms())
    return Box(topology, positions, pme_system(topology, forcefield), choice, listed)


def shipped_box(name: str = DEFAULT_BOX) -> Path:
    """One of the project's own boxes.

    Raises:
        ForceFieldError: it did not come with this installation.
    """
    for directory in SHIPPED:
        if (directory / name).is_file():
            return directory / name
    raise ForceFieldError(f"the box {name} did not come with this installation; name a PDB file")


def make_whole(positions, topology) -> np.ndarray:
    """Positions (N, 3) in nm, every atom at the periodic image that is nearest to the first one of its residue."""
    box = topology.getPeriodicBoxVectors()
    if box is None:
        return positions
    first = np.array([next(atom.residue.atoms()).index for atom in topology.atoms()])
    arms = positions - positions[first]
    for vector in reversed(np.array(box.value_in_unit(unit.nanometer))):
        # In OpenMM's reduced form the last non-zero component of a vector is its own.
        axis = int(np.flatnonzero(vector)[-1])
        arms = arms - np.outer(np.round(arms[:, axis] / vector[axis]), vector)
    return positions[first] + arms


def _narrowest_width(box) -> float:
    """Smallest width in nm of a box in OpenMM's reduced form: a along x, b in the xy plane."""
    lengths = np.array(box.value_in_unit(unit.nanometer))
    return float(np.diag(lengths).min())


def describe(box: Box) -> str:
    """Size and treatment of the interactions, in words."""
    vectors = box.topology.getPeriodicBoxVectors()
    residues = f"{box.topology.getNumResidues()} residues"
    if vectors is None:
        return f"{residues} without a periodic box, no cut-off"
    edges = np.linalg.norm(np.array(vectors.value_in_unit(unit.nanometer)), axis=1)
    cutoff = next(f.getCutoffDistance() for f in box.system.getForces() if isinstance(f, openmm.NonbondedForce))
    return (
        f"{residues} in {' x '.join(f'{edge:.4f}' for edge in edges)} nm, "
        f"PME with a cut-off of {cutoff.value_in_unit(unit.nanometer):.3g} nm"
    )


def first_line(error: BaseException) -> str:
    """An error's message on one line."""
    return " ".join(str(error).split()) or type(error).__name__
