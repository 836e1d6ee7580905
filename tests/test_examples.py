"""The examples run from a fresh checkout and print their results."""

import json
import re
import subprocess
import sys
from pathlib import Path

import mdtraj
import numpy as np
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


@pytest.mark.thorough
def test_patchy_colloids_write_orientations(tmp_path):
    gsd = pytest.importorskip("gsd.hoomd")
    text = output(tmp_path, "patchy_colloids.py")
    assert "150 node of 5 atoms, 350 link of 3 atoms" in text
    total = float(re.search(r"total=(\S+) K", text).group(1))
    # 3000 degrees of freedom: six and a half standard deviations.
    assert abs(total - 300) < 6.5 * 300 * (2 / 3000) ** 0.5
    with gsd.open(str(tmp_path / "patchy.gsd")) as file:
        assert len(file) == 10
        assert file[-1].particles.types == ["node", "link"]
        assert file[-1].particles.orientation.shape == (500, 4)


@pytest.mark.thorough
def test_c60_turns_in_its_crystal(tmp_path):
    text = output(tmp_path, "c60.py", "--steps", "50")
    assert "32 C60 of 60 atoms" in text
    # A free molecule turns by 2 ps / 4.95 ps radians at sqrt(kT/I).
    assert 5 < int(re.search(r"turned by (\d+) degrees", text).group(1)) < 60


@pytest.mark.thorough
def test_rods_have_five_degrees_of_freedom(tmp_path):
    text = output(tmp_path, "rods.py", "--steps", "500")
    along, about = (json.loads(part) for part in re.search(r"axes: \[(\[.*?\]), (\[.*?\])\]", text).groups())
    assert about[0] == 0
    # Squares of 256 normal numbers: six and a half standard deviations.
    assert np.abs(np.array(along + about[1:]) - 1).max() < 6.5 * (2 / 256) ** 0.5


@pytest.mark.thorough
def test_a_piston_stays_above_its_gas(tmp_path):
    text = output(tmp_path, "piston.py", "--steps", "500")
    height = float(re.search(r"piston ([\d.]+) nm", text).group(1))
    # It starts at 4 nm, and may fall until the gas holds it.
    assert 1 < height < 5


@pytest.mark.thorough
def test_gay_berne_ellipsoids_conserve_energy(tmp_path):
    text = output(tmp_path, "gay_berne.py", "--steps", "50")
    assert "All Forces are the gradients of their energies" in text
    potential, total = map(float, re.search(r"by ([\d.]+) kJ/mol, the sum by (\S+)", text).groups())
    # rms(H)/rms(V) is 0.001 % at 26 fs, and the steps have 20 fs.
    assert total < 1e-4 * potential


@pytest.mark.thorough
def test_a_chain_keeps_its_domains(tmp_path):
    text = output(tmp_path, "domain_chain.py", "--steps", "100")
    assert "2 rigid of 36 atoms, 48 points" in text
    assert "domains are" in text


def test_examples_need_only_what_is_installed():
    """Those on pages run anywhere; others read systems of the repository."""
    page = (ROOT / "docs" / "guide" / "howto" / "rigid-particles.md").read_text()
    page += (ROOT / "docs" / "guide" / "howto" / "rigid-domains.md").read_text()
    shown = re.findall(r"literalinclude\} \.\./\.\./\.\./examples/(\w+\.py)", page)
    assert len(shown) == 6
    for name in shown:
        text = (EXAMPLES / name).read_text()
        assert not re.search(r"studies|systems|tests", text), name


def test_a_new_users_script_is_short():
    lines = (EXAMPLES / "patchy_colloids.py").read_text().splitlines()
    code = [line for line in lines if line.strip() and not line.startswith(("#", '"""'))]
    assert len(code) <= 40
