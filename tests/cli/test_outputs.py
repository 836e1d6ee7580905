"""Files of a run: none replaces an input or another output, and errors are reported in one line."""

import io
import os
import resource
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from openmm_sier.cli import main, streams
from openmm_sier.cli.files import checkpoints, records
from openmm_sier.cli.files.kinds import KINDS
from openmm_sier.cli.settings import FILES, SETTINGS
from openmm_sier.inputs import equilibration
from tests.support.commands import SMALL, complaint, contents, frames, write_lattice


@pytest.fixture(scope="module")
def lattice(tmp_path_factory):
    return write_lattice(tmp_path_factory.mktemp("box") / "box.pdb").read_bytes()


@pytest.fixture
def box(tmp_path, monkeypatch, lattice):
    """A PDB file of the test's own in the current directory."""
    monkeypatch.chdir(tmp_path)
    Path("box.pdb").write_bytes(lattice)
    return Path("box.pdb")


@pytest.fixture
def no_equilibration(monkeypatch):
    """Fails where something that could be refused at once is not."""
    monkeypatch.setattr(equilibration, "equilibrate", lambda *_: pytest.fail("the equilibration was begun"))


def test_each_option_of_an_output_has_a_kind_and_each_kind_its_interval():
    assert {kind.option for kind in KINDS.values()} == set(FILES) - {"box", "topology"}
    assert {kind.every for kind in KINDS.values()} <= set(SETTINGS)


# --- inputs are not destroyed ---


@pytest.mark.parametrize(
    ("name", "make", "options"),
    [
        ("box.pdb", None, ["--report", "box.pdb"]),
        ("box.pdb", None, ["--report", "../{here}/box.pdb"]),
        ("x.dcd", Path.symlink_to, ["--out", "x.dcd"]),
        ("x.csv", Path.hardlink_to, ["--pressure-tensor", "x.csv"]),
        # The checkpoint.
        ("x.chk", Path.symlink_to, ["--out", "x.dcd"]),
    ],
)
def test_no_output_is_the_pdb_file(box, tmp_path, capsys, lattice, no_equilibration, name, make, options):
    if make:
        make(Path(name), box)
    options = [option.format(here=tmp_path.name) for option in options]
    assert "would overwrite the input box.pdb" in complaint(capsys, "run", box, *SMALL, *options, "--overwrite")
    assert box.read_bytes() == lattice


def test_no_output_is_a_force_field(box, capsys, no_equilibration):
    field = Path("mine.xml")
    field.write_bytes((Path(equilibration.openmm.app.__file__).parent / "data" / "tip3p.xml").read_bytes())
    before = field.read_bytes()
    message = complaint(capsys, "run", box, "--forcefield", "mine.xml", "--report", "mine.xml", "--overwrite")
    assert "mine.xml would overwrite the input mine.xml" in message
    # One that lies beside the PDB file and is looked for there.
    Path("there").mkdir()
    moved = field.rename("there/mine.xml")
    box = box.rename("there/box.pdb")
    options = ["--forcefield", "mine.xml", "--report", "there/mine.xml", "--overwrite"]
    assert "would overwrite the input there/mine.xml" in complaint(capsys, "run", box, *options)
    assert moved.read_bytes() == before


def test_no_output_is_the_checkpoint_that_a_run_starts_from(box, capsys):
    assert main.main(["run", str(box), *SMALL, "--steps", "5"]) == 0
    before = Path("box.chk").read_bytes()
    message = complaint(capsys, "run", box, *SMALL, "--start", "box.chk", "--overwrite")
    assert "box.chk would overwrite the input box.chk" in message
    assert Path("box.chk").read_bytes() == before


@pytest.mark.parametrize(
    "options",
    [
        ["--report", "x.chk"],
        ["--report", "linked.csv"],
        ["--report", "x.csv", "--pressure-tensor", "x.csv"],
    ],
)
def test_no_output_is_another_one(box, capsys, no_equilibration, options):
    # A link to nothing yet.
    Path("linked.csv").symlink_to("x.dcd")
    command = ["run", box, *SMALL, "--out", "x.dcd", *options, "--overwrite"]
    assert "outputs must be different files" in complaint(capsys, *command)


