"""Start of `rosrm web` without a master: its address, its encryption, its errors."""

from __future__ import annotations

import os
import signal
import socket
import ssl
import subprocess
import sys
from contextlib import ExitStack, suppress
from http.client import IncompleteRead

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from rosrm.testing.local_cluster import claim_domain
from rosrm.testing.loopback import settings_on_this_machine
from rosrm_web.connections import MOST_CONNECTIONS
from tests.programs import needs
from tests.ros.web_kit import gateway
from tests.waiting import PATIENCE, wait_until

TOKEN = "v" * 32


@pytest.fixture(scope="module")
def ros():
    """Return the settings of a domain without a master."""
    domain, claim = claim_domain()
    with claim:
        yield settings_on_this_machine(domain)


@pytest.fixture(scope="module")
def web(ros):
    with gateway(ros) as one:
        yield one


def test_without_a_master_the_gateway_searches(web):
    """The gateway answers at once; each request for data gets the reason."""
    status = web.get("/v1/status")
    assert (list(status), status["gateway"]["state"]) == (["gateway"], "searching")

    answer = web.ask("/v1/hosts")
    # The reason is that no master answers or, before the first master of this user, that there is
    # no key.
    assert (answer.status, answer.json["detail"] != "") == (503, True)
    assert status["gateway"]["reason"]
    with web.follow() as changes:
        assert next(changes).data["state"] == "searching"


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\x02\x00\x01" + bytes(300),  # TLS
        b"GET / HTTP/9.9\r\n\r\n",
        b"\r\n" * 1000 + b"?",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"GET /" + b"x" * 100_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 100_000 + b"\r\n\r\n",
        b"GET http://evil.example/v1/status HTTP/1.1\r\nHost: evil.example\r\n\r\n",
    ],
)
def test_a_broken_request_is_refused(web, sent):
    """The connection ends with an error at most, and the next request is answered."""
    with socket.create_connection(web.address, timeout=PATIENCE) as client, suppress(OSError):
        client.sendall(sent)
        client.shutdown(socket.SHUT_WR)
        answer = b"".join(iter(lambda: client.recv(65536), b""))
        assert not answer or int(answer.split()[1]) >= 400
    assert web.ask("/v1/status").status == 200


