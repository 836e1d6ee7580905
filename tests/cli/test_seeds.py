"""`run --seeds`: parallel members, killed, stopped and refused; the same bytes as single runs."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import openmm
import pytest

from openmm_sier.cli import main
from openmm_sier.cli.command_line import parse
from openmm_sier.cli.many import members
from openmm_sier.cli.many.command import _grouped, _usual_workers
from openmm_sier.cli.many.complete import is_complete, settings_in
from openmm_sier.cli.many.members import Member, command_of, run_many
from openmm_sier.cli.many.seeds import read_seeds
from openmm_sier.dynamics.threads import cores
from openmm_sier.engines import snapshot
from tests.support.commands import SMALL, complaint, contents, log, run, wait_for

pytest.importorskip("distributed")

#: Seconds after which a test fails rather than wait. Each member takes some seconds to begin.
LIMIT = 300

MANY = [*SMALL, "--out", "a.dcd", "--report-every", "0.02"]

#: ps between rows and frames, and the length of a run that no machine completes while a test waits.
ROW, FOR_EVER = 0.02, 1e6


def until(rows):
    """Options of runs with so many rows after the first."""
    return ["--time", f"{ROW * rows:g}"]


def files(place, seeds):
    return {
        name: (Path(place) / name).read_bytes() for seed in seeds for name in (f"a-seed{seed}{end}" for end in ENDS)
    }


#: Of the files whose bytes tell where a run went. Checkpoints hold the time of their making.
ENDS = (".dcd", ".csv")


@pytest.fixture(scope="module")
def single_runs(box, tmp_path_factory):
    """A function that makes runs one after the other, as long as they are wanted; their directory."""
    place = tmp_path_factory.mktemp("single")

    def make(rows, seeds=(1, 2, 3)):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(place)
            patch.setenv("OPENMM_CPU_THREADS", "1")
            for seed in seeds:
                line = ["run", box, *MANY, *until(rows), "--seed", seed, "--overwrite"]
                line[line.index("a.dcd")] = f"a-seed{seed}.dcd"
                run(*line)
        return place

    return make


def test_nothing_listens_beyond_this_machine():
    """Dask's scheduler and each of its workers have an HTTP server, by default on all interfaces."""
    psutil = pytest.importorskip("psutil")
    with members._client(None, 2):
        listening = {each.laddr.ip for each in psutil.Process().net_connections() if each.status == "LISTEN"}
    assert listening == {"127.0.0.1"}


def started(box, *options):
    command = [sys.executable, "-m", "openmm_sier.cli", "run", box, *MANY, *options]
    return subprocess.Popen(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )


def ended(process):
    """Exit code, output and complaint of a process that is to end soon."""
    try:
        out, err = process.communicate(timeout=LIMIT)
    finally:
        process.kill()
    return process.returncode, out, "".join(line for line in err.splitlines(True) if not line.endswith(" left\n"))


def rows(seed):
    path = Path(f"a-seed{seed}.csv")
    return path.read_text().count("\n") - 1 if path.exists() else 0


def process_of(seed):
    """The process of a member in this directory, by its command line; None without one."""
    for process in Path("/proc").glob("[0-9]*"):
        # Any process may end meanwhile.
        with suppress(OSError):
            words = (process / "cmdline").read_bytes().split(b"\0")
            if f"a-seed{seed}.dcd".encode() in words and (process / "cwd").resolve() == Path().resolve():
                return int(process.name)
    return None


def wait_for_members():
    """Wait until all members have ended, which complete a step and their files by themselves."""
    latest = time.monotonic() + LIMIT
    while any(process_of(seed) for seed in (1, 2, 3)):
        assert time.monotonic() < latest
        time.sleep(0.1)


def assert_a_call_completes_what_is_there(box, single_runs, seeds=(1, 2, 3)):
    """The same command, now with an end: all files are those of single runs, byte by byte."""
    wait_for_members()
    end = max(map(rows, seeds)) + 5
    code, _, err = ended(started(box, "--seeds", f"1-{len(seeds)}", "--workers", "3", *until(end)))
    assert (code, err) == (0, "")
    assert files(".", seeds) == files(single_runs(end, seeds), seeds)
    assert len(log("a-seed2.csv")["Step"]) == end + 1


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("1-3", [1, 2, 3]), ("7", [7]), ("1-2,9, 4 - 5", [1, 2, 9, 4, 5]), ("2147483647", [2147483647])],
)
def test_seeds_are_read(text, seeds):
    assert read_seeds(text) == seeds


@pytest.mark.parametrize(
    "text", ["", "0", "0-3", "3-1", "1,1", "1-3,2", "a", "1.5", "-3", "1-", "1-99999", "2147483648"]
)
def test_seeds_that_are_none(capsys, text):
    message = complaint(capsys, "run", "box.pdb", f"--seeds={text}", code=main.MISUSED)
    assert "expected" in message
    assert repr(text) in message


