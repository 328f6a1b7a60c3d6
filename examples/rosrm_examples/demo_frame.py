"""Common frame of the demos: arguments, exit status, folder of results, memory check."""

from __future__ import annotations

import argparse
import fcntl
import shutil
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TextIO

import psutil
from rich.console import Console

from rosrm import RosrmError
from rosrm_examples.demo_run import DemoFailed, Stopped, StopSignals
from rosrm_examples.errors import ExampleError
from rosrm_report.writing import read_report, write_page
from rosrm_resources.memory import CgroupMemory

#: A folder below the folder of results: states and logs of master and slaves.
CLUSTER: Final = "cluster"
REPORT_FILE: Final = "report.html"
#: Mark of a folder that belongs to a demo, which may empty it.
_MARK: Final = ".rosrm-demo"


class Unfit(Exception):
    """The demo cannot begin with these arguments, or on this machine."""


@dataclass(frozen=True)
class Stage:
    """The console and the signals of a demo.

    Attributes:
        console: for its output.
        signals: to be checked regularly.
    """

    console: Console
    signals: StopSignals


def run_demo(name: str, out: Path, demonstrate: Callable[[Stage], None]) -> int:
    """Run a demo and report the reason where it stops; return the exit status."""
    stage = Stage(Console(), StopSignals())
    try:
        demonstrate(stage)
    except Stopped as stopped:
        print(f"{name}: stopped by {stopped}", file=sys.stderr)
        return 128 + stopped.number
    except (Unfit, ExampleError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except DemoFailed as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except (RosrmError, TimeoutError, OSError) as error:
        print(f"{name}: {error}; see the logs in {out / CLUSTER}", file=sys.stderr)
        return 1
    return 0


def demo_parser(name: str, description: str) -> argparse.ArgumentParser:
    """Return a parser with the arguments that every demo takes."""
    parser = argparse.ArgumentParser(
        prog=f"python -m rosrm_examples.{name}", description=description
    )
    parser.add_argument("--out", required=True, type=Path, help="folder to write to")
    parser.add_argument(
        "--drive", help="name or path of the drive; else KITTI 0001 where it is, else the street"
    )
    return parser


def own_folder(out: Path, left: Iterable[str], folders: Iterable[str] = ()) -> TextIO:
    """Empty the folder of an earlier demo; return a file that locks out a second demo.

    Args:
        left: files that a demo writes.
        folders: that it makes, in addition to that of the cluster.

    Raises:
        Unfit: the folder belongs to no demo, or another demo writes to it.
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
    for folder in (CLUSTER, *folders):
        shutil.rmtree(out / folder, ignore_errors=True)
    for name in left:
        (out / name).unlink(missing_ok=True)
    return lock


def write_report(out: Path, title: str) -> None:
    """Write the report of a demo from its events and samples, and from the logs of its hosts."""
    write_page(read_report(out, title), out / REPORT_FILE)


def free_memory() -> float:
    """Return the free bytes of this machine, or of this process's control group if less."""
    free = float(psutil.virtual_memory().available)
    group = CgroupMemory.find()
    if group is not None:
        free = min(free, group.capacity * (1.0 - group.usage()))
        group.close()
    return free
