"""The probe `network`, with fake interfaces."""

from types import SimpleNamespace

import psutil
import pytest

from rosrm.errors import ConfigError, SkipPlugin
from rosrm.testing import FakeClock
from rosrm_resources.network import NetworkOptions, NetworkProbe, links


class Machine:
    """Interfaces by name: speed in Mbit/s (0: unknown), up or not, physical or not."""

    def __init__(self, path, monkeypatch):
        self.path, self.stats, self.counters = path, {}, {}
        monkeypatch.setattr(psutil, "net_if_stats", lambda: self.stats)
        monkeypatch.setattr(psutil, "net_io_counters", lambda pernic, nowrap: self.counters)

    def put(self, name, speed=1000, *, up=True, physical=True):
        self.stats[name] = SimpleNamespace(isup=up, speed=speed)
        if physical:
            (self.path / name / "device").mkdir(parents=True)
        self.count(name, 0, 0)

    def count(self, name, received, sent):
        self.counters[name] = SimpleNamespace(bytes_recv=received, bytes_sent=sent)

    def links(self, **options):
        return links(NetworkOptions(**options), self.path)


@pytest.fixture
def machine(tmp_path, monkeypatch):
    return Machine(tmp_path, monkeypatch)


def test_physical_interfaces_that_are_up_count(machine):
    """Bridges, the loopback and unplugged interfaces do not count; 1000 Mbit/s are 125 MB/s."""
    machine.put("eth0", 1000)
    machine.put("eth1", 100, up=False)
    machine.put("docker0", 10000, physical=False)
    machine.put("wlan0", 0)
    assert machine.links() == {"eth0": 125e6}


def test_no_interface_or_one_of_unknown_speed_is_absent_with_the_way_out(machine):
    """A wireless link reports no speed; the option sets it."""
    machine.put("lo", physical=False)
    with pytest.raises(SkipPlugin, match="no physical network interface is up"):
        machine.links()
    machine.put("wlan0", 0)
    with pytest.raises(SkipPlugin, match="speed of wlan0 is not known; the option `capacity`"):
        machine.links()
    assert machine.links(capacity=5e6) == {"wlan0": 5e6}


def test_chosen_interface_must_exist_and_have_a_speed(machine):
    """An interface chosen by name is refused, not skipped."""
    machine.put("eth0")
    machine.put("tun0", 0, physical=False)
    with pytest.raises(ConfigError, match="interfaces eth9 do not exist; there are: eth0, tun0"):
        machine.links(interfaces=("eth9",))
    with pytest.raises(ConfigError, match="speed of tun0 is not known"):
        machine.links(interfaces=("eth0", "tun0"))
    assert machine.links(interfaces=("tun0",), capacity=1e6) == {"tun0": 1e6}


def test_the_busier_direction_of_the_busiest_link(machine):
    """The slowest link is the capacity, the fullest the usage."""
    machine.put("eth0", 1000)
    machine.put("eth1", 80)
    clock = FakeClock()
    probe = NetworkProbe(machine.links(), 1.0, clock)
    assert probe.resources[0].capacity == 10e6
    machine.count("eth0", 25_000_000, 50_000_000)
    machine.count("eth1", 2_500_000, 1_000_000)
    clock.advance(1.0)
    assert probe.read()[0].usage == pytest.approx(0.4)


def test_interface_that_goes_away_raises(machine):
    """The reading is then stale, not 0."""
    machine.put("eth0")
    probe = NetworkProbe(machine.links(), 1.0, FakeClock())
    machine.counters.clear()
    with pytest.raises(OSError, match="interface eth0 is gone"):
        probe.read()
