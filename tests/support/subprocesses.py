"""Python programs in separate interpreters."""

import subprocess
import sys

#: Seconds after which a program counts as hanging. They take some seconds on a machine that has nothing else to do.
LIMIT = 900


def run_python(program: str, *arguments, environment=None) -> str:
    """Return the output of a program.

    Raises:
        AssertionError: it failed, with its errors.
    """
    process = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=LIMIT,
        env=environment,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout
