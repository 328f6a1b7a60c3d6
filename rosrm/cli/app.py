"""Where the `rosrm` command begins.

Nothing is imported before Ctrl-C is taken care of, and every command imports what it needs when it
runs: `rosrm --help` is quick, and needs no ROS.
"""

from __future__ import annotations

import sys
import time

#: When this process began, by the monotonic clock: what is promised to be quick counts from here.
BEGUN = time.monotonic()

#: What a shell gives for a program that Ctrl-C ended.
INTERRUPTED = 130


def main() -> None:
    """Run the command line and exit with its code."""
    try:
        from rosrm.cli.commands import app  # noqa: PLC0415 - see above

        app(prog_name="rosrm")
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
