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
KICK, DRIFT, BATHE, PROJECT, COUNT_BEFORE, COUNT_AFTER, DISPLACE, KICK_FROM_THERE = (
    *("kick", "drift", "bathe", "project", "count before", "count after"),
    *("displace", "kick from there"),
)

#: The calls that change positions.
MOVES = DRIFT, DISPLACE, KICK_FROM_THERE

#: Number of scalars of a bath: factor of momenta and width of their noise, and those of angular momenta.
BATH_SCALARS = 4

#: Threads in a block of kernels with a thread for each mover.
BLOCK = 64


class Call(NamedTuple):
    """One thing that all movers do.

    Attributes:
        kind: one of the above.
        scalars: numbers of its scalars: of a drift its time, followed by those of its steps of RATTLE; of a bath the
            first of `BATH_SCALARS`.
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
        for call in calls:
            if call.kind in (COUNT_BEFORE, COUNT_AFTER):
                lines += self._counted("-" if call.kind == COUNT_BEFORE else "+")
            elif call.kind == BATHE:
                counted = counts_heat
                lines += self._counted("-") if counted else []
                lines += self.call(call, noise + used)
                lines += self._counted("+") if counted else []
                used += self.noise * self.number
            else:
                lines += self.call(call, noise)
        return lines + self.end(calls), used

    def _counted(self, sign: str) -> list[str]:
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
        return ["writeBody(&body, record, THE_POSITIONS, velm, THE_BODY_TABLES);"]

    def call(self, call: Call, noise: int) -> list[str]:
        scalar = f"scalars[{call.scalars[0]}]" if call.scalars else ""
        if call.kind == KICK:
            return [f"kickBody(&body, record, {scalar}, force, THE_BODY_TABLES THE_TEAM);"]
        if call.kind == DRIFT:
            return [f"driftBody(&body, record, {scalar}, THE_BODY_TABLES);"]
        if call.kind == BATHE:
            random = f"random + randomIndex + {noise} + 2*n"
            return [f"bathBody(&body, record, scalars + {call.scalars[0]}, {random}, THE_BODY_TABLES);"]
        if call.kind == DISPLACE:
            # Velocities are those about the axes before.
            return [
                "writeBody(&body, record, THE_POSITIONS, velm, THE_BODY_TABLES);",
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
        if call.kind == DRIFT:
            return [f"x += {scalar}*v;"]
        if call.kind == BATHE:
            bath = f"scalars + {call.scalars[0]}"
            return [f"v = bathVelocity(v, w, {bath}, random[randomIndex + {noise} + n]);"]
        if call.kind == DISPLACE:
            return [
                "kept[i] = make_mixed4(x.x, x.y, x.z, 0);",
                f"x += ({scalar}*PER_UNIT*w)*forceOn(force, i);",
            ]
        return []

    @property
    def energy(self) -> str:
        return "NUMBER(0.5)/w*dot(v, v)"
