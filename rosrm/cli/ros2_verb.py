"""`ros2 rosrm`: the commands of `rosrm` as a verb of `ros2`.

`ros2` finds the class by an entry point, and needs only the attributes below. So rosrm imports
nothing of ros2cli.
"""

from __future__ import annotations

import argparse
from typing import Any, Final

from rosrm.cli import app


class RosrmVerb:
    """Place the processes of a ROS 2 application on hosts, and keep them running."""

    NAME: Final = "rosrm"
    EXTENSION_POINT_VERSION: Final = "0.1"

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Pass all words to `rosrm`, including options such as `-h`."""
        del cli_name
        parser.prefix_chars = ""  # no word is an option of this parser
        parser.add_argument("words", nargs=argparse.REMAINDER)

    def main(self, *, parser: Any, args: Any) -> None:
        """Run a command of `rosrm` and exit with its code."""
        del parser
        app.main(args.words)
