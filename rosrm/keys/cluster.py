"""The cluster's secret and its principals: what the master knows of keys."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from nacl.signing import SigningKey

from rosrm.keys.derivation import derived
from rosrm.keys.roles import Grant, Principal, Role

#: Generation of the keys that a holder of the cluster's secret derives without a grant.
OWN: Final = 0


@dataclass(frozen=True, slots=True)
class PrincipalKey:
    """A principal's key: what its key file holds.

    Attributes:
        key: secret that the principal and the master share.
        master: the master's public Ed25519 key, 32 bytes.
    """

    grant: Grant
    key: bytes
    master: bytes


@dataclass(frozen=True, slots=True)
class ClusterSecret:
    """The secret from which all keys of a cluster are derived; whoever has it has the cluster."""

    secret: bytes = field(repr=False)

    @property
    def signing_key(self) -> SigningKey:
        """The key by which the master signs what it publishes to all."""
        return SigningKey(derived(self.secret, "signature of the master"))

    def key_of(self, grant: Grant) -> PrincipalKey:
        """Return the key of a principal in a generation."""
        key = derived(self.secret, "principal", str(grant.principal), grant.generation)
        return PrincipalKey(grant, key, bytes(self.signing_key.verify_key))


def own_grant(principal: Principal) -> Grant:
    """Return the grant of a process that holds the cluster's secret itself."""
    return Grant(principal, Role.HOST if principal.kind == "host" else Role.OPERATOR, OWN)


class Principals:
    """The grants that are valid now.

    A principal without a grant is refused, except with a key of generation `OWN`.
    """

    def __init__(self, secret: ClusterSecret, grants: Iterable[Grant] = ()) -> None:
        self._secret = secret
        self._grants: Mapping[Principal, Grant] = {one.principal: one for one in grants}
        self._keys: dict[Grant, PrincipalKey] = {}

    def key_of(self, principal: Principal, generation: int) -> PrincipalKey | None:
        """Return the key by which messages of a principal are opened; None: it has no grant."""
        grant = own_grant(principal) if generation == OWN else self._grants.get(principal)
        if grant is None or grant.generation != generation:
            return None
        known = self._keys.get(grant)
        if known is None:
            known = self._keys[grant] = self._secret.key_of(grant)
        return known
