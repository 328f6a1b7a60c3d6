"""Settings of `rosrm web`: addresses, TLS, private files."""

from __future__ import annotations

import socket

import pytest

from rosrm.errors import ConfigError
from rosrm_web.serving import open_socket
from rosrm_web.settings import Settings, checked


@pytest.mark.parametrize(
    ("listen", "address", "port"),
    [
        ("127.0.0.1", "127.0.0.1", 8290),
        ("127.0.0.2:0", "127.0.0.2", 0),
        ("::1", "::1", 8290),
        ("[::1]:8291", "::1", 8291),
    ],
)
def test_an_address_with_or_without_a_port(listen, address, port):
    """The default port is 8290."""
    settings = checked(listen)

    assert (settings.address, settings.port, settings.scheme) == (address, port, "http")


@pytest.mark.parametrize(
    "listen",
    ["", "robot-1", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:65536", "[::1", "1.2.3", ":80"],
)
def test_an_invalid_address_is_refused(listen):
    """The error names the option and its value."""
    with pytest.raises(ConfigError, match=r"^--listen"):
        checked(listen)


@pytest.mark.parametrize("listen", ["0.0.0.0", "192.0.2.1:8290", "[::]:8290"])
def test_plain_http_stays_on_this_machine(listen):
    """Beyond it only an explicit option allows HTTP without TLS."""
    with pytest.raises(ConfigError, match=r"--certificate FILE .* or allow it: --plain-http"):
        checked(listen)


def test_a_key_that_others_can_read_is_refused(tmp_path):
    """The error has the remedy."""
    key = tmp_path / "key.pem"
    key.write_text("secret")
    key.chmod(0o640)

    with pytest.raises(ConfigError, match=f"`chmod 600 {key}`"):
        checked("127.0.0.1", certificate=tmp_path / "cert.pem", key=key)


@pytest.mark.parametrize("content", ["", "no PEM"])
def test_a_broken_certificate_is_refused(tmp_path, content):
    """Before the gateway listens."""
    file = tmp_path / "both.pem"
    file.write_text(content)
    file.chmod(0o600)

    with pytest.raises(ConfigError, match=f"--certificate {file}: "):
        checked("127.0.0.1", certificate=file)


def test_a_missing_file_is_refused(tmp_path):
    """The error names the option."""
    with pytest.raises(ConfigError, match=r"--certificate .*: cannot be read: No such file"):
        checked("127.0.0.1", certificate=tmp_path / "none.pem")


def test_a_port_in_use_is_one_clear_error():
    """The error names the port and another one."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=f"port {port} is in use, .* give another port"):
            open_socket(Settings(port=port))


def test_an_address_of_another_machine_is_refused():
    """192.0.2.1 belongs to no machine."""
    with pytest.raises(ConfigError, match=r"192.0.2.1 port 0 cannot be used: "):
        open_socket(Settings("192.0.2.1", 0))
