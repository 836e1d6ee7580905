"""Samples of a liquid of rigid molecules from the trajectory of a run: centres, orientations and dipoles."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import mdtraj
import numpy as np
import openmm
from openmm import unit

from openmm_sier.measure.forcefields import Box
from openmm_sier.measure.pdb_files import box_vectors

#: Unit of charges.
CHARGE = unit.elementary_charge

#: Frames read at a time.
CHUNK = 200

#: Bins of pair distributions in nm.
BIN = 0.002

#: Interval in ps between the frames whose pairs are counted. Frames closer in time are much alike.
APART = 1.0


class LiquidSamples(NamedTuple):
    """Frames of a trajectory.

    Attributes:
        interval: ps between frames.
        centres: (n, m, 3), nm, of the molecules' first atoms, unwrapped, without their mean motion.
        directions: (n, m, 3), unit vectors from the second atom to the third, H to H in water.
        dipoles: (n, 3) of the box, e nm; None where molecules are charged, since it then depends on their images.
        volumes: (n,), nm^3.
        distances: (b,), nm, middles of the bins of pair distances.
        pairs_by_frame: (k, b), radial distribution of the first atoms in k frames, `APART` or more from each other.
    """

    interval: float
    centres: np.ndarray
    directions: np.ndarray
    dipoles: np.ndarray | None
    volumes: np.ndarray
    distances: np.ndarray
    pairs_by_frame: np.ndarray

    @property
    def pairs(self) -> np.ndarray:
        """(b,), radial distribution of the first atoms."""
        return self.pairs_by_frame.mean(axis=0)


class NoLiquidError(ValueError):
    """A box is not one of a periodic liquid of one kind of molecule with three atoms or more."""


def read_samples(trajectory: Path, box: Box, interval: float, skip: float = 0.0) -> LiquidSamples:
    """Read a trajectory of whole molecules.

    Args:
        trajectory: .dcd or .xtc.
        box: the PDB file; the trajectory has the atoms that it lists.
        interval: ps between frames.
        skip: ps to leave out at the beginning.

    Raises:
        NoLiquidError: see `molecules_of_liquid`.
        ValueError: there is no frame, or a position or an edge of the box is not finite.
        OSError: the file cannot be read.
    """
    topology = mdtraj.Topology.from_openmm(box.topology).subset(box.listed)
    first, box_edges = molecules_of_liquid(box)
    frames, pairs = [], []
    stride, first_frame, done = max(1, round(APART / interval)), round(skip / interval), 0
    dipole_of = _dipole_of(box)
    chosen = topology.select_pairs(first[:512], first)
    # All runs need the same bins, and their boxes may become smaller than that of the PDB file.
    reach = min(1.0, 0.45 * float(box_edges.min()))
    for chunk in read_chunks(trajectory, topology, first_frame):
        finite = np.isfinite(chunk.xyz).all(axis=(1, 2)) & np.isfinite(chunk.unitcell_lengths).all(axis=1)
        if not finite.all():
            number = first_frame + done + int(np.flatnonzero(~finite)[0]) + 1
            raise ValueError(f"{trajectory}, frame {number}: a position or an edge of the box is not finite")
        arms = (chunk.xyz[:, first + 2] - chunk.xyz[:, first + 1]).astype(float)
        directions = arms / np.linalg.norm(arms, axis=2, keepdims=True)
        dipoles = np.array([] if dipole_of is None else [dipole_of(positions) for positions in chunk.xyz])
        frames.append((chunk.xyz[:, first].astype(float), chunk.unitcell_lengths.astype(float), directions, dipoles))
        for counted in range(-done % stride, len(chunk), stride):
            distances, found = mdtraj.compute_rdf(chunk[counted], chosen, r_range=(0.0, reach), bin_width=BIN)
            pairs.append(found)
        done += len(chunk)
    if not frames:
        raise ValueError(f"{trajectory} has no frames after {skip:g} ps")
    centres, edges, directions, dipoles = map(np.concatenate, zip(*frames, strict=True))
    centres, volumes = unwrapped(centres, edges), edges.prod(axis=1)
    given = None if dipole_of is None else dipoles
    return LiquidSamples(interval, centres, directions, given, volumes, distances, np.array(pairs))


@contextmanager
def quietly() -> Iterator[None]:
    """Without the lines that MDTraj's reader of DCD files prints, which is not written in Python."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def read_chunks(trajectory: Path, topology: mdtraj.Topology, skip: int = 0) -> Iterator[mdtraj.Trajectory]:
    """Frames of a trajectory, some at a time, without the lines that MDTraj's reader of DCD files prints."""
    chunks = mdtraj.iterload(str(trajectory), chunk=CHUNK, skip=skip, top=topology)
    while True:
        with quietly():
            chunk = next(chunks, None)
        if chunk is None:
            return
        yield chunk


