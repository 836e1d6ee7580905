"""Short text for many indices, for messages."""

from collections.abc import Iterable

#: Maximum number of indices that are listed one by one.
MAX_LISTED = 8


def ranges(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """Return the first and the last of each run of consecutive numbers, in ascending order.

    >>> ranges([4, 0, 1, 2])
    [(0, 2), (4, 4)]
    """
    runs: list[tuple[int, int]] = []
    for number in sorted(set(map(int, numbers))):
        if runs and number == runs[-1][1] + 1:
            runs[-1] = runs[-1][0], number
        else:
            runs.append((number, number))
    return runs


def as_ranges(numbers: Iterable[int]) -> str:
    """Return numbers as text, with each run of consecutive numbers as a range.

    >>> as_ranges([4, 0, 1, 2])
    '0-2,4'
    """
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges(numbers))
