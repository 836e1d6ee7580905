"""The command `openmm-sier info`: the rigid bodies and points of an input."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from openmm import app

from openmm_sier.cli.console import note, table
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.settings import InputSettings
from openmm_sier.cli.simulated_system import with_rigid_bodies
from openmm_sier.dynamics.index_ranges import MAX_LISTED
from openmm_sier.dynamics.species import Species
from openmm_sier.inputs.forcefields import Box, density_of
from openmm_sier.inputs.inputs import read_input
from openmm_sier.inputs.pdb_files import box_vectors, extent

COLUMNS = ("residues", "number", "atoms", "mass", "moments of inertia", "freedoms")


def execute(given: InputSettings) -> None:
    """Print the kinds of rigid body and of point of an input, masses in dalton and moments in dalton nm^2.

    Args:
        given: settings that the user chose, and defaults.

    Raises:
        Misused: there are no coordinates, or a setting has no effect with the topology.
        ForceFieldError, RigidityError, OSError: as their messages say.
    """
    settings = new_settings(given)
    box = read_input(settings.box, settings.topology, settings.forcefield, settings.constraints, edges=settings.edges)
    box, bodies = with_rigid_bodies(box, settings.rigid)
    atoms = list(box.topology.atoms())
    rows = [_row(species, atoms) for species in bodies.species]
    table(f"{settings.box}, {' '.join(box.files)} ({box.reason})", COLUMNS, rows)
    points = int(np.count_nonzero(bodies.point_particles))
    rigid = bodies.n - points
    counts = f"{rigid} rigid {'body' if rigid == 1 else 'bodies'}" if rigid else ""
    if points:
        counts += f"{', ' if counts else ''}{points} points (atoms that move by themselves)"
    counts += f", {bodies.n_particles} particles, {bodies.dof} degrees of freedom"
    if count := len(bodies.constraints.pairs):
        counts += f", {count} constraints between points"
    note(counts + _extent(box))


def _row(species: Species, atoms: Sequence[app.topology.Atom]) -> list[str]:
    first = species.atoms[0]
    names = Counter(atoms[i].residue.name for i in species.atoms[:, 0])
    return [
        " ".join(names),
        str(len(species.atoms)),
        " ".join(atoms[i].name for i in first) if len(first) <= MAX_LISTED else f"{len(first)} atoms",
        f"{species.mass:.4f}",
        " ".join(f"{moment:.6f}" for moment in species.moments) if species.moments.any() else "-",
        str(species.dof),
    ]


def _extent(box: Box) -> str:
    if (vectors := box_vectors(box.topology)) is None:
        return ", no periodic box"
    return f", box {extent(vectors)}, {density_of(box):.3f} g/ml"
