"""Measurements of links between hosts, as a slave reports them in its answer to `MeasureLinks`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

from rosrm.model.description_checks import name_fault
from rosrm.model.values import LARGEST_RATE

#: Most interfaces of one host that are told apart.
INTERFACES: Final = 8
#: Most addresses of a host, peers of one order, and flows of one report.
MOST_ADDRESSES: Final = 8
MOST_PEERS: Final = 16
MOST_FLOWS: Final = 512
#: Largest number of a host in a packet, and most bytes of a key.
MOST_NUMBER: Final = 2**32 - 1
MOST_KEY_BYTES: Final = 32
#: Longest round trip, in seconds; a longer one counts as no answer.
LONGEST_ROUND_TRIP: Final = 10.0
#: Seconds for which a slave waits for answers of other hosts.
MEASURE_SECONDS: Final = 3.0
_Entry = TypeVar("_Entry")
_PART: Final = "(25[0-5]|2[0-4][0-9]|1[0-9]{2}|[1-9]?[0-9])"
_ADDRESS: Final = re.compile(rf"({_PART}\.){{3}}{_PART}")


@dataclass(frozen=True, slots=True)
class Interface:
    """A network interface towards other hosts.

    Attributes:
        rate: bytes a second that it can carry; NaN: not known.
        traffic: bytes a second that it carries, in its busier direction.
    """

    rate: float
    traffic: float = 0.0


@dataclass(frozen=True, slots=True)
class LinkPeer:
    """Another host to which a slave measures its link.

    Attributes:
        host_id: number of the host.
        host: name of the host.
        addresses: IPv4 addresses of the host.
        port: UDP port on which its slave answers.
        key: key of the packets between both; b"": there is none yet, or with `security: none`.
    """

    host_id: int
    host: str
    addresses: tuple[str, ...]
    port: int
    key: bytes = field(default=b"", repr=False)


@dataclass(frozen=True, slots=True)
class LinkReport:
    """Measurements of a slave.

    Attributes:
        addresses: IPv4 addresses of the host.
        port: UDP port on which the slave answers; 0: it answers no packets.
        limit: fraction of the rate of each interface that flows may use.
        interfaces: at most INTERFACES.
        peers: number of another host to the interface towards it and the seconds of a round trip
            (NaN: no answer).
        flows: number of an instance of this host to the bytes a second that it receives from other
            nodes, by their full names.
    """

    addresses: tuple[str, ...] = ()
    port: int = 0
    limit: float = 1.0
    interfaces: tuple[Interface, ...] = ()
    peers: Mapping[int, tuple[int, float]] = field(default_factory=dict)
    flows: Mapping[int, Mapping[str, float]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the report as a JSON object; null stands for NaN."""
        return {
            "addresses": list(self.addresses),
            "port": self.port,
            "limit": self.limit,
            "interfaces": [[_or_null(one.rate), one.traffic] for one in self.interfaces],
            "peers": {str(peer): [at, _or_null(trip)] for peer, (at, trip) in self.peers.items()},
            "flows": {str(number): dict(rates) for number, rates in self.flows.items()},
        }


def report_from_json(plain: Mapping[str, Any]) -> tuple[LinkReport, list[str]]:
    """Return the inverse of `LinkReport.to_json`, and why entries of it are left out.

    The rate of an interface that is left out is unknown, because peers refer to it by its number.

    Raises:
        ValueError: the report cannot be read.
    """
    left = _LeftOut([])
    try:
        given = left.some(plain["interfaces"], INTERFACES, "interfaces")
        interfaces = tuple(left.valid(_interface, one) or Interface(math.nan) for one in given)
        peers = dict(
            left.all_valid(lambda one: _measured_peer(one, len(interfaces)),
                           left.some(plain["peers"].items(), MOST_PEERS, "peers"))
        )  # fmt: skip
        flows: dict[int, dict[str, float]] = {}
        given = [
            (number, *flow) for number, rates in plain["flows"].items() for flow in rates.items()
        ]
        for number, node, rate in left.all_valid(_flow, left.some(given, MOST_FLOWS, "flows")):
            flows.setdefault(number, {})[node] = rate
        addresses = tuple(_some(plain["addresses"], MOST_ADDRESSES, "addresses"))
        port, limit = plain["port"], _number(plain["limit"], "the limit", 1.0)
        is_complete = _is_place(addresses, port)
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"it is malformed ({type(error).__name__})") from None
    if not is_complete:
        raise ValueError(f"it has an impossible address or port: {addresses!r:.200}, {port!r:.50}")
    return LinkReport(addresses, port, limit, interfaces, peers, flows), left.faults


