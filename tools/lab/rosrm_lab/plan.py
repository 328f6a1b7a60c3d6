"""Plan of a lab: its hosts, their sizes, addresses and names. Pure: makes nothing."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path
from typing import Any, Final

from rosrm.errors import ConfigError

MIB: Final = 2**20
GIB: Final = 2**30

#: Bytes; with less, not even a shell is sure to run. A ROS program in Python needs a multiple.
LEAST_MEMORY: Final = 16 * MIB
#: Cores; the kernel grants CPU time by the millisecond, in periods of 100 ms at most.
LEAST_CPU: Final = 0.01
#: Bytes; with less, ext4 leaves hardly any room for files.
LEAST_DISK: Final = 16 * MIB
MOST_HOSTS: Final = 250
DEFAULT_DISK: Final = GIB

#: Range of the labs' addresses, one /24 each.
POOL: Final = IPv4Network("10.213.0.0/16")
_POOL_PREFIX: Final = 24

#: Ranges that no host can have an address of.
_UNUSABLE: Final = {
    IPv4Network("0.0.0.0/8"): "this network itself",
    IPv4Network("127.0.0.0/8"): "loopback, which never leaves a host",
    IPv4Network("224.0.0.0/4"): "multicast",
    IPv4Network("240.0.0.0/4"): "reserved, and broadcast",
}

#: Pattern of host names; interface names, namespaces and control groups contain them.
_NAME: Final = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9-]{0,30}[A-Za-z0-9])?")


@dataclass(frozen=True, slots=True)
class HostPlan:
    """One virtual host.

    Attributes:
        name: its host name.
        memory: bytes that its processes may use together; None: no limit.
        cpu: cores that its processes may use together; None: no limit.
        disk: bytes of the file system that holds its data.
    """

    name: str
    memory: int | None = None
    cpu: float | None = None
    disk: int = DEFAULT_DISK

    def __post_init__(self) -> None:
        """Refuse an impossible host; raises `ConfigError`."""
        check_name(self.name, "host")
        _check_least(self, "memory", self.memory, LEAST_MEMORY, "16MiB")
        _check_least(self, "cpu", self.cpu, LEAST_CPU, "0.01 cores")
        _check_least(self, "disk", self.disk, LEAST_DISK, "16MiB")


@dataclass(frozen=True, slots=True)
class LabPlan:
    """A lab: hosts in one network of their own.

    Attributes:
        name: several labs with different names can exist side by side.
        hosts: in the order of their addresses.
        subnet: of their addresses.
    """

    name: str
    hosts: tuple[HostPlan, ...]
    subnet: IPv4Network

    def __post_init__(self) -> None:
        """Refuse an impossible lab; raises `ConfigError`."""
        check_name(self.name, "lab")
        if not 1 <= len(self.hosts) <= MOST_HOSTS:
            raise ConfigError(
                f"lab {self.name!r}: {len(self.hosts)} hosts; allowed are 1 to {MOST_HOSTS}"
            )
        twice = sorted({one for one in self.names if self.names.count(one) > 1})
        if twice:
            raise ConfigError(f"lab {self.name!r}: host {', '.join(twice)} is given twice")
        room = self.subnet.num_addresses - 2
        if len(self.hosts) > room:
            raise ConfigError(
                f"the subnet {self.subnet} has {max(0, room)} addresses for {len(self.hosts)} "
                "hosts; give a larger one, for example a /24"
            )

    @property
    def names(self) -> list[str]:
        """Return the hosts' names."""
        return [host.name for host in self.hosts]

    def host(self, name: str) -> HostPlan:
        """Return a host by its name; raises `ConfigError` where there is none."""
        for host in self.hosts:
            if host.name == name:
                return host
        raise ConfigError(
            f"lab {self.name!r} has no host {name!r}; it has: {', '.join(self.names)}"
        )

    def number(self, name: str) -> int:
        """Return the number of a host, from 1 on."""
        return self.names.index(self.host(name).name) + 1

    def address(self, name: str) -> IPv4Address:
        """Return the address of a host on the lab's network."""
        return self.subnet.network_address + self.number(name)

    def mac(self, name: str) -> str:
        """Return a host's hardware address; it stays when the host is booted again."""
        low = int(self.address(name)).to_bytes(4, "big")
        return "02:00:" + ":".join(f"{byte:02x}" for byte in low)

    def port(self, name: str) -> str:
        """Return the interface of the switch to which a host is connected."""
        return f"port{self.number(name)}"

    def hosts_file(self) -> str:
        """Return the content of each host's /etc/hosts."""
        lines = ["127.0.0.1 localhost", "::1 localhost"]
        lines += [f"{self.address(name)} {name}" for name in self.names]
        return "\n".join(lines) + "\n"

    def to_plain(self) -> dict[str, Any]:
        """Return the content of the lab's state file."""
        return {
            "name": self.name,
            "subnet": str(self.subnet),
            "hosts": [astuple(host) for host in self.hosts],
        }

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> LabPlan:
        """Build a plan from the result of `to_plain`."""
        hosts = tuple(HostPlan(*fields) for fields in plain["hosts"])
        return cls(plain["name"], hosts, IPv4Network(plain["subnet"]))


