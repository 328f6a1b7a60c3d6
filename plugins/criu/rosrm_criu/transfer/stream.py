"""Archive received from its source, over as many connections as necessary."""

from __future__ import annotations

import contextlib
import hmac
import secrets
import ssl
import time
from typing import TYPE_CHECKING, Final

import urllib3
from urllib3.exceptions import HTTPError, NewConnectionError, SSLError

from rosrm.errors import TransferError
from rosrm_criu.transfer.addresses import nearest_first
from rosrm_criu.transfer.form import DIGEST_SIZE, READER_HEADER, Offer, new_digest
from rosrm_criu.transfer.zstd import ZstdDecompressor, ZstdError

if TYPE_CHECKING:
    from rosrm_criu.transfer.certificate import Identity

#: Seconds for one address to answer.
_CONNECT: Final = 2.0
#: Seconds without a byte until a connection is given up.
_SILENCE: Final = 5.0
#: Seconds to wait for the return of a source after a broken connection.
_PATIENCE: Final = 10.0
#: Seconds between two rounds of connection attempts to all its addresses.
_PAUSE: Final = 0.2
#: Most broken connections in one transfer.
_MOST_BREAKS: Final = 10
_PIECE: Final = 1 << 16
#: Bytes to read of an error response.
_WORDS: Final = 1000
_OK: Final = 200


class _Broken(Exception):
    """A connection that ended before the archive did; its text is the cause."""


