"""Journal stall: the state of a master whose journal is not written yet, or cannot be written.

The decisions of the last turn are neither executed nor lost. The master waits for a slow write, and
retries a failed one. It executes the decisions, and decides again, only after the write succeeds.
During the stall the master sends beats, receives readings and answers queries. It refuses other
requests; while a write is merely slow, it first holds them for some seconds. The core's clock is
stopped, so that no deadline passes and no host counts as silent.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, get_args

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Command, Reply
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.recovery.journal_stall import note_readings
from rosrm.errors import JournalBlocked
from rosrm.master.journal_writer import JournalLate

_log = logging.getLogger("rosrm.master")

#: Seconds for which requests are held while a write is slow. A client waits 10 s for an answer, so
#: it receives the reason of a refusal.
_HOLD: Final = 5.0
#: Most queued status batches; the master requests the rest again from the slaves.
_MOST_STATUSES: Final = 10_000
#: Events whose sender waits for an answer.
_REQUESTS: Final = (happened.HostRegistered, *get_args(happened.ClientRequest))
#: Events that are dropped, because they recur.
_DROPPED: Final = (
    happened.TimePassed, happened.UsagesReceived, happened.PeerRefused, happened.SourceStranded,
)  # fmt: skip
#: Events of which only the newest of each host is kept.
_NEWEST: Final = (happened.ProcessRequested, happened.SnapshotsReported, happened.KeyRevoked)


@dataclass(slots=True)
class JournalStall:
    """Journal stall, from the first late or failed write of a group until the write succeeds.

    Attributes:
        commands: the commands that are not durable yet, in order.
        fault: the last failure; a `JournalLate` means that the write continues.
        since: monotonic time at which the first write was late or failed, seconds.
        core_now: time of the core's stopped clock.
        tried: monotonic time of the last attempt to write, seconds.
        refuses: True: requests are refused; False: they are held.
    """

    commands: Sequence[Command]
    fault: JournalBlocked
    since: float
    core_now: float
    tried: float
    refuses: bool = False
    _waiting: list[happened.Event] = field(default_factory=list)
    _newest: dict[tuple[type, int], happened.Event] = field(default_factory=dict)
    _statuses: int = 0

    @property
    def is_late(self) -> bool:
        """Return True while a write continues, which must not be repeated."""
        return isinstance(self.fault, JournalLate)

    def take(
        self, state: MasterState, events: Iterable[happened.Event],
        reply: Callable[[Reply], None], now: float,
    ) -> None:  # fmt: skip
        """Apply readings, hold or refuse requests, and queue other events.

        Args:
            state: of the core.
            events: in order.
            reply: sends a refusal.
            now: monotonic time, seconds.
        """
        if not self.refuses and (not self.is_late or now - self.since >= _HOLD):
            self.refuses = True
            _log.error(
                "%s. Running processes continue; the master accepts no new work until then",
                self.fault,
            )
            events, self._waiting, self._statuses = [*self._waiting, *events], [], 0
        for event in events:
            if isinstance(event, happened.ReadingsReceived):
                note_readings(state, event, self.core_now)
            elif self.refuses and isinstance(event, _REQUESTS):
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
            f"the master accepts no new work: {self.fault.public}. Running processes continue, and "
            f"the master accepts work again as soon as it can write"
        )
