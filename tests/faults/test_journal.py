"""Journal faults of a real master: lost newest records, a damaged file, a full disk."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sqlite3
from pathlib import Path

import pytest

from rosrm.config.settings import LivenessSettings
from rosrm.errors import JournalError, NoMaster, Refused
from rosrm.journal.recovery import recover
from rosrm.journal.sqlite import SqliteJournal
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Intent, Record
from tests.faults.disks import small_disk
from tests.ros.clusters import alive, clusters, host, job, service
from tests.waiting import PATIENCE, wait_gone, wait_until

#: Seconds. Short, because tests wait for the lease; a busy machine needs some room for suspect.
LIVENESS = LivenessSettings(suspect=2.0, lease=5.0)


def files_of(cluster) -> list[Path]:
    return sorted((cluster.directory / "master").glob("journal.sqlite*"))


def boot_of(cluster) -> str:
    """Return the boot ID of the machine at the time when the journal's master ran."""
    with contextlib.closing(sqlite3.connect(files_of(cluster)[0])) as database:
        (value,) = database.execute("SELECT value FROM intent WHERE key = 'epoch'").fetchone()
    return str(value)


# --- a journal gap -----------------------------------------------------------------------------


def test_a_journal_gap_is_reported_and_starts_nothing_twice(make_cluster) -> None:
    """A journal gap is reported, and no process runs twice.

    The state is that after a power failure: the newest records are gone, and hosts know them. Both
    slaves were restarted since. Processes started in the lost part are stopped. A process queued
    before is started again once its lost instance has ended; all others keep running.
    """
    cluster = make_cluster(host("h0"), host("h1"), liveness=LIVENESS)
    cluster.submit(service("before"))
    pid = cluster.wait("before", "running").pid
    for name in ("h0", "h1"):
        cluster.client.set_host_state(name, "cordon")
    cluster.submit(service("queued"))
    cluster.end(cluster.master, signal.SIGKILL)
    kept = {path: path.read_bytes() for path in files_of(cluster)}
    cluster.reconnect()
    cluster.start_master()
    up = {"h0", "h1"}
    cluster.wait_until(
        "both up", lambda v: {r.description.name for r in v.hosts if r.state == "up"} == up
    )
    cluster.client.set_host_state("h1", "uncordon")
    lost = cluster.wait("queued", "running").pid
    cluster.submit(service("after"))
    stranger = cluster.wait("after", "running").pid
    for _ in range(20):
        cluster.client.list()  # each beat carries the newest sequence to every host
        cluster.client.spin(0.02)

    cluster.end(cluster.master, signal.SIGKILL)
    for path in files_of(cluster):
        path.unlink()
    for path, content in kept.items():
        path.write_bytes(content)
    for name in ("h0", "h1"):
        cluster.end(cluster.slaves[name], signal.SIGKILL)
    for one in cluster.hosts:
        cluster.start_slave(one)
    cluster.reconnect()
    cluster.start_master()
    told = cluster.wait_for_event("journal_behind")
    assert told.facts["lost"] == told.facts["seen"] - told.facts["newest"] > 0
    for name in ("h0", "h1"):
        cluster.client.set_host_state(name, "uncordon")
    wait_gone(lost)
    wait_gone(stranger)
    row = cluster.wait("queued", "running")
    assert row.pid != lost
    assert cluster.wait("before", "running").pid == pid
    assert [one.name for one in cluster.client.list(processes=True).processes] == [
        "before", "queued",
    ]  # fmt: skip
    assert len(cluster.events("journal_behind")) == 1


