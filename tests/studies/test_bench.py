"""The benchmark measures correctly; no test asserts a speed."""

import os
import sys

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import SIERIntegrator
from openmm_sier.inputs import forcefields
from studies.bench import peers
from tests.support.commands import SYSTEMS
from tests.support.flexible_systems import started
from tests.support.waters import plain_context


@pytest.fixture(scope="module")
def liquid():
    """512 molecules of TIP3P with velocities: the System, a State, and the input of peers."""
    result = forcefields.read_box(SYSTEMS / "tip3p-512.pdb")
    context = started(result.system, SIERIntegrator(0.001, "SIER2"), result.positions, 297, seed=1)
    state = context.getState(positions=True, velocities=True)
    return result.system, state, peers.liquid_of(result.system, state)


@pytest.mark.thorough
def test_what_gromacs_gets_has_the_same_energy(liquid, tmp_path):
    """OpenMM's own reader of GROMACS files builds the System again."""
    system, state, told = liquid
    (tmp_path / "conf.gro").write_text(peers._gro(told))
    (tmp_path / "topol.top").write_text(peers._topology(told))
    gro = app.GromacsGroFile(str(tmp_path / "conf.gro"))
    top = app.GromacsTopFile(str(tmp_path / "topol.top"), periodicBoxVectors=gro.getPeriodicBoxVectors())
    again = top.createSystem(nonbondedMethod=app.PME, nonbondedCutoff=told.cutoff * unit.nanometer)
    for force in again.getForces():
        if isinstance(force, openmm.NonbondedForce):
            force.setUseSwitchingFunction(True)
            force.setSwitchingDistance(told.switch)
            force.setPMEParameters(told.alpha, *told.mesh)
    energies = []
    for one, positions in ((system, state.getPositions()), (again, gro.getPositions())):
        context = plain_context(one, positions)
        context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        energies.append(context.getState(energy=True).getPotentialEnergy()._value)
    # Coordinates with nine decimals, 1e-9 nm, against forces of up to 1e3 kJ/mol/nm on 1536 atoms.
    assert energies[1] == pytest.approx(energies[0], abs=1e-3)
    lines = peers._gro(told).splitlines()[2:-1]
    written = np.array([[float(line[62 + 14 * k : 76 + 14 * k]) for k in range(3)] for line in lines])
    assert np.abs(written - state.getVelocities(asNumpy=True)._value).max() < 1e-10
    assert f"fourier-nx = {told.mesh[0]}" in peers._mdp(told, 1.0, 10, 1)


def test_what_lammps_gets(liquid):
    _, state, told = liquid
    lines = peers._lammps_data(told).splitlines()
    first = lines.index("Atoms # full") + 2
    atoms = np.array([line.split() for line in lines[first : first + 1536]], dtype=float)
    assert np.abs(0.1 * atoms[:, 4:] - state.getPositions(asNumpy=True)._value).max() < 1e-13
    assert atoms[:3, 1:4].tolist() == [[1, 1, -0.834], [1, 2, 0.417], [1, 2, 0.417]]
    first = lines.index("Velocities") + 2
    velocities = np.array([line.split()[1:] for line in lines[first : first + 1536]], dtype=float)
    # 1 A/fs is 100 nm/ps.
    assert np.abs(100 * velocities - state.getVelocities(asNumpy=True)._value).max() < 1e-12
    assert "pair_coeff 1 1 0.152 3.1507524" in peers._lammps_input(told, 1.0, 10, 1)
    assert f"gewald {told.alpha / 10:.6f}"[:14] in peers._lammps_input(told, 1.0, 10, 1)


FAKE = """#!{python}
import sys
if sys.argv[1:] == ["-h"]:
    print("Large-scale Atomic/Molecular Massively Parallel Simulator - 1 Jan 2030\\n\\nCompiler: GNU C++ 20")
    sys.exit()
assert sys.argv[1:] == ["-in", "in.lmp", "-log", "log"] and "run 4" in open("in.lmp").read()
print("   Step         PotEng         KinEng")
print("         0  -10.0   5.0")
print("         2  -12.0   6.5")
print("         4  -11.0   6.0")
print("Loop time of 0.25 on 1 procs for 4 steps with 1536 atoms")
print("96.0% CPU use with 1 MPI tasks x 1 OpenMP threads")
"""


def test_a_program_on_the_path_is_found_and_read(liquid, tmp_path, monkeypatch):
    program = tmp_path / "lmp"
    program.write_text(FAKE.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=None)
    monkeypatch.setattr(sys, "executable", os.devnull)
    (peer,) = peers.installed()
    assert peer.name == "LAMMPS rigid/nve/small"
    energies, seconds, processor = peer.simulate(liquid[2], 1.5, 4, 2, tmp_path)
    assert energies.time == pytest.approx([0, 0.003, 0.006])
    assert energies.total == pytest.approx([-5 * 4.184, -5.5 * 4.184, -5 * 4.184])
    assert seconds == 0.25
    assert processor == pytest.approx(0.24)
    assert peer.build.startswith("LAMMPS 1 Jan 2030, double precision, GNU C++ 20, ")
