"""Log of the supervisor's own problems: `supervisor.log`, which is its standard error."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from rosrm.wording import printable, reason_of

#: Bytes beyond which the log is emptied.
MOST_BYTES: Final = 1 << 20
#: Maximum number of lines that wait for the disk.
MOST_WAITING: Final = 100
#: Descriptor of the standard error.
_ERRORS: Final = 2


def write(text: str) -> None:
    """Write one line, with the time by this host's clock; not at once after `use_thread`.

    The reports of a full disk come here, so a line that cannot be written is counted instead. The
    next line that can be written says how many are missing.
    """
    global _missing, _why  # noqa: PLW0603 - of the one log
    if len(_waiting) >= MOST_WAITING:
        _missing += 1
        _why = "the disk did not answer"
        return
    _waiting.append((time.strftime("%Y-%m-%dT%H:%M:%S"), text))
    if len(_waiting) == 1:
        _begin(_write_waiting)


def use_thread(begin: Callable[[Callable[[], None]], object]) -> None:
    """Write all further lines in a thread that `begin` hands calls to."""
    global _begin  # noqa: PLW0603 - of the one log
    _begin = begin


_missing = 0
_why = ""
_waiting: deque[tuple[str, str]] = deque()


def _at_once(work: Callable[[], None]) -> None:
    work()


_begin: Callable[[Callable[[], None]], object] = _at_once


def _write_waiting() -> None:
    global _missing  # noqa: PLW0603 - of the one log
    while _waiting:
        when, text = _waiting[0]
        lines = f"{_missing} lines before this one are missing: {_why}\n" if _missing else ""
        if _written(printable(f"{when} {lines}{text}\n")):
            _missing = 0
            _empty_if_full()
        else:
            _missing += 1
        _waiting.popleft()


def _written(line: str) -> bool:
    """Write a line; return False if that failed."""
    global _why  # noqa: PLW0603 - as above
    try:
        # Not by `sys.stderr`, whose buffer would repeat a failed line with each further one.
        os.write(_ERRORS, line.encode(errors="backslashreplace"))
    except OSError as error:
        _why = reason_of(error)
        return False
    return True


def write_fault(text: str) -> None:
    """Write a line, and the traceback of the exception that is being handled.

    The import of the module `traceback` needs a descriptor, and there may be none left.
    """
    _, fault, trace = sys.exc_info()
    lines = [text, "Traceback (most recent call last):"]
    while trace is not None:
        code = trace.tb_frame.f_code
        lines.append(f"  {code.co_filename}:{trace.tb_lineno} in {code.co_name}")
        trace = trace.tb_next
    write("\n".join([*lines, f"{type(fault).__name__}: {fault}"]))


def _empty_if_full() -> None:
    """Truncate the log beyond its bound; a terminal or pipe has no size."""
    with contextlib.suppress(OSError, ValueError):
        if os.fstat(_ERRORS).st_size > MOST_BYTES:
            os.ftruncate(_ERRORS, 0)
