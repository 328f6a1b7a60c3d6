"""A master whose journal cannot be written: what it has decided waits, and it decides nothing more.

What of one turn could not be made durable is neither carried out nor lost: it is tried again until
it can be written, and only then is it carried out and is anything else decided. Meanwhile the
master beats, takes readings and answers whoever only reads; other requests are refused. The core's
clock stands still, so that no deadline passes by it and no host counts as silent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Command, Reply
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.recovery.journal_stall import note_readings

#: Status batches that are kept for later; slaves are asked again for what is beyond.
_MOST_STATUSES: Final = 10_000
#: Requests that are turned away.
_REFUSED: Final = (
    happened.HostRegistered,
    happened.SubmissionReceived,
    happened.CancelRequested,
    happened.RestartRequested,
    happened.MigrationRequested,
    happened.CheckpointRequested,
    happened.RestoreRequested,
    happened.HostStateRequested,
    happened.PruneRequested,
)
#: These come again by themselves.
_DROPPED: Final = (happened.TimePassed, happened.UsagesReceived, happened.PeerRefused)


@dataclass(slots=True)
class Standstill:
    """From the moment at which a group could not be written until it is.

    Attributes:
        commands: what could not be made durable, in order.
        reason: why, for people.
        since: monotonic seconds.
        core_now: the time that it is for the core meanwhile.
        tried: when writing it was tried last.
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
        """Note what can be noted, turn requests away, keep the rest for later."""
        for event in events:
            if isinstance(event, happened.ReadingsReceived):
                note_readings(state, event, self.core_now)
            elif isinstance(event, _REFUSED):
                reply(Reply(event.request, False, "journal", self.refusal))
            elif isinstance(event, happened.ProcessRequested | happened.KeptStatesReceived):
                self._newest[type(event), event.host_id] = event  # no other counts any more
            elif not isinstance(event, _DROPPED):
                self._keep(event)

    def _keep(self, event: happened.Event) -> None:
        if isinstance(event, happened.StatusesReceived):
            self._statuses += 1
            if self._statuses > _MOST_STATUSES:
                return
        self._waiting.append(event)

    def waiting(self) -> list[happened.Event]:
        """What is to be decided afterwards, in order."""
        return [*self._waiting, *self._newest.values()]

    @property
    def refusal(self) -> str:
        """What a request is told."""
        return (
            f"the master accepts no new work: {self.reason}. Running processes continue, and the "
            f"master accepts work again as soon as it can write"
        )
