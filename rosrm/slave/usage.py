"""What each instance uses: its session is followed, and said once the readings show it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rosrm.model.values import InstanceId, InstanceState, InstanceStatus
from rosrm.slave.sessions import SessionTable, SessionUsage

#: Readings that go out between looking at what each instance uses and saying it: so the master
#: never takes a need for met that does not show in the readings which it has.
_READINGS_FIRST: Final = 3
_RUNS: Final = frozenset({InstanceState.RUNNING, InstanceState.STOPPING})


class UsageWatch:
    """Follows the sessions of the instances.

    Args:
        sessions: the table that the probes use too.
    """

    def __init__(self, sessions: SessionTable) -> None:
        self._sessions = sessions
        self._leaders: dict[InstanceId, int] = {}
        self._starting: set[InstanceId] = set()
        self._seen: Mapping[int, SessionUsage] = {}
        self._say_in = 0

    def follow(self, status: InstanceStatus) -> None:
        """Keep the table of sessions by what has become of an instance."""
        leader = self._leaders.get(status.instance, 0)
        runs = status.state in _RUNS and status.pid
        if leader and (leader != status.pid or not runs):
            self._sessions.remove(leader, status.cpu_time)
            del self._leaders[status.instance]
        elif status.state.ended and status.instance in self._starting:
            # Too short to have been seen running: its time counts too. That of an instance which
            # ended before this slave started does not.
            self._sessions.remove(status.pid, status.cpu_time)
        if status.state is InstanceState.STARTING:
            self._starting.add(status.instance)
        else:
            self._starting.discard(status.instance)
        if runs and status.instance not in self._leaders:
            self._sessions.add(status.pid)
            self._leaders[status.instance] = status.pid

    def look(self, now: float) -> None:
        """See what each instance uses, unless what was seen last has not been said yet."""
        if not self._leaders or self._seen:
            return
        self._sessions.refresh(now)
        usage = self._sessions.usage()
        self._seen = {one.number: usage[pid] for one, pid in self._leaders.items() if pid in usage}
        self._say_in = _READINGS_FIRST

    def after_reading(self) -> Mapping[int, SessionUsage]:
        """A reading went out: what is to be said now, by instance number; empty: nothing."""
        self._say_in -= 1
        if not self._seen or self._say_in > 0:
            return {}
        seen, self._seen = self._seen, {}
        return seen
