"""Navigation and captions for the Markdown pages, added while they are read.

The pages stay plain Markdown for Git hosts: the navigation follows the lists of `docs/README.md`,
and a fenced block with a title gets it as its caption.
"""

from __future__ import annotations

import os.path
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from sphinx.application import Sphinx

INDEX: Final = "docs/README"
#: Pages whose links are their chapters.
_BOOKS: Final = ("docs/decisions/README", "docs/reference/api/README")
#: Pages beside `docs/`, for contributors.
_PROJECT: Final = ("/CHANGELOG", "/CONTRIBUTING", "/SECURITY")

_SECTION: Final = re.compile(
    r"^## ([^:\n]+)(?::[^\n]*)?\n(.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL
)
_LINK: Final = re.compile(r"\]\(([^)#\s]+)\.md\)")
#: A site has no page for a folder of the repository.
_LINK_TO_FOLDER: Final = re.compile(r"\[([^\]\n]+)\]\(([^)#:\s]+)\)")
_TITLED: Final = re.compile(r'^```(\w+) title="([^"\n]+)"$', re.MULTILINE)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the changes to the pages."""
    app.connect("source-read", _complete)
    app.connect("build-finished", _add_first_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _complete(app: Sphinx, page: str, source: list[str]) -> None:
    """Add what only the site needs to the text of a page."""
    text = _TITLED.sub(r"```{code-block} \1\n:caption: \2\n", source[0])
    folder = (Path(app.srcdir) / page).parent
    text = _LINK_TO_FOLDER.sub(
        lambda link: link[1] if (folder / link[2]).is_dir() else link[0], text
    )
    if page == app.config.root_doc:
        index = (Path(app.srcdir) / f"{INDEX}.md").read_text(encoding="utf-8")
        text += _toctree("", [f"All pages </{INDEX}>"])
        for section in _SECTION.finditer(index):
            text += _toctree(section[1], _linked(INDEX, section[2]))
        text += _toctree("Project", _PROJECT)
    elif page in _BOOKS:
        text += _toctree("", _linked(page, text))
    source[0] = text


def _linked(page: str, text: str) -> Iterator[str]:
    """Yield the pages to which a part of a page links, each once."""
    seen = {page, "README"}
    for link in _LINK.findall(text):
        target = os.path.normpath(f"{page}/../{link}")
        if target not in seen:
            seen.add(target)
            yield f"/{target}"


def _toctree(caption: str, pages: Any) -> str:
    lines = ["", "", "```{toctree}", ":hidden:", *([f":caption: {caption}"] if caption else ())]
    return "\n".join([*lines, "", *pages, "```", ""])


def _add_first_page(app: Sphinx, error: Exception | None) -> None:
    """Copy the first page to the name that web servers look for."""
    if error is None and app.builder.name == "html":
        shutil.copy(app.outdir / f"{app.config.root_doc}.html", app.outdir / "index.html")
