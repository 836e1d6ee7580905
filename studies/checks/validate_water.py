"""Runs of water that physical_validation should pass, by SIER4G and hybrid Monte Carlo, and should fail, by SIER2.

    python -m studies.checks.validate_water --out DIR --time 150

64 molecules of TIP3P in a periodic box: SIER4G at 6 fs at constant temperature (297 and 325 K), at constant pressure
(1 and 1300 bar at 297 K, from four seeds each, and 1 bar at 325 K) and by hybrid Monte Carlo (297 and 325 K), and
SIER2 at 4 fs at constant temperature (297 and 325 K). Temperatures and pressures are as far apart as `openmm-sier
validate` suggests. A friction of 10/ps makes samples 0.06 ps apart nearly independent. What is complete is not done
again. Needs the extra `validation`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from openmm_sier.cli.main import main as main_command
from openmm_sier.cli.validate import InvalidError
from studies.boxes import write_lattice
from studies.command import Settings, execute
from studies.report import SILENT, Report

MOLECULES = 64

PLAN = """[options]
box = "box.pdb"
time = {time:g}
equilibrate = 10
platform = "CPU"
every = 1
report_every = 0.06
checkpoint_every = 2

[[members]]
scheme = ["sier2"]
dt = [4]
ensemble = ["nvt"]
friction = [10]
temperature = [297, 325]

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


def verdict(members: list[Path]) -> int:
    """The exit code of `openmm-sier validate`, 2 ps of each run left out."""
    return main_command(["validate", *map(str, members), "--skip", "2"])


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
        ValueError: runs failed, or a verdict is not the expected one.
    """
    if not (settings.out / "box.pdb").exists():
        write_lattice(settings.out / "box.pdb", MOLECULES)
    plan = settings.out / "validate-water.toml"
    plan.write_text(PLAN.format(time=settings.time))
    if main_command(["ensemble", str(plan), "--processes", str(settings.processes)]):
        raise ValueError("some runs failed")
    directory = plan.with_suffix("")
    found = verdict(sorted(directory.glob("sier4g-*"))), verdict(sorted(directory.glob("sier2-*")))
    report.note("exit codes: SIER4G and hybrid Monte Carlo {}, SIER2 at 4 fs {}".format(*found))
    if found != (0, InvalidError.exit_code):
        raise ValueError(f"the exit codes should be 0 and {InvalidError.exit_code}")


def main(arguments: Sequence[str] | None = None) -> int:
    return execute(ValidationSettings, study, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
