"""LAMMPS and GROMACS, if installed, with the same liquid: rigid water of three sites.

Both get the positions, velocities, charges, cut-offs, Ewald parameter, mesh and spline order of the OpenMM System. What
differs is written down in `DIFFERENCES` and printed with the comparison. With `usual` settings they get positions,
velocities, charges and cut-offs alone, and take what they recommend for the rest, see `studies.bench.usual_inputs`.

Both run with as many threads as OpenMM, `OPENMM_CPU_THREADS` or all cores.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics import threads
from studies.sampling import Energies
from studies.units import md

KCAL = 4.184
#: nm^2/ps^2 times dalton is kJ/mol; LAMMPS' velocities are in A/fs.
ANGSTROM = 0.1
SPLINE_ORDER = 5

DIFFERENCES = {
    "LAMMPS": "fix rigid/nve/small; Lennard-Jones switched by the cubic in r^2 of lj/charmm, PPPM of the same mesh",
    "GROMACS": "md-vv with SETTLE; the same quintic switch; pair list of 1.1 nm, in single precision but for gmx_d",
}


class PeerError(RuntimeError):
    """A peer could not be run."""


@dataclass(frozen=True)
class Liquid:
    """A System of three-site water as peers need it, in OpenMM's units.

    Attributes:
        positions, velocities: (N, 3), atoms in the order O, H, H.
        box: edges of the rectangular box, (3,).
        masses, charges, sigmas, epsilons: of O and H, (2,).
        bonds: O-H and H-H distance.
        cutoff, switch: of the direct sum, and where the switching of Lennard-Jones begins.
        alpha, mesh: of the Ewald sum, 1/nm and (3,).
    """

    positions: np.ndarray
    velocities: np.ndarray
    box: np.ndarray
    masses: np.ndarray
    charges: np.ndarray
    sigmas: np.ndarray
    epsilons: np.ndarray
    bonds: tuple[float, float]
    cutoff: float
    switch: float
    alpha: float
    mesh: tuple[int, int, int]

    @property
    def molecules(self) -> int:
        return len(self.positions) // 3


class Run(NamedTuple):
    """Result of a program: energies, and the wall and processor time of its steps in seconds."""

    energies: Energies
    seconds: float
    processor: float


#: (liquid, step in fs, number of steps, steps between two samples) -> a program's input.
Input = Callable[[Liquid, float, int, int], str]


@dataclass(frozen=True)
class Peer:
    """An installed program.

    Attributes:
        name: for tables.
        simulate: (liquid, step in fs, number of steps, steps between two samples, empty directory) -> what it did.
        build: version, precision, compiled instructions and threads, as the program prints them.
    """

    name: str
    simulate: Callable[[Liquid, float, int, int, Path], Run]
    build: str


def installed() -> list[Peer]:
    """The peers on this machine: `lmp`, `gmx` and `gmx_d` on the PATH or in the folder of the running Python."""
    programs = [lammps("LAMMPS rigid/nve/small", _lammps_input)]
    programs += [gromacs(f"GROMACS md-vv, {name}", _mdp, program) for name, program in PRECISIONS.items()]
    return [peer for peer in programs if peer is not None]


#: GROMACS by precision.
PRECISIONS = {"mixed": "gmx", "double": "gmx_d"}


def lammps(name: str, script: Input) -> Peer | None:
    """LAMMPS with an input, where it is installed."""
    if (program := _find("lmp")) is None:
        return None
    return Peer(name, partial(_of_lammps, program, script), f"{_lammps_build(program)}, {threads.count()} threads")


def gromacs(name: str, mdp: Input, command: str = "gmx") -> Peer | None:
    """GROMACS with parameters of a run, where it is installed."""
    if (program := _find(command)) is None:
        return None
    return Peer(name, partial(_of_gromacs, program, mdp), f"{_gromacs_build(program)}, {threads.count()} threads")


def _lammps_build(program: str) -> str:
    output = _output_of(program, "-h")
    version = re.search(r"Massively Parallel Simulator - (.+)", output)
    compiler = re.search(r"^Compiler: (.+)", output, re.M)
    return f"LAMMPS {version[1] if version else '?'}, double precision, {compiler[1] if compiler else '?'}"


def _gromacs_build(program: str) -> str:
    output = _output_of(program, "--version")
    named = dict(re.findall(r"^(GROMACS version|Precision|SIMD instructions|CPU FFT library): +(.+)", output, re.M))
    return ", ".join(f"{name.removesuffix(' version')} {value}" for name, value in named.items()) or "GROMACS ?"


def _output_of(program: str, option: str) -> str:
    """Return the output of a program about itself."""
    return subprocess.run([program, option], capture_output=True, text=True).stdout


def _find(program: str) -> str | None:
    return shutil.which(program) or shutil.which(program, path=str(Path(sys.executable).parent))


def liquid_of(system: openmm.System, start: openmm.State) -> Liquid | None:
    """The System at a State with positions and velocities; None if it is not three-site water alone."""
    force = next(f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
    n = system.getNumParticles()
    kinds = [tuple(md(value) for value in force.getParticleParameters(i)) for i in range(n)]
    masses = [md(system.getParticleMass(i)) for i in range(n)]
    water = n % 3 == 0 and kinds == (kinds[:1] + 2 * kinds[1:2]) * (n // 3) and system.getNumConstraints() == n
    if not water or any(system.isVirtualSite(i) for i in range(n)):
        return None
    constraints = (system.getConstraintParameters(c) for c in range(n))
    distances = {frozenset((i, j)): md(d) for i, j, d in constraints if max(i, j) < 3}
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    alpha, *mesh = force.getPMEParametersInContext(context)
    (q1, s1, e1), (q2, s2, e2) = kinds[:2]
    return Liquid(
        positions=md(start.getPositions(asNumpy=True)),
        velocities=md(start.getVelocities(asNumpy=True)),
        box=np.diag(md(start.getPeriodicBoxVectors(asNumpy=True))),
        masses=np.array(masses[:2]),
        charges=np.array([q1, q2]),
        sigmas=np.array([s1, s2]),
        epsilons=np.array([e1, e2]),
        bonds=(distances[frozenset((0, 1))], distances[frozenset((1, 2))]),
        cutoff=force.getCutoffDistance().value_in_unit(unit.nanometer),
        switch=force.getSwitchingDistance().value_in_unit(unit.nanometer),
        alpha=float(md(alpha)),
        mesh=(int(mesh[0]), int(mesh[1]), int(mesh[2])),
    )


def _execute(command: list[str], directory: Path, text: str = "") -> str:
    process = subprocess.run(command, cwd=directory, input=text, capture_output=True, text=True)
    if process.returncode:
        tail = " ".join((process.stderr or process.stdout).split()[-40:])
        raise PeerError(f"{Path(command[0]).name} ended with code {process.returncode}: {tail}")
    return process.stdout


def _of_lammps(
    program: str, script: Input, liquid: Liquid, step: float, steps: int, every: int, directory: Path
) -> Run:
    """A run of LAMMPS, with threads if its `mpiexec` is in the same folder."""
    # An MPI other than the one that LAMMPS was built with would start that many independent runs.
    launcher = shutil.which("mpiexec", path=str(Path(program).parent)) if threads.count() > 1 else None
    launch = [launcher, "-n", str(threads.count())] if launcher else []
    (directory / "data").write_text(_lammps_data(liquid))
    (directory / "in.lmp").write_text(script(liquid, step, steps, every))
    text = _execute([*launch, program, "-in", "in.lmp", "-log", "log"], directory)
    table = re.search(r"^ *Step +PotEng +KinEng *\n((?: *\d.*\n)+)Loop time of ([\d.eE+-]+)", text, re.M)
    if table is None:
        raise PeerError("LAMMPS printed no energies")
    rows = np.array([line.split() for line in table[1].splitlines()], dtype=float)
    energies = Energies(1e-3 * step * rows[:, 0], KCAL * rows[:, 1], KCAL * rows[:, 2])
    seconds, use = float(table[2]), re.search(r"([\d.]+)% CPU use with (\d+) MPI tasks", text)
    return Run(energies, seconds, seconds * float(use[1]) / 100 * int(use[2]) if use else math.nan)


def _lammps_input(liquid: Liquid, step: float, steps: int, every: int) -> str:
    motion = f"""kspace_style pppm 1e-5
