"""Seeds of many runs on a command line."""

import re

from openmm_sier.cli.errors import Misused

#: Largest number of seeds in a range.
MOST = 10_000


def read_seeds(text: str) -> list[int]:
    """Return the seeds of a text such as "1-24" or "1-4,7,9".

    Raises:
        Misused: the text has another form, or a seed twice.
    """
    seeds: list[int] = []
    for item in text.split(","):
        if not (match := re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*", item)):
            raise Misused(f"--seeds: expected seeds such as 1-24 or 1-4,7,9, got {text!r}")
        first, last = int(match[1]), int(match[2] or match[1])
        if not 1 <= first <= last < 2**31:
            raise Misused(
                f"--seeds: expected seeds from 1 to {2**31 - 1}, the lower one first, got {item.strip()!r} in {text!r}"
            )
        if last - first >= MOST:
            raise Misused(f"--seeds: expected at most {MOST} seeds, got {text!r}")
        seeds += range(first, last + 1)
    if len(set(seeds)) < len(seeds):
        raise Misused(f"--seeds: expected each seed once, got {text!r}")
    return seeds
