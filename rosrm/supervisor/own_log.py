"""Log of the supervisor's own problems: `supervisor.log`, which is its standard error."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from typing import Final

from rosrm.wording import printable

#: Bytes beyond which the log is emptied.
MOST_BYTES: Final = 1 << 20


def write(text: str) -> None:
    """Write one line, with the time by this host's clock."""
    sys.stderr.write(printable(f"{time.strftime('%Y-%m-%dT%H:%M:%S')} {text}\n"))
    sys.stderr.flush()
    _empty_if_full()


def write_fault(text: str) -> None:
    """Write a line, and the traceback of the exception that is being handled."""
    import traceback  # noqa: PLC0415 - only a defect needs it

    write(f"{text}\n{traceback.format_exc()}")


def _empty_if_full() -> None:
    """Truncate the log beyond its bound; a terminal or pipe has no size."""
    with contextlib.suppress(OSError, ValueError):
        if os.fstat(sys.stderr.fileno()).st_size > MOST_BYTES:
            os.ftruncate(sys.stderr.fileno(), 0)