class Stream:
    """Reader of an offered archive, which resumes broken connections.

    Args:
        offer: of the source.
        timeout: seconds for the whole transfer.
        identity: to show to the source, which knows its certificate.

    Attributes:
        address: of the source, once it was reached.
        received: compressed bytes that were received.
        resumed: number of broken connections that were resumed.
    """

    def __init__(self, offer: Offer, *, timeout: float, identity: Identity) -> None:
        self._offer = offer
        self._timeout = timeout
        self._deadline = time.monotonic() + timeout
        self._context = _context(identity)
        self._addresses = list(nearest_first(offer.addresses))
        self._headers = {
            "Authorization": f"Bearer {offer.token}",
            READER_HEADER: secrets.token_urlsafe(16),
        }
        self._pool: urllib3.HTTPSConnectionPool | None = None
        self._response: urllib3.BaseHTTPResponse | None = None
        self._decompressor = ZstdDecompressor()
        self._digest = new_digest()
        self._offset = 0
        self._break = ""
        self.address = ""
        self.received = 0
        self.resumed = 0

    def read(self, size: int, /) -> bytes:
        """Return at most `size` bytes of the archive; none at its end. Raise `TransferError`."""
        size = min(size, self._offer.length - self._offset)
        if size <= 0:
            return b""
        data = self._next(size)
        self._digest.update(data)
        return data

    def check(self) -> str:
        """Return the checksum of the archive, after the archive was read to its end.

        Raises:
            TransferError: the source sent a different checksum.
        """
        told = b""
        while len(told) < DIGEST_SIZE:
            told += self._next(DIGEST_SIZE - len(told))
        if not hmac.compare_digest(told, self._digest.digest()):
            raise TransferError(
                f"what came from {self.address} does not match its checksum: it was damaged on "
                "the way, or changed while it was sent"
            )
        return told.hex()

    def say_taken(self) -> None:
        """Confirm complete reception to the source; if this is lost, the offer ends in time."""
        assert self._pool is not None
        assert self._response is not None
        self._response.drain_conn()
        with contextlib.suppress(HTTPError, OSError):
            self._pool.urlopen("POST", "/taken", headers=self._headers, retries=False)

    def close(self) -> None:
        """Close the connection."""
        if self._response is not None:
            self._response.close()
            self._response = None
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def _next(self, size: int) -> bytes:
        while True:
            if self._response is None:
                self._connect()
            try:
                data = self._decompressed(size)
            except _Broken as broken:
                self.close()
                self._break = str(broken)
                self.resumed += 1
                if self.resumed > _MOST_BREAKS:
                    raise TransferError(self._story("it broke again and again")) from None
            else:
                self._offset += len(data)
                return data

    def _decompressed(self, size: int) -> bytes:
        """Return the next bytes, at least one."""
        while True:
            packed = self._packed() if self._decompressor.needs_input else b""
            try:
                data: bytes = self._decompressor.decompress(packed, size)
            except ZstdError as error:
                raise TransferError(f"what came from {self.address} is damaged: {error}") from None
            if data:
                return data
            if self._decompressor.eof:
                raise _Broken("the stream ended too soon")

    def _packed(self) -> bytes:
        assert self._response is not None
        now = time.monotonic()
        if now > self._deadline:
            raise TransferError(
                f"the transfer took longer than {self._timeout:g} s: {self._offset} of "
                f"{self._offer.length} bytes had come"
            )
        try:
            packed = self._response.read(_PIECE, decode_content=False)
        except (HTTPError, OSError) as error:
            raise _Broken(_words(error)) from None
        if not packed:
            raise _Broken("the stream ended too soon")
        self.received += len(packed)
        return packed

    def _connect(self) -> None:
        """Connect to the source, and request the stream from the next byte on."""
        until = min(self._deadline, time.monotonic() + _PATIENCE)
        while True:
            faults = []
            hopeless = True
            for address in self._addresses:
                try:
                    response = self._request(address)
                except (HTTPError, OSError) as error:
                    faults.append(f"{address}:{self._offer.port}: {_words(error)}")
                    hopeless = hopeless and _is_final(error)
                else:
                    self._begin(address, response)
                    return
            if hopeless or time.monotonic() > until:
                raise TransferError(self._story("; ".join(faults)))
            time.sleep(_PAUSE)

    def _request(self, address: str) -> urllib3.BaseHTTPResponse:
        self._pool = urllib3.HTTPSConnectionPool(
            address,
            self._offer.port,
            maxsize=1,
            timeout=urllib3.Timeout(
                connect=self._patience(_CONNECT), read=self._patience(_SILENCE)
            ),
            # A peer with this certificate has the key that was created for this offer.
            assert_fingerprint=self._offer.fingerprint,
            assert_hostname=False,
            ssl_context=self._context,
        )
        return self._pool.urlopen(
            "GET",
            f"/archive?from={self._offset}",
            headers=self._headers,
            retries=False,
            preload_content=False,
            decode_content=False,
        )

    def _patience(self, most: float) -> float:
        return max(0.1, min(most, self._deadline - time.monotonic()))

    def _begin(self, address: str, response: urllib3.BaseHTTPResponse) -> None:
        self._response = response
        self._decompressor = ZstdDecompressor()
        self.address = address
        self._addresses.sort(key=lambda one: one != address)
        if response.status != _OK:
            raise TransferError(
                f"{address}:{self._offer.port} refuses the transfer: {_answer(response)}"
            )

    def _story(self, why: str) -> str:
        if not self._break:
            return (
                f"the source cannot be reached: {why}; its offer, which stands for "
                f"{self._offer.seconds:g} s, may be over"
            )
        return (
            f"the transfer was cut after {self._offset} of {self._offer.length} bytes "
            f"({self._break}) and cannot go on: {why}"
        )


def _context(identity: Identity) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # urllib3 checks the fingerprint before it sends anything
    context.verify_mode = ssl.CERT_NONE
    identity.load_into(context)
    return context


def _answer(response: urllib3.BaseHTTPResponse) -> str:
    try:
        return response.read(_WORDS).decode(errors="replace")
    except (HTTPError, OSError):
        return f"status {response.status}"


def _is_final(error: Exception) -> bool:
    """Return True if waiting is useless: no server listens, or another server answers."""
    if isinstance(error, SSLError):
        return "ingerprint" in str(error)
    return isinstance(error, NewConnectionError) and isinstance(
        error.__cause__ or error.__context__, ConnectionRefusedError
    )


def _words(error: Exception) -> str:
    if isinstance(error, SSLError):
        return "another server answers" if _is_final(error) else "the TLS connection broke"
    if isinstance(error, NewConnectionError):
        cause = error.__cause__ or error.__context__
        return str(getattr(cause, "strerror", None) or cause).lower()
    if isinstance(error, urllib3.exceptions.TimeoutError):
        return "nothing came in time"
    return "the connection broke"
