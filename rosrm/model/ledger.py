"""Ledger: what each principal has in a store, and the bounds of it by role and store.

Every store of the master that users fill has a bound by principal, in number and in size, so that
no user takes the place of the others. docs/reference/limits.md has this table for users.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, Generic, TypeVar

KeyT = TypeVar("KeyT", bound=Hashable)


class Store(str, Enum):
    """A store of the master that the requests of users fill."""

    SPECS = "specs"
    KNOWN_SPECS = "known specs"
    ANSWERS = "answers"
    LISTINGS = "listings"
    UPLOADS = "uploads"


@dataclass(frozen=True, slots=True)
class Amount:
    """Number and size, in bytes, of entries in a store."""

    number: int = 0
    size: int = 0


_MIB: Final = 2**20
#: Bounds of a principal in each store: of a user, and of an operator.
BOUNDS: Final[Mapping[Store, tuple[Amount, Amount]]] = {
    Store.SPECS: (Amount(40_000, 64 * _MIB), Amount(200_000, 512 * _MIB)),
    Store.KNOWN_SPECS: (Amount(20_000, 16 * _MIB), Amount(20_000, 64 * _MIB)),
    Store.ANSWERS: (Amount(50_000, 4 * _MIB), Amount(50_000, 32 * _MIB)),
    Store.LISTINGS: (Amount(8), Amount(32)),
    Store.UPLOADS: (Amount(8), Amount(8)),
}


def bound_of(store: Store, *, is_operator: bool) -> Amount:
    """Return the bound of a principal in a store."""
    return BOUNDS[store][is_operator]


class Ledger(Generic[KeyT]):
    """Entries of one store by principal, each with its size, in the order of their addition."""

    def __init__(self) -> None:
        self._entries: dict[str, dict[KeyT, int]] = {}
        self._sizes: dict[str, int] = {}

    def put(self, principal: str, key: KeyT, size: int) -> None:
        """Add an entry as the newest of its principal; it replaces one with the same key."""
        self.remove(principal, key)
        self._entries.setdefault(principal, {})[key] = size
        self._sizes[principal] = self._sizes.get(principal, 0) + size

    def remove(self, principal: str, key: KeyT) -> None:
        """Remove an entry, if there is one."""
        entries = self._entries.get(principal, {})
        if key not in entries:
            return
        self._sizes[principal] -= entries.pop(key)
        if not entries:
            del self._entries[principal], self._sizes[principal]

    def of(self, principal: str) -> Amount:
        """Return the number and the size of the entries of a principal."""
        return Amount(len(self._entries.get(principal, ())), self._sizes.get(principal, 0))

    def size_of(self, principal: str, key: KeyT) -> int:
        """Return the size of an entry; 0: there is none."""
        return self._entries.get(principal, {}).get(key, 0)

    def beyond(self, principal: str, bound: Amount) -> Iterator[KeyT]:
        """Yield the oldest entry of a principal while it exceeds a bound.

        The caller removes each entry before it asks for the next one. The newest entry stays.
        """
        while True:
            amount = self.of(principal)
            if amount.number <= 1 or _is_within(amount, bound):
                return
            yield next(iter(self._entries[principal]))

    def items(self) -> dict[str, dict[KeyT, int]]:
        """Return a copy of all entries by principal."""
        return {principal: dict(entries) for principal, entries in self._entries.items()}


def _is_within(amount: Amount, bound: Amount) -> bool:
    return amount.number <= bound.number and amount.size <= bound.size
