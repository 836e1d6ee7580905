"""What README and the documentation claim, each beside the record or the tests that show it.

    python -m studies.claims        writes docs/measurements/trust.md, and the figures into README and the paper's draft

A claim is a sentence with fields for its figures. Figures come from a record in studies/data, and each has a bound: a
record that no longer keeps it fails the tests, and so does a sentence of README that is not this one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import pandas as pd

from openmm_sier.dynamics.schemes import SIER2, SIER4G
from studies import records
from studies.command import SYSTEMS
from studies.records import Record

ROOT = SYSTEMS.parent
DATA = ROOT / "studies" / "data"
PAGE = ROOT / "docs" / "measurements" / "trust.md"

README, DRAFT = ROOT / "README.md", ROOT / "paper" / "paper.md"

#: README's table of speeds.
TABLE = re.compile(r"\| \| water, 512 .*?(?=\n(?!\|))", re.DOTALL)

#: Least and most that a figure may be.
Bound = tuple[float, float]

#: No bound on this side.
ANY = float("inf")


@dataclass(frozen=True)
class Claim:
    """A claim that a record shows.

    Attributes:
        text: the sentence, with fields such as {least:.0f}.
        record: file in studies/data.
        command: that makes it.
        figures: of the record, by the names of the fields.
        bounds: of figures, by name.
        in_readme: whether README has the sentence, word for word.
        in_paper: whether the draft of the paper has it.
    """

    text: str
    record: str
    command: str
    figures: Callable[[Record], Mapping[str, float]]
    bounds: Mapping[str, Bound]
    in_readme: bool = False
    in_paper: bool = False

    def found(self) -> Mapping[str, float]:
        """The figures of the record."""
        return self.figures(records.read(DATA / self.record))

    def sentence(self) -> str:
        """The text with its figures."""
        return self.text.format_map(self.found())


@dataclass(frozen=True)
class Tested:
    """A claim that tests show.

    Attributes:
        text: the sentence.
        tests: files or folders, or files with the name of a test after "::".
        more: a study that shows it too.
    """

    text: str
    tests: tuple[str, ...]
    more: str = field(default="")


# --- figures ---


def _one(frame: pd.DataFrame, **wanted: object) -> pd.Series:
    """The only row that has these values.

    Raises:
        LookupError: there is none, or there are several.
    """
    rows = frame
    for name, value in wanted.items():
        rows = rows[rows[name] == value]
    if len(rows) != 1:
        raise LookupError(f"{len(rows)} rows have {wanted}")
    return rows.iloc[0]


def _large_boxes(record: Record) -> Mapping[str, float]:
    gains, usual = record.tables["gains"], 1e3 * SIER4G.constant_energy_step
    large = gains[(gains["time"] == 100) & (gains["step"] == usual) & (gains["molecules"] != 64)]["gain"]
    # Rounded down, which claims no more than there is.
    return {"least": int(large.min()), "most": int(large.max()), "count": len(large)}


def _gain(**wanted: object) -> Callable[[Record], Mapping[str, float]]:
    return lambda record: {"gain": _one(record.tables["gains"], method="SIER4G", **wanted)["gain"]}


def _long_steps(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    ratios = [
        _one(rows, liquid=liquid, method="SIER2P3", step=12.0)["percent"]
        / _one(rows, liquid=liquid, method="OpenMM Verlet", step=2.0)["percent"]
        for liquid in rows["liquid"].unique()
    ]
    return {"least": min(ratios), "most": max(ratios)}


def _preparation(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    switched = rows[(rows["tolerance"] == 5e-4) & (rows["cutoff"] == 0.9) & (rows["switch"] == "yes")]
    means = switched.groupby(["balanced", "method"])["percent"].mean()
    return {
        "before": means["no", "SIER4G"],
        "after": means["yes", "SIER4G"],
        "verlet": means["yes", "OpenMM Verlet"],
        "gain": means["no", "SIER4G"] / means["yes", "SIER4G"],
    }


def _axes(record: Record) -> Mapping[str, float]:
    """Splittings of the rotation about axes, over exact rotation, at 1.8 and 2.2 fs with PME."""
    rows = record.tables["points"]
    rows = rows[(rows["kind"] == "PME") & rows["force_step_fs"].isin([1.8, 2.2])]
    means = rows.groupby("method")["percent"].mean()
    crossing = _one(record.tables["crossings"], kind="PME")["force_step_fs"]
    return {"ratio": means["MRDL"] / means["SIER2"], "crossing": crossing}


def _equipartition(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    verlet, own = _one(rows, method="OpenMM Verlet", step=2.0), _one(rows, method="SIER4G", step=6.0)
    return {
        "verlet": verlet["difference"],
        "verlet_error": verlet["difference_error"],
        "own": own["difference"],
        "own_error": own["difference_error"],
        "off": abs(own["difference"]) / own["difference_error"],
    }


def _speeds(record: Record) -> Mapping[str, float]:
    rows, step = record.tables["speeds"], 1e3 * (SIER2.heavy_bath_step or 0)
    water = rows[(rows["name"] == "SIER2 in a bath, 10 fs") & rows["box"].str.startswith("water")]["over_middle"]
    solute = {
        box: _one(rows, name=f"SIER2 in a bath, {step:g} fs", box=box)["over_middle"] for box in ("peptide", "dhfr")
    }
    return {"least": water.min(), "most": water.max(), **solute}


def _bath(box: str, at: str, step: float, *averaged: str) -> Callable[[Record], Mapping[str, float]]:
    """Averages of SIER2 beside exact ones: the largest difference in errors, and temperatures."""

    def found(record: Record) -> Mapping[str, float]:
        rows = record.tables["rows"]
        own = _one(rows, box=box, at=at, method=f"SIER2, {step:g} fs")
        exact = _one(rows, box=box, at=at, method="SIER4G HMC, 8 fs")
        off = {
            name: abs(own[name] - exact[name]) / (own[f"{name}_error"] ** 2 + exact[f"{name}_error"] ** 2) ** 0.5
            for name in averaged
        }
        shares = {f"{name}_share": 100 * abs(own[name] / exact[name] - 1) for name in averaged}
        hot = {f"{part}_off": own[part] - 297 for part in ("water", "solute") if own[part] == own[part]}
        return {"off": max(off.values()), **shares, **hot, "step": step}

    return found


def _trials_of_dhfr(record: Record) -> Mapping[str, float]:
    row = _one(record.tables["rows"], box="dhfr", method="SIER4G HMC, 9 fs")
    return {"accepted": row["accepted"], "trials": row["trials"]}


def _middle(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    middle = rows[rows["method"] == "OpenMM LangevinMiddle"].set_index(["box", "step"])
    energies = [middle.loc[(box, 4.0), "energy"] / middle.loc[(box, 1.0), "energy"] - 1 for box in rows["box"].unique()]
    return {"energy": 100 * max(map(abs, energies))}


def _exactness(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    return {"count": len(rows), "off": rows["off"].abs().max()}


def _solvated(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    row = _one(rows, box="dhfr", moving="all", masses="3", scheme="sier4g", per_force=2.0)
    verlet = _one(rows, box="dhfr", moving="all", masses="3", scheme="verlet", per_force=2.0)
    return {
        "accepted": row["accepted"],
        "trials": row["trials"],
        "rate": row["accepted"] / row["trials"],
        "verlet": verlet["accepted"],
        "verlet_trials": verlet["trials"],
    }


def _mixture(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"].set_index("label")
    exact = rows.loc["HMC, SIER4G, 2 fs, hydrogens of 1"]
    middle = rows.loc["LangevinMiddle, 4 fs, hydrogens of 1"]
    return {
        "exact": abs(exact["conf_rotation"] - 298.15) / exact["conf_rotation_error"],
        "bias": middle["conf_rotation"] - 298.15,
        "bias_error": middle["conf_rotation_error"],
    }


# --- the list ---

WHOLE_RUN = "python -m studies.whole_run"
HEAT_BATH = "python -m studies.heat_bath"

CLAIMS = (
    Claim(
        "Over 100 ps of 512 molecules the energy error of SIER4G at 4 fs is {least:.0f} to {most:.0f} times smaller "
        "than that of Verlet at 1.33 fs, which takes as many forces, in {count} liquids.",
        "whole-run.json",
        f"{WHOLE_RUN} --molecules 512 --time 100 --methods verlet sier4g --per-force 1.3333333333333333 "
        "--liquids TIP3P SPC/E TIP4P/2005 OPC peptide",
        _large_boxes,
        {"least": (10, ANY), "count": (5, ANY)},
        in_readme=True,
        in_paper=True,
    ),
    Claim(
        "In TIP5P it is {gain:.1f} times smaller.",
        "whole-run.json",
        f"{WHOLE_RUN} --liquids TIP5P --molecules 64 --time 100",
        _gain(liquid="TIP5P"),
        {"gain": (3, ANY)},
        in_readme=True,
        in_paper=True,
    ),
    Claim(
        "Over 1 ns of 64 molecules of TIP3P it is {gain:.0f} times smaller.",
        "whole-run.json",
        f"{WHOLE_RUN} --liquids TIP3P --molecules 64 --time 1000",
        _gain(time=1000.0),
        {"gain": (8, ANY)},
        in_readme=True,
        in_paper=True,
    ),
    Claim(
        "At 6 fs the energy of SIER4G walks at random, and the gain over 50 ps is only {gain:.1f}.",
        "whole-run.json",
        WHOLE_RUN,
        _gain(step=6.0),
        {"gain": (1, 3)},
        in_paper=True,
    ),
    Claim(
        "Within 1 ps SIER2P3 at 12 fs has {least:.1f} to {most:.1f} times the energy error of Verlet at 2 fs, for half"
        " its forces.",
        "schemes.json",
        "python -m studies.schemes systems/BOX.pdb --schemes verlet sier2p3 --dt 2 4",
        _long_steps,
        {"most": (0, 1.5)},
        in_paper=True,
    ),
    Claim(
        "In liquid water with a scheme of second order, a splitting of the rotation about principal axes (MRDL, and in "
        "quaternions NO_SQUISH) has {ratio:.2f} times the energy error of exact rotation at 2 fs, and the paper's "
        "SIER4 has less up to {crossing:.1f} fs per force.",
        "paper-water.json",
        "python -m studies.paper",
        _axes,
        {"ratio": (0.9, 1.1), "crossing": (1.8, 2.3)},
        in_paper=True,
    ),
    Claim(
        "At OpenMM's default tolerance SIER4G at 6 fs has an energy error of {before:.2f} % within 1 ps, and "
        "{after:.2f} % on a prepared System, where Verlet at 2 fs has {verlet:.2f} %.",
        "defaults.json",
        "python -m studies.defaults",
        _preparation,
        {"gain": (8, ANY)},
    ),
    Claim(
        "At constant energy rotations of SIER4G at 6 fs are as warm as translations, within {own_error:.1f} K; with "
        "Verlet at 2 fs they differ by {verlet:.1f} ± {verlet_error:.1f} K.",
        "equipartition.json",
        "python -m studies.equipartition",
        _equipartition,
        {"off": (0, 2), "verlet": (-ANY, -1)},
    ),
    Claim(
        "In a heat bath, with heavy hydrogens for both, SIER2 simulates {least:.1f} to {most:.1f} times as much in a "
        "day as OpenMM's LangevinMiddle at 4 fs in water, {peptide:.1f} times with a peptide and {dhfr:.1f} times with"
        " a protein.",
        "speed.json",
        "python -m studies.speed",
        _speeds,
        {"least": (1.9, ANY), "peptide": (1.7, ANY), "dhfr": (1.7, ANY)},
        in_readme=True,
        in_paper=True,
    ),
    Claim(
        "At {step:g} fs the energies of bonds, angles and torsions of the peptide differ from exact ones by at most "
        "{off:.1f} errors, and the potential energy by {potential_share:.2f} %.",
        "heat-bath.json",
        HEAT_BATH,
        _bath("peptide", "constant volume", 9, "potential", "bonds", "angles", "torsions"),
        {"off": (0, 3), "potential_share": (0, 0.2), "water_off": (-1, 1)},
        in_paper=True,
    ),
    Claim(
        "At {step:g} fs and 1 bar the potential energy of TIP3P differs from the exact one by {potential_share:.2f} %,"
        " and the density by {density_share:.2f} %.",
        "heat-bath.json",
        f"{HEAT_BATH} systems/tip3p-512.pdb --time 100 --pressure 1",
        _bath("tip3p-512", "1 bar", 10, "potential", "density"),
        {"off": (0, 3), "potential_share": (0, 0.3), "density_share": (0, 0.6), "water_off": (-1, 1)},
        in_paper=True,
    ),
    Claim(
        "LangevinMiddle at 4 fs gives three models of water the energy that it has at 1 fs within {energy:.1f} %, so "
        "that with light hydrogens it is as good as any integrator here.",
        "step-study.json",
        "openmm-sier ensemble systems/step-study.toml",
        _middle,
        {"energy": (0, 0.6)},
    ),
    Claim(
        "{count:.0f} averages of hybrid Monte Carlo whose values are known are met within {off:.1f} errors, at steps "
        "so long that half of the trials are rejected.",
        "exactness.json",
        "python -m studies.hmc.exactness",
        _exactness,
        {"off": (0, 3), "count": (16, 16)},
        in_paper=True,
    ),
    Claim(
        "DHFR in water, 23558 atoms, has {accepted:.0f} of {trials:.0f} trials accepted with SIER4G at 6 fs, and "
        "{verlet:.0f} of {verlet_trials:.0f} with Verlet at 2 fs.",
        "solvated.json",
        "python -m studies.hmc.solvated dhfr --trials 100",
        _solvated,
        {"rate": (0.9, 1)},
    ),
    Claim(
        "DHFR in water, 23558 atoms, has {accepted:.0%} of {trials:.0f} trials of 36 fs accepted at 9 fs with heavy "
        "hydrogens.",
        "heat-bath.json",
        f'{HEAT_BATH} dhfr --methods "SIER4G HMC, 9 fs" --time 4',
        _trials_of_dhfr,
        {"accepted": (0.85, 1), "trials": (100, ANY)},
        in_readme=True,
        in_paper=True,
    ),
    Claim(
        "In a mixture with N-methylacetamide the configurational temperature of water's rotation is {bias:.1f} ± "
        "{bias_error:.1f} K too high with LangevinMiddle at 4 fs, and off by {exact:.1f} errors with hybrid Monte "
        "Carlo.",
        "mixture.json",
        "python -m studies.hmc.mixture",
        _mixture,
        {"exact": (0, 2)},
    ),
)

TESTED = (
    Tested(
        "Free rotation is exact: it agrees with SciPy's elliptic functions, an ODE solver and the paper's own formulas"
        " to rounding.",
        ("tests/dynamics/rotation",),
    ),
    Tested(
        "Schemes have the order that they claim, and are reversible.",
        ("tests/dynamics/test_schemes.py", "tests/dynamics/test_operators.py", "tests/dynamics/test_constrained.py"),
    ),
    Tested(
        "SIER2, SIER4 and SIER4V are symplectic to rounding, SIER4G and SIER4P up to fifth order in the step.",
        ("tests/dynamics/test_operators.py", "tests/dynamics/test_gradient_kick.py"),
    ),
    Tested(
        "Restarts are bit-identical on Reference, and on CPU with one thread.",
        ("tests/integrators/test_restart.py",),
        "python -m studies.checks.repeatability",
    ),
    Tested(
        "Rigid molecules of any kind are moved, and their degrees of freedom counted rightly.",
        ("tests/engines/test_body_kinds.py", "tests/engines/test_molecules.py", "tests/engines/test_temperature.py"),
    ),
    Tested(
        "Temperatures in a heat bath have no error of the step.",
        ("tests/integrators/test_langevin.py::test_temperatures_are_those_just_after_the_bath",),
    ),
    Tested("Hybrid Monte Carlo is exact with constraints too.", ("tests/integrators/test_hmc.py",)),
    Tested(
        "physical_validation finds no deviation of kinetic energies from the canonical ensemble, and openmmtools' "
        "caches, moves and replica exchange work.",
        ("tests/validation",),
        "python -m studies.checks.validate_water --out DIR",
    ),
    Tested(
        "A run that is killed or interrupted loses nothing that it has written.",
        ("tests/cli/test_stopping.py", "tests/cli/test_outputs.py"),
        "python -m studies.checks.kill_ensemble",
    ),
)

LIMITS = (
    "No GPU was at hand. The native engine was tested by OpenCL on a CPU, and its speed on GPUs is not known.",
    "Gains of single rows of whole runs are good to a factor of 1.5: a random walk scatters from start to start.",
    "Balanced sums of PME leave a net force on the box that is three to four times larger than OpenMM's, and still "
    "small (`python -m studies.checks.net_force`).",
    "Errors from fewer than 20 independent samples are too small. The command marks them.",
    "With the native engine an error inside a step of molecular dynamics leaves the Context where it happened, as with "
    "OpenMM's integrators.",
)


# --- the page, and README ---


def table_of_speeds() -> str:
    """README's table: simulated time over that of LangevinMiddle at 4 fs, in a heat bath."""
    rows = records.read(DATA / "speed.json").tables["speeds"]
    there = list(rows["box"].unique())
    wanted = {
        "OpenMM LangevinMiddle, 5 fs": "LangevinMiddle, 5 fs",
        "OpenMM MTSLangevin, 8 fs": "MTSLangevin, 8 fs",
        "SIER2 in a bath, 9 fs": "SIER2, 9 fs",
        "SIER2 in a bath, 10 fs": "SIER2, 10 fs, rigid molecules alone",
    }
    heads = [box.removeprefix("water-") if k else box.replace("-", ", ") for k, box in enumerate(there)]
    lines = [f"| | {' | '.join(heads)} |", "|---|" + "---|" * len(there)]
    for name, shown in wanted.items():
        mine = rows[rows["name"] == name].set_index("box")["over_middle"]
        cells = [
            f"{mine[box]:.2f}" if box in mine and not ("alone" in shown and "water" not in box) else "" for box in there
        ]
        lines.append(f"| {shown} | {' | '.join(cells)} |")
    return "\n".join(lines)


