"""The specs of the newest requests on applications, by digest."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm.model.ledger import Ledger, Store, bound_of
from rosrm.model.requester import Requester
from rosrm.model.sizes import size_of
from rosrm.model.values import ProcessSpec
from rosrm.ros.spec_digests import LENGTH


class KnownSpecs:
    """Specs that each user has sent, by the digests that the user gave.

    The digests are not checked: a wrong one affects only the later requests of the same user.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[str, str], ProcessSpec] = {}
        self._ledger = Ledger[str]()

    def lacking(self, user: str, digests: Sequence[str]) -> list[int]:
        """Return the positions of the digests of which no spec is kept."""
        return [at for at, digest in enumerate(digests) if (user, digest) not in self._kept]

    def completed(
        self, user: str, digests: Sequence[str], sent: Sequence[ProcessSpec]
    ) -> tuple[ProcessSpec, ...]:
        """Return all specs of a target, in the order of their digests.

        Args:
            sent: the specs that are not kept, or all.
        """
        if len(sent) == len(digests):
            return tuple(sent)
        rest = iter(sent)
        found = (self._kept.get((user, digest)) for digest in digests)
        return tuple(next(rest) if one is None else one for one in found)

    def keep(self, user: Requester, digests: Sequence[str], specs: Sequence[ProcessSpec]) -> None:
        """Keep the specs of a target for the next requests of a user; drop the oldest ones."""
        for digest, spec in zip(digests, specs, strict=False):
            if len(digest) == LENGTH:
                self._kept[user.name, digest] = spec
                self._ledger.put(user.name, digest, size_of(spec))
        bound = bound_of(Store.KNOWN_SPECS, is_operator=user.is_operator)
        for digest in self._ledger.beyond(user.name, bound):
            self._ledger.remove(user.name, digest)
            del self._kept[user.name, digest]
