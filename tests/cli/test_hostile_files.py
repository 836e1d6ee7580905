"""Files from anybody: none of them executes code or is waited for, and nothing is changed."""

import os
import pickle
import re
import shutil
import zipfile
from pathlib import Path

import openmm
import pytest
from openmm import app

from tests.support.commands import SMALL, complaint, contents, rewrite_notes, run, write_lattice

#: What code that is executed writes.
MARKER = "executed"

RESTART = ["run", "box.pdb", "--platform", "Reference", "--restart", "box.chk", "--steps", "4"]
START = ["run", "box.pdb", "--platform", "Reference", "--start", "box.chk", "--steps", "1", "--out", "new.dcd"]
TUNE = ["tune", "box.pdb", "--platform", "Reference", "--start", "box.chk"]
USES = pytest.mark.parametrize("command", [RESTART, START, TUNE], ids=["restart", "start", "tune"])


@pytest.fixture(scope="module")
def a_run(tmp_path_factory):
    """A directory with a run of eight molecules of water."""
    place = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        write_lattice(Path("box.pdb"), 8)
        run("run", "box.pdb", *SMALL, "--report-every", "0.004", "--steps", "2")
    return place


@pytest.fixture
def here(a_run, tmp_path):
    """Its files, in the current directory."""
    shutil.copytree(a_run, tmp_path, dirs_exist_ok=True)
    return tmp_path


class Executed:
    """A function of a PythonForce that leaves the marker when it is unpickled."""

    def __reduce__(self):
        return (open, (MARKER, "w"))


def python_force():
    """XML of a PythonForce, the tag open."""
    return f'type="PythonForce" version="2" function="{pickle.dumps(Executed()).hex()}" usesPeriodic="0"'


def hostile_xml(tag="System", force=None):
    """A System of one atom by the attribute `type`, with a tag of its own, and with a Force that executes code."""
    forces = (force or "{}").format(f"<Force {python_force()}><GlobalParameters/><Particles/></Force>")
    return (
        f'<?xml version="1.0" ?><{tag} type="System" version="1" openmmVersion="8.6">'
        '<PeriodicBoxVectors><A x="2" y="0" z="0"/><B x="0" y="2" z="0"/><C x="0" y="0" z="2"/></PeriodicBoxVectors>'
        f'<Particles><Particle mass="1"/></Particles><Constraints/><Forces>{forces}</Forces></{tag}>'
    )


#: Force within which another is, up to the Force.
VARIABLE = (
    '<Force type="CustomCVForce" version="0" energy="a" name="a" forceGroup="0"><GlobalParameters/>'
    "<EnergyParameterDerivatives/><CollectiveVariables><CollectiveVariable name='a'>{}</CollectiveVariable>"
    "</CollectiveVariables><Functions/></Force>"
)
ALCHEMICAL = (
    '<Force type="ATMForce" version="0" energy="1" name="a" forceGroup="0"><GlobalParameters/>'
    "<EnergyParameterDerivatives/><Forces><Force>{}</Force></Forces><Particles/></Force>"
)

#: XML that OpenMM executes. Its parser ends a comment at the first ">".
HOSTILE = {
    "system": hostile_xml(),
    "type alone": hostile_xml("State"),
    "collective variable": hostile_xml(force=VARIABLE),
    "alchemical": hostile_xml(force=ALCHEMICAL),
    "comment": hostile_xml(force="<!-- > {} -->"),
}


