"""The kernels of a step in C, and the commands that launch them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import resources
from typing import NamedTuple

import numpy as np

from openmm_sier.engines.compiled import rotation
from openmm_sier.engines.compiled.body_tables import BodyTables
from openmm_sier.engines.compiled.movers import MOST_IN_CLUSTER, PROJECT, Call, Clusters, Mover
from openmm_sier.engines.compiled.step_program import FORCES, LAUNCH, SITES, UPDATE, Command, Kernel, StepProgram
from openmm_sier.engines.compiled.symbols import literal
from openmm_sier.engines.compiled.writing import UPDATES, Epoch

#: Threads in a block of kernels in which each thread has a mover of its own.
BLOCK = 64

#: Velocities just after a bath.
BATHED = "bathed"

#: Arguments of all kernels, with their declarations in C.
ARGUMENTS = {
    "posq": "GLOBAL real4* RESTRICT posq",
    "posqCorrection": "GLOBAL real4* RESTRICT posqCorrection",
    "velm": "GLOBAL mixed4* RESTRICT velm",
    "force": "GLOBAL const mm_long* RESTRICT force",
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
    "heat": "GLOBAL mm_long* RESTRICT heat",
}


class Work(NamedTuple):
    """Calls of one set of movers in a launch."""

    mover: Mover
    calls: tuple[Call, ...]


class ProgramWriter:
    """Writer of a program from epochs."""

    def __init__(self, tables: BodyTables, fast_groups: int, counts_heat: bool, has_sites: bool, n_particles: int):
        """
        Args:
            tables: all that moves.
            fast_groups: bit mask.
            counts_heat: whether heat is counted.
            has_sites: whether there are virtual sites.
            n_particles: number of particles.
        """
        self._tables = tables
        self._fast_groups = fast_groups
        self._counts_heat = counts_heat
        self._has_sites = has_sites
        self._n_particles = n_particles
        self._commands: list[Command] = []
        #: Kernels by their text, and the texts of each size of a team.
        self._kernels: dict[tuple[int, str], Kernel] = {}
        self._teams: dict[int, list[str]] = {}

    def write(self, epochs: Iterable[Epoch]) -> StepProgram:
        """Return the program of epochs."""
        for epoch in epochs:
            self._write_epoch(epoch)
        tables = self._tables
        heat_parts = max(1, sum(mover.number for mover in (*tables.others, *tables.members)))
        return StepProgram(
            sources=tuple(_source(team, texts) for team, texts in self._teams.items()),
            integers=tables.integers,
            numbers={
                **tables.numbers,
                "kept": np.zeros(4 * self._n_particles),
                BATHED: np.zeros(4 * self._n_particles),
            },
            totals={"heat": heat_parts},
            kernels=tuple(self._kernels.values()),
            commands=tuple(self._commands),
            bodies=tables.atoms,
        )

    def _write_epoch(self, epoch: Epoch) -> None:
        if epoch.begins_with == UPDATES:
            self._commands.append(Command(UPDATE))
        elif epoch.begins_with == FORCES:
            self._commands.append(Command(FORCES, _signed(~self._fast_groups)))
        for number, part in enumerate(epoch.parts):
            if number:
                self._commands.append(Command(FORCES, _signed(self._fast_groups)))
            work = [Work(mover, tuple(part)) for mover in self._tables.members]
            if not number:
                work += [Work(mover, tuple(epoch.others)) for mover in self._tables.others]
            self._launch(work)
        if epoch.moves and self._has_sites:
            self._commands.append(Command(SITES))

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
            texts.append(_function(name, team, body))
            threads = team * sum(each.mover.number for each in work)
            moves = any(call.moves for each in work for call in each.calls)
            source = list(self._teams).index(team)
            block = BLOCK if team == 1 else team
            self._kernels[key] = Kernel(name, source, tuple(ARGUMENTS), threads, block, noise, moves)
        return list(self._kernels).index(key)


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


def _function(name: str, team: int, body: str) -> str:
    declarations = []
    for argument, declaration in ARGUMENTS.items():
        if argument == "posqCorrection":
            declarations.append(f"#ifdef USE_MIXED_PRECISION\n    {declaration},\n#endif")
        else:
            declarations.append(f"    {declaration},")
    buffer = f"    LOCAL mixed buffer[{3 * team}];\n" if team > 1 else ""
    return f"KERNEL void {name}(\n" + "\n".join(declarations).rstrip(",") + f") {{\n{buffer}{body}}}\n"


def _source(team: int, texts: Iterable[str]) -> str:
    """Return kernels with what they have in common."""
    folder = resources.files("openmm_sier.engines.compiled")
    common = "\n".join(folder.joinpath(name).read_text() for name in ("motion.cc", "clusters.cc"))
    head, marker, rest = common.partition("// --- formulas ---\n")
    constants = {"LANES": team, "MOST_IN_CLUSTER": MOST_IN_CLUSTER, "LONGEST_PHASE": literal(rotation.LONGEST_PHASE)}
    defined = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    return "\n".join([defined + head, rotation.functions(), marker + rest, *texts])
