"""Security of a master, slave or client: its peers, and the keys of their messages."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol

from nacl.bindings import crypto_sign, crypto_sign_open
from nacl.exceptions import CryptoError

from rosrm import clocks
from rosrm.errors import ConfigError
from rosrm.keys.cluster import ClusterSecret, PrincipalKey, Principals, own_grant
from rosrm.keys.derivation import derived
from rosrm.keys.handoffs import HandoffKeys, instance_key, new_link
from rosrm.keys.hashing import digest_of
from rosrm.keys.links import KeyedLink, Link, OpenLink
from rosrm.keys.roles import Grant, Principal, Role, principal_of
from rosrm.keys.sealing import RUN_BYTES, Direction
from rosrm.keys.tickets import Ticket, ticket_of

#: Bytes of the tag before an Ed25519 signature, of that signature, and of both.
_TAG_BYTES: Final = 16
_ED25519_BYTES: Final = 64
SIGNATURE_BYTES: Final = _TAG_BYTES + _ED25519_BYTES
#: Separates this use of BLAKE2b from every other one; at most 16 bytes.
_TAG_PERSON: Final = b"rosrm signature"
#: Run of a peer that is not known yet.
UNKNOWN_RUN: Final = bytes(RUN_BYTES)
#: Principal of a master as a client of another master.
_MASTER: Final = Principal("user", "rosrm-master")
#: Valid tickets of one bearer that a slave accepts: at most two for each of a thousand processes.
_MOST_TICKETS: Final = 4096
#: Peers that a master, slave or client with `security: none` stores.
_MOST_PEERS: Final = 20_000


def new_run() -> bytes:
    """Return the random number of a new run."""
    return os.urandom(RUN_BYTES)


@dataclass(slots=True)
class Peer:
    """The other side of a link.

    Attributes:
        name: principal or ticket whose key seals the messages of both sides.
        generation: generation of the key.
        link: seals messages for the peer, and opens messages of the peer.
        grant: rights of the peer.
        ticket: the ticket whose key seals the messages; None for a principal or the master.
        run: newest known run of the peer, to which messages for the peer are bound.
    """

    name: str
    generation: int
    link: Link
    grant: Grant
    ticket: Ticket | None = None
    run: bytes = field(default=UNKNOWN_RUN)


class Security(Protocol):
    """Interface of the security of a master, slave or client.

    Attributes:
        run: random number of the run of this master, slave or client.
        described: text for users, for example "the key of host:robot-1".
        tickets_from: lowest version of the tickets that are in force.
        cluster: digest that identifies the cluster and discloses no key; b"": no keys.
    """

    run: bytes
    described: str
    tickets_from: int
    cluster: bytes

    def peer(self, name: str, generation: int) -> Peer | None:
        """Return the peer with this name and key generation; None if no such key is valid."""

    def remember(self, peer: Peer) -> None:
        """Store a peer after a genuine message; forged messages must not use memory."""

    def accepts(self, ticket: Ticket) -> bool:
        """Return True if the ticket of a genuine request is in force."""

    def signature(self, content: bytes) -> bytes:
        """Return the signature of a message to all receivers; b"" if this is not the master."""

    def is_signed(self, content: bytes, signature: bytes) -> bool:
        """Return True if the master signed a message."""


class Member(Security, Protocol):
    """Interface of the security of a slave or client, which has one master.

    Attributes:
        master: the master.
    """

    master: Peer

    def note_beat(self, tickets_from: int) -> None:
        """Store the time of a beat of the master, and the lowest version of tickets in force."""

    def bearer(self, ticket: str, key: bytes, run: bytes) -> Peer:
        """Return the slave to which this slave or client sends requests with a ticket.

        Args:
            ticket: text of the ticket.
            key: key of the ticket.
            run: run of the slave.
        """

    def instance_key(self, process: str, number: int) -> bytes | None:
        """Return the key of an instance on this host; None with `security: none`."""

    def link_key(self, host_id: int) -> bytes:
        """Return the key with which the slave of another host measures its link to this host.

        The key is b"" with `security: none`.
        """


class MemberSecurity:
    """Security of a slave or client, which has a key and one master.

    Attributes:
        run: random number of the run of this slave or client.
        master: the master.
    """

    def __init__(self, key: PrincipalKey, run: bytes | None = None) -> None:
        self.run = run or new_run()
        self.tickets_from = 0
        self._beat_at = 0
        self._key = key
        whom = str(key.grant.principal)
        self.described = f"the key of {whom}"
        self.cluster = _identifier(key.master)
        link = KeyedLink(key.key, self.run, Direction.TO_MASTER, Direction.FROM_MASTER)
        grant = Grant(key.grant.principal, Role.MASTER, key.grant.generation)
        self.master = Peer(whom, key.grant.generation, link, grant)
        self._bearers: dict[Principal, OrderedDict[str, Peer]] = {}

    def peer(self, name: str, generation: int) -> Peer | None:
        """Return the master, or the bearer of a ticket for this slave, which may have expired."""
        if (name, generation) == (self.master.name, self.master.generation):
            return self.master
        ticket = ticket_of(name)
        if ticket is None:
            return None
        if not self._is_valid(ticket):
            return self._bearer_of(ticket)  # a genuine request gets the answer `stale`
        held: Mapping[str, Peer] = self._bearers.get(ticket.bearer, {})
        return held.get(name) or (self._bearer_of(ticket) if self._has_room(held) else None)

    def _has_room(self, held: Mapping[str, Peer]) -> bool:
        """Return True if a bearer may use another ticket.

        No valid ticket is removed from memory; otherwise its recorded requests would open again.
        """
        return len(held) < _MOST_TICKETS or not self._is_valid(_oldest(held))

    def _bearer_of(self, ticket: Ticket) -> Peer:
        link = new_link(ticket.key(self._key.key), Direction.FROM_PEER, Direction.TO_PEER)
        return Peer(ticket.text(), 0, link, _bearer_grant(ticket), ticket)

    def remember(self, peer: Peer) -> None:
        """Store the bearer of a genuine request; remove the expired tickets of that bearer."""
        if peer.ticket is None or not self._is_valid(peer.ticket):
            return
        held = self._bearers.setdefault(peer.ticket.bearer, OrderedDict())
        held[peer.name] = peer
        while not self._is_valid(_oldest(held)):
            held.popitem(last=False)

    def note_beat(self, tickets_from: int) -> None:
        """Store the time of a beat of the master, and the lowest version of tickets in force."""
        self.tickets_from, self._beat_at = tickets_from, clocks.boot_time_ns()

    def accepts(self, ticket: Ticket) -> bool:
        """Return True if the ticket of a genuine request is in force."""
        return ticket.version >= self.tickets_from and self._is_valid(ticket)

    def _is_valid(self, ticket: Ticket) -> bool:
        return ticket.is_valid(clocks.boot_time_ns(), self._beat_at)

    def bearer(self, ticket: str, key: bytes, run: bytes) -> Peer:
        """Return the slave to which this slave or client sends requests with a ticket.

        The master may give the same ticket twice. So each link has a new run; otherwise two links
        would use the same nonces under the same key.
        """
        link = new_link(key, Direction.TO_PEER, Direction.FROM_PEER)
        return Peer(ticket, 0, link, self.master.grant, run=run)

    def instance_key(self, process: str, number: int) -> bytes | None:
        """Return the key of an instance on this host."""
        return instance_key(self._key.key, process, number)

    def link_key(self, host_id: int) -> bytes:
        """Return the key with which the slave of another host measures its link to this host."""
        return derived(self._key.key, "link", host_id)

    def signature(self, content: bytes) -> bytes:
        """Return b"": only the master signs."""
        del content
        return b""

    def is_signed(self, content: bytes, signature: bytes) -> bool:
        """Return True if the master signed a message."""
        return _is_signed(content, signature, self._key.master)


class MasterSecurity:
    """Security of the master: its peers are the principals with a valid grant.

    Attributes:
        run: random number of this run of the master.
    """

    def __init__(
        self, secret: ClusterSecret, grants: Iterable[Grant] = (), run: bytes | None = None
    ) -> None:
        self.run = run or new_run()
        self.tickets_from = 0
        self.described = "keys"
        self._peers: dict[tuple[str, int], Peer] = {}
        # Links by key, also of revoked and replaced keys. Such a key may become valid again, with
        # another role or a secret from a backup; a new link would then repeat nonces.
        self._links: dict[bytes, Link] = {}
        self._secret = secret
        self.replace(secret, grants)

    def replace(self, secret: ClusterSecret, grants: Iterable[Grant]) -> None:
        """Replace secret and grants; remove the peers whose key or role is no longer valid."""
        self.tickets_from += 1
        changed = self._peers and secret != self._secret
        self._secret = secret
        self._signing_key = bytes(secret.signing_key) + bytes(secret.signing_key.verify_key)
        self.cluster = _identifier(self._signing_key[32:])
        self._principals = Principals(grants)
        self._peers = {
            known: peer for known, peer in self._peers.items()
            if not changed and self.has_access(peer)
        }  # fmt: skip

    def has_access(self, peer: Peer) -> bool:
        """Return True while the key and the role of a peer are valid."""
        grant = self._principals.valid_grant(peer.grant.principal, peer.generation)
        return grant == peer.grant and self._link_of(peer.grant) is peer.link

    def peer(self, name: str, generation: int) -> Peer | None:
        """Return the principal with a valid grant of this generation; None if no grant is valid."""
        known = self._peers.get((name, generation))
        if known is not None:
            return known
        try:
            grant = self._principals.valid_grant(principal_of(name), generation)
        except ConfigError:
            return None
        return None if grant is None else Peer(name, generation, self._link_of(grant), grant)

    def _link_of(self, grant: Grant) -> Link:
        key = self._secret.shared_key(grant)
        known = self._links.get(key)
        return known or KeyedLink(key, self.run, Direction.FROM_MASTER, Direction.TO_MASTER)

    def remember(self, peer: Peer) -> None:
        """Store a principal after a genuine message."""
        if self._peers.get((peer.name, peer.generation)) is not peer:
            self._peers[peer.name, peer.generation] = peer
            self._links[self._secret.shared_key(peer.grant)] = peer.link

    def accepts(self, ticket: Ticket) -> bool:
        """Return False: tickets are for slaves."""
        del ticket
        return False

    def introduction(self, host: Peer, ticket: Ticket) -> bytes:
        """Return the key of a ticket for requests to the slave of `host`."""
        return ticket.key(self._secret.shared_key(host.grant))

    def link_key_of(self, host: Peer, host_id: int) -> bytes:
        """Return the key with which host number `host_id` measures its link to `host`."""
        return derived(self._secret.shared_key(host.grant), "link", host_id)

    def client(self) -> MemberSecurity:
        """Return the security with which this master sends requests to one of the same secret."""
        grant = own_grant(_MASTER)
        return MemberSecurity(self._secret.key_of(grant))

    def snapshot_key(self, process: str, first: int) -> bytes:
        """Return the key that encrypts the replicas of the snapshots of a process.

        Args:
            process: name of the process. Another user may have submitted that name before.
            first: lowest number of an instance whose snapshots are valid. This number is different
                for each submission of the name.
        """
        return derived(self._secret.secret, "state", process, first)

    def handoff_keys(self, host_of: Callable[[str, int], str | None]) -> HandoffKeys:
        """Return the keys of handoffs.

        Args:
            host_of: returns the host of an instance, given by process and number; None if it is
                unknown.
        """

        def host_key(process: str, number: int) -> bytes | None:
            host = host_of(process, number)
            return None if host is None else self._secret.shared_key(self._grant_of_host(host))

        return HandoffKeys(lambda: self._secret.secret, host_key)

    def _grant_of_host(self, host: str) -> Grant:
        """Return the grant of the key that the slave of a host uses.

        Before the first message of the slave, assume the key in its grant.
        """
        principal = Principal("host", host)
        granted, own = self._principals.grant_of(principal), own_grant(principal)
        uses_granted = (str(principal), granted.generation) in self._peers
        uses_own = not uses_granted and (str(principal), own.generation) in self._peers
        return own if uses_own else granted

    def signature(self, content: bytes) -> bytes:
        """Return the signature of a message to all receivers."""
        key = self._signing_key
        return _tag(content, key[32:]) + crypto_sign(content, key)[:_ED25519_BYTES]

    def is_signed(self, content: bytes, signature: bytes) -> bool:
        """Return True if a master with the same secret signed a message."""
        return _is_signed(content, signature, self._signing_key[32:])


class NoSecurity:
    """`security: none`: every message is accepted under the principal that it names.

    Args:
        principal: principal of this slave or client; None for the master.
        run: random number of the run of this master, slave or client; None: a new number.

    Attributes:
        run: random number of the run of this master, slave or client.
        master: the master, for a slave or client.
    """

    def __init__(self, principal: Principal | None = None, run: bytes | None = None) -> None:
        self.run = run or new_run()
        self.tickets_from = 0
        self.described = "none"
        self.cluster = b""
        self._link = OpenLink(self.run)
        self._peers: OrderedDict[tuple[str, int], Peer] = OrderedDict()
        name = "" if principal is None else str(principal)  # no message has the name ""
        grant = Grant(principal or Principal("user", ""), Role.MASTER, 0)
        self.master = Peer(name, 0, self._link, grant)

    def peer(self, name: str, generation: int) -> Peer | None:
        """Return the principal with all rights of its kind; None if the name is invalid."""
        if (name, generation) == (self.master.name, self.master.generation):
            return self.master
        known = self._peers.get((name, generation))
        if known is not None:
            return known
        ticket = ticket_of(name)
        if ticket is not None:
            return Peer(name, 0, self._link, _bearer_grant(ticket), ticket)
        try:
            return Peer(name, generation, self._link, own_grant(principal_of(name)))
        except ConfigError:
            return None

    def remember(self, peer: Peer) -> None:
        """Store a peer; remove the least recently used one beyond `_MOST_PEERS`."""
        self._peers[peer.name, peer.generation] = peer
        self._peers.move_to_end((peer.name, peer.generation))
        if len(self._peers) > _MOST_PEERS:
            self._peers.popitem(last=False)

    def note_beat(self, tickets_from: int) -> None:
        """Store the lowest version of tickets in force."""
        self.tickets_from = tickets_from

    def accepts(self, ticket: Ticket) -> bool:
        """Return True if the version of a ticket is in force."""
        return ticket.version >= self.tickets_from

    def bearer(self, ticket: str, key: bytes, run: bytes) -> Peer:
        """Return the slave to which this slave or client sends requests with a ticket."""
        del key
        return Peer(ticket, 0, self._link, self.master.grant, run=run)

    def instance_key(self, process: str, number: int) -> None:
        """Return no key."""
        del process, number

    def link_key(self, host_id: int) -> bytes:
        """Return no key."""
        del host_id
        return b""

    def link_key_of(self, host: Peer, host_id: int) -> bytes:
        """Return no key."""
        del host, host_id
        return b""

    def introduction(self, host: Peer, ticket: Ticket) -> bytes:
        """Return no key."""
        del host, ticket
        return b""

    def client(self) -> NoSecurity:
        """Return the security with which this master sends requests to another master."""
        return NoSecurity(_MASTER)

    def snapshot_key(self, process: str, first: int) -> bytes:
        """Return no key."""
        del process, first
        return b""

    def handoff_keys(self, host_of: Callable[[str, int], str | None]) -> None:
        """Return no keys."""
        del host_of

    def has_access(self, peer: Peer) -> bool:
        """Return True."""
        del peer
        return True

    def signature(self, content: bytes) -> bytes:
        """Return no signature."""
        del content
        return b""

    def is_signed(self, content: bytes, signature: bytes) -> bool:
        """Return True."""
        del content, signature
        return True


#: Security of the master.
Authority = MasterSecurity | NoSecurity


def _oldest(held: Mapping[str, Peer]) -> Ticket:
    ticket = next(iter(held.values())).ticket
    assert ticket is not None, "only bearers of tickets are stored"
    return ticket


def _bearer_grant(ticket: Ticket) -> Grant:
    return Grant(ticket.bearer, Role.BEARER, 0)


def _tag(content: bytes, master: bytes) -> bytes:
    """Return the tag of a message of the master.

    The key of the tag is the master's public key, which only slaves and clients with a key have. A
    check of the tag takes a fiftieth of the time of a check of the signature. So a sender without a
    key cannot use up their CPU time with forged messages. Every slave or client with a key could
    forge the tag, but not the signature.
    """
    return digest_of(content, _TAG_BYTES, _TAG_PERSON, master)


def _identifier(master: bytes) -> bytes:
    """Return the identifier of a cluster, from the master's key that its members have."""
    return digest_of(master, 16, b"rosrm cluster")


def _is_signed(content: bytes, signature: bytes, key: bytes) -> bool:
    if signature[:_TAG_BYTES] != _tag(content, key):
        return False
    try:
        crypto_sign_open(signature[_TAG_BYTES:] + content, key)
    except CryptoError:
        return False
    return True
