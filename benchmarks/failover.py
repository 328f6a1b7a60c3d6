"""Time until a lost host is detected and its processes continue elsewhere, and false losses.

Four hosts on one machine, in a network of their own. In each round one is switched off: its slave,
its supervisor and its processes get SIGKILL at one moment, from which all times count. `detect`:
until the master declares the host lost; `detect_over_lease`: the same less the lease. `standby`:
until an external observer receives an output of the standby of a stateful process;
`standby_after_decision`: the same from the master's record of the loss on. `restart`: the same as
`standby` for a process without a standby, which is restarted from its snapshot. Then all cores are
under full load for minutes (`--minutes`), and the hosts that are declared lost are counted; none
has failed.

A cycle publishes its output first, and then its state. `state_lost` counts published states that a
standby did not have; the goal is 0. `standby_repeated` counts outputs that it published again: one
if the host failed between output and state, else as many as states were lost. `standby_skipped`
counts outputs of the standby's first cycles that were published before the observer discovered it.
`standbys_of_heard_states`: rounds in which the observer received the states up to the last one; in
the others only the state before the last output is known. `restart_repeated_most` is the largest
age of a restored snapshot, in cycles.

Exit status: 1 if a state was lost, or a host that had not failed.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from rclpy.serialization import deserialize_message
from std_msgs.msg import Int64MultiArray

from benchmarks.handoff import Observer, Output
from benchmarks.handoff_nodes import QOS
from benchmarks.machine import (
    isolated_transports,
    milliseconds,
    parser,
    print_report,
    quantiles,
    say,
)
from benchmarks.stopping import run
from rosrm.config.settings import ClusterConfig, ControlSettings, HostConfig, LivenessSettings
from rosrm.model.values import (
    HostLossPolicy,
    MigrationPolicy,
    ProcessSpec,
    StandbyPolicy,
    StopPolicy,
)
from rosrm.ros.names import token
from rosrm.ros.sealed_codec import decode
from rosrm.snapshots import reader
from rosrm.testing.local_cluster import LocalCluster
from rosrm_msgs.msg import Sealed

_ROOT = Path(__file__).resolve().parents[1]
_HOSTS = ("h0", "h1", "h2", "h3")
_PATIENCE = 60.0
_NS = 1e9
#: A lease below a second needs a shorter beat.
_SHORT = (
    LivenessSettings(suspect=0.3, lease=0.8),
    ControlSettings(beat_period=0.1),
)
_GUARDED, _KEPT = "guarded", "kept"


@dataclass(frozen=True)
class Continuation:
    """The cycle from which a successor continued.

    Attributes:
        received: last cycle of the predecessor with a received output.
        published: last cycle of the predecessor with a received state.
        first: cycle of the successor's first output.
    """

    received: int
    published: int
    first: int

    @property
    def lost(self) -> int:
        """Return the number of published states after the one from which it continued.

        Before a cycle's output, the state of the cycle before was published, received or not.
        """
        return max(0, max(self.published, self.received - 1) + 1 - self.first)

    @property
    def repeated(self) -> int:
        """Return the number of repeated outputs."""
        return max(0, self.received + 1 - self.first)

    @property
    def skipped(self) -> int:
        """Return the number of outputs that were not received, between the last and the first."""
        return max(0, self.first - self.received - 1)


class Witness(Observer):
    """Observer of the states, in a cluster without security, as well as of the outputs."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain)
        #: Newest published cycle, by instance.
        self.states: dict[int, int] = {}
        self._topics: set[str] = set()

    def find_states(self) -> None:
        """Subscribe to the topics of states that exist by now."""
        for topic, types in self._node.get_topic_names_and_types():
            is_state = topic.endswith("/state") and "rosrm_msgs/msg/Sealed" in types
            if is_state and topic not in self._topics:
                self._topics.add(topic)
                self._node.create_subscription(Sealed, topic, self._note, QOS, raw=True)

    def _note(self, data: bytes) -> None:
        envelope = decode(data)
        if envelope is None:
            return
        number, sequence = deserialize_message(bytes(envelope.body), Int64MultiArray).data
        self.states[number] = max(sequence, self.states.get(number, 0))

    def continuation_of(self, former: int, after: Output) -> Continuation:
        """Return the cycle from which a successor continued, by its first output."""
        received = max(one.sequence for one in self.outputs if one.instance == former)
        return Continuation(received, self.states.get(former, 0), after.sequence)


@dataclass
class Outcome:
    """The outcome of all rounds; seconds from the fault.

    Attributes:
        detect: until the host was lost.
        standby, restart: until the successor's first output.
        standby_after_decision: from the loss until the standby's first output.
        standby_continuation, restart_continuation: the cycles from which the successors continued.
    """

    detect: list[float] = field(default_factory=list)
    standby: list[float] = field(default_factory=list)
    standby_after_decision: list[float] = field(default_factory=list)
    restart: list[float] = field(default_factory=list)
    standby_continuation: list[Continuation] = field(default_factory=list)
    restart_continuation: list[Continuation] = field(default_factory=list)


