"""Results as files: JSON with every parameter, seed and version, and CSV for the points of the figures."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from openmm_sier.version import __version__

#: Packages that results can depend on.
PACKAGES = ("numpy", "openmm", "numba", "mpmath", "matplotlib")


def provenance() -> dict[str, object]:
    """Versions and machine."""
    versions = {"openmm-sier": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {"versions": versions, "machine": platform.platform(), "processors": os.cpu_count()}


def write_json(path: Path, result: Any, seconds: float) -> None:
    """Write a result, a dataclass that holds its settings, with versions and machine.

    Args:
        path: of the file.
        result: dataclass.
        seconds: that the experiment took.
    """
    content = {**provenance(), "seconds": round(seconds, 1), "result": dataclasses.asdict(result)}
    path.write_text(json.dumps(_plain(content), indent=1, allow_nan=False) + "\n")


def write_csv(path: Path, rows: Sequence) -> None:
    """Write dataclasses of one kind as rows; a field that holds a tuple gives a row for each of its elements."""
    flat = [line for row in rows for line in _lines(dataclasses.asdict(row))]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(flat[0]))
        writer.writeheader()
        writer.writerows(flat)


def _lines(row: dict) -> list[dict]:
    many = [name for name, value in row.items() if isinstance(value, (tuple, list))]
    if not many:
        return [row]
    return [row | dict(zip(many, values, strict=True)) for values in zip(*(row[name] for name in many), strict=True)]


def _plain(value: Any) -> Any:
    """A value as JSON can hold it; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
