"""LAMMPS and GROMACS at their recommended settings for rigid water at constant energy, for comparisons of speed.

The cut-off is that of the OpenMM System. Everything else that decides the cost is each program's own choice.
"""

from __future__ import annotations

import math

from studies.bench import peers
from studies.bench.peers import ANGSTROM, Liquid, Peer

#: Step that both recommend for water held rigid, fs.
STEP = 2.0


def installed() -> list[Peer]:
    """The programs on this machine, GROMACS in mixed precision, which is its usual one."""
    programs = [peers.lammps("LAMMPS", lammps_input), peers.gromacs("GROMACS", mdp)]
    return [peer for peer in programs if peer is not None]


def lammps_input(liquid: Liquid, step: float, steps: int, every: int) -> str:
    """Verlet with SHAKE, PPPM to 1e-4, Lennard-Jones switched off as CHARMM does it."""
    oh, hh = liquid.bonds
    angle = 2 * math.degrees(math.asin(hh / (2 * oh)))
    molecule = f"bond_coeff 1 {oh / ANGSTROM:.12g}\nangle_coeff 1 {angle:.12g}"
    motion = f"""kspace_style pppm 1e-4
timestep {step}
fix rigid all shake 1e-4 20 0 b 1 a 1
fix motion all nve"""
    return peers.lammps_run(liquid, molecule, motion, steps, every)


def mdp(liquid: Liquid, step: float, steps: int, every: int) -> str:
    """Leap-frog with SETTLE, and the defaults for lists, mesh and splines."""
    return f"""integrator = md
dt = {1e-3 * step:.9g}
nsteps = {steps}
nstenergy = {every}
nstcalcenergy = {every}
nstlog = 0
comm-mode = None
cutoff-scheme = Verlet
coulombtype = PME
rcoulomb = {liquid.cutoff:.6g}
rvdw = {liquid.cutoff:.6g}
"""
