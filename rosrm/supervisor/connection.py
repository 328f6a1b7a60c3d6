"""One connection to the supervisor: lines in, lines out, never waiting."""

from __future__ import annotations

import socket
import struct
from typing import Final

from rosrm.supervisor import own_log
from rosrm.supervisor.json_lines import Lines

#: A client that leaves so many bytes unread is cut off; it hears everything anew when it returns.
MOST_UNREAD: Final = 8 << 20
_CHUNK: Final = 1 << 16


class Connection:
    """A peer at the socket.

    Attributes:
        pid: of the peer, as the kernel says.
        uid: of the peer, as the kernel says.
        closing: it is closed as soon as what is to be sent has been.
        gone: nothing more can come from it or go to it.
        environment: the base that its launches name.
    """

    def __init__(self, peer: socket.socket) -> None:
        peer.setblocking(False)
        credentials = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        self.pid, self.uid, _ = struct.unpack("3i", credentials)
        self.closing = False
        self.gone = False
        self.environment = ""
        self._peer = peer
        self._lines = Lines()
        self._unsent = b""

    def fileno(self) -> int:
        """For the selector."""
        return self._peer.fileno()

    @property
    def has_unsent(self) -> bool:
        """Something waits until the peer reads."""
        return bool(self._unsent)

    def read(self) -> list[bytes]:
        """The lines that have come. Raises ProtocolError where one is too long."""
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
        """Send now what the peer can take, and the rest with later calls."""
        self._unsent += data
        try:
            while self._unsent and not self.gone:
                self._unsent = self._unsent[self._peer.send(self._unsent) :]
        except BlockingIOError:
            self.gone = len(self._unsent) > MOST_UNREAD
        except OSError:  # it is gone; what it was told is told again to the next
            self.gone = True
        if self.closing and not self._unsent:
            self.gone = True

    def finish(self, data: bytes, timeout: float) -> None:
        """Send the last that it is told, waiting at most `timeout` seconds for it to read.

        The connection stays open: its end is to mean that this process is gone.
        """
        self._peer.settimeout(timeout)
        try:
            self._peer.sendall(self._unsent + data)
        except OSError as error:
            own_log.say(f"the client (pid {self.pid}) was not told the rest: {error}")

    def close(self) -> None:
        """Release the socket."""
        self.gone = True
        self._peer.close()
