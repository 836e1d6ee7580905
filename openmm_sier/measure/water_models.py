"""Water models by their geometry, and recognition of the model in a PDB file.

Rigid water models share few geometries. TIP3P, in Amber's form and in CHARMM's, has that of TIP4P and TIP5P without
their charge sites; SPC has that of SPC/E; OpenMM adds OPC and all other water of four sites in that of TIP4P-Ew. A PDB
file with such a geometry does not identify its model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from openmm import app

#: Coordinates in a PDB file are rounded to this, nm.
PDB_RESOLUTION = 1e-4

#: OpenMM's default constraint tolerance, 1e-5, of the longest distance in a molecule, nm.
CONSTRAINT_ERROR = 2e-6

#: The model whose geometry OpenMM's `Modeller.addSolvent` gives to all water of four sites.
OF_ADDED_WATER = "TIP4P-Ew"


class ForceFieldError(ValueError):
    """No force field can be picked, found or applied."""


class WaterModel(NamedTuple):
    """The geometry by which a water model is recognized.

    Attributes:
        name: as in the literature.
        sites: of one molecule, virtual sites included.
        distances: O-H, H-H and, where there are sites without mass, O-M, nm.
        file: OpenMM's force field with water alone; None where it has none.
        file_with_ions: OpenMM's force field with ions too; None where it has none.
    """

    name: str
    sites: int
    distances: tuple[float, ...]
    file: str | None
    file_with_ions: str | None = None

    def suggestion(self, ions: bool) -> str:
        """The model with the option that names it."""
        file = self.file_with_ions if ions else self.file
        missing = f"OpenMM has no file{' with ions' if ions else ''} for it"
        return f"{self.name} ({f'--forcefield {file}' if file else missing})"


_TIP = (0.09572, 0.15139)
_SPC = (0.1, 0.163298)

#: Geometries are from the force-field files themselves or, for models without a file in OpenMM, from their papers:
#: SPC, Berendsen et al., in Intermolecular Forces, ed. Pullman (1981), 331; TIP4P-D, Piana et al., J. Phys. Chem. B
#: 119, 5113 (2015). Files with the same parameters (amber19, charmm36_2024) are listed once.
WATER_MODELS = (
    WaterModel("TIP3P", 3, _TIP, "tip3p.xml", "amber14/tip3p.xml"),
    WaterModel("TIP3P of CHARMM", 3, _TIP, "charmm36/water.xml", "charmm36/water.xml"),
    WaterModel("SPC/E", 3, _SPC, "spce.xml", "amber14/spce.xml"),
    WaterModel("SPC", 3, _SPC, None),
    WaterModel("OPC3", 3, (0.097888, 0.159851), "opc3.xml", "amber14/opc3.xml"),
    WaterModel("TIP3P-FB", 3, (0.101181, 0.163868), "tip3pfb.xml", "amber14/tip3pfb.xml"),
    WaterModel("TIP4P", 4, (*_TIP, 0.015), "tip4p.xml"),
    WaterModel("TIP4P-Ew", 4, (*_TIP, 0.0125), "tip4pew.xml", "amber14/tip4pew.xml"),
    WaterModel("TIP4P/2005", 4, (*_TIP, 0.01546), "tip4p2005.xml", "charmm36/tip4p2005.xml"),
    WaterModel("TIP4P-D", 4, (*_TIP, 0.01546), None),
    WaterModel("TIP4P-FB", 4, (*_TIP, 0.010527), "tip4pfb.xml", "amber14/tip4pfb.xml"),
    WaterModel("OPC", 4, (0.087243, 0.137121, 0.015940), "opc.xml", "amber14/opc.xml"),
    WaterModel("TIP5P", 5, (*_TIP, 0.07), "tip5p.xml", "charmm36/tip5p.xml"),
    WaterModel("TIP5P-Ew", 5, (*_TIP, 0.07), "charmm36/tip5pew.xml", "charmm36/tip5pew.xml"),
)


def recognize(waters: Sequence[app.topology.Residue], positions: np.ndarray, ions: bool = False) -> WaterModel:
    """The one water model that has the geometry of these molecules.

    Without virtual sites in the file, the geometry of the atoms alone has to identify it.

    Args:
        waters: residues of an openmm.app.Topology, all of them water.
        positions: of all atoms, molecules whole, (N, 3), nm.
        ions: whether there are ions too; messages name files with ions then.

    Raises:
        ForceFieldError: molecules differ or are no water, no known model has their geometry, or several have. The
            message lists the candidates.
    """
    measured = _distances(waters, positions)
    sites = len(list(waters[0].atoms()))
    candidates = [model for model in WATER_MODELS if sites in (3, model.sites)]
    fitting = [model for model in candidates if _fits(measured, model)]
    if sites == 4 and any(model.name == OF_ADDED_WATER for model in fitting):
        fitting = candidates
    if len(fitting) == 1:
        return fitting[0]
    shown = zip(("O-H", "H-H", "O-M"), measured.mean(axis=0), strict=False)
    how_many = "several models" if fitting else "no known model"
    raise ForceFieldError(
        f"the water ({sites} sites, {', '.join(f'{name} {value:.5f}' for name, value in shown)} nm) has the geometry "
        f"of {how_many}: name a force field, that of {', '.join(m.suggestion(ions) for m in fitting or candidates)}"
    )


def _fits(measured: np.ndarray, model: WaterModel) -> bool:
    """Whether distances (n, 2 or 3) are those of a model, up to the rounding of a PDB file.

    A coordinate rounded to d has a variance of d^2/12, so that a distance has the standard deviation d/sqrt(6), 4e-5
    nm, and at most an error of sqrt(3) d. The mean over n molecules is known to 4e-5/sqrt(n) nm, 2e-6 nm for 512, and
    the closest models, TIP4P and TIP4P/2005, are 5e-4 nm apart. Four such errors are allowed. Rounding across the bond
    adds d^2/6r to a distance r on average, 2e-7 nm at most.
    """
    errors = measured - np.array(model.distances[: measured.shape[1]])
    of_mean = 4 * PDB_RESOLUTION / math.sqrt(6 * len(measured)) + CONSTRAINT_ERROR
    of_each = math.sqrt(3) * PDB_RESOLUTION + CONSTRAINT_ERROR
    return bool((np.abs(errors.mean(axis=0)) <= of_mean).all() and (np.abs(errors) <= of_each).all())


def _distances(waters: Sequence[app.topology.Residue], positions: np.ndarray) -> np.ndarray:
    """O-H (mean of both), H-H and, with sites without mass, O-M (mean of all), nm, of each molecule, (n, 2 or 3)."""
    found = []
    for residue in waters:
        places: dict[str, list[np.ndarray]] = {"O": [], "H": [], "M": []}
        for atom in residue.atoms():
            places.setdefault("M" if atom.element is None else atom.element.symbol, []).append(positions[atom.index])
        oxygens, hydrogens, massless, *others = places.values()
        sites = len(oxygens), len(hydrogens), len(massless)
        if others or sites[:2] != (1, 2) or sites[2] > 2 or len(massless) != len(list(waters[0].atoms())) - 3:
            raise ForceFieldError(
                f"residue {residue.name} {residue.id} has the atoms {' '.join(atom.name for atom in residue.atoms())}, "
                "expected water with 3, 4 or 5 sites, the same in all molecules. Are hydrogens missing? Otherwise name "
                "a force field with --forcefield"
            )
        arms = [np.linalg.norm(np.array(group) - oxygens[0], axis=1).mean() for group in (hydrogens, massless) if group]
        found.append([arms[0], np.linalg.norm(hydrogens[1] - hydrogens[0]), *arms[1:]])
    return np.array(found)
