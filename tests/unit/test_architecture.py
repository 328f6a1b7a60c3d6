"""Checks of `make lint` as tests: import contracts, style and types."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOLS = Path(sys.executable).parent

COMMANDS = {
    "contracts": ["lint-imports"],
    "style": ["ruff", "check", "--quiet", "--output-format=concise"],
    "format": ["ruff", "format", "--check", "--quiet"],
    "types": ["mypy", "--no-error-summary"],
}


@pytest.mark.parametrize("what", COMMANDS)
@pytest.mark.timeout(300)
def test_repository_keeps(what: str) -> None:
    if what == "types" and sys.version_info < (3, 11):
        pytest.skip(
            "Python 3.10 has no newer numpy than 2.2, whose types are not those checked with"
        )
    tool, *arguments = COMMANDS[what]

    run = subprocess.run(
        [TOOLS / tool, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )

    if run.returncode != 0:
        pytest.fail(f"{' '.join(COMMANDS[what])}\n{run.stdout}{run.stderr}", pytrace=False)
