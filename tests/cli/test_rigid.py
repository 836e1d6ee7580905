"""Bodies that the command holds rigid: by ranges of residues and selections, from start to trajectory."""

import mdtraj
import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier.cli.files.checkpoints import read_checkpoint
from tests.support.commands import complaint, run
from tests.support.domains import domain_system, folded, topology_of

CHAIN = ("chain.pdb", "--topology", "system.xml")
DOMAINS = ("--rigid", "A:2-13", "A:24-37")
SHORT = ("--dt", "20", "--ensemble", "nvt", "--platform", "Reference", "--equilibrate", "0.2", "--every", "0.1")


@pytest.fixture(autouse=True)
def chain(tmp_path, monkeypatch):
    """A chain with two domains in the current directory."""
    monkeypatch.chdir(tmp_path)
    with open("chain.pdb", "w") as file:
        app.PDBFile.writeFile(topology_of(), folded() * unit.nanometer, file, keepIds=True)
    system = domain_system(box=12.0, elastic=False)
    with open("system.xml", "w") as file:
        file.write(openmm.XmlSerializer.serialize(system))


def stretched(trajectory):
    """By how much distances within the domains change along a trajectory, and within all, nm."""
    x = mdtraj.load(trajectory, top="chain.pdb").xyz
    assert len(x) > 1
    distances = np.linalg.norm(x[:, :, None] - x[:, None], axis=3)
    spread = np.ptp(distances, axis=0)
    return max(spread[1:13, 1:13].max(), spread[23:37, 23:37].max()), spread.max()


def test_from_coordinates_to_a_trajectory(capsys):
    run("run", *CHAIN, *SHORT, *DOMAINS, "--steps", "20", "--out", "whole.dcd")
    out = capsys.readouterr().out
    assert "rigid: A:2-13 (atoms 1-12), A:24-37 (atoms 23-36)" in out
    assert "usual steps are 26 fs with SIER4G" in out
    within, among = stretched("whole.dcd")
    # The DCD file has single precision in Angstrom, of coordinates up to 120.
    assert within < 1e-4
    # Between beads of some 110 dalton, which move by 0.015 nm from frame to frame: that the distances of all 15 from
    # each other change by less than a tenth of it has a probability below 1e-9.
    assert among > 1e-3


@pytest.mark.thorough
def test_a_restart_has_the_words_of_the_checkpoint(capsys):
    words = ("run", *CHAIN, *SHORT, *DOMAINS, "--checkpoint-every", "0.1")
    run(*words, "--steps", "20", "--out", "whole.dcd")
    run(*words, "--steps", "10", "--out", "cut.dcd")
    assert read_checkpoint("cut.chk")[1].plan["rigid"] == ["A:2-13", "A:24-37"]
    run("run", "--restart", "cut.chk", "--steps", "15", "--platform", "Reference")
    again = ("run", "--restart", "cut.chk", "--steps", "20", "--platform", "Reference")
    run(*again, *DOMAINS)
    assert np.array_equal(mdtraj.load("cut.dcd", top="chain.pdb").xyz, mdtraj.load("whole.dcd", top="chain.pdb").xyz)
    assert "differs from" in complaint(capsys, *again, "--rigid", "A:2-13")


def test_what_is_rigid_is_shown(capsys):
    for head in ("A:2-13", "resSeq 2 to 13", "index 1 to 12"):
        run("info", *CHAIN, "--rigid", head, "A:24-37")
        out = capsys.readouterr().out
        assert f"{head} (atoms 1-12), A:24-37 (atoms 23-36)" in out
        assert "2 rigid bodies, 14 points" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("A:2-50", "no chain A has residues 2-50"),
        ("GLI", "'GLI' describes no body"),
    ],
)
def test_words_that_describe_nothing(capsys, words, said):
    assert said in complaint(capsys, "info", *CHAIN, "--rigid", words)


def test_a_body_without_bonds_that_the_boundary_cuts_is_read_whole(capsys):
    """Only the selection joins the atoms. The largest moment is 0.36; as the file has them it is 65."""
    x = np.array([[2.9, 1.0, 1.0], [0.05, 1.0, 1.0], [0.05, 1.15, 1.0]])
    system, pairwise = openmm.System(), openmm.NonbondedForce()
    pairwise.setNonbondedMethod(pairwise.CutoffPeriodic)
    system.setDefaultPeriodicBoxVectors(*(3 * np.eye(3)))
    topology = app.Topology()
    residue = topology.addResidue("TRI", topology.addChain())
    for name in ("C1", "C2", "C3"):
        system.addParticle(12.0)
        pairwise.addParticle(0, 0.3, 0)
        topology.addAtom(name, app.Element.getBySymbol("C"), residue)
    system.addForce(pairwise)
    topology.setPeriodicBoxVectors(3 * np.eye(3) * unit.nanometer)
    with open("cut.pdb", "w") as file:
        app.PDBFile.writeFile(topology, x * unit.nanometer, file)
    with open("cut.xml", "w") as file:
        file.write(openmm.XmlSerializer.serialize(system))
    run("info", "cut.pdb", "--topology", "cut.xml", "--rigid", "index 0 to 2")
    assert "0.090000 0.270000 0.360000" in capsys.readouterr().out
    run("run", "cut.pdb", "--topology", "cut.xml", "--rigid", "index 0 to 2", *SHORT, "--steps", "5", "--out", "t.dcd")
    distances = np.linalg.norm(np.diff(mdtraj.load("t.dcd", top="cut.pdb").xyz, axis=1), axis=2)
    # Single precision in Angstrom, of coordinates up to 30.
    np.testing.assert_allclose(distances, 0.15, atol=1e-5)