kspace_modify gewald {liquid.alpha * ANGSTROM:.12g} mesh {" ".join(map(str, liquid.mesh))} order {SPLINE_ORDER} diff ad
neighbor 2.0 bin
neigh_modify every 1 delay 0 check yes
timestep {step}
fix motion all rigid/nve/small molecule"""
    return lammps_run(liquid, "bond_coeff *\nangle_coeff *", motion, steps, every)


def lammps_run(liquid: Liquid, molecule: str, motion: str, steps: int, every: int) -> str:
    """The input of a run: the coefficients of bond and angle, the sums of PPPM and how molecules move are given."""
    pairs = "\n".join(
        f"pair_coeff {i + 1} {i + 1} {liquid.epsilons[i] / KCAL:.12g} {liquid.sigmas[i] / ANGSTROM:.12g}"
        for i in (0, 1)
    )
    return f"""units real
atom_style full
bond_style zero
angle_style zero
special_bonds lj/coul 0 0 0
pair_style lj/charmm/coul/long {liquid.switch / ANGSTROM} {liquid.cutoff / ANGSTROM}
pair_modify mix arithmetic
read_data data
{molecule}
{pairs}
{motion}
thermo {every}
thermo_style custom step pe ke
thermo_modify norm no format float %.12g
run {steps}
"""


def _lammps_data(liquid: Liquid) -> str:
    n = liquid.molecules
    edges = liquid.box / ANGSTROM
    lines = ["water", "", f"{3 * n} atoms", f"{2 * n} bonds", f"{n} angles", "2 atom types", "1 bond types"]
    lines += ["1 angle types", ""]
    lines += [f"0 {edge:.12g} {axis}lo {axis}hi" for edge, axis in zip(edges, "xyz", strict=True)]
    lines += ["", "Masses", "", *(f"{i + 1} {mass:.12g}" for i, mass in enumerate(liquid.masses))]
    lines += ["", "Atoms # full", ""]
    for i, place in enumerate(liquid.positions / ANGSTROM):
        kind = 1 if i % 3 == 0 else 2
        where = " ".join(f"{x:.12f}" for x in place)
        lines.append(f"{i + 1} {i // 3 + 1} {kind} {liquid.charges[kind - 1]:.12g} {where}")
    lines += ["", "Velocities", ""]
    # nm/ps are 0.01 A/fs.
    lines += [f"{i + 1} " + " ".join(f"{0.01 * x:.14g}" for x in v) for i, v in enumerate(liquid.velocities)]
    bonds = [(3 * m + 1, 3 * m + 1 + k) for m in range(n) for k in (1, 2)]
    lines += ["", "Bonds", "", *(f"{i + 1} 1 {a} {b}" for i, (a, b) in enumerate(bonds))]
    lines += ["", "Angles", "", *(f"{m + 1} 1 {3 * m + 2} {3 * m + 1} {3 * m + 3}" for m in range(n))]
    return "\n".join(lines) + "\n"


def _of_gromacs(program: str, mdp: Input, liquid: Liquid, step: float, steps: int, every: int, directory: Path) -> Run:
    """A run of GROMACS."""
    (directory / "conf.gro").write_text(_gro(liquid))
    (directory / "topol.top").write_text(_topology(liquid))
    (directory / "grompp.mdp").write_text(mdp(liquid, step, steps, every))
    _execute([program, "grompp", "-maxwarn", "10"], directory)
    before, begun = _children(), time.perf_counter()
    _execute([program, "mdrun", "-ntmpi", "1", "-ntomp", str(threads.count()), "-pin", "off"], directory)
    share = (_children() - before) / (time.perf_counter() - begun)
    _execute([program, "energy", "-dp", "-o", "e.xvg"], directory, "Potential\nKinetic-En.\n\n")
    times, potential, kinetic = np.loadtxt(directory / "e.xvg", comments=("#", "@")).T
    wall = re.search(r"^ +Time: +[\d.]+ +([\d.]+)", (directory / "md.log").read_text(), re.M)
    seconds = float(wall[1]) if wall else math.nan
    # Its own "core time" is wall time times threads.
    return Run(Energies(times, potential, kinetic), seconds, seconds * share)


def _children() -> float:
    """Processor time of programs that have ended, s."""
    times = os.times()
    return times.children_user + times.children_system


def _gro(liquid: Liquid) -> str:
    """Positions and velocities with 9 and 10 decimals; GROMACS infers them from the spacing of the decimal points."""
    lines = ["water", str(len(liquid.positions))]
    for i, (x, v) in enumerate(zip(liquid.positions, liquid.velocities, strict=True)):
        name = ("OW", "HW1", "HW2")[i % 3]
        numbers = "".join(f"{a:14.9f}" for a in x) + "".join(f"{a:14.10f}" for a in v)
        lines.append(f"{(i // 3 + 1) % 100000:5d}SOL  {name:>5s}{(i + 1) % 100000:5d}{numbers}")
    return "\n".join([*lines, " ".join(f"{edge:.9f}" for edge in liquid.box)]) + "\n"


def _topology(liquid: Liquid) -> str:
    types = "\n".join(
        f"{name} {mass:.9g} {charge:.9g} A {sigma:.12g} {epsilon:.12g}"
        for name, mass, charge, sigma, epsilon in zip(
            ("OT", "HT"), liquid.masses, liquid.charges, liquid.sigmas, liquid.epsilons, strict=True
        )
    )
    atoms = "\n".join(
        f"{i + 1} {'OT' if i == 0 else 'HT'} 1 SOL {name} {i + 1} {liquid.charges[min(i, 1)]:.9g}"
        for i, name in enumerate(("OW", "HW1", "HW2"))
    )
    return f"""[ defaults ]
