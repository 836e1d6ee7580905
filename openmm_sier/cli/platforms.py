"""The platform of a run: a restart keeps that of its checkpoint, and reports differences."""

from collections.abc import Mapping
from pathlib import Path

import openmm

from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.settings import RunSettings

#: In the notes of a checkpoint, the name of the platform, and properties on which the last bits of forces depend.
NAME, PROPERTIES = "Platform", ("Precision", "Threads")


def check_platform(name: str | None) -> None:
    """Refuse a platform that OpenMM does not have here.

    Raises:
        Misused: naming those that it has.
    """
    here = _platforms()
    if name is not None and name not in here:
        raise Misused(f"argument --platform: expected one of those that OpenMM has here, {', '.join(here)}; got {name}")


def _platforms() -> list[str]:
    return [openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())]


def platform_of(context: openmm.Context) -> dict[str, str]:
    """Return the platform of a Context for the notes of a checkpoint."""
    platform = context.getPlatform()
    properties = [name for name in PROPERTIES if name in platform.getPropertyNames()]
    return {NAME: platform.getName(), **{name: platform.getPropertyValue(context, name) for name in properties}}


def keep_platform(settings: RunSettings, checkpoint: Path, noted: Mapping[str, str]) -> RunSettings:
    """Return the settings of a restart, on the platform of its checkpoint unless the user chose another.

    Args:
        settings: of the run.
        checkpoint: its path.
        noted: platform in the checkpoint, see `platform_of`.

    Raises:
        RunError: OpenMM does not have the platform here.
    """
    if settings.platform is not None:
        return settings
    here = _platforms()
    if noted[NAME] not in here:
        raise RunError(
            f"{checkpoint} was written on the {noted[NAME]} platform, which OpenMM does not have here: choose one of "
            f"{', '.join(here)} with --platform"
        )
    return settings.model_copy(update={"platform": noted[NAME]})


def differences(context: openmm.Context, checkpoint: Path, noted: Mapping[str, str]) -> list[str]:
    """Return a message if a run continues with another platform, precision or number of threads."""
    current = platform_of(context)
    if noted == current:
        return []
    return [
        f"{checkpoint} was written on {_described(noted)}, and the run continues on {_described(current)}: the two "
        "round forces differently"
    ]


def _described(platform: Mapping[str, str]) -> str:
    properties = ", ".join(f"{name} {value}" for name, value in platform.items() if name != NAME)
    return f"{platform[NAME]} ({properties})" if properties else platform[NAME]
