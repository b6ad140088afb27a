"""The site of the pages, for `make docs`: Sphinx reads the Markdown files as they are."""

import re
from pathlib import Path
from typing import Any

from pygments.lexers.special import TextLexer

ROOT = Path(__file__).parents[2]
project = "zenoh-plc-gateway"
extensions = ["myst_parser"]
html_theme = "furo"
html_title = project
html_show_sphinx = False
html_search_scorer = "docs/site/scorer.js"  # from the root of the sources
root_doc = "docs/README"
include_patterns = ["docs/**.md", "README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"]
myst_heading_anchors = 6
INDEX = re.compile(r"^\| \[[\w.-]+\]\(([\w.-]+)\.md\)", re.MULTILINE)
OTHERS = {
    "docs/README": ["../README", "contributors/README", "../SECURITY", "../CHANGELOG"],
    "docs/contributors/README": ["../../CONTRIBUTING"],
}


def read(_app: Any, page: str, source: list[str]) -> None:
    """The tables of an index are its contents; a link to a folder has no page here."""
    text = source[0]
    if page in OTHERS:
        pages = "\n".join([*INDEX.findall(text), *OTHERS[page]])
        text += f"\n```{{toctree}}\n:hidden:\n\n{pages}\n```\n"
    here = (ROOT / page).parent

    def linked(link: re.Match[str]) -> str:
        return link[1] if (here / link[2]).is_dir() else link[0]

    source[0] = re.sub(r"\[([^\]]*)\]\((\.\.?/[\w./-]+)\)", linked, text)


def setup(app: Any) -> None:
    app.connect("source-read", read)
    app.add_lexer("mermaid", TextLexer)
