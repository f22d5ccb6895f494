"""Configure Sphinx: the checkout is the source, so that every relative link of a page is a link of the site.

    sphinx-build -c docs/site -b html --fail-on-warning . site

Pages stay plain Markdown that a code host shows as well. What is generated stands where a page has a comment
``<!-- site: NAME ... -->`` (``generated.py``).
"""

import os
import sys
from pathlib import Path

SITE = Path(__file__).resolve().parent
sys.path.insert(0, str(SITE))
sys.path.insert(0, str(SITE.parents[1]))  # the package of this checkout, installed or not

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # it would log that it looks for others

project = "vssm-gym"
copyright = "the authors of vssm-gym"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "generated",
    "docstrings",
    "repository_links",
]

root_doc = "README"
include_patterns = [
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "SECURITY.md",
    "docs/**.md",
    "eval/baselines/README.md",
    "envs/assets/LICENSES.md",
]
exclude_patterns = [".*", "site", "build", "dist", "out", "tests", "vssm_gym", "agents", "examples", "docs/site"]

myst_enable_extensions = ["attrs_inline"]  # anchors: generated.py
myst_heading_anchors = 6
highlight_language = "none"  # indented blocks are equations
suppress_warnings = ["myst.header"]  # the README's headings begin below its title

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
maximum_signature_line_length = 88
add_module_names = False
python_use_unqualified_type_names = True
viewcode_follow_imported_members = False  # entries are of the modules that define them
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True  # attributes as one list, without types: the signature has them
napoleon_attr_annotations = False

html_theme = "furo"  # no script, font or style from elsewhere
html_title = "vssm-gym"
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]
copybutton_exclude = ".linenos, .gp, .go"
