"""Settings of a run that contradict each other, and settings that have no effect with the others."""

from collections.abc import Callable, Collection, Iterator

from openmm_sier.cli.arguments import flag
from openmm_sier.cli.settings import RunSettings
from openmm_sier.observe.openmm_integrators import BAROSTAT_INTERVAL

#: Ending of the names of trajectories.
TRAJECTORY = ".dcd"

#: Two settings of the same quantity, of which a user may choose one.
LENGTHS = "steps", "time"

#: Settings that have an effect only with others: these in words, and a function that checks them.
DEPENDENT: dict[str, tuple[str, Callable[[RunSettings], bool]]] = {
    "thermostat": (
        "--ensemble nvt or npt, and a scheme of this package",
        lambda settings: settings.ensemble in ("nvt", "npt") and settings.method.scheme is not None,
    ),
    "friction": ("--ensemble nvt, npt or hmc", lambda settings: settings.ensemble != "nve"),
    "pressure": ("--ensemble npt or hmc", lambda settings: settings.ensemble in ("npt", "hmc")),
    "steps_per_trial": ("--ensemble hmc", lambda settings: settings.ensemble == "hmc"),
    "pressure_tensor_every": (
        "--pressure-tensor FILE.csv",
        lambda settings: settings.pressure_tensor is not None,
    ),
}


def contradiction(settings: RunSettings, chosen: Collection[str]) -> str | None:
    """Return the reason why no run can have these settings; None if a run can.

    Args:
        settings: each within its range.
        chosen: names of the settings that a user chose.
    """
    return next(_contradictions(settings, chosen), None)


def _contradictions(settings: RunSettings, chosen: Collection[str]) -> Iterator[str]:
    yield from _of_motion(settings)
    yield from _of_files(settings)
    if all(name in chosen for name in LENGTHS):
        yield f"{' and '.join(map(flag, LENGTHS))} both say how long the run is: give one of them"
    for name, (needed, does_something) in DEPENDENT.items():
        if name in chosen and not does_something(settings):
            yield f"{flag(name)} needs {needed}"


def _of_motion(settings: RunSettings) -> Iterator[str]:
    method = settings.method
    if settings.ensemble not in method.ensembles:
        yield f"{method.name} supports the ensembles {', '.join(method.ensembles)}, got {settings.ensemble}"
    if settings.cutoff and settings.switch and settings.switch >= settings.cutoff:
        yield f"--switch {settings.switch:g} must be below --cutoff {settings.cutoff:g}"
    if method.scheme is not None:
        return
    if settings.rigid:
        yield (
            f"--rigid {' '.join(settings.rigid)} needs a scheme of this package: {method.name} keeps molecules rigid "
            "only by constraints"
        )
    if settings.moves_volume and settings.interval(settings.checkpoint_every) < BAROSTAT_INTERVAL:
        yield (
            f"--checkpoint-every {settings.checkpoint_every:g} is too short: OpenMM's barostat counts its "
            f"{BAROSTAT_INTERVAL} steps from zero after each checkpoint, and would never act. Give "
            f"{BAROSTAT_INTERVAL * settings.step_time:g} ps or more"
        )


def _of_files(settings: RunSettings) -> Iterator[str]:
    if settings.out.suffix.lower() != TRAJECTORY:
        yield f"the name of a trajectory must end in {TRAJECTORY}, got {settings.out}"
    for table in (settings.report, settings.pressure_tensor):
        if table is not None and table.suffix.lower() == TRAJECTORY:
            yield f"{table} will be a table: give a name that ends in .csv"
