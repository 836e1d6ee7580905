"""What moves in a step of the kernels engine, each by one thread or a team of threads, as code in C.

A mover is a set of bodies, of points, or of points with constraints. Its code reads the atoms, makes calls of the
functions of `motion.cc` one after the other, and writes the atoms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

#: What calls do. A gradient kick is two of them, with forces at the displaced positions between.
KICK, DISPLACE, KICK_FROM_THERE = "kick", "displace", "kick from there"
DRIFT, TO_BATH, BATHE, FROM_BATH = "drift", "drift to bath", "bathe", "drift from bath"
PROJECT = "project"
COUNT_BEFORE, COUNT_AFTER = "count before", "count after"

#: Those of trials: velocities are drawn, and their energy is summed; they are scaled and the start is kept; the energy
#: of an end is summed; velocities are multiplied and shifted; the start comes back.
DRAW, START, SUM_END, CHANGE, GO_BACK = "draw", "start", "sum end", "change", "go back"

#: The calls that change positions.
DRIFTS = DRIFT, TO_BATH, FROM_BATH
MOVES = *DRIFTS, DISPLACE, KICK_FROM_THERE, GO_BACK

#: The calls that change nothing of a mover.
READS = COUNT_BEFORE, COUNT_AFTER, SUM_END

#: Atoms in a cluster of constraints to one of them.
MOST_IN_CLUSTER = 5


class Call(NamedTuple):
    """One thing that all movers do.

    Attributes:
        kind: one of the above.
        scalars: numbers of its scalars: of a drift its time, followed by those of its steps of RATTLE; of a bath the
            first of four.
    """

    kind: str
    scalars: tuple[int, ...] = ()

    @property
    def moves(self) -> bool:
        """Return whether it changes positions."""
        return self.kind in MOVES


class _Atoms(NamedTuple):
    """How code goes through the atoms of a mover.

    Attributes:
        loop: head of a loop, if any.
        number: expression of the number of an atom.
    """

    loop: str
    number: str


@dataclass(frozen=True)
class Mover:
    """Bodies or points that move in one way.

    Attributes:
        first: the first of them in its table.
        number: how many.
        part: number of the first of them among the parts of the heat.
    """

    first: int
    number: int
    part: int

    #: Threads that share one of them.
    team: ClassVar[int] = 1
    #: Random vectors for each in a bath.
    noise: ClassVar[int] = 1
    #: Lines that find number n, with `{first}`, and lines that then read it.
    found: ClassVar[tuple[str, ...]]
    read: ClassVar[tuple[str, ...]]
    #: Lines that come before the reading after a displacement.
    came_back: ClassVar[tuple[str, ...]] = ()
    #: Lines that write velocities, and positions.
    moved: ClassVar[tuple[str, ...]]
    placed: ClassVar[tuple[str, ...]]
    #: Its atoms once it was found.
    atoms: ClassVar[_Atoms]
    #: Expressions of kinetic energy and momentum.
    energy: ClassVar[str]
    momentum: ClassVar[str]
    #: Lines of calls, with `{scalar}`, the first scalar; `{bath}`, its place, and `{noise}`, that of the noise.
    texts: ClassVar[Mapping[str, tuple[str, ...]]]

    def lines(self, calls: Sequence[Call], noise: int, counts_heat: bool) -> tuple[list[str], int]:
        """Return all lines for number n, and the number of random vectors that they use for all movers.

        Args:
            calls: in order.
            noise: the first random vector.
            counts_heat: whether the heat of baths is counted.
        """
        lines = [line.format(first=self.first) for line in self.found]
        kinds = [call.kind for call in calls]
        if kinds == [GO_BACK]:
            return [*lines, self._on_atoms("goBack({}, THE_POSITIONS, velm, force, THE_START);")], 0
        if kinds[0] == KICK_FROM_THERE:
            lines += self.came_back
        lines += self.read
        used = 0
        for call in calls:
            if counts_heat:
                lines += self._counted(call, noise + used, divides_drift=TO_BATH in kinds)
            else:
                lines += self._call(call, noise + used)
            if call.kind in (BATHE, DRAW):
                used += self.noise * self.number
        return lines + self._end(calls), used

    def _end(self, calls: Sequence[Call]) -> list[str]:
        """Return lines that write what calls have changed."""
        if all(call.kind in READS for call in calls):
            return []
        return [*self.moved, *(self.placed if any(call.moves for call in calls) else ())]

    def _call(self, call: Call, noise: int) -> list[str]:
        """Return the lines of a call, whose first random vector for these movers is `noise`."""
        if call.kind in (COUNT_BEFORE, COUNT_AFTER):
            return self._count("-" if call.kind == COUNT_BEFORE else "+")
        if call.kind == SUM_END:
            return self._sum("endSums")
        place = call.scalars[0] if call.scalars else 0
        values = {"scalar": f"scalars[{place}]", "bath": f"scalars + {place}", "noise": noise}
        lines = [line.format(**values) for line in self.texts.get(call.kind, ())]
        if call.kind == DRAW:
            bath = [line.format(**values | {"bath": "values"}) for line in self.texts[BATHE]]
            return [*lines, *bath, *self._call(Call(PROJECT), noise), *self._sum("startSums")]
        if call.kind == START:
            factor = "const mixed factor = factorOfStart(values, startSums);"
            return [factor, *lines, self._on_atoms("keepStart({}, THE_POSITIONS, velm, force, factor, THE_START);")]
        return lines

    def _counted(self, call: Call, noise: int, divides_drift: bool) -> list[str]:
        """Return the lines of a call, with those that count the heat of a bath; `divides_drift` is for clusters."""
        lines = self._call(call, noise)
        return [*self._count("-"), *lines, *self._count("+")] if call.kind == BATHE else lines

    def _count(self, sign: str) -> list[str]:
        """Return lines that add the kinetic energy to the heat, or take it from there."""
        return [f"{self._once}heat[{self.part} + n] {sign}= fixedPoint({self.energy});"]

    def _sum(self, sums: str) -> list[str]:
        """Return lines that add kinetic energy and momentum to sums of trials."""
        return [f"{self._once}addToSums({sums}, {self.energy}, {self.momentum});"]

    @property
    def _once(self) -> str:
        """Return what lets one thread do it."""
        return "" if self.team == 1 else "if (LANE == 0) "

    def _on_atoms(self, statement: str) -> str:
        """Return a statement for each atom."""
        return self.atoms.loop + statement.format(self.atoms.number)


class Bodies(Mover):
    """Rigid bodies of a table `bodies`, each of which a thread moves."""

    noise = 2
    found = (
        "const int4 record = bodies[{first} + n];",
        "const int4 reference = references[record.w];",
    )
    read = ("Body body = readBody(record, reference, THE_POSITIONS, velm, THE_BODY_TABLES THE_TEAM);",)
    came_back = ("swapPositions(record, THE_POSITIONS, kept, bodyAtoms);",)
    moved = ("moveBody(&body, record, velm, THE_BODY_TABLES);",)
    placed = ("placeBody(&body, record, THE_POSITIONS, THE_BODY_TABLES);",)
    atoms = _Atoms("for (int k = LANE; k < record.y; k += LANES) ", "bodyAtoms[record.x + k]")
    energy = "kineticEnergyOfBody(&body, record, THE_BODY_TABLES)"
    momentum = "body.p"
    texts: ClassVar = {
        KICK: ("kickBody(&body, record, {scalar}, force, THE_BODY_TABLES THE_TEAM);",),
        **dict.fromkeys(DRIFTS, ("driftBody(&body, record, {scalar}, THE_BODY_TABLES);",)),
        BATHE: ("bathBody(&body, record, {bath}, random + randomIndex + {noise} + 2*n, THE_BODY_TABLES);",),
        # Velocities are those about the axes before.
        DISPLACE: (
            "moveBody(&body, record, velm, THE_BODY_TABLES);",
            "keepPositions(record, THE_POSITIONS, kept, bodyAtoms);",
            "displaceBody(&body, record, {scalar}, force, THE_BODY_TABLES THE_TEAM);",
            "placeBody(&body, record, THE_POSITIONS, THE_BODY_TABLES);",
        ),
        KICK_FROM_THERE: ("kickBodyFrom(&body, record, {scalar}, kept, force, bodyAtoms THE_TEAM);",),
        DRAW: ("shiftBody(&body, record, values, THE_BODY_TABLES);",),
        START: ("scaleBody(&body, factor);",),
        CHANGE: ("scaleBody(&body, values[0]);", "shiftBody(&body, record, values, THE_BODY_TABLES);"),
    }

    def _end(self, calls: Sequence[Call]) -> list[str]:
        return [] if calls[-1].kind == DISPLACE else super()._end(calls)


class LargeBodies(Bodies):
    """Rigid bodies each of which a team of threads moves."""

    team = 64


class Points(Mover):
    """Atoms of a table `points` without constraints."""

    found = ("const int i = points[{first} + n];",)
    read = (
        "const mixed w = velm[i].w;",
        "mixed3 x = positionOf(THE_POSITIONS, i), v = velocityOf(velm, i);",
    )
    moved = ("putVelocity(velm, i, v);",)
    placed = ("putPosition(THE_POSITIONS, i, x);",)
    atoms = _Atoms("", "i")
    energy = "NUMBER(0.5)/w*dot(v, v)"
    momentum = "(1/w)*v"
    texts: ClassVar = {
        KICK: ("v += ({scalar}*PER_UNIT*w)*forceOn(force, i);",),
        **dict.fromkeys(DRIFTS, ("x += {scalar}*v;",)),
        BATHE: (
            "v = bathVelocity(v, w, {bath}, random[randomIndex + {noise} + n]);",
            "keepVector(i, v, bathed);",
        ),
        DISPLACE: ("keepVector(i, x, kept);", "x += ({scalar}*PER_UNIT*w)*forceOn(force, i);"),
        KICK_FROM_THERE: ("x = trim(kept[i]);", "v += ({scalar}*PER_UNIT*w)*forceOn(force, i);"),
        DRAW: ("v += shiftOf(values);",),
        START: ("v = factor*v;",),
        CHANGE: ("v = values[0]*v + shiftOf(values);",),
    }


class Clusters(Mover):
    """Atoms with constraints to one other atom, of tables `clusters` and `clusterLengths`."""

    noise = MOST_IN_CLUSTER
    found = (
        f"GLOBAL const int* row = clusters + {MOST_IN_CLUSTER + 1}*({{first}} + n);",
        f"GLOBAL const mixed* lengths = clusterLengths + {MOST_IN_CLUSTER}*({{first}} + n);",
    )
    read = ("Cluster c;", "readCluster(&c, row, lengths, THE_POSITIONS, velm);")
    moved = ("writeVelocities(&c, velm);",)
    placed = ("placeCluster(&c, THE_POSITIONS);",)
    atoms = _Atoms("for (int k = 0; k < row[0]; k++) ", "row[k + 1]")
    energy = "kineticEnergyOfCluster(&c)"
    momentum = "momentumOfCluster(&c)"
    texts: ClassVar = {
        KICK: ("kickCluster(&c, {scalar}, force);",),
        TO_BATH: ("driftClusterToBath(&c, {scalar});",),
        FROM_BATH: ("driftClusterFromBath(&c, {scalar});",),
        BATHE: (f"bathCluster(&c, {{bath}}, random + randomIndex + {{noise}} + {MOST_IN_CLUSTER}*n, bathed);",),
        PROJECT: ("projectVectors(&c, c.x, c.v);",),
        DISPLACE: ("displaceCluster(&c, {scalar}, force, kept);",),
        KICK_FROM_THERE: ("kickClusterFrom(&c, {scalar}, kept, force);",),
        DRAW: ("changeCluster(&c, 1, shiftOf(values));",),
        START: ("changeCluster(&c, factor, make_mixed3(0, 0, 0));",),
        CHANGE: ("changeCluster(&c, values[0], shiftOf(values));",),
    }

    def _call(self, call: Call, noise: int) -> list[str]:
        if call.kind == DRIFT:
            steps = call.scalars[1:] or call.scalars
            return [f"driftCluster(&c, scalars[{step}]);" for step in steps]
        return super()._call(call, noise)

    def _counted(self, call: Call, noise: int, divides_drift: bool) -> list[str]:
        """Return the lines of a call; energies are those of velocities without parts along the constraints."""
        lines, project = self._call(call, noise), self._call(Call(PROJECT), noise)
        if divides_drift and call.kind == TO_BATH:
            # It projects first, and velocities do not change after that.
            return [*lines, *self._count("-")]
        if divides_drift and call.kind == FROM_BATH:
            return [*lines, *project, *self._count("+")]
        if call.kind == BATHE and not divides_drift:
            return [*project, *self._count("-"), *lines, *project, *self._count("+")]
        return lines