@pytest.mark.parametrize("killed", [False, True])
def test_after_a_reboot_the_master_waits_for_all_hosts(make_cluster, killed) -> None:
    """After a reboot of its machine the master waits for all hosts to report.

    Its journal may have lost records that a disconnected host acts on. The master also waits when
    the first master after the reboot was killed before all hosts reported.
    """
    cluster = make_cluster(host("h0"), host("h1"), liveness=LIVENESS)
    for part in (cluster.master, cluster.slaves.pop("h1")):
        cluster.end(part, signal.SIGKILL)
    with sqlite3.connect(files_of(cluster)[0]) as database:
        database.execute(
            "UPDATE intent SET value = json_set(value, '$.boot', 'another') WHERE key = 'epoch'"
        )
    cluster.reconnect()
    cluster.start_master()
    if killed:
        wait_until(lambda: "another" not in boot_of(cluster), "the next boot is in the journal")
        cluster.restart_master()
    assert cluster.run(job("p", "true"))[0].state == "finished"
    kinds = [(event.kind, event.process or event.host) for event in cluster.events()]
    assert kinds.index(("assigned", "p")) > kinds.index(("host_lost", "h1"))


# --- a damaged or lost file --------------------------------------------------------------------


def test_a_damaged_journal_is_refused_and_recovered(make_cluster) -> None:
    """The master explains the repair and stops nothing; recovery keeps all readable rows."""
    cluster = make_cluster(host("h0"), liveness=LIVENESS)
    cluster.submit(service("p"))
    pid = cluster.wait("p", "running").pid
    cluster.submit(*(job(f"j{n:03}", "true") for n in range(200)))
    cluster.ended("j199")
    cluster.end(cluster.master, signal.SIGINT)
    journal = cluster.directory / "master" / "journal.sqlite"
    raw = bytearray(journal.read_bytes())
    leaves = [at for at in range(4096, len(raw), 4096) if b'"j100"' in raw[at : at + 4096]]
    for at in leaves:
        raw[at : at + 4096] = os.urandom(4096)
    journal.write_bytes(raw)

    cluster.reconnect()
    assert cluster.start_master().process.wait(PATIENCE) == 1
    said = cluster.log_of("master")
    assert f"rosrm master: the journal {journal} cannot be used" in said
    assert "`--recover`" in said
    assert "move it away" in said
    assert "Traceback" not in said
    assert alive(pid)

    recover(journal)
    cluster.start_master()
    cluster.wait_for_hosts()
    assert cluster.events("journal_recovered")
    assert cluster.wait("p", "running").pid == pid
    assert cluster.run(job("new", "true"))[0].state == "finished"


def test_a_master_without_its_journal_starts_empty(make_cluster) -> None:
    """Processes of the lost journal are stopped as unknown; their names are free, new work runs.

    The slave sees no silence of the master, and the same epoch as before, or an older one.
    """
    # A master without the records that hosts have seen assigns no work for one lease.
    cluster = make_cluster(host("h0"), liveness=LivenessSettings(lease=3.0))

    def may_submit() -> bool:
        with contextlib.suppress(Refused):  # until the slave has reported its end
            return bool(cluster.submit(service("p")))
        return False

    for epoch in (1, 2):
        if epoch == 2:
            cluster.restart_master()
            cluster.wait_for_hosts()
        else:
            cluster.submit(service("p"))
        before = cluster.wait("p", "running")
        cluster.end(cluster.master, signal.SIGKILL)
        for path in files_of(cluster):
            path.unlink()
        cluster.reconnect()
        cluster.start_master()
        # The host registers before its open request for work is repeated.
        cluster.wait_for_hosts()
        assert "epoch 1" in cluster.events("master_started")[-1].message
        wait_gone(before.pid)
        wait_until(may_submit, "the end of the unknown process", pause=cluster.client.spin)
        assert cluster.wait("p", "running").pid != before.pid


def test_a_damaged_journal_on_a_full_disk_is_left_as_it_is(tmp_path) -> None:
    """The error names the space that recovery needs, without a traceback; with room it succeeds."""
    with small_disk(tmp_path / "disk") as disk:
        path = disk.place / "journal.sqlite"
        journal = SqliteJournal(path)
        many = [
            Intent("process", f"p{n:03}", {"instances": {}, "x": "y" * 200}) for n in range(300)
        ]
        journal.write([], many, 0.0)
        journal.close()
        raw = bytearray(path.read_bytes())
        at = raw.index(b"p299") // 4096 * 4096
        raw[at : at + 4096] = os.urandom(4096)
        path.write_bytes(raw)
        disk.fill()
        with pytest.raises(JournalError, match=r"not recovered.*No space left.*of 1\.0 MiB"):
            recover(path)
        assert path.read_bytes() == raw
        assert not list(disk.place.glob("recovery-*"))
        disk.make_room()
        assert "was recovered" in recover(path)


