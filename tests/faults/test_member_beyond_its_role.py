"""Members with genuine keys that try what their roles do not permit."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import pytest

from rosrm.keys import key_files
from rosrm.keys.cluster import own_grant
from rosrm.keys.roles import Role, action_of, principal_of
from rosrm.keys.security import MemberSecurity
from rosrm.keys.tickets import ticket_of
from rosrm.ros import names, qos
from rosrm.ros.introductions import introduction_request
from rosrm.ros.sealed_readings import reading_channel, seal_reading
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import srv
from tests.faults.intruder import Intruder, path
from tests.faults.intruder_scene import HOSTS, SECRET, WITNESS, Scene, guarded_hosts, registration
from tests.ros.clusters import service

READS = (names.LIST, names.EXPLAIN)
OF_HOSTS = (names.REGISTER_HOST, names.LEAVE, names.REQUEST_PROCESS)
ME = f"user:{key_files.user_name()}"


@pytest.fixture(scope="module")
def scene(make_shared):
    return Scene(make_shared(*guarded_hosts()))


@pytest.fixture(scope="module")
def shared_member(scene):
    with closing(Intruder(scene.cluster.ros, *HOSTS)) as member:
        member.wait(lambda: member.runs.keys() >= {"", *HOSTS} or scene.check(), "all runs")
        yield member


@pytest.fixture
def member(scene, shared_member):
    """Yield a participant for members; afterwards all is as before."""
    yield shared_member
    scene.check()


def user(name: str, role: Role) -> MemberSecurity:
    """Return the security of a user with a new key."""
    home = key_files.key_home()
    grant = key_files.add_grant(home, principal_of(f"user:{name}"), role)
    return MemberSecurity(key_files.read_secret(home).key_of(grant))


def key_of_host(name: str) -> Any:
    secret = key_files.read_secret(key_files.key_home())
    return secret.key_of(own_grant(principal_of(f"host:{name}")))


def refusals(scene, member, security, *left_out: str) -> dict[str, list[tuple[str, str]]]:
    """Return code and message of the refusals of all requests but some; check that none is done."""
    found: dict[str, list[tuple[str, str]]] = {}
    for name, request in scene.requests():
        if name not in left_out:
            answer = member.answer_of_master(security, name, request).answer
            assert not answer.accepted, f"{name}: {answer.message}"
            found.setdefault(name, []).append((answer.code, answer.message))
    return found


def test_a_viewer_only_reads(scene, member) -> None:
    """Every other request is denied with who, what and whom to ask; no listing has the secret."""
    vera = user("vera", Role.VIEWER)
    denied = refusals(scene, member, vera, *READS)
    for name, answers in denied.items():
        for code, message in answers:
            assert code == "denied"
            what = f"user:vera has the role viewer, which may not {action_of(name)}"
            assert message.startswith(what)
            assert "operator" in message
    requests = dict(scene.requests())
    for name in READS:
        response = member.answer_of_master(vera, name, requests[name])
        assert response.answer.accepted
        assert SECRET not in str(response)


def test_a_submitter_changes_nothing_of_others(scene, member) -> None:
    """Not another's processes, hosts, logs, or what is ended; its own process runs."""
    sam = user("sam", Role.SUBMITTER)
    denied = refusals(scene, member, sam, *READS, names.SUBMIT)
    assert {code for answers in denied.values() for code, _ in answers} == {"denied"}
    for name in (names.CANCEL, names.RESTART, names.MIGRATE, names.CHECKPOINT, names.RESTORE):
        ((_, message),) = denied[name]
        assert f"{WITNESS} belongs to {ME}; user:sam may act only on its own" in message
        assert "ask the owner or an operator" in message
    for name in (names.PRUNE, names.SET_HOST_STATE, names.REBALANCE, names.RELOAD, *OF_HOSTS):
        assert all("operator" in message for _, message in denied[name])
    _, message = denied[names.INTRODUCE][0]
    assert f"the logs of '{WITNESS}' are for its owner and operators" in message


def test_a_host_sends_no_request_of_users(scene, member) -> None:
    """Nor does it read, register as another host, take its work, or report that it leaves."""
    other = MemberSecurity(key_of_host(HOSTS[1]))
    denied = refusals(scene, member, other)
    for name, answers in denied.items():
        expected = {"unknown"} if name in (names.LEAVE, names.REQUEST_PROCESS) else {"denied"}
        assert {code for code, _ in answers} == expected, name
    ((_, message),) = denied[names.REGISTER_HOST]
    assert message == "host:h1 may not register as 'h0': a slave registers only the host of its key"
    new = member.answer_of_master(other, names.REGISTER_HOST, registration("h9")).answer
    assert (new.accepted, new.code) == (False, "denied")


