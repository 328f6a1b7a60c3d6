"""Search of a starting master for a running one (docs/decisions/0066).

The master beats and offers its services already, so that slaves without a master register. Until
the search ends, nothing is decided: registrations wait among the events, handshakes of clients and
other masters wait for their answers, and requests for other runs are left to those runs.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from rosrm.core.master import events as happened
from rosrm.core.master.commands import Reply
from rosrm.keys.security import Authority
from rosrm.ros.master.endpoint import MasterEndpoint
from rosrm.ros.sealed import SealedEndpoints
from rosrm_msgs import srv

#: Seconds between two handshakes with any other master.
ASK_EVERY: Final = 0.1


class MasterSearch:
    """The search; it begins at once.

    Args:
        endpoints, endpoint: of the starting master.

    Attributes:
        found: the answer of another master; None: there is none so far.
    """

    def __init__(self, endpoints: SealedEndpoints[Authority], endpoint: MasterEndpoint) -> None:
        self._endpoints, self._endpoint = endpoints, endpoint
        self.found: srv.Handshake.Response | None = None
        endpoints.refuses_other_runs = False
        endpoint.services.hold_greetings()

    def ask(self, now: float) -> None:
        """Ask all other masters for a handshake; to be called every `ASK_EVERY` seconds."""
        self._endpoint.rivals.expire(now)
        self._endpoint.rivals.ask(now, self._take)

    def _take(self, answer: srv.Handshake.Response | None) -> None:
        self.found = self.found or answer

    def has_ended(self, hosts: Collection[str]) -> bool:
        """Return True if a master was found, or no other master has a host of the journal.

        A slave without a master registers with the first one that answers. So if all hosts of the
        journal wait here for their registration, no other master has one of them.
        """
        events = self._endpoint.events
        if self.found is not None or not 0 < len(hosts) <= len(events):
            return self.found is not None
        registering = {
            event.description.name for event in events if isinstance(event, happened.HostRegistered)
        }
        return registering.issuperset(hosts)

    def end(self) -> None:
        """Answer everything that waits, because this master starts."""
        self._endpoints.refuses_other_runs = True
        self._endpoint.services.answer_greetings()

    def give_way(self, reason: str) -> None:
        """Send the waiting slaves back to their search, because another master was found."""
        for event in self._endpoint.take_events():
            if isinstance(event, happened.HostRegistered):
                self._endpoint.services.reply(Reply(event.request, False, "journal", reason))
