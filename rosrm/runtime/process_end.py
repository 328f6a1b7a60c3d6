"""The end of a process that has run code of plugins, which may have left what never ends."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Final, NoReturn, TextIO

#: Seconds for the ends of threads and workers of plugins, after the part itself has ended.
_LAST_SECONDS: Final = 3.0


def end_process(code: int) -> NoReturn:
    """End this process with an exit code, also if a plugin has left threads that do not end.

    Python waits for threads and workers, so that they may finish; they get a few seconds.
    """
    import threading  # noqa: PLC0415 - not for the commands of `rosrm`, of which most need it not

    for stream in (sys.stdout, sys.stderr):
        flushed(stream)
    timer = threading.Timer(_LAST_SECONDS, end_now, [code])
    timer.daemon = True
    timer.start()
    sys.exit(code)


def flushed(stream: TextIO) -> OSError | None:
    """Flush a standard stream; return the fault of one that cannot be written, as its terminal.

    What it still holds goes to /dev/null. Otherwise Python would try again at the end, and exit
    with 120.
    """
    try:
        stream.flush()
    except OSError as error:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
        return error
    return None


def end_now(code: int) -> NoReturn:
    """End the workers that a plugin has left, and this process, which waits for no thread."""
    workers = getattr(sys.modules.get("multiprocessing.process"), "_children", ())
    for worker in list(workers):
        with contextlib.suppress(Exception):
            worker.kill()
    for stream in (sys.stderr, sys.stdout):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(code)
