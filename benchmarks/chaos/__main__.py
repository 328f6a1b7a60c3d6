"""Random faults on virtual hosts, judged by observation alone.

Exit status: 0 without a violation, 1 with one, 2 when something is missing, 128 + signal number
when a signal stopped it. Needs root. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final

from benchmarks.chaos import clocks, work
from benchmarks.chaos.client_load import ClientLoad
from benchmarks.chaos.cluster import HOSTS, LEASE_S, Cluster
from benchmarks.chaos.event_log import EventLog
from benchmarks.chaos.faults import Round, draw
from benchmarks.chaos.intruder import intruder
from benchmarks.chaos.stalls import StallWatch
from benchmarks.chaos.trial import Stuck, Tally, Trial
from benchmarks.machine import parser, percentile, print_report, say
from benchmarks.stopping import run
from rosrm_lab import needs

#: Labs that may get stuck before the benchmark gives up.
_MOST_STUCK: Final = 5
_NO_CLOCKS: Final = "the package libfaketime is not installed (pip install libfaketime)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Inject faults until the number or the time is reached; return the exit status."""
    options = _parse(arguments)
    needs.check_rights()
    needs.check_commands()
    if clocks.library() is None:
        say(f"faults of clocks are left out: {_NO_CLOCKS}")
    tally, began = Tally(), time.monotonic()
    try:
        out = options.out or Path(tempfile.mkdtemp(prefix="rosrm-chaos-"))
        out.mkdir(parents=True, exist_ok=True)
        _run(options, out, tally, began)
    finally:
        if tally.rounds:
            _report(options, tally, time.monotonic() - began)
    return 1 if tally.violations else 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    command_line = parser(__doc__)
    command_line.add_argument(
        "--minutes", type=float, default=5.0, help="minutes after which no new fault begins"
    )
    command_line.add_argument("--seed", type=int, default=1, help="seed of the faults")
    command_line.add_argument(
        "--faults", type=int, default=500, help="approximate maximum number of faults"
    )
    command_line.add_argument(
        "--out", type=Path, help="folder for settings, logs and violations, else a temporary one"
    )
    command_line.add_argument("--lab", default="chaos", help="name of the lab")
    command_line.add_argument(
        "--intruder",
        action="store_true",
        help="let a participant without a key send forged, repeated and random messages",
    )
    return command_line.parse_args(arguments)


def _run(options: argparse.Namespace, out: Path, tally: Tally, began: float) -> None:
    """Run the rounds in one lab; start another lab where one gets stuck."""
    event_log = EventLog(options.seed)
    services = [*work.services(), *work.rolled()]
    names = [service.name for service in services]
    movable = [service.name for service in services if service.sort.strategy]
    rounds = draw(options.seed, HOSTS, names, movable)
    deadline = began + 60.0 * options.minutes
    for number in itertools.count(1):
        folder = out / f"lab{number}"
        lines = folder / "lines"
        lines.mkdir(parents=True, exist_ok=True)
        try:
            with (
                Cluster(
                    options.lab, folder, lambda text: event_log.add(text, aloud=True)
                ) as cluster,
                ClientLoad(cluster.lab, folder / "desk.log", event_log.add) as client_load,
                StallWatch(cluster.pids(), LEASE_S) as stall_watch,
                _intruder(options, cluster, folder),
            ):
                trial = Trial(
                    cluster, client_load, lines, out, event_log, tally,
                    stall_watch=stall_watch,
                )  # fmt: skip
                trial.begin()
                say(f"no deviations: {len(names)} services on {len(HOSTS)} hosts")
                for drawn in _while(rounds, options.faults, deadline, tally):
                    trial.round(drawn)
                trial.end()
            break
        except Stuck as stuck:
            say(f"stuck: {stuck}")
            if number == _MOST_STUCK or time.monotonic() > deadline:
                break


def _intruder(
    options: argparse.Namespace, cluster: Cluster, folder: Path
) -> AbstractContextManager[None]:
    return intruder(cluster.lab, folder / "intruder.log") if options.intruder else nullcontext()


def _while(rounds: Iterator[Round], faults: int, deadline: float, tally: Tally) -> Iterator[Round]:
    while tally.faults < faults and time.monotonic() < deadline:
        yield next(rounds)


def _report(options: argparse.Namespace, tally: Tally, seconds: float) -> None:
    violations = tally.violations
    left_out = {} if clocks.library() else {"clock": _NO_CLOCKS}
    print_report(
        "chaos",
        {
            "faults": tally.faults, "violations": violations.total(), "lost": violations["lost"],
            "doubled": violations["doubled"], "orphans": violations["orphans"],
            "seed": options.seed, "intruder": options.intruder, "minutes": round(seconds / 60.0, 1),
            "violations_by_kind": dict(violations), "by_kind": dict(sorted(tally.by_kind.items())),
            "applied": dict(tally.applied), "in_apply": dict(sorted((+tally.in_apply).items())),
            "recovery_s": _spread(tally.recovery), "whole_s": _spread(tally.whole),
            "parted_s": _spread({"owner": tally.parted}), "overloaded": tally.overloaded,
            "load": _spread({"average": tally.loads}),
            "allowed": dict(tally.allowed), "missed": dict(tally.missed), "left_out": left_out,
            "services": len([*work.services(), *work.rolled()]) + 1,
            "processes_p50": statistics.median(tally.counts) if tally.counts else None,
            "hosts": len(HOSTS), "lease_s": LEASE_S,
        },
        runs=tally.rounds,
    )  # fmt: skip


def _spread(seconds: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Return median, 99th percentile and maximum by kind."""
    return {
        kind: {
            "n": len(values), "p50": round(statistics.median(values), 2),
            "p99": round(percentile(values, 0.99), 2), "max": round(max(values), 2),
        }
        for kind, values in sorted(seconds.items())
        if values
    }  # fmt: skip


if __name__ == "__main__":
    sys.exit(run("chaos", main))
