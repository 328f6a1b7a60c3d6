"""The portable counter with a reason against migration, by its first argument.

`pipe`: the process holds a pipe whose other end belongs to an outside process. `hangs FILE`: a
callback does not return while this file exists.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from rosrm_criu.node import run_portable
from rosrm_examples.portable_counter import PortableCounter


class Troubled(PortableCounter):
    def __init__(self) -> None:
        super().__init__(mb=1.0, period=0.02)
        if sys.argv[1] == "pipe":  # the shell ends, so the supervisor is the parent of `cat`
            shell = ["sh", "-c", "exec 3<&0; cat <&3 >/dev/null &"]
            self.child = subprocess.Popen(shell, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
            self.child.wait()

    def tick(self) -> None:
        while sys.argv[1] == "hangs" and Path(sys.argv[2]).exists():
            time.sleep(0.01)
        super().tick()


if __name__ == "__main__":
    run_portable(Troubled)
