"""The demo: three hosts on this machine map a LiDAR drive while memory runs short.

    python -m rosrm_examples.demo --out out/demo

A master and three slaves come up as three hosts, each with a budget of memory. NDT SLAM processes
(ROS 2 nodes) map the pieces of a drive, placed by rosrm. Meanwhile processes that hold 8 to 80 MB
arrive one after another, until every host is at its limit and the queue waits (the paper's Fig. 6).
As they end, a recorder that cannot leave its host grows until that host is over its limit, and the
master moves others off it (the paper's Fig. 10).

Exit status: 0 when everything was done; 1 when something failed; 2 when the arguments cannot be
used; 128 + signal number (130 for Ctrl-C) when a signal stopped it.
"""

from __future__ import annotations

import os
import signal

if __name__ == "__main__":  # ends the imports below without a traceback
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

import argparse
import fcntl
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, TextIO

import psutil
from rich.console import Console

from rosrm.core.views import ProcessRow
from rosrm.errors import RosrmError
from rosrm_examples.demo_job import LEAST_BUDGET, Scenario, arrivals, budget_for, count_by_kind
from rosrm_examples.demo_plots import USAGE_FILE, draw_usage, title_of
from rosrm_examples.demo_record import EVENTS_FILE, SAMPLES_FILE, Record, summarise
from rosrm_examples.demo_run import Demo, DemoFailed, Stopped, StopSignals
from rosrm_examples.demo_screen import screen_for
from rosrm_examples.drives import Drive, default_drive, load_drive
from rosrm_examples.errors import ExampleError
from rosrm_examples.merge import join, write_map
from rosrm_examples.pieces import load_pieces
from rosrm_resources.memory import CgroupMemory

SUMMARY_FILE: Final = "summary.json"
#: What the demo leaves, in the order in which one looks at it.
LEFT: Final = (SUMMARY_FILE, USAGE_FILE, "map.png", "map.ply", EVENTS_FILE, SAMPLES_FILE)
#: Below the folder of results; a folder with this file in it is the demo's own to empty.
_CLUSTER, _PIECES, _MARK = "cluster", "pieces", ".rosrm-demo"


class Unfit(Exception):
    """The demo cannot begin with these arguments, or on this machine."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the demo; returns the exit status."""
    options = _parse(arguments)
    signals = StopSignals()
    console = Console()
    try:
        _demonstrate(options, signals, console)
    except Stopped as stopped:
        print(f"demo: stopped by {stopped}", file=sys.stderr)
        return 128 + stopped.number
    except (Unfit, ExampleError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 2
    except DemoFailed as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except (RosrmError, TimeoutError, OSError) as error:
        print(f"demo: {error}; see the logs in {options.out / _CLUSTER}", file=sys.stderr)
        return 1
    return 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m rosrm_examples.demo",
        description="Three hosts on this machine map a LiDAR drive while memory runs short.",
    )
    parser.add_argument("--out", required=True, type=Path, help="folder to write to")
    parser.add_argument(
        "--drive", help="name or path of the drive; else KITTI 0001 where it is, else the street"
    )
    parser.add_argument("--pieces", type=int, default=9, help="number of pieces (default: 9)")
    parser.add_argument(  # with this default every host comes close to its limit
        "--seed", type=int, default=328, help="of the holders' sizes (default: 328)"
    )
    parser.add_argument(
        "--pace", type=_pace, default=1.0, help="0.5 to 4 times as fast as usual (default: 1)"
    )
    return parser.parse_args(arguments)


def _pace(text: str) -> float:
    pace = float(text)
    if not 0.5 <= pace <= 4:
        raise argparse.ArgumentTypeError(f"{text} is not within 0.5 to 4")
    return pace


