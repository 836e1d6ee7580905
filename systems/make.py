#!/usr/bin/env python3
"""Make boxes of liquid water, pure or with salt, at a temperature and an imposed density.

    python make.py                                            the files that are shipped
    python make.py --model tip4p --molecules 512              one of them
    python make.py --model tip3p --salt 0.5 --molecules 1000  0.5 mol of NaCl in a kg of water

The molecules are set on a lattice in a box of the wanted density, with random orientations, and are then melted and
equilibrated at constant volume. The PDB file holds the real atoms and names the force field, which adds virtual sites.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import RigidBodies
from openmm_sier.dynamics.constants import GRAM_PER_CM3
from openmm_sier.inputs import forcefields

HERE = Path(__file__).parent
KG_PER_MOL = 0.0180153  #: water


@dataclass(frozen=True)
class Model:
    """Force-field files for pure water and, where there is one, for water with Na+ and Cl-."""

    pure: str
    with_ions: str | None = None


MODELS = {
    "spce": Model("spce.xml", "amber14/spce.xml"),
    "tip3p": Model("tip3p.xml", "amber14/tip3p.xml"),
    "tip4p": Model("tip4p.xml"),
    "tip4p2005": Model("tip4p2005.xml"),
    "tip5p": Model("tip5p.xml"),
}

#: Model, number of bodies and salt (mol/kg) of the shipped files.
SHIPPED = [(name, 512, 0.0) for name in MODELS] + [("tip4p", 1, 0.0), ("tip3p", 512, 1.0)]

MELTING_TEMPERATURE = 400.0  #: K
STEP = 0.002  #: ps
FRICTION = 1.0  #: 1/ps


# --- densities ---


def water_density(temperature: float) -> float:
    """Density in g/cm^3 of water at 1 atm and a temperature in K (Tanaka et al., Metrologia 38, 301 (2001), Eq. 1)."""
    t = temperature - 273.15
    if not 0 <= t <= 40:
        raise ValueError(
            f"the density of water is known here from 273.15 to 313.15 K, not at {temperature} K; give --density"
        )
    return 0.99997495 * (1 - (t - 3.983035) ** 2 * (t + 301.797) / (522528.9 * (t + 69.34881)))


#: Specific volume in cm^3/g of NaCl in water at 1 bar: rows for 20, 25 and 30 C, columns for the molalities below
#: (P. S. Z. Rogers and K. S. Pitzer, J. Phys. Chem. Ref. Data 11, 15 (1982)). The first column is pure water.
SALT_TEMPERATURES = np.array([293.15, 298.15, 303.15])
SALT_MOLALITIES = np.array([0.1, 0.25, 0.5, 0.75, 1.0, 2.0, 3.0, 4.0, 5.0])
SALT_VOLUMES = np.array(
    [
        [0.997620, 0.991564, 0.981833, 0.972505, 0.963544, 0.930909, 0.902565, 0.877643, 0.855469],
        [0.998834, 0.992832, 0.983185, 0.973932, 0.965038, 0.932590, 0.904339, 0.879457, 0.857301],
        [1.000279, 0.994319, 0.984735, 0.975539, 0.966694, 0.934382, 0.906194, 0.881334, 0.859185],
    ]
)


def salt_water_density(temperature: float, molality: float) -> float:
    """Density in g/cm^3 of NaCl in water; polynomials of degree 2 in temperature and 4 in molality interpolate."""
    if not (SALT_TEMPERATURES[0] <= temperature <= SALT_TEMPERATURES[-1] and 0.1 <= molality <= SALT_MOLALITIES[-1]):
        raise ValueError(
            "the density of NaCl in water is known here from 293.15 to 303.15 K and 0.1 to 5 mol/kg, "
            f"not at {temperature} K and {molality:.3g} mol/kg; give --density"
        )
    volumes = [np.polyval(np.polyfit(SALT_MOLALITIES, row, 4), molality) for row in SALT_VOLUMES]
    return float(1 / np.polyval(np.polyfit(SALT_TEMPERATURES - 298.15, volumes, 2), temperature - 298.15))


def density_at(temperature: float, molality: float) -> float:
    return salt_water_density(temperature, molality) if molality else water_density(temperature)


# --- the start: molecules on a lattice ---


def water_geometry(forcefield) -> np.ndarray:
    """Positions (3, 3) in nm of O, H and H of the force field's rigid water, about the centre of mass."""
    topology = app.Topology()
    add_water(topology, topology.addChain())
    guess = np.array([[0, 0, 0], [0.08, 0.06, 0], [-0.08, 0.06, 0]]) * unit.nanometer
    topology, _ = forcefields.add_virtual_sites(topology, guess, forcefield)
    (water,) = RigidBodies.from_system(forcefields.pme_system(topology, forcefield)).species
    return water.sites.T


