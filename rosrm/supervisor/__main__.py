"""Start of the supervisor of one host: `python -m rosrm.supervisor --state DIR`.

First stage: this process becomes a daemon with a session of its own, so that neither a terminal's
Ctrl-C nor the end of the slave reaches it. It also becomes a subreaper, by ctypes, the only way.
Then it executes the bare interpreter (`bare_interpreter.py`), which stays a subreaper and frees
this memory.

The slave runs this file by its path in an interpreter without site-packages, which starts faster
and skips the ROS wheels' bootstrapper. So this file imports the standard library only.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import sys

_PR_SET_CHILD_SUBREAPER = 36


def main() -> None:
    """Parse the command line, detach, and execute the bare interpreter."""
    parser = argparse.ArgumentParser(
        prog="python -m rosrm.supervisor",
        description="The parent of one host's processes; it outlives the slave.",
    )
    parser.add_argument("--state", required=True, metavar="DIR", help="the host's state directory")
    parser.add_argument("--log-max-bytes", type=int, default=10 << 20, help="bytes of one log file")
    parser.add_argument("--log-keep", type=int, default=2, help="older files for each instance")
    parser.add_argument("--log-instances", type=int, default=5, help="logs kept of one process")
    parser.add_argument("--log-processes", type=int, default=500, help="processes with logs kept")
    parser.add_argument("--log-keep-bytes", type=int, default=2 * 10**9, help="bytes of all logs")
    parser.add_argument("--foreground", action="store_true", help="stay a child of the caller")
    options = parser.parse_args()
    state = os.path.abspath(options.state)
    if not options.foreground:
        _detach()
    _become_subreaper()
    limits = (
        options.log_max_bytes, options.log_keep, options.log_instances, options.log_processes,
        options.log_keep_bytes,
    )  # fmt: skip
    bare = os.path.join(os.path.dirname(os.path.abspath(__file__)), "bare_interpreter.py")
    command = [sys.executable, "-I", "-S", bare, state, *(str(limit) for limit in limits)]
    os.execv(sys.executable, command)  # noqa: S606 - no shell is wanted


def _detach() -> None:
    """Continue as an orphan in a session that has no terminal and can get none."""
    if os.fork():
        os._exit(0)
    os.setsid()
    if os.fork():
        os._exit(0)
    os.chdir("/")


def _become_subreaper() -> None:
    """Adopt the orphans of this process's descendants; an exec keeps the role, a fork does not."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
        number = ctypes.get_errno()
        sys.exit(f"this kernel has no subreapers: {os.strerror(number)}")


main()
