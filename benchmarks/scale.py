"""Cost of a master with a thousand slaves at 10 Hz, and the readings that it misses.

The master is the real one, started as by `rosrm master`. The slaves are simulated
(`benchmarks/simulated_slaves.py`), many in each of a few processes; their messages come from a real
slave's code. The master publishes its own figures on `master_load`, by its own clock:

- `received_per_s`: slave-cycles that messages account for; `missed`: those without a message, by
  the slaves' own counts. `offered_per_s`: cycles of the simulated slaves.
- `us_per_message`: CPU of all threads of the master, by slave-cycle: reception, decoding, decision.
- `oldest_reading_p99_s`: at each look of the master, the age of the oldest among the newest
  readings of all hosts.
- `request_process_*_ms`: one job at a time, from the call of `submit` to the assignment at the
  slave, an order to the slave's own service. `assigned_*_ms`: from the same call to the master's
  record of the assignment.
- `first_request_ms`: the same for the first job, which the other figures exclude. It takes longer,
  because the ROS client of the service `submit` is created for it, and DDS must discover that.
- `request_process_master_cpu_ms`, `request_process_slaves_cpu_ms`: CPU time of the master, and of
  all simulated slaves, for each of these jobs, beyond their CPU time without jobs.

With several numbers (`--slaves 1000 5000 1000 5000`), each is measured in turn. `cost_ratio` is the
cost of a slave-cycle (`us_per_message`) with the most slaves over that with the fewest, of the
medians. All use the same `--hz`: choose one that the machine reaches with the most slaves.

Where permitted, everything runs in a network namespace of its own and uses UDP, as real hosts do;
`transports` names the transports used.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from benchmarks.machine import isolated_transports, parser, percentile, print_report, say
from benchmarks.simulated_slaves import STEP
from benchmarks.stopping import run
from rosrm.config.settings import ClusterConfig
from rosrm.errors import RosrmError
from rosrm.keys.finding import user_security
from rosrm.keys.roles import SecurityMode
from rosrm.model.ros_settings import RosSettings
from rosrm.model.values import Kind, ProcessSpec
from rosrm.ros import names, qos
from rosrm.ros.participant import Participant
from rosrm.ros.sealed import SealedEndpoints
from rosrm.testing.local_cluster import LocalCluster
from rosrm_msgs import msg

_ROOT = Path(__file__).resolve().parents[1]
#: Seconds at the full rate before the count: in the first half minute slaves request work
#: repeatedly, with growing intervals.
_SETTLE = 30.0
#: Seconds for a message on `master_load`, which comes once a second.
_PATIENCE = 30.0
_END = 15.0
#: Jobs by default. The 99th percentile of fewer than 100 is the longest time.
JOBS = 30
#: Seconds between two jobs.
_PAUSE = 0.1
#: Processes of one request.
_AT_ONCE = 200
#: States of a process before its start.
_BEFORE = frozenset({"queued", "assigned", "starting"})


class Loads:
    """Receiver of the master's `master_load`.

    Attributes:
        received: the content of each message, oldest first.
    """

    def __init__(self, settings: RosSettings, security: SecurityMode) -> None:
        self._participant = Participant(settings, "rosrm_scale")
        self.received: list[dict[str, Any]] = []
        topic = names.Names(settings.namespace)(names.MASTER_LOAD)
        endpoints = SealedEndpoints(self._participant, user_security(security))
        endpoints.follow(msg.Event, topic, qos.LOAD, self._take)

    def _take(self, message: msg.Event, _run: bytes) -> None:
        self.received.append({**json.loads(message.data), "elapsed": message.elapsed})

    def wait(self, seconds: float) -> list[dict[str, Any]]:
        """Return the messages of so many seconds, from the next one on.

        Raises:
            TimeoutError: no further message came.
        """
        self.received.clear()
        deadline = time.monotonic() + seconds + _PATIENCE
        while len(self.received) < 2 or _span(self.received) < seconds:
            if time.monotonic() >= deadline:
                raise TimeoutError(f"no message on master_load for {_PATIENCE:g} s")
            self._participant.spin(0.2)
        return list(self.received)

    def close(self) -> None:
        """Leave the ROS graph."""
        self._participant.close()


def _span(loads: Sequence[dict[str, Any]]) -> float:
    return float(loads[-1]["elapsed"] - loads[0]["elapsed"])


@dataclass
class Crowd:
    """The processes of the simulated slaves; they end when they are closed.

    Attributes:
        domain: of the master.
        hz, step: of a slave's cycles, and of its readings.
        timeout: seconds for all slaves of a process to register.
        security: of the master.
    """

    domain: int
    hz: float
    step: float
    timeout: float
    security: SecurityMode = "keys"
    _processes: list[subprocess.Popen[str]] = field(default_factory=list)

    def start(self, slaves: int, processes: int) -> None:
        """Start so many slaves, and wait until all are registered."""
        bounds = [slaves * number // processes for number in range(processes + 1)]
        for first, end in itertools.pairwise(bounds):
            options = {
                "domain": self.domain, "first": first + 1, "slaves": end - first, "hz": self.hz,
                "step": self.step, "timeout": self.timeout, "security": self.security,
            }  # fmt: skip
            words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
            self._processes.append(
                subprocess.Popen(
                    [sys.executable, "-m", "benchmarks.simulated_slaves", *words],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=_ROOT,
                    start_new_session=True,  # a Ctrl-C is for the parent, which closes their input
                )
            )  # fmt: skip
        self.reports()

    def reports(self) -> list[dict[str, Any]]:
        """Return the next report of each process.

        Raises:
            RosrmError: a process has ended instead.
        """
        return [_next_report(process) for process in self._processes]

    def toggle(self) -> None:
        """Start the count, or end it.

        Raises:
            RosrmError: a process has ended.
        """
        for process in self._processes:
            assert process.stdin is not None
            try:
                process.stdin.write("\n")
                process.stdin.flush()
            except BrokenPipeError:
                raise _ended(process) from None

    def close(self) -> None:
        """End all processes, by pid."""
        for process in self._processes:
            if process.stdin is not None:
                with contextlib.suppress(BrokenPipeError):  # it has ended already
                    process.stdin.close()
        for process in self._processes:
            try:
                process.wait(_END)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(_END)


def _next_report(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Return the next line of JSON; Fast DDS writes to the standard output as well."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("{"):
            return dict(json.loads(line))
    raise _ended(process)


def _ended(process: subprocess.Popen[str]) -> RosrmError:
    return RosrmError(f"simulated slaves ended with exit code {process.wait(_END)}; see above")


def occupied_cluster(
    opened: ExitStack, folder: Path, hosts: int, processes: int, step: float, timeout: float
) -> tuple[LocalCluster, Crowd]:
    """Return a cluster of simulated hosts with running services; `opened` closes both."""
    cluster = LocalCluster(folder, ClusterConfig())
    opened.callback(cluster.close)
    assert cluster.domain is not None
    cluster.start_master()
    cluster.client.list()
    crowd = Crowd(cluster.domain, 10.0, step, timeout)
    opened.callback(crowd.close)
    crowd.start(hosts, 1)
    _start_processes(cluster, processes, timeout)
    say(f"{hosts} hosts, {processes} processes")
    return cluster, crowd


def _start_processes(cluster: LocalCluster, count: int, timeout: float) -> None:
    """Submit `count` services, and wait until all of them are placed."""
    names = [f"process_{number}" for number in range(count)]
    for start in range(0, count, _AT_ONCE):  # a busy machine needs longer for all of them
        part = names[start : start + _AT_ONCE]
        cluster.client.submit([ProcessSpec(name, command=("true",)) for name in part])
    cluster.wait_until(
        f"{count} processes are placed",
        lambda view: not any(row.state in _BEFORE for row in view.processes),
        timeout,
    )


def readings(crowd: Crowd, loads: Loads, seconds: float) -> dict[str, float]:
    """Return the figures of the readings of all slaves over so many seconds.

    Raises:
        RosrmError: there was no reading.
    """
    crowd.toggle()
    seen = loads.wait(seconds)
    crowd.toggle()
    sent = crowd.reports()
    first, last, span = seen[0], seen[-1], _span(seen)
    cycles = last["cycles"] - first["cycles"]
    cpu = last["cpu_s"] - first["cpu_s"]
    ages = [age for one in seen[1:] for age in one["oldest_reading_s"]]
    offered = sum(one["cycles"] for one in sent)
    if not cycles or not offered:
        raise RosrmError(
            f"in {span:.1f} s the slaves executed {offered} cycles and the master received "
            f"{cycles}; both must be above 0: increase --seconds"
        )
    return {
        "offered_per_s": sum(one["cycles"] / one["seconds"] for one in sent),
        "received_per_s": cycles / span,
        "missed": last["missed"] - first["missed"],
        "master_cpu": cpu / span,
        "us_per_message": 1e6 * cpu / cycles,
        "oldest_reading_p99_s": percentile(ages, 0.99),
        "hosts_heard": min(one["hosts"] for one in seen),
        "messages_per_cycle": sum(one["messages"] for one in sent) / offered,
        "masters_lost": sum(one["lost"] for one in sent),
        "late_cycles": sum(one["late"] for one in sent),
        "simulated_slaves_cpu": sum(one["cpu"] / one["seconds"] for one in sent),
        "seconds": span,
    }


def requests(
    cluster: LocalCluster, crowd: Crowd, idle: Mapping[str, float], jobs: int
) -> dict[str, float]:
    """Return the delays from submission to the assignment at the slave, one job at a time.

    Args:
        cluster: of the master.
        crowd: the slaves.
        idle: the figures of `readings`, measured without jobs.
        jobs: number of measured jobs, without the first one.
    """
    crowd.toggle()
    first = _submit(cluster, "first")
    _wait_for_end(cluster, "first")
    began, cpu = time.monotonic(), _cpu_of_master(cluster)
    called = {name: _submit(cluster, name) for name in (f"job{n}" for n in range(jobs))}
    _wait_for_end(cluster, f"job{jobs - 1}")
    crowd.toggle()
    reports = crowd.reports()
    taken = {name: at for one in reports for name, at in one["taken"].items()}
    master = _cpu_of_master(cluster) - cpu - idle["master_cpu"] * (time.monotonic() - began)
    slaves = sum(
        one["cpu"] - idle["simulated_slaves_cpu"] / len(reports) * one["seconds"] for one in reports
    )
    took = [1e3 * (taken[name] - called[name]) for name in called if name in taken]
    decided = [1e3 * (_assigned_at(cluster, name) - at) for name, at in called.items()]
    if not took:
        raise RosrmError(f"no simulated slave got one of {jobs} jobs within {_END:g} s")
    return {
        "first_request_ms": 1e3 * (taken.get("first", math.inf) - first),
        "assigned_p50_ms": percentile(decided, 0.5),
        "assigned_p99_ms": percentile(decided, 0.99),
        "request_process_p50_ms": percentile(took, 0.5),
        "request_process_p99_ms": percentile(took, 0.99),
        "request_process_master_cpu_ms": 1e3 * master / jobs,
        "request_process_slaves_cpu_ms": 1e3 * slaves / jobs,
        "request_process_answered": len(took),
        "request_process_asked": jobs,
    }


def _submit(cluster: LocalCluster, name: str) -> float:
    """Submit a job, wait for a moment, and return the unix time of the call."""
    called = time.time()
    cluster.client.submit([ProcessSpec(name, command=("true",), kind=Kind.JOB)])
    cluster.client.spin(_PAUSE)
    return called


def _cpu_of_master(cluster: LocalCluster) -> float:
    assert cluster.master is not None
    used = psutil.Process(cluster.master.process.pid).cpu_times()
    return float(used.user + used.system)


def _assigned_at(cluster: LocalCluster, name: str) -> float:
    """Return the unix time of the record of a job's assignment; infinite: there is none."""
    events = cluster.client.list(events=True, process=name).events
    return next((one.wall_time for one in events if one.kind == "assigned"), math.inf)


