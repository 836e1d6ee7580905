"""Runs of water that physical_validation should pass, by SIER4G and hybrid Monte Carlo, and should fail, by SIER2.

    python -m studies.checks.validate_water --out DIR --time 150

64 molecules of TIP3P in a periodic box: SIER4G at 6 fs at constant temperature (297 and 325 K), at constant pressure
(1 and 1300 bar at 297 K, from four seeds each, and 1 bar at 325 K) and by hybrid Monte Carlo (297 and 325 K), and
SIER2 at 4 fs at constant temperature (297 and 325 K). Temperatures and pressures are as far apart as `openmm-sier
validate` suggests. A friction of 10/ps makes samples 0.06 ps apart nearly independent. What is complete is not done
again. Needs the extra `validation`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from openmm import unit

from openmm_sier.cli import main
from openmm_sier.cli.validate import InvalidError
from openmm_sier.measure import forcefields
from systems import make

MOLECULES, DENSITY, FORCEFIELD = 64, 0.997, "tip3p.xml"

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


def write_box(path: Path) -> None:
    """Molecules on a lattice, for the runs to equilibrate."""
    topology = make.make_topology(MOLECULES, 0)
    edge = make.box_edge(topology, DENSITY)
    topology.setUnitCellDimensions([edge] * 3 * unit.nanometer)
    geometry = make.water_geometry(forcefields.load([FORCEFIELD]))
    rng = np.random.default_rng(3)
    positions = make.start_positions(MOLECULES, 0, edge, geometry, rng) * unit.nanometer
    make.write(path, topology, positions, edge, [f"FORCEFIELD {FORCEFIELD}"])


def verdict(members: list[Path]) -> int:
    """The exit code of `openmm-sier validate`, 2 ps of each run left out."""
    return main.main(["validate", *map(str, members), "--skip", "2"])


def run(out: Path, time: float, processes: int) -> None:
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "box.pdb").exists():
        write_box(out / "box.pdb")
    plan = out / "validate-water.toml"
    plan.write_text(PLAN.format(time=time))
    if main.main(["ensemble", str(plan), "--processes", str(processes)]):
        sys.exit("some runs failed")
    directory = plan.with_suffix("")
    passed = verdict(sorted(directory.glob("sier4g-*")))
    found_out = verdict(sorted(directory.glob("sier2-*")))
    print(f"exit codes: SIER4G and hybrid Monte Carlo {passed}, SIER2 at 4 fs {found_out}")
    sys.exit((passed, found_out) != (0, InvalidError.exit_code))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/validate-water"))
    parser.add_argument("--time", metavar="PS", type=float, default=150.0, help="of each run (default: 150)")
    parser.add_argument("--processes", metavar="N", type=int, default=2, help="default: 2")
    options = parser.parse_args()
    run(options.out, options.time, options.processes)
