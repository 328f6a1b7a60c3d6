"""A stranger in the domain of a cluster: nothing it sends starts, stops, moves, reads or wedges."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from array import array
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from rclpy._rclpy_pybind11 import RMWError
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.keys import key_files
from rosrm.keys.cluster import own_grant
from rosrm.keys.roles import Role, principal_of
from rosrm.keys.security import NoSecurity
from rosrm.keys.tickets import Ticket
from rosrm.ros import master_socket, names, qos
from rosrm.ros.sealed_readings import reading_channel, seal_reading
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg
from tests.faults.intruder import (
    TOPICS,
    Intruder,
    false_master,
    false_member,
    path,
    random_sealed,
    sealed_like,
    services,
    strange_principals,
)
from tests.faults.intruder_scene import HOSTS, SECRET, WITNESS, Scene, bytes_below, guarded_hosts
from tests.waiting import PATIENCE

MIB = 2**20
FLOOD = 5000
NAMES = (f"user:{key_files.user_name()}", "user:eve", "host:h0", "host:h9", "user:rosrm-master")


@pytest.fixture(scope="module")
def scene(make_shared):
    return Scene(make_shared(*guarded_hosts()))


@pytest.fixture(scope="module")
def shared_intruder(scene):
    with closing(Intruder(scene.cluster.ros, *HOSTS)) as intruder:
        # A slave shows its run by the statuses of a job.
        intruder.wait(lambda: intruder.runs.keys() >= {"", *HOSTS} or scene.check(), "all runs")
        yield intruder


@pytest.fixture
def intruder(scene, shared_intruder):
    """Yield a stranger; afterwards all is as before, and it has read nothing."""
    yield shared_intruder
    scene.check()
    heard = b"".join(data for topic in shared_intruder.heard.values() for data in topic)
    requests = (one for heard in shared_intruder.overheard.values() for one in heard)
    heard += b"".join(bytes(one.body) for one in requests)
    assert SECRET.encode() not in heard


@pytest.fixture(params=["other keys", "no keys"])
def false_identity(request):
    """Yield a function that returns the security of a member that the master does not know."""
    if request.param == "no keys":
        return lambda name: NoSecurity(principal_of(name))
    return false_member


def start(scene: Scene, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command of `rosrm` in the domain of the cluster."""
    domain = {"ROS_DOMAIN_ID": str(scene.cluster.domain), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-m", "rosrm.cli", *words], check=False, capture_output=True, text=True,
        env={**os.environ, **domain, **environment}, timeout=PATIENCE,
    )  # fmt: skip


# --- forged messages ----------------------------------------------------------------------------


def test_no_request_of_a_stranger_is_answered(scene, intruder, false_identity) -> None:
    """In the name of an operator, a new user, a host, a new host, or another master."""
    for name in NAMES:
        security = false_identity(name)
        intruder.wait_for_beat()
        futures = [
            (service, intruder.ask_master(security, service, request))
            for service, request in scene.requests(name.removeprefix("host:"))
        ]
        intruder.spin(0.3)
        assert [service for service, future in futures if future.done()] == []


def test_forged_messages_of_hosts_change_nothing(scene, intruder, false_identity) -> None:
    """Readings, statuses, usages and snapshots, in the name of a host or of a new one."""
    for name in ("host:h0", "host:h9"):
        security = false_identity(name)
        security.master.run = intruder.runs[""]
        endpoints = intruder.endpoints(security)
        for topic, message in scene.messages(HOSTS[0]):
            if topic == names.RESOURCE_INFO:
                channel = reading_channel(path(topic))
                for _ in range(50):  # best effort
                    intruder.publish(path(topic), seal_reading(security.master, channel, message))
            else:
                sender = endpoints.publisher(
                    type(message), path(topic), qos.STATUSES, security.master
                )
                intruder.spin(0.3)
                sender.publish(message)
    intruder.spin(0.5)


def test_forged_beats_lead_nobody_away(scene, intruder) -> None:
    """Beats of an older master, and of this one that hears no host, signed by another key."""
    beat = intruder.beat
    for security in (false_master(), NoSecurity()):
        topic = path(names.MASTER_BEAT)
        sender = intruder.endpoints(security).announcer(msg.MasterBeat, topic, qos.BEAT)
        security.run = intruder.runs[""]
        for epoch, incarnation in ((beat.epoch + 1, 99), (beat.epoch, beat.incarnation)):
            for _ in range(20):
                sender.publish(
                    msg.MasterBeat(
                        protocol_version=PROTOCOL_VERSION, name=beat.name, hostname=beat.hostname,
                        pid=beat.pid, epoch=epoch, incarnation=incarnation, beat=2**62,
                        uptime=1e8, journal=2**62, silent_hosts=[0, 1, 2],
                    )
                )  # fmt: skip
                intruder.spin(0.05)
    registered = [event.host for event in scene.cluster.events("host_registered")]
    assert sorted(registered) == sorted(HOSTS)


