"""Journal stall: the state of a master that cannot write its journal.

The decisions of the last turn are neither executed nor lost. The master retries to write them, and
executes them and decides again only after that succeeds. During the stall the master sends beats,
receives readings and answers queries; it refuses other requests. The core's clock is stopped, so
that no deadline passes and no host counts as silent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Command, Reply
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.recovery.journal_stall import note_readings

#: Most queued status batches; the master requests the rest again from the slaves.
_MOST_STATUSES: Final = 10_000
#: Events that are dropped, because they recur.
_DROPPED: Final = (
    happened.TimePassed, happened.UsagesReceived, happened.PeerRefused, happened.SourceStranded,
)  # fmt: skip
#: Events of which only the newest of each host is kept.
_NEWEST: Final = (happened.ProcessRequested, happened.SnapshotsReported, happened.KeyRevoked)


@dataclass(slots=True)
class JournalStall:
    """Journal stall, from the first failed write of a group until the write succeeds.

    Attributes:
        commands: the commands that are not durable yet, in order.
        reason: text of the failure, for clients.
        since: monotonic time of the first failure, seconds.
        core_now: time of the core's stopped clock.
        tried: monotonic time of the last attempt to write, seconds.
    """

    commands: Sequence[Command]
    reason: str
    since: float
    core_now: float
    tried: float
    _waiting: list[happened.Event] = field(default_factory=list)
    _newest: dict[tuple[type, int], happened.Event] = field(default_factory=dict)
    _statuses: int = 0

    def take(
        self, state: MasterState, events: Iterable[happened.Event], reply: Callable[[Reply], None]
    ) -> None:
        """Apply readings, refuse requests, and queue other events."""
        for event in events:
            if isinstance(event, happened.ReadingsReceived):
                note_readings(state, event, self.core_now)
            elif isinstance(event, happened.HostRegistered | happened.ClientRequest):
                reply(Reply(event.request, False, "journal", self.refusal))
            elif isinstance(event, _NEWEST):
                self._newest[type(event), event.host_id] = event  # replaces older ones
            elif not isinstance(event, _DROPPED):
                self._keep(event)

    def _keep(self, event: happened.Event) -> None:
        if isinstance(event, happened.StatusesReceived):
            self._statuses += 1
            if self._statuses > _MOST_STATUSES:
                return
        self._waiting.append(event)

    def waiting(self) -> list[happened.Event]:
        """Return the events to decide after the stall, in order."""
        return [*self._waiting, *self._newest.values()]

    @property
    def refusal(self) -> str:
        """Return the reason with which requests are refused."""
        return (
            f"the master accepts no new work: {self.reason}. Running processes continue, and the "
            f"master accepts work again as soon as it can write"
        )
