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
    "Program",
    "RigidBodies",
    "SolverTrial",
    "Species",
    "StepCheck",
    "StockIntegrator",
    "StoredLedger",
    "Volume",
)
nitpick_ignore_regex = [
    ("py:class", r"(openmm|numpy|collections|os|pathlib)\..*"),
    ("py:class", rf"openmm_sier\..*\.({'|'.join(INNER)})"),
    ("py:exc", r".*(Error|Exception)"),
]

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
    formula = tex2mathml(source, as_block=block)
    translator.body.append(f'<div class="formula">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def _keep_errors_with_numbers(app: Sphinx, document: nodes.document, name: str) -> None:
    """No line ends before or after ±, in tables above all."""
    for text in list(document.findall(nodes.Text)):
        if " ± " in text and not isinstance(text.parent, nodes.literal | nodes.literal_block):
            text.parent.replace(text, nodes.Text(text.replace(" ± ", "\u00a0±\u00a0")))


def setup(app: Sphinx) -> None:
    app.connect("doctree-resolved", _keep_errors_with_numbers)
    app.add_html_math_renderer(
        "mathml",
        (lambda translator, node: _formula(translator, node, False), None),
        (lambda translator, node: _formula(translator, node, True), None),
    )
