"""The kernels of a step in C, and the commands that launch them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import resources
from typing import NamedTuple

import numpy as np

from openmm_sier.engines.compiled.body_tables import BodyTables
from openmm_sier.engines.compiled.movers import MAKE_RIGID, MOST_IN_CLUSTER, PROJECT, Call, Clusters, Mover
from openmm_sier.engines.compiled.step_program import (
    FORCES,
    FORCES_AND_ENERGY,
    LAUNCH,
    REORDER,
    SITES,
    UPDATE,
    Command,
    Kernel,
    StepProgram,
)
from openmm_sier.engines.compiled.symbols import literal
from openmm_sier.engines.compiled.writing import ENERGY, NOTHING, UPDATES, Epoch

#: Threads in a block of kernels in which each thread has a mover of its own.
BLOCK = 64

#: Velocities just after a bath.
BATHED = "bathed"

#: Numbers of trials that the host writes, and those that it reads.
VALUES, N_VALUES = "values", 5
SUMS, N_SUMS = "sums", 4

#: Kernels of `trials.cc`, each of which is a block.
DRAW, CHANGE, KEEP, GO_BACK, SUM_MOTION = (f"sier{name}" for name in ("Draw", "Change", "Keep", "GoBack", "SumMotion"))
TRIAL_KERNELS = DRAW, CHANGE, KEEP, GO_BACK, SUM_MOTION

#: Threads that make sums together.
SUM_TEAM = 256

#: In place of the size of a team, for kernels without movers.
NO_TEAM = 0

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
    "startX": "GLOBAL mixed4* RESTRICT startX",
    "startV": "GLOBAL mixed4* RESTRICT startV",
    "values": "GLOBAL const mixed* RESTRICT values",
    "sums": "GLOBAL mixed* RESTRICT sums",
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
        self._blocks: list[list[Command]] = []
        #: Kernels by their text, and the texts of each size of a team.
        self._kernels: dict[tuple[int, str], Kernel] = {}
        self._teams: dict[int, list[str]] = {}

    @property
    def _commands(self) -> list[Command]:
        """Return the commands of the block that is written."""
        return self._blocks[-1]

    def write_block(self, epochs: Iterable[Epoch]) -> None:
        """Write epochs as a block of commands."""
        self._blocks.append([])
        for epoch in epochs:
            self._write_epoch(epoch)

    def write_trials(self) -> None:
        """Write the blocks of trials: the energy where the atoms are, and one for each of `TRIAL_KERNELS`."""
        self.write_block([Epoch(ENERGY)])
        self._teams[NO_TEAM] = [_trial_functions()]
        for name in TRIAL_KERNELS:
            self._blocks.append([Command(REORDER)] if name == DRAW else [])
            team = SUM_TEAM if name == SUM_MOTION else BLOCK
            threads = SUM_TEAM if name == SUM_MOTION else self._n_particles
            noise = self._n_particles if name == DRAW else 0
            source = list(self._teams).index(NO_TEAM)
            kernel = Kernel(name, source, tuple(ARGUMENTS), threads, team, noise, name == GO_BACK)
            self._kernels[NO_TEAM, name] = kernel
            self._commands.append(Command(LAUNCH, len(self._kernels) - 1))
            if name == DRAW:
                call = [Call(MAKE_RIGID)]
                self._write_epoch(Epoch(NOTHING, call, [call]))
            if name == GO_BACK and self._has_sites:
                self._commands.append(Command(SITES))

    def program(self) -> StepProgram:
        """Return the program of all blocks."""
        tables = self._tables
        vectors = np.zeros(4 * self._n_particles)
        of_trials = vectors if NO_TEAM in self._teams else np.zeros(4)
        heat_parts = max(1, sum(mover.number for mover in (*tables.others, *tables.members)))
        return StepProgram(
            sources=tuple(_source(team, texts, self._n_particles) for team, texts in self._teams.items()),
            integers=tables.integers,
            numbers={
                **tables.numbers,
                "kept": vectors,
                BATHED: vectors,
                "startX": of_trials,
                "startV": of_trials,
                VALUES: np.zeros(N_VALUES),
                SUMS: np.zeros(N_SUMS),
            },
            totals={"heat": heat_parts},
            kernels=tuple(self._kernels.values()),
            blocks=tuple(map(tuple, self._blocks)),
            bodies=tables.atoms,
        )

    def _write_epoch(self, epoch: Epoch) -> None:
        if epoch.begins_with == UPDATES:
            self._commands.append(Command(UPDATE))
        elif epoch.begins_with == FORCES:
            self._commands.append(Command(FORCES, _signed(~self._fast_groups)))
        elif epoch.begins_with == ENERGY:
            if self._fast_groups:
                self._commands.append(Command(FORCES_AND_ENERGY, _signed(self._fast_groups)))
            self._commands.append(Command(FORCES_AND_ENERGY, _signed(~self._fast_groups)))
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
    buffer = f"    LOCAL mixed buffer[{3 * team}];\n" if team > 1 else ""
    return f"KERNEL void {name}({_parameters()}) {{\n{buffer}{body}}}\n"


def _parameters() -> str:
    """Return the parameters of all kernels."""
    declarations = []
    for argument, declaration in ARGUMENTS.items():
        if argument == "posqCorrection":
            declarations.append(f"#ifdef USE_MIXED_PRECISION\n    {declaration},\n#endif")
        else:
            declarations.append(f"    {declaration},")
    return "\n" + "\n".join(declarations).rstrip(",")


def _trial_functions() -> str:
    """Return the kernels of trials."""
    return _text("trials.cc").replace("(PARAMETERS)", f"({_parameters()})")


def _text(name: str) -> str:
    """Return a file of this folder."""
    return resources.files("openmm_sier.engines.compiled").joinpath(name).read_text()


def _source(team: int, texts: Iterable[str], n_particles: int) -> str:
    """Return kernels with what they have in common."""
    # Its formulas bring Numba, which takes long to import.
    from openmm_sier.engines.compiled import rotation

    head, marker, rest = _text("motion.cc").partition("// --- formulas ---\n")
    constants = {
        "LANES": max(1, team),
        "MOST_IN_CLUSTER": MOST_IN_CLUSTER,
        "LONGEST_PHASE": literal(rotation.LONGEST_PHASE),
        "NUM_PARTICLES": n_particles,
        "SUM_TEAM": SUM_TEAM,
    }
    defined = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    return "\n".join([defined + head, rotation.functions(), marker + rest, _text("clusters.cc"), *texts])
