"""Mapping that is rendered when first read, because most facts are never read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


class Lazy(Mapping[str, Any]):
    """A mapping rendered once, from values that no longer change (a copy, a frozen spec)."""

    __slots__ = ("_rendered",)

    def __init__(self) -> None:
        self._rendered: Mapping[str, Any] | None = None

    def render(self) -> Mapping[str, Any]:
        """Return the mapping; read only values that no longer change."""
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
