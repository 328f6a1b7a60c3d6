"""The end of a process that has run code of plugins, which may have left what never ends."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from typing import Final, NoReturn

#: Seconds for the ends of threads and workers of plugins, after the part itself has ended.
_LAST_SECONDS: Final = 3.0


def end_process(code: int) -> NoReturn:
    """End this process with an exit code, also if a plugin has left threads that do not end.

    Python waits for threads and workers, so that they may finish; they get a few seconds.
    """
    timer = threading.Timer(_LAST_SECONDS, end_now, [code])
    timer.daemon = True
    timer.start()
    sys.exit(code)


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
