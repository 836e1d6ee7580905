"""What a step costs beyond its forces, and what accuracy costs: the measurements behind `openmm-sier bench`.

All timings of one table come from one run. What is compared takes turns, several rounds of it, and ratios are taken
within a round, so that the drift of a machine's speed cancels; medians over the rounds are shown with their standard
errors.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from openmm_sier.studies import console
from openmm_sier.studies.bench import accuracy, layer, rotations, steps
from openmm_sier.studies.bench.timing import Settings, machine

#: What can be measured: (settings) -> what `show` prints and the record keeps.
PARTS = {"steps": steps, "rotations": rotations, "layer": layer, "accuracy": accuracy}


def run(settings: Settings, out: Path) -> dict:
    """Measure, print the tables, and write bench.json and, with matplotlib, bench.png to a directory.

    Raises:
        ValueError: a part is unknown.
    """
    for name in settings.parts or ():
        if name not in PARTS:
            raise ValueError(f"unknown part {name!r} of the benchmark; known are {', '.join(PARTS)}")
    out.mkdir(parents=True, exist_ok=True)
    here = machine()
    console.note(", ".join(f"{name} {value}" for name, value in here.items()))
    parameters = asdict(settings) | {"box": settings.box.name}
    console.note(", ".join(f"{name} {value}" for name, value in parameters.items()))
    found: dict[str, Any] = {name: PARTS[name].measure(settings) for name in settings.parts or PARTS}
    for name, values in found.items():
        PARTS[name].show(values)
    record = {"machine": here, "settings": parameters} | found
    if "accuracy" in found:
        record["accuracy"] = accuracy.record(found["accuracy"])
        console.draw("cost_figure", found["accuracy"], out / "bench.png")
    (out / "bench.json").write_text(json.dumps(record, indent=1, default=str))
    return record
