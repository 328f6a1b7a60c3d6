"""The rollout demo: an application gets new versions while it maps a drive, one of them faulty.

    python -m rosrm_examples.demo_rollout --out out/rollout

A master and a slave start as one host. The application `mapping` has a SLAM node, a viewer and a
recorder; a player publishes the scans of a LiDAR drive as a scanner would. In mid-drive the second
version is applied: each process is replaced in its own way, the SLAM by handing over its state. The
viewer of the third version ends soon after its start, so the master returns to the second one. An
observer receives every pose; in the end they are compared with those of the same drive mapped in
one go.

Exit status: 0 when no scan was lost or mapped twice and the SLAM was handed over three times; 1
when something was otherwise; 2 when the arguments cannot be used; 128 + signal number (130 for
Ctrl-C) when a signal stopped it.
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
from pathlib import Path
from typing import Any, Final

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
from rosrm_examples.demo_screen import screen_for
from rosrm_examples.drives import load_drive
from rosrm_examples.map_part import load_parts
from rosrm_examples.migration_results import LiveRun, differences, summarise, unmigrated_poses
from rosrm_examples.observer import Observer
from rosrm_examples.played_drive import PlayedDrive, add_rate
from rosrm_examples.rollout_job import (
    BUDGET,
    HANDOFFS,
    HOST,
    RolloutScript,
    cluster_config,
    host_config,
)
from rosrm_examples.rollout_plot import POSES_FILE, ROLLOUT_FILE, draw_rollout

SUMMARY_FILE: Final = "summary.json"
#: Files that the demo writes, in the order in which a user looks at them.
LEFT: Final = (REPORT_FILE, SUMMARY_FILE, ROLLOUT_FILE, EVENTS_FILE, SAMPLES_FILE, POSES_FILE)
#: A drive that lasts as long as all versions need: 40 s.
DRIVE: Final = "street:400"
_PARTS: Final = "parts"
_PLAYED: Final = "player.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    parser = demo_parser("demo_rollout", "An application gets new versions while it maps a drive.")
    add_rate(parser, "1")
    options = parser.parse_args(arguments)
    return run_demo("demo_rollout", options.out, lambda stage: _demonstrate(options, stage))


def _demonstrate(options: argparse.Namespace, stage: Stage) -> None:
    if free_memory() < BUDGET:
        raise Unfit(f"less than {BUDGET / 2**20:.0f} MiB of memory are free here")
    out: Path = options.out
    live = PlayedDrive(
        drive=load_drive(options.drive or DRIVE),
        rate=options.rate or 1.0,
        out=(out / _PARTS).absolute(),
        report=(out / _PLAYED).absolute(),
        working_directory=Path.cwd(),
    )
    with own_folder(out, (*LEFT, _PLAYED), [_PARTS]):
        opening = f"rosrm rollout demo: {live.drive.name}, {len(live.drive)} scans"
        stage.console.print(opening, highlight=False, soft_wrap=True)
        record = Record((HOST,), {"memory": MEMORY_LIMIT}, BUDGET)
        run = _carry_out(live, record, out / CLUSTER, stage)
        stage.signals.check()
        summary = _write_results(out, run, record)
    stage.console.print(_closing(summary, out), highlight=False, soft_wrap=True)
    wrong = differences(summary, "full", migrations=HANDOFFS)
    if wrong:
        why = record.last_problem()
        raise DemoFailed(f"{'; '.join(wrong)}{why}; see the logs in {out / CLUSTER}")


def _carry_out(live: PlayedDrive, record: Record, directory: Path, stage: Stage) -> LiveRun:
    """Play and map the drive on a cluster; return the observations."""
    cluster = LocalCluster(directory, cluster_config(), [host_config(os.cpu_count() or 1)])
    with closing(Observer(cluster.ros)) as observer:
        script = RolloutScript(live, observer)
        screen = screen_for(stage.console, script.progress, script.progress)
        Demo(cluster, record, screen, stage.signals).carry_out(script)
        received = list(observer.received)
    sent = int(json.loads(live.report.read_text())["scans_sent"])
    return LiveRun(live.drive, sent, received, load_parts(live.out), live.period)


def _write_results(out: Path, run: LiveRun, record: Record) -> dict[str, Any]:
    """Write all results of the demo; return the summary."""
    record.write(out)
    figures = summarise(run, unmigrated_poses(run.drive), len(run.parts) - 1)
    gaps = [round(1e3 * gap, 1) for gap in run.gaps()]
    summary = {**figures, "gaps_ms": gaps}
    (out / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n")
    arrived = [one.arrived for one in run.received]
    (out / POSES_FILE).write_text(json.dumps(arrived) + "\n")
    draw_rollout(out / ROLLOUT_FILE, record, arrived)
    write_report(out, f"{run.drive.name}: three versions of an application")
    return summary


def _closing(summary: dict[str, Any], out: Path) -> str:
    gaps = ", ".join(f"{gap:.0f}" for gap in summary["gaps_ms"])
    scans = (
        f"{summary['scans_processed']} of {summary['scans_sent']} scans mapped: "
        f"{summary['scans_lost']} lost, {summary['scans_repeated']} repeated"
    )
    handoffs = (
        f"{summary['migrations']} handoffs of the SLAM, gaps of {gaps} ms beyond the period of "
        f"{summary['period_ms']:.0f} ms; at most {summary['max_deviation_m']} m from the run of "
        "one instance"
    )
    return "\n".join([scans, handoffs, "", *(f"  {out / name}" for name in LEFT)])


if __name__ == "__main__":
    sys.exit(main())
