"""Configuration of the documentation site.

    python -m sphinx -W --keep-going -n docs build/site

builds it with warnings as errors. Pages that show records say so in their first lines, and MyST-NB executes them. The
notebooks are shown as they were stored: `python docs/notebooks/execute.py` executes them anew.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx

from openmm_sier.version import __version__

project = "openmm_sier"
author = "The openmm_sier developers"
project_copyright = author
version = release = __version__

# The studies, which are not installed; for the kernels of executed pages too.
ROOT = str(Path(__file__).parents[1])
sys.path.insert(0, ROOT)
os.environ["PYTHONPATH"] = os.pathsep.join([ROOT, *filter(None, [os.environ.get("PYTHONPATH")])])

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]

myst_enable_extensions = ["attrs_block", "dollarmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_execution_show_tb = True
# Seconds for a cell, on the busiest machine.
nb_execution_timeout = 300
nb_eval_name_regex = ".*"
nb_render_markdown_format = "myst"
nb_output_stderr = "remove"

# Docstrings put code between single backquotes.
default_role = "code"
autodoc_member_order = "bysource"
# Types come from the signatures, and stand beside what docstrings say of arguments.
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autoclass_content = "both"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# Classes of other packages, of which no inventory is at hand, classes that only signatures name, and errors that have
# no page of their own.
INNER = (
    "Actions",
    "Constraints",
    "Mark",
    "Memory",
    "MoleculeCentres",
    "Move",
    "OpenMMIntegrator",
    "Program",
    "RigidBodies",
    "Sites",
    "SolverTest",
    "Species",
    "StepCheck",
    "Volume",
)
nitpick_ignore_regex = [
    ("py:class", r"(openmm|numpy|collections|os|pathlib)\..*"),
    ("py:class", rf"openmm_sier\..*\.({'|'.join(INNER)})"),
    ("py:exc", r".*(Error|Exception)"),
    # Signatures of OpenMM that overrides of its methods have.
    ("py:class", "Context"),
]

# Letters up to which a cell of a table stays on one line, and beyond which it gets a column of some width.
SHORT_CELL, LONG_CELL = 14, 20

# A letter with an accent, before an index.
ACCENTED = re.compile(r"\\(?:tilde|hat|bar|dot|vec) ?(?:\{(?:[^{}]|\{[^{}]*\})*\}|\w)(?=[_^])")

html_theme = "furo"
html_title = f"openmm_sier {version}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_favicon = "_static/favicon.svg"
html_show_sphinx = False
html_math_renderer = "mathml"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
copybutton_line_continuation_character = "\\"


def _formula(translator, node: nodes.Element, block: bool) -> None:
    """A formula as MathML, which browsers show by themselves: no script is loaded, from here or from elsewhere."""
    source = re.sub(r"\s+", " ", node.astext()).strip()
    # Docutils puts an index under a letter with an accent; one of nothing, after the letter, stands where it should.
    source = ACCENTED.sub(r"\g<0>{}", source)
    formula = tex2mathml(source, as_block=block)
    translator.body.append(f'<div class="formula">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def _keep_errors_with_numbers(app: Sphinx, document: nodes.document, name: str) -> None:
    """No line ends before or after ±, in tables above all."""
    for text in list(document.findall(nodes.Text)):
        if " ± " in text and not isinstance(text.parent, nodes.literal | nodes.literal_block):
            text.parent.replace(text, nodes.Text(text.replace(" ± ", "\u00a0±\u00a0")))


def _mark_cells(app: Sphinx, document: nodes.document, name: str) -> None:
    """Mark short cells, which no line may break, and long ones, which need some width, for the style sheet."""
    for cell in document.findall(nodes.entry):
        text = cell.astext()
        if "±" in text or len(text) <= SHORT_CELL:
            cell["classes"].append("short")
        elif len(text) > LONG_CELL:
            cell["classes"].append("long")


def _say_nothing_of_tuples(app: Sphinx, kind: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Leave out the docstring that Python gives to the constructor of a named tuple."""
    lines[:] = [line for line in lines if not line.startswith("Create new instance of ")]


def _skip_fields_of_tuples(
    app: Sphinx, kind: str, name: str, thing: object, skip: bool, options: object
) -> bool | None:
    """Leave out fields of named tuples, which the docstring of the class describes."""
    return True if (getattr(thing, "__doc__", None) or "").startswith("Alias for field number") else None


def _link_back_to_what_is_there(app: Sphinx, page: str, template: str, context: dict, document: object) -> None:
    """Leave links from the source to the reference only for names that it has.

    Sphinx takes one name of a module for all of its objects, but some stand there under another one.
    """
    if page.startswith("_modules/"):
        known = app.env.domains["py"].objects
        back = r'<a class="viewcode-back" href="[^"#]*#([^"]*)">[^<]*</a>'
        context["body"] = re.sub(back, lambda link: link[0] if link[1] in known else "", context["body"])


def setup(app: Sphinx) -> None:
    app.connect("autodoc-process-docstring", _say_nothing_of_tuples)
    app.connect("autodoc-skip-member", _skip_fields_of_tuples)
    app.connect("html-page-context", _link_back_to_what_is_there)
    app.connect("doctree-resolved", _keep_errors_with_numbers)
    app.connect("doctree-resolved", _mark_cells)
    app.add_html_math_renderer(
        "mathml",
        (lambda translator, node: _formula(translator, node, False), None),
        (lambda translator, node: _formula(translator, node, True), None),
    )
