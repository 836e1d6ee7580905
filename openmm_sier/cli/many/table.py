"""Progress of many runs: a live table in a terminal, otherwise occasional lines."""

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from openmm_sier.cli.console import Pace
from openmm_sier.cli.many.members import Member, Watch


@contextmanager
def watching(steps: int) -> Iterator[Watch]:
    """Show members on standard error while they run.

    Args:
        steps: of each.
    """
    console = Console(stderr=True)
    pace = Pace()
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None

    def watch(members: Sequence[Member]) -> None:
        with suppress(OSError):
            if live:
                live.update(_table(members, steps), refresh=True)
            elif pace.is_due():
                print(described(members, steps), file=sys.stderr, flush=True)

    with suppress(OSError):
        if live:
            live.start()
    try:
        yield watch
    finally:
        with suppress(OSError):
            if live:
                live.stop()


def described(members: Sequence[Member], steps: int) -> str:
    """Return the number of members in each state, and the share of all steps that is done, in words."""
    counts = Counter(member.state for member in members)
    share = sum(min(member.step, steps) for member in members) / (steps * len(members))
    return f"{', '.join(f'{count} {state}' for state, count in counts.items())}: {100 * share:.0f} % of all steps"


def _table(members: Sequence[Member], steps: int) -> Table:
    table = Table("seed", "", "", "state", title=described(members, steps), title_justify="left")
    for member in members:
        bar = ProgressBar(total=steps, completed=min(member.step, steps), width=30)
        table.add_row(str(member.seed), bar, f"{100 * min(member.step, steps) / steps:.0f} %", member.state)
    return table
