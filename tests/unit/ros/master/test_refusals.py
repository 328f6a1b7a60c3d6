"""Records of refused peers: one of each kind in ten seconds, whatever names the senders choose."""

from __future__ import annotations

from rosrm.core.master.events import PeerRefused
from rosrm.ros.master import refusals
from rosrm.ros.master.refusals import Refusals


class Clock:
    now = 100.0

    def boot_time(self) -> float:
        return self.now


def test_refusals_are_counted_by_kind(monkeypatch) -> None:
    """A stranger may have any number of names; another kind is recorded at once."""
    clock, recorded = Clock(), []
    monkeypatch.setattr(refusals, "clocks", clock)
    refuse = Refusals(recorded.append)
    for number in range(1000):
        refuse("handshake", f"slave {number}", "another version")
    refuse("process_status", "host 3", "flying")
    assert recorded == [
        PeerRefused("slave 0", "another version"),
        PeerRefused("host 3", "flying"),
    ]
    clock.now += 10.0
    refuse("handshake", "slave x", "another version")
    assert recorded[-1].reason == "another version (999 more of this kind since the last record)"
