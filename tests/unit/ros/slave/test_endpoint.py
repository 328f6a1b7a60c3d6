"""Connection of a slave to its master: without DDS, with a simulated clock."""

from __future__ import annotations

import logging

import pytest

from rosrm.core.slave import events
from rosrm.core.slave.state import SlaveState
from rosrm.keys.roles import Principal
from rosrm.model.values import HostDescription
from rosrm.ros.slave import endpoint
from rosrm.ros.slave.endpoint import MasterLink, SlaveEndpoint
from rosrm.ros.slave.journal_watermark import JournalWatermark, Watermark
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg, srv
from tests.unit.ros.wire import Call, Wire

PERIOD = 0.2
PERIOD_OF_MASTER = PERIOD


class Clock:
    """Clock in seconds; stands in for `rosrm.clocks`."""

    now = 100.0

    def boot_time(self) -> float:
        return self.now

    def boot_time_ns(self) -> int:
        return int(self.now * 1e9)

    wall_time_ns = boot_time_ns


class Host:
    """Fake runtime of the slave."""

    def __init__(self) -> None:
        self.events = []
        self.contacts: list[float] = []

    def take(self, event) -> None:
        if isinstance(event, events.ContactConfirmed):
            self.contacts.append(event.at)
        else:
            self.events.append(event)


class Master:
    """Run of a master, as a slave sees it."""

    def __init__(self, slave: Slave, incarnation: int, epoch: int = 1, pid: int = 7) -> None:
        self._slave = slave
        self._is = {"hostname": "m", "pid": pid, "epoch": epoch}
        self._incarnation = incarnation
        self._epoch = epoch

    def beat(
        self, silent_hosts=(), age: float = 0.0, journal: int = 0, tickets_from: int = 0
    ) -> None:
        beat = msg.MasterBeat(
            protocol_version=PROTOCOL_VERSION, incarnation=self._incarnation,
            beat=self._slave.clock.boot_time_ns() - int(age * 1e9), silent_hosts=list(silent_hosts),
            journal=journal, tickets_from=tickets_from, **self._is,
        )  # fmt: skip
        self._slave.wire.hear[msg.MasterBeat](beat)

    def greet(self) -> None:
        response = srv.Handshake.Response(
            protocol_version=PROTOCOL_VERSION, accepted=True, master="m",
            beat=self._slave.clock.boot_time_ns(), **self._is,
        )  # fmt: skip
        self._slave.newest(srv.Handshake).answer(response)

    def take_in(self, **refusal) -> None:
        """Answer the slave's registration; `refusal` has the fields of a refusal."""
        answer = {"protocol_version": PROTOCOL_VERSION, "accepted": not refusal, **refusal}
        self._slave.newest(srv.RegisterHost).answer(
            srv.RegisterHost.Response(
                answer=msg.Answer(epoch=self._epoch, **answer),
                host_id=1,
                beat_period=PERIOD_OF_MASTER,
            )
        )


class Slave:
    """Endpoint of a slave with its fake surroundings."""

    def __init__(self, clock: Clock, seen: JournalWatermark | None = None) -> None:
        self.clock, self.wire, self.host = clock, Wire(Principal("host", "h0")), Host()
        description = HostDescription("h0", 5)
        self.endpoint = SlaveEndpoint(
            self.wire, description, SlaveState(), take=self.host.take, seen=seen
        )

    @property
    def link(self) -> MasterLink:
        return self.endpoint.link

    def sent(self, kind) -> list[Call]:
        return self.wire.to[kind].sent

    def newest(self, kind) -> Call:
        return self.sent(kind)[-1]

    def pass_time(self, seconds: float, *masters: Master) -> None:
        """Let time pass, cycle by cycle, with beats of these masters."""
        for _ in range(round(seconds / PERIOD)):
            self.clock.now += PERIOD
            for master in masters:
                master.beat()
            self.endpoint.advance(self.clock.now)
            self.endpoint.ask(self.clock.now)

    def find(self, master: Master) -> None:
        """Greet the slave and send a beat, so that it registers."""
        self.pass_time(PERIOD)
        master.beat()
        master.greet()

    def join(self, master: Master) -> None:
        """Greet the slave, send beats and accept its registration."""
        self.find(master)
        master.take_in()
        assert self.link is MasterLink.REGISTERED


