"""Search of a starting master for a running one (docs/decisions/0066).

During the search the starting master sends beats and offers its services, so that slaves without a
master register. The master decides nothing yet: registrations wait as events, handshakes of clients
and other masters wait for their answers, and requests for another run get no answer, because that
run may still answer them.
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

#: Seconds between two handshakes that are sent to all other masters.
ASK_EVERY: Final = 0.1


class MasterSearch:
    """Search for another master; creating the object begins the search.

    Args:
        endpoints, endpoint: of the starting master.

    Attributes:
        found: the answer of another master; None: there is none so far.
    """

    def __init__(self, endpoints: SealedEndpoints[Authority], endpoint: MasterEndpoint) -> None:
        self._endpoints, self._endpoint = endpoints, endpoint
        self.found: srv.Handshake.Response | None = None
        endpoints.refuses_other_runs = False
        endpoint.services.hold_handshakes()

    def ask(self, now: float) -> None:
        """Ask all other masters for a handshake; to be called every `ASK_EVERY` seconds."""
        self._endpoint.rivals.expire(now)
        self._endpoint.rivals.ask(now, self._take)

    def _take(self, answer: srv.Handshake.Response | None) -> None:
        self.found = self.found or answer

    def has_ended(self, hosts: Collection[str]) -> bool:
        """Return True if another master answered, or none can have a host of the journal.

        A slave without a master registers with the first one that answers. So if all hosts of the
        journal wait here for their registration, no other master has one of them.
        """
        if self.found is not None:
            return True
        events = self._endpoint.events
        if not hosts or len(events) < len(hosts):
            return False
        registering = {
            event.description.name for event in events if isinstance(event, happened.HostRegistered)
        }
        return registering.issuperset(hosts)

    def end(self) -> None:
        """Answer the held handshakes, and refuse requests for other runs again."""
        self._endpoints.refuses_other_runs = True
        self._endpoint.services.answer_held_handshakes()

    def refuse_registrations(self, reason: str) -> None:
        """Refuse the waiting registrations with `journal`: the slaves then find that master."""
        for event in self._endpoint.take_events():
            if isinstance(event, happened.HostRegistered):
                self._endpoint.services.reply(Reply(event.request, False, "journal", reason))