def test_temporary_files_replace_no_others(box, capsys):
    """No file of the user and no other output of the run has their names."""
    Path("x.chk.tmp").write_text("mine")
    extras = ["--report", "x.csv.tmp"]
    assert main.main(["run", str(box), *SMALL, "--steps", "5", "--out", "x.dcd", *extras]) == 0
    assert Path("x.chk.tmp").read_text() == "mine"
    assert Path("x.csv.tmp").read_text().startswith("Step,")
    assert sorted(path.name for path in Path().iterdir()) == [
        *("box.pdb", "x.chk", "x.chk.tmp", "x.csv.tmp", "x.dcd"),
    ]


def test_a_new_file_has_the_permissions_of_others():
    Path("there").write_text("")
    records.replace(Path("made"), memoryview(b""))
    assert Path("made").stat().st_mode == Path("there").stat().st_mode
    # Those that a user gave it stay.
    Path("made").chmod(0o600)
    records.replace(Path("made"), memoryview(b"new"))
    assert stat.S_IMODE(Path("made").stat().st_mode) == 0o600


def test_what_a_checkpoint_notes_is_on_the_disk_before_it_replaces_the_old_one(monkeypatch):
    """After a power failure the file is the old or the new one, and the log has the rows that it notes."""
    log, done = records.Log(Path("a.csv"), ["Step"], None), []

    def watch(name):
        original = getattr(os, name)

        def watched(*arguments):
            done.append(name)
            return original(*arguments)

        monkeypatch.setattr(os, name, watched)

    for name in ("fsync", "replace"):
        watch(name)
    log.noted()
    assert done == ["fsync"]
    records.replace(Path("a.chk"), memoryview(b"new"))
    assert done == ["fsync", "fsync", "replace"]


def test_settings_are_inputs_too(box, capsys, no_equilibration):
    Path("a.csv").write_text('ensemble = "nve"\n')
    before = contents(Path())
    message = complaint(capsys, "run", box, *SMALL, "--config", "a.csv", "--out", "a.dcd", "--overwrite")
    assert "a.csv would overwrite the input a.csv: give another name" in message
    assert contents(Path()) == before


def test_paths_that_are_refused(box, capsys, no_equilibration):
    Path("there.dcd").mkdir()
    Path("full.csv").write_text("mine\n")
    for code, options, expected in (
        (1, ["--out", "there.dcd"], ": there.dcd is not a regular file"),
        (2, ["--pressure-tensor-every", "1"], "--pressure-tensor-every needs --pressure-tensor"),
        # A root who overwrites it would lose the device.
        (1, ["--report", "/dev/null", "--overwrite"], "/dev/null is not a regular file"),
        (1, ["--out", "none/a.dcd"], "there is no directory none for a.dcd: make it"),
        (1, ["--report", "full.csv"], "full.csv exists"),
        (2, ["--report", "x.dcd", "--out", "y.dcd"], "x.dcd will be a table: give a name that ends in .csv"),
        (2, ["--out", "y.xtc"], "the name of a trajectory must end in .dcd, got y.xtc"),
        (2, ["--cutoff", "0.4", "--switch", "0.4"], "--switch 0.4 must be below --cutoff 0.4"),
        (2, ["--platform", "Abacus"], "--platform: expected one of those that OpenMM has here, Reference, "),
        (2, ["--platform", "HIP"], "got HIP: pip install 'openmm[hip6]' brings it"),
        (2, ["--platform", "Abacus", "--seeds", "1-2"], "openmm-sier: argument --platform: expected one of "),
    ):
        message = complaint(capsys, "run", box, *options, code=code)
        assert expected in message
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    assert sorted(path.name for path in Path().iterdir()) == ["box.pdb", "full.csv", "there.dcd"]


def test_files_that_are_missing_at_a_restart(box, capsys):
    assert main.main(["run", str(box), *SMALL, "--steps", "10", "--out", "box.DCD"]) == 0
    capsys.readouterr()
    again = ["run", box, "--platform", "Reference", "--steps", "20", "--restart", "box.chk"]
    for name in ("box.DCD", "box.csv"):
        content = Path(name).read_bytes()
        Path(name).unlink()
        assert f"{name}, which the run of this checkpoint writes, is missing: put it back" in complaint(capsys, *again)
        Path(name).write_bytes(content)
    assert main.main([str(argument) for argument in again]) == 0


