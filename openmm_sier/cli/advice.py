"""What the library advises its callers, as options of the command."""

from __future__ import annotations

from openmm_sier.system import vibrations

#: The same for users of the command, which prepares every System.
AS_OPTIONS = {
    vibrations.SHORTER_STEP: "Take a shorter step (--dt)",
    vibrations.MORE_SUBSTEPS: "Take a shorter step (--dt)",
    vibrations.CONSTRAIN: "hold the bond by --constraints hbonds (bonds to hydrogen) or allbonds",
}


def for_the_command(message: str) -> str:
    """A message of the library that names options of the command in place of arguments."""
    for advice, option in AS_OPTIONS.items():
        message = message.replace(advice, option)
    return message
