"""The migration demo: a drive is mapped live, and in mid-drive the SLAM migrates to another host.

    python -m rosrm_examples.demo_migration --out out/migration

A master and three slaves start as three hosts, each with a budget of memory. On one of them a
player publishes the scans of a LiDAR drive as a scanner would; on another a SLAM node maps them. In
mid-drive that host reaches its limit of memory: rosrm hands the SLAM off to the third host, with
its state, while the drive continues. An observer receives every pose; in the end they are compared
with those of the same drive mapped in one go.

Exit status: 0 when no scan was lost or mapped twice and the SLAM migrated once; 1 when something
was otherwise; 2 when the arguments cannot be used; 128 + signal number (130 for Ctrl-C) when a
signal stopped it.
"""

from __future__ import annotations

import os
import signal

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy, and as for the SLAM process
if __name__ == "__main__":  # exits without a traceback while the imports below run
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import closing
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.colors import to_rgb

from rosrm import Listing
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
from rosrm_examples.demo_job import MEMORY_LIMIT
from rosrm_examples.demo_record import EVENTS_FILE, SAMPLES_FILE, Record
from rosrm_examples.demo_run import Demo, DemoFailed
from rosrm_examples.demo_screen import memory_line, screen_for
from rosrm_examples.drives import drive_of
from rosrm_examples.errors import PieceError
from rosrm_examples.map_part import load_parts
from rosrm_examples.migration_job import (
    BUDGET,
    HOSTS,
    LEAST_FREE,
    SLAM,
    LiveDrive,
    MigrationScript,
    cluster_config,
    host_configs,
    usual_rate,
)
from rosrm_examples.migration_results import LiveRun, differences, summarise, unmigrated_poses
from rosrm_examples.observer import Observer
from rosrm_examples.picture import Stretch, draw_errors, draw_stretches
from rosrm_examples.played_drive import add_rate
from rosrm_examples.ply import write_ply
from rosrm_examples.slam_state import STATES

SUMMARY_FILE: Final = "summary.json"
MAP_FILE, TRAJECTORY_FILE, CLOUD_FILE = "map.png", "trajectory.png", "map.ply"
#: Files that the demo writes, in the order in which a user looks at them.
LEFT: Final = (
    REPORT_FILE,
    SUMMARY_FILE,
    MAP_FILE,
    TRAJECTORY_FILE,
    CLOUD_FILE,
    EVENTS_FILE,
    SAMPLES_FILE,
)
#: A folder below the folder of results: the map of each instance of the SLAM.
_PARTS: Final = "parts"
_PLAYED: Final = "player.json"

#: Source and destination, as in the paper's Fig. 11, and those after them.
_COLOURS: Final = ("#2563c9", "#2f9e44", "#c98a1b", "#9c36b5")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    options = _parse(arguments)
    return run_demo("demo_migration", options.out, lambda stage: _demonstrate(options, stage))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = demo_parser(
        "demo_migration", "A drive is mapped live, and in mid-drive the SLAM moves to another host."
    )
    parser.add_argument(
        "--state", choices=sorted(STATES), default="full", help="what moves (default: full)"
    )
    add_rate(parser, "1, or less, for 20 s in all")
    return parser.parse_args(arguments)


def _demonstrate(options: argparse.Namespace, stage: Stage) -> None:
    _check_memory()
    out: Path = options.out
    drive = drive_of(options.drive)
    live = LiveDrive(
        drive=drive,
        rate=options.rate or usual_rate(drive),
        state=options.state,
        out=(out / _PARTS).absolute(),
        report=(out / _PLAYED).absolute(),
        working_directory=Path.cwd(),
    )
    with own_folder(out, (*LEFT, _PLAYED), [_PARTS]):
        stage.console.print(_opening(live), highlight=False, soft_wrap=True)
        record = Record(HOSTS, {"memory": MEMORY_LIMIT}, BUDGET)
        run = _carry_out(live, record, out / CLUSTER, stage)
        stage.signals.check()
        summary = _write_results(out, run, record)
    stage.console.print(_closing(summary, out), highlight=False, soft_wrap=True)
    wrong = differences(summary, live.state, migrations=1)
    if wrong:
        why = record.last_problem()
        raise DemoFailed(f"{'; '.join(wrong)}{why}; see the logs in {out / CLUSTER}")