1 2 no 1.0 1.0
[ atomtypes ]
{types}
[ moleculetype ]
SOL 2
[ atoms ]
{atoms}
[ settles ]
1 1 {liquid.bonds[0]:.12g} {liquid.bonds[1]:.12g}
[ exclusions ]
1 2 3
2 1 3
3 1 2
[ system ]
water
[ molecules ]
SOL {liquid.molecules}
"""


def _mdp(liquid: Liquid, step: float, steps: int, every: int) -> str:
    x, y, z = liquid.mesh
    return f"""integrator = md-vv
dt = {1e-3 * step:.9g}
nsteps = {steps}
nstenergy = {every}
nstcalcenergy = {every}
nstlog = 0
nstxout-compressed = 0
comm-mode = None
continuation = no
gen-vel = no
cutoff-scheme = Verlet
verlet-buffer-tolerance = -1
nstlist = 10
rlist = {liquid.cutoff + 0.2:.6g}
coulombtype = PME
rcoulomb = {liquid.cutoff:.6g}
ewald-rtol = {math.erfc(liquid.alpha * liquid.cutoff):.12g}
fourier-nx = {x}
fourier-ny = {y}
fourier-nz = {z}
pme-order = {SPLINE_ORDER}
vdwtype = cut-off
vdw-modifier = potential-switch
rvdw-switch = {liquid.switch:.6g}
rvdw = {liquid.cutoff:.6g}
DispCorr = no
constraints = none
"""