def _wait_for_end(cluster: LocalCluster, name: str) -> None:
    """Wait for a job's end; jobs run in order. A job that is stuck counts as unanswered."""
    deadline = time.monotonic() + _END
    while time.monotonic() < deadline:
        (row,) = cluster.client.list(processes=True, process=name).processes
        if row.state == "finished":
            return
        cluster.client.spin(_PAUSE)


def measure(
    arguments: argparse.Namespace, slaves: int, folder: Path, security: SecurityMode = "keys"
) -> dict[str, float]:
    """Return all figures of one run.

    Args:
        arguments: of the command line.
        slaves: number of simulated slaves.
        folder: for the state of the master.
        security: of the cluster.

    Raises:
        RosrmError: a part ended, or readings or assignments are missing.
        TimeoutError: no message of the master came.
    """
    with ExitStack() as opened:
        most = max(slaves, ClusterConfig().max_hosts)
        cluster = LocalCluster(folder, ClusterConfig(security=security, max_hosts=most))
        opened.callback(cluster.close)
        assert cluster.domain is not None
        cluster.start_master()
        cluster.client.list()
        loads = Loads(cluster.ros, security)
        opened.callback(loads.close)
        crowd = Crowd(cluster.domain, arguments.hz, arguments.step, arguments.timeout, security)
        opened.callback(crowd.close)
        begun = time.monotonic()
        crowd.start(slaves, arguments.processes)
        up = time.monotonic() - begun
        say(f"{slaves} slaves are registered after {up:.1f} s")
        loads.wait(arguments.settle)
        figures = readings(crowd, loads, arguments.seconds)
        say(f"{figures['us_per_message']:.1f} us a slave-cycle, {figures['missed']} missed")
        answered = requests(cluster, crowd, figures, arguments.jobs)
        return {**figures, **answered, "all_registered_s": up}


