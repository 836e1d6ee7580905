"""Settings of the study."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from studies.command import Settings


@dataclass(frozen=True, kw_only=True)
class GpuSettings(Settings):
    """Choose what is measured.

    Attributes:
        boxes: by name, see `boxes.named`.
        averages: boxes in which averages are compared too.
        energies: boxes in which energies of runs without a bath are followed too.
        methods: names of those that are measured beside the one that ratios are taken over; all unless given.
        chains: number of chains with rigid domains that are timed too, a square; None: none.
        benchmarks: the folder examples/benchmarks of OpenMM's sources.
        platform: of OpenMM; None takes the fastest.
        temperature: K.
        rounds: in which all methods take their turns.
        turn: seconds of a turn.
        time: of runs for averages, ps.
        settle: before these, ps.
        energy_time: of runs without a bath, ps.
    """

    boxes: tuple[str, ...] = ("water-4096", "dhfr", "water-32768")
    averages: tuple[str, ...] = ("water-4096", "dhfr")
    energies: tuple[str, ...] = ("water-4096", "dhfr")
    methods: tuple[str, ...] = ()
    chains: int | None = None
    benchmarks: Path | None = None
    platform: str | None = None
    temperature: float = 300.0
    rounds: int = 5
    turn: float = 0.5
    time: float = 100.0
    settle: float = 10.0
    energy_time: float = 50.0
