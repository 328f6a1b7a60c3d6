"""ROS settings: domain, discovery, transports, interface. This module does not import ROS."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from rosrm.errors import ConfigError

#: Highest domain id, because higher ones need ports beyond 65535.
HIGHEST_DOMAIN: Final = 232
#: An absolute ROS namespace.
NAMESPACE: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
#: Environment variable with the network interface of rosrm's own participants.
INTERFACE_VARIABLE: Final = "ROSRM_INTERFACE"
#: Variables that can keep apart two participants of one machine and domain.
_SEPARATING: Final = (
    INTERFACE_VARIABLE, "ROS_DISCOVERY_SERVER", "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_SECURITY_ENABLE", "ROS_SECURITY_KEYSTORE",
    "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class RosSettings:
    """ROS settings of a part of rosrm; None and "" keep the environment's value.

    Attributes:
        domain: ROS_DOMAIN_ID.
        discovery_range: "localhost", "subnet", "off" or "system_default".
        discovery_server: "host:port" of a Fast DDS discovery server, instead of multicast.
        transports: FASTDDS_BUILTIN_TRANSPORTS, for example "UDPv4".
        namespace: namespace of rosrm's topics and services.
        interface: ROSRM_INTERFACE, name or IPv4 address of the only network interface of rosrm's
            own participants; those of the processes use all interfaces.
    """

    domain: int | None = None
    discovery_range: str = ""
    discovery_server: str = ""
    transports: str = ""
    namespace: str = "/rosrm"
    interface: str = ""

    def environment(self) -> Mapping[str, str]:
        """Return the environment variables with these settings, for this process and children."""
        variables = {
            "ROS_DOMAIN_ID": "" if self.domain is None else str(self.domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": self.discovery_range.upper(),
            "ROS_DISCOVERY_SERVER": self.discovery_server,
            # A plain client gets only its own topics from the server and sees no other nodes.
            "ROS_SUPER_CLIENT": "TRUE" if self.discovery_server else "",
            "FASTDDS_BUILTIN_TRANSPORTS": self.transports,
            INTERFACE_VARIABLE: self.interface,
        }
        return {name: value for name, value in variables.items() if value}

    def check(self) -> None:
        """Raise `ConfigError` for a setting, or a ROS_DOMAIN_ID in force, that ROS cannot use.

        Otherwise DDS would print an error without a remedy or end the process, or rclpy would raise
        a traceback.
        """
        self._check_interface()
        if not NAMESPACE.fullmatch(self.namespace):
            raise ConfigError(
                f'{self.namespace!r} is not an absolute ROS namespace such as "/rosrm"'
            )
        if self.domain is not None:
            if type(self.domain) is not int or not 0 <= self.domain <= HIGHEST_DOMAIN:
                raise ConfigError(
                    f"the ROS domain {self.domain!r} is not a whole number from 0 to "
                    f"{HIGHEST_DOMAIN}"
                )
            return
        word = os.environ.get("ROS_DOMAIN_ID", "")
        if not word:
            return
        if not (word.isascii() and word.isdigit() and int(word) <= HIGHEST_DOMAIN):
            raise ConfigError(
                f"ROS_DOMAIN_ID={word!r} is not a whole number from 0 to {HIGHEST_DOMAIN}; set "
                f"the variable to one, or give --domain N"
            )

    def _check_interface(self) -> None:
        """Raise `ConfigError` if Fast DDS would ignore the interface because of another setting."""
        joined = self._in_force()
        interface = self.interface_in_force()
        conflict = ""
        if joined.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST":
            conflict = "discovery.range: localhost (or ROS_AUTOMATIC_DISCOVERY_RANGE)"
        elif joined.get("ROS_LOCALHOST_ONLY") == "1":
            conflict = "ROS_LOCALHOST_ONLY=1"
        elif joined.get("FASTDDS_BUILTIN_TRANSPORTS", "") not in ("", "UDPv4"):
            conflict = "transports other than UDPv4 (or FASTDDS_BUILTIN_TRANSPORTS)"
        elif "fastrtps" not in _rmw_of(joined):
            conflict = f"RMW_IMPLEMENTATION={joined['RMW_IMPLEMENTATION']}"
        if interface and conflict:
            raise ConfigError(
                f"the interface {interface!r} (ros.interface or {INTERFACE_VARIABLE}) cannot be "
                f"combined with {conflict}; leave one of them out"
            )

    def interface_in_force(self) -> str:
        """Return the interface of these settings or of ROSRM_INTERFACE; "": all interfaces."""
        return self._in_force().get(INTERFACE_VARIABLE, "")

    def socket_name(self) -> tuple[str, str]:
        """Return the domain part of the name of a socket, and a text of other settings.

        The text has the settings that can keep DDS participants of one domain apart.
        """
        joined = self._in_force()
        is_off = joined.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "OFF"
        alone = is_off and os.getpid()  # meets no other participant
        variables = (joined.get(name) or "" for name in _SEPARATING)
        others = [self.namespace, alone, _rmw_of(joined), *variables]
        return f"rosrm/{joined.get('ROS_DOMAIN_ID') or '0'}/", repr(others)

    def is_local(self) -> bool:
        """Return True if ROS traffic stays on this machine."""
        joined = self._in_force()
        is_local = joined.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
        return is_local or joined.get("ROS_LOCALHOST_ONLY") == "1"

    def _in_force(self) -> Mapping[str, str]:
        return {**os.environ, **self.environment()}

    def describe(self) -> str:
        """Return a text on the domain, RMW, discovery and interface in force."""
        joined = self._in_force()
        discovery = joined.get("ROS_DISCOVERY_SERVER") or joined.get(
            "ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET"
        )
        interface = self.interface_in_force()
        return (
            f"domain {joined.get('ROS_DOMAIN_ID', '0')}, "
            f"RMW {_rmw_of(joined)}, "
            f"discovery {discovery}" + (f", interface {interface}" if interface else "")
        )


def _rmw_of(joined: Mapping[str, str]) -> str:
    return joined.get("RMW_IMPLEMENTATION") or "rmw_fastrtps_cpp"
