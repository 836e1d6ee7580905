"""Where the numbers of the documentation are, and the commands that made them."""

from __future__ import annotations

from pathlib import Path

DATA = Path(__file__).parent / "data"

#: For each file of `DATA` the commands that made it, one after the other.
COMMANDS = {
    "acceptance.json": ("python -m studies.acceptance",),
    "acceptance-long-steps.json": (
        "python -m studies.acceptance systems/tip3p-512.pdb --sizes 512 --schemes verlet sier2v2 sier2p3 sier4g "
        "--dt 3 4 5 --trials 40",
    ),
    "cost.json": ("OPENMM_CPU_THREADS=1 python -m studies.bench.accuracy --platform CPU",),
    "crowding.json": ("OPENMM_CPU_THREADS=1 python -m studies.crowding --platform CPU",),
    "defaults.json": ("python -m studies.defaults",),
    "dipeptide-samples.json": ("python -m studies.hmc.costs",),
    "domains.json": ("OPENMM_CPU_THREADS=1 python -m studies.domains",),
    "equipartition.json": ("python -m studies.equipartition",),
    "equipartition-long-steps.json": (
        "python -m studies.equipartition --ensemble nvt --friction 20 --time 24 --equilibrate 3 --methods sier2p3 "
        "--dt 3 4 5",
    ),
    "exactness.json": ("python -m studies.hmc.exactness",),
    "frames.json": ("OPENMM_CPU_THREADS=1 python -m studies.frames",),
    "gpu.json": (
        "python -m studies.gpu --platform CUDA --benchmarks benchmarks --chains 64 --rounds 3 --turn 0.3 --time 150 "
        "--energy-time 30",
        "python -m studies.gpu --platform CUDA --benchmarks benchmarks --boxes dhfr-8 --methods "
        '"LangevinMiddle, 5 fs" "SIER2, 9 fs" "SIER2, 9 fs, heat counted" --rounds 3 --turn 0.3',
    ),
    "heat-bath.json": (
        "python -m studies.heat_bath",
        'python -m studies.heat_bath systems/tip3p-512.pdb --methods "SIER2, 9 fs, reciprocal sum every 18 fs" '
        '"SIER2, 9 fs, 1/ps, rotations 5/ps" --time 75',
        "python -m studies.heat_bath systems/tip3p-512.pdb --methods "
        '"SIER2, 9 fs, reciprocal sum every 18 fs, just before it" --time 50',
    ),
    "launches.json": ("python -m studies.launches --processes 2",),
    "long-steps.json": (
        "python -m studies.step_study --boxes tip3p-512 --methods langevinmiddle sier2p3 --per-force 5 4 --times 50 40 "
        "--out long-steps",
        "python -m studies.step_study --boxes tip3p-512 --methods sier2p3 sier2v2 --per-force 3 --times 30 "
        "--out long-steps",
        "python -m studies.step_study --boxes tip3p-512 --methods verlet --per-force 2 --times 20 --out long-steps",
    ),
    "mixture.json": (
        "python -m studies.hmc.mixture --method hmc --step 2 --time 60",
        "python -m studies.hmc.mixture --method langevin --step 4 --time 120",
    ),
    "native-accuracy.json": ("python -m studies.native.accuracy systems/tip3p-512.pdb",),
    "native-accuracy-peptide.json": (
        "python -m studies.native.accuracy systems/peptide.pdb --schemes sier2 sier4g sier4p --time 0.2",
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
    "processed.json": ("python -m studies.processed --time 50 --starts 1",),
    "reciprocal.json": ("OPENMM_CPU_THREADS=1 python -m studies.reciprocal",),
    "schemes.json": (
        "python -m studies.schemes systems/tip3p-512.pdb --starts 2",
        "python -m studies.schemes systems/BOX.pdb --schemes sier2p3 --dt 4",
    ),
    "schemes-scan.json": ("python -m studies.schemes --dt 4 --schemes drift:0.1125,0.292453,0.3875",),
    "solvated.json": ("python -m studies.hmc.solvated dhfr",),
    "speed.json": ("OPENMM_CPU_THREADS=1 python -m studies.speed --platform CPU",),
    "step-study.json": (
        "python -m studies.step_study",
        "python -m studies.step_study --methods hmc --per-force 3 2 --times 44 30",
    ),
    "trial-cost.json": ("OPENMM_CPU_THREADS=1 python -m studies.hmc.trial_cost --trials 10",),
    "trial-lengths.json": (
        "python -m studies.hmc.lengths --schemes sier2v2 sier2p3 sier4g '4 stages' '3 stages, kicks first'",
        "python -m studies.hmc.lengths systems/peptide.pdb --schemes sier2v2 sier2p3 --steps 4 5 --starts 24 "
        "--longest 150",
    ),
    "trials.json": ("python -m studies.hmc.trials",),
    "whole-run.json": ("python -m studies.whole_run",),
}
