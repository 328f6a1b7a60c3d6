"""A directory with files of all kinds that an artifact may have."""

from __future__ import annotations

import pytest


@pytest.fixture
def source(tmp_path):
    """Return a directory with a program, a data file and a link between them."""
    source = tmp_path / "source"
    (source / "lib").mkdir(parents=True)
    (source / "run.sh").write_text("#!/bin/sh\n")
    (source / "run.sh").chmod(0o754)
    (source / "lib" / "data.bin").write_bytes(bytes(range(256)) * 3000)
    (source / "lib" / "newest").symlink_to("data.bin")
    return source
