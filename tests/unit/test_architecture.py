"""The architecture's contracts, the style and the types, as tests: what `make lint` runs."""

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
    tool, *arguments = COMMANDS[what]

    run = subprocess.run(
        [TOOLS / tool, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )

    if run.returncode != 0:
        pytest.fail(f"{' '.join(COMMANDS[what])}\n{run.stdout}{run.stderr}", pytrace=False)
