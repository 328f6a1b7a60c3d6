"""Search for another running master, by its beats and its answer to a handshake.

A beat alone does not prove that a master runs, because a recorded beat can be sent again, and with
`security: none` any participant can send one. So this master sends a handshake when it receives a
beat, and counts only a master that answers with the same run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from rosrm import clocks
from rosrm.keys.security import Authority, Member
from rosrm.model.durations import LONGEST
from rosrm.ros import names
from rosrm.ros.control import ControlClient, master_identity, version_refusal
from rosrm.ros.master.services import MasterIdentity
from rosrm.ros.sealed import SealedClient, SealedEndpoints
from rosrm.version import PROTOCOL_VERSION, __version__
from rosrm_msgs import msg, srv

#: Seconds for the answer of another master, and from one question to the next.
_PATIENCE: Final = 1.0


class RivalWatch:
    """Finds another master of this namespace.

    All masters of a namespace offer the same service, so this master must not answer its own
    question: it recognises it by its name as a client.

    Args:
        identity: of this master.
        refuse: receives the sender of a refused beat, and the reason.

    Attributes:
        found: newest beat of another master that answered; None: none since the last one was taken.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Authority], identity: MasterIdentity,
        refuse: Callable[[str, str], None],
    ) -> None:  # fmt: skip
        self._endpoints = endpoints
        self._identity = identity
        self._refuse = refuse
        self.found: msg.MasterBeat | None = None
        self._newest: msg.MasterBeat | None = None
        self._ask_at = -math.inf
        self._control = ControlClient(endpoints.participant, f"master {identity.name}")
        self._client: SealedClient | None = None

    def take_beat(self, beat: msg.MasterBeat, _run: bytes) -> None:
        """Take a beat; ask its sender for a handshake if it is another master."""
        if beat.incarnation == self._identity.incarnation:
            return
        fault = version_refusal(beat.protocol_version, "another master")
        if not fault and not 0.0 <= beat.uptime <= LONGEST:
            fault = f"a beat with an uptime of {beat.uptime} s"
        if fault:
            self._refuse(f"master {beat.name}", fault)
            return
        now = clocks.boot_time()
        self._newest = beat
        if now >= self._ask_at:
            self._ask_at = now + _PATIENCE
            self._ask(beat, now)

    def _ask(self, beat: msg.MasterBeat, now: float) -> None:
        def answered(answer: srv.Handshake.Response | None) -> None:
            if answer is None or master_identity(answer) != master_identity(beat):
                return
            newest = self._newest
            is_same = newest is not None and newest.incarnation == beat.incarnation
            self.found = newest if is_same else beat

        self.ask(now, answered)

    def ask(self, now: float, answered: Callable[[srv.Handshake.Response | None], None]) -> None:
        """Send a handshake to all other masters.

        `answered` is called with an answer, or with None after `_PATIENCE` seconds.
        """
        request = srv.Handshake.Request(
            protocol_version=PROTOCOL_VERSION, software_version=__version__, role="master",
            name=self._identity.as_client,
        )  # fmt: skip
        self._control.call(self._made_client(), request, now + _PATIENCE, answered)

    def _made_client(self) -> SealedClient:
        security: Member = self._endpoints.security.client()  # its secret may have changed
        if self._client is None:
            path = names.Names(self._endpoints.participant.settings.namespace)(names.HANDSHAKE)
            self._client = self._endpoints.client(srv.Handshake, path, security.master)
        self._client.peer = security.master
        return self._client

    def expire(self, now: float) -> None:
        """End a question without an answer in time."""
        self._control.expire(now)

    def take_found(self) -> msg.MasterBeat | None:
        """Return the newest beat of another master that has answered, once."""
        found, self.found = self.found, None
        return found
