"""Connections of the gateway: how many there are, and how long each may wait for its client."""

from __future__ import annotations

import asyncio
import ssl
from collections import Counter
from typing import Any, Final, Literal, cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

from rosrm.threads import log_fault

#: Highest number of connections at the same time.
MOST_CONNECTIONS: Final = 128
#: Highest number of WebSockets among them, so that pages leave room for requests.
MOST_WEBSOCKETS: Final = 64
#: Seconds for the request line and the headers, and before them for the TLS handshake.
HEAD_TIMEOUT: Final = 10.0
#: Seconds for which a client may read its answer too slowly.
READ_TIMEOUT: Final = 20.0


class Connection(H11Protocol):
    """A connection that ends when its client is too slow.

    uvicorn limits the time between two requests, and `guard` that of a body. The limits here are on
    the head of a request, on the TLS handshake, and on the reading of answers. One connection more
    than `MOST_CONNECTIONS` ends the oldest one that waits for its client, so that no number of
    unfinished requests blocks other clients. Without such a connection the new one ends.

    Args:
        tls: context of the server; None: plain HTTP.
        uvicorn: arguments of `H11Protocol`.

    Attributes:
        begun: monotonic time (s) of its beginning.
    """

    def __init__(self, *, tls: ssl.SSLContext | None = None, **uvicorn: Any) -> None:
        super().__init__(**uvicorn)
        self._tls = tls
        self._handshake: asyncio.Task[None] | None = None
        self._early = b""
        self._timers: dict[Literal["head", "read"], asyncio.TimerHandle] = {}
        self.begun = self.loop.time()

    @property
    def address(self) -> str:
        """Return the address of the client; "": unknown."""
        return self.client[0] if self.client else ""

    @property
    def waits_for_client(self) -> bool:
        """Return True if the client has to send or to read something."""
        cycle: RequestResponseCycle | None = self.cycle
        if cycle is None or cycle.response_complete:
            return True
        return cycle.more_body or self.flow.write_paused

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to wait for a request."""
        super().connection_made(cast("asyncio.Transport", transport))
        if len(self.connections) > MOST_CONNECTIONS:
            _make_room(self)
        if self._tls is None:
            self._start_timer("head", HEAD_TIMEOUT)
        else:
            self.transport.pause_reading()  # `start_tls` continues
            self._handshake = self.loop.create_task(self._encrypt(self._tls))

    async def _encrypt(self, tls: ssl.SSLContext) -> None:
        try:
            transport = await self.loop.start_tls(
                self.transport, self, tls, server_side=True, ssl_handshake_timeout=HEAD_TIMEOUT
            )
        except OSError:  # also ssl.SSLError and a time-out: the client does not speak TLS
            transport = None
        except Exception as fault:  # noqa: BLE001 - otherwise the connection would stay for ever
            log_fault("a TLS handshake", fault)
            transport = None
        if transport is None:  # the client has left
            self.end()
            return
        self._handshake = None
        super().connection_made(transport)
        self._start_timer("head", HEAD_TIMEOUT)
        if self._early:  # asyncio passes the first data before it returns the transport
            self.data_received(self._early)

    def data_received(self, data: bytes) -> None:
        """Process data; start the time limit for a head at the first byte of a request."""
        if self._handshake is not None:
            self._early += data
            return
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._stop_timer("head")
        elif "head" not in self._timers:
            self._start_timer("head", HEAD_TIMEOUT)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Pass the connection to the protocol of WebSockets."""
        others = sum(not isinstance(one, Connection) for one in self.connections)
        if others < MOST_WEBSOCKETS:
            super().handle_websocket_upgrade(event)
        else:
            self.end()

    def _start_timer(self, name: Literal["head", "read"], seconds: float) -> None:
        self._timers[name] = self.loop.call_later(seconds, self.end)

    def _stop_timer(self, name: Literal["head", "read"]) -> None:
        if name in self._timers:
            self._timers.pop(name).cancel()

    def pause_writing(self) -> None:
        """Wait for a client that reads too slowly."""
        super().pause_writing()
        self._start_timer("read", READ_TIMEOUT)

    def resume_writing(self) -> None:
        """Continue, because the client has read enough."""
        super().resume_writing()
        self._stop_timer("read")

    def connection_lost(self, error: Exception | None) -> None:
        """Stop the timers of the closed connection."""
        self._stop_timer("head")
        self._stop_timer("read")
        super().connection_lost(error)

    def end(self) -> None:
        """End the connection; drop what its client has not read."""
        self.connections.discard(self)
        self.transport.abort()


def _make_room(new: Connection) -> None:
    """End a connection that waits for its client, or the new one.

    Among the waiting ones, the oldest one of the address with the most connections ends. So a
    machine that opens many connections does not displace others.
    """
    known = [one for one in new.connections if isinstance(one, Connection)]
    of_address = Counter(one.address for one in known)
    waiting = [one for one in known if one is not new and one.waits_for_client]
    order = lambda one: (-of_address[one.address], one.begun)  # noqa: E731
    min(waiting, key=order, default=new).end()
