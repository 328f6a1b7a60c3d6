"""TLS server of one directory for one reader, until it is fetched or the offer expires.

A reader sends the token of the offer, receives the archive and its checksum in parts (`form`), and
confirms that it has verified everything. Only the first reader with the token is accepted, and if
its connection breaks, the offer ends. TLS admits only the destination whose certificate is known.
"""

from __future__ import annotations

import contextlib
import hmac
import secrets
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final, Literal

from rosrm import clocks, threads
from rosrm.errors import TransferError
from rosrm_criu.transfer.addresses import own_addresses
from rosrm_criu.transfer.archive import Archive
from rosrm_criu.transfer.certificate import TlsIdentity, fingerprint_of, new_identity
from rosrm_criu.transfer.form import PART_HEAD, TAKEN, Offer, OfferResult

_LOOPBACK: Final = "127.0.0.1"
#: Seconds for a reader to complete the TLS handshake and to send the token.
_GREETING: Final = 10.0
#: Seconds until connections are accepted again, where there was no room for one.
_ACCEPT_AGAIN: Final = 0.1
#: Maximum number of connections, each with a thread, whose reader is not admitted yet.
_MOST_STRANGERS: Final = 16
#: Seconds of unused time that may be made up at once.
_SLACK: Final = 0.05
#: Bytes of the line with the token, at most.
_LONGEST: Final = 256


