"""Readers: one System in files of AMBER, GROMACS and OpenMM has the same bodies, temperatures and energies.

Files of CHARMM and PDB files with a force field are compared in `tests/cli/test_inputs.py`.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openmm
import pytest
from hypothesis import strategies as st

from openmm_sier import RigidBodies, SIERIntegrator
from openmm_sier.inputs.inputs import read_input
from tests.laws import writers
from tests.laws.law import Law
from tests.laws.mixtures import Built, Mixture
from tests.laws.molecules import Chain, Ion, Molecule, Water, WithSite
from tests.laws.readings import clusters, evaluated
from tests.support.waters import context_at, plain_context

#: kJ/mol. AMBER rounds charges and positions to 1e-8 of some 10^3 kJ/mol. Bonds of waters to their sites, which GROMACS
#: does not have, are a percent longer than 0.02 nm, 0.004 kJ/mol each in five waters at most. A term that is lost or a
#: charge in another place changes the energy by more than 1.
ROUNDING = 0.03

#: Kelvins: masses and velocities are the same, and lengths differ by 1e-8 nm.
KELVINS = 1e-3


@dataclass(frozen=True)
class Read:
    """A mixture in vacuum that files hold, of waters with three or four sites, ions and chains without hydrogens."""

    mixture: Mixture

    def check(self) -> None:
        built = self.mixture.build()
        expected = seen(built.plain, built.positions, built.velocities)
        with tempfile.TemporaryDirectory() as directory:
            for name, (coordinates, topology) in self._files(built, Path(directory)).items():
                box = read_input(coordinates, topology)
                found = seen(box.system, box.positions._value, built.velocities)
                for what, (value, wanted) in {key: (found[key], expected[key]) for key in expected}.items():
                    assert value == wanted, f"{name}: {what} {value} in place of {wanted}"

    def _files(self, built: Built, directory: Path) -> dict[str, tuple[Path, Path]]:
        """Write all files; return those of coordinates and of the topology by the name of the program."""
        residues, first = [], 0
        for molecule in self.mixture.molecules:
            name, names = names_of(molecule)
            residues.append(writers.Residue(name, tuple(range(first, first + len(names))), names))
            first += len(names)
        terms = writers.Terms(built.plain)
        context = plain_context(built.plain, built.positions)
        writers.write(
            directory,
            prmtop=writers.prmtop(terms, residues),
            inpcrd=writers.inpcrd(built.positions),
            top=writers.top(terms, residues, (0.15, 0.15)),
            gro=writers.gro(residues, built.positions),
            system=openmm.XmlSerializer.serialize(built.plain),
            state=openmm.XmlSerializer.serialize(context.getState(positions=True)),
        )
        (directory / "made.system").rename(directory / "system.xml")
        (directory / "made.state").rename(directory / "state.xml")
        return {
            "AMBER": (directory / "made.inpcrd", directory / "made.prmtop"),
            "GROMACS": (directory / "made.gro", directory / "made.top"),
            "OpenMM": (directory / "state.xml", directory / "system.xml"),
        }


def names_of(molecule: Molecule) -> tuple[str, tuple[str, ...]]:
    """Return names of a residue and of its atoms, by which readers know water and its site."""
    if isinstance(molecule, Water):
        return "WAT", ("O", "H1", "H2")
    if isinstance(molecule, WithSite):
        return "WAT", ("O", "H1", "H2", "EPW")
    if isinstance(molecule, Ion):
        return "NA", ("NA",)
    return "MOL", tuple(f"{'CNO'[i % 3]}{i + 1}" for i in range(len(molecule.parts().masses)))


def seen(system: openmm.System, x: np.ndarray, velocities: np.ndarray) -> dict[str, object]:
    """Return what must not depend on files: bodies, degrees of freedom, temperature and energy."""
    bodies = RigidBodies.from_system(system)
    context = context_at(system, SIERIntegrator(0.001), (x, velocities))
    kelvins = context.getIntegrator().computeSystemTemperature()._value
    energy, _ = evaluated(system, x)
    return {
        "bodies": clusters(bodies),
        "degrees of freedom": bodies.dof,
        "the number of virtual sites": sum(system.isVirtualSite(i) for i in range(system.getNumParticles())),
        "the temperature": pytest.approx(kelvins, abs=KELVINS, nan_ok=True),
        "the energy": pytest.approx(energy, abs=ROUNDING),
    }


def cases(platform: str) -> st.SearchStrategy[Read]:
    """Draw a mixture that all files can hold."""
    rigid = st.just(Water())
    with_site = st.builds(WithSite, rigid, st.just("three"), st.just(True))
    ions = st.builds(Ion, st.sampled_from([1.0, -1.0]))
    chains = st.builds(Chain, st.integers(2, 3))
    # OpenMM's reader of AMBER knows one kind of water.
    molecules = st.one_of(
        *(st.lists(st.one_of(ions, chains, water), min_size=1, max_size=5) for water in (rigid, with_site))
    )
    return st.builds(lambda drawn, seed: Read(Mixture(tuple(drawn), seed)), molecules, st.integers(0, 2**16))


LAW = Law("readers", cases, few=10)


@LAW.numbers()
def test_files_hold_one_system(examples):
    LAW.hold(examples)