def molecules_of_liquid(box: Box) -> tuple[np.ndarray, np.ndarray]:
    """The first atom of each molecule among the listed ones, (m,), and the edges of the box, (3,), nm.

    Raises:
        NoLiquidError: there is more than one kind of molecule, or one of less than three atoms, or no rectangular
            periodic box.
    """
    if (lengths := box_vectors(box.topology)) is None:
        raise NoLiquidError("there is no periodic box")
    edges = np.diag(lengths)
    if (lengths != np.diag(edges)).any():
        raise NoLiquidError("the box is not rectangular: its molecules cannot be followed through it")
    topology = mdtraj.Topology.from_openmm(box.topology).subset(box.listed)
    kinds = sorted({residue.name for residue in topology.residues})
    if len(kinds) > 1 or min(residue.n_atoms for residue in topology.residues) < 3:
        shown = ", ".join(kinds[:8]) + (", ..." if len(kinds) > 8 else "")
        raise NoLiquidError(f"the box is not one of one kind of molecule with three atoms or more, but has {shown}")
    return np.array([residue.atom(0).index for residue in topology.residues]), edges


def unwrapped(wrapped: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Positions (n, m, 3) followed through the faces of rectangular boxes of edges (n, 3), without the mean motion.

    Each step is the shortest one in the box at its end, which keeps diffusion correct where the box changes.

    Source: von Bülow, Bullerjahn and Hummer, J. Chem. Phys. 153, 021101 (2020).
    """
    steps = np.diff(wrapped, axis=0)
    now = edges[1:, None]
    steps -= now * np.round(steps / now)
    steps -= steps.mean(axis=1, keepdims=True)
    return np.concatenate([wrapped[:1], wrapped[:1] + np.cumsum(steps, axis=0)])


def _dipole_of(box: Box) -> Callable[[np.ndarray], np.ndarray] | None:
    """What gives the dipole (3,), e nm, of the listed particles' positions (l, 3); None where molecules are charged."""
    force = next(f for f in box.system.getForces() if isinstance(f, openmm.NonbondedForce))
    n = box.system.getNumParticles()
    charges = np.array([force.getParticleParameters(i)[0].value_in_unit(CHARGE) for i in range(n)])
    owners = [atom.residue.index for atom in box.topology.atoms()]
    if np.abs(np.bincount(owners, charges)).max() >= 1e-6:
        return None
    if len(box.listed) == n:
        return lambda positions: charges @ positions.astype(float)
    # A trajectory may leave virtual sites out.
    bare = openmm.XmlSerializer.clone(box.system)
    for number in reversed(range(bare.getNumForces())):
        bare.removeForce(number)
    reference = openmm.Platform.getPlatformByName("Reference")
    context = openmm.Context(bare, openmm.VerletIntegrator(0.001), reference)

    def found(positions: np.ndarray) -> np.ndarray:
        places = np.zeros((n, 3))
        places[box.listed] = positions
        context.setPositions(places)
        context.computeVirtualSites()
        return charges @ context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)

    return found