@pytest.fixture
def slave(monkeypatch, caplog) -> Slave:
    caplog.set_level(logging.INFO)
    clock = Clock()
    monkeypatch.setattr(endpoint, "clocks", clock)
    return Slave(clock)


@pytest.mark.parametrize("epoch", [1, 2, 3])
def test_another_run_of_the_master_is_reported_at_any_epoch(slave, epoch) -> None:
    """A master with a lost journal begins at epoch 1 again: the slave registers with it, too."""
    old, new = Master(slave, 11, epoch=2), Master(slave, 12, epoch=epoch, pid=8)
    slave.join(old)
    slave.pass_time(2.0, old)
    assert slave.link is MasterLink.REGISTERED
    slave.pass_time(1.0, new)
    assert events.MasterLost() in slave.host.events
    assert slave.link is MasterLink.GREETING

    new.greet()
    assert slave.link is MasterLink.REGISTERING
    new.take_in()
    asked = len(slave.sent(srv.RequestProcess))
    slave.pass_time(PERIOD, new)
    assert slave.host.events[-1] == events.Registered(epoch, renumbers=epoch <= 2)
    assert len(slave.sent(srv.RegisterHost)) == 2
    assert len(slave.sent(srv.RequestProcess)) == asked + 1
    assert slave.newest(srv.RequestProcess).request.envelope.epoch == epoch


def test_another_run_gets_a_handshake_at_its_first_beat(slave) -> None:
    """After a restart of the master, its hosts must not wait for their next cycles."""
    slave.join(Master(slave, 11))
    slave.clock.now += 1.0
    Master(slave, 12, epoch=2, pid=8).beat()
    assert len(slave.sent(srv.Handshake)) == 2


def test_another_run_is_reported_without_a_contact_with_the_first(slave) -> None:
    """The first run is killed right after its greeting, which does not identify the run."""
    old, new = Master(slave, 11), Master(slave, 12, pid=8)
    slave.pass_time(PERIOD)
    old.greet()
    assert slave.link is MasterLink.LISTENING
    slave.pass_time(1.0, new)
    assert slave.sent(srv.RegisterHost) == []
    slave.pass_time(3.0, new)  # the greeting has expired
    new.greet()
    new.take_in()
    assert slave.link is MasterLink.REGISTERED


def test_a_run_that_replaces_the_first_is_reported(slave) -> None:
    """In a container every master is pid 1 of the same host name."""
    old, new = Master(slave, 11, pid=1), Master(slave, 12, pid=1)
    slave.join(old)
    slave.pass_time(1.0, new)
    assert slave.link is MasterLink.GREETING
    new.greet()
    new.take_in()
    assert slave.host.events[-1] == events.Registered(1, renumbers=True)
    slave.pass_time(5.0, new)
    assert slave.link is MasterLink.REGISTERED
    assert len(slave.sent(srv.RegisterHost)) == 2
    slave.pass_time(3.0)  # the new run is silent for a while
    slave.pass_time(PERIOD, new)
    new.greet()
    new.take_in()
    assert slave.host.events[-1] == events.Registered(1, renumbers=False)


def test_of_two_masters_the_running_one_is_kept(slave) -> None:
    """The younger of two masters stops. Beats alone, of any epoch, prove no other master."""
    ours = Master(slave, 11, epoch=2)
    slave.join(ours)
    for epoch in (1, 2, 3, 2**64 - 1):
        slave.pass_time(3.0, ours, Master(slave, 12, epoch=epoch, pid=8))
        assert slave.link is MasterLink.REGISTERED
    slave.pass_time(1.0, Master(slave, 13, epoch=3, pid=9))
    assert slave.link is MasterLink.GREETING


def test_a_handshake_with_a_killed_master_is_soon_repeated(slave) -> None:
    """The killed master looks ready for two minutes; the next one never receives the request."""
    slave.join(Master(slave, 11))
    new = Master(slave, 12, epoch=2, pid=8)
    slave.pass_time(0.8, new)
    assert slave.link is MasterLink.GREETING
    before = len(slave.sent(srv.Handshake))
    slave.pass_time(0.4, new)
    assert len(slave.sent(srv.Handshake)) == before + 1
    slave.pass_time(9.0, new)
    assert len(slave.sent(srv.Handshake)) <= before + 5  # a thousand slaves ask at the same time
    new.greet()
    new.take_in()
    assert slave.link is MasterLink.REGISTERED


