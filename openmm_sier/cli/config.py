"""Settings of a run in TOML files: `openmm-sier run --config`."""

import json
import sys
from pathlib import Path

from pydantic import ValidationError

from openmm_sier.cli.contradictions import LENGTHS
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.fields import refusal
from openmm_sier.cli.settings import RunSettings
from openmm_sier.system.untrusted_files import open_regular

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def read_config(path: Path) -> RunSettings:
    """Return the settings in a TOML file. Paths are relative to the current directory.

    Raises:
        RunError: the file is not TOML.
        Misused: a setting is unknown or wrong; the message names the file and the setting.
        OSError: the file cannot be read.
    """
    try:
        with open_regular(path) as file:
            table = tomllib.load(file)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RunError(f"{path} is not a TOML file: {error}") from None
    named = {name.replace("-", "_"): value for name, value in table.items()}
    try:
        # In JSON, paths are strings, and a string is no number.
        return RunSettings.model_validate_json(json.dumps(named, default=str), strict=True)
    except ValidationError as error:
        raise Misused(f"{path}: {': '.join(refusal(error, RunSettings))}") from None


def joined(of_file: RunSettings, of_line: RunSettings) -> RunSettings:
    """Return the settings of a TOML file; those of the command line override them."""
    has_length = any(name in of_line.chosen for name in LENGTHS)
    from_file = {name: value for name, value in of_file.chosen.items() if not (has_length and name in LENGTHS)}
    return RunSettings.model_construct(**{**from_file, **of_line.chosen})
