"""Assembly of states from marks and parts, in any order of arrival. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

#: Newest stored parts of one topic that no mark names yet, and most bytes of its stored parts.
_KEPT: Final = 16
_MOST_BYTES: Final = 1 << 30
#: Bytes of a digest: two contents with the same one do not occur.
_DIGEST_BYTES: Final = 16
#: Most marks, and most entries of their lists, that wait for parts of their states.
_MOST_MARKS: Final = 20_000
_MOST_ENTRIES: Final = 50_000_000


class PartKey(NamedTuple):
    """Size and digest that identify the content of one serialised message.

    Attributes:
        size: bytes.
        digest: BLAKE2b in hexadecimal digits. (A CRC is not enough: a content that ends with its
            own CRC, as in many formats, always has the same CRC.)
    """

    size: int
    digest: str


def part_key(data: bytes) -> PartKey:
    """Return the key by which a mark names a part."""
    from rosrm.keys.hashing import digest_of  # noqa: PLC0415 - 0.8 MiB, which few nodes need

    return PartKey(len(data), digest_of(data, _DIGEST_BYTES, b"").hex())


@dataclass(frozen=True, slots=True)
class Cut:
    """A complete state.

    Attributes:
        mark: the mark as received.
        passed: skipped earlier marks; this state covers everything that they cover.
        parts: serialised messages by topic.
        arrived: arrival of the mark, monotonic seconds.
    """

    mark: Any
    passed: tuple[Any, ...]
    parts: Mapping[str, bytes]
    arrived: float


class CutAssembler:
    """Assembly of the newest state whose parts have all arrived."""

    def __init__(self) -> None:
        self._at_hand: dict[str, dict[PartKey, bytes]] = {}
        self._waiting: list[tuple[Any, float]] = []
        self._entries = 0

    def expect(self, topic: str) -> None:
        """Add a topic that carries a part of the state."""
        self._at_hand.setdefault(topic, {})

    def add_part(self, topic: str, data: bytes) -> None:
        """Add a message of a state topic."""
        at_hand = self._at_hand[topic]
        key = part_key(data)
        at_hand.pop(key, None)  # insert it again as the newest
        at_hand[key] = data
        if len(at_hand) > _KEPT:
            marked = {_key_of(mark, topic) for mark, _ in self._waiting}
            for old in list(at_hand)[:-_KEPT]:
                if old not in marked:
                    del at_hand[old]
        while len(at_hand) > 1 and sum(one.size for one in at_hand) > _MOST_BYTES:
            del at_hand[next(iter(at_hand))]

    def add_mark(self, mark: Any, now: float) -> bool:
        """Add a mark, newer than all before; return False if too many wait for their parts."""
        self._waiting.append((mark, now))
        self._entries += entries_of(mark)
        return len(self._waiting) <= _MOST_MARKS and self._entries <= _MOST_ENTRIES

    def take(self) -> Cut | None:
        """Return the newest complete state not taken before; drop older ones."""
        for index in range(len(self._waiting) - 1, -1, -1):
            mark, arrived = self._waiting[index]
            wanted = {part.topic: PartKey(part.size, part.digest) for part in mark.parts}
            parts = {topic: self._at_hand[topic].get(key) for topic, key in wanted.items()}
            if all(data is not None for data in parts.values()):
                passed = tuple(older for older, _ in self._waiting[:index])
                del self._waiting[: index + 1]
                self._entries = sum(entries_of(mark) for mark, _ in self._waiting)
                self._forget_older(wanted)
                found = {topic: data for topic, data in parts.items() if data is not None}
                return Cut(mark, passed, found, arrived)
        return None

    def missing(self) -> list[str]:
        """Return the topics of the newest mark whose part has not arrived."""
        if not self._waiting:
            return []
        mark, _ = self._waiting[-1]
        return [
            part.topic
            for part in mark.parts
            if PartKey(part.size, part.digest) not in self._at_hand[part.topic]
        ]

    def _forget_older(self, wanted: Mapping[str, PartKey]) -> None:
        """Drop parts older than those in use: parts come in order, so no mark names them again."""
        for topic, key in wanted.items():
            at_hand = self._at_hand[topic]
            while next(iter(at_hand)) != key:
                del at_hand[next(iter(at_hand))]


def entries_of(mark: Any) -> int:
    """Return the number of entries in the lists of a mark."""
    stamps = sum(len(one.covered) for one in mark.inputs)
    return stamps + len(mark.parts) + len(mark.inputs) + len(mark.outputs) + len(mark.timers_due)


def _key_of(mark: Any, topic: str) -> PartKey | None:
    """Return a mark's key of the part on a topic; None: the mark has no such part."""
    part = next((part for part in mark.parts if part.topic == topic), None)
    return None if part is None else PartKey(part.size, part.digest)
