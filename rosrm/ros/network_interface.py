"""Check of the setting `ros.interface` against the interfaces of this machine."""

from __future__ import annotations

import socket

from rosrm.errors import ConfigError
from rosrm.model.ros_settings import INTERFACE_VARIABLE
from rosrm.wording import reason_of


def check_loopback() -> None:
    """Check that the parts of rosrm on this machine can reach each other; raises `ConfigError`."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        try:
            any_socket.connect(("127.0.0.1", 9))  # only looks for a route
        except OSError as error:
            raise ConfigError(
                f"the loopback interface has no address ({reason_of(error)}), so the parts of "
                "rosrm on this machine cannot reach each other; bring it up: `ip link set lo up`"
            ) from None


def check_interface(interface: str) -> None:
    """Check that this machine has a network interface, given by its name or IPv4 address.

    Raises:
        ConfigError: there is none, or the interface has no IPv4 address.
    """
    import psutil  # noqa: PLC0415 - only where an interface is chosen

    addresses = {
        name: [one.address for one in found if one.family == socket.AF_INET]
        for name, found in psutil.net_if_addrs().items()
    }
    usable = {name: found for name, found in addresses.items() if found}
    if interface in usable or any(interface in found for found in usable.values()):
        return
    fault = "has no IPv4 address" if interface in addresses else "does not exist on this machine"
    shown = ", ".join(f"{name} ({', '.join(found)})" for name, found in sorted(usable.items()))
    raise ConfigError(
        f"the network interface {interface!r} (ros.interface or {INTERFACE_VARIABLE}) {fault}; "
        f"available: {shown or 'none'}"
    )
