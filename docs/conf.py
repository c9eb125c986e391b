"""Settings of the site of documents; `make docs` builds it."""

import re
import sys
from importlib import metadata, resources
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).parent
# One script from a package that is used for its files alone, so that the site loads nothing from elsewhere.
MATHJAX = resources.files("sphinx-mathjax-offline") / "static" / "mathjax" / "tex-svg.js"
sys.path.insert(0, str(DOCS / "extensions"))

project = "OSF manipulation"
release = metadata.version("osf-manipulation")
copyright = "the contributors; MIT licence"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "command_reference",
    "rest_reference",
    "source_pages",
]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
exclude_patterns = ["explanation/report-measured.md"]  # part of the page beside it

default_role = "literal"  # of single backticks in docstrings
autoclass_content = "both"  # the class and its constructor
autodoc_default_options = {"members": True, "member-order": "bysource", "exclude-members": "model_config"}
autodoc_typehints_format = "short"
autosummary_generate = False
napoleon_custom_sections = [("Attributes", "params_style")]  # of dataclasses, what their constructors take
python_maximum_signature_line_length = 90

html_theme = "furo"
pygments_dark_style = "github-dark"
html_title = project
html_favicon = html_logo = "../static/icon.svg"
html_static_path = ["site.css", str(MATHJAX)]
mathjax_path = "tex-svg.js"
html_css_files = ["site.css"]
html_copy_source = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#17646e", "color-brand-content": "#17646e"},
    "dark_css_variables": {"color-brand-primary": "#63b8c2", "color-brand-content": "#63b8c2"},
}

FROM_ROOT = {"benchmarks": "BENCHMARKS.md", "changelog": "CHANGELOG.md", "contributing": "CONTRIBUTING.md"}


def take_from_root(_app: Sphinx, page: str, source: list[str]) -> None:
    """Show pages that stand at the top of the repository, and let links to them lead there."""
    if page in FROM_ROOT:
        source[0] = (DOCS.parent / FROM_ROOT[page]).read_text(encoding="utf-8").replace("](docs/", "](")
    for name, file in FROM_ROOT.items():
        source[0] = re.sub(rf"\]\((\.\./)*{file}", f"](/{name}.md", source[0])


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", take_from_root)
