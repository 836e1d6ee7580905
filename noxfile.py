"""The tests on every Python and on the oldest and newest dependencies that pyproject.toml admits: `nox`.

Interpreters are those on the PATH. Dependencies come from the package index as wheels.
"""

from pathlib import Path

import nox

PYTHONS = ["3.10", "3.11", "3.12", "3.13"]
EXTRAS = list(nox.project.load_toml("pyproject.toml")["project"]["optional-dependencies"])

nox.options.sessions = ["tests"]
nox.options.default_venv_backend = "uv|virtualenv"


@nox.session(python=PYTHONS)
@nox.parametrize("dependencies", ["oldest", "newest"], ids=["oldest", "newest"])
def tests(session: nox.Session, dependencies: str) -> None:
    """The fast tests, or what is given to pytest: `nox -s "tests-3.13(oldest)" -- tests/engines`."""
    session.install("uv")
    resolution = "lowest-direct" if dependencies == "oldest" else "highest"
    wanted = Path(session.create_tmp()) / "requirements.txt"
    # Releases without a wheel for this Python count as not admitted: nobody builds NumPy or OpenMM here.
    session.run_install(
        *("uv", "pip", "compile", "--quiet", "--resolution", resolution, "--only-binary", ":all:", "--extra", "test"),
        *("--python-version", str(session.python), "--output-file", str(wanted), "pyproject.toml"),
    )
    session.install("-r", str(wanted))
    session.install("--no-deps", "-e", ".")
    session.run("python", "-m", "pytest", *(session.posargs or ["-n", "auto", "--dist", "worksteal"]))


@nox.session
def wheel(session: nox.Session) -> None:
    """The wheel alone, with every extra, in an empty environment: installed, imported, and a box of water simulated."""
    session.install("build", "twine")
    folder = Path(session.create_tmp()).resolve()
    for old in folder.glob("openmm_sier-*"):
        old.unlink()
    session.run("python", "-m", "build", "--outdir", str(folder))
    session.run("python", "-m", "twine", "check", "--strict", *map(str, folder.glob("openmm_sier-*")))
    (built,) = folder.glob("*.whl")
    session.install(f"{built}[{','.join(EXTRAS)}]")
    with session.chdir(folder):  # away from the sources
        session.run("python", "-c", "import openmm_sier; print(openmm_sier.__version__, openmm_sier.__file__)")
        box = "import importlib.resources as r; print(r.files('openmm_sier.systems') / 'tip3p-512.pdb')"
        path = session.run("python", "-c", box, silent=True).strip()
        session.run(
            *("openmm-sier", "run", path, "--steps", "20", "--equilibrate", "0.1", "--out", "water.dcd", "--overwrite")
        )
