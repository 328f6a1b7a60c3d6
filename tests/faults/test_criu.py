"""Each part of a migration by criu is killed at each of its steps.

A part that is killed with SIGKILL is started again, like by a service manager. Afterwards one
instance owns the name, and its memory is the same: the count continues, and no number was received
twice. Files on the disks of the hosts show each moment.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.model.values import HostLossPolicy
from rosrm_criu.engine import restore_result
from tests.faults.handoff_watcher import instances
from tests.ros.clusters import PATIENCE
from tests.ros.portable_kit import NAME, Listener, ask, counter, nothing_left, two_hosts

pytestmark = pytest.mark.timeout(300)

_OTHER = {"left": "right", "right": "left"}
#: Bytes a second, so that a transfer takes a while; for a node with much memory.
_SLOWLY, _LESS_SLOWLY = 4_000_000, 40_000_000


class Scene:
    """A counter that migrates to and fro.

    Args:
        make: makes a cluster.
        arguments: of the counter.
        max_rate: bytes a second that a transfer may send.
        lease: seconds of silence after which a host is lost.
        fields: of the counter's spec.
    """

    def __init__(
        self, make, *arguments: str, max_rate: int = _SLOWLY,
        lease: float = LivenessSettings().lease, **fields,
    ) -> None:  # fmt: skip
        self.cluster = two_hosts(make, liveness=LivenessSettings(lease=lease))
        self.listener = Listener(self.cluster.domain)
        self.cluster.submit(counter(*arguments, options={"max_rate": max_rate}, **fields))
        self._source = self._number = 0
        self.source = ""

    def close(self) -> None:
        self.listener.close()

    def move(self, moment: str) -> None:
        """Begin a migration, and return at one of its moments."""
        row = self.cluster.wait(NAME, "running")
        self.listener.receive(20)
        self.source, self._number = row.host, row.number
        self._before = self.cluster.client.list().last_sequence
        left = set(self._signs(moment))  # of earlier migrations
        refusal = ask(self.cluster, _OTHER[row.host])
        assert not refusal, refusal
        deadline = time.monotonic() + PATIENCE
        while not set(self._signs(moment)) - left:
            assert time.monotonic() < deadline, f"no {moment}: {self._log()}"
            time.sleep(0.001)

    def _signs(self, moment: str) -> Iterator[Path]:
        here, there = (
            self.cluster.directory / "hosts" / name / "images"
            for name in (self.source, _OTHER[self.source])
        )
        if moment == "checkpoint":
            return here.glob("out-*")
        if moment in ("copy", "fetch"):  # only a node with much memory is copied
            return there.glob(".rosrm-fetch-*/*")
        if moment == "restore":
            return there.glob("in-*/manifest.json")
        return there.glob(f"in-*/{restore_result.FILE}")

    def kill(self, victim: str) -> None:
        """Kill a part with SIGKILL, and start it again like a service manager."""
        cluster = self.cluster
        if victim == "master":
            cluster.master.process.kill()
            cluster.master.process.wait(PATIENCE)
            cluster.reconnect()
            cluster.start_master()
            return
        if victim in ("source", "destination"):
            if pid := self._pid_of(victim):
                os.kill(pid, signal.SIGKILL)
            return
        name = self.source if victim == "source's slave" else _OTHER[self.source]
        cluster.slaves[name].process.kill()
        cluster.slaves[name].process.wait(PATIENCE)
        cluster.start_slave(next(one for one in cluster.hosts if one.host == name))

    def _pid_of(self, victim: str) -> int | None:
        """Return the pid of the source, or of the destination once it was started.

        None: the migration has killed the source.
        """
        deadline = time.monotonic() + PATIENCE
        while True:
            found = instances(self.cluster, NAME)
            number = self._number if victim == "source" else max(found)
            if victim == "source" or number != self._number:
                return found.get(number)
            assert time.monotonic() < deadline, f"no {victim}: {found}"

    def end(self, *, but: str = "?") -> str:
        """Return the end, "migrated" or "stayed"; one instance is left, whose counts arrive.

        Args:
            but: host where an image may be left for a while.
        """
        deadline = time.monotonic() + 90.0
        while not (ends := self._ends()):
            assert time.monotonic() < deadline, f"the migration has not ended: {self._log()}"
            self.cluster.client.spin(0.1)
        assert len(ends) == 1, ends
        row = self.cluster.wait(NAME, "running")
        self.listener.receive(30)
        assert set(instances(self.cluster, NAME)) == {row.number}
        self.cluster.wait_for_hosts()
        nothing_left(self.cluster, but=but)
        return ends[0]

    def switch_off(self, victim: str) -> str:
        """Switch off the host of the source or of the destination; return its name."""
        name = self.source if victim == "source" else _OTHER[self.source]
        self.cluster.switch_off(name)
        return name

    def switch_on(self, name: str) -> None:
        """Switch a host on again; only its disk is as before."""
        self.cluster.start_slave_again(name)

    def _ends(self) -> list[str]:
        events = self.cluster.events(process=NAME, after=self._before)
        return [event.kind for event in events if event.kind in ("migrated", "stayed")]

    def _log(self) -> str:
        return self.cluster.log_of("master")[-3000:]


@pytest.fixture(scope="module")
def scene(make_shared):
    one = Scene(make_shared)
    yield one
    one.close()


@pytest.fixture(scope="module")
def large(make_shared):
    """Yield a scene whose counter has enough memory for a copy before its dump."""
    one = Scene(make_shared, "--mb", "80", "--period", "0.02", max_rate=_LESS_SLOWLY)
    yield one
    one.close()


@pytest.fixture(scope="module")
def restless(make_shared):
    """Yield a scene with a short lease and `host_loss: elsewhere`."""
    one = Scene(make_shared, lease=4.0, host_loss=HostLossPolicy("elsewhere"))
    yield one
    one.close()


@pytest.mark.parametrize("moment", ["checkpoint", "fetch", "restore", "join"])
@pytest.mark.parametrize("victim", ["master", "source's slave", "destination's slave"])
def test_the_master_or_a_slave_is_killed(criu, scene, victim, moment):
    """The node continues its count, here or there, and no count is received twice."""
    scene.move(moment)
    scene.kill(victim)
    scene.end()
    assert min(scene.listener.steps()) > 0
    assert len(scene.listener.checksums) == 1


@pytest.mark.parametrize(
    ("victim", "moment"),
    [("source's slave", "copy"), ("destination's slave", "copy"), ("source's slave", "checkpoint")],
)
def test_a_slave_is_killed_during_the_copy_of_the_memory_or_the_comparison(
    criu, large, victim, moment
):
    """The node migrates with its whole memory, or stays, and no part of the copy is left."""
    large.move(moment)
    large.kill(victim)
    large.end()
    assert min(large.listener.steps()) > 0
    assert len(large.listener.checksums) == 1


@pytest.mark.parametrize("moment", ["restore", "join"])
def test_the_destination_is_killed(criu, scene, moment):
    """Before the commit the source continues; after it, the policy starts another instance."""
    scene.move(moment)
    scene.kill("destination")
    if scene.end() == "stayed":
        assert min(scene.listener.steps()) > 0
    scene.listener.forget()


def test_the_source_is_killed_in_its_dump(criu, scene):
    """Its policy starts it again, and there is no other instance."""
    scene.move("checkpoint")
    scene.kill("source")
    assert scene.end() == "stayed"
    scene.listener.forget()


def test_the_source_is_killed_once_its_image_is_restored(criu, scene):
    """The source was frozen, and the image has all its memory: the count continues from there."""
    scene.move("join")
    scene.kill("source")
    assert scene.end() == "migrated"
    assert min(scene.listener.steps()) > 0
    assert len(scene.listener.checksums) == 1


@pytest.mark.parametrize("moment", ["fetch", "restore"])
def test_the_destination_s_host_is_switched_off(criu, scene, moment):
    """Before the commit the source continues, at the latest when that host counts as lost."""
    scene.move(moment)
    name = scene.switch_off("destination")
    scene.listener.receive(20, 90.0)
    scene.switch_on(name)
    # Its next slave gives the image two minutes: it cannot know that the migration has ended.
    assert scene.end(but=name) == "stayed"
    assert min(scene.listener.steps()) > 0


@pytest.mark.parametrize(
    ("victim", "moment"), [("source", "fetch"), ("source", "restore"), ("destination", "join")]
)
def test_a_host_with_host_loss_elsewhere_is_switched_off(criu, restless, victim, moment):
    """The migration ends: one counter runs on the other host, and stays the only one."""
    scene = restless
    scene.move(moment)
    name = scene.switch_off(victim)
    scene.listener.forget()
    scene.listener.receive(50, 90.0)
    row = scene.cluster.wait(NAME, "running")
    assert row.host == _OTHER[name]
    assert not scene.cluster.events("migration_stuck", process=NAME)
    scene.switch_on(name)
    # Its next slave keeps the fetched image for two minutes.
    scene.end(but=name)
    assert scene.cluster.wait(NAME, "running").number == row.number
    assert min(scene.listener.steps()) > 0
    scene.listener.forget()