def test_a_host_gets_no_ticket_for_a_process_that_it_never_ran(scene, member) -> None:
    """Neither to replace replicas of its snapshots nor to read them."""
    other = MemberSecurity(key_of_host(HOSTS[1]))
    for wanted in (names.STORE_REPLICA, names.READ_SNAPSHOT, names.READ_LOG, names.CONTROL):
        request = introduction_request(HOSTS[0], wanted, WITNESS)
        response = member.answer_of_master(other, names.INTRODUCE, request)
        assert (response.answer.code, response.ticket, len(response.key)) == ("denied", "", 0)


def test_a_host_speaks_for_no_other(scene, member) -> None:
    """Its readings, statuses, usages and snapshots of another host are dropped."""
    other = MemberSecurity(key_of_host(HOSTS[1]))
    other.master.run = member.runs[""]
    for topic, message in scene.messages(HOSTS[0]):
        if topic == names.RESOURCE_INFO:
            sealed = seal_reading(other.master, reading_channel(path(topic)), message)
            for _ in range(50):  # best effort
                member.publish(path(topic), sealed)
                member.spin(0.01)
        else:
            endpoints, kind = member.endpoints(other), type(message)
            sender = endpoints.publisher(kind, path(topic), qos.STATUSES, other.master)
            member.spin(0.3)
            sender.publish(message)
    scene.cluster.wait_for_event("peer_refused", "host:h1 is not the slave of host")


# --- tickets ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sues(scene, shared_member):
    """Yield the security of a submitter, and its ticket for the logs of its own process."""
    sue = user("sue", Role.SUBMITTER)
    process = service("sues", required_labels={"who": HOSTS[0]})
    from rosrm.ros import convert

    request = srv.Submit.Request(processes=[convert.spec_to_msg(process)])
    assert shared_member.answer_of_master(sue, names.SUBMIT, request).answer.accepted
    scene.cluster.wait("sues", "running")
    scene.remember()
    request = introduction_request(HOSTS[0], names.READ_LOG, "sues")
    ticket = shared_member.answer_of_master(sue, names.INTRODUCE, request)
    assert ticket.answer.accepted
    return sue, ticket


def test_a_ticket_is_for_one_service_process_and_host(member, sues) -> None:
    """A slave serves the log of its process; all else is denied, or not answered."""
    sue, ticket = sues
    peer = sue.bearer(ticket.ticket, bytes(ticket.key), bytes(ticket.run))

    def ask(kind: Any, name: str, process: str, host: str = HOSTS[0]) -> Any:
        request = kind.Request(protocol_version=PROTOCOL_VERSION, process=process)
        asked = member.ask(sue, path.of_host(host, name), peer, request)
        response = member.answer(asked)
        return None if response is None else response.answer.code

    assert ask(srv.ReadLog, names.READ_LOG, "sues") == ""
    assert ask(srv.ReadLog, names.READ_LOG, WITNESS) == "denied"
    assert ask(srv.StoreReplica, names.STORE_REPLICA, "sues") == "denied"
    assert ask(srv.ReadSnapshot, names.READ_SNAPSHOT, "sues") == "denied"
    assert ask(srv.ReadLog, names.READ_LOG, "sues", HOSTS[1]) is None


def answer_to(member, sues, ticket, key: bytes) -> Any:
    """Return the answer of the slave to a request for a log with a ticket; None: there is none."""
    sue, genuine = sues
    peer = sue.bearer(ticket.text(), key, bytes(genuine.run))
    request = srv.ReadLog.Request(protocol_version=PROTOCOL_VERSION, process=ticket.process)
    asked = member.ask(sue, path.of_host(HOSTS[0], names.READ_LOG), peer, request)
    return member.answer(asked)


@pytest.mark.parametrize(
    "changes", [{"process": WITNESS}, {"until": 2**62}, {"bearer": principal_of(ME)}]
)
def test_a_changed_ticket_opens_nothing(member, sues, changes) -> None:
    """Another process, time or bearer under the same key."""
    _, genuine = sues
    ticket = ticket_of(genuine.ticket)._replace(**changes)
    assert answer_to(member, sues, ticket, bytes(genuine.key)) is None


def test_an_expired_ticket_reads_nothing(member, sues) -> None:
    """Its bearer gets the reason, and can ask the master for another one."""
    late = ticket_of(sues[1].ticket)._replace(until=1)
    response = answer_to(member, sues, late, late.key(key_of_host(HOSTS[0]).key))
    assert (response.answer.code, bytes(response.content)) == ("stale", b"")
