"""Security of one part of rosrm: with whom it may speak, and the links to them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from rosrm.errors import ConfigError
from rosrm.keys.cluster import ClusterSecret, PrincipalKey, Principals, own_grant
from rosrm.keys.links import KeyedLink, Link, OpenLink
from rosrm.keys.roles import Grant, principal_of
from rosrm.keys.sealing import RUN_BYTES, Direction


def new_run() -> bytes:
    """Return a random number for a run of a part."""
    return os.urandom(RUN_BYTES)


@dataclass(frozen=True, slots=True)
class Peer:
    """The other side of a conversation, under the key of one principal.

    Attributes:
        principal: whose key seals the conversation, on both sides.
        generation: of the key.
        link: seals what this side says and opens what the peer says.
        grant: rights of the peer; of the master those of the principal itself.
    """

    principal: str
    generation: int
    link: Link
    grant: Grant


class Security(Protocol):
    """Interface of the security of one part.

    Attributes:
        run: random number of this part's run.
    """

    run: bytes

    def peer(self, principal: str, generation: int) -> Peer | None:
        """Return whoever may speak under a principal's key; None: nobody may."""


class MemberSecurity:
    """Security of a slave or client: it speaks with the master under its own key.

    Attributes:
        run: random number of this part's run.
        master: the master.
    """

    def __init__(self, key: PrincipalKey, run: bytes | None = None) -> None:
        self.run = run or new_run()
        grant = key.grant
        link = KeyedLink(key.key, self.run, Direction.TO_MASTER, Direction.FROM_MASTER)
        self.master = Peer(str(grant.principal), grant.generation, link, grant)

    def peer(self, principal: str, generation: int) -> Peer | None:
        """Return the master, if a message is sealed by the key that is shared with it."""
        mine = (self.master.principal, self.master.generation)
        return self.master if (principal, generation) == mine else None


class MasterSecurity:
    """Security of the master: it speaks with every principal that has a valid grant.

    Attributes:
        run: random number of this run of the master.
    """

    def __init__(
        self, secret: ClusterSecret, grants: Iterable[Grant] = (), run: bytes | None = None
    ) -> None:
        self.run = run or new_run()
        self._secret = secret
        self._peers: dict[tuple[str, int], Peer] = {}
        self.replace_grants(grants)

    def replace_grants(self, grants: Iterable[Grant]) -> None:
        """Replace the valid grants; principals that keep theirs keep their links."""
        self._principals = Principals(self._secret, grants)
        self._peers = {
            known: peer for known, peer in self._peers.items()
            if self._principals.key_of(peer.grant.principal, peer.generation) is not None
        }  # fmt: skip

    def peer(self, principal: str, generation: int) -> Peer | None:
        """Return a principal with a valid grant of this generation."""
        known = self._peers.get((principal, generation))
        if known is not None:
            return known
        try:
            key = self._principals.key_of(principal_of(principal), generation)
        except ConfigError:
            return None
        if key is None:
            return None
        link = KeyedLink(key.key, self.run, Direction.FROM_MASTER, Direction.TO_MASTER)
        peer = self._peers[principal, generation] = Peer(principal, generation, link, key.grant)
        return peer


class NoSecurity:
    """`security: none`: everybody is believed to be the principal that a message names.

    Attributes:
        run: random number of this part's run.
    """

    def __init__(self, run: bytes | None = None) -> None:
        self.run = run or new_run()
        self._link = OpenLink(self.run)

    def peer(self, principal: str, generation: int) -> Peer | None:
        """Return the principal with all rights of its kind; None: the name is invalid."""
        try:
            grant = own_grant(principal_of(principal))
        except ConfigError:
            return None
        return Peer(principal, generation, self._link, grant)