def _costs(runs: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Return the figures of a single run; of several runs, their figures and the ratio of costs."""
    if len(runs) == 1:
        return dict(runs[0])
    costs: dict[float, list[float]] = {}
    for one in runs:
        costs.setdefault(one["slaves"], []).append(one["us_per_message"])
    least, most = (statistics.median(costs[end(costs)]) for end in (min, max))
    return {"cost_ratio": most / least, "by_turns": list(runs)}


def main() -> int:
    """Measure and print one JSON object; return the exit status."""
    command_line = parser(__doc__)
    command_line.add_argument(
        "--slaves",
        type=_positive(int),
        nargs="+",
        default=[1000],
        help="numbers of simulated slaves, e.g. 1000 5000; each is measured in turn",
    )
    command_line.add_argument(
        "--hz",
        type=_positive(float),
        default=10.0,
        help="cycles a second of each slave",
    )
    command_line.add_argument(
        "--seconds",
        type=_positive(float),
        default=30.0,
        help="seconds of the measurement",
    )
    command_line.add_argument(
        "--processes",
        type=_positive(int),
        default=2,
        help="number of processes that the slaves share",
    )
    command_line.add_argument(
        "--step", type=float, default=STEP,
        help="standard deviation of a usage's change per cycle; with 0.1 nearly all cycles send",
    )  # fmt: skip
    command_line.add_argument(
        "--timeout",
        type=_positive(float),
        default=240.0,
        help="seconds for all slaves to register",
    )
    command_line.add_argument(
        "--settle",
        type=_positive(float),
        default=_SETTLE,
        help="seconds from the registration to the measurement",
    )
    command_line.add_argument(
        "--jobs",
        type=_positive(int),
        default=JOBS,
        help="jobs whose assignments are timed, one at a time",
    )
    arguments = command_line.parse_args()
    if arguments.processes > min(arguments.slaves):
        command_line.error(
            f"{min(arguments.slaves)} slaves cannot share {arguments.processes} processes"
        )
    transports = isolated_transports()
    runs = []
    for slaves in arguments.slaves:
        with tempfile.TemporaryDirectory(prefix="rosrm-scale-") as folder:
            runs.append({"slaves": slaves, **measure(arguments, slaves, Path(folder))})
    print_report(
        "scale",
        {
            "hz": arguments.hz, "step": arguments.step, **_costs(runs), "transports": transports,
        },
        runs=len(runs),
    )  # fmt: skip
    return 0


def _positive(kind: type) -> Any:
    def parse(text: str) -> Any:
        value = kind(text)
        if not value > 0:
            raise argparse.ArgumentTypeError(f"{text} is not above 0")
        return value

    return parse


if __name__ == "__main__":
    sys.exit(run("scale", main))
