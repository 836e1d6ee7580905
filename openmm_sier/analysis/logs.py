"""Read the logs of runs: CSV tables of numbers with a heading."""

import io
import os

import numpy as np

from openmm_sier.system.untrusted_files import open_regular


def read_log(path: str | os.PathLike[str], *, whole_lines: bool = False) -> dict[str, np.ndarray]:
    """Read a log of the command or of `ConservationReporter`, by column.

    >>> columns = read_log("run.csv")
    >>> energies = columns["Conserved Energy (kJ/mole)"]

    Args:
        path: the CSV file.
        whole_lines: True skips an incomplete last line of a killed run; False refuses it.

    Returns:
        Arrays (rows,) by the names in the heading.

    Raises:
        OSError: the file cannot be read.
        ValueError: a row contains something else than numbers, or not as many as the heading has names.
    """
    with io.TextIOWrapper(open_regular(path)) as file:
        columns = file.readline().rstrip().split(",")
        lines = (line for line in file if line.endswith("\n")) if whole_lines else file
        try:
            rows = np.loadtxt(lines, delimiter=",", ndmin=2).reshape(-1, len(columns))
        except ValueError as error:
            raise ValueError(f"cannot read the rows of {os.fspath(path)} below its heading: {error}") from error
    return dict(zip(columns, rows.T, strict=True))
