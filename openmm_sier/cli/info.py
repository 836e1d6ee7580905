"""The command `openmm-sier info`: the rigid bodies and points of an input."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import openmm
from openmm import app

from openmm_sier.cli.console import note, table
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.simulated_system import with_rigid_bodies
from openmm_sier.dynamics.index_ranges import MAX_LISTED
from openmm_sier.dynamics.species import Species
from openmm_sier.inputs.forcefields import Box, density_of
from openmm_sier.inputs.inputs import read_input
from openmm_sier.inputs.pdb_files import box_vectors, extent
from openmm_sier.system.find_bodies import RigidBodies

#: Moments that differ by less than this fraction of the largest are called equal.
EQUAL = 1e-6

#: Names of tops: whether the two lower moments are equal, and the two upper ones.
TOPS = {(True, True): "spherical", (True, False): "oblate", (False, True): "prolate", (False, False): "asymmetric"}

COLUMNS = ("residues", "number", "atoms", "virtual sites", "mass", "moments of inertia", "kind", "freedoms")


def execute(options: Mapping[str, Any]) -> None:
    """Print the kinds of rigid body and of point of an input, masses in dalton and moments in dalton nm^2.

    Args:
        options: of the user by name, see `RunSettings`.

    Raises:
        RunError: a setting has no effect with the topology.
        ForceFieldError, RigidityError, OSError: as their messages say.
    """
    if "box" not in options:
        raise Misused("info needs BOX, a file of coordinates (see openmm-sier info --help)")
    settings = new_settings(options)
    box = read_input(settings.box, settings.topology, settings.forcefield, settings.constraints, edges=settings.edges)
    box, bodies = with_rigid_bodies(box, settings.rigid)
    atoms = list(box.topology.atoms())
    sites = _virtual_sites(box.system, bodies)
    rows = [_row(species, atoms, sites) for species in bodies.species]
    table(f"{settings.box}, {' '.join(box.files)} ({box.reason})", COLUMNS, rows)
    points = int(np.count_nonzero(bodies.point_particles))
    counts = f"{bodies.n - points} rigid bodies" if bodies.n > points else ""
    if points:
        counts += f"{', ' if counts else ''}{points} points (atoms that move by themselves)"
    counts += f", {bodies.n_particles} particles, {bodies.dof} degrees of freedom"
    if count := len(bodies.constraints.pairs):
        counts += f", {count} constraints between points"
    note(counts + _extent(box))


def _row(species: Species, atoms: Sequence[app.topology.Atom], sites: dict[int, list[int]]) -> list[str]:
    first = species.atoms[0]
    names = Counter(atoms[i].residue.name for i in species.atoms[:, 0])
    return [
        " ".join(names),
        str(len(species.atoms)),
        " ".join(atoms[i].name for i in first) if len(first) <= MAX_LISTED else f"{len(first)} atoms",
        " ".join(atoms[i].name for i in sites.get(int(first[0]), [])) or "-",
        f"{species.mass:.4f}",
        " ".join(f"{moment:.6f}" for moment in species.moments) if species.moments.any() else "-",
        kind(species.moments),
        str(species.dof),
    ]


def kind(moments: np.ndarray) -> str:
    """Return the name of a top with these ascending moments."""
    low, middle, high = moments
    if high == 0:
        return "point"
    if low == 0:
        return "linear"
    equal = middle - low < EQUAL * high, high - middle < EQUAL * high
    return f"{TOPS[equal]} top"


def _virtual_sites(system: openmm.System, bodies: RigidBodies) -> dict[int, list[int]]:
    """Return virtual sites that depend on the atoms of a body, by the first atom of the body."""
    body_of = {int(i): int(members[0]) for species in bodies.species for members in species.atoms for i in members}
    sites: dict[int, list[int]] = {}
    for i in range(system.getNumParticles()):
        if system.isVirtualSite(i):
            sites.setdefault(body_of[system.getVirtualSite(i).getParticle(0)], []).append(i)
    return sites


def _extent(box: Box) -> str:
    if (vectors := box_vectors(box.topology)) is None:
        return ", no periodic box"
    return f", box {extent(vectors)}, {density_of(box):.3f} g/ml"
