"""Mappings that are rendered at the first read, because most facts are never read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rosrm.model.codec import to_plain
from rosrm.model.plan import Plan
from rosrm.model.values import ProcessSpec


class Lazy(Mapping[str, Any]):
    """A mapping that is rendered once, from immutable values (a copy, a frozen spec)."""

    __slots__ = ("_rendered",)

    def __init__(self) -> None:
        self._rendered: Mapping[str, Any] | None = None

    def render(self) -> Mapping[str, Any]:
        """Return the mapping; read only immutable values."""
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


class Plain(Lazy):
    """A spec or a plan as JSON, rendered once for all the intents that contain it."""

    __slots__ = ("_value",)

    def __init__(self, value: ProcessSpec | Plan) -> None:
        super().__init__()
        self._value = value

    def render(self) -> Mapping[str, Any]:
        """Return all fields of the value."""
        plain: Mapping[str, Any] = to_plain(self._value)
        return plain
