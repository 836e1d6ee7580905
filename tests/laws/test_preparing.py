"""Preparing changes nothing but what it says: energies, forces, bodies and masses are as before."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import openmm
import pytest
from hypothesis import strategies as st
from scipy.special import erfc

from openmm_sier import RigidBodies, balance_pme, prepare_system
from openmm_sier.prepare.masses import LIGHTEST_CENTRE
from openmm_sier.system.tables import HEAVIEST_HYDROGEN, HEAVIEST_IN_CHAINS
from tests.laws.law import Law
from tests.laws.mechanics import allowed_motions, constrained_pairs, masses_of
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import HEAVY, Built, Mixture
from tests.laws.molecules import Jointed, WithSite
from tests.laws.readings import clusters, evaluated
from tests.support.waters import force_of

#: Relative to the largest force in the System and to its energy: rounding of the close pairs, which are added to one
#: group and taken from another.
ROUNDING = {"Reference": 1e-9, "CPU": 1e-5, "OpenCL": 1e-5}

#: Number of charges at random places by which sums of PME are judged at least, in boxes that have `DENSITIES` of them.
CHARGES, DENSITIES = 100, (5, 60, 250)

#: Errors of forces by balanced sums may be larger than OpenMM's by this. Those of a hundred charges scatter by a tenth,
#: and in triclinic boxes the formula by which a box is taken for dense is off by up to a quarter.
WORSE = 1.25

#: Largest error of forces by PME at OpenMM's default tolerance, relative to the largest force, which counts as at least
#: that of two unit charges half a cut-off apart, kJ/mol/nm. Terms that are lost or doubled are larger.
PME, LEAST = 5e-3, 1000


@dataclass(frozen=True)
class Preparing:
    """A mixture that is prepared."""

    mixture: Mixture
    platform: str = "Reference"

    def check(self) -> None:
        built = self.mixture.build()
        self._forces_are_as_before(built)
        if "PME" in self.mixture.surroundings and self.mixture.form not in ("none", "inner"):
            self._sums_are_no_worse(built)
        groups_are_as_said(built)
        masses_are_as_said(built)
        bodies_are_as_before(built)
        self._again_is_once(built)

    def _forces_are_as_before(self, built: Built) -> None:
        meshed = "PME" in self.mixture.surroundings
        # In triclinic boxes PME of Reference is off by up to 20 kJ/mol/nm with any mesh.
        is_off = self.mixture.surroundings == "triclinic PME" and self.platform == "Reference"
        (energy, forces), (now, forces_now) = (
            evaluated(system, built.positions, "CPU" if is_off else self.platform)
            for system in (built.plain, built.system)
        )
        close, scale = PME if meshed else ROUNDING[self.platform], np.abs(forces).max() + LEAST
        assert now == pytest.approx(energy, rel=close, abs=close * LEAST), f"energy {now} in place of {energy}"
        worst = np.abs(forces_now - forces).max()
        assert worst < close * scale, f"forces are off by {worst} of {scale} kJ/mol/nm"

    def _sums_are_no_worse(self, built: Built) -> None:
        """Compare forces of the charges at random places, and of more or fewer ones, with a tight sum."""
        force = force_of(built.plain)
        own = np.array([force.getParticleParameters(i)[0]._value for i in range(force.getNumParticles())])
        if any(own):
            before, now = errors_of_sums([probe(system, own) for system in (built.plain, built.system)], own)
            assert now <= WORSE * before, f"error of the sums of PME {now:.3g} kJ/mol/nm, which was {before:.3g}"
        charges = (-1.0) ** np.arange(DENSITIES[self.mixture.seed % 3])
        unbalanced, balanced = probe(built.plain, charges), probe(built.plain, charges)
        balance_pme(balanced, constantEnergy=self.mixture.prepared != "heavy")
        before, now = errors_of_sums([unbalanced, balanced], charges)
        assert now <= WORSE * before, f"error for {len(charges)} charges {now:.3g} kJ/mol/nm, which was {before:.3g}"

    def _again_is_once(self, built: Built) -> None:
        again = openmm.XmlSerializer.clone(built.system)
        result = prepare_system(
            again, built.named or None, hydrogenMass=HEAVY if self.mixture.prepared == "heavy" else None
        )
        assert result == built.preparation
        assert openmm.XmlSerializer.serialize(again) == openmm.XmlSerializer.serialize(built.system)


def probe(system: openmm.System, charges: np.ndarray) -> openmm.System:
    """Return a System with the box and PME of another one, and other charges."""
    force = force_of(system)
    result, copied = openmm.System(), openmm.NonbondedForce()
    for charge in charges:
        copied.addParticle(charge, 1, 0)
        result.addParticle(1.0)
    copied.setNonbondedMethod(force.PME)
    copied.setCutoffDistance(force.getCutoffDistance())
    copied.setEwaldErrorTolerance(force.getEwaldErrorTolerance())
    copied.setPMEParameters(*force.getPMEParameters())
    result.addForce(copied)
    result.setDefaultPeriodicBoxVectors(*system.getDefaultPeriodicBoxVectors())
    return result


def errors_of_sums(systems: list[openmm.System], charges: np.ndarray) -> np.ndarray:
    """Return errors (rms) of the forces on charges at random places in Systems of `probe` with one box, kJ/mol/nm.

    On the CPU platform, since in triclinic boxes PME of Reference is off with any mesh.
    """
    box = np.array([edge._value for edge in systems[0].getDefaultPeriodicBoxVectors()])
    rng = np.random.default_rng(1)
    squares = []
    # The errors are those of the largest charges, of which there may be few.
    alike = (charges**2).sum() ** 2 / (charges**4).sum()
    for _ in range(math.ceil(CHARGES / alike)):
        x = rng.random((len(charges), 3)) @ box
        exact = ewald(box, x, charges)
        squares.append([(evaluated(system, x, "CPU")[1] - exact) ** 2 for system in systems])
    return np.sqrt(np.mean(squares, axis=(0, 2, 3)))


def ewald(box: np.ndarray, x: np.ndarray, charges: np.ndarray) -> np.ndarray:
    """Return forces (N, 3) in kJ/mol/nm on charges in a box of any shape, good to 1e-5 of them.

    The classical sums, whose terms fall to exp(-12) at half of the smallest width of the box and at the largest wave.
    Of a pair only one image is nearer than that: the one with components of less than half an edge.
    """
    inverse = np.linalg.inv(box)
    width = 1 / np.linalg.norm(inverse, axis=0).max()
    alpha = 7 / width
    apart = (x[:, None] - x) @ inverse
    apart = (apart - np.round(apart)) @ box
    r = np.linalg.norm(apart, axis=2)
    r[r == 0] = np.inf
    strength = (erfc(alpha * r) / r + 2 * alpha / np.sqrt(np.pi) * np.exp(-((alpha * r) ** 2))) / r**2
    near = np.einsum("j,ij,ijd->id", charges, strength, apart)
    most = np.ceil(7 * alpha / (2 * np.pi) * np.linalg.norm(box, axis=1)).astype(int)
    counts = np.stack(np.meshgrid(*[np.arange(-m, m + 1) for m in most]), -1).reshape(-1, 3)
    # Of waves of opposite directions, whose forces are the same, one is counted.
    k = 2 * np.pi * counts[len(counts) // 2 + 1 :] @ inverse.T
    k = k[(k**2).sum(axis=1) < (7 * alpha) ** 2]
    weight = 8 * np.pi / abs(np.linalg.det(box)) * np.exp(-(k**2).sum(axis=1) / (4 * alpha**2)) / (k**2).sum(axis=1)
    # Angles of up to 100 are good to 1e-5 in single precision, whose cosines take a tenth of the time.
    angles = (x @ k.T).astype(np.float32)
    cosines, sines = np.cos(angles), np.sin(angles)
    far = (weight * ((charges @ cosines) * sines - (charges @ sines) * cosines)) @ k
    return COULOMB * charges[:, None] * (near + far)


def groups_are_as_said(built: Built) -> None:
    """Forces are the same ones, in their groups or in the fast one, which has no terms on what does not move."""
    fast = built.preparation.fastForceGroups
    assert built.system.getNumForces() >= built.plain.getNumForces()
    for before, now in zip(built.plain.getForces(), built.system.getForces(), strict=False):
        assert type(now) is type(before)
        assert now.getForceGroup() in {before.getForceGroup(), *fast}
    still = {i for i, mass in enumerate(masses_of(built.system)) if not mass}
    for force in built.system.getForces():
        if force.getForceGroup() not in fast:
            continue
        assert not isinstance(force, (openmm.NonbondedForce, openmm.CustomNonbondedForce))
        if isinstance(force, openmm.HarmonicBondForce):
            terms = [force.getBondParameters(k)[:2] for k in range(force.getNumBonds())]
        elif isinstance(force, openmm.HarmonicAngleForce):
            terms = [force.getAngleParameters(k)[:3] for k in range(force.getNumAngles())]
        else:
            continue
        # Terms that move nothing may be in any group.
        mixed = [[built.names[i] for i in term] for term in terms if still & set(term) and not still.issuperset(term)]
        assert not mixed, f"{force.getName()} is fast and acts on {mixed}"


def masses_are_as_said(built: Built) -> None:
    """Each molecule keeps its mass, and hydrogens have the masses of the sentence."""
    before, now = masses_of(built.plain), masses_of(built.system)
    said = [(int(n), float(mass)) for done in built.preparation.done for n, mass in SAID.findall(done)]
    changed = np.flatnonzero(now != before)
    assert len(changed) == 0 or said, f"masses of {[built.names[i] for i in changed]} changed without a word"
    for number in {name.split(",")[0] for name in built.names}:
        molecule = [i for i, name in enumerate(built.names) if name.split(",")[0] == number]
        assert now[molecule].sum() == pytest.approx(before[molecule].sum(), rel=1e-12), number
        if number.startswith("Chain"):
            # Each of its heavy atoms is bonded to another one.
            heavier = now[molecule][now[molecule] > before[molecule]]
            assert (heavier <= HEAVIEST_IN_CHAINS).all(), f"hydrogens of molecule {number} have {heavier} dalton"
        lighter = now[molecule][now[molecule] < before[molecule]]
        assert (lighter >= LIGHTEST_CENTRE - 1e-9).all(), f"atoms of molecule {number} have {lighter} dalton"
    for count, mass in said:
        found = (np.isclose(now, mass, atol=0.006) & (before > 0) & (before < HEAVIEST_HYDROGEN)).sum()
        assert found >= count, f"{found} atoms have {mass} dalton, and {count} is said"


#: kJ nm/mol.
COULOMB = 138.935456

#: In the sentence on masses.
SAID = re.compile(r"(\d+) hydrogens have ([\d.]+) dalton")


def bodies_are_as_before(built: Built) -> None:
    """So are particles, constraints, sites and the box, and degrees of freedom are those of mechanics."""
    plain, system, n = built.plain, built.system, len(built.positions)
    assert system.getNumParticles() == n
    assert [system.getConstraintParameters(k) for k in range(system.getNumConstraints())] == [
        plain.getConstraintParameters(k) for k in range(plain.getNumConstraints())
    ]
    assert [i for i in range(n) if system.isVirtualSite(i)] == [i for i in range(n) if plain.isVirtualSite(i)]
    assert system.getDefaultPeriodicBoxVectors() == plain.getDefaultPeriodicBoxVectors()
    before, now = (
        RigidBodies.from_system(each, rigid=built.named, positions=built.positions) for each in (plain, system)
    )
    assert clusters(now) == clusters(before)
    pairs, _ = constrained_pairs(system)
    freedoms = allowed_motions(masses_of(system), built.positions, built.named, pairs)
    assert now.dof == before.dof == freedoms.shape[1]


def cases(platform: str) -> st.SearchStrategy[Preparing]:
    """Draw a mixture that is prepared."""
    return st.builds(Preparing, mixtures(prepared=("yes", "heavy")), st.just(platform))


LAW = Law("preparing", cases, few=25)


@LAW.numbers()
def test_preparing_changes_nothing_but_what_it_says(examples):
    LAW.hold(examples)


def test_bodies_at_different_images_are_whole():
    """Their ways to one image are rounded for each atom."""
    molecules = (WithSite(Jointed("pair", other="bent"), "two"),)
    Preparing(Mixture(molecules, surroundings="cut-off", prepared="yes", crossing=True)).check()
