"""Requests of a slave to the master for the contents of artifacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from rosrm.errors import Refused
from rosrm.keys.security import Member
from rosrm.ros import names
from rosrm.ros.control import ControlClient
from rosrm.ros.sealed import SealedClient, SealedEndpoints
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import srv

#: Seconds without use after which the client is destroyed.
_IDLE: Final = 60.0
#: Most bytes of one part.
_MOST: Final = 256 << 10


class ArtifactPart(NamedTuple):
    """Part of an archive.

    Attributes:
        size: bytes of the whole archive.
        data: b"": the archive ends before this part.
    """

    size: int
    data: bytes


class ArtifactEndpoint:
    """Client of the master's service `read_artifact`; it exists only while it is used."""

    def __init__(self, endpoints: SealedEndpoints[Member], name: str) -> None:
        self._endpoints = endpoints
        self._control = ControlClient(endpoints.participant, f"slave {name}")
        self._client: SealedClient | None = None
        self._used = 0.0

    def finds_master(self, now: float) -> bool:
        """Return True if the master's service is discovered."""
        self._used = now
        if self._client is None:
            path = names.Names(self._endpoints.participant.settings.namespace)
            self._client = self._endpoints.client(
                srv.ReadArtifact, path(names.READ_ARTIFACT), self._endpoints.security.master
            )
        return bool(self._client.service_is_ready())

    def ask(
        self, digest: str, offset: int, deadline: float,
        done: Callable[[ArtifactPart | Refused | None], None],
    ) -> None:  # fmt: skip
        """Request a part; `done` gets it, the master's refusal, or None: no answer in time.

        Args:
            offset: of the first byte.
            deadline: monotonic seconds.
        """
        request = srv.ReadArtifact.Request(
            protocol_version=PROTOCOL_VERSION, digest=digest, offset=offset, max_bytes=_MOST
        )

        def answered(response: srv.ReadArtifact.Response | None) -> None:
            if response is None:
                done(None)
            elif not response.answer.accepted:
                done(Refused(response.answer.message, response.answer.code))
            else:
                done(ArtifactPart(response.size, bytes(response.data)))

        self._control.call(self._client, request, deadline, answered)

    def expire(self, now: float) -> None:
        """End requests without an answer in time, and destroy an idle client."""
        self._control.expire(now)
        if self._client is not None and now - self._used >= _IDLE:
            self._client.destroy()
            self._client = None
