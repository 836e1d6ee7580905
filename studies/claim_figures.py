"""Figures of claims, from their records."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import pandas as pd

from openmm_sier.dynamics.schemes import SIER2, SIER4G
from studies.hmc import trials
from studies.records import Record, percent_off
from studies.trust import one

#: Of SIER4G at constant energy, and of SIER2 in a bath with heavy hydrogens, fs.
USUAL, IN_A_BATH = 1e3 * (SIER4G.constant_energy_step or 0), 1e3 * (SIER2.heavy_bath_step or 0)


#: The method of SIER2 in a bath in the study of heat baths.
OWN_BATH = f"SIER2, {IN_A_BATH:g} fs"

#: The same in the study of speed, and OpenMM's integrator there.
OWN_ON_A_CPU, MIDDLE_ON_A_CPU = f"SIER2 in a bath, {IN_A_BATH:g} fs", "OpenMM LangevinMiddle"


#: OpenMM's default ewaldErrorTolerance.
DEFAULT_TOLERANCE = 5e-4

#: ps of the shortest run that tells a drift, and how the energy walks.
LONG = 50.0


def usual_gains(record: Record) -> pd.DataFrame:
    """Of all liquids, sizes and tolerances at the usual step, in runs that are long."""
    gains = record.tables["gains"]
    return gains[(gains["step"] == USUAL) & (gains["time"] >= LONG)]


def gains_of_several_starts(record: Record) -> dict[str, float]:
    """Return the gains in TIP5P and TIP3P, 64 molecules at OpenMM's default tolerance, with their errors.

    Of all liquids in such runs `liquids` is the number, `outside` that of those whose gain is not between the two, and
    `starts` the least number of starts.
    """
    gains = usual_gains(record)
    rows = gains[(gains["molecules"] == 64) & (gains["tolerance"] == DEFAULT_TOLERANCE) & (gains["time"] == LONG)]
    least = one(rows, liquid="TIP5P")
    most = one(rows, liquid="TIP3P")
    return {
        "least": least["gain"],
        "least_error": least["gain_error"],
        "most": most["gain"],
        "most_error": most["gain_error"],
        "liquids": rows["liquid"].nunique(),
        "outside": (~rows["gain"].between(least["gain"], most["gain"])).sum(),
        "starts": rows[["starts", "starts_verlet"]].to_numpy().min(),
    }


def gains_of_single_runs(record: Record) -> dict[str, float]:
    """Return the least and largest gain at a tighter tolerance, and the number of gains."""
    gains = usual_gains(record)
    single = gains[gains["tolerance"] < DEFAULT_TOLERANCE]["gain"]
    # The largest is rounded down, which claims no more than there is.
    return {"least": single.min(), "most": int(single.max()), "count": len(single)}


def extremes(rows: pd.DataFrame, name: str) -> dict[str, float]:
    """Return the least and the largest of a column, with their errors."""
    ends = {"least": rows.loc[rows[name].idxmin()], "most": rows.loc[rows[name].idxmax()]}
    return {f"{end}{of}": row[f"{name}{of}"] for end, row in ends.items() for of in ("", "_error")}


def price_at_constant_energy(record: Record) -> Mapping[str, float]:
    """Speed of SIER4G at its usual step over that of Verlet at 2 fs, in all boxes."""
    rows = record.tables["speeds"]
    return extremes(rows[rows["name"] == f"SIER4G, {USUAL:g} fs"], "over")


def price_on_a_gpu(record: Record) -> Mapping[str, float]:
    """Speed of SIER4G at its usual step over that of LangevinMiddle at 4 fs, in all boxes."""
    rows = record.tables["speeds"]
    return extremes(rows[rows["method"] == f"SIER4G, {USUAL:g} fs"], "over")


def frequencies(record: Record) -> Mapping[str, float]:
    """How far stretches of C=O are off, in 1/cm, and processor time of SIER4G over that of Verlet at 1 fs."""
    rows, figures = record.tables["rows"], dict[str, float]()
    methods = {"own": ("SIER4G", USUAL), "verlet": ("OpenMM Verlet", 2.0), "short": ("OpenMM Verlet", 1.0)}
    found = {name: one(rows, method=method, step=step) for name, (method, step) in methods.items()}
    for name, row in found.items():
        figures |= {name: row["carbonyl_off"], f"{name}_error": row["carbonyl_off_error"]}
    return figures | {"price": found["own"]["seconds"] / found["short"]["seconds"], "starts": found["own"]["starts"]}


def gain(**conditions: object) -> Callable[[Record], Mapping[str, float]]:
    return lambda record: {"gain": one(record.tables["gains"], method="SIER4G", **conditions)["gain"]}


def drifts(record: Record) -> Mapping[str, float]:
    usual = usual_gains(record)
    return {"off": (usual["drift"].abs() / usual["its_error"]).max(skipna=False)}


def errors_at_long_steps(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    ratios = [
        one(rows, liquid=liquid, method="SIER2P3", step=12.0)["percent"]
        / one(rows, liquid=liquid, method="OpenMM Verlet", step=2.0)["percent"]
        for liquid in rows["liquid"].unique()
    ]
    return {"least": min(ratios), "most": max(ratios)}


def preparation(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    switched = rows[(rows["tolerance"] == 5e-4) & (rows["cutoff"] == 0.9) & (rows["switch"] == "yes")]
    means = switched.groupby(["balanced", "method"])["percent"].mean()
    return {
        "before": means["no", "SIER4G"],
        "after": means["yes", "SIER4G"],
        "verlet": means["yes", "OpenMM Verlet"],
        "gain": means["no", "SIER4G"] / means["yes", "SIER4G"],
    }


def splittings_about_axes(record: Record) -> Mapping[str, float]:
    """Splittings of the rotation about axes, over exact rotation, at 1.8 and 2.2 fs with PME."""
    rows = record.tables["points"]
    rows = rows[(rows["kind"] == "PME") & rows["force_step_fs"].isin([1.8, 2.2])]
    means = rows.groupby("method")["percent"].mean()
    crossing = one(record.tables["crossings"], kind="PME")["force_step_fs"]
    return {"ratio": means["MRDL"] / means["SIER2"], "crossing": crossing}


def equipartition(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    verlet, sier4g = one(rows, method="OpenMM Verlet", step=2.0), one(rows, method="SIER4G", step=6.0)
    return {
        "verlet": verlet["difference"],
        "verlet_error": verlet["difference_error"],
        "own": sier4g["difference"],
        "own_error": sier4g["difference_error"],
        "off": abs(sier4g["difference"]) / sier4g["difference_error"],
    }


def speeds_in_a_bath(record: Record) -> Mapping[str, float]:
    rows = record.tables["speeds"]
    water = rows[(rows["name"] == OWN_ON_A_CPU) & rows["box"].str.startswith("water")]["over_middle"]
    return {**solutes_on_a_cpu(record), "least": water.min()}


def _over_middle(record: Record, box: str, method: str) -> tuple[float, float]:
    """Speed over that of LangevinMiddle at 4 fs, with its error."""
    row = one(record.tables["speeds"], box=box, name=method)
    return row["over_middle"], row["over_middle_error"]


def solutes_on_a_cpu(record: Record) -> Mapping[str, float]:
    figures = dict[str, float]()
    for box in ("dhfr", "peptide"):
        figures[box], figures[f"{box}_error"] = _over_middle(record, box, OWN_ON_A_CPU)
    rivals = [_over_middle(record, box, f"{MIDDLE_ON_A_CPU}, 5 fs") for box in ("dhfr", "peptide")]
    figures["rival"], figures["rival_error"] = max(rivals)
    return figures


def water_on_a_cpu(record: Record) -> Mapping[str, float]:
    """Of 4096 molecules."""
    own = _over_middle(record, "water-4096", OWN_ON_A_CPU)
    middle = _over_middle(record, "water-4096", f"{MIDDLE_ON_A_CPU}, {IN_A_BATH:g} fs")
    return {"own": own[0], "own_error": own[1], "middle": middle[0], "middle_error": middle[1]}


#: Boxes in which usual trials are compared with LangevinMiddle.
BOXES_OF_TRIALS = ("tip3p-64", "spce-64", "tip4p2005-64", "peptide")


def savings_of_trials(record: Record) -> Mapping[str, float]:
    """Forces that an independent energy saves by usual trials, in per cent of those of LangevinMiddle at 4 fs."""
    rows = record.tables["rows"]
    usual = rows[(rows["method"] == trials.USUAL) & rows["box"].isin(BOXES_OF_TRIALS)].sort_values("relative")
    best, worst = usual.iloc[0], usual.iloc[-1]
    return {
        "least": 100 * (1 - worst["relative"]),
        "least_error": 100 * worst["relative_error"],
        "most": 100 * (1 - best["relative"]),
        "most_error": 100 * best["relative_error"],
    }


def speeds_on_a_gpu(record: Record) -> Mapping[str, float]:
    rows, name = record.tables["speeds"], f"SIER2, {IN_A_BATH:g} fs"
    figures = dict[str, float]()
    for kind, box in (("water", "water-4096"), ("dhfr", "dhfr")):
        row = one(rows, method=name, box=box)
        figures |= {kind: row["over"], f"{kind}_error": row["over_error"]}
    middle = one(rows, method=f"LangevinMiddle, {IN_A_BATH:g} fs, heavy hydrogens", box="water-4096")
    return {**figures, "middle": middle["over"]}


def _beside_exact(record: Record, method: str, key: str, **at: str) -> tuple[float, float]:
    """How far an average is from that of hybrid Monte Carlo, with its standard error, in per cent."""
    row, exact = (one(record.tables["rows"], **at, method=each) for each in (method, "SIER4G HMC, 8 fs"))
    return percent_off(row, exact, key)


def water_in_a_bath(record: Record) -> Mapping[str, float]:
    at = {"box": "tip3p-512", "at": "1 bar"}
    (V, dV), (density, error) = (_beside_exact(record, OWN_BATH, key, **at) for key in ("potential", "density"))
    return {"potential": V, "potential_error": dV, "density": density, "density_error": error}


def peptide_in_a_bath(record: Record) -> Mapping[str, float]:
    """Of SIER2 and of LangevinMiddle the potential energy, and the largest difference of bonded energies."""
    at, figures = {"box": "peptide", "at": "constant volume"}, dict[str, float]()
    for name, method in (("own", OWN_BATH), ("middle", "LangevinMiddle, 4 fs")):
        figures[name], figures[f"{name}_error"] = _beside_exact(record, method, "potential", **at)
        bonded = (_beside_exact(record, method, key, **at)[0] for key in ("bonds", "angles", "torsions"))
        figures[f"{name}_bonded"] = max(map(abs, bonded))
    return figures


def temperatures_in_a_bath(record: Record) -> Mapping[str, float]:
    row = one(record.tables["rows"], box="peptide", at="constant volume", method=OWN_BATH)
    return {"own": row["water"] - record.settings["temperature"], "own_error": row["water_error"]}


def light_hydrogens(record: Record) -> Mapping[str, float]:
    speed = {
        method: one(record.tables["rows"], box="tip3p-512", at="1 bar", method=f"{method}, 4 fs, light")["speed"]
        for method in ("SIER2", "LangevinMiddle")
    }
    return {"share": 100 * speed["SIER2"] / speed["LangevinMiddle"]}


def trials_of_dhfr(record: Record) -> Mapping[str, float]:
    row = one(record.tables["rows"], box="dhfr", method="SIER4G HMC, 9 fs")
    return {"accepted": 100 * row["accepted"], "trials": row["trials"]}


def costs_of_trials(record: Record) -> Mapping[str, float]:
    """Forces for an independent energy over those of LangevinMiddle: of usual trials, and of longer steps in water."""
    waters = {"tip3p": "tip3p-64", "spce": "spce-64", "tip4p2005": "tip4p2005-64"}
    rows, figures = record.tables["rows"], dict[str, float]()
    usual = {name: one(rows, box=box, method=trials.USUAL) for name, box in (waters | {"peptide": "peptide"}).items()}
    longer = {f"{name}_longer": one(rows, box=box, method=trials.LONGER) for name, box in waters.items()}
    for kind, of in (("", usual), ("_longer", longer)):
        costs = [row["relative"] for row in of.values()]
        figures |= {f"least{kind}": min(costs), f"most{kind}": max(costs)}
        figures |= {name: row["relative"] for name, row in of.items()}
        figures |= {f"{name}_error": row["relative_error"] for name, row in of.items()}
    return figures | {"accepted": min(row["accepted"] for row in usual.values())}


def energies_of_langevin_middle(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    middle = rows[rows["method"] == "OpenMM LangevinMiddle"].set_index(["box", "step"])
    energies = [middle.loc[(box, 4.0), "energy"] / middle.loc[(box, 1.0), "energy"] - 1 for box in rows["box"].unique()]
    return {"energy": 100 * max(map(abs, energies))}


def known_averages(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    return {"count": len(rows), "off": rows["off"].abs().max(skipna=False)}


def acceptance_of_dhfr(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    row = one(rows, box="dhfr", moving="all", masses="3", scheme="sier4g", per_force=2.0)
    verlet = one(rows, box="dhfr", moving="all", masses="3", scheme="verlet", per_force=2.0)
    return {
        "accepted": row["accepted"],
        "trials": row["trials"],
        "rate": row["accepted"] / row["trials"],
        "verlet": verlet["accepted"],
        "verlet_trials": verlet["trials"],
    }


def mixture(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"].set_index("label")
    exact = rows.loc["HMC, SIER4G, 2 fs, hydrogens of 1"]
    middle = rows.loc["LangevinMiddle, 4 fs, hydrogens of 1"]
    return {
        "exact": abs(exact["conf_rotation"] - 298.15) / exact["conf_rotation_error"],
        "bias": middle["conf_rotation"] - 298.15,
        "bias_error": middle["conf_rotation_error"],
    }


def free_rotation(record: Record) -> Mapping[str, float]:
    rows = record.tables["curves"]
    rows = rows[(rows["step_fs"] == 8) & (rows["time"] == 10)]
    return {"own": one(rows, method="SIER2")["delta"], "mrdl": one(rows, method="MRDL")["delta"]}


def errors_by_opencl(record: Record) -> Mapping[str, float]:
    return {"most": record.tables["rows"][["opencl_double", "opencl_mixed"]].max(axis=None, skipna=False)}


def cost_of_native_steps(record: Record) -> Mapping[str, float]:
    rows = record.tables["rows"]
    ratios = rows[rows["what"] == "native / exact"]["ratio"]
    return {"least": ratios.min(), "most": ratios.max(skipna=False)}


#: Methods of the study of rigid domains.
RIGID, SPRINGS = "SIER2", "LangevinMiddle, springs"


def domains_at_constant_energy(record: Record) -> Mapping[str, float]:
    row = one(record.tables["gains"], key="chain", method="SIER4G", step=30.0)
    return {"verlet": row["verlet"], "gain": row["gain"]}


def domains_in_a_bath(record: Record) -> Mapping[str, float]:
    speeds = record.tables["speeds"]
    rigid = one(speeds, key="chain", method=RIGID, step=60.0)["ns_a_day"]
    usual, same = (one(speeds, key="chain", method=SPRINGS, step=step)["ns_a_day"] for step in (10.0, 60.0))
    off = one(record.tables["averages"], key="chain", method=RIGID, step=60.0)["off"]
    return {"off": off, "over": rigid / usual, "longest": rigid / same}


def patchy_particles_at_constant_energy(record: Record) -> Mapping[str, float]:
    """Of SIER4G at its longest step, beside the shortest of Verlet: speed over it, and the energy errors of both."""
    shortest = record.tables["energies"].query("key == 'patchy' and name == 'verlet'")["step"].min()
    methods = {"rigid": ("SIER4G", 60.0), "springs": ("Verlet, springs", shortest)}
    rows = {
        name: (
            one(record.tables["speeds"], key="patchy", method=method, step=step)["ns_a_day"],
            one(record.tables["energies"], key="patchy", method=method, step=step)["percent"],
        )
        for name, (method, step) in methods.items()
    }
    (speed, error), (of_verlet, its_error) = rows["rigid"], rows["springs"]
    return {"over": speed / of_verlet, "error": error, "verlet": shortest, "its_error": its_error}


def patchy_particles(record: Record) -> Mapping[str, float]:
    """Of SIER2 at 60 fs; LangevinMiddle takes its longest step with right averages."""
    speeds = record.tables["speeds"]
    longest = speeds.query(f"key == 'patchy' and method == '{SPRINGS}'")["longest"].iloc[0]
    own = one(speeds, key="patchy", method=RIGID, step=60.0)
    rival = one(speeds, key="patchy", method=SPRINGS, step=longest)
    spread = math.hypot(*(row["ns_a_day_error"] / row["ns_a_day"] for row in (own, rival)))
    return {"bath": own["over"], "bath_error": own["over"] * spread, "rival": longest}


def costs_beside_lammps(record: Record) -> Mapping[str, float]:
    """Processor time of SIER4G over that of LAMMPS, at energy errors of 0.1 and 0.03 %."""
    figures = dict[str, float]()
    for name, error in (("usual", 0.1), ("small", 0.03)):
        row = one(record.tables["costs"], method="SIER4G", error=error)
        figures |= {name: row["relative"], f"{name}_error": row["relative_error"]}
    return figures