def test_beats_confirm_the_contact_of_this_host(slave) -> None:
    """Beats of the accepting master count, unless they list this host as silent."""
    ours, another = Master(slave, 11, epoch=2), Master(slave, 12, epoch=1, pid=8)
    slave.pass_time(PERIOD, ours)
    ours.greet()
    assert slave.host.contacts == []  # no master has accepted the host yet
    ours.take_in()
    slave.host.contacts.clear()
    slave.clock.now += 1.0
    ours.beat(silent_hosts=[1, 7])
    another.beat()
    assert slave.host.contacts == []
    ours.beat(silent_hosts=[2])
    assert slave.host.contacts == pytest.approx([slave.clock.now])


def test_the_master_says_which_tickets_are_in_force(slave) -> None:
    """A beat of another master says nothing about them."""
    master, other = Master(slave, 11), Master(slave, 12, pid=8)
    slave.join(master)
    other.beat(tickets_from=9)
    assert slave.wire.security.tickets_from == 0
    master.beat(tickets_from=3)
    assert slave.wire.security.tickets_from == 3


def test_delayed_beats_confirm_the_contact_of_their_time(slave) -> None:
    """A slave that was stopped finds old beats in its sockets."""
    ours = Master(slave, 11)
    slave.join(ours)
    slave.pass_time(1.0, ours)
    slave.host.contacts.clear()
    slave.clock.now += 1.5
    ours.beat(age=1.3)
    ours.beat(age=1.1)
    now = slave.clock.now
    assert slave.host.contacts == pytest.approx([now - 1.3, now - 1.1], abs=0.01)


@pytest.mark.parametrize("ahead", [20.0, 1e6, 18e9])
def test_a_beat_that_is_still_to_come_is_refused(slave, ahead) -> None:
    """Another has sent it: with it, later beats would look old, and fences stop the processes."""
    ours = Master(slave, 11)
    slave.join(ours)
    slave.pass_time(1.0, ours)
    slave.host.contacts.clear()
    ours.beat(age=-ahead)
    slave.pass_time(1.0, ours)
    assert slave.host.contacts == pytest.approx(
        [slave.clock.now - PERIOD * n for n in (4, 3, 2, 1, 0)], abs=0.01
    )
    slave.pass_time(40.0, ours)
    beat = slave.newest(srv.RequestProcess).request.envelope.receiver_beat
    assert beat <= slave.clock.boot_time_ns()


def test_beats_of_others_do_not_disturb_a_registration(slave) -> None:
    """A request with the beat of another master would be stale."""
    ours, another = Master(slave, 11), Master(slave, 12, pid=8)
    slave.pass_time(PERIOD)
    ours.greet()
    for _ in range(3):
        another.beat(age=50.0)
    assert slave.link is MasterLink.LISTENING
    ours.beat()
    assert slave.link is MasterLink.REGISTERING
    envelope = slave.newest(srv.RegisterHost).request.envelope
    assert envelope.receiver_beat == slave.clock.boot_time_ns()


@pytest.mark.parametrize("period", [0.0, -1.0, float("nan"), float("inf"), 1e300])
def test_an_impossible_beat_period_is_refused(slave, monkeypatch, period) -> None:
    """The slave would never notice the end of its master."""
    monkeypatch.setattr("tests.unit.ros.slave.test_endpoint.PERIOD_OF_MASTER", period)
    slave.find(Master(slave, 11))
    Master(slave, 11).take_in()
    assert slave.link is MasterLink.SEARCHING


def test_a_late_greeting_starts_no_session(slave) -> None:
    """The round trip is too long to give the age of the master's messages."""
    ours = Master(slave, 11)
    slave.pass_time(PERIOD)
    slave.clock.now += 10.0
    ours.greet()
    assert slave.link is MasterLink.SEARCHING


