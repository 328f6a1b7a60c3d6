"""Replication and fetch of snapshots of a process with a key; with files, without ROS."""

from __future__ import annotations

import errno
import logging
import os
import threading
import zlib
from dataclasses import replace
from pathlib import Path

import pytest

from rosrm.model.values import Assignment, InstanceId
from rosrm.slave.replication import store
from rosrm.slave.replication.encryption import encrypted
from rosrm.slave.replication.keys import KEY
from rosrm.snapshots import reader
from rosrm.snapshots.format import TransferPart, checked
from tests.unit.slave.test_replication import P7, PATIENCE, Net, assignment, prepare
from tests.unit.slave.test_snapshot_store import snapshot

ONE, OTHER = bytes(range(32)), bytes(32)
PLAIN = b"\x2a" * 64


@pytest.fixture
def net(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    net = Net(tmp_path, caplog)
    net.wait = 0.05
    return net


def start(net: Net, host: str, *snapshot_hosts: str, number: int = 9, **fields) -> Assignment:
    """Start an instance with a key on a host; return the assignment that is launched."""
    fields.setdefault("state_key", ONE)
    (launched,) = prepare(net, host, assignment(*snapshot_hosts, number=number, **fields))
    return launched


def replicate(net: Net, *to: str, sequence: int = 42, size: int = 600_000) -> None:
    """Run p#7 on a, and send its snapshot to other hosts."""
    net.add_all("".join({"a", *to}))
    start(net, "a", number=7)
    net.slaves["a"].keep(P7, to, 1.0)
    net.write("a", sequence, size)
    net.until(lambda: all(net.age(host) == (7, sequence) for host in to), "the replicas")


def state_for_node(net: Net, host: str, number: int = 9) -> tuple[int, int] | None:
    """Return the age of the snapshot that a node would restore on a host."""
    found, _ = reader.newest(net.directory(host), number)
    return None if found is None else found.head.age


def copy_of(net: Net, host: str) -> Path:
    return net.directory(host) / reader.COPY


def plain_snapshot(net: Net, host: str = "a") -> bytes:
    return reader.newest_content(net.directory(host))[1]


def whole(data: bytes) -> TransferPart:
    head = checked(data)[0]
    return TransferPart(head.process, *head.age, 0, len(data), zlib.crc32(data), data)


def send(net: Net, host: str, data: bytes) -> str:
    """Offer a replica to a host as another slave does; return the reason of a refusal."""
    answers = []
    net.slaves[host].take_part(whole(data), answers.append)
    net.settle()
    return "" if answers[0] is None else answers[0].message


def messages(net: Net, says: str) -> list[str]:
    return [one for one in net.log.messages if says in one]


# --- on the way and at rest -----------------------------------------------------------------------


def test_what_leaves_the_host_and_what_is_stored_is_encrypted(net):
    """The keeper's slave reports the replica, and has no key of it."""
    replicate(net, "b")
    assert all(PLAIN not in part.data for part in net.wires["a"].given)
    assert reader.peek(copy_of(net, "b")).encrypted
    assert PLAIN not in copy_of(net, "b").read_bytes()
    assert not (net.directory("b") / KEY).exists()
    net.until(lambda: net.reports["b"][-1:] and net.reports["b"][-1], "the report")
    assert [(one.instance, one.sequence) for one in net.reports["b"][-1]] == [(P7, 42)]


def test_without_a_key_everything_is_plain(net):
    net.replicate("b")
    prepare(net, "a", assignment(number=7))
    net.write("a", 42)
    net.until(lambda: net.age("b") == (7, 42), "the replica")
    assert copy_of(net, "b").read_bytes() == plain_snapshot(net)


def test_the_next_run_of_a_slave_encrypts_too(net):
    """The instance runs on over the restart, and no assignment comes again."""
    replicate(net, "b")
    net.add("a")
    net.slaves["a"].keep(P7, ["b"], 1.0)
    net.write("a", 43, 600_000)
    net.until(lambda: net.age("b") == (7, 43), "the second replica")
    assert reader.peek(copy_of(net, "b")).encrypted


def test_a_host_that_runs_the_process_gives_its_snapshot_encrypted_only(net):
    """Any slave may ask for it."""
    replicate(net)
    answers = []
    net.slaves["a"].read_part("p", (0, 0), 0, 1 << 20, answers.append)
    net.settle()
    assert (answers[0].number, answers[0].sequence) == (7, 42)
    assert PLAIN not in answers[0].data


def test_nothing_is_sent_while_the_key_cannot_be_read(net):
    replicate(net, "b")
    (net.directory("a") / KEY).write_bytes(b"damaged")
    net.write("a", 43)
    net.pass_times(30)
    assert net.age("b") == (7, 42)
    assert messages(net, "holds no key")


def test_an_ended_instance_leaves_no_key_behind(net):
    """Neither one with a snapshot, which the master drops, nor one without."""
    replicate(net)
    net.slaves["a"].ended(P7)
    net.settle()
    assert (net.directory("a") / KEY).exists()
    net.slaves["a"].drop(P7, lives=False)
    net.settle()
    assert not net.directory("a").exists()
    start(net, "a", number=8)
    assert (net.directory("a") / KEY).exists()
    net.slaves["a"].ended(InstanceId("p", 8))
    net.settle()
    assert not net.directory("a").exists()


def test_an_instance_that_ends_during_its_local_search_leaves_no_key_behind(net):
    """The search, which stores the key, may begin only after the end."""
    net.add("a")
    slave, free = net.slaves["a"], threading.Event()
    slave._jobs.put(lambda: free.wait(PATIENCE))
    given = assignment(number=8, state_key=ONE)
    slave.prepare(given, lambda _: None)
    slave.forget(given.instance)
    slave.ended(given.instance)
    free.set()
    net.settle()
    assert not (net.directory("a") / KEY).exists()


def test_launchers_and_supervisor_get_no_key(net):
    net.add("a")
    assert start(net, "a") == replace(assignment(), state_key=b"")


# --- for a start ----------------------------------------------------------------------------------


def test_a_successor_on_the_host_of_the_replica_reads_it(net):
    """The slave decrypts the replica before the node starts; the node knows no keys."""
    replicate(net, "b")
    assert state_for_node(net, "b") is None
    start(net, "b", "b")
    assert state_for_node(net, "b") == (7, 42)
    assert plain_snapshot(net, "b") == plain_snapshot(net, "a")
    assert not copy_of(net, "b").exists()


def test_a_successor_on_another_host_fetches_and_reads_it(net):
    replicate(net, "b", size=10_000)
    net.add("c")
    start(net, "c", "b")
    assert state_for_node(net, "c") == (7, 42)
    assert plain_snapshot(net, "c") == plain_snapshot(net, "a")
    assert sorted(path.name for path in net.directory("c").iterdir()) == ["key", "state.0"]
    assert messages(net, "was fetched from b for p#9")


def test_a_destination_of_a_handoff_has_key_and_state(net):
    """After the commit it may crash before its first own snapshot."""
    replicate(net, "b")
    start(net, "b", shadow=True)
    assert state_for_node(net, "b") == (7, 42)
    assert (net.directory("b") / KEY).exists()


def test_a_replica_that_cannot_be_written_for_the_node_stays(net, monkeypatch):
    """The disk is full: the process starts, and the slave logs the reason."""
    replicate(net, "b")

    def full(directory: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(store, "write_slot", full)
    start(net, "b", "b")
    assert state_for_node(net, "b") is None
    assert copy_of(net, "b").exists()
    assert messages(net, "not used for p#9: No space left on device")


@pytest.mark.parametrize("headers", [0, 1], ids=["header", "content"])
def test_a_replica_that_cannot_be_read_now_stays(net, monkeypatch, headers):
    """The disk fails: the replica may be sound, and the only one."""
    replicate(net, "b")
    opened, right = [], os.open

    def failing(path, *rest) -> int:
        if str(path).endswith(f"/{reader.COPY}"):
            opened.append(path)
            if len(opened) > headers:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
        return right(path, *rest)

    monkeypatch.setattr(os, "open", failing)
    start(net, "b", "b")
    assert copy_of(net, "b").exists()
    assert messages(net, "not used for p#9: Input/output error")


@pytest.mark.parametrize("lacks", [0, 1])
def test_a_replica_waits_for_the_end_of_a_lack(net, monkeypatch, lacks):
    """A start without the replica would lose the state: its own snapshots would be newer."""
    net.wait = 10.0
    replicate(net, "b")
    opened, right = [], os.open

    def lacking(path, *rest) -> int:
        if str(path).endswith(f"/{reader.COPY}"):
            opened.append(path)
            if len(opened) in (1 + lacks, 3):
                raise OSError(errno.ENFILE, os.strerror(errno.ENFILE))
        return right(path, *rest)

    monkeypatch.setattr(os, "open", lacking)
    start(net, "b", "b")
    assert state_for_node(net, "b") == (7, 42)


def test_an_own_snapshot_that_is_newer_stays(net):
    """The replica replaces at most the older one of a node's two files."""
    replicate(net, "b")
    net.write("b", 3, number=8)
    start(net, "b", "b")
    assert state_for_node(net, "b") == (8, 3)
    assert copy_of(net, "b").exists()


def test_the_replica_of_a_later_instance_is_left_alone(net):
    """The assignment is late; a node never overwrites the file of a later instance."""
    replicate(net, "b")
    start(net, "b", number=6)
    assert state_for_node(net, "b", 6) is None
    assert copy_of(net, "b").exists()


def as_snapshot(content: bytes, number: int = 7, sequence: int = 42):
    data = snapshot("p", number, sequence, content)
    return checked(data)[0], data


#: Replicas of another slave's making, by the reason of their refusal.
FORGERIES = {
    "encrypted with another key": lambda age: encrypted(OTHER, *as_snapshot(b"forged", *age)),
    "it is not encrypted, and this process has a key": lambda age: as_snapshot(b"forged", *age)[1],
}


@pytest.mark.parametrize("why", FORGERIES)
def test_a_forged_replica_is_refused_and_the_next_host_is_asked(net, why):
    """Another slave can neither change the state nor replace it by an own one."""
    replicate(net, "b", "c", size=10_000)
    copy_of(net, "b").write_bytes(FORGERIES[why]((7, 42)))
    net.add("d")
    start(net, "d", "b", "c")
    assert state_for_node(net, "d") == (7, 42)
    assert plain_snapshot(net, "d") == plain_snapshot(net, "a")


@pytest.mark.parametrize("why", FORGERIES)
def test_a_start_says_why_the_only_replica_was_refused(net, why):
    replicate(net, "b", size=10_000)
    copy_of(net, "b").write_bytes(FORGERIES[why]((7, 42)))
    net.add("d")
    start(net, "d", "b")
    assert state_for_node(net, "d") is None
    (message,) = messages(net, "it starts from nothing")
    assert why in message
    assert sorted(path.name for path in net.directory("d").iterdir()) == ["key"]


@pytest.mark.parametrize("why", FORGERIES)
def test_a_forged_replica_on_the_host_itself_is_deleted_and_the_next_host_is_asked(net, why):
    """The host may have stored it before the process had a key here."""
    replicate(net, "b", "c", size=10_000)
    copy_of(net, "b").write_bytes(FORGERIES[why]((7, 42)))
    start(net, "b", "b", "c")
    assert state_for_node(net, "b") == (7, 42)
    assert plain_snapshot(net, "b") == plain_snapshot(net, "a")
    (message,) = messages(net, "the replica here is not used for p#9")
    assert why in message
    assert messages(net, "was fetched from c")


@pytest.mark.parametrize("host", ["b", "d"])
def test_an_encrypted_replica_is_refused_where_the_process_has_no_key(net, host):
    """The cluster's security was switched off."""
    replicate(net, "b", size=10_000)
    if host not in net.slaves:
        net.add(host)
    start(net, host, "b", state_key=b"")
    assert state_for_node(net, host) is None
    assert messages(net, "it is encrypted, and this process has no key")


@pytest.mark.parametrize("why", FORGERIES)
def test_a_host_with_the_key_stores_no_forged_replica(net, why):
    """A forged replica would displace the true one, or be read at the next restart."""
    replicate(net)
    before = plain_snapshot(net)
    assert why in send(net, "a", FORGERIES[why]((7, 2**40)))
    assert plain_snapshot(net) == before
    assert not copy_of(net, "a").exists()


def test_a_replica_that_arrives_during_a_fetch_does_not_hide_the_fetched_one(net):
    """The node cannot read the encrypted replica, so it must not count as the newest state."""
    replicate(net, "b", size=10_000)
    slave = net.add("c")
    request = assignment("b", state_key=ONE)
    started: list[Assignment] = []
    slave.prepare(request, started.append)
    net.slaves["c"]._jobs.put(
        lambda: slave._store.take(whole(encrypted(ONE, *as_snapshot(b"x", 7, 43))), bounded=True)
    )
    net.until(lambda: started, "the start")
    assert state_for_node(net, "c") == (7, 42)


def test_the_bounds_count_the_encrypted_size(net):
    """A replica that fits without encryption alone is refused."""
    net.add("a")
    start(net, "a", number=7)
    net.write("a", 1, 5000)
    size = len(plain_snapshot(net))
    net.add("b", max_bytes=size)
    net.slaves["a"].keep(P7, ["b"], 1.0)
    net.until(lambda: messages(net, "keep.max_bytes"), "the refusal")
    net.add("b", max_bytes=size + 110)
    net.until(lambda: net.age("b") == (7, 1), "the replica")
