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

from rosrm.errors import ConfigError
from rosrm.runtime import durable
from rosrm.wording import reason_of

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
        with contextlib.suppress(OSError):
            durable.replace_durably(str(directory / _NOTE), f"{_machine()} {name}\n".encode())
    if not kept or kept != host or kept == name:
        return ""
    return (
        f"this machine is named {name!r} now; its host keeps its first name {host!r}, to which its "
        f"processes belong. To change that, stop them, and give the host a file with `host: {name}`"
    )


def _kept(directory: Path) -> str:
    words = _text_of(directory / _NOTE).split()
    return words[1] if len(words) == 2 and words[0] == _machine() else ""


def _machine() -> str:
    return _text_of(_MACHINE_ID).strip() or "-"


def _text_of(path: Path) -> str:
    """Return the text of a file; "": this user has no such file.

    Raises:
        ConfigError: it cannot be read now. The present name would be another host.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError, PermissionError, UnicodeDecodeError):
        return ""
    except OSError as error:
        raise ConfigError(
            f"{path}, which has the name of this host, cannot be read: {reason_of(error)}. Try "
            f"again, or write `host: NAME` into host.yaml"
        ) from None
