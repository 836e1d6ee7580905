"""The examples run from a fresh checkout and print their results."""

import re
import subprocess
import sys
from pathlib import Path

import mdtraj
import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"


def output(directory, name, *arguments):
    process = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments], cwd=directory, capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr
    return process.stdout


@pytest.mark.thorough
def test_free_body_turns_over_and_conserves(tmp_path):
    text = output(tmp_path, "free_body.py", "--time", "40")
    assert "turned over 3 times" in text
    # Rounding over 40 steps, and over a phase of 80 radian in one step.
    energy, momentum, attitude = (float(x) for x in re.findall(r"(?:by|within) (\d\.\de[+-]\d+)", text))
    assert energy < 1e-13
    assert momentum < 1e-13
    assert attitude < 1e-10


@pytest.mark.thorough
def test_water_box_conserves_energy(tmp_path):
    text = output(tmp_path, "water_box.py", "--steps", "20")
    share = float(re.search(r"([\d.]+)% of it", text).group(1))
    # SIER4 at 4 fs is at 0.016 % of the fluctuation over ps; 20 steps see less of the fluctuation.
    assert share < 0.2


@pytest.mark.thorough
def test_pdb_setup_names_the_bodies_and_writes_a_trajectory(tmp_path):
    text = output(tmp_path, "pdb_setup.py", "--steps", "10")
    assert re.search(r"494 x HOH +18\.015 dalton, 6 degrees of freedom", text)
    assert re.search(r"9 x NA +22\.990 dalton, 3 degrees of freedom", text)
    assert re.search(r"9 x CL +35\.450 dalton, 3 degrees of freedom", text)
    assert "rotation at" in text
    read = mdtraj.load(str(tmp_path / "salt.dcd"), top=str(ROOT / "systems" / "tip3p-nacl-512.pdb"))
    assert read.n_frames == 10


@pytest.mark.thorough
def test_peptide_has_three_temperatures(tmp_path):
    text = output(tmp_path, "peptide.py", "--steps", "3")
    assert "Force group 1 has the fast forces now: HarmonicBondForce, PeriodicTorsionForce, HarmonicAngleForce" in text
    # 235 degrees of freedom of the peptide, a few steps after velocities of 297 K: six and a half standard deviations.
    peptide = int(re.search(r"the peptide at (\d+) K", text).group(1))
    assert abs(peptide - 297) < 6.5 * 297 * (2 / 235) ** 0.5
    assert len((tmp_path / "peptide.csv").read_text().splitlines()) == 4
