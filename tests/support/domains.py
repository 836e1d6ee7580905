"""Chains of beads with rigid domains, in the manner of coarse-grained models of proteins."""

from collections.abc import Sequence

import numpy as np
import openmm
from openmm import app

from openmm_sier import RigidBodies, select_bodies

#: Beads of a chain, and the residues of its two domains.
BEADS = 40
DOMAINS = ("2-13", "24-37")

#: A bond as in models of one bead a residue: nm, kJ/mol/nm^2.
LENGTH, STRENGTH = 0.38, 8033.0

#: With the mass of carbon, dalton, and this, kJ/mol/nm^2, bonds have a period of 30 fs, as those of atoms.
CARBON, STIFF = 12.0, 2.6e5


def topology_of(chains: int = 1) -> app.Topology:
    """Chains A, B and so on, of residues from 1."""
    topology = app.Topology()
    for number in range(chains):
        chain = topology.addChain("ABCDEFGH"[number])
        previous = None
        for residue in range(1, BEADS + 1):
            atom = topology.addAtom("CA", None, topology.addResidue("GLY", chain, str(residue)))
            if previous is not None:
                topology.addBond(previous, atom)
            previous = atom
    return topology


def folded(chains: int = 1, apart: float = 4.0) -> np.ndarray:
    """Positions of chains whose domains are compact: walks on a lattice with the distance of bonds, (N, 3), nm."""
    places = []
    for chain in range(chains):
        x, y, z = 0, 0, 0
        for bead in range(BEADS):
            places.append((x * LENGTH, y * LENGTH + chain * apart, z * LENGTH))
            # To and fro in layers of three, so that beads far apart along the chain are near.
            if bead % 3 == 2:
                y += 1 if bead % 18 < 9 else -1
                if bead % 9 == 8:
                    z += 1
                    y += -1 if bead % 18 < 9 else 1
            else:
                x += 1 if (bead // 3) % 2 == 0 else -1
    noise = np.random.default_rng(4).normal(scale=0.015, size=(len(places), 3))
    return np.array(places) + noise


def domain_system(
    chains: int = 1,
    cut_off: float | None = 1.2,
    box: float | None = None,
    elastic: bool = True,
    mass: float = 110.0,
    strength: float = STRENGTH,
) -> openmm.System:
    """Beads of a mass with charges and a short-range attraction, bonds of a strength along chains, angles and torsions.

    Without `elastic` there are no bonded terms within domains. A CustomNonbondedForce and a NonbondedForce exclude
    neighbours; the NonbondedForce has exceptions, weakened, for those two bonds apart.
    """
    rng = np.random.default_rng(7)
    system = openmm.System()
    charged = openmm.NonbondedForce()
    sticky = openmm.CustomNonbondedForce("strength*(lambda1+lambda2)*((size/r)^12-(size/r)^6); size=0.5*(size1+size2)")
    sticky.addGlobalParameter("strength", 0.4)
    sticky.addPerParticleParameter("lambda")
    sticky.addPerParticleParameter("size")
    bonds, angles, torsions = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce(), openmm.PeriodicTorsionForce()
    for chain in range(chains):
        first = chain * BEADS
        rng = np.random.default_rng(7)
        for bead in range(BEADS):
            system.addParticle(mass)
            charged.addParticle(rng.choice([-0.5, 0.0, 0.5]), 0.4, 0.3)
            sticky.addParticle([rng.uniform(0.2, 1.0), rng.uniform(0.4, 0.5)])
            at = first + bead
            if bead > 0 and (elastic or not _in_domain(bead - 1, bead)):
                bonds.addBond(at - 1, at, LENGTH, strength)
            if bead > 0:
                charged.addException(at - 1, at, 0, 1, 0)
                sticky.addExclusion(at - 1, at)
            if bead > 1 and (elastic or not _in_domain(bead - 2, bead)):
                angles.addAngle(at - 2, at - 1, at, 2.0, 20.0)
            if bead > 1:
                charged.addException(at - 2, at, 0.01, 0.4, 0.1)
                sticky.addExclusion(at - 2, at)
            if bead > 2 and (elastic or not _in_domain(bead - 3, bead)):
                torsions.addTorsion(at - 3, at - 2, at - 1, at, 1, 0.5, 2.0)
    for force in (charged, sticky):
        if cut_off is not None:
            periodic, open_ = force.CutoffPeriodic, force.CutoffNonPeriodic
            force.setNonbondedMethod(open_ if box is None else periodic)
            force.setCutoffDistance(cut_off)
    sticky.setUseSwitchingFunction(cut_off is not None)
    sticky.setSwitchingDistance(0.8)
    if box is not None:
        system.setDefaultPeriodicBoxVectors([box, 0, 0], [0, box, 0], [0, 0, box])
    for force in (charged, sticky, bonds, angles, torsions):
        system.addForce(force)
    return system


def stiff_chain(
    frozen: Sequence[int] = (), cut_off: float | None = 1.2, box: float | None = None
) -> tuple[openmm.System, RigidBodies, np.ndarray]:
    """A chain with two rigid domains and bonds as fast as those of atoms: System, bodies and positions (N, 3) in nm.

    Beads in `frozen` do not move. Ryckaert and Bellemans' torsions go along the linkers and into the domains.
    """
    topology, positions = topology_of(), folded()
    system = domain_system(cut_off=cut_off, box=box, elastic=False, mass=CARBON, strength=STIFF)
    for bead in frozen:
        system.setParticleMass(bead, 0.0)
    torsions = openmm.RBTorsionForce()
    for i in range(11, 25):
        torsions.addTorsion(i - 2, i - 1, i, i + 1, 1.0, 0.5, -0.3, 0.2, 0.1, -0.1)
    system.addForce(torsions)
    bodies = RigidBodies.from_system(system, topology, select_bodies(topology, descriptions()), positions)
    q, A = bodies.fit(positions)
    return system, bodies, bodies.place(q, A, positions)


def descriptions(chains: Sequence[str] = "A") -> list[str]:
    """The domains of chains, as `select_bodies` takes them."""
    return [f"{chain}:{residues}" for chain in chains for residues in DOMAINS]


def _in_domain(first: int, last: int) -> bool:
    """Return whether beads of a chain, counted from 0, are all in one domain."""
    ends = (tuple(map(int, residues.split("-"))) for residues in DOMAINS)
    return any(start <= first + 1 and last + 1 <= end for start, end in ends)
