"""Fresh virtual environments on top of the running one, for the installation of plugins by pip.

A fresh environment, so that a test's installation affects nothing else. The environment is not
empty, so that it is quick and needs no network: a `.pth` file adds the folders of the running
Python. pip and the build backend are therefore those of the running Python, too, and pip downloads
nothing.
"""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
import sysconfig
import venv
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: A user's `pip install`, without downloads and without build isolation.
PIP = """#!/bin/sh
action="$1"; shift
[ "$action" = install ] && set -- --no-deps --no-build-isolation --no-index "$@"
exec "{python}" -m pip "$action" --disable-pip-version-check "$@"
"""
ROSRM = """#!/bin/sh
exec "{python}" -m rosrm.cli "$@"
"""


@dataclass(frozen=True)
class Environment:
    """A virtual environment and a working folder.

    Attributes:
        more: environment variables beside those of the test.
    """

    bin: Path
    folder: Path
    more: dict[str, str] = field(default_factory=dict)

    def variables(self) -> dict[str, str]:
        """Return the environment variables of a shell with this environment activated."""
        surroundings = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith(("PIP_", "ROSRM_", "VIRTUAL_ENV"))
        }
        return {
            **surroundings,
            "PATH": f"{self.bin}:{surroundings.get('PATH', '')}",
            "PYTHONDONTWRITEBYTECODE": "1",
            "NO_COLOR": "1",
            "PIP_ROOT_USER_ACTION": "ignore",
            **self.more,
        }

    def shell(self, command: str, folder: Path | None = None) -> subprocess.CompletedProcess:
        """Run a line as a user with this environment activated would."""
        return subprocess.run(
            ["bash", "-c", f"set -o pipefail; {command}"],
            cwd=folder or self.folder,
            env=self.variables(),
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )

    def python(self, code: str) -> str:
        """Run Python code in this environment and return its output."""
        done = subprocess.run(
            [self.bin / "python", "-c", code],
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout


def pip_environment(tmp_path: Path) -> Environment:
    """Return a fresh environment in a folder of a test."""
    needed = ("pip", "setuptools", "rosrm-scoring", "rosrm-migration")
    absent = [name for name in needed if not _installed(name)]
    if absent:
        pytest.skip(f"not installed: {', '.join(absent)}; `make setup` does it")
    place = tmp_path / "environment"
    venv.create(place, with_pip=False)
    home = place / "bin"
    site = Path(sysconfig.get_path("purelib", vars={"base": str(place), "platbase": str(place)}))
    shown = [str(ROOT), *(path for path in sys.path if _is_shown(path))]
    (site / "shown.pth").write_text("\n".join(shown), encoding="utf-8")
    for name, script in (("pip", PIP), ("rosrm", ROSRM)):
        (home / name).write_text(script.format(python=home / "python"), encoding="utf-8")
        (home / name).chmod(0o755)
    folder = tmp_path / "work"
    folder.mkdir()
    return Environment(home, folder)


def _is_shown(path: str) -> bool:
    """Return True for folders outside the standard library, which each environment has."""
    standard = sysconfig.get_path("stdlib")
    return Path(path).is_dir() and path not in (standard, f"{standard}/lib-dynload")


def _installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
