"""Addresses of a host, and the order in which a peer should try them."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable, Iterator, Sequence

import psutil


def own_addresses() -> tuple[str, ...]:
    """Return the IPv4 addresses of this host's active interfaces, loopback last."""
    found = dict.fromkeys(str(interface.ip) for interface in _interfaces())
    return tuple(sorted(found, key=lambda one: ipaddress.IPv4Address(one).is_loopback))


def nearest_first(addresses: Iterable[str]) -> Sequence[str]:
    """Return addresses on this host's networks first, then others, loopback last."""
    networks = [interface.network for interface in _interfaces()]

    def distance(text: str) -> int:
        address = ipaddress.IPv4Address(text)
        if address.is_loopback:
            return 2
        return 0 if any(address in network for network in networks) else 1

    return sorted(addresses, key=distance)


def _interfaces() -> Iterator[ipaddress.IPv4Interface]:
    up = {name for name, status in psutil.net_if_stats().items() if status.isup}
    for name, addresses in psutil.net_if_addrs().items():
        for one in addresses:
            if name in up and one.family == socket.AF_INET:
                yield ipaddress.IPv4Interface(f"{one.address}/{one.netmask or 32}")
