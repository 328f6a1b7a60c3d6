"""Network faults of each host, and the firewall rules that cause them. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import astuple, dataclass, field, replace
from typing import Any, Final, Literal

from rosrm.errors import ConfigError
from rosrm.wording import amount

#: "in": packets to the host; "out": packets from the host.
Direction = Literal["in", "out", "both"]
DIRECTIONS: Final = ("in", "out", "both")

_TABLE: Final = "rosrm_lab"
#: Fractions are rounded to one in so many.
_DICE: Final = 1_000_000
#: Seconds; netem keeps microseconds in 32 bits.
_MOST_DELAY: Final = 60.0
#: Bytes a second.
_LEAST_RATE: Final = 1e3
_MOST_RATE: Final = 1e11
#: Seconds of the rate that may pass at once, and bytes at least: a large message is one burst.
_BURST: Final = 0.1
_LEAST_BURST: Final = 65_536


@dataclass(frozen=True, slots=True)
class Wire:
    """One direction of a host's link.

    Attributes:
        cut: nothing passes.
        loss: fraction of the packets that are lost, each by chance.
        delay: seconds by which each packet is late.
        rate: bytes a second that pass, and packets beyond are lost; 0: no limit.
    """

    cut: bool = False
    loss: float = 0.0
    delay: float = 0.0
    rate: float = 0.0


@dataclass(frozen=True, slots=True)
class Link:
    """Both directions of a host's link.

    Attributes:
        incoming: to the host.
        outgoing: from the host.
    """

    incoming: Wire = field(default_factory=Wire)
    outgoing: Wire = field(default_factory=Wire)

    def changed(self, direction: Direction, **values: Any) -> Link:
        """Return a link with other values in one direction or both; raises `ConfigError`."""
        check_direction(direction)
        incoming, outgoing = self.incoming, self.outgoing
        if direction != "out":
            incoming = replace(incoming, **values)
        if direction != "in":
            outgoing = replace(outgoing, **values)
        return Link(incoming, outgoing)

    @property
    def delays(self) -> bool:
        """Return True if it delays packets in any direction."""
        return bool(self.incoming.delay or self.outgoing.delay)

    def describe(self) -> str:
        """Return the faults as text; "" for a link without faults."""
        if self.incoming == self.outgoing:
            return _words(self.incoming)
        parts = [("in", self.incoming), ("out", self.outgoing)]
        return "; ".join(f"{way}: {_words(wire)}" for way, wire in parts if wire != Wire())


def check_direction(direction: str) -> None:
    """Raise `ConfigError` for an unknown direction."""
    if direction not in DIRECTIONS:
        raise ConfigError(f"direction {direction!r}; allowed: {', '.join(DIRECTIONS)}")


def check_loss(fraction: float) -> None:
    """Raise `ConfigError` for a number that is not a fraction."""
    if not 0.0 <= fraction <= 1.0:
        raise ConfigError(f"loss {fraction:g} is not within 0..1 (0 % to 100 %)")


def check_delay(seconds: float) -> None:
    """Raise `ConfigError` for an impossible delay."""
    if not 0.0 <= seconds <= _MOST_DELAY:
        raise ConfigError(f"delay {seconds:g} s is not within 0..{_MOST_DELAY:g} s")


def check_rate(rate: float) -> None:
    """Raise `ConfigError` for an impossible rate."""
    if rate and not _LEAST_RATE <= rate <= _MOST_RATE:
        allowed = f"{_LEAST_RATE / 1e3:g} kB/s to {_MOST_RATE / 1e9:g} GB/s, and 0 for no limit"
        raise ConfigError(f"rate {rate:g} B/s; allowed: {allowed}")


def ruleset(links: Mapping[str, Link]) -> str:
    """Return the whole firewall of the switch, for `nft -f`, which applies it atomically.

    Args:
        links: by the port of the switch.
    """
    rules = [rule for port, link in links.items() for rule in _rules(port, link)]
    # Naming the table before the deletion makes it succeed when there is none yet.
    lines = [
        f"table bridge {_TABLE}",
        f"delete table bridge {_TABLE}",
        f"table bridge {_TABLE} {{",
        "  chain between_hosts {",
        "    type filter hook forward priority 0; policy accept;",
        # Without ARP, a host's address could not be resolved: a one-way cut would be two-way.
        "    ether type arp accept",
        *(f"    {rule}" for rule in rules),
        "  }",
        "}",
    ]
    return "\n".join(lines) + "\n"


def _rules(port: str, link: Link) -> Iterator[str]:
    for match, wire in ((f'oifname "{port}"', link.incoming), (f'iifname "{port}"', link.outgoing)):
        lost = round(wire.loss * _DICE)
        if wire.cut or lost == _DICE:
            yield f"{match} drop"
        elif lost:
            yield f"{match} numgen random mod {_DICE} < {lost} drop"
        if wire.rate and not wire.cut:
            burst = max(_LEAST_BURST, round(_BURST * wire.rate))
            over = f"limit rate over {round(wire.rate)} bytes/second burst {burst} bytes"
            yield f"{match} {over} drop"


def _words(wire: Wire) -> str:
    parts = ["cut"] if wire.cut else []
    if wire.loss:
        parts.append(f"loss {wire.loss * 100:g} %")
    if wire.delay:
        parts.append(f"delay {wire.delay * 1000:g} ms")
    if wire.rate:
        parts.append(f"rate {amount(wire.rate, 'B/s')}")
    return ", ".join(parts)


def to_plain(links: Mapping[str, Link]) -> dict[str, Any]:
    """Return the content of the lab's state file."""
    return {
        name: tuple(_fields(wire) for wire in (link.incoming, link.outgoing))
        for name, link in links.items()
    }


def _fields(wire: Wire) -> tuple[Any, ...]:
    """Return the fields of a direction; without a rate, as versions without rates read them."""
    fields = astuple(wire)
    return fields if wire.rate else fields[:-1]


def from_plain(plain: Mapping[str, Any]) -> dict[str, Link]:
    """Build the links from the result of `to_plain`."""
    return {name: Link(Wire(*into), Wire(*out)) for name, (into, out) in plain.items()}
