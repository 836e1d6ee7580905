"""Commands sent to a GPU per step, as a command."""

from __future__ import annotations

from studies import launches
from studies.command import command
from studies.launches.study import LaunchesSettings, study

main = command(LaunchesSettings, study, launches.__doc__, __name__)