def uniform(
    number: int, *, memory: int | None = None, cpu: float | None = None, disk: int = DEFAULT_DISK
) -> list[HostPlan]:
    """Return equal hosts: host1, host2, ..., in the units of `HostPlan`."""
    if not 1 <= number <= MOST_HOSTS:
        raise ConfigError(f"{number} hosts; allowed are 1 to {MOST_HOSTS}")
    return [HostPlan(f"host{i}", memory, cpu, disk) for i in range(1, number + 1)]


def check_name(name: str, what: str) -> None:
    """Raise `ConfigError` for a name that a host or lab cannot have."""
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} cannot be the name of a {what}. Allowed: at most 32 letters, digits and "
            "'-', a letter or digit at both ends"
        )


def parse_subnet(text: str) -> IPv4Network:
    """Return a subnet such as 10.9.0.0/24; raises `ConfigError`."""
    try:
        return IPv4Network(text)
    except ValueError as error:
        raise ConfigError(
            f"--subnet {text!r}: {error}; give an IPv4 range such as 10.9.0.0/24"
        ) from None


def check_usable(subnet: IPv4Network) -> None:
    """Raise `ConfigError` for a subnet with addresses that no host can have."""
    for other, what in _UNUSABLE.items():
        if subnet.overlaps(other):
            raise ConfigError(
                f"the address range {subnet} cannot be a lab's: {other} is {what}. Choose one of "
                "hosts, such as 10.9.0.0/24, or leave it out: then a free one is taken"
            )


def free_subnet(taken: Sequence[IPv4Network]) -> IPv4Network:
    """Return the first subnet of the pool that is free; raises `ConfigError` when all are taken.

    Args:
        taken: ranges in use by this machine and other labs.
    """
    for subnet in POOL.subnets(new_prefix=_POOL_PREFIX):
        if not any(subnet.overlaps(other) for other in taken):
            return subnet
    raise ConfigError(f"every /24 of {POOL} is in use on this machine; choose one with --subnet")


def check_free(subnet: IPv4Network, taken: Iterable[tuple[IPv4Network, str]]) -> None:
    """Raise `ConfigError` for a subnet that is in use.

    Args:
        subnet: to be used.
        taken: ranges, each with its owner.
    """
    for other, owner in taken:
        if subnet.overlaps(other):
            raise ConfigError(
                f"the address range {subnet} is in use: {owner} has {other}. Choose another "
                "--subnet, or leave it out: then a free one is taken"
            )


def total(amounts: Iterable[float | None]) -> float:
    """Return the sum of the limits that are set."""
    return sum(amount for amount in amounts if amount is not None)


def _check_least(host: HostPlan, what: str, amount: float | None, least: float, words: str) -> None:
    if amount is not None and amount < least:
        raise ConfigError(f"host {host.name}: {what} {amount:g} is too little; at least {words}")


# --- names on the machine ---------------------------------------------------------------------

#: Prefix of the namespaces and control groups of all labs.
PREFIX: Final = "rosrm-lab"
#: Folder in which ip and pyroute2 keep named network namespaces.
_NAMESPACES: Final = Path("/run/netns")


def switch_namespace(lab: str) -> str:
    """Return the name of the network namespace with the bridge between a lab's hosts."""
    return f"{PREFIX}:{lab}"


def host_namespace(lab: str, host: str) -> str:
    """Return the name of the network namespace of a host."""
    return f"{PREFIX}:{lab}:{host}"


def namespace_path(name: str) -> Path:
    """Return the file of a network namespace."""
    return _NAMESPACES / name


def namespaces_of(lab: str, existing: Iterable[str]) -> Iterator[str]:
    """Yield the namespaces that belong to a lab, those of its hosts first."""
    mine = [name for name in existing if name.startswith(host_namespace(lab, ""))]
    yield from mine
    if switch_namespace(lab) in existing:
        yield switch_namespace(lab)
