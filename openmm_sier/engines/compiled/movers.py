"""What moves in a step of the kernels engine, each by one thread or a team of threads, as code in C.

A mover is a set of bodies, of points, or of points with constraints. Its code reads the atoms, makes calls of the
functions of `motion.cc` one after the other, and writes the atoms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

#: What calls do. A gradient kick is two of them, with forces at the displaced positions between.
KICK, DISPLACE, KICK_FROM_THERE = "kick", "displace", "kick from there"
DRIFT, TO_BATH, BATHE, FROM_BATH = "drift", "drift to bath", "bathe", "drift from bath"
PROJECT, MAKE_RIGID = "project", "make rigid"
COUNT_BEFORE, COUNT_AFTER = "count before", "count after"

#: The calls that change positions.
DRIFTS = DRIFT, TO_BATH, FROM_BATH
MOVES = *DRIFTS, DISPLACE, KICK_FROM_THERE

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


@dataclass(frozen=True)
class Mover(ABC):
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
    team = 1
    #: Random vectors for each in a bath.
    noise = 1

    @abstractmethod
    def begin(self, calls: Sequence[Call]) -> list[str]:
        """Return lines that read number n."""

    @abstractmethod
    def end(self, calls: Sequence[Call]) -> list[str]:
        """Return lines that write it."""

    @abstractmethod
    def call(self, call: Call, noise: int) -> list[str]:
        """Return the lines of a call.

        Args:
            call: the call.
            noise: the first random vector for these movers.
        """

    @property
    @abstractmethod
    def energy(self) -> str:
        """Return an expression of the kinetic energy."""

    def lines(self, calls: Sequence[Call], noise: int, counts_heat: bool) -> tuple[list[str], int]:
        """Return all lines for number n, and the number of random vectors that they use for all movers.

        Args:
            calls: in order.
            noise: the first random vector.
            counts_heat: whether the heat of baths is counted.
        """
        lines = self.begin(calls)
        used = 0
        divides_drift = any(call.kind == TO_BATH for call in calls)
        for call in calls:
            if call.kind in (COUNT_BEFORE, COUNT_AFTER):
                lines += self.count("-" if call.kind == COUNT_BEFORE else "+")
            elif counts_heat:
                lines += self.counted(call, noise + used, divides_drift)
            else:
                lines += self.call(call, noise + used)
            if call.kind == BATHE:
                used += self.noise * self.number
        return lines + self.end(calls), used

    def counted(self, call: Call, noise: int, divides_drift: bool) -> list[str]:
        """Return the lines of a call, with those that count the heat of a bath.

        Args:
            call: the call.
            noise: the first random vector for these movers.
            divides_drift: whether the bath is in the middle of a drift.
        """
        lines = self.call(call, noise)
        return [*self.count("-"), *lines, *self.count("+")] if call.kind == BATHE else lines

    def count(self, sign: str) -> list[str]:
        """Return lines that add the kinetic energy to the heat, or take it from there."""
        is_first = "" if self.team == 1 else "if (LANE == 0) "
        return [f"{is_first}heat[{self.part} + n] {sign}= fixedPoint({self.energy});"]


class Bodies(Mover):
    """Rigid bodies of a table `bodies`, each of which a thread moves."""

    noise = 2

    def begin(self, calls: Sequence[Call]) -> list[str]:
        lines = [
            f"const int4 record = bodies[{self.first} + n];",
            "const int4 reference = references[record.w];",
        ]
        if calls[0].kind == KICK_FROM_THERE:
            lines.append("swapPositions(record, THE_POSITIONS, kept, bodyAtoms);")
        lines.append("Body body = readBody(record, reference, THE_POSITIONS, velm, THE_BODY_TABLES THE_TEAM);")
        return lines

    def end(self, calls: Sequence[Call]) -> list[str]:
        if calls[-1].kind == DISPLACE or all(call.kind in (COUNT_BEFORE, COUNT_AFTER) for call in calls):
            return []
        lines = ["moveBody(&body, record, velm, THE_BODY_TABLES);"]
        if any(call.moves for call in calls):
            lines.append("placeBody(&body, record, THE_POSITIONS, THE_BODY_TABLES);")
        return lines

    def call(self, call: Call, noise: int) -> list[str]:
        scalar = f"scalars[{call.scalars[0]}]" if call.scalars else ""
        if call.kind == KICK:
            return [f"kickBody(&body, record, {scalar}, force, THE_BODY_TABLES THE_TEAM);"]
        if call.kind in DRIFTS:
            return [f"driftBody(&body, record, {scalar}, THE_BODY_TABLES);"]
        if call.kind == BATHE:
            random = f"random + randomIndex + {noise} + 2*n"
            return [f"bathBody(&body, record, scalars + {call.scalars[0]}, {random}, THE_BODY_TABLES);"]
        if call.kind == DISPLACE:
            # Velocities are those about the axes before.
            return [
                "moveBody(&body, record, velm, THE_BODY_TABLES);",
                "keepPositions(record, THE_POSITIONS, kept, bodyAtoms);",
                f"displaceBody(&body, record, {scalar}, force, THE_BODY_TABLES THE_TEAM);",
                "placeBody(&body, record, THE_POSITIONS, THE_BODY_TABLES);",
            ]
        if call.kind == KICK_FROM_THERE:
            return [f"kickBodyFrom(&body, record, {scalar}, kept, force, bodyAtoms THE_TEAM);"]
        return []

    @property
    def energy(self) -> str:
        return "kineticEnergyOfBody(&body, record, THE_BODY_TABLES)"


class LargeBodies(Bodies):
    """Rigid bodies each of which a team of threads moves."""

    team = 64


class Points(Mover):
    """Atoms of a table `points` without constraints."""

    def begin(self, calls: Sequence[Call]) -> list[str]:
        lines = [
            f"const int i = points[{self.first} + n];",
            "const mixed w = velm[i].w;",
            "mixed3 x = positionOf(THE_POSITIONS, i), v = velocityOf(velm, i);",
        ]
        if calls[0].kind == KICK_FROM_THERE:
            lines.append("x = trim(kept[i]);")
        return lines

    def end(self, calls: Sequence[Call]) -> list[str]:
        lines = ["putVelocity(velm, i, v);"]
        if any(call.moves for call in calls):
            lines.append("putPosition(THE_POSITIONS, i, x);")
        return lines

    def call(self, call: Call, noise: int) -> list[str]:
        scalar = f"scalars[{call.scalars[0]}]" if call.scalars else ""
        if call.kind in (KICK, KICK_FROM_THERE):
            return [f"v += ({scalar}*PER_UNIT*w)*forceOn(force, i);"]
        if call.kind in DRIFTS:
            return [f"x += {scalar}*v;"]
        if call.kind == BATHE:
            bath = f"scalars + {call.scalars[0]}"
            return [f"v = bathVelocity(v, w, {bath}, random[randomIndex + {noise} + n]);", _keep_bathed("i", "v")]
        if call.kind == DISPLACE:
            return [
                "kept[i] = make_mixed4(x.x, x.y, x.z, 0);",
                f"x += ({scalar}*PER_UNIT*w)*forceOn(force, i);",
            ]
        return []

    @property
    def energy(self) -> str:
        return "NUMBER(0.5)/w*dot(v, v)"


class Clusters(Mover):
    """Atoms with constraints to one other atom, of tables `clusters` and `clusterLengths`."""

    noise = MOST_IN_CLUSTER

    def begin(self, calls: Sequence[Call]) -> list[str]:
        place = f"({self.first} + n)"
        tables = f"clusters + {MOST_IN_CLUSTER + 1}*{place}, clusterLengths + {MOST_IN_CLUSTER}*{place}"
        return ["Cluster c;", f"readCluster(&c, {tables}, THE_POSITIONS, velm);"]

    def end(self, calls: Sequence[Call]) -> list[str]:
        lines = ["writeVelocities(&c, velm);"]
        if any(call.moves for call in calls):
            lines.append("placeCluster(&c, THE_POSITIONS);")
        return lines

    def call(self, call: Call, noise: int) -> list[str]:
        scalar = f"scalars[{call.scalars[0]}]" if call.scalars else ""
        if call.kind == KICK:
            return [f"kickCluster(&c, {scalar}, force);"]
        if call.kind == DRIFT:
            steps = call.scalars[1:] or call.scalars
            return [f"driftCluster(&c, scalars[{step}]);" for step in steps]
        if call.kind == TO_BATH:
            return [f"driftClusterToBath(&c, {scalar});"]
        if call.kind == FROM_BATH:
            return [f"driftClusterFromBath(&c, {scalar});"]
        if call.kind == BATHE:
            random = f"random[randomIndex + {noise} + {self.noise}*n + k]"
            return [
                "for (int k = 0; k < c.size; k++) {",
                f"    c.v[k] = bathVelocity(c.v[k], c.w[k], scalars + {call.scalars[0]}, {random});",
                f"    {_keep_bathed('c.atoms[k]', 'c.v[k]')}",
                "}",
            ]
        if call.kind in (PROJECT, MAKE_RIGID):
            return ["projectVectors(&c, c.x, c.v);"]
        if call.kind == DISPLACE:
            return [f"displaceCluster(&c, {scalar}, force, kept);"]
        return [f"kickClusterFrom(&c, {scalar}, kept, force);"]

    def counted(self, call: Call, noise: int, divides_drift: bool) -> list[str]:
        """See `Mover.counted`; energies are those of velocities without parts along the constraints."""
        lines, project = self.call(call, noise), self.call(Call(PROJECT), noise)
        if divides_drift and call.kind == TO_BATH:
            # It projects first, and velocities do not change after that.
            return [*lines, *self.count("-")]
        if divides_drift and call.kind == FROM_BATH:
            return [*lines, *project, *self.count("+")]
        if call.kind == BATHE and not divides_drift:
            return [*project, *self.count("-"), *lines, *project, *self.count("+")]
        return lines

    @property
    def energy(self) -> str:
        return "kineticEnergyOfCluster(&c)"


def _keep_bathed(atom: str, velocity: str) -> str:
    """Return a line that keeps the velocity just after a bath."""
    return f"bathed[{atom}] = make_mixed4({velocity}.x, {velocity}.y, {velocity}.z, 0);"
