"""Files that an instance reads: its parameters and its key, beside its log.

The content comes with the order and is in the record, so no sync has to precede a start. Each start
compares each file with its content, and writes the file if it differs, because a loss of power may
have emptied or removed it.
"""

from __future__ import annotations

import os

from rosrm.runtime import durable
from rosrm.runtime.private_files import open_private
from rosrm.supervisor.spawn_error import SpawnError
from rosrm.wording import reason_of


def provide(path: str, content: str) -> None:
    """Write a file, unless it has this content already; raises SpawnError."""
    wanted = content.encode()
    try:
        if _content(path, len(wanted)) != wanted:
            os.close(durable.replace_atomically(path, wanted))
    except OSError as error:
        fault = f"the file {path!r} cannot be written: {reason_of(error)}"
        raise SpawnError(
            fault, transient=True
        ) from None  # retried, as for a log that cannot be opened


def _content(path: str, size: int) -> bytes | None:
    """Return the content of a file of this size; None: it is missing, a link or of another size."""
    try:
        file = open_private(path, os.O_RDONLY)
    except (FileNotFoundError, PermissionError):  # PermissionError: a link
        return None
    with open(file, "rb") as opened:
        return opened.read() if os.fstat(file).st_size == size else None
