"""The documentation as a site: built without a warning, whole, and readable without a network."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

import rosrm

pytest.importorskip("sphinx", reason="Sphinx is not installed (`pip install '.[docs]'`)")

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]

#: Attributes by which a page loads files; a link that a reader follows loads nothing.
_LOADING = {"img": "src", "link": "href", "script": "src", "source": "src", "iframe": "src"}


class Loaded(HTMLParser):
    """The addresses of files that a page loads."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        address = dict(attrs).get(_LOADING.get(tag, ""))
        if address and not address.startswith("data:"):
            self.addresses.append(address)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site; a warning, such as a link that leads nowhere, is an error."""
    folder = tmp_path_factory.mktemp("site")
    words = ["-c", "docs/site", "-d", folder / "doctrees", "-b", "html", "-j", "auto"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words, "-W", "--keep-going", "-q", ".", folder / "html"],
        cwd=ROOT, capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return folder / "html"


def read(site: Path, page: str) -> str:
    return (site / page).read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_site_has_every_page(site):
    """The README is also the first page, which links to all sections."""
    names = [page.relative_to(ROOT).with_suffix(".html") for page in PAGES]
    assert [name for name in names if not (site / name).is_file()] == []
    first = read(site, "index.html")
    assert first == read(site, "README.html")
    for caption in ("Tutorials", "How-to", "Reference", "Explanation", "Decisions", "Project"):
        assert f'<span class="caption-text">{caption}</span>' in first


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_every_page_loads_only_files_of_the_site(site):
    for page in site.rglob("*.html"):
        for address in Loaded(page.read_text(encoding="utf-8")).addresses:
            path = unquote(re.sub(r"[?#].*", "", address))
            assert (page.parent / path).exists(), f"{page.relative_to(site)} loads {address}"
    styles = "".join(style.read_text(encoding="utf-8") for style in site.rglob("*.css"))
    assert re.findall(r"@import|url\(['\"]?(?:https?:)?//", styles) == []


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_every_public_name_is_described_once(site):
    """Autodoc has found each name of `rosrm`, and the search finds the pages of the client."""
    pages = "".join(
        page.read_text("utf-8") for page in (site / "docs/reference/api").glob("*.html")
    )
    wanted = [name for name in rosrm.__all__ if name in rosrm._MODULES]
    count = {name: len(re.findall(rf'<dt [^>]*id="rosrm\.{name}"', pages)) for name in wanted}
    assert {name: times for name, times in count.items() if times != 1} == {}
    assert "docs/reference/api/client" in read(site, "searchindex.js")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_diagrams_and_titles_of_files_are_shown(site):
    """A mermaid block is a picture, and `title=` of a fenced block its caption."""
    page = read(site, "docs/reference/protocol.html")
    assert page.count('<img src="data:image/svg+xml;base64,') == 3
    assert "sequenceDiagram" in page  # the alternative text
    assert '<span class="caption-text">work.yaml</span>' in read(site, "index.html")