def _check_memory() -> None:
    free = free_memory()
    if free < LEAST_FREE:
        raise Unfit(
            f"{free / 2**20:.0f} MiB of memory are free here; the demo needs "
            f"{LEAST_FREE / 2**20:.0f}"
        )


def _carry_out(live: LiveDrive, record: Record, directory: Path, stage: Stage) -> LiveRun:
    """Play and map the drive on a cluster; return the observations."""
    cluster = LocalCluster(directory, cluster_config(), host_configs(os.cpu_count() or 1))
    with closing(Observer(cluster.ros)) as observer:
        script = MigrationScript(live, observer)

        def line(view: Listing) -> str:
            return f"{memory_line(view)}   {script.progress(view)}"

        screen = screen_for(stage.console, script.progress, line)
        Demo(cluster, record, screen, stage.signals).carry_out(script)
        received = list(observer.received)
    sent = int(json.loads(live.report.read_text())["scans_sent"])
    try:
        parts = load_parts(live.out)
    except PieceError as error:
        raise DemoFailed(f"{error}; see the logs in {directory}") from error
    return LiveRun(live.drive, sent, received, parts, live.period)


# --- results -----------------------------------------------------------------------------------


def _write_results(out: Path, run: LiveRun, record: Record) -> dict[str, Any]:
    """Write all results of the demo; return the summary."""
    record.write(out)
    moves = [move for move in record.moves() if move.process == SLAM]
    summary = summarise(run, unmigrated_poses(run.drive), len(moves))
    (out / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n")
    stretches = [
        Stretch(
            f"mapped on {part.host}", colour, part.points, part.poses[:, :3, 3], run.numbers(part)
        )
        for part, colour in zip(run.parts, cycle(_COLOURS), strict=False)
    ]
    truth = None if run.drive.truth is None else run.drive.truth[:, :3, 3]
    title = f"{run.drive.name}: {summary['scans_processed']} scans"
    draw_stretches(out / MAP_FILE, stretches, truth, title)
    draw_errors(out / TRAJECTORY_FILE, stretches, truth, title)
    colours = [
        np.tile((255 * np.array(to_rgb(one.colour))).astype(np.uint8), (len(one.points), 1))
        for one in stretches
    ]
    points = np.concatenate([one.points for one in stretches])
    write_ply(out / CLOUD_FILE, points, np.concatenate(colours))
    write_report(out, title)
    return summary


# --- words -------------------------------------------------------------------------------------


def _opening(live: LiveDrive) -> str:
    return (
        f"rosrm migration demo: {live.drive.name}, {len(live.drive)} scans, one every "
        f"{1e3 * live.period:.0f} ms, state: {live.state}"
    )


def _closing(summary: dict[str, Any], out: Path) -> str:
    gap, error = summary["gap_ms"], summary["end_error_percent"]
    quality = "" if error is None else f"; its end {error:.2f} % of the path off the truth"
    hosts = ", ".join(f"{part['scans']} on {part['host']}" for part in summary["parts"])
    moves = summary["migrations"]
    scans = (
        f"{summary['scans_processed']} of {summary['scans_sent']} scans mapped ({hosts}): "
        f"{summary['scans_lost']} lost, {summary['scans_repeated']} repeated, "
        f"{moves} migration{'' if moves == 1 else 's'}"
    )
    move = (
        f"gap {'?' if gap is None else format(gap, '.1f')} ms beyond the period of "
        f"{summary['period_ms']:.0f} ms; at most {summary['max_deviation_m']} m from the "
        f"unmigrated run{quality}"
    )
    return "\n".join([scans, move, "", *(f"  {out / name}" for name in LEFT)])


if __name__ == "__main__":
    sys.exit(main())
