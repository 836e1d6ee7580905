"""Where `openmm-sier` begins."""

from __future__ import annotations

from openmm_sier_command.arguments import parse


def main() -> int:
    """Carry out the command line of this process and return the exit code."""
    options = parse()
    # OpenMM is imported only once there is something to do.
    from openmm_sier.cli.main import carry_out

    return carry_out(options)
