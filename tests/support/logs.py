"""Synthetic logs of runs with known means, drifts and fluctuations."""

import zipfile
from pathlib import Path

import numpy as np

from openmm_sier.cli.files.checkpoints import FORMAT, Notes
from openmm_sier.cli.files.records import Noted
from openmm_sier.cli.planning import new_settings
from openmm_sier.cli.settings import RunSettings
from openmm_sier.observe.conservation import COLUMNS, csv_line
from tests.support.series import correlated

#: What fluctuates: mean and standard deviation. Values 0.04 ps apart keep half of their deviations.
FLUCTUATING = {
    "Potential Energy (kJ/mole)": (-5000.0, 50.0),
    "Translational Temperature (K)": (297.0, 12.0),
    "Rotational Temperature (K)": (297.0, 12.0),
    "Density (g/mL)": (0.99, 0.01),
}
KEPT, INTERVAL = 0.5, 0.04

#: kJ/mol, the standard deviation of the conserved energy.
NOISE = 0.5


def write_log(path, ensemble="nve", rows=501, seed=1, drift=0.0, change=None, columns=None):
    """Write a log.

    Args:
        path: of the file.
        ensemble: "nve", "nvt", "npt" or "hmc".
        rows: how many.
        seed: of its noise.
        drift: of the conserved energy, kJ/mol/ps.
        change: is called with the columns, and changes them.
        columns: names of those that are written; all unless given.
    """
    rng, log = np.random.default_rng(seed), {name: np.zeros(rows) for name in COLUMNS}
    log["Step"] = np.arange(rows)
    log["Time (ps)"] = INTERVAL * np.arange(rows)
    for name, (mean, spread) in FLUCTUATING.items():
        log[name] = mean + spread * correlated(rng, rows, KEPT)
    log["Flexible Temperature (K)"] = np.full(rows, np.nan)
    log["Conserved Energy (kJ/mole)"] = -3000 + NOISE * rng.normal(size=rows) + drift * log["Time (ps)"]
    heat = 30 * rng.normal(size=rows).cumsum() if ensemble != "nve" else np.zeros(rows)
    log["Total Energy (kJ/mole)"] = log["Conserved Energy (kJ/mole)"] + heat
    if ensemble != "npt":
        log["Density (g/mL)"] = np.full(rows, 0.997)
    if ensemble == "hmc":
        accepted = rng.random(rows) < 0.9
        log["Acceptance"] = accepted.cumsum() / np.arange(1, rows + 1)
        log["Energy Error (kT)"] = 0.3 * rng.normal(size=rows)
    if change is not None:
        change(log)
    names = list(columns or log)
    rows_of_numbers = zip(*(log[name].tolist() for name in names), strict=True)
    Path(path).write_text("".join(map(csv_line, [names, *rows_of_numbers])))
    return log


def write_notes(path, ensemble, seed=1):
    """Write a checkpoint beside a log, with notes of its run alone."""
    checkpoint = Path(path).with_suffix(".chk")
    given = RunSettings(box=Path("box.pdb"), ensemble=ensemble, seed=seed, out=Path(path).with_suffix(".dcd"))
    empty = Noted(0, 0, 32 * "0")
    notes = Notes(
        format=FORMAT,
        plan=new_settings(given).noted(checkpoint),
        step=0,
        potential_energy=0.0,
        platform={"Platform": "Reference"},
        inputs={},
        unsettled=None,
        trajectory=empty,
        log=empty,
    )
    with zipfile.ZipFile(checkpoint, "w") as archive:
        archive.writestr("notes.json", notes.model_dump_json())
