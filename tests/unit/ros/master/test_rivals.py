"""Search for another master: a beat counts only with the sender's own answer to a handshake."""

from __future__ import annotations

import math

import pytest

from rosrm.keys.cluster import ClusterSecret
from rosrm.keys.security import MasterSecurity
from rosrm.ros.master import rivals
from rosrm.ros.master.rivals import RivalWatch
from rosrm.ros.master.services import MasterIdentity
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg, srv
from tests.unit.ros.wire import Wire

OWN = 11
IDENTITY = MasterIdentity("m", "r", 8, 3, OWN)


class Watch:
    """The watch of a master, with its fake surroundings."""

    def __init__(self, monkeypatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(rivals, "clocks", self)
        self.wire, self.refused = Wire(), []
        self.watch = RivalWatch(
            self.wire, IDENTITY, lambda who, reason: self.refused.append((who, reason))
        )
        monkeypatch.setattr(self.watch, "_endpoints", self.wire)

    def boot_time(self) -> float:
        return self.now

    @property
    def asked(self) -> list:
        peer = self.wire.to.get(srv.Handshake)
        return [] if peer is None else peer.sent

    def beat(self, incarnation: int = 12, uptime: float = 50.0, **changes) -> None:
        known = {
            "protocol_version": PROTOCOL_VERSION, "name": "m", "hostname": "r", "pid": 9,
            "epoch": 4, "incarnation": incarnation, "uptime": uptime,
        }  # fmt: skip
        self.watch.take_beat(msg.MasterBeat(**{**known, **changes}), b"")

    def answer(self, **changes) -> None:
        known = {"protocol_version": PROTOCOL_VERSION, "hostname": "r", "pid": 9, "epoch": 4}
        self.asked[-1].answer(srv.Handshake.Response(**{**known, **changes}))


@pytest.fixture
def watch(monkeypatch) -> Watch:
    return Watch(monkeypatch)


def test_another_master_that_answers_is_found(watch) -> None:
    """Its newest beat counts, because the uptimes are compared."""
    watch.beat(uptime=50.0)
    watch.beat(uptime=50.2)
    (asked,) = watch.asked
    assert (asked.request.role, asked.request.name) == ("master", IDENTITY.as_client)
    watch.answer()
    assert watch.watch.take_found().uptime == 50.2
    assert watch.watch.take_found() is None


def test_a_beat_alone_is_no_master(watch) -> None:
    """No answer, or that of another one, does not count; each second asks again."""
    watch.beat(uptime=1e8)
    watch.now += 1.0
    watch.watch.expire(watch.now)
    watch.beat(uptime=1e8)
    assert len(watch.asked) == 2
    watch.answer(pid=10)
    assert watch.watch.take_found() is None


def test_own_beats_ask_nobody(watch) -> None:
    watch.beat(incarnation=OWN)
    assert watch.asked == []


@pytest.mark.parametrize(
    "changes",
    [{"uptime": math.nan}, {"uptime": math.inf}, {"uptime": -1.0}, {"uptime": 1e9},
     {"protocol_version": 99}],
)  # fmt: skip
def test_an_impossible_beat_is_refused(watch, changes) -> None:
    watch.beat(**changes)
    assert watch.asked == []
    assert len(watch.refused) == 1


def test_another_master_is_asked_with_the_present_secret(watch) -> None:
    """After `rosrm key rotate` no master would answer a request under the former one."""
    first, second = ClusterSecret(b"1" * 32), ClusterSecret(b"2" * 32)
    watch.wire.security = master = MasterSecurity(first)
    for secret in (first, second):
        master.replace(secret, [])
        watch.beat()
        peer = watch.wire.to[srv.Handshake].peer
        asked = peer.link.seal(b"channel", b"question")
        known = master.peer(peer.name, peer.generation)
        assert known.link.open(b"channel", asked) == b"question"
        watch.now += 1.0
