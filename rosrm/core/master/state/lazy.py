"""A mapping that is made when it is first read: who hands over facts need not spell them out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


class Lazy(Mapping[str, Any]):
    """Renders itself once, from values that do not change any more (a snapshot, a frozen spec)."""

    __slots__ = ("_rendered",)

    def __init__(self) -> None:
        self._rendered: Mapping[str, Any] | None = None

    def render(self) -> Mapping[str, Any]:
        """Make the mapping; must not look at anything that changes."""
        raise NotImplementedError

    def _made(self) -> Mapping[str, Any]:
        if self._rendered is None:
            self._rendered = self.render()
        return self._rendered

    def __getitem__(self, key: str) -> Any:
        return self._made()[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._made())

    def __len__(self) -> int:
        return len(self._made())

    def __repr__(self) -> str:
        return repr(self._made())