def run_process(command, **options):
    """Exit code, standard output and standard error of a shell command, in which $RUN is our command."""
    environment = {**os.environ, "RUN": f"{sys.executable} -m openmm_sier.cli"}
    process = subprocess.run(
        ["sh", "-c", command], env=environment, capture_output=True, text=True, timeout=300, check=False, **options
    )
    return process.returncode, process.stdout, process.stderr


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("to", "said"),
    [
        (">&-", "standard output is closed; send it to a file, or to /dev/null"),
        ("> /dev/full", "No space left on device"),
    ],
)
def test_standard_output_that_takes_nothing(box, to, said):
    code, _, err = run_process(f"$RUN run box.pdb {to}")
    assert (code, err) == (1, f"openmm-sier: {said}\n")
    assert [path.name for path in Path().iterdir()] == ["box.pdb"]


def test_letters_that_standard_output_does_not_have_are_escaped():
    printed = io.TextIOWrapper(io.BytesIO(), "ascii")
    streams.escape(printed)
    print("1 ± 2", file=printed, end="", flush=True)
    assert printed.buffer.getvalue() == b"1 \\xb1 2"


@pytest.mark.thorough
def test_reader_of_standard_output_that_has_gone(box):
    """A run of days needs no reader: `openmm-sier run ... | head -1` completes."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "openmm_sier.cli", "run", "box.pdb", *SMALL, "--steps", "2"]
    process = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, timeout=300, check=False)
    os.close(writer)
    assert (process.returncode, process.stderr) == (0, b"")
    assert records.last_step(Path("box.csv")) == 0
    assert Path("box.chk").exists()


# --- disks that become full ---


@pytest.fixture
def file_size_limit():
    """A function that limits the bytes of any file that this process writes, as a quota does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_file_that_cannot_grow(box, capsys, file_size_limit):
    """The run ends with the file's name, keeps its last checkpoint, and can be continued."""
    options = ["--dt", "4", "--platform", "Reference", "--equilibrate", "0", "--checkpoint-every", "0.02"]
    options += ["--every", "0.004", "--report-every", "0.4"]
    assert main.main(["run", str(box), *options, "--steps", "1", "--out", "first.dcd"]) == 0
    # Checkpoints fit, which differ a little in size.
    room = round(1.3 * Path("first.chk").stat().st_size)
    capsys.readouterr()
    file_size_limit(room)
    message = complaint(capsys, "run", box, *options, "--steps", "400")
    file_size_limit(resource.RLIM_INFINITY)
    assert message.startswith("openmm-sier: box.dcd: File too large, at step ")
    assert "The last checkpoint is box.chk" in message
    notes = checkpoints.read_checkpoint(Path("box.chk"))[1]
    assert f"of step {notes.step};" in message
    assert not list(Path().glob("*.tmp"))
    more = notes.step + 5
    assert main.main(["run", str(box), "--platform", "Reference", "--restart", "box.chk", "--steps", str(more)]) == 0
    assert frames(Path("box.dcd"), box).n_frames == more


def test_checkpoint_that_does_not_fit(box, capsys, file_size_limit):
    assert main.main(["run", str(box), *SMALL, "--steps", "20"]) == 0
    before = Path("box.chk").read_bytes()
    capsys.readouterr()
    file_size_limit(len(before) - 1000)
    message = complaint(capsys, "run", box, "--platform", "Reference", "--restart", "box.chk", "--steps", "40")
    file_size_limit(resource.RLIM_INFINITY)
    assert message.startswith("openmm-sier: box.chk: File too large, at step 25")
    assert "is box.chk, of step 20; --restart continues from it" in message
    assert Path("box.chk").read_bytes() == before
    assert not Path("box.chk.tmp").exists()
    assert main.main(["run", str(box), "--platform", "Reference", "--restart", "box.chk", "--steps", "40"]) == 0
    assert frames(Path("box.dcd"), box).n_frames == 8
