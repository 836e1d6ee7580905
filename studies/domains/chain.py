"""Chains of rigid domains on flexible linkers with one bead per residue, similar to CALVADOS.

Ashbaugh-Hatch and Debye-Hückel interactions and bonds with the parameters of CALVADOS 2 (G. Tesei and K. Lindorff-
Larsen, Open Research Europe 2, 94 (2022)); domains with an elastic network as in F. Cao et al., Protein Science 33,
e5172 (2024): bonds, and springs of 700 kJ/mol/nm^2 up to 0.9 nm. Each chain has 120 residues: two domains, which are
bundles of three helices EAAAKEAAAK, and tails and a linker that are rich in glycine and serine.
"""

from __future__ import annotations

import itertools
import math
import string
from dataclasses import replace
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit
from scipy.optimize import brentq

from studies.domains.models import (
    INTERACTIONS,
    JOINTS,
    LINKERS,
    Model,
    Pair,
    exclude,
    nearer,
    pairs_within,
    springs,
    with_force,
)

#: By residue: mass in dalton, charge, sigma in nm, lambda.
RESIDUES = {
    "A": (71.07, 0, 0.504, 0.2743297969040348),
    "E": (129.11, -1, 0.592, 0.0006935460962935),
    "G": (57.05, 0, 0.450, 0.7058843733666401),
    "K": (128.17, 1, 0.636, 0.1790211738990582),
    "S": (87.08, 0, 0.518, 0.4625416811611541),
}

NAMES = {"A": "ALA", "E": "GLU", "G": "GLY", "K": "LYS", "S": "SER"}

DOMAIN = "EAAAKEAAAKGSGEAAAKEAAAKGSGEAAAKEAAAK"
TAIL = "GSAGSEGSKGSA"
SEQUENCE = TAIL + DOMAIN + 2 * TAIL + DOMAIN + TAIL
STARTS = (len(TAIL), 3 * len(TAIL) + len(DOMAIN))

#: Bonds: nm and kJ/mol/nm^2. Ashbaugh-Hatch: kJ/mol, and nm of the cut-off.
LENGTH, STIFFNESS = 0.38, 8033.0
EPSILON, NEAR = 0.8368, 2.0

#: Bonds as fast as those of atoms, in another model: kJ/mol/nm^2, and the mass in dalton with which they have a period
#: of 30 fs.
STIFF, CARBON = 2.6e5, 12.0

#: Debye-Hückel at 300 K and 150 mM: kJ/mol nm over the permittivity of water, the Debye length, and the cut-off, nm.
COULOMB, DEBYE, FAR = 138.935458 / 77.7, 0.787, 4.0

#: The elastic network of domains: kJ/mol/nm^2 and nm.
NETWORK, REACH = 700.0, 0.9

#: A helix by residue: nm along it, nm about it, radians. Helices of a domain are this far apart, nm.
RISE, RADIUS, TURN, APART = 0.15, 0.23, math.radians(100), 1.0

#: Residues of each helix and of each loop of a domain.
HELIX, LOOP = 10, 3

#: nm, edge of the periodic box. Two chains start as far apart as they can, and move by less than 2 nm in 2 ns with a
#: friction of 1/ps: they do not meet. A run in which they did would remember it to its end.
EDGE = 24.0

ASHBAUGH_HATCH = """
    select(step(r - 2^(1/6)*sigma), lambda*lj, lj + epsilon*(1 - lambda)) - lambda*4*epsilon*(cut^12 - cut^6);
    lj = 4*epsilon*((sigma/r)^12 - (sigma/r)^6); cut = sigma/rc;
    sigma = (sigma1 + sigma2)/2; lambda = (lambda1 + lambda2)/2
"""


