"""The process of one command: when it began, and its exit code after Ctrl-C."""

from __future__ import annotations

import time
from typing import Final

#: When this process began, by the monotonic clock: time-outs of a command count from here.
BEGUN: Final = time.monotonic()

#: What a shell gives for a program that Ctrl-C ended.
INTERRUPTED: Final = 130
