"""The last lines of a log, for error texts."""

from __future__ import annotations

import os
from typing import Final

from rosrm.wording import reason_of

#: Bytes at the end of a log that are read.
_MOST: Final = 1 << 16


def last_lines(path: str | os.PathLike[str]) -> list[str]:
    """Return the lines at the end of a log; a log that cannot be read has one with the reason.

    Bytes that are no UTF-8 are replaced, so that no log hides the error that names it.
    """
    try:
        with open(path, "rb") as file:  # noqa: PTH123 - the supervisor has no pathlib
            file.seek(max(0, file.seek(0, os.SEEK_END) - _MOST))
            return file.read(_MOST).decode(errors="replace").splitlines()
    except OSError as error:
        return [f"(the log cannot be read: {reason_of(error)})"]