def add_water(topology, chain) -> None:
    residue = topology.addResidue("HOH", chain)
    oxygen, *hydrogens = (
        topology.addAtom(name, app.Element.getBySymbol(name[0]), residue) for name in ("O", "H1", "H2")
    )
    for hydrogen in hydrogens:
        topology.addBond(oxygen, hydrogen)


def make_topology(n_waters: int, n_pairs: int):
    """Waters, then n sodium and n chloride ions."""
    topology = app.Topology()
    chain = topology.addChain()
    for _ in range(n_waters):
        add_water(topology, chain)
    if n_pairs:
        chain = topology.addChain()
        for symbol in ["Na"] * n_pairs + ["Cl"] * n_pairs:
            topology.addAtom(
                symbol.upper(), app.Element.getBySymbol(symbol), topology.addResidue(symbol.upper(), chain)
            )
    return topology


def lattice(n: int, edge: float, rng) -> np.ndarray:
    """Centres (n, 3) in nm: randomly chosen points of the smallest simple cubic lattice that has enough of them."""
    side = int(np.ceil(round(n ** (1 / 3), 9)))
    points = (np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3) + 0.5) * (edge / side)
    return rng.permutation(points)[:n]


def random_rotations(n: int, rng) -> np.ndarray:
    """Rotation matrices (n, 3, 3), uniform: from unit quaternions with normally distributed components."""
    w, x, y, z = (quaternions := rng.normal(size=(4, n))) / np.linalg.norm(quaternions, axis=0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def start_positions(n_waters: int, n_pairs: int, edge: float, geometry: np.ndarray, rng) -> np.ndarray:
    """Positions in nm of the atoms of `make_topology`."""
    centres = lattice(n_waters + 2 * n_pairs, edge, rng)
    waters = np.einsum("kx,nyx->nky", geometry, random_rotations(n_waters, rng)) + centres[:n_waters, None]
    return np.vstack([waters.reshape(-1, 3), centres[n_waters:]])


# --- melting and equilibration ---


def equilibrate(system, topology, positions, options):
    """Positions (a Quantity) after melting and equilibration at constant volume, whole molecules in the box."""
    integrator = openmm.LangevinMiddleIntegrator(MELTING_TEMPERATURE, FRICTION, STEP)
    integrator.setRandomNumberSeed(options.seed)
    integrator.setConstraintTolerance(1e-6)
    context = openmm.Context(
        system, integrator, openmm.Platform.getPlatformByName("CPU"), {"Threads": str(options.threads)}
    )
    context.setPeriodicBoxVectors(*topology.getPeriodicBoxVectors())
    context.setPositions(positions)
    context.computeVirtualSites()
    openmm.LocalEnergyMinimizer.minimize(context, maxIterations=500)
    context.setVelocitiesToTemperature(MELTING_TEMPERATURE, options.seed)
    integrator.step(round(options.melt / STEP))
    integrator.setTemperature(options.temperature)
    integrator.step(round(options.equilibrate / STEP))
    return context.getState(positions=True, enforcePeriodicBox=True).getPositions()


# --- writing ---


def real_atoms(topology, positions):
    """Topology and positions without the virtual sites."""
    modeller = app.Modeller(topology, positions)
    modeller.delete([atom for atom in modeller.topology.atoms() if atom.element is None])
    return modeller.topology, modeller.positions


def write(path: Path, topology, positions, edge: float | None, remarks: list[str]) -> None:
    with path.open("w") as file:
        file.writelines(f"REMARK  99 {remark}\n" for remark in remarks)
        if edge is not None:
            file.write(f"CRYST1{10 * edge:9.3f}{10 * edge:9.3f}{10 * edge:9.3f}  90.00  90.00  90.00 P 1           1\n")
        app.PDBFile.writeModel(topology, positions, file)
        app.PDBFile.writeFooter(topology, file)


def box_edge(topology, density: float) -> float:
    """Edge in nm of the cubic box, to the 0.001 A that a PDB file has."""
    mass = sum(atom.element.mass.value_in_unit(unit.dalton) for atom in topology.atoms())
    return round(float(np.cbrt(mass / (density * GRAM_PER_CM3))), 4)


def make(name: str, n_bodies: int, salt: float, options) -> Path:
    """Make and write one file.

    Args:
        name: key of `MODELS`.
        n_bodies: water molecules and ions together.
        salt: NaCl, mol in a kg of water.
        options: of the command line.
    """
    file = MODELS[name].with_ions if salt else MODELS[name].pure
    if file is None:
        raise ValueError(f"no force field with ions is known here for {name} water; tip3p and spce have one")
    forcefield = forcefields.load([file], HERE)
    path = options.out or HERE / f"{name}{'-nacl' if salt else ''}-{n_bodies}.pdb"
    if path.exists() and not options.overwrite:
        raise ValueError(f"{path} exists: give another name with --out, or replace it with --overwrite")
    remarks = [f"FORCEFIELD {file}"]
    if n_bodies == 1:
        write(path, make_topology(1, 0), water_geometry(forcefield) * unit.nanometer, None, remarks)
        return path
    n_waters, n_pairs = composition(n_bodies, salt)
    molality = n_pairs / (n_waters * KG_PER_MOL)
    density = options.density or density_at(options.temperature, molality)
    topology, positions, edge = make_liquid(forcefield, n_waters, n_pairs, density, options)
    remarks.append(f"{name} at {options.temperature:g} K and {density:.4f} g/cm3, {n_waters} water molecules")
    remarks += [f"and {n_pairs} NaCl, {molality:.3f} mol/kg"] if salt else []
    remarks.append(f"equilibrated for {options.equilibrate:g} ps at constant volume, seed {options.seed}")
    write(path, topology, positions, edge, remarks)
    return path


def composition(n_bodies: int, salt: float) -> tuple[int, int]:
    """Numbers of water molecules and of ion pairs that come nearest to a molality."""
    n_pairs = round(n_bodies / (1 / (salt * KG_PER_MOL) + 2)) if salt else 0
    if salt and not n_pairs:
        raise ValueError(f"{n_bodies} molecules and ions are too few for {salt} mol/kg of salt")
    return n_bodies - 2 * n_pairs, n_pairs


def make_liquid(forcefield, n_waters: int, n_pairs: int, density: float, options):
    """Topology, equilibrated positions and box edge (nm) of a liquid, without virtual sites."""
    topology = make_topology(n_waters, n_pairs)
    edge = box_edge(topology, density)
    topology.setUnitCellDimensions([edge] * 3 * unit.nanometer)
    rng = np.random.default_rng(options.seed)
    positions = start_positions(n_waters, n_pairs, edge, water_geometry(forcefield), rng) * unit.nanometer
    topology, positions = forcefields.add_virtual_sites(topology, positions, forcefield)
    positions = equilibrate(forcefields.pme_system(topology, forcefield), topology, positions, options)
    return *real_atoms(topology, positions), edge


# --- the command line ---


def parse(arguments):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", choices=sorted(MODELS), help="water model; without one, all shipped files are made")
    parser.add_argument("--molecules", type=int, default=512, help="number of molecules and ions (default: 512)")
    parser.add_argument("--salt", type=float, default=0.0, help="NaCl, mol in a kg of water (default: 0)")
    parser.add_argument("--temperature", type=float, default=297.0, help="K (default: 297)")
    parser.add_argument("--density", type=float, help="g/cm3 (default: that of experiment)")
    parser.add_argument("--melt", type=float, default=20.0, help="ps at 400 K before that (default: 20)")
    parser.add_argument("--equilibrate", type=float, default=150.0, help="ps after melting (default: 150)")
    parser.add_argument("--seed", type=int, default=1, help="of lattice, orientations and thermostat (default: 1)")
    parser.add_argument("--threads", type=int, default=2, help="of OpenMM's CPU platform (default: 2)")
    parser.add_argument("--out", type=Path, help="PDB file (default: beside this program, named after the contents)")
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")
    return parser.parse_args(arguments)


def main(arguments=None) -> int:
    options = parse(arguments)
    wanted = [(options.model, options.molecules, options.salt)] if options.model else SHIPPED
    try:
        for name, n_bodies, salt in wanted:
            print(make(name, n_bodies, salt, options))
    except ValueError as error:
        print(f"make.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