def test_names_with_a_dash_are_no_options_of_a_member():
    options = {"forcefield": [Path("-f.xml"), Path("g.xml")], "pressure": -5.0, "topology": Path("-t.top")}
    line = command_of(Path("-w.pdb"), Member(1, Path("-m-seed1.dcd")), options)
    chosen = parse(line).carry_out.args[0].chosen
    assert chosen.pop("resume")
    assert chosen == {"box": Path("-w.pdb"), "out": Path("-m-seed1.dcd"), "seed": 1, **options}
    # Where a member looks for it.
    assert line[line.index("--out") + 1] == "./-m-seed1.dcd"


def test_each_member_has_tensors_of_its_own():
    member = Member(7, Path("a-seed7.dcd"))
    line = command_of(Path("w.pdb"), member, {"pressure_tensor": Path("there/p.csv")})
    assert parse(line).carry_out.args[0].chosen["pressure_tensor"] == Path("there/p-seed7.csv")


def test_a_platform_that_does_not_work_is_not_the_usual_one(monkeypatch):
    """OpenMM takes another one, whose cores members share; here Reference stands for a GPU without its driver."""
    monkeypatch.setattr(snapshot, "HOST_PLATFORMS", ("CPU",))
    monkeypatch.setattr(openmm.Platform, "getSpeed", lambda platform: 100 * (platform.getName() == "Reference"))
    assert _usual_workers(None) == cores()
    assert _usual_workers("Reference") == 1


def test_each_complaint_is_reported_once():
    runs = [Member(seed, Path(f"a-seed{seed}.dcd")) for seed in (1, 2, 5)]
    complaints = [("no space", run) for run in runs]
    assert _grouped([*complaints, ("another", runs[0])]) == ["no space (--seed 1, 2, 5)", "another (--seed 1)"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seeds", "1-2", "--seed", "3"], "--seed and --seeds both set seeds"),
        (["--seeds", "1-2", "--report", "b.csv"], "--report names one file, but the logs of --seeds are named after"),
        (["--seeds", "1-2", "--restart", "a.chk"], "leave out --restart"),
        (["--seeds", "1-2", "--workers", "2", "--scheduler", "tcp://a:1"], "--workers is for this machine"),
        (["--workers", "2"], "--workers needs --seeds"),
        (["--scheduler", "tcp://a:1"], "--scheduler needs --seeds"),
        (["--seeds", "1-2", "--ensemble", "nvt", "--pressure", "1"], "--pressure needs --ensemble npt or hmc"),
        (["--seeds", "1-2", "--out", "x.abc"], "the name of a trajectory must end in .dcd, got x.abc"),
    ],
)
def test_options_that_do_not_go_together(box, capsys, options, message):
    before = contents(Path())
    assert message in complaint(capsys, "run", box, *options, code=main.MISUSED)
    assert contents(Path()) == before