def _demonstrate(options: argparse.Namespace, signals: StopSignals, console: Console) -> None:
    drive = load_drive(options.drive) if options.drive else default_drive()
    drive.piece(1, options.pieces)  # raises where it cannot be cut so
    scenario = Scenario(
        drive.name, len(drive), options.pieces, options.seed, options.pace, _budget()
    )
    out: Path = options.out
    with _own_folder(out):
        console.print(_opening(scenario), highlight=False, soft_wrap=True)
        demo = Demo(scenario, out / _CLUSTER, screen_for(console), signals)
        processes = demo.carry_out(arrivals(scenario, (out / _PIECES).absolute(), Path.cwd()))
        signals.check()
        summary = _write_results(out, drive, demo.record, processes)
    console.print(_closing(summary, processes, out), highlight=False, soft_wrap=True)


# --- the folder of results ---------------------------------------------------------------------


def _own_folder(out: Path) -> TextIO:
    """Empties the folder of an earlier demo; the file that is returned keeps a second demo out.

    Raises:
        Unfit: the folder is not of a demo, or another demo writes to it.
    """
    out.mkdir(parents=True, exist_ok=True)
    mark = out / _MARK
    if not mark.exists() and any(out.iterdir()):
        raise Unfit(f"--out {out}: holds files that are of no demo; name a new or empty folder")
    lock = mark.open("a")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise Unfit(f"--out {out}: another demo is writing to it") from None
    for folder in (_CLUSTER, _PIECES):
        shutil.rmtree(out / folder, ignore_errors=True)
    for name in (*LEFT, "trajectory.npz"):
        (out / name).unlink(missing_ok=True)
    return lock


def _write_results(
    out: Path, drive: Drive, record: Record, processes: Sequence[ProcessRow]
) -> dict[str, Any]:
    """Writes everything that the demo leaves; returns the summary."""
    record.write(out)
    figures = write_map(join(load_pieces(out / _PIECES)), drive, out)
    draw_usage(out / USAGE_FILE, record, title_of(record))
    summary = summarise(record, processes, {"drive": drive.name, **figures})
    (out / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n")
    return summary


# --- memory ------------------------------------------------------------------------------------


def _budget() -> int:
    """The memory of each host, bytes; less than usual where this machine has little.

    Raises:
        Unfit: too little for the demo.
    """
    free = float(psutil.virtual_memory().available)
    group = CgroupMemory.find()
    if group is not None:
        free = min(free, group.capacity * (1.0 - group.usage()))
        group.close()
    budget = budget_for(free)
    if budget < LEAST_BUDGET:
        raise Unfit(
            f"{free / 2**20:.0f} MiB of memory are free here; three hosts of "
            f"{LEAST_BUDGET / 2**20:.0f} MiB and what runs beside need {LEAST_BUDGET / 2**18:.0f}"
        )
    return budget


# --- words -------------------------------------------------------------------------------------


def _opening(scenario: Scenario) -> str:
    return (
        f"rosrm demo: {scenario.drive}, {scenario.scans} scans in {scenario.pieces} pieces, "
        f"on three hosts of {scenario.budget / 2**20:.0f} MiB each"
    )


def _closing(summary: dict[str, Any], processes: Sequence[ProcessRow], out: Path) -> str:
    counts = count_by_kind([row.name for row in processes])
    done, error = summary["processes"], summary["end_error_percent"]
    quality = "" if error is None else f", its end {error:.2f} % of the path off the truth"
    hosts = ", ".join(
        f"{name} {figures['assignments']}" for name, figures in summary["per_host"].items()
    )
    processes_line = (
        f"{done['finished']} of {done['submitted']} processes finished in "
        f"{summary['makespan_s']:.0f} s: {counts['piece']} pieces of the map, "
        f"{counts['holder']} holders, {counts['recorder']} recorder"
    )
    moves = summary["migrations"]
    lines = [
        processes_line,
        f"{summary['assignments']} assignments ({hosts}), {moves} migrations off a full host",
        f"map of {summary['map_points']:,} points{quality}",
        "",
        *(f"  {out / name}" for name in LEFT),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
