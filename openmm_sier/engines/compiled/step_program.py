"""A step as a program of the package openmm-sier-kernels: tables, kernels in C, and commands."""

from typing import NamedTuple

import numpy as np

#: Kinds of command: OpenMM's own updates, forces of some groups, these and their energy, the launch of a kernel,
#: virtual sites, another order of the atoms in memory, and forces of some groups that a kernel has brought back.
UPDATE, FORCES, FORCES_AND_ENERGY = "update", "forces", "forces and energy"
LAUNCH, SITES, REORDER, RESTORED = "launch", "sites", "reorder", "restored"


class Kernel(NamedTuple):
    """A kernel in C.

    Attributes:
        name: of the function.
        source: the number of the source that it is in.
        arguments: names of its arguments, see `kernel_text.ARGUMENTS`.
        threads: number of threads.
        block: number of threads in a block.
        noise: number of random vectors of four that a launch uses.
        moves_atoms: whether it changes positions.
    """

    name: str
    source: int
    arguments: tuple[str, ...]
    threads: int
    block: int
    noise: int
    moves_atoms: bool


class Command(NamedTuple):
    """A command.

    Attributes:
        kind: one of the kinds above.
        number: bit mask of force groups, number of a kernel, or of steps since atoms could get another order.
    """

    kind: str
    number: int = 0


class StepProgram(NamedTuple):
    """A step.

    Attributes:
        sources: kernels in C.
        integers, numbers: tables that kernels read, by their names.
        totals: sums that kernels add to, by their names, with the number of their parts.
        kernels: all kernels.
        blocks: commands of a step, and those of other blocks that are executed one by one.
        bodies: atoms that must stay together, (m, k) for each kind.
    """

    sources: tuple[str, ...]
    integers: dict[str, np.ndarray]
    numbers: dict[str, np.ndarray]
    totals: dict[str, int]
    kernels: tuple[Kernel, ...]
    blocks: tuple[tuple[Command, ...], ...]
    bodies: tuple[np.ndarray, ...]
