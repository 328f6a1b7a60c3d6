"""TCP proxy between two ends of a connection, which can cut it or damage its data."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """A fault of one connection, after a number of bytes from the server.

    Attributes:
        after: number of bytes.
        flips: flip a bit of the next byte; otherwise the connection is cut.
    """

    after: int
    flips: bool = False


class Wire:
    """A proxy that listens on its own port and forwards each connection to a server.

    Args:
        port: of the server, on loopback.
        faults: of the first connections, in order; all others have none.
        for_each: returns the fault of a connection by its number from 0; replaces `faults`.
        then_gone: stop listening after the first fault that cuts a connection.
    """

    def __init__(
        self, port: int, *faults: Fault, for_each: Callable[[int], Fault] | None = None,
        then_gone: bool = False,
    ) -> None:  # fmt: skip
        self._server = port
        self._fault = for_each or (lambda n: faults[n] if n < len(faults) else None)
        self._then_gone = then_gone
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = []
        self.port = self._listener.getsockname()[1]
        self.connections = 0
        self.broke = threading.Event()
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            server = socket.create_connection(("127.0.0.1", self._server), timeout=10)
            fault = self._fault(self.connections)
            self.connections += 1
            self._open += [client, server]
            for source, sink, what in ((client, server, None), (server, client, fault)):
                threading.Thread(target=self._carry, args=(source, sink, what), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket, fault: Fault | None) -> None:
        left = fault.after if fault else None
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                if left is not None and len(data) > left:
                    if not fault.flips:
                        sink.sendall(data[:left])
                        if self._then_gone:
                            self._stop_listening()
                        self.broke.set()
                        break
                    data = data[:left] + bytes([data[left] ^ 1]) + data[left + 1 :]
                    left = None
                    self.broke.set()
                elif left is not None:
                    left -= len(data)
                sink.sendall(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _stop_listening(self) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def close(self) -> None:
        self._stop_listening()
        self._thread.join(10)
        for one in self._open:
            one.close()


@contextlib.contextmanager
def wire(port: int, *faults: Fault, **settings) -> Iterator[Wire]:
    between = Wire(port, *faults, **settings)
    try:
        yield between
    finally:
        between.close()
