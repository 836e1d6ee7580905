"""Claims of README and the documentation about measurements, each with its record.

A claim is a sentence with fields for its figures. They come from a record in studies/data, and have bounds, which the
tests assert, as they assert that README and the draft of the paper have the sentence with these figures. The uses that
README lists are in `studies.readme`. The page docs/measurements/trust.md lists all claims.

    python -m studies.claims

prints the sentences of README and of the draft.
"""

from __future__ import annotations

from studies import claim_figures as figures
from studies import readme
from studies.trust import ANY, Claim

CONSTANT_ENERGY = (
    Claim(
        "With {starts:.0f} starts of 50 ps in 64 molecules of five models of water the energy error of SIER4G at 4 fs "
        "is {least:.1f} ± {least_error:.1f} (TIP5P) to {most:.1f} ± {most_error:.1f} times (TIP3P) smaller than that "
        "of OpenMM's Verlet at 1.33 fs, which computes forces as often.",
        "whole-run.json",
        figures.gains_of_several_starts,
        {"least": (3, ANY), "most": (15, ANY), "liquids": (5, 5), "outside": (0, 0), "starts": (4, 4)},
        in_paper=True,
    ),
    Claim(
        "In {count:.0f} single runs at a tighter tolerance, of larger boxes and a peptide too, and of up to 1 ns, it "
        "is {least:.1f} to {most:.0f} times smaller.",
        "whole-run.json",
        figures.gains_of_single_runs,
        {"least": (3, ANY), "most": (20, ANY), "count": (8, 8)},
        in_paper=True,
    ),
    Claim(
        "Over 1 ns of 64 molecules of TIP3P it is {gain:.1f} times smaller.",
        "whole-run.json",
        figures.gain(time=1000.0),
        {"gain": (8, ANY)},
        in_paper=True,
    ),
    Claim(
        "On a CPU SIER4G at 4 fs simulates {least:.2f} to {most:.2f} times as much in a day as Verlet at 2 fs.",
        "speed.json",
        figures.price_at_constant_energy,
        {"least": (0.6, 1), "most": (0.6, 1)},
        in_paper=True,
    ),
    Claim(
        "On a GPU (H200), with an earlier version of the native engine, it simulates {least:.1f} to {most:.1f} times "
        "as much as LangevinMiddle at 4 fs.",
        "gpu.json",
        figures.price_on_a_gpu,
        {"most": (0, 1)},
    ),
    Claim(
        "No drift is seen in these runs: none is more than {off:.1f} of its errors.",
        "whole-run.json",
        figures.drifts,
        {"off": (0, 3)},
    ),
    Claim(
        "At 6 fs the energy of SIER4G walks at random, and the gain over 50 ps is only {gain:.1f}.",
        "whole-run.json",
        figures.gain(step=6.0),
        {"gain": (1, 3)},
        in_paper=True,
    ),
    Claim(
        "Within 1 ps SIER2P3 at 12 fs has {least:.1f} to {most:.1f} times the energy error of Verlet at 2 fs, for half"
        " its forces.",
        "schemes.json",
        figures.errors_at_long_steps,
        {"most": (0, 1.5)},
    ),
    Claim(
        "At OpenMM's default tolerance SIER4G at 6 fs has an energy error of {before:.2f} % within 1 ps, and "
        "{after:.2f} % on a prepared System, where Verlet at 2 fs has {verlet:.2f} %.",
        "defaults.json",
        figures.preparation,
        {"gain": (8, ANY)},
    ),
    Claim(
        "At constant energy rotations of SIER4G at 6 fs are as warm as translations, within {own_error:.1f} K; with "
        "Verlet at 2 fs they differ by {verlet:.1f} ± {verlet_error:.1f} K.",
        "equipartition.json",
        figures.equipartition,
        {"off": (0, 2), "verlet": (-ANY, -1)},
    ),
)

