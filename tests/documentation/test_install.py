"""What installing, using and uninstalling the package leaves behind, in environments of their own and offline."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

pytest.importorskip("pip", minversion="22.3")  # for --python

ROOT = Path(__file__).parents[2]

#: Seconds after which a command counts as hanging.
LIMIT = 300

#: Prints where the package is; what compiles a loop.
USE = "import openmm_sier; print(openmm_sier.__file__)"
COMPILE = """
import numpy as np
from openmm_sier.dynamics import rotation
rotation.exact(np.ones((3, 3, 1)), np.ones((3, 1)), (1, 2, 3), 0.001)
"""


class Environment:
    """A virtual environment with what the package needs, and without the package."""

    def __init__(self, folder: Path) -> None:
        venv.create(folder / "venv")
        self.python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
        result = self.execute(self.python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))")
        self.packages = Path(result.strip())
        self.caches, self.sources = folder / "caches", folder / "sources"
        needed = folder / "needed"
        needed.mkdir()
        for path in {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}:
            for entry in Path(path).iterdir():
                if not entry.name.startswith(("openmm_sier", "__editable__")):
                    (needed / entry.name).symlink_to(entry)
        (self.packages / "needed.pth").write_text(f"{needed}\n")
        self.sources.mkdir()
        for name in ("openmm_sier", "systems", "pyproject.toml", "README.md", "LICENSE"):
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, self.sources / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / name, self.sources)

    def execute(self, *command: str | Path) -> str:
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA_", "PYTHON", "OPENMM_SIER"))}
        # Every platform's place for caches.
        for name in ("XDG_CACHE_HOME", "HOME", "LOCALAPPDATA"):
            environment[name] = str(getattr(self, "caches", ""))
        process = subprocess.run(
            command, cwd=self.python.parent, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
        )
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    def pip(self, *arguments: str | Path) -> None:
        self.execute(sys.executable, "-m", "pip", "--python", self.python, *arguments)

    def install(self, *options: str) -> None:
        self.pip("install", "--no-deps", "--no-build-isolation", "--no-index", *options, self.sources)

    def use(self) -> Path:
        return Path(self.execute(self.python, "-c", USE).strip())

    def uninstall(self) -> None:
        self.pip("uninstall", "--yes", "openmm-sier")

    @property
    def ours(self) -> list[str]:
        """What lies in the environment's packages besides what they need."""
        return sorted(path.name for path in self.packages.iterdir() if path.name != "needed.pth")


@pytest.fixture
def environment(tmp_path):
    return Environment(tmp_path)


@pytest.mark.thorough
def test_installs_of_either_kind_follow_each_other_and_leave_nothing(environment):
    """The second install takes the place of the first, and what is imported is its package."""
    environment.install()
    assert environment.use() == environment.packages / "openmm_sier" / "__init__.py"
    # Compiled code beside the modules would stay after the package is gone.
    environment.execute(environment.python, "-c", COMPILE)
    assert list(environment.caches.rglob("*.nbc"))
    environment.install("--editable")
    assert environment.use() == environment.sources / "openmm_sier" / "__init__.py"
    environment.uninstall()
    assert environment.ours == []


@pytest.mark.thorough
def test_a_folder_that_is_left_does_not_hide_an_editable_install(environment):
    left = environment.packages / "openmm_sier" / "dynamics" / "kernels" / "__pycache__"
    left.mkdir(parents=True)
    (left / "bodies.kick-110.py311.nbi").touch()
    environment.install("--editable")
    assert environment.use() == environment.sources / "openmm_sier" / "__init__.py"
