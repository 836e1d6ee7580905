"""Studies from command line to files, in miniature; no test asserts a speed."""

import json
import math
import shlex
from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import openmm
import pandas as pd
import pytest
from openmm import app, unit

from openmm_sier.inputs.forcefields import Interactions
from studies import frame, gpu, heat_bath, kernels, records, speed, speed_boxes, timing, whole_run
from studies.domains import __main__ as domains_command
from studies.domains import energy as domains_energy
from studies.domains import speed as domains_speed
from studies.hmc import trials
from studies.paper import __main__ as paper_command
from studies.paper import dipole, free_rotation, liquids, water_runs
from tests.support.commands import SYSTEMS
from tests.support.matrices import representatives
from tests.support.studies import make_here
from tests.support.waters import water_box

DIPEPTIDE = SYSTEMS / "dipeptide.pdb"


class Miniature(NamedTuple):
    """A study made small: its module, command lines, the check of its tables, and what is changed in its modules."""

    study: ModuleType
    lines: tuple[str, ...]
    check: Callable[[dict[str, pd.DataFrame]], None]
    patches: tuple[tuple[object, str, object], ...]


#: By the names of their records.
MINIATURES: dict[str, Miniature] = {}

#: Those that draw a figure of the same name.
DRAWN = {"domains", "water", "whole-run"}

#: Those whose runs are not kept one by one. Kept runs are not made again.
MADE_AT_ONCE = {"dipole", "free-rotation", "gpu", "speed", "water"}

#: The one whose runs have a process of their own, as those of all studies have outside of tests.
IN_ITS_PROCESS = "whole-run"

#: Boxes that are equilibrated as they are need no minimization, which takes longer than runs in miniature.
EQUILIBRATED = (openmm.LocalEnergyMinimizer, "minimize", staticmethod(lambda *arguments: None))


def miniature(record, study, *lines, patches=()):
    """Makes a check of tables one of a study in miniature.

    Args:
        record: name of its file.
        study: its module.
        lines: command lines, one after the other, in which names of files are filled in.
        patches: what is changed in its modules.
    """

    def add(check):
        MINIATURES[record] = Miniature(study, lines, check, patches)
        return check

    return add


#: 64 molecules in a box of 1.24 nm leave a cut-off of 0.6 nm.
WATER = water_runs.WaterSettings(
    molecules=64,
    cutoffs=liquids.Cutoffs(molecular_on=0.4, molecular_off=0.6),
    kinds=(liquids.MOLECULAR,),
    force_steps_fs=(0.5, 1.0, 2.0, 3.0),
    compared_from_fs=2.0,
    compared_to_fs=2.0,
    fine_below_fs=0.0,
    span=0.2,
    runs=1,
    relax=0.2,
)
FREE = free_rotation.FreeRotationSettings(steps_fs=(8.0,), span=0.2, bodies=10, exact_bodies=2)


@miniature(
    "dipole", paper_command, "dipole --quick", patches=((dipole, "QUICK", dipole.DipoleSettings(bodies=20, span=0.1)),)
)
@miniature("free-rotation", paper_command, "free-rotation --quick", patches=((free_rotation, "QUICK", FREE),))
def any_tables(found):
    assert found


@miniature(
    "domains",
    domains_command,
    "--models patchy --shorter 200 --rounds 1",
    "--models chain --kinds bath --methods hmc sier2 inner --steps 40 --shorter 200",
    patches=((domains_speed, "TURN", 0.01), (domains_energy, "WARMING", 1.0)),
)
def domains(found):
    rows = found["averages"].set_index(["key", "name", "step"])
    names = ("hmc", "springs-hmc", "sier2", "frames", "langevinmiddle")
    assert set(rows.loc["patchy"].index.get_level_values("name")) == set(names)
    # Springs start at rest, and take up to half of the heat in 0.75 ps; 384 degrees of freedom scatter by 7 %.
    assert rows.loc["patchy", "temperature"].between(100, 450).all()
    assert rows.loc["chain", "gyration"].between(1, 10).all()
    assert found["broken"].empty
    assert (found["speeds"]["ns_a_day"] > 0).all()
    # Springs have periods of 70 fs, of which 5 fs are a fourteenth; without them 20 fs are short.
    energies = found["energies"].set_index(["method", "step"])["rms"]
    assert energies["SIER4G", 20.0] < energies["Verlet, springs", 5.0]
    assert list(found["gains"]["step"]) == [20, 40, 60]


