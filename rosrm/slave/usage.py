"""Usage of each instance, measured by its session and published after the readings show it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

from rosrm.model.values import InstanceId, InstanceState, InstanceStatus
from rosrm.slave.instance_group import InstanceGroup
from rosrm.slave.sessions import SessionTable, SessionUsage

#: Readings that are published between the measurement of the usage and its publication. So the
#: master never releases a reservation before its readings include the load.
_READINGS_FIRST: Final = 3
_RUNS: Final = frozenset({InstanceState.RUNNING, InstanceState.STOPPING})


class UsageWatch:
    """Measurement of the sessions of the instances.

    Args:
        sessions: the table that the probes use too.
        group_of: returns the control group of an instance.
    """

    def __init__(
        self, sessions: SessionTable, group_of: Callable[[InstanceId], InstanceGroup]
    ) -> None:
        self._sessions = sessions
        self._group_of = group_of
        self._leaders: dict[InstanceId, int] = {}
        self._seen: Mapping[int, SessionUsage] = {}
        self._publish_in = 0

    def follow(self, status: InstanceStatus) -> None:
        """Update the table of sessions by the new status of an instance."""
        leader = self._leaders.get(status.instance, 0)
        runs = status.state in _RUNS and status.pid
        if leader and (leader != status.pid or not runs):
            self._sessions.remove(leader, status.cpu_time)
            del self._leaders[status.instance]
        if runs and status.instance not in self._leaders:
            self._sessions.add(status.pid, self._group_of(status.instance))
            self._leaders[status.instance] = status.pid

    def look(self, now: float, by_process: Mapping[int, Mapping[int, float]]) -> None:
        """Measure the usage of each instance, unless the last result is not published yet.

        Args:
            now: monotonic seconds.
            by_process: slot to pid to amount, as the probes measured it for the last reading.
        """
        if not self._leaders or self._seen:
            return
        self._sessions.refresh(now)
        usage = self._sessions.usage()
        self._seen = {
            one.number: replace(usage[pid], others=self._others(pid, by_process))
            for one, pid in self._leaders.items()
            if pid in usage
        }
        self._publish_in = _READINGS_FIRST

    def forget(self) -> None:
        """Forget the usage that is not published yet, because slots have other resources now."""
        self._seen = {}

    def _others(
        self, leader: int, by_process: Mapping[int, Mapping[int, float]]
    ) -> dict[int, float]:
        members = self._sessions.members(leader)
        return {
            slot: sum(amounts.get(pid, 0.0) for pid in members)
            for slot, amounts in by_process.items()
        }

    def after_reading(self) -> Mapping[int, SessionUsage]:
        """Count a published reading; return the usage to publish, by instance number, or {}."""
        self._publish_in -= 1
        if not self._seen or self._publish_in > 0:
            return {}
        seen, self._seen = self._seen, {}
        return seen
