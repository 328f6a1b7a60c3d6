"""Security of master, slaves and clients: which messages open, before and after a revocation."""

from __future__ import annotations

import gc
import os
import pickle
from types import SimpleNamespace

import pytest

from rosrm import clocks
from rosrm.keys import security
from rosrm.keys.cluster import ClusterSecret, own_grant
from rosrm.keys.links import SealedMessage
from rosrm.keys.roles import Grant, Principal, Role
from rosrm.keys.security import Authority, MasterSecurity, Member, MemberSecurity, NoSecurity, Peer
from rosrm.keys.tickets import Ticket

SECRET = ClusterSecret(b"s" * 32)
ROBOT = Grant(Principal("host", "robot-1"), Role.HOST, 3)
ADA = Grant(Principal("user", "ada"), Role.SUBMITTER, 1)
CHANNEL, OTHER_CHANNEL = b"c" * 16, b"d" * 16


def member(grant: Grant, secret: ClusterSecret = SECRET) -> MemberSecurity:
    return MemberSecurity(secret.key_of(grant))


@pytest.fixture
def master() -> MasterSecurity:
    return MasterSecurity(SECRET, [ROBOT, ADA])


def said(peer: Peer, text: bytes = b"text") -> SealedMessage:
    return peer.link.seal(CHANNEL, text, peer.run)


def opened(by: Authority | Member, name: str, generation: int, message: SealedMessage) -> bool:
    """Return True if a part opens a message for its run; store a genuine sender."""
    peer = by.peer(name, generation)
    if peer is None or peer.link.open(CHANNEL, message, by.run) is None:
        return False
    by.remember(peer)
    return True


def to_master(part: Member, master: Authority) -> bool:
    part.master.run = master.run
    return opened(master, part.master.name, part.master.generation, said(part.master))


def test_the_master_opens_messages_of_principals_with_a_valid_grant(master: MasterSecurity) -> None:
    """The role is that of the grant, and not of the message."""
    assert to_master(member(ROBOT), master)
    assert master.peer("host:robot-1", 3).grant == ROBOT


@pytest.mark.parametrize(
    "sender",
    [
        member(ROBOT, ClusterSecret(b"x" * 32)),
        member(Grant(ROBOT.principal, Role.HOST, 2)),
        member(Grant(Principal("host", "robot-2"), Role.HOST, 1)),
        NoSecurity(ROBOT.principal),
    ],
    ids=["of another cluster", "with a former key", "without a grant", "without a key"],
)
def test_messages_of_others_do_not_open(master: MasterSecurity, sender: Member) -> None:
    assert not to_master(sender, master)
    assert not master._peers


def test_a_part_that_can_read_the_secret_needs_no_grant(master: MasterSecurity) -> None:
    """As slaves and commands of the user that runs the master."""
    own = member(Grant(Principal("user", "root"), Role.OPERATOR, 0))
    assert to_master(own, master)
    assert master.peer("user:root", 0).grant.role is Role.OPERATOR


def test_a_slave_opens_messages_of_the_master_only(master: MasterSecurity) -> None:
    """Not those of a user, although both have keys of the cluster."""
    robot, ada = member(ROBOT), member(ADA)
    assert to_master(robot, master)
    answer = said(master.peer("host:robot-1", 3))
    assert robot.master.link.open(CHANNEL, answer, bytes(16)) == b"text"
    assert robot.peer("user:ada", 1) is None
    assert not opened(robot, "host:robot-1", 3, said(ada.master))


def test_a_revoked_key_ends_and_the_links_of_others_stay(master: MasterSecurity) -> None:
    """The counters of the others stay, so that no recorded message is accepted again."""
    robot, ada = member(ROBOT), member(ADA)
    assert to_master(robot, master)
    assert to_master(ada, master)
    recorded = said(robot.master)
    assert opened(master, "host:robot-1", 3, recorded)
    revoked = master.peer("user:ada", 1)
    master.replace(SECRET, [ROBOT])
    assert not master.has_access(revoked)
    assert not to_master(ada, master)
    assert not opened(master, "host:robot-1", 3, recorded)
    assert to_master(robot, master)


def test_a_stranger_makes_the_master_store_nothing(master: MasterSecurity) -> None:
    """Each message may name another principal; no peer and no key of it is kept."""
    assert to_master(member(ROBOT), master)

    def send_as_strangers() -> None:
        for number in range(20):
            assert not opened(master, f"host:stranger-{number}", 0, said(member(ADA).master))

    send_as_strangers()
    before = len(gc.get_objects())
    send_as_strangers()
    assert len(gc.get_objects()) - before < 10


def test_a_changed_role_applies_at_once(master: MasterSecurity) -> None:
    former = master.peer("user:ada", 1)
    master.remember(former)
    master.replace(SECRET, [ROBOT, Grant(ADA.principal, Role.VIEWER, 1)])
    assert not master.has_access(former)
    assert master.peer("user:ada", 1).grant.role is Role.VIEWER


