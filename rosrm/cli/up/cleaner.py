"""Program that ends and removes what a killed `rosrm up` has left of its cluster.

`rosrm up` starts it with a pipe as standard input: `python -I -S cleaner.py DIRECTORY`. The pipe is
closed when `rosrm up` has ended, whatever the cause. Master and slaves end with their parent. The
program waits for them, stops supervisors that a killed slave has left, and removes the directory,
unless the pipe had the word `KEEP`. It imports the standard library only, to stay small.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

#: Seconds for the parts of the cluster to end, and between two looks.
PATIENCE = 30.0
_LOOK = 0.02
#: Word in the pipe with which the directory stays.
KEEP = b"keep"


def main() -> None:
    """Wait for the end of `rosrm up`, and clean up."""
    directory = Path(sys.argv[1])
    is_kept = KEEP in sys.stdin.buffer.read()
    _wait_until_free(directory.glob("hosts/*/slave.lock"))
    stop_supervisors(directory)
    _wait_until_free(directory.glob("master/master.lock"))
    if not is_kept:
        shutil.rmtree(directory, ignore_errors=True)


def stop_supervisors(directory: Path) -> None:
    """Stop the supervisors of all hosts with their processes, and wait for their ends.

    A supervisor waits for its processes, and a process that waits for a dead disk never ends. So
    the supervisor is killed after a while.
    """
    for number in (signal.SIGTERM, signal.SIGKILL):
        locks = list(directory.glob("hosts/*/supervisor/supervisor.lock"))
        for lock in locks:
            with suppress(OSError, ValueError):  # it has ended, or has not written its pid yet
                if not _is_free(lock):
                    os.kill(int(lock.read_text()), number)  # noqa: TID251 - it imports no rosrm
        if _wait_until_free(locks):
            return


def _is_free(lock: Path) -> bool:
    """Return True if no process holds a lock."""
    with lock.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def _wait_until_free(locks: Iterable[Path]) -> bool:
    """Wait until no process holds any of the locks; return False after `PATIENCE`."""
    held, looks = list(locks), int(PATIENCE / _LOOK)
    for _ in range(looks):
        held = [lock for lock in held if not _is_free(lock)]
        if not held:
            return True
        time.sleep(_LOOK)
    return False


if __name__ == "__main__":
    main()
