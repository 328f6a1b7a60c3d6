"""One connection of the supervisor: lines in, lines out, never blocking."""

from __future__ import annotations

import socket
import struct
from typing import Final

from rosrm.supervisor import own_log
from rosrm.supervisor.json_lines import LineSplitter

#: Unread bytes at which a client is disconnected; it receives all statuses when it reconnects.
MOST_UNREAD: Final = 8 << 20
_CHUNK: Final = 1 << 16


class Connection:
    """A peer at the socket.

    Attributes:
        pid: of the peer, from the kernel.
        uid: of the peer, from the kernel.
        closing: the connection is closed once all unsent bytes have been sent.
        gone: no further bytes can be received or sent.
        environment: the base environment that its launches refer to.
    """

    def __init__(self, peer: socket.socket) -> None:
        peer.setblocking(False)
        credentials = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        self.pid, self.uid, _ = struct.unpack("3i", credentials)
        self.closing = False
        self.gone = False
        self.environment = ""
        self._peer = peer
        self._lines = LineSplitter()
        self._unsent = b""

    def fileno(self) -> int:
        """Return the descriptor for the selector."""
        return self._peer.fileno()

    @property
    def has_unsent(self) -> bool:
        """Return True if bytes wait until the peer reads."""
        return bool(self._unsent)

    def read(self) -> list[bytes]:
        """Return the lines received so far. Raises ProtocolError for one that is too long."""
        parts = []
        while not self.gone:
            try:
                part = self._peer.recv(_CHUNK)
            except BlockingIOError:
                break
            except OSError:  # a peer that was killed with unread data in its socket
                part = b""
            self.gone = not part
            parts.append(part)
            if len(part) < _CHUNK:
                break
        return self._lines.feed(b"".join(parts))

    def send(self, data: bytes) -> None:
        """Send the bytes that the peer can take now, and the rest in later calls."""
        self._unsent += data
        try:
            while self._unsent and not self.gone:
                self._unsent = self._unsent[self._peer.send(self._unsent) :]
        except BlockingIOError:
            self.gone = len(self._unsent) > MOST_UNREAD
        except OSError:  # the peer is gone; the next client receives every status again
            self.gone = True
        if self.closing and not self._unsent:
            self.gone = True

    def finish(self, data: bytes, timeout: float) -> None:
        """Send the last bytes, waiting at most `timeout` seconds for the peer to read.

        The connection stays open, because its end must mean the end of this process, as far as
        others can wait for that.
        """
        self._peer.settimeout(timeout)
        try:
            self._peer.sendall(self._unsent + data)
        except OSError as error:
            own_log.write(f"the client (pid {self.pid}) did not read the last messages: {error}")

    def close(self) -> None:
        """Release the socket."""
        self.gone = True
        self._peer.close()