def domain() -> np.ndarray:
    """Positions (36, 3) in nm of a bundle of three helices, joined by arcs."""
    centres = APART * np.array([[0, 0], [1, 0], [0.5, math.sqrt(0.75)]])
    helices = []
    for number, centre in enumerate(centres):
        along = RISE * np.arange(HELIX)
        angle = TURN * np.arange(HELIX) + 2 * math.pi / 3 * number
        around = centre + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        helix = np.column_stack([around, along])
        helices.append(helix if number % 2 == 0 else helix[::-1])
    pieces = [helices[0]]
    for number, helix in enumerate(helices[1:]):
        outwards = np.array([0, 0, 1.0 if number % 2 == 0 else -1.0])
        pieces += [arc(pieces[-1][-1], helix[0], outwards), helix]
    return np.concatenate(pieces)


def arc(start: np.ndarray, end: np.ndarray, outwards: np.ndarray) -> np.ndarray:
    """`LOOP` points (3 numbers each) on an arc of a circle between two points, with a bond's length between neighbours.

    Chords that span the angle w each are 2 R sin(w/2) long, and the ends of n of them 2 R sin(n w/2) apart.
    """
    chords = LOOP + 1
    across = end - start
    gap = float(np.linalg.norm(across))
    widest = 2 * math.pi / chords
    angle = brentq(lambda w: math.sin(chords * w / 2) / math.sin(w / 2) - gap / LENGTH, 1e-6, widest)
    radius = LENGTH / (2 * math.sin(angle / 2))
    along = across / gap
    away = outwards - along * (outwards @ along)
    away /= np.linalg.norm(away)
    angles = angle * (np.arange(1, chords)[:, None] - chords / 2)
    lift = radius * (np.cos(angles) - math.cos(chords * angle / 2))
    return (start + end) / 2 + radius * np.sin(angles) * along + lift * away


def one_chain() -> np.ndarray:
    """Positions (120, 3) in nm: tails and linker are zigzags along z, which enter a domain below and leave it above."""
    places = np.empty((len(SEQUENCE), 3))
    shape = domain() - domain()[0]
    at = np.zeros(3)
    number = 0
    while number < len(SEQUENCE):
        if number in STARTS:
            places[number : number + len(DOMAIN)] = shape + at
            number += len(DOMAIN)
            at = places[number - 1] + LENGTH * np.array([0, 0, 1.0])
        else:
            places[number] = at
            number += 1
            at = at + LENGTH * np.array([0.28 * (-1) ** number, 0, 0.96])
    return places


def model(chains: int = 2) -> Model:
    """Return chains along the diagonal of a periodic box at 300 K."""
    places = EDGE / chains * (np.arange(chains) + 0.5)
    return _model("two chains of 120 residues", np.column_stack([places] * 3))


def sheet(edge: int) -> Model:
    """Return a square of chains in the same box, for timings of larger Systems."""
    places = EDGE / edge * (np.arange(edge) + 0.5)
    centres = np.array([[x, y, EDGE / 2] for x in places for y in places])
    return _model(f"{edge * edge} chains of 120 residues", centres)


def _model(name: str, centres: np.ndarray) -> Model:
    """Return chains about centres, (n, 3) in nm.

    With springs, pairs of a domain that no spring joins interact, as they do in models with elastic networks.
    """
    chains = len(centres)
    single = one_chain() - one_chain().mean(axis=0)
    places = np.concatenate([single + centre for centre in centres])
    firsts = [chain * len(SEQUENCE) for chain in range(chains)]
    molecules = [list(range(first, first + len(SEQUENCE))) for first in firsts]
    bodies = [list(range(first + at, first + at + len(DOMAIN))) for first in firsts for at in STARTS]
    inside = pairs_within(bodies)
    bonds = {pair for molecule in molecules for pair in itertools.pairwise(molecule)}
    network = dict.fromkeys(nearer(inside, places, REACH), NETWORK) | dict.fromkeys(bonds & inside, STIFFNESS)
    rigid = _system(chains, bonds - inside, bonds | inside, bodies)
    elastic = with_force(_system(chains, bonds - inside, bonds | set(network), bodies), springs(places, network))
    return Model(name, rigid, elastic, places, bodies, molecules)


