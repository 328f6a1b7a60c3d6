"""An installed plugin, as far as Python sees it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def imported(tmp_path: Path, monkeypatch) -> Callable[[str], None]:
    """Return a function that installs a plugin, whose code runs when plugins are loaded."""

    def install(code: str) -> None:
        folder = tmp_path / "talker-1.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: talker\nVersion: 1\n")
        (folder / "entry_points.txt").write_text("[rosrm]\ntalker = talker\n")
        (tmp_path / "talker.py").write_text(code)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    return install
