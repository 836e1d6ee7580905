"""Reads the logs of runs: tables of numbers in CSV, with a heading."""

import os

import numpy as np


def read_log(path: str | os.PathLike[str], *, whole_lines: bool = False) -> dict[str, np.ndarray]:
    """Return all rows of a log, as the command and `ConservationReporter` write them, by column.

    Args:
        path: of the log.
        whole_lines: whether a last line without its end, as a killed run leaves, is left out rather than refused.

    Returns:
        An array (rows,) for each name in the heading.

    Raises:
        OSError: the file cannot be read.
        ValueError: a row has no numbers, or not as many as the heading has names.
    """
    with open(path) as file:
        columns = file.readline().rstrip().split(",")
        lines = (line for line in file if line.endswith("\n")) if whole_lines else file
        try:
            rows = np.loadtxt(lines, delimiter=",", ndmin=2).reshape(-1, len(columns))
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)} below its heading: {error}") from error
    return dict(zip(columns, rows.T, strict=True))
