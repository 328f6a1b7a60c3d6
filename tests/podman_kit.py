"""A podman with storage of its own, and an image made of the static busybox of this machine."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import pytest

from tests.programs import path_of, require

ROOT = Path(__file__).parents[1]
IMAGE = "localhost/busybox:test"
#: Link that is in the image and not on the host, and those to the libraries of the host.
_LINKS = {"in-image": "bin", "lib": "usr/lib", "lib64": "usr/lib64"}
#: Directories of the host that every container sees, for the Python of the tests with its packages.
_FOR_PYTHON = sorted({"/usr", "/etc", sys.base_prefix, sys.prefix, str(ROOT)})
_TOOLS = ("sh", "sleep", "cat", "echo", "env", "touch", "kill")


def ask(*arguments: str) -> str:
    """Return what podman prints; fails the test if podman fails."""
    command = ["podman", *arguments]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert answer.returncode == 0, f"{command}: {answer.stderr}"
    return answer.stdout


def listed() -> list[str]:
    """Return the names of all containers."""
    return ask("ps", "--all", "--format={{.Names}}").split()


@pytest.fixture(scope="module")
def podman():
    """Give podman a storage of its own, with the image IMAGE.

    Below a long path, podman does not notice the end of a container for 20 s.
    """
    require("podman", "busybox")
    busybox = path_of("busybox")
    with (
        tempfile.TemporaryDirectory(prefix="podman-", ignore_cleanup_errors=True) as short,
        pytest.MonkeyPatch.context() as monkeypatch,
    ):
        folder = Path(short)
        _configure(folder, monkeypatch)
        _pack_image(folder / "root.tar", busybox)
        _try("import", str(folder / "root.tar"), IMAGE)
        _try(
            "run",
            "--rm",
            "--pull=never",
            "--network=host",
            "--init",
            "--cgroups=disabled",
            IMAGE,
            "echo",
            "it runs",
        )
        yield
        for words in (["rm", "--all", "--force", "--time=0"], ["rmi", "--all", "--force"]):
            subprocess.run(["podman", *words], check=False, timeout=60, stdout=subprocess.DEVNULL)


def _try(*arguments: str) -> None:
    """Skip the test with the reason if podman does not work here."""
    command = ["podman", *arguments]
    tried = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if tried.returncode != 0:
        pytest.skip(f"podman does not work here: {tried.stderr.strip()[-300:]}")


def _configure(folder: Path, monkeypatch) -> None:
    storage, settings = folder / "storage.conf", folder / "containers.conf"
    storage.write_text(
        f'[storage]\ndriver = "vfs"\ngraphroot = "{folder}/graph"\nrunroot = "{folder}/run"\n'
    )
    settings.write_text(
        '[engine]\nevents_logger = "none"\ncgroup_manager = "cgroupfs"\n'
        f'tmp_dir = "{folder}/libpod"\nlock_type = "file"\n'
        # Without CAP_SYS_RESOURCE even root cannot raise the limits to podman's defaults.
        '[containers]\ndefault_ulimits = ["nofile=1024:4096", "nproc=4096:4096"]\n'
        f"volumes = {json.dumps([f'{one}:{one}:ro' for one in _FOR_PYTHON])}\n"
    )
    monkeypatch.setenv("CONTAINERS_STORAGE_CONF", str(storage))
    monkeypatch.setenv("CONTAINERS_CONF", str(settings))
    if _mixes_cgroups():
        _hide_cgroups(folder, monkeypatch)


def _mixes_cgroups() -> bool:
    """Return True if control groups of both versions have controllers, which crun refuses."""
    unified = Path("/sys/fs/cgroup/unified/cgroup.controllers")
    return unified.exists() and bool(unified.read_text().strip())


def _hide_cgroups(folder: Path, monkeypatch) -> None:
    """Put a podman first on the PATH that sees no control groups; its processes are in them."""
    inner, outer = folder / "podman.sh", folder / "bin" / "podman"
    inner.write_text(f'mount -t tmpfs none /sys/fs/cgroup; exec {shutil.which("podman")} "$@"\n')
    outer.parent.mkdir()
    outer.write_text(f'#!/bin/sh\nexec unshare --mount sh {inner} "$@"\n')
    outer.chmod(0o755)
    monkeypatch.setenv("PATH", f"{outer.parent}:{os.environ['PATH']}")


def _pack_image(archive: Path, busybox: str) -> None:
    links = {**{f"bin/{tool}": "busybox" for tool in _TOOLS}, **_LINKS}
    with tarfile.open(archive, "w") as tar:
        tar.add(os.path.realpath(busybox), "bin/busybox")
        for name, target in links.items():
            link = tarfile.TarInfo(name)
            link.type, link.linkname = tarfile.SYMTYPE, target
            tar.addfile(link)
