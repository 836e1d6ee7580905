"""Constraint graphs of any shape, for Numba to compile: sparse elimination and the iterations that use it.

Atoms and constraints of all connected components are stored one after another; `starts` say where each component
begins. Constraints are in the order of elimination. Row e of the matrix G_1 M^-1 G_0^T has elements at
`columns[rows[e]:rows[e + 1]]`, ascending, its diagonal at `diagonal[e]`; the pattern is symmetric and includes fill-in.
An element is `weights` times the scalar product of two bond vectors: the sum of +-1/m of the atoms that the constraints
share.

Redundant constraints, as in a cage with more bonds than freedoms, give pivots that are zero to rounding: their
multipliers are set to zero, and the others do the work. NumPy executes only `factor`, to count redundant constraints.
"""

from __future__ import annotations

import numpy as np

#: A pivot below this fraction of its diagonal element is that of a redundant constraint.
PIVOT = 1e-9

#: The update that follows a relative residual below this is the last one; each reduces it a hundredfold or more.
GRAPH_CLOSE = 1e-11

#: Residuals that fall by less than this factor call for another matrix.
SLOW = 0.2

GRAPH_ITERATIONS = 60


def bonds(start, stop, ends, x, out):
    """Write the vectors of the constraints from start to stop between atoms at x, (atoms, 3)."""
    for e in range(start, stop):
        for a in range(3):
            out[e, a] = x[ends[e, 0], a] - x[ends[e, 1], a]


def factor(start, stop, pattern, left, right, values, inverses, work):
    """LU factors of the rows from start to stop, written to `values`, and inverse pivots; returns the rank.

    Args:
        pattern: (rows, columns, diagonal, weights).
        left, right: bond vectors that the residuals see and along which the multipliers act.
        values: elements of the factors, as `columns`.
        inverses: of the pivots; 0 for redundant constraints.
        work: one number for each constraint.
    """
    rows, columns, diagonal, weights = pattern
    rank = 0
    for e in range(start, stop):
        for n in range(rows[e], rows[e + 1]):
            f = columns[n]
            dot = left[e, 0] * right[f, 0] + left[e, 1] * right[f, 1] + left[e, 2] * right[f, 2]
            work[f] = weights[n] * dot
        scale = abs(work[e])
        for n in range(rows[e], diagonal[e]):
            f = columns[n]
            share = work[f] * inverses[f]
            work[f] = share
            for m in range(diagonal[f] + 1, rows[f + 1]):
                work[columns[m]] -= share * values[m]
        for n in range(rows[e], rows[e + 1]):
            values[n] = work[columns[n]]
        pivot = work[e]
        inverses[e] = 0.0
        if abs(pivot) > PIVOT * scale:
            inverses[e] = 1 / pivot
            rank += 1
    return rank


def substitute(start, stop, pattern, values, inverses, x):
    """Solve with the factors in place."""
    rows, columns, diagonal, _ = pattern
    for e in range(start, stop):
        for n in range(rows[e], diagonal[e]):
            x[e] -= values[n] * x[columns[n]]
    for e in range(stop - 1, start - 1, -1):
        for n in range(diagonal[e] + 1, rows[e + 1]):
            x[e] -= values[n] * x[columns[n]]
        x[e] *= inverses[e]


def push(start, stop, ends, along, multipliers, inverse_masses, v):
    """Add the velocities that multipliers along bond vectors give."""
    for e in range(start, stop):
        i, j = ends[e]
        for a in range(3):
            impulse = multipliers[e] * along[e, a]
            v[i, a] += impulse * inverse_masses[i]
            v[j, a] -= impulse * inverse_masses[j]


def constrain_graph(part, graph, x, v, d, scratch):
    """Velocities, changed in place, with which x + d v satisfies the constraints; writes the positions reached.

    Args:
        part: (first atom, end, first constraint, end) of a component.
        graph: (ends, squares, inverse_masses, pattern).
        x, v: positions and velocities, (atoms, 3).
        scratch: (reached, before, after, values, inverses, work, residuals).

    Returns:
        Whether it converged.
    """
    low, high, start, stop = part
    ends, squares, inverse_masses, pattern = graph
    reached, before, after, values, inverses, work, residuals = scratch
    bonds(start, stop, ends, x, before)
    last = 0.0
    for _ in range(GRAPH_ITERATIONS):
        for i in range(low, high):
            for a in range(3):
                reached[i, a] = x[i, a] + d * v[i, a]
        bonds(start, stop, ends, reached, after)
        worst = 0.0
        for e in range(start, stop):
            square = after[e, 0] * after[e, 0] + after[e, 1] * after[e, 1] + after[e, 2] * after[e, 2]
            residuals[e] = 0.5 * (squares[e] - square) / d
            worst = np.maximum(worst, abs(squares[e] - square) / squares[e])
        # NaN comes here too, goes on to the last iteration and fails.
        if not worst < SLOW * last:
            factor(start, stop, pattern, after, before, values, inverses, work)
        last = worst
        substitute(start, stop, pattern, values, inverses, residuals)
        push(start, stop, ends, before, residuals, inverse_masses, v)
        if worst < GRAPH_CLOSE:
            for i in range(low, high):
                for a in range(3):
                    reached[i, a] = x[i, a] + d * v[i, a]
            return True
    return False


