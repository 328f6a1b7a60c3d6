"""Start of `rosrm web` without a master: its address, its encryption, its errors."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
from contextlib import suppress

import pytest

from rosrm.testing.local_cluster import claim_domain
from rosrm.testing.loopback import settings_on_this_machine
from tests.ros.web_kit import gateway
from tests.waiting import PATIENCE

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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_gateway_while_a_reader_follows(ros, number):
    """With success: no reader delays the end."""
    with gateway(ros) as one, one.follow() as changes:
        next(changes)
        assert one.end(number) == 0


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


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificate")
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
