"""Measurement of links over real sockets, and the interfaces of a host."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from rosrm import clocks
from rosrm.config.settings import LinkSettings
from rosrm.keys import link_packets
from rosrm.model.links import INTERFACES, LinkPeer, LinkReport
from rosrm.model.orders import MeasureLinks
from rosrm.slave.interfaces import Traffic, interface_towards
from rosrm.slave.links import LinkProber
from tests.limits import no_more_files
from tests.waiting import wait_until

KEY = b"k" * 32
LOCAL = "127.0.0.1"


def prober(number: int, key: bytes = KEY, **settings: object) -> LinkProber:
    return LinkProber(
        LinkSettings(**settings), key_of=lambda _: key, own_id=lambda: number, only=LOCAL
    )


def port_of(one: LinkProber) -> int:
    return measured(one, MeasureLinks()).port


def measured(
    one: LinkProber, order: MeasureLinks, each_turn: Callable[[], object] = lambda: None
) -> LinkReport:
    """Return the report of a measurement."""
    reports: list[LinkReport] = []
    one.measure(order, reports.append)

    def done() -> bool:
        each_turn()
        one.turn(clocks.boot_time())
        return bool(reports)

    wait_until(done, "a report on links", 20.0)
    return reports[0]


@pytest.fixture
def both() -> Iterator[tuple[LinkProber, LinkProber]]:
    with closing(prober(1)) as one, closing(prober(2)) as other:
        yield one, other


def peer(one: LinkProber, *, key: bytes = KEY, addresses: tuple[str, ...] = (LOCAL,)) -> LinkPeer:
    return LinkPeer(2, "other", addresses, port_of(one), key)


def test_a_round_trip_is_measured_without_the_wait_at_the_other_slave(both) -> None:
    """The other slave reads its socket seldom, and the wait does not count."""
    one, other = both
    turns = [0.0]

    def seldom() -> None:
        if clocks.boot_time() - turns[-1] > 0.2:
            turns.append(clocks.boot_time())
            other.turn(turns[-1])

    report = measured(one, MeasureLinks((peer(other),)), seldom)
    ((interface, seconds),) = report.peers.values()
    assert interface == 0
    assert 0.0 < seconds < 0.1


def test_a_peer_that_does_not_answer_has_no_round_trip(both) -> None:
    """The report comes in time, with NaN."""
    one, other = both
    report = measured(one, MeasureLinks((peer(other),)))
    ((_, seconds),) = report.peers.values()
    assert math.isnan(seconds)


def test_a_peer_with_another_key_gets_no_answer(both) -> None:
    """Neither side takes packets under a wrong key."""
    one, other = both
    order = MeasureLinks((peer(other, key=b"x" * 32),))
    report = measured(one, order, lambda: other.turn(clocks.boot_time()))
    assert math.isnan(report.peers[2][1])


def test_the_address_that_answers_is_found(both) -> None:
    """A host may have addresses that others cannot reach."""
    one, other = both
    order = MeasureLinks((peer(other, addresses=("127.0.0.77", "192.0.2.1", LOCAL)),))
    report = measured(one, order, lambda: other.turn(clocks.boot_time()))
    assert report.peers[2][1] < 1.0


def test_a_forged_echo_is_ignored(both) -> None:
    """A stranger that does not see the probe cannot name its random number."""
    one, other = both
    target = (LOCAL, port_of(one))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:

        def flood() -> None:
            packet = link_packets.Packet(True, 1, b"guess" + bytes(11), 0)
            stranger.sendto(link_packets.echo(KEY, packet, 0), target)
            stranger.sendto(b"nonsense", target)

        report = measured(one, MeasureLinks((peer(other),)), flood)
    assert math.isnan(report.peers[2][1])


def test_a_flood_takes_a_bounded_number_of_packets_each_turn(both, monkeypatch) -> None:
    """Packets beyond wait in a small buffer, or are dropped by the kernel."""
    one, _ = both
    target = (LOCAL, port_of(one))
    checked: list[bytes] = []
    monkeypatch.setattr(link_packets, "opened", lambda data, _key: checked.append(data))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(500):
            stranger.sendto(b"x" * 48, target)
    one.turn(clocks.boot_time())
    assert 0 < len(checked) <= 16


def test_a_port_that_is_taken_disables_the_answers(caplog) -> None:
    """The slave runs on, and its report has no port."""
    caplog.set_level("INFO")
    with closing(prober(1)) as one, closing(prober(2, port=port_of(one))) as other:
        assert port_of(other) == 0
        assert "links are not measured: no UDP socket on port" in caplog.text


# --- interfaces -------------------------------------------------------------------------------


@pytest.fixture
def kernel(tmp_path: Path) -> Callable[..., None]:
    """Return a function that writes the counters and the speed of an interface."""

    def write(name: str, received: int, sent: int, speed: str = "1000\n") -> None:
        counters = tmp_path / name / "statistics"
        counters.mkdir(parents=True, exist_ok=True)
        (counters / "rx_bytes").write_text(f"{received}\n")
        (counters / "tx_bytes").write_text(f"{sent}\n")
        (tmp_path / name / "speed").write_text(speed)

    return write


def test_the_traffic_is_that_of_the_busier_direction_since_the_last_report(
    kernel, tmp_path
) -> None:
    """The first report has none; a counter that starts again counts as none."""
    now = [0.0]
    traffic = Traffic(None, {}, lambda: now[0], tmp_path)
    kernel("eth0", 0, 0)
    assert traffic.number("eth0", "other") == 0
    assert traffic.read()[0].traffic == 0.0
    kernel("eth0", 1_000, 20_000)
    now[0] = 10.0
    assert traffic.read()[0].traffic == 2_000.0
    with no_more_files():
        assert traffic.read()[0].traffic == 2_000.0, "0 would tell that the link is free"
    kernel("eth0", 0, 0)
    now[0] = 20.0
    assert traffic.read()[0].traffic == 0.0


def test_the_rate_is_the_speed_of_the_interface_unless_it_is_given(kernel, tmp_path) -> None:
    """An interface without a speed, such as a radio, has an unknown rate."""
    for name, speed in (("eth0", "1000\n"), ("wlan0", "-1\n"), ("other", "")):
        kernel(name, 0, 0, speed)
    traffic = Traffic(None, {"far": 2e6}, classes=tmp_path)
    numbers = [traffic.number(name, "near") for name in ("eth0", "wlan0", "other", "gone")]
    assert numbers == [0, 1, 2, 3]
    assert traffic.number("eth0", "far") == 4
    rates = [one.rate for one in traffic.read()]
    assert rates[0] == 125e6
    assert all(map(math.isnan, rates[1:4]))
    assert rates[4] == 2e6
    given = Traffic(5e6, {}, classes=tmp_path)
    given.number("eth0", "near")
    assert given.read()[0].rate == 5e6


def test_a_host_has_a_bounded_number_of_interfaces() -> None:
    """Links beyond stay unknown."""
    traffic = Traffic(1.0, {})
    numbers = [traffic.number(f"eth{n}", "other") for n in range(INTERFACES + 1)]
    assert numbers == [*range(INTERFACES), None]


def test_the_interface_towards_an_address_is_that_of_the_route() -> None:
    """Text that is no address has none."""
    assert interface_towards(LOCAL) == "lo"
    assert interface_towards("nowhere.invalid.") == ""