def page() -> str:
    """The page of the documentation."""
    shown = [f"| {one.sentence()} | `{one.command}` | `{one.record}` |" for one in CLAIMS]
    tested = []
    for one in TESTED:
        commands = "<br>".join(f"`{line}`" for line in (f"pytest {' '.join(one.tests)}", one.more) if line)
        tested.append(f"| {one.text} | {commands} |")
    return "\n".join(
        [
            "# How far it can be trusted",
            "",
            "Every claim of README and of this site, beside what shows it. `python -m studies.claims` makes this page.",
            "",
            "## Shown by measurements",
            "",
            "Each figure is read from a record in `studies/data`, and has a bound that the tests assert.",
            "",
            "| claim | command | record |",
            "|---|---|---|",
            *shown,
            "",
            "## Shown by tests",
            "",
            "| claim | command |",
            "|---|---|",
            *tested,
            "",
            "## Limits",
            "",
            *(f"- {one}" for one in LIMITS),
            "",
        ]
    )


def refreshed(text: str) -> str:
    """A text in which sentences of claims have the figures of the records, and README's table is the present one."""
    for claim in CLAIMS:
        words = [re.sub(r"\\\{.*?\\\}", r"\\S+?", re.escape(word)) for word in claim.text.split()]
        text = re.sub(r"\s+".join(words), lambda _, claim=claim: claim.sentence(), text)  # type: ignore[misc]
    return TABLE.sub(lambda _: table_of_speeds(), text)


def main() -> None:
    """Write the page, and the figures into README and the draft."""
    for path in (README, DRAFT):
        path.write_text(refreshed(path.read_text()))
    PAGE.write_text(page())


if __name__ == "__main__":
    main()