def project_graph(part, graph, x, v, scratch):
    """Take from the velocities what changes the lengths of the constraints; twice, so that only rounding remains."""
    _, _, start, stop = part
    ends, _, inverse_masses, pattern = graph
    _, _, after, values, inverses, work, residuals = scratch
    bonds(start, stop, ends, x, after)
    factor(start, stop, pattern, after, after, values, inverses, work)
    for _ in range(2):
        for e in range(start, stop):
            i, j = ends[e]
            residuals[e] = 0.0
            for a in range(3):
                residuals[e] -= after[e, a] * (v[i, a] - v[j, a])
        substitute(start, stop, pattern, values, inverses, residuals)
        push(start, stop, ends, after, residuals, inverse_masses, v)


def take(low, high, atoms, q, p, inverse_masses, x, v):
    """Positions relative to the component's first atom, and velocities, (atoms, 3), of columns of q and p, (3, n)."""
    for i in range(low, high):
        for a in range(3):
            x[i, a] = q[a, atoms[i]] - q[a, atoms[low]]
            v[i, a] = p[a, atoms[i]] * inverse_masses[i]


def put_positions(low, high, atoms, q, x, new_q):
    """Write positions relative to the component's first atom as columns of new_q."""
    for i in range(low, high):
        for a in range(3):
            new_q[a, atoms[i]] = q[a, atoms[low]] + x[i, a]


def put_momenta(low, high, atoms, p, v, inverse_masses, new_p):
    """Write momenta as columns of new_p; the first atom takes the remainder, which conserves the total to rounding."""
    for a in range(3):
        rest = 0.0
        for i in range(low, high):
            new_p[a, atoms[i]] = v[i, a] / inverse_masses[i]
            rest += p[a, atoms[i]] - new_p[a, atoms[i]]
        new_p[a, atoms[low]] += rest


def room(n_atoms, n_constraints, n_elements):
    """Arrays to work in: x, v and the scratch of `constrain_graph`."""
    x, v, reached = np.empty((n_atoms, 3)), np.empty((n_atoms, 3)), np.empty((n_atoms, 3))
    before, after = np.empty((n_constraints, 3)), np.empty((n_constraints, 3))
    values, inverses = np.empty(n_elements), np.empty(n_constraints)
    work, residuals = np.empty(n_constraints), np.empty(n_constraints)
    return x, v, (reached, before, after, values, inverses, work, residuals)


def drift_graphs(q, p, times, atoms, starts, graph, new_q, new_p):
    """Geodesic motion of all components by RATTLE steps, see `star_loops.drift_star`.

    Args:
        q, p: (3, n).
        times: lengths of the steps.
        atoms: column of q for each atom of the graphs.
        starts: rows (first atom, end, first constraint, end) for each component.
        graph: as for `constrain_graph`.
        new_q, new_p: (3, n), of which the columns of the atoms are written.

    Returns:
        The first component that failed, or -1.
    """
    inverse_masses, pattern = graph[2], graph[3]
    x, v, scratch = room(len(atoms), len(graph[0]), len(pattern[1]))
    for c in range(len(starts)):
        part = (starts[c, 0], starts[c, 1], starts[c, 2], starts[c, 3])
        low, high = part[0], part[1]
        take(low, high, atoms, q, p, inverse_masses, x, v)
        for d in times:
            if not constrain_graph(part, graph, x, v, d, scratch):
                return c
            for i in range(low, high):
                for a in range(3):
                    x[i, a] = scratch[0][i, a]
        project_graph(part, graph, x, v, scratch)
        put_positions(low, high, atoms, q, x, new_q)
        put_momenta(low, high, atoms, p, v, inverse_masses, new_p)
    return -1


def displace_graphs(q, force, shift, atoms, starts, graph, new_q):
    """All components moved by shift M^-1 force and put back along the gradients at q; returns as `drift_graphs`."""
    inverse_masses, pattern = graph[2], graph[3]
    x, v, scratch = room(len(atoms), len(graph[0]), len(pattern[1]))
    for c in range(len(starts)):
        part = (starts[c, 0], starts[c, 1], starts[c, 2], starts[c, 3])
        low, high = part[0], part[1]
        take(low, high, atoms, q, force, inverse_masses, x, v)
        for i in range(low, high):
            for a in range(3):
                v[i, a] *= shift
        if not constrain_graph(part, graph, x, v, 1.0, scratch):
            return c
        put_positions(low, high, atoms, q, scratch[0], new_q)
    return -1


def project_graphs(q, p, atoms, starts, graph, new_p):
    """The momenta, or forces, of all components without what acts along their constraints."""
    inverse_masses, pattern = graph[2], graph[3]
    x, v, scratch = room(len(atoms), len(graph[0]), len(pattern[1]))
    for c in range(len(starts)):
        part = (starts[c, 0], starts[c, 1], starts[c, 2], starts[c, 3])
        take(part[0], part[1], atoms, q, p, inverse_masses, x, v)
        project_graph(part, graph, x, v, scratch)
        put_momenta(part[0], part[1], atoms, p, v, inverse_masses, new_p)


#: The functions that are called from outside.
LOOPS = (drift_graphs, displace_graphs, project_graphs)
