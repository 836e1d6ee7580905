"""Files of finished runs with given values, as `openmm-sier run` writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openmm

from openmm_sier.cli.files import checkpoints, records
from openmm_sier.cli.plan import Options, new_plan
from openmm_sier.observe import conservation


def empty_state():
    system = openmm.System()
    system.addParticle(1.0)
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[0.0, 0.0, 0.0]])
    return context.getState(positions=True)


def write_run(name, values, **options):
    """A directory like that of an ensemble's member, without a trajectory.

    Args:
        name: of the directory.
        values: columns of the log; the others are zero.
        options: of the run.
    """
    Path(name).mkdir()
    checkpoint = Path(name) / "run.chk"
    options = {"box": Path("box.pdb"), "out": Path(name) / "run.dcd"} | options
    plan = new_plan(Options(**options))
    rows = len(next(iter(values.values())))
    columns = dict.fromkeys(conservation.COLUMNS, np.zeros(rows)) | values
    columns["Step"] = plan.interval(plan.report_every) * np.arange(rows)
    write_rows(Path(plan.report), columns)
    notes = {
        "plan": plan.noted(checkpoint),
        "step": plan.steps,
        "potential_energy": float(columns["Potential Energy (kJ/mole)"][-1]),
        "trajectory": {"size": 0, "count": 0, "fingerprint": "none"},
        "log": {"size": Path(plan.report).stat().st_size, "count": rows, "fingerprint": "none"},
    }
    checkpoints.write_checkpoint(checkpoint, empty_state(), notes)
    return name


def note_count(checkpoint, file, count):
    """Let a checkpoint note that a file has so many records."""
    state, notes = checkpoints.read_checkpoint(Path(checkpoint))
    notes[file] = notes.get(file, {"size": 0, "fingerprint": "none"}) | {"count": count}
    checkpoints.write_checkpoint(Path(checkpoint), state, notes)


def write_rows(path, columns):
    file = records.Log(path, tuple(columns))
    for row in np.transpose(list(columns.values())):
        file.write(row)
    file.finish()