class RateLimiter:
    """Rate limiter that spreads bytes evenly over time, so that others can use the network too.

    Args:
        rate: bytes per second; 0: no bound.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._due = 0.0

    def wait(self, size: int, now: float) -> float:
        """Return the seconds to pause.

        Args:
            size: bytes that were just sent.
            now: monotonic time in seconds.
        """
        if not self._rate:
            return 0.0
        self._due = max(self._due, now - _SLACK) + size / self._rate
        return max(0.0, self._due - now)


class _Server:
    """Listener with a thread for each connection, so that a silent stranger blocks no reader.

    Args:
        archive: the archive to send.
        context: TLS settings, with the certificate of the only reader.
        max_rate: most bytes per second to send; 0: no bound.
        over: set once the reader has confirmed everything, or its connection broke.

    Attributes:
        token: which a reader has to send.
        port: of the listener.
        outcome: "taken" or "broken" once `over` is set here; None before.
        sent: bytes that were sent.
    """

    def __init__(
        self, archive: Archive, context: ssl.SSLContext, max_rate: float, over: threading.Event
    ) -> None:
        self._archive = archive
        self._context = context
        self._pace = RateLimiter(max_rate)
        self._over = over
        self._listener = socket.create_server(("", 0))
        self._admitting = threading.Lock()
        self._reader: ssl.SSLSocket | None = None
        #: Connections whose reader is not admitted yet; each has a thread.
        self._strangers: deque[ssl.SSLSocket] = deque()
        self.token = secrets.token_urlsafe(32)
        self.port: int = self._listener.getsockname()[1]
        self.outcome: Literal["taken", "broken"] | None = None
        self.sent = 0

    def start(self) -> None:
        """Accept connections in the background."""
        threads.start(self._accept, "listener", again=True)

    def close(self) -> None:
        """Stop listening, and cut the transmission under way."""
        with self._admitting:
            for one in (self._listener, self._reader):
                if one is not None:
                    # This wakes the socket's thread. SSLSocket.shutdown would change its TLS state.
                    with contextlib.suppress(OSError):
                        socket.socket.shutdown(one, socket.SHUT_RDWR)
            self._listener.close()

    def _accept(self) -> None:
        while self._listener.fileno() >= 0:
            try:
                plain, _ = self._listener.accept()
                threads.start(partial(self._converse, plain), "reader")
            except OSError:  # closed, or no room for another connection now
                self._over.wait(_ACCEPT_AGAIN)

    @contextlib.contextmanager
    def _greeting(self, new: ssl.SSLSocket) -> Iterator[None]:
        """Count a connection without an admitted reader; beyond the bound the oldest one ends."""
        self._strangers.append(new)
        with contextlib.suppress(OSError, IndexError):  # it has ended
            if len(self._strangers) > _MOST_STRANGERS:
                socket.socket.shutdown(self._strangers.popleft(), socket.SHUT_RDWR)
        try:
            yield
        finally:
            with contextlib.suppress(ValueError):
                self._strangers.remove(new)

    def _converse(self, plain: socket.socket) -> None:
        with plain, contextlib.suppress(OSError):  # a stranger's handshake may fail
            plain.settimeout(_GREETING)
            with self._context.wrap_socket(
                plain, server_side=True, do_handshake_on_connect=False
            ) as connection:
                with self._greeting(connection):
                    connection.do_handshake()
                    refusal = self._refusal(connection)
                if refusal:
                    _say_fault(connection, refusal)
                    return
                try:
                    taken = self._send(connection)
                except OSError:
                    taken = False
                self.outcome = "taken" if taken else "broken"
                self._over.set()

    def _refusal(self, connection: ssl.SSLSocket) -> str:
        """Return the reason to refuse a connection; "": the reader is admitted."""
        line = b""
        while not line.endswith(b"\n") and len(line) < _LONGEST:
            piece = connection.recv(_LONGEST)
            if not piece:
                break
            line += piece
        if not hmac.compare_digest(line, f"{self.token}\n".encode()):
            return "the token is not the one of this offer"
        with self._admitting:
            if self._reader is not None:
                return "another reader fetches it already, and an offer can be used once"
            self._reader = connection
        return ""

    def _send(self, connection: ssl.SSLSocket) -> bool:
        """Send the archive; return True if the reader confirms it. Raise `OSError`."""
        connection.settimeout(None)  # the offer bounds the time
        try:
            for piece in self._archive.compressed():
                connection.sendall(len(piece).to_bytes(PART_HEAD, "big") + piece)
                self.sent += len(piece)
                time.sleep(self._pace.wait(len(piece), clocks.boot_time()))
        except TransferError as error:
            _say_fault(connection, str(error))
            return False
        return connection.recv(1) == TAKEN


def _say_fault(connection: ssl.SSLSocket, why: str) -> None:
    connection.sendall(bytes(PART_HEAD) + why.encode(errors="replace"))


def _context(identity: TlsIdentity, to: str) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    identity.load_into(context)
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(cadata=to)
    return context


def serve(
    directory: Path, *, seconds: float, max_rate: float, to: str,
    announce: Callable[[Offer], None], over: threading.Event,
) -> OfferResult:  # fmt: skip
    """Offer a directory, and wait for the end of the offer.

    Args:
        directory: offered completely, in its current state.
        seconds: validity of the offer.
        max_rate: most compressed bytes per second to send; 0: no bound.
        to: certificate of the only destination that may fetch it, in PEM.
        announce: receives the offer once it can be fetched.
        over: set by the caller to withdraw the offer, and by this function at its end.

    Raises:
        TransferError: the directory cannot be offered.
    """
    archive = Archive(directory)
    try:
        only = fingerprint_of(to)
    except ValueError:
        raise TransferError("the destination's certificate is no certificate") from None
    identity = new_identity()
    server = _Server(archive, _context(identity, to), max_rate, over)
    try:
        server.start()
        announce(
            Offer(
                addresses=own_addresses() or (_LOOPBACK,),
                port=server.port,
                fingerprint=identity.fingerprint,
                token=server.token,
                size=archive.size,
                files=archive.files,
                length=archive.length,
                seconds=seconds,
                to=only,
            )
        )
        was_set = over.wait(seconds)
        outcome = server.outcome or ("withdrawn" if was_set else "expired")
    finally:
        server.close()
    return OfferResult(outcome, server.sent)
