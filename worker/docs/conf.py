"""How Sphinx builds the guide; `scripts/docs` calls it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from limber.version import VERSION

project = "Limber"
author = "The Limber developers"
release = VERSION
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "reference_tables"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "amsmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "pydata_sphinx_theme"
html_theme_options = {"show_toc_level": 2, "navigation_with_keys": False}
html_show_sourcelink = False
autodoc_typehints = "none"
nitpicky = False