IN_A_HEAT_BATH = (
    Claim(
        "On a CPU SIER2 at 9 fs simulates {dhfr:.1f} times as much in a day around a protein as OpenMM's "
        "LangevinMiddle at 4 fs, and {peptide:.1f} times around a peptide, with heavy hydrogens for both, where "
        "LangevinMiddle at 5 fs has {rival:.1f}; in water it is at least {least:.1f} times.",
        "speed.json",
        figures.speeds_in_a_bath,
        {"least": (1.9, ANY), "peptide": (1.7, ANY), "dhfr": (1.7, ANY), "rival": (1.1, 1.4)},
        in_paper=True,
    ),
    Claim(
        "In TIP3P LangevinMiddle at 9 fs on the same System simulates {middle:.2f} ± {middle_error:.2f} times as much "
        "as at 4 fs, and SIER2 {own:.2f} ± {own_error:.2f} times.",
        "speed.json",
        figures.water_on_a_cpu,
        {"middle": (1.8, ANY), "own": (1.8, ANY)},
        in_paper=True,
    ),
    Claim(
        "At 9 fs the potential energy of a peptide in water is off by {own:+.2f} ± {own_error:.2f} %, and the energies "
        "of its bonds, angles and torsions by up to {own_bonded:.1f} %; with LangevinMiddle at 4 fs these are "
        "{middle:+.2f} ± {middle_error:.2f} % and {middle_bonded:.1f} %.",
        "heat-bath.json",
        figures.peptide_in_a_bath,
        {"own": (-0.2, 0.2), "own_bonded": (0, 3)},
        in_paper=True,
    ),
    Claim(
        "At 9 fs and 1 bar the potential energy of TIP3P differs from the exact one by {potential:.2f} ± "
        "{potential_error:.2f} %, and the density by {density:.2f} ± {density_error:.2f} %.",
        "heat-bath.json",
        figures.water_in_a_bath,
        {"potential": (-0.2, 0.2), "density": (-0.6, 0.6)},
    ),
    Claim(
        "With SIER2 at 9 fs reports of the temperature of the water around the peptide are off the bath by {own:+.1f} "
        "± {own_error:.1f} K.",
        "heat-bath.json",
        figures.temperatures_in_a_bath,
        {"own": (-1, 1)},
    ),
    Claim(
        "On a GPU (H200), with an earlier version of the native engine, SIER2 at 9 fs simulates {dhfr:.1f} times as "
        "much as LangevinMiddle at 4 fs around a protein, and {water:.1f} times in water, where LangevinMiddle at 9 fs "
        "on the same System reaches {middle:.1f}.",
        "gpu.json",
        figures.speeds_on_a_gpu,
        {"water": (1.7, ANY), "dhfr": (1.3, ANY)},
        in_paper=True,
    ),
    Claim(
        "With light hydrogens SIER2 at 4 fs simulates {share:.0f} % of what LangevinMiddle does at 4 fs, in TIP3P.",
        "heat-bath.json",
        figures.light_hydrogens,
        {"share": (80, 120)},
    ),
    Claim(
        "LangevinMiddle at 4 fs gives three models of water the energy that it has at 1 fs within {energy:.1f} %.",
        "step-study.json",
        figures.energies_of_langevin_middle,
        {"energy": (0, 0.6)},
    ),
)

EXACT_AVERAGES = (
    Claim(
        "{count:.0f} averages of hybrid Monte Carlo whose values are known are met within {off:.1f} errors, at steps "
        "so long that half of the first ends are rejected.",
        "exactness.json",
        figures.known_averages,
        {"off": (0, 3), "count": (16, 16)},
        in_paper=True,
    ),
    Claim(
        "Hybrid Monte Carlo makes averages exact, and an independent potential energy costs {least:.1f} to {most:.1f} "
        "times the forces that it costs LangevinMiddle at 4 fs, in three models of water and around a peptide, and in "
        "small boxes of water, in steps of 12 fs, {least_longer:.1f} to {most_longer:.1f} times.",
        "trials.json",
        figures.costs_of_trials,
        {"most": (0, 1.2), "most_longer": (0, 0.85), "accepted": (0.85, 1)},
        in_paper=True,
    ),
    Claim(
        "In 64 molecules of TIP3P it costs {tip3p:.2f} ± {tip3p_error:.2f} times as many, of SPC/E {spce:.2f} ± "
        "{spce_error:.2f}, of TIP4P/2005 {tip4p2005:.2f} ± {tip4p2005_error:.2f}, and around a peptide {peptide:.2f} ± "
        "{peptide_error:.2f}.",
        "trials.json",
        figures.costs_of_trials,
        {"tip3p": (0, 0.7), "spce": (0, 2), "tip4p2005": (0, 1.3), "peptide": (0, 1.2)},
    ),
    Claim(
        "Of DHFR in water, 23558 atoms, {accepted:.0f} % of {trials:.0f} trials of 36 fs are accepted with SIER4G at 9 "
        "fs and heavy hydrogens.",
        "heat-bath.json",
        figures.trials_of_dhfr,
        {"accepted": (85, 100), "trials": (100, ANY)},
    ),
    Claim(
        "With hydrogens of 3 dalton in DHFR, and of 1 in water, {accepted:.0f} of {trials:.0f} trials of 30 fs are "
        "accepted with SIER4G at 6 fs, and {verlet:.0f} of {verlet_trials:.0f} with Verlet at 2 fs.",
        "solvated.json",
        figures.acceptance_of_dhfr,
        {"rate": (0.9, 1)},
    ),
    Claim(
        "In a mixture with N-methylacetamide the configurational temperature of water's rotation is {bias:.1f} ± "
        "{bias_error:.1f} K too high with LangevinMiddle at 4 fs, and off by {exact:.1f} errors with hybrid Monte "
        "Carlo.",
        "mixture.json",
        figures.mixture,
        {"exact": (0, 2)},
    ),
)