@dataclass(frozen=True, slots=True)
class _LeftOut:
    """Entries of a report that are left out.

    Attributes:
        faults: the reason of each entry, or of several beyond a bound.
    """

    faults: list[str]

    def some(self, given: Iterable[_Entry], most: int, what: str) -> list[_Entry]:
        """Return the first entries; a reason stands for those beyond a bound."""
        found = list(given)
        if len(found) > most:
            self.faults.append(f"it has {len(found)} {what}; at most {most}")
        return found[:most]

    def valid(self, read: Callable[[Any], _Entry], given: Any) -> _Entry | None:
        """Return an entry; None: it is left out."""
        try:
            return read(given)
        except (ValueError, LookupError, TypeError, AttributeError, OverflowError) as fault:
            self.faults.append(str(fault))
            return None

    def all_valid(self, read: Callable[[Any], _Entry], given: Iterable[Any]) -> Iterator[_Entry]:
        """Yield the entries that are not left out."""
        for one in given:
            entry = self.valid(read, one)
            if entry is not None:
                yield entry


def _interface(given: Any) -> Interface:
    rate, traffic = given
    return Interface(_rate(rate, "a link rate"), _number(traffic, "traffic", LARGEST_RATE))


def _measured_peer(given: Any, interfaces: int) -> tuple[int, tuple[int, float]]:
    peer, (at, trip) = given
    return int(peer), (_index(at, interfaces), _trip(trip))


def _flow(given: Any) -> tuple[int, str, float]:
    number, node, rate = given
    return (
        int(number),
        str(node),
        _number(rate, f"the rate of a flow from {node!s:.200}", LARGEST_RATE),
    )


def peer_to_json(peer: LinkPeer) -> dict[str, Any]:
    """Return a peer with its key as a JSON object."""
    return {
        "host_id": peer.host_id, "host": peer.host, "addresses": list(peer.addresses),
        "port": peer.port, "key": peer.key.hex(),
    }  # fmt: skip


def peers_from_json(plain: Any) -> tuple[LinkPeer, ...]:
    """Return the peers of a JSON list; raise `ValueError` for an impossible value."""
    try:
        return tuple(map(_peer, _some(plain, MOST_PEERS, "peers")))
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"it is malformed ({type(error).__name__})") from None


def _peer(plain: Any) -> LinkPeer:
    peer = LinkPeer(
        int(plain["host_id"]), str(plain["host"]),
        tuple(_some(plain["addresses"], MOST_ADDRESSES, "addresses")), plain["port"],
        bytes.fromhex(plain["key"]),
    )  # fmt: skip
    fault = name_fault(peer.host, "host")
    if not 0 < peer.host_id <= MOST_NUMBER or len(peer.key) > MOST_KEY_BYTES:
        fault = fault or f"host {peer.host_id} cannot be, or its key"
    if fault or not _is_place(peer.addresses, peer.port):
        raise ValueError(fault or f"{peer.host} has an impossible address or port")
    return peer


def _is_place(addresses: tuple[Any, ...], port: Any) -> bool:
    is_port = type(port) is int and 0 <= port < 1 << 16
    return is_port and all(map(_ADDRESS.fullmatch, addresses))


def _some(given: Any, most: int, what: str) -> list[Any]:
    found = list(given)
    if len(found) > most:
        raise ValueError(f"it has {len(found)} {what}; at most {most}")
    return found


def _number(given: Any, what: str, most: float) -> float:
    if isinstance(given, bool) or not isinstance(given, (int, float)) or not 0.0 <= given <= most:
        raise ValueError(f"{what} is {given!r:.50}; allowed: 0 to {most:g}")
    return float(given)


def _rate(given: Any, what: str) -> float:
    rate = math.nan if given is None else _number(given, what, LARGEST_RATE)
    if rate == 0.0:
        raise ValueError(f"{what} is 0; it must be greater")
    return rate


def _trip(given: Any) -> float:
    return math.nan if given is None else _number(given, "a round trip", LONGEST_ROUND_TRIP)


def _index(given: Any, size: int) -> int:
    if type(given) is not int or not 0 <= given < size:
        raise ValueError(f"interface {given!r:.50} does not exist; there are {size}")
    return given


def _or_null(value: float) -> float | None:
    return None if math.isnan(value) else value