def test_a_silent_master_is_lost(slave) -> None:
    slave.join(Master(slave, 11))
    slave.pass_time(1.8)
    assert slave.link is MasterLink.REGISTERED
    slave.pass_time(0.6)
    assert slave.link is not MasterLink.REGISTERED
    assert events.MasterLost() in slave.host.events


def test_a_slave_that_leaves_does_not_wait_for_a_master_that_fell_silent(slave, caplog) -> None:
    """The slave leaves once the master is silent; its log claims no running processes."""
    slave.join(Master(slave, 11))
    slave.pass_time(1.6)
    left = []
    slave.endpoint.leave(lambda: left.append(slave.clock.now))
    slave.pass_time(0.6)
    assert slave.link is not MasterLink.REGISTERED
    assert len(left) == 1
    assert not [line for line in caplog.messages if "keep running" in line]


def test_a_returning_master_learns_that_the_slave_leaves(slave) -> None:
    """The stop may take long; until its end the master must not count the host as staying."""
    slave.join(Master(slave, 11))
    slave.endpoint.leave(lambda: None)
    slave.pass_time(3.0)
    slave.join(Master(slave, 12, epoch=2))
    assert [call.request.envelope.epoch for call in slave.sent(srv.Leave)] == [1, 2]


def test_a_request_for_work_that_was_lost_is_soon_repeated(slave) -> None:
    """The first request after a registration may get lost; a long open one is repeated rarely."""
    master = Master(slave, 11)
    slave.join(master)
    start, at = slave.clock.now, []
    for _ in range(round(100.0 / PERIOD)):
        before = len(slave.sent(srv.RequestProcess))
        slave.pass_time(PERIOD, master)
        if len(slave.sent(srv.RequestProcess)) > before:
            at.append(slave.clock.now - start)
    assert at == pytest.approx([0.2, 0.6, 1.2, 2.2, 4.2, 8.2, 16.2, 32.2, 62.2, 92.2], abs=1.0)
    assert at[1] - at[0] < 0.5
    answer = msg.Answer(protocol_version=PROTOCOL_VERSION, accepted=True)
    slave.newest(srv.RequestProcess).answer(srv.RequestProcess.Response(answer=answer))
    before = len(slave.sent(srv.RequestProcess))
    slave.pass_time(29.0, master)
    assert len(slave.sent(srv.RequestProcess)) == before + 1


def test_work_that_crosses_with_the_next_request_is_taken(slave) -> None:
    """The master answered the former request at the moment in which the slave renewed it."""
    master = Master(slave, 11)
    slave.join(master)
    slave.pass_time(0.6, master)
    first, second = slave.sent(srv.RequestProcess)
    answer = msg.Answer(protocol_version=PROTOCOL_VERSION, accepted=True)
    first.answer(srv.RequestProcess.Response(answer=answer))
    assert events.AssignmentsReceived((), None) in slave.host.events
    slave.pass_time(PERIOD, master)
    assert len(slave.sent(srv.RequestProcess)) == 3  # the master keeps the newest of them open
    slave.pass_time(5.0, master)
    second.answer(srv.RequestProcess.Response(answer=answer))  # the slave has given it up by then
    assert slave.host.events.count(events.AssignmentsReceived((), None)) == 1


@pytest.mark.parametrize(
    ("code", "message"), [("name_taken", "a live one"), ("journal", "a full disk")]
)
def test_a_refused_registration_is_logged_once_and_retried(slave, caplog, code, message) -> None:
    """The name of the host is in use, or a master with a journal stall accepts no host for now."""
    ours = Master(slave, 11)
    for _ in range(3):
        slave.find(ours)
        ours.take_in(code=code, message=message)
        assert slave.link is MasterLink.SEARCHING
    assert slave.endpoint.failure == ""
    (line,) = [line for line in caplog.messages if message in line]
    assert line == caplog.messages[0]
    assert code == "journal" or line.startswith("a live one. Asking again for 5 s")
    slave.join(ours)


# --- remembered journal numbers ----------------------------------------------------------------


