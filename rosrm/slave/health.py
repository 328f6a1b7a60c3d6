"""Health checks of instances; the slave's core decides on their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from rosrm.core.slave.events import LookedAt
from rosrm.core.slave.state import HeldInstance
from rosrm.core.slave.watches import Observation, Watch
from rosrm.model.values import InstanceId
from rosrm.ros.participant import Participant
from rosrm.ros.slave.graph import GraphWatch
from rosrm.ros.slave.health import HealthMonitor, SimulatedClock
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.sessions import SessionTable
from rosrm.supervisor.procfs import read_stat

#: State in /proc of a process that a signal has stopped; "t" means stopped by a debugger.
_STOPPED: Final = "T"


class HealthWatch:
    """Health checks of the watched instances, subscribed only to the configured topics.

    The participant creates a node when the first instance needs a topic or a lifecycle state.

    Attributes:
        watches: True if the last call of `look` had instances to check.
    """

    def __init__(
        self, participant: Participant, graph: GraphWatch, sessions: SessionTable,
        launchers: Launchers,
    ) -> None:  # fmt: skip
        self._participant, self._graph, self._sessions = participant, graph, sessions
        self._launchers = launchers
        self.watches = False
        self._node: Any = None
        self._clock: SimulatedClock | None = None
        self._monitors: dict[tuple[InstanceId, int], HealthMonitor] = {}

    def look(self, watched: Mapping[InstanceId, HeldInstance], now: float) -> list[LookedAt]:
        """Return the result of one check of each watched instance; a check that fails has none."""
        self.watches = bool(watched)
        runs = {(instance, held.status.pid) for instance, held in watched.items()}
        for run in [run for run in self._monitors if run not in runs]:
            self._monitors.pop(run).close()
        results: list[LookedAt] = []
        for instance, held in watched.items():
            self._participant.guard.call(self._check, instance, held, now, results.append)
        return results

    def _check(
        self, instance: InstanceId, held: HeldInstance, now: float,
        result: Callable[[LookedAt], None],
    ) -> None:  # fmt: skip
        watch = held.watched
        # Where a launcher cannot tell, a silent node may be being moved: that is no observation.
        if watch is not None and self._launchers.has_departed(held.status.pid) is False:
            look = self._look(instance, held.status.pid, watch, now)
            result(LookedAt(instance, held.status.pid, look))

    def _look(self, instance: InstanceId, pid: int, watch: Watch, now: float) -> Observation:
        stat = read_stat(self._launchers.root(pid))
        stopped = stat is not None and stat.state == _STOPPED
        if not watch.topics and not watch.services:
            return Observation(stopped)
        monitor = self._monitors.get((instance, pid))
        if monitor is None:
            monitor = self._monitors[instance, pid] = self._listen(watch, now)
        messages, trouble = monitor.topic(self._sessions.known_as(pid), now)
        clock = monitor.clock(now)
        return Observation(stopped, messages, trouble, monitor.state(now), clock)

    def _listen(self, watch: Watch, now: float) -> HealthMonitor:
        if self._node is None:
            name = f"{self._participant.node.get_name()}_health"
            self._node = self._participant.unwatched_node(name)
            self._clock = SimulatedClock(self._node)
        return HealthMonitor(self._node, self._graph, watch, now, self._clock)
