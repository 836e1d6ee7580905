"""Where the numbers of the documentation are, and the commands that made them."""

from __future__ import annotations

from pathlib import Path

DATA = Path(__file__).parent / "data"

#: For each file of `DATA` the commands that made it, one after the other.
COMMANDS = {
    "cost.json": ("OPENMM_CPU_THREADS=1 python -m studies.bench.accuracy --platform CPU",),
    "defaults.json": ("python -m studies.defaults",),
    "domains.json": ("OPENMM_CPU_THREADS=1 python -m studies.domains",),
    "equipartition.json": ("python -m studies.equipartition",),
    "exactness.json": ("python -m studies.hmc.exactness",),
    "gpu.json": (
        "python -m studies.gpu --platform CUDA --benchmarks benchmarks --chains 64 --rounds 3 --turn 0.3 --time 150 "
        "--energy-time 30",
        "python -m studies.gpu --platform CUDA --benchmarks benchmarks --boxes dhfr-8 --methods "
        '"LangevinMiddle, 5 fs" "SIER2, 9 fs" "SIER2, 9 fs, heat counted" --rounds 3 --turn 0.3',
    ),
    "heat-bath.json": (
        "python -m studies.heat_bath",
        'python -m studies.heat_bath systems/tip3p-512.pdb --methods "SIER2, 9 fs, 1/ps, rotations 5/ps" --time 75',
    ),
    "launches.json": ("python -m studies.launches --processes 2",),
    "mixture.json": (
        "python -m studies.hmc.mixture --method hmc --step 2 --time 60",
        "python -m studies.hmc.mixture --method langevin --step 4 --time 120",
    ),
    "native-cost.json": ("OPENMM_CPU_THREADS=1 python -m studies.native.cost systems/tip3p-512.pdb",),
    "native-substeps.json": (
        "python systems/make.py --model tip3p --molecules 64 --equilibrate 15 --out tip3p-64.pdb",
        "python -m studies.native.substeps tip3p-64.pdb --substeps 1 3 --time 1000",
    ),
    "native-platforms.json": (
        "python -m studies.native.accuracy systems/BOX.pdb --on Reference OpenCL:double OpenCL:mixed --time 0.06",
    ),
    "paper-dipole.json": ("python -m studies.paper dipole",),
    "paper-free-rotation.json": ("python -m studies.paper free-rotation --quick",),
    "paper-water.json": ("python -m studies.paper water",),
    "schemes.json": (
        "python -m studies.schemes systems/tip3p-512.pdb --starts 2",
        "python -m studies.schemes systems/BOX.pdb --schemes sier2p3 --dt 4",
    ),
    "solvated.json": ("python -m studies.hmc.solvated dhfr",),
    "speed.json": ("OPENMM_CPU_THREADS=1 python -m studies.speed --platform CPU",),
    "step-study.json": (
        "python -m studies.step_study",
        "python -m studies.step_study --methods hmc --per-force 3 2 --times 44 30",
    ),
    "trials.json": ("python -m studies.hmc.trials",),
    "whole-run.json": ("python -m studies.whole_run",),
}
