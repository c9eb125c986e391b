"""Sphinx extension: links to Python files lead to pages of the site, and to the line of the name that they show.

`[`masked_loss`](../../osfcore/estimation/objective.py)` in a page leads to the file on GitHub, and on the site to the
definition of `masked_loss`. `sphinx.ext.viewcode` does this only for what the Python reference lists.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util import logging

ROOT = Path(__file__).parents[2]
BEFORE_DOWNLOADS_ARE_COPIED = 400


def lines_of(code: str) -> dict[str, int]:
    """Return the line of each function, class, constant and method of a module, methods as `Class.method`."""
    found: dict[str, int] = {}

    def collect(body: list[ast.stmt], owner: str) -> None:
        for statement in body:
            if isinstance(statement, ast.FunctionDef | ast.ClassDef):
                found[owner + statement.name] = statement.lineno
            if isinstance(statement, ast.ClassDef):
                collect(statement.body, f"{statement.name}.")
            if isinstance(statement, ast.Assign | ast.AnnAssign):
                targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
                found.update({owner + name.id: name.lineno for name in targets if isinstance(name, ast.Name)})

    collect(ast.parse(code).body, "")
    return found


def link(app: Sphinx, doctree: nodes.document) -> None:
    """Let links to Python files lead to their pages."""
    for node in list(doctree.findall(addnodes.download_reference)):
        file = (Path(app.env.doc2path(app.env.docname)).parent / node["reftarget"]).resolve()
        if file.suffix != ".py" or not file.is_relative_to(ROOT):
            continue
        shown, page = node.astext(), f"code/{file.relative_to(ROOT).with_suffix('')}"
        lines = lines_of(file.read_text(encoding="utf-8"))
        if re.fullmatch(r"[\w.]+", shown) and shown not in lines and shown != file.name:
            logging.getLogger(__name__).warning("%s has no %s", file.relative_to(ROOT), shown, location=node)
        place = f"#L-{lines[shown]}" if shown in lines else ""
        uri = app.builder.get_relative_uri(app.env.docname, page) + place
        node.replace_self(nodes.reference("", "", *node.children, internal=True, refuri=uri))
        app.env.metadata[app.env.docname].setdefault("source_pages", []).append((page, str(file)))


def pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield a page for each file that a link leads to."""
    for page, file in sorted(
        {link for of_page in app.env.metadata.values() for link in of_page.get("source_pages", ())}
    ):
        path = Path(file).relative_to(ROOT)
        code = app.builder.highlighter.highlight_block(  # pyright: ignore[reportAttributeAccessIssue]
            Path(file).read_text(encoding="utf-8"), "python", linenos="inline", lineanchors="L"
        )
        yield page, {"title": path.name, "body": f"<h1>{path.name}</h1><p>{path}</p>{code}"}, "page.html"


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("doctree-read", link, priority=BEFORE_DOWNLOADS_ARE_COPIED)
    app.connect("html-collect-pages", pages)
