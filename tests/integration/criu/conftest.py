"""Fixtures of the CRIU tests: CRIU, older versions of it, and a user without rights."""

from __future__ import annotations

import fcntl
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rosrm.errors import CriuError
from rosrm_criu.engine.binary import CriuBinary, default_prefix, find, opened
from rosrm_criu.engine.probe import probe

ROOT = Path(__file__).parents[3]
#: Older versions are downloaded once, into the virtual environment.
OLDER = ROOT / ".venv" / "criu-older"

#: Installs CRIU in a folder.
SCRIPT = ROOT / "scripts" / "install_criu.sh"

#: Uid of a user who owns nothing.
NOBODY = 65534


def install_criu(folder: Path, **environment: object) -> subprocess.CompletedProcess:
    """Run the script that installs CRIU in a folder."""
    variables = {**os.environ, **{name: str(value) for name, value in environment.items()}}
    return subprocess.run(
        [SCRIPT, folder], env=variables, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="session")
def criu() -> CriuBinary:
    """Return the working CRIU that `make setup` installs."""
    try:
        found = find()
    except CriuError as error:
        pytest.skip(str(error))
    able = probe(found)
    if not able.works:
        pytest.skip(able.reason)
    return found


@pytest.fixture(scope="session")
def cached() -> Path:
    """Return the package files of the CRIU that `make setup` installs."""
    folder = default_prefix() / "packages"
    if not any(folder.glob("*.deb")):
        pytest.skip(f"no packages of CRIU in {folder}: `make setup` had none to fetch")
    return folder


@pytest.fixture(scope="session")
def old() -> Callable[[str], CriuBinary]:
    """Return a function for a Debian release's own CRIU: Debian 12 has 3.17, Debian 13 has 4.1."""

    def of(suite: str) -> CriuBinary:
        if platform.freedesktop_os_release()["ID"] != "debian":
            pytest.skip(f"only Debian has the release {suite}")
        OLDER.mkdir(parents=True, exist_ok=True)
        with (OLDER / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another worker may be downloading it
            done = install_criu(OLDER / suite, SUITE=suite)
        if done.returncode:
            pytest.skip(f"no CRIU of {suite}: {done.stderr}")
        return opened(OLDER / suite / "bin/criu")

    return of


@pytest.fixture
def public() -> Iterator[Path]:
    """Yield a folder in which every user may write."""
    with tempfile.TemporaryDirectory(prefix="rosrm-test-") as folder:
        Path(folder).chmod(0o777)
        yield Path(folder)


@pytest.fixture(scope="session")
def as_nobody() -> Callable[..., subprocess.CompletedProcess]:
    """Return a function that runs `python ...` as a user without rights or installed packages."""
    if os.geteuid() != 0:
        pytest.skip("only root may act as another user")
    user = {"user": NOBODY, "group": NOBODY, "extra_groups": [], "cwd": "/"}
    # Other users may be unable to read the interpreter of the virtual environment.
    seen = subprocess.run(
        ["/usr/bin/env", "-i", sys.executable, "-c", "import rosrm_criu.engine.probe"],
        capture_output=True,
        check=False,
        **user,
    )
    python = sys.executable if seen.returncode == 0 else shutil.which("python3", path="/usr/bin")
    code = "import sys; assert sys.version_info >= (3, 10); import rosrm_criu.engine.probe"
    path = f"{ROOT}:{ROOT / 'plugins/criu'}"
    variables = {"PYTHONPATH": path}
    if (
        python is None
        or subprocess.run([python, "-c", code], env=variables, check=False, **user).returncode
    ):
        pytest.skip("no Python and rosrm that every user can read")

    def run(*words: object, home: Path, **environment: object):
        variables = {"PYTHONPATH": path, "PATH": "/usr/bin:/bin", "HOME": home, "TMPDIR": home}
        variables |= {"PYTHONDONTWRITEBYTECODE": 1, **environment}
        return subprocess.run(
            [python, *map(str, words)],
            env={name: str(value) for name, value in variables.items()},
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
            **user,
        )

    return run
