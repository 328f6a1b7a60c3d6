"""Annotation of the start order of a process, a mapping of names that has two keys of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, get_args

from rosrm.extensions.units import Seconds
from rosrm.model.values import DependencyRestartAction, StartCondition, StartOrder

#: Keys that are no names of processes.
_OWN_KEYS: Final = ("delay", "on_restart")


@dataclass(frozen=True)
class StartOrderInFile:
    """Annotation of a start order: `{camera: ready, calibrate: finished, delay: 2s}`."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that reads the mapping."""
        from pydantic_core import core_schema as schema  # noqa: PLC0415 - only files need pydantic

        own = {"delay": handler.generate_schema(Seconds), "on_restart": _words(schema, _ACTIONS)}
        mapping = schema.typed_dict_schema(
            {key: schema.typed_dict_field(own[key], required=False) for key in _OWN_KEYS},
            extra_behavior="allow", extras_schema=_words(schema, get_args(StartCondition)),
        )  # fmt: skip
        return schema.no_info_after_validator_function(self.read, mapping)

    @staticmethod
    def read(given: Mapping[str, Any]) -> StartOrder:
        """Return the start order in a checked mapping."""
        own = {key: given[key] for key in _OWN_KEYS if key in given}
        return StartOrder({key: given[key] for key in given if key not in own}, **own)


_ACTIONS: Final = get_args(DependencyRestartAction)


def _words(schema: Any, allowed: tuple[str, ...]) -> Any:
    return schema.literal_schema(list(allowed))