def test_a_recovery_has_all_rows_or_leaves_the_journal_as_it_is(tmp_path) -> None:
    """The room may suffice for the new journal, but not for the end of its write-ahead log."""
    with small_disk(tmp_path / "disk", size="8m") as disk:
        path = disk.place / "state" / "journal.sqlite"
        journal = SqliteJournal(path)
        intents = [
            Intent("process", f"p{n:03}", {"instances": {}, "x": "y" * 2000}) for n in range(100)
        ]
        journal.write([Record(EventKind.ASSIGNED, "p")], intents, 0.0)
        journal.close()
        raw = bytearray(path.read_bytes())
        with contextlib.closing(sqlite3.connect(path)) as database:
            query = "SELECT rootpage FROM sqlite_master WHERE name = 'record_process'"
            (page,) = database.execute(query).fetchone()
        raw[(page - 1) * 4096 : page * 4096] = bytes(4096)
        outcomes = set()
        for pages in range(len(raw) // 4096, len(raw) * 4 // 4096, 8):
            shutil.rmtree(path.parent)
            path.parent.mkdir(mode=0o700)
            path.write_bytes(raw)
            disk.fill(but=pages * 4096)
            try:
                recover(path)
            except JournalError:
                outcomes.add("unchanged")
                assert path.read_bytes() == raw
            else:
                outcomes.add("recovered")
                disk.make_room()
                with contextlib.closing(SqliteJournal(path)) as journal:
                    assert len(journal.intents("process")) == len(intents), pages
            disk.make_room()
        assert outcomes == {"unchanged", "recovered"}


# --- a journal stall --------------------------------------------------------------------------


def test_a_journal_locked_by_another_program(make_cluster) -> None:
    """The master resumes after another program releases its lock on the journal."""
    cluster = make_cluster(host("h0"), liveness=LIVENESS)
    cluster.submit(service("stays"), service("ends"))
    pids = {name: cluster.wait(name, "running").pid for name in ("stays", "ends")}
    holder = sqlite3.connect(files_of(cluster)[0], isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    os.kill(pids["ends"], signal.SIGKILL)
    assert "another program has it open" in blocked(cluster)
    with pytest.raises(Refused, match="another program has it open"):
        cluster.submit(job("new", "true"))
    holder.close()
    cluster.wait_for_event("journal_back", "another program has it open")
    assert cluster.ended("ends").state == "failed"
    assert cluster.run(job("new", "true"))[0].state == "finished"
    assert cluster.wait("stays", "running").pid == pids["stays"]
    assert not cluster.events("host_lost")


# --- a full disk -------------------------------------------------------------------------------


@pytest.fixture
def disk(tmp_path):
    """Mount a small disk at the state directory of the master."""
    with small_disk(tmp_path / "c" / "master") as disk:
        yield disk


@pytest.fixture
def cluster(disk, tmp_path):
    with clusters(lambda: tmp_path / "c") as make:
        yield make(host("h0", max_processes=3), host("h1", max_processes=1), liveness=LIVENESS)


def blocked(cluster) -> str:
    """Wait until the master takes no new work; return the reason."""
    return wait_until(lambda: cluster.client.list().trouble, "the master noticing its full disk")


def test_a_full_disk_stops_new_work_and_keeps_what_runs(cluster, disk) -> None:
    """Requests are refused with the file system's name; nothing is lost, nothing runs twice.

    The journal stall lasts longer than the lease, and no host is lost by it. Decisions that could
    not be written are carried out in order when there is room. A slave restarted during the stall
    rejoins with its process.
    """
    ran = cluster.directory / "ran"
    cluster.submit(service("s0"), service("ends"), service("s1"), service("s2"))
    pids = {name: cluster.wait(name, "running").pid for name in ("s0", "ends", "s1", "s2")}
    cluster.submit(*(job(f"q{n}", "sh", "-c", f"echo q{n} >> {ran}") for n in range(5)))
    where = {row.name: row.host for row in cluster.client.list(processes=True).processes}
    disk.fill()
    os.kill(pids["ends"], signal.SIGKILL)  # frees a place, so the master must decide
    reason = blocked(cluster)
    for part in ("free of 1.0 MiB", "make room", "Running processes continue"):
        assert part in reason
    assert str(disk.place) not in reason
    for request in (
        lambda: cluster.submit(job("late", "true")),
        lambda: cluster.client.cancel(["s0"]),
        lambda: cluster.client.migrate("s0"),
        lambda: cluster.client.set_host_state("h0", "drain"),
    ):
        with pytest.raises(Refused, match="disk is full") as refusal:
            request()
        assert refusal.value.code == "journal"
    cluster.end(cluster.slaves["h1"], signal.SIGKILL)
    cluster.start_slave(cluster.hosts[1])
    cluster.stays(LIVENESS.lease + 1.0, lambda: cluster.client.list().trouble, "the stall")
    assert not ran.exists()
    assert all(alive(pid) for name, pid in pids.items() if name != "ends")

    disk.make_room()
    cluster.wait_for_event("journal_back", "disk is full")
    for n in range(5):
        assert cluster.ended(f"q{n}").state == "finished"
    assert ran.read_text().split() == ["q0", "q1", "q2", "q3", "q4"]
    assert cluster.process("ends").state == "failed"
    for name in ("s0", "s1", "s2"):
        row = cluster.wait(name, "running")
        assert (row.pid, row.host) == (pids[name], where[name])
    assert not cluster.events("host_lost")
    assert cluster.run(job("late", "true"))[0].state == "finished"
    assert cluster.log_of("master").count("the master accepts no new work until then") == 1


def test_a_master_is_killed_while_its_disk_is_full(cluster, disk) -> None:
    """Decisions that were not written are not carried out; the master starts when there is room."""
    cluster.submit(service("s0"), service("ends"))
    pids = {name: cluster.wait(name, "running").pid for name in ("s0", "ends")}
    disk.fill()
    os.kill(pids["ends"], signal.SIGKILL)
    blocked(cluster)
    cluster.end(cluster.master, signal.SIGKILL)
    cluster.reconnect()
    assert cluster.start_master().process.wait(PATIENCE) == 1
    said = cluster.log_of("master")
    assert "disk is full" in said
    assert "Traceback" not in said
    disk.make_room()
    cluster.start_master()
    cluster.wait_for_hosts()
    assert cluster.ended("ends").state == "failed"
    assert cluster.wait("s0", "running").pid == pids["s0"]


def test_a_master_is_stopped_while_its_disk_is_full(cluster, disk) -> None:
    """A master stopped on a full disk exits with 0."""
    cluster.submit(service("ends"))
    pid = cluster.wait("ends", "running").pid
    disk.fill()
    os.kill(pid, signal.SIGKILL)
    blocked(cluster)
    assert cluster.end(cluster.master, signal.SIGINT) == 0
    assert "Traceback" not in cluster.log_of("master")
    disk.make_room()
    cluster.reconnect()
    cluster.start_master()
    assert cluster.ended("ends").state == "failed"


def test_a_request_while_the_disk_becomes_full(cluster, disk) -> None:
    """The answer waits for the journal; if the journal is late, the error gives the reason."""
    disk.fill()
    cluster.client._timeout = 1.0
    with pytest.raises(NoMaster, match=r"did not answer .*disk is full.* may still be executed"):
        cluster.submit(job("first", "true"))
    with pytest.raises(Refused, match="disk is full"):
        cluster.submit(job("second", "true"))
    disk.make_room()
    assert cluster.ended("first").state == "finished"
    assert [row.name for row in cluster.client.list(processes=True).processes] == ["first"]
