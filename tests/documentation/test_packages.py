"""Version and metadata agree in all files that state them."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from openmm_sier.version import __version__

ROOT = Path(__file__).parent.parent.parent


def stated(path, pattern):
    return re.findall(pattern, (ROOT / path).read_text(), re.MULTILINE)


def test_the_recipe_has_the_version_and_the_dependencies():
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib")
    assert stated("recipe/recipe.yaml", r'^  version: "(.*)"$') == [__version__]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    run = (ROOT / "recipe" / "recipe.yaml").read_text().split("  run:\n")[1].split("\ntests:")[0]
    listed = {line.strip().removeprefix("- ").replace(" ", "") for line in run.splitlines() if "- " in line}
    # A package without an architecture has what any of its Pythons needs.
    needed = {text.split(";")[0] for text in (*project["dependencies"], *extras["cli"])}
    assert listed - {"python>=${{python_min}}"} == needed
    assert stated("recipe/recipe.yaml", r'python_min: "(.*)"') == [project["requires-python"].removeprefix(">=")]


def test_every_folder_of_the_package_is_installed_with_all_its_files():
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib")
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    places = setup["package-dir"]
    folders = {name: ROOT / places.get(name, name.replace(".", "/")) for name in setup["packages"]}
    assert set(folders.values()) == {path.parent for path in (ROOT / "openmm_sier").rglob("*.py")} | {ROOT / "systems"}
    for name, folder in folders.items():
        patterns = ["*.py", "README.md", *setup["package-data"].get(name, [])]
        files = [path for path in folder.iterdir() if path.is_file()]
        assert [path.name for path in files if not any(map(path.match, patterns))] == []


def git(*arguments):
    """Lines that git prints; none in a checkout without git."""
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split("\n")


def has_a_place(path):
    """Whether a folder or a kind of file at the top of the repository is for this path."""
    if len(path.parts) > 1:
        return path.parts[0] in {
            ".ci",
            "docs",
            "examples",
            "kernels",
            "openmm_sier",
            "paper",
            "recipe",
            "studies",
            "systems",
            "tests",
        }
    return path.suffix in {"", ".cff", ".in", ".md", ".py", ".toml", ".yaml"}


def debris(paths):
    """Return what has no place in the repository, such as outputs of a run."""
    return [path for path in paths if path and not has_a_place(Path(path))]


def test_no_run_has_left_its_outputs_in_the_repository():
    """Neither as tracked files nor as files that git does not ignore."""
    assert debris(git("ls-files", "--cached", "--others", "--exclude-standard")) == []


def test_outputs_of_a_run_are_found():
    left = ["out-scan/chain.json", "water.xtc"]
    assert debris(["README.md", ".gitignore", "systems/peptide.pdb", *left, ""]) == left


def test_a_tag_of_this_commit_is_the_version():
    """Checkouts without tags or without git have nothing to compare."""
    tags = git("tag", "--points-at", "HEAD")
    assert [tag for tag in tags if re.fullmatch(r"v\d+\.\d+\.\d+", tag) and tag != f"v{__version__}"] == []


def test_changelog_and_citation_know_the_version():
    assert stated("CHANGELOG.md", r"^## (.*)$")[0] == __version__
    assert stated("CITATION.cff", "^version: (.*)$") == [__version__]


def test_the_paper_cites_what_its_bibliography_has():
    """No entry is missing, and none stands there uncited."""
    text = (ROOT / "paper" / "paper.md").read_text().split("---\n", 2)[2]
    cited = set(re.findall(r"@(\w+)", text))
    assert cited == set(stated("paper/paper.bib", r"^@\w+\{(\w+),$"))


def test_the_noxfile_lists_a_session_for_each_python_claimed():
    classifiers = stated("pyproject.toml", r"Python :: (3\.\d+)")
    assert [", ".join(f'"{version}"' for version in classifiers)] == stated("noxfile.py", r"^PYTHONS = \[(.*)\]$")
    assert sys.version_info[:2] in [tuple(map(int, version.split("."))) for version in classifiers]
