"""Methods, steps and times of the runs of each model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from studies.domains import chain, patchy, zeolite
from studies.domains.models import Model


@dataclass(frozen=True)
class Plan:
    """Runs of a model.

    Attributes:
        build: makes the model.
        settle: ps of the equilibration.
        step: of it, fs.
        time: of a run in the bath, ps.
        interval: ps between two samples.
        most: steps of such a run, which is shorter if it would have more.
        baths: steps in fs for each of `methods.METHODS`; without any only its speed is measured.
        energies: steps in fs for each of `energy.INTEGRATORS`, at constant energy.
        energy_time: of a run at constant energy, ps.
        slow: averages that a run of this length remembers to its end, so that its errors are too small: they are shown,
            and not compared.
    """

    build: Callable[[], Model]
    settle: float
    step: float
    time: float
    most: int
    baths: Mapping[str, tuple[float, ...]]
    energies: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    energy_time: float = 20.0
    interval: float = 1.0
    slow: tuple[str, ...] = ()


PLANS = {
    "chain": Plan(
        chain.model,
        settle=800.0,
        step=40.0,
        time=1200.0,
        most=60_000,
        baths={
            "hmc": (60.0,),
            "sier2": (40.0, 60.0, 80.0, 100.0),
            "inner": (80.0,),
            "frames": (40.0,),
            "springs-hmc": (60.0,),
            "langevinmiddle": (20.0, 40.0, 60.0, 80.0),
        },
        energies={
            "sier4g": (10.0, 20.0, 30.0, 60.0),
            "sier4g-inner": (30.0, 60.0),
            "verlet": (5 / 3, 10 / 3, 10.0),
        },
        energy_time=6.0,
        # The shape of chains relaxes within some ns, and contacts of linkers and domains with it.
        slow=("potential", "gyration"),
    ),
    "stiff": Plan(
        chain.stiff_model,
        settle=6.0,
        step=3.0,
        time=0.0,
        most=0,
        baths={},
        energies={
            "sier4g": (3.0, 4.0),
            "sier4g-linkers": (3.0, 4.0, 6.0),
            "sier4g-inner": (3.0, 4.0, 6.0, 9.0),
        },
        energy_time=1.2,
    ),
    "patchy": Plan(
        patchy.model,
        settle=60.0,
        step=20.0,
        time=150.0,
        most=30_000,
        baths={
            "hmc": (40.0,),
            "springs-hmc": (15.0,),
            "sier2": (20.0, 40.0, 60.0),
            "frames": (40.0,),
            "langevinmiddle": (10.0, 20.0, 30.0, 40.0),
        },
        energies={"sier4g": (20.0, 40.0, 60.0), "verlet": (2.5, 5.0)},
        energy_time=6.0,
    ),
    "zeolite": Plan(
        zeolite.model,
        settle=15.0,
        step=5.0,
        time=30.0,
        interval=0.1,
        most=6_000,
        # Molecules go from cage to cage within hundreds of ps.
        slow=("potential",),
        baths={"hmc": (12.0,), "sier2": (5.0, 10.0, 20.0), "frames": (10.0,)},
    ),
}
