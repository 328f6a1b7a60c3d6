"""Where the `rosrm` command begins.

Nothing is imported before Ctrl-C is taken care of, and every command imports what it needs when it
runs: `rosrm --help` is quick, and needs no ROS. A command that asks the master joins ROS first of
all (`rosrm.cli.early`).
"""

from __future__ import annotations

import os
import sys
import time

#: When this process began, by the monotonic clock: what is promised to be quick counts from here.
BEGUN = time.monotonic()

#: What a shell gives for a program that Ctrl-C ended.
INTERRUPTED = 130


def main() -> None:
    """Run the command line and exit with its code."""
    try:
        _run()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _run() -> None:
    from rosrm.cli import early  # noqa: PLC0415 - see above

    try:
        early.join(sys.argv[1:], os.environ)
        from rosrm.cli.commands import app  # noqa: PLC0415 - see above

        app(prog_name="rosrm")
    except SystemExit as ended:
        early.drop()
        _leave(ended.code)
        raise
    finally:
        early.drop()


def _leave(code: object) -> None:
    """End the process at once where ROS was used: Fast DDS sleeps 0.1 s at a normal exit."""
    if "rclpy" in sys.modules and (code is None or isinstance(code, int)):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code or 0)
