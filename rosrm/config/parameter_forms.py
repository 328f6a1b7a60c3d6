"""Annotation of the ROS parameters of a process: a mapping, or a list of sources in order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rosrm.model.parameters import flattened, has_sections, sections_of
from rosrm.model.values import ParameterSource


@dataclass(frozen=True)
class ParametersInFile:
    """Annotation of parameters: `{rate: 10}`, or `[params.yaml, {rate: 10}]`."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema that reads a list as sources, and leaves a mapping as it is."""
        from pydantic_core import core_schema as schema  # noqa: PLC0415 - only files need pydantic

        many = schema.no_info_after_validator_function(
            lambda given: tuple(self.read(given)), schema.list_schema(schema.any_schema())
        )
        return schema.tagged_union_schema(
            {"one": handler.generate_schema(Mapping[str, Any]), "many": many},
            discriminator=lambda given: "many" if isinstance(given, (list, tuple)) else "one",
        )

    @staticmethod
    def read(given: list[Any]) -> Iterator[ParameterSource]:
        """Yield the sources in a list of paths, parameters, and contents of parameter files."""
        for number, item in enumerate(given, 1):
            if isinstance(item, str) and item:
                yield ParameterSource(file=item)
            elif has_sections(item):
                try:
                    yield from sections_of(item)
                except ValueError as error:
                    raise ValueError(f"entry {number}: {error}") from None
            elif isinstance(item, Mapping):
                yield ParameterSource(parameters=dict(flattened(item)))
            else:
                raise ValueError(
                    f"entry {number}: the path of a parameters file or a mapping is required, not "
                    f"{item!r:.60}"
                )