@pytest.mark.parametrize("by", ["role", "secret"])
def test_a_key_that_is_valid_again_has_its_former_counters(master: MasterSecurity, by: str) -> None:
    """Otherwise nonces would be used twice, and recorded messages would open again."""
    ada = member(ADA)
    assert to_master(ada, master)
    recorded = said(ada.master)
    assert opened(master, "user:ada", 1, recorded)
    answer = said(master.peer("user:ada", 1))
    if by == "secret":
        master.replace(ClusterSecret(b"n" * 32), [ADA])
        master.replace(SECRET, [ADA])
    else:
        master.replace(SECRET, [Grant(ADA.principal, Role.VIEWER, 1)])
    assert not opened(master, "user:ada", 1, recorded)
    assert said(master.peer("user:ada", 1)).counter == answer.counter + 1


def test_strangers_make_the_master_store_nothing(master: MasterSecurity) -> None:
    """Neither names that have no grant, nor those of holders of the secret."""
    stored = len(pickle.dumps(vars(master)))
    for number in range(100):
        assert not opened(master, f"user:{number}", 0, SealedMessage(bytes(16), 1, bytes(40)))
    assert len(pickle.dumps(vars(master))) == stored


def test_a_new_secret_ends_all_keys(master: MasterSecurity) -> None:
    robot = member(ROBOT)
    assert to_master(robot, master)
    known = master.peer("host:robot-1", 3)
    assert master.has_access(known)
    master.replace(ClusterSecret(b"n" * 32), [ROBOT])
    assert not to_master(robot, master)
    assert not master.has_access(known)


def test_all_principals_recognize_the_signature_of_the_master(master: MasterSecurity) -> None:
    """A signature of another cluster, or of another text, is refused."""
    signature = master.signature(b"beat")
    assert member(ROBOT).is_signed(b"beat", signature)
    assert master.is_signed(b"beat", signature)
    assert not member(ROBOT).is_signed(b"beats", signature)
    assert not member(ROBOT, ClusterSecret(b"x" * 32)).is_signed(b"beat", signature)
    assert not member(ROBOT).is_signed(b"beat", b"")


def test_a_stranger_causes_no_check_of_a_signature(master: MasterSecurity, monkeypatch) -> None:
    """A check of the tag, which a stranger cannot make, takes a fiftieth of the time."""
    checked: list[bytes] = []
    monkeypatch.setattr(
        security, "crypto_sign_open", lambda signed, _: checked.append(signed) or b""
    )
    robot, genuine = member(ROBOT), master.signature(b"beat")
    for forged in (bytes(80), os.urandom(80), master.signature(b"other"), genuine[16:] + genuine):
        assert not robot.is_signed(b"beat", forged)
    assert checked == []
    assert robot.is_signed(b"beat", genuine)
    assert checked


def test_another_submission_of_a_process_has_another_key_of_its_snapshots(
    master: MasterSecurity,
) -> None:
    """The name may belong to another user by then."""
    keys = {master.snapshot_key(name, first) for name in "pq" for first in (1, 8)}
    assert len(keys) == 4


def introduced(master: MasterSecurity, until: float = 59.0) -> tuple[Peer, Ticket, MemberSecurity]:
    """Return robot-1 as ada sees it, ada's ticket, and robot-1's own security."""
    robot = member(ROBOT)
    expiry = clocks.boot_time_ns() + int(until * 1e9)
    ticket = Ticket(expiry, 3, "read_log", 7, "talker", ADA.principal)
    key = master.introduction(master.peer("host:robot-1", 3), ticket)
    return member(ADA).bearer(ticket.text(), key, robot.run), ticket, robot


def test_a_slave_accepts_the_bearer_of_a_ticket(master: MasterSecurity) -> None:
    """The slave gets bearer, service and process; the answer opens for the bearer."""
    slave, ticket, robot = introduced(master)
    request = said(slave)
    assert opened(robot, slave.name, 0, request)
    bearer = robot.peer(slave.name, 0)
    assert (bearer.ticket, bearer.grant.role) == (ticket, Role.BEARER)
    answer = bearer.link.seal(CHANNEL, b"log", request.reference)
    assert slave.link.open(CHANNEL, answer, request.reference) == b"log"


def test_two_links_of_one_ticket_use_no_nonce_twice(master: MasterSecurity) -> None:
    """The master gives the same ticket again while it has no newer reading of the slave."""
    slave, ticket, robot = introduced(master)
    key = master.introduction(master.peer("host:robot-1", 3), ticket)
    ada = member(ADA)
    one, two = (ada.bearer(ticket.text(), key, robot.run) for _ in range(2))
    assert said(one).run != said(two).run
    first, second = (robot.peer(slave.name, 0) for _ in range(2))
    assert said(first).run != said(second).run


