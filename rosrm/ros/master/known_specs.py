"""The specs of the newest requests on applications, by digest."""

from __future__ import annotations

from typing import Final

from rosrm.errors import Refused
from rosrm.model.values import ProcessSpec
from rosrm.ros.spec_digests import LENGTH, UNKNOWN_DIGEST

_Specs = tuple[ProcessSpec, ...]

#: Most requests whose specs are kept.
_MOST: Final = 8


class KnownSpecs:
    """Specs that each user has sent, by the digest that the user gave.

    The digest is not checked: a wrong one affects only the later requests of the same user.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[str, str], _Specs] = {}

    def keep(self, user: str, digest: str, specs: _Specs) -> None:
        """Keep specs for the next requests of a user; drop the oldest ones."""
        if not specs or len(digest) != LENGTH:
            return
        self._kept.pop((user, digest), None)
        self._kept[user, digest] = specs
        if len(self._kept) > _MOST:
            del self._kept[next(iter(self._kept))]

    def find(self, user: str, digest: str) -> _Specs:
        """Return the specs that a user has sent with a digest; raise `Refused` if none are kept."""
        specs = self._kept.get((user, digest))
        if specs is None:
            raise Refused(
                f"the master does not have the processes with the digest {digest!r:.80}; send the "
                f"processes themselves",
                UNKNOWN_DIGEST,
            )
        self.keep(user, digest, specs)
        return specs
