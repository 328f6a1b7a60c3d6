"""`ros2 rosrm`: the commands of `rosrm` as a verb of `ros2`.

`ros2` finds the class by an entry point, and needs only the attributes below. So rosrm imports
nothing of ros2cli.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
from typing import Any, Final

from rosrm.cli import app

#: Seconds for a completion, which gives up a silent master sooner.
_PATIENCE: Final = 5.0


class RosrmVerb:
    """Place the processes of a ROS 2 application on hosts, and keep them running."""

    NAME: Final = "rosrm"
    EXTENSION_POINT_VERSION: Final = "0.1"

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Pass all words to `rosrm`, including options such as `-h`."""
        del cli_name
        parser.prefix_chars = ""  # no word is an option of this parser
        words = parser.add_argument("words", nargs=argparse.REMAINDER)
        words.completer = complete  # type: ignore[attr-defined] # for argcomplete

    def main(self, *, parser: Any, args: Any) -> None:
        """Run a command of `rosrm` and exit with its code."""
        del parser
        app.main(args.words)


def complete(prefix: str, parsed_args: argparse.Namespace, **_others: Any) -> list[str]:
    """Return the words that may stand in place of `prefix`, as argcomplete asks for them.

    `rosrm` completes its own command line in a process of its own, as for a shell.
    """
    words = ["rosrm", *(parsed_args.words or [])]
    line = {
        "_ROSRM_COMPLETE": "complete_bash", "COMP_WORDS": shlex.join([*words, prefix]),
        "COMP_CWORD": str(len(words)),
    }  # fmt: skip
    try:
        done = subprocess.run(
            [sys.executable, "-m", "rosrm.cli"], env={**os.environ, **line}, text=True,
            stdin=subprocess.DEVNULL, capture_output=True, timeout=_PATIENCE, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return []
    return done.stdout.split()
