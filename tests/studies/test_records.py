"""Records of studies as files, and settings as options."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pandas as pd
import pytest

from studies import command, records
from studies.command import BoxSettings, Settings
from studies.records import Record

ROWS = pd.DataFrame(
    [("SIER2", 296.83, 0.14, 512), ("SIER4", math.nan, math.nan, 64)], columns=["method", "T", "T_error", "molecules"]
)


def test_a_record_is_read_as_it_was_written(tmp_path):
    Record({"box": Path("box.pdb"), "dt": (1.0, 2.0)}, {"rows": ROWS}, {"edge": 1.5}).write(tmp_path / "a.json")
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["versions"]["openmm-sier"]
    assert content["tables"]["rows"][1]["T"] is None
    result = records.read(tmp_path / "a.json")
    pd.testing.assert_frame_equal(result.tables["rows"], ROWS)
    assert result.settings == {"box": "box.pdb", "dt": [1.0, 2.0]}
    assert result.notes == {"edge": 1.5}
    (tmp_path / "b.json").write_text("{}")
    with pytest.raises(ValueError, match="no record"):
        records.read(tmp_path / "b.json")


def test_a_record_has_the_commands_that_made_it(tmp_path, monkeypatch):
    """Those of the same settings, which add to the same runs."""
    path = tmp_path / "a.json"

    def commands_after(command, settings):
        monkeypatch.setattr(records, "COMMAND", command)
        Record(settings, {"rows": ROWS}, {}).write(path)
        return list(records.read(path).commands)

    settings = {"box": Path("box.pdb"), "dt": (1.0, 2.0)}
    # One that was written before records had commands.
    path.write_text(json.dumps({"settings": {}, "notes": {}, "tables": {}}))
    assert commands_after("first", settings) == ["first"]
    assert commands_after("second", settings) == ["first", "second"]
    assert commands_after("first", settings) == ["first", "second"]
    assert commands_after("third", settings | {"dt": (1.0,)}) == ["third"]
    assert records.read(path).commands["third"].endswith((" s", " min", " h"))


@dataclass(frozen=True, kw_only=True)
class Files(Settings):
    boxes: tuple[Path, ...] = (Path("/here/a.pdb"), Path("/there/b.pdb"))


def test_files_are_recorded_by_their_names():
    assert Files().recorded() == {"seed": 1, "boxes": ("a.pdb", "b.pdb")}


@dataclass(frozen=True, kw_only=True)
class Numbers(Settings):
    """Of a study.

    Attributes:
        dt: fs.
        pressure: bar.
    """

    dt: tuple[float, ...] = (1.0,)
    pressure: float = 1.0

    ANY_SIGN: ClassVar[tuple[str, ...]] = ("pressure",)


def test_fields_are_options(tmp_path):
    results = []
    arguments = ["--dt", "2", "3", "--pressure", "-5", "--out", str(tmp_path / "new" / "out")]
    assert command.command(Numbers, lambda settings, report: results.append(settings), "what", "")(arguments) == 0
    assert results == [Numbers(out=tmp_path / "new" / "out", seed=1, dt=(2.0, 3.0), pressure=-5.0)]
    assert (tmp_path / "new" / "out").is_dir()


def test_a_box_may_stand_first(tmp_path):
    results = []
    main = command.command(BoxSettings, lambda settings, report: results.append(settings.box), "what", "")
    assert main(["a.pdb", "--out", str(tmp_path)]) == main(["--out", str(tmp_path), "--box", "b.pdb"]) == 0
    assert results == [Path("a.pdb"), Path("b.pdb")]


def test_help_explains_the_options_of_all_studies(capsys):
    assert command.command(Numbers, lambda settings, report: None, "What it does.", "")(["--help"]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "What it does." in output
    assert "bar." in output
    assert "directory for numbers and figures" in output


def test_errors_are_one_line(tmp_path, capsys):
    def study(settings, report):
        raise ValueError("too\nlittle")

    assert command.command(Numbers, study, "", "")(["--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == "too little\n"
    with pytest.raises(SystemExit) as stop:
        command.command(Numbers, study, "", "")(["--dt", "-1"])
    assert stop.value.code == 2
    assert "dt must be above 0, got -1.0" in capsys.readouterr().err


def test_a_directory_has_results_of_one_kind(tmp_path):
    command.claim(tmp_path / "settings.json", {"time": 0.1, "dt": (1, 2)})
    command.claim(tmp_path / "settings.json", {"time": 0.1, "dt": (1, 2)})
    with pytest.raises(ValueError, match=r"time 0\.1, got 0\.2"):
        command.claim(tmp_path / "settings.json", {"time": 0.2, "dt": (1, 2)})
