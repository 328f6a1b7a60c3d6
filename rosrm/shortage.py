"""Errors that tell what the machine or this process lacks now, not what a file or process is.

Code that took one of them for "it does not exist" ended a process that runs, or deleted the only
copy of a state.
"""

from __future__ import annotations

import errno
from typing import Final

#: No room for another open file, or no memory.
SHORTAGE: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM})


def raise_shortage(error: OSError) -> None:
    """Raise an error that is a shortage; any other one tells something about the file."""
    if error.errno in SHORTAGE:
        raise error
