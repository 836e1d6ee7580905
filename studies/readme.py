"""The uses that README and the first page of the documentation list, each with its gain and the alternative.

Gains are on CPUs: the record of a GPU is of an earlier native engine.
"""

from __future__ import annotations

from collections.abc import Iterator

from studies import claim_figures as figures
from studies.trust import ANY, Claim

#: Uses, each of claims about one or more records.
USES: tuple[tuple[Claim, ...], ...] = (
    (
        Claim(
            "**Averages of a protein or another solute in water**: {peptide:.1f} to {dhfr:.1f} times as fast on a CPU "
            "as OpenMM's LangevinMiddle at 4 fs (its longest step, 5 fs: {rival:.1f}), both with heavy hydrogens.",
            "speed.json",
            figures.solutes_on_a_cpu,
            {"dhfr": (1.7, ANY), "peptide": (1.7, ANY), "rival": (1.1, 1.4)},
            in_readme=True,
        ),
    ),
    (
        Claim(
            "**Averages of rigid water**: {middle:.1f} times as fast, with OpenMM's own LangevinMiddle, which takes 9 "
            "fs after `prepare_system` (with SIERLangevinIntegrator: {own:.1f}).",
            "heat-bath.json",
            figures.water_on_a_cpu,
            {"middle": (1.8, ANY), "own": (1.8, ANY)},
            in_readme=True,
        ),
    ),
    (
        Claim(
            "**Dynamics at constant energy** (viscosity, diffusion, spectra): {least:.1f} to {most:.0f} times smaller "
            "energy errors than Verlet with as many forces, one start of each liquid;",
            "whole-run.json",
            figures.gains_of_whole_runs,
            {"least": (3, ANY), "most": (20, ANY)},
            in_readme=True,
        ),
        Claim(
            "the price: {least:.2f} to {most:.2f} times the speed of Verlet at 2 fs on a CPU,",
            "speed.json",
            figures.price_at_constant_energy,
            {"least": (0.6, 1), "most": (0.6, 1)},
            in_readme=True,
        ),
        Claim(
            "and {least:.1f} to {most:.1f} times that of LangevinMiddle at 4 fs on an H200 with an earlier version.",
            "gpu.json",
            figures.price_on_a_gpu,
            {"most": (0, 1)},
            in_readme=True,
        ),
    ),
    (
        Claim(
            "**Averages without an error of the step**, by hybrid Monte Carlo: {least:.0f} ± {least_error:.0f} to "
            "{most:.0f} ± {most_error:.0f} % fewer force evaluations than LangevinMiddle at 4 fs for the same error "
            "bar of the energy, in boxes of 64 molecules of water and around a peptide, on a CPU.",
            "trials.json",
            figures.savings_of_trials,
            {"least": (0, ANY), "most": (20, ANY)},
            in_readme=True,
        ),
    ),
    (
        Claim(
            "**Rigid molecules, nanoparticles and domains of any size**: patchy particles in a heat bath {bath:.1f} "
            "times as fast as with LangevinMiddle and springs, at its longest right step of {rival:.0f} fs.",
            "domains.json",
            figures.patchy_particles,
            {"bath": (1.1, ANY)},
            in_readme=True,
        ),
    ),
)


def uses() -> str:
    """Return the list of uses with the figures of the records, in Markdown."""
    lines = (" ".join(claim.sentence() for claim in use) for use in USES)
    return "".join(f"- {line}\n" for line in lines)


def claims() -> Iterator[Claim]:
    """Yield the claims of the list."""
    for use in USES:
        yield from use
