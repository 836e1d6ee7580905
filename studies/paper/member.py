"""A member of the ensemble of runs of water in a process of its own, see `openmm_sier.cli.member`."""

from __future__ import annotations

from openmm_sier.cli.member import serve
from studies.paper.__main__ import main

if __name__ == "__main__":
    serve(lambda arguments: main([*arguments, "--out", "."]))