def test_the_journal_position_of_a_former_run_is_sent_back(monkeypatch, tmp_path) -> None:
    """A later run of the slave reports it, too; the same run of the master needs no report."""
    clock = Clock()
    monkeypatch.setattr(endpoint, "clocks", clock)
    path = tmp_path / "journal_seen"
    slave = Slave(clock, JournalWatermark(path))
    old = Master(slave, 11, epoch=2)
    slave.join(old)
    assert slave.newest(srv.RegisterHost).request.journal_seen == 0
    old.beat(journal=40)
    old.beat(journal=41)
    slave.pass_time(PERIOD)
    again = Slave(clock, JournalWatermark(path))
    for one in (slave, again):
        new = Master(one, 12, epoch=3, pid=8)
        one.pass_time(3.0, new)
        new.greet()
        assert one.newest(srv.RegisterHost).request.journal_seen == 41
        new.take_in()
        new.beat(journal=7)
    assert JournalWatermark(path).of_former_run("m", 12) == 0
    assert JournalWatermark(path).of_former_run("m", 13) == 7
    assert JournalWatermark(path).of_former_run("another", 13) == 0


def test_an_assignment_has_the_journal_position_of_its_record(slave) -> None:
    """The next beat may come too late. An order of another run of the master has another epoch."""
    first = Master(slave, 11, epoch=2)
    slave.join(first)
    slave.endpoint.note_journal(41, epoch=2)
    slave.endpoint.note_journal(99, epoch=1)
    second = Master(slave, 12, epoch=3, pid=8)
    slave.pass_time(3.0, second)
    second.greet()
    assert slave.newest(srv.RegisterHost).request.journal_seen == 41


def test_a_journal_that_cannot_be_remembered_is_remembered_in_memory(tmp_path) -> None:
    """The slave's disk is full, or its file is invalid."""
    path = tmp_path / "journal_seen"
    path.write_bytes(b"\xff nonsense")
    seen = JournalWatermark(path)
    assert seen.of_former_run("m", 2) == 0
    path.unlink()
    path.mkdir()
    seen.note(Watermark(5, 1, "m"))
    assert seen.of_former_run("m", 2) == 5


def test_an_impossible_journal_position_is_not_remembered(slave) -> None:
    """A forged beat; the next master would take its journal for damaged."""
    seen = JournalWatermark()
    seen.note(Watermark(2**64 - 1, 1, "m"))
    assert seen.of_former_run("m", 2) == 0


def test_an_answer_that_cannot_be_taken_in_counts_as_none(slave, monkeypatch, caplog) -> None:
    """The slave repeats its request, instead of waiting forever during a registration."""
    master = Master(slave, 11)
    slave.find(master)

    def fails(*_arguments) -> None:
        raise KeyError("oops")

    monkeypatch.setattr(slave.endpoint._reporter, "begin", fails)
    master.take_in()
    assert [one for one in caplog.messages if "KeyError: 'oops'" in one]
    assert slave.link is MasterLink.SEARCHING
    monkeypatch.undo()


def test_messages_without_a_valid_key_are_reported_at_a_bounded_rate(slave) -> None:
    """The first at once, further ones every ten seconds, none twice."""
    published: list[msg.ProcessStatusBatch] = []
    slave.endpoint._statuses.publish = published.append
    master = Master(slave, 11)
    slave.wire.refused("/rosrm/host/h0/control")
    slave.join(master)
    slave.pass_time(1.0, master)
    assert [one.strangers for one in published] == [1]
    for _ in range(5000):
        slave.wire.refused("/rosrm/host/h0/control")
    slave.pass_time(5.0, master)
    assert len(published) == 1
    slave.pass_time(30.0, master)
    assert [one.strangers for one in published] == [1, 5000]


def test_a_slave_that_the_master_does_not_receive_says_so_once(slave, caplog) -> None:
    """For example after its key was revoked; the beats of the master still arrive."""
    master = Master(slave, 11)
    slave.join(master)

    def lines(seconds: float, *silent: int) -> int:
        for _ in range(round(seconds / PERIOD)):
            slave.clock.now += PERIOD
            master.beat(silent_hosts=silent)
        said = sum("the key of host:h0 was revoked" in line for line in caplog.messages)
        caplog.clear()
        return said

    assert lines(4.0, 1) == 0
    assert lines(0.2) == 0
    assert lines(4.8, 1) == 0
    assert lines(60.0, 1) == 1
    assert lines(1.0) == 0
    assert lines(6.0, 1) == 1
