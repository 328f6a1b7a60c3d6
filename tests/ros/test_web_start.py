"""Start of `rosrm web` without a master: its address, its encryption, its errors."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys

import pytest

from rosrm.testing.local_cluster import claim_domain
from rosrm.testing.loopback import settings_on_this_machine
from tests.ros.web_kit import gateway

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
    """It answers at once, and each request for data gets the reason."""
    status = web.get("/v1/status")
    assert (list(status), status["gateway"]["state"]) == (["gateway"], "searching")

    answer = web.ask("/v1/hosts")
    assert (answer.status, answer.json["detail"][:9]) == (503, "no master")
    with web.follow() as changes:
        assert next(changes).data["state"] == "searching"


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