def rewrite_state(checkpoint, xml):
    """Replace the State in a checkpoint."""
    with zipfile.ZipFile(checkpoint) as archive:
        notes = archive.read("notes.json")
    with zipfile.ZipFile(checkpoint, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("state.xml", xml)
        archive.writestr("notes.json", notes)


def refused(capsys, *command, code=1):
    """Return the complaint of a command that leaves all files as they are."""
    before = contents(Path())
    message = complaint(capsys, *command, code=code)
    assert contents(Path()) == before
    assert MARKER not in before
    return message


# --- code in XML ---


@pytest.mark.parametrize("name", HOSTILE)
def test_openmm_executes_hostile_xml(here, name):
    """Otherwise the tests below would show nothing."""
    openmm.XmlSerializer.deserializeSystem(HOSTILE[name])
    assert Path(MARKER).exists()


@USES
def test_a_checkpoint_holds_a_state(here, capsys, command):
    rewrite_state("box.chk", HOSTILE["system"])
    assert "expected a State, got 'System' of the type 'System'" in refused(capsys, *command)


@pytest.mark.parametrize("name", HOSTILE)
def test_nothing_in_a_checkpoint_is_executed(here, capsys, name):
    rewrite_state("box.chk", HOSTILE[name])
    assert "box.chk is damaged, or is not a checkpoint" in refused(capsys, *RESTART)


@pytest.mark.parametrize("name", HOSTILE)
def test_nothing_in_coordinates_is_executed(here, capsys, name):
    Path("evil.xml").write_text(HOSTILE[name])
    system = openmm.System()
    system.addParticle(1.0)
    Path("system.xml").write_text(openmm.XmlSerializer.serialize(system))
    message = refused(capsys, "info", "evil.xml", "--topology", "system.xml")
    assert "evil.xml" in message


@pytest.mark.parametrize("name", HOSTILE)
def test_nothing_in_a_topology_is_executed(here, capsys, name):
    Path("evil.xml").write_text(HOSTILE[name])
    message = refused(capsys, "info", "box.pdb", "--topology", "evil.xml")
    assert "evil.xml" in message
    if name in ("system", "collective variable", "alchemical"):
        assert "it has a 'PythonForce'" in message
        assert "Create the System in a script" in message


def test_document_types_are_refused(here, capsys):
    """They define entities, which grow without bound."""
    entities = '<!DOCTYPE System [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
    Path("evil.xml").write_text(entities + "<System type='System' version='1'>&b;</System>")
    assert "it has a document type" in refused(capsys, "info", "box.pdb", "--topology", "evil.xml")


# --- code in force fields ---


def force_field(path):
    """Write the force field of the box with a script."""
    text = (Path(app.__file__).parent / "data" / "tip3p.xml").read_text()
    code = f"open({os.path.abspath(MARKER)!r}, 'w').close()"
    Path(path).write_text(text.replace("</ForceField>", f"<Script>{code}</Script></ForceField>"))


@pytest.mark.parametrize("place", ["beside", "below", "absolute", "above", "of OpenMM"])
@USES
def test_a_checkpoint_names_no_force_field(here, capsys, tmp_path_factory, place, command):
    """A file in the folder of the checkpoint may contain code too."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    Path("below").mkdir()
    data = Path(app.__file__).parent / "data"
    # OpenMM seeks files that are not found elsewhere in directories of its own.
    of_openmm = Path(*[".."] * (len(data.parts) - 1), *elsewhere.parts[1:], "evil.xml")
    name = {
        "beside": "evil.xml",
        "below": "below/evil.xml",
        "absolute": str(elsewhere / "evil.xml"),
        "above": os.path.relpath(elsewhere / "evil.xml"),
        "of OpenMM": str(of_openmm),
    }[place]
    force_field(elsewhere / "evil.xml" if place not in ("beside", "below") else name)
    rewrite_notes("box.chk", lambda notes: notes["plan"].update(forcefield=[name]))
    message = refused(capsys, *command)
    assert f"box.chk names {name}, a force field that comes neither with OpenMM nor with this package" in message
    assert f"give --forcefield {name}" in message


def test_a_force_field_that_is_named_again_is_executed(here, capsys):
    force_field("mine.xml")
    run(*("run", "box.pdb", *SMALL, "--forcefield", "mine.xml", "--steps", "2", "--overwrite"))
    Path(MARKER).unlink()
    assert "give --forcefield mine.xml" in refused(capsys, *RESTART)
    run(*RESTART, "--forcefield", "mine.xml")
    Path(MARKER).unlink()
    assert "give --forcefield mine.xml" in refused(capsys, *START)
    run(*START, "--forcefield", "mine.xml")
    assert Path(MARKER).exists()


def test_a_force_field_that_was_edited_is_refused_also_if_it_is_named_again(here, capsys):
    shutil.copy(Path(app.__file__).parent / "data" / "tip3p.xml", "mine.xml")
    run(*("run", "box.pdb", *SMALL, "--forcefield", "mine.xml", "--steps", "2", "--overwrite"))
    with Path("mine.xml").open("a") as file:
        file.write("<!-- edited -->")
    message = refused(capsys, *RESTART, "--forcefield", "mine.xml")
    assert "mine.xml is not the file that the run of box.chk read" in message


def test_the_force_field_of_coordinates_that_a_checkpoint_names(here, capsys):
    """Who names a PDB file trusts the force field that it names."""
    force_field("mine.xml")
    text = Path("box.pdb").read_text()
    assert "tip3p.xml" in text
    Path("box.pdb").write_text(text.replace("tip3p.xml", "mine.xml"))
    run("run", "box.pdb", *SMALL, "--steps", "2", "--overwrite")
    Path(MARKER).unlink()
    again = ["run", *RESTART[2:]]
    assert "box.chk names mine.xml, a force field that comes neither" in (message := refused(capsys, *again))
    assert "give box.pdb as BOX" in message
    run(*RESTART)


# --- States ---


@pytest.mark.parametrize("use", [RESTART, START, TUNE], ids=["restart", "start", "tune"])
def test_a_state_that_no_run_writes(here, capsys, use):
    """OpenMM ends the process if positions are not finite, and continues without velocities."""
    with zipfile.ZipFile("box.chk") as archive:
        state = archive.read("state.xml").decode()
    lost = re.sub(r"<Position [^>]*/>", '<Position x="nan" y="0" z="0"/>', state, count=1)
    never = re.sub(r" time=[^ ]*", ' time="nan"', state, count=1)
    cold = re.sub(r" sier_heat=[^ ]*", ' sier_heat="inf"', state, count=1)
    without = re.sub("<Velocities>.*</Velocities>", "", state, flags=re.DOTALL)
    wide = re.sub("<A [^>]*/>", '<A x="1e300" y="0" z="0"/>', state)
    for xml, reason in (
        (lost, "it has numbers that are not finite"),
        (never, "it has numbers that are not finite"),
        (cold, "it has numbers that are not finite"),
        (without, "its State lacks positions or velocities"),
        (wide, "its State has a box with an edge of 1e+300 nm"),
    ):
        assert xml != state
        rewrite_state("box.chk", xml)
        message = refused(capsys, *use)
        assert "not a checkpoint of openmm-sier run" in message
        assert reason in message


def test_a_start_in_a_box_that_is_too_small(here, capsys):
    with zipfile.ZipFile("box.chk") as archive:
        state = archive.read("state.xml").decode()
    rewrite_state("box.chk", re.sub(r"<A [^>]*/>", '<A x="0.01" y="0" z="0"/>', state))
    Path("new.csv").write_text("an earlier log")
    message = refused(capsys, *START, "--overwrite")
    assert "box.chk does not fit box.pdb: The periodic box size" in message


@pytest.mark.parametrize("way", ["locked", "deep", "no JSON"])
def test_zip_files_that_are_no_checkpoints(here, capsys, way):
    with zipfile.ZipFile("box.chk") as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    contents["notes.json"] = {"deep": b"[" * 10**6, "no JSON": b"\xff"}.get(way, contents["notes.json"])
    with zipfile.ZipFile("box.chk", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    if way == "locked":
        # The flag of encrypted parts, in both of their headers.
        packed = bytearray(Path("box.chk").read_bytes())
        for magic, place in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
            at = -1
            while (at := packed.find(magic, at + 1)) >= 0:
                packed[at + place] |= 1
        Path("box.chk").write_bytes(packed)
    assert "box.chk is damaged, or is not a checkpoint" in refused(capsys, *RESTART)


# --- files that are waited for ---


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no such pipes here")
@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "line",
    [
        "run box.pdb --restart pipe",
        "run box.pdb --start pipe",
        "run box.pdb --config pipe",
        "run pipe",
        "run box.pdb --topology pipe",
        "run box.pdb --forcefield pipe",
        "summary pipe",
        "setup pipe",
    ],
)
def test_pipes_are_not_waited_for(here, capsys, line):
    os.mkfifo("pipe")
    assert "pipe: not a regular file" in refused(capsys, *line.split())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no such pipes here")
@pytest.mark.timeout(60)
def test_pipes_among_other_files_are_not_waited_for(here, capsys):
    shutil.copy("box.csv", "other.csv")
    os.mkfifo("other.chk")
    run("summary", "other.csv")
    Path("box.dcd").unlink()
    os.mkfifo("box.dcd")
    # The trajectory of a checkpoint that has nothing left to do, and of one that has.
    for steps in ("2", "4"):
        assert "box.dcd" in complaint(capsys, *RESTART[:-1], steps)
    Path("box.pdb").unlink()
    os.mkfifo("box.pdb")
    assert "box.pdb: not a regular file" in complaint(capsys, "run", *RESTART[2:])
