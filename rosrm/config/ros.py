"""Section `ros` of `cluster.yaml` and `host.yaml`."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, Final, Literal

from pydantic import AfterValidator

from rosrm.extensions.units import Quantity
from rosrm.model.ros_settings import HIGHEST_DOMAIN, NAMESPACE, RosSettings

_DEFAULT: Final = RosSettings()
_SERVER: Final = re.compile(r"[^\s:;]+:\d{1,5}(;[^\s:;]*(:\d{1,5})?)*|[^\s:;]+")
_INTERFACE: Final = re.compile(r"[^\s/:]{1,15}")
_TRANSPORTS: Final = ("DEFAULT", "DEFAULTv6", "SHM", "UDPv4", "UDPv6", "LARGE_DATA", "P2P")


def _server(given: str) -> str:
    if given and not _SERVER.fullmatch(given):
        raise ValueError(f'{given!r} is not "host:port"')
    return given


def _namespace(given: str) -> str:
    if not NAMESPACE.fullmatch(given):
        raise ValueError(f'{given!r} is not an absolute ROS namespace such as "/rosrm"')
    return given


def _interface(given: str) -> str:
    if given and not _INTERFACE.fullmatch(given):
        raise ValueError(f'{given!r} is no name or IPv4 address of an interface such as "wg0"')
    return given


def _transports(given: str) -> str:
    if given and given.split("?", maxsplit=1)[0] not in _TRANSPORTS:
        raise ValueError(f"{given!r} is unknown. Allowed: {', '.join(_TRANSPORTS)}")
    return given


@dataclass(frozen=True, slots=True)
class DiscoveryInFile:
    """Discovery of participants: by multicast within a range, or by a server."""

    range: Literal["", "localhost", "subnet", "off", "system_default"] = ""
    server: Annotated[str, AfterValidator(_server)] = _DEFAULT.discovery_server


@dataclass(frozen=True, slots=True)
class RosInFile:
    """Section `ros` as written in a file."""

    domain: Annotated[int, Quantity(high=HIGHEST_DOMAIN, whole=True)] | None = _DEFAULT.domain
    discovery: DiscoveryInFile = field(default_factory=DiscoveryInFile)
    transports: Annotated[str, AfterValidator(_transports)] = _DEFAULT.transports
    namespace: Annotated[str, AfterValidator(_namespace)] = _DEFAULT.namespace
    interface: Annotated[str, AfterValidator(_interface)] = _DEFAULT.interface

    def settings(self) -> RosSettings:
        """Return the section as settings."""
        return RosSettings(
            domain=self.domain,
            discovery_range=self.discovery.range,
            discovery_server=self.discovery.server,
            transports=self.transports,
            namespace=self.namespace,
            interface=self.interface,
        )
