"""Entry point of the `rosrm` command.

No module is imported before Ctrl-C is handled, and every command imports its modules when it runs.
So `rosrm --help` is quick and needs no ROS. A command that needs the master first joins ROS
(`rosrm.cli.early`).
"""

from __future__ import annotations

import errno
import gc
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, NoReturn, TextIO

from rosrm.cli.process import INTERRUPTED
from rosrm.runtime.durable import NO_ROOM
from rosrm.runtime.process_end import end_now, flushed
from rosrm.wording import reason_of

#: New objects after which Python looks for cycles: more than the imports of a command create, for
#: which the default of 700 costs 10 % of a command's CPU time.
_COLLECT_AFTER: Final = 100_000
#: Modules after whose import threads of others may run.
_KEEP_THREADS: Final = ("rclpy", "rosrm.extensions.registry")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command line, by default that of this process, and exit with its code."""
    gc.set_threshold(_COLLECT_AFTER)
    _open_closed_streams()
    _leave_removed_directory()
    try:
        _run(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:
        _leave(INTERRUPTED)
    except Exception:  # noqa: BLE001 - reported as Python does, which would then wait for threads
        sys.excepthook(*sys.exc_info())
        _leave(1)


def _leave_removed_directory() -> None:
    """Change to / if the current directory was removed, where every absolute path would fail."""
    try:
        os.getcwd()  # noqa: PTH109 - pathlib is not imported yet
    except OSError as error:
        os.chdir("/")
        _say(f"rosrm: the current directory cannot be used ({reason_of(error)}); continuing in /")


def _open_closed_streams() -> None:
    """Connect closed standard streams to /dev/null, because files would get their descriptors."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)  # takes the stream's number
            os.set_inheritable(null, True)
            setattr(sys, name, os.fdopen(null, mode, encoding="utf-8"))


def _run(arguments: Sequence[str]) -> None:
    from rosrm.cli import early, parserless  # noqa: PLC0415 - see above
    from rosrm.cli.output import legible  # noqa: PLC0415 - see above

    legible.never_fail()
    try:
        early.join(early.completed_words(os.environ) or arguments, os.environ)
        command = parserless.command(arguments)
        if command is not None:
            _run_without_parser(command)
        from rosrm.cli.command_tree import app, keep_only  # noqa: PLC0415 - see above

        keep_only(arguments)
        app(arguments, prog_name="rosrm")
    except SystemExit as ended:
        early.drop()
        _leave(ended.code)
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        early.drop()
        _say(f"rosrm: {error}")
        _leave(1)
    finally:
        early.drop()


def _run_without_parser(command: Callable[[], None]) -> NoReturn:
    from rosrm.cli.output.plain import errors_reported  # noqa: PLC0415 - see above

    try:
        with errors_reported():
            command()
    except BrokenPipeError:
        sys.exit(1)
    sys.exit(0)


def _leave(code: object) -> NoReturn:
    """Exit with a code, or with 1 if the rest of the output cannot be written.

    If ROS or plugins were used, skip the normal exit: in it Fast DDS sleeps 0.1 s, and Python waits
    for threads that a plugin has left.
    """
    if code is None or isinstance(code, int):
        status = code or 0
    else:
        _say(str(code))
        status = 1
    for stream in (sys.stdout, sys.stderr):
        status = status if _flush(stream, status) else status or 1
    if not sys.modules.keys().isdisjoint(_KEEP_THREADS):
        end_now(status)
    sys.exit(status)


def _flush(stream: TextIO, status: int) -> bool:
    """Flush a standard stream; return False if it cannot be written."""
    error = flushed(stream)
    if error is not None and error.errno != errno.EPIPE and status == 0:
        _say(f"rosrm: the output cannot be written: {reason_of(error)}")
    return error is None


def _say(text: str) -> None:
    """Print a line to standard error; ignore a closed one."""
    with suppress(OSError):
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