def _process(name: str, rate: float, **fields: object) -> ProcessSpec:
    return ProcessSpec(
        name, module="benchmarks.handoff_nodes", arguments=("count", "--rate", str(rate)),
        environment={"PYTHONPATH": str(_ROOT)}, ros=True, stop=StopPolicy(0.5, 0.5),
        migration=MigrationPolicy("handoff"), host_loss=HostLossPolicy("elsewhere"),
        **fields,  # type: ignore[arg-type]
    )  # fmt: skip


def _hosts() -> list[HostConfig]:
    # Without cpu: the hosts share the processor, and a busy one would leave room on none.
    probes: dict[str, dict[str, object]] = {"memory": {}, "disk": {}}
    limits = {"memory": 0.98, "disk": 1.0}
    return [HostConfig(host=name, probes=probes, limits=limits) for name in _HOSTS]


@contextlib.contextmanager
def _cluster(liveness: LivenessSettings, control: ControlSettings) -> Iterator[LocalCluster]:
    with tempfile.TemporaryDirectory(prefix="rosrm-failover-") as folder:
        # The witness, which has no key, reads the states.
        settings = ClusterConfig(liveness=liveness, control=control, security="none")
        with LocalCluster(Path(folder), cluster=settings, hosts=_hosts()) as cluster:
            yield cluster


# --- rounds -----------------------------------------------------------------------------------


def measure(rounds: int, rate: float) -> Outcome:
    """Switch hosts off, one a round, by turns the host of the one process and of the other.

    Raises:
        TimeoutError: a successor or a state did not come; the message names it.
    """
    outcome = Outcome()
    with contextlib.ExitStack() as stack:
        cluster = stack.enter_context(_cluster(*_SHORT))
        observer = Witness(cluster.domain or 0)
        stack.callback(observer.close)
        cluster.client.submit(
            [
                _process(_GUARDED, rate, standby=StandbyPolicy(wanted=True)),
                _process(_KEPT, rate),
            ]
        )
        for number, name in zip(range(rounds), itertools.cycle((_GUARDED, _KEPT)), strict=False):
            _round(cluster, observer, name, outcome)
            if (number + 1) % 10 == 0:
                say(f"{number + 1}/{rounds} hosts switched off")
    return outcome


def _round(cluster: LocalCluster, observer: Witness, name: str, outcome: Outcome) -> None:
    _wait_until_calm(cluster)
    observer.find_states()
    before = {one: cluster.process(one) for one in (_GUARDED, _KEPT)}
    host = before[name].host
    last_event = cluster.client.list(events=True, newest=1).events[-1].sequence
    observer.outputs.clear()
    observer.wait_for(20)
    fault = cluster.switch_off(host)
    lost_at = _lost_at(cluster, host, last_event)
    for one, row in before.items():
        if row.host != host:
            continue
        after = _wait_for_successor(observer, row.number, _of(cluster, one, row.number))
        continuation = observer.continuation_of(row.number, after)
        seconds = after.received / _NS - fault
        if one == _GUARDED:
            outcome.standby.append(seconds)
            outcome.standby_after_decision.append(seconds + fault - lost_at)
            outcome.standby_continuation.append(continuation)
        else:
            outcome.restart.append(seconds)
            outcome.restart_continuation.append(continuation)
    outcome.detect.append(lost_at - fault)
    cluster.start_slave(next(one for one in _hosts() if one.host == host))


def _wait_until_calm(cluster: LocalCluster) -> None:
    """Wait until both processes run, the standby is ready, and a new replica is elsewhere."""

    def calm(view: object) -> bool:
        rows = {row.name: row for row in view.processes}  # type: ignore[attr-defined]
        running = all(rows[one].state == "running" for one in (_GUARDED, _KEPT))
        return running and "standby is ready" in rows[_GUARDED].reason

    cluster.wait_for_hosts(_PATIENCE)
    cluster.wait_until("two processes and a standby", calm, _PATIENCE)
    row = cluster.process(_KEPT)
    before, deadline = _copies(cluster, row.host, row.number), time.monotonic() + _PATIENCE
    while not any(
        sequence > before.get(host, 0)
        for host, sequence in _copies(cluster, row.host, row.number).items()
    ):
        if time.monotonic() >= deadline:
            raise TimeoutError(f"no other host got a new replica of {_KEPT} within {_PATIENCE:g} s")
        cluster.client.spin(0.1)


