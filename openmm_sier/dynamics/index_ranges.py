"""Sets of indices: as ranges in messages, written out, and without repetitions."""

from collections.abc import Iterable

import numpy as np

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


def of_ranges(starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return the indices of ranges, one range after the other.

    >>> of_ranges(np.array([5, 0]), np.array([7, 3]))
    array([5, 6, 0, 1, 2])
    """
    counts = stops - starts
    return np.arange(counts.sum()) + np.repeat(starts - (np.cumsum(counts) - counts), counts)


def distinct(numbers: np.ndarray) -> np.ndarray:
    """Return distinct numbers of an array, (m,), ascending. `np.unique` takes a hundred times as long for integers."""
    ordered = np.sort(numbers, axis=None)
    is_first = np.ones(len(ordered), dtype=bool)
    np.not_equal(ordered[1:], ordered[:-1], out=is_first[1:])
    return ordered[is_first]