def test_no_valid_ticket_is_forgotten(master: MasterSecurity, monkeypatch) -> None:
    """Otherwise its recorded requests would open again. Each bearer has a bound of its own."""
    now = 0
    monkeypatch.setattr(security, "clocks", SimpleNamespace(boot_time_ns=lambda: now))
    monkeypatch.setattr(security, "_MOST_TICKETS", 2)
    robot = member(ROBOT)

    def asks(bearer: str, until: int) -> bool:
        """Let a bearer send its first request with a ticket."""
        ticket = Ticket(until, 3, "read_log", 7, "talker", Principal("user", bearer))
        key = master.introduction(master.peer("host:robot-1", 3), ticket)
        slave = member(ADA).bearer(ticket.text(), key, robot.run)
        return opened(robot, slave.name, 0, said(slave))

    assert asks("ada", 1)
    assert asks("ada", 2)
    assert not asks("ada", 3)
    assert asks("eve", 3)
    now = 2
    robot.note_beat(tickets_from=0)
    assert asks("ada", 3)


@pytest.mark.parametrize(
    "changes",
    [{"process": "other"}, {"service": "control"}, {"until": 2**63}, {"first": 0}],
)
def test_a_changed_ticket_opens_nothing(master: MasterSecurity, changes: dict) -> None:
    """The key is derived from the text of the ticket."""
    slave, ticket, robot = introduced(master)
    assert not opened(robot, ticket._replace(**changes).text(), 0, said(slave))
    assert not robot._bearers


@pytest.mark.parametrize("until", [-1.0, 3600.0], ids=["ended", "from before the host's boot"])
def test_a_ticket_is_valid_for_a_minute(master: MasterSecurity, until: float) -> None:
    """By the clock of the slave, which begins again when the host boots.

    A message under a void ticket opens, so that its bearer can get an answer. Nothing is stored.
    """
    slave, ticket, robot = introduced(master, until)
    robot.note_beat(tickets_from=0)
    assert not robot.accepts(ticket)
    assert opened(robot, slave.name, 0, said(slave))
    assert not robot._bearers


def test_tickets_do_not_expire_while_the_master_is_away(monkeypatch) -> None:
    """No client could get another ticket, and slaves would send no replicas."""
    now = 0
    monkeypatch.setattr(security, "clocks", SimpleNamespace(boot_time_ns=lambda: now))
    robot = member(ROBOT)
    valid, expired = (
        Ticket(until, 3, "store_replica", 0, "talker", Principal("host", "robot-2"))
        for until in (60, 59)
    )
    now = 60
    robot.note_beat(tickets_from=3)
    now = 10**15
    assert (robot.accepts(valid), robot.accepts(expired)) == (True, False)
    robot.note_beat(tickets_from=3)
    assert not robot.accepts(valid)


def test_a_recorded_request_opens_under_no_other_text_of_its_ticket(master: MasterSecurity) -> None:
    """The text travels in the clear, so a stranger can change it in a recorded request."""
    slave, _, robot = introduced(master)
    request = said(slave)
    assert opened(robot, slave.name, 0, request)
    assert not opened(robot, slave.name.replace("ticket:", "ticket:0"), 0, request)


def test_a_ticket_is_for_one_host(master: MasterSecurity) -> None:
    slave, _, _ = introduced(master)
    other = member(Grant(Principal("host", "robot-2"), Role.HOST, 1))
    assert not opened(other, slave.name, 0, said(slave))


def test_both_sides_have_the_same_keys_of_a_handoff(master: MasterSecurity) -> None:
    """The host's slave gives its node the key of the instance; another host has another one."""
    robot, local = member(ROBOT), member(own_grant(Principal("host", "local")))
    hosts = {("p", 7): "robot-1", ("p", 8): "local"}
    keys = master.handoff_keys(lambda process, number: hosts.get((process, number)))
    for _ in ("after a restart of the master no host has spoken yet", "both have spoken"):
        assert keys.of_instance("p", 7) == robot.instance_key("p", 7)
        assert keys.of_instance("p", 8) == local.instance_key("p", 8)
        assert to_master(robot, master)
        assert to_master(local, master)
    assert keys.of_instance("q", 7) is None


def test_a_new_secret_counts_for_handoffs_too(master: MasterSecurity) -> None:
    """The operator rotates it because others may know the former one."""
    keys = master.handoff_keys(lambda *_: "robot-1")
    former = keys.of_instance("p", 7), keys.of_handoff("p", 8)
    master.replace(ClusterSecret(b"n" * 32), [ROBOT])
    assert keys.of_instance("p", 7) != former[0]
    assert keys.of_handoff("p", 8) != former[1]


def test_a_host_that_has_a_grant_and_speaks_without_it_is_known_by_what_it_uses(
    master: MasterSecurity,
) -> None:
    """A slave on the master's machine may read the cluster's secret, and have no key file."""
    local = member(own_grant(ROBOT.principal))
    assert to_master(local, master)
    keys = master.handoff_keys(lambda *_: "robot-1")
    assert keys.of_instance("p", 7) == local.instance_key("p", 7)


def test_security_none_accepts_every_name() -> None:
    """A user has the role of an operator; the name must be that of a principal."""
    authority = NoSecurity()
    assert to_master(NoSecurity(ROBOT.principal), authority)
    assert authority.peer("host:robot-1", 0).grant.role is Role.HOST
    assert authority.peer("user:ada", 0).grant.role is Role.OPERATOR
    assert authority.peer("a b", 0) is None
