"""Search for another running master, by its beats and its answer to a handshake.

A beat alone proves no master, because any participant can send one. So a master whose beat arrives
is asked for a handshake, and only one that answers as the same run counts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Final

from rosrm.model.durations import LONGEST
from rosrm.ros import names, qos
from rosrm.ros.control import ControlClient, master_identity, version_refusal
from rosrm.ros.participant import Participant
from rosrm.version import PROTOCOL_VERSION, __version__
from rosrm_msgs import msg, srv

#: Seconds for the answer of another master, and from one question to the next.
_PATIENCE: Final = 1.0


class RivalWatch:
    """Finds another master of this namespace.

    All masters of a namespace offer the same service, so this master must not answer its own
    question: it recognises it by `own_name`.

    Args:
        master: name of this master.
        incarnation: of its run.
        refuse: receives the sender of a refused beat, and the reason.

    Attributes:
        found: newest beat of another master that answered; None: none since the last one was taken.
        own_name: name under which this master asks for a handshake.
    """

    def __init__(
        self, participant: Participant, master: str, incarnation: int,
        refuse: Callable[[str, str], None],
    ) -> None:  # fmt: skip
        self._participant = participant
        self._incarnation = incarnation
        self._refuse = refuse
        self.found: msg.MasterBeat | None = None
        self.own_name = f"{master} {incarnation}"
        self._newest: msg.MasterBeat | None = None
        self._ask_at = -math.inf
        self._control = ControlClient(participant, f"master {master}")
        self._client: Any = None

    def take_beat(self, beat: msg.MasterBeat) -> None:
        """Take a beat; ask its sender for a handshake if it is another master."""
        if beat.incarnation == self._incarnation:
            return
        fault = version_refusal(beat.protocol_version, "another master")
        if not fault and not 0.0 <= beat.uptime <= LONGEST:
            fault = f"a beat with an uptime of {beat.uptime} s"
        if fault:
            self._refuse(f"master {beat.name}", fault)
            return
        now = time.monotonic()
        self._newest = beat
        if now >= self._ask_at:
            self._ask_at = now + _PATIENCE
            self._ask(beat, now)

    def _ask(self, beat: msg.MasterBeat, now: float) -> None:
        request = srv.Handshake.Request(
            protocol_version=PROTOCOL_VERSION, software_version=__version__, role="master",
            name=self.own_name,
        )  # fmt: skip

        def answered(answer: srv.Handshake.Response | None) -> None:
            if answer is None or master_identity(answer) != master_identity(beat):
                return
            newest = self._newest
            is_same = newest is not None and newest.incarnation == beat.incarnation
            self.found = newest if is_same else beat

        self._control.call(self._made_client(), request, now + _PATIENCE, answered)

    def _made_client(self) -> Any:
        if self._client is None:
            path = names.Names(self._participant.settings.namespace)(names.HANDSHAKE)
            self._client = self._participant.node.create_client(
                srv.Handshake, path, qos_profile=qos.SERVICE
            )
        return self._client

    def expire(self, now: float) -> None:
        """End a question without an answer in time."""
        self._control.expire(now)

    def take_found(self) -> msg.MasterBeat | None:
        """Return the newest beat of another master that has answered, once."""
        found, self.found = self.found, None
        return found
