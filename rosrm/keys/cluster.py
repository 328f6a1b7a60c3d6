"""The cluster's secret and its principals, at the master."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from nacl.signing import SigningKey

from rosrm.keys.derivation import derived
from rosrm.keys.roles import Grant, Principal, Role

#: Generation of a key without a grant, derived by a program that can read the cluster's secret.
OWN: Final = 0


@dataclass(frozen=True, slots=True)
class PrincipalKey:
    """A principal's key, as in its key file.

    Attributes:
        key: secret that the principal and the master share.
        master: the master's public Ed25519 key, 32 bytes.
    """

    grant: Grant
    key: bytes = field(repr=False)
    master: bytes


@dataclass(frozen=True, slots=True)
class ClusterSecret:
    """Secret from which all keys of a cluster are derived; its holder has all rights."""

    secret: bytes = field(repr=False)

    @property
    def signing_key(self) -> SigningKey:
        """The key with which the master signs its messages to all receivers."""
        return SigningKey(derived(self.secret, "signature of the master"))

    def shared_key(self, grant: Grant) -> bytes:
        """Return the secret that the master and the principal of a grant share."""
        return derived(self.secret, "principal", str(grant.principal), grant.generation)

    def key_of(self, grant: Grant) -> PrincipalKey:
        """Return the key of a principal, as in its key file."""
        return PrincipalKey(grant, self.shared_key(grant), bytes(self.signing_key.verify_key))


def own_grant(principal: Principal) -> Grant:
    """Return the grant of a principal whose program can read the cluster's secret."""
    return Grant(principal, Role.HOST if principal.kind == "host" else Role.OPERATOR, OWN)


class Principals:
    """The valid grants of a cluster.

    A principal without a grant is refused, except with a key of generation `OWN`. No look-up stores
    anything, because a sender without a key can name any number of principals.
    """

    def __init__(self, grants: Iterable[Grant] = ()) -> None:
        self._grants: Mapping[Principal, Grant] = {one.principal: one for one in grants}

    def grant_of(self, principal: Principal) -> Grant:
        """Return the grant of a principal; without one, its grant of generation `OWN`."""
        return self._grants.get(principal) or own_grant(principal)

    def valid_grant(self, principal: Principal, generation: int) -> Grant | None:
        """Return the grant of a principal in a generation; None if no such grant is valid."""
        grant = own_grant(principal) if generation == OWN else self._grants.get(principal)
        return grant if grant is not None and grant.generation == generation else None
