"""Send buffer for a peer that may stop reading: a sender never blocks."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import threading
from typing import Final

from rosrm import clocks, threads
from rosrm.supervisor.discovery import writable

#: Most bytes that may wait for the peer, beside those in its socket.
MOST_UNSENT: Final = 8 << 20
#: Seconds that `close` waits for the sending thread.
_CLOSE_PATIENCE: Final = 5.0
_FLAGS: Final = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL


class Overfull(Exception):
    """Too many bytes wait for the peer; nothing was added."""


class Outgoing:
    """A queue of bytes for a socket; a thread sends in order what the socket does not take at once.

    Args:
        peer: the connected socket; `close` closes it too.
    """

    def __init__(self, peer: socket.socket) -> None:
        self._peer = peer
        self._lock = threading.Lock()
        self._unsent = bytearray()
        self._thread: threads.Thread | None = None
        self._took_at = 0.0
        self._gone = False

    @property
    def waits(self) -> float:
        """Seconds since the peer last took any of the waiting bytes; 0.0: nothing waits."""
        with self._lock:
            return clocks.awake_time() - self._took_at if self._unsent else 0.0

    @property
    def is_free(self) -> bool:
        """Return True if bytes would go out at once or the peer is gone (`send` raises)."""
        return not self.waits and (self._gone or writable(self._peer, 0.0))

    def send(self, data: bytes) -> None:
        """Send the bytes that the peer takes now, and the rest as it reads.

        Raises:
            Overfull: the peer has not read for so long that too much waits for it.
            OSError: the peer is gone.
        """
        with self._lock:
            if self._gone:
                raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
            if not self._unsent:
                self._send_first(data)
            elif len(self._unsent) + len(data) > MOST_UNSENT:
                raise Overfull
            else:
                self._unsent += data

    def _send_first(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                view = view[self._peer.send(view, _FLAGS) :]
        except BlockingIOError:
            self._unsent += view
            self._took_at = clocks.awake_time()
            self._start_sending()

    def _start_sending(self) -> None:
        try:
            self._thread = threads.start(self._send_rest, "orders", failed=lambda _: self.drop())
        except RuntimeError as fault:  # no further thread: nothing would send what waits
            self._gone = True
            self._unsent.clear()
            raise OSError(errno.EAGAIN, f"{fault}") from None

    def _send_rest(self) -> None:
        """Send the waiting bytes; runs in a thread of its own until nothing waits."""
        while writable(self._peer, None):
            with self._lock:
                if not self._send_some():
                    return

    def _send_some(self) -> bool:
        """Send what the socket takes; return True if bytes are left."""
        try:
            sent = 0 if self._gone else self._peer.send(self._unsent, _FLAGS)
        except BlockingIOError:
            return True
        except OSError:  # the next read or send on this connection fails too, and reports it
            self._gone = True
        else:
            del self._unsent[:sent]
            self._took_at = clocks.awake_time()
        if self._gone:
            self._unsent.clear()
        return bool(self._unsent)

    def drop(self) -> None:
        """Break the connection and wake its waiting threads; the peer can still read sent bytes."""
        with self._lock:
            self._gone = True
            with contextlib.suppress(OSError):  # the connection may be broken already
                self._peer.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Break the connection, and release the socket."""
        self.drop()
        if self._thread is not None:
            self._thread.join(_CLOSE_PATIENCE)
        self._peer.close()
