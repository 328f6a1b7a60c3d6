"""Measurement of the links to other hosts, on order of the master.

A probe is a small UDP packet, of which a peer gets two in a measurement. The kernel stamps the
arrival of probe and echo, and the echo says how long it has waited at the other slave. So neither
slave needs a thread or a quick answer: the main loop reads the socket, a bounded number of packets
each time. Packets beyond are dropped by the kernel.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import socket
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from rosrm import clocks
from rosrm.config.settings import LinkSettings
from rosrm.keys import link_packets
from rosrm.keys.link_packets import NONCE_BYTES, PACKET_BYTES, Packet
from rosrm.model.links import (
    LONGEST_ROUND_TRIP,
    MEASURE_SECONDS,
    MOST_ADDRESSES,
    LinkPeer,
    LinkReport,
)
from rosrm.model.orders import MeasureLinks
from rosrm.runtime.addresses import reachable_addresses
from rosrm.slave.interfaces import Traffic, interface_towards

_log = logging.getLogger("rosrm.slave")

#: Socket option and message by which the kernel gives the time of arrival.
_SO_TIMESTAMPNS: Final = 35
_TIMESPEC: Final = struct.Struct("@qq")
#: Most packets that the loop reads at a time; others wait in a small buffer or are dropped.
_AT_A_TIME: Final = 16
_BUFFER_BYTES: Final = 8192
#: Packets to each peer in one measurement, and seconds between them.
_PROBES: Final = 2
_AGAIN: Final = 0.3
#: Seconds of the order's time that are left for its answer.
_MARGIN: Final = 0.5

Done = Callable[[LinkReport], None]


@dataclass(slots=True)
class _Sent:
    peer: LinkPeer
    address: str
    at: int


@dataclass(slots=True)
class _Measurement:
    """One order that is carried out.

    Attributes:
        trips: host number to address and seconds of the quickest echo.
    """

    order: MeasureLinks
    done: Done
    deadline: float
    again_at: float
    rounds: int = 0
    trips: dict[int, tuple[str, float]] = field(default_factory=dict)


class LinkProber:
    """Answers the probes of other slaves, and measures the links to them.

    Args:
        settings: of the links of this host.
        key_of: returns the key of packets from the host of a number to this one.
        own_id: returns the number of this host; 0: not registered.
        only: IPv4 address to which the socket is bound; "": all.
        flows: returns the flows to the instances of this host, see `LinkReport`.
    """

    def __init__(
        self, settings: LinkSettings, *, key_of: Callable[[int], bytes], own_id: Callable[[], int],
        only: str = "", flows: Callable[[], Mapping[int, Mapping[str, float]]] = dict,
    ) -> None:  # fmt: skip
        self._settings = settings
        self._key_of, self._own_id, self._flows = key_of, own_id, flows
        self._only = only
        self._traffic = Traffic(settings.rate, settings.rates)
        self._sent: dict[bytes, _Sent] = {}
        self._open: _Measurement | None = None
        self._answers_from: dict[int, str] = {}
        self._socket = self._bound()

    def _bound(self) -> socket.socket | None:
        """Return the socket; None, and log why: other hosts then cannot measure their links."""
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            opened.bind((self._only, self._settings.port))
        except OSError as error:
            opened.close()
            port = self._settings.port or "any"
            _log.info("links are not measured: no UDP socket on port %s: %s", port, error)
            return None
        return opened

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()

    def measure(self, order: MeasureLinks, done: Done) -> None:
        """Measure links; `done` gets the report within `MEASURE_SECONDS`."""
        if self._open is not None:
            self._finish(self._open)
        now = clocks.boot_time()
        rounds = 0 if order.peers else _PROBES
        self._open = _Measurement(order, done, now + MEASURE_SECONDS - _MARGIN, now, rounds)
        self.turn(now)

    def turn(self, now: float) -> None:
        """Answer received probes, and take the next step of a measurement; never blocks."""
        for data, arrived, sender in self._received():
            packet = link_packets.opened(data, self._key)
            if packet is not None and packet.is_echo:
                self._take_echo(packet, arrived)
            elif packet is not None:
                self._answer(packet, arrived, sender)
        measurement = self._open
        if measurement is None:
            return
        if measurement.rounds < _PROBES and now >= measurement.again_at:
            measurement.rounds += 1
            measurement.again_at = now + _AGAIN
            self._send_probes(measurement)
        is_complete = measurement.rounds == _PROBES and not self._sent
        if is_complete or now >= measurement.deadline:
            self._finish(measurement)

    def _received(self) -> list[tuple[bytes, int, tuple[str, int]]]:
        """Return packets with the nanoseconds of their arrival (unix time) and their senders."""
        found: list[tuple[bytes, int, tuple[str, int]]] = []
        while self._socket is not None and len(found) < _AT_A_TIME:
            try:
                data, notes, _, sender = self._socket.recvmsg(PACKET_BYTES + 1, 64)
            except OSError:  # none is left, or another host has refused a packet
                break
            for level, kind, content in notes:
                if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                    seconds, rest = _TIMESPEC.unpack(content)
                    found.append((data, seconds * 1_000_000_000 + rest, sender))
        return found

    def _key(self, packet: Packet) -> bytes | None:
        if not packet.is_echo:
            return self._key_of(packet.host_id)
        sent = self._sent.get(packet.nonce)
        return None if sent is None else sent.peer.key

    def _answer(self, packet: Packet, arrived: int, sender: tuple[str, int]) -> None:
        key = self._key_of(packet.host_id)
        self._send(link_packets.echo(key, packet, clocks.wall_time_ns() - arrived), sender)

    def _take_echo(self, packet: Packet, arrived: int) -> None:
        sent = self._sent.pop(packet.nonce)
        measurement = self._open
        seconds = (arrived - sent.at - packet.wait) * 1e-9
        if measurement is None or not 0.0 < seconds <= LONGEST_ROUND_TRIP:
            return  # a clock was set
        known = measurement.trips.get(sent.peer.host_id)
        if known is None or seconds < known[1]:
            measurement.trips[sent.peer.host_id] = (sent.address, seconds)

    def _send_probes(self, measurement: _Measurement) -> None:
        for peer in measurement.order.peers:
            known = self._answers_from.get(peer.host_id)
            for address in (known,) if known in peer.addresses else peer.addresses:
                nonce = os.urandom(NONCE_BYTES)
                content = link_packets.probe(peer.key, self._own_id(), nonce)
                self._sent[nonce] = _Sent(peer, address, clocks.wall_time_ns())
                self._send(content, (address, peer.port))

    def _send(self, content: bytes, receiver: tuple[str, int]) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):  # no route, or a full buffer: as if it were lost
                self._socket.sendto(content, receiver)

    def _finish(self, measurement: _Measurement) -> None:
        self._open = None
        self._sent.clear()
        peers = {}
        for peer in measurement.order.peers:
            address, seconds = measurement.trips.get(peer.host_id, ("", math.nan))
            if address:
                self._answers_from[peer.host_id] = address
            else:
                self._answers_from.pop(peer.host_id, None)
            towards = address or next(iter(peer.addresses), "")
            number = self._traffic.number(interface_towards(towards), peer.host)
            if number is not None and towards:
                peers[peer.host_id] = (number, seconds)
        port = self._socket.getsockname()[1] if self._socket is not None else 0
        addresses = (self._only,) if self._only else reachable_addresses()[:MOST_ADDRESSES]
        measurement.done(
            LinkReport(
                addresses, port, self._settings.limit, self._traffic.read(), peers, self._flows()
            )
        )
