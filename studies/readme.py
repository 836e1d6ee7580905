"""The uses that README and the first page of the documentation list, each with its gain, its price and the alternative.

Gains are on CPUs, but where a GPU is named: that record is of an earlier native engine.
"""

from __future__ import annotations

from collections.abc import Iterator

from studies import claim_figures as figures
from studies.trust import ANY, Claim

#: Uses, each of claims about one or more records.
USES: tuple[tuple[Claim, ...], ...] = (
    (
        Claim(
            "**Averages of a protein or another solute in water**: {dhfr:.2f} ± {dhfr_error:.2f} times as fast on a "
            "CPU as OpenMM's LangevinMiddle at 4 fs around DHFR, and {peptide:.2f} ± {peptide_error:.2f} times around "
            "a peptide, where LangevinMiddle at 5 fs, its longest step, is {rival:.2f} ± {rival_error:.2f} times as "
            "fast; all with heavy hydrogens.",
            "speed.json",
            figures.solutes_on_a_cpu,
            {"dhfr": (1.7, ANY), "peptide": (1.7, ANY), "rival": (1.1, 1.4)},
            in_readme=True,
        ),
        Claim(
            "On an H200 an earlier version was {dhfr:.2f} ± {dhfr_error:.2f} times as fast; this one was not timed on "
            "a GPU.",
            "gpu.json",
            figures.speeds_on_a_gpu,
            {"dhfr": (1.3, ANY)},
            in_readme=True,
        ),
        Claim(
            "The error of the potential energy around a peptide is {own:+.2f} ± {own_error:.2f} % (LangevinMiddle at 4 "
            "fs: {middle:+.2f} ± {middle_error:.2f} %).",
            "heat-bath.json",
            figures.peptide_in_a_bath,
            {"own": (-0.2, 0.2)},
            in_readme=True,
        ),
    ),
    (
        Claim(
            "**Averages of rigid water**: after `prepare_system` OpenMM's own LangevinMiddle takes 9 fs, which is "
            "{middle:.2f} ± {middle_error:.2f} times as fast on a CPU as 4 fs in 4096 molecules "
            "(SIERLangevinIntegrator at 9 fs: {own:.2f} ± {own_error:.2f} times).",
            "speed.json",
            figures.water_on_a_cpu,
            {"middle": (1.8, ANY), "own": (1.8, ANY)},
            in_readme=True,
        ),
    ),
    (
        Claim(
            "**Dynamics at constant energy** (viscosity, diffusion, spectra), with unchanged masses: energy errors "
            "{least:.1f} ± {least_error:.1f} (TIP5P) to {most:.1f} ± {most_error:.1f} times (TIP3P) smaller than "
            "Verlet's with as many forces, in 64 molecules of five models of water ({starts:.0f} starts of 50 "
            "ps each, OpenMM's default tolerance of PME),",
            "whole-run.json",
            figures.gains_of_several_starts,
            {"least": (3, ANY), "most": (15, ANY), "liquids": (5, 5), "outside": (0, 0), "starts": (3, ANY)},
            in_readme=True,
        ),
        Claim(
            "and {least:.1f} to {most:.0f} times in {count:.0f} single runs at a tighter tolerance, of 64 and 512 "
            "molecules and a peptide, 50 ps to 1 ns.",
            "whole-run.json",
            figures.gains_of_single_runs,
            {"least": (3, ANY), "most": (20, ANY), "count": (8, 8)},
            in_readme=True,
        ),
        Claim(
            "A C=O stretch in water is {verlet:.1f} ± {verlet_error:.1f} cm⁻¹ too high with Verlet at 2 fs, and "
            "{short:.1f} with Verlet at 1 fs, which costs as much as SIERIntegrator at 4 fs, where it is off by "
            "{own:+.1f} ± {own_error:.1f} ({starts:.0f} starts).",
            "vibrations.json",
            figures.frequencies,
            {"verlet": (20, 40), "own": (-5, 5), "price": (0.8, 1.25), "starts": (2, ANY)},
            in_readme=True,
        ),
        Claim(
            "The price: at its step of 4 fs SIERIntegrator is {least:.2f} to {most:.2f} ± {most_error:.2f} times as "
            "fast as Verlet at 2 fs on a CPU,",
            "speed.json",
            figures.price_at_constant_energy,
            {"least": (0.6, 1), "most": (0.6, 1)},
            in_readme=True,
        ),
        Claim(
            "and was {least:.1f} to {most:.1f} times as fast as LangevinMiddle at 4 fs on an H200, with an earlier "
            "version.",
            "gpu.json",
            figures.price_on_a_gpu,
            {"most": (0, 1)},
            in_readme=True,
        ),
    ),
    (
        Claim(
            "**Averages without an error of the time step**, by hybrid Monte Carlo: the same error bar of the energy "
            "takes fewer force evaluations than with LangevinMiddle at 4 fs, by {least:.0f} ± {least_error:.0f} % to "
            "{most:.0f} ± {most_error:.0f} % in three boxes of 64 molecules of water and around a peptide, on a CPU.",
            "trials.json",
            figures.savings_of_trials,
            {"least": (0, ANY), "most": (20, ANY)},
            in_readme=True,
        ),
    ),
    (
        Claim(
            "**Rigid bodies of any shape and size**, which OpenMM lacks: patchy colloids with massless patches, "
            "nanoparticles, rods with a friction of their own along each axis, rigid domains of chains. In a heat bath "
            "patchy particles at 60 fs are {bath:.1f} ± {bath_error:.1f} times as fast on a CPU as springs with "
            "LangevinMiddle at {rival:.0f} fs, its longest step with right averages.",
            "domains.json",
            figures.patchy_particles,
            {"bath": (1.1, ANY)},
            in_readme=True,
        ),
        Claim(
            "At constant energy rings of liquid benzene take {usual:.2f} ± {usual_error:.2f} times the processor time "
            "of `fix rigid/nve/small` of LAMMPS on one thread, at an energy error of 0.1 %.",
            "beside-lammps.json",
            figures.costs_beside_lammps,
            {"usual": (0, 0.6), "small": (0, 0.6)},
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
