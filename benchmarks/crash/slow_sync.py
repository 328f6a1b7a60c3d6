"""Run a command as on a disk whose syncs are slow: `slow_sync MILLISECONDS COMMAND...`.

An SD card takes some 20 ms for an `fsync`, an SSD for servers below 0.1 ms.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.crash.recording import compiled


def main() -> None:
    """Compile the library, and run the command with it; exit as the command does."""
    milliseconds, *command = sys.argv[1:]
    with tempfile.TemporaryDirectory(prefix="rosrm-slow-") as folder:
        library = compiled(Path(__file__).with_name("slow_sync.c"), Path(folder))
        variables = {"LD_PRELOAD": str(library), "SYNC_DELAY_MS": str(int(milliseconds))}
        done = subprocess.run(command, env={**os.environ, **variables}, check=False)
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
