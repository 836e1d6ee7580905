"""The table of README: for each purpose the gain on a CPU and on a GPU over OpenMM's integrators at their best.

A cell is text, or claims that fill it with figures of records.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from studies import claim_figures as figures
from studies.trust import ANY, Claim

Cell = tuple[Claim | str, ...]

HEADINGS = ("You want", "Take", "On a CPU", "On a GPU (H200)")


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        purpose: of the user.
        code: lines of a script.
        on_cpu: gain on a CPU.
        on_gpu: gain on a GPU.
    """

    purpose: str
    code: str
    on_cpu: Cell
    on_gpu: Cell


HEAVY = "`prepare_system(system, hydrogenMass=4*dalton)`"

ROWS = (
    Row(
        "averages of a protein or another solute in water",
        f"{HEAVY}, `SIERLangevinIntegrator`, 9 fs",
        (
            Claim(
                "{dhfr:.1f}; around a peptide {peptide:.1f} (LangevinMiddle at 5 fs: {rival:.1f})",
                "speed.json",
                figures.solutes_on_a_cpu,
                {"dhfr": (1.7, ANY), "peptide": (1.7, ANY), "rival": (1.1, 1.4)},
            ),
        ),
        (
            Claim(
                "{one:.1f} (LangevinMiddle at 5 fs: {rival:.1f}); in a large box {eight:.1f} ({rival_eight:.1f})",
                "gpu.json",
                figures.solutes_on_a_gpu,
                {"one": (1.3, ANY), "eight": (1.2, ANY), "rival": (1.1, 1.4)},
            ),
        ),
    ),
    Row(
        "averages of rigid water alone, except its density",
        f"{HEAVY}, OpenMM's LangevinMiddle, 9 fs",
        (
            Claim(
                "{middle:.1f} (SIER2 at 9 fs: {own:.1f};",
                "heat-bath.json",
                figures.water_on_a_cpu,
                {"middle": (1.8, ANY), "own": (1.8, ANY)},
            ),
            Claim(
                "LangevinMiddle at 10 fs: {longer:.1f})",
                "speed.json",
                figures.longer_steps_in_water,
                {"longer": (1.9, ANY)},
            ),
        ),
        (
            Claim(
                "{middle:.1f} (SIER2 at 9 fs: {own:.1f})",
                "gpu.json",
                figures.water_on_a_gpu,
                {"middle": (2, ANY), "own": (1.7, ANY)},
            ),
        ),
    ),
    Row(
        "averages without an error of the step",
        f"{HEAVY}, `SIERHMCIntegrator`, 9 fs",
        (
            Claim(
                "{least:.0f} to {most:.0f} % fewer force evaluations than LangevinMiddle at 4 fs, for the same error "
                "bar of the energy",
                "trials.json",
                figures.savings_of_trials,
                {"least": (0, ANY)},
            ),
            Claim(
                "(LangevinMiddle at 9 fs in TIP3P, not exact: {least:.0f} to {most:.0f} % fewer)",
                "heat-bath.json",
                figures.savings_of_long_steps,
                {"least": (20, ANY)},
            ),
        ),
        (
            Claim(
                "nothing: {water:.1f} in water, {dhfr:.1f} around a protein",
                "gpu.json",
                figures.trials_on_a_gpu,
                {"water": (0, 1), "dhfr": (0, 1)},
            ),
        ),
    ),
    Row(
        "an energy that holds: viscosity, diffusion, spectra",
        "`prepare_system(system)`, `SIERIntegrator`, 4 fs",
        (
            Claim(
                "over 100 ps {least:.0f} to {most:.0f} times smaller energy errors than Verlet at 1.33 fs, also "
                "prepared, with as many forces",
                "whole-run.json",
                figures.gains_of_large_boxes,
                {"least": (10, ANY)},
            ),
        ),
        (
            Claim(
                "{least:.1f} times smaller than Verlet at 1 fs, also prepared; preparing makes that of Verlet "
                "{protein:.1f} to {water:.1f} times smaller",
                "gpu.json",
                figures.energies_on_a_gpu,
                {"least": (1, ANY), "water": (3, ANY), "protein": (1.5, ANY)},
            ),
        ),
    ),
    Row(
        "rigid bodies, such as patchy particles",
        "`RigidBodies`, `SIERLangevinIntegrator` at 60 fs, or `SIERIntegrator`",
        (
            Claim(
                "in a bath {bath:.1f} times LangevinMiddle with springs at {rival:.0f} fs; at constant energy "
                "{energy:.0f} times Verlet with springs, at the same error (extrapolated)",
                "domains.json",
                figures.patchy_particles,
                {"bath": (1.1, ANY), "energy": (50, ANY)},
            ),
        ),
        ("not measured",),
    ),
    Row(
        "coarse-grained chains with rigid domains",
        "`RigidBodies`, `SIERIntegrator`, 30 fs",
        (
            Claim(
                "{energy:.1f} times Verlet with springs, at the same energy error; in a bath nothing: {bath:.1f} times "
                "LangevinMiddle with springs, both at 60 fs",
                "domains.json",
                figures.chains,
                {"energy": (4, ANY), "bath": (0.9, 1.1)},
            ),
        ),
        (
            Claim(
                "nothing: LangevinMiddle with springs is {rival:.1f} times as fast",
                "gpu.json",
                figures.chains_on_a_gpu,
                {"rival": (3, ANY)},
            ),
        ),
    ),
)


def claims() -> Iterator[Claim]:
    """Yield the claims of the table, each with its purpose and column before its text."""
    for row in ROWS:
        for heading, cell in zip(HEADINGS[2:], (row.on_cpu, row.on_gpu), strict=True):
            for claim in cell:
                if isinstance(claim, Claim):
                    yield replace(claim, text=f"README, {row.purpose}, {heading}: {claim.text}")


def table() -> str:
    """Return the table with the figures of the records, in Markdown."""
    rows = [(row.purpose, row.code, _filled(row.on_cpu), _filled(row.on_gpu)) for row in ROWS]
    lines = [HEADINGS, ("---",) * len(HEADINGS), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _filled(cell: Cell) -> str:
    return " ".join(claim if isinstance(claim, str) else claim.sentence() for claim in cell)