def test_slaves_obey_no_other_master(scene, intruder) -> None:
    """Orders to start, stop and kill, of a master with another secret or with none."""
    for security in (false_master(), NoSecurity()):
        for order in scene.orders():
            peer = intruder.as_master(security, HOSTS[0])
            service = path.of_host(HOSTS[0], names.CONTROL)
            assert intruder.answer(intruder.ask(security, service, peer, order)) is None


def test_the_master_counts_the_messages_that_a_slave_refused(scene, intruder) -> None:
    """`rosrm status` names the host, because the slave reports a number alone."""
    order, host = next(scene.orders()), HOSTS[0]
    security = false_master()
    peer = intruder.as_master(security, host)
    intruder.ask(security, path.of_host(host, names.CONTROL), peer, order)
    intruder.wait(
        lambda: f"on the topics of host:{host}" in scene.cluster.client.list().strangers,
        "the number of the slave",
    )


@pytest.mark.parametrize("wanted", [names.READ_LOG, names.STORE_REPLICA, names.READ_SNAPSHOT])
def test_forged_tickets_open_no_slave(intruder, wanted) -> None:
    """A ticket whose key the master did not derive reads and stores nothing."""
    fields = {"protocol_version": PROTOCOL_VERSION, "process": WITNESS}
    service = path.of_host(HOSTS[0], wanted)
    request = services(*HOSTS)[service].Request(**fields)
    ticket = Ticket(2**63, 1, wanted, 0, WITNESS, principal_of(NAMES[0])).text()
    for security in (false_member(NAMES[0]), NoSecurity(principal_of(NAMES[0]))):
        peer = security.bearer(ticket, os.urandom(32), intruder.runs[HOSTS[0]])
        assert intruder.answer(intruder.ask(security, service, peer, request)) is None


# --- garbage ------------------------------------------------------------------------------------


def test_random_bytes_end_nothing(intruder) -> None:
    """As messages, bodies, names of principals, and runs, on each topic and service."""
    for topic in TOPICS:
        for size in (0, 1, 4, 11, 60, 236, 1000):
            intruder.publish(topic, os.urandom(size))
            intruder.publish(topic, b"\0\1\0\0" + os.urandom(size))
        for name in (*strange_principals(), *NAMES):
            intruder.publish(topic, serialize_message(random_sealed(name)))
    for service in services(*HOSTS):
        for name in (*strange_principals(), *NAMES):
            intruder.call(service, random_sealed(name))
    intruder.spin(0.5)


def test_huge_messages_end_nothing(scene, intruder) -> None:
    """Messages of 50 MB; memory of master and slaves grows by less than a few of them."""
    before = scene.memory()
    huge = random_sealed("host:h0", 50_000_000)
    intruder.publish(path(names.PROCESS_STATUS), serialize_message(huge))
    signed = msg.Signed(format=1, counter=2**40, run=array("B", bytes(16)), body=huge.body)
    intruder.publish(path(names.MASTER_BEAT), serialize_message(signed))
    for service in (path(names.SUBMIT), path.of_host(HOSTS[0], names.STORE_REPLICA)):
        intruder.call(service, huge)
    intruder.spin(3.0)
    after = scene.memory()
    assert all(after[name] - before[name] < 300 * MIB for name in before), (before, after)


# --- floods -------------------------------------------------------------------------------------


def test_floods_end_nothing_and_store_little(scene, intruder) -> None:
    """5,000 messages on each topic and service, each of another stranger."""
    records, memory = len(scene.records()), scene.memory()
    journal = bytes_below(scene.cluster.directory / "master")
    messages = [random_sealed(f"host:s{number}") for number in range(FLOOD)]
    for topic in TOPICS:
        for number, message in enumerate(messages):
            intruder.publish(topic, serialize_message(message))
            if number % 500 == 0:
                intruder.spin(0.01)
    for service in services(*HOSTS):
        for message in messages:
            intruder.call(service, message)
        intruder.spin(0.01)
    scene.check()
    assert len(scene.records()) - records < 20
    grown = {name: size - memory[name] for name, size in scene.memory().items()}
    assert max(grown.values()) < 100 * MIB, grown
    assert bytes_below(scene.cluster.directory / "master") - journal < MIB


def test_the_status_shows_strangers(scene, intruder) -> None:
    """With their number, and the topic of the last message."""
    status = start(scene, "status")
    assert "messages without a valid key refused, the last" in status.stdout, status.stderr


# --- what was overheard -------------------------------------------------------------------------


def test_second_servers_neither_learn_nor_answer(scene, intruder, monkeypatch) -> None:
    """The answers of the intruder come first; the requests reach the true servers, unread."""
    monkeypatch.setattr(master_socket, "connect", lambda _: None)  # all requests over DDS
    intruder.overhear()
    cluster = scene.cluster

    def ask() -> bool:
        cluster.reconnect()
        scene.run_jobs(TOKEN=SECRET)
        assert SECRET in cluster.log(WITNESS)
        cluster.client.explain(WITNESS)
        for action in ("cordon", "uncordon"):
            cluster.client.set_host_state(HOSTS[1], action)
        intruder.spin(0.2)
        used = (names.SUBMIT, names.LIST, names.EXPLAIN, names.INTRODUCE, names.SET_HOST_STATE)
        log = path.of_host(HOSTS[0], names.READ_LOG)
        return all(intruder.overheard[one] for one in (*map(path, used), log))

    intruder.wait(ask, "requests to be overheard")


