"""HTTPS server of one directory for one reader, until it is fetched or the offer expires.

    GET /archive?from=N   archive and checksum from byte N on, compressed
    POST /taken           the reader has received and verified everything: ends the offer

Both need `Authorization: Bearer TOKEN` and a random number of the reader (`Rosrm-Reader`). Only the
first reader with the token is accepted: it may resume a broken connection, and all others are
refused. TLS admits only the destination whose certificate is known.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
import socket
import ssl
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from aiohttp import web

from rosrm.errors import TransferError
from rosrm_criu.transfer.addresses import own_addresses
from rosrm_criu.transfer.archive import Archive
from rosrm_criu.transfer.certificate import Identity, fingerprint_of, new_identity
from rosrm_criu.transfer.form import DIGEST_SIZE, READER_HEADER, Offer, Sent
from rosrm_criu.transfer.rate import Pace
from rosrm_criu.transfer.zstd import compressed

_LOOPBACK: Final = "127.0.0.1"
#: Seconds to send the answer to the last request.
_FAREWELL: Final = 2.0


class _Refusal(Exception):
    """Refusal of a request; its text is sent to the reader."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


class _Desk:
    """Handlers that send the archive.

    Attributes:
        taken: set once the reader has received everything.
        sent: bytes that were sent.
    """

    def __init__(self, archive: Archive, token: str, max_rate: float) -> None:
        self._archive = archive
        self._token = token
        self._pace = Pace(max_rate)
        self._reader = ""
        self._sending: asyncio.Task[object] | None = None
        self._fault = ""
        self.taken = asyncio.Event()
        self.sent = 0

    async def archive(self, request: web.Request) -> web.StreamResponse:
        """Send the archive, from the byte that the reader requests."""
        try:
            start = self._start(request)
        except _Refusal as refusal:
            return web.Response(status=refusal.status, text=str(refusal))
        self.stop()  # the reader has given up that connection
        self._sending = own = asyncio.current_task()
        response = web.StreamResponse(headers={"Content-Type": "application/zstd"})
        try:
            await response.prepare(request)
            await self._send(response, start)
        except ConnectionError:
            return response  # the reader may reconnect
        except TransferError as error:
            self._fault = str(error)  # sent to the reader when it reconnects
            if request.transport is not None:
                request.transport.abort()
        finally:
            if self._sending is own:  # its connection may serve another request later
                self._sending = None
        return response

    async def take(self, request: web.Request) -> web.Response:
        """Accept the reader's confirmation that it has received everything."""
        try:
            self._admit(request)
        except _Refusal as refusal:
            return web.Response(status=refusal.status, text=str(refusal))
        self.taken.set()
        return web.Response(status=204)

    def _start(self, request: web.Request) -> int:
        self._admit(request)
        if self._fault:
            raise _Refusal(410, self._fault)
        text = request.query.get("from", "0")
        if not (text.isascii() and text.isdigit() and len(text) < 20):
            raise _Refusal(400, "'from' is no number of bytes")
        start = int(text)
        if start >= self._archive.length + DIGEST_SIZE:
            raise _Refusal(416, "there is nothing from there on")
        return start

    def _admit(self, request: web.Request) -> None:
        brought = _bytes(request.headers.get("Authorization", ""))
        if not hmac.compare_digest(brought, f"Bearer {self._token}".encode()):
            raise _Refusal(401, "the token is not the one of this offer")
        reader = request.headers.get(READER_HEADER, "")
        if not reader:
            raise _Refusal(400, f"the request has no {READER_HEADER}")
        self._reader = self._reader or reader
        if not hmac.compare_digest(_bytes(reader), _bytes(self._reader)):
            raise _Refusal(403, "another reader fetches it already, and an offer can be used once")

    def stop(self) -> None:
        """Cancel the transmission under way, if there is one."""
        if self._sending is not None:
            self._sending.cancel()

    async def _send(self, response: web.StreamResponse, start: int) -> None:
        for piece in compressed(self._archive.pieces(start)):
            await response.write(piece)
            self.sent += len(piece)
            await asyncio.sleep(self._pace.wait(len(piece), time.monotonic()))
        await response.write_eof()


def _bytes(header: str) -> bytes:
    """Return the bytes of a header as they were received."""
    return header.encode("utf-8", "surrogateescape")


def _context(identity: Identity, to: str) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    identity.load_into(context)
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(cadata=to)
    return context


async def serve(
    directory: Path, *, seconds: float, max_rate: float, to: str,
    announce: Callable[[Offer], None], withdrawn: asyncio.Event,
) -> Sent:  # fmt: skip
    """Offer a directory, and wait for the end of the offer.

    Args:
        directory: offered completely, in its current state.
        seconds: validity of the offer.
        max_rate: most compressed bytes per second to send; 0: no bound.
        to: certificate of the only destination that may fetch it, in PEM.
        announce: receives the offer once it can be fetched.
        withdrawn: set to end the offer.

    Raises:
        TransferError: the directory cannot be offered.
    """
    archive = Archive(directory)
    try:
        only = fingerprint_of(to)
    except ValueError:
        raise TransferError("what came as the destination's certificate is none") from None
    identity = new_identity()
    desk = _Desk(archive, token := secrets.token_urlsafe(32), max_rate)
    application = web.Application()
    application.add_routes([web.get("/archive", desk.archive), web.post("/taken", desk.take)])
    # No access log, because it is not needed and could leak secrets.
    runner = web.AppRunner(application, access_log=None, shutdown_timeout=_FAREWELL)
    await runner.setup()
    try:
        listener = socket.create_server(("", 0))
        await web.SockSite(runner, listener, ssl_context=_context(identity, to)).start()
        announce(
            Offer(
                addresses=own_addresses() or (_LOOPBACK,),
                port=listener.getsockname()[1],
                fingerprint=identity.fingerprint,
                token=token,
                size=archive.size,
                files=archive.files,
                length=archive.length,
                seconds=seconds,
                to=only,
            )
        )
        over = [asyncio.create_task(one.wait()) for one in (desk.taken, withdrawn)]
        await asyncio.wait(over, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        is_withdrawn = withdrawn.is_set()  # read now: an offer that has expired stays expired
        for task in over:
            task.cancel()
    finally:
        desk.stop()
        await runner.cleanup()
    if desk.taken.is_set():
        return Sent("taken", desk.sent)
    return Sent("withdrawn" if is_withdrawn else "expired", desk.sent)
