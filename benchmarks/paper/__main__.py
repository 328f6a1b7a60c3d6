"""Measurement of the paper's figures and table (section IV): `python -m benchmarks.paper -h`.

Exit status: 0 when every claim holds; 1 when one does not; 2 when something is missing or failed;
128 + signal number when a signal stopped it. The labs are removed. A figure that failed leaves its
folder with settings, logs and records, and the other figures are measured nevertheless.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from benchmarks.machine import say
from benchmarks.paper.labs import Failed
from benchmarks.paper.page import checked_page, update_page
from benchmarks.paper.repeated import combined
from benchmarks.paper.report import (
    FIGURES,
    REPEATED,
    Options,
    Result,
    plain_report,
    write_report,
)
from benchmarks.stopping import Stopped, own_keys, raise_signals
from rosrm.errors import RosrmError
from rosrm_examples.errors import ExampleError
from rosrm_lab import needs
from rosrm_report.writing import read_report, write_page

#: These need no hosts: the slaves are simulated, or share the machine with budgets.
_WITHOUT_LAB = ("fig9", "fig11")
#: Exit status where nothing was measured.
_FAILED = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the figures that the arguments name; return the exit status."""
    options = _parse(arguments)
    names = FIGURES if options.figure == "all" else (options.figure,)
    raise_signals()
    try:
        if options.page is not None:
            checked_page(options.page)  # before an hour's work, not after it
        options.out.mkdir(parents=True, exist_ok=True)
        if set(names) - set(_WITHOUT_LAB):
            needs.check_rights()
            needs.check_commands(needs.FROM_THE_START)
        with own_keys():
            statuses = {name: _measured(name, options) for name in names}
        if options.page is not None:
            measured = [name for name, status in statuses.items() if status != _FAILED]
            update_page(options.page, options.out, measured)
            say(f"{options.page}: {', '.join(measured) or 'nothing'} written")
    except Stopped as stopped:
        say(f"stopped by {stopped}")
        return 128 + stopped.number
    except (RosrmError, OSError) as error:
        say(f"benchmarks.paper: {error}")
        return _FAILED
    return max(statuses.values())


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper",
        description="Measures figures and table of the paper's section IV. Needs root.",
    )
    parser.add_argument("figure", choices=(*FIGURES, "all"))
    parser.add_argument("--out", required=True, type=Path, help="folder for FIGURE.json and .png")
    parser.add_argument(
        "--runs",
        type=int,
        default=3,
        help="number of runs of each figure, and of each case of Table III (default: 3)",
    )
    parser.add_argument(
        "--drive", action="append", default=[], metavar="DRIVE",
        help="for Table III: name or path of a LiDAR drive, several times for several; else the "
        "KITTI drives 0001, 0002 and 0027 in the folder that ROSRM_KITTI names (without it: in "
        "../shared/data/kitti beside the repository), or a simulated street. Fig. 11 plays the "
        "first one",
    )  # fmt: skip
    parser.add_argument(
        "--page", type=Path, help="write what was measured into this page (docs/evaluation.md)"
    )
    parser.add_argument("--small", action="store_true", help="only show that it works")
    parser.add_argument(
        "--lab", default="paper", help="what the names of the labs begin with (default: paper)"
    )
    options = parser.parse_args(arguments)
    if options.runs < 1:
        parser.error(f"--runs {options.runs}: at least 1")
    if options.small and options.page is not None:
        parser.error("--page: --small measures nothing worth writing there; leave one of them out")
    return options


def _measured(name: str, options: argparse.Namespace) -> int:
    """Measure one figure, write it, and report the outcome; return its exit status."""
    results = [options.out / f"{name}{suffix}" for suffix in (".json", ".png", ".html")]
    for old in results:  # a failed measurement must not leave the results of an earlier one
        old.unlink(missing_ok=True)
    load = os.getloadavg()[0]
    say(f"{name}: begins (load average {load:.2f})")
    folder = Path(tempfile.mkdtemp(prefix=f"rosrm-paper-{name}-"))
    try:
        report = _report(name, options, folder, load)
    except (Failed, RosrmError, ExampleError, subprocess.SubprocessError, OSError) as error:
        say(f"{name}: failed: {error}")
        say(f"{name}: settings, logs and records are kept in {folder}")
        return _FAILED
    except BaseException:  # Ctrl-C or a bug: the folder is of no use
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)
    wrong = report["against_it"]
    for reason in wrong:
        say(f"{name}: against the claim: {reason}")
    say(f"{name}: {'holds' if not wrong else 'DOES NOT HOLD'}, {report['seconds']:.0f} s")
    print(json.dumps(report), flush=True)
    return 1 if wrong else 0


def _report(name: str, options: argparse.Namespace, folder: Path, load: float) -> dict[str, Any]:
    """Measure one figure; write numbers, picture and report of its run; return the numbers."""
    module, began = importlib.import_module(f"benchmarks.paper.{name}"), time.monotonic()
    wanted = Options(folder, options.runs, tuple(options.drive), options.small, options.lab)
    result = _result(name, module, wanted)
    report = plain_report(
        name, module.CLAIM, result, small=options.small, seconds=time.monotonic() - began,
        load_before=load,
    )  # fmt: skip
    result.draw(options.out / f"{name}.png")
    if result.source is not None:
        write_page(
            read_report(result.source, f"{name}: {module.CLAIM}"), options.out / f"{name}.html"
        )
    write_report(options.out, name, report)
    return report


def _result(name: str, module: ModuleType, options: Options) -> Result:
    """Measure a figure as often as the options say; a small one, and Table III, only once.

    Table III repeats its cases itself, interleaved.
    """
    if name not in REPEATED or options.small:
        result: Result = module.measure(options)
        return result
    results = []
    for number in range(1, options.runs + 1):
        say(f"{name}: run {number} of {options.runs}")
        folder = options.folder / f"run{number}"
        folder.mkdir()
        results.append(module.measure(replace(options, folder=folder)))
    return combined(results, module.SPREAD)


if __name__ == "__main__":
    sys.exit(main())
