"""Sphinx's settings. Pages are Markdown; tutorials are run, and what can be walked is written when the site is built.

There is no sphinx-gallery: what it does, running what it shows, myst-nb does for the tutorials, and the pictures of
landscapes have a site of their own, `landscape gallery build`, which becomes a part of this one.
"""

from __future__ import annotations

import os
import sys
from atexit import register
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "src")]
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # where `landscape` is
# What pages show of commands is what a stranger sees: no colours, no bars, nothing that was measured here before.
measurements = mkdtemp(prefix="gradscape-docs-")
register(rmtree, measurements, ignore_errors=True)
os.environ |= {"COLUMNS": "100", "TTY_COMPATIBLE": "0", "XDG_DATA_HOME": measurements}
os.environ["PYTHONWARNINGS"] = 'ignore:install "ipywidgets"'  # whose scripts a page would load from elsewhere

import gradscape  # noqa: E402 # once it can be found

project = "gradscape"
author = "The gradscape developers"
copyright = "The gradscape developers, MIT licence"
version = release = gradscape.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinxcontrib.bibtex",
    "sphinx_copybutton",
    "docs.pages.extension",
]
exclude_patterns = ["example_package", "templates", "**/__pycache__"]
templates_path = ["templates"]
bibtex_bibfiles = ["references.bib"]
bibtex_reference_style = "author_year"

myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 4  # as GitHub has them, which links are written for
myst_links_external_new_tab = False
nb_execution_mode = "force"
nb_execution_timeout = -1
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_merge_streams = True

smartquotes_action = "q"  # two dashes begin an option
html_math_renderer = "mathml"  # which browsers draw by themselves; MathJax would be another megabyte of scripts
add_module_names = False
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
maximum_signature_line_length = 60
python_display_short_literal_types = True
autosummary_imported_members = True
napoleon_google_docstring = False
default_role = "literal"  # one backtick on each side is code, as in Markdown

html_theme = "pydata_sphinx_theme"
html_title = f"gradscape {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_sidebars = {"start": [], "generated/wall": []}  # which have no pages below them
TABLES = ("measured", "remedies", "fidelities", "races", "benchmarks", "parts")
html_theme_options = {
    "secondary_sidebar_items": {"**": ["page-toc"], **{page: [] for page in TABLES}},  # tables get its room
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "footer_start": ["copyright"],
    "footer_end": [],
    "back_to_top_button": False,
}
html_context = {"default_mode": "auto"}
copybutton_prompt_text = "$ "
