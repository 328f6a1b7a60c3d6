"""Log of the supervisor's own problems: `supervisor.log`, which is its standard error."""

from __future__ import annotations

import sys
import time


def write(text: str) -> None:
    """Write one line, with the time by this host's clock."""
    sys.stderr.write(f"{time.strftime('%Y-%m-%dT%H:%M:%S')} {text}\n")
    sys.stderr.flush()
