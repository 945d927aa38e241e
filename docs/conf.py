"""Sphinx configuration of the documentation; `./tools/run docs` builds it into build/docs."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "weldcal"
author = "The weldcal developers"
project_copyright = author
language = "en"

# command_reference writes the reference of all commands from the program itself.
# myst_nb reads the tutorials, which are notebooks, and leaves the other pages to myst_parser. It executes none: a test
# does, and their pictures are files. `-D nb_execution_mode=force` executes them and shows what they print.
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "command_reference"]
source_suffix = {".md": "myst-nb"}
nb_execution_mode = "off"
nb_execution_timeout = 300
exclude_patterns = ["_extensions"]

# "--option" stays as it is typed, and `names` of docstrings are code.
smartquotes = False
default_role = "code"

# Links to headings, as GitHub makes them.
myst_heading_anchors = 4

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
# The reference shows `weldcal.calibrate`, not the module that holds it.
add_module_names = True

# The search index is part of the pages: no server and no network is needed.
html_theme = "furo"
html_title = "weldcal"
html_copy_source = False
html_show_sphinx = False
pygments_style = "tango"
pygments_dark_style = "native"
