"""Limits of connections, over real sockets."""

from __future__ import annotations

import asyncio
import socket
import ssl
import subprocess
from pathlib import Path

import pytest

from rosrm_web import connections
from rosrm_web.serving import http_server
from rosrm_web.settings import Settings
from tests.programs import needs
from tests.waiting import PATIENCE

#: A valid request, but for the empty line at its end.
HEAD = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
#: Bytes that no socket buffers.
LARGE = 16 * 2**20


async def app(scope, receive, send):
    """Answer with 204; /large with many bytes, /never with nothing."""
    if scope["type"] == "lifespan":
        await receive()
        await send({"type": "lifespan.startup.complete"})
        await receive()
        await send({"type": "lifespan.shutdown.complete"})
        return
    while (await receive()).get("more_body"):
        pass
    if scope["path"] == "/never":
        while (await receive())["type"] != "http.disconnect":
            pass
        return
    content = b"x" * LARGE if scope["path"] == "/large" else b""
    await send({"type": "http.response.start", "status": 200 if content else 204, "headers": []})
    for start in range(0, len(content), 2**16):
        part = content[start : start + 2**16]
        await send({"type": "http.response.body", "body": part, "more_body": True})
    await send({"type": "http.response.body"})


def run(scene, settings=Settings()):  # noqa: B008 - frozen
    """Run a scene of clients, given the address of a server."""

    async def served():
        listener = socket.create_server(("127.0.0.1", 0))
        server = http_server(app, settings)
        serving = asyncio.create_task(server._serve([listener]))
        try:
            await asyncio.wait_for(scene(*listener.getsockname()), PATIENCE)
        finally:
            server.should_exit = True
            await serving

    asyncio.run(served())


async def answered(reader, writer, sent=HEAD + b"\r\n"):
    """Send a request; return True if its answer is a success, False if the connection ends."""
    try:
        writer.write(sent)
        head = await reader.readuntil(b"\r\n\r\n")
    except (asyncio.IncompleteReadError, ConnectionError):
        return False
    return head.startswith(b"HTTP/1.1 204 ")


async def ended(reader):
    """Return what arrives until the connection ends."""
    try:
        return await reader.read()
    except ConnectionError:
        return b""


@pytest.mark.parametrize("before", [b"", HEAD + b"\r\n"])
@pytest.mark.parametrize("sent", [b"", b"G", HEAD])
def test_a_head_that_never_ends_is_dropped(monkeypatch, before, sent):
    """The limit holds for the first and later heads of a connection; bytes do not extend it."""
    monkeypatch.setattr(connections, "HEAD_TIMEOUT", 0.2)

    async def scene(*address):
        reader, writer = await asyncio.open_connection(*address)
        if before:
            assert await answered(reader, writer, before)
            writer.write(sent or b"G")
        else:
            writer.write(sent)
        dripping = asyncio.create_task(drip(writer))
        assert await ended(reader) == b""
        dripping.cancel()

    async def drip(writer):
        while sent:
            await asyncio.sleep(0.05)
            writer.write(b"x")

    run(scene)


def test_unfinished_requests_keep_no_other_client_out(monkeypatch):
    """The oldest unfinished request ends; requests in progress stay."""
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 8)

    async def scene(*address):
        busy = await asyncio.open_connection(*address)
        busy[1].write(HEAD.replace(b"/", b"/never", 1) + b"\r\n")
        heads = (b"", HEAD, HEAD + b"Content-Length: 9\r\n\r\nx")
        slow = []
        for number in range(20):
            slow.append(await asyncio.open_connection(*address))
            slow[-1][1].write(heads[number % 3])
        assert await answered(*await asyncio.open_connection(*address))
        for reader, _ in slow[:12]:
            assert await ended(reader) == b""
        assert not busy[0].at_eof()
        for _, writer in (busy, *slow):
            writer.close()

    run(scene)


def test_one_request_too_many_in_progress_ends(monkeypatch):
    """The requests before it stay, and a place is free when one has ended."""
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 3)

    async def scene(*address):
        busy = []
        for _ in range(3):
            busy.append(await asyncio.open_connection(*address))
            busy[-1][1].write(HEAD.replace(b"/", b"/never", 1) + b"\r\n")
        while await answered(*await asyncio.open_connection(*address)):
            pass  # the server has not read all requests yet
        busy[0][1].close()
        while not await answered(*await asyncio.open_connection(*address)):
            pass  # the server has not seen the end yet
        assert not any(reader.at_eof() for reader, _ in busy[1:])
        for _, writer in busy[1:]:
            writer.close()

    run(scene)


def test_a_reader_that_takes_nothing_is_ended(monkeypatch):
    """The gateway drops the rest of the answer."""
    monkeypatch.setattr(connections, "READ_TIMEOUT", 0.2)

    async def scene(*address):
        loop = asyncio.get_running_loop()
        client = socket.create_connection(address)
        with client:
            client.sendall(HEAD.replace(b"/", b"/large", 1) + b"\r\n")
            client.setblocking(False)
            while connections_of(client):
                await asyncio.sleep(0.02)
            taken = 0
            try:
                while part := await loop.sock_recv(client, 2**20):
                    taken += len(part)
            except ConnectionError:
                pass
            assert taken < LARGE

    def connections_of(client):
        """Return True while the server's side of a connection is there."""
        where = f"{client.getsockname()[1]:04X}"
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()]
        return any(row[2].endswith(f":{where}") and row[3] == "01" for row in rows[1:])

    run(scene)


@needs("openssl")
def test_a_handshake_that_never_ends_is_dropped(monkeypatch, tmp_path):
    """A handshake counts as a connection; a client that finishes it is answered."""
    monkeypatch.setattr(connections, "HEAD_TIMEOUT", 1.0)
    file = tmp_path / "both.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256",
         "-nodes", "-subj", "/CN=robot-1", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2",
         "-out", file, "-keyout", "-"], check=True, stdout=(tmp_path / "key.pem").open("w"),
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    context = ssl.create_default_context(cafile=str(file))

    async def scene(*address):
        silent, _ = await asyncio.open_connection(*address)
        assert await answered(*await asyncio.open_connection(*address, ssl=context))
        assert await ended(silent) == b""

    run(scene, Settings(certificate=file, key=tmp_path / "key.pem"))


def test_connections_of_one_address_end_none_of_another(monkeypatch):
    """A flood of one machine ends its own connections, not the older one of another machine."""
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 8)

    async def scene(*address):
        other = await asyncio.open_connection(*address, local_addr=("127.0.0.2", 0))
        other[1].write(HEAD)
        flood = []
        for _ in range(30):
            flood.append(await asyncio.open_connection(*address))
            flood[-1][1].write(HEAD)
            await asyncio.sleep(0)
        assert await ended(flood[0][0]) == b""
        assert await answered(*other, b"\r\n")

    run(scene)
