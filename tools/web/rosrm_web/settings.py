"""Checked settings of the gateway."""

from __future__ import annotations

import ipaddress
import socket
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rosrm.errors import ConfigError
from rosrm_web.private_files import check_private
from rosrm_web.tokens import User, read_tokens

DEFAULT_LISTEN: Final = "127.0.0.1:8290"
DEFAULT_PORT: Final = 8290


@dataclass(frozen=True)
class Settings:
    """Settings of the gateway.

    Attributes:
        address: IP address on which it listens.
        port: TCP port; 0: any free one.
        certificate: path of the certificate chain; None: plain HTTP.
        key: path of its private key; None: in the file of the certificate.
        names: further names of this machine that a request may address.
        tokens: path of the file with the users; None: everyone may read.
        users: users of that file at the start.
        is_acting: requests of operators act; otherwise the gateway only reads.
    """

    address: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()
    tokens: Path | None = None
    users: tuple[User, ...] = ()
    is_acting: bool = False

    @property
    def scheme(self) -> str:
        """Return the scheme of its URLs."""
        return "http" if self.certificate is None else "https"

    @property
    def host_names(self) -> frozenset[str]:
        """Return the names, beside IP addresses, by which a request may address the gateway."""
        return frozenset(name.lower() for name in ("localhost", socket.gethostname(), *self.names))

    def tls(self) -> ssl.SSLContext | None:
        """Return the context of the server; None: plain HTTP."""
        return None if self.certificate is None else _tls(self.certificate, self.key)


def checked(
    listen: str, *, certificate: Path | None = None, key: Path | None = None,
    plain_http: bool = False, names: Sequence[str] = (), tokens: Path | None = None,
    allow_actions: bool = False,
) -> Settings:  # fmt: skip
    """Return the settings of the command.

    Args:
        listen: "ADDRESS" or "ADDRESS:PORT".
        certificate: path of a PEM file with the certificate chain; None: no TLS.
        key: path of a PEM file with its private key; None: in the file of the certificate.
        plain_http: allow HTTP without TLS on an address that other machines can reach.
        names: further names of this machine.
        tokens: path of the file with the tokens; None: everyone may read.
        allow_actions: let operators act.

    Raises:
        ConfigError: an option is invalid, or the settings would send tokens and logs unencrypted.
    """
    address, port = _address(listen)
    if key is not None and certificate is None:
        raise ConfigError("--key: give the certificate too: --certificate FILE")
    if certificate is not None:
        _check_tls(certificate, key)
    elif not plain_http and not ipaddress.ip_address(address).is_loopback:
        raise ConfigError(
            f"--listen {listen}: other machines can reach this address, and plain HTTP is not "
            "encrypted. Give --certificate FILE (and --key FILE), or allow it: --plain-http"
        )
    users = () if tokens is None else read_tokens(tokens)
    if not users and not ipaddress.ip_address(address).is_loopback:
        raise ConfigError(
            f"--listen {listen}: other machines can reach this address, and could read everything. "
            "Give a file with tokens: --tokens FILE"
        )
    if allow_actions and not any(user.role == "operator" for user in users):
        raise ConfigError(
            "--allow-actions: only users with a token of an operator may act: give --tokens FILE "
            "with a line `operator NAME TOKEN`"
        )
    return Settings(
        address, port, certificate, key, tuple(names), tokens, users, is_acting=allow_actions
    )


def _address(listen: str) -> tuple[str, int]:
    """Return address and port of "ADDRESS", "ADDRESS:PORT" or "[IPV6]:PORT"."""
    address, mark, port = listen.rpartition(":")
    if not mark or (":" in address and not address.startswith("[")):  # IPv6 without a port
        address, port = listen, str(DEFAULT_PORT)
    bare = address.removeprefix("[").removesuffix("]")
    try:
        ipaddress.ip_address(bare)
    except ValueError:
        raise ConfigError(
            f"--listen {listen}: an IP address is required, with or without a port, such as "
            "127.0.0.1:8290, 0.0.0.0 or [::1]:8290"
        ) from None
    if not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"--listen {listen}: the port is 0 to 65535; 0: any free one")
    return bare, int(port)


def _check_tls(certificate: Path, key: Path | None) -> None:
    secret = key or certificate
    check_private("--key" if key else "--certificate", secret)
    try:
        _tls(certificate, key)
    except (OSError, ssl.SSLError, ValueError) as error:
        reason = getattr(error, "strerror", None) or getattr(error, "reason", None) or error
        raise ConfigError(
            f"--certificate {certificate}: certificate and key cannot be used: {reason}"
        ) from None


def _tls(certificate: Path, key: Path | None) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key, password=_no_password)
    return context


def _no_password() -> str:
    raise ValueError("the key has a password; store it without one, readable by its owner only")