def test_a_port_in_use_is_one_sentence(ros):
    """The second gateway ends before it answers anything."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        where = f"127.0.0.1:{other.getsockname()[1]}"
        done = subprocess.run(
            [sys.executable, "-m", "rosrm.cli", "web", "--listen", where], check=False,
            env={**os.environ, **ros.environment()}, capture_output=True, text=True,
        )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "is in use" in done.stderr


def test_unfinished_requests_keep_no_other_client_out(web):
    """There are more such requests than connections; the heads of some are complete."""
    head = b"POST /v1/cordon HTTP/1.1\r\nHost: localhost\r\n"
    with ExitStack() as stack:
        for number in range(2 * MOST_CONNECTIONS):
            client = stack.enter_context(socket.create_connection(web.address, timeout=PATIENCE))
            client.sendall((b"", head, head + b"Content-Length: 9\r\n\r\n")[number % 3])
        assert web.ask("/v1/status").status == 200


def test_pages_are_bounded(web):
    """One more page is refused with a sentence; a page without a browser is closed for it."""
    refused = wait_until(
        lambda: next((one for one in [web.ask("/")] if one.status == 503), None),
        "a page is refused",
    )
    assert "pages are open" in refused.json["detail"]
    wait_until(lambda: web.ask("/").status == 200, "a place is free again")


def test_a_revoked_token_ends_its_streams_and_pages(ros, tmp_path):
    """No restart is needed; the requests of users that stay in the file continue."""
    file = tmp_path / "tokens"
    file.touch(0o600)
    ada, eve = {"Authorization": f"Bearer {'a' * 32}"}, {"Authorization": f"Bearer {TOKEN}"}
    file.write_text(f"viewer ada {'a' * 32}\nviewer eve {TOKEN}\n")
    with gateway(ros, "--tokens", str(file)) as web, ExitStack() as stack:
        streams = [stack.enter_context(web.follow(**one)) for one in (ada, eve)]
        page = f"ws{web.url.removeprefix('http')}/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
        pages = [stack.enter_context(connect(page, additional_headers=one)) for one in (ada, eve)]
        assert [one.recv(PATIENCE)[0] for one in pages] == ["0", "0"]  # both are open

        revoked = tmp_path / "new"
        revoked.touch(0o600)
        revoked.write_text(f"viewer ada {'a' * 32}\n")
        revoked.replace(file)
        with suppress(IncompleteRead):  # the stream has no end of its own
            assert [one.kind for one in streams[1]] == ["master"]
        with pytest.raises(ConnectionClosed):
            pages[1].recv(PATIENCE)
        assert web.ask("/v1/status", **eve).status == 401
        assert web.ask("/v1/status", **ada).status == 200
        pages[0].ping().wait(PATIENCE)
        assert next(streams[0]).kind == "master"


def test_an_invalid_file_of_tokens_keeps_the_former_ones(ros, tmp_path):
    """The log has the reason, and the metric is 1 until the file is valid again."""
    file = tmp_path / "tokens"
    file.touch(0o600)
    file.write_text(f"viewer eve {TOKEN}\n")
    eve = {"Authorization": f"Bearer {TOKEN}"}
    with gateway(ros, "--tokens", str(file)) as web:

        def is_invalid(value: bytes) -> bool:
            return b"\nrosrm_web_tokens_invalid " + value in web.ask("/metrics", **eve).body

        assert is_invalid(b"0.0")
        file.chmod(0o644)
        wait_until(lambda: is_invalid(b"1.0"), "the metric says that the file is invalid")
        wait_until(
            lambda: any("other users can read or change it" in line for line in web.said),
            "the gateway logs the reason",
            seen=lambda: web.said,
        )
        file.chmod(0o600)
        wait_until(lambda: is_invalid(b"0.0"), "the file is read again")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_gateway_while_a_reader_follows(ros, number):
    """With success: no reader delays the end."""
    with gateway(ros) as one, one.follow() as changes:
        next(changes)
        assert one.end(number) == 0


def test_a_signal_that_the_starter_ignores_does_not_end_the_gateway(ros):
    """As SIGINT where a script without job control starts it with `&`."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with gateway(ros) as one:
            one.process.send_signal(signal.SIGINT)
            assert one.get("/v1/status")
            assert one.end(signal.SIGTERM) == 0
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.fixture
def certificate(tmp_path):
    """Return the files of a certificate for 127.0.0.1 and of its key."""
    names = tmp_path / "web.crt", tmp_path / "web.key"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256",
         "-nodes", "-subj", "/CN=robot-1", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2",
         "-out", names[0], "-keyout", names[1]], check=True, capture_output=True,
    )  # fmt: skip
    names[1].chmod(0o600)
    return names


@needs("openssl")
def test_https_with_tokens(ros, tmp_path, certificate):
    """The answers tell browsers to use HTTPS; a broken handshake disturbs no one."""
    tokens = tmp_path / "tokens"
    tokens.touch(0o600)
    tokens.write_text(f"viewer eve {TOKEN}\n")
    crt, key = map(str, certificate)
    words = ("--certificate", crt, "--key", key, "--tokens", str(tokens))
    with gateway(ros, *words, tls=ssl.create_default_context(cafile=crt)) as one:
        assert one.url.startswith("https://")
        with socket.create_connection(one.address) as plain:
            plain.sendall(b"GET / HTTP/1.1\r\n\r\n")
        answer = one.ask("/v1/status", Authorization=f"Bearer {TOKEN}")
        assert (answer.status, one.ask("/v1/status").status) == (200, 401)
        assert "max-age" in answer.headers["strict-transport-security"]
