"""Seeds of many runs, as a command line has them."""

import re
from collections.abc import Sequence

from openmm_sier.cli.errors import Misused

#: Most seeds of one range.
MOST = 10_000


def read_seeds(text: str) -> list[int]:
    """Return the seeds that a text such as "1-24" or "1-4,7,9" means.

    Raises:
        Misused: it means none, or one twice.
    """
    seeds: list[int] = []
    for part in text.split(","):
        if not (match := re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*", part)):
            raise Misused(f"--seeds: expected seeds such as 1-24 or 1-4,7,9, got {text!r}")
        first, last = int(match[1]), int(match[2] or match[1])
        if not 1 <= first <= last < 2**31:
            raise Misused(
                f"--seeds: expected seeds from 1 to {2**31 - 1}, the lower one first, got {part.strip()!r} in {text!r}"
            )
        if last - first >= MOST:
            raise Misused(f"--seeds: expected at most {MOST} seeds, got {text!r}")
        seeds += range(first, last + 1)
    if len(set(seeds)) < len(seeds):
        raise Misused(f"--seeds: expected each seed once, got {text!r}")
    return seeds


def shown(seeds: Sequence[int]) -> str:
    """Return seeds as `read_seeds` reads them."""
    parts: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    words = [f"{part[0]}-{part[-1]}" if len(part) > 1 else str(part[0]) for part in parts]
    return f"{'seed' if len(set(seeds)) == 1 else 'seeds'} {','.join(words)}"
