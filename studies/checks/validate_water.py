"""Runs of water by SIER4G and hybrid Monte Carlo that physical_validation should pass.

    python -m studies.checks.validate_water --out DIR --time 150

64 molecules of TIP3P in a periodic box: SIER4G at 6 fs at constant temperature (297 and 325 K), at constant pressure
(1 and 1300 bar at 297 K, from four seeds each, and 1 bar at 325 K) and by hybrid Monte Carlo (297 and 325 K).
Temperatures and pressures are as far apart as `physical_validation.ensemble.estimate_interval` suggests. A friction of
10/ps makes samples 0.06 ps apart nearly independent. What is complete is not done again. Needs the extra `validation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from openmm_sier.cli.finished_runs import open_runs
from openmm_sier.cli.main import main as main_command
from openmm_sier.measure.validation import ensemble_data, kinetic_data
from studies.boxes import write_lattice
from studies.command import Settings, command
from studies.records import table
from studies.report import SILENT, Report

MOLECULES = 64

#: Standard errors beyond which a check fails.
LIMIT = 4.0

PLAN = """[options]
box = "box.pdb"
time = {time:g}
equilibrate = 10
platform = "CPU"
every = 1
report_every = 0.06
checkpoint_every = 2

[[members]]
scheme = ["sier4g"]
ensemble = ["nvt"]
friction = [10]
temperature = [297, 325]

[[members]]
scheme = ["sier4g"]
ensemble = ["npt"]
friction = [10]
pressure = [1, 1300]
seed = [1, 2, 3, 4]

[[members]]
scheme = ["sier4g"]
ensemble = ["npt"]
friction = [10]
temperature = [325]

[[members]]
scheme = ["sier4g"]
ensemble = ["hmc"]
temperature = [297, 325]
"""


#: Temperature in K and pressure in bar by the runs at this state point. `COMPARED` are pairs of them.
POINTS = {
    "sier4g-nvt-friction10-temperature297": (297.0, None),
    "sier4g-nvt-friction10-temperature325": (325.0, None),
    "sier4g-npt-friction10-pressure1-seed*": (297.0, 1.0),
    "sier4g-npt-friction10-pressure1300-seed*": (297.0, 1300.0),
    "sier4g-npt-friction10-temperature325": (325.0, 1.0),
    "sier4g-hmc-temperature297": (297.0, None),
    "sier4g-hmc-temperature325": (325.0, None),
}

COMPARED = ((0, 1), (2, 3), (2, 4), (5, 6))

COLUMNS = {"runs": "{runs}", "check": "{check}", "standard errors": "{distance:.1f}"}


def verdicts(directory: Path) -> pd.DataFrame:
    """Distances from what statistical mechanics demands in standard errors, 2 ps of each run left out."""
    import physical_validation as pv

    logs = {name: [run.log(2.0) for run in open_runs(sorted(directory.glob(name)))] for name in POINTS}
    options = {"data_is_uncorrelated": True, "bootstrap_seed": 5, "verbosity": 0}
    rows = []
    for name, (temperature, _) in POINTS.items():
        for group, data in kinetic_data(logs[name], temperature).items():
            mean, width = pv.kinetic_energy.distribution(data, strict=False, **options)
            rows += [(name, f"{group}: mean kinetic energy", mean), (name, f"{group}: its width", width)]
    points = [(name, ensemble_data(logs[name], *point)) for name, point in POINTS.items()]
    for one, two in COMPARED:
        slope = pv.ensemble.check(points[one][1], points[two][1], **options)[0]
        rows.append((f"{points[one][0]} and {points[two][0]}", "slope of ln(P2/P1)", abs(slope)))
    return pd.DataFrame(rows, columns=["runs", "check", "distance"])


@dataclass(frozen=True)
class ValidationSettings(Settings):
    """What is run.

    Attributes:
        time: of each run, ps.
        processes: at a time.
    """

    time: float = 150.0
    processes: int = 2
    out: Path = Path("out/validate-water")


def study(settings: ValidationSettings, report: Report = SILENT) -> None:
    """Run and test.

    Raises:
        ValueError: runs failed, or a check.
    """
    if not (settings.out / "box.pdb").exists():
        write_lattice(settings.out / "box.pdb", MOLECULES)
    plan = settings.out / "validate-water.toml"
    plan.write_text(PLAN.format(time=settings.time))
    if main_command(["ensemble", str(plan), "--processes", str(settings.processes)]):
        raise ValueError("some runs failed")
    found = verdicts(plan.with_suffix(""))
    report.table(table("Distances from statistical mechanics", found, COLUMNS, left=2))
    if failed := int((~(found["distance"] <= LIMIT)).sum()):
        raise ValueError(f"{failed} of {len(found)} checks failed")


main = command(ValidationSettings, study, __doc__, __name__)