@pytest.mark.parametrize("after", ["at once", "a restart of the master"])
def test_recorded_messages_have_no_second_effect(scene, intruder, after) -> None:
    """On each topic and service: as they were, with a higher counter, and of another run."""
    if after != "at once":
        scene.cluster.restart_master()
        scene.cluster.wait_for_hosts()
        scene.remember()
    intruder.spin(0.5)
    newest = scene.cluster.client.list().last_sequence
    for topic, heard in intruder.heard.items():
        for data in heard[-500:]:
            for again in (data, *changed(TOPICS[topic][0], data)):
                intruder.publish(topic, again)
    for service, heard in intruder.overheard.items():
        for message in heard[-50:]:
            newer = sealed_like(message, counter=message.counter + 2**20)
            for again in (message, newer, sealed_like(newer, run=os.urandom(16))):
                intruder.call(service, again)
    intruder.spin(1.0)
    assert {event.kind for event in scene.cluster.events(after=newest)} <= {"peer_refused"}


def changed(kind: Any, data: bytes) -> Iterator[bytes]:
    """Yield a recorded message with a higher counter, and with another run, if it is one."""
    try:
        message = deserialize_message(data, kind)
    except RMWError:  # one that the intruder has sent
        return
    if message.counter < 2**60:
        message.counter += 2**20
        yield serialize_message(message)
    if hasattr(message, "run"):
        message.run = array("B", os.urandom(16))
        yield serialize_message(message)


# --- another local user -------------------------------------------------------------------------


@pytest.fixture
def open_parents(scene):
    """Let everybody enter the parents of the cluster's directory, as those of a home directory."""
    modes = {
        one: one.stat().st_mode
        for one in (scene.cluster.directory, *scene.cluster.directory.parents[:2])
    }
    for one, mode in modes.items():
        one.chmod(mode | 0o055)
    yield
    for one, mode in modes.items():
        one.chmod(mode)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_another_local_user_reads_and_does_nothing(scene, intruder, open_parents) -> None:
    """No file, socket or key of the cluster's user is usable, and no request is answered."""
    if not all(one.stat().st_mode & 0o005 for one in Path(__file__).resolve().parents[2:]):
        pytest.skip("others may not read the directory of this checkout, and so not run rosrm")
    parts = ",".join(str(one.process.pid) for one in scene.cluster.parts())
    refused = scene.refused()
    run = subprocess.run(
        [sys.executable, "-m", "tests.faults.other_user", str(scene.cluster.domain),
         str(scene.cluster.directory), str(key_files.key_home()),
         f"{scene.witness.pid},{parts}"],
        capture_output=True, text=True, timeout=2 * PATIENCE, check=False,
        env={**os.environ, "HOME": "/nowhere", "ROS_LOG_DIR": "/tmp"},
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert found.pop("looked at") > 10
    assert found == {"opened": [], "used": [], "answered": []}
    assert scene.refused() > refused + 10  # the master has received the requests


# --- key files ----------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["mode", "owner", "link"])
def test_key_files_that_others_can_change_are_refused(scene, tmp_path, fault) -> None:
    """A command with such a file ends with the reason, before it joins the domain."""
    secret = key_files.read_secret(key_files.key_home())
    file = tmp_path / "ada.key"
    key_files.write_key(file, secret.key_of(own_grant(principal_of("user:ada"))))
    if fault == "mode":
        file.chmod(0o644)
    elif fault == "owner":
        if os.geteuid() != 0:
            pytest.skip("only root can give a file away")
        os.chown(file, 65534, 65534)
    else:
        file = file.rename(tmp_path / "true.key")
        (tmp_path / "ada.key").symlink_to(file)
    settings = tmp_path / "host.yaml"
    settings.write_text(f"host: h9\nstate: {tmp_path}/state\n")
    for words in (["status"], ["slave", "--config", str(settings)]):
        run = start(scene, *words, ROSRM_KEY=str(tmp_path / "ada.key"))
        assert run.returncode != 0
        assert "the key file" in run.stderr


def test_grants_that_others_can_write_change_nothing(scene, intruder) -> None:
    """A running master keeps the grants that it has, and logs why."""
    grants = key_files.key_home() / key_files.GRANTS_FILE
    key_files.add_grant(key_files.key_home(), principal_of("user:vera"), Role.VIEWER)
    before = grants.read_text()
    grants.write_text(before + "- {principal: 'user:eve', role: operator, generation: 1}\n")
    grants.chmod(0o666)
    try:
        intruder.wait(lambda: "the keys stay as they were" in scene.cluster.log_of("master"),
                      "the refusal of the file")  # fmt: skip
        scene.check()
    finally:
        grants.write_text(before)
        grants.chmod(0o600)
