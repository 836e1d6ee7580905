"""Find out whether a run is complete without a process for it, which would load OpenMM to say so."""

from collections.abc import Sequence
from contextlib import suppress

from openmm_sier.cli.command_line import settings_of
from openmm_sier.cli.errors import NothingLeft
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.files.outputs import Outputs
from openmm_sier.cli.restart import Restart, checkpoint_to_continue
from openmm_sier.cli.settings import RunSettings


def settings_in(line: Sequence[str]) -> RunSettings | None:
    """Return the settings in a command line, after `openmm-sier`; None if it is wrong, as the process of a run says."""
    with suppress(Exception):
        return settings_of(line)
    return None


def is_complete(given: RunSettings) -> bool:
    """Return whether a run has reached its last step, and all its files are as it left them.

    Args:
        given: settings of its command line, with `resume`.
    """
    # Whatever is wrong is reported by the process of the run.
    with suppress(Exception), FileLocks() as locks:
        checkpoint = checkpoint_to_continue(given, locks)
        if checkpoint is None:
            return False
        beginning = Restart(given, checkpoint)
        outputs = Outputs(beginning.settings, checkpoint)
        outputs.check(beginning.sources.values(), beginning.continues)
        try:
            beginning.check_inputs(outputs)
        except NothingLeft:
            return True
    return False
