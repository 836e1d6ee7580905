"""`python -m studies.launches`: counted commands, and the number of launches a step."""

import pandas as pd
import pytest

from studies.launches import cases, counting, host, shim
from studies.launches.counting import OTHERS
from studies.launches.shim import Commands
from studies.launches.study import LaunchesSettings, study
from tests.support import opencl

#: Seconds after which a case counts as hanging. It takes 10 s on a machine that has nothing else to do.
LIMIT = 1800

#: For a box and a method: the launches of a step of which OpenMM must not need more, and those that follow from the
#: program alone. These are the same whatever OpenMM's forces are made of.
HELD = {
    ("tip4p-512", "sier2"): (39, {"atoms": 3, "constraints, positions": 2, "constraints, velocities": 1}),
    ("peptide", "sier2"): (55, {"atoms": 6, "constraints, positions": 9, "constraints, velocities": 2}),
    ("tip3p-512", "sier4g"): (94, {"atoms": 11, "constraints, positions": 16, "constraints, velocities": 2}),
}


# --- numbers ---


def test_commands_are_counted_by_what_they_do():
    result = counting.numbers(
        [
            Commands("kernel", "computePerDof", False, 5, 0),
            Commands("kernel", "computeNonbonded", False, 2, 0),
            Commands("kernel", "VkFFT_main", False, 6, 0),
            Commands("kernel", "unheardOf", False, 1, 0),
            Commands("copy", "", False, 3, 300),
            Commands("read", "", False, 2, 8),
            Commands("read", "", True, 1, 1000),
            Commands("write", "", True, 4, 64),
            Commands("wait", "", True, 2, 0),
        ]
    )
    kernels = {"launches": 14, "atoms": 5, "nonbonded": 2, "mesh": 6, OTHERS: 1}
    copies = {"copies": 3, "copies_bytes": 300}
    reads = {"reads": 3, "reads_bytes": 1008, "blocking_reads": 1}
    writes = {"writes": 4, "writes_bytes": 64, "blocking_writes": 4}
    # OpenMM waits for a blocking transfer as it does for an event.
    assert result == kernels | copies | reads | writes | {"waits": 7}


def test_a_step_is_distinguished_from_its_call():
    """Thirty launches for a step, and one for a call with two reads; one read in every step."""
    one, many = {"launches": 31, "reads": 3}, {"launches": 301, "reads": 12, "writes": 9}
    assert counting.divided(one, many, 10) == (
        {"launches": 30, "reads": 1, "writes": 1},
        {"launches": 1, "reads": 2, "writes": -1},
    )


# --- the library ---


def test_without_a_compiler_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(OSError, match="no C compiler"):
        shim.build(tmp_path)


def test_it_must_be_preloaded():
    with pytest.raises(OSError, match="LD_PRELOAD"):
        shim.Shim()


# --- OpenMM ---


def skip_without_opencl() -> None:
    if shim.compiler() is None:
        pytest.skip("there is no C compiler")
    if "OpenCL" not in opencl.gpu_platforms():
        pytest.skip("OpenMM has no OpenCL platform here: pip install 'openmm-sier[opencl-test]' brings it on the CPU")


@pytest.fixture(scope="module")
def rows_of_step(tmp_path_factory):
    """A function that counts a case, and gives the row of a step and its kernels by what they do."""
    skip_without_opencl()
    out = tmp_path_factory.mktemp("launches")

    def count(box: str, method: str) -> tuple[pd.Series, dict[str, float]]:
        result = study(LaunchesSettings(boxes=(box,), methods=(method,), precisions=("mixed",), out=out)).tables
        (step,) = result["rows"].query("per == 'step'").to_dict("records")
        kernels = result["kernels"].set_index("kind")["launches"].to_dict()
        return step, kernels

    return count


@pytest.mark.thorough
@pytest.mark.timeout(LIMIT)
@pytest.mark.parametrize(("box", "method"), HELD)
def test_launches_of_a_step(rows_of_step, box, method):
    most, own = HELD[box, method]
    step, kernels = rows_of_step(box, method)
    assert step["launches"] <= most
    assert {kind: kernels.get(kind, 0) for kind in own} == own
    # Whatever is written to the device in mid-step drains it first.
    assert step["writes"] == 0
    # OpenMM sends no kernel in a step that the study has no name for.
    assert OTHERS not in kernels
    # Each full force waits for the number of interacting tiles. The watch for runaways reads velocities now and then.
    forces = 3 if method == "sier4g" else 1
    assert forces <= step["waits"] < forces + 0.2
    assert step["method"] == cases.CASES[method].integrator.name


@pytest.mark.thorough
@pytest.mark.timeout(LIMIT)
def test_a_trial_sends_numbers_alone(rows_of_step):
    """Sixteen forces, each with four bytes of flags of its neighbour list, and one more after a trial that is rejected.

    Reads that block are those of three sums for the centre of mass, two kinetic energies and one potential energy, and
    another one after a rejection.
    """
    step, kernels = rows_of_step("tip3p-512", "hmc")
    assert step["launches"] <= 400 + 27
    assert step["writes_bytes"] + step["reads_bytes"] - 4 * 16 <= 1000
    assert 6 <= step["blocking_reads"] <= 7
    assert step["blocking_writes"] == 3
    assert step["copies"] == 0
    # Two for each drift: constraints, and the positions that follow from them.
    assert kernels["constraints, positions"] == 32


@pytest.mark.thorough
@pytest.mark.timeout(LIMIT)
@pytest.mark.parametrize("method", ["langevinmiddle", "sier2"])
def test_time_of_the_host(tmp_path, method):
    """Steps without commands are timed, by OpenMM's integrator and by a program."""
    skip_without_opencl()
    settings = host.HostSettings(boxes=("tip3p-64",), methods=(method,), out=tmp_path)
    (row,) = host.study(settings).tables["rows"].to_dict("records")
    assert row["atoms"] == 3 * 64
    assert 0 < row["host_low"] <= row["host"] <= row["host_high"]
    assert row["busy"] > 0
