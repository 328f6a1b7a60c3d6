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
from collections.abc import Iterable
from contextlib import suppress
from glob import escape, glob

#: Word in the pipe with which the directory stays.
KEEP = b"keep"


def main() -> None:
    """Wait for the end of `rosrm up`, and clean up."""
    directory = sys.argv[1]
    is_kept = KEEP in sys.stdin.buffer.read()
    for lock in _locks(directory, "hosts/*/slave.lock"):
        _wait_until_free(lock)
    stop_supervisors(directory)
    for lock in _locks(directory, "master/master.lock"):
        _wait_until_free(lock)
    if not is_kept:
        shutil.rmtree(directory, ignore_errors=True)


def stop_supervisors(directory: str) -> None:
    """Stop the supervisors of all hosts with their processes, and wait for their ends."""
    locks = _locks(directory, "hosts/*/supervisor/supervisor.lock")
    for lock in locks:
        with suppress(OSError, ValueError):  # it has ended, or has not written its pid yet
            if not _is_free(lock):
                os.kill(int(_content(lock)), signal.SIGTERM)
    for lock in locks:
        _wait_until_free(lock)


def _locks(directory: str, pattern: str) -> Iterable[str]:
    return sorted(glob(os.path.join(escape(directory), pattern)))


def _content(path: str) -> str:
    with open(path, encoding="ascii") as file:
        return file.read()


def _is_free(path: str) -> bool:
    """Return True if no process holds a lock."""
    with open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def _wait_until_free(path: str) -> None:
    with suppress(FileNotFoundError), open(path, "rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH)


if __name__ == "__main__":
    main()
