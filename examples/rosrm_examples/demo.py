"""The demo: three hosts on this machine map a LiDAR drive while memory runs short.

    python -m rosrm_examples.demo --out out/demo

A master and three slaves start as three hosts, each with a budget of memory. NDT SLAM processes
(ROS 2 nodes) map the pieces of a drive, placed by rosrm. At the same time, processes that hold 8 to
80 MB arrive one after another, until every host is at its limit and the queue waits (the paper's
Fig. 6). As they end, a recorder that cannot leave its host grows until that host is over its limit,
and the master migrates others off it (the paper's Fig. 10).

Exit status: 0 when everything was done; 1 when something failed; 2 when the arguments cannot be
used; 128 + signal number (130 for Ctrl-C) when a signal stopped it.
"""

from __future__ import annotations

import os
import signal

if __name__ == "__main__":  # exits without a traceback while the imports below run
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rosrm import ProcessRow
from rosrm.testing.local_cluster import LocalCluster
from rosrm_examples.demo_frame import (
    CLUSTER,
    REPORT_FILE,
    Stage,
    Unfit,
    demo_parser,
    free_memory,
    own_folder,
    run_demo,
    write_report,
)
from rosrm_examples.demo_job import (
    HOSTS,
    LEAST_BUDGET,
    MEMORY_LIMIT,
    Scenario,
    arrivals,
    budget_for,
    cluster_config,
    count_by_kind,
    host_configs,
)
from rosrm_examples.demo_plots import USAGE_FILE, draw_usage, title_of
from rosrm_examples.demo_record import EVENTS_FILE, SAMPLES_FILE, Record, summarise
from rosrm_examples.demo_run import Arrivals, Demo
from rosrm_examples.demo_screen import screen_for
from rosrm_examples.drives import Drive, drive_of
from rosrm_examples.merge import join, write_map
from rosrm_examples.pieces import load_pieces

SUMMARY_FILE: Final = "summary.json"
#: Files that the demo writes, in the order in which a user looks at them.
LEFT: Final = (
    REPORT_FILE,
    SUMMARY_FILE,
    USAGE_FILE,
    "map.png",
    "map.ply",
    EVENTS_FILE,
    SAMPLES_FILE,
)
#: A folder below the folder of results.
_PIECES: Final = "pieces"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    options = _parse(arguments)
    return run_demo("demo", options.out, lambda stage: _demonstrate(options, stage))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = demo_parser(
        "demo", "Three hosts on this machine map a LiDAR drive while memory runs short."
    )
    parser.add_argument("--pieces", type=int, default=9, help="number of pieces (default: 9)")
    parser.add_argument(  # this default brings every host close to its limit
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


def _demonstrate(options: argparse.Namespace, stage: Stage) -> None:
    drive = drive_of(options.drive)
    drive.piece(1, options.pieces)  # raises where the drive is too short
    scenario = Scenario(
        drive.name, len(drive), options.pieces, options.seed, options.pace, _budget()
    )
    out: Path = options.out
    with own_folder(out, (*LEFT, "trajectory.npz"), [_PIECES]):
        stage.console.print(_opening(scenario), highlight=False, soft_wrap=True)
        record = Record(HOSTS, {"memory": MEMORY_LIMIT}, scenario.budget)
        demo = Demo(_cluster(scenario, out), record, screen_for(stage.console), stage.signals)
        coming = arrivals(scenario, (out / _PIECES).absolute(), Path.cwd())
        processes = demo.carry_out(Arrivals(coming))
        stage.signals.check()
        summary = _write_results(out, drive, record, processes)
    stage.console.print(_closing(summary, processes, out), highlight=False, soft_wrap=True)


def _cluster(scenario: Scenario, out: Path) -> LocalCluster:
    hosts = host_configs(scenario.budget, os.cpu_count() or 1)
    return LocalCluster(out / CLUSTER, cluster_config(scenario.pace), hosts)


def _write_results(
    out: Path, drive: Drive, record: Record, processes: Sequence[ProcessRow]
) -> dict[str, Any]:
    """Write all results of the demo; return the summary."""
    record.write(out)
    figures = write_map(join(load_pieces(out / _PIECES)), drive, out)
    draw_usage(out / USAGE_FILE, record, title_of(record))
    summary = summarise(record, processes, {"drive": drive.name, **figures})
    (out / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n")
    write_report(out, title_of(record))
    return summary


# --- memory ------------------------------------------------------------------------------------


def _budget() -> int:
    """Return the memory of each host, bytes; less than usual where this machine has little.

    Raises:
        Unfit: too little for the demo.
    """
    free = free_memory()
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
        f"{summary['assignments']} assignments ({hosts}), migrations off a full host: {moves}",
        f"map of {summary['map_points']:,} points{quality}",
        "",
        *(f"  {out / name}" for name in LEFT),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