@miniature(
    "speed",
    speed,
    # A liquid, since a lattice is so hot when it melts that steps of 9 fs break it.
    "{tip3p_64} --boxes water-59 dipeptide --rounds 1 --turn 1e-6 --time 0.02 --equilibrate 0.01 --starts 1 "
    "--platform CPU",
    patches=(
        (speed, "STEPS", {"verlet": (0.5, 2.0), "sier2": (0.5,), "sier2p3": (1.0,), "sier4g": (1.0,)}),
        # The cut-off that fits the box.
        (speed_boxes, "INTERACTIONS", Interactions()),
        (speed_boxes, "SOLUTES", {"dipeptide": DIPEPTIDE}),
        (speed, "SOLUTES", {"dipeptide": DIPEPTIDE}),
    ),
)
def speeds(found):
    rows = found["speeds"]
    assert rows.groupby("box", sort=False)["atoms"].first().to_dict() == {"water-59": 177, "dipeptide": 721}
    alone, solute = ([1, 2, 2, longest / 3, 4 / 3, 2, 4, 5] for longest in (12, 9))
    assert list(rows["fs_per_force"]) == pytest.approx([*alone, 8, 9, 10, 6, 8, 9, 10, *solute, 8, 8, 9, 10])
    assert set(rows["platform"]) == {"CPU"}
    assert list(rows["engine"][:8]) == ["", "", "exact", "exact", "exact", "", "", ""]
    assert (rows.loc[rows["name"] == speed.REFERENCE, "over"] == 1).all()
    assert (rows.loc[rows["name"] == speed.BATH_REFERENCE, "over_middle"] == 1).all()
    # Speed at equal energy error is for water alone.
    assert set(found["equal"]["box"]) == {"water-59"}
    assert set(found["points"]["method"]) == {"OpenMM Verlet", "SIER2", "SIER2P3", "SIER4G"}


@miniature(
    "gpu",
    gpu,
    "--boxes water-512 --averages water-512 --energies water-512 --chains 1 --rounds 1 --turn 1e-6 --time 0.08 "
    "--settle 0.01 --energy-time 0.04 --platform CPU",
    patches=(
        EQUILIBRATED,
        (frame, "CALL", 2),
        (timing, "CALL", 2),
        (gpu, "EVERY", 18.0),
        (gpu, "EVERY_ENERGY", 4.0),
        (gpu, "WARM", 0.01),
    ),
)
def on_gpus(found):
    rows = found["speeds"].set_index("method")
    assert (rows["atoms"] == 1536).all()
    assert rows.loc[gpu.REFERENCE, "over"] == 1
    assert (rows["microseconds"] > 0).all()
    assert rows.loc["SIER2, 9 fs", "engine"] == "exact" == rows.loc["SIER2, 9 fs, exact engine", "engine"]
    # Methods without a bath have no averages, and the one with short steps no speed.
    means = found["averages"].set_index("method")
    alone = {"Verlet, 2 fs", "SIER4G, 4 fs", "SIER2, 9 fs, exact engine", gpu.SHORT_STEPS}
    assert set(rows.index) ^ set(means.index) == alone
    assert means["trials"].dropna().tolist() == [1]
    assert (means[["translation", "rotation"]] > 0).all(axis=None)
    energies = found["energies"].set_index("method")["percent"]
    assert (energies[["SIER4G, 4 fs", "Verlet, 2 fs"]] > 0).all()
    assert found["domains"]["beads"].tolist() == 5 * [120]
    assert set(found["domains"]["engine"]) == {"", "native", "exact"}


@miniature(
    "kernels",
    kernels,
    "--kinds energy --starts 2",
    # Without compiled kernels there is the exact engine.
    patches=(
        (kernels, "STEPS", 20),
        (kernels, "EVERY_ENERGY", 4.0),
        (kernels, "WARM", 0.02),
        (kernels, "APART", 0.01),
        (kernels, "MOVERS", {kernels.ENERGY: (kernels.EXACT,)}),
    ),
)
def engines(found):
    rows = found["energy"]
    assert rows["engine"].tolist() == ["exact"]
    assert (rows[["starts", "steps"]] == (2, 20)).all(axis=None)
    assert (rows[["percent", "percent_error"]] > 0).all(axis=None)