ROTATION_AND_ENGINES = (
    Claim(
        "After 10 ps of free rotation in steps of 8 fs the attitude is off by {own:.0e} with exact rotation, and by "
        "{mrdl:.2f} with a splitting about principal axes (MRDL).",
        "paper-free-rotation.json",
        figures.free_rotation,
        {"own": (0, 1e-11), "mrdl": (0.01, ANY)},
    ),
    Claim(
        "In liquid water with a scheme of second order, a splitting of the rotation about principal axes (MRDL, and in "
        "quaternions NO_SQUISH) has {ratio:.2f} times the energy error of exact rotation at 2 fs, and the paper's "
        "SIER4 has less up to {crossing:.1f} fs per force.",
        "paper-water.json",
        figures.splittings_about_axes,
        {"ratio": (0.9, 1.1), "crossing": (1.8, 2.3)},
        in_paper=True,
    ),
    Claim(
        "By OpenCL on a CPU the native engine has at most {most:.2f} times the energy error of the exact engine, in "
        "runs of 0.06 ps.",
        "native-platforms.json",
        figures.errors_by_opencl,
        {"most": (0, 1.2)},
    ),
    Claim(
        "On a CPU a step of the native engine takes {least:.1f} to {most:.1f} times as long as one of the exact "
        "engine.",
        "native-cost.json",
        figures.cost_of_native_steps,
        {"most": (0, 1.5)},
    ),
)

RIGID_DOMAINS = (
    Claim(
        "Of coarse-grained chains with rigid domains SIER4G at 30 fs simulates {gain:.1f} times as much in a day as "
        "Verlet at {verlet:.1f} fs with springs in the domains, at the same energy error.",
        "domains.json",
        figures.domains_at_constant_energy,
        {"gain": (4, ANY)},
    ),
    Claim(
        "In a bath their bonds and temperatures are exact within {off:.1f} errors with SIER2 at 60 fs, which simulates "
        "{over:.1f} times as much in a day as LangevinMiddle with the network at its usual 10 fs, and {longest:.1f} "
        "times as much as the same at 60 fs.",
        "domains.json",
        figures.domains_in_a_bath,
        {"off": (0, 3), "over": (2, ANY)},
    ),
    Claim(
        "Of patchy particles SIER4G at 60 fs simulates {over:.1f} times as much in a day as Verlet at {verlet:g} fs "
        "with springs, with an energy error of {error:.3f} % beside {its_error:.2f} %, from one start.",
        "domains.json",
        figures.patchy_particles_at_constant_energy,
        {"over": (4, ANY), "error": (0, 0.01)},
    ),
)

TOPICS = {
    "The uses that README lists": tuple(readme.claims()),
    "Constant energy": CONSTANT_ENERGY,
    "Averages in a heat bath": IN_A_HEAT_BATH,
    "Exact averages": EXACT_AVERAGES,
    "Rigid domains": RIGID_DOMAINS,
    "Free rotation, and engines": ROTATION_AND_ENGINES,
}

CLAIMS = tuple(claim for claims in TOPICS.values() for claim in claims)


def main() -> None:
    print(readme.uses())
    for claim in CLAIMS:
        if claim.in_readme or claim.in_paper:
            print(claim.sentence())


if __name__ == "__main__":
    main()