def stiff_model() -> Model:
    """The same chains with bonds as fast as those of atoms, and beads as heavy as carbon."""
    network = model()
    system = openmm.XmlSerializer.clone(network.rigid)
    for bead in range(system.getNumParticles()):
        system.setParticleMass(bead, CARBON)
    for force in system.getForces():
        if force.getName() in (LINKERS, JOINTS):
            for number in range(force.getNumBonds()):
                one, other, length, _ = force.getBondParameters(number)
                force.setBondParameters(number, one, other, length, STIFF)
    return replace(network, name="two chains with stiff bonds", rigid=system, network=None)


def _system(chains: int, bonds: set[Pair], left_out: set[Pair], bodies: list[list[int]]) -> openmm.System:
    """Chains with bonds, and with interactions of all pairs but for those left out."""
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors([EDGE, 0, 0], [0, EDGE, 0], [0, 0, EDGE])
    linkers, joints = openmm.HarmonicBondForce(), openmm.HarmonicBondForce()
    linkers.setName(LINKERS)
    joints.setName(JOINTS)
    domains = {bead for body in bodies for bead in body}
    for pair in sorted(bonds):
        (joints if domains & set(pair) else linkers).addBond(*pair, LENGTH, STIFFNESS)
    contacts, charges = contact_force(), charge_force()
    for residue in chains * SEQUENCE:
        mass, charge, sigma, strength = RESIDUES[residue]
        system.addParticle(mass)
        contacts.addParticle([sigma, strength])
        charges.addParticle([charge])
    for force in (contacts, charges):
        exclude(force, left_out)
        force.setForceGroup(INTERACTIONS)
    for force in (linkers, joints, contacts, charges):
        system.addForce(force)
    return system


def topology(chains: int = 2) -> app.Topology:
    """The chains with residues of one bead, numbered from 1."""
    result = app.Topology()
    for name in string.ascii_uppercase[:chains]:
        chain = result.addChain(name)
        beads = []
        for number, letter in enumerate(SEQUENCE, 1):
            residue = result.addResidue(NAMES[letter], chain, str(number))
            beads.append(result.addAtom("CA", None, residue))
        for first, second in itertools.pairwise(beads):
            result.addBond(first, second)
    result.setPeriodicBoxVectors(EDGE * np.eye(3) * unit.nanometer)
    return result


def write(folder: Path, chains: int = 2) -> None:
    """Write the model as users have theirs: chain.pdb, and system.xml with the bonds within domains.

    They do nothing, but tell programs that write trajectories which atoms are one molecule.
    """
    network = model(chains)
    inside = pairs_within(network.bodies) & {
        pair for molecule in network.chains for pair in itertools.pairwise(molecule)
    }
    system = with_force(network.rigid, springs(network.positions, dict.fromkeys(inside, STIFFNESS)))
    with (folder / "chain.pdb").open("w") as file:
        app.PDBFile.writeFile(topology(chains), network.positions * unit.nanometer, file)
    (folder / "system.xml").write_text(openmm.XmlSerializer.serialize(system))


def contact_force() -> openmm.CustomNonbondedForce:
    """The Ashbaugh-Hatch interaction, zero at its cut-off."""
    force = openmm.CustomNonbondedForce(" ".join(ASHBAUGH_HATCH.split()))
    force.setName("contacts")
    for name in ("sigma", "lambda"):
        force.addPerParticleParameter(name)
    force.addGlobalParameter("epsilon", EPSILON)
    force.addGlobalParameter("rc", NEAR)
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(NEAR)
    return force


def charge_force() -> openmm.CustomNonbondedForce:
    """The Debye-Hückel interaction, zero at its cut-off."""
    force = openmm.CustomNonbondedForce("coulomb*charge1*charge2*(exp(-r/debye)/r - exp(-far/debye)/far)")
    force.setName("charges")
    force.addPerParticleParameter("charge")
    for name, value in (("coulomb", COULOMB), ("debye", DEBYE), ("far", FAR)):
        force.addGlobalParameter(name, value)
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(FAR)
    return force
