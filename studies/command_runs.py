"""Runs of `openmm-sier run` for studies: each in a separate process and directory, from which it continues."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mdtraj
import numpy as np

from openmm_sier import analysis
from openmm_sier.cli.arguments import arguments
from openmm_sier.cli.errors import NothingLeft

#: Names of the files of a run.
TRAJECTORY, LOG, CHECKPOINT = "run.dcd", "run.csv", "run.chk"


class RunFailed(ValueError):
    """A run ended with an error."""


def carry_out(directory: Path, box: Path, options: Mapping[str, Any]) -> None:
    """Make a run in a directory, or continue an existing one to its end.

    Args:
        directory: for its files.
        box: coordinates.
        options: of `openmm-sier run` by their names, besides those that name files.

    Raises:
        RunFailed: with the message of the command.
    """
    directory.mkdir(parents=True, exist_ok=True)
    begin = ["--out", TRAJECTORY, "--overwrite"]
    way = ["--restart", CHECKPOINT] if (directory / CHECKPOINT).exists() else begin
    words = [each for name, value in options.items() for each in arguments(name, value)]
    line = [sys.executable, "-m", "openmm_sier.cli", "run", str(box.resolve()), *words, *way]
    process = subprocess.run(line, cwd=directory, capture_output=True, text=True, check=False)
    if process.returncode not in (0, NothingLeft.exit_code):
        raise RunFailed(f"the run in {directory} failed: {process.stderr}")


def read_log(directory: Path, skip: float) -> dict[str, np.ndarray]:
    """Return the columns of the log of a run without its first `skip` ps."""
    log = analysis.read_log(directory / LOG)
    is_later = log["Time (ps)"] >= skip
    return {name: column[is_later] for name, column in log.items()}


def read_frames(directory: Path, box: Path) -> mdtraj.Trajectory:
    """Return the frames of a run of a PDB file."""
    return mdtraj.load(str(directory / TRAJECTORY), top=str(box))
