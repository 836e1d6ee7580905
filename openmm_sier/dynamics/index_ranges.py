"""Names of many numbers in a few words, for messages."""

from collections.abc import Iterable

#: A list of at most this many numbers is written out.
MAX_LISTED = 8


def ranges(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """Return the first and the last of each run of consecutive numbers, in ascending order.

    >>> ranges([4, 0, 1, 2])
    [(0, 2), (4, 4)]
    """
    found: list[tuple[int, int]] = []
    for number in sorted(set(map(int, numbers))):
        if found and number == found[-1][1] + 1:
            found[-1] = found[-1][0], number
        else:
            found.append((number, number))
    return found


def as_ranges(numbers: Iterable[int]) -> str:
    """Return numbers as text, with each run of consecutive ones by its ends.

    >>> as_ranges([4, 0, 1, 2])
    '0-2,4'
    """
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges(numbers))
