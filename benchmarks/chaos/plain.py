"""Plain programs of the workload, and the lines that the whole workload writes.

Run by its path, with the standard library alone. `service`: writes "active" ten times a second
until it is stopped. `tree`: the same, with a child that only waits. `job SECONDS`: writes
"active" for so long, then "done".
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time

#: Hz.
RATE = 10.0


class Lines:
    """The file of this process; its lines survive the end of the process.

    A line: monotonic time, instance, host, pid, time of birth, version, word, number. The
    monotonic clock is the same on all hosts of a lab. A faulty version ends before its first line.
    """

    def __init__(self) -> None:
        if "CHAOS_FAULTY" in os.environ:
            sys.exit(3)
        path = os.path.join(os.environ["CHAOS_LINES"], os.environ["ROSRM_PROCESS"])  # noqa: PTH118
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        instance, born = os.environ["ROSRM_INSTANCE"], time.monotonic()
        version = os.environ.get("CHAOS_VERSION", "0")
        self._head = f"{instance} {socket.gethostname()} {os.getpid()} {born:.4f} {version}"
        self.write("born")

    def write(self, word: str, number: int = 0) -> None:
        """Write one line, in one system call."""
        os.write(self._file, f"{time.monotonic():.4f} {self._head} {word} {number}\n".encode())


class Stopped(Exception):
    """SIGINT or SIGTERM came."""


def stop(number: int, _: object) -> None:
    raise Stopped(number)


def serve(lines: Lines, seconds: float) -> None:
    """Write "active" at `RATE` for so many seconds."""
    begun, count = time.monotonic(), 0
    while time.monotonic() < begun + seconds:
        count += 1
        lines.write("active", count)
        time.sleep(max(0.0, begun + count / RATE - time.monotonic()))


def have_child() -> None:
    """Fork a child that waits for a signal, and does not notice its parent's end."""
    if os.fork() == 0:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        while True:
            signal.pause()


def main() -> None:
    kind = sys.argv[1]
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    lines = Lines()
    try:
        if kind == "tree":
            have_child()
        serve(lines, float(sys.argv[2]) if kind == "job" else float("inf"))
        lines.write("done")
    except Stopped:
        lines.write("stopped")


if __name__ == "__main__":
    main()
