"""The disks of virtual hosts: files with a file system, mounted by the host itself."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Final

from rosrm.errors import LabError
from rosrm.runtime.private_files import open_private
from rosrm_lab import needs
from rosrm_lab.plan import HostPlan
from rosrm_lab.store import make_private_folder

#: Seconds for mkfs on a sparse file.
_FORMAT: Final = 60.0


def make(image: Path, host: HostPlan) -> None:
    """Make a sparse file with an ext4 file system: no journal, no reserve, ready at once.

    Raises:
        LabError: it could not be made.
    """
    make_private_folder(image.parent)
    with os.fdopen(open_private(str(image), os.O_WRONLY | os.O_CREAT | os.O_TRUNC), "wb") as file:
        file.truncate(host.disk)
    command = [
        needs.find_command("mkfs.ext4"),
        *("-q", "-F", "-m", "0", "-O", "^has_journal"),
        *("-E", "lazy_itable_init=1,nodiscard", str(image)),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_FORMAT)
    if done.returncode:
        raise LabError(f"the disk of host {host.name} could not be made: {done.stderr.strip()}")


def used(mount: Path) -> int | None:
    """Return the bytes in use on a file system; None: it is gone."""
    try:
        status = os.statvfs(mount)
    except OSError:  # the host was switched off at this moment
        return None
    return (status.f_blocks - status.f_bfree) * status.f_frsize
