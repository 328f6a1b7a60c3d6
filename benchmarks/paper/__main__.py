"""Measures the figures and the table of the section IV of the paper: python -m benchmarks.paper -h.

Exit status: 0 when every claim holds; 1 when one does not; 2 when something is missing or failed;
128 + signal number when a signal stopped it. Nothing of a lab is left behind.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from benchmarks.machine import say
from benchmarks.paper.labs import Failed
from benchmarks.paper.page import checked_page, update_page
from benchmarks.paper.report import FIGURES, Options, plain_report, write_report
from rosrm.errors import RosrmError
from rosrm.lab import needs
from rosrm_examples.errors import ExampleError

#: Needs no hosts: the slaves are simulated.
_WITHOUT_LAB = ("fig9",)


class Stopped(Exception):
    """A signal came.

    Attributes:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what is asked for; returns the exit status."""
    options = _parse(arguments)
    names = FIGURES if options.figure == "all" else (options.figure,)
    _raise_signals()
    try:
        if options.page is not None:
            checked_page(options.page)  # before an hour's work, not after it
        options.out.mkdir(parents=True, exist_ok=True)
        if set(names) - set(_WITHOUT_LAB):
            needs.check_rights()
        statuses = [_measured(name, options) for name in names]
        if options.page is not None:
            say(f"{options.page}: {', '.join(update_page(options.page, options.out))}")
    except Stopped as stopped:
        say(f"stopped by {stopped}")
        return 128 + stopped.number
    except (RosrmError, OSError) as error:
        say(f"benchmarks.paper: {error}")
        return 2
    return max(statuses)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper",
        description="Measures figures and table of the paper's section IV. Needs root.",
    )
    parser.add_argument("figure", choices=(*FIGURES, "all"))
    parser.add_argument("--out", required=True, type=Path, help="folder for FIGURE.json and .png")
    parser.add_argument(
        "--runs", type=int, default=3, help="of each case of Table III, interleaved (default: 3)"
    )
    parser.add_argument(
        "--drive", action="append", default=[], metavar="DRIVE",
        help="for Table III: name or path of a LiDAR drive, several times for several; else the "
        "KITTI drives 0001, 0002 and 0027 in the folder that ROSRM_KITTI names, or a simulated "
        "street",
    )  # fmt: skip
    parser.add_argument(
        "--page", type=Path, help="write what is in the folder into this page (docs/evaluation.md)"
    )
    parser.add_argument("--small", action="store_true", help="only show that it works")
    parser.add_argument(
        "--lab", default="paper", help="what the names of the labs begin with (default: paper)"
    )
    options = parser.parse_args(arguments)
    if options.runs < 1:
        parser.error(f"--runs {options.runs}: at least 1")
    return options


def _measured(name: str, options: argparse.Namespace) -> int:
    """Measure one figure, write it, and say how it went; returns its exit status."""
    module = importlib.import_module(f"benchmarks.paper.{name}")
    load, began = os.getloadavg()[0], time.monotonic()
    say(f"{name}: begins (load average {load:.2f})")
    with tempfile.TemporaryDirectory(prefix=f"rosrm-paper-{name}-") as folder:
        wanted = Options(
            Path(folder), options.runs, tuple(options.drive), options.small, options.lab
        )
        try:
            result = module.measure(wanted)
        except (Failed, RosrmError, ExampleError, TimeoutError) as error:
            say(f"{name}: failed: {error}")
            return 2
    report = plain_report(
        name, module.CLAIM, result, seconds=time.monotonic() - began, load_before=load
    )
    write_report(options.out, name, report)
    result.draw(options.out / f"{name}.png")
    for reason in result.wrong:
        say(f"{name}: against the claim: {reason}")
    say(f"{name}: {'holds' if not result.wrong else 'DOES NOT HOLD'}, {report['seconds']:.0f} s")
    print(json.dumps(report), flush=True)
    return 1 if result.wrong else 0


def _raise_signals() -> None:
    main_process = os.getpid()

    def stop(number: int, _: FrameType | None) -> None:
        if os.getpid() != main_process:  # pyroute2 forks, and ends what it forked by SIGTERM
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(one, signal.SIG_IGN)  # what is under way is cleaned up, undisturbed
        raise Stopped(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)


if __name__ == "__main__":
    sys.exit(main())
