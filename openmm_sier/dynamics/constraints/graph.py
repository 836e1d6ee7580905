"""The graph of constraints: connected components, stars among them, and the order of elimination of the others."""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from openmm_sier.dynamics.backend.constraint_tables import Graphs, Pattern, Stars
from openmm_sier.dynamics.backend.star_loops import MOST_LEAVES


def joined(n: int, pairs: np.ndarray) -> np.ndarray:
    """For each of n nodes the smallest number in its connected component of the graph with edges (c, 2), (n,)."""
    ends = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    first = np.arange(n)
    while (apart := first[ends[:, 0]] != first[ends[:, 1]]).any():
        ends = ends[apart]
        low, high = np.sort(first[ends], axis=1).T
        np.minimum.at(first, high, low)
        # Each node now points to a smaller one of its component, and in the end to the smallest.
        while not np.array_equal(further := first[first], first):
            first = further
    return first


def components(pairs: np.ndarray) -> list[list[int]]:
    """Numbers of the pairs (c, 2) of each connected component, ordered by their first pair."""
    pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    labels = joined(int(pairs.max(initial=-1)) + 1, pairs)[pairs[:, 0]]
    _, first, inverse, counts = np.unique(labels, return_index=True, return_inverse=True, return_counts=True)
    members = np.split(np.argsort(inverse.reshape(-1), kind="stable"), np.cumsum(counts))[:-1]
    return [members[number].tolist() for number in np.argsort(first)]


def star_centre(pairs: Sequence[Sequence[int]], masses: np.ndarray) -> int | None:
    """The atom that all pairs (k, 2) of a component share, for one pair the heavier atom; None if it is not a star."""
    if len(pairs) > MOST_LEAVES:
        return None
    shared = set(pairs[0]).intersection(*pairs[1:])
    leaves = {atom for pair in pairs for atom in pair}
    if not shared or len(leaves) != len(pairs) + 1:
        return None
    return int(max(shared, key=lambda atom: (masses[atom], -atom)))


def gather_stars(
    found: list[tuple[int, list[int]]], pairs: np.ndarray, lengths: np.ndarray, masses: np.ndarray
) -> list[Stars]:
    """Stars grouped by their number of leaves.

    Args:
        found: for each star its centre and the numbers of its pairs.
        pairs, lengths, masses: all pairs (c, 2), their lengths (c,), and masses (n,) of all atoms.
    """
    by_size: dict[int, list[tuple[int, list[int]]]] = defaultdict(list)
    for centre, numbers in found:
        by_size[len(numbers)].append((centre, numbers))
    stars = []
    for _, group in sorted(by_size.items()):
        centres = np.array([centre for centre, _ in group], dtype=np.int64)
        table = np.array([numbers for _, numbers in group]).T
        leaves = np.ascontiguousarray(pairs[table].sum(axis=2) - centres)
        squares = np.ascontiguousarray(lengths[table] ** 2)
        stars.append(Stars(centres, leaves, 1 / masses[leaves], 1 / masses[centres], squares))
    return stars


def gather_graphs(found: list[list[int]], pairs: np.ndarray, lengths: np.ndarray, masses: np.ndarray) -> Graphs | None:
    """The components of given pair numbers, with arguments as for `gather_stars`; None if there are none."""
    if not found:
        return None
    atoms: list[int] = []
    starts: list[tuple[int, int, int, int]] = []
    order: list[int] = []
    blocks: list[list[int]] = []
    ends: list[np.ndarray] = []
    for numbers in found:
        local, members = np.unique(pairs[numbers], return_inverse=True)
        members = members.reshape(-1, 2)
        sequence, rows = eliminate(members)
        first_atom, first_pair = len(atoms), len(order)
        atoms += [int(atom) for atom in local]
        order += [numbers[e] for e in sequence]
        ends.append(members[sequence] + first_atom)
        blocks += [[column + first_pair for column in row] for row in rows]
        starts.append((first_atom, len(atoms), first_pair, len(order)))
    columns = np.array([column for row in blocks for column in row], dtype=np.int64)
    rows_at = np.cumsum([0] + [len(row) for row in blocks]).astype(np.int64)
    diagonal = np.array([rows_at[e] + row.index(e) for e, row in enumerate(blocks)], dtype=np.int64)
    joined, inverse_masses = np.concatenate(ends).astype(np.int64), 1 / masses[atoms]
    weights = _weights(joined, inverse_masses, np.repeat(np.arange(len(blocks)), np.diff(rows_at)), columns)
    pattern = Pattern(rows_at, columns, diagonal, weights)
    squares = lengths[order] ** 2
    return Graphs(np.array(atoms, np.int64), np.array(starts, np.int64), joined, squares, inverse_masses, pattern)


def _weights(ends: np.ndarray, inverse_masses: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """For pairs of constraints the sum of +-1/m of the atoms they share: + where both begin or both end there."""
    weights = np.zeros(len(rows))
    for one in range(2):
        for other in range(2):
            shared = ends[rows, one] == ends[columns, other]
            weights += np.where(shared, inverse_masses[ends[rows, one]] * (1 if one == other else -1), 0.0)
    return weights


def eliminate(members: np.ndarray) -> tuple[list[int], list[list[int]]]:
    """An order of elimination by least degree, which causes little fill-in for molecules.

    Source: Tinney and Walker, Proc. IEEE 55, 1801 (1967).

    Args:
        members: atoms of each constraint, (e, 2); constraints that share one are neighbours.

    Returns:
        The constraints in their order, and for each in that order the sorted positions of its elements, including
        fill-in.
    """
    at: dict[int, set[int]] = defaultdict(set)
    for number, pair in enumerate(members):
        for atom in pair:
            at[int(atom)].add(number)
    neighbours = [set().union(*(at[int(atom)] for atom in pair)) - {e} for e, pair in enumerate(members)]
    queue = [(len(near), e) for e, near in enumerate(neighbours)]
    heapq.heapify(queue)
    sequence: list[int] = []
    later: list[set[int]] = []
    place = np.full(len(members), -1)
    while queue:
        degree, e = heapq.heappop(queue)
        near = neighbours[e]
        if place[e] >= 0 or degree != len(near):
            continue
        place[e] = len(sequence)
        sequence.append(e)
        later.append(near)
        for other in near:
            neighbours[other] |= near
            neighbours[other] -= {other, e}
            heapq.heappush(queue, (len(neighbours[other]), other))
    rows: list[set[int]] = [{e} for e in range(len(sequence))]
    for row, near in enumerate(later):
        for other in near:
            rows[row].add(int(place[other]))
            rows[int(place[other])].add(row)
    return sequence, [sorted(row) for row in rows]
