"""`make setup` where pip refuses: real pip, with a package index in a folder."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import pytest

from scripts import setup


class Index:
    """A package index in a folder, as `pip --index-url` reads it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, name: str, version: str, *, needs: str = "", python: str = ">=3.8") -> None:
        """Add a wheel, with what it requires."""
        package = self.folder / name
        package.mkdir(parents=True, exist_ok=True)
        wheel = package / f"{name}-{version}-py3-none-any.whl"
        metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        metadata += f"Requires-Python: {python}\n" + (f"Requires-Dist: {needs}\n" if needs else "")
        with zipfile.ZipFile(wheel, "w") as archive:
            info = f"{name}-{version}.dist-info"
            archive.writestr(f"{info}/METADATA", metadata)
            archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
            archive.writestr(f"{info}/RECORD", "")
        with (package / "index.html").open("a") as page:
            quoted = python.replace(">", "&gt;")
            page.write(f'<a href="{wheel.name}" data-requires-python="{quoted}">{wheel.name}</a>\n')


@pytest.fixture
def index(tmp_path, monkeypatch):
    """An index that pip alone uses; setup reads its pins and writes its log in a folder."""
    for name, value in (("CONSTRAINTS", "constraints.txt"), ("LOG", "setup.log")):
        monkeypatch.setattr(setup, name, tmp_path / value)
    monkeypatch.setattr(setup, "ROOT", tmp_path)
    monkeypatch.setattr(setup, "PYTHON", Path(sys.executable))
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.setenv("PIP_INDEX_URL", (tmp_path / "index").as_uri())
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    monkeypatch.delenv("PIP_EXTRA_INDEX_URL", raising=False)
    return Index(tmp_path / "index")


def refusal(*pins: str) -> str:
    """Return the error of the step that installs `page`, with these pins."""
    setup.CONSTRAINTS.write_text("\n".join(pins) + "\n")
    with pytest.raises(setup.SetupError) as raised:
        setup.Steps().run("page", *setup.pip("install", "--dry-run", "page"))
    return str(raised.value)


def test_a_pin_that_needs_a_newer_python_is_named(index):
    """Pip, which would try all versions around that pin, is ended."""
    for version in range(1, 30):
        index.add("page", f"{version}.0", needs="sieve")
    index.add("sieve", "2.0")
    index.add("sieve", "4.0", python=">=3.99")

    refused = refusal("sieve==4.0")

    assert refused.startswith("sieve==4.0 of constraints.txt needs Python >=3.99, and this is ")
    assert "make setup PYTHON=" in refused


def test_a_pin_that_the_index_lacks_is_named(index):
    index.add("page", "1.0", needs="sieve")
    index.add("page", "2.0", needs="sieve")
    index.add("sieve", "2.0")

    assert refusal("sieve==4.0").startswith("sieve==4.0 of constraints.txt is not in the package")
