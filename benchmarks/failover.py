"""How soon a lost host is noticed, and how soon its processes go on elsewhere.

Four hosts on one machine, in a network of their own. In each round one is switched off: its slave,
its supervisor and its processes get SIGKILL at one moment, where all times begin. `detect`: until
the master has it for lost. `standby`: until an outside observer hears the standby of a stateful
process. `restart`: until it hears the instance that was started anew, from its kept state, of a
process without a standby. Then a load on all cores, for minutes: how many hosts are taken for lost
that were not?

A cycle speaks, and then publishes its state. `state_lost` counts published states from which a
standby did not go on; there must be none. `standby_repeated` counts outputs that it said again: one
where the power went between the output and its state, which nobody can know better, or else as
many as states were lost. `standby_skipped` counts outputs that nobody heard: of the standby's first
cycles, before the observer had found it. Of as many as `standbys_of_heard_states` the states were
heard to the last; of the others it is only known what was published before an output.
`restart_repeated` is the age of a kept state, in cycles.

Exit status: 1 where a state or a host was lost that should not have been.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from std_msgs.msg import Int64MultiArray

from benchmarks.handoff import Observer, Output
from benchmarks.handoff_nodes import QOS
from benchmarks.machine import percentile, print_report, say
from benchmarks.stopping import run
from rosrm import snapshots
from rosrm.config.settings import ClusterConfig, ControlSettings, HostConfig, LivenessSettings
from rosrm.model.values import (
    HostLossPolicy,
    MigrationPolicy,
    ProcessSpec,
    StandbyPolicy,
    StopPolicy,
)
from rosrm.ros.names import token
from rosrm.testing.local_cluster import LocalCluster
from rosrm.testing.loopback import enter_private_network

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
class GoneOn:
    """The cycle from which a successor continued.

    Attributes:
        said: last cycle of the predecessor with a received output.
        published: last cycle of the predecessor with a received state.
        first: cycle of the successor's first output.
    """

    said: int
    published: int
    first: int

    @property
    def lost(self) -> int:
        """Return the number of published states after the one from which it continued.

        Before a cycle's output, the state of the cycle before was published, received or not.
        """
        return max(0, max(self.published, self.said - 1) + 1 - self.first)

    @property
    def repeated(self) -> int:
        """Return the number of repeated outputs."""
        return max(0, self.said + 1 - self.first)

    @property
    def skipped(self) -> int:
        """Return the number of outputs that were not received, between the last and the first."""
        return max(0, self.first - self.said - 1)


class Witness(Observer):
    """Observer of the states as well as of the outputs."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain)
        #: Newest published cycle, by instance.
        self.states: dict[int, int] = {}
        self._topics: set[str] = set()

    def find_states(self) -> None:
        """Subscribe to the topics of states that exist by now."""
        for topic, types in self._node.get_topic_names_and_types():
            is_state = topic.endswith("/state") and "std_msgs/msg/Int64MultiArray" in types
            if is_state and topic not in self._topics:
                self._topics.add(topic)
                self._node.create_subscription(Int64MultiArray, topic, self._note, QOS)

    def _note(self, message: Int64MultiArray) -> None:
        number, sequence = message.data
        self.states[number] = max(sequence, self.states.get(number, 0))

    def gone_on(self, former: int, after: Output) -> GoneOn:
        """Return the cycle from which a successor continued, by its first output."""
        said = max(one.sequence for one in self.outputs if one.instance == former)
        return GoneOn(said, self.states.get(former, 0), after.sequence)


@dataclass
class Outcome:
    """The outcome of all rounds; seconds from the fault.

    Attributes:
        detect: until the host was lost.
        standby, restart: until the successor's first output.
        standby_gone_on, restart_gone_on: the cycles from which the successors continued.
    """

    detect: list[float] = field(default_factory=list)
    standby: list[float] = field(default_factory=list)
    restart: list[float] = field(default_factory=list)
    standby_gone_on: list[GoneOn] = field(default_factory=list)
    restart_gone_on: list[GoneOn] = field(default_factory=list)


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
        settings = ClusterConfig(liveness=liveness, control=control)
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
    for one, row in before.items():
        if row.host != host:
            continue
        after = _wait_for_successor(observer, row.number, _of(cluster, one, row.number))
        gone_on = observer.gone_on(row.number, after)
        seconds = after.received / _NS - fault
        if one == _GUARDED:
            outcome.standby.append(seconds)
            outcome.standby_gone_on.append(gone_on)
        else:
            outcome.restart.append(seconds)
            outcome.restart_gone_on.append(gone_on)
    outcome.detect.append(_lost_at(cluster, host, last_event) - fault)
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
            raise TimeoutError(f"no other host kept a new state of {_KEPT} in {_PATIENCE:g} s")
        cluster.client.spin(0.1)


def _copies(cluster: LocalCluster, own: str, number: int) -> dict[str, int]:
    """Return the other hosts with a replica of an instance's state on disk, and its cycle."""
    heads = {
        name: snapshots.newest_head(cluster.directory / "hosts" / name / "kept" / token(_KEPT))
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
    raise TimeoutError(f"#{number}, which follows #{former}, was not heard in {_PATIENCE:g} s")


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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=40, help="hosts that are switched off")
    parser.add_argument("--rate", type=float, default=50.0, help="Hz, of the nodes")
    parser.add_argument("--minutes", type=float, default=10.0, help="of load")
    chosen = parser.parse_args()
    alone = enter_private_network()
    outcome = measure(chosen.rounds, chosen.rate)
    losses = false_losses(chosen.minutes)
    lost = sum(one.lost for one in outcome.standby_gone_on)
    print_report(
        "failover",
        {
            "lease_s": _SHORT[0].lease, "rate_hz": chosen.rate,
            **_quantiles("detect", outcome.detect), **_quantiles("standby", outcome.standby),
            **_quantiles("restart", outcome.restart),
            "state_lost": lost,
            "standbys_of_heard_states": sum(
                one.published >= one.said - 1 for one in outcome.standby_gone_on
            ),
            "standby_repeated": sum(one.repeated for one in outcome.standby_gone_on),
            "standby_skipped": sum(one.skipped for one in outcome.standby_gone_on),
            "restart_repeated_most": max(
                (one.repeated for one in outcome.restart_gone_on), default=None
            ),
            "standbys": len(outcome.standby), "restarts": len(outcome.restart),
            "false_losses": sum(losses.values()), "false_losses_by_lease": losses,
            "load_minutes": chosen.minutes,
            "transports": "UDPv4, in a network namespace" if alone else "default, LOCALHOST",
        },
        runs=chosen.rounds,
    )  # fmt: skip
    return 1 if lost or any(losses.values()) else 0


def _quantiles(name: str, seconds: Sequence[float]) -> dict[str, float | None]:
    return {
        f"{name}_p{percent}_s": round(percentile(list(seconds), percent / 100), 3)
        if seconds
        else None
        for percent in (50, 99)
    }


if __name__ == "__main__":
    sys.exit(run("failover", main))
