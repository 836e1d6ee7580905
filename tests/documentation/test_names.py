"""Files, modules and studies that pages name are there. Sphinx sees links, but no names in backquotes."""

import importlib
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
#: A changelog names what is gone.
PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("systems/*.md")} - {ROOT / "CHANGELOG.md"})

FOLDERS = "docs|examples|openmm_sier|studies|systems|tests"


def missing_files(text: str) -> list[str]:
    """Paths in backquotes; NEW stands for what a reader may add."""
    named = re.findall(rf"`((?:{FOLDERS})/[\w/.\-]+)`", text)
    return [path for path in named if "NEW" not in path and not (ROOT / path).exists()]


def missing_tests(text: str) -> list[str]:
    """Return tests after `pytest` in backquotes that are not there: files or folders, with functions after "::"."""
    named = [name for line in re.findall(r"`pytest ([^`]*)`", text) for name in re.findall(r"tests/\S+", line)]
    return [name for name in named if not has_test(*name.partition("::")[::2])]


def missing_modules(text: str) -> list[str]:
    """Modules in backquotes or after `python -m`, with attributes of theirs."""
    named = re.findall(r"`(openmm_sier(?:\.\w+)+)", text) + re.findall(r"python -m ((?:studies|tests)(?:\.\w+)*)", text)
    return [name for name in named if not is_there(name)]


def has_test(path: str, function: str) -> bool:
    if not (ROOT / path).exists():
        return False
    return not function or f"def {function}(" in (ROOT / path).read_text()


def is_there(name: str) -> bool:
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        if (ROOT.joinpath(*parts[:n]).with_suffix(".py")).exists() or ROOT.joinpath(*parts[:n]).is_dir():
            result = None if n == len(parts) else importlib.import_module(".".join(parts[:n]))
            for attribute in parts[n:]:
                result = getattr(result, attribute, None)
                if result is None:
                    return False
            return True
    return False


def test_names_on_pages_exist():
    missing = {}
    for page in PAGES:
        text = page.read_text()
        if names := missing_files(text) + missing_modules(text) + missing_tests(text):
            missing[page.name] = names
    assert missing == {}


def test_names_of_code_in_contributing_are_there():
    """Also bare names, such as `_advance` or `forces.py`; NEW stands for what a reader may add."""
    text = re.sub(r"^( {4}|```).*$", "", (ROOT / "CONTRIBUTING.md").read_text(), flags=re.MULTILINE)
    named = {name for name in re.findall(r"`([A-Za-z_][\w./]*)`", text) if "NEW" not in name}
    sources = [path for folder in ("openmm_sier", "studies", "tests") for path in (ROOT / folder).rglob("*.py")]
    words = set(re.findall(r"\w+", " ".join(path.read_text() for path in sources)))
    places = {part for path in sources for part in path.relative_to(ROOT).with_suffix("").parts}
    places |= {path.stem for path in [*ROOT.iterdir(), *ROOT.glob("*/*")]}
    known = words | places | {"py", "md", "toml", "yaml", "cff", "NEW", "nox"}
    unknown = {name for name in named if not set(re.findall(r"\w+", name)) <= known}
    assert unknown == set()


def test_links_of_pages_that_sphinx_does_not_build():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)\s#]+)[^)\s]*\)", page.read_text()):
            assert re.match("https?:", target) or (page.parent / target).exists(), f"{page.name}: {target}"


def test_names_that_are_wrong_are_found():
    assert missing_files("`tests/engines/test_nothing.py` and `tests/conftest.py`") == ["tests/engines/test_nothing.py"]
    tested = "`pytest tests/conftest.py::test_nothing tests/documentation/test_names.py::is_there tests/none`"
    assert missing_tests(tested) == ["tests/conftest.py::test_nothing", "tests/none"]
    wrong = "`openmm_sier.context.reporters`, `openmm_sier.hooks.install` and python -m studies.hmc.solid"
    assert missing_modules(wrong) == ["openmm_sier.context.reporters", "studies.hmc.solid"]
