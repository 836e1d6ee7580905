"""The kernels of a step in C, and the commands that launch them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import NamedTuple

import numpy as np

from openmm_sier.engines.compiled.body_tables import BodyTables
from openmm_sier.engines.compiled.movers import MOST_IN_CLUSTER, PROJECT, Call, Clusters, Mover
from openmm_sier.engines.compiled.step_program import (
    FORCES,
    FORCES_AND_ENERGY,
    LAUNCH,
    REORDER,
    SITES,
    Command,
    Kernel,
    StepProgram,
)
from openmm_sier.engines.compiled.symbols import literal
from openmm_sier.engines.compiled.writing import FAST, NOTHING, SLOW, Part

#: Threads in a block of kernels in which each thread has a mover of its own.
BLOCK = 64

#: Velocities just after a bath.
BATHED = "bathed"

#: Numbers of trials that the host writes, and sums that it reads, in several slots; see `trials.cc`.
VALUES, N_VALUES = "values", 8
START_SUMS, END_SUMS = "startSums", "endSums"
SUM_SLOTS, SUM_SIZE = 32, 5

#: The largest kinetic energy of a mover that is summed, kJ/mol.
MOST_ENERGY = 1e6

#: Arguments of kernels, with their declarations in C.
ARGUMENTS = {
    "posq": "GLOBAL real4* RESTRICT posq",
    "posqCorrection": "GLOBAL real4* RESTRICT posqCorrection",
    "velm": "GLOBAL mixed4* RESTRICT velm",
    "force": "GLOBAL mm_long* RESTRICT force",
    "random": "GLOBAL const float4* RESTRICT random",
    "randomIndex": "int randomIndex",
    "scalars": "GLOBAL const mixed* RESTRICT scalars",
    "bodies": "GLOBAL const int4* RESTRICT bodies",
    "bodyAtoms": "GLOBAL const int* RESTRICT bodyAtoms",
    "sites": "GLOBAL const mixed4* RESTRICT sites",
    "kinds": "GLOBAL const mixed4* RESTRICT kinds",
    "references": "GLOBAL const int4* RESTRICT references",
    "points": "GLOBAL const int* RESTRICT points",
    "clusters": "GLOBAL const int* RESTRICT clusters",
    "clusterLengths": "GLOBAL const mixed* RESTRICT clusterLengths",
    "kept": "GLOBAL mixed4* RESTRICT kept",
    "bathed": "GLOBAL mixed4* RESTRICT bathed",
    "startX": "GLOBAL mixed4* RESTRICT startX",
    "startV": "GLOBAL mixed4* RESTRICT startV",
    "startF": "GLOBAL mm_long* RESTRICT startF",
    "values": "GLOBAL const mixed* RESTRICT values",
    START_SUMS: "GLOBAL mm_ulong* RESTRICT startSums",
    END_SUMS: "GLOBAL mm_ulong* RESTRICT endSums",
    "heat": "GLOBAL mm_long* RESTRICT heat",
}


#: Macros that stand for several of them.
MACROS = {
    "THE_POSITIONS": ("posq", "posqCorrection"),
    "THE_BODY_TABLES": ("bodyAtoms", "sites", "kinds"),
    "THE_START": ("startX", "startV", "startF"),
}


class Work(NamedTuple):
    """Calls of one set of movers in a launch."""

    mover: Mover
    calls: tuple[Call, ...]


class ProgramWriter:
    """Writer of a program from parts."""

    def __init__(
        self,
        tables: BodyTables,
        fast_groups: int,
        counts_heat: bool,
        trial_steps: int,
        has_sites: bool,
        n_particles: int,
    ) -> None:
        """
        Args:
            tables: all that moves.
            fast_groups: bit mask.
            counts_heat: whether heat is counted.
            trial_steps: number of steps of a trial; 0 without blocks of trials.
            has_sites: whether there are virtual sites.
            n_particles: number of particles.
        """
        self._tables = tables
        self._fast_groups = fast_groups
        self._counts_heat = counts_heat
        self._has_sites = has_sites
        self._n_particles = n_particles
        self._trial_steps = trial_steps
        self._blocks: list[list[Command]] = []
        #: Kernels by their text, and the texts of each size of a team.
        self._kernels: dict[tuple[int, str], Kernel] = {}
        self._teams: dict[int, list[str]] = {}

    @property
    def _commands(self) -> list[Command]:
        """Return the commands of the block that is written."""
        return self._blocks[-1]

    def write_block(self, parts: Iterable[Part]) -> None:
        """Write parts as a block of commands."""
        self._blocks.append([])
        has_moved = False
        for part in parts:
            if has_moved and part.begins_with != FAST:
                self._place_sites()
                has_moved = False
            self._write_part(part)
            has_moved = has_moved or part.moves
        if has_moved:
            self._place_sites()

    def program(self) -> StepProgram:
        """Return the program of all blocks."""
        tables = self._tables
        vectors = np.zeros(4 * self._n_particles)
        of_trials = vectors if self._trial_steps else np.zeros(4)
        sums = SUM_SLOTS * SUM_SIZE
        forces = 3 * self._n_particles if self._trial_steps else 1
        return StepProgram(
            sources=tuple(self._source(team, texts) for team, texts in self._teams.items()),
            integers=tables.integers,
            numbers={
                **tables.numbers,
                "kept": vectors,
                BATHED: vectors,
                "startX": of_trials,
                "startV": of_trials,
                VALUES: np.zeros(N_VALUES),
            },
            totals={"heat": max(1, self._n_movers), START_SUMS: sums, END_SUMS: sums, "startF": forces},
            kernels=tuple(self._kernels.values()),
            blocks=tuple(map(tuple, self._blocks)),
            bodies=tables.atoms,
        )

    @property
    def _n_movers(self) -> int:
        return sum(mover.number for mover in (*self._tables.others, *self._tables.members))

    @property
    def sum_units(self) -> float:
        """Return the units of sums of trials in one kJ/mol or Da nm/ps, a power of two with which none overflows."""
        return 2.0 ** math.floor(62 - math.log2(MOST_ENERGY * max(1, self._n_movers)))

    def _place_sites(self) -> None:
        if self._has_sites:
            self._commands.append(Command(SITES))

    def _write_part(self, part: Part) -> None:
        groups = _signed(self._fast_groups if part.begins_with == FAST else ~self._fast_groups)
        if part.begins_with == REORDER:
            self._commands.append(Command(REORDER, self._trial_steps))
        elif part.begins_with in (SLOW, FAST):
            self._commands.append(Command(FORCES_AND_ENERGY if part.wants_energy else FORCES, groups))
        elif part.begins_with != NOTHING:
            self._commands.append(Command(part.begins_with, groups))
        work = [Work(mover, tuple(part.members)) for mover in self._tables.members]
        work += [Work(mover, tuple(part.others)) for mover in self._tables.others]
        self._launch(work)

    def _launch(self, work: Sequence[Work]) -> None:
        """Launch a kernel for all movers that have a thread each, and one for those that have a team each."""
        for team in sorted({each.mover.team for each in work}):
            chosen = [each for each in work if each.mover.team == team and _does_something(each)]
            if chosen:
                self._commands.append(Command(LAUNCH, self._kernel(team, chosen)))

    def _kernel(self, team: int, work: Sequence[Work]) -> int:
        """Return the number of the kernel that does some work, which is written unless it is there."""
        body, noise = _body(team, work, self._counts_heat)
        key = team, body
        if key not in self._kernels:
            texts = self._teams.setdefault(team, [])
            name = f"sierStep{len(texts)}"
            arguments = _arguments(body)
            texts.append(_function(name, team, arguments, body))
            threads = team * sum(each.mover.number for each in work)
            moves = any(call.moves for each in work for call in each.calls)
            source = list(self._teams).index(team)
            block = BLOCK if team == 1 else team
            self._kernels[key] = Kernel(name, source, arguments, threads, block, noise, moves)
        return list(self._kernels).index(key)

    def _source(self, team: int, texts: Iterable[str]) -> str:
        """Return kernels with what they have in common."""
        # Its formulas bring Numba, which takes long to import.
        from openmm_sier.engines.compiled import rotation

        head, marker, rest = _text("motion.cc").partition("// --- formulas ---\n")
        constants = {
            "LANES": team,
            "MOST_IN_CLUSTER": MOST_IN_CLUSTER,
            "LONGEST_PHASE": literal(rotation.LONGEST_PHASE),
            "NUM_PARTICLES": self._n_particles,
            "SUM_SLOTS": SUM_SLOTS,
            "SUM_SIZE": SUM_SIZE,
            "SUM_UNITS": literal(self.sum_units),
            "MOST_ENERGY": literal(MOST_ENERGY),
        }
        defined = "".join(f"#define {name} {value}\n" for name, value in constants.items())
        functions = [rotation.functions(), marker + rest, _text("clusters.cc"), _text("trials.cc")]
        return "\n".join([defined + head, *functions, *texts])


def _does_something(each: Work) -> bool:
    return any(call.kind != PROJECT or isinstance(each.mover, Clusters) for call in each.calls)


def _signed(mask: int) -> int:
    """Return a bit mask of 32 force groups as a signed number of C."""
    unsigned = mask & 0xFFFFFFFF
    return unsigned - 2**32 if unsigned >= 2**31 else unsigned


def _body(team: int, work: Sequence[Work], counts_heat: bool) -> tuple[str, int]:
    """Return the loop of a kernel, and the number of random vectors that it uses.

    Args:
        team: number of threads for each mover.
        work: of movers that have so many.
        counts_heat: whether the heat of baths is counted.
    """
    total = sum(each.mover.number for each in work)
    first, stride = ("GLOBAL_ID", "GLOBAL_SIZE") if team == 1 else ("GROUP_ID", "NUM_GROUPS")
    lines = [f"    for (int m = {first}; m < {total}; m += {stride}) {{"]
    start = noise = 0
    for each in work:
        code, used = each.mover.lines(each.calls, noise, counts_heat)
        end = start + each.mover.number
        lines += [f"        if ({start} <= m && m < {end}) {{", f"            const int n = m - {start};"]
        lines += [f"            {line}" for line in code]
        lines += ["        }"]
        start = end
        noise += used
    return "\n".join([*lines, "    }\n"]), noise


def _arguments(body: str) -> tuple[str, ...]:
    """Return the arguments that the body of a kernel uses: OpenMM passes each anew in every launch."""
    words = set(re.findall(r"\w+", body))
    for macro, arguments in MACROS.items():
        if macro in words:
            words.update(arguments)
    return tuple(argument for argument in ARGUMENTS if argument in words)


def _function(name: str, team: int, arguments: Sequence[str], body: str) -> str:
    buffer = f"    LOCAL mixed buffer[{3 * team}];\n" if team > 1 else ""
    return f"KERNEL void {name}({_parameters(arguments)}) {{\n{buffer}{body}}}\n"


def _parameters(arguments: Sequence[str]) -> str:
    """Return the parameters of a kernel, the last of which is not `posqCorrection`."""
    declarations = []
    for argument in arguments:
        if argument == "posqCorrection":
            declarations.append(f"#ifdef USE_MIXED_PRECISION\n    {ARGUMENTS[argument]},\n#endif")
        else:
            declarations.append(f"    {ARGUMENTS[argument]},")
    return "\n" + "\n".join(declarations).rstrip(",")


def _text(name: str) -> str:
    """Return a file of this folder."""
    return resources.files("openmm_sier.engines.compiled").joinpath(name).read_text()
