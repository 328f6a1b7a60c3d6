"""Settings of the documentation site: Sphinx with MyST and furo. `make docs` builds it.

The pages are the Markdown files of the repository, unchanged. The modules beside this file add what
only the site needs: `pages.py` navigation and captions, `diagrams.py` Mermaid drawings, `api.py`
the reference from docstrings.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(ROOT)]

from rosrm.version import __version__  # noqa: E402 - the line above finds it

project = "rosrm"
version = release = __version__
project_copyright = "the authors of rosrm, Apache-2.0"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "pages",
    "diagrams",
    "api",
]

# --- pages ------------------------------------------------------------------------------------

root_doc = "README"
include_patterns = [
    "*.md",
    "docs/**.md",
    "benchmarks/README.md",
    "examples/README.md",
    "examples/plugins/README.md",
]
# Sphinx looks into every other folder, although no pattern above matches there.
exclude_patterns = [".*", "build", "install", "log", "out", "plugins", "rosrm*", "tests", "tools"]

myst_heading_anchors = 6  # as a Git host makes them
myst_fence_as_directive = ["mermaid"]

# A link that leads nowhere is an error, and so is a private type in the interface of a public name.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(?!rosrm\.).*"),  # without a network, types of other packages have no pages
    # Parts of a spec that programs give as a mapping or read, but do not import.
    ("py:class", r"rosrm\.model\.(values|adoption|codec|records)\..*"),
    # Internal types of the contracts of `rosrm.testing`.
    ("py:class", r"rosrm\.extensions\..*"),
]
linkcheck_anchors = False  # Git hosts add anchors to a page by script
linkcheck_timeout = 20

# --- reference from docstrings ----------------------------------------------------------------

# The modules of ROS are missing on a machine without ROS 2.
autodoc_mock_imports = [
    name
    for name in ("rclpy", "rosrm_msgs")
    if getattr(find_spec(name), "origin", None) is None  # a folder of that name is no module
]
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
add_module_names = False
python_maximum_signature_line_length = 88
napoleon_use_ivar = True
napoleon_attr_annotations = False  # the signature has the types
default_role = "code"  # `a name` in a docstring, as in Markdown

# --- appearance -------------------------------------------------------------------------------

html_theme = "furo"
html_title = f"rosrm {version}"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_show_search_summary = False  # read by requests, which a browser refuses for files
html_copy_source = False
html_show_sourcelink = False
pygments_style = "friendly"
pygments_dark_style = "monokai"
