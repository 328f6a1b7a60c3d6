"""Mappings that are rendered at the first read, because most facts are never read."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

from rosrm.model.codec import to_json, to_plain
from rosrm.model.plan import Plan
from rosrm.model.spec_text import spec_to_json
from rosrm.model.values import ProcessSpec

#: Types of most values in a mapping. A look-up here takes a fifth of the time of `isinstance`.
_COMMON: Final = frozenset({str, int, float, bool, type(None), dict, list, tuple})


class Lazy(Mapping[str, Any]):
    """A mapping that is rendered once, from immutable values (a copy, a frozen spec)."""

    __slots__ = ("_rendered", "_text")

    def __init__(self) -> None:
        self._rendered: Mapping[str, Any] | None = None
        self._text = ""

    def render(self) -> Mapping[str, Any]:
        """Return the mapping; read only immutable values."""
        raise NotImplementedError

    @property
    def text(self) -> str:
        """Return the mapping as JSON, encoded once for all rows of the journal that contain it."""
        if not self._text:
            self._text = self.encode()
        return self._text

    def encode(self) -> str:
        """Return the mapping as JSON."""
        return to_json(self.render() if self._rendered is None else self._rendered)

    def _made(self) -> Mapping[str, Any]:
        if self._rendered is None:
            self._rendered = json.loads(self._text) if self._text else self.render()
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

    def encode(self) -> str:
        """Return the value as JSON."""
        value = self._value
        return spec_to_json(value) if isinstance(value, ProcessSpec) else super().encode()


def mapping_to_json(value: Mapping[str, Any]) -> str:
    """Return a mapping as JSON: first its lazy values, by their `text`, then all others."""
    lazy = {
        name: item for name, item in value.items()
        if type(item) not in _COMMON and isinstance(item, Lazy)
    }  # fmt: skip
    if not lazy:
        return to_json(value)
    texts = ", ".join([f"{to_json(name)}: {item.text}" for name, item in lazy.items()])
    rest = dict(value)
    for name in lazy:
        del rest[name]
    others = to_json(rest)
    return f"{{{texts}{'' if others == '{}' else ', '}{others[1:]}"