@miniature(
    "whole-run",
    whole_run,
    "--methods verlet sier4g --per-force 1.5 20 --starts 1 --time 0.3 --equilibrate 0.1",
    "--liquids {tip3p_64} --methods sier2 --per-force 1 --starts 1 --time 0.3 --equilibrate 0.1",
)
def whole_runs(found):
    rows = found["rows"].set_index(["method", "step"])
    assert rows.loc[("SIER4G", 4.5), "percent"] > 0
    assert rows.loc[("OpenMM Verlet", 1.5), "percent"] > 0
    assert "A step of 60 fs is too long" in rows.loc[("SIER4G", 60.0), "broken"]
    assert rows["percent"].isna()["SIER4G", 60.0]
    assert found["gains"]["gain"].dropna().iloc[0] > 0
    # A file is a liquid by its name.
    assert found["rows"].set_index("liquid")["percent"]["named"] > 0


@miniature(
    "heat-bath",
    heat_bath,
    '{dipeptide} --methods "LangevinMiddle, 4 fs" "SIER2, 8 fs" --time 0.4 --equilibrate 0.02 --friction 20',
    # 25 samples of both: a mean of 20 or more always has an error, and is known.
    patches=(EQUILIBRATED, (heat_bath, "INTERVAL", 16.0)),
)
def bath_averages(found):
    rows = found["rows"].set_index("method")
    assert (rows[["water", "solute", "bonds"]] > 0).all(axis=None)
    assert rows.loc["LangevinMiddle, 4 fs", "over"] == 1


@miniature(
    "trials",
    trials,
    '{dipeptide} --methods "LangevinMiddle, 4 fs" "SIER2V2 HMC, 9 fs x 8, 1/ps" --time 0.36 --equilibrate 0.02',
    patches=(EQUILIBRATED, (heat_bath, "INTERVAL", 72.0)),
)
def costs_of_trials(found):
    rows = found["rows"].set_index("method")
    assert (rows["broken"] == "").all()
    assert 0 <= rows.loc["SIER2V2 HMC, 9 fs x 8, 1/ps", "accepted"] <= 1
    # Costs are not known from so short a run; `test_hmc_studies` has those of made-up ones.
    assert (rows["milliseconds"] > 0).all()


@miniature("water", paper_command, "water --quick", patches=((water_runs, "QUICK", WATER),))
def errors_of_schemes(found):
    """Between 0.5 and 1 fs the slopes are the orders, but for higher ones and one short run; MRDL lies on SIER2.

    Runs of 0.2 ps from one start, in double precision, are so short that chaos parts them by rounding alone.
    """
    percent = found["points"].set_index(["method", "force_step_fs"])["percent"]
    for name, order in (("SIER2", 2), ("SIER4", 4)):
        assert math.log2(percent[name, 1.0] / percent[name, 0.5]) == pytest.approx(order, abs=0.5)
    assert percent["MRDL", 2.0] == pytest.approx(percent["SIER2", 2.0], rel=0.05)
    assert 1.5 < found["crossings"]["force_step_fs"][0] < 2.8


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    place = tmp_path_factory.mktemp("boxes")
    topology, positions, _ = water_box("tip3p", 64)
    app.PDBFile.writeFile(topology, positions * unit.nanometer, str(place / "box.pdb"))
    named = place / "named.pdb"
    named.write_text("REMARK  99 FORCEFIELD tip3p.xml\n" + (place / "box.pdb").read_text())
    return {"tip3p_64": named, "dipeptide": DIPEPTIDE}


@pytest.mark.parametrize("name", representatives(MINIATURES, "heat-bath"))
def test_in_miniature(name, boxes, tmp_path, monkeypatch, capsys):
    made = MINIATURES[name]
    for patch in made.patches:
        monkeypatch.setattr(*patch)
    if name != IN_ITS_PROCESS:
        monkeypatch.setattr(records, "make_missing", make_here)

    def execute(line):
        arguments = shlex.split(line.format(**boxes, out=tmp_path))
        return made.study.main([*arguments, "--out", str(tmp_path)]), capsys.readouterr()

    for line in made.lines:
        code, (said, complaint) = execute(line)
        assert code == 0, complaint
    record = records.read(tmp_path / f"{name}.json")
    made.check(record.tables)
    assert said.strip()
    assert json.loads((tmp_path / f"{name}.json").read_text())["versions"]["openmm"]
    if name in DRAWN:
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    if name in MADE_AT_ONCE:
        return
    runs = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.jsonl")}
    assert runs
    assert execute(made.lines[0])[0] == 0
    assert {path: path.stat().st_mtime_ns for path in runs} == runs
    again = records.read(tmp_path / f"{name}.json").tables
    for key, table in record.tables.items():
        pd.testing.assert_frame_equal(again[key], table)
