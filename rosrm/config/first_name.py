"""Name of a host whose file does not name it: the first name of its machine.

A machine may be renamed while its processes run, by DHCP or by a user. They belong to the host of
the first name, so the host keeps that name, with its state. A copy of the disk in another machine
has another machine id, and takes its own name.
"""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path
from typing import Final

from rosrm.runtime.private_files import open_private

_NOTE: Final = ".host"
_MACHINE_ID: Final = Path("/etc/machine-id")


def default_states() -> Path:
    """Return the directory of the default state directories of this user."""
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "rosrm"


def default_host() -> str:
    """Return the name of a host with neither a name nor a state directory in its file."""
    return first_name(default_states())


def first_name(directory: Path) -> str:
    """Return the name that is kept in a directory of this machine, else its present name."""
    return _kept(directory) or socket.gethostname()


def keep_name(directory: Path, host: str) -> str:
    """Store the name of a host in a directory; return a note for the user, "": none.

    A name that the file of the host gives is not stored, because it is not the machine's name.
    """
    name, kept = socket.gethostname(), _kept(directory)
    if not kept and host == name:
        with (
            contextlib.suppress(OSError),
            os.fdopen(
                open_private(str(directory / _NOTE), os.O_WRONLY | os.O_CREAT | os.O_TRUNC), "w"
            ) as note,
        ):
            note.write(f"{_machine()} {name}\n")
    if not kept or kept != host or kept == name:
        return ""
    return (
        f"this machine is named {name!r} now; its host keeps its first name {host!r}, to which its "
        f"processes belong. To change that, stop them, and give the host a file with `host: {name}`"
    )


def _kept(directory: Path) -> str:
    with contextlib.suppress(OSError, ValueError):
        machine, name = (directory / _NOTE).read_text(encoding="utf-8").split()
        return name if machine == _machine() else ""
    return ""


def _machine() -> str:
    with contextlib.suppress(OSError):
        return _MACHINE_ID.read_text(encoding="ascii").strip() or "-"
    return "-"
