"""Start time of the command's process, and its exit code after Ctrl-C."""

from __future__ import annotations

from typing import Final

from rosrm import clocks

#: Monotonic start time of this process, from which the time-outs of a command count.
BEGUN: Final = clocks.boot_time()

#: Exit code of a program that Ctrl-C has ended, as in a shell.
INTERRUPTED: Final = 130
