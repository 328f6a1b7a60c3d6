"""Fetch of an offered directory over one TLS connection; a failure leaves nothing."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import socket
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rosrm import clocks
from rosrm.errors import TransferError
from rosrm.runtime.disk_space import room_for
from rosrm.wording import reason_of
from rosrm_criu.transfer.addresses import nearest_first
from rosrm_criu.transfer.archive import Unpacker
from rosrm_criu.transfer.form import PART_HEAD, TAKEN, Fetched, Offer
from rosrm_criu.transfer.landing import StagingDirectory

if TYPE_CHECKING:
    from rosrm_criu.transfer.certificate import TlsIdentity

#: Seconds for one address to answer.
_CONNECT: Final = 2.0
#: Seconds without a byte until the connection is given up. TCP repeats a lost packet after 0.2,
#: 0.6, 1.4, 3, 6.2 and 12.6 s, so that the connection survives a cut of up to 12 s.
_SILENCE: Final = 15.0
#: Bytes per read.
_PIECE: Final = 1 << 16
#: Most bytes of a part of the stream, and of the reason why the source stops.
_LARGEST_PART: Final = 1 << 24
_LONGEST_REASON: Final = 1000
#: Bytes that a file may occupy beyond its content, rounded up.
_ROUNDING: Final = 4096


class _Stream:
    """Connection to the source of an offer, and reader of the compressed bytes from it.

    Args:
        offer: of the source.
        timeout: seconds for the whole transfer.
        identity: to show to the source, which knows its certificate.

    Attributes:
        address: of the source.
        received: compressed bytes that were received.

    Raises:
        TransferError: the source cannot be reached.
    """

    def __init__(self, offer: Offer, *, timeout: float, identity: TlsIdentity) -> None:
        self._offer = offer
        self._timeout = timeout
        self._deadline = clocks.boot_time() + timeout
        self._part = 0  # bytes that are left of the current part
        self.received = 0
        self._connection, self.address = self._connect(_context(identity))

    def read(self) -> bytes:
        """Return the next compressed bytes, at least one; raise `TransferError`."""
        if not self._part:
            self._part = int.from_bytes(self._exactly(PART_HEAD), "big")
            if not self._part:
                raise TransferError(
                    f"{self.address}:{self._offer.port} refuses the transfer: {self._reason()}"
                )
            if self._part > _LARGEST_PART:
                raise TransferError("the received data is damaged: a part of it is too large")
        data = self._receive(min(self._part, _PIECE))
        self._part -= len(data)
        self.received += len(data)
        return data

    def confirm(self) -> None:
        """Confirm complete reception to the source; if this is lost, the source sees a break."""
        with contextlib.suppress(OSError):
            self._connection.sendall(TAKEN)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _connect(self, context: ssl.SSLContext) -> tuple[ssl.SSLSocket, str]:
        """Return a connection to the first address that answers as the source, and the address."""
        faults = []
        for address in nearest_first(self._offer.addresses):
            try:
                return self._greet(address, context), address
            except (OSError, _AnotherServer) as error:
                faults.append(f"{address}:{self._offer.port}: {_cause(error)}")
        raise TransferError(
            f"the source cannot be reached: {'; '.join(faults)}; its offer, which stands for "
            f"{self._offer.seconds:g} s, may be over"
        )

    def _greet(self, address: str, context: ssl.SSLContext) -> ssl.SSLSocket:
        """Connect to an address, check the certificate, and only then send the token."""
        plain = socket.create_connection((address, self._offer.port), self._seconds(_CONNECT))
        with contextlib.ExitStack() as closing:
            closing.enter_context(plain)
            connection = closing.enter_context(context.wrap_socket(plain))
            shown = hashlib.sha256(connection.getpeercert(binary_form=True) or b"").hexdigest()
            # A peer with this certificate has the key that was created for this offer.
            if not hmac.compare_digest(shown, self._offer.fingerprint):
                raise _AnotherServer
            connection.sendall(f"{self._offer.token}\n".encode())
            closing.pop_all()
        return connection

    def _reason(self) -> str:
        reason = b""
        with contextlib.suppress(OSError):
            while len(reason) < _LONGEST_REASON:
                self._connection.settimeout(self._seconds(_CONNECT))
                piece = self._connection.recv(_LONGEST_REASON)
                if not piece:
                    break
                reason += piece
        return reason.decode(errors="replace")

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            data += self._receive(size - len(data))
        return data

    def _receive(self, size: int) -> bytes:
        """Return at most `size` bytes, and at least one; raise `TransferError`."""
        if clocks.boot_time() > self._deadline:
            raise TransferError(f"the transfer took longer than {self._timeout:g} s")
        try:
            self._connection.settimeout(self._seconds(_SILENCE))
            data = self._connection.recv(size)
        except TimeoutError:
            if clocks.boot_time() > self._deadline:
                return self._receive(size)
            raise TransferError(f"the transfer was cut: nothing came for {_SILENCE:g} s") from None
        except OSError as error:
            raise TransferError(f"the transfer was cut: {_cause(error)}") from None
        if not data:
            raise TransferError("the transfer was cut: the source closed the connection")
        return data

    def _seconds(self, most: float) -> float:
        return max(0.1, min(most, self._deadline - clocks.boot_time()))


class _AnotherServer(Exception):
    """The peer shows another certificate than that of the offer."""


def receive(
    offer: Offer, target: Path, *, timeout: float, reserve: int, identity: TlsIdentity,
    before_placing: Callable[[], None],
) -> Fetched:  # fmt: skip
    """Fetch a directory.

    Args:
        offer: of the source.
        target: path of the new directory, which must not exist yet.
        timeout: seconds for the whole fetch.
        reserve: bytes that must stay free on the file system.
        identity: the one whose certificate the source knows.
        before_placing: called after complete verification, before the target appears.

    Raises:
        TransferError: the directory cannot be fetched completely; nothing of it is left.
    """
    began = clocks.boot_time()
    if identity.fingerprint != offer.to:
        raise TransferError("what is offered is for another destination than this one")
    with contextlib.closing(StagingDirectory(target)) as landing:
        landing.require(offer.length + offer.files * _ROUNDING, reserve)
        with contextlib.closing(_Stream(offer, timeout=timeout, identity=identity)) as stream:
            checksum = _unpack(stream, offer, landing.path, target)
            before_placing()
            landing.become_target()
            stream.confirm()
    return Fetched(
        address=stream.address,
        size=offer.size,
        files=offer.files,
        received=stream.received,
        seconds=clocks.boot_time() - began,
        checksum=checksum,
    )


def _unpack(stream: _Stream, offer: Offer, directory: Path, target: Path) -> str:
    """Write the directory, and verify it; return its checksum."""
    unpacker = Unpacker(stream.read, offer.length, offer.files)
    try:
        unpacker.unpack(directory)
        return unpacker.check()
    except OSError as error:
        room = room_for(target)
        raise TransferError(
            f"{target} cannot be written: {reason_of(error)}" + (f"; {room}" if room else "")
        ) from None
    except TransferError as error:
        if unpacker.position < offer.length:
            come = f"{unpacker.position} of {offer.length} bytes had come"
            raise TransferError(f"{error}; {come}") from None
        raise


def _context(identity: TlsIdentity) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the fingerprint is compared before anything is sent
    context.verify_mode = ssl.CERT_NONE
    identity.load_into(context)
    return context


def _cause(error: Exception) -> str:
    if isinstance(error, _AnotherServer):
        return "another server answers"
    if isinstance(error, TimeoutError):
        return "no answer in time"
    if isinstance(error, ssl.SSLError):
        return "the TLS connection broke"
    return reason_of(error).lower() if isinstance(error, OSError) else str(error)