def test_without_dask(box, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'openmm-sier[many]'" in complaint(capsys, "run", box, *MANY, "--seeds", "1-2")


@pytest.mark.thorough
def test_a_killed_member_is_begun_again(box, single_runs):
    process = started(box, "--seeds", "1-2", "--workers", "2", "--time", str(FOR_EVER))
    wait_for(lambda: rows(2) > 6, process, LIMIT)
    killed = process_of(2)
    os.kill(killed, signal.SIGKILL)
    wait_for(lambda: process_of(2) not in (None, killed) and rows(2) > 12, process, LIMIT)
    process.send_signal(signal.SIGINT)
    code, _, err = ended(process)
    assert code == 130
    assert err == "openmm-sier: stopped: 0 of 2 runs are complete. Give the same command again to continue\n"
    assert_a_call_completes_what_is_there(box, single_runs, seeds=(1, 2))


def test_a_picture_that_is_not_theirs_is_refused(box, capsys):
    pytest.importorskip("matplotlib")
    Path("a.png").write_bytes(b"mine")
    before = contents(Path())
    message = complaint(capsys, "run", box, "--out", "a.dcd", "--seeds", "1-2", "--steps", "1", "--plot", "a.png")
    assert "a.png exists" in message
    assert contents(Path()) == before


@pytest.mark.thorough
def test_runs_that_are_complete_are_drawn(box, single_runs):
    for path in single_runs(4, (1, 2)).iterdir():
        shutil.copy(path, ".")
    before = contents(Path())
    code, out, err = ended(started(box, "--seeds", "1-2", "--workers", "1", *until(4), "--plot", "a.png"))
    assert (code, err) == (0, "")
    assert "2 runs of SIER2, NVE, 4 fs, to step 20 (0.08 ps), 1 at a time" in out
    assert "mean over 2 runs" in out
    after = contents(Path())
    assert after.pop("a.png").startswith(b"\x89PNG")
    assert after == before
    # The same command draws its own picture again.
    code, _, err = ended(started(box, "--seeds", "1-2", "--workers", "1", *until(4), "--plot", "a.png"))
    assert (code, err) == (0, "")


@pytest.mark.thorough
def test_a_second_call_continues_after_the_first_was_killed(box, single_runs):
    process = started(box, "--seeds", "1-2", "--workers", "2", "--time", str(FOR_EVER))
    wait_for(lambda: max(map(rows, (1, 2))) > 3, process, LIMIT)
    process.kill()
    ended(process)
    assert_a_call_completes_what_is_there(box, single_runs, seeds=(1, 2))


def test_a_stop_before_the_first_step_begins_nothing_again(box, monkeypatch):
    """One member equilibrates for ever, which a signal ends at once, and the other waits."""
    monkeypatch.setattr(members, "REFRESH", 0.02)
    options = {"scheme": "sier2", "dt": 4, "platform": "Reference", "equilibrate": FOR_EVER, "time": 0.4}
    begun = Path(".a-seed1.csv.lock").exists
    runs = run_many(box, [1, 2], out="a.dcd", workers=1, stop=begun, **options)
    assert [(run.state, run.error) for run in runs] == 2 * [("stopped", "")]
    assert not Path("a-seed2.csv").exists()


def test_complete_runs_need_no_process(box, monkeypatch):
    options = {"scheme": "sier2", "dt": 4, "platform": "Reference", "equilibrate": 0, "steps": 4}
    (member,) = run_many(box, [1], out="a.dcd", **options)
    assert (member.state, member.error) == ("complete", "")
    monkeypatch.setattr(members, "_client", None)
    (member,) = run_many(box, [1], out="a.dcd", **options)
    assert (member.state, member.error) == ("complete", "")
    # Longer runs, and those whose files are damaged, are left to their processes.
    assert not is_complete(settings_in(command_of(box, member, options | {"steps": 5})))
    assert is_complete(settings_in(command_of(box, member, options)))
    Path("a-seed1.csv").write_text("mine\n")
    assert not is_complete(settings_in(command_of(box, member, options)))


@pytest.mark.thorough
def test_a_process_that_has_computed_may_begin_runs(box, monkeypatch):
    """A forked child would hang in its first Context. A member is a new program, for which nothing calls `os.fork`."""
    system = openmm.System()
    system.addParticle(1)
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("CPU"))
    context.setPositions([openmm.Vec3(0, 0, 0)])
    context.getIntegrator().step(1)
    monkeypatch.setattr(os, "fork", None)
    (member,) = run_many(box, [1], out="a.dcd", platform="CPU", equilibrate=0, steps=1)
    assert (member.state, member.error) == ("complete", "")


@pytest.mark.thorough
def test_a_member_that_fails_does_not_end_the_others(box, single_runs, capsys):
    Path("a-seed2.csv").write_text("mine\n")
    code, _, err = ended(started(box, "--seeds", "1-2", "--workers", "2", *until(4)))
    assert code == 1
    assert err.count("\n") == 1
    assert "a-seed2.csv exists, but its checkpoint a-seed2.chk does not" in err
    assert "(--seed 2). 1 of 2 runs are complete" in err
    assert "1 of 2 runs are complete. Give the same command again to continue the others" in err
    assert files(".", (1,)) == files(single_runs(4, (1,)), (1,))
    assert Path("a-seed2.csv").read_text() == "mine\n"


@pytest.fixture
def scheduler():
    """A scheduler of Dask with two workers: its address and all processes."""
    programs = []

    def start(module, *options):
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options]
        programs.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        return programs[-1]

    first = start(
        "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", "s.json"
    )
    wait_for(lambda: Path("s.json").exists() and Path("s.json").read_text().rstrip().endswith("}"), first, LIMIT)
    address = re.search(r"tcp://[\d.]+:\d+", Path("s.json").read_text())[0]
    options = ["--nthreads", "1", "--no-dashboard", "--memory-limit", "0", "--death-timeout", "60", "--no-nanny"]
    workers = [start("dask_worker", address, *options) for _ in range(2)]
    yield address, first, workers
    for program in programs:
        program.kill()
        program.wait()


@pytest.mark.thorough
def test_workers_and_the_scheduler_are_killed(box, single_runs, scheduler):
    address, first, workers = scheduler
    process = started(box, "--seeds", "1-3", "--scheduler", address, "--time", str(FOR_EVER))
    # Two of three runs have a worker each.
    wait_for(lambda: sum(rows(seed) > 3 for seed in (1, 2, 3)) == 2, process, LIMIT)
    workers[0].kill()
    # The other worker goes on with its run.
    done = sum(map(rows, (1, 2, 3)))
    wait_for(lambda: sum(map(rows, (1, 2, 3))) > done + 6, process, LIMIT)
    first.kill()
    code, _, err = ended(process)
    assert code == 1
    assert err == (
        f"openmm-sier: the scheduler {address} went away. Give the same command again to continue the runs that are "
        "not complete\n"
    )
    workers[1].kill()
    assert_a_call_completes_what_is_there(box, single_runs)