def _copies(cluster: LocalCluster, own: str, number: int) -> dict[str, int]:
    """Return the other hosts with a replica of an instance's state on disk, and its cycle."""
    heads = {
        name: reader.newest_head(cluster.directory / "hosts" / name / "kept" / token(_KEPT))
        for name in _HOSTS
        if name != own
    }
    return {name: one.sequence for name, one in heads.items() if one and one.instance == number}


def _of(cluster: LocalCluster, name: str, former: int) -> int:
    """Wait for the successor of an instance; return its number."""

    def followed(view: object) -> bool:
        rows = view.processes  # type: ignore[attr-defined]
        return any(row.name == name and row.number not in (0, former) for row in rows)

    cluster.wait_until(f"a successor of {name}#{former}", followed, _PATIENCE)
    return int(cluster.process(name).number)


def _wait_for_successor(observer: Observer, former: int, number: int) -> Output:
    deadline = time.monotonic() + _PATIENCE
    while time.monotonic() < deadline:
        for output in list(observer.outputs):
            if output.instance == number:
                return output
        time.sleep(0.005)
    raise TimeoutError(f"#{number}, which follows #{former}, had no output within {_PATIENCE:g} s")


def _lost_at(cluster: LocalCluster, host: str, after: int) -> float:
    """Return the unix time at which the master declared a host lost."""
    deadline = time.monotonic() + _PATIENCE
    while time.monotonic() < deadline:
        events = cluster.client.list(events=True, host=host, after=after).events
        for event in events:
            if event.kind == "host_lost":
                return float(event.wall_time)
        cluster.client.spin(0.05)
    raise TimeoutError(f"{host} was not lost within {_PATIENCE:g} s")


# --- load -------------------------------------------------------------------------------------


def false_losses(minutes: float) -> dict[str, int]:
    """Return the number of hosts that are declared lost while other programs occupy every core.

    Returns:
        by lease: there is a cluster for each, and all are under the same load at once.
    """
    leases = {"0.8 s": _SHORT, "default": (LivenessSettings(), ControlSettings())}
    with contextlib.ExitStack() as stack:
        clusters = {name: stack.enter_context(_cluster(*lease)) for name, lease in leases.items()}
        stack.enter_context(_load())
        until = time.monotonic() + 60.0 * minutes
        while time.monotonic() < until:
            for cluster in clusters.values():
                cluster.client.spin(0.5)
        return {name: _lost(cluster) for name, cluster in clusters.items()}


def _lost(cluster: LocalCluster) -> int:
    return sum(event.kind == "host_lost" for event in cluster.client.list(events=True).events)


@contextlib.contextmanager
def _load() -> Iterator[None]:
    """Run one counting process for each core."""
    counting = "while True: pass"
    burners = [
        subprocess.Popen([sys.executable, "-c", counting])
        for _ in range(len(os.sched_getaffinity(0)))
    ]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def main() -> int:
    """Measure and print one JSON object; return the exit status."""
    command_line = parser(__doc__)
    command_line.add_argument(
        "--rounds",
        type=int,
        default=40,
        help="number of hosts that are switched off, one after the other",
    )
    command_line.add_argument(
        "--rate", type=float, default=50.0, help="cycles a second of the nodes (Hz)"
    )
    command_line.add_argument("--minutes", type=float, default=10.0, help="minutes of full load")
    chosen = command_line.parse_args()
    transports = isolated_transports()
    outcome = measure(chosen.rounds, chosen.rate)
    losses = false_losses(chosen.minutes)
    lost = sum(one.lost for one in outcome.standby_continuation)
    print_report(
        "failover",
        {
            "lease_s": _SHORT[0].lease, "rate_hz": chosen.rate,
            **quantiles("detect", outcome.detect), **quantiles("standby", outcome.standby),
            **quantiles("restart", outcome.restart),
            **milliseconds("detect_over_lease", [one - _SHORT[0].lease for one in outcome.detect]),
            **milliseconds("standby_after_decision", outcome.standby_after_decision),
            "state_lost": lost,
            "standbys_of_heard_states": sum(
                one.published >= one.received - 1 for one in outcome.standby_continuation
            ),
            "standby_repeated": sum(one.repeated for one in outcome.standby_continuation),
            "standby_skipped": sum(one.skipped for one in outcome.standby_continuation),
            "restart_repeated_most": max(
                (one.repeated for one in outcome.restart_continuation), default=None
            ),
            "standbys": len(outcome.standby), "restarts": len(outcome.restart),
            "false_losses": sum(losses.values()), "false_losses_by_lease": losses,
            "load_minutes": chosen.minutes,
            "transports": transports,
        },
        runs=chosen.rounds,
    )  # fmt: skip
    return 1 if lost or any(losses.values()) else 0


if __name__ == "__main__":
    sys.exit(run("failover", main))
